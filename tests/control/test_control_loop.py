"""The control loop in virtual time against the real driver and device core: bytes on a virtual wire."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fakes.linear_policy import LinearPolicy, feedback_spec

from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.passive import PassiveConfig
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.record import CycleFlag, CycleRecord
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.errors import ConfigurationError, DatasetError, TransportTimeoutError
from deal_hw.motions.behaviours import Behaviour, HoldBehaviour, PolicyBehaviour
from deal_hw.motions.excitation.behaviours import RichBehaviour, RichConfig
from deal_hw.motions.planned_end import ENDING_EVENT, PlannedEnd
from deal_hw.testing.faults import FaultRates, FaultyTransport, FrameFaults
from deal_hw.types import FloatArray, JointCommand, RobotState, Status

MS = 1_000_000


def balance(disturb: Callable[[int, FloatArray], FloatArray] = lambda k, a: a) -> PolicyBehaviour:
    """Return a behaviour that balances the nominal cart-pole."""
    return PolicyBehaviour(LinearPolicy(feedback_spec(DESCRIPTION), disturb=disturb), DESCRIPTION)


def make_loop(rig: Any, behaviour: Behaviour, *, sink: Any = None, **config: Any) -> ControlLoop:
    """Return a loop on the rig's robot."""
    settings = LoopConfig(**{"duration_s": 2.0, **config})
    return ControlLoop(rig.robot, behaviour, Safety(DESCRIPTION), rig.clock, sink or rig.sink, settings)


def sent_types(rig: Any) -> list[protocol.MessageType]:
    """Return the types of all messages that the host put on the wire."""
    decoder = protocol.FrameDecoder()
    wire = [m for record in rig.records for m in record.wire] + rig.robot.take_wire()
    payloads = decoder.feed(b"\0" + b"".join(m.payload for m in wire if m.channel == "tx"))
    return [protocol.decode(payload).TYPE for payload in payloads]


def test_a_run_balances_and_ends_passive(rig: Any) -> None:
    """2 s are 100 commands; the pole stands; hello, home, arm come first and stop comes last."""
    report = make_loop(rig, balance()).run()
    assert (report.outcome, report.reason, report.error) == (Outcome.FINISHED, "the run is over", "")
    assert report.passive_confirmed
    assert (report.cycles_sent, report.loop_timing.cycles, report.loop_timing.overruns) == (100, 100, 0)
    assert abs(rig.device.true_trajectory().position[-200, 1]) < 0.05
    types = sent_types(rig)
    assert types[:3] == [protocol.MessageType.HELLO, protocol.MessageType.HOME, protocol.MessageType.ARM]
    assert types[3:103] == [protocol.MessageType.TARGET] * 100
    assert set(types[103:]) == {protocol.MessageType.STOP}


def test_records_hold_each_state_once_and_what_was_sent(rig: Any) -> None:
    """100 cycles and one last record; 5 ms between states; commands numbered from 0 every 20 ms."""
    make_loop(rig, balance()).run()
    assert [r.cycle for r in rig.records] == list(range(101))
    states = [s for r in rig.records for s in r.states]
    assert np.unique(np.diff([s.device_ns for s in states])).tolist() == [5 * MS]
    assert [r.sent_sequence for r in rig.records[:-1]] == list(range(100))
    assert set(np.diff([r.sent_ns for r in rig.records[:-1]])) == {20 * MS}
    assert {r.safety_state for r in rig.records[:-1]} == {"active"}
    for record in rig.records[:-1]:
        assert record.requested is not None and record.sent is not None and record.action is not None
        # The wire carries whole micrometres.
        assert abs(record.requested.position_target[0] - record.sent.position_target[0]) <= 0.5e-6
    # The last state of the run answers the last command, or the one before.
    assert states[-1].command_sequence >= 98


def test_dry_run_computes_and_sends_nothing(rig: Any) -> None:
    """Not a byte, hello included; but the commands are in the record."""
    rig.robot = CartpoleRobot(listen_only(rig.transport), rig.clock)
    report = make_loop(rig, balance(), dry_run=True).run()
    assert report.outcome is Outcome.FINISHED
    assert report.cycles_sent == 0
    assert sent_types(rig) == []
    assert all(r.requested is not None and r.sent is None for r in rig.records[:-1])
    assert {r.safety_state for r in rig.records[:-1]} == {"disarmed"}


def test_dry_run_says_what_would_have_tripped(rig: Any) -> None:
    """A NaN in a dry run is noted once, and the run goes on."""
    report = make_loop(rig, balance(lambda k, a: a * math.nan if k == 3 else a), dry_run=True).run()
    assert report.outcome is Outcome.FINISHED
    assert ("would trip", "while disarmed: action_not_finite") in rig.events
    assert rig.records[3].requested is not None and math.isnan(rig.records[3].requested.position_target[0])


