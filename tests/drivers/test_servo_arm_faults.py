"""One servo of an arm fails in a run: the run trips, names it, and all motors become passive."""

from __future__ import annotations

import re
from collections import deque
from pathlib import Path
from typing import Any

import pytest
from arm_rig import BUSES, Rig
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.passive import PassiveConfig
from deal_hw.control.safety.safety import Safety
from deal_hw.drivers.servo_arm.absence import QUIET_NS, SILENT_NS, AbsenceWatch, CollisionWatch
from deal_hw.drivers.servo_arm.families import DAMPING, FAMILIES, OFF, ON
from deal_hw.drivers.servo_arm.faults import ArmFaults
from deal_hw.drivers.servo_arm.robot import ServoArm
from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus.interface import SilentServosError
from deal_hw.errors import ConfigurationError, FrameError, SafetyError, TransportTimeoutError
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.testing.faults import FaultyTransport, OneBadFrame
from deal_hw.transport import Message, Transport, TransportWrapper
from deal_hw.workflows.emulation.plug_in import request_of
from deal_hw.workflows.emulation.settings import EmulateArmSettings

PASSIVE = {"dynamixel": OFF, "feetech": DAMPING}
NAMES = {1: "servo 1 (shoulder)", 2: "servo 2 (elbow)"}
SILENT = (
    "stopped answering: it restarted, or lost its supply or its cable. Check both, end other programs on the "
    "bus, then start again"
)
PERIOD_NS = 20_000_000


def played(rig: Rig) -> LoopReport:
    """Hold the start pose for 0.6 s by the control loop, which gives up an unconfirmed end after 2 s."""
    config = LoopConfig(duration_s=0.6, passive=PassiveConfig(timeout_s=2.0))
    robot, description = rig.robot, rig.description
    loop = ControlLoop(
        robot, HoldBehaviour(description), Safety(description), rig.clock, lambda record: True, config
    )
    return loop.run()


def torques(rig: Rig) -> list[int]:
    """How each motor is."""
    return [int(joint.torque) for joint in rig.device.joints]


@pytest.fixture(params=BUSES)
def bus(request: pytest.FixtureRequest) -> str:
    """The bus."""
    return str(request.param)


@pytest.fixture(params=[1, 2])
def servo(request: pytest.FixtureRequest) -> int:
    """The servo that fails: the first of a group is the one that hides the others on a Dynamixel bus."""
    return int(request.param)


def test_an_unplugged_servo_is_named(tmp_path: Path, bus: str, servo: int) -> None:
    """Before the age of the states ends the run; nobody confirms that all motors are passive."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(faulty_servo=servo, servo_absent_after_s=0.3))
    report = played(rig)
    assert (report.outcome, report.passive_confirmed) == (Outcome.TRIPPED, False)
    assert report.reason == f"{NAMES[servo]} {SILENT}"
    assert report.flags == ("device_fault",)
    wanted = [PASSIVE[bus], PASSIVE[bus]]
    # Without supply it neither holds nor brakes.
    wanted[servo - 1] = OFF
    assert torques(rig) == wanted


def test_a_restarting_servo_is_named_and_becomes_passive(tmp_path: Path, bus: str, servo: int) -> None:
    """It is silent at first; when it answers again, it gets the passive command, too."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(faulty_servo=servo, servo_reboot_after_s=0.3))
    report = played(rig)
    assert (report.outcome, report.passive_confirmed) == (Outcome.TRIPPED, True)
    assert report.reason == f"{NAMES[servo]} {SILENT}"
    assert torques(rig) == [PASSIVE[bus]] * 2


def test_an_overload_trips_with_its_remedy(tmp_path: Path, bus: str, servo: int) -> None:
    """A Dynamixel servo gives no torque until it was switched off; a Feetech servo holds with less."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(faulty_servo=servo, servo_overload_after_s=0.3))
    report = played(rig)
    assert (report.outcome, report.passive_confirmed) == (Outcome.TRIPPED, True)
    remedy = {
        "dynamixel": "overload (look for a jam or too high a load; lower the effort limit); it gives no "
        "torque until it is switched off and on",
        "feetech": "overload: it holds with reduced torque (take the load off and look for a jam; if the "
        "next start still reports it, switch the servo's supply off and on)",
    }[bus]
    assert report.reason.startswith(f"{NAMES[servo]} reports: {remedy}")
    assert torques(rig) == [PASSIVE[bus]] * 2


def test_an_overload_that_stays_refuses_the_next_start(tmp_path: Path, bus: str) -> None:
    """Nothing moves; after the remedy the arm starts again."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(servo_overload_after_s=0.3))
    played(rig)
    rig.robot.connect()
    with pytest.raises(SafetyError, match=r"servo 2 \(elbow\) reports: overload"):
        rig.robot.home(5.0)
    assert ON not in torques(rig)
    rig.device.joints[1].restart(rig.clock.now_ns())
    rig.advance(1.0)
    rig.robot.home(5.0)
    rig.robot.arm(1.0)
    assert torques(rig) == [ON, ON]


