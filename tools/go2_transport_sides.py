"""The two processes of ``tools/measure_go2_transport.py``: a controller and a robot that only measure.

Each message has its number and its sending time in bytes that the receiver does not use. Both processes run
on one machine, so their clocks are the same and ages are exact.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import struct
import sys
import time
from array import array
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.control.loop.timing import LoopTiming, Spread
from deal_hw.control.process.realtime import become_realtime, die_with_parent
from deal_hw.drivers.transports.topics import LOW_COMMAND, LOW_STATE
from deal_hw.errors import DealHwError, TransportError, TransportLostError, TransportTimeoutError
from deal_hw.robots.connect import make_topic_transport
from deal_hw.transport import Message, TopicTransport, WireOptions

_MARK: Final = struct.Struct("<IQ")
_HEADER: Final = bytes.fromhex("00010000")
_LAYOUT: Final[Mapping[str, tuple[int, int]]] = {LOW_COMMAND: (812, 748), LOW_STATE: (1180, 1104)}
"""Topic -> bytes of its message, and the offset of the field wireless_remote."""
LATE_NS: Final = 1_000_000
"""Cycles with a larger delay are listed one by one, for the stall monitor to judge [ns]."""
_MEETING_S: Final = 10.0
_STALE_NS: Final = 100_000_000


def mark(topic: str, number: int, sent_ns: int) -> bytes:
    """Return a message of the topic's size with its number and sending time [ns]."""
    size, place = _LAYOUT[topic]
    message = bytearray(size)
    message[:4] = _HEADER
    _MARK.pack_into(message, place, number, sent_ns)
    return bytes(message)


def read_mark(topic: str, payload: bytes) -> tuple[int, int]:
    """Return number and sending time [ns] of a message that :func:`mark` made."""
    number, sent_ns = _MARK.unpack_from(payload, _LAYOUT[topic][1])
    return number, sent_ns


@dataclass(slots=True)
class Arrivals:
    """Arrivals of a numbered stream; number 0 is a hello and does not count.

    Attributes:
        count: Number of messages that arrived, each number once.
        newest: The highest number.
        newest_sent_ns: Its sending time [ns].
        disordered: Messages that came after a higher number, or twice.
        stale: Messages older than 0.1 s at arrival.
        gaps: First missing number and number of missing ones from there, flat.
        ages: Time from sending to arrival [ns].
    """

    count: int = 0
    newest: int = 0
    newest_sent_ns: int = 0
    disordered: int = 0
    stale: int = 0
    gaps: array[int] = field(default_factory=lambda: array("q"))
    ages: array[int] = field(default_factory=lambda: array("q"))

    def note(self, number: int, sent_ns: int, stamp_ns: int) -> None:
        """Count a message."""
        if number == 0:
            return
        if number <= self.newest:
            self.disordered += 1
            return
        if number > self.newest + 1:
            self.gaps.extend((self.newest + 1, number - self.newest - 1))
        self.count += 1
        self.newest, self.newest_sent_ns = number, sent_ns
        age_ns = stamp_ns - sent_ns
        self.ages.append(age_ns)
        self.stale += age_ns > _STALE_NS

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "count": self.count,
            "newest": self.newest,
            "disordered": self.disordered,
            "stale": self.stale,
            "gaps": list(self.gaps),
            "age": _plain(Spread.of(self.ages)),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Freeze:
    """Cycles at which the robot's process is stopped (SIGSTOP) and continued (SIGCONT).

    Attributes:
        pid: The process.
        first: Cycle before which it is stopped; 0 for never.
        last: Cycle before which it goes on.
        settled: Last cycle that may still be disturbed.
    """

    pid: int
    first: int
    last: int
    settled: int

    def act(self, number: int) -> None:
        """Stop the process or let it go on, if it is time."""
        if number == self.first:
            os.kill(self.pid, signal.SIGSTOP)
        elif number == self.last:
            os.kill(self.pid, signal.SIGCONT)


