"""The control loop with a robot on legs, in virtual time: the real driver against the emulated Go2."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport, _newest
from deal_hw.control.process.channel import RUNNING, Outcome
from deal_hw.control.safety.passive import PassiveConfig
from deal_hw.control.safety.safety import CycleInput, Safety, SafetyDecision
from deal_hw.data.recording.record import CycleRecord, encode
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION as ON_STAND
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.faults import FaultPlan
from deal_hw.drivers.go2.emulator.truth import nominal_truth
from deal_hw.drivers.go2.messages.low_command import decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.go2.robot import Go2OnStandRobot, Go2Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.unitree.command_log import DAMPING, STIFF, kind_of
from deal_hw.drivers.unitree.go_messages.low_state import LowState
from deal_hw.motions.behaviours import Behaviour, HoldBehaviour
from deal_hw.motions.posture import PostureBehaviour, PostureConfig
from deal_hw.transport import Message
from deal_hw.types import JointCommand, RobotState, Status

MS = 1_000_000
POSTURE = PostureConfig(fold_s=0.5, rise_s=0.8, settle_s=0.2, lie_s=0.8)
HOLD_S = 0.4
SWITCHER = topics.request("motion_switcher")


class Tap:
    """The emulated robot, with an ear on its wire and a hand in it."""

    def __init__(self, device: Go2Device) -> None:
        self._device = device
        self.received: list[tuple[int, str, bytes]] = []
        self.heights: list[float] = []
        self.deaf_to: set[str] = set()
        self.state: Callable[[LowState], LowState] | None = None

    @property
    def device_ns(self) -> int:
        """Device time [ns]."""
        return self._device.device_ns

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Note what the host sent, and pass it on."""
        self.received.append((stamp_ns, topic, payload))
        if topic not in self.deaf_to:
            self._device.receive(topic, payload, stamp_ns)

    def tick(self) -> list[tuple[str, bytes]]:
        """Let the robot live; its states may be another's."""
        out = self._device.tick()
        self.heights.append(self._device.base_height)
        change = self.state
        if change is None:
            return out
        return [
            (t, encode_low_state(change(decode_low_state(p).values())) if t == topics.LOW_STATE else p)
            for t, p in out
        ]


class Spy(Safety):
    """The safety module, with a copy of its inputs."""

    def __init__(self) -> None:
        super().__init__(DRIVER)
        self.inputs: list[CycleInput] = []
        self.decisions: list[SafetyDecision] = []

    def step(self, cycle: CycleInput, wanted: JointCommand | None) -> SafetyDecision:
        """Judge as ever."""
        self.inputs.append(cycle)
        self.decisions.append(super().step(cycle, wanted))
        return self.decisions[-1]


class LegRig:
    """An ideal Go2 that lies on the floor under sport mode, on a virtual wire."""

    def __init__(self, **faults: Any) -> None:
        self.clock = VirtualClock(10**9)
        self.device = Go2Device(nominal_truth("ideal"), plan=FaultPlan(**faults))
        self.tap = Tap(self.device)
        self.robot = Go2Robot(VirtualTopics(self.tap, self.clock), self.clock)
        self.safety = Spy()
        self.records: list[CycleRecord] = []
        self.beats: list[tuple[str, float]] = []

    def sink(self, record: CycleRecord) -> bool:
        """Keep a record."""
        self.records.append(record)
        return True

    def loop(self, behaviour: Behaviour | None = None, **config: Any) -> ControlLoop:
        """Return a loop that stands up, does something and lies down."""
        whole = PostureBehaviour(behaviour or HoldBehaviour(DRIVER), DRIVER, HOLD_S, POSTURE)
        settings = LoopConfig(**{"duration_s": whole.longest_s, **config})
        return ControlLoop(
            self.robot,
            whole,
            self.safety,
            self.clock,
            self.sink,
            settings,
            progress=lambda phase, silence_s: self.beats.append((phase, silence_s)),
            end=whole.end,
        )

    @property
    def commands(self) -> list[tuple[int, str, bytes]]:
        """When which kind of motor command was received."""
        return [
            (stamp_ns, kind_of(decode_low_command(payload)), payload)
            for stamp_ns, topic, payload in self.tap.received
            if topic == topics.LOW_COMMAND
        ]

    @property
    def events(self) -> list[tuple[str, str]]:
        """Kind and message of all events."""
        return [(event.kind, event.message) for record in self.records for event in record.events]

    @property
    def tripped_ns(self) -> int:
        """Host time of the cycle that the safety module ended."""
        return next(record.start_ns for record in self.records if record.safety_state == "passive")


