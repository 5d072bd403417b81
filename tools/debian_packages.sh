# Sourced by scripts that need Debian packages.

# install_packages WHAT PACKAGE...: installs them where that needs no password; elsewhere it says what WHAT needs and
# ends the script with 1, and the tests that need it are skipped. With NO_INSTALL=1 nothing is ever installed.
install_packages() {
  local what=$1 as_root=() advice install
  shift
  advice="apt-get install --yes --no-install-recommends $*"
  [ "$(id -u)" = 0 ] || as_root=(sudo --non-interactive)
  if [ "${NO_INSTALL:-}" = 1 ] || ! command -v apt-get >/dev/null \
    || { [ "$(id -u)" != 0 ] && ! sudo --non-interactive true 2>/dev/null; }; then
    echo "$what: $advice (as root)" >&2
    exit 1
  fi
  echo "$what: installing $*" >&2
  export DEBIAN_FRONTEND=noninteractive
  install=(${as_root[@]+"${as_root[@]}"} apt-get install --yes --no-install-recommends "$@")
  # The package lists may be missing (containers) or old: only then they are fetched.
  "${install[@]}" >/dev/null 2>&1 \
    || { ${as_root[@]+"${as_root[@]}"} apt-get update >/dev/null 2>&1 && "${install[@]}" >/dev/null 2>&1; } \
    || { echo "$what: the packages could not be installed; try: $advice (as root)" >&2; exit 1; }
}
