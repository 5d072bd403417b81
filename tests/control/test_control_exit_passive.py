"""The passive command at the end of a run: against a clock, over every reconnect, on a virtual wire."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.passive import PassiveConfig, make_passive
from deal_hw.control.safety.safety import Safety
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION as ON_STAND
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import nominal_truth as go2_truth
from deal_hw.drivers.go2.robot import Go2OnStandRobot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.drivers.unitree.command_log import DAMPING, STIFF
from deal_hw.errors import ConfigurationError, TransportLostError, TransportTimeoutError
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.transport import Message
from deal_hw.types import RobotState, Status

MS, S = 1_000_000, 1_000_000_000


class LimitedClock(VirtualClock):
    """A clock that fails the test where an attempt would never end: time stands still, or runs on and on."""

    def __init__(self) -> None:
        super().__init__(S)
        self._asked_at, self._asked = 0, 0

    def now_ns(self) -> int:
        """Return the time, as long as it is of use to anybody."""
        now_ns = super().now_ns()
        self._asked = self._asked + 1 if now_ns == self._asked_at else 0
        self._asked_at = now_ns
        assert self._asked < 1000, "the time stands still"
        return now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Jump to the deadline."""
        assert deadline_ns < 100 * S, "the time is over, and nobody gives up"
        super().sleep_until_ns(deadline_ns)


class Wire(VirtualTransport):
    """A virtual wire that counts, and that can be silent both ways without an error.

    Attributes:
        sent: When which message left the host [ns, payload], lost ones included.
        opened: When it was opened [ns].
        silent: Whether what is sent is lost and nothing is received.
        deaf: Whether nothing is received.
        error: Raised by reading, where there is one.
    """

    def __init__(self, device: CartpoleDevice, clock: VirtualClock) -> None:
        super().__init__(device, clock)
        self.sent: list[tuple[int, bytes]] = []
        self.opened: list[int] = []
        self.silent = self.deaf = False
        self.error: Exception | None = None

    def open(self) -> None:
        """Note when."""
        self.opened.append(self._clock.now_ns())
        super().open()

    def send(self, message: Message) -> None:
        """Note it; lose it where the wire is silent."""
        self.sent.append((self._clock.now_ns(), message.payload))
        if not self.silent:
            super().send(message)

    def receive(self, timeout_s: float) -> Message:
        """Hear nothing where the wire is silent."""
        if self.error is not None:
            raise self.error
        if not (self.silent or self.deaf):
            return super().receive(timeout_s)
        self._clock.sleep_until_ns(self._clock.now_ns() + round(timeout_s * 1e9))
        self.run_ticks()
        self._queue.clear()
        raise TransportTimeoutError("silence")


@dataclass
class Armed:
    """An armed cart-pole, and the messages to its operator."""

    clock: VirtualClock = field(default_factory=LimitedClock)
    reported: list[tuple[int, str, float]] = field(default_factory=list)
    then: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.device = CartpoleDevice(nominal_truth("ideal"))
        self.wire = Wire(self.device, self.clock)
        self.robot = CartpoleRobot(self.wire, self.clock)
        self.robot.connect()
        self.robot.home(10.0)
        self.robot.arm(1.0)
        self.begin_ns = self.clock.now_ns()
        self.wire.sent.clear()
        self.wire.opened.clear()

    @property
    def passed_s(self) -> float:
        """Time since it was armed [s]."""
        return (self.clock.now_ns() - self.begin_ns) * 1e-9

    def progress(self, text: str, silence_s: float) -> None:
        """Note what the operator reads, and let something happen."""
        self.reported.append((self.clock.now_ns() - self.begin_ns, text, silence_s))
        self.then()

    def make_passive(self, **settings: Any) -> bool:
        """Make it passive, under these settings."""
        return make_passive(self.robot, self.clock, PassiveConfig(**settings), progress=self.progress)

    def motor_off(self) -> bool:
        """Let the device catch up; return whether its motor is off."""
        self.device.advance_to(self.clock.now_ns() - S)
        return not self.device.armed

    def stops(self) -> list[int]:
        """When a passive command left the host, since it was armed [ns]."""
        decoder = protocol.FrameDecoder()
        found = []
        for stamp_ns, payload in self.wire.sent:
            kinds = [protocol.decode(frame).TYPE for frame in decoder.feed(payload)]
            found += [stamp_ns - self.begin_ns] * kinds.count(protocol.MessageType.STOP)
        return found


def test_a_robot_that_hears_is_passive_at_the_first_attempt() -> None:
    """At once, and no trouble is reported; states of every 5 ms confirm three commands in a row."""
    armed = Armed()
    assert armed.make_passive()
    assert armed.motor_off()
    assert armed.stops() == [0, 5 * MS, 10 * MS]
    assert armed.reported == []
    assert armed.passed_s < 0.05


