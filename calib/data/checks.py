"""Checks before any long work: are the recordings sufficient, and which parameters do they show?"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.parts import longest_windows, taken
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.window_data import WindowData
from deal_hw.data.checks.samples import SHORTEST_PART_S
from deal_hw.data.recording.excitation import FEWEST_CHANGES, LEAST_MOTION
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.sim.engine.batch import COMMAND_DELAY
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray


def check_delays(problem: Problem) -> None:
    """Check that command delays can be separated from the latency, which is searched as well.

    Raises:
        ConfigurationError: Every actuator's delay is searched, and the latency as well.
    """
    delays = [p for p in problem.space if p.kind == COMMAND_DELAY]
    moved = {element for p in delays for element in p.elements}
    if problem.fixed_latency_s is None and moved >= set(problem.robot.actuator_names):
        raise ConfigurationError(
            f"{', '.join(p.name for p in delays)}: the latency, which is searched as well, delays every "
            "command too, so the recordings show only their sum; leave the delay of one actuator out, mark "
            "one as `known`, or give the latency (--latency)"
        )


def check_excitation(problem: Problem) -> None:
    """Check that the recordings are long enough and that every joint moves.

    Where no command ever changes and the actuators are motors, the motion is that of the joints alone (a free
    swing). Then one moving joint is enough.

    Raises:
        InsufficientDataError: They are not; the message says what was found and what to record.
    """
    seconds = sum(float(np.sum(e.usable)) * e.period_s for e in problem.episodes)
    advice = "record again with `deal-hw collect --motion rich` (4 s; --excitation-level 1 to 3 is stronger)"
    if seconds < SHORTEST_PART_S:
        raise InsufficientDataError(
            f"{seconds:.2f} s of usable samples, at least {SHORTEST_PART_S:g} s are needed; {advice}"
        )
    names = problem.robot.description.joint_names
    joints = problem.robot.joints
    used = [e.position[e.usable][:, joints] for e in problem.episodes if e.usable.any()]
    spans = np.max([np.ptp(position, axis=0) for position in used], axis=0)
    noises = problem.noise_std[: problem.coordinates][joints]
    if problem.known_std is None and not problem.noise_free:
        # A joint that friction held shows few values of its encoder, and less noise than its sensor has, even
        # none. That is not enough to calibrate from.
        values = np.array([[len(np.unique(x)) for x in e.position[:, joints].T] for e in problem.episodes])
        sensor = np.asarray(problem.robot.description.sensor.position_std)
        coarse = np.max(values, axis=0) < LEAST_MOTION
        noises = np.where(coarse, np.maximum(noises, sensor), noises)
    least = LEAST_MOTION if problem.known_std is None else LEAST_CHOSEN_MOTION
    still = [
        f"{name} moved {span:.2g} (noise {noise:.2g})"
        for name, span, noise in zip(names, spans, noises, strict=True)
        if span < least * noise
    ]
    changes = target_changes(problem.episodes)
    passive = changes == 0 and problem.robot.description.actuation == "motor"
    if still and not (passive and len(still) < len(names)):
        raise InsufficientDataError(f"the recording hardly moves: {'; '.join(still)}; {advice}")
    if changes < FEWEST_CHANGES and not passive:
        raise InsufficientDataError(
            f"the position target changed {changes} times, at least {FEWEST_CHANGES} are needed; {advice}"
        )


def target_changes(episodes: Sequence[SampledEpisode]) -> int:
    """Return how often the commands change in recordings."""
    return sum(int(np.count_nonzero(np.any(np.diff(e.target, axis=0) != 0, axis=1))) for e in episodes)


LEAST_CHOSEN_MOTION = 5.0
"""The same where the residual scale was chosen. That scale includes model error and is far above the
sensor's noise."""

WINDOW_S = 0.5
"""Length of the windows [s]."""

MOST_WINDOWS = 12
"""Most windows to predict."""

NOTHING = 1e-9
"""Predictions that differ by fewer standard deviations of the noise are equal [-]."""

FAINT = 1.0
"""A range that changes predictions by fewer standard deviations is hardly visible [-]."""

NUDGE = 1e-6
"""Small parameter change that reveals jumps, in the parameter's own scale."""

PUSH = 1e-3
"""Larger change that measures the true slope."""

JUMP = 10.0
"""Ratio of the slopes under nudge and push above which a prediction jumps [-]."""