def test_a_servo_without_data_is_stopped_by_its_own_watchdog_only(tmp_path: Path, bus: str) -> None:
    """Its supply stays: a Feetech servo holds its goal for ever, and the run says that it is not passive."""
    rig = Rig(tmp_path, bus)
    step = rig.device._step

    def cut_after_a_while() -> None:
        if rig.robot._sequence >= 20:
            rig.servos[1].present = False
        step()

    rig.device._step = cut_after_a_while  # type: ignore[method-assign]
    report = played(rig)
    assert report.outcome is Outcome.TRIPPED and not report.passive_confirmed
    assert report.reason == f"{NAMES[2]} {SILENT}"
    assert torques(rig) == [PASSIVE[bus], ON]
    assert rig.device.joints[1].stopped == (bus == "dynamixel")


def test_a_servo_that_falls_silent_on_the_way_to_the_start_pose_is_named(
    tmp_path: Path, bus: str, servo: int
) -> None:
    """And the others become passive."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(faulty_servo=servo, servo_absent_after_s=0.2))
    robot = rig.armed()
    rig.run(3, target=0.8)
    with pytest.raises(TransportTimeoutError) as caught:
        robot.home(20.0)
    assert str(caught.value).endswith(f"{NAMES[servo]} {SILENT}")
    rig.advance(0.05)
    assert ON not in torques(rig)


def test_a_short_silence_of_one_servo_is_no_fault(tmp_path: Path, bus: str, servo: int) -> None:
    """Two missed states: the run goes on, and they are counted."""
    rig = Rig(tmp_path, bus)
    robot = rig.armed()
    rig.run(5)
    rig.servos[servo - 1].present = False
    rig.run(2)
    rig.servos[servo - 1].present = True
    assert len(rig.run(5)) >= 4
    assert not robot.fault and robot.transport_errors >= 2


def test_a_torque_that_another_program_took_is_said(tmp_path: Path, bus: str) -> None:
    """As LeRobot's programs begin: with torque off."""
    rig = Rig(tmp_path, bus)
    robot = rig.armed()
    rig.run(3)
    rig.device.receive(_torque_off(rig))
    rig.run(3)
    assert "servo 2 (elbow) lost its torque" in robot.fault and "another program" in robot.fault


# Another master, and two servos of one id.

FOREIGN = r"another program commands this bus: servo 2 \(elbow\) has the goal 2200 ticks, which this run did "
ON_LINE = r"another program commands this bus: on the bus came a packet \(sync write\) to all servos"
TWOFOLD = {
    servo: f"two servos answer as id {servo} ({NAMES[servo][9:-1]}), or its plug is loose" for servo in (1, 2)
}


def commands_until_the_trip(rig: Rig) -> int:
    """Run until the driver has a fault; return how many commands were sent after another program began."""
    robot = rig.armed()
    while not rig.device.trouble:
        rig.run(1)
    count = 0
    while not robot.fault:
        rig.run(1)
        count += 1
        assert count < 20, "no fault"
    return count


@pytest.mark.parametrize(("rate_hz", "most"), [(100.0, 3), (60.0, 3), (30.0, 5)])
def test_another_programs_goals_trip_at_once(tmp_path: Path, bus: str, rate_hz: float, most: int) -> None:
    """By the second state that shows one: within two or three cycles where it writes in each of them."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(foreign_writer_after_s=0.3, foreign_rate_hz=rate_hz))
    assert commands_until_the_trip(rig) <= most
    assert re.match(FOREIGN, rig.robot.fault) and "end it" in rig.robot.fault
    assert "torque and goals again" in rig.robot.fault


def test_a_run_with_another_program_ends_passive(tmp_path: Path, bus: str) -> None:
    """The reason is that, and no number of transport errors; that all motors are passive is confirmed."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(foreign_writer_after_s=0.3))
    report = played(rig)
    assert (report.outcome, report.passive_confirmed) == (Outcome.TRIPPED, True)
    assert re.match(FOREIGN, report.reason) and report.flags == ("device_fault",)
    assert torques(rig) == [PASSIVE[bus]] * 2


def test_another_masters_packets_on_the_line_are_named(tmp_path: Path, bus: str) -> None:
    """Even where it writes what this run writes: two masters on one line collide."""
    rig = Rig(tmp_path, bus)
    robot = rig.armed()
    rig.run(3)
    for _ in range(2):
        assert not robot.fault
        rig.device.bus.receive_foreign(rig.device.joints[1].goal_packet(rig.device.joints[1].goal), True)
        rig.run(1)
    assert re.match(ON_LINE, robot.fault)


