"""A recording on the device's own time grid, ready for the simulator."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.types import FloatArray, IntArray, Status, Trajectory

SENT = ("target", "stiffness", "damping", "effort_limit", "speed_limit")
"""Arrays of an episode with one row per period."""

SAMPLED = {
    "sample": 1,
    "position": 2,
    "velocity": 2,
    "effort": 2,
    "usable": 1,
    "reported": 1,
    "reference": 2,
    "estimate_std": 2,
}
"""Number of axes of an episode's values per sample; values for all samples have fewer."""


@dataclass(frozen=True, slots=True)
class SampledEpisode:
    """T samples and the commands in force, on a grid of S device periods.

    Attributes:
        step_s: Device period [s].
        sample: Grid index of each sample, (T,).
        position: Reported positions, tangent coordinates (T, C): the six of a floating base, if any, then the
            joints. Unmeasured coordinates hold an estimate.
        velocity: Reported velocities, (T, C), likewise.
        target: Position target in each period, before any latency, (S, A).
        stiffness: Sent stiffness in each period, (S, A).
        damping: (S, A).
        effort_limit: (S, A).
        speed_limit: (S, A).
        usable: Samples between which the simulator may predict: armed, no watchdog, no gap to the next, (T,).
        start_setpoint: The set-point at the first period, (A,).
        first_row: Index in the recording of the first sample here.
        origin: Device period 0 of the grid, counted from the recording's first sample.
        reported: Samples that the robot reported; the others are interpolated, (T,). None: all.
        reference: Reference orientation of each sample, (T, 4); None for a fixed base.
        measured: Which entries of (position, velocity) were measured and count as observations, (2 C,). None:
            the positions.
        estimate_std: Standard deviation of the unmeasured entries, (2 C,) or, sample by sample, (T, 2 C);
            None if all positions were measured.
        noise_free: Whether the whole state is reported without any error, as only a simulated target does.
        name: Name of its source for messages, mostly a file's.
        effort: Recorded efforts of the joints, (T, J); NaN where there is none. None: no joint has any.
        setup: Name of the robot's set-up, such as one with a payload; "" for the model itself.
    """

    step_s: float
    sample: IntArray
    position: FloatArray
    velocity: FloatArray
    target: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    effort_limit: FloatArray
    speed_limit: FloatArray
    usable: npt.NDArray[np.bool_]
    start_setpoint: FloatArray
    first_row: int = 0
    origin: int = 0
    reported: npt.NDArray[np.bool_] | None = None
    reference: FloatArray | None = None
    measured: npt.NDArray[np.bool_] | None = None
    estimate_std: FloatArray | None = None
    noise_free: bool = False
    name: str = ""
    setup: str = ""
    effort: FloatArray | None = None

    @property
    def channels(self) -> IntArray:
        """Indices into (position, velocity), 2 C, of the M channels that are compared with predictions."""
        C = self.position.shape[1]
        return np.arange(C) if self.measured is None else np.flatnonzero(self.measured)

    @property
    def steps(self) -> int:
        """Periods S on the grid."""
        return int(self.target.shape[0])

    @property
    def stride(self) -> int:
        """Device periods from one sample to the next, without lost ones."""
        return int(np.median(np.diff(self.sample)))

    @property
    def period_s(self) -> float:
        """Time from one sample to the next [s]."""
        return self.stride * self.step_s

    @property
    def time_s(self) -> FloatArray:
        """Time of each sample since the recording's first one, (T,) [s]."""
        return np.asarray((self.origin + self.sample) * self.step_s, dtype=np.float64)

    def cut(self, rows: slice, periods: slice) -> SampledEpisode:
        """Return the episode with these samples and periods only; indices and the start stay."""
        samples = {n: v[rows] for n, axes in SAMPLED.items() if np.ndim(v := getattr(self, n)) == axes}
        sent = {name: getattr(self, name)[periods] for name in SENT}
        return dataclasses.replace(self, **samples, **sent)


