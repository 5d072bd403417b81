"""What an emulated humanoid on a crane is made of, and its hidden truth; never for a calibrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, TypeVar

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.drivers.unitree.emulated_profile import REALISTIC, SENSOR, SensorProfile, find_profile
from deal_hw.drivers.unitree.emulated_truth import JointTruth, JointTruthFile, draw_joints, truth_rng
from deal_hw.drivers.unitree.humanoid import per_joint
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.reading import reading
from deal_hw.schema import from_values

DEFAULT_RANGE_RATIO: Final = 1.5
"""By default hidden quantities lie within this ratio of the nominal ones."""
PROFILES: Final = {
    "ideal": SensorProfile(name="ideal"),
    "sensor": SensorProfile(name="sensor", **SENSOR),
    "realistic": SensorProfile(name="realistic", **REALISTIC),
}
"""Assumptions, as for the Go2."""


def profile(name: str) -> SensorProfile:
    """Return a profile by name.

    Raises:
        UnknownNameError: There is no such profile.
    """
    return find_profile(name, PROFILES)


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatedHumanoid:
    """What an emulated humanoid is made of.

    Attributes:
        kind: The robot, as its maker writes it.
        stream: A number of its own, so that two robots of one seed differ.
        descriptions: Its descriptions by the robots' names, the usual one first.
        frictionloss: Nominal Coulomb friction of each part [N·m].
        joint_damping: Nominal viscous friction of every joint [N·m·s/rad].
        armature: Nominal inertia of every rotor at its joint [kg·m²].
    """

    kind: str
    stream: int
    descriptions: Mapping[str, RobotDescription]
    frictionloss: Mapping[str, float]
    joint_damping: float
    armature: float


HT = TypeVar("HT", bound="HumanoidTruth")


@dataclass(frozen=True, slots=True, kw_only=True)
class HumanoidTruth(JointTruth):
    """Hidden parameters of a humanoid; see :class:`~deal_hw.drivers.unitree.emulated_truth.JointTruth`.

    Attributes:
        machine: What the robot is made of.
        robot: One of the machine's robots, such as "g1".
    """

    machine: ClassVar[EmulatedHumanoid]
    robot: str

    def __post_init__(self) -> None:
        self.require(self.robot)
        JointTruth.__post_init__(self)

    @classmethod
    def require(cls, robot: str) -> RobotDescription:
        """Return the description of a robot of this machine.

        Raises:
            UnknownNameError: There is no such robot.
        """
        if robot not in cls.machine.descriptions:
            raise UnknownNameError(f"emulated {cls.machine.kind}", robot, cls.machine.descriptions)
        return cls.machine.descriptions[robot]

    @property
    def description(self) -> RobotDescription:
        """The robot's description."""
        return self.machine.descriptions[self.robot]

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints."""
        return self.description.joint_names

    @property
    def owner(self) -> str:
        """The robot, for messages."""
        return self.robot

    def parameters(self) -> dict[str, float]:
        """Return the true values under the names in the parameter sets, at the description's gains."""
        return self.at_gains(np.array(self.description.stiffness), np.array(self.description.damping))

    @classmethod
    def from_json(cls: type[HT], values: Mapping[str, Any]) -> HT:
        """Return the truth that :meth:`to_json` wrote; other keys are ignored.

        Raises:
            ConfigurationError: A value is missing or invalid.
        """
        with reading(
            "the values",
            f"the truth of a {cls.machine.kind}",
            "--reveal-to writes one",
            error=ConfigurationError,
        ):
            found = from_values(_TruthFile, values)
            joints = cls.require(found.robot).joint_names
            return cls(robot=found.robot, profile=profile(found.profile).name, **found.values(joints))

    @classmethod
    def nominal(
        cls: type[HT], profile_name: str = "ideal", seed: int = 0, robot: str = "", **changes: Any
    ) -> HT:
        """Return a truth that equals the description, without latency unless given among the changes.

        Args:
            profile_name: Name of the profile.
            seed: Seed of noise and jitter.
            robot: One of the machine's robots; "" for the usual one.
            **changes: Fields with other values.

        Raises:
            UnknownNameError: There is no such profile or robot.
        """
        machine = cls.machine
        name = robot or next(iter(machine.descriptions))
        joints: Sequence[str] = cls.require(name).joint_names
        one = (1.0,) * len(joints)
        usual = {
            "stiffness": one,
            "damping": one,
            "joint_damping": (machine.joint_damping,) * len(joints),
            "frictionloss": per_joint(machine.frictionloss, joints),
            "armature": (machine.armature,) * len(joints),
            "encoder_bias": (0.0,) * len(joints),
        }
        return cls(robot=name, profile=profile(profile_name).name, seed=seed, **{**usual, **changes})

    @classmethod
    def draw(
        cls: type[HT],
        profile_name: str,
        seed: int,
        *,
        range_ratio: float = DEFAULT_RANGE_RATIO,
        robot: str = "",
    ) -> HT:
        """Draw a hidden truth: each quantity log-uniformly in the middle 80 % of its range.

        Args:
            profile_name: Name of the profile.
            seed: Seed of the draw.
            range_ratio: Ratio of the range around the nominal values.
            robot: One of the machine's robots; "" for the usual one.

        Raises:
            UnknownNameError: There is no such profile or robot.
            ConfigurationError: ``range_ratio`` is not above 1, or the seed is negative.
        """
        found = profile(profile_name)
        rng = truth_rng(seed, range_ratio, cls.machine.stream)
        middle = cls.nominal(profile_name, seed, robot)
        drawn = draw_joints(rng, middle, range_ratio, found)
        return cls(robot=middle.robot, profile=profile_name, seed=seed, **drawn)


@dataclass(frozen=True, slots=True)
class _TruthFile(JointTruthFile):
    robot: str
