"""Limits of a process that opens a network from anywhere: memory, time, files, network, other processes.

The system call filter is a seccomp program. It needs no rights, holds for all threads and cannot be lifted. A
call that it refuses fails with EPERM, as if the process had no right to it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import math
import os
import platform
import resource
import struct
import time
from pathlib import Path
from typing import Final

_SET_NO_NEW_PRIVILEGES, _SET_SECCOMP, _FILTER = 38, 22, 2
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _REFUSE = 0x7FFF_0000, 0x0005_0000 | errno.EPERM
_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16
"""Places in the kernel's description of a call (struct seccomp_data); an argument has 8 bytes."""
_X32: Final = 0x4000_0000
"""First number of x86_64's second table of calls."""
_CHANGES: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC

_REFUSED: Final = {
    "network": (
        "socket socketpair connect bind listen accept accept4 sendto sendmsg sendmmsg recvmsg recvmmsg "
        "io_uring_setup io_uring_enter io_uring_register"
    ),
    "programs": (
        "execve execveat ptrace process_vm_readv process_vm_writev kill tkill tgkill pidfd_open "
        "pidfd_getfd pidfd_send_signal rt_sigqueueinfo rt_tgsigqueueinfo setns unshare bpf perf_event_open "
        "keyctl add_key request_key userfaultfd shmget shmat msgget semget mq_open"
    ),
    "files": (
        "creat truncate rename renameat renameat2 unlink unlinkat mkdir mkdirat mknod mknodat rmdir link "
        "linkat symlink symlinkat chmod fchmodat fchmodat2 chown lchown fchownat utimensat setxattr "
        "lsetxattr mount umount2 move_mount open_tree fsopen chroot pivot_root openat2 open_by_handle_at "
        "name_to_handle_at"
    ),
}
"""Calls that a process which computes needs for nothing."""
# From the kernel's tables, arch/x86/entry/syscalls/syscall_64.tbl and include/uapi/asm-generic/unistd.h.
_X86_64: Final = {
    **{"socket": 41, "connect": 42, "accept": 43, "sendto": 44, "sendmsg": 46, "recvmsg": 47, "bind": 49},
    **{"listen": 50, "socketpair": 53, "execve": 59, "kill": 62, "shmget": 29, "shmat": 30, "semget": 64},
    **{"msgget": 68, "truncate": 76, "rename": 82, "mkdir": 83, "rmdir": 84, "creat": 85, "link": 86},
    **{"unlink": 87, "symlink": 88, "chmod": 90, "chown": 92, "lchown": 94, "ptrace": 101, "mknod": 133},
    **{"rt_sigqueueinfo": 129, "pivot_root": 155, "chroot": 161, "mount": 165, "umount2": 166},
    **{"setxattr": 188, "lsetxattr": 189, "tkill": 200, "tgkill": 234, "mq_open": 240, "add_key": 248},
    **{"request_key": 249, "keyctl": 250, "mkdirat": 258, "mknodat": 259, "fchownat": 260, "unlinkat": 263},
    **{"renameat": 264, "linkat": 265, "symlinkat": 266, "fchmodat": 268, "unshare": 272, "utimensat": 280},
    **{"accept4": 288, "rt_tgsigqueueinfo": 297, "perf_event_open": 298, "recvmmsg": 299},
    **{"name_to_handle_at": 303, "open_by_handle_at": 304, "sendmmsg": 307, "setns": 308},
    **{"process_vm_readv": 310, "process_vm_writev": 311, "renameat2": 316, "bpf": 321, "execveat": 322},
    **{"userfaultfd": 323},
}
_AARCH64: Final = {
    **{"setxattr": 5, "lsetxattr": 6, "mknodat": 33, "mkdirat": 34, "unlinkat": 35, "symlinkat": 36},
    **{"linkat": 37, "renameat": 38, "umount2": 39, "mount": 40, "pivot_root": 41, "truncate": 45},
    **{"chroot": 51, "fchmodat": 53, "fchownat": 54, "utimensat": 88, "unshare": 97, "ptrace": 117},
    **{"kill": 129, "tkill": 130, "tgkill": 131, "rt_sigqueueinfo": 138, "mq_open": 180, "msgget": 186},
    **{"semget": 190, "shmget": 194, "shmat": 196, "socket": 198, "socketpair": 199, "bind": 200},
    **{"listen": 201, "accept": 202, "connect": 203, "sendto": 206, "sendmsg": 211, "recvmsg": 212},
    **{"add_key": 217, "request_key": 218, "keyctl": 219, "execve": 221, "rt_tgsigqueueinfo": 240},
    **{"perf_event_open": 241, "accept4": 242, "recvmmsg": 243, "name_to_handle_at": 264},
    **{"open_by_handle_at": 265, "setns": 268, "sendmmsg": 269, "process_vm_readv": 270},
    **{"process_vm_writev": 271, "renameat2": 276, "bpf": 280, "execveat": 281, "userfaultfd": 282},
}
_BOTH: Final = {
    **{"pidfd_send_signal": 424, "io_uring_setup": 425, "io_uring_enter": 426, "io_uring_register": 427},
    **{"open_tree": 428, "move_mount": 429, "fsopen": 430, "pidfd_open": 434, "openat2": 437},
    **{"pidfd_getfd": 438, "fchmodat2": 452},
}
_OPEN: Final = {"x86_64": {2: 1, 257: 2}, "aarch64": {56: 2}}
"""Calls that open a file, and which of their arguments holds the flags."""
_MACHINES: Final = {"x86_64": (0xC000_003E, _X86_64), "aarch64": (0xC000_00B7, _AARCH64)}