def align(trajectory: Trajectory, description: RobotDescription, name: str = "") -> SampledEpisode:
    """Put a recording on the device's time grid.

    A state sample reports the command in force and its age. So the reception of each command is known on the
    device's clock to the microsecond, whatever the delays on the wire. A command acts from the first period
    that starts at or after its reception.

    Args:
        trajectory: The recording.
        description: The robot.
        name: Name of the recording.

    Returns:
        The episode, from the first armed sample with a command in force to the last armed one.

    Raises:
        InsufficientDataError: There is no such sample.
    """
    step_s = 1.0 / description.device_rate_hz
    armed = (trajectory.status & int(Status.ARMED)) != 0
    known = armed & (trajectory.command_sequence >= 0)
    known &= np.isin(trajectory.command_sequence, trajectory.sent_sequence)
    if known.sum() < 2:
        raise InsufficientDataError(
            "the recording has no armed samples with a command in force; record again with `deal-hw collect`"
        )
    rows = np.arange(int(np.argmax(known)), len(known) - int(np.argmax(known[::-1])))
    device = np.round(trajectory.device_s / step_s).astype(np.int64)
    sequence, age = trajectory.command_sequence[rows], trajectory.command_age_s[rows]
    # A command acts from the next period boundary on; the small term keeps a reception exactly on a boundary
    # there.
    acts = np.ceil((trajectory.device_s[rows] - np.nan_to_num(age)) / step_s - 1e-3).astype(np.int64)
    # The set-point starts to move with the first command, before the first sample that reports it.
    origin = min(int(acts[0]), int(device[rows[0]]))
    sample = device[rows] - origin
    steps = int(sample[-1])

    begins = _begins(trajectory, rows, np.where(known[rows], sequence, -1), acts, step_s)
    in_force = np.zeros(max(steps, 1), dtype=np.int64)
    for index, begin in begins:
        in_force[max(begin - origin, 0) :] = index
    gap = np.diff(sample, append=sample[-1])
    usable = armed[rows] & known[rows] & ((trajectory.status[rows] & int(Status.WATCHDOG)) == 0)
    usable &= gap <= 2 * round(description.device_rate_hz / description.state_rate_hz)
    usable &= np.isfinite(trajectory.position[rows]).all(axis=1)
    effort = trajectory.effort[rows]
    return SampledEpisode(
        step_s=step_s,
        sample=sample,
        effort=effort if np.isfinite(effort).any() else None,
        position=trajectory.position[rows],
        velocity=trajectory.velocity[rows],
        target=trajectory.position_target[in_force],
        stiffness=trajectory.stiffness[in_force],
        damping=trajectory.damping[in_force],
        effort_limit=trajectory.effort_limit[in_force],
        speed_limit=trajectory.speed_limit[in_force],
        usable=usable,
        start_setpoint=description.held(_armed_at(trajectory, armed, int(rows[0]))),
        first_row=int(rows[0]),
        origin=origin - int(device[0]),
        name=name,
    )


def _armed_at(trajectory: Trajectory, armed: npt.NDArray[np.bool_], first: int) -> FloatArray:
    """Return the position at which a servo's set-point began, (J,): that of its arming.

    By the first sample that reports a command the robot has moved some micrometres. A slewing set-point would
    carry that as a constant error until it arrives.
    """
    row = first
    while row > 0 and armed[row - 1] and trajectory.command_sequence[row - 1] < 0:
        row -= 1
    found = trajectory.position[row]
    return np.asarray(np.where(np.isfinite(found), found, trajectory.position[first]))


