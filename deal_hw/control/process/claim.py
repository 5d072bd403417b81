"""The exclusive claim on a robot on this computer: a name that only one process tree can hold."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import socket
import struct
from pathlib import Path
from types import TracebackType

from typing_extensions import Self

from deal_hw.errors import PortBusyError

_PEER_CREDENTIALS = struct.Struct("3i")


class LocalClaim:
    """Holds a name as long as this process lives, or a child that inherited the descriptor.

    The name is an abstract Unix socket: a killed process leaves no file behind, no permission is needed, and
    other programs can ask for the holder. The child counts, since it makes the robot passive when its parent
    dies.

    Args:
        resource: The claimed resource, such as a transport with its address; the same text is the same claim.
    """

    def __init__(self, resource: str) -> None:
        self._resource = resource
        self._name = b"\0deal-hw/claim/" + hashlib.sha256(resource.encode()).hexdigest()[:32].encode()
        self._socket: socket.socket | None = None

    @property
    def held(self) -> bool:
        """Whether a process on this computer holds the name, this one or another."""
        with socket.socket(socket.AF_UNIX) as asking:
            asking.setblocking(False)
            # EAGAIN: the holder's queue is full.
            return asking.connect_ex(self._name) in (0, errno.EAGAIN)

    def fileno(self) -> int:
        """Return the descriptor that a child inherits."""
        if self._socket is None:
            raise RuntimeError("the claim is not held")
        return self._socket.fileno()

    def acquire(self) -> None:
        """Take the name.

        Raises:
            PortBusyError: Another run holds it; the message names it.
        """
        held = socket.socket(socket.AF_UNIX)
        try:
            held.bind(self._name)
            # Connections of other programs stay in the queue, so it must be long enough for many of them.
            held.listen()
        except OSError as error:
            held.close()
            if error.errno != errno.EADDRINUSE:
                raise
            raise PortBusyError(
                f"{self._resource}: the robot is in use by {self._holder()}. Two programs that command one "
                "robot make it jump. End the other run (Ctrl-C in its terminal), then start this one"
            ) from None
        self._socket = held

    def release(self) -> None:
        """Release the name; idempotent."""
        held, self._socket = self._socket, None
        if held is not None:
            held.close()

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()

    def _holder(self) -> str:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as asking:
            asking.setblocking(False)
            asking.connect(self._name)
            credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER_CREDENTIALS.size)
            pid, _, _ = _PEER_CREDENTIALS.unpack(credentials)
            words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
            command = " ".join(Path(word.decode(errors="replace")).name for word in words[:6] if word)
            return f"process {pid} ({command[:120]})"
        return "another run"
