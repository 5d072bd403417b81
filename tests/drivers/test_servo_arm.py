"""An arm of servos on either bus: the robot contract, and what is its own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm_rig import BUSES, Rig

from deal_hw.control.safety.passive import make_passive
from deal_hw.drivers.servo_arm.families import OFF, ServoSample
from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus.feetech import registers as f
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.errors import (
    ConfigurationError,
    SafetyError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.testing.faults import FaultyTransport, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.transport import Message, Transport
from deal_hw.types import Status

TORQUE = {"dynamixel": r.TORQUE_ENABLE, "feetech": f.TORQUE_ENABLE}
GOAL = {"dynamixel": r.GOAL_POSITION, "feetech": f.GOAL_POSITION}
MODEL = {"dynamixel": r.MODEL_NUMBER, "feetech": f.MODEL_NUMBER}
MODE = {"dynamixel": r.OPERATING_MODE, "feetech": f.OPERATING_MODE}


class _ArmSuite(RobotSuite):
    """The contract of a robot, of an arm on one bus."""

    bus = ""

    def outdate(self, rig: Rig) -> None:
        """Make a servo too old."""
        raise NotImplementedError

    @pytest.fixture
    def bench(self, tmp_path: Path) -> RobotBench:
        fault = OneBadFrame(20)
        rig = Rig(tmp_path, self.bus, lambda t: FaultyTransport(t, received=fault))
        foreign, newer, silent = (Rig(tmp_path, self.bus) for _ in range(3))
        foreign.servos[0].put(MODEL[self.bus], 350)
        self.outdate(newer)
        for servo in silent.servos:
            servo.present = False
        return RobotBench(
            robot=rig.robot,
            foreign=foreign.robot,
            newer=newer.robot,
            silent=silent.robot,
            unplug=rig.virtual.unplug,
            corrupt=fault.corrupt_next,
        )


class TestDynamixelArm(_ArmSuite):
    bus = "dynamixel"

    def outdate(self, rig: Rig) -> None:
        rig.servos[1].protocol = 1


class TestFeetechArm(_ArmSuite):
    bus = "feetech"

    def outdate(self, rig: Rig) -> None:
        rig.servos[1].put(f.FIRMWARE_MINOR, 8)


@pytest.fixture(params=BUSES)
def bus(request: pytest.FixtureRequest) -> str:
    """The bus."""
    return str(request.param)


@pytest.fixture
def rig(tmp_path: Path, bus: str) -> Rig:
    """An arm on that bus."""
    return Rig(tmp_path, bus)


def test_the_emulators_latency_is_the_truths(tmp_path: Path, bus: str) -> None:
    """A goal acts from the first physics step of 2 ms that begins 5 ms after its reception."""
    rig = Rig(tmp_path, bus)
    device = rig.device
    device._latency_ns = 5_000_000
    for received_ns, acts_ns in (
        (1_000_000_000, 1_006_000_000),
        (2_000_300_000, 2_006_000_000),
        (3_001_000_000, 3_006_000_000),
        (4_001_100_000, 4_008_000_000),
    ):
        device.advance_to(received_ns)
        rig.servos[1].put(GOAL[bus], 2000 + received_ns // 1_000_000_000)
        device.receive(b"")
        assert device._coming[-1][0] * 2_000_000 == acts_ns


def test_both_directions_of_mounting(rig: Rig) -> None:
    """Both joints go where they are told, though one servo is mounted the other way round."""
    rig.armed()
    states = rig.run(50, target=0.3)
    true = rig.true_position()
    # The arm's weight bends the shoulder by 0.02 rad.
    np.testing.assert_allclose(true, 0.3, atol=0.03)
    np.testing.assert_allclose(states[-1].position, true, atol=2e-3)
    assert rig.servos[0].get(GOAL[rig.file.servo_bus.bus]) == 2048 - round(0.3 * 4096 / (2 * np.pi))  # type: ignore[union-attr]


def test_states_stand_on_a_regular_grid(rig: Rig) -> None:
    """One state a command, 20 ms apart, each of them fresh; nothing is lost."""
    rig.armed()
    states = rig.run(50)
    assert len(states) in (50, 51)
    assert set(np.diff([state.device_ns for state in states[1:]])) == {20_000_000}
    assert rig.robot.transport_errors == 0


def test_moving_joints_are_reported_at_one_time(rig: Rig, bus: str) -> None:
    """The second servo answers after the first: its position is moved back by its velocity.

    Its turn comes 83 bytes later (Dynamixel: 72 and 11 around), or 37 (Feetech: 31 and 6), of 10 us each.
    """
    rig.robot.connect()
    sample = ServoSample(ticks=2048, ticks_s=4096.0, duty=0.0, goal=2048, torque=OFF, fault="")
    shoulder = dataclasses.replace(sample, ticks_s=-4096.0)
    rig.robot._receive({1: shoulder, 2: dataclasses.replace(sample, ticks=2000)})
    (state,) = rig.robot._states
    np.testing.assert_allclose(state.velocity, 2 * np.pi)
    late_s = {"dynamixel": 830e-6, "feetech": 370e-6}[bus]
    assert state.position[0] - state.position[1] == pytest.approx(2 * np.pi * late_s)


def test_connecting_leaves_an_arm_up_that_a_killed_run_left_stiff(rig: Rig, bus: str) -> None:
    """No register is written by connect: torque and goals stay."""
    rig.armed()
    rig.run(20, target=0.4)
    rig.robot.disconnect()
    rig.robot.connect()
    rig.advance(0.1)
    assert [servo.get(TORQUE[bus]) for servo in rig.servos] == [1, 1]
    assert rig.true_position()[1] > 0.3


def test_the_goal_is_where_the_arm_is_before_torque_comes_on(rig: Rig, bus: str) -> None:
    """A servo with an old goal would jump to it."""
    rig.robot.connect()
    for servo in rig.servos:
        servo.put(GOAL[bus], 3000)
    seen: list[tuple[int, int]] = []
    post = rig.robot._bus.post

    def noted(writes: Any) -> int:
        sent_ns = post(writes)
        rig.advance(0.002)
        seen.extend((servo.get(TORQUE[bus]), servo.get(GOAL[bus])) for servo in rig.servos)
        return sent_ns

    rig.robot._bus.post = noted  # type: ignore[method-assign]
    rig.robot.home(20.0)
    assert any(torque for torque, _ in seen)
    assert all(goal < 2200 for torque, goal in seen if torque)


def test_homing_is_slow_and_ends_at_the_start_pose(rig: Rig) -> None:
    """From 0.8 rad away at most 0.5 rad/s, both joints arriving together, with torque kept."""
    rig.armed()
    rig.run(60, target=0.8)
    start_ns = rig.clock.now_ns()
    rig.robot.home(20.0)
    seconds = (rig.clock.now_ns() - start_ns) / 1e9
    assert 1.4 < seconds < 4.0
    np.testing.assert_allclose(rig.true_position(), 0.0, atol=0.05)
    assert rig.device.mode == "armed"


def test_a_blocked_joint_ends_homing_passive(rig: Rig, bus: str) -> None:
    """A joint that does not move is named as in a run, and the arm is passive."""
    rig.armed()
    rig.run(60, target=0.8)
    batch: Any = rig.device._batch
    advance = batch.advance

    def blocked(setpoint: Any, *args: Any) -> Any:
        rig.device._batch.set_state(np.array([[0.8, 0.8]]), np.zeros((1, 2)))
        return advance(setpoint, *args)

    batch.advance = blocked
    with pytest.raises(SafetyError, match=r"joint '(shoulder|elbow)' does not follow: .* It is blocked"):
        rig.robot.home(3.0)
    rig.advance(0.05)
    assert rig.device.mode == ("idle" if bus == "dynamixel" else "braking")


def test_a_joint_far_outside_its_range_is_not_driven(tmp_path: Path, bus: str) -> None:
    """Such as by a wrong zero: the message names the joint, where it is, and what to do."""
    rig = Rig(tmp_path, bus)
    rig.robot.connect()
    start = np.array([[0.0, 2.9]])
    rig.device._batch.set_state(start, np.zeros((1, 2)))
    rig.advance(0.01)
    with pytest.raises(SafetyError, match=r"joint elbow is at 2\.\d+ rad, outside .*move it by hand"):
        rig.robot.home(5.0)
    assert rig.device.mode in ("idle", "braking")


def test_gains_go_out_when_they_change_only(rig: Rig, bus: str) -> None:
    """A stiffer command writes P; the next one the goals alone."""
    robot = rig.armed()
    command = default_command(robot)
    command.stiffness[1] *= 0.5
    sent = robot.send_command(command)
    rig.advance(0.01)
    gains = [joint.gains.p for joint in rig.device.joints]
    assert gains == ([400, 200] if bus == "dynamixel" else [32, 16])
    np.testing.assert_allclose(sent.stiffness, [17.8, 8.9])
    robot.take_wire()
    robot.send_command(command)
    (again,) = [m for m in robot.take_wire() if m.channel == "tx"]
    # Dynamixel: 10 bytes around, address 2, size 2, and 1 + 4 a servo. Feetech: 8 around, and 1 + 2 a servo.
    assert len(again.payload) == (24 if bus == "dynamixel" else 14)


def test_gains_are_not_kept_in_a_feetechs_eeprom(tmp_path: Path) -> None:
    """The lock is on while they are written: after a restart the servo has its own again."""
    rig = Rig(tmp_path, "feetech")
    before = rig.servos[0].get(f.P_GAIN)
    robot = rig.armed()
    command = default_command(robot)
    command.stiffness[:] *= 0.25
    robot.send_command(command)
    rig.advance(0.01)
    assert rig.servos[0].get(f.P_GAIN) == 8
    rig.servos[0].reboot(rig.clock.now_ns())
    assert rig.servos[0].get(f.P_GAIN) == before


def test_an_effort_limit_keeps_to_the_servos_own(tmp_path: Path) -> None:
    """A gripper whose Max Torque is 50 % gets 50 % at the full effort limit."""
    rig = Rig(tmp_path, "feetech")
    rig.servos[1].keep(f.MAX_TORQUE, 500)
    rig.armed()
    rig.advance(0.01)
    assert [servo.get(f.TORQUE_LIMIT) for servo in rig.servos] == [1000, 500]


def test_a_lost_command_is_counted_and_gains_are_sent_again(rig: Rig) -> None:
    """A write that got lost shows with the next sample: the servos still have the goals before."""

    class Deaf(FaultyTransport):
        deaf = False

        def send(self, message: Message) -> None:
            if not self.deaf:
                self._inner.send(message)
            self.deaf = False

    robot = rig.armed()
    rig.run(2)
    deaf = Deaf(rig.virtual, received=None)
    robot._bus._port._transport = deaf
    deaf.deaf = True
    before, errors = robot.last_sequence, robot.transport_errors
    states = rig.run(1, target=0.1)
    assert {state.command_sequence for state in states} == {before}
    assert robot.transport_errors == errors + 1
    assert rig.run(1, target=0.2)[-1].command_sequence == before + 2


def test_a_servo_that_loses_its_torque_is_a_fault(rig: Rig, bus: str) -> None:
    """By a restart or by another program: named, the arm is not armed any more, arming needs homing."""
    robot = rig.armed()
    rig.run(3)
    rig.servos[1].put(TORQUE[bus], 0)
    rig.run(2)
    assert "servo 2 (elbow) lost its torque" in robot.fault and "another program" in robot.fault
    with pytest.raises(SafetyError, match="start pose"):
        robot.arm(1.0)


def test_a_servo_that_vanishes_is_named(rig: Rig) -> None:
    """After some missed samples each is asked alone; the absent one becomes the fault."""
    robot = rig.armed()
    rig.run(3)
    rig.servos[1].present = False
    rig.run(60)
    assert "servo 2 (elbow) stopped answering" in robot.fault


def test_a_cut_cable_is_no_servos_fault(rig: Rig) -> None:
    """While no servo answers none is named: what trips the run is the age of the states."""
    robot = rig.armed()
    rig.run(3)
    for servo in rig.servos:
        servo.present = False
    rig.run(60)
    assert not robot.fault
    for servo in rig.servos:
        servo.present = True
    assert rig.run(30)[-1].position.shape == (2,)


def test_an_overheated_servo_is_a_fault_with_its_remedy(rig: Rig) -> None:
    """What the servo reports is said in words."""
    robot = rig.armed()
    rig.run(3)
    rig.servos[0].fail(1 << 2)
    rig.run(2)
    assert "servo 1 (shoulder) reports: overheated (let it cool" in robot.fault


@pytest.mark.parametrize("change", [{"ticks": 900}, {"fault": "overload"}, {"torque": OFF}])
def test_one_misread_sample_is_a_miss(rig: Rig, change: dict[str, Any]) -> None:
    """A check of 8 bits passes some corrupt answers: one does not trip; the next says whether it is true."""
    robot = rig.armed()
    rig.run(5)
    sample, spoil = robot._family.sample, [2]

    def misread(servo: int, data: bytes) -> ServoSample:
        found = sample(servo, data)
        if servo == 2 and spoil[0]:
            spoil[0] -= 1
            return dataclasses.replace(found, **change)
        return found

    robot._family.sample = misread  # type: ignore[method-assign]
    spoil[0] = 1
    errors = robot.transport_errors
    states = rig.run(3)
    assert robot.transport_errors == errors + 1 and not robot.fault
    assert all(np.abs(state.position).max() < 0.1 for state in states)
    spoil[0] = 2
    states = rig.run(3)
    assert robot.fault or np.abs([state.position for state in states]).max() > 1.0


def test_passive_is_the_robots_choice_and_is_confirmed(rig: Rig, bus: str) -> None:
    """No torque, or braking: with brakes the arm sinks slowly."""
    robot = rig.armed()
    rig.run(30, target=1.2)
    assert make_passive(robot, rig.clock)
    high = rig.true_position()[0]
    rig.advance(0.2)
    assert rig.device.mode == ("idle" if bus == "dynamixel" else "braking")
    assert rig.true_position()[0] == pytest.approx(high, abs=0.2)


def test_a_silent_host_is_stopped_by_servos_that_can(rig: Rig, bus: str) -> None:
    """Dynamixel's Bus Watchdog holds the arm after 0.2 s; Feetech has none, and says so."""
    robot = rig.armed()
    rig.run(5)
    rig.advance(0.3)
    if bus == "feetech":
        assert robot.watchdog_s == 0 and rig.device.mode == "armed"
        assert "the servos' supply switch" in robot.if_cut
        return
    assert rig.device.watchdog and rig.device.mode == "stopped"
    assert "watchdog" in robot.if_cut
    robot.passive()
    robot.home(10.0)
    robot.arm(1.0)
    assert not rig.device.watchdog
    assert np.abs(rig.run(20, target=0.2)[-1].position - 0.2).max() < 0.05