def fill_gaps(episode: SampledEpisode, longest_s: float = 0.05) -> SampledEpisode:
    """Return the episode with samples at regular times; lost ones are interpolated over short gaps.

    Interpolated samples are marked in ``reported``, and nothing is fitted to them. Without them a single lost
    frame would end every window around it. Start states are smoothed over them, so short gaps get a cubic
    spline: three samples on straight lines moved an estimate of a real arm by an eighth of its interval, on a
    spline by a third of that. Longer gaps get straight lines, which cannot overshoot.

    Args:
        episode: The episode.
        longest_s: Longest gap that is bridged [s].
    """
    stride = episode.stride
    if not np.any(np.diff(episode.sample) > stride):
        return episode
    regular = np.arange(episode.sample[0], episode.sample[-1] + 1, stride)
    after = np.clip(np.searchsorted(episode.sample, regular), 0, len(episode.sample) - 1)
    reported = episode.sample[after] == regular
    before = np.where(reported, after, after - 1)
    bridged = (episode.sample[after] - episode.sample[before]) * episode.step_s <= longest_s
    both = np.isfinite(episode.position).all(axis=1)

    def line(values: FloatArray) -> FloatArray:
        straight = np.stack([np.interp(regular, episode.sample, column) for column in values.T], axis=1)
        sound = np.isfinite(values).all(axis=1)
        if np.count_nonzero(sound) < 2:
            return straight
        curved = CubicSpline(episode.sample[sound], values[sound])(regular)
        return np.where(bridged[:, None], curved, straight)

    def whole(std: FloatArray) -> FloatArray:
        return np.broadcast_to(std, (len(episode.sample), 2 * episode.position.shape[1]))

    effort = episode.effort
    # A sample before a gap was marked as unusable only for that; now it counts whether the gap is bridged.
    sound = both & ((episode.usable) | (np.diff(episode.sample, append=episode.sample[-1]) > stride))
    return dataclasses.replace(
        episode,
        sample=regular,
        position=np.where(reported[:, None], episode.position[after], line(episode.position)),
        velocity=np.where(reported[:, None], episode.velocity[after], line(episode.velocity)),
        effort=None if effort is None else np.where(reported[:, None], effort[after], np.nan),
        usable=sound[before] & sound[after] & bridged,
        reported=reported,
        reference=None if episode.reference is None else episode.reference[after],
        estimate_std=None if episode.estimate_std is None else whole(episode.estimate_std)[after],
    )


def thin(episode: SampledEpisode, rate_hz: float) -> SampledEpisode:
    """Return the episode with about ``rate_hz`` samples per second; sent values stay.

    States come faster than the motion changes: beyond some samples per control period, more samples cost time
    and add little information. Every n-th one is kept on the device's grid, so that lost ones shift nothing.

    Args:
        episode: The episode.
        rate_hz: Samples per second to keep; the next possible rate above is taken.

    Raises:
        ConfigurationError: The rate is not above 0.
    """
    if not rate_hz > 0:
        raise ConfigurationError(f"a rate of samples is above 0 Hz, got {rate_hz:g}")
    every = int((1.0 / rate_hz) / episode.period_s + 1e-6)
    if every <= 1:
        return episode
    whole = fill_gaps(episode)
    kept = np.flatnonzero((whole.sample - whole.sample[0]) % (every * episode.stride) == 0)
    std = whole.estimate_std
    return dataclasses.replace(
        whole,
        sample=whole.sample[kept],
        position=whole.position[kept],
        velocity=whole.velocity[kept],
        effort=None if whole.effort is None else whole.effort[kept],
        usable=np.minimum.reduceat(whole.usable, kept),
        reported=None if whole.reported is None else whole.reported[kept],
        reference=None if whole.reference is None else whole.reference[kept],
        estimate_std=std[kept] if std is not None and std.ndim == 2 else std,
    )


def _begins(
    trajectory: Trajectory, rows: IntArray, sequence: IntArray, acts: IntArray, step_s: float
) -> list[tuple[int, int]]:
    """Return which command acts from which device period on, in order.

    A command that no sample reports was lost, unless no sample came while it would have been reported. Then
    it is placed by the clocks' offset, which follows from the reported commands.

    Args:
        trajectory: The recording.
        rows: The samples that count, (T,).
        sequence: Command in force at each, (T,); -1 where unknown.
        acts: Device period from which that command acts, (T,).
        step_s: Device period [s].

    Returns:
        Index among the commands sent, and device period.
    """
    order = {int(s): i for i, s in enumerate(trajectory.sent_sequence)}
    numbers, first = np.unique(sequence, return_index=True)
    seen = {order[int(n)]: int(acts[at]) for n, at in zip(numbers, first, strict=True) if n >= 0}
    offset = float(np.median([period * step_s - trajectory.sent_s[i] for i, period in seen.items()]))
    sampled = np.round(trajectory.device_s[rows] / step_s)
    begins = dict(seen)
    indices = sorted(seen)
    for before, after in itertools.pairwise(indices):
        for i in range(before + 1, after):
            begin = round((trajectory.sent_s[i] + offset) / step_s)
            until = begins[after] if i + 1 == after else round((trajectory.sent_s[i + 1] + offset) / step_s)
            if seen[before] < begin and not np.any((sampled >= begin) & (sampled < until)):
                begins[i] = begin
    return sorted(begins.items())
