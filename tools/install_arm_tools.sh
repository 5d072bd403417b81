#!/usr/bin/env bash
# Installs what the cart-pole's firmware for the STM32 is built and tried with, where that needs no password; elsewhere
# it says what to install and fails, and the tests that need it are skipped.
set -euo pipefail
. "$(dirname "$0")/debian_packages.sh"

have() { command -v arm-none-eabi-gcc >/dev/null && command -v qemu-system-arm >/dev/null; }

have || install_packages "the cart-pole's firmware for the STM32 needs gcc-arm-none-eabi and QEMU" \
  gcc-arm-none-eabi qemu-system-arm