def test_a_host_that_dies_before_the_first_command_is_noticed_by_servos_that_can(tmp_path: Path) -> None:
    """From the begin of homing on; who is only slow arms all the same."""
    rig = Rig(tmp_path, "dynamixel")
    robot = rig.robot
    robot.connect()
    robot.home(10.0)
    rig.advance(0.3)
    assert rig.device.mode == "stopped"
    robot.arm(1.0)
    states = rig.run(20, target=0.2)
    assert rig.device.mode == "armed" and not any(Status.WATCHDOG in state.status for state in states)
    assert np.abs(states[-1].position - 0.2).max() < 0.05


def test_who_only_reads_states_does_not_keep_the_motors_going(tmp_path: Path) -> None:
    """Our questions keep the servos' watchdogs quiet, so the driver itself ends a motion without commands."""
    rig = Rig(tmp_path, "dynamixel")
    robot = rig.armed()
    rig.run(2)
    start_ns = rig.clock.now_ns()
    while Status.ARMED in (state := robot.read_state(0.1)).status:
        assert rig.clock.now_ns() - start_ns < 300_000_000
    assert Status.WATCHDOG in state.status


def test_after_passive_no_goal_is_written(rig: Rig, bus: str) -> None:
    """It is not known of every servo that a goal does not switch its torque on."""
    robot = rig.armed()
    robot.passive()
    rig.advance(0.01)
    before = [servo.get(GOAL[bus]) for servo in rig.servos]
    robot.send_command(default_command(robot, 0.5))
    rig.advance(0.01)
    assert [servo.get(GOAL[bus]) for servo in rig.servos] == before


