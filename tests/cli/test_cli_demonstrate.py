"""Demonstrations that adapt: emulated cart-poles that hardly move, or move too much, at first."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.bench import loop as bench_loop
from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.checks import check_excitation
from deal_hw.calib.data.problem import Problem
from deal_hw.calibration import Budget, CalibrationResult, Identifiability
from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.collect import collect
from deal_hw.control.process.channel import Outcome
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, nominal_truth
from deal_hw.errors import InsufficientDataError
from deal_hw.motions.excitation.level import ExcitationLevelSearch
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import align, fill_gaps
from deal_hw.workflows.calibration.episodes import choose_episodes
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.emulation.virtual import VirtualCartpole, VirtualEpisode, demonstrate
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.shipped import shipped_policy

pytestmark = pytest.mark.real_time


def shown(truth: CartpoleTruth) -> tuple[VirtualEpisode, ExcitationLevelSearch]:
    """Return the demonstration of an emulated robot."""
    policy = str(shipped_policy("cartpole"))
    plan = RunPlan(robot="cartpole", motion="rich", policy=policy, seed=truth.seed)
    return demonstrate(VirtualCartpole(truth), plan)


def test_a_robot_that_moves_is_recorded_once() -> None:
    """The nominal one needs no second recording, and what is played is the profile itself."""
    run, search = shown(nominal_truth())
    assert [a.level for a in search.attempts] == [0]
    assert run.report.outcome is Outcome.FINISHED


def test_a_creeping_robot_is_recorded_again_stronger_and_then_moves() -> None:
    """Strong damping, a slow set-point, a pole that stands in its own friction: one step up makes it fall."""
    run, search = shown(draw_truth("ideal", 7, range_ratio=20.0))
    assert any("pole moved" in words for words in search.attempts[0].shortfalls)
    assert search.attempts[search.best].enough and search.attempts[search.best].level > 0
    assert np.ptp(run.trajectory.position[:, 1]) > 1.0


def test_a_robot_that_trips_is_recorded_again_gentler() -> None:
    """A stiff and light one reaches the end of its range at first."""
    run, search = shown(draw_truth("ideal", 9, range_ratio=20.0))
    assert search.attempts[0].tripped and search.attempts[search.best].level < 0
    assert run.report.outcome is Outcome.FINISHED


def test_a_stuck_robot_is_refused_without_any_noise_too() -> None:
    """No level moves a pole that is held by more than its weight; the calibration says so, and what to do.

    It creeps by 23 mrad, as friction in MuJoCo does: 15 counts of an encoder with 4096 a turn.
    """
    truth = nominal_truth()
    truth = dataclasses.replace(truth, parameters={**truth.parameters, "pole.frictionloss": 2.0})
    run, search = shown(truth)
    assert not search.attempts[search.best].enough
    assert search.words and any("pole moved" in words for words in search.attempts[0].shortfalls)
    episode = fill_gaps(align(run.trajectory, DESCRIPTION))
    count = 2 * np.pi / 4096
    counted = dataclasses.replace(episode, position=np.round(episode.position / count) * count)
    problem = Problem(load_model(DESCRIPTION), k9_space(), [counted], threads=1)
    with pytest.raises(InsufficientDataError, match=r"hardly moves: pole moved .* \(noise 0\.002\)"):
        check_excitation(problem)


def test_collect_records_again_what_hardly_moved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In half a second no pole falls: the operator is informed, and only the repetition is fitted."""
    with EmulatorProcess("cartpole", "--nominal", "--profile", "sensor") as emulator:
        asked = COLLECT.settings(
            robot="cartpole", port=emulator.port, out=tmp_path, seconds=0.4, attempts=2, quiet=True
        )
        report = collect(asked)
    assert [e.outcome for e in report.episodes] == [Outcome.FINISHED] * 2
    reported = capsys.readouterr().err
    assert "pole moved" in reported and "recording again, stronger (excitation level 1)" in reported
    assert "continue with --excitation-level 2" in reported
    dataset = Dataset.open(tmp_path / "dataset")
    metadata = [dataset.read(i).metadata for i in range(2)]
    assert [(m["excitation_level"], m["attempt"], m["seed"]) for m in metadata] == [(0, 0, 0), (1, 1, 0)]
    printed: list[str] = []
    assert choose_episodes(dataset, (), (), printed.append) == ((1,), ())
    assert "episodes [0] hardly moved" in printed[0]
    assert choose_episodes(dataset, (0, 1), ()) == ((0, 1), ())


def test_a_row_is_flagged_where_a_parameter_is_given_no_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """No alarm, but a limit that the recording never reached: the row names it."""

    def reported(*args: Any, **kwargs: Any) -> CalibrationResult:
        verdicts: list[Identifiability] = ["identifiable"] * 9
        verdicts[7] = "not identifiable"
        return dataclasses.replace(calibrate_or_raise(*args, **kwargs), verdicts=tuple(verdicts), alarms=())

    case = make_case("cartpole", "ideal", 3, 3.0)
    monkeypatch.setattr(bench_loop, "calibrate_or_raise", reported)
    row, _ = bench_loop.calibration_row(case, "midpoint", Budget(refine=False), 1)
    assert row["untold"] == ["servo.effort_limit"] and row["flagged"] and not row["alarms"]
    assert row["excitation_levels"] == list(case.excitation_levels)
