"""The hidden truth of an emulated Go2; for the emulator and for benches, never for a calibrator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deal_hw.drivers.go2.descriptions.floor import (
    DAMPING_NMS_RAD,
    FLOOR_FRICTION,
    FRICTIONLOSS_NM,
    JOINTS,
    PARTS,
    STIFFNESS_NM_RAD,
    TRUNK_KG,
)
from deal_hw.drivers.go2.emulator.profiles import profile as find_profile
from deal_hw.drivers.unitree.emulated_truth import JointTruth, JointTruthFile, draw_joints, truth_rng
from deal_hw.errors import ConfigurationError
from deal_hw.reading import number, reading
from deal_hw.schema import from_values

JOINT_DAMPING_NMS_RAD: Final = 0.6
ARMATURE_KGM2: Final = 0.01
DEFAULT_RANGE_RATIO: Final = 2.0
"""By default hidden quantities lie within this ratio of the nominal ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Go2Truth(JointTruth):
    """Hidden parameters of a Go2; see :class:`~deal_hw.drivers.unitree.emulated_truth.JointTruth`.

    Attributes:
        payload_kg: Mass that is strapped to the trunk [kg]; the trunk's inertia grows in proportion.
        floor_friction: Sliding friction between feet and floor.
    """

    stiffness: tuple[float, ...] = (1.0,) * 12
    damping: tuple[float, ...] = (1.0,) * 12
    joint_damping: tuple[float, ...] = (JOINT_DAMPING_NMS_RAD,) * 12
    frictionloss: tuple[float, ...] = (FRICTIONLOSS_NM,) * 12
    armature: tuple[float, ...] = (ARMATURE_KGM2,) * 12
    encoder_bias: tuple[float, ...] = (0.0,) * 12
    payload_kg: float = 0.0
    floor_friction: float = FLOOR_FRICTION

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints, in model order."""
        return JOINTS

    @property
    def owner(self) -> str:
        """The robot, for messages."""
        return "Go2"

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
        gains = self.parameters(STIFFNESS_NM_RAD, DAMPING_NMS_RAD)
        friction = np.array(self.frictionloss).reshape(-1, len(PARTS)).mean(axis=0)
        return {
            **{name: value for name, value in gains.items() if name.endswith(".stiffness")},
            **{
                name: value - JOINT_DAMPING_NMS_RAD
                for name, value in gains.items()
                if name.endswith(".damping")
            },
            "base.mass": TRUNK_KG + self.payload_kg,
            "floor.friction": self.floor_friction,
            **{f"{part}s.frictionloss": float(friction[i]) for i, part in enumerate(PARTS)},
        }

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; joints by name."""
        return {"robot": "go2", **JointTruth.to_json(self)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Go2Truth:
        """Return the truth that :meth:`to_json` wrote; other keys are ignored.

        Raises:
            ConfigurationError: A value is missing or invalid.
        """
        with reading("the values", "the truth of a Go2", "--reveal-to writes one", error=ConfigurationError):
            found = from_values(_TruthFile, values)
            return cls(
                profile=find_profile(found.profile).name,
                payload_kg=number(found.payload_kg, "payload_kg", 0, 100),
                floor_friction=number(found.floor_friction, "floor_friction", 0, 10),
                **found.values(JOINTS),
            )


@dataclass(frozen=True, slots=True)
class _TruthFile(JointTruthFile):
    payload_kg: float
    floor_friction: float


def nominal_truth(profile: str = "ideal", seed: int = 0, **changes: Any) -> Go2Truth:
    """Return a truth that equals the description, without latency unless given among the changes."""
    return Go2Truth(profile=find_profile(profile).name, seed=seed, **changes)


def draw_truth(profile: str, seed: int, *, range_ratio: float = DEFAULT_RANGE_RATIO) -> Go2Truth:
    """Draw a hidden truth: each quantity log-uniformly in the middle 80 % of its range.

    Args:
        profile: Name of the profile.
        seed: Seed of the draw.
        range_ratio: Ratio of the range around the nominal values.

    Raises:
        UnknownNameError: There is no such profile.
        ConfigurationError: ``range_ratio`` is not above 1, or the seed is negative.
    """
    found = find_profile(profile)
    rng = truth_rng(seed, range_ratio, 0x602)
    joints = draw_joints(rng, nominal_truth(profile, seed), range_ratio, found)
    return Go2Truth(
        profile=profile,
        seed=seed,
        payload_kg=float(rng.uniform(*found.payload_kg)),
        floor_friction=float(rng.uniform(*found.floor_friction)),
        **joints,
    )
