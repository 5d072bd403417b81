"""The hidden truth of an emulated G1; for the emulator and for benches, never for a calibrator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.drivers.g1.description import (
    ARMATURE_KGM2,
    DAMPING_NMS_RAD,
    DESCRIPTION,
    DESCRIPTION_23,
    FRICTIONLOSS_NM,
    JOINT_DAMPING_NMS_RAD,
    STIFFNESS_NM_RAD,
    per_joint,
)
from deal_hw.drivers.g1.emulator.profiles import profile as find_profile
from deal_hw.drivers.unitree.emulated_truth import JointTruth, JointTruthFile, draw_joints, truth_rng
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.reading import reading
from deal_hw.schema import from_values

DEFAULT_RANGE_RATIO: Final = 1.5
"""By default hidden quantities lie within this ratio of the nominal ones."""
DESCRIPTIONS: Final[Mapping[str, RobotDescription]] = {one.name: one for one in (DESCRIPTION, DESCRIPTION_23)}


@dataclass(frozen=True, slots=True, kw_only=True)
class G1Truth(JointTruth):
    """Hidden parameters of a G1; see :class:`~deal_hw.drivers.unitree.emulated_truth.JointTruth`.

    Attributes:
        robot: "g1" or "g1_23dof".
    """

    robot: str

    def __post_init__(self) -> None:
        if self.robot not in DESCRIPTIONS:
            raise UnknownNameError("emulated G1", self.robot, DESCRIPTIONS)
        JointTruth.__post_init__(self)

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints."""
        return DESCRIPTIONS[self.robot].joint_names

    @property
    def owner(self) -> str:
        """The robot, for messages."""
        return self.robot

    def parameters(self) -> dict[str, float]:
        """Return the true values under the names in the parameter sets, at the description's gains."""
        return self.at_gains(
            np.array(per_joint(STIFFNESS_NM_RAD, self.joints)),
            np.array(per_joint(DAMPING_NMS_RAD, self.joints)),
        )

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> G1Truth:
        """Return the truth that :meth:`to_json` wrote; other keys are ignored.

        Raises:
            ConfigurationError: A value is missing or invalid.
        """
        with reading("the values", "the truth of a G1", "--reveal-to writes one", error=ConfigurationError):
            found = from_values(_TruthFile, values)
            if found.robot not in DESCRIPTIONS:
                raise UnknownNameError("emulated G1", found.robot, DESCRIPTIONS)
            joints = DESCRIPTIONS[found.robot].joint_names
            profile = find_profile(found.profile).name
            return cls(robot=found.robot, profile=profile, **found.values(joints))


@dataclass(frozen=True, slots=True)
class _TruthFile(JointTruthFile):
    robot: str


def nominal_truth(profile: str = "ideal", seed: int = 0, robot: str = "g1", **changes: Any) -> G1Truth:
    """Return a truth that equals the description, without latency unless given among the changes."""
    joints = DESCRIPTIONS[robot].joint_names
    one = (1.0,) * len(joints)
    usual = {
        "stiffness": one,
        "damping": one,
        "joint_damping": (JOINT_DAMPING_NMS_RAD,) * len(joints),
        "frictionloss": per_joint(FRICTIONLOSS_NM, joints),
        "armature": (ARMATURE_KGM2,) * len(joints),
        "encoder_bias": (0.0,) * len(joints),
    }
    return G1Truth(robot=robot, profile=find_profile(profile).name, seed=seed, **{**usual, **changes})


def draw_truth(
    profile: str, seed: int, *, range_ratio: float = DEFAULT_RANGE_RATIO, robot: str = "g1"
) -> G1Truth:
    """Draw a hidden truth: each quantity log-uniformly in the middle 80 % of its range.

    Args:
        profile: Name of the profile.
        seed: Seed of the draw.
        range_ratio: Ratio of the range around the nominal values.
        robot: "g1" or "g1_23dof".

    Raises:
        UnknownNameError: There is no such profile.
        ConfigurationError: ``range_ratio`` is not above 1, or the seed is negative.
    """
    found = find_profile(profile)
    rng = truth_rng(seed, range_ratio, 0x61)
    middle = nominal_truth(profile, seed, robot)
    return G1Truth(robot=robot, profile=profile, seed=seed, **draw_joints(rng, middle, range_ratio, found))