@pytest.mark.parametrize("wanted", [1, 3])
def test_one_state_that_looks_passive_is_no_proof(wanted: int) -> None:
    """A stiff robot without load looks damped as the link returns, before it got a command: asked again."""
    armed = Armed()
    state = armed.robot.read_state(1.0)
    shown = iter([Status(0), Status(0), Status.ARMED, Status(0), Status(0), Status(0), Status(0)])

    def read_state(timeout_s: float) -> RobotState:
        if not timeout_s:
            raise TransportTimeoutError("nothing waits")
        armed.clock.advance_ns(50 * MS)
        return dataclasses.replace(state, status=next(shown))

    armed.robot.read_state = read_state  # type: ignore[method-assign]
    assert armed.make_passive(confirmations=wanted)
    # Two of the first three commands were shown by chance; three in a row are wanted.
    assert armed.stops() == [n * 50 * MS for n in range(1 if wanted == 1 else 6)]
    assert len(armed.reported) == (0 if wanted == 1 else 1)


@pytest.mark.parametrize("count", [0, -1, 101])
def test_a_count_of_confirmations_that_cannot_be_is_refused(count: int) -> None:
    """The message says what is allowed."""
    with pytest.raises(ConfigurationError, match=f"confirmations is {count}; allowed: 1 to 100"):
        PassiveConfig(confirmations=count)


@pytest.mark.parametrize("down_s", [0.1, 0.5, 1.5, 3.0, 25.0])
@pytest.mark.parametrize("kind", ["error", "silence"])
def test_a_link_that_comes_back_ends_passive(kind: str, down_s: float) -> None:
    """The command is repeated all the time; the path is opened again; the robot confirms soon afterwards."""
    armed = Armed()

    def down(state: bool) -> None:
        if kind == "silence":
            armed.wire.silent = state
        elif state:
            armed.wire.unplug()
        else:
            armed.wire.plug_in()

    def then() -> None:
        if armed.passed_s >= down_s:
            down(False)

    armed.then = then
    down(True)
    assert armed.make_passive()
    assert armed.motor_off()
    # A lost path is tried every 0.5 s, an attempt takes 0.05 s.
    assert down_s <= armed.passed_s <= down_s + 0.7
    gaps = [b - a for a, b in zip(armed.stops(), armed.stops()[1:], strict=False)]
    assert kind == "error" or max(gaps) <= 51 * MS


def test_a_link_that_stays_away_is_given_up_after_the_stated_time() -> None:
    """30 s of attempts every 50 ms; a new line for the operator each second; the path tried every 0.5 s."""
    armed = Armed()
    armed.wire.unplug()
    assert not armed.make_passive()
    assert armed.clock.now_ns() - armed.begin_ns == 30 * S
    texts = list(dict.fromkeys(text for _, text, _ in armed.reported))
    why = "the connection is lost (virtual wire: the device vanished)"
    assert texts == [f"{why}; passive command repeated for {s} s, {30 - s} s left" for s in range(30)]
    assert [silence_s for _, _, silence_s in armed.reported[:2]] == [10.0, 1.0]
    opened = [(ns - armed.begin_ns) / S for ns in armed.wire.opened]
    assert len(opened) == 60
    assert {round(b - a, 9) for a, b in itertools.pairwise(opened)} == {0.5}
    assert len(armed.wire.sent) == 601


def test_a_silent_robot_is_told_apart_and_its_path_is_opened_every_three_seconds() -> None:
    """No error, no state: perhaps the path is dead and does not know it."""
    armed = Armed()
    armed.wire.silent = True
    assert not armed.make_passive(timeout_s=10.0)
    assert (
        armed.reported[0][1] == "the robot does not confirm it; passive command repeated for 0 s, 10 s left"
    )
    assert [ns - armed.begin_ns for ns in armed.wire.opened] == [3 * S, 6 * S, 9 * S]
    assert len(armed.stops()) == 200


@pytest.mark.parametrize("lost", [True, False])
def test_every_time_is_kept_to_the_nanosecond(lost: bool) -> None:
    """Seconds instead of their parts, where a wrong factor would show."""
    armed = Armed()
    if lost:
        armed.wire.unplug()
    else:
        armed.wire.silent = True
    assert not armed.make_passive(timeout_s=12.0, confirm_s=1.0, reopen_s=2.0, silent_s=4.0)
    # An attempt on a lost link takes no time: there is one more.
    assert armed.stops() == [n * S for n in range(13 if lost else 12)]
    opened = [ns - armed.begin_ns for ns in armed.wire.opened]
    assert opened == [n * S for n in (range(0, 12, 2) if lost else (4, 8))]