class At:
    """Holds the default pose and does something once, so many cycles after it began."""

    action = None

    def __init__(self, cycle: int, act: Callable[[], None]) -> None:
        self._hold, self._left, self._act = HoldBehaviour(DRIVER), cycle, act
        self.seen: list[RobotState] = []

    def reset(self) -> None:
        """Nothing to forget."""

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the default pose."""
        self.seen.append(state)
        if self._left == 0:
            self._act()
        self._left -= 1
        return self._hold.command(state, time_s)


@pytest.fixture(scope="module")
def stood() -> tuple[LegRig, LoopReport]:
    """A whole run that ends well, and its report."""
    rig = LegRig()
    return rig, rig.loop(hand_back=True).run()


Stood = tuple[LegRig, LoopReport]


def test_the_robot_stands_up_and_lies_down(stood: Stood) -> None:
    """Default pose about 0.3 m above the floor, lying below 0.15 m; 3.3 s are 165 commands."""
    rig, report = stood
    assert (report.outcome, report.reason, report.error) == (Outcome.FINISHED, "the run is over", "")
    assert report.passive_confirmed
    assert report.cycles_sent == report.loop_timing.cycles == 165
    assert report.loop_timing.overruns == 0
    run = rig.tap.heights[(rig.records[0].start_ns - 10**9) // MS : (rig.records[-1].start_ns - 10**9) // MS]
    assert max(run) > 0.25
    assert run[-1] < 0.15


def test_commands_are_repeated_between_cycles(stood: Stood) -> None:
    """The same bytes every 2 ms, the last time as the next cycle begins; damping alone follows the last."""
    rig, report = stood
    stiff = [(stamp, payload) for stamp, kind, payload in rig.commands if kind == STIFF]
    assert len(stiff) == 11 * report.cycles_sent
    for cycle, record in enumerate(rig.records[:-1]):
        own = stiff[11 * cycle : 11 * cycle + 11]
        assert [stamp - record.sent_ns for stamp, _ in own] == [2 * MS * k for k in range(11)]
        assert len({payload for _, payload in own}) == 1
    kinds = [kind for _, kind, _ in rig.commands]
    first, last = kinds.index(STIFF), len(kinds) - 1 - kinds[::-1].index(STIFF)
    assert set(kinds[first : last + 1]) == {STIFF}
    assert set(kinds[last + 1 :]) == {DAMPING}


def test_the_safety_module_knows_when_a_command_was_last_sent(stood: Stood) -> None:
    """Not known in the first cycle; then the command was repeated as the cycle began."""
    ages = [cycle.command_age_ns for cycle in stood[0].safety.inputs]
    assert ages[0] == -1
    assert set(ages[1:]) == {0}
    assert {cycle.fault for cycle in stood[0].safety.inputs} == {""}


def test_the_heartbeat_is_as_short_as_the_robot_asks_for(stood: Stood) -> None:
    """A Go2 holds its last target for ever, so its supervisor waits for 0.2 s, not for the usual 0.3 s."""
    assert DRIVER.limits.silence_s == 0.2
    assert {silence_s for phase, silence_s in stood[0].beats if phase == RUNNING} == {0.2}
    assert [phase for phase, _ in stood[0].beats if phase != RUNNING] == [
        "connecting",
        "homing",
        "arming",
        "making passive",
        "handing back",
    ]


def test_each_state_is_recorded_once_with_its_body(stood: Stood) -> None:
    """2 ms from state to state without a gap, ten a cycle, each with IMU, feet and temperatures."""
    rig, _ = stood
    states = [state for record in rig.records for state in record.states]
    assert set(np.diff([state.device_ns for state in states])) == {2 * MS}
    assert set(np.diff([state.sequence for state in states])) == {1}
    assert {len(record.states) for record in rig.records[1:-1]} == {10}
    bodies = [state.body for state in states if state.body is not None]
    assert len(bodies) == len(states)
    for body in bodies:
        assert np.linalg.norm(body.orientation) == pytest.approx(1.0, abs=1e-3)
        assert (len(body.foot_force), len(body.temperature), len(body.lost)) == (4, 12, 12)
    assert {Status.ARMED in state.status for state in states} == {True}


def test_every_record_fits_a_datagram(stood: Stood) -> None:
    """Setting up leaves seconds of raw bytes; the first record carries their end, the rest all of theirs."""
    rig, _ = stood
    sizes = [len(encode(record)) for record in rig.records]
    assert max(sizes) < 100_000
    first = rig.records[0].wire
    assert 30_000 < sum(len(message.payload) for message in first) < 48_000
    assert first[-1].stamp_ns == rig.records[0].sent_ns
    for record in rig.records[1:-1]:
        assert [m.channel for m in record.wire].count("tx") == 1, "repeats of a command are not recorded"
        assert len([m for m in record.wire if m.channel == "rx"]) >= 10


def test_a_finished_run_hands_the_robot_back_after_damping(stood: Stood) -> None:
    """Sport mode has the robot again, asked for after the last motor command."""
    rig, _ = stood
    assert rig.device.sport_name == "normal"
    assert ("handed back", "the robot's own controller has the robot again") in rig.events
    last_command = max(stamp for stamp, *_ in rig.commands)
    asked = [stamp for stamp, topic, _ in rig.tap.received if topic == SWITCHER]
    assert asked[-1] > last_command
    assert rig.records[-1].events[-1].kind == "ended"


def test_a_trip_damps_at_once_and_repeats_nothing(stood: Stood) -> None:
    """A motor at 95 degrees: in the cycle that sees it the last command is damping, and stays it."""
    rig = LegRig(hot_after_s=1.3)
    report = rig.loop(hand_back=True).run()
    assert report.outcome is Outcome.TRIPPED
    assert report.reason == "the motor of joint 'FL_calf_joint' is at 95 °C, at most 85 °C are allowed"
    assert report.passive_confirmed
    after = [(stamp - rig.tripped_ns, kind) for stamp, kind, _ in rig.commands if stamp >= rig.tripped_ns]
    # The last repeat as the cycle begins; then three copies each of the trip's own damping and of the first
    # attempt to have it confirmed; then the two attempts that show it is no chance.
    assert after[:7] == [(0, STIFF), *[(0, DAMPING)] * 6]
    assert [kind for _, kind in after[7:]] == [DAMPING] * 6 and after[-1][0] < 50_000_000
    assert rig.records[-2].sent is None
    # Nobody hands a robot back after a trip: somebody should look at it first.
    assert rig.device.sport_name == ""
    assert "handing back" not in dict(rig.beats)


def test_another_program_on_the_wire_trips_with_the_drivers_words(stood: Stood) -> None:
    """Sport mode returns: the driver's fault reaches the safety module and the operator."""
    rig = LegRig(sport_after_s=1.2)
    report = rig.loop().run()
    assert report.outcome is Outcome.TRIPPED
    assert "another program commands the robot's motors" in report.reason
    assert rig.safety.decisions[-1].flags[0] == "device_fault"
    assert rig.safety.inputs[-1].fault == report.reason
    assert rig.safety.inputs[-2].fault == ""


