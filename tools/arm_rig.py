"""Emulated arms of servos for tests: two joints, on either bus, in virtual time; two arms of seven joints."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.clock import VirtualClock
from deal_hw.drivers.servo_arm.device import ArmDevice
from deal_hw.drivers.servo_arm.emulator import arm_device
from deal_hw.drivers.servo_arm.families import FAMILIES
from deal_hw.drivers.servo_arm.faults import ArmFaults
from deal_hw.drivers.servo_arm.robot import ServoArm
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import TransportTimeoutError
from deal_hw.sim.robots.file_description import file_description
from deal_hw.sim.robots.hardware_section import HardwareSection, ServoEntry
from deal_hw.sim.robots.robot_file import RobotFile, write_robot_file
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.sim.robots.simulated import SimulatedTruth, default_space
from deal_hw.sim.robots.user_robot import derive_robot
from deal_hw.testing.robot_suite import arm, default_command, run_cycles
from deal_hw.transport import Transport
from deal_hw.types import RobotState

MJCF = """
<mujoco model="two_joints">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <joint axis="0 1 0" range="-1.5 1.5" damping="0.6" armature="0.028" frictionloss="0.05"/>
    <position kp="17.8" kv="0" forcerange="-2.94 2.94" ctrlrange="-1.5 1.5"/>
    <geom type="capsule" size="0.012" mass="0.1" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder"/>
      <geom fromto="0 0 0 0 0 0.12"/>
      <body name="fore" pos="0 0 0.12">
        <joint name="elbow"/>
        <geom fromto="0 0 0 0 0 0.12"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="shoulder" joint="shoulder"/><position name="elbow" joint="elbow"/></actuator>
