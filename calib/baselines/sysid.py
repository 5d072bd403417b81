"""`mujoco-sysid`: DeepMind's ``mujoco.sysid`` as an outside reference, on the same windows as every method.

Its user knows windows, smoothed start states and ranges. The controls are delayed by the latency of the
problem or the settings, by none without one. Or the latency is one more parameter of its least squares
(:func:`with_delay`). It starts at the nominal model, and the intervals are its own.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.baselines.least_squares import FittedStart, OneShotSearch, textbook_covariance
from deal_hw.calib.data.innovations import cut
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.search import SearchLog
from deal_hw.errors import ConfigurationError
from deal_hw.sim.recordings.sysid_adapter import SysidRecording, check_space, identify, require_sysid

TICKS = 10
"""Window length in control periods."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SysidSettings:
    """Settings of `mujoco-sysid`.

    Attributes:
        window_s: Window length in seconds instead [s].
        latency_s: A latency found by other means, such as our scan [s]; None for the problem's if given, and
            otherwise zero.
        delay: If no latency is given, search it within the problem's range as one more parameter.
    """

    window_s: float | None = None
    latency_s: float | None = None
    delay: bool = False


@dataclass(frozen=True)
class MujocoSysid(OneShotSearch):
    """``mujoco.sysid`` with its default optimiser; nothing is drawn."""

    name = "mujoco-sysid"
    settings: SysidSettings = field(default_factory=SysidSettings)

    def solve(self, log: SearchLog, rng: np.random.Generator) -> FittedStart:
        """See :meth:`OneShotSearch.solve`.

        Raises:
            ConfigurationError: A parameter has no counterpart, or joint positions were not measured.
            MissingExtraError: ``mujoco.sysid`` is not installed.
        """
        problem, settings = log.problem, self.settings
        require_sysid()
        check_space(problem.space)
        _check_channels(problem)
        given = settings.latency_s if problem.fixed_latency_s is None else problem.fixed_latency_s
        if settings.delay and given is None:
            return _solve(log, settings, problem.first_latency_s, "its own")
        source = "given" if given is not None else "none, as its user would have it"
        latency_s = log.coordinates.clip_latency(given or 0.0)
        words = f"its own, {1e3 * latency_s:g} ms of latency ({source})"
        return _solve(log, dataclasses.replace(settings, delay=False), latency_s, words)


def with_delay(window_s: float) -> MujocoSysid:
    """Return `mujoco-sysid` tuned for delayed commands: windows of ``window_s`` and a searched latency."""
    return MujocoSysid(SysidSettings(window_s=window_s, delay=True))


def _check_channels(problem: Problem) -> None:
    joints = range(problem.coordinates)[problem.robot.joints]
    missing = [problem.robot.coordinates[j] for j in joints if j not in problem.channels]
    if missing:
        raise ConfigurationError(
            f"mujoco-sysid fits joint positions, and those of {', '.join(missing)} were not measured; choose "
            "another method"
        )


def _solve(log: SearchLog, settings: SysidSettings, latency_s: float, source: str) -> FittedStart:
    problem, ticks = log.problem, TICKS
    if settings.window_s is not None:
        ticks = max(round(settings.window_s * problem.robot.description.control_rate_hz), 1)
    recordings = [
        SysidRecording(problem.episodes[d.episode], d.windows, d.start_position, d.start_velocity)
        for d in cut(problem, ticks)
    ]
    space = problem.space
    found = identify(
        problem.robot,
        space,
        recordings,
        latency_s=latency_s,
        latency_range_s=problem.latency_range_s if settings.delay else None,
        iterations=log.budget.generations,
        threads=problem.threads,
    )
    # From derivatives by the value to those by its logarithm on a log scale.
    chain = np.where(space.log_scale, found.theta, 1.0)
    interval = np.stack([found.theta - found.half_width, found.theta + found.half_width], axis=1)
    return FittedStart(
        theta=found.theta,
        covariance=textbook_covariance(space, found.jacobian * chain, found.residual),
        latency_s=found.latency_s,
        iterations=found.iterations,
        message=found.message,
        source=source,
        steps=found.steps,
        interval=np.clip(interval, space.low[:, None], space.high[:, None]),
    )
