"""Every robot with a driver in front of its emulator, in virtual time, and the motions shipped for it.

A run of a robot is the same loop, driver, wire and safety filter as on a real one. Only time is virtual, so
that hundreds of runs take minutes and the machine's load changes nothing.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from arm_rig import arm_file
from measure_wire_calibration import virtual_wire
from ros2_rig import ros2_file

from deal_hw.clock import Clock, VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.record import CycleRecord
from deal_hw.drivers.b2.emulator import B2Truth
from deal_hw.drivers.b2.fault_rows import B2, B2_ON_STAND
from deal_hw.drivers.b2.robot import B2OnStandRobot, B2Robot
from deal_hw.drivers.cartpole import fault_rows
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth as draw_cartpole
from deal_hw.drivers.cartpole.plant.profiles import PROFILES
from deal_hw.drivers.g1.emulator.device import G1Device
from deal_hw.drivers.g1.emulator.truth import G1Truth
from deal_hw.drivers.g1.fault_rows import G1
from deal_hw.drivers.g1.robot import G1Robot
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.drivers.go2.fault_rows import GO2, GO2_ON_STAND
from deal_hw.drivers.go2.robot import Go2OnStandRobot, Go2Robot
from deal_hw.drivers.h1.emulator import H1Device, H1Truth
from deal_hw.drivers.h1.fault_rows import H1
from deal_hw.drivers.h1.robot import H1Robot
from deal_hw.drivers.ros2 import fault_rows as ros2_rows
from deal_hw.drivers.ros2.emulator import ros2_device
from deal_hw.drivers.ros2.robot import Ros2ControlRobot
from deal_hw.drivers.servo_arm import fault_rows as arm_rows
from deal_hw.drivers.servo_arm.emulator import arm_device
from deal_hw.drivers.servo_arm.families import FAMILIES
from deal_hw.drivers.servo_arm.robot import ServoArm
from deal_hw.drivers.so101.description import emulated_space
from deal_hw.drivers.so101.emulator import so101_device
from deal_hw.drivers.so101.fault_rows import SO101
from deal_hw.drivers.so101.robot import so101_arm
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.motions.excitation.behaviours import RichConfig
from deal_hw.motions.planned_end import PlannedEnd
from deal_hw.motions.posture import PostureConfig, limited_for
from deal_hw.parameters import ParameterSpace
from deal_hw.robot import Robot
from deal_hw.robots.file_emulator import LATENCY_S, RANGE_RATIO
from deal_hw.sim.robots.file_description import file_description
from deal_hw.sim.robots.simulated import SimulatedTruth, default_space, draw_truth
from deal_hw.testing.fault_rows import FaultRig, FaultTable
from deal_hw.testing.virtual_processes import World
from deal_hw.transport import TopicTransport, Transport
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
        driver: Makes a driver of it over a wire and its clock.
        clock: The clock that all share.
        wire: The virtual wire.
        device: The emulated device.
        robot: A driver.
    """

    driver: Callable[[Any, Any], Robot]
    clock: VirtualClock
    wire: Any
    device: Any
    robot: Robot = field(init=False)

    def __post_init__(self) -> None:
        self.robot = self.driver(self.wire, self.clock)


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetRobot:
    """A robot, and what it does.

    Attributes:
        name: For tables: the robot and its wire.
        make: Makes it from a profile and a seed.
        motions: Name of a motion -> fields of its :class:`RunPlan`.
        profiles: The emulator's profiles.
        faults: Its fault table.
        fault_plan: What differs in the plan of a run with a fault.
    """

    name: str
    make: Callable[[str, int], VirtualRobot]
    motions: Mapping[str, Mapping[str, Any]]
    profiles: tuple[str, ...] = tuple(PROFILES)
    plan: Mapping[str, Any] = field(default_factory=dict)
    faults: FaultTable
    fault_plan: Mapping[str, Any] = field(default_factory=dict)

    def run_plan(self, motion: str, seed: int) -> RunPlan:
        """Return the plan of a motion."""
        values = {"seconds": SECONDS, "seed": seed, **self.plan, **self.motions[motion]}
        return RunPlan(**values)

    def fault_rig(self, seed: int = 0) -> FaultRig:
        """Return the robot, just switched on, for a run with a fault."""
        made = self.make("ideal", seed)
        plan = RunPlan(**{"seconds": 4.0, "seed": seed, **self.plan, **self.fault_plan})
        d = made.robot.description
        return FaultRig(
            table=self.faults,
            description=d,
            world=World(made.clock, made.wire),
            topics=isinstance(made.wire, VirtualTopics),
            make_robot=made.driver,
            make_behaviour=lambda end: make_behaviour(plan, d, end=end),
            make_next=lambda end: make_behaviour(replace(plan, motion="hold"), d, end=end),
            seconds=plan.longest_s,
        )


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

