#!/usr/bin/env bash
# Builds the file system of an ARM computer (arm64, Debian 12) under QEMU, installs deal-hw in it, and runs the bridge
# there against an emulated Go2 on this computer, over DDS on loopback. What is there is not built again.
#
#   tools/arm64_robot_computer.sh ROOT CYCLONEDDS
#
# ROOT: folder of the file system, made here. CYCLONEDDS: sources of Cyclone DDS 11.0.1 (git clone --branch 11.0.1).
# QEMU=FILE names QEMU's program for arm64, version 10 or newer: older ones lack IP_MULTICAST_IF, and DDS does not start.
# Exit status: 0 the check passed, 1 it failed, 2 something is missing. As root, on x86-64.
set -euo pipefail

miss() { echo "arm64: $*" >&2; exit 2; }
note() { echo "arm64: $* ($SECONDS s)" >&2; }

[ $# = 2 ] || miss "usage: $0 ROOT CYCLONEDDS"
[ "$(id -u)" = 0 ] || miss "run it as root (debootstrap and chroot need it)"
root=$(realpath -m "$1") source=$(realpath -m "$2")
cd "$(dirname "$0")/.."
. tools/debian_packages.sh
python=$PWD/.venv/bin/python
[ -x "$python" ] || miss "first: make setup"
grep -q 'VERSION 11\.0\.1 ' "$source/CMakeLists.txt" 2>/dev/null || miss "$source is not the source of Cyclone DDS 11.0.1"
have() { command -v debootstrap aarch64-linux-gnu-gcc cmake ninja >/dev/null; }
have || (install_packages "an ARM file system" debootstrap gcc-aarch64-linux-gnu libc6-dev-arm64-cross cmake ninja-build) \
  || exit 2
qemu=${QEMU:-$(command -v qemu-aarch64 || command -v qemu-aarch64-static || true)}
[ -x "$qemu" ] || miss "install qemu-user (Debian 13) or qemu-user-static (Debian 12: from backports), or set QEMU=FILE"
[ "$("$qemu" --version | sed -n 's/.*version \([0-9]*\).*/\1/p')" -ge 10 ] \
  || miss "$qemu is older than QEMU 10; set QEMU=FILE"

# What this run adds to the system is removed at its end: the registration with the kernel, and the mounts.
kernel=/proc/sys/fs/binfmt_misc
undo() {
  local each
  for each in dev/shm dev sys proc; do
    ! mountpoint -q "$root/$each" || umount "$root/$each" || true
  done
  [ -z "${registered:-}" ] || echo -1 >$kernel/deal-hw-arm64
  [ -z "${mounted:-}" ] || umount $kernel
}
trap undo EXIT
if [ ! -e $kernel/register ]; then
  mount -t binfmt_misc binfmt_misc $kernel || miss "this kernel has no binfmt_misc"
  mounted=1
fi
if ! grep -qs "interpreter $(realpath "$qemu")\$" $kernel/*aarch64*; then
  # F: the kernel opens QEMU now, so that it needs no copy in ROOT. The last registration counts.
  magic='\x7f\x45\x4c\x46\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00'
  mask='\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff'
  echo ":deal-hw-arm64:M::$magic:$mask:$(realpath "$qemu"):OF" >$kernel/register
  registered=1
fi

if [ ! -e "$root/opt/debootstrap-done" ]; then
  [ ! -e "$root" ] || miss "$root is there but not complete; remove it or name another folder"
  mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Codename: bookworm' | head -n 1)
  debootstrap --arch=arm64 --variant=minbase --include=ca-certificates,python3,python3-venv,python3-dev,gcc,g++,libc6-dev \
    bookworm "$root" ${mirror:+"$mirror"} >"$root.log" 2>&1 || miss "debootstrap failed; see $root.log"
  touch "$root/opt/debootstrap-done"
fi
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"
mount -t proc proc "$root/proc"
mount -t sysfs sysfs "$root/sys"
mount --bind /dev "$root/dev"
mount -t tmpfs tmpfs "$root/dev/shm"
inside() { env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root PIP_CERT=/etc/ssl/certs/ca-certificates.crt "$@"; }
note "file system: $(inside chroot "$root" uname -m), $(inside chroot "$root" python3 --version)"

# Cyclone itself is compiled by a cross compiler, because GCC under QEMU takes much longer.
if [ ! -e "$root/opt/cyclonedds-11/lib/libddsc.so" ]; then
  cmake -G Ninja -S "$source" -B "$root/opt/cross" -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 \
    -DCMAKE_C_COMPILER=aarch64-linux-gnu-gcc -DCMAKE_INSTALL_PREFIX=/opt/cyclonedds-11 -DBUILD_IDLC=ON \
    -DENABLE_SSL=OFF -DENABLE_ICEORYX=OFF >"$root.log" 2>&1 || miss "cmake failed; see $root.log"
  QEMU_LD_PREFIX=$root DESTDIR=$root cmake --build "$root/opt/cross" -j 2 --target install >"$root.log" 2>&1 \
    || miss "Cyclone DDS does not build; see $root.log"
fi
note "Cyclone DDS 11.0.1"

pip() { inside CYCLONEDDS_HOME=/opt/cyclonedds-11 chroot "$root" /opt/deal-hw/bin/pip install --quiet --no-compile "$@"; }
[ -x "$root/opt/deal-hw/bin/pip" ] || inside chroot "$root" python3 -m venv /opt/deal-hw
[ -e "$root"/opt/deal-hw/lib/python3.11/site-packages/cyclonedds/core.py ] || pip --no-binary cyclonedds cyclonedds==11.0.1
copy=$(mktemp -d "$root/opt/source.XXXX")
git ls-files -z | tar --create --null --files-from - | tar --extract --directory "$copy"
rm -rf "$root/opt/built"
"$python" -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir "$root/opt/built" "$copy"
rm -rf "$copy"
cp constraints.txt "$root/opt/built/"
wheel=$(basename "$root"/opt/built/deal_hw-*.whl)
pip --constraint /opt/built/constraints.txt "/opt/built/$wheel[zenoh,deploy]"
pip --no-deps --force-reinstall "/opt/built/$wheel"
note "deal-hw: $wheel"

PYTHONPATH=tools "$python" - "$root" <<'CHECK' || { note "the check failed"; exit 1; }
"""The emulated Go2 and a controller here, the bridge under QEMU between them."""
import json, shutil, sys, tempfile
from pathlib import Path

import bridge_client
from bridge_client import BridgeClient
from bridge_rig import bridge_process, make_keys, wire
from deal_hw.clock import MonotonicClock
from deal_hw.workflows.emulation.process import VerbProcess

root, clock = sys.argv[1], MonotonicClock()
# The emulated processor is too slow for 500 commands a second beside 500 states.
bridge_client.PERIOD_NS, seconds = 10_000_000, 10.0
on_arm = ("sh", "-c", 'shift; exec chroot "$0" /opt/deal-hw/bin/python3 "$@"', root)


def rate(client, count):
    begin, first = clock.now_ns(), count()
    client.hear(lambda: clock.now_ns() - begin > seconds * 1e9)
    return round((count() - first) / ((clock.now_ns() - begin) * 1e-9), 1)


with tempfile.TemporaryDirectory() as folder:
    keys, events = Path(folder, "keys"), Path(folder, "events.jsonl")
    make_keys(keys, "127.0.0.1")
    inside = Path(root + str(keys))
    shutil.copytree(keys, inside)
    robot = ("--port", "lo", "--domain", "77", "--profile", "ideal", "--nominal", "--sport", "off")
    bridge = bridge_process(keys, 77, "tls/127.0.0.1:0", "--command-age-s", "0.5", prefix=on_arm)
    result = {}
    try:
        with VerbProcess("emulate", "go2", *robot, "--events-to", str(events)):
            begin = clock.now_ns()
            port = bridge.start()
            result["bridge_start_s"] = round((clock.now_ns() - begin) * 1e-9, 1)
            with BridgeClient(port, wire(keys, "controller")) as client:
                client.hear(lambda: client.frame is not None and bool(client.status))
                result["states_a_second"] = rate(client, lambda: client.states)
                client.take_over()
                result["commands_a_second"] = rate(client, lambda: client.status["admitted"])
                result["in_charge"] = client.in_charge
            result["bridge"] = bridge.stop()[1].strip().splitlines()
        kinds = [json.loads(line)[2] for line in events.read_text().splitlines()]
        result["commands_at_the_robot"] = [kind for kind in kinds if kind in ("stiff", "damping", "off")]
    finally:
        bridge.stop()
        shutil.rmtree(inside.parent)
        print(json.dumps(result, indent=2))
CHECK
note "the check passed"