def limit(memory: int, seconds: int) -> None:
    """Limit the memory beyond what is in use now [B], and the processor time from now on [s].

    No dump of the memory is written.
    """
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    for kind, most in (
        (resource.RLIMIT_AS, in_use + memory),
        # The kernel ends an endless network with SIGXCPU.
        (resource.RLIMIT_CPU, math.ceil(time.process_time()) + seconds),
        (resource.RLIMIT_CORE, 0),
    ):
        _limit(kind, most)


def cut_off() -> str:
    """Refuse this process, for ever, network, other programs and changes of files.

    Files can still be read, since libraries load parts of themselves on use. Connections that are open now
    stay.

    Returns:
        Why that could not be done; "" if it was.
    """
    machine = platform.machine()
    if machine not in _MACHINES:
        _limit(resource.RLIMIT_FSIZE, 0)
        return f"no filter of system calls is known for {machine}"
    program = _program(machine)
    filled = ctypes.create_string_buffer(program, len(program))

    class Program(ctypes.Structure):
        _fields_ = [("length", ctypes.c_ushort), ("filter", ctypes.c_void_p)]

    given = Program(len(program) // 8, ctypes.addressof(filled))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_SET_NO_NEW_PRIVILEGES, 1, 0, 0, 0) == 0 and (
        libc.prctl(_SET_SECCOMP, _FILTER, ctypes.byref(given), 0, 0) == 0
    ):
        return ""
    # It stops the writing of files at least, error output included.
    _limit(resource.RLIMIT_FSIZE, 0)
    return f"the kernel refuses a filter of system calls ({os.strerror(ctypes.get_errno())})"


def _limit(kind: int, most: int) -> None:
    hard = resource.getrlimit(kind)[1]
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _program(machine: str) -> bytes:
    """Return the filter: refuse the calls of the tables, and files opened to change; allow the rest."""
    architecture, own = _MACHINES[machine]
    numbers = {**own, **_BOTH}
    refused = [numbers[name] for text in _REFUSED.values() for name in text.split() if name in numbers]
    lines = [
        _line(_LOAD, _ARCHITECTURE),
        # A call in another machine's numbers would pass by the table.
        _line(_EQUAL, architecture, 1, 0),
        _line(_RETURN, _REFUSE),
        _line(_LOAD, _NUMBER),
        _line(_AT_LEAST, _X32, 0, 1),
        _line(_RETURN, _REFUSE),
    ]
    for number in refused:
        lines += [_line(_EQUAL, number, 0, 1), _line(_RETURN, _REFUSE)]
    for number, argument in _OPEN[machine].items():
        lines += [
            _line(_EQUAL, number, 0, 4),
            _line(_LOAD, _ARGUMENTS + 8 * argument),
            _line(_ANY_BIT, _CHANGES, 0, 1),
            _line(_RETURN, _REFUSE),
            _line(_RETURN, _ALLOW),
        ]
    return b"".join([*lines, _line(_RETURN, _ALLOW)])


def _line(code: int, value: int, then: int = 0, otherwise: int = 0) -> bytes:
    """Return an instruction; jumps count the instructions that are skipped."""
    return struct.pack("=HBBI", code, then, otherwise, value)