# Before any motion.


def test_an_adapter_that_returns_our_packets_is_said_and_costs_nothing(tmp_path: Path) -> None:
    """Such as one that joins both directions of a half-duplex line; it is no other program."""
    rig = Rig(tmp_path, "feetech")
    adapter: Any = rig.device.bus
    adapter.echo = True
    robot = rig.armed()
    assert robot.info is not None and "returns this computer's own packets" in robot.info.servos
    errors = robot.transport_errors
    assert len(rig.run(20)) >= 19
    assert not robot.fault and robot.transport_errors == errors


def test_a_missing_servo_is_named_with_those_that_answer(rig: Rig) -> None:
    """And what to check."""
    rig.servos[1].present = False
    with pytest.raises(TransportTimeoutError, match=r"servo 2 \(elbow\) does not answer; these do: 1 \("):
        rig.robot.connect()


def test_a_servo_of_another_model_is_refused(tmp_path: Path, bus: str) -> None:
    """robot.yaml names one model, the servo says another."""
    rig = Rig(tmp_path, bus)
    section = rig.file.servo_bus
    assert section is not None
    other = {"dynamixel": "xm430-w350", "feetech": "sts3250"}[bus]
    servos = tuple(dataclasses.replace(servo, model=other) for servo in section.servos)
    rig.robot._hardware = dataclasses.replace(section, servos=servos)
    with pytest.raises(WrongDeviceError, match=f"robot.yaml says {other}"):
        rig.robot.connect()


