"""Checks of `deal-hw doctor` on this computer, without a robot."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import resource
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from deal_hw.errors import DealHwError, short
from deal_hw.findings import Finding, Severity
from deal_hw.install import install_line
from deal_hw.priorities import FIFO_PRIORITY

PACKAGES: Final = (
    ("eclipse-zenoh", "zenoh"),
    ("cyclonedds", "dds"),
    ("mujoco", "sim"),
    ("torch", "calib"),
    ("rerun-sdk", "viz"),
    ("onnxruntime", "deploy"),
    ("python-can", "can"),
    ("cantools", "can"),
    ("dynamixel-sdk", "dynamixel"),
)
"""Distribution, extra that installs it."""
_LEAST_LOCK_BYTES: Final = 512 << 20
_COARSE_S: Final = 1e-5
_LEAST_RECEIVE_BYTES: Final = 200_000
_AGREES_RAD: Final = 1e-5


def examine_machine(packages: Sequence[tuple[str, str]] = PACKAGES) -> Iterator[Finding]:
    """Yield the findings; ``packages`` are distributions and the extras that install them."""
    yield _system()
    yield from _packages(packages)
    yield from _gpu()
    yield _scheduling()
    yield _memory()
    yield from _clock()
    yield _receive_buffer()


def _system() -> Finding:
    text = f"Python {platform.python_version()} on {platform.system()} {platform.release()}, "
    text += f"{platform.machine()}, {os.cpu_count()} processors"
    if sys.platform != "linux":
        return Finding("system", Severity.FAIL, text, "deal-hw drives robots from Linux only")
    return Finding("system", Severity.OK, text)


def _packages(packages: Sequence[tuple[str, str]]) -> Iterator[Finding]:
    for name, extra in packages:
        if version := _version(name):
            yield Finding("packages", Severity.OK, f"{name} {version}")
        else:
            hint = f"if this computer needs it: {install_line(extra)}"
            yield Finding("packages", Severity.NOTE, f"{name} is not installed", hint)


def _gpu() -> Iterator[Finding]:
    """Yield whether `--engine warp` has a GPU that agrees with MuJoCo, where its packages are installed."""
    if not _version("mujoco-warp"):
        return
    from deal_hw.sim.engine.gpu import gpu_problem

    problem = gpu_problem()
    if problem:
        hint = "look at `nvidia-smi`; `--engine mujoco` needs no GPU"
        yield Finding("gpu", Severity.NOTE, f"{problem}: `--engine warp` cannot run", hint)
        return
    from deal_hw.sim.engine.warp_check import difference_from_mujoco

    try:
        difference = difference_from_mujoco()
    except (DealHwError, RuntimeError) as err:
        hint = "update the NVIDIA driver; `--engine mujoco` needs no GPU"
        yield Finding("gpu", Severity.WARN, f"the GPU cannot simulate a pendulum: {short(str(err))}", hint)
        return
    text = f"the GPU simulates a pendulum as MuJoCo does to {difference:.1g} rad in 0.1 s"
    if difference < _AGREES_RAD:
        yield Finding("gpu", Severity.OK, text)
    else:
        hint = f"less than {_AGREES_RAD:g} rad is expected in float32: use `--engine mujoco`"
        yield Finding("gpu", Severity.WARN, text, hint)


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _scheduling() -> Finding:
    allowed = _may_use_fifo()
    if allowed:
        return Finding("scheduling", Severity.OK, f"SCHED_FIFO with priority {FIFO_PRIORITY} is permitted")
    return Finding(
        "scheduling",
        Severity.WARN,
        "SCHED_FIFO is refused: cycles will be late when the computer is busy",
        f"write `{_user()} - rtprio {FIFO_PRIORITY + 20}` into /etc/security/limits.conf and log in again, "
        "or give the Python interpreter CAP_SYS_NICE",
    )


def _may_use_fifo() -> bool:
    """Try it in a child process, so that this one keeps its scheduling."""
    child = os.fork()
    if child == 0:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        except OSError:
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def _memory() -> Finding:
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if os.geteuid() == 0 or soft == resource.RLIM_INFINITY or soft >= _LEAST_LOCK_BYTES:
        return Finding("memory", Severity.OK, "memory can be locked")
    return Finding(
        "memory",
        Severity.WARN,
        f"only {soft >> 20} MiB of memory can be locked: a page fault may delay a cycle",
        f"write `{_user()} - memlock unlimited` into /etc/security/limits.conf and log in again",
    )


def _clock() -> Iterator[Finding]:
    resolution_s = time.get_clock_info("monotonic").resolution
    source = _read("/sys/devices/system/clocksource/clocksource0/current_clocksource") or "unknown"
    text = f"the monotonic clock has {resolution_s * 1e9:.0f} ns resolution, source {source}"
    if resolution_s > _COARSE_S or source in ("jiffies", "acpi_pm"):
        yield Finding(
            "clock", Severity.WARN, text, "time stamps will be coarse; choose the clock source tsc or hpet"
        )
    else:
        yield Finding("clock", Severity.OK, text)
    governor = _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if governor and governor != "performance":
        yield Finding(
            "clock",
            Severity.NOTE,
            f"the processor's frequency governor is {governor}",
            "for faster wake-ups: `cpupower frequency-set -g performance`",
        )


def _receive_buffer() -> Finding:
    most = int(_read("/proc/sys/net/core/rmem_max") or 0)
    text = f"sockets may buffer {most // 1000} kB of received data"
    if most >= _LEAST_RECEIVE_BYTES:
        return Finding("network", Severity.OK, text)
    return Finding("network", Severity.WARN, text, "sysctl -w net.core.rmem_max=2097152")


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _user() -> str:
    return os.environ.get("USER") or f"#{os.getuid()}"
