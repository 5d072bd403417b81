"""Sensors that are finer than the model: the cart's encoder sees what no model predicts, the pole's not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from deal_hw.bench.scores import log_error_x100
from deal_hw.bench.tasks import Case
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.channel_weights import weight_channels
from deal_hw.calib.fit.refinement import at_parameters, refine

COUNT_M = 25e-6


@pytest.fixture
def fine(noisy: Case) -> Problem:
    """A recording whose cart is measured to 25 um without noise, and moves by 60 um unlike the model."""
    assert noisy.fit_truth is not None
    assert noisy.truth is not None
    time_s = noisy.fit.time_s
    # Sensors report the state of some ticks ago.
    reported_s = time_s - 1e-3 * noisy.truth.sensing_ticks
    cart = CubicSpline(time_s, noisy.fit_truth[0][:, 0])(reported_s)
    cart += 60e-6 * np.sin(2 * np.pi * 6.0 * time_s)
    position = noisy.fit.position.copy()
    position[:, 0] = np.round(cart / COUNT_M) * COUNT_M
    whole = Problem(noisy.robot, noisy.space, [dataclasses.replace(noisy.fit, position=position)], threads=1)
    return whole.part([time_s < 2.5])


@pytest.mark.slow
def test_a_channel_finer_than_the_model_is_weighted_by_what_the_model_leaves(
    fine: Problem, noisy: Case
) -> None:
    """The pole keeps its noise's weight, and what only it tells is not bent to the cart's micrometres."""
    fit = refine(fine, noisy.theta, noisy.latency_s, (0.2,))
    weighted = weight_channels(fine, fit)
    assert weighted is not None
    cart, pole = weighted.scale
    # 60 um / sqrt(2) over 25 um / sqrt(12), less what start states take.
    assert 4.0 < cart < 6.5
    assert pole == 1.0
    # What is reported of the residual stays in units of the sensors' noise.
    assert weighted.chi2 == pytest.approx((cart**2 + 1) / 2, rel=0.2)
    assert weighted.fit.chi2 == pytest.approx(1.0, abs=0.3)
    assert weighted.fit.shooting.length > fit.shooting.length
    assert log_error_x100(fit.theta, noisy.theta) > 2.0
    assert log_error_x100(weighted.fit.theta, noisy.theta) < 1.0


def test_usual_noise_is_never_weighted_anew(noisy: Case) -> None:
    """Where noise hides what a model cannot follow, a residual above it asks for a search."""
    problem = Problem(noisy.robot, noisy.space, [noisy.fit], threads=1)
    fit = at_parameters(problem, noisy.theta * 1.2, noisy.latency_s, 40)
    assert fit.chi2 > 1.3
    assert weight_channels(problem, fit) is None
