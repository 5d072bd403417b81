"""The diffusion step with a regression's estimate, on a problem whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from try_diffusion_regression import GENERATIONS, STEPS, Diffusion, Step


@pytest.mark.parametrize("step", [s for s in STEPS.values() if s is not None and s.keep >= 0.05])
def test_members_end_at_the_truth_of_a_linear_problem(step: Step) -> None:
    """Five measurements that are linear in three parameters, without noise: every schedule must find them."""
    rng = np.random.default_rng(0)
    matrix, truth = rng.normal(size=(5, 3)), np.array([0.8, -1.2, 0.3])
    members = Diffusion(rng.normal(size=(60, 3)), rng, 10.0, step)
    for _ in range(GENERATIONS):
        assert not members.finished
        members.tell((truth - members.ask()) @ matrix.T)
    assert members.finished
    np.testing.assert_allclose(members.ask().mean(axis=0), truth, atol=0.05)


def test_members_that_are_told_nothing_stay_where_the_noise_takes_them() -> None:
    """Residuals of zero: the estimates are the members, and no noise is left at the end."""
    rng = np.random.default_rng(1)
    start = rng.normal(size=(40, 2))
    members = Diffusion(start, rng, 2.0, Step(0.05, 0.0))
    members.tell(np.zeros((40, 4)))
    scaled = (members.ask() - start.mean(axis=0)) / (start - start.mean(axis=0))
    assert np.ptp(scaled) < 1e-9