class Controller:
    """Sends commands and reads states as the control process does: at each deadline, then sleeps."""

    def __init__(self, transport: TopicTransport, clock: Clock, rate_hz: float, freeze: Freeze) -> None:
        self._transport, self._clock, self._freeze = transport, clock, freeze
        self._loop_timing = LoopTiming(clock, rate_hz)
        self._states = Arrivals()
        self._quiet, self._frozen = _Cycles(), _Cycles()
        self._touched = [0, 0]
        self._begun_ns = 0
        self._period_errors = array("q")

    def run(self, cycles: int) -> dict[str, Any]:
        """Wait for the robot, run this number of cycles and return the measurements."""
        self._meet()
        print("running", flush=True)
        cpu_ns, begun_ns = time.process_time_ns(), self._clock.now_ns()
        for number in range(1, cycles + 1):
            self._cycle(number)
        wall_ns = self._clock.now_ns() - begun_ns
        return {
            "loop_timing": self._loop_timing.report().to_json(),
            "period_error": _plain(Spread.of(self._period_errors)),
            "quiet": self._quiet.to_json(),
            "frozen": self._frozen.to_json() if self._freeze.first else None,
            "sent": cycles,
            "states": self._states.to_json(),
            "states_touched": self._touched,
            "cpu_share": (time.process_time_ns() - cpu_ns) / wall_ns,
        }

    def _meet(self) -> None:
        until_ns = self._clock.now_ns() + round(_MEETING_S * 1e9)
        while self._clock.now_ns() < until_ns:
            self._transport.send(Message(LOW_COMMAND, mark(LOW_COMMAND, 0, 0), 0))
            with contextlib.suppress(TransportTimeoutError):
                self._states.newest = read_mark(LOW_STATE, self._transport.receive(0.02).payload)[0]
                return
        raise TransportTimeoutError(f"controller and robot did not find each other within {_MEETING_S:g} s")

    def _cycle(self, number: int) -> None:
        self._loop_timing.begin()
        begun_ns = self._clock.now_ns()
        if self._begun_ns:
            self._period_errors.append(abs(begun_ns - self._begun_ns - self._loop_timing.period_ns))
        self._begun_ns = begun_ns
        self._freeze.act(number)
        lost = self._drain()
        sent_ns = self._clock.now_ns()
        try:
            self._transport.send(Message(LOW_COMMAND, mark(LOW_COMMAND, number, sent_ns), 0))
        except TransportError:
            lost = True
        done_ns = self._clock.now_ns()
        suffers = self._freeze.first and self._freeze.first <= number <= self._freeze.settled
        part = self._frozen if suffers else self._quiet
        part.note(begun_ns - self._loop_timing.late_ns, done_ns)
        part.works.append(done_ns - begun_ns)
        if self._states.newest_sent_ns:
            part.ages.append(sent_ns - self._states.newest_sent_ns)
        part.sends.append(done_ns - sent_ns)
        part.lost += lost
        if number == self._freeze.first:
            self._touched[0] = self._states.newest
        if number == self._freeze.settled:
            self._touched[1] = self._states.newest

    def _drain(self) -> bool:
        try:
            while True:
                message = self._transport.receive(0.0)
                self._states.note(*read_mark(LOW_STATE, message.payload), message.stamp_ns)
        except TransportTimeoutError:
            return False
        except TransportLostError:
            return True


