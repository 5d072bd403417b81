"""A user's robot in virtual time: its MJCF with hidden parameters, measured by its sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.errors import CalibrationError, ConfigurationError, TransportTimeoutError
from deal_hw.parameters import ParameterSpace
from deal_hw.robot import Robot
from deal_hw.schema import plain
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import reported
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.parameters import without_masses_and_zeros
from deal_hw.sim.parameters.default_space import default_space as doubted
from deal_hw.transport import Message
from deal_hw.types import FloatArray, JointCommand, RobotState, Status

SETTLE_S = 1.0
"""Homing holds the start pose for this time [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedTruth:
    """Hidden values of a simulated robot.

    Attributes:
        parameters: Values by name (SI).
        latency_s: From the reception of a command to its effect [s].
        seed: Of the sensors' noise.
    """

    parameters: Mapping[str, float]
    latency_s: float
    seed: int

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values: dict[str, Any] = plain(self)
        return values


def default_space(description: RobotDescription) -> ParameterSpace:
    """Return what differs in a simulated robot of a user: friction, damping, armature and gains of the MJCF.

    Masses and zeros, which a calibration doubts, too, are those of the MJCF.
    """
    model = compile_mjcf(description.mjcf)
    return without_masses_and_zeros(doubted(model))


def draw_truth(space: ParameterSpace, seed: int, range_ratio: float, latency_s: float) -> SimulatedTruth:
    """Return hidden parameters, uniform in the middle 10-90 % of their ranges.

    Args:
        space: The parameters.
        seed: Seeds the draw.
        range_ratio: Factor of the ranges on either side of the nominal values.
        latency_s: See :class:`SimulatedTruth` [s].
    """
    rng = np.random.default_rng(seed)
    space = space.with_ratio(range_ratio)
    values = space.unnormalize(rng.uniform(0.1, 0.9, len(space)))
    hidden = {**space.known, **dict(zip(space.names, map(float, values), strict=True))}
    return SimulatedTruth(parameters=hidden, latency_s=latency_s, seed=seed)


class SimulatedRobot(Robot):
    """A simulated robot on a fixed base; it moves with the clock.

    Args:
        robot: The nominal model.
        space: The truth's parameters.
        truth: The hidden values.
        clock: Virtual clock: reading a state moves it.

    Raises:
        ConfigurationError: The base floats.
    """

    def __init__(self, robot: RobotModel, space: ParameterSpace, truth: SimulatedTruth, clock: Clock) -> None:
        self.description = robot.description  # type: ignore[misc]  # A user's robot is known at run time.
        if robot.base is not None:
            raise ConfigurationError(
                f"robot {self.description.name!r} has a floating base; only robots with a fixed base can be "
                "simulated here. Remove the free joint from a copy of the MJCF"
            )
        self._robot, self._clock, self._truth = robot, clock, truth
        self._batch = ServoBatch(robot, space, 1, threads=1)
        self._batch.set_parameters(np.array([[truth.parameters[name] for name in space.names]]))
        self._effort = self._batch.batch.bind("qfrc_actuator")
        self._rng = np.random.default_rng((truth.seed, 1))
        self._stride = round(self.description.device_rate_hz / self.description.state_rate_hz)
        self._origin_ns = clock.now_ns()
        self._samples = 0
        self._step = 0
        self._status = Status(0)
        self._sequence = -1
        self._received_ns = -1
        self._coming: list[tuple[int, JointCommand]] = []
        self._home = np.array(self.description.default_position)
        self._setpoint = self._rest()
        self._memory = self._batch.commands.memory(self._setpoint[None])
        self._reset()

    def connect(self) -> None:
        """Do nothing: there is no connection."""

    def disconnect(self) -> None:
        """Do nothing: there is no connection."""

    def home(self, timeout_s: float) -> None:
        """Set the start pose, and let the robot settle there."""
        self._reset()
        settle = np.repeat(
            self._rest()[None, None], round(SETTLE_S * self.description.device_rate_hz), axis=1
        )
        self._advance(settle)

    def arm(self, timeout_s: float) -> None:
        """Enable the motors."""
        self._status = Status.ARMED

    def read_state(self, timeout_s: float) -> RobotState:
        """See :class:`~deal_hw.robot.Robot`; the clock moves to the sample, or by ``timeout_s``."""
        due_ns = self._origin_ns + round((self._samples + 1) * 1e9 / self.description.state_rate_hz)
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if due_ns > until_ns:
            self._clock.sleep_until_ns(until_ns)
            raise TransportTimeoutError("no sample in time")
        self._clock.sleep_until_ns(due_ns)
        self._samples += 1
        self._advance_to(self._samples * self._stride)
        sensor = self.description.sensor
        return RobotState(
            position=reported(self._batch.position[0], sensor.noise, sensor.resolution, self._rng),
            velocity=self._batch.velocity[0].copy(),
            effort=self._effort[0, list(self._robot.qvel)].copy(),
            receive_ns=due_ns,
            device_ns=due_ns,
            sequence=self._samples - 1,
            command_sequence=self._sequence,
            command_age_ns=due_ns - self._received_ns if self._sequence >= 0 else -1,
            status=self._status,
        )

    def send_command(self, command: JointCommand) -> JointCommand:
        """Accept a command; it acts after the latency."""
        now_ns = self._clock.now_ns()
        self._sequence += 1
        self._received_ns = now_ns
        acts_s = (now_ns - self._origin_ns) * 1e-9 + self._truth.latency_s
        self._coming.append((math.ceil(acts_s * self.description.device_rate_hz - 1e-6), command))
        return command

    def passive(self) -> None:
        """Switch the motors off."""
        self._status = Status(0)
        self._coming.clear()
        off = np.zeros(len(self.description.actuated))
        self._batch.set_sent(off, off, np.array(self.description.effort_limit))
        self._setpoint = self._rest()

    @property
    def last_sequence(self) -> int:
        """See :class:`~deal_hw.robot.Robot`."""
        return self._sequence

    @property
    def transport_errors(self) -> int:
        """0: there is no wire."""
        return 0

    def fileno(self) -> int:
        """Return -1: there is no port."""
        return -1

    def take_wire(self) -> list[Message]:
        """Return nothing: there is no wire."""
        return []

    def _rest(self) -> FloatArray:
        """Return the actuators' command before the first one: the start pose, or no effort."""
        return self.description.held(self._home)

    def _reset(self) -> None:
        d = self.description
        self._batch.set_sent(np.array(d.stiffness), np.array(d.damping), np.array(d.effort_limit))
        self._batch.set_state(self._home[None], np.zeros((1, len(self._home))))
        self._memory = self._batch.commands.memory(self._rest()[None])

    def _advance_to(self, step: int) -> None:
        while self._step < step:
            while self._coming and self._coming[0][0] <= self._step:
                command = self._coming.pop(0)[1]
                self._setpoint = command.position_target
                self._batch.set_sent(command.stiffness, command.damping, command.effort_limit)
            end = min(step, self._coming[0][0]) if self._coming else step
            self._advance(np.repeat(self._setpoint[None, None], end - self._step, axis=1))
            self._step = end

    def _advance(self, setpoint: FloatArray) -> None:
        if self._batch.commands.any:
            setpoint, self._memory = self._batch.commands.act(setpoint, self._memory, self._robot.step_s)
        position, _ = self._batch.advance(setpoint)
        if not np.isfinite(position).all():
            raise CalibrationError(
                f"the simulated {self.description.name!r} diverged; reduce the MJCF's timestep"
            )