MANY = 0.2
"""Least share of windows that jump [-]. A contact that begins at another moment makes a few jump."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """Change of predictions from one end of a parameter's range to the other.

    Attributes:
        names: The K parameters.
        effect: Largest change of any sample, in standard deviations of the noise, (K,).
    """

    names: tuple[str, ...]
    effect: FloatArray

    @property
    def unseen(self) -> tuple[str, ...]:
        """Parameters with no effect."""
        return tuple(n for n, e in zip(self.names, self.effect, strict=True) if e < NOTHING)

    @property
    def faint(self) -> tuple[str, ...]:
        """Parameters whose whole range changes no sample by more than the noise."""
        return tuple(n for n, e in zip(self.names, self.effect, strict=True) if NOTHING <= e < FAINT)

    def without(self, names: Collection[str]) -> Sensitivity:
        """Return that of the other parameters."""
        kept = [k for k, name in enumerate(self.names) if name not in names]
        return Sensitivity(tuple(self.names[k] for k in kept), self.effect[kept])


def compute_sensitivity(problem: Problem) -> Sensitivity:
    """Compare rollouts at both ends of each parameter's range with the nominal one.

    Raises:
        InsufficientDataError: The recordings hold no window.
    """
    space = problem.space
    K = len(space)
    theta = np.repeat(space.nominal[None], 1 + 2 * K, axis=0)
    for k in range(K):
        theta[1 + 2 * k, k], theta[2 + 2 * k, k] = space.low[k], space.high[k]
    effect = np.zeros(K)
    for change, data in _changes(problem, theta):
        change = change / data.std
        # A member that diverges at the end of its range does have an effect.
        change = np.where(np.isfinite(change), change, np.where(data.reported, np.inf, 0.0))
        effect = np.maximum(effect, change.reshape(K, -1).max(axis=1))
    return Sensitivity(space.names, effect)


def jumps(problem: Problem) -> dict[str, float]:
    """Return the parameters whose smallest change makes predictions jump, and the size of the jump.

    Fits follow derivatives. Those of a simulator whose solver stops early are noise: the fit then splits two
    frictions at one joint arbitrarily.

    Raises:
        InsufficientDataError: The recordings hold no window.
    """
    space = problem.space
    K = len(space)
    value = space.to_scale(space.nominal)
    # Towards the middle of the range: a value at its end would be clipped.
    inwards = np.where(value > (space.to_scale(space.low) + space.to_scale(space.high)) / 2, -1.0, 1.0)
    values = np.repeat(value[None], 1 + 2 * K, axis=0)
    values[1 : 1 + K] += NUDGE * np.diag(inwards)
    values[1 + K :] += PUSH * np.diag(inwards)
    changes = []
    for change, data in _changes(problem, space.from_scale(values)):
        largest = np.where(data.reported, change, 0.0).max(axis=(2, 3))
        changes.append(np.nan_to_num(largest, nan=0.0, posinf=0.0))
    nudged, pushed = np.split(np.concatenate(changes, axis=1), 2)
    jumping = nudged > np.maximum(
        JUMP * NUDGE / PUSH * pushed,
        NOTHING * np.min(problem.noise_std[problem.channels]),
    )
    rough = np.mean(jumping, axis=1) > MANY
    return {name: float(nudged[k].max()) for k, name in enumerate(space.names) if rough[k]}


def require_sensitive(found: Sensitivity) -> None:
    """Refuse parameters without effect on any rollout.

    Raises:
        ConfigurationError: There are such parameters; the message names them.
    """
    if found.unseen:
        raise ConfigurationError(
            f"no rollout of these recordings depends on {', '.join(found.unseen)}: predictions are the same "
            "from one end of the range to the other. Remove them from the parameters (or give them with "
            "--known), or record a motion that shows them"
        )


def _changes(problem: Problem, theta: FloatArray) -> Iterator[tuple[FloatArray, WindowData]]:
    """Yield how predictions of members (N, K) differ from the first one's, (N - 1, W, H, M), and windows.

    There are about ``most_windows`` of them, evenly over all recordings.
    """
    latency, first = np.full(len(theta), problem.fixed_latency_s or 0.0), 0
    windows = longest_windows(problem, WINDOW_S)
    every = max(sum(len(data.windows) for data in windows) // MOST_WINDOWS, 1)
    for data in windows:
        rows = np.arange((-first) % every, len(data.windows), every)
        first += len(data.windows)
        if rows.size:
            part = taken(data, rows)
            predicted = problem.predict(theta, latency, part).observed
            yield np.abs(predicted[1:] - predicted[:1]), part