def test_the_remote_stops_the_run(stood: Stood) -> None:
    """L2+B is the operator's stop, no trip; the robot is handed back after it."""
    rig = LegRig(stop_after_s=1.2)
    report = rig.loop(hand_back=True).run()
    assert (report.outcome, report.reason) == (Outcome.STOPPED, "L2+B was pressed on the remote")
    assert report.passive_confirmed
    assert rig.device.sport_name == "normal"


def test_an_unconfirmed_robot_is_not_handed_back() -> None:
    """The robot falls silent as the operator stops: nothing is asked of its services."""
    rig = LegRig()

    def end() -> None:
        rig.device.begin_fault("freeze")
        loop.request_stop()

    # Long enough that the wire is opened again without success.
    loop = rig.loop(At(3, end), hand_back=True, passive=PassiveConfig(timeout_s=4.0))
    report = loop.run()
    assert (report.outcome, report.passive_confirmed) == (Outcome.STOPPED, False)
    assert "handing back" not in dict(rig.beats)
    assert rig.commands[-1][1] == DAMPING
    assert not any(t == SWITCHER for stamp, t, _ in rig.tap.received if stamp >= rig.tripped_ns)


def test_a_robot_that_cannot_be_handed_back_is_a_warning() -> None:
    """Its services do not answer any more: the run still finished, and the operator is informed."""
    rig = LegRig()
    report = rig.loop(
        At(3, lambda: rig.tap.deaf_to.add(SWITCHER)), hand_back=True, hand_back_timeout_s=1.0
    ).run()
    assert (report.outcome, report.passive_confirmed) == (Outcome.FINISHED, True)
    warnings = [message for kind, message in rig.events if kind == "warning"]
    assert len(warnings) == 1
    assert warnings[0].startswith("the robot did not return to its own controller: ")


