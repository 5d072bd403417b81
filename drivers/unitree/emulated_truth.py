"""The hidden truth of an emulated robot's joints; for emulators and benches, never for a calibrator."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Final

import numpy as np

from deal_hw.drivers.unitree.emulated_profile import SensorProfile
from deal_hw.errors import ConfigurationError
from deal_hw.reading import number
from deal_hw.schema import OPEN
from deal_hw.types import FloatArray

PER_JOINT: Final = ("stiffness", "damping", "joint_damping", "frictionloss", "armature", "encoder_bias")


@dataclass(frozen=True, slots=True, kw_only=True)
class JointTruth(abc.ABC):
    """Hidden parameters, which a calibrator has to find; tuples follow the robot's joints (J).

    Attributes:
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

    profile: str
    seed: int
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    joint_damping: tuple[float, ...]
    frictionloss: tuple[float, ...]
    armature: tuple[float, ...]
    encoder_bias: tuple[float, ...]
    latency_ms: int = 0

    @property
    @abc.abstractmethod
    def joints(self) -> tuple[str, ...]:
        """The joints."""

    @property
    @abc.abstractmethod
    def owner(self) -> str:
        """The robot, for messages."""

    def __post_init__(self) -> None:
        for name in PER_JOINT:
            if len(getattr(self, name)) != len(self.joints):
                raise ConfigurationError(
                    f"the truth of a {self.owner}: {name} has {len(getattr(self, name))} entries, expected "
                    f"{len(self.joints)}"
                )

    def at_gains(self, stiffness: FloatArray | float, damping: FloatArray | float) -> dict[str, float]:
        """Return the true values of the joints under the names in parameter sets.

        Args:
            stiffness: Commanded kp, (J,) or one for all [N·m/rad].
            damping: Commanded kd [N·m·s/rad]; the joint's own viscous friction adds to it.
        """
        rows = {
            "stiffness": np.array(self.stiffness) * stiffness,
            "damping": np.array(self.damping) * damping + self.joint_damping,
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
            joined = entry.name in PER_JOINT
            values[entry.name] = dict(zip(self.joints, value, strict=True)) if joined else value
        return values


@dataclass(frozen=True, slots=True)
class JointTruthFile:
    """A truth as its file has it: joints by name."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN

    profile: str
    seed: int
    latency_ms: int
    stiffness: dict[str, float]
    damping: dict[str, float]
    joint_damping: dict[str, float]
    frictionloss: dict[str, float]
    armature: dict[str, float]
    encoder_bias: dict[str, float]

    def values(self, joints: Sequence[str]) -> dict[str, Any]:
        """Return the fields of a :class:`JointTruth` but the profile, checked.

        Raises:
            ConfigurationError: A number is out of its range.
        """
        arrays = {
            name: tuple(
                number(getattr(self, name)[joint], f"{name} of {joint}", -1e3, 1e3) for joint in joints
            )
            for name in PER_JOINT
        }
        return {
            "seed": int(number(self.seed, "seed", 0)),
            "latency_ms": int(number(self.latency_ms, "latency_ms", 0, 1000)),
            **arrays,
        }


def truth_rng(seed: int, range_ratio: float, stream: int) -> np.random.Generator:
    """Return the generator of a draw.

    Args:
        seed: Its seed.
        range_ratio: Ratio of the ranges around the nominal values.
        stream: A number of the robot's own, so that two robots of one seed differ.

    Raises:
        ConfigurationError: ``range_ratio`` is not above 1, or the seed is negative.
    """
    if seed < 0:
        raise ConfigurationError(f"a seed is 0 or more, got {seed}")
    if not 1.0 < range_ratio < math.inf:
        raise ConfigurationError(f"the range ratio must be above 1, got {range_ratio}")
    return np.random.default_rng([seed, stream])


def draw_joints(
    rng: np.random.Generator, middle: JointTruth, range_ratio: float, profile: SensorProfile
) -> dict[str, Any]:
    """Draw hidden values of joints: each log-uniformly in the middle 80 % of its range; bias and latency.

    Args:
        rng: The generator.
        middle: The nominal values.
        range_ratio: Ratio of the ranges around them.
        profile: Has the ranges of bias and latency.
    """

    def around(nominal: tuple[float, ...]) -> tuple[float, ...]:
        exponent = rng.uniform(-0.8, 0.8, len(nominal))
        return tuple(float(v) for v in np.array(nominal) * range_ratio**exponent)

    low, high = profile.latency_ms
    bias = profile.encoder_bias_rad
    drawn: dict[str, Any] = {
        name: around(getattr(middle, name)) for name in PER_JOINT if name != "encoder_bias"
    }
    drawn["encoder_bias"] = tuple(float(v) for v in rng.uniform(-bias, bias, len(middle.joints)))
    drawn["latency_ms"] = int(rng.integers(low, high + 1))
    return drawn
