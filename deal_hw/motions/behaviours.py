"""Behaviours: the commands of a run, cycle by cycle, before the safety filter. Numpy only."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, DatasetError, PolicyError, PolicyMismatchError
from deal_hw.motions.velocity import FixedVelocity, VelocitySource
from deal_hw.policy import (
    BASE_QUANTITIES,
    WORLD_QUANTITIES,
    ObservationBuilder,
    Policy,
    PolicySpec,
)
from deal_hw.rotations import rotation_vector
from deal_hw.types import FloatArray, JointCommand, RobotState, Trajectory


class Behaviour(Protocol):
    """Turns states into commands."""

    @property
    def action(self) -> FloatArray | None:
        """The unitless action behind the last command, (A,), or None."""
        ...

    def reset(self) -> None:
        """Restart; the same state sequence then gives the same commands."""
        ...

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the command for a state.

        Args:
            state: The newest state.
            time_s: Time since the run's first cycle, on the grid of deadlines [s].
        """
        ...


def centre(description: RobotDescription) -> FloatArray:
    """Return the centre of signals and actions, (A,): the default pose; for motors zero effort."""
    return description.held(np.array(description.default_position))


def position_command(description: RobotDescription | PolicySpec, target: FloatArray) -> JointCommand:
    """Return a position target, (A,), with the gains and limits of a robot or of a policy."""
    zeros = np.zeros(len(description.actuated))
    return JointCommand(
        position_target=np.array(target, dtype=float),
        velocity_target=zeros,
        stiffness=np.array(description.stiffness),
        damping=np.array(description.damping),
        effort=zeros,
        effort_limit=np.array(description.effort_limit),
        speed_limit=np.array(description.speed_limit),
    )


class ActionMap:
    """Turns the answers of a policy's network into actions and targets, as its spec says.

    Attributes:
        centre: The target of action 0, (A,).
        scale: Change of the target by action 1, (A,).
        limit: Largest absolute action.

    Args:
        spec: The policy's spec.
        around: The target of action 0, (A,).
        scale: Change of the target by action 1, (A,); by default that of the spec.
    """

    def __init__(self, spec: PolicySpec, around: FloatArray, scale: FloatArray | None = None) -> None:
        self.centre = around
        self.scale = np.array(spec.action_scale) if scale is None else scale
        self.limit = spec.action_limit
        self._range = np.array(spec.target_range).T if spec.target_range else None

    @classmethod
    def of_robot(cls, spec: PolicySpec, description: RobotDescription) -> ActionMap:
        """Return the map to the targets that a robot gets."""
        return cls(spec, np.array(spec.action_offset) if spec.action_offset else centre(description))

    def action(self, answer: FloatArray) -> FloatArray:
        """Return the actions of answers, (..., A) each; NaN stays, for the safety filter to trip on."""
        return np.clip(answer, -self.limit, self.limit)

    def target(self, action: FloatArray) -> FloatArray:
        """Return the targets of actions, (..., A) each."""
        target = self.centre + self.scale * action
        return target if self._range is None else np.clip(target, *self._range)


