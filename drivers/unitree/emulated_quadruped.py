"""What an emulated quadruped of Unitree is made of, and its hidden truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar

import numpy as np

from deal_hw.drivers.unitree.emulated_profile import SensorProfile, find_profile
from deal_hw.drivers.unitree.emulated_truth import (
    JointTruth,
    JointTruthFile,
    draw_joints,
    truth_rng,
)
from deal_hw.errors import ConfigurationError
from deal_hw.reading import number, reading
from deal_hw.schema import from_values

PARTS: Final = ("hip", "thigh", "calf")
DEFAULT_RANGE_RATIO: Final = 2.0
"""By default hidden quantities lie within this ratio of the nominal ones."""
PerJoint = tuple[float, ...]
"""A value for each joint, (12,), in model order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QuadrupedProfile(SensorProfile):
    """Differences of an emulated quadruped from its equations.

    Attributes:
        payload_kg: Lowest and highest hidden mass that is strapped to the trunk [kg].
        floor_friction: Lowest and highest hidden sliding friction of the floor.
    """

    payload_kg: tuple[float, float] = (0.0, 0.0)
    floor_friction: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SportGains:
    """Gains of sport mode's own commands.

    Attributes:
        stiffness: While it stands or moves [N·m/rad].
        damping: The same [N·m·s/rad].
        released: kd in which the joints are damped, with kp = 0 [N·m·s/rad].
    """

    stiffness: float
    damping: float
    released: float


@dataclass(frozen=True, slots=True, kw_only=True)
class BatteryFacts:
    """An emulated battery.

    Attributes:
        cells: Number of cells in series.
        capacity_ah: Its capacity [A·h].
        idle_a: Current of the robot at rest [A].
        loss_w_nm2: The motors' loss for the square of the torque [W/(N·m)²].
        resistance_ohm: Inner resistance [ohm].
    """

    cells: int
    capacity_ah: float
    idle_a: float
    loss_w_nm2: float
    resistance_ohm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatedQuadruped:
    """Facts about one quadruped for its emulator.

    Attributes:
        robot: Its name in deal-hw.
        kind: Its name in a sentence.
        stream: A number of its own for random streams, so that two robots of one seed differ.
        joints: The joints, in model order.
        floor_mjcf: Its model on the floor.
        stand_mjcf: Its model with the base held in the air.
        effort_limit: Largest effort of each motor [N·m].
        no_load: Speed of each motor without load [rad/s].
        servo_modes: Modes in which a motor follows commands; the first is that of sport mode's commands.
        heat_k_nm2: Final warming of a motor for the square of its torque [K/(N·m)²].
        hanging: Pose of limp legs in the air [rad].
        standing_m: Height of the base at the beginning in sport mode's standing pose [m].
        lying_m: The same in its lying pose [m].
        sport: Gains of sport mode.
        battery: The battery.
        trunk_kg: Mass of the trunk without payload [kg].
        gains: kp and kd of the robot on the floor [N·m/rad, N·m·s/rad].
        stand_gains: The same on a stand.
        joint_damping: Nominal viscous friction of each joint [N·m·s/rad].
        frictionloss: Nominal Coulomb friction of each joint [N·m].
        armature: Nominal inertia of each rotor at its joint [kg·m²].
        floor_friction: Nominal sliding friction between feet and floor.
        profiles: Profiles by name.
    """

    robot: str
    kind: str
    stream: int
    joints: tuple[str, ...]
    floor_mjcf: Path
    stand_mjcf: Path
    effort_limit: PerJoint
    no_load: PerJoint
    servo_modes: tuple[int, ...]
    heat_k_nm2: float
    hanging: PerJoint
    standing_m: float
    lying_m: float
    sport: SportGains
    battery: BatteryFacts
    trunk_kg: float
    gains: tuple[float, float]
    stand_gains: tuple[float, float]
    joint_damping: PerJoint
    frictionloss: PerJoint
    armature: PerJoint
    floor_friction: float
    profiles: Mapping[str, QuadrupedProfile]

    def profile(self, name: str) -> QuadrupedProfile:
        """Return a profile by name.

        Raises:
            UnknownNameError: There is no such profile.
        """
        return find_profile(name, self.profiles)


QT = TypeVar("QT", bound="QuadrupedTruth")


