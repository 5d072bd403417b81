"""N simulated robots as a host sees them at the control rate: delay, speed-limited set-points, sensor noise.

Training environments and evaluation share this class. It does, batched, what the emulated device does frame
by frame; the loop below it is :class:`~deal_hw.sim.engine.closed_loop.ClosedLoop`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import ClosedLoop, reported
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.types import FloatArray

BoolArray = npt.NDArray[np.bool_]

EXACT_SENSOR = SensorModel(noise=(), resolution=(), velocity_window_s=0.0)
"""Reports the true state."""


class ServoLoop:
    """N robots, each with its own parameters, latency and noise.

    Args:
        description: The robot.
        space: The parameters in which members differ.
        count: Members N.
        sensor: Sensor model of the reported state; the description's by default.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.
        step_s: Physics step [s]; the device period by default.
        scene: Returns the model to simulate, made from the robot's own, such as one with a terrain.

    Attributes:
        reported_position: Reported positions, (N, C): a floating base, if any, then the joints. The sensor
            model applies to the joints; the base is reported without error.
        reported_velocity: (N, C).
    """

    def __init__(
        self,
        description: RobotDescription,
        space: ParameterSpace,
        count: int,
        *,
        sensor: SensorModel | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
        step_s: float | None = None,
        scene: Callable[[RobotModel], RobotModel] | None = None,
    ) -> None:
        self.description = description
        self.count = count
        period_s = 1.0 / description.device_rate_hz
        robot = load_model(description, step_s or period_s)
        model = robot if scene is None else scene(robot)
        self.batch = ServoBatch(model, space, count, threads, engine=engine)
        self._theta = np.repeat(space.nominal[None], count, axis=0)
        self._sensor = description.sensor if sensor is None else sensor
        self._window = _window_periods(self._sensor, description)
        C = self.batch.position.shape[1]
        self._home = self.batch.position[0].copy()
        self._home[self.batch.robot.joints] = description.default_position
        self._loop = ClosedLoop(self.batch, description.steps_per_control, period_s, whole=True)
        self._now: tuple[FloatArray, FloatArray] | None = None
        self._reports = np.zeros((self._window + 1, count, C))
        self.reported_position = np.zeros((count, C))
        self.reported_velocity = np.zeros((count, C))

    @property
    def theta(self) -> FloatArray:
        """Each member's parameters, (N, K)."""
        return self._theta

    @property
    def position(self) -> FloatArray:
        """True positions, (N, C)."""
        return self._state()[0]

    @property
    def velocity(self) -> FloatArray:
        """True velocities, (N, C)."""
        return self._state()[1]

    def set_state(self, position: FloatArray, velocity: FloatArray, members: npt.NDArray[np.intp]) -> None:
        """Set the true state, (M, C) each, of M members; what was reported remains."""
        self.batch.set_state(position, velocity, members)
        self._now = None

    def _state(self) -> tuple[FloatArray, FloatArray]:
        if self._now is None:
            self._now = self.batch.position, self.batch.velocity
        return self._now

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
        """Restart M of the members: armed, set-point and targets at their own position; motors at zero.

        Args:
            where: The M members, a mask (N,).
            theta: Their parameters, (M, K).
            latency_s: Their total latencies, (M,) [s]; rounded to device periods. Command delays are added.
            position: Their positions, (M, C).
            velocity: Their velocities, (M, C).
            rng: For the noise of the first report.
            setpoint: First set-point and targets, (M, A); the position by default.
        """
        members = np.flatnonzero(where)
        self._theta[members] = theta
        self.batch.set_parameters(self._theta, members)
        self.set_state(position, velocity, members)
        start = setpoint
        if start is None:
            start = self.description.held(position[:, self.batch.robot.joints])
        self._loop.restart(start, latency_s, members)
        period_s = 1.0 / self.description.control_rate_hz
        for age in range(self._window + 1):
            # The host watched the robot before the episode, too: past reports differ by noise and motion.
            self._reports[age, members] = self._report(position - age * period_s * velocity, rng)
        self._publish(members, velocity)

    def step(self, target: FloatArray, rng: np.random.Generator) -> BoolArray:
        """Send targets and advance by one control period.

        Args:
            target: Position targets [m or rad] or motor commands, (N, A).
            rng: For the noise.

        Returns:
            Members whose physics diverged, (N,); they report the default pose until they are restarted.
        """
        rate = None
        if self.description.actuation == "position":
            limit = self.batch.servo_factor("servo_speed_limit") * np.array(self.description.speed_limit)
            rate = limit * self._loop.step_s
        position, velocity = (values[:, -1] for values in self._loop.advance(target, rate))
        self._now = position, velocity
        diverged: BoolArray = ~np.isfinite(np.concatenate([position, velocity], axis=1)).all(axis=1)
        if diverged.any():
            self._now = None
            position = np.where(diverged[:, None], self._home, position)
            velocity = np.where(diverged[:, None], 0.0, velocity)
        self._reports = np.roll(self._reports, 1, axis=0)
        self._reports[0] = self._report(position, rng)
        self._publish(slice(None), velocity)
        return diverged

    def _publish(self, members: npt.NDArray[np.intp] | slice, velocity: FloatArray) -> None:
        now, then = self._reports[0, members], self._reports[-1, members]
        self.reported_position[members] = now
        if self._window:
            velocity = (now - then) * (self.description.control_rate_hz / self._window)
        self.reported_velocity[members] = velocity

    def _report(self, position: FloatArray, rng: np.random.Generator) -> FloatArray:
        if not self._sensor.noise:
            return position
        joints = self.batch.robot.joints
        seen = reported(position[:, joints], self._sensor.noise, self._sensor.resolution, rng)
        return np.concatenate([position[:, : joints.start], seen], axis=1)


def _window_periods(sensor: SensorModel, description: RobotDescription) -> int:
    """Return the velocity window in control periods; 0 for true velocities."""
    periods = sensor.velocity_window_s * description.control_rate_hz
    if abs(periods - round(periods)) > 1e-9:
        raise ConfigurationError(
            f"velocity_window_s = {sensor.velocity_window_s:g} s must be a whole number of control periods "
            f"of {1 / description.control_rate_hz:g} s"
        )
    return round(periods)