def test_a_policy_that_returns_nan_trips_and_nothing_of_it_is_sent(rig: Any) -> None:
    """In cycle 10: ten commands, then stop."""
    report = make_loop(rig, balance(lambda k, a: a * math.nan if k == 10 else a)).run()
    assert report.outcome is Outcome.TRIPPED
    assert report.reason == "the policy asked for a command that is not finite"
    assert (report.cycles_sent, report.passive_confirmed) == (10, True)
    assert ("passive", report.reason) in rig.events
    assert rig.records[10].sent is None and rig.records[10].safety_state == "passive"


def test_a_policy_that_is_late_trips(rig: Any) -> None:
    """A policy that takes 41 ms in cycle 5; the record is flagged."""

    def late(call: int, action: FloatArray) -> FloatArray:
        rig.clock.advance_ns(41 * MS if call == 5 else 0)
        return action

    report = make_loop(rig, balance(late)).run()
    assert report.outcome is Outcome.TRIPPED
    assert report.reason.startswith("the policy took 41.0 ms, at most 40 ms are allowed")
    assert rig.records[5].flags & CycleFlag.POLICY_LATE
    assert report.cycles_sent == 5


def test_a_policy_that_is_a_little_late_overruns_and_goes_on(rig: Any) -> None:
    """30 ms in one cycle: the next starts 10 ms late, the one after is on the grid again."""

    def late(call: int, action: FloatArray) -> FloatArray:
        rig.clock.advance_ns(30 * MS if call == 5 else 0)
        return action

    report = make_loop(rig, balance(late)).run()
    assert report.outcome is Outcome.FINISHED
    assert (report.loop_timing.overruns, report.loop_timing.overruns_beyond_period) == (1, 0)
    late_by = [r.start_ns - r.deadline_ns for r in rig.records[:10]]
    assert late_by == [0, 0, 0, 0, 0, 0, 10 * MS, 0, 0, 0]


def test_clipping_by_us_is_flagged_and_counted(rig: Any) -> None:
    """Set-points of 0.3 m go out as 0.25 m, with a flag in each record and one event."""
    report = make_loop(rig, HoldBehaviour(DESCRIPTION, np.array([0.3])), duration_s=0.2).run()
    assert report.outcome is Outcome.FINISHED
    assert report.clipped == {"target": 10}
    assert all(r.flags & CycleFlag.CLIPPED for r in rig.records[:10])
    assert [r.sent.position_target[0] for r in rig.records[:10] if r.sent] == [0.25] * 10
    assert [kind for kind, _ in rig.events].count("clipped") == 1


def test_running_into_the_end_of_the_track_trips(rig: Any) -> None:
    """A behaviour that pushes as hard as it may over the end is stopped there, 20 mm before the end stop."""

    class Push:
        action = None

        def reset(self) -> None:
            """Nothing."""

        def command(self, state: RobotState, time_s: float) -> JointCommand:
            """Hold 0.25 m without damping at full effort: the cart shoots past it."""
            one = np.ones(1)
            return JointCommand(0.25 * one, 0 * one, 200 * one, 0 * one, 0 * one, 8 * one, 3 * one)

    report = make_loop(rig, Push()).run()
    assert report.outcome is Outcome.TRIPPED
    assert "joint 'cart' is at 0.3" in report.reason


def test_an_operator_stop_ends_the_run_passively(rig: Any) -> None:
    """A stop asked for in cycle 7 ends with cycle 8, or in that cycle, and is no trip."""
    loops: list[ControlLoop] = []

    def stop(call: int, action: FloatArray) -> FloatArray:
        if call == 7:
            loops[0].request_stop()
        return action

    loops.append(make_loop(rig, balance(stop)))
    report = loops[0].run()
    assert (report.outcome, report.reason) == (Outcome.STOPPED, "stopped by the operator")
    assert report.cycles_sent == 7


@pytest.mark.parametrize("phase", ["connecting", "homing", "arming"])
def test_a_stop_while_waiting_for_the_robot_is_obeyed_at_once(rig: Any, phase: str) -> None:
    """Before there are cycles, a stop interrupts whatever is waited for; nothing was sent to the motor."""
    loops: list[ControlLoop] = []

    def progress(name: str, silence_s: float) -> None:
        if name == phase:
            loops[0].request_stop()

    config = LoopConfig(duration_s=2.0)
    loops.append(
        ControlLoop(rig.robot, balance(), Safety(DESCRIPTION), rig.clock, rig.sink, config, progress=progress)
    )
    report = loops[0].run()
    assert (report.outcome, report.cycles_sent) == (Outcome.STOPPED, 0)


