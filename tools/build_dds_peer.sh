#!/usr/bin/env bash
# Builds the test peer on Cyclone DDS 0.10.2 into build/dds_peer/. Missing packages are installed where that needs no
# password, unless --no-install is given; elsewhere the script says what to install and fails, and the tests that need
# the peer are skipped.
set -euo pipefail
cd "$(dirname "$0")/.."
. tools/debian_packages.sh

source=tests/drivers/peer_0102
out=build/dds_peer

have() { command -v idlc >/dev/null && command -v gcc >/dev/null && [ -e /usr/include/dds/dds.h ]; }

[ "${1:-}" != --no-install ] || NO_INSTALL=1
have || install_packages "the DDS test peer needs Cyclone DDS 0.10.2 (Debian 12 has it)" \
  cyclonedds-dev cyclonedds-tools gcc libc6-dev

mkdir -p "$out"
if [ "$out/go2_peer" -nt "$source/go2_peer.c" ] && [ "$out/go2_peer" -nt "$source/go2_messages.idl" ]; then
  exit 0
fi
idlc -o "$out" "$source/go2_messages.idl"
gcc -O2 -std=gnu11 -Wall -Wextra -Werror -I "$out" -I "/usr/include/$(gcc -print-multiarch)" \
  -o "$out/go2_peer.new" "$source/go2_peer.c" "$out/go2_messages.c" -lddsc -lm
mv "$out/go2_peer.new" "$out/go2_peer"
