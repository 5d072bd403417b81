#!/usr/bin/env bash
# Installs what the cart-pole's firmware is built and simulated with, where that needs no password; elsewhere it says
# what to install and fails, and the tests that need it are skipped.
set -euo pipefail
. "$(dirname "$0")/debian_packages.sh"

have() { command -v gcc >/dev/null && command -v avr-gcc >/dev/null && [ -e /usr/include/simavr/sim_avr.h ] \
  && [ -e /usr/include/libelf.h ] && [ -e /usr/lib/avr/include/avr/io.h ]; }

have || install_packages "the cart-pole's firmware needs gcc-avr and simavr" \
  gcc libc6-dev gcc-avr avr-libc binutils-avr libsimavr-dev libelf-dev