def test_a_stop_before_the_run_ends_it_before_it_begins(rig: Any) -> None:
    """Nothing is sent at all."""
    loop = make_loop(rig, balance())
    loop.request_stop("too early")
    report = loop.run()
    assert (report.outcome, report.reason) == (Outcome.STOPPED, "too early")
    assert sent_types(rig) == []


def test_ctrl_c_in_the_behaviour_ends_passively(rig: Any) -> None:
    """From Python, a KeyboardInterrupt is an operator's stop."""

    def interrupt(call: int, action: FloatArray) -> FloatArray:
        if call == 3:
            raise KeyboardInterrupt
        return action

    report = make_loop(rig, balance(interrupt)).run()
    assert (report.outcome, report.passive_confirmed) == (Outcome.STOPPED, True)


def test_a_bug_in_the_behaviour_ends_passively_with_its_message(rig: Any) -> None:
    """Any exception makes the robot passive first and is reported afterwards."""

    def broken(call: int, action: FloatArray) -> FloatArray:
        if call == 3:
            raise ZeroDivisionError("three")
        return action

    report = make_loop(rig, balance(broken)).run()
    assert (report.outcome, report.reason, report.error) == (Outcome.FAILED, "three", "ZeroDivisionError")
    assert report.passive_confirmed
    assert rig.records[-1].events[-1].kind == "ended"


def test_a_cable_that_is_pulled_fails_with_what_to_do(rig: Any) -> None:
    """The run is tripped; the robot cannot confirm; its own watchdog stops the motor 200 ms later."""

    def pull(call: int, action: FloatArray) -> FloatArray:
        if call == 20:
            rig.transport.unplug()
        return action

    report = make_loop(rig, balance(pull)).run()
    assert (report.outcome, report.error) == (Outcome.TRIPPED, "")
    assert report.reason == "the connection is lost: virtual wire: the device vanished"
    assert not report.passive_confirmed
    assert ("passive", report.reason) in rig.events
    assert rig.device.armed
    rig.device.advance_to(rig.clock.now_ns())
    for _ in range(200):
        rig.device.tick()
    assert not rig.device.armed


def test_a_state_stream_that_stops_trips(rig: Any) -> None:
    """Without states the newest one grows old: 60 ms and no more."""

    class Deaf(FaultyTransport):
        deaf = False

        def receive(self, timeout_s: float) -> Any:
            if not self.deaf:
                return super().receive(timeout_s)
            rig.clock.advance_ns(round(timeout_s * 1e9))
            raise TransportTimeoutError("nothing")

    transport = Deaf(rig.transport)
    rig.robot = CartpoleRobot(transport, rig.clock)

    def silence(call: int, action: FloatArray) -> FloatArray:
        transport.deaf = call >= 30
        return action

    report = make_loop(rig, balance(silence), passive=PassiveConfig(timeout_s=0.1)).run()
    assert report.outcome is Outcome.TRIPPED
    # Ages at the cycles after the last state: 20, 40, 60 (allowed), 80 ms.
    assert report.reason == "the newest state is 80 ms old, at most 60 ms are allowed"
    assert report.flags == ("state_stale",)
    assert report.cycles_sent == 34
    assert rig.records[31].flags & CycleFlag.NO_STATE
    assert not report.passive_confirmed


@pytest.mark.parametrize(("share", "outcome"), [(0.05, Outcome.FINISHED), (0.5, Outcome.TRIPPED)])
def test_corrupt_frames_are_survived_up_to_a_share(rig: Any, share: float, outcome: Outcome) -> None:
    """5 % is counted and survived; 50 % trips."""
    faults = FrameFaults(FaultRates(corrupt=share), np.random.default_rng(3))
    rig.robot = CartpoleRobot(FaultyTransport(rig.transport, received=faults), rig.clock)
    report = make_loop(rig, balance()).run()
    assert report.outcome is outcome
    assert report.loop_timing.transport_errors > 0
    assert any(r.flags & CycleFlag.LINK_ERROR for r in rig.records)


def test_a_recorder_that_refuses_is_counted(rig: Any) -> None:
    """Each third hand-over refused: 33 of 100 lost, and each record says how many were lost before."""
    count = 0

    def sink(record: CycleRecord) -> bool:
        nonlocal count
        count += 1
        return rig.sink(record) if count % 3 else False

    report = make_loop(rig, balance(), sink=sink).run()
    assert report.outcome is Outcome.FINISHED
    assert report.loop_timing.losses == 33
    assert rig.records[-1].lost == 33