class PolicyBehaviour:
    """Runs a policy: target = centre + scale x action, with the gains and limits of the policy's spec.

    Actions are clipped, by default to [-1, 1]; NaN passes through, for the safety filter to trip on. A
    requested velocity is clipped to the policy's training range, if its spec contains one.

    Attributes:
        follows_velocity: Whether it observes a requested velocity.
        follows_targets: Whether it observes a pose that it is to reach.
        follows_obstacle: Whether it observes a platform ahead.

    Args:
        policy: The policy.
        description: The robot that it will run on.
        source: The requested velocity of the base, for a policy that observes it; by default zero.
        targets: Returns the pose to reach at a time [s], (A,), for a policy that observes it; by default the
            robot's default pose.
        obstacle: Distance and height of a platform ahead [m], for a policy that observes it; by default not
            said.

    Raises:
        PolicyMismatchError: The policy was made for another robot, or observes a quantity that this one
            cannot sense.
        PolicyError: It returns an action of another shape.
    """

    def __init__(
        self,
        policy: Policy,
        description: RobotDescription,
        source: VelocitySource | None = None,
        targets: Callable[[float], FloatArray] | None = None,
        obstacle: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        spec = policy.spec
        spec.check_fits(description)
        observed = {term.quantity for term in spec.observation}
        unseen = sorted(observed & {"linear_velocity", "height", *WORLD_QUANTITIES})
        if description.limits.legs is None and description.floating_base is None:
            unseen = sorted(observed & {*BASE_QUANTITIES, *WORLD_QUANTITIES})
        if unseen:
            raise PolicyMismatchError(
                f"the policy observes {' and '.join(unseen)} of the base, which no sensor of "
                f"{description.name!r} reports; train a policy without them"
            )
        self._source = source or FixedVelocity()
        self._slowest, self._fastest = np.array(spec.command_range or ((-np.inf, np.inf),) * 3).T
        self._observes_base = spec.observes_base
        self.follows_velocity = "command" in observed
        self.follows_targets = "joint_target" in observed
        self.follows_obstacle = "obstacle" in observed
        self._obstacle = np.array(obstacle)
        self._targets, self._actuated = targets, list(description.actuated_index)
        self._policy = policy
        self._observations = ObservationBuilder(spec)
        self._observations.obstacle = self._obstacle.copy()
        self._map = ActionMap.of_robot(spec, description)
        self._template = position_command(spec, self._map.centre)
        self.action: FloatArray | None = None

    def reset(self) -> None:
        """Clear the policy's memory."""
        self._policy.reset()
        self._observations.reset()
        self._observations.obstacle = self._obstacle.copy()
        self.action = None

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the policy's command."""
        wanted = self._source.velocity(state, time_s)
        self._observations.command = np.clip(wanted, self._slowest, self._fastest)
        if self._targets is not None:
            self._observations.joint_target[self._actuated] = self._targets(time_s)
        observation = self._observations.build(*self._coordinates(state))
        action = np.asarray(self._policy.act(observation), dtype=float)
        if action.shape != self._map.scale.shape:
            raise PolicyError(
                f"the policy returned an action of shape {action.shape}, expected {self._map.scale.shape}; "
                "export a policy for this robot"
            )
        self.action = self._map.action(action)
        self._observations.record_action(self.action)
        return dataclasses.replace(self._template, position_target=self._map.target(self.action))

    def _coordinates(self, state: RobotState) -> tuple[FloatArray, FloatArray]:
        """Return positions and velocities in the policy's layout, with the base's first if it needs them."""
        if not self._observes_base:
            return state.position, state.velocity
        if state.body is None:
            raise PolicyError(
                "the policy observes the base's orientation, which this robot's states do not contain; use "
                "a policy for this robot"
            )
        # Position and linear velocity of the base are not sensed; a check has shown that the policy does not
        # observe them.
        unknown = np.zeros(3)
        return (
            np.concatenate([unknown, rotation_vector(state.body.orientation), state.position]),
            np.concatenate([unknown, state.body.angular_velocity, state.velocity]),
        )


class HoldBehaviour:
    """Holds one position: the default pose, or the pose given."""

    action: FloatArray | None = None

    def __init__(self, description: RobotDescription, position: FloatArray | None = None) -> None:
        self._command = position_command(description, centre(description) if position is None else position)

    def reset(self) -> None:
        """No memory to clear."""

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the command."""
        return self._command


class ReplayBehaviour:
    """Repeats the requested commands of a recording, by time.

    Args:
        trajectory: The recording.
        description: The robot that it will run on.

    Raises:
        ConfigurationError: The recording is of another robot.
        DatasetError: It contains no command.
    """

    action: FloatArray | None = None

    def __init__(self, trajectory: Trajectory, description: RobotDescription) -> None:
        if trajectory.actuated != description.actuated or trajectory.joint_names != description.joint_names:
            raise ConfigurationError(
                f"the recording has joints {trajectory.joint_names}, actuated {trajectory.actuated}; robot "
                f"{description.name!r} has {description.joint_names}, actuated {description.actuated}; "
                "replay it on the recorded robot"
            )
        if not trajectory.sent_s.size:
            raise DatasetError("the recording contains no command to replay; choose another episode")
        self._trajectory = trajectory
        self._time_s = trajectory.sent_s - trajectory.sent_s[0]
        # Commands are sent on a grid of periods; half a period of slack keeps send jitter from shifting them
        # by one.
        self._slack_s = 0.5 / description.control_rate_hz

    @property
    def duration_s(self) -> float:
        """Time from the first command to one period after the last [s]."""
        return float(self._time_s[-1]) + 2 * self._slack_s

    def reset(self) -> None:
        """No memory to clear."""

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the command that was active at this time of the recording."""
        i = max(int(np.searchsorted(self._time_s, time_s + self._slack_s, side="right")) - 1, 0)
        t = self._trajectory
        zeros = np.zeros(len(t.actuated))
        return JointCommand(
            t.requested_position[i],
            zeros,
            t.stiffness[i],
            t.damping[i],
            zeros,
            t.effort_limit[i],
            t.speed_limit[i],
        )
