"""Every robot with a driver in front of its emulator, in virtual time, and the motions shipped for it.

A run of a robot is the same loop, driver, wire and safety filter as on a real one. Only time is virtual, so
that hundreds of runs take minutes and the machine's load changes nothing.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from arm_rig import arm_file
from measure_wire_calibration import virtual_wire
from ros2_rig import ros2_file

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.record import CycleRecord
from deal_hw.drivers.b2.emulator import B2Truth
from deal_hw.drivers.b2.robot import B2OnStandRobot, B2Robot
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth as draw_cartpole
from deal_hw.drivers.cartpole.plant.profiles import PROFILES
from deal_hw.drivers.g1.emulator.device import G1Device
from deal_hw.drivers.g1.emulator.truth import G1Truth
from deal_hw.drivers.g1.robot import G1Robot
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.drivers.go2.robot import Go2OnStandRobot, Go2Robot
from deal_hw.drivers.h1.emulator import H1Device, H1Truth
from deal_hw.drivers.h1.robot import H1Robot
from deal_hw.drivers.ros2.emulator import ros2_device
from deal_hw.drivers.ros2.robot import Ros2ControlRobot
from deal_hw.drivers.servo_arm.emulator import arm_device
from deal_hw.drivers.servo_arm.families import FAMILIES
from deal_hw.drivers.servo_arm.robot import ServoArm
from deal_hw.drivers.so101.description import emulated_space
from deal_hw.drivers.so101.emulator import so101_device
from deal_hw.drivers.so101.robot import so101_arm
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.motions.excitation.behaviours import RichConfig
from deal_hw.motions.planned_end import PlannedEnd
from deal_hw.motions.posture import limited_for
from deal_hw.parameters import ParameterSpace
from deal_hw.robot import Robot
from deal_hw.robots.file_emulator import LATENCY_S, RANGE_RATIO
from deal_hw.sim.robots.file_description import file_description
from deal_hw.sim.robots.simulated import SimulatedTruth, default_space, draw_truth
from deal_hw.testing.joint_faults import FaultyJoints
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.workflows.shipped import required_policy

CARTPOLE_RATIO: Final = 5.0
SECONDS: Final = 6.0
"""Length of each motion, without standing up and lying down [s]."""
POSES: Final = "0.4,-0.4,0.5,0.3,0.5,0.5"
"""A pose that the SO-101's policy reaches [rad]."""