def test_opening_may_take_longer_than_the_time_that_is_left() -> None:
    """Nothing is left then, not less than that."""
    armed = Armed()
    armed.wire.unplug()
    armed.wire.open = lambda: armed.clock.advance_ns(3 * S)  # type: ignore[method-assign]
    assert not armed.make_passive(timeout_s=2.0)
    reported = [text.partition("repeated for ")[2] for _, text, _ in armed.reported]
    assert reported == ["0 s, 2 s left", "3 s, 0 s left"]


def test_states_that_say_armed_keep_the_path_as_it_is() -> None:
    """The robot is received and does not obey: a new path would not help, and would cost the old one."""
    armed = Armed()

    class Deaf(CartpoleDevice):
        def receive(self, data: bytes) -> None:
            """Hear nothing, and be spared by the watchdog."""
            self.firmware._alive_tick = 10**9  # type: ignore[attr-defined]

    armed.device.__class__ = Deaf
    assert not armed.make_passive(timeout_s=7.0)
    assert armed.wire.opened == []
    assert (
        armed.reported[-1][1] == "the robot does not confirm it; passive command repeated for 6 s, 1 s left"
    )


@pytest.mark.parametrize("error", [TransportLostError("the read side is gone"), ZeroDivisionError("a bug")])
def test_a_path_that_cannot_be_read_is_still_written(error: Exception) -> None:
    """Nothing confirms it, but the passive command goes out with the first attempt and the motor stops."""
    armed = Armed()
    armed.wire.error = error
    assert not armed.make_passive(timeout_s=0.01)
    assert armed.stops() == [0, 50 * MS]
    armed.clock.advance_ns(5 * MS)
    assert armed.motor_off()


def test_samples_from_before_confirm_nothing() -> None:
    """Unarmed samples wait on the wire of a supervisor; then the device falls silent."""
    clock = LimitedClock()
    device = CartpoleDevice(nominal_truth("ideal"))
    robot = CartpoleRobot(VirtualTransport(device, clock), clock)
    robot.connect()
    clock.advance_ns(20 * MS)
    assert robot.read_state(0.0).status == 0
    tick = device.tick
    device.tick = lambda: tick()[:0]  # type: ignore[method-assign]
    assert not make_passive(robot, clock, PassiveConfig(timeout_s=0.1))


def test_what_is_left_of_the_time_is_waited_for_to_the_nanosecond() -> None:
    """One nanosecond is still waited for, none is not."""
    armed = Armed()
    state = dataclasses.replace(armed.robot.read_state(1.0), status=Status.ARMED)
    asked: list[float] = []

    def read_state(timeout_s: float) -> RobotState:
        asked.append(timeout_s)
        if len(asked) == 1:
            raise TransportTimeoutError("nothing waits")
        armed.clock.advance_ns(round(timeout_s * 1e9) - (len(asked) == 2))
        return state

    armed.robot.read_state = read_state  # type: ignore[method-assign]
    assert not armed.make_passive(timeout_s=0.05)
    assert asked == pytest.approx([0.0, 0.05, 1e-9], rel=1e-12)


def test_a_robot_that_sends_faster_than_it_is_read_is_told_again() -> None:
    """What waits is read for 0.05 s at most, so that the command is repeated; nothing confirms it."""
    armed = Armed()
    state = dataclasses.replace(armed.robot.read_state(1.0), status=Status(0))

    def read_state(timeout_s: float) -> RobotState:
        armed.clock.advance_ns(MS)
        return state

    armed.robot.read_state = read_state  # type: ignore[method-assign]
    armed.begin_ns = armed.clock.now_ns()
    assert not armed.make_passive(timeout_s=5.0)
    assert armed.stops() == [n * 50 * MS for n in range(100)]
    assert armed.wire.opened == []
    assert armed.reported[0][1].startswith("the robot does not confirm it; passive")


def test_a_display_that_fails_stops_nothing() -> None:
    """The terminal is gone, as after SIGHUP: each line of progress raises, and the command is repeated."""
    armed = Armed()
    armed.wire.silent = True

    def then() -> None:
        armed.wire.silent = armed.passed_s < 2.0
        raise OSError(5, "Input/output error")

    armed.then = then
    assert armed.make_passive()
    assert armed.passed_s > 2.0 and armed.motor_off()


def test_a_driver_that_fails_in_every_way_is_survived() -> None:
    """Sending and opening raise what no driver should; the attempts go on until the time is over."""
    armed = Armed()

    def broken(*arguments: object) -> None:
        raise ZeroDivisionError("a bug")

    armed.wire.send = armed.wire.reopen = broken  # type: ignore[method-assign, assignment]
    assert not armed.make_passive(timeout_s=1.0)
    assert armed.reported[0][1].startswith(
        "the connection is lost (a bug); passive command repeated for 0 s, 1 s left"
    )