def test_another_program_is_named_on_the_way_to_the_start_pose(tmp_path: Path, bus: str) -> None:
    """And not as a joint that is blocked; the motors become passive."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(foreign_writer_after_s=0.2, foreign_rate_hz=100.0))
    robot = rig.armed()
    rig.run(3, target=0.8)
    with pytest.raises(SafetyError, match=FOREIGN.replace("2200", r"\d+")):
        robot.home(20.0)
    rig.advance(0.05)
    assert ON not in torques(rig)


def test_after_the_other_program_has_ended_the_arm_starts_again(tmp_path: Path, bus: str) -> None:
    """Its goals are those before the start."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(foreign_writer_after_s=0.3))
    played(rig)
    rig.device._other = None
    rig.robot.connect()
    rig.robot.home(5.0)
    rig.robot.arm(1.0)
    assert len(rig.run(10)) >= 9 and not rig.robot.fault


def test_one_corrupt_goal_is_no_other_program(tmp_path: Path, bus: str) -> None:
    """Of a corrupt answer that passed its checksum, or of such a command."""
    rig = Rig(tmp_path, bus)
    robot = rig.armed()
    rig.run(3)
    rig.device.bus.receive_foreign(rig.device.joints[1].goal_packet(2345), False)
    errors = robot.transport_errors
    rig.run(30)
    assert not robot.fault and robot.transport_errors <= errors + 1


def test_a_second_servo_of_one_id_is_named(tmp_path: Path, bus: str, servo: int) -> None:
    """Before the age of the states ends the run. Nobody confirms that both servos are passive."""
    rig = Rig(tmp_path, bus, faults=ArmFaults(faulty_servo=servo, duplicate_id_after_s=0.3))
    report = played(rig)
    assert (report.outcome, report.passive_confirmed) == (Outcome.TRIPPED, False)
    assert report.reason.startswith(TWOFOLD[servo]) and "an id of its own" in report.reason
    assert report.flags == ("device_fault",)
    assert torques(rig) == [PASSIVE[bus]] * 2


@given(st.integers(2, 14), st.data())
def test_noise_is_no_second_servo(count: int, data: st.DataObject) -> None:
    """It spoils now this answer, now that one; a servo that alone is spoilt is named with the third."""
    ids = tuple(range(1, count + 1))
    watch = CollisionWatch(ids, 0)
    now_ns, noisy = 0, data.draw(st.sampled_from(ids))
    for spoilt in (noisy % count + 1, *([noisy] * 20)):
        now_ns += PERIOD_NS
        assert watch.missed([one for one in ids if one != spoilt], now_ns) is None
    now_ns += QUIET_NS
    watch.answered(now_ns)
    named = [watch.missed([one for one in ids if one != noisy], now_ns + k * PERIOD_NS) for k in (1, 2, 3, 4)]
    assert named == [None, None, noisy, noisy]


def _torque_off(rig: Rig) -> bytes:
    """Return the bytes by which a host switches the elbow's torque off."""
    bus: Any = rig.robot._bus
    bus._put_writes(rig.robot._family.torque([2], OFF))
    data = bytes(bus._port.written)
    bus._port.written.clear()
    return data


# What the bus reports.


def test_a_group_with_a_silent_servo_says_who_answered(tmp_path: Path, bus: str) -> None:
    """On a Dynamixel bus those behind it wait in vain; corrupt bytes say nothing about who is there."""
    fault = OneBadFrame(20)
    rig = Rig(tmp_path, bus, lambda transport: FaultyTransport(transport, received=fault))
    rig.robot.connect()
    ask, take = rig.robot._bus.ask, rig.robot._bus.take

    def error_of(servos: tuple[int, ...]) -> Exception:
        ask(servos, *rig.robot._family.block)
        with pytest.raises((SilentServosError, FrameError)) as caught:
            take(rig.clock.now_ns() + 10**9)
        return caught.value

    rig.servos[0].present = False
    silent = error_of((2, 1))
    assert isinstance(silent, SilentServosError) and silent.answered == (2,)
    hidden = error_of((1, 2))
    assert isinstance(hidden, SilentServosError)
    assert hidden.answered == (() if bus == "dynamixel" else (2,))
    fault.corrupt_next()
    assert isinstance(error_of((2, 1)), FrameError)


# Who is absent.


def answers(order: tuple[int, ...], absent: set[int], waiting: bool) -> tuple[int, ...]:
    """Return which servos answer; waiting ones only after the one before them."""
    if not waiting:
        return tuple(servo for servo in order if servo not in absent)
    end = next((k for k, servo in enumerate(order) if servo in absent), len(order))
    return order[:end]


