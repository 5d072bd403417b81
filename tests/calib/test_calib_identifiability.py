"""Bounds, priors, null directions and verdicts from normal equations, by hand."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import Uncertainty, ended_at_bound, uncertainty
from deal_hw.calib.fit.null_space import null_space, sparse_basis
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.fit.residual import Normal
from deal_hw.calib.validation.time_steps import LatencyScan, averaged
from deal_hw.calibration import Z90
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.types import FloatArray


def _space(*names: str) -> ParameterSpace:
    return ParameterSpace(
        Parameter(name=n, kind="body_mass", elements=("b",), unit="kg", nominal=1.0, low=0.2, high=5.0)
        for n in names
    )


def _told(
    space: ParameterSpace,
    theta: list[float],
    hessian: FloatArray,
    gradient: FloatArray | None = None,
    prior: FloatArray | None = None,
    jitter_s: float = 0.0,
) -> Uncertainty:
    """Statement with a decided latency and white residuals of variance 1 / 1.44: inflation is then 1.44."""
    whole = np.zeros((len(space) + 1,) * 2)
    whole[: len(space), : len(space)] = hessian
    white = np.random.default_rng(0).normal(size=(4, 50, 2))
    nothing = np.zeros(len(whole))
    slope, known = (nothing if given is None else given for given in (gradient, prior))
    normal = Normal(1.0, 1, whole, slope, (white,), known)
    return uncertainty(
        space,
        np.array(theta),
        0.0,
        normal,
        1.0,
        (0.0, 0.04),
        kinks=1.2,
        fixed_latency=True,
        timing_std_s=jitter_s,
    )


def test_a_parameter_at_its_bound_is_fixed_there_for_the_others() -> None:
    """Strongly correlated with one at its bound, the other is as sure as if that one were known."""
    hessian = 1e4 * np.array([[1.0, 0.9], [0.9, 1.0]])
    inside = _told(_space("a", "b"), [1.0, 2.0], hessian)
    at = _told(_space("a", "b"), [1.0, 5.0], hessian, gradient=np.array([0.0, -50.0, 0.0]))
    assert list(at.bound) == [0, 1]
    assert at.covariance[0, 0] == pytest.approx(1.44 / 1e4, rel=1e-3)
    assert inside.covariance[0, 0] == pytest.approx(1.44 / 1e4 / 0.19, rel=1e-2)
    assert any("bound of the search range: b (5 kg)" in alarm.seen for alarm in at.alarms)


@pytest.mark.parametrize(("jitter_s", "seen"), [(4e-5, []), (4e-4, ["jitter by 0.4 ms"])])
def test_a_jitter_too_small_to_matter_is_no_alarm(jitter_s: float, seen: list[str]) -> None:
    """Fast motion without noise looks like 0.04 ms of it, and the alarm had 0.0 ms."""
    reported = _told(_space("a", "b"), [1.0, 2.0], 1e4 * np.eye(2), jitter_s=jitter_s)
    assert len(reported.alarms) == len(seen)
    assert all(words in alarm.seen for words, alarm in zip(seen, reported.alarms, strict=True))


@pytest.mark.parametrize(("kind", "alarms"), [("servo_play", False), ("encoder_bias", True)])
def test_the_least_value_that_a_parameter_can_have_is_an_answer(kind: str, alarms: bool) -> None:
    """No play: there is no wider range to ask for. An encoder's zero can be below the range's 0."""
    space = ParameterSpace(
        [
            Parameter(
                name="p",
                kind=kind,
                elements=("b",),
                unit="m",
                nominal=0.01,
                low=0.0,
                high=0.05,
                scale="linear",
            )
        ]
    )
    reported = _told(space, [0.0], np.array([[1e8]]), gradient=np.array([50.0, 0.0]))
    assert reported.interval[0, 0] == 0.0
    assert any("bound of the search range" in alarm.seen for alarm in reported.alarms) == alarms


def test_the_interval_at_a_bound_lies_on_one_side() -> None:
    """Without a slope it is the half normal's 90 %, 1.645 std; with a steep one ln 10 over the slope."""
    flat = _told(_space("a", "b"), [1.0, 5.0], np.diag([1e4, 1e4]))
    std = np.sqrt(1.44 / 1e4)
    assert flat.interval[1] == pytest.approx([5.0 * np.exp(-Z90 * std), 5.0], rel=1e-4)
    steep = _told(_space("a", "b"), [1.0, 0.2], np.diag([1e4, 1e4]), gradient=np.array([0.0, 1440.0, 0.0]))
    # Slope 1000 after inflation, curvature small beside it: an exponential law.
    assert steep.interval[1, 0] == 0.2
    assert steep.interval[1, 1] == pytest.approx(0.2 * np.exp(np.log(10) / 1000), rel=1e-3)


def test_a_bound_that_the_data_do_not_press_is_none() -> None:
    """At the bound, but the cost falls inwards: the parameter stays free."""
    reported = _told(_space("a", "b"), [1.0, 5.0], np.diag([1e4, 1e4]), gradient=np.array([0.0, 5.0, 0.0]))
    assert list(reported.bound) == [0, 0]
    (alarm,) = [alarm for alarm in reported.alarms if "bound" in alarm.seen]
    assert "b (5 kg)" in alarm.seen and "the data do not press" in alarm.means


