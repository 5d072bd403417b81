"""Data of the report from robot, result and recordings: the only part of the report that simulates."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.innovations import Members, whitened_residual
from deal_hw.calib.data.parts import longest_windows, samples_in
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.window_data import MemberPrediction, WindowData
from deal_hw.calib.hypotheses.recording_zeros import fitted_zeros, with_other_zeros
from deal_hw.calib.validation.residual_place import quantities, size_over
from deal_hw.calibration import CalibrationResult
from deal_hw.errors import InsufficientDataError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.own_setups import OWN
from deal_hw.sim.recordings.parts import joined
from deal_hw.types import FloatArray, IntArray
from deal_hw.viz.robot_drawing import RobotDrawing, draw_robot

MOST_PANELS = 24
"""Most panels for each sort of recordings, one per channel."""

WHITENED_SIZE = 600
"""Most samples times channels of a whitened window: the size of its covariance."""

WHITENED_S = 0.2
"""Longest whitened window [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OverlayPanel:
    """One recording beside predictions that restart from the measured state.

    Attributes:
        title: The recording's file, with its part if several are shown.
        heldout: It was not used in the fit.
        names: The M measured channels.
        units: Unit of each channel, (M,).
        time_s: Time of each sample since the recording's first, (T,) [s].
        real: Measured values, (T, M).
        nominal: Predicted by the user's own model, (T, M); NaN where nothing was predicted.
        calibrated: Predicted by the calibrated model, likewise.
        window_s: Length of the predictions [s].
    """

    title: str
    heldout: bool
    names: tuple[str, ...]
    units: tuple[str, ...]
    time_s: FloatArray
    real: FloatArray
    nominal: FloatArray
    calibrated: FloatArray
    window_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Residuals:
    """Whitened prediction errors of the calibrated model: white and of unit variance where it is right.

    Attributes:
        title: The recording, as in :class:`OverlayPanel`.
        names: The M measured channels.
        time_s: Time at the end of each window's samples, (W, H) [s].
        whitened: Recording minus prediction, in standard deviations, (W, H, M); NaN where it diverged.
    """

    title: str
    names: tuple[str, ...]
    time_s: FloatArray
    whitened: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualOver:
    """Size of a channel's whitened residual in all fitted recordings, over a quantity of its joint.

    Attributes:
        channel: The channel.
        kind: The quantity, such as "speed".
        unit: Its unit.
        at: Middles of the parts of its range, (B,).
        size: Root mean square in each, (B,); NaN where there are too few samples.
    """

    channel: str
    kind: str
    unit: str
    at: FloatArray
    size: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportInputs:
    """Everything on the page.

    Attributes:
        robot: The robot's name.
        result: The calibration's result.
        overlays: Recordings beside predictions, held-out ones first.
        residuals: Whitened errors of the fitted recordings.
        spread: The same over the motion of each joint.
        drawing: The robot at a moment of a held-out recording.
        heldout: Names of the held-out recordings.
        heldout_s: Their total length [s].
        tick_s: Device period, the unit of the latency scan [s]; None where unknown.
        telemetry: Verdicts of the telemetry checks, in words.
        left_out: Omitted recordings, in words.
    """

    robot: str
    result: CalibrationResult
    overlays: tuple[OverlayPanel, ...] = ()
    residuals: tuple[Residuals, ...] = ()
    spread: tuple[ResidualOver, ...] = ()
    drawing: RobotDrawing | None = None
    heldout: tuple[str, ...] = ()
    heldout_s: float = 0.0
    tick_s: float | None = None
    telemetry: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def gather(
    robot: RobotModel,
    result: CalibrationResult,
    episodes: Sequence[SampledEpisode],
    holdout: Sequence[SampledEpisode] = (),
    *,
    telemetry: Sequence[str] = (),
    window_s: float = WHITENED_S,
    threads: int | None = None,
) -> ReportInputs:
    """Simulate the predictions of the report on the fitted recordings and on held-out ones.

    ``telemetry`` are verdicts of the telemetry checks, in words. Drawn predictions last ``window_s``, or less
    where no recording is as long.
    """
    overlays: list[OverlayPanel] = []
    residuals: list[Residuals] = []
    spread: list[ResidualOver] = []
    left_out: list[str] = []
    drawing = None
    # A recording that was cut into stretches is shown as one.
    fitted, held = joined(episodes), joined(holdout)
    theta = np.stack([result.space.nominal, result.estimate])
    # The same candidates as in the held-out error.
    latency_s = np.array([robot.latency_s, result.latency_s])
    parts = Counter(e.name for e in (*fitted, *held))
    for group, heldout in ((held, True), (fitted, False)):
        word = "held-out" if heldout else "fitted"
        if not group:
            continue
        shown = group[: max(min(MOST_PANELS // len(group[0].channels), len(group)), 1)]
        if len(group) > len(shown):
            left_out.append(f"{len(group) - len(shown)} more {word} recordings are not drawn")
        space = with_other_zeros(result.space, shown)
        problem = Problem(robot, space, shown, threads=threads, fixed_latency_s=result.latency_s)
        each = zip(theta, latency_s, strict=True)
        members = np.stack([fitted_zeros(problem, values, float(late)) for values, late in each])
        titles = [_title(e, f"{word} recording {i} of {len(group)}", parts) for i, e in enumerate(shown, 1)]
        for data in _windows(problem, window_s):
            predicted = problem.predict(members, latency_s, data)
            overlays.append(_overlay(problem, data, predicted, titles[data.episode], heldout))
            if heldout and drawing is None:
                drawing = _worst_moment(problem, data, predicted, titles[data.episode])
        if not heldout:
            residuals, spread = _residuals(problem, result, titles)
    return ReportInputs(
        robot=robot.description.name,
        result=result,
        overlays=tuple(overlays),
        residuals=tuple(residuals),
        spread=tuple(spread),
        drawing=drawing,
        heldout=tuple(dict.fromkeys(e.name for e in holdout)),
        heldout_s=float(sum(e.time_s[-1] - e.time_s[0] for e in holdout)),
        tick_s=max((e.step_s for e in episodes), default=None),
        telemetry=tuple(telemetry),
        left_out=tuple(left_out),
    )


def _title(episode: SampledEpisode, other: str, parts: Counter[str]) -> str:
    """Return a recording's title, with its part if several are shown."""
    if not episode.name:
        return other
    between = f", {episode.time_s[0]:.4g} to {episode.time_s[-1]:.4g} s"
    named = episode.setup and not episode.setup.startswith(OWN)
    setup = f", set-up {episode.setup}" if named else ""
    return episode.name + setup + (between if parts[episode.name] > 1 else "")


def _overlay(
    problem: Problem, data: WindowData, predicted: MemberPrediction, title: str, heldout: bool
) -> OverlayPanel:
    real = problem.measured(data.episode)
    both = np.full((2, *real.shape), np.nan)
    both[:, data.windows.samples()] = predicted.observed
    episode = problem.episodes[data.episode]
    if episode.reported is not None:
        real = np.where(episode.reported[:, None], real, np.nan)
    return OverlayPanel(
        title=title,
        heldout=heldout,
        names=problem.channel_names,
        units=problem.channel_units,
        time_s=episode.time_s,
        real=real,
        nominal=both[0],
        calibrated=both[1],
        window_s=data.windows.length * episode.period_s,
    )


def _worst_moment(
    problem: Problem, data: WindowData, predicted: MemberPrediction, title: str
) -> RobotDrawing | None:
    """Draw the robot at the end of the window after which the nominal model is furthest off."""
    episode, sample = problem.episodes[data.episode], data.windows.samples()[:, -1]
    columns = problem.channels[problem.channels < problem.coordinates]
    ends = predicted.position[:, :, -1]
    off = (ends[0] - episode.position[sample])[:, columns]
    far = np.linalg.norm(off / np.maximum(np.ptp(episode.position[:, columns], axis=0), 1e-12), axis=1)
    far = np.where(np.isfinite(ends).all(axis=(0, 2)), far, -1.0)
    worst = int(np.argmax(far))
    row = int(sample[worst])
    # An unmeasured coordinate, such as a base's place, is drawn at its estimate.
    states = np.tile(episode.position[row], (3, 1))
    states[1:, columns] = ends[:, worst, columns]
    return draw_robot(
        problem.robot,
        dict(zip(("real", "nominal", "calibrated"), states, strict=True)),
        episode.position,
        None if episode.reference is None else np.append(episode.reference, episode.reference[[row]], axis=0),
        f"{title} at {episode.time_s[row]:.4g} s, after {data.windows.length * episode.period_s:.3g} s of "
        "prediction: where the nominal model is furthest off",
    )


def _windows(problem: Problem, window_s: float) -> Iterator[WindowData]:
    """Yield the windows of each recording, as long as requested or as it holds."""
    for index in range(len(problem.episodes)):
        alone = [np.full(len(e.sample), i == index) for i, e in enumerate(problem.episodes)]
        with contextlib.suppress(InsufficientDataError):
            yield from longest_windows(problem.part(alone), window_s)


def _residuals(
    problem: Problem, result: CalibrationResult, titles: Sequence[str]
) -> tuple[list[Residuals], list[ResidualOver]]:
    centre = Members(result.estimate[None], np.array([result.latency_s]))
    M = len(problem.channels)
    faster = problem.period_s / min(e.period_s for e in problem.episodes)
    length = max(min(samples_in(problem, WHITENED_S), int(WHITENED_SIZE // M / faster)), 2)
    found = []
    try:
        windows = problem.windows(length)
    except InsufficientDataError:
        return [], []
    for data in windows:
        whitened = whitened_residual(problem, centre, centre, [data]).reshape(data.measured.shape)
        # A missing sample has weight zero: its zero is no residual.
        whitened = np.where(data.reported & np.isfinite(whitened), whitened, np.nan)
        episode = problem.episodes[data.episode]
        found.append(
            Residuals(
                title=titles[data.episode],
                names=problem.channel_names,
                time_s=episode.time_s[data.windows.samples()],
                whitened=whitened,
            )
        )
    at = [(data.episode, data.windows.samples().ravel()) for data in windows]
    power = np.concatenate([one.whitened.reshape(-1, M) ** 2 for one in found])
    return found, _spread(problem, result.latency_s, power, at)


def _spread(
    problem: Problem, latency_s: float, power: FloatArray, at: Sequence[tuple[int, IntArray]]
) -> list[ResidualOver]:
    """Return the size of the residual, (n, M), over the motion of the joints; ``at`` has its samples."""
    found, of = list[ResidualOver](), quantities(problem, latency_s)
    for m, channel in enumerate(problem.channel_names):
        for one in of:
            if one.of != channel or one.kind == "time":
                continue
            middle, size = size_over(power[:, m], one.at(at))
            if np.isfinite(size).sum() > 1:
                found.append(
                    ResidualOver(channel=channel, kind=one.kind, unit=one.unit, at=middle, size=size)
                )
    return found