@dataclass(slots=True)
class _Cycles:
    delays: array[int] = field(default_factory=lambda: array("q"))
    works: array[int] = field(default_factory=lambda: array("q"))
    sends: array[int] = field(default_factory=lambda: array("q"))
    ages: array[int] = field(default_factory=lambda: array("q"))
    late: array[int] = field(default_factory=lambda: array("q"))
    lost: int = 0

    def note(self, deadline_ns: int, done_ns: int) -> None:
        self.delays.append(done_ns - deadline_ns)
        if done_ns - deadline_ns > LATE_NS:
            self.late.extend((deadline_ns, done_ns))

    def to_json(self) -> dict[str, Any]:
        return {
            "late": list(self.late),
            "cycles": len(self.delays),
            "cycle_delay": _plain(Spread.of(self.delays)),
            "work": _plain(Spread.of(self.works)),
            "state_age": _plain(Spread.of(self.ages)),
            "send": _plain(Spread.of(self.sends)),
            "cycles_without_link": self.lost,
        }


def _plain(spread: Spread) -> dict[str, float | None]:
    return {name: None if value != value else value for name, value in asdict(spread).items()}


class RobotSide:
    """Sends states at the rate from the first command on, and counts commands; stops at SIGTERM."""

    def __init__(self, transport: TopicTransport, clock: Clock, rate_hz: float) -> None:
        self._transport, self._clock = transport, clock
        self._loop_timing = LoopTiming(clock, rate_hz)
        self._commands = Arrivals()
        self._stopped = False

    def stop(self, *_: object) -> None:
        """Request the end."""
        self._stopped = True

    def run(self) -> dict[str, Any]:
        """Serve until the end is requested, and return the measurements."""
        while not self._stopped:
            with contextlib.suppress(TransportTimeoutError):
                self._transport.receive(0.1)
                break
        cpu_ns, begun_ns = time.process_time_ns(), self._clock.now_ns()
        number = 0
        while not self._stopped:
            self._loop_timing.begin()
            number += 1
            sent_ns = self._clock.now_ns()
            with contextlib.suppress(TransportError):
                self._transport.send(Message(LOW_STATE, mark(LOW_STATE, number, sent_ns), 0))
            self._listen(self._loop_timing.deadline_ns)
        wall_ns = max(1, self._clock.now_ns() - begun_ns)
        return {
            "loop_timing": self._loop_timing.report().to_json(),
            "sent": number,
            "commands": self._commands.to_json(),
            "cpu_share": (time.process_time_ns() - cpu_ns) / wall_ns,
        }

    def _listen(self, until_ns: int) -> None:
        while (left_ns := until_ns - self._clock.now_ns()) > 0 and not self._stopped:
            try:
                message = self._transport.receive(left_ns * 1e-9)
            except TransportTimeoutError:
                return
            self._commands.note(*read_mark(LOW_COMMAND, message.payload), message.stamp_ns)


def main() -> int:
    """Read orders from standard input, be the side named by the first argument, print the result as JSON."""
    orders = json.load(sys.stdin)
    die_with_parent(orders["parent_pid"])
    clock = MonotonicClock()
    transport = make_topic_transport(
        orders["transport"], orders["port"], clock, WireOptions.from_json(orders["wire"])
    )
    granted = become_realtime()
    try:
        result = _run(sys.argv[1], transport, clock, orders)
    except DealHwError as error:
        result = {"error": f"{type(error).__name__}: {error}"}
    finally:
        transport.close()
    print(json.dumps({**result, "scheduling": granted.scheduling, "warnings": granted.warnings}), flush=True)
    return 0


def _run(side: str, transport: TopicTransport, clock: Clock, orders: Mapping[str, Any]) -> dict[str, Any]:
    if side == "robot":
        robot = RobotSide(transport, clock, orders["rate_hz"])
        signal.signal(signal.SIGTERM, robot.stop)
        transport.declare(publish=[LOW_STATE], subscribe=[LOW_COMMAND])
        transport.open()
        print("ready", flush=True)
        return robot.run()
    transport.declare(publish=[LOW_COMMAND], subscribe=[LOW_STATE])
    transport.open()
    print("ready", flush=True)
    freeze = Freeze(**orders["freeze"])
    return Controller(transport, clock, orders["rate_hz"], freeze).run(orders["cycles"])


if __name__ == "__main__":
    sys.exit(main())
