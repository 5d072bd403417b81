"""Real-time scheduling and memory locking for a process with deadlines."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from deal_hw.child_process import signal_at_end_of_parent
from deal_hw.priorities import FIFO_PRIORITY

_MCL_CURRENT, _MCL_FUTURE = 1, 2
PARENT_DIED = signal.SIGUSR1
"""Signal that the kernel sends when the parent dies. Another program may send it, too: see
:func:`parent_is_gone`."""
_MCL_ONFAULT = 4
_PF_EXITING = 4


@dataclass(frozen=True, slots=True)
class Granted:
    """What the operating system granted.

    Attributes:
        scheduling: Scheduling and memory, as text for the report on loop timing.
        warnings: Refused requests with their remedy; empty if all were granted.
    """

    scheduling: str
    warnings: tuple[str, ...]


def become_realtime() -> Granted:
    """Ask for SCHED_FIFO and locked memory and freeze the garbage collector; call once, after all imports.

    A refusal is a warning, not an error: the loop still runs, but less regularly.
    """
    words: list[str] = []
    warnings: list[str] = []
    gc.collect()
    gc.freeze()
    # Before SCHED_FIFO: locking reads every page of every library, which must not delay a process with a
    # deadline.
    memory_refused = _lock_memory()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        words.append("SCHED_FIFO")
    except OSError as err:
        words.append("default")
        warnings.append(
            f"SCHED_FIFO was refused ({err.strerror}): expect late cycles under load. Remedy: an rtprio "
            "line for this user in /etc/security/limits.conf, or CAP_SYS_NICE"
        )
    if memory_refused is None:
        words.append("mlockall")
    else:
        warnings.append(
            f"mlockall was refused ({memory_refused}): a page fault may delay a cycle. Remedy: a memlock "
            "line for this user in /etc/security/limits.conf, or CAP_IPC_LOCK"
        )
    return Granted(" + ".join(words), tuple(warnings))


@contextlib.contextmanager
def priority(level: int, *, children: bool = False, lock: bool = False) -> Iterator[None]:
    """Run the calling thread under SCHED_FIFO inside the block if permitted; otherwise do nothing.

    Args:
        level: The priority.
        children: Whether threads and processes started inside inherit it.
        lock: Whether to keep the process's pages in memory, so that it is not swapped out.
    """
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    policy = os.SCHED_FIFO | (0 if children else os.SCHED_RESET_ON_FORK)
    libc = ctypes.CDLL(None) if lock else None
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(level))
    if libc is not None:
        libc.mlockall(_MCL_CURRENT | _MCL_ONFAULT)
    try:
        yield
    finally:
        if libc is not None:
            libc.munlockall()
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, *before)


def raise_priority(pid: int) -> None:
    """Give the threads of a process real-time priority if permitted, so that a killed process ends sooner.

    It ends only after each of its threads has run once more. On a busy machine threads of ordinary priority,
    such as those of a network's runtime, take hundreds of ms.
    """
    with contextlib.suppress(OSError):
        for thread in os.listdir(f"/proc/{pid}/task"):
            with contextlib.suppress(OSError):
                os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))


def hurry_the_dying() -> None:
    """Give real-time priority to all processes that are ending, if permitted.

    A killed one keeps its ports and claims until its last thread has run once more. By then the kernel does
    not show any more which program it was.
    """
    for pid in os.listdir("/proc"):
        if pid.isdigit() and is_ending(int(pid)):
            raise_priority(int(pid))


def _lock_memory() -> str | None:
    """Lock the process's memory; return the reason of a refusal."""
    # With MCL_FUTURE under a finite limit, a later allocation beyond it fails and kills the loop in the
    # middle of a run; so future pages are locked only where there is no limit.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY or os.geteuid() == 0
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | (_MCL_FUTURE if unlimited else 0)) == 0:
        return None
    return os.strerror(ctypes.get_errno())


def die_with_parent(parent_pid: int) -> None:
    """Have the kernel send ``PARENT_DIED`` when the parent dies, so that the loop ends by its passive route.

    See :func:`deal_hw.child_process.signal_at_end_of_parent`.
    """
    signal_at_end_of_parent(parent_pid, PARENT_DIED)


def parent_is_gone(parent_pid: int) -> bool:
    """Return whether the parent has ended, or is ending at this moment.

    A parent with several threads still has its process id when the kernel sends ``PARENT_DIED``. The kernel
    then shows that it is exiting, or has SIGKILL pending.

    Args:
        parent_pid: The parent's process id, as the parent gave it.
    """
    if os.getppid() != parent_pid:
        return True
    if not _stat(parent_pid):
        return Path("/proc/self/stat").exists()
    return is_ending(parent_pid)


def is_ending(pid: int) -> bool:
    """Return whether a process is ending at this moment, or has ended."""
    words = _stat(pid)
    if not words:
        return True
    state, flags, pending = words[0], int(words[6]), int(words[28])
    return state in "ZX" or bool(flags & _PF_EXITING) or bool(pending & 1 << signal.SIGKILL - 1)


def process_state(pid: int) -> str:
    """Return a process's state as the kernel shows it, such as "T" for stopped; "X" where there is none."""
    return (_stat(pid) or ["X"])[0]


def _stat(pid: int) -> list[str]:
    """Return what the kernel says of a process, from its state on; empty where there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


class _Event(ctypes.Structure):
    """``struct sigevent``, 64 bytes."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("rest", ctypes.c_byte * 48),
    )


class _Times(ctypes.Structure):
    """``struct itimerspec``: interval, then time left, each in seconds and nanoseconds."""

    _fields_ = (("interval", ctypes.c_long * 2), ("left", ctypes.c_long * 2))


def kill_self_after(seconds: float) -> None:
    """Have the kernel kill this process after a time [s]: the last resort of an orphan.

    The timer sends SIGKILL, which nothing holds back. SIGALRM would need its default action, and the SIGALRM
    of another program would then end this process before the robot is passive.
    """
    timer = ctypes.c_void_p()
    event, times = _Event(signal=signal.SIGKILL), _Times(left=(int(seconds), round(seconds % 1 * 1e9)))
    for library in (None, "librt.so.1"):
        with contextlib.suppress(OSError, AttributeError):
            libc = ctypes.CDLL(library, use_errno=True)
            # Before glibc 2.34 these are in librt.
            libc.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer))
            libc.timer_settime(timer, 0, ctypes.byref(times), None)
            return
