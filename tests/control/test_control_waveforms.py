"""Excitation signals: spectra, peaks, laws of sweeps, ranks and tables, by hand and by properties."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.motions.excitation.waveforms import (
    Steps,
    Sweep,
    Tones,
    Wave,
    ease,
    multisine,
    random_steps,
    schroeder_phases,
)
from deal_hw.schema import from_values
from deal_hw.types import FloatArray

WAVE: Any = Wave
LENGTH_S = 8.0
GRID_S = np.arange(0.0, LENGTH_S, 1 / 400)


def rank_share(values: FloatArray) -> float:
    """Return the least over the greatest singular value of centred columns: 0 where they are dependent."""
    spectrum = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
    return float(spectrum[-1] / spectrum[0])


@given(
    joints=st.integers(1, 4),
    low_hz=st.floats(0.2, 1.0),
    width=st.floats(2.0, 6.0),
    tilt=st.floats(0.0, 1.0),
    seed=st.integers(0, 10**6),
)
@settings(max_examples=40, deadline=None)
def test_multisine_keeps_its_band_and_its_peak(
    joints: int, low_hz: float, width: float, tilt: float, seed: int
) -> None:
    """All power lies on harmonics inside the band, no joint shares one, no sum exceeds its amplitude."""
    amplitude = np.linspace(0.1, 0.4, joints)
    wave = multisine(
        amplitude, low_hz, low_hz + width, 1 / LENGTH_S, tilt=tilt, rng=np.random.default_rng(seed)
    )
    values = wave.at(GRID_S)
    assert np.all(np.max(np.abs(values), axis=0) <= amplitude * 1.001)
    power = np.abs(np.fft.rfft(values, axis=0)) ** 2
    hz = np.fft.rfftfreq(len(GRID_S), 1 / 400)
    inside = (hz >= low_hz - 1e-9) & (hz <= low_hz + width + 1e-9)
    assert np.all(power[~inside].sum(axis=0) < 1e-12 * power.sum(axis=0))
    loud = power > 1e-6 * power.max(axis=0)
    assert np.all(loud.sum(axis=1) <= 1)
    assert joints == 1 or rank_share(values) > 0.1


def crest_factor(values: FloatArray) -> float:
    """Return peak over root mean square of a signal."""
    return float(np.max(np.abs(values)) / np.sqrt(np.mean(values**2)))


@given(count=st.integers(8, 24), seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_schroeder_phases_keep_the_peak_low(count: int, seed: int) -> None:
    """A flat sum of 8 to 24 harmonics peaks at less than 2 rms; in phase it would at sqrt(2 F), 4 to 7."""
    wave = multisine(
        np.ones(1), 0.5, 0.5 + (count - 1) / LENGTH_S, 1 / LENGTH_S, rng=np.random.default_rng(seed)
    )
    assert crest_factor(wave.at(GRID_S)) < 2.0
    aligned = Tones(
        frequency_hz=wave.frequency_hz,
        amplitude=wave.amplitude,
        phase=((math.pi / 2,) * len(wave.phase[0]),),
    )
    assert crest_factor(aligned.at(GRID_S)) > 3.9


def test_schroeder_phases_by_hand() -> None:
    """Four equal tones: 0, -2 pi / 4 x (0, 1, 1 + 2, 1 + 2 + 3)."""
    found = schroeder_phases(np.ones(4))
    np.testing.assert_allclose(found, -2 * math.pi / 4 * np.array([0, 1, 3, 6]))


@pytest.mark.parametrize("law", ["linear", "log"])
def test_sweep_makes_the_cycles_of_its_law(law: str) -> None:
    """1 to 4 Hz in 4 s: mean frequency 2.5 Hz, or 3 / ln 4 where it grows by equal ratios."""
    wave = Sweep(amplitude=(1.0,), duration_s=4.0, low_hz=1.0, high_hz=4.0, law=law)  # type: ignore[arg-type]
    t = np.arange(0.0, 4.0, 1e-4)
    x = wave.at(t)[:, 0]
    crossings = int(np.sum(np.diff(np.sign(x[np.abs(x) > 0])) != 0))
    mean_hz = (1.0 + 4.0) / 2 if law == "linear" else 3.0 / math.log(4.0)
    assert crossings / 2 == pytest.approx(4.0 * mean_hz, abs=0.6)


def test_one_by_one_moves_one_joint_at_a_time() -> None:
    """Each joint has a third of the time, begins and ends at rest."""
    wave = Sweep(amplitude=(0.1, 0.2, 0.3), duration_s=LENGTH_S, low_hz=0.5, high_hz=4.0)
    values = wave.at(GRID_S)
    assert np.all(np.sum(np.abs(values) > 0, axis=1) <= 1)
    assert np.max(np.abs(np.diff(values, axis=0)), axis=0).max() < 0.3 * 2 * math.pi * 4.2 / 400
    assert np.all(np.max(np.abs(values), axis=0) > [0.09, 0.18, 0.27])
    assert rank_share(values) > 0.2


def test_staggered_sweeps_are_independent_where_shifted_phases_are_not() -> None:
    """Five joints: all directions are excited; five phases of one sweep span two."""
    wave = Sweep(amplitude=(0.1,) * 5, duration_s=LENGTH_S, low_hz=0.3, high_hz=4.0, arrangement="staggered")
    values = wave.at(GRID_S)
    assert rank_share(values) > 0.3
    np.testing.assert_allclose(values[0], 0.0, atol=1e-12)
    # No joint jumps where its band starts over.
    assert np.max(np.abs(np.diff(values, axis=0))) < 0.1 * 2 * math.pi * 4.2 / 400
    single = Sweep(amplitude=(1.0,), duration_s=LENGTH_S, low_hz=0.3, high_hz=4.0)
    phase = single._phase(GRID_S, LENGTH_S)
    shifted = np.stack([np.sin(phase + a) for a in range(5)], axis=1)
    assert rank_share(shifted) < 1e-6


@given(shortest=st.floats(0.02, 0.3), ratio=st.floats(1.0, 4.0), seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_random_steps_stay_inside_and_cover_the_run(shortest: float, ratio: float, seed: int) -> None:
    """No offset exceeds its amplitude, no hold is shorter or longer than asked for."""
    amplitude = np.array([0.1, 0.5])
    wave = random_steps(amplitude, LENGTH_S, (shortest, shortest * ratio), np.random.default_rng(seed))
    assert np.all(np.abs(wave.at(GRID_S)) <= amplitude)
    holds = np.diff(wave.begin_s)
    assert np.all((holds >= shortest - 1e-9) & (holds <= shortest * ratio + 1e-9))
    assert wave.begin_s[-1] >= LENGTH_S


WAVES = st.one_of(
    st.builds(
        Tones,
        frequency_hz=st.just(((0.5, 1.0), (0.7, 1.3))),
        amplitude=st.tuples(*[st.tuples(*[st.floats(-1, 1)] * 2)] * 2),
        phase=st.tuples(*[st.tuples(*[st.floats(-7, 7)] * 2)] * 2),
    ),
    st.builds(
        Sweep,
        amplitude=st.tuples(st.floats(0, 1), st.floats(0, 1)),
        duration_s=st.floats(0.5, 20),
        low_hz=st.floats(0.1, 1),
        high_hz=st.floats(1, 9),
        law=st.sampled_from(("linear", "log")),
        arrangement=st.sampled_from(("one-by-one", "staggered")),
    ),
    st.builds(
        Steps, begin_s=st.just((0.0, 0.25)), value=st.tuples(*[st.tuples(*[st.floats(-1, 1)] * 2)] * 2)
    ),
)


@given(wave=WAVES, factor=st.tuples(st.floats(0, 1), st.floats(0, 1)))
@settings(max_examples=60, deadline=None)
def test_tables_survive_json_and_scale(wave: Tones | Sweep | Steps, factor: tuple[float, float]) -> None:
    """What is read back is equal; a scaled signal is the signal, scaled."""
    assert from_values(WAVE, dataclasses.asdict(wave)) == wave
    t = np.linspace(0.0, 0.5, 7)
    scaled = wave.scaled(np.array(factor)).at(t)
    np.testing.assert_allclose(scaled, wave.at(t) * np.array(factor), atol=1e-12)


@pytest.mark.parametrize(
    "values",
    [
        {"wave": "tones", "frequency_hz": [[1.0]], "amplitude": [[float("nan")]], "phase": [[0.0]]},
        {"wave": "tones", "frequency_hz": [[1.0]], "amplitude": [[1.0, 2.0]], "phase": [[0.0]]},
        {"wave": "tones", "frequency_hz": [[0.0]], "amplitude": [[1.0]], "phase": [[0.0]]},
        {"wave": "steps", "begin_s": [0.0, 0.0], "value": [[1.0], [2.0]]},
        {"wave": "steps", "begin_s": [0.0]},
        {"wave": "sweep", "amplitude": [1.0], "duration_s": 1.0, "low_hz": 2.0, "high_hz": 1.0},
    ],
)
def test_tables_that_cannot_be_are_refused(values: dict[str, object]) -> None:
    """NaN, ragged tables, frequencies and times that make no sense."""
    with pytest.raises(ConfigurationError):
        from_values(WAVE, values)


def test_unknown_names_list_what_there_is() -> None:
    """Of a wave, and of a sweep's law."""
    with pytest.raises(ConfigurationError, match=r"square.*tones"):
        from_values(WAVE, {"wave": "square"})
    with pytest.raises(UnknownNameError, match=r"quadratic.*linear"):
        Sweep(amplitude=(1.0,), duration_s=1.0, low_hz=1.0, high_hz=2.0, law="quadratic")  # type: ignore[arg-type]


def test_a_band_without_harmonics_is_refused() -> None:
    """0.3 to 0.4 Hz holds no multiple of 1 Hz."""
    with pytest.raises(ConfigurationError, match="contains 0 multiples"):
        multisine(np.ones(1), 0.3, 0.4, 1.0, rng=np.random.default_rng(0))


def test_ease_rises_and_falls() -> None:
    """Half way up after half the time; 1 between; 0 at both ends."""
    np.testing.assert_allclose(
        ease(np.array([0.0, 0.1, 0.2, 1.0, 1.9, 2.0, 2.5]), 2.0, 0.2), [0, 0.5, 1, 1, 0.5, 0, 0], atol=1e-12
    )
