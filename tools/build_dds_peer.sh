#!/usr/bin/env bash
# Builds the test peer on Cyclone DDS 0.10.2 into build/dds_peer/. Missing packages are installed where that needs no
# password, unless --no-install is given; elsewhere the script says what to install and fails, and the tests that need
# the peer are skipped.
set -euo pipefail
cd "$(dirname "$0")/.."

packages=(cyclonedds-dev cyclonedds-tools gcc libc6-dev)
advice="apt-get install --yes --no-install-recommends ${packages[*]}"
source=tests/drivers/peer_0102
out=build/dds_peer

have() { command -v idlc >/dev/null && command -v gcc >/dev/null && [ -e /usr/include/dds/dds.h ]; }

if ! have; then
  as_root=()
  [ "$(id -u)" = 0 ] || as_root=(sudo --non-interactive)
  if [ "${1:-}" = --no-install ] || ! command -v apt-get >/dev/null \
    || { [ "$(id -u)" != 0 ] && ! sudo --non-interactive true 2>/dev/null; }; then
    echo "the DDS test peer needs Cyclone DDS 0.10.2 (Debian 12 has it): $advice (as root)" >&2
    exit 1
  fi
  echo "installing ${packages[*]} for the DDS test peer" >&2
  export DEBIAN_FRONTEND=noninteractive
  install=(${as_root[@]+"${as_root[@]}"} apt-get install --yes --no-install-recommends "${packages[@]}")
  # The package lists may be missing (containers) or old: only then they are fetched.
  "${install[@]}" >/dev/null 2>&1 \
    || { ${as_root[@]+"${as_root[@]}"} apt-get update >/dev/null 2>&1 && "${install[@]}" >/dev/null 2>&1; } \
    || { echo "the DDS test peer could not be built; try: $advice (as root)" >&2; exit 1; }
fi

mkdir -p "$out"
if [ "$out/go2_peer" -nt "$source/go2_peer.c" ] && [ "$out/go2_peer" -nt "$source/go2_messages.idl" ]; then
  exit 0
fi
idlc -o "$out" "$source/go2_messages.idl"
gcc -O2 -std=gnu11 -Wall -Wextra -Werror -I "$out" -I "/usr/include/$(gcc -print-multiarch)" \
  -o "$out/go2_peer.new" "$source/go2_peer.c" "$out/go2_messages.c" -lddsc -lm
mv "$out/go2_peer.new" "$out/go2_peer"
