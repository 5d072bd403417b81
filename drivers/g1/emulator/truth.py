"""The hidden truth of an emulated G1; for the emulator and for benches, never for a calibrator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Final

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
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.reading import number, reading
from deal_hw.schema import OPEN, from_values

DEFAULT_RANGE_RATIO: Final = 1.5
"""By default hidden quantities lie within this ratio of the nominal ones."""
DESCRIPTIONS: Final[Mapping[str, RobotDescription]] = {one.name: one for one in (DESCRIPTION, DESCRIPTION_23)}
_PER_JOINT: Final = ("stiffness", "damping", "joint_damping", "frictionloss", "armature", "encoder_bias")


@dataclass(frozen=True, slots=True, kw_only=True)
class G1Truth:
    """Hidden parameters, which a calibrator has to find; tuples follow the robot's joints (J).

    Attributes:
        robot: "g1" or "g1_23dof".
        profile: Name of the profile.
        seed: Seed of the draw, of noise and of jitter.
        stiffness: True kp over commanded kp.
        damping: The same for kd.
        joint_damping: Viscous friction [N·m·s/rad].
        frictionloss: Coulomb friction of the gears [N·m].
        armature: Inertia of the rotors at the joint [kg·m²].
        encoder_bias: Reported minus true position [rad]; a motor closes its loop on the reported one.
        latency_ms: Time from a command's reception to its effect, without jitter [ms].
    """

    robot: str
    profile: str
    seed: int
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    joint_damping: tuple[float, ...]
    frictionloss: tuple[float, ...]
    armature: tuple[float, ...]
    encoder_bias: tuple[float, ...]
    latency_ms: int = 0

    def __post_init__(self) -> None:
        if self.robot not in DESCRIPTIONS:
            raise UnknownNameError("emulated G1", self.robot, DESCRIPTIONS)
        for name in _PER_JOINT:
            if len(getattr(self, name)) != len(self.joints):
                raise ConfigurationError(
                    f"the truth of a {self.robot}: {name} has {len(getattr(self, name))} entries, expected "
                    f"{len(self.joints)}"
                )

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints."""
        return DESCRIPTIONS[self.robot].joint_names

    def parameters(self) -> dict[str, float]:
        """Return the true values under the names in the parameter sets, at the description's gains."""
        kp = np.array(per_joint(STIFFNESS_NM_RAD, self.joints))
        kd = np.array(per_joint(DAMPING_NMS_RAD, self.joints))
        rows = {
            "stiffness": np.array(self.stiffness) * kp,
            "damping": np.array(self.damping) * kd + self.joint_damping,
            "frictionloss": np.array(self.frictionloss),
            "armature": np.array(self.armature),
            "encoder_bias": np.array(self.encoder_bias),
        }
        return {
            f"{joint}.{name}": float(value)
            for name, values in rows.items()
            for joint, value in zip(self.joints, values, strict=True)
        }

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; joints by name."""
        values: dict[str, Any] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            joined = entry.name in _PER_JOINT
            values[entry.name] = dict(zip(self.joints, value, strict=True)) if joined else value
        return values

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
            arrays = {
                name: tuple(
                    number(getattr(found, name)[joint], f"{name} of {joint}", -1e3, 1e3) for joint in joints
                )
                for name in _PER_JOINT
            }
            return cls(
                robot=found.robot,
                profile=find_profile(found.profile).name,
                seed=int(number(found.seed, "seed", 0)),
                latency_ms=int(number(found.latency_ms, "latency_ms", 0, 1000)),
                **arrays,
            )


@dataclass(frozen=True, slots=True)
class _TruthFile:
    """A truth as its file has it: joints by name."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN

    robot: str
    profile: str
    seed: int
    latency_ms: int
    stiffness: dict[str, float]
    damping: dict[str, float]
    joint_damping: dict[str, float]
    frictionloss: dict[str, float]
    armature: dict[str, float]
    encoder_bias: dict[str, float]


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
    if seed < 0:
        raise ConfigurationError(f"a seed is 0 or more, got {seed}")
    if not 1.0 < range_ratio < math.inf:
        raise ConfigurationError(f"the range ratio must be above 1, got {range_ratio}")
    rng = np.random.default_rng([seed, 0x61])
    middle = nominal_truth(profile, seed, robot)

    def around(nominal: tuple[float, ...]) -> tuple[float, ...]:
        exponent = rng.uniform(-0.8, 0.8, len(nominal))
        return tuple(float(v) for v in np.array(nominal) * range_ratio**exponent)

    low, high = found.latency_ms
    bias = found.encoder_bias_rad
    drawn = {name: around(getattr(middle, name)) for name in _PER_JOINT if name != "encoder_bias"}
    return G1Truth(
        robot=robot,
        profile=profile,
        seed=seed,
        encoder_bias=tuple(float(v) for v in rng.uniform(-bias, bias, len(middle.joints))),
        latency_ms=int(rng.integers(low, high + 1)),
        **drawn,
    )
