"""N simulated robots in a closed loop: targets, delayed and slewed set-points, the engine.

Training, fitness, planned excitations and simulated targets use this loop. They differ in the source of the
targets and in the observed part of the state.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.laws.setpoints import delay, slew
from deal_hw.types import FloatArray


class ClosedLoop:
    """The path from the targets that a host sends to the states of N members.

    Args:
        batch: The members; their command delays and laws apply.
        steps: Device periods in a control period.
        step_s: Length of a device period [s]; the physics step by default.
        whole: Round latencies to device periods, as a device does; otherwise set-points are interpolated.
    """

    def __init__(
        self, batch: ServoBatch, steps: int, step_s: float | None = None, *, whole: bool = False
    ) -> None:
        self.batch, self.steps, self._whole = batch, steps, whole
        self.step_s = batch.robot.step_s if step_s is None else step_s
        self._lag = np.zeros((batch.count, 1))
        self._path = np.zeros((batch.count, 1, len(batch.robot.description.actuated)))
        self._memory = batch.commands.memory(self._path[:, 0])

    def restart(
        self,
        setpoint: FloatArray,
        latency_s: FloatArray,
        where: npt.NDArray[np.intp] | slice = slice(None),
    ) -> None:
        """Restart M of the members, with parameters set, from a constant past set-point.

        Args:
            setpoint: The past set-point, (M, A).
            latency_s: Their total latencies, (M,) [s]; negative ones count as zero.
            where: The members.
        """
        late = np.zeros(self.batch.count)
        late[where] = latency_s
        lag = np.maximum(self.batch.lag_s(late), 0.0).reshape(self.batch.count, -1) / self.step_s
        if lag.shape != self._lag.shape:
            self._lag = np.zeros(lag.shape)
        self._lag[where] = np.rint(lag[where]) if self._whole else lag[where]
        missing = int(np.ceil(self._lag.max())) + 1 - self._path.shape[1]
        if missing > 0:
            self._path = np.concatenate([np.repeat(self._path[:, :1], missing, axis=1), self._path], axis=1)
        self._path[where] = setpoint[:, None]
        if self.batch.commands.any:
            held = self._path[:, 0].copy()
            held[where] = setpoint
            self._memory[where] = self.batch.commands.memory(held)[where]

    def advance(
        self, target: FloatArray, rate: FloatArray | None = None, every: int = 0
    ) -> tuple[FloatArray, FloatArray]:
        """Send targets and advance by one control period.

        Args:
            target: Position targets [m or rad] or motor commands, (N, A), or those at each step, (N, S, A).
            rate: Largest change of a set-point in a device period, (N, A) or at each of its steps (N, S, A);
                None for motors, whose commands are not slewed.
            every: Record after each ``every``-th device period; 0 records only the end.

        Returns:
            Positions and velocities there, (N, S // every, C) each; NaN where a member diverged.
        """
        ahead = target if target.ndim == 3 else np.repeat(target[:, None], self.steps, axis=1)
        if rate is not None:
            ahead = slew(self._path[:, -1], ahead, rate)
        path = np.concatenate([self._path, ahead], axis=1)
        self._path = path[:, self.steps :]
        late = delay(path, self._lag, path[:, 0], self.steps)
        if self.batch.commands.any:
            late, self._memory = self.batch.commands.act(late, self._memory, self.step_s)
        control = on_physics_steps(self.batch, late, self.step_s)
        return self.batch.advance(control, round(every * self.step_s / self.batch.robot.step_s))


def on_physics_steps(batch: ServoBatch, path: FloatArray, step_s: float) -> FloatArray:
    """Return set-points of device periods of ``step_s``, (N, S, A), at the engine's steps.

    A physics step may be several device periods (the DEAL paper's 5 ms): then set-points are sampled. Or it
    is a part of one.
    """
    ratio = batch.robot.step_s / step_s
    if ratio >= 1:
        return path[:, :: round(ratio)]
    return np.repeat(path, round(1 / ratio), axis=1)


def reported(
    joints: FloatArray, noise: Sequence[float], resolution: Sequence[float], rng: np.random.Generator
) -> FloatArray:
    """Return joint positions, (..., J), as an encoder reports them: with noise, then rounded.

    Args:
        joints: The true positions [m or rad].
        noise: Standard deviations, (J,).
        resolution: Steps of the encoder, (J,); 0 or empty for none.
        rng: Draws the noise.
    """
    noisy = joints + rng.standard_normal(joints.shape) * np.array(noise)
    steps = np.array(resolution) if len(resolution) else np.zeros(len(noise))
    rounded = np.rint(noisy / np.where(steps > 0, steps, 1.0)) * steps
    return np.asarray(np.where(steps > 0, rounded, noisy))