def test_a_recorder_that_is_gone_ends_the_run_passively(rig: Any) -> None:
    """No record, no run."""

    def sink(record: CycleRecord) -> bool:
        if record.cycle >= 12:
            raise DatasetError("the recorder has ended")
        return True

    report = make_loop(rig, balance(), sink=sink).run()
    assert (report.outcome, report.reason, report.error) == (
        Outcome.FAILED,
        "the recorder has ended",
        "DatasetError",
    )
    assert report.passive_confirmed


def test_a_record_that_cannot_be_made_does_not_hide_how_the_robot_is(rig: Any) -> None:
    """A bug while records are written, and a robot that no longer answers: the report says both."""

    def silent(timeout_s: float) -> Any:
        raise TransportTimeoutError("no answer")

    def sink(record: CycleRecord) -> bool:
        rig.transport.receive = silent
        raise RuntimeError("cannot encode")

    report = make_loop(rig, balance(), sink=sink, passive=PassiveConfig(timeout_s=0.2)).run()
    assert (report.outcome, report.reason, report.error) == (Outcome.FAILED, "cannot encode", "RuntimeError")
    assert not report.passive_confirmed


def test_rich_runs_twice_alike_and_reaches_the_devices_own_limits(rig: Any) -> None:
    """The same seed gives the same motion, bit for bit; the device clamps, we do not."""
    report = make_loop(rig, RichBehaviour(DESCRIPTION, balance(), RichConfig(), 5), duration_s=4.0).run()
    other = type(rig)()
    make_loop(other, RichBehaviour(DESCRIPTION, balance(), RichConfig(), 5), duration_s=4.0).run()
    assert report.outcome is Outcome.FINISHED
    assert report.clipped == {}
    a, b = ([s.position for r in x.records for s in r.states] for x in (rig, other))
    assert np.array_equal(a, b)
    assert any(
        s.status & (Status.EFFORT_CLAMPED | Status.SPEED_CLAMPED) for r in rig.records for s in r.states
    )


def test_the_heartbeat_names_each_phase(rig: Any) -> None:
    """Phases in order, each with the longest silence to be expected."""
    phases: list[tuple[str, float]] = []
    loop = ControlLoop(
        rig.robot,
        balance(),
        Safety(DESCRIPTION),
        rig.clock,
        rig.sink,
        LoopConfig(duration_s=0.1),
        progress=lambda name, silence_s: phases.append((name, silence_s)),
    )
    loop.run()
    assert [name for name, _ in phases] == [
        "connecting",
        "homing",
        "arming",
        *["running"] * 5,
        "making passive",
    ]
    assert all(silence_s > 0 for _, silence_s in phases)


def test_the_report_survives_json(rig: Any) -> None:
    """It crosses a process boundary."""
    report = make_loop(rig, balance(), duration_s=0.1).run()
    assert json.loads(json.dumps(report.to_json(), allow_nan=False)) == report.to_json()


def test_settings_that_cannot_be_are_refused() -> None:
    """A run of no time."""
    with pytest.raises(ConfigurationError, match="a length above 0 s"):
        LoopConfig(duration_s=0.0)


@pytest.mark.parametrize(
    ("reason", "outcome", "reported"),
    [
        ("", Outcome.FINISHED, "the run is over"),
        ("the battery is low", Outcome.STOPPED, "the battery is low"),
    ],
)
def test_a_planned_end_may_come_before_the_time_is_up(
    rig: Any, reason: str, outcome: Outcome, reported: str
) -> None:
    """The cycle that is over is the last; its parts are events; it makes the robot passive like every end."""
    end = PlannedEnd()

    class Ends(HoldBehaviour):
        def command(self, state: RobotState, time_s: float) -> JointCommand:
            if abs(time_s - 0.2) < 1e-6:
                end.reason = reason
                end.note("it lies down")
            end.over = time_s > 0.39
            return super().command(state, time_s)

    settings = LoopConfig(duration_s=2.0)
    loop = ControlLoop(
        rig.robot, Ends(DESCRIPTION), Safety(DESCRIPTION), rig.clock, rig.sink, settings, end=end
    )
    report = loop.run()
    assert (report.outcome, report.reason, report.passive_confirmed) == (outcome, reported, True)
    # Cycles 0 to 20 at 50 Hz; the last one, at 0.4 s, says that it is over.
    assert report.cycles_sent == 21
    assert [message for kind, message in rig.events if kind == ENDING_EVENT] == ["it lies down"]