@given(st.integers(1, 14), st.data(), st.booleans())
def test_only_an_absent_servo_is_named(count: int, data: st.DataObject, waiting: bool) -> None:
    """Whatever servos are absent; one alone is named with the third request that it misses."""
    ids = tuple(range(1, count + 1))
    absent = data.draw(st.sets(st.sampled_from(ids), min_size=1))
    watch = AbsenceWatch(ids, 0)
    named = [watch.missed(answers(watch.order, absent, waiting), round(k * PERIOD_NS)) for k in range(1, 7)]
    assert set(named) - {None} <= absent
    if len(absent) == 1:
        assert named == [None, None, *absent, *absent, *absent, *absent]
    if len(absent) == count > 1:
        # A cut cable.
        assert set(named) == {None}


@given(st.integers(2, 14), st.data(), st.booleans())
def test_a_servo_that_answers_again_is_not_named(count: int, data: st.DataObject, waiting: bool) -> None:
    """Silences that are shorter than the limit, however many of them."""
    ids = tuple(range(1, count + 1))
    watch, now_ns = AbsenceWatch(ids, 0), 0
    for servo in data.draw(st.lists(st.sampled_from(ids), max_size=8)):
        for _ in range(4):
            now_ns += SILENT_NS // 4 - 1
            assert watch.missed(answers(watch.order, {servo}, waiting), now_ns) is None
        watch.answered(now_ns)
        assert watch.order == ids


# The emulator's options.


def test_the_faults_reach_the_emulator() -> None:
    """As options of an SO-101 and of a robot.yaml."""
    faults = ArmFaults(faulty_servo=3, servo_reboot_after_s=1.0)
    assert request_of(EmulateArmSettings("so101", servos=faults), "serial").servos == faults


def test_a_faulty_servo_must_exist(tmp_path: Path, bus: str) -> None:
    """The message lists the ids."""
    with pytest.raises(ConfigurationError, match=r"--faulty-servo 7: no servo has this id.*\[1, 2\]"):
        Rig(tmp_path, bus, faults=ArmFaults(faulty_servo=7))


def test_a_robot_without_a_bus_has_no_servos(tmp_path: Path) -> None:
    """Its robot.yaml names none, so a fault of a servo would have no effect."""
    with pytest.raises(ConfigurationError, match=r"--servo-absent-after-s would have no effect.*has a bus"):
        EmulateArmSettings(str(tmp_path / "robot.yaml"), servos=ArmFaults(servo_absent_after_s=1.0))


def test_an_absent_servos_watchdog_counts_its_own_silence(tmp_path: Path) -> None:
    """Packets for the others do not reach it."""
    rig = Rig(tmp_path, "dynamixel")
    rig.armed()
    rig.servos[1].present = False
    rig.run(20)
    assert [servo.watchdog_tripped for servo in rig.servos] == [False, True]
    assert rig.servos[1].get(r.TORQUE_ENABLE) == 1


# An answer that comes too late.


class OneLateAnswer(TransportWrapper):
    """A transport that delays what the servos answer to the next message, if it is told so."""

    def __init__(self, inner: Transport, clock: VirtualClock) -> None:
        super().__init__(inner)
        self.next_is_late = False
        self._clock = clock
        self._delay_ns = 0
        self._waiting: deque[tuple[int, Message]] = deque()

    def send(self, message: Message) -> None:
        """Send a message; the answer to the first one is late."""
        self._delay_ns, self.next_is_late = 20_000_000 * self.next_is_late, False
        self._inner.send(message)

    def receive(self, timeout_s: float) -> Message:
        """Receive the next message at its time."""
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not self._waiting or self._waiting[0][0] > self._clock.now_ns():
            until_ns = min(end_ns, self._waiting[0][0]) if self._waiting else end_ns
            try:
                message = self._inner.receive(max(0, until_ns - self._clock.now_ns()) / 1e9)
                due_ns = self._clock.now_ns() + self._delay_ns
                # Bytes do not overtake each other.
                self._waiting.append((max([due_ns, *(before for before, _ in self._waiting)]), message))
            except TransportTimeoutError:
                if until_ns == end_ns:
                    raise
        return self._waiting.popleft()[1]


def test_a_request_is_repeated_after_the_late_answer(tmp_path: Path, bus: str) -> None:
    """One sample is missed. Otherwise all answers stay one request behind, and are refused as corrupt."""
    rig = Rig(tmp_path, bus)
    link = OneLateAnswer(rig.virtual, rig.clock)
    assert rig.file.servo_bus is not None
    robot = ServoArm(link, rig.clock, rig.description, rig.file.servo_bus, FAMILIES[bus]())
    robot.connect()
    robot.home(5.0)
    before = robot.transport_errors
    link.next_is_late = True
    robot.arm(1.0)
    assert robot.transport_errors == before + 1
