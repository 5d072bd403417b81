"""A controller behind the Go2's bridge that holds a pose: for measurements and tests of the bridge."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Final, Self

import numpy as np

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.realtime import priority
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.zenoh_stamps import Echoes
from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.rpc import decode_request
from deal_hw.errors import TransportError, TransportTimeoutError
from deal_hw.priorities import FIFO_PRIORITY
from deal_hw.transport import Message, WireOptions

PERIOD_NS: Final = 2_000_000
PATIENCE_S: Final = 15.0
ZERO: Final = np.zeros(12)
STIFFNESS: Final = 20.0
"""Stiffness of the held pose [N·m/rad]."""


class BridgeClient:
    """Sends a command every 2 ms in a thread, and receives the bridge's messages; a context manager.

    Attributes:
        frame: Newest state; None before the first.
        states: States received so far.
        status: The bridge's last status; empty before.

    Args:
        port: End point of the bridge.
        options: Certificates.
        settings: Further settings of its Zenoh session.
    """

    def __init__(self, port: str, options: WireOptions, settings: Mapping[str, Any] | None = None) -> None:
        self._clock = MonotonicClock()
        self._link = ZenohTransport(port, self._clock, options, settings)
        self._link.declare(publish=[topics.LOW_COMMAND], subscribe=[topics.LOW_STATE, topics.BRIDGE])
        self._encoder = LowCommandEncoder()
        self._gains = np.full(12, STIFFNESS), np.full(12, 1.0)
        self.frame: LowStateFrame | None = None
        self.states = 0
        self.status: dict[str, Any] = {}
        self._payload = b""
        self._end = threading.Event()

    def __enter__(self) -> Self:
        # Zenoh's threads inherit the priority; a late command would count as silence.
        with priority(FIFO_PRIORITY, children=True):
            self._link.open()
        self._end.clear()
        self._thread = threading.Thread(target=self._send_all, name="commands", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._thread.join()
        self._link.close()

    @property
    def echoes(self) -> Echoes:
        """The stamper of its messages; only while it is open."""
        found = self._link._echoes
        assert found is not None
        return found

    @property
    def in_charge(self) -> bool:
        """Whether this client has the robot, by the bridge's status."""
        return bool(self.status["stream"] == f"{self.echoes.stream:016x}")

    def listen(self, timeout_s: float = 0.0) -> None:
        """Take received messages, waiting this long for the first one [s]."""
        with contextlib.suppress(TransportError):
            while True:
                message = self._link.receive(timeout_s)
                timeout_s = 0.0
                if message.channel == topics.LOW_STATE:
                    self.frame = decode_low_state(message.payload)
                    self.states += 1
                else:
                    self.status = json.loads(decode_request(message.payload).parameter)

    def send(self, payload: bytes, attachment: bytes = b"") -> bool:
        """Put a command on the wire; return whether there was a link."""
        try:
            self._link.send(Message(topics.LOW_COMMAND, payload, 0, attachment))
        except TransportError:
            return False
        return True

    def damping(self) -> bytes:
        """Return the command of the hand-over."""
        return self._encoder.encode(LowCommand(ZERO, ZERO, ZERO, np.full(12, 5.0), ZERO))

    def pose(self) -> bytes:
        """Return a command that holds the measured pose, inside the range of targets."""
        if self.frame is None:
            raise TransportTimeoutError("no state has come")
        low, high = np.array(DRIVER.limits.target).T
        target = np.clip(self.frame.position, low, high)
        return self._encoder.encode(LowCommand(target, ZERO, *self._gains, ZERO))

    def hear(self, until: Callable[[], bool]) -> None:
        """Listen without sending until a condition holds.

        Raises:
            TransportTimeoutError: It is not so in time.
        """
        end_ns = self._clock.now_ns() + round(PATIENCE_S * 1e9)
        while not until():
            if self._clock.now_ns() > end_ns:
                raise TransportTimeoutError(
                    f"not received within {PATIENCE_S:g} s; the bridge: {self.status}"
                )
            self.listen(0.02)

    def take_over(self) -> None:
        """Take the robot over by damping, then hold the present pose."""
        self.hear(lambda: self.frame is not None and bool(self.status))
        self._begin()
        while not self.in_charge:
            # On a busy machine this process may pause for longer than the bridge waits, so it starts again.
            self._begin()

    def _begin(self) -> None:
        self.repeat(self.damping(), lambda: self.in_charge)
        admitted = self.status["admitted"]
        self.repeat(self.pose(), lambda: not self.in_charge or self.status["admitted"] > admitted + 50)

    def repeat(self, payload: bytes, until: Callable[[], bool]) -> None:
        """Send a command every 2 ms from now on, b"" for none; return once a condition holds.

        Raises:
            TransportTimeoutError: It is not so in time.
        """
        self._payload = payload
        self.hear(until)

    def _send_all(self) -> None:
        due_ns = self._clock.now_ns()
        with priority(FIFO_PRIORITY):
            while not self._end.is_set():
                if self._payload:
                    self.send(self._payload)
                due_ns = max(due_ns + PERIOD_NS, self._clock.now_ns())
                self._clock.sleep_until_ns(due_ns)
