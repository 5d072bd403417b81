#!/usr/bin/env bash
# Builds the test peer on Fast DDS 2.9 into build/fastdds_peer/. Without the headers in /usr/include, Debian 12's packages
# are downloaded and unpacked there, which needs no password. With --no-install nothing is downloaded: then the script
# says what to do and fails, and the tests that need the peer are skipped.
set -euo pipefail
cd "$(dirname "$0")/.."

source=tests/drivers/peer_fastdds/ros2_peer.cpp
out=build/fastdds_peer
mkdir -p "$out"
[ ! "$out/ros2_peer" -nt "$source" ] || exit 0

root=$out/root
[ ! -d /usr/include/fastdds ] || root=
fail() { echo "the Fast DDS test peer: $1" >&2; exit 1; }
command -v g++ >/dev/null || fail "apt-get install --yes g++ (as root)"
if [ -n "$root" ] && [ ! -d "$root/usr/include/fastdds" ]; then
  [ "${1:-}" != --no-install ] || fail "tools/build_fastdds_peer.sh downloads what it needs"
  mkdir -p "$out/packages"
  (cd "$out/packages" && apt-get download libfastrtps-dev libfastrtps2.9 libfastcdr-dev libfastcdr1 libtinyxml2-9 \
    libfoonathan-memory-dev libfoonathan-memory0.7.2 libasio-dev >/dev/null 2>&1) \
    || fail "apt-get download libfastrtps-dev (Debian 12 has it) and what it needs failed; try apt-get update (as root)"
  for package in "$out"/packages/*.deb; do dpkg-deb --extract "$package" "$out/new"; done
  mv "$out/new" "$root"
fi
libraries=$(realpath "${root:-/}")/usr/lib/$(gcc -print-multiarch)
# An rpath that libraries of libraries are looked up in, too, which new dtags have not.
g++ -O1 -std=c++17 -Wall -Wextra -Werror ${root:+-isystem "$root/usr/include" -isystem "$root/usr/include/$(gcc -print-multiarch)"} \
  -o "$out/ros2_peer.new" "$source" \
  -L "$libraries" -lfastrtps -lfastcdr -Wl,--disable-new-dtags,-rpath,"$libraries",-rpath-link,"$libraries"
mv "$out/ros2_peer.new" "$out/ros2_peer"