@pytest.mark.parametrize("stall_ms", [200, 700])
def test_a_stall_trips_and_its_record_still_fits(stall_ms: int) -> None:
    """Hundreds of states wait after a stall: the record that says why the run ended must get through."""
    rig = LegRig()
    keep = rig.sink

    def stall(record: CycleRecord) -> bool:
        rig.clock.advance_ns(stall_ms * MS if record.cycle == 60 else 0)
        return keep(record)

    rig.sink = stall  # type: ignore[method-assign]
    report = rig.loop().run()
    assert report.outcome is Outcome.TRIPPED
    assert report.reason.startswith(f"no command was sent for {stall_ms} ms")
    assert all(len(encode(record)) < 128 * 1024 for record in rig.records)
    assert ("passive", report.reason) in rig.events
    states = [state.sequence for record in rig.records for state in record.states]
    lost = int(np.sum(np.diff(states) - 1))
    assert (lost == 0) is (stall_ms == 200), "of more states than fit, the newest are kept"


def test_a_policy_never_sees_an_orientation_that_is_no_number() -> None:
    """An inertial sensor that reports NaN trips before anything is computed from it."""
    rig = LegRig()

    def blind() -> None:
        nan = np.full(4, np.nan)
        rig.tap.state = lambda state: dataclasses.replace(state, orientation=nan)

    behaviour = At(3, blind)
    report = rig.loop(behaviour).run()
    assert report.outcome is Outcome.TRIPPED
    assert report.reason == "the inertial sensor reports a value that is not finite"
    seen = [state.body for state in behaviour.seen if state.body is not None]
    assert len(seen) == 4
    assert all(np.isfinite(body.orientation).all() for body in seen)


def test_a_dry_run_sends_nothing_at_all() -> None:
    """Sport mode keeps the robot: no motor command, no request; commands are computed and recorded."""
    rig = LegRig()
    report = rig.loop(dry_run=True, hand_back=True, duration_s=0.5).run()
    assert (report.outcome, report.cycles_sent) == (Outcome.FINISHED, 0)
    assert rig.tap.received == []
    assert "handing back" not in dict(rig.beats), "nothing was taken"
    assert rig.device.sport_name == "normal"
    assert all(record.requested is not None and record.sent is None for record in rig.records[:-1])


def test_a_robot_that_hangs_needs_no_standing_up() -> None:
    """Its legs go to the default pose in the air, without a floor, and are damped at the end."""
    clock = VirtualClock(10**9)
    device = Go2Device(nominal_truth("ideal"), on_stand=True)
    robot = Go2OnStandRobot(VirtualTopics(device, clock), clock)
    records: list[CycleRecord] = []

    def sink(record: CycleRecord) -> bool:
        records.append(record)
        return True

    hold, safety = HoldBehaviour(ON_STAND), Safety(ON_STAND)
    report = ControlLoop(robot, hold, safety, clock, sink, LoopConfig(duration_s=2.5)).run()
    assert (report.outcome, report.passive_confirmed) == (Outcome.FINISHED, True), report.reason
    last = records[-2].states[-1]
    np.testing.assert_allclose(last.position, ON_STAND.default_position, atol=0.12)
    assert device.log.changes[-1][2] == DAMPING


@given(st.lists(st.integers(0, 60_000), max_size=12))
def test_of_raw_bytes_the_newest_that_fit_are_kept(sizes: list[int]) -> None:
    """A suffix, in order, as long as possible; 16 bytes and the channel's name go with each."""
    wire = [Message("rx", bytes(size), stamp) for stamp, size in enumerate(sizes)]
    kept = _newest(wire)
    assert kept == tuple(wire[len(wire) - len(kept) :])
    cost = [size + 18 for size in sizes]
    assert sum(cost[len(wire) - len(kept) :]) <= 48_000
    assert len(kept) == len(wire) or sum(cost[len(wire) - len(kept) - 1 :]) > 48_000