</mujoco>
"""
BUSES = ("dynamixel", "feetech")
SEVEN = {
    "shoulder_pan": "0 0 1",
    "shoulder_lift": "0 1 0",
    "upper_arm_roll": "1 0 0",
    "elbow": "0 1 0",
    "forearm_roll": "1 0 0",
    "wrist_flex": "0 1 0",
    "wrist_roll": "1 0 0",
}
"""Joints of an arm of seven, and their axes."""
LINK_M, LINK_KG = 0.05, 0.06
_P_GAIN = {"dynamixel": 400, "feetech": 32}
_PASSIVE: dict[str, Any] = {"dynamixel": "off", "feetech": "damping"}


def arm_file(folder: Path, bus: str, **section: Any) -> RobotFile:
    """Write an arm's MJCF and robot.yaml into a folder, and return the latter's content.

    The shoulder's servo is mounted the other way round.
    """
    mjcf = folder / "arm.xml"
    mjcf.write_text(MJCF, encoding="utf-8")
    own = derive_robot(mjcf, name="two joints", control_rate_hz=50.0).file
    servos = (
        ServoEntry(joint="shoulder", id=1, zero=2048, direction=-1, p_gain=_P_GAIN[bus]),
        ServoEntry(joint="elbow", id=2, zero=2000, p_gain=_P_GAIN[bus]),
    )
    values = {"bus": bus, "servos": servos, "passive": _PASSIVE[bus], **section}
    return write_driven(folder, own, HardwareSection(**values))


def two_arms_file(folder: Path, bus: str) -> RobotFile:
    """Write MJCF and robot.yaml of a robot with two arms of seven joints on one bus; return the latter."""
    joints = MJCF.partition("<worldbody>")[0]
    arms = _arm("left", 0.15) + _arm("right", -0.15)
    names = [f"{side}_{name}" for side in ("left", "right") for name in SEVEN]
    motors = "".join(f'<position name="{name}" joint="{name}"/>' for name in names)
    mjcf = folder / "arms.xml"
    mjcf.write_text(
        f"{joints}<worldbody>{arms}</worldbody><actuator>{motors}</actuator></mujoco>", encoding="utf-8"
    )
    own = derive_robot(mjcf, name="two arms", control_rate_hz=50.0, several_trees=True).file
    section = HardwareSection(
        bus=bus,  # type: ignore[arg-type]
        # 14 Dynamixel servos need the faster rate for 50 states a second.
        baud_rate=2_000_000 if bus == "dynamixel" else 1_000_000,
        passive=_PASSIVE[bus],
        servos=tuple(
            ServoEntry(
                joint=name, id=number, zero=2048, direction=-1 if number % 2 else 1, p_gain=_P_GAIN[bus]
            )
            for number, name in enumerate(names, 1)
        ),
    )
    return write_driven(folder, own, section)


def write_driven(
    folder: Path, own: RobotFile, hardware: HardwareSection | Ros2Section, **more: Any
) -> RobotFile:
    """Write the robot.yaml of a robot that is driven, whose joints are limited; return its content.

    Args:
        folder: Where the file is written, beside the MJCF.
        own: What the MJCF says.
        hardware: What drives the joints.
        more: Further fields of the file.
    """
    joints = tuple(dataclasses.replace(joint, velocity_limit=6.0) for joint in own.joints)
    file = dataclasses.replace(own, joints=joints, hardware=hardware, **more)
    (folder / "robot.yaml").write_text(write_robot_file(file), encoding="utf-8")
    return file


def _arm(side: str, y: float) -> str:
    """Return the bodies of an arm, each link at the end of the one before."""
    links = "".join(
        f'<body name="{side}_{name}_link" pos="{LINK_M} 0 0"><joint name="{side}_{name}" axis="{axis}"/>'
        f'<geom fromto="0 0 0 {LINK_M} 0 0" mass="{LINK_KG}"/>'
        for name, axis in SEVEN.items()
    )
    return f'<body name="{side}" pos="0 {y} 0.3">{links}{"</body>" * len(SEVEN)}</body>'


class Rig:
    """An emulated arm, its driver, and the wire between them, in virtual time."""

    def __init__(
        self,
        folder: Path,
        bus: str,
        wrap: Callable[[Transport], Transport] = lambda transport: transport,
        device_file: RobotFile | None = None,
        faults: ArmFaults | None = None,
        **section: Any,
    ) -> None:
        self.file = arm_file(folder, bus, **section)
        self.description = file_description(self.file, folder / "arm.xml")
        assert self.file.servo_bus is not None
        self.clock = VirtualClock()
        self.phases: list[str] = []
        self.loop: Any = None
        space = default_space(self.description)
        values = {**space.known, **{p.name: p.nominal for p in space.parameters}}
        truth = SimulatedTruth(parameters=values, latency_s=0.0, seed=0)
        hardware = (device_file or self.file).servo_bus
        assert hardware is not None
        self.device: ArmDevice = arm_device(
            hardware, self.description, space, truth, faults=faults, noisy=False
        )
        self.virtual = VirtualTransport(self.device, self.clock)
        self.robot = ServoArm(
            wrap(self.virtual), self.clock, self.description, self.file.servo_bus, FAMILIES[bus]()
        )

    @property
    def servos(self) -> list[Any]:
        """The emulated servos, in the order of the joints."""
        return list(self.device.bus.servos)

    def armed(self) -> ServoArm:
        """Return the driver, connected, homed and armed, after its first command."""
        arm(self.robot)
        return self.robot

    def run(self, cycles: int, target: float = 0.0) -> list[RobotState]:
        """Command and read as the control loop does; return the states."""
        return run_cycles(self.robot, self.clock, cycles, default_command(self.robot, target))

    def advance(self, seconds: float) -> None:
        """Let device time pass without the driver."""
        self.clock.advance_ns(round(seconds * 1e9))
        try:
            while True:
                self.virtual.receive(0.0)
        except TransportTimeoutError:
            return

    def true_position(self) -> np.ndarray[Any, Any]:
        """True positions of the joints [rad]."""
        return self.device.true_position
