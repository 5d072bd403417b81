"""A user's robot: its robot.yaml, its MJCF, and the description from both."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, shown
from deal_hw.reading import reading
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.mjcf.describe import WINDOW_TICKS, Sampling, describe, sampling
from deal_hw.sim.mjcf.joint_facts import joint_facts
from deal_hw.sim.parameters.fields import element_names
from deal_hw.sim.robots.file_description import file_description, free_of, limits_of, sensor_of
from deal_hw.sim.robots.robot_file import ActuatorEntry, JointEntry, RobotFile, read_robot_file

_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)


@dataclass(frozen=True, slots=True, kw_only=True)
class UserRobot:
    """A consistent pair of robot.yaml and MJCF.

    Attributes:
        file: The content of robot.yaml.
        mjcf: The MJCF.
        model: The compiled MJCF; treat as read-only.
    """

    file: RobotFile
    mjcf: Path
    model: Any

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints, in the order of every array, (J,)."""
        return tuple(joint.name for joint in self.file.joints)

    @property
    def rates(self) -> Sampling:
        """The robot's own rates on the physics grid of its MJCF."""
        samples = round(self.file.state_rate_hz / self.file.control_rate_hz)
        period_s, step_s = 1.0 / self.file.state_rate_hz, float(self.model.opt.timestep)
        found = sampling(period_s, step_s, samples * period_s * WINDOW_TICKS)
        return dataclasses.replace(found, samples_per_tick=samples)

    def description(self, rates: Sampling | None = None) -> RobotDescription:
        """Return the robot's description.

        Args:
            rates: Rates of recordings, if they differ from the robot's own.
        """
        if self.file.hardware is not None and rates is None:
            # As the driver has it, so that recordings and simulation have one description.
            return file_description(self.file, self.mjcf)
        rates = rates or self.rates
        joints = self.file.joints
        driven = [(joint, joint.actuator) for joint in joints if joint.actuator is not None]
        control_hz = 1.0 / (rates.period_s * rates.samples_per_tick)
        base = describe(self.mjcf, self.model, self.joint_names, [joint.name for joint, _ in driven], rates)
        return dataclasses.replace(
            base,
            name=self.file.name,
            default_position=tuple(joint.default_position for joint in joints),
            effort_limit=tuple(free_of(actuator.effort_limit) for _, actuator in driven),
            limits=limits_of(self.file, control_hz),
            sensor=sensor_of(self.file),
            feet=self.file.feet,
            sources={name: "robot.yaml" for name in ("limits", "sensor", "default_position", "effort_limit")}
            | {name: "the MJCF" for name in ("joint_names", "stiffness", "damping")},
        )


def read_robot(path: Path) -> UserRobot:
    """Read a robot.yaml and its MJCF.

    Raises:
        ConfigurationError: One cannot be read, or they contradict each other; the message says what to write.
    """
    file = read_robot_file(path)
    mjcf = Path(path).parent / file.mjcf
    if not mjcf.is_file():
        raise ConfigurationError(
            f"{path}: its model {file.mjcf} does not exist ({mjcf}); write its path at `mjcf`, relative to "
            "robot.yaml"
        )
    robot = UserRobot(file=file, mjcf=mjcf, model=compile_mjcf(mjcf))
    found = list(contradictions(robot))
    if found:
        raise ConfigurationError(f"{path} contradicts {mjcf.name}: {'; '.join(found)}")
    return robot


