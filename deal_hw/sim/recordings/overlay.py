"""Simulation beside a recording: predictions that restart from the measured state every window.

A replay of a whole recording shows little: with an unstable robot it leaves the recording within a second,
for any model. Over a window of a fraction of a second the error is the model's. The overlay is
for viewing, so nothing is fitted: each window starts from measured positions, smoothed over a few samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align
from deal_hw.sim.recordings.standing import tangent_base, with_sensed_base
from deal_hw.sim.recordings.windows import Windows, cut_windows, predict_windows, setpoints
from deal_hw.types import FloatArray, IntArray, Trajectory

DEFAULT_WINDOW_S = 0.2
DEFAULT_SMOOTHING_S = 0.04
"""With 0.03 s to 0.06 s the true parameters of simulated noisy cart-poles predict best."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Prediction of W windows of H samples by one parameter set.

    Attributes:
        theta: The parameters, (K,).
        latency_s: Total latency [s].
        position: Positions at each window's start and its H samples, (W, H + 1, J); NaN where the simulation
            diverged.
        velocity: Velocities, as the robot would report them, (W, H + 1, J).
        window_rmse: Root mean square position error of each window, (W, J).
        position_nrmse: Root mean square position error over the range of the signal, (J,).
        velocity_nrmse: The same of velocities, (J,).
        base: Poses of a floating base, position and quaternion wxyz, (W, H + 1, 7); None for a fixed one.
    """

    theta: FloatArray
    latency_s: float
    position: FloatArray
    velocity: FloatArray
    window_rmse: FloatArray
    position_nrmse: FloatArray
    velocity_nrmse: FloatArray
    base: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """Predictions of several parameter sets over one recording.

    Attributes:
        joint_names: The J joints.
        sample: Index into the recording of each point, (W, H + 1); a window's last is often the next one's
            first.
        device_s: Device time of each point, (W, H + 1) [s].
        receive_s: Host time of each point, (W, H + 1) [s].
        position: Measured positions, (W, H + 1, J).
        velocity: Measured velocities, (W, H + 1, J).
        window_s: Length of a window [s].
        predictions: By name of the parameter set.
    """

    joint_names: tuple[str, ...]
    sample: IntArray
    device_s: FloatArray
    receive_s: FloatArray
    position: FloatArray
    velocity: FloatArray
    window_s: float
    predictions: Mapping[str, Prediction]

    def position_error(self, name: str) -> FloatArray:
        """Return predicted minus measured positions, (W, H + 1, J)."""
        return self.predictions[name].position - self.position

    def velocity_error(self, name: str) -> FloatArray:
        """Return predicted minus measured velocities, (W, H + 1, J)."""
        return self.predictions[name].velocity - self.velocity

    def worst_moment_s(self, name: str) -> float:
        """Return the device time of a set's largest position error [s], joints weighted by their range."""
        spread = np.ptp(self.position.reshape(-1, self.position.shape[2]), axis=0)
        share = np.abs(self.position_error(name)[:, 1:]) / np.where(spread > 0, spread, np.inf)
        far = np.nan_to_num(share).sum(axis=2)
        return float(self.device_s[:, 1:].flat[int(np.argmax(far))])

    @staticmethod
    def broken(values: FloatArray) -> FloatArray:
        """Join windows, (W, H + 1, J), to one trace with a NaN row after each, (W * (H + 2), J)."""
        gaps = np.full_like(values[:, :1], np.nan)
        return np.concatenate([values, gaps], axis=1).reshape(-1, values.shape[2])

    @staticmethod
    def broken_time(time_s: FloatArray) -> FloatArray:
        """Return the times of :meth:`broken`, (W * (H + 2),); breaks are at windows' ends."""
        return np.concatenate([time_s, time_s[:, -1:]], axis=1).ravel()