@dataclass(slots=True, eq=False)
class VirtualRobot:
    """One robot, ready to run.

    Attributes:
        robot: Its driver.
        clock: The clock that all share.
        wire: The virtual wire.
        device: The emulated device.
    """

    robot: Robot
    clock: VirtualClock
    wire: Any
    device: Any

    @property
    def joints(self) -> FaultyJoints:
        """Faults of its joints."""
        mechanics = getattr(self.device, "_mechanics", None)
        found: FaultyJoints = mechanics.joint_faults if mechanics else self.device._joint_faults
        return found

    @property
    def device_ns(self) -> int:
        """Time of its joints' faults [ns]."""
        mechanics = getattr(self.device, "_mechanics", None)
        return int(mechanics._now_ns if mechanics else self.device.device_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetRobot:
    """A robot, and what it does.

    Attributes:
        name: For tables: the robot and its wire.
        make: Makes it from a profile and a seed.
        motions: Name of a motion -> fields of its :class:`RunPlan`.
        profiles: The emulator's profiles.
    """

    name: str
    make: Callable[[str, int], VirtualRobot]
    motions: Mapping[str, Mapping[str, Any]]
    profiles: tuple[str, ...] = tuple(PROFILES)
    plan: Mapping[str, Any] = field(default_factory=dict)

    def run_plan(self, motion: str, seed: int) -> RunPlan:
        """Return the plan of a motion."""
        values = {"seconds": SECONDS, "seed": seed, **self.plan, **self.motions[motion]}
        return RunPlan(**values)


def run(
    one: VirtualRobot,
    plan: RunPlan,
    sink: Callable[[CycleRecord], bool] = lambda record: True,
    safety: type[Safety] = Safety,
) -> tuple[LoopReport, Safety]:
    """Run a plan, as a control process does; return how it went, and the safety module after it."""
    d = one.robot.description
    end = PlannedEnd()
    behaviour = make_behaviour(plan, d, end=end)
    made = safety(limited_for(behaviour, d))
    loop = ControlLoop(
        one.robot,
        behaviour,
        made,
        one.clock,
        sink,
        LoopConfig(duration_s=plan.longest_s, record_wire=False, home=plan.home),
        end=end,
    )
    return loop.run(), made


def cases(fleet: Mapping[str, FleetRobot], names: tuple[str, ...]) -> Iterator[tuple[FleetRobot, str, str]]:
    """Yield robot, profile and motion of each combination."""
    for name in names:
        for profile in fleet[name].profiles:
            for motion in fleet[name].motions:
                yield fleet[name], profile, motion


# The robots.

_EXCITE: Final = {
    "chirp": {"motion": "excite", "excite": "chirp"},
    "multisine": {"motion": "excite", "excite": "multisine"},
}


def _cartpole(wire: str, profile: str, seed: int) -> VirtualRobot:
    virtual = virtual_wire(wire, draw_cartpole(profile, seed, range_ratio=CARTPOLE_RATIO))
    transport = virtual._transport
    return VirtualRobot(virtual.robot(transport, virtual.clock), virtual.clock, transport, virtual.device)


def _truth(space: ParameterSpace, profile: str, seed: int) -> SimulatedTruth:
    return draw_truth(space, seed, RANGE_RATIO, 0.0 if profile == "ideal" else LATENCY_S)


def _so101(profile: str, seed: int) -> VirtualRobot:
    clock = VirtualClock(10**12)
    truth = _truth(emulated_space(), profile, seed)
    device = so101_device(truth, noisy=profile != "ideal")
    wire = VirtualTransport(device, clock)
    return VirtualRobot(so101_arm(wire, clock), clock, wire, device)


def _arm(bus: str, profile: str, seed: int) -> VirtualRobot:
    folder = Path(tempfile.mkdtemp())
    file = arm_file(folder, bus)
    assert file.servo_bus is not None
    d, clock = file_description(file, folder / "arm.xml"), VirtualClock(10**12)
    space = default_space(d)
    device = arm_device(
        file.servo_bus,
        d,
        space,
        _truth(space, profile, seed),
        noisy=profile != "ideal",
    )
    wire = VirtualTransport(device, clock)
    return VirtualRobot(ServoArm(wire, clock, d, file.servo_bus, FAMILIES[bus]()), clock, wire, device)


def _ros2(command: str, profile: str, seed: int) -> VirtualRobot:
    folder = Path(tempfile.mkdtemp())
    file = ros2_file(folder, command)
    assert file.ros2 is not None
    d, clock = file_description(file, folder / "arm.xml"), VirtualClock(10**12)
    truth = _truth(default_space(d), profile, seed)
    device = ros2_device(file.ros2, d, truth, noisy=profile != "ideal")
    wire = VirtualTopics(device, clock)
    return VirtualRobot(Ros2ControlRobot(wire, clock, d, file.ros2), clock, wire, device)


def _unitree(device: Callable[[], Any], driver: Callable[..., Robot]) -> VirtualRobot:
    clock, made = VirtualClock(10**9), device()
    wire = VirtualTopics(made, clock)
    return VirtualRobot(driver(wire, clock), clock, wire, made)


def _go2(on_stand: bool, profile: str, seed: int) -> VirtualRobot:
    truth = Go2Truth.draw(profile, seed)
    device = partial(Go2Device, truth, on_stand=on_stand, sport="")
    return _unitree(device, Go2OnStandRobot if on_stand else Go2Robot)


def _b2(on_stand: bool, profile: str, seed: int) -> VirtualRobot:
    truth = B2Truth.draw(profile, seed)
    device = partial(Go2Device, truth, on_stand=on_stand, sport="")
    return _unitree(device, B2OnStandRobot if on_stand else B2Robot)


def _g1(profile: str, seed: int) -> VirtualRobot:
    truth = G1Truth.draw(profile, seed, robot="g1")
    return _unitree(lambda: G1Device(truth), partial(G1Robot, hung_on_crane=True))


def _h1(profile: str, seed: int) -> VirtualRobot:
    truth = H1Truth.draw(profile, seed, robot="h1")
    return _unitree(lambda: H1Device(truth), partial(H1Robot, hung_on_crane=True))


def _balancing() -> dict[str, Any]:
    return {"robot": "cartpole", "policy": str(required_policy("cartpole"))}


def _walking(task: str, velocity: str, **more: Any) -> dict[str, Any]:
    return {
        "policy": str(required_policy("go2", task)),
        "velocity": velocity,
        "motion": "balance",
        "stand": True,
        **more,
    }


def fleet() -> dict[str, FleetRobot]:
    """Return every robot with a driver, by name."""
    cartpole_motions: dict[str, dict[str, Any]] = {
        "rich": {"motion": "rich"},
        "rich, level 3": {"motion": "rich", "excitation_level": 3.0},
        "chirp": {"motion": "chirp"},
        "balance": {"motion": "balance"},
        **_EXCITE,
    }
    unbalanced = RichConfig(balance_s=0.0)
    arm_motions: dict[str, dict[str, Any]] = {
        "rich": {"motion": "rich", "rich": unbalanced},
        "rich, level 3": {"motion": "rich", "rich": unbalanced, "excitation_level": 3.0},
        "chirp of one joint": {"motion": "chirp"},
        "hold": {"motion": "hold"},
        **_EXCITE,
    }
    stand: dict[str, dict[str, Any]] = {
        **_EXCITE,
        "hold": {"motion": "hold"},
        "rich": {"motion": "rich", "rich": unbalanced},
    }
    sensors = ("ideal", "sensor")
    robots = [
        *(
            FleetRobot(
                name=f"cartpole {wire}",
                make=partial(_cartpole, wire),
                motions=cartpole_motions,
                plan=_balancing(),
            )
            for wire in ("serial", "can", "odrive", "dynamixel")
        ),
        FleetRobot(
            name="so101",
            make=_so101,
            profiles=sensors,
            plan={"robot": "so101"},
            motions={
                **arm_motions,
                "reach": {"motion": "balance", "policy": str(required_policy("so101")), "target": POSES},
            },
        ),
        *(
            FleetRobot(
                name=f"arm {bus}",
                make=partial(_arm, bus),
                profiles=sensors,
                plan={"robot": "arm"},
                motions=arm_motions,
            )
            for bus in ("feetech", "dynamixel")
        ),
        *(
            FleetRobot(
                name=f"ros2 {command}",
                make=partial(_ros2, command),
                profiles=sensors,
                plan={"robot": "arm"},
                motions=arm_motions,
            )
            for command in ("position", "trajectory")
        ),
        FleetRobot(
            name="go2",
            make=partial(_go2, False),
            plan={"robot": "go2"},
            motions={
                "walk": _walking("walk", "0.6,0.2,0.4"),
                "walk back": _walking("walk", "-0.5,-0.2,-0.5"),
                "canter": _walking("canter", "1.4,0,0"),
                "climb": _walking("climb", "0.5,0,0"),
                "hold": {"motion": "hold", "stand": True},
            },
        ),
        FleetRobot(
            name="go2_on_stand", make=partial(_go2, True), plan={"robot": "go2_on_stand"}, motions=stand
        ),
        FleetRobot(
            name="b2",
            make=partial(_b2, False),
            plan={"robot": "b2"},
            motions={"hold": {"motion": "hold", "stand": True}},
        ),
        FleetRobot(name="b2_on_stand", make=partial(_b2, True), plan={"robot": "b2_on_stand"}, motions=stand),
        FleetRobot(name="g1", make=_g1, plan={"robot": "g1"}, motions=stand),
        FleetRobot(name="h1", make=_h1, plan={"robot": "h1"}, motions=stand),
    ]
    return {one.name: one for one in robots}
