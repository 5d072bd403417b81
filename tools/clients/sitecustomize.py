"""Gives other people's programs the emulated port or bus in place of the one that they open by name.

Python runs this file at its start where the folder is on PYTHONPATH. ``DEAL_HW_CLIENT_PORTS`` holds pairs
NAME=PORT, joined by commas: a serial port NAME opens PORT, a SocketCAN interface NAME opens the slcan adapter
at PORT. ``DEAL_HW_CLIENT_UNUSED`` holds names of packages, joined by commas, that a program imports and does
not use here, and that need not work on this machine: they are empty. Nothing else of a program is changed.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import os
import queue
import sys
import threading
import types
from typing import Any

_PORTS = dict(pair.split("=", 1) for pair in os.environ.get("DEAL_HW_CLIENT_PORTS", "").split(",") if pair)
_UNUSED = tuple(name for name in os.environ.get("DEAL_HW_CLIENT_UNUSED", "").split(",") if name)
_BITRATE = 500_000


def _serial() -> None:
    import serial

    original = serial.Serial.__init__

    def opened(self: Any, port: str | None = None, *args: Any, **kwargs: Any) -> None:
        original(self, _PORTS.get(port, port) if port else port, *args, **kwargs)

    serial.Serial.__init__ = opened  # type: ignore[method-assign]


def _can() -> None:
    import can
    from can.interfaces.slcan import slcanBus

    class AsSocketCan(can.BusABC):
        """An slcan adapter whose frames wait in a queue, as SocketCAN's do.

        python-can's own slcan bus reads the port while a program waits. So a program that empties the queue
        before a request would find the frames of the meantime in the port afterwards.
        """

        def __init__(self, port: str) -> None:
            super().__init__(channel=port)
            self.channel_info = f"slcan adapter at {port}"
            self._bus = slcanBus(port, bitrate=_BITRATE, sleep_after_open=0.1)
            self._frames: queue.Queue[can.Message] = queue.Queue()
            self._ends = threading.Event()
            threading.Thread(target=self._read, daemon=True).start()

        def _read(self) -> None:
            while not self._ends.is_set():
                if (frame := self._bus.recv(0.1)) is not None:
                    self._frames.put(frame)

        def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
            try:
                return self._frames.get(timeout is None or timeout > 0, timeout), False
            except queue.Empty:
                return None, False

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            self._bus.send(msg, timeout)

        def shutdown(self) -> None:
            self._ends.set()
            super().shutdown()

    original: Any = can.interface.Bus

    def bus(channel: Any = None, interface: str | None = None, **kwargs: Any) -> Any:
        interface = interface or kwargs.pop("bustype", None)
        if interface == "socketcan" and channel in _PORTS:
            return AsSocketCan(_PORTS[channel])
        return original(channel, interface=interface, **kwargs)

    can.interface.Bus = can.Bus = bus  # type: ignore[assignment]


for _patch in (_serial, _can) if _PORTS else ():
    try:
        _patch()
    except ImportError:  # A program that does not use it needs no such package.
        continue


class _EmptyModule(types.ModuleType):
    """Each name in it is an empty class, from which a program may derive its own."""

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


class _EmptyPackages(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the unused packages and all their modules."""

    def find_spec(
        self, name: str, path: Any = None, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name.partition(".")[0] not in _UNUSED:
            return None
        return importlib.machinery.ModuleSpec(name, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        return _EmptyModule(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        """Nothing is in it."""


if _UNUSED:
    sys.meta_path.insert(0, _EmptyPackages())