def derive_robot(
    mjcf: Path,
    *,
    name: str = "",
    control_rate_hz: float,
    state_rate_hz: float | None = None,
    feet: Sequence[str] = (),
    several_trees: bool = False,
    mjcf_entry: str = "",
    recorded: Collection[str] = (),
) -> UserRobot:
    """Return the robot that an MJCF describes.

    Args:
        mjcf: The model.
        name: The robot's name; "" for that of the file.
        control_rate_hz: Commands per second, which no MJCF has.
        state_rate_hz: States per second; None for ``control_rate_hz``.
        feet: Sphere geoms of the feet.
        several_trees: Whether driven joints in several trees are one robot, such as two arms.
        mjcf_entry: The model's path in robot.yaml; "" for its name alone.
        recorded: Joints that are read although an equality of the model moves them with others; the robot
            has these, too.

    Raises:
        ConfigurationError: It does not compile, has no known actuator, or has two robots.
    """
    mjcf = Path(mjcf)
    model = compile_mjcf(mjcf)
    if not several_trees:
        _check_one_tree(mjcf, model)
    facts = joint_facts(mjcf, model)
    read = [name for name in facts.names if name not in facts.followers or name in recorded]
    driven = [joint for joint, on in zip(facts.names, facts.servo | facts.motor, strict=True) if on]
    period_s = 1.0 / (state_rate_hz or control_rate_hz)
    rates = sampling(period_s, float(model.opt.timestep), period_s * WINDOW_TICKS)
    base = describe(mjcf, model, read, driven, rates)
    joints = []
    for position, joint in zip(base.default_position, read, strict=True):
        j = facts.names.index(joint)
        low, high = facts.limits[j]
        actuator = None
        if joint in driven:
            a = driven.index(joint)
            actuator = ActuatorEntry(
                # The sum with 0 makes -0.0 a 0.
                stiffness=base.stiffness[a] + 0.0,
                damping=base.damping[a] + 0.0,
                effort_limit=_finite(base.effort_limit[a]),
            )
            if facts.servo[j]:
                low, high = max(low, facts.command[j, 0]), min(high, facts.command[j, 1])
        ranged = math.isfinite(low) and math.isfinite(high)
        with reading(f"model {mjcf}, joint {joint}", "a joint of a robot", error=ConfigurationError):
            entry = JointEntry(
                name=joint,
                unit="m" if facts.units[j] == "m" else "rad",
                default_position=float(np.clip(position, low, high)),
                position_range=(float(low), float(high)) if ranged else None,
                actuator=actuator,
            )
        joints.append(entry)
    file = RobotFile(
        version=1,
        name=name or mjcf.stem,
        mjcf=mjcf_entry or mjcf.name,
        actuation="motor" if base.actuation == "motor" else "position",
        floating_base=base.floating_base,
        feet=tuple(feet),
        control_rate_hz=control_rate_hz,
        state_rate_hz=state_rate_hz or control_rate_hz,
        physics_step=float(model.opt.timestep),
        joints=tuple(joints),
    )
    robot = UserRobot(file=file, mjcf=mjcf, model=model)
    if found := list(contradictions(robot)):
        raise ConfigurationError(f"{mjcf}: {'; '.join(found)}")
    return robot