CARTPOLES: Final = {
    "serial": fault_rows.SERIAL,
    "can": fault_rows.CAN,
    "odrive": fault_rows.ODRIVE,
    "dynamixel": fault_rows.DYNAMIXEL,
}
ARMS: Final = {"feetech": arm_rows.FEETECH, "dynamixel": arm_rows.DYNAMIXEL}
CONTROLLERS: Final = {"position": ros2_rows.POSITION, "trajectory": ros2_rows.TRAJECTORY}
"""Fault tables by wire, by bus and by kind of controller."""
UP_S: Final = 600
"""How long a robot with a clock of its own has been on [s]."""
_SHORT: Final = PostureConfig(fold_s=0.6, rise_s=1.0, settle_s=0.2, lie_s=1.0)
"""Standing up and lying down in less time than usual."""

_EXCITE: Final = {
    "chirp": {"motion": "excite", "excite": "chirp"},
    "multisine": {"motion": "excite", "excite": "multisine"},
}


def _cartpole(wire: str, profile: str, seed: int) -> VirtualRobot:
    virtual = virtual_wire(wire, draw_cartpole(profile, seed, range_ratio=CARTPOLE_RATIO))
    if wire != "dynamixel":
        # It was switched on a while ago.
        device: Any = virtual.device
        device.firmware.clock_us = UP_S * 1_000_000
    return VirtualRobot(virtual.robot, virtual.clock, virtual._transport, virtual.device)


def _truth(space: ParameterSpace, profile: str, seed: int) -> SimulatedTruth:
    return draw_truth(space, seed, RANGE_RATIO, 0.0 if profile == "ideal" else LATENCY_S)


def _so101(profile: str, seed: int) -> VirtualRobot:
    clock = VirtualClock(10**12)
    truth = _truth(emulated_space(), profile, seed)
    device = so101_device(truth, noisy=profile != "ideal")
    return VirtualRobot(so101_arm, clock, VirtualTransport(device, clock), device)


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
    wire, section = VirtualTransport(device, clock), file.servo_bus

    def driver(wire: Transport, clock: Clock) -> ServoArm:
        return ServoArm(wire, clock, d, section, FAMILIES[bus]())

    return VirtualRobot(driver, clock, wire, device)


def _ros2(command: str, profile: str, seed: int) -> VirtualRobot:
    folder = Path(tempfile.mkdtemp())
    file = ros2_file(folder, command)
    assert file.ros2 is not None
    d, clock = file_description(file, folder / "arm.xml"), VirtualClock(10**12)
    truth = _truth(default_space(d), profile, seed)
    device = ros2_device(file.ros2, d, truth, noisy=profile != "ideal")
    wire, section = VirtualTopics(device, clock), file.ros2

    def driver(wire: TopicTransport, clock: Clock) -> Ros2ControlRobot:
        return Ros2ControlRobot(wire, clock, d, section)

    return VirtualRobot(driver, clock, wire, device)


