"""Trials: simulated robots with given parameters under a behaviour, behind the safety filter.

It is the closed loop of the robot, at the control rate: state, behaviour, safety filter, set-point generator,
latency, engine. Several members with their own parameters run side by side.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import Behaviour
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import ClosedLoop
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray, JointCommand, RobotState, Status


@dataclass(frozen=True, slots=True)
class Scenario:
    """D simulated robots on which every candidate is tried.

    Attributes:
        theta: Physical parameters, (D, K).
        latency_s: Total latencies, (D,) [s].
        position: Joint positions at the start, (D, J); they start at rest.
    """

    theta: FloatArray
    latency_s: FloatArray
    position: FloatArray

    def __len__(self) -> int:
        return len(self.theta)

    def part(self, rows: Sequence[int]) -> Scenario:
        """Return some of the members."""
        index = list(rows)
        return Scenario(self.theta[index], self.latency_s[index], self.position[index])


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of one member.

    Attributes:
        episode: Its recording without noise.
        tripped: Which limit it came near; "" for none.
        clipped: Number of commands that the safety filter changed.
    """

    episode: SampledEpisode
    tripped: str
    clipped: int


class TrialRunner:
    """Runs behaviours on the members of a scenario; the simulator is kept between candidates.

    A trial may use ``trip_share`` of the trip ranges. A few dozen simulated robots do not cover all real
    ones: a design that used the whole range on 48 of them tripped on one of the first three emulated ones.

    Raises:
        ConfigurationError: The robot's base floats, or its rates do not divide.
    """

    def __init__(
        self,
        robot: RobotModel,
        space: ParameterSpace,
        scenario: Scenario,
        seconds: float,
        threads: int | None = None,
        trip_share: float = 0.85,
    ) -> None:
        description = robot.description
        if robot.base is not None:
            raise ConfigurationError(
                f"robot {description.name!r} has a floating base; excitations are designed for robots on a "
                "stand (such as go2_suspended), which cannot fall over"
            )
        self._robot, self._scenario, self._trip_share = robot, scenario, trip_share
        self._device_s = 1.0 / description.device_rate_hz
        self._period = description.steps_per_control
        self._stride = round(description.device_rate_hz / description.state_rate_hz)
        if self._period % self._stride:
            raise ConfigurationError(
                f"{description.name}: states every {self._stride} device periods do not divide control "
                f"periods of {self._period}"
            )
        self._ticks = math.ceil(seconds * description.control_rate_hz - 1e-9)
        self._batch = ServoBatch(robot, space, len(scenario), threads)

    def run(self, behaviours: Sequence[Behaviour], until_trip: bool = False) -> list[Trial]:
        """Run one behaviour per member, each reset first; with ``until_trip``, up to the first trip.

        Raises:
            ConfigurationError: They request different gains or limits at a time.
        """
        description, scenario = self._robot.description, self._scenario
        for behaviour in behaviours:
            behaviour.reset()
        self._batch.set_parameters(scenario.theta)
        self._batch.set_state(scenario.position, np.zeros_like(scenario.position))
        loop = _Loop(description, scenario.position, self._trip_share)
        positions, velocities = [self._batch.position[:, None]], [self._batch.velocity[:, None]]
        path = ClosedLoop(self._batch, self._period, self._device_s)
        path.restart(description.held(scenario.position), scenario.latency_s)
        motor = description.actuation == "motor"
        speed = self._batch.servo_factor("servo_speed_limit")
        for tick in range(self._ticks):
            sent = loop.command(behaviours, positions[-1][:, -1], velocities[-1][:, -1], tick)
            lead = sent[next((n for n, why in enumerate(loop.tripped) if not why), 0)]
            self._batch.set_sent(lead.stiffness, lead.damping, lead.effort_limit)
            rate = None if motor else speed * lead.speed_limit * self._device_s
            x, v = path.advance(np.stack([c.position_target for c in sent]), rate, self._stride)
            positions.append(x)
            velocities.append(v)
            loop.watch(x, v)
            if until_trip and any(loop.tripped):
                break
        x, v = np.concatenate(positions, axis=1), np.concatenate(velocities, axis=1)
        return [self._trial(loop, n, x[n], v[n]) for n in range(len(scenario))]

    def _trial(self, loop: _Loop, n: int, x: FloatArray, v: FloatArray) -> Trial:
        def each(name: str) -> FloatArray:
            return np.repeat([getattr(sent[n], name) for sent in loop.sent], self._period, axis=0)

        start = x[0][list(self._robot.description.actuated_index)]
        episode = SampledEpisode(
            step_s=self._device_s,
            sample=np.arange(len(x)) * self._stride,
            position=x,
            velocity=v,
            target=each("position_target"),
            stiffness=each("stiffness"),
            damping=each("damping"),
            effort_limit=each("effort_limit"),
            speed_limit=each("speed_limit"),
            usable=np.ones(len(x), dtype=bool),
            start_setpoint=start,
        )
        return Trial(episode, loop.tripped[n], loop.clipped[n])