def test_a_servo_in_another_mode_is_refused(rig: Rig, bus: str) -> None:
    """Nothing is written: the mode belongs to the EEPROM, and the owner sets it."""
    rig.servos[0].put(MODE[bus], 1)
    with pytest.raises(
        ConfigurationError, match=r"shoulder: servo 1 has 1 in its register Operating Mode; set"
    ):
        rig.robot.connect()


def test_a_servos_own_limits_must_hold_the_range(rig: Rig, bus: str) -> None:
    """It would stop short of its targets without a word."""
    register = {"dynamixel": r.MIN_POSITION_LIMIT, "feetech": f.MIN_POSITION}[bus]
    rig.servos[1].put(register, 1500)
    with pytest.raises(ConfigurationError, match=r"servo 2 itself allows 1500 to 4095 ticks.*1022 to 2978"):
        rig.robot.connect()


def test_old_firmware_is_refused(tmp_path: Path) -> None:
    """Of Feetech servos; the message has the version and where to update it."""
    rig = Rig(tmp_path, "feetech")
    rig.servos[0].put(f.FIRMWARE_MINOR, 5)
    with pytest.raises(VersionMismatchError, match=r"servo 1 \(shoulder\) has firmware 3\.5; update it"):
        rig.robot.connect()


def test_coarse_speeds_of_a_feetech_are_read_in_their_unit(tmp_path: Path) -> None:
    """Bit 2 of Phase decides between 1 and 50 ticks/s."""
    rig = Rig(tmp_path, "feetech")
    rig.servos[1].put(f.PHASE, 8)
    rig.robot.connect()
    family = rig.robot._family
    data = rig.servos[1].read(f.BLOCK_ADDRESS, f.BLOCK_BYTES)
    rig.servos[1].put(f.PRESENT_SPEED, 4)
    data = rig.servos[1].read(f.BLOCK_ADDRESS, f.BLOCK_BYTES)
    assert family.sample(2, data).ticks_s == 200.0
    assert family.sample(1, data).ticks_s == 4.0


def test_a_bus_that_is_too_slow_is_refused(tmp_path: Path) -> None:
    """At 57600 baud one sample of two Dynamixel servos takes longer than half a period."""
    rig = Rig(tmp_path, "dynamixel", baud_rate=57_600)
    with pytest.raises(ConfigurationError, match=r"take 3\d\.\d ms, more than half of the 20 ms"):
        rig.robot.connect()


def test_a_dry_run_cannot_listen(tmp_path: Path, bus: str) -> None:
    """Servos only answer."""
    rig = Rig(tmp_path, bus, _listen)
    with pytest.raises(ConfigurationError, match="leave --dry-run out"):
        rig.robot.connect()


def _listen(transport: Transport) -> Transport:
    return listen_only(transport)
