"""A stand-in of systemd-logind on a system bus of its own: real D-Bus messages and file descriptors."""

from __future__ import annotations

import array
import os
import select
import socket
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

from jeepney import DBusAddress, HeaderFields, MessageType, Parser, new_error, new_method_return, new_signal
from jeepney.low_level import Message

_MANAGER = DBusAddress("/org/freedesktop/login1", interface="org.freedesktop.login1.Manager")


class FakeLogind:
    """The bus and logind in one; a context manager.

    Attributes:
        address: For the environment variable DBUS_SYSTEM_BUS_ADDRESS.
        asked: What was asked for: what, who, why, mode.
        matches: Rules of the signals that a client wants.

    Args:
        folder: For the socket.
        refuse: Modes that are refused, as polkit does for a session over ssh.
        hangs: Whether the bus accepts a connection, and then does nothing.
    """

    def __init__(self, folder: Path, refuse: tuple[str, ...] = (), *, hangs: bool = False) -> None:
        self._path = folder / "bus"
        self.address = f"unix:path={self._path}"
        self._refuse, self._hangs = refuse, hangs
        self.asked: list[tuple[str, str, str, str]] = []
        self.matches: list[str] = []
        self._locks: dict[str, int] = {}
        self._listener = socket.socket(socket.AF_UNIX)
        self._client: socket.socket | None = None
        self._serial = 0
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        self._listener.bind(str(self._path))
        self._listener.listen()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for end in (self._listener, self._client):
            if end is not None:
                try:
                    end.shutdown(socket.SHUT_RDWR)
                except OSError:
                    pass
                end.close()
        self._thread.join()
        for lock in self._locks.values():
            os.close(lock)

    def released(self, mode: str, timeout_s: float = 20.0) -> bool:
        """Return whether a lock is released, at once or within the time [s]."""
        return bool(select.select([self._locks[mode]], [], [], timeout_s)[0])

    def prepare_for_sleep(self, begins: bool = True) -> None:
        """Say that the computer is about to sleep, or that it is awake again."""
        assert self._client is not None
        self._send(self._client, new_signal(_MANAGER, "PrepareForSleep", "b", (begins,)))

    def _serve(self) -> None:
        try:
            self._client, _ = self._listener.accept()
            if not self._hangs:
                self._answer(self._client, self._authenticate(self._client))
        except OSError:
            return

    def _authenticate(self, client: socket.socket) -> bytes:
        """Answer the lines before the first message; return what came after them."""
        answers = {b"AUTH": b"OK 1234deadbeef\r\n", b"NEGOTIATE_UNIX_FD": b"AGREE_UNIX_FD\r\n"}
        received = b""
        while True:
            line, end, rest = received.partition(b"\r\n")
            if not end:
                received += client.recv(4096)
            elif line == b"BEGIN":
                return rest
            else:
                client.sendall(answers[line.strip(b"\0").partition(b" ")[0]])
                received = rest

    def _answer(self, client: socket.socket, data: bytes) -> None:
        parser = Parser()
        while True:
            parser.add_data(data)
            while (message := parser.get_next_message()) is not None:
                if message.header.message_type is MessageType.method_call:
                    self._reply(client, message)
            if not (data := client.recv(4096)):
                return

    def _reply(self, client: socket.socket, message: Message) -> None:
        match message.header.fields[HeaderFields.member]:
            case "Hello":
                self._send(client, new_method_return(message, "s", (":1.7",)))
            case "AddMatch":
                self.matches.append(message.body[0])
                self._send(client, new_method_return(message))
            case "Inhibit":
                what, who, why, mode = message.body
                self.asked.append((what, who, why, mode))
                if mode in self._refuse:
                    name = "org.freedesktop.DBus.Error.AccessDenied"
                    self._send(client, new_error(message, name, "s", ("Permission denied",)))
                    return
                ours, theirs = os.pipe()
                self._locks[mode] = ours
                self._send(client, new_method_return(message, "h", (theirs,)))
                os.close(theirs)

    def _send(self, client: socket.socket, message: Message) -> None:
        self._serial += 1
        descriptors = array.array("i")
        data = message.serialise(serial=self._serial, fds=descriptors)
        client.sendmsg([data], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, descriptors)] if descriptors else [])
