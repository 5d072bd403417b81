"""The judge of hypotheses: which it accepts among all that were asked, and how often it is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.calib.hypotheses.judge import UnseenGain, accepted, needed
from deal_hw.calib.hypotheses.thresholds import FALSE_DISCOVERIES

ASKED, SAMPLES = 20, 400


def gains(rng: np.random.Generator, true: int) -> dict[int, UnseenGain]:
    """Return what each of 20 regressors gains on 400 samples beside a constant, of which ``true`` act.

    Each is fitted to half of the samples and predicts the other half; neighbours have 0.7 of the same effect,
    as laws have.
    """
    shared = rng.standard_normal((SAMPLES, ASKED + 1))
    columns = 0.84 * shared[:, :-1] + 0.55 * shared[:, 1:]
    values = rng.standard_normal(SAMPLES) + 0.5 * columns[:, : 4 * true : 4].sum(axis=1)
    half = SAMPLES // 2
    # The model without a hypothesis has seen all samples.
    before = float(np.mean((values[half:] - values.mean()) ** 2))
    found = dict[int, UnseenGain]()
    for k in range(ASKED):
        design = np.stack([np.ones(SAMPLES), columns[:, k]], axis=1)
        slope, *_ = np.linalg.lstsq(design[:half], values[:half], rcond=None)
        after = float(np.mean((values[half:] - design[half:] @ slope) ** 2))
        found[k] = UnseenGain(before, after, half)
    return found


def test_where_nothing_is_there_hardly_anything_is_accepted() -> None:
    """300 robots without an effect, 20 hypotheses each: at most a tenth of the robots get any."""
    rng = np.random.default_rng(0)
    wrong = sum(bool(accepted(gains(rng, 0))) for _ in range(300))
    assert wrong <= FALSE_DISCOVERIES * 300


def test_what_is_there_is_found() -> None:
    """Two effects of a quarter of the noise each: most are found, and little else than their neighbours."""
    rng = np.random.default_rng(1)
    found = [accepted(gains(rng, 2)) for _ in range(100)]
    assert np.mean([len({0, 4} & set(each)) for each in found]) > 1.6
    near = {0, 1, 4, 5, 3}
    assert np.mean([len(set(each) - near) / max(len(each), 1) for each in found]) < FALSE_DISCOVERIES


def test_more_evidence_is_needed_the_more_is_asked() -> None:
    """By the root of the likelihood ratio: odds of 10 for one alone, of 200 for one of 20, of 100 for two."""
    assert np.exp(needed(1) / 4) == pytest.approx(10)
    assert np.exp(needed(20) / 4) == pytest.approx(200)
    assert np.exp(needed(20, 2) / 4) == pytest.approx(100)
    # One of 20 needs a deviance of 21.2, and two of them 18.4.
    two = {name: UnseenGain(1.1, 1.1 * np.exp(-d / 100), 100) for name, d in (("a", 19.0), ("b", 20.0))}
    assert accepted(two, 20) == ["b", "a"] and accepted({"b": two["b"]}, 20) == []
    assert accepted({"b": two["b"], "c": None}) == ["b"]


def test_what_explains_little_is_not_accepted() -> None:
    """2 % of the squared residual, however sure; and a worse prediction is a share below 0."""
    assert accepted({"a": UnseenGain(1.0, 0.98, 1e6)}) == []
    worse = UnseenGain(1.0, 1.2, 1e3)
    assert worse.share < 0 and worse.deviance < 0 and not worse.promises(1)
