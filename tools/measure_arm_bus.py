#!/usr/bin/env python3
"""Round trips and cycles of an arm of servos at 50 Hz: 6 and 14 joints on either bus.

    python tools/measure_arm_bus.py --seconds 40

A round trip is the time from writing the request to the last byte of all servos' answers: the registers that
the driver reads with every state. A cycle ends when the goals of all servos are written behind it. The time
of these bytes on the wire is shown beside them. Emulated servos answer over a pseudo-terminal, and take the
wire's time, too; their torque stays off.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import tyro
from measuring import Rows, spread

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.realtime import become_realtime
from deal_hw.drivers.servo_arm.families import FAMILIES
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import FrameError, TransportTimeoutError
from deal_hw.sim.robots.hardware_section import HardwareSection, ServoEntry
from deal_hw.sim.robots.robot_file import write_robot_file
from deal_hw.sim.robots.user_robot import derive_robot
from deal_hw.workflows.emulation.process import EmulatorProcess

RATE_HZ = 50.0
ANSWER_S = 0.008
"""As `answer_ms` in robot.yaml by default [s]."""
MIDDLE = 2048


class Arm(NamedTuple):
    """A row: bus, number of joints, baud rate."""

    bus: Literal["feetech", "dynamixel"]
    joints: int
    baud_rate: int


ARMS = (
    Arm("feetech", 6, 1_000_000),
    Arm("feetech", 14, 1_000_000),
    Arm("dynamixel", 6, 1_000_000),
    Arm("dynamixel", 14, 1_000_000),
    Arm("dynamixel", 14, 2_000_000),
)
"""Feetech servos have no higher rate. The driver refuses 14 Dynamixel servos at 1 Mbit/s and 50 states a
second: they take more than half of a period."""


@dataclass(frozen=True, kw_only=True)
class MeasureArmBus:
    """Measure round trips and cycles of arms of servos."""

    seconds: float = 40.0
    """Length of each row [s]."""

    out: Path | None = None
    """Write the rows to this JSON file."""


def chain(joints: int) -> str:
    """Return the MJCF of a chain of equal links without weight: it stands without torque."""
    link = '<body name="link{0}" pos="0 0 0.05"><joint name="joint{0}"/><geom fromto="0 0 0 0 0 0.05"/>'
    bodies = "".join(link.format(k) for k in range(joints)) + "</body>" * joints
    motors = "".join(f'<position name="joint{k}" joint="joint{k}"/>' for k in range(joints))
    return f"""
<mujoco model="chain">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <default>
    <joint axis="0 1 0" range="-1.5 1.5" damping="0.6" armature="0.028"/>
    <position kp="17.8" forcerange="-2.94 2.94" ctrlrange="-1.5 1.5"/>
    <geom type="capsule" size="0.012" mass="0.05" contype="0" conaffinity="0"/>
  </default>
  <worldbody>{bodies}</worldbody>
  <actuator>{motors}</actuator>
</mujoco>
"""


def write_arm(folder: Path, arm: Arm) -> Path:
    """Write an arm's MJCF and robot.yaml into a folder, and return the latter."""
    mjcf, path = folder / "arm.xml", folder / "robot.yaml"
    mjcf.write_text(chain(arm.joints), encoding="utf-8")
    own = derive_robot(mjcf, name="chain", control_rate_hz=RATE_HZ).file
    servos = tuple(
        ServoEntry(joint=joint.name, id=k, zero=MIDDLE, p_gain=32) for k, joint in enumerate(own.joints, 1)
    )
    section = HardwareSection(bus=arm.bus, baud_rate=arm.baud_rate, servos=servos)
    limited = tuple(dataclasses.replace(joint, velocity_limit=6.0) for joint in own.joints)
    file = dataclasses.replace(own, joints=limited, hardware=section)
    path.write_text(write_robot_file(file), encoding="utf-8")
    return path


@contextmanager
def emulated(arm: Arm) -> Iterator[str]:
    """Yield the port of an emulated arm."""
    with tempfile.TemporaryDirectory() as folder:
        robot = write_arm(Path(folder), arm)
        with EmulatorProcess(str(robot), "--nominal", "--profile", "sensor") as emulator:
            yield emulator.port


def measure(port: str, arm: Arm, seconds: float) -> dict[str, Any]:
    """Return one row: round trips and cycles [ms]."""
    clock, family = MonotonicClock(), FAMILIES[arm.bus]()
    servos = tuple(range(1, arm.joints + 1))
    goals = family.goals(dict.fromkeys(servos, MIDDLE))
    trips, cycles, missed, count = [], [], 0, round(RATE_HZ * seconds)
    with SerialTransport(port, arm.baud_rate) as transport:
        bus = family.bus(transport, clock, arm.baud_rate, ANSWER_S)
        due_ns = clock.now_ns()
        for _ in range(count):
            due_ns += round(1e9 / RATE_HZ)
            clock.sleep_until_ns(due_ns)
            asked_ns = bus.ask(servos, *family.block)
            try:
                while bus.take(asked_ns + 10**9) is None:
                    continue
            except (TransportTimeoutError, FrameError):
                missed += 1
                continue
            trips.append((clock.now_ns() - asked_ns) / 1e6)
            bus.post(goals)
            cycles.append((clock.now_ns() - asked_ns) / 1e6)
        wire_ms = 1e3 * family.cycle_s(bus, arm.joints, arm.baud_rate)
    return {
        **arm._asdict(),
        "rate_hz": RATE_HZ,
        "cycles": count,
        "missed": missed,
        **spread(trips, "_round_trip_ms"),
        **spread(cycles, "_cycle_ms"),
        "wire_ms": round(wire_ms, 3),
    }


def main(config: MeasureArmBus) -> None:
    """Measure and print each row as it comes."""
    rows = Rows(__file__, config.out)
    become_realtime()
    for arm in ARMS:
        with emulated(arm) as port:
            rows.add(measure(port, arm, config.seconds))


if __name__ == "__main__":
    main(tyro.cli(MeasureArmBus, description=__doc__))