def _unitree(device: Callable[[], Any], driver: Callable[..., Robot]) -> VirtualRobot:
    clock, made = VirtualClock(10**9), device()
    return VirtualRobot(driver, clock, VirtualTopics(made, clock), made)


def _go2(on_stand: bool, profile: str, seed: int) -> VirtualRobot:
    truth = Go2Truth.draw(profile, seed)
    device = partial(Go2Device, truth, on_stand=on_stand, sport="", tick_ms=1000 * UP_S)
    return _unitree(device, Go2OnStandRobot if on_stand else Go2Robot)


def _b2(on_stand: bool, profile: str, seed: int) -> VirtualRobot:
    truth = B2Truth.draw(profile, seed)
    device = partial(Go2Device, truth, on_stand=on_stand, sport="", tick_ms=1000 * UP_S)
    return _unitree(device, B2OnStandRobot if on_stand else B2Robot)


def _g1(profile: str, seed: int) -> VirtualRobot:
    truth = G1Truth.draw(profile, seed, robot="g1")
    return _unitree(
        lambda: G1Device(truth, controller="", tick_ms=1000 * UP_S), partial(G1Robot, hung_on_crane=True)
    )


def _h1(profile: str, seed: int) -> VirtualRobot:
    truth = H1Truth.draw(profile, seed, robot="h1")
    return _unitree(
        lambda: H1Device(truth, controller="", tick_ms=1000 * UP_S), partial(H1Robot, hung_on_crane=True)
    )


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
                faults=table,
                fault_plan=_EXCITE["multisine"],
            )
            for wire, table in CARTPOLES.items()
        ),
        FleetRobot(
            name="so101",
            make=_so101,
            profiles=sensors,
            plan={"robot": "so101"},
            faults=SO101,
            fault_plan=_EXCITE["multisine"],
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
                faults=table,
                fault_plan=_EXCITE["multisine"],
            )
            for bus, table in ARMS.items()
        ),
        *(
            FleetRobot(
                name=f"ros2 {command}",
                make=partial(_ros2, command),
                profiles=sensors,
                plan={"robot": "arm"},
                motions=arm_motions,
                faults=table,
                fault_plan=_EXCITE["multisine"],
            )
            for command, table in CONTROLLERS.items()
        ),
        FleetRobot(
            name="go2",
            make=partial(_go2, False),
            plan={"robot": "go2"},
            faults=GO2,
            fault_plan={**_walking("walk", "0.6,0.2,0.4"), "posture": _SHORT, "seconds": 3.5},
            motions={
                "walk": _walking("walk", "0.6,0.2,0.4"),
                "walk back": _walking("walk", "-0.5,-0.2,-0.5"),
                "canter": _walking("canter", "1.4,0,0"),
                "climb": _walking("climb", "0.5,0,0"),
                "hold": {"motion": "hold", "stand": True},
            },
        ),
        FleetRobot(
            name="go2_on_stand",
            make=partial(_go2, True),
            plan={"robot": "go2_on_stand"},
            motions=stand,
            faults=GO2_ON_STAND,
            fault_plan=_EXCITE["multisine"],
        ),
        FleetRobot(
            name="b2",
            make=partial(_b2, False),
            plan={"robot": "b2"},
            motions={"hold": {"motion": "hold", "stand": True}},
            faults=B2,
            fault_plan={"motion": "hold", "stand": True, "posture": _SHORT, "seconds": 1.0},
        ),
        FleetRobot(
            name="b2_on_stand",
            make=partial(_b2, True),
            plan={"robot": "b2_on_stand"},
            motions=stand,
            faults=B2_ON_STAND,
            fault_plan=_EXCITE["multisine"],
        ),
        *(
            FleetRobot(
                name=name,
                make=make,
                plan={"robot": name},
                motions=stand,
                faults=table,
                fault_plan={**_EXCITE["multisine"], "seconds": SECONDS},
            )
            for name, make, table in (("g1", _g1, G1), ("h1", _h1, H1))
        ),
    ]
    return {one.name: one for one in robots}
