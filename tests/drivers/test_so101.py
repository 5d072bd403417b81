"""The SO-101: the robot contract, and the calibration that its servos keep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.servo_arm.calibrated import CalibratedArm
from deal_hw.drivers.servo_bus.feetech import registers as f
from deal_hw.drivers.so101.description import DRIVEN, JOINTS, emulated_space
from deal_hw.drivers.so101.emulator import homed, so101_device
from deal_hw.drivers.so101.robot import HARDWARE, RANGES, so101_arm
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import ConfigurationError, WrongDeviceError
from deal_hw.motions.behaviours import position_command
from deal_hw.sim.robots.hardware_section import RAD
from deal_hw.sim.robots.simulated import SimulatedTruth
from deal_hw.testing.faults import FaultyTransport, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, arm, run_cycles
from deal_hw.transport import Transport
from deal_hw.types import RobotState


class Arm:
    """An emulated SO-101 with its driver, in virtual time.

    Args:
        bias: Encoder biases by joint [rad].
        wrap: Puts something between driver and wire.
    """

    def __init__(self, wrap: Callable[[Transport], Transport] = lambda wire: wire, **bias: float) -> None:
        space = emulated_space()
        values = {p.name: p.nominal for p in space.parameters}
        values |= {f"{joint}.encoder_bias": value for joint, value in bias.items()}
        self.clock = VirtualClock()
        self.device = so101_device(SimulatedTruth(parameters=values, latency_s=0.0, seed=0), noisy=False)
        self.virtual = VirtualTransport(self.device, self.clock)
        self.robot: CalibratedArm = so101_arm(wrap(self.virtual), self.clock)

    def write(self, joint: str, low: int, high: int) -> None:
        """Set the limits that lerobot-calibrate writes [ticks]."""
        servo = self.device.bus.servos[JOINTS.index(joint)]
        servo.keep(f.MIN_POSITION, low)
        servo.keep(f.MAX_POSITION, high)

    def hold(self, pose: list[float], cycles: int = 100) -> RobotState:
        """Home, arm, command one pose for some cycles; return the last state."""
        arm(self.robot)
        return run_cycles(self.robot, self.clock, cycles, position_command(DRIVEN, np.array(pose)))[-1]


class TestSo101(RobotSuite):
    """The contract of a robot."""

    @pytest.fixture
    def bench(self) -> RobotBench:
        fault = OneBadFrame(20)
        arm = Arm(lambda wire: FaultyTransport(wire, received=fault))
        foreign, newer, silent = Arm(), Arm(), Arm()
        foreign.device.bus.servos[0].put(f.MODEL_NUMBER, 350)
        newer.device.bus.servos[1].put(f.FIRMWARE_MINOR, 8)
        for servo in silent.device.bus.servos:
            servo.present = False
        return RobotBench(
            robot=arm.robot,
            foreign=foreign.robot,
            newer=newer.robot,
            silent=silent.robot,
            unplug=arm.virtual.unplug,
            corrupt=fault.corrupt_next,
        )


def test_zeros_are_the_middles_of_the_calibrated_travels() -> None:
    """A published calibration (shoulder_pan 746 to 3477, elbow_flex 901 to 3110), by hand."""
    arm = Arm()
    arm.write("shoulder_pan", 746, 3477)
    arm.write("elbow_flex", 901, 3110)
    arm.robot.connect()
    zeros = {servo.joint: servo.zero for servo in arm.robot._servos}
    # (746 + 3477) / 2 = 2111.5, rounded to even; (901 + 3110) / 2 = 2005.5.
    assert (zeros["shoulder_pan"], zeros["elbow_flex"]) == (2112, 2006)
    # The gripper's range is -0.1745 to 2.1633 rad, so its middle is 648 ticks above its zero.
    assert zeros["gripper"] == 2047 - 648
    assert zeros["wrist_roll"] == 2048


def test_a_middle_that_was_not_found_exactly_is_an_encoder_bias() -> None:
    """Positions are reported with the bias: the arm stands 0.04 rad beside what it reports."""
    arm = Arm(wrist_roll=0.04)
    state = arm.hold([0.0, -0.5, 0.5, 0.0, 0.3, 0.2])
    roll = JOINTS.index("wrist_roll")
    assert state.position[roll] == pytest.approx(0.3, abs=0.01)
    assert arm.device.true_position[roll] == pytest.approx(state.position[roll] - 0.04, abs=2 * RAD)


def test_goals_stay_within_the_servos_limits() -> None:
    """A travel narrower than the model's: the goal is clipped, and the command that was sent says so."""
    arm = Arm()
    servo = homed().servos[JOINTS.index("elbow_flex")]
    arm.write("elbow_flex", servo.ticks(-1.5), servo.ticks(1.5))
    arm.hold([0.0] * 6, cycles=5)
    target = np.array([0.0, 0.0, 1.64, 0.0, 0.0, 0.0])
    sent = arm.robot.send_command(position_command(DRIVEN, target))
    assert sent.position_target[JOINTS.index("elbow_flex")] == pytest.approx(1.5, abs=RAD)
    assert arm.robot.transport_errors == 0


@pytest.mark.parametrize("limits", [(0, 4095), (0, 0), (3000, 1000)])
def test_an_arm_that_was_never_calibrated_is_refused(limits: tuple[int, int]) -> None:
    """Limits as from the factory are no travel; only wrist_roll has a whole turn."""
    arm = Arm()
    arm.write("shoulder_lift", *limits)
    with pytest.raises(ConfigurationError, match=r"shoulder_lift.*never calibrated.*lerobot-calibrate"):
        arm.robot.connect()
    assert not any(servo.get(f.TORQUE_ENABLE) for servo in arm.device.bus.servos)


def test_another_joints_travel_is_refused_with_all_that_is_wrong() -> None:
    """Two joints that were hardly swept: both are named in one message."""
    arm = Arm()
    arm.write("shoulder_lift", 2000, 2400)
    arm.write("gripper", 1000, 1200)
    with pytest.raises(ConfigurationError, match=r"shoulder_lift.*in common.*gripper.*lerobot-calibrate"):
        arm.robot.connect()


def test_ids_in_another_order_are_found_by_their_models() -> None:
    """A bus with another servo at id 3 names joint, id and what an SO-101 has there."""
    arm = Arm()
    arm.device.bus.servos[2].put(f.MODEL_NUMBER, f.STS3250)
    with pytest.raises(WrongDeviceError, match=r"servo 3 .elbow_flex. is a sts3250, the SO-101 of LeRobot"):
        arm.robot.connect()


def test_it_lies_down_before_it_goes_limp() -> None:
    """At a planned end the arm folds itself, within the ranges of its joints."""
    arm = Arm()
    arm.hold([0.3, 0.2, -0.3, 0.1, 0.2, 0.5], cycles=20)
    assert arm.robot.lowers
    arm.robot.lower(20.0)
    rest = np.array([servo.rest for servo in HARDWARE.servos])
    np.testing.assert_allclose(arm.device.true_position, rest, atol=0.2)
    for servo in HARDWARE.servos:
        assert servo.rest is not None
        low, high = RANGES[servo.joint]
        assert low <= servo.rest <= high
