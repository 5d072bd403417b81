"""Fewer samples of an episode: on the device's grid, with nothing moved by what was lost."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.sim.recordings.episode import SampledEpisode, thin

SAMPLES = 100


def episode(lost: tuple[int, ...] = ()) -> SampledEpisode:
    """Return 0.2 s of one joint at 500 Hz on a grid of 1 ms; its position is its time in seconds."""
    kept = np.setdiff1d(np.arange(SAMPLES), lost)
    sample = 2 * kept
    one = np.ones((2 * SAMPLES, 1))
    return SampledEpisode(
        step_s=1e-3,
        sample=sample,
        position=1e-3 * sample[:, None],
        velocity=np.ones((len(sample), 1)),
        target=one,
        stiffness=one,
        damping=one,
        effort_limit=one,
        speed_limit=one,
        usable=np.ones(len(sample), dtype=bool),
        start_setpoint=np.zeros(1),
    )


def test_every_fifth_sample_of_500_hz_is_100_hz() -> None:
    """Samples 10 ms apart, what was sent untouched."""
    found = thin(episode(), 100.0)
    assert found.stride == 10 and found.period_s == pytest.approx(0.01)
    assert np.array_equal(found.sample, np.arange(0, 200, 10))
    assert np.allclose(found.position[:, 0], 1e-3 * found.sample)
    assert found.steps == 200 and found.usable.all()


def test_a_rate_between_shares_keeps_more() -> None:
    """200 of 500 Hz is every 2.5th: every second one is kept, 250 Hz."""
    assert thin(episode(), 200.0).stride == 4


@pytest.mark.parametrize("rate_hz", [500.0, 1000.0])
def test_a_rate_at_or_above_the_recordings_changes_nothing(rate_hz: float) -> None:
    """The same object comes back."""
    whole = episode()
    assert thin(whole, rate_hz) is whole


def test_a_lost_sample_holds_its_place_and_moves_no_other() -> None:
    """Sample 50 (100 ms) falls on the kept grid: it is filled in and marked; sample 51 does not show."""
    found = thin(episode(lost=(50, 51)), 100.0)
    assert np.array_equal(found.sample, np.arange(0, 200, 10))
    assert found.reported is not None
    assert np.flatnonzero(~found.reported).tolist() == [10]
    assert found.usable.all()


def test_what_is_unusable_between_two_kept_samples_counts() -> None:
    """Sample 52 was under the watchdog: no window may run from sample 50 to 55."""
    whole = episode()
    usable = whole.usable.copy()
    usable[52] = False
    found = thin(dataclasses.replace(whole, usable=usable), 100.0)
    assert np.flatnonzero(~found.usable).tolist() == [10]


def test_all_that_belongs_to_a_sample_goes_with_it() -> None:
    """Charts and spreads of estimates keep one row a sample."""
    whole = dataclasses.replace(
        episode(), reference=np.arange(4.0 * SAMPLES).reshape(SAMPLES, 4), estimate_std=np.ones((SAMPLES, 2))
    )
    found = thin(whole, 100.0)
    assert found.reference is not None and found.estimate_std is not None
    assert found.reference[:, 0].tolist() == [20.0 * k for k in range(20)]
    assert found.estimate_std.shape == (20, 2)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan")])
def test_no_rate_is_refused(rate_hz: float) -> None:
    """Nothing would be left."""
    with pytest.raises(ConfigurationError, match="above 0 Hz"):
        thin(episode(), rate_hz)
