"""Excitation signals: sums of sines, sweeps and random steps, as small tables that any process can evaluate.

A signal is an offset from the centre of each actuated joint (A), a function of the time since it began. Numpy
only: an optimiser may fill the tables, but the control process that plays them needs none.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.schema import FINITE, Tagged
from deal_hw.types import FloatArray

Law = Literal["linear", "log"]
Arrangement = Literal["one-by-one", "staggered"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tones:
    """A sum of sines for each joint.

    Attributes:
        frequency_hz: (A, F).
        amplitude: (A, F) [m or rad].
        phase: At time 0, (A, F) [rad].
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    wave: Literal["tones"] = "tones"
    frequency_hz: tuple[tuple[float, ...], ...]
    amplitude: tuple[tuple[float, ...], ...]
    phase: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        shapes = {tuple(len(row) for row in part) for part in (self.frequency_hz, self.amplitude, self.phase)}
        if len(shapes) != 1 or not self.frequency_hz:
            raise ConfigurationError(f"tones need tables of one shape, got rows of {sorted(shapes)}")
        if not all(f > 0 for row in self.frequency_hz for f in row):
            raise ConfigurationError("tones need frequencies above 0 Hz")

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return the offsets at times, (T, A)."""
        columns = []
        for frequency, amplitude, phase in zip(self.frequency_hz, self.amplitude, self.phase, strict=True):
            angle = 2 * math.pi * np.outer(time_s, frequency) + np.array(phase)
            columns.append(np.sin(angle) @ np.array(amplitude))
        return np.stack(columns, axis=1)

    def scaled(self, factor: FloatArray) -> Tones:
        """Return the signal with each joint's offsets multiplied, (A,)."""
        rows = zip(self.amplitude, factor, strict=True)
        return dataclasses.replace(self, amplitude=tuple(tuple(a * float(f) for a in row) for row, f in rows))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """A sine whose frequency runs from low to high.

    The same sweep on all joints, or sweeps that differ in phase only, would span only one or two directions
    of the joint space. So the joints move one by one, or each starts at another frequency and wraps around in
    the band (``staggered``).

    Attributes:
        amplitude: (A,) [m or rad].
        duration_s: Length of the signal [s].
        low_hz: Lowest frequency.
        high_hz: Highest frequency.
        law: Whether the frequency grows linearly or exponentially.
        arrangement: How several joints share the time.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    wave: Literal["sweep"] = "sweep"
    amplitude: tuple[float, ...]
    duration_s: float
    low_hz: float
    high_hz: float
    law: Law = "linear"
    arrangement: Arrangement = "one-by-one"

    def __post_init__(self) -> None:
        if not (self.duration_s > 0 and 0 < self.low_hz <= self.high_hz and self.amplitude):
            raise ConfigurationError(
                f"not a usable sweep: {self.low_hz:g} to {self.high_hz:g} Hz in {self.duration_s:g} s; "
                "needed: 0 < low <= high, and a duration above 0 s"
            )
        if self.law not in get_args(Law):
            raise UnknownNameError("sweep law", self.law, get_args(Law))
        if self.arrangement not in get_args(Arrangement):
            raise UnknownNameError("arrangement", self.arrangement, get_args(Arrangement))

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return the offsets at times, (T, A)."""
        A, T = len(self.amplitude), self.duration_s
        out = np.zeros((len(time_s), A))
        for a, amplitude in enumerate(self.amplitude):
            if self.arrangement == "staggered":
                begin = a / A * T
                # The band ends at another frequency than it begins, so the phase continues over the wrap.
                lap = self._phase(np.array([T]), T)[0]
                moved = time_s + begin
                phase = (
                    self._phase(moved % T, T)
                    + lap * np.floor_divide(moved, T)
                    - self._phase(np.array([begin]), T)
                )
                out[:, a] = amplitude * np.sin(phase)
                continue
            share = T / A
            local = time_s - a * share
            inside = (local >= 0) & (local <= share)
            # Each joint's turn begins and ends at rest.
            window = ease(local, share, min(0.1 * share, 0.2))
            out[inside, a] = (amplitude * window * np.sin(self._phase(local, share)))[inside]
        return out

    def _phase(self, time_s: FloatArray, duration_s: float) -> FloatArray:
        ratio = self.high_hz / self.low_hz
        if self.law == "linear" or ratio == 1.0:
            slope = (self.high_hz - self.low_hz) / duration_s
            return np.asarray(2 * math.pi * (self.low_hz * time_s + 0.5 * slope * time_s**2))
        grown = np.expm1(time_s / duration_s * math.log(ratio))
        return np.asarray(2 * math.pi * self.low_hz * duration_s / math.log(ratio) * grown)

    def scaled(self, factor: FloatArray) -> Sweep:
        """Return the signal with each joint's offsets multiplied, (A,)."""
        scaled = tuple(a * float(f) for a, f in zip(self.amplitude, factor, strict=True))
        return dataclasses.replace(self, amplitude=scaled)


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """Offsets that are held.

    Attributes:
        begin_s: Start time of each, increasing from 0, (S,).
        value: (S, A) [m or rad].
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    wave: Literal["steps"] = "steps"
    begin_s: tuple[float, ...]
    value: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in zip(self.begin_s, self.begin_s[1:], strict=False))
        if not self.begin_s or len(self.begin_s) != len(self.value) or self.begin_s[0] != 0 or not rising:
            raise ConfigurationError("steps need one value for each time, and times that increase from 0")
        if len({len(row) for row in self.value}) != 1:
            raise ConfigurationError("steps need as many values at each time")

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return the offsets at times, (T, A)."""
        row = np.searchsorted(np.array(self.begin_s), time_s, side="right") - 1
        return np.array(self.value)[np.maximum(row, 0)]

    def scaled(self, factor: FloatArray) -> Steps:
        """Return the signal with each joint's offsets multiplied, (A,)."""
        rows = tuple(tuple(v * float(f) for v, f in zip(row, factor, strict=True)) for row in self.value)
        return dataclasses.replace(self, value=rows)