class _Loop:
    """Behaviours behind the safety filter, with the safety module's trip limits."""

    def __init__(self, description: RobotDescription, position: FloatArray, trip_share: float) -> None:
        self._description, self._trip_share = description, trip_share
        self._index = list(description.actuated_index)
        self._filters = [SafetyFilter(description) for _ in position]
        self._start = position[:, self._index]
        self._previous = self._start.copy()
        self.tripped = [""] * len(position)
        self.clipped = [0] * len(position)
        self.sent: list[list[JointCommand]] = []

    def command(
        self, behaviours: Sequence[Behaviour], position: FloatArray, velocity: FloatArray, tick: int
    ) -> list[JointCommand]:
        """Return what is sent to each member."""
        time_s = tick / self._description.control_rate_hz
        sent = []
        for n, behaviour in enumerate(behaviours):
            if self.tripped[n]:
                # A tripped trial is not used, so its further motion does not matter.
                sent.append(self.sent[-1][n])
                continue
            x, v = position[n], velocity[n]
            state = RobotState(x, v, np.zeros_like(x), 0, 0, tick, -1, -1, Status.ARMED)
            wanted = behaviour.command(state, time_s)
            sent.append(self._filtered(n, wanted, x[self._index], v[self._index], time_s))
        running = [command for command, why in zip(sent, self.tripped, strict=True) if not why]
        if any(not _same_limits(running[0], other) for other in running):
            raise ConfigurationError("behaviours that run side by side must send the same gains and limits")
        self.sent.append(sent)
        return sent

    def _filtered(
        self, n: int, wanted: JointCommand, measured: FloatArray, velocity: FloatArray, time_s: float
    ) -> JointCommand:
        if not self._filters[n].accepts(wanted):
            self.tripped[n] = "the behaviour asked for a command that is not finite"
            return dataclasses.replace(wanted, position_target=self._previous[n])
        share = 1.0
        if self._description.limits.ease_in_s > 0:
            share = min(time_s / self._description.limits.ease_in_s, 1.0)
        eased = self._start[n] + share * (wanted.position_target - self._start[n])
        command, clipped = self._filters[n].clip(
            dataclasses.replace(wanted, position_target=eased), self._previous[n], measured, velocity
        )
        if "gains" in clipped:
            self.tripped[n] = "a joint moved so fast that its braking would exceed the limit of effort"
        self.clipped[n] += bool(clipped)
        self._previous[n] = command.position_target
        return command

    def watch(self, position: FloatArray, velocity: FloatArray) -> None:
        """Note the members that came near the limits that trip, (N, H, J) each."""
        limits, names = self._description.limits, self._description.joint_names
        low, high = np.array(limits.trip_position).T
        bounded = np.isfinite(low) & np.isfinite(high)
        width = np.subtract(high, low, out=np.zeros_like(low), where=bounded)
        spare = 0.5 * (1 - self._trip_share) * width
        low, high = low + spare, high - spare
        fast = self._trip_share * np.array(limits.trip_velocity)
        for n in range(len(position)):
            if self.tripped[n]:
                continue
            if not np.isfinite(position[n]).all():
                self.tripped[n] = "the simulation diverged"
                continue
            out = np.any((position[n] < low) | (position[n] > high), axis=0)
            over = np.any(np.abs(velocity[n]) > fast, axis=0)
            if out.any():
                self.tripped[n] = f"{names[int(np.argmax(out))]} came near the end of its range"
            elif over.any():
                self.tripped[n] = f"{names[int(np.argmax(over))]} moved nearly too fast"


def _same_limits(a: JointCommand, b: JointCommand) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("stiffness", "damping", "effort_limit", "speed_limit")
    )