def test_the_defaults_are_as_documented() -> None:
    """docs/explanation/safety.md names them."""
    assert PassiveConfig() == PassiveConfig(
        timeout_s=30.0, confirm_s=0.05, confirmations=3, reopen_s=0.5, silent_s=3.0
    )
    assert PassiveConfig(confirmations=1) and PassiveConfig(confirmations=100)


@pytest.mark.parametrize("name", ["timeout_s", "confirm_s", "reopen_s", "silent_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, 3600.0, math.nan, math.inf])
def test_settings_that_cannot_be_are_refused(name: str, value: float) -> None:
    """Both ends are outside."""
    changes: dict[str, Any] = {name: value}
    with pytest.raises(ConfigurationError) as raised:
        PassiveConfig(**changes)
    assert str(raised.value) == f"PassiveConfig.{name} is {value!r} s; allowed: above 0, below 3600"


# A robot that holds its last command for ever, through the whole loop.


class Hung:
    """A Go2 on a stand, run by the control loop, whose wire is cut at a moment of the run."""

    def __init__(self) -> None:
        self.clock = LimitedClock()
        self.device = Go2Device(go2_truth("ideal"), on_stand=True)
        self.wire = VirtualTopics(self.device, self.clock)
        self.robot = Go2OnStandRobot(self.wire, self.clock)
        self.beats: list[tuple[str, float]] = []
        self.at: Callable[[str], None] = lambda phase: None

    def progress(self, phase: str, silence_s: float) -> None:
        """Note the heartbeat."""
        self.beats.append((phase, silence_s))
        self.at(phase)

    def run(self, **config: Any) -> LoopReport:
        """Hold the standing pose for half a second."""
        return ControlLoop(
            self.robot,
            HoldBehaviour(ON_STAND),
            Safety(ON_STAND),
            self.clock,
            lambda record: True,
            LoopConfig(duration_s=0.5, **config),
            progress=self.progress,
        ).run()

    @property
    def kinds(self) -> list[str]:
        """The kinds of command that the robot received, each change once."""
        return [kind for *_, kind in self.device.log.changes]


def test_a_go2_whose_link_drops_while_the_run_ends_is_damped_once_it_is_back() -> None:
    """The passive command is repeated by the clock: a number of attempts would be used up at once."""
    rig = Hung()
    cut_ns = 0

    def at(phase: str) -> None:
        nonlocal cut_ns
        if phase == "making passive":
            cut_ns = rig.clock.now_ns()
            rig.wire.unplug()
        elif cut_ns and rig.clock.now_ns() - cut_ns > 3 * S:
            rig.wire.plug_in()

    rig.at = at
    report = rig.run()
    assert (report.outcome, report.passive_confirmed) == (Outcome.FINISHED, True)
    assert rig.kinds[-2:] == [STIFF, DAMPING]
    reported = [phase for phase, _ in rig.beats if phase.startswith("making passive: ")]
    assert reported[0].startswith(
        "making passive: the connection is lost (virtual wire: the device vanished); passive"
    )


def test_a_go2_whose_link_is_lost_in_the_run_trips_at_once_and_is_damped_once_it_is_back() -> None:
    """The reason names the link; what was sent before the cut is held until then."""
    rig = Hung()
    running = 0

    def at(phase: str) -> None:
        nonlocal running
        running += phase == "running"
        if running == 10:
            running += 1
            rig.wire.unplug()
        if phase.endswith("for 2 s, 28 s left"):
            rig.wire.plug_in()

    rig.at = at
    report = rig.run(hand_back=True)
    assert (report.outcome, report.error, report.passive_confirmed) == (Outcome.TRIPPED, "", True)
    assert report.reason == "the connection is lost: virtual wire: the device vanished"
    assert rig.kinds[-2:] == [STIFF, DAMPING]
    assert "handing back" not in dict(rig.beats)


@pytest.mark.parametrize("phase", ["connecting", "homing"])
def test_a_go2_that_was_not_commanded_yet_is_left_alone(phase: str) -> None:
    """Stopped while its own controller may still have it: not one motor command."""
    rig = Hung()
    received: list[str] = []
    receive = rig.device.receive

    def overheard(topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        received.append(topic)
        receive(topic, payload, stamp_ns)

    rig.device.receive = overheard  # type: ignore[method-assign]

    def at(name: str) -> None:
        if name == phase:
            raise KeyboardInterrupt

    rig.at = at
    report = rig.run()
    assert (report.outcome, report.passive_confirmed) == (Outcome.STOPPED, True)
    assert topics.LOW_COMMAND not in received
    assert "making passive" not in dict(rig.beats)
