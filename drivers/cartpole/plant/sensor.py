"""Converts the true state to a state frame's integers: delay, noise, quantisation, differenced velocity."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from deal_hw.drivers.cartpole.plant.profiles import CartpoleProfile

_I32 = 0x7FFF_FFFF


class Motor(NamedTuple):
    """Reading of the motor's own encoder, without delay: position and velocity of the cart [m, m/s]."""

    position: float
    velocity: float


class Sample(NamedTuple):
    """True state and set-point at one control tick, before the physics step [m, m/s, rad, rad/s, m]."""

    cart: float
    cart_velocity: float
    pole: float
    pole_velocity: float
    setpoint: float


class Reading(NamedTuple):
    """Values of a state frame [um, um/s, urad, urad/s]; the set-point at that time [m]; the end stop."""

    cart_um: int
    cart_um_s: int
    pole_urad: int
    pole_urad_s: int
    setpoint: float
    at_end_stop: bool = False


class Sensor:
    """The delay line and the encoders.

    Args:
        profile: Noise, quantisation, velocity estimate and jitter.
        delay_ticks: A frame reports the state of that many device ticks ago.
        state_rate_hz: Rate at which :meth:`read` is called.
        rng: Source of noise and jitter.
    """

    def __init__(
        self, profile: CartpoleProfile, delay_ticks: int, state_rate_hz: int, rng: np.random.Generator
    ) -> None:
        self._noise = profile.sensor.noise
        self._resolution = profile.sensor.resolution
        self._delay = delay_ticks
        self._jitter = profile.sensing_jitter_ticks
        self._rng = rng
        self._samples: deque[Sample] = deque(maxlen=delay_ticks + self._jitter + 1)
        window = round(profile.sensor.velocity_window_s * state_rate_hz)
        self._rate_hz = state_rate_hz
        self._reported: deque[tuple[int, int]] = deque(maxlen=window + 1)

    def observe(self, sample: Sample) -> None:
        """Take the state of this tick; once a tick."""
        self._samples.append(sample)

    def restart(self) -> None:
        """Forget the past: the angle's turn count was set anew."""
        self._samples.clear()
        self._reported.clear()

    def read(self) -> Reading:
        """Return the values of this tick's frame."""
        delay = self._delay + (int(self._rng.integers(0, self._jitter + 1)) if self._jitter else 0)
        sample = self._samples[-1 - min(delay, len(self._samples) - 1)]
        cart_um = self._encode(sample.cart, 0)
        pole_urad = self._encode(sample.pole, 1)
        self._reported.append((cart_um, pole_urad))
        if self._reported.maxlen == 1:
            velocity = (fit(sample.cart_velocity * 1e6), fit(sample.pole_velocity * 1e6))
        else:
            velocity = self._difference()
        return Reading(cart_um, velocity[0], pole_urad, velocity[1], sample.setpoint)

    def _encode(self, value: float, joint: int) -> int:
        if self._noise[joint]:
            value += self._noise[joint] * self._rng.standard_normal()
        if step := self._resolution[joint]:
            value = round(value / step) * step
        return fit(value * 1e6)

    def _difference(self) -> tuple[int, int]:
        (old_cart, old_pole), (cart, pole) = self._reported[0], self._reported[-1]
        # Right after a start the window is not full yet; then the difference covers the samples so far.
        count = max(1, len(self._reported) - 1)
        return fit((cart - old_cart) * self._rate_hz / count), fit((pole - old_pole) * self._rate_hz / count)


def fit(value: float) -> int:
    """Return the nearest integer that a field of 32 bits with sign holds."""
    return min(max(round(value), -_I32), _I32)
