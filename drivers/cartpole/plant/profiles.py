"""Profiles of an emulated cart-pole: sensors, latency and imperfect mechanics, in three steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from deal_hw.description import SensorModel
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import UnknownNameError


@dataclass(frozen=True, slots=True, kw_only=True)
class CartpoleProfile:
    """How an emulated device differs from its equations.

    Attributes:
        name: The profile's name, as on the command line.
        sensor: Noise, quantisation and velocity estimate.
        latency_ticks: Lowest and highest total latency, actuation plus sensing, before jitter [device ticks].
        actuation_jitter_ticks: A command acts up to this much later, uniformly [device ticks].
        sensing_jitter_ticks: A frame reports a state up to this much older, uniformly [device ticks].
        stribeck_ratio: Friction at standstill over friction in motion, less 1.
        stribeck_speed_m_s: Speed at which that excess has fallen to 1/e [m/s].
        backlash_m: Play between the motor with its encoder and the cart [m].
        drop_probability: Share of state frames that are never sent.
    """

    name: str
    sensor: SensorModel
    latency_ticks: tuple[int, int]
    actuation_jitter_ticks: int = 0
    sensing_jitter_ticks: int = 0
    stribeck_ratio: float = 0.0
    stribeck_speed_m_s: float = 0.02
    backlash_m: float = 0.0
    drop_probability: float = 0.0

    @property
    def mean_jitter_ticks(self) -> float:
        """Mean of both jitters together [device ticks]: each is uniform from 0."""
        return (self.actuation_jitter_ticks + self.sensing_jitter_ticks) / 2


PROFILES: Final = {
    "ideal": CartpoleProfile(
        name="ideal",
        sensor=SensorModel(noise=(0.0, 0.0), resolution=(0.0, 0.0), velocity_window_s=0.0),
        latency_ticks=(0, 0),
    ),
    "sensor": CartpoleProfile(name="sensor", sensor=DESCRIPTION.sensor, latency_ticks=(5, 25)),
    "realistic": CartpoleProfile(
        name="realistic",
        sensor=DESCRIPTION.sensor,
        latency_ticks=(5, 25),
        actuation_jitter_ticks=3,
        sensing_jitter_ticks=2,
        stribeck_ratio=0.4,
        backlash_m=0.0004,
        drop_probability=0.01,
    ),
}


def profile(name: str) -> CartpoleProfile:
    """Return a profile by name.

    Raises:
        UnknownNameError: There is no such profile.
    """
    if name not in PROFILES:
        raise UnknownNameError("profile", name, PROFILES)
    return PROFILES[name]
