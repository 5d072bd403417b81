"""The hidden truth of an emulated cart-pole; for emulator and benches, never for a calibrator."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from deal_hw.drivers.cartpole.description import k9_space, laws_space, parameter_space
from deal_hw.drivers.cartpole.plant.profiles import profile as find_profile
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.reading import number, reading
from deal_hw.schema import OPEN, from_values, plain

MOST_TICKS = 1000
"""Longest latency of one side [device ticks]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CartpoleTruth:
    """Hidden values that a calibration should find.

    Attributes:
        profile: Name of the profile.
        seed: Seed of the draw, of noise and of the start angles.
        parameters: Every parameter of ``parameter_space()`` by name, known ones included [SI units], and the
            laws of ``laws_space()`` where they were drawn; else the profile's act.
        actuation_ticks: A command acts that many device ticks after it was received, before jitter.
        sensing_ticks: A frame reports the state of that many device ticks ago, before jitter.
        refused: Draws before this one that the oracle policy could not balance.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN

    profile: str
    seed: int
    parameters: Mapping[str, float]
    actuation_ticks: int = 0
    sensing_ticks: int = 0
    refused: int = 0

    @property
    def latency_s(self) -> float:
        """Mean total latency: actuation plus sensing, and the mean of the profile's jitter [s].

        Jitter only delays. So the mean, which a calibration finds, is later than the constant part.
        """
        return (
            self.actuation_ticks + self.sensing_ticks + find_profile(self.profile).mean_jitter_ticks
        ) * 1e-3

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**plain(self), "latency_s": self.latency_s}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> CartpoleTruth:
        """Return the truth that :meth:`to_json` wrote.

        Raises:
            ConfigurationError: A value is missing or invalid.
        """
        with reading(
            "the values", "the truth of a cart-pole", "--reveal-to writes one", error=ConfigurationError
        ):
            found = from_values(cls, values)
            find_profile(found.profile)
            number(found.seed, "seed", 0)
            number(found.refused, "refused", 0)
            number(found.actuation_ticks, "actuation_ticks", 0, MOST_TICKS)
            number(found.sensing_ticks, "sensing_ticks", 0, MOST_TICKS)
            space = laws_space() if "cart.friction_stribeck" in found.parameters else parameter_space()
            known = {
                p.name: number(found.parameters[p.name], p.name, 0.1 * p.low, 10 * p.high)
                for p in space.parameters
            }
            return dataclasses.replace(found, parameters=known)


def unique_id(truth: CartpoleTruth) -> int:
    """Return the serial number of the device with this truth."""
    return 0xE000_0000 + truth.seed % 2**28


def nominal_truth(profile: str = "ideal", seed: int = 0, **changes: Any) -> CartpoleTruth:
    """Return a truth that equals the description, without latency unless given among the changes."""
    parameters = {p.name: p.nominal for p in parameter_space().parameters}
    return CartpoleTruth(profile=profile, seed=seed, parameters=parameters, **changes)


def candidate_truth(
    profile: str,
    rng: np.random.Generator,
    *,
    seed: int,
    range_ratio: float,
    refused: int,
    space: ParameterSpace | None = None,
) -> CartpoleTruth:
    """Draw free parameters in the 10-90 % part of their range, uniformly in their scales, and a latency.

    ``space`` says which parameters are free, and around which values; without it K9. Parameters that it does
    not have keep their nominal values.
    """
    chosen = space or k9_space()
    space = chosen.with_ratio(range_ratio).with_known(chosen.known)
    values = space.unnormalize(rng.uniform(0.1, 0.9, len(space)))
    low, high = find_profile(profile).latency_ticks
    total = int(rng.integers(low, high + 1))
    sensing = int(rng.integers(0, total + 1))
    return CartpoleTruth(
        profile=profile,
        seed=seed,
        parameters={
            **{p.name: p.nominal for p in parameter_space().parameters},
            **space.known,
            **dict(zip(space.names, map(float, values), strict=True)),
        },
        actuation_ticks=total - sensing,
        sensing_ticks=sensing,
        refused=refused,
    )
