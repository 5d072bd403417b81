#!/usr/bin/env bash
# Installs what the cart-pole's firmware is built and simulated with, where that needs no password; elsewhere it says
# what to install and fails, and the tests that need it are skipped.
set -euo pipefail

packages=(gcc libc6-dev gcc-avr avr-libc binutils-avr libsimavr-dev libelf-dev)
advice="apt-get install --yes --no-install-recommends ${packages[*]}"

have() { command -v gcc >/dev/null && command -v avr-gcc >/dev/null && [ -e /usr/include/simavr/sim_avr.h ] \
  && [ -e /usr/include/libelf.h ] && [ -e /usr/lib/avr/include/avr/io.h ]; }

have && exit 0
as_root=()
[ "$(id -u)" = 0 ] || as_root=(sudo --non-interactive)
if ! command -v apt-get >/dev/null || { [ "$(id -u)" != 0 ] && ! sudo --non-interactive true 2>/dev/null; }; then
  echo "the cart-pole's firmware needs gcc-avr and simavr: $advice (as root)" >&2
  exit 1
fi
echo "installing ${packages[*]} for the cart-pole's firmware" >&2
export DEBIAN_FRONTEND=noninteractive
install=(${as_root[@]+"${as_root[@]}"} apt-get install --yes --no-install-recommends "${packages[@]}")
# The package lists may be missing (containers) or old: only then they are fetched.
"${install[@]}" >/dev/null 2>&1 \
  || { ${as_root[@]+"${as_root[@]}"} apt-get update >/dev/null 2>&1 && "${install[@]}" >/dev/null 2>&1; } \
  || { echo "gcc-avr and simavr could not be installed; try: $advice (as root)" >&2; exit 1; }
