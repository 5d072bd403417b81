"""A calibration problem: recordings on the device's time grid, a batched simulator, and what is searched.

Every method sees the data through this class, so that all of them use the same simulator, the same start
states and the same count of simulated steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import savgol_coeffs

from deal_hw.calib.noise import NoiseModel, noise_model, white_noise_std
from deal_hw.errors import InsufficientDataError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.batch import ServoBatch
from deal_hw.sim.episode import Episode, fill_gaps
from deal_hw.sim.model import RobotModel
from deal_hw.sim.windows import Windows, cut_windows, predict_windows, setpoints
from deal_hw.types import FloatArray

WIRE_RESOLUTION = 1e-6
"""Positions travel as whole micrometres and microradians."""

LATENCY_RANGE_S = (0.0, 0.04)


@dataclass(frozen=True, slots=True)
class StartStates:
    """Smoothed states at every sample of an episode, with their uncertainty.

    Attributes:
        position: (T, J).
        velocity: (T, J).
        position_std: Standard deviation of a smoothed position, (J,).
        velocity_std: Standard deviation of a smoothed velocity, (J,).
    """

    position: FloatArray
    velocity: FloatArray
    position_std: FloatArray
    velocity_std: FloatArray


@dataclass(frozen=True, slots=True)
class WindowData:
    """Windows of one episode with their measured samples.

    Attributes:
        episode: Index of the episode.
        windows: W windows of H samples.
        measured: Reported positions at the predicted samples, (W, H, J).
        start_position: Smoothed positions at the starts, (W, J).
        start_velocity: Smoothed velocities at the starts, (W, J).
        reported_start: Reported positions at the starts, (W, J).
        std: Standard deviation of the measured positions, (W, H, J); infinite where none was reported.
        start_std: Standard deviation of the reported start positions, (W, J).
    """

    episode: int
    windows: Windows
    measured: FloatArray
    start_position: FloatArray
    start_velocity: FloatArray
    reported_start: FloatArray
    std: FloatArray
    start_std: FloatArray


@dataclass(slots=True)
class Problem:
    """Recordings, simulator and parameters.

    Attributes:
        robot: The nominal model.
        space: What is searched.
        episodes: The recordings to fit; short gaps are filled in and not fitted to.
        threads: Simulation threads; None for all CPUs.
        latency_range_s: Total latencies that are searched [s].
        fixed_latency_s: A latency that is given; None to search it.
        noise_std: Noise of positions over all speeds, (J,).
        noise: Noise at rest and jitter of the samples' time.
        starts: Smoothed states of each episode.
    """

    robot: RobotModel
    space: ParameterSpace
    episodes: Sequence[Episode]
    threads: int | None = None
    latency_range_s: tuple[float, float] = LATENCY_RANGE_S
    fixed_latency_s: float | None = None
    noise_std: FloatArray = field(init=False)
    noise: NoiseModel = field(init=False)
    starts: list[StartStates] = field(init=False)
    _batches: dict[int, ServoBatch] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        if not self.episodes:
            raise InsufficientDataError("no recording was given; record one with `deal-hw collect`")
        self.episodes = [fill_gaps(e) for e in self.episodes]
        floor = WIRE_RESOLUTION / np.sqrt(12.0)
        self.noise_std = np.max([white_noise_std(e.position, floor) for e in self.episodes], axis=0)
        self.starts = [smooth_states(e, self.noise_std) for e in self.episodes]
        positions, velocities = [e.position for e in self.episodes], [s.velocity for s in self.starts]
        self.noise = noise_model(positions, velocities, float(floor))

    @property
    def steps(self) -> int:
        """Physics steps simulated so far."""
        return sum(batch.steps for batch in self._batches.values())

    @property
    def joints(self) -> int:
        """Joints J."""
        return int(self.episodes[0].position.shape[1])

    def batch(self, count: int) -> ServoBatch:
        """Return the simulator of ``count`` members; made once for each count."""
        if count not in self._batches:
            self._batches[count] = ServoBatch(self.robot, self.space, count, self.threads)
        return self._batches[count]

    def windows(self, length: int, hop: int | None = None, offset: int = 0) -> list[WindowData]:
        """Cut all episodes into windows of ``length`` samples.

        Args:
            length: Samples predicted in each window, H.
            hop: Samples from start to start; H by default.
            offset: First sample that may start a window.

        Raises:
            InsufficientDataError: No episode holds a window.
        """
        found: list[WindowData] = []
        problem = ""
        for index, episode in enumerate(self.episodes):
            try:
                windows = cut_windows(episode, length, hop, offset)
            except InsufficientDataError as err:
                problem = str(err)
                continue
            starts = self.starts[index]
            std = self.noise.std(starts.velocity)
            if episode.reported is not None:
                std = np.where(episode.reported[:, None], std, np.inf)
            found.append(
                WindowData(
                    episode=index,
                    windows=windows,
                    measured=episode.position[windows.samples()],
                    start_position=starts.position[windows.start],
                    start_velocity=starts.velocity[windows.start],
                    reported_start=episode.position[windows.start],
                    std=std[windows.samples()],
                    start_std=std[windows.start],
                )
            )
        if not found:
            raise InsufficientDataError(problem)
        return found

    def predict(
        self,
        theta: FloatArray,
        latency_s: FloatArray,
        data: WindowData,
        position: FloatArray | None = None,
        velocity: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Predict windows with N parameter vectors.

        Args:
            theta: Physical values, (N, K).
            latency_s: Total latency of each member, (N,) [s].
            data: The windows.
            position: Start positions, (W, J) or (N, W, J); the smoothed ones by default.
            velocity: Start velocities, likewise.

        Returns:
            Positions and velocities, (N, W, H, J) each; NaN where a member diverged.
        """
        batch = self.batch(len(theta))
        batch.set_parameters(theta)
        episode = self.episodes[data.episode]
        path = setpoints(batch, episode, latency_s)
        return predict_windows(
            batch,
            episode,
            data.windows,
            data.start_position if position is None else position,
            data.start_velocity if velocity is None else velocity,
            path,
        )


