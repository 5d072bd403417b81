"""N simulated robots as a host sees them at the control rate: late targets, slow set-points, noisy reports.

The environments of training and the evaluation stand on this one class. It does, batched, what the emulated
device does frame by frame; :class:`~deal_hw.sim.engine.batch.ServoBatch`, the calibrator's, is the physics.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import COMMAND_DELAY, ServoBatch
from deal_hw.sim.engine.model import load_model
from deal_hw.types import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]

SLEWLESS = 1e9
"""Largest change a step of a set-point without a speed limit: finite, as 0 x infinity is no number."""

EXACT_SENSOR = SensorModel(noise=(), resolution=(), velocity_window_s=0.0)
"""Reports the true state."""


def delayed_setpoints(
    start: FloatArray, older: FloatArray, newer: FloatArray, switch: IntArray, rate: FloatArray, steps: int
) -> FloatArray:
    """Return the set-point at each step of one control period, in closed form.

    A latency is a whole number of steps, so within a period the target changes at most once; towards a
    constant target the slewed set-point is a clipped ramp. Equal to
    :func:`deal_hw.sim.engine.servo.slew` on the same targets.

    Args:
        start: Set-point before the first step, (N, A).
        older: Target in force before the change, (N, A).
        newer: Target in force from it on, (N, A).
        switch: Steps for which the older one is in force, (N,), or for each actuator, (N, A).
        rate: Largest change a step, (N, A).
        steps: Steps S in a control period.

    Returns:
        (N, S, A).
    """
    count = np.arange(1, steps + 1)[:, None]
    switch = switch.reshape(len(switch), -1)
    before = np.minimum(count, switch[:, None]) * rate[:, None]
    after = np.maximum(count - switch[:, None], 0) * rate[:, None]
    reach = switch * rate
    middle = start + np.clip(older - start, -reach, reach)
    first = start[:, None] + np.clip((older - start)[:, None], -before, before)
    second = middle[:, None] + np.clip((newer - middle)[:, None], -after, after)
    return np.where(count <= switch[:, None], first, second)


class ServoLoop:
    """N robots, each with its own parameters, latency and noise.

    Args:
        description: The robot.
        space: The parameters that members differ in.
        count: Members N.
        longest_latency_s: The longest total latency that :meth:`restart` will be given [s], command delays
            of the parameters not counted.
        sensor: What stands between the true and the reported state; the description's by default.
        threads: Threads of the physics; None for all CPUs.

    Attributes:
        reported_position: What the host is told, (N, C): the joints, after a floating base where there is
            one. The sensor model is the joints'; the base is reported as it is.
        reported_velocity: (N, C).
    """

    def __init__(
        self,
        description: RobotDescription,
        space: ParameterSpace,
        count: int,
        *,
        longest_latency_s: float,
        sensor: SensorModel | None = None,
        threads: int | None = 1,
    ) -> None:
        self.description = description
        self.count = count
        self.steps = description.steps_per_control
        self._step_s = 1.0 / description.device_rate_hz
        self.batch = ServoBatch(load_model(description, self._step_s), space, count, threads)
        self._theta = np.repeat(space.nominal[None], count, axis=0)
        self._sensor = description.sensor if sensor is None else sensor
        self._window = _window_periods(self._sensor, description)
        C, A = self.batch.position.shape[1], len(description.actuated)
        self._home = self.batch.position[0].copy()
        self._home[self.batch.robot.joints] = description.default_position
        longest_latency_s += max((p.high for p in space.parameters if p.kind == COMMAND_DELAY), default=0.0)
        depth = int(np.ceil(longest_latency_s * description.device_rate_hz / self.steps)) + 2
        self._targets = np.zeros((depth, count, A))
        self._latency = np.zeros((count, A), dtype=np.int64)
        self._setpoint = np.zeros((count, A))
        self._reports = np.zeros((self._window + 1, count, C))
        self.reported_position = np.zeros((count, C))
        self.reported_velocity = np.zeros((count, C))

    @property
    def position(self) -> FloatArray:
        """True positions, (N, C)."""
        return self.batch.position

    @property
    def velocity(self) -> FloatArray:
        """True velocities, (N, C)."""
        return self.batch.velocity

    def restart(
        self,
        where: BoolArray,
        theta: FloatArray,
        latency_s: FloatArray,
        position: FloatArray,
        velocity: FloatArray,
        rng: np.random.Generator,
        setpoint: FloatArray | None = None,
    ) -> None:
        """Start M of the members anew: armed, set-point and targets at their own position; motors at zero.

        Args:
            where: The M members, a mask (N,).
            theta: Their parameters, (M, K).
            latency_s: Their total latencies, (M,) [s]; rounded to device periods.
            position: Their positions, (M, C).
            velocity: Their velocities, (M, C).
            rng: For the noise of the first report.
            setpoint: Set-point and targets to start with, (M, A), where they are not the position.

        Raises:
            ConfigurationError: A latency is negative or longer than the loop was made for.
        """
        members = np.flatnonzero(where)
        self._theta[members] = theta
        self.batch.set_parameters(self._theta, members)
        late = np.zeros(self.count)
        late[members] = latency_s
        late = self.batch.lag_s(late).reshape(self.count, -1)[members]
        ticks = np.rint(late / self._step_s).astype(np.int64)
        longest = (len(self._targets) - 1) * self.steps
        if ticks.size and (ticks.min() < 0 or ticks.max() >= longest):
            raise ConfigurationError(
                f"latencies must lie in [0, {longest * self._step_s:g}) s, got {late.min():g}..{late.max():g}"
            )
        self.batch.set_state(position, velocity, members)
        self._latency[members] = ticks
        start = setpoint
        if start is None:
            start = position[:, self.batch.robot.joints][:, list(self.description.actuated_index)]
            if self.description.actuation == "motor":
                start = np.zeros_like(start)
        self._setpoint[members] = start
        self._targets[:, members] = start
        period_s = 1.0 / self.description.control_rate_hz
        for age in range(self._window + 1):
            # The host watched the robot before the episode, too: reports of the past differ by noise and
            # motion.
            self._reports[age, members] = self._report(position - age * period_s * velocity, rng)
        self._publish(members, velocity)

    def step(self, target: FloatArray, rng: np.random.Generator) -> BoolArray:
        """Send targets and advance by one control period.

        Args:
            target: Position targets [m or rad] or motor commands, (N, A).
            rng: For the noise.

        Returns:
            Members whose physics diverged, (N,); their reports are the default pose until they are restarted.
        """
        self._targets = np.roll(self._targets, 1, axis=0)
        self._targets[0] = target
        periods, switch = np.divmod(self._latency, self.steps)
        members = np.arange(self.count)
        rows, columns = members[:, None], np.arange(self._latency.shape[1])
        rate = (
            self.batch.servo_factor("servo_speed_limit")
            * np.array(self.description.speed_limit)
            * self._step_s
        )
        rate = np.minimum(rate, SLEWLESS)
        setpoints = delayed_setpoints(
            self._setpoint, self._targets[periods + 1, rows, columns], self._targets[periods, rows, columns],
            switch, rate, self.steps,
        )  # fmt: skip
        self._setpoint = setpoints[:, -1]
        position, velocity = (values[:, -1] for values in self.batch.advance(setpoints))
        diverged: BoolArray = ~np.isfinite(np.concatenate([position, velocity], axis=1)).all(axis=1)
        if diverged.any():
            position = np.where(diverged[:, None], self._home, position)
            velocity = np.where(diverged[:, None], 0.0, velocity)
        self._reports = np.roll(self._reports, 1, axis=0)
        self._reports[0] = self._report(position, rng)
        self._publish(members, velocity)
        return diverged

    def _publish(self, members: npt.NDArray[np.intp], velocity: FloatArray) -> None:
        now, then = self._reports[0, members], self._reports[-1, members]
        self.reported_position[members] = now
        if self._window:
            velocity = (now - then) * (self.description.control_rate_hz / self._window)
        self.reported_velocity[members] = velocity

    def _report(self, position: FloatArray, rng: np.random.Generator) -> FloatArray:
        if not self._sensor.noise:
            return position
        joints = position[:, self.batch.robot.joints]
        noisy = joints + rng.standard_normal(joints.shape) * self._sensor.noise
        resolution = np.array(self._sensor.resolution)
        step = np.where(resolution > 0, resolution, 1.0)
        noisy = np.where(resolution > 0, np.rint(noisy / step) * step, noisy)
        base = position[:, : self.batch.robot.joints.start]
        return np.concatenate([base, noisy], axis=1)


def _window_periods(sensor: SensorModel, description: RobotDescription) -> int:
    """Return the velocity window in control periods; 0 for true velocities."""
    periods = sensor.velocity_window_s * description.control_rate_hz
    if abs(periods - round(periods)) > 1e-9:
        raise ConfigurationError(
            f"velocity_window_s = {sensor.velocity_window_s:g} s must be a whole number of control periods "
            f"of {1 / description.control_rate_hz:g} s"
        )
    return round(periods)