@dataclass(frozen=True, slots=True, kw_only=True)
class QuadrupedTruth(JointTruth):
    """Hidden parameters of a quadruped; see :class:`~deal_hw.drivers.unitree.emulated_truth.JointTruth`.

    Attributes:
        machine: What the robot is made of.
        payload_kg: Mass that is strapped to the trunk [kg]; the trunk's inertia grows in proportion.
        floor_friction: Sliding friction between feet and floor.
    """

    machine: ClassVar[EmulatedQuadruped]
    payload_kg: float = 0.0
    floor_friction: float

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints, in model order."""
        return self.machine.joints

    @property
    def owner(self) -> str:
        """The robot, for messages."""
        return self.machine.kind

    def parameters(self, stiffness: float, damping: float) -> dict[str, float]:
        """Return the true values under the names in the parameter sets of the robot on a stand.

        Args:
            stiffness: Commanded kp [N·m/rad].
            damping: Commanded kd [N·m·s/rad]; the joint's own viscous friction adds to it.
        """
        return self.at_gains(stiffness, damping)

    def walk_parameters(self) -> dict[str, float]:
        """Return the true values under the names in the parameter sets of the robot on the floor.

        There a joint's damping is the motor's alone; the model has the viscous friction. A friction that
        several joints share is their mean.
        """
        machine = self.machine
        gains = self.parameters(*machine.gains)
        friction = np.array(self.frictionloss).reshape(-1, len(PARTS)).mean(axis=0)
        own = dict(zip((f"{joint}.damping" for joint in machine.joints), machine.joint_damping, strict=True))
        return {
            **{name: value for name, value in gains.items() if name.endswith(".stiffness")},
            **{name: gains[name] - damping for name, damping in own.items()},
            "base.mass": machine.trunk_kg + self.payload_kg,
            "floor.friction": self.floor_friction,
            **{f"{part}s.frictionloss": float(friction[i]) for i, part in enumerate(PARTS)},
        }

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; joints by name."""
        return {"robot": self.machine.robot, **JointTruth.to_json(self)}

    @classmethod
    def from_json(cls: type[QT], values: Mapping[str, Any]) -> QT:
        """Return the truth that :meth:`to_json` wrote; other keys are ignored.

        Raises:
            ConfigurationError: A value is missing or invalid, or it is the truth of another robot.
        """
        machine = cls.machine
        what = f"the truth of a {machine.kind}"
        with reading("the values", what, "--reveal-to writes one", error=ConfigurationError):
            found = from_values(_TruthFile, values)
            if found.robot != machine.robot:
                raise ConfigurationError(f"they are the truth of a {found.robot}, not of a {machine.robot}")
            return cls(
                profile=machine.profile(found.profile).name,
                payload_kg=number(found.payload_kg, "payload_kg", 0, 100),
                floor_friction=number(found.floor_friction, "floor_friction", 0, 10),
                **found.values(machine.joints),
            )

    @classmethod
    def nominal(cls: type[QT], profile: str = "ideal", seed: int = 0, **changes: Any) -> QT:
        """Return a truth that equals the description, without latency unless given among the changes.

        Raises:
            UnknownNameError: There is no such profile.
        """
        machine = cls.machine
        one = (1.0,) * len(machine.joints)
        usual: dict[str, Any] = {
            "stiffness": one,
            "damping": one,
            "joint_damping": machine.joint_damping,
            "frictionloss": machine.frictionloss,
            "armature": machine.armature,
            "encoder_bias": (0.0,) * len(machine.joints),
            "floor_friction": machine.floor_friction,
        }
        return cls(profile=machine.profile(profile).name, seed=seed, **{**usual, **changes})

    @classmethod
    def draw(cls: type[QT], profile: str, seed: int, *, range_ratio: float = DEFAULT_RANGE_RATIO) -> QT:
        """Draw a hidden truth: each quantity log-uniformly in the middle 80 % of its range.

        Args:
            profile: Name of the profile.
            seed: Seed of the draw.
            range_ratio: Ratio of the range around the nominal values.

        Raises:
            UnknownNameError: There is no such profile.
            ConfigurationError: ``range_ratio`` is not above 1, or the seed is negative.
        """
        found = cls.machine.profile(profile)
        rng = truth_rng(seed, range_ratio, cls.machine.stream)
        joints = draw_joints(rng, cls.nominal(profile, seed), range_ratio, found)
        return cls(
            profile=profile,
            seed=seed,
            payload_kg=float(rng.uniform(*found.payload_kg)),
            floor_friction=float(rng.uniform(*found.floor_friction)),
            **joints,
        )


@dataclass(frozen=True, slots=True)
class _TruthFile(JointTruthFile):
    robot: str
    payload_kg: float
    floor_friction: float