def test_what_ended_at_a_bound_is_what_the_alarms_name() -> None:
    """Pressed, not pressed, and not seen at all: whoever lies at an end is named, nobody else."""
    space, theta = _space("a", "b", "c", "d"), [5.0, 0.2, 5.0, 4.99]
    hessian, gradient = np.diag([1e4, 1e4, 1e-9, 1e4]), np.array([-50.0, -50.0, 0.0, -50.0, 0.0])
    reported = _told(space, theta, hessian, gradient=gradient)
    pressed, other = [alarm for alarm in reported.alarms if "bound" in alarm.seen]
    assert "a (5 kg)" in pressed.seen and "do not press" not in pressed.means
    assert "b (0.2 kg), c (5 kg)" in other.seen and "do not press" in other.means
    ended = ended_at_bound(space, np.array(theta))
    assert ended.tolist() == [True, True, True, False]
    assert list(reported.bound) == [1, 0, 0, 0]


def test_a_prior_resolves_a_common_factor() -> None:
    """Only a / b is seen; weighed to 1 %, both are known to 1 %, and no null direction is left."""
    data = 1e6 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    blind = _told(_space("a", "b"), [1.0, 1.0], data)
    assert blind.verdicts == ("not identifiable", "not identifiable")
    assert len(blind.null_directions) == 1
    space = _space("a", "b")
    assert blind.interval == pytest.approx(
        np.stack([space.unnormalize(np.full(2, 0.05)), space.unnormalize(np.full(2, 0.95))], axis=1)
    )
    weight = np.array([1 / 0.01**2, 0.0, 0.0])
    weighed = _told(space, [1.0, 1.0], data + np.diag(weight[:2]), prior=weight)
    assert weighed.null_directions == ()
    assert weighed.verdicts == ("identifiable", "identifiable")
    # The prior is no data: a residual that is too large does not make the scale less sure.
    assert weighed.covariance[0, 0] == pytest.approx(1e-4, rel=0.01)


@pytest.mark.parametrize(("expected_std", "verdict"), [(0.8, "weak"), (None, "not identifiable")])
def test_an_expected_value_that_the_data_sharpen_is_a_value(expected_std: float | None, verdict: str) -> None:
    """What is known to half of its logarithm: from 0.8 that were expected, or from a range of hardly more."""
    space = ParameterSpace(
        dataclasses.replace(p, low=0.25, high=4.0, prior_mean=expected_std and 1.0, prior_std=expected_std)
        for p in _space("a")
    )
    prior = np.array([1 / 0.8**2 if expected_std else 0.0, 0.0])
    known = _told(space, [1.0], np.array([[1 / 0.5**2]]), prior=prior)
    assert known.verdicts == (verdict,)


def test_what_a_null_direction_hardly_moves_keeps_its_value() -> None:
    """C moves by a hundredth of a and b along the direction that nobody sees: it is identified to 1 %."""
    v = np.array([1.0, 1.0, 0.01])
    projector = np.eye(3) - np.outer(v, v) / (v @ v)
    reported = _told(_space("a", "b", "c"), [1.0, 1.0, 1.0], 1e8 * projector)
    assert reported.verdicts == ("not identifiable", "not identifiable", "identifiable")


def test_plausible_latencies_that_disagree_cost_a_verdict() -> None:
    """At two ticks that explain the data alike one parameter differs by half: it is weak."""
    space = _space("a", "b")
    reported = _told(space, [1.0, 1.0], np.diag([1e4, 1e4]))
    assert reported.verdicts == ("identifiable", "identifiable")
    fits = [
        SimpleNamespace(theta=np.array([a, 1.0]), latency_s=0.003, chi2=1.0, normal=SimpleNamespace(cost=9.0))
        for a in (1.0, 1.65)
    ]
    problem = SimpleNamespace(step_s=1e-3, latency_range_s=(0.0, 0.04))
    scan = LatencyScan((3, 4), cast("tuple[Refined, ...]", tuple(fits)))
    found = averaged(cast("Problem", problem), scan, reported)
    assert found.verdicts == ("weak", "identifiable")
    assert found.covariance[0, 0] == pytest.approx(1.44e-4 + np.log(1.65) ** 2 / 2, rel=1e-3)


def test_sparse_basis_finds_the_readable_directions() -> None:
    """Any rotation of (1,1,1,0,0) and (0,0,1,-1,2) comes back as these two."""
    readable = np.array([[1.0, 1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0, 2.0]])
    angle = 0.7
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ readable
    found = sparse_basis(np.linalg.qr(turned.T)[0].T)
    found = found / np.max(np.abs(found), axis=1, keepdims=True)
    for wanted in readable / np.max(np.abs(readable), axis=1, keepdims=True):
        assert min(min(np.abs(f - wanted).max(), np.abs(f + wanted).max()) for f in found) < 1e-6


def test_null_space_leaves_the_ranges_own_spread() -> None:
    """One direction of two parameters unseen: each keeps 1 / sqrt(2) of its range's standard deviation."""
    space = _space("a", "b")
    found = null_space(space, 1e8 * np.array([[1.0, -1.0], [-1.0, 1.0]]))
    assert found.std == pytest.approx(space.width / np.sqrt(12) / np.sqrt(2), rel=1e-3)
    assert found.directions == pytest.approx(np.ones((1, 2))) or found.directions == pytest.approx(
        -np.ones((1, 2))
    )