SMOOTHING_S = 0.1
SMOOTHING_ORDER = 3
NOISE_FREE_STD = 2e-5


def smooth_states(episode: Episode, noise_std: FloatArray) -> StartStates:
    """Estimate the state at every sample by local polynomials (Savitzky-Golay).

    Positions that are free of noise are left alone, and so are the reported velocities then: smoothing would
    only round off the impacts.

    Args:
        episode: The recording.
        noise_std: Noise of the positions, (J,).
    """
    if np.all(noise_std < NOISE_FREE_STD):
        return StartStates(
            episode.position, episode.velocity, np.maximum(noise_std, 1e-7), np.full_like(noise_std, 1e-4)
        )
    period = episode.period_s
    length = max(2 * round(SMOOTHING_S / period / 2) + 1, SMOOTHING_ORDER + 2)
    half = length // 2
    T = len(episode.sample)
    if length > T:
        raise InsufficientDataError(
            f"the recording has {T} usable samples, the shortest that can be smoothed has {length}; "
            "record longer"
        )
    position, velocity = np.empty_like(episode.position), np.empty_like(episode.position)
    centre = savgol_coeffs(length, SMOOTHING_ORDER, use="dot")
    slope = savgol_coeffs(length, SMOOTHING_ORDER, deriv=1, delta=period, use="dot")
    for t in range(T):
        first = min(max(t - half, 0), T - length)
        at = t - first
        if at == half:
            weights, rates = centre, slope
        else:
            weights = savgol_coeffs(length, SMOOTHING_ORDER, pos=at, use="dot")
            rates = savgol_coeffs(length, SMOOTHING_ORDER, deriv=1, delta=period, pos=at, use="dot")
        section = episode.position[first : first + length]
        position[t], velocity[t] = weights @ section, rates @ section
    # Twice the propagated noise: kinks of stick-slip and saturation are not polynomials.
    return StartStates(
        position,
        velocity,
        2 * noise_std * float(np.linalg.norm(centre)),
        2 * noise_std * float(np.linalg.norm(slope)),
    )
