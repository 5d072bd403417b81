"""The refinement from exact states: its basin, the whole step of latency, windows that nothing explains."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.checks import check_excitation
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import MISMATCH_CHI2
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.validation.time_steps import scan_latency
from deal_hw.errors import InsufficientDataError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

Beginning = Callable[[SampledEpisode, float], SampledEpisode]
Known = Callable[[ParameterSpace, FloatArray], tuple[ParameterSpace, FloatArray]]
SECONDS = 1.0
STEP_S = 0.002


@dataclasses.dataclass(frozen=True)
class Seen:
    """A Go2 whose whole state is reported, three drive parameters unknown in ranges of a factor twenty."""

    robot: RobotModel
    space: ParameterSpace
    episode: SampledEpisode
    truth: FloatArray


@pytest.fixture(scope="module")
def seen(beginning: Beginning, three_unknown: Known) -> Seen:
    """The beginning of a tuning seed."""
    case = make_case("go2", "ideal", 2, 3.0)
    space, truth = three_unknown(case.space.with_ratio(20.0), case.theta)
    return Seen(case.robot, space, beginning(case.fit, SECONDS), truth)


@pytest.mark.slow
def test_a_factor_of_eight_off_and_a_step_late_comes_out_exact(seen: Seen) -> None:
    """No search: from eight times the truth and the wrong whole step, all to 1e-6 and the latency right."""
    problem = Problem(seen.robot, seen.space, [seen.episode], threads=1)
    start = np.clip(seen.truth * [8.0, 0.15, 8.0], seen.space.low, seen.space.high)
    found = refine(problem, start, 1.2 * STEP_S)
    np.testing.assert_allclose(found.theta, seen.truth, rtol=1e-6)
    assert found.latency_s == 0.0
    assert found.chi2 < 1e-9


def test_a_window_that_nothing_explains_bends_no_parameter_and_is_not_silenced(seen: Seen) -> None:
    """Three samples 1 mrad off: parameters stay exact, the residual stays a mismatch."""
    position = seen.episode.position.copy()
    position[20:23, -1] += 1e-3
    wrong = dataclasses.replace(seen.episode, position=position)
    problem = Problem(seen.robot, seen.space, [wrong], threads=1, fixed_latency_s=0.0)
    found = refine(problem, seen.truth * [1.1, 0.9, 1.1], 0.0)
    np.testing.assert_allclose(found.theta, seen.truth, rtol=1e-4)
    assert found.chi2 > MISMATCH_CHI2


def test_the_scan_takes_the_refinement_itself_at_its_own_step(seen: Seen) -> None:
    """Only the neighbour is refined anew, and no weight is left for it."""
    problem = Problem(seen.robot, seen.space, [seen.episode], threads=1)
    found = refine(problem, seen.truth * 1.05, 0.0)
    scan = scan_latency(problem, found, None)
    assert scan is not None and scan.ticks == (0, 1)
    assert scan.refined[0] is found
    np.testing.assert_allclose(scan.weights, [1.0, 0.0], atol=1e-12)


def test_exact_motion_need_not_stand_out_of_a_sensor_that_was_not_there(seen: Seen) -> None:
    """10 mrad excite a joint whose state is exact or whose sensor is fine, but not with 2 mrad a count."""
    position = seen.episode.position.copy()
    swing = position[:, -1] - position[:, -1].mean()
    position[:, -1] = position[0, -1] + 0.01 * swing / np.ptp(swing)
    little = dataclasses.replace(seen.episode, position=position)
    check_excitation(Problem(seen.robot, seen.space, [little], threads=1))
    fine = dataclasses.replace(little, noise_free=False)
    check_excitation(Problem(seen.robot, seen.space, [fine], threads=1))
    position[:, -1] = np.round(position[:, -1] / 2e-3) * 2e-3
    sensed = dataclasses.replace(fine, position=position)
    with pytest.raises(InsufficientDataError, match="hardly moves"):
        check_excitation(Problem(seen.robot, seen.space, [sensed], threads=1))