Wave = Annotated[Tones | Sweep | Steps, Tagged("wave")]
"""Any of the signals; in JSON the field ``wave`` names it."""


def ease(time_s: FloatArray, duration_s: float, ease_s: float) -> FloatArray:
    """Return a window that rises from 0 and falls back to it by a raised cosine, in [0, 1].

    Args:
        time_s: Times since the window began, (T,).
        duration_s: Its length [s].
        ease_s: Time of the rise, and of the fall [s]; 0 for none.
    """
    inside = (time_s >= 0) & (time_s <= duration_s)
    if ease_s <= 0:
        return np.where(inside, 1.0, 0.0)
    edge = np.minimum(time_s, duration_s - time_s) / ease_s
    return np.where(inside, 0.5 - 0.5 * np.cos(math.pi * np.clip(edge, 0.0, 1.0)), 0.0)


def schroeder_phases(power: FloatArray) -> FloatArray:
    """Return phases that keep the peak of a sum of harmonics low, (F,) [rad].

    Schroeder (1970), "Synthesis of low-peak-factor signals and binary sequences with low autocorrelation":
    the phase of tone k decreases by the power of the tones before it, weighted by their distance.

    Args:
        power: Power of each tone, in the order of frequency, (F,).
    """
    share = power / np.sum(power)
    before = np.concatenate([[0.0], np.cumsum(share)[:-1]])
    # The sum over l < k of (k - l) p_l is the power, cumulated twice.
    return np.asarray(-2 * math.pi * np.cumsum(before))


MOST_TONES = 24
"""Most tones of a joint."""


def multisine(
    amplitude: FloatArray,
    low_hz: float,
    high_hz: float,
    base_hz: float,
    *,
    tilt: float = 0.0,
    rng: np.random.Generator,
) -> Tones:
    """Return a multisine with Schroeder phases, other harmonics for each joint.

    The start within the period and the sign are random; neither changes spectrum or peak.

    Args:
        amplitude: Peak of each joint's sum over its period, (A,) [m or rad].
        low_hz: Lowest frequency.
        high_hz: Highest frequency.
        base_hz: All frequencies are multiples of it: 1 / length of the signal, so that the joints' signals
            are orthogonal.
        tilt: Amplitudes fall with frequency to this power; 0 is flat, 1 equal speeds.
        rng: Draws beginning and sign of each joint.

    Raises:
        ConfigurationError: The band contains fewer harmonics than there are joints.
    """
    A = len(amplitude)
    harmonics = np.arange(math.ceil(low_hz / base_hz - 1e-9), math.floor(high_hz / base_hz + 1e-9) + 1)
    harmonics = harmonics[harmonics > 0]
    count = min(len(harmonics) // A, MOST_TONES)
    if count < 1:
        raise ConfigurationError(
            f"the band {low_hz:g} to {high_hz:g} Hz contains {len(harmonics)} multiples of {base_hz:.3g} "
            f"Hz, but each joint needs one, {A} in total; widen the band or record longer"
        )
    frequency, height, phase = [], [], []
    for a in range(A):
        own = harmonics[a::A]
        chosen = own[np.unique(np.round(np.linspace(0, len(own) - 1, count)).astype(int))]
        f = chosen * base_hz
        tone = (f / f[0]) ** -tilt
        shift = schroeder_phases(tone**2) + 2 * math.pi * f * rng.uniform(0.0, 1.0 / base_hz)
        grid = np.linspace(0.0, 1.0 / base_hz, 64 * int(chosen[-1]), endpoint=False)
        peak = np.max(np.abs(np.sin(2 * math.pi * np.outer(grid, f) + shift) @ tone))
        frequency.append(tuple(map(float, f)))
        height.append(tuple(map(float, rng.choice((-1.0, 1.0)) * amplitude[a] * tone / peak)))
        phase.append(tuple(map(float, np.mod(shift, 2 * math.pi))))
    return Tones(frequency_hz=tuple(frequency), amplitude=tuple(height), phase=tuple(phase))


def random_steps(
    amplitude: FloatArray, duration_s: float, hold_s: tuple[float, float], rng: np.random.Generator
) -> Steps:
    """Return uniformly drawn offsets, each held for a time drawn from a range.

    Args:
        amplitude: Largest offset of each joint, (A,) [m or rad].
        duration_s: Length of the signal [s].
        hold_s: Shortest and longest hold [s].
        rng: Draws both.
    """
    low, high = hold_s
    if not 0 < low <= high:
        raise ConfigurationError(f"hold times of {low!r} to {high!r} s: needed is 0 < shortest <= longest")
    begin, value = [0.0], [tuple(map(float, rng.uniform(-1.0, 1.0, len(amplitude)) * amplitude))]
    while begin[-1] < duration_s:
        begin.append(begin[-1] + float(rng.uniform(low, high)))
        value.append(tuple(map(float, rng.uniform(-1.0, 1.0, len(amplitude)) * amplitude)))
    return Steps(begin_s=tuple(begin), value=tuple(value))
