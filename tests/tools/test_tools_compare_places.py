"""Places of truths and estimates in the search ranges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from compare_places import places, summary

from deal_hw.drivers.cartpole.description import SPACES
from deal_hw.errors import ConfigurationError

pytestmark = pytest.mark.real_time


def row(seed: int, method: str, bench: str = "fixed-range") -> dict[str, Any]:
    """Return a row whose estimate is the truth ("reads"), or a draw ("guesses"), or the middle."""
    space = SPACES["k9"]().with_ratio(20.0)
    truth = space.unnormalize(np.random.default_rng(seed).uniform(0.1, 0.9, len(space)))
    guess = space.unnormalize(np.random.default_rng(1000 + seed).uniform(0.1, 0.9, len(space)))
    found = {"reads": truth, "guesses": guess}.get(method, space.center)
    return {
        "bench": bench,
        "task": "cartpole",
        "range_ratio": 20.0,
        "method": method,
        "seed": seed,
        "error": "",
        "error_percent": 10.0 * seed,
        "heldout_nrmse_calibrated": 0.1,
        "heldout_nrmse_nominal": 0.2,
        "per_parameter": {
            name: {"truth": t, "estimate": e} for name, t, e in zip(space.names, truth, found, strict=True)
        },
    }


def test_a_search_that_reads_the_recording_has_a_correlation_of_one() -> None:
    """30 robots: an exact search has 1, a guess about 0, and a fixed place none at all."""
    rows = [row(seed, method) for seed in range(30) for method in ("reads", "guesses", "middle")]
    found = {group["method"]: group for group in summary([*rows, {**rows[0], "error": "diverged"}])}
    assert found["reads"]["correlation"] == pytest.approx(1.0)
    assert abs(found["guesses"]["correlation"]) < 0.2
    assert found["middle"]["correlation"] is None
    assert found["reads"]["robots"] == 30 and found["reads"]["places"] == 270
    assert found["reads"]["error_percent"] == 145.0 and found["reads"]["heldout_over_nominal"] == 0.5


def test_the_ends_of_a_range_are_0_and_1() -> None:
    """On the logarithmic scale the middle of [p / 20, 20 p] is p."""
    np.testing.assert_allclose(places(row(0, "middle"))[1], 0.5)


def test_rows_with_one_place_for_all_truths_are_refused() -> None:
    """`bench paper` puts the truth at the same place of every range."""
    with pytest.raises(ConfigurationError, match="one place of every range"):
        summary([row(0, "reads", "paper")])
