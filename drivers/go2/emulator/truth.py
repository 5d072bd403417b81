"""The hidden truth of an emulated Go2; for the emulator and for benches, never for a calibrator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Final

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
from deal_hw.errors import ConfigurationError
from deal_hw.reading import number, reading
from deal_hw.schema import OPEN, from_values

JOINT_DAMPING_NMS_RAD: Final = 0.6
ARMATURE_KGM2: Final = 0.01
DEFAULT_RANGE_RATIO: Final = 2.0
"""By default hidden quantities lie within this ratio of the nominal ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Go2Truth:
    """Hidden parameters, which a calibrator has to find; tuples follow the 12 joints in model order.

    Attributes:
        profile: Name of the profile.
        seed: Seed of the draw, of noise and of jitter.
        stiffness: True kp over commanded kp.
        damping: The same for kd.
        joint_damping: Viscous friction [N·m·s/rad].
        frictionloss: Coulomb friction of the gears [N·m].
        armature: Inertia of the rotors at the joint [kg·m²].
        encoder_bias: Reported minus true position [rad]; a motor closes its loop on the reported one.
        payload_kg: Mass that is strapped to the trunk [kg]; the trunk's inertia grows in proportion.
        floor_friction: Sliding friction between feet and floor.
        latency_ms: Time from a command's reception to its effect, without jitter [ms].
    """

    profile: str
    seed: int
    stiffness: tuple[float, ...] = (1.0,) * 12
    damping: tuple[float, ...] = (1.0,) * 12
    joint_damping: tuple[float, ...] = (JOINT_DAMPING_NMS_RAD,) * 12
    frictionloss: tuple[float, ...] = (FRICTIONLOSS_NM,) * 12
    armature: tuple[float, ...] = (ARMATURE_KGM2,) * 12
    encoder_bias: tuple[float, ...] = (0.0,) * 12
    payload_kg: float = 0.0
    floor_friction: float = FLOOR_FRICTION
    latency_ms: int = 0

    def __post_init__(self) -> None:
        for name in _PER_JOINT:
            if len(getattr(self, name)) != len(JOINTS):
                raise ConfigurationError(
                    f"the truth of a Go2: {name} has {len(getattr(self, name))} entries, expected 12"
                )

    def parameters(self, stiffness: float, damping: float) -> dict[str, float]:
        """Return the true values under the names in the parameter sets of the robot on a stand.

        Args:
            stiffness: Commanded kp [N·m/rad].
            damping: Commanded kd [N·m·s/rad]; the joint's own viscous friction adds to it.
        """
        motor = np.array(self.damping) * damping + self.joint_damping
        rows = {
            "stiffness": np.array(self.stiffness) * stiffness,
            "damping": motor,
            "frictionloss": np.array(self.frictionloss),
            "armature": np.array(self.armature),
            "encoder_bias": np.array(self.encoder_bias),
        }
        return {
            f"{joint}.{name}": float(value)
            for name, values in rows.items()
            for joint, value in zip(JOINTS, values, strict=True)
        }

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
        values: dict[str, Any] = {"robot": "go2"}
        for entry in fields(self):
            value = getattr(self, entry.name)
            values[entry.name] = dict(zip(JOINTS, value, strict=True)) if entry.name in _PER_JOINT else value
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Go2Truth:
        """Return the truth that :meth:`to_json` wrote; other keys are ignored.

        Raises:
            ConfigurationError: A value is missing or invalid.
        """
        with reading("the values", "the truth of a Go2", "--reveal-to writes one", error=ConfigurationError):
            found = from_values(_TruthFile, values)
            arrays = {
                name: tuple(
                    number(getattr(found, name)[joint], f"{name} of {joint}", -1e3, 1e3) for joint in JOINTS
                )
                for name in _PER_JOINT
            }
            return cls(
                profile=find_profile(found.profile).name,
                seed=int(number(found.seed, "seed", 0)),
                latency_ms=int(number(found.latency_ms, "latency_ms", 0, 1000)),
                payload_kg=number(found.payload_kg, "payload_kg", 0, 100),
                floor_friction=number(found.floor_friction, "floor_friction", 0, 10),
                **arrays,
            )


@dataclass(frozen=True, slots=True)
class _TruthFile:
    """A truth as its file has it: joints by name."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN

    profile: str
    seed: int
    latency_ms: int
    payload_kg: float
    floor_friction: float
    stiffness: dict[str, float]
    damping: dict[str, float]
    joint_damping: dict[str, float]
    frictionloss: dict[str, float]
    armature: dict[str, float]
    encoder_bias: dict[str, float]


_PER_JOINT: Final = ("stiffness", "damping", "joint_damping", "frictionloss", "armature", "encoder_bias")


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
    if seed < 0:
        raise ConfigurationError(f"a seed is 0 or more, got {seed}")
    if not 1.0 < range_ratio < math.inf:
        raise ConfigurationError(f"the range ratio must be above 1, got {range_ratio}")
    rng = np.random.default_rng([seed, 0x602])

    def around(nominal: float) -> tuple[float, ...]:
        exponent = rng.uniform(-0.8, 0.8, len(JOINTS))
        return tuple(float(v) for v in nominal * range_ratio**exponent)

    low, high = found.latency_ms
    bias = found.encoder_bias_rad
    return Go2Truth(
        profile=profile,
        seed=seed,
        stiffness=around(1.0),
        damping=around(1.0),
        joint_damping=around(JOINT_DAMPING_NMS_RAD),
        frictionloss=around(FRICTIONLOSS_NM),
        armature=around(ARMATURE_KGM2),
        encoder_bias=tuple(float(v) for v in rng.uniform(-bias, bias, len(JOINTS))),
        latency_ms=int(rng.integers(low, high + 1)),
        payload_kg=float(rng.uniform(*found.payload_kg)),
        floor_friction=float(rng.uniform(*found.floor_friction)),
    )
