"""Checks of a Unitree robot and its connection: listens, and asks which mode is active; no motor command.

Works over every transport of topics; over DDS it also reads the domain's discovery.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final, Generic, Protocol, TypeVar

import numpy as np

from deal_hw.clock import Clock
from deal_hw.control.safety.leg_checks import tilt
from deal_hw.data.checks.clock_rate import judge_clock
from deal_hw.documentation import page
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.motion_switcher import CHECK_MODE, SWITCHER, RefusedError, ServiceClient
from deal_hw.drivers.unitree.remote import decode_remote
from deal_hw.drivers.unitree.robot import StateFrame
from deal_hw.drivers.unitree.tick_stream import PERIOD_MS, RefusedStates
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.errors import FrameError, TransportError, TransportTimeoutError
from deal_hw.findings import Finding, Severity
from deal_hw.transport import Message, TopicTransport
from deal_hw.types import FloatArray

ROUND_TRIPS: Final = 20
_STATE_HZ: Final = 1000.0 / PERIOD_MS
_SLOW_ROUND_TRIP_S: Final = 0.02
_ANSWER_S: Final = 1.0
_LATE_S: Final = 0.01
_FEW_REFUSED: Final = 0.01


class BodyFrame(StateFrame, Protocol):
    """What the checks read in a state."""

    @property
    def orientation(self) -> FloatArray:
        """Quaternion wxyz, base in the world, (4,)."""
        ...


F = TypeVar("F", bound=BodyFrame)


@dataclass(slots=True)
class Received(Generic[F]):
    """Messages received while listening.

    Attributes:
        refused: Counts refused states.
        stamps: When each state arrived [ns].
        ticks: The robot's clock in each state [ms]; none where it has no clock.
        last: The newest state; None before the first.
        commands: Number of commands to the motors.
        repeated: Number of states that equalled the one before, where that counts.
    """

    refused: RefusedStates

    stamps: list[int] = field(default_factory=list)
    ticks: list[int] = field(default_factory=list)
    last: F | None = None
    commands: int = 0
    repeated: int = 0


class UnitreeDoctor(Generic[F]):
    """Listens to a robot and asks its motion switcher.

    Attributes:
        wording: What messages say of the robot.
        kind: The robot, in a sentence.
        types: Types of the topics that have another type than the Go2's.
        controller: Name of its own controller.
        released: What happens with its own controller, in an advice.
        level: How to bring the robot into a level pose, as a request.

    Args:
        link: A transport of topics, not opened.
        clock: The clock of its stamps.
        seconds: How long to listen [s].
    """

    wording: ClassVar[Wording]
    kind: ClassVar[str]
    types: ClassVar[Mapping[str, str]] = {}
    controller: ClassVar[str]
    released: ClassVar[str]
    level: ClassVar[str]

    def __init__(self, link: TopicTransport, clock: Clock, seconds: float) -> None:
        self._link, self._clock, self._seconds = link, clock, seconds

    def run(self) -> Iterator[Finding]:
        """Yield findings; the transport is closed at the end.

        Raises:
            TransportError: It cannot be opened.
        """
        if not isinstance(self._link, TopicTransport):
            raise TransportError(f"{type(self._link).__name__} carries no topics")
        self._link.name_types(self.types)
        self._link.declare(
            publish=[topics.request(SWITCHER)],
            subscribe=[topics.LOW_STATE, topics.LOW_COMMAND, topics.response(SWITCHER)],
        )
        with self._link:
            yield Finding("link", Severity.OK, "the transport is open")
            received = self._listen()
            yield from self._discovery()
            yield from self._beforehand()
            yield from self._judge_states(received)
            mode = yield from self._asked_mode()
            yield from self._judge_commands(received, self._link.writers(topics.LOW_COMMAND), mode)
            if received.last is not None:
                yield from self._judge_motors(received.last)
                yield from self._judge_robot(received.last)

    def _make_refusals(self) -> RefusedStates:
        """Return what counts refused states."""
        raise NotImplementedError

    def _decode(self, payload: bytes) -> F:
        """Return the state in a payload; raises a FrameError where it is corrupt."""
        raise NotImplementedError

    def _beforehand(self) -> Iterator[Finding]:
        """Yield findings on how the states are checked."""
        yield from ()

    def _judge_motors(self, frame: F) -> Iterator[Finding]:
        """Yield findings on supply and motors."""
        raise NotImplementedError

    def _asked_mode(self) -> Generator[Finding, None, str | None]:
        """Yield the motion switcher's answer; return the active mode's name, None without an answer."""
        return (yield from self._ask_mode())

    def _listen(self) -> Received[F]:
        received: Received[F] = Received(self._make_refusals())
        end_ns = self._clock.now_ns() + round(self._seconds * 1e9)
        while (left_ns := end_ns - self._clock.now_ns()) > 0:
            try:
                self._take(received, self._link.receive(left_ns * 1e-9))
            except TransportTimeoutError:
                break
        return received

    def _take(self, received: Received[F], message: Message) -> None:
        if message.channel == topics.LOW_COMMAND:
            received.commands += 1
        if message.channel != topics.LOW_STATE:
            return
        try:
            frame = self._decode(message.payload)
        except FrameError as error:
            received.refused.add(message.payload, error)
            return
        self._keep(received, message, frame)

    def _keep(self, received: Received[F], message: Message, frame: F) -> None:
        received.stamps.append(message.stamp_ns)
        received.ticks.append(frame.tick_ms)
        received.last = frame

    def _discovery(self) -> Iterator[Finding]:
        survey = getattr(self._link, "survey", None)
        if survey is None:
            return
        seen = survey()
        if not seen.peers:
            yield Finding(
                "dds",
                Severity.FAIL,
                "no other participant is on the domain",
                "is the robot on, is this its network (192.168.123.x), is the domain 0, does a firewall "
                "block UDP 7400 to 7500?",
            )
        for peer in seen.peers:
            yield Finding("dds", Severity.OK, str(peer))
        for complaint in seen.complaints:
            yield Finding("dds", Severity.FAIL, complaint, f"see {page('how-to/go2-dds.md')}")
        typed: dict[str, set[str]] = {}
        for end in seen.endpoints:
            if end.topic in topics.TYPES:
                typed.setdefault(end.shown_hash, set()).add(end.topic)
        for shown, names in typed.items():
            yield Finding("dds", Severity.OK, f"{', '.join(sorted(names))}: {shown}")

    def _ask_mode(self) -> Generator[Finding, None, str | None]:
        """Yield the motion switcher's answer; return the active mode's name, None without an answer."""
        services = ServiceClient(
            self._send,
            lambda timeout_s: services.take(self._link.receive(timeout_s)),
            self._clock,
            self.wording,
        )
        times: list[float] = []
        name = None
        for _ in range(ROUND_TRIPS):
            begun_ns = self._clock.now_ns()
            try:
                name = str(services.ask(SWITCHER, CHECK_MODE, {}, _ANSWER_S).get("name", ""))
            except TransportTimeoutError:
                break
            except (RefusedError, FrameError) as error:
                yield Finding("services", Severity.WARN, str(error), "restart the robot if it persists")
                return None
            times.append((self._clock.now_ns() - begun_ns) * 1e-9)
        if name is None:
            yield Finding(
                "services",
                Severity.WARN,
                f"the service {SWITCHER} does not answer",
                "older firmware has the service robot_state instead; deal-hw tries that one, too",
            )
            return None
        p50, most = float(np.median(times)), max(times)
        text = (
            f"round trip of a request: {p50 * 1e3:.2f} ms median, {most * 1e3:.2f} ms longest of {len(times)}"
        )
        remedy = "use a cable instead of wireless; stop other load on network and computer"
        yield Finding.judged("link", p50 > _SLOW_ROUND_TRIP_S, text, remedy)
        yield self._judge_mode(name)
        return name

    def _send(self, topic: str, payload: bytes) -> None:
        self._link.send(Message(topic, payload, self._clock.now_ns()))

    def _judge_states(self, received: Received[F]) -> Iterator[Finding]:
        if received.refused.count:
            yield self._judge_refused(received.refused, len(received.stamps))
            if not received.stamps:
                return
        if len(received.stamps) < 2 and received.repeated:
            yield Finding(
                "states",
                Severity.FAIL,
                f"states arrive, but do not change: {received.repeated} times the same",
                "let the simulation run: it is paused",
            )
            return
        if len(received.stamps) < 2:
            yield Finding(
                "states",
                Severity.FAIL,
                f"no states came on {topics.LOW_STATE} within {self._seconds:g} s",
                "check that the robot is on and has started up (one minute), the interface or end point, and "
                "the firewall",
            )
            return
        gaps = np.diff(received.stamps) * 1e-9
        rate = (len(received.stamps) - 1) / ((received.stamps[-1] - received.stamps[0]) * 1e-9)
        text = (
            f"{rate:.0f} states a second; time between two: {np.median(gaps) * 1e3:.2f} ms median, "
            f"{np.percentile(gaps, 99) * 1e3:.2f} ms p99, {gaps.max() * 1e3:.2f} ms longest"
        )
        sparse, late = rate < 0.9 * _STATE_HZ, float(np.percentile(gaps, 99)) > _LATE_S
        remedy = "use a cable instead of wireless, or a faster or less busy computer"
        yield Finding.judged("states", sparse or late, text, remedy)
        if not received.ticks:
            return
        ticks = np.diff(np.array(received.ticks, dtype=np.int64).astype(np.uint32))
        steps = ticks.astype(np.int32)
        if (steps == 0).all():
            yield Finding(
                "states", Severity.FAIL, "the robot's clock (tick) stands still", "restart the robot"
            )
            return
        missing = int(np.sum(np.maximum(steps // PERIOD_MS - 1, 0)))
        back = int(np.sum(steps <= 0))
        if missing or back:
            yield Finding(
                "states",
                Severity.NOTE,
                f"{missing} states lost and {back} repeated or out of order of {len(received.ticks)}",
            )
        device_ms = np.concatenate(((0,), np.cumsum(steps.astype(np.int64))))
        yield judge_clock(np.array(received.stamps), 1_000_000 * device_ms)

    def _judge_refused(self, refused: RefusedStates, sound: int) -> Finding:
        """Return one finding about all refused states, given the number of valid ones."""
        share = refused.count / (refused.count + sound)
        text = (
            f"{refused.count} of {refused.count + sound} messages on {topics.LOW_STATE} ({share:.1%}) are no "
            f"{self.kind} states; the first: {refused.first}"
        )
        if sound:
            remedy = (
                "states are corrupted on the way: use another cable, not wireless; check for a second "
                "program that sends them"
            )
        else:
            remedy = refused.remedy
        return Finding("states", Severity.FAIL if share > _FEW_REFUSED else Severity.WARN, text, remedy)

    def _judge_commands(
        self, received: Received[F], writers: tuple[str, ...], mode: str | None
    ) -> Iterator[Finding]:
        if received.commands and mode is None:
            yield Finding(
                "commands",
                Severity.WARN,
                f"{received.commands} motor commands came; the robot did not report whether its "
                f"{self.controller} sends them",
                "look for other programs that command the motors; an observer's certificate may not ask the "
                "robot: run doctor with a controller's",
            )
        elif received.commands and mode:
            yield Finding(
                "commands",
                Severity.NOTE,
                f"{received.commands} motor commands came while {self.controller} {mode!r} is active, "
                "probably its own",
                "run doctor again after the release: then no program may command the motors",
            )
        elif received.commands:
            who = f" ({'; '.join(writers)})" if writers else ""
            yield Finding(
                "commands",
                Severity.FAIL,
                f"another program commands the motors: {received.commands} messages{who}",
                "stop that program",
            )
        elif writers:
            yield Finding(
                "commands",
                Severity.WARN,
                f"silent writers of {topics.LOW_COMMAND}: {'; '.join(writers)}",
                "stop them if they are not deal-hw's own",
            )
        else:
            yield Finding("commands", Severity.OK, "nobody else commands the motors")

    def _judge_robot(self, frame: F) -> Iterator[Finding]:
        lean = math.degrees(tilt(frame.orientation))
        tilted = not lean < 30.0 or not abs(float(frame.orientation @ frame.orientation) - 1.0) < 0.01
        yield Finding.judged("robot", tilted, f"the body leans by {lean:.0f} degrees", self.level)
        remote = decode_remote(frame.remote)
        if remote is None:
            yield Finding(
                "robot",
                Severity.NOTE,
                "no remote is heard: L2+B cannot stop the robot",
                "switch the remote on and pair it before you arm",
            )
        else:
            yield Finding("robot", Severity.OK, "the remote is heard: L2+B makes the robot passive")

    def _judge_mode(self, name: str) -> Finding:
        if not name:
            return Finding("services", Severity.OK, f"no {self.controller} is active: the low level is free")
        return Finding(
            "services",
            Severity.NOTE,
            f"{self.controller} {name!r} is active",
            self.released,
        )