def compute_overlay(
    trajectory: Trajectory,
    description: RobotDescription,
    space: ParameterSpace,
    sets: Mapping[str, FloatArray],
    *,
    latency_s: float = 0.0,
    window_s: float = DEFAULT_WINDOW_S,
    smoothing_s: float = DEFAULT_SMOOTHING_S,
) -> Overlay:
    """Predict a recording with several parameter sets.

    Args:
        trajectory: The recording.
        description: The robot.
        space: The parameters that the sets differ in.
        sets: Physical values (K,) by name, such as ``"nominal"`` and ``"calibrated"``.
        latency_s: Total latency (actuation plus sensing), the same for all sets [s].
        window_s: Length of a window [s].
        smoothing_s: Half width of the fit around each start [s]; 0 takes the reported state as it is.

    Raises:
        ConfigurationError: A window shorter than a sample, a negative time, or values that do not fit the
            space.
        InsufficientDataError: Nowhere are there enough armed samples in a row.
    """
    length = _window_samples(window_s, description)
    _check(space, sets, latency_s, smoothing_s)
    robot = load_model(description)
    episode = align(trajectory, description)
    if robot.base is not None:
        if trajectory.body is None or not description.feet:
            raise InsufficientDataError(
                "the recording lacks the floating base; predictions need its IMU, and names of feet in the "
                "robot's description"
            )
        episode = with_sensed_base(episode, robot, trajectory, robot.description.feet)
    windows = cut_windows(episode, length)
    row = episode.first_row + np.concatenate([windows.start[:, None], windows.samples()], axis=1)
    smooth = _smoothed_starts(trajectory, row[:, 0], smoothing_s)
    velocity_window_s = reported_velocity_window(trajectory, description)

    batch = ServoBatch(robot, space, len(sets), threads=1)
    batch.set_parameters(np.array([np.asarray(theta, dtype=float) for theta in sets.values()]))
    path = setpoints(batch, episode, np.full(len(sets), latency_s))
    # The base of a floating robot starts at the episode's estimate.
    start_x, start_v = episode.position[windows.start].copy(), episode.velocity[windows.start].copy()
    start_x[:, robot.joints], start_v[:, robot.joints] = smooth[:, 0], smooth[:, 1]
    x, v = predict_windows(batch, episode, windows, start_x, start_v, path)
    measured = trajectory.position[row], trajectory.velocity[row]
    predictions = {}
    for n, (name, theta) in enumerate(sets.items()):
        position = np.concatenate([smooth[:, :1], x[n][..., robot.joints]], axis=1)
        velocity = np.concatenate([smooth[:, 1:2], v[n][..., robot.joints]], axis=1)
        if velocity_window_s:
            velocity = _as_reported(position, smooth, windows, episode.step_s, velocity_window_s)
        error = position - measured[0]
        predictions[name] = Prediction(
            theta=np.array(theta, dtype=float),
            latency_s=latency_s,
            position=position,
            velocity=velocity,
            window_rmse=np.sqrt(np.mean(np.square(error[:, 1:]), axis=1)),
            position_nrmse=_nrmse(error, measured[0]),
            velocity_nrmse=_nrmse(velocity - measured[1], measured[1]),
            base=_base(episode, windows, start_x, x[n]),
        )
    return Overlay(
        joint_names=trajectory.joint_names,
        sample=row,
        device_s=trajectory.device_s[row],
        receive_s=trajectory.receive_s[row],
        position=measured[0],
        velocity=measured[1],
        window_s=length * windows.stride * episode.step_s,
        predictions=predictions,
    )


def _base(episode: SampledEpisode, windows: Windows, start: FloatArray, x: FloatArray) -> FloatArray | None:
    """Return the base's poses at the points of windows, (W, H + 1, 7); None for a fixed base."""
    if episode.reference is None:
        return None
    points = np.concatenate([windows.start[:, None], windows.samples()], axis=1)
    return tangent_base(np.concatenate([start[:, None], x], axis=1), episode.reference[points])


