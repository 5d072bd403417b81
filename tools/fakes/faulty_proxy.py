"""A TCP connection that can freeze, be reset and be refused, as a robot's link can."""

from __future__ import annotations

import contextlib
import selectors
import socket
import struct
import threading
from types import TracebackType
from typing import Literal

from typing_extensions import Self

from deal_hw.control.process.realtime import priority
from deal_hw.priorities import TRANSPORT_PRIORITY

State = Literal["open", "frozen", "refused"]
_READ = 65536
_RESET_AT_ONCE = struct.pack("ii", 1, 0)
_JOIN_S = 5.0


class FaultyProxy:
    """Forwards TCP connections from a port of its own to a target; a context manager.

    Frozen, nothing passes in either direction and nothing is closed, as behind a switch that restarts: what
    was sent meanwhile waits in the kernel's buffers and arrives late. Refused, each connection ends with a
    reset and new ones are refused, as where the program at the other end restarts.

    Attributes:
        port: Its port on 127.0.0.1.

    Args:
        target: Host and port to forward to.
    """

    def __init__(self, target: tuple[str, int]) -> None:
        self._target = target
        self.port = 0
        self._state: State = "open"
        self._wanted: State = "open"
        self._ending = False
        self._changed = threading.Condition()
        self._selector = selectors.DefaultSelector()
        self._wake, self._woken = socket.socketpair()
        self._listener: socket.socket | None = None
        self._pairs: dict[socket.socket, socket.socket] = {}
        self._waiting: dict[socket.socket, bytes] = {}
        self._thread = threading.Thread(target=self._run, name="faulty proxy", daemon=True)

    def __enter__(self) -> Self:
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._listen()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending = True
        self._wake.send(b"!")
        self._thread.join(_JOIN_S)

    def set(self, state: State) -> None:
        """Change the treatment of connections; returns when it is in force.

        Raises:
            TimeoutError: The thread does not answer.
        """
        with self._changed:
            self._wanted = state
            self._wake.send(b"!")
            if not self._changed.wait_for(lambda: self._state == state, _JOIN_S):
                raise TimeoutError("the proxy does not answer")

    def _listen(self) -> None:
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", self.port))
        listener.listen(16)
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self._listener = listener
        self._selector.register(listener, selectors.EVENT_READ)

    def _run(self) -> None:
        with priority(TRANSPORT_PRIORITY):
            while not self._ending:
                for key, events in self._selector.select():
                    if key.fileobj is self._woken:
                        self._woken.recv(4096)
                    elif key.fileobj is self._listener:
                        self._accept(self._listener)
                    elif isinstance(key.fileobj, socket.socket) and key.fileobj in self._pairs:
                        self._move(key.fileobj, events)
                if self._wanted != self._state:
                    self._change()
        for end in [*self._pairs, self._listener, self._woken, self._wake]:
            if end is not None:
                end.close()
        self._selector.close()

    def _change(self) -> None:
        with self._changed:
            if self._wanted == "refused" and self._listener is not None:
                self._forget(self._listener)
                self._listener = None
                for end in list(self._pairs):
                    self._drop(end, reset=True)
            if self._state == "refused":
                self._listen()
            self._state = self._wanted
            for end in self._pairs:
                self._watch(end)
            self._changed.notify_all()

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            near, _ = listener.accept()
            try:
                far = socket.create_connection(self._target, 1.0)
            except OSError:
                near.close()
                return
            for end, other in ((near, far), (far, near)):
                end.setblocking(False)
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._pairs[end], self._waiting[end] = other, b""
            for end in (near, far):
                self._watch(end)

    def _watch(self, end: socket.socket) -> None:
        """Read if the other end takes more, write if data wait; neither while frozen."""
        events = 0
        if self._state != "frozen":
            events |= 0 if self._waiting[self._pairs[end]] else selectors.EVENT_READ
            events |= selectors.EVENT_WRITE if self._waiting[end] else 0
        known = end in self._selector.get_map()
        if events and known:
            self._selector.modify(end, events)
        elif events:
            self._selector.register(end, events)
        elif known:
            self._selector.unregister(end)

    def _move(self, end: socket.socket, events: int) -> None:
        other = self._pairs[end]
        try:
            if events & selectors.EVENT_READ:
                data = end.recv(_READ)
                if not data:
                    self._drop(end)
                    return
                self._waiting[other] += data
                self._write(other)
            if events & selectors.EVENT_WRITE:
                self._write(end)
        except BlockingIOError:
            pass
        except OSError:
            self._drop(end, reset=True)
            return
        self._watch(end)
        self._watch(other)

    def _write(self, end: socket.socket) -> None:
        with contextlib.suppress(BlockingIOError):
            self._waiting[end] = self._waiting[end][end.send(self._waiting[end]) :]

    def _drop(self, end: socket.socket, *, reset: bool = False) -> None:
        for one in (end, self._pairs.get(end)):
            if one is not None and one in self._pairs:
                if reset:
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_AT_ONCE)
                self._forget(one)
                del self._waiting[one]
        other = self._pairs.pop(end, None)
        if other is not None:
            self._pairs.pop(other, None)

    def _forget(self, end: socket.socket) -> None:
        with contextlib.suppress(KeyError):
            self._selector.unregister(end)
        end.close()
