#!/usr/bin/env bash
# Builds the test peers on Cyclone DDS 0.10.2 into build/dds_peer/. Missing packages are installed where that needs no
# password, unless --no-install is given; elsewhere the script says what to install and fails, and the tests that need
# the peers are skipped.
set -euo pipefail
cd "$(dirname "$0")/.."
. tools/debian_packages.sh

source=tests/drivers/peer_0102
out=build/dds_peer

have() { command -v idlc >/dev/null && command -v gcc >/dev/null && [ -e /usr/include/dds/dds.h ]; }

[ "${1:-}" != --no-install ] || NO_INSTALL=1
have || install_packages "the DDS test peers need Cyclone DDS 0.10.2 (Debian 12 has it)" \
  cyclonedds-dev cyclonedds-tools gcc libc6-dev

mkdir -p "$out"
# build NAME MESSAGES: compiles $source/NAME.c with the messages of $source/MESSAGES.idl, if one of them is newer.
build() {
  local program=$out/$1 idl=$source/$2.idl
  if [ "$program" -nt "$source/$1.c" ] && [ "$program" -nt "$idl" ]; then
    return
  fi
  idlc -o "$out" "$idl"
  gcc -O2 -std=gnu11 -Wall -Wextra -Werror -I "$out" -I "/usr/include/$(gcc -print-multiarch)" \
    -o "$program.new" "$source/$1.c" "$out/$2.c" -lddsc -lm
  mv "$program.new" "$program"
}

build go2_peer go2_messages
build ros2_peer ros2_messages