def reported_velocity_window(trajectory: Trajectory, description: RobotDescription) -> float:
    """Return the time over which the robot differences positions to report velocities [s]; 0 if it does not.

    Such velocities are late by half that time, so predictions to compare must be computed alike.
    """
    window_s = description.sensor.velocity_window_s
    lag = round(window_s * description.state_rate_hz)
    if lag < 1 or len(trajectory.device_s) <= lag:
        return 0.0
    span = trajectory.device_s[lag:] - trajectory.device_s[:-lag]
    whole = np.abs(span - window_s) < 0.5 / description.device_rate_hz
    if not whole.any():
        return 0.0
    quotient = (trajectory.position[lag:] - trajectory.position[:-lag])[whole] / window_s
    off = np.median(np.abs(quotient - trajectory.velocity[lag:][whole]), axis=0)
    # Positions and velocities are each rounded to the wire's resolution: a few micrometres over the window.
    return window_s if np.all(off * window_s <= 5e-6) else 0.0


def _window_samples(window_s: float, description: RobotDescription) -> int:
    length = round(window_s * description.state_rate_hz) if np.isfinite(window_s) else 0
    if length < 1:
        least = 1.0 / description.state_rate_hz
        raise ConfigurationError(f"the window must be at least one sample, {least:g} s, got {window_s:g} s")
    return length


def _check(
    space: ParameterSpace, sets: Mapping[str, FloatArray], latency_s: float, smoothing_s: float
) -> None:
    if not sets:
        raise ConfigurationError(
            "an overlay needs at least one parameter set, such as {'nominal': space.nominal}"
        )
    for name, theta in sets.items():
        if np.shape(theta) != (len(space),):
            raise ConfigurationError(
                f"parameter set {name!r} has shape {np.shape(theta)}; the space has {len(space)} free "
                "parameters"
            )
    for what, value in (("latency", latency_s), ("smoothing time", smoothing_s)):
        if not (np.isfinite(value) and value >= 0):
            raise ConfigurationError(f"the {what} must be 0 s or more, got {value:g} s")


def _smoothed_starts(trajectory: Trajectory, rows: IntArray, half_width_s: float) -> FloatArray:
    """Return position, velocity, acceleration at each row, (W, 3, J): a parabola over +-half_width_s."""
    out = np.zeros((len(rows), 3, len(trajectory.joint_names)))
    for w, row in enumerate(rows):
        out[w, 0], out[w, 1] = trajectory.position[row], trajectory.velocity[row]
        now = trajectory.device_s[row]
        low, high = np.searchsorted(
            trajectory.device_s, (now - half_width_s - 1e-9, now + half_width_s + 1e-9)
        )
        near = low + np.flatnonzero(np.isfinite(trajectory.position[low:high]).all(axis=1))
        # With four points a parabola has one degree of freedom for smoothing.
        if half_width_s > 0 and len(near) >= 4:
            t = trajectory.device_s[near] - now
            out[w] = np.linalg.lstsq(
                np.stack([np.ones_like(t), t, t**2 / 2], axis=1), trajectory.position[near], rcond=None
            )[0]
    return out


def _as_reported(
    position: FloatArray, start: FloatArray, windows: Windows, step_s: float, velocity_window_s: float
) -> FloatArray:
    """Return velocities as differences of positions, (W, H + 1, J); before a start, those of a parabola."""
    sample_s = windows.stride * step_s
    lag = max(round(velocity_window_s / sample_s), 1)
    before = -sample_s * np.arange(lag, 0, -1)[:, None]
    past = start[:, :1] + start[:, 1:2] * before + start[:, 2:] * before**2 / 2
    whole = np.concatenate([past, position], axis=1)
    return np.asarray((whole[:, lag:] - whole[:, :-lag]) / (lag * sample_s))


def _nrmse(error: FloatArray, measured: FloatArray) -> FloatArray:
    # The first point of a window is its start state, not a prediction.
    rmse = np.sqrt(np.mean(np.square(error[:, 1:]), axis=(0, 1)))
    spread = np.ptp(measured.reshape(-1, measured.shape[-1]), axis=0)
    return np.asarray(np.divide(rmse, spread, out=np.full_like(rmse, np.nan), where=spread > 0))
