"""An emulated Go2 on DDS with a bridge before it, each a process of its own, and their certificates."""

from __future__ import annotations

import datetime
import json
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from bridge_client import PATIENCE_S

from deal_hw.cli.keys import Make, make
from deal_hw.clock import MonotonicClock
from deal_hw.drivers.transports.certificates import sign
from deal_hw.errors import TransportTimeoutError
from deal_hw.transport import WireOptions
from deal_hw.workflows.emulation.process import VerbProcess


def make_keys(folder: Path, *addresses: str) -> None:
    """Make the certificates of ``deal-hw keys make``, and one that has expired, named ``expired``."""
    now = datetime.datetime.now(datetime.timezone.utc)
    make(Make(out=folder, robot=addresses, days=30), now)
    sign(folder, "expired", addresses=(), days=1, now=now - datetime.timedelta(days=2))


def wire(folder: Path, name: str) -> WireOptions:
    """Return the options of a certificate's holder; "" for none."""
    own: dict[str, Any] = (
        {"certificate": folder / f"{name}.pem", "key": folder / f"{name}.key"} if name else {}
    )
    return WireOptions(ca=folder / "ca.pem", **own)


def bridge_process(
    keys: Path, domain: int, listen: str, *options: str, prefix: Sequence[str] = ()
) -> VerbProcess:
    """Return a bridge between DDS on loopback and an end point, not started."""
    own = wire(keys, "robot")
    files = ("--ca", str(own.ca), "--certificate", str(own.certificate), "--key", str(own.key))
    where = ("--port", "lo", "--domain", str(domain), "--listen", listen)
    return VerbProcess("bridge", "go2", *where, *files, *options, prefix=prefix)


class BridgeRig:
    """The two processes; a context manager.

    Attributes:
        keys: Folder of the certificates.
        port: End point of the bridge.
        bridge: Its process.

    Args:
        folder: For certificates and logs.
        domain: DDS domain.
        address: Address at which the bridge listens.
        prefix: A command to run both under, such as ``ip netns exec NAME``.
        emulator: More options of the emulator.
        bridge: More options of the bridge.
    """

    def __init__(
        self,
        folder: Path,
        domain: int,
        *,
        address: str = "127.0.0.1",
        prefix: Sequence[str] = (),
        emulator: Sequence[str] = ("--profile", "ideal", "--nominal", "--sport", "off"),
        bridge: Sequence[str] = (),
    ) -> None:
        self.keys = folder / "keys"
        make_keys(self.keys, address)
        self._options = tuple(bridge)
        self._events, self._domain, self._prefix = folder / "events.jsonl", domain, prefix
        self._events.touch()
        where = ("--port", "lo", "--domain", str(domain), "--events-to", str(self._events))
        self._robot = VerbProcess("emulate", "go2", *where, *emulator, prefix=prefix)
        self.port = f"tls/{address}:0"
        self.bridge = self._make_bridge()

    def __enter__(self) -> Self:
        self._robot.start()
        try:
            self.start_bridge()
        except BaseException:
            self._robot.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bridge.stop()
        self._robot.stop()

    def start_bridge(self) -> None:
        """Start the bridge, at the end point of the one before."""
        self.bridge = self._make_bridge()
        self.port = self.bridge.start()

    def kill_bridge(self) -> None:
        """Kill it with SIGKILL, as the kernel does when memory runs out."""
        os.kill(self.bridge.pid, signal.SIGKILL)
        self.bridge.stop()

    def options(self, name: str) -> WireOptions:
        """Return the options of a client by its certificate's name."""
        return wire(self.keys, name)

    def reported(self) -> list[tuple[int, str]]:
        """Return the robot's commands so far: host time [ns], kind of command."""
        lines = self._events.read_text(encoding="utf-8").splitlines()
        return [(stamp_ns, what) for _, stamp_ns, what in map(json.loads, lines)]

    def commands(self) -> list[str]:
        """Return the kinds of motor commands so far, in order of change."""
        return [what for _, what in self.reported() if what in ("stiff", "damping", "off")]

    def await_commands(self, kinds: Sequence[str]) -> None:
        """Return once the robot has received motor commands of these kinds.

        Raises:
            TransportTimeoutError: They are not in time.
        """
        clock = MonotonicClock()
        end_ns = clock.now_ns() + round(PATIENCE_S * 1e9)
        while (found := self.commands()) != list(kinds):
            if clock.now_ns() > end_ns:
                raise TransportTimeoutError(f"the robot got {found}, expected {list(kinds)}")
            clock.sleep_until_ns(clock.now_ns() + 10_000_000)

    def _make_bridge(self) -> VerbProcess:
        return bridge_process(self.keys, self._domain, self.port, *self._options, prefix=self._prefix)
