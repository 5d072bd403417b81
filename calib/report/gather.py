"""From robot, result and recordings to what the report shows: the only part that simulates."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np

from deal_hw.calib.data.coordinates import Members
from deal_hw.calib.data.innovations import whitened_residual
from deal_hw.calib.data.problem import Problem, WindowData, samples_in
from deal_hw.calib.fit.output_error import longest_windows
from deal_hw.calib.report.inputs import Overlay, ReportInputs, Residuals
from deal_hw.calib.validation.normalised_error import HELDOUT_WINDOW_S
from deal_hw.calib.validation.split_half import HalvesRow, halves_rows
from deal_hw.calibration import CalibrationResult
from deal_hw.errors import InsufficientDataError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import Episode
from deal_hw.types import FloatArray

PANELS = 24
"""Panels drawn of each sort of recordings, one a channel; more would make the page long and say the same."""

WHITENED_SIZE = 600
"""Samples times channels of a window that is whitened: its covariance matrix has so many rows."""


def gather(
    robot: RobotModel,
    result: CalibrationResult,
    episodes: Sequence[Episode],
    holdout: Sequence[Episode] = (),
    *,
    telemetry: Sequence[str] = (),
    halves: Sequence[HalvesRow] = (),
    window_s: float = HELDOUT_WINDOW_S,
    threads: int | None = None,
) -> ReportInputs:
    """Simulate what the report shows.

    Args:
        robot: The nominal model.
        result: What the calibration found.
        episodes: The fitted recordings.
        holdout: Recordings that the search has not seen.
        telemetry: Verdicts of the telemetry checks, in words.
        halves: Agreement of disjoint halves of the data; by default what the result's provenance says.
        window_s: Drawn predictions restart this often [s]; where no recording is as long, more often.
        threads: Simulation threads.
    """
    overlays: list[Overlay] = []
    residuals: list[Residuals] = []
    left_out: list[str] = []
    for group, heldout in ((episodes, False), (holdout, True)):
        word = "held-out" if heldout else "fitted"
        if not group:
            continue
        shown = group[: max(min(PANELS // len(group[0].channels), len(group)), 1)]
        if len(group) > len(shown):
            left_out.append(f"{len(group) - len(shown)} more {word} recordings are not drawn")
        problem = Problem(robot, result.space, shown, threads=threads, fixed_latency_s=result.latency_s)
        titles = [f"{word} recording {i + 1} of {len(group)}" for i in range(len(shown))]
        overlays.extend(_overlays(problem, result, titles, heldout, window_s))
        if not heldout:
            residuals.extend(_residuals(problem, result, titles))
    return ReportInputs(
        robot=robot.description.name,
        result=result,
        overlays=tuple(overlays),
        residuals=tuple(residuals),
        tick_s=episodes[0].step_s if episodes else None,
        telemetry=tuple(telemetry),
        halves=tuple(halves) or halves_rows(result.provenance),
        left_out=tuple(left_out),
    )


def _overlays(
    problem: Problem, result: CalibrationResult, titles: Sequence[str], heldout: bool, window_s: float
) -> list[Overlay]:
    theta = np.stack([result.space.nominal, result.estimate])
    # The user's own model knows no latency: the same candidates as in the held-out error.
    latency = np.array([0.0, result.latency_s])
    found = []
    for data in _windows(problem, window_s):
        predicted = problem.predict(theta, latency, data).observed
        real = problem.measured(data.episode)
        both = np.full((2, *real.shape), np.nan)
        both[:, data.windows.samples()] = predicted
        episode = problem.episodes[data.episode]
        if episode.reported is not None:
            real = np.where(episode.reported[:, None], real, np.nan)
        found.append(
            Overlay(
                title=titles[data.episode],
                heldout=heldout,
                names=problem.channel_names,
                units=_units(problem),
                time_s=np.asarray(episode.sample * episode.step_s, dtype=np.float64),
                real=real,
                nominal=both[0],
                calibrated=both[1],
                window_s=data.windows.length * episode.period_s,
            )
        )
    return found


def _windows(problem: Problem, window_s: float) -> Iterator[WindowData]:
    """Yield the windows of each recording, as long as wanted or as it holds."""
    for index in range(len(problem.episodes)):
        alone = [np.full(len(e.sample), i == index) for i, e in enumerate(problem.episodes)]
        with contextlib.suppress(InsufficientDataError):
            yield from longest_windows(problem.part(alone), window_s)


def _units(problem: Problem) -> tuple[str, ...]:
    units = problem.robot.coordinate_units
    every = (*units, *(f"{unit}/s" for unit in units))
    return tuple(every[c] for c in problem.channels)


def _residuals(problem: Problem, result: CalibrationResult, titles: Sequence[str]) -> list[Residuals]:
    centre = Members(result.estimate[None], np.array([result.latency_s]))
    M = len(problem.channels)
    length = max(min(samples_in(problem, HELDOUT_WINDOW_S), WHITENED_SIZE // M), 2)
    found = []
    try:
        windows = problem.windows(length)
    except InsufficientDataError:
        return []
    for data in windows:
        whitened = _whitened(problem, centre, data)
        episode = problem.episodes[data.episode]
        time = np.asarray(episode.sample[data.windows.samples()] * episode.step_s, dtype=np.float64)
        found.append(
            Residuals(title=titles[data.episode], names=problem.channel_names, time_s=time, whitened=whitened)
        )
    return found


def _whitened(problem: Problem, centre: Members, data: WindowData) -> FloatArray:
    """Return the whitened residual of each window, (W, H, M); NaN where nothing was reported."""
    whitened = whitened_residual(problem, centre, centre, [data]).reshape(data.measured.shape)
    # A sample that nobody reported weighs nothing: its zero is no residual.
    return np.where(np.isfinite(data.std) & np.isfinite(whitened), whitened, np.nan)
