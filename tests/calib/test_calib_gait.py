"""What the fit of a walk allows for beyond its residual: other windows, and all forces together."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import Uncertainty
from deal_hw.calib.pipeline.methods import make_method
from deal_hw.calib.pipeline.output_error_fits import FORCES, GAIT, _including, _scaled_together
from deal_hw.calibration import Z90
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import walk_space
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.workflows.calibration.intake import CalibrationInput, usual_method
from deal_hw.workflows.calibration.settings import DriverDatasetSettings

SHARE = 0.04
"""Standard deviation of each parameter before."""


class _OfSpace:
    """All that is asked of a problem here."""

    def __init__(self, space: ParameterSpace) -> None:
        self.space = space


@pytest.fixture
def problem() -> Problem:
    """Return the space of a walk as a problem."""
    return cast("Problem", _OfSpace(walk_space()))


def known_at(space: ParameterSpace, theta: np.ndarray) -> Uncertainty:
    """Return an uncertainty with independent parameters, each known to a share."""
    half = np.exp(Z90 * SHARE)
    K = len(theta)
    return Uncertainty(
        space=space,
        theta=theta,
        covariance=SHARE**2 * np.eye(K),
        interval=np.stack([theta / half, theta * half], axis=1),
        latency_interval_s=(0.0, 0.01),
        null_directions=(),
        alarms=(),
        inflation=1.0,
        blind=np.zeros(K, dtype=bool),
        bound=np.zeros(K, dtype=np.int64),
        clustered=None,
        widened=np.ones(K),
    )


def test_forces_that_may_be_off_together_widen_what_scales_with_them(problem: Problem) -> None:
    """Gains by the root of both squares, and they move together; the floor's friction stays."""
    space, theta = problem.space, problem.space.nominal
    wider = _scaled_together(known_at(space, theta), FORCES, 0.05)
    half = np.log(wider.interval[:, 1] / theta)
    for k, p in enumerate(space):
        wanted = np.hypot(SHARE, np.log(1.05)) if p.kind in FORCES else SHARE
        assert half[k] == pytest.approx(Z90 * wanted, rel=1e-6), p.name
    gains = [k for k, p in enumerate(space) if p.kind == "servo_stiffness"]
    assert wider.covariance[gains[0], gains[1]] == pytest.approx(np.log(1.05) ** 2)
    floor = space.names.index("floor.friction")
    assert wider.covariance[floor, gains[0]] == 0.0


def test_a_walk_may_be_wrong_about_the_floor(problem: Problem) -> None:
    """Its kinds name parameters of the walk's space, and the floor's friction is one of them."""
    kinds = [kind for kinds, _ in GAIT.common_std for kind in kinds]
    assert {p.kind for p in problem.space} >= set(kinds)
    assert problem.space["floor.friction"].kind in kinds


def test_intervals_hold_what_other_windows_found(problem: Problem) -> None:
    """An estimate far outside moves one end to it; one inside moves none."""
    space, theta = problem.space, problem.space.nominal
    other = theta.copy()
    other[0], other[1] = 1.5 * theta[0], 1.001 * theta[1]
    before = known_at(space, theta)
    after = _including(before, other)
    assert after.interval[0, 1] == pytest.approx(other[0])
    np.testing.assert_allclose(after.interval[1:], before.interval[1:])
    assert after.covariance[0, 0] == pytest.approx(SHARE**2 + np.log(1.5) ** 2)
    assert after.verdicts[0] != "identifiable" and set(after.verdicts[1:]) == {"identifiable"}


def test_a_walk_is_fitted_by_gait_unless_something_else_is_asked_for() -> None:
    """A method that is named stays, and so does the default of a robot that stands."""
    robot = load_model(DRIVER)

    def method(*, walks: bool, **settings: str) -> str:
        work = cast("CalibrationInput", SimpleNamespace(robot=robot, walks=walks))
        return usual_method(DriverDatasetSettings(dataset="d", **settings), work)  # type: ignore[arg-type]

    assert method(walks=True) == "gait"
    assert method(walks=False) == "default"
    assert method(walks=True, method="default") == "default"
    assert method(walks=True, search="deal-paper") == "default+deal-paper"
    assert make_method("gait", refine=True).name == "gait"
    assert GAIT.robust and GAIT.long_s < 0.4
