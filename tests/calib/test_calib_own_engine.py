"""The engine's pieces as an API: the page's program, and a residual of one's own."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.calib.api import OwnResidual, Problem, Shooting, SolverSettings, minimise, value_bounds
from deal_hw.calib.data.window_data import WindowData
from deal_hw.types import FloatArray

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "own-calibration-engine.md"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the page's program leaves."""
    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("page"))
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.S):
            exec(compile(block, str(PAGE), "exec"), names)
    return names


@pytest.mark.slow
def test_the_page_finds_what_it_says(page: dict[str, Any]) -> None:
    """Stiffness 6, damping 0.28 less the model's 0.04, no zero, friction 0.1; by each solver and residual."""
    true = np.array([6.0, 0.24, 0.0, 0.1])
    for name, within in (("found", 0.01), ("own_solver", 0.01), ("own_residual", 0.03)):
        fit = page[name]
        np.testing.assert_allclose(fit.theta, true, rtol=within, atol=0.005, err_msg=name)
    assert page["plain"].chi2 > 5 and page["found"].chi2 < 1.1 and page["judged"] < 1.3
    assert page["own_solver"].chi2 < 1.1
    low, high = page["own_intervals"].T
    assert np.all((low < true) & (true < high))
    assert np.all(high - low > np.ptp(page["intervals"], axis=1))


def _error(data: WindowData, predicted: FloatArray) -> FloatArray:
    """The engine's own residual, with white noise."""
    return np.asarray((predicted - data.measured) / np.where(data.reported, data.std, np.inf))


def test_the_engines_own_residual_gives_its_normal_equations(small_problem: Callable[..., Problem]) -> None:
    """Cost, residuals, derivatives and Hessian are those of `Shooting`, which computes them otherwise."""
    problem = small_problem(fixed_latency_s=None)
    windows = Shooting(problem, 12, given=True)
    own = OwnResidual(windows, _error)
    value = own.start() + 0.05
    point = windows.start(problem.space.from_scale(value[:-1]), float(value[-1]))
    expected, found = windows.normal(point, keep=True), own.normal(value)
    np.testing.assert_allclose(own.residual(value), windows.vector(point), rtol=1e-12)
    np.testing.assert_allclose(own.jacobian(value), windows.derivative(expected), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.hessian, expected.hessian, rtol=1e-6)
    np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-6)
    assert found.cost == pytest.approx(expected.cost) and found.count == expected.count
    assert own.refined(value).chi2 == pytest.approx(expected.cost / (expected.count - len(value)))


def test_what_was_not_reported_does_not_count(small_problem: Callable[..., Problem]) -> None:
    """A gap that was filled; whatever the residual returns there."""
    problem = small_problem()
    first = problem.episodes[0]
    seen = np.arange(len(first.sample)) % 7 != 3
    gapped = replace(problem, episodes=[replace(first, reported=seen)])
    own = OwnResidual(Shooting(gapped, 12, given=True), lambda data, predicted: np.ones_like(predicted))
    data = own.windows.data[0]
    ones = own.residual(own.start())[: data.measured.size].reshape(data.measured.shape)
    np.testing.assert_array_equal(ones, data.reported)
    assert own.normal(own.start()).count == np.count_nonzero(data.reported) < data.measured.size


def test_the_solver_takes_it(small_problem: Callable[..., Problem]) -> None:
    """From 30 % off to the solution of the nearest residual."""
    problem = small_problem()
    own = OwnResidual(Shooting(problem, 12, given=True), _error)
    value, used = minimise(own, own.start(), value_bounds(problem), SolverSettings(), fixed_latency=True)
    assert used > 1 and own.normal(value).cost < 1e-3 * own.normal(own.start()).cost