def contradictions(robot: UserRobot) -> Iterator[str]:
    """Yield the contradictions of robot.yaml and its MJCF, each with what to write instead."""
    file, model = robot.file, robot.model
    facts = joint_facts(robot.mjcf, model)
    strange = [name for name in robot.joint_names if name not in facts.names]
    needed = [name for name in facts.names if name not in facts.followers]
    absent = [name for name in needed if name not in robot.joint_names]
    if strange or absent:
        if strange:
            yield f"the MJCF has no joint {', '.join(strange)}; its joints are {', '.join(facts.names)}"
        if absent:
            yield (
                f"the MJCF's joints {', '.join(absent)} are not among `joints`; add them, or if they belong "
                "to another robot, name an MJCF with one robot"
            )
        return
    driven = [joint.name for joint in file.joints if joint.actuator is not None]
    moved = [name for name, on in zip(facts.names, facts.servo | facts.motor, strict=True) if on]
    for name in sorted({*driven, *moved}):
        if name not in moved:
            yield f"no actuator of the MJCF drives {name}; write `actuator: null`, or add one to the MJCF"
        elif name not in driven:
            yield f"an actuator of the MJCF drives {name}; write its `actuator`, or remove it from the MJCF"
    if sorted(driven) != sorted(moved):
        return
    base = describe(robot.mjcf, model, robot.joint_names, driven, robot.rates)
    for what, given, own in (
        ("actuation", file.actuation, base.actuation),
        ("floating_base", file.floating_base, base.floating_base),
    ):
        if given != own:
            yield f"{what} is {shown(given)}; write {'null' if own is None else own}, as the MJCF has it"
    if file.hardware is not None and base.motors:
        yield (
            f"{', '.join(base.motors)} take efforts in the MJCF, and `hardware` commands positions; give "
            "them a <position> each"
        )
    yield from _of_joints(robot, base, facts.limits[[facts.names.index(n) for n in robot.joint_names]])
    geoms = element_names(model, "geom")
    spheres = [name for i, name in enumerate(geoms) if name and model.geom_type[i] == _SPHERE]
    for foot in file.feet:
        if foot not in spheres:
            known = ", ".join(spheres) or "none has a name"
            yield f"foot {foot!r} is no sphere geom of the MJCF; its spheres: {known}"
    step_s = float(model.opt.timestep)
    if file.physics_step is None and file.hardware is not None:
        yield f"physics_step is missing; write {step_s!r}, the MJCF's timestep"
    if file.physics_step is not None and not math.isclose(file.physics_step, step_s, rel_tol=1e-9):
        yield f"physics_step is {file.physics_step:g}, the MJCF's timestep {step_s:g}; write {step_s!r}"
    if 1.0 / file.state_rate_hz < float(model.opt.timestep) * (1 - 1e-6):
        yield (
            f"state_rate_hz {file.state_rate_hz:g} is faster than the MJCF's timestep of "
            f"{model.opt.timestep:g} s; write at most {1 / model.opt.timestep:g}, or a smaller timestep"
        )


def _of_joints(robot: UserRobot, base: RobotDescription, limits: Any) -> Iterator[str]:
    for j, joint in enumerate(robot.file.joints):
        if joint.unit != base.position_units[j]:
            yield f"unit of {joint.name} is {joint.unit}; write {base.position_units[j]}"
        low, high = joint.position_range or limits[j]
        if low < limits[j, 0] - 1e-9 or high > limits[j, 1] + 1e-9:
            yield (
                f"position_range of {joint.name} is {low:g} to {high:g}, the MJCF's range "
                f"{limits[j, 0]:g} to {limits[j, 1]:g}; stay inside, or widen the MJCF's range"
            )
        if joint.actuator is None:
            continue
        a = base.actuated.index(joint.name)
        for name, given, own in (
            ("stiffness", joint.actuator.stiffness, base.stiffness[a]),
            ("damping", joint.actuator.damping, base.damping[a]),
        ):
            if not math.isclose(given, own, rel_tol=1e-6, abs_tol=1e-12):
                yield _differs(name, joint.name, given, own)
        given, own = free_of(joint.actuator.effort_limit), base.effort_limit[a]
        if given != own and not math.isclose(given, own, rel_tol=1e-6) and math.isfinite(own):
            yield _differs("effort_limit", joint.name, given, own)


def _differs(name: str, joint: str, given: float, own: float) -> str:
    return f"{name} of {joint} is {given:g}, the MJCF's {own:g}; write {own!r}, or change the MJCF"


def _check_one_tree(mjcf: Path, model: Any) -> None:
    """Raise `ConfigurationError` if the driven joints lie in several trees of bodies."""
    roots: dict[int, list[str]] = {}
    for actuator in range(model.nu):
        joint = int(model.actuator_trnid[actuator, 0])
        if int(model.actuator_trntype[actuator]) == int(mujoco.mjtTrn.mjTRN_JOINT):
            root = int(model.body_rootid[model.jnt_bodyid[joint]])
            roots.setdefault(root, []).append(model.joint(joint).name or f"joint {joint}")
    if len(roots) > 1:
        trees = "; ".join(
            f"{model.body(root).name or f'body {root}'} ({', '.join(names)})" for root, names in roots.items()
        )
        raise ConfigurationError(
            f"model {mjcf} holds {len(roots)} robots: {trees}. Name an MJCF with one of them; or, where they "
            "are one robot, such as two arms, add --several-trees"
        )


def _finite(limit: float) -> float | None:
    return float(limit) if math.isfinite(limit) else None
