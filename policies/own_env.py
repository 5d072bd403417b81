"""A user's Gymnasium environment, prepared for our trainers: calibrated physics, a policy's layout.

The policy's file must describe its observations and actions. Either the environment has an attribute
``policy_spec``. Or it observes the robot's joint positions (relative to the default pose), then their
velocities, and its action is the actuators' control: this is tested before the training.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, UnknownNameError, short
from deal_hw.motions.behaviours import centre
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.vector_env import TaskKnowledge
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.sim.engine.in_place import ModelInPlace
from deal_hw.sim.engine.model import actuator_of
from deal_hw.sim.parameters.fields import element_id
from deal_hw.types import FloatArray

TOLERANCE = 1e-5
"""Largest difference between the environment's observation and the one described in the policy's file."""
TRIED = 3
"""Number of test steps."""


@dataclasses.dataclass(frozen=True, slots=True)
class OwnTask:
    """Name of the task, for the training record."""

    env: str


class OwnVectorEnv(TaskKnowledge, SyncVectorEnv):
    """N members of a user's environment; every reset draws their parameters.

    Args:
        env: Its name, module:ENV_ID.
        description: The robot.
        distribution: Distribution of parameters and latency. Latency delays actions by whole steps.
        count: Members N.

    Attributes:
        layout: Layout of observation and action.
        task: Name of the task.

    Raises:
        ConfigurationError: The environment cannot be used; the message says what to change.
        UnknownNameError: Its model lacks a joint of the robot, or an element of the distribution.
    """

    def __init__(
        self, env: str, description: RobotDescription, distribution: ParameterDistribution, count: int
    ) -> None:
        self.layout = _layout(env, description, distribution)
        self.description, self.task = description, OwnTask(env)
        super().__init__(
            [lambda: _Member(_made(env), self.layout, description, distribution) for _ in range(count)],
            autoreset_mode=AutoresetMode.SAME_STEP,
        )

    def measures(self) -> dict[str, float]:
        """Return nothing beside the return."""
        return {}

    def privileged(self) -> FloatArray:
        """Return no further information for the critic, (N, 0)."""
        return np.zeros((self.num_envs, 0))


class _Member(gymnasium.Wrapper[Any, Any, Any, Any]):
    """One environment with delayed actions in [-1, 1], and physics drawn at each reset."""

    def __init__(
        self, env: Any, layout: PolicySpec, description: RobotDescription, distribution: ParameterDistribution
    ) -> None:
        super().__init__(env)
        O, A = len(layout.observation), len(layout.actuated)  # noqa: E741
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (O,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (A,), np.float32)
        self._control = _control(env, layout, description)
        self._distribution, self._period_s = distribution, 1.0 / layout.control_rate_hz
        self._physics = None
        if len(distribution.space.parameters):
            self._physics = ModelInPlace(env.unwrapped.model, distribution.space)
        self._rng = np.random.default_rng(0)
        self._late: deque[FloatArray] = deque()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:
            self._rng = np.random.default_rng([seed, 1])
        if self._physics is not None:
            self._physics.apply(self._distribution.sample(self._rng, 1)[0])
        late_s = float(self._distribution.sample_latency(self._rng, 1)[0])
        rest = np.zeros(self.action_space.shape or ())
        self._late = deque([rest] * round(late_s / self._period_s))
        observation, info = self.env.reset(seed=seed, options=options)
        return np.asarray(observation, dtype=np.float32), info

    def step(self, action: Any) -> Any:
        self._late.append(np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0))
        given = self._control.of(self._late.popleft())
        observation, reward, terminated, truncated, info = self.env.step(given)
        # An episode that fails in its last step has failed: nothing comes after it that has a value.
        truncated = bool(truncated and not terminated)
        return np.asarray(observation, dtype=np.float32), float(reward), bool(terminated), truncated, info


def _made(env: str) -> Any:
    try:
        return gymnasium.make(env)
    except Exception as err:
        raise ConfigurationError(
            f"--env {env}: {short(str(err))}; write module:ENV_ID, such as my_robot.envs:Reach-v0, of a "
            "module that registers it and lies on Python's path"
        ) from err


def _layout(env: str, description: RobotDescription, distribution: ParameterDistribution) -> PolicySpec:
    """Return the layout of observation and action, after a test."""
    made = _made(env)
    try:
        spaces = made.observation_space, made.action_space
        if not all(isinstance(one, gymnasium.spaces.Box) and len(one.shape) == 1 for one in spaces):
            raise ConfigurationError(
                f"--env {env}: observation and action must each be a Box of one dimension, not {spaces[0]} "
                f"and {spaces[1]}"
            )
        own = getattr(made.unwrapped, "policy_spec", None)
        if own is None:
            return _tried(env, made, description, distribution)
        if not isinstance(own, PolicySpec) or [len(own.observation), len(own.actuated)] != [
            one.shape[0] for one in spaces
        ]:
            raise ConfigurationError(
                f"--env {env}: its policy_spec must be a deal_hw.policy.PolicySpec with a term for each "
                "observation and a joint for each action"
            )
        return dataclasses.replace(own, trained_under=distribution.digest())
    finally:
        made.close()


def _tried(
    env: str, made: Any, description: RobotDescription, distribution: ParameterDistribution
) -> PolicySpec:
    """Return the layout of joint positions, then velocities; refuse an environment with another one."""
    model, data = (getattr(made.unwrapped, name, None) for name in ("model", "data"))
    if model is None or data is None or not hasattr(model, "jnt_qposadr"):
        raise ConfigurationError(
            f"--env {env} is no MuJoCo environment (it has no `model` and `data`): calibrated parameters "
            "cannot be applied to it"
        )
    try:
        joints = [element_id(model, "joint", name) for name in description.joint_names]
        actuators = [actuator_of(model, name) for name in description.actuated]
    except UnknownNameError as err:
        raise ConfigurationError(f"--env {env}: its model is not that of the robot: {err}") from err
    at, moving = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    layout = _plain_layout(description, distribution)
    control = _control(made, layout, description)
    if made.action_space.shape != (len(actuators),):
        raise ConfigurationError(
            f"--env {env} takes {made.action_space.shape[0]} actions, robot {description.name!r} has "
            f"{len(actuators)} actuators; let each action be an actuator's ctrl, in the MJCF's order"
        )
    made.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(TRIED):
        before = float(data.time)
        given = control.of(rng.uniform(-0.1, 0.1, len(actuators)))
        seen = np.asarray(made.step(given)[0], dtype=np.float64)
        wanted = np.concatenate([data.qpos[at] - description.default_position, data.qvel[moving]])
        if seen.shape != wanted.shape or np.abs(seen - wanted).max() > TOLERANCE:
            raise ConfigurationError(
                f"--env {env} does not observe the {len(joints)} joint positions (relative to "
                "default_position) and then their velocities, so the policy's file could not describe its "
                "observation; observe these, or give the environment an attribute policy_spec (a "
                "deal_hw.policy.PolicySpec)"
            )
        if not np.allclose(data.ctrl, given, atol=TOLERANCE):
            raise ConfigurationError(
                f"--env {env} does not write its actions unchanged into the actuators' ctrl; do that, or "
                "give it an attribute policy_spec"
            )
        rate_hz = 1.0 / (float(data.time) - before)
        if not np.isclose(rate_hz, description.control_rate_hz, rtol=1e-3):
            raise ConfigurationError(
                f"--env {env} makes {rate_hz:.6g} steps a second, robot {description.name!r} takes "
                f"{description.control_rate_hz:g} commands; correct frame_skip, or control_rate_hz in "
                "robot.yaml"
            )
    return layout


def _plain_layout(description: RobotDescription, distribution: ParameterDistribution) -> PolicySpec:
    low, high = np.array(description.limits.target).T
    middle = centre(description)
    scale = np.minimum(middle - low, high - middle)
    if not (np.isfinite(scale) & (scale > 0)).all() or not np.isfinite(description.effort_limit).all():
        raise ConfigurationError(
            f"robot {description.name!r}: a policy's actions need a position_range around default_position "
            "and an effort_limit of every actuator; write them into robot.yaml"
        )
    terms = [
        ObservationTerm(quantity=quantity, joint=joint, scale=1.0)
        for quantity in ("position", "velocity")
        for joint in description.joint_names
    ]
    return PolicySpec.of_robot(description, terms, map(float, scale), trained_under=distribution.digest())


@dataclasses.dataclass(frozen=True, slots=True)
class _Control:
    """Map from actions in [-1, 1] to an environment's actions, (A,) each.

    Attributes:
        middle: Value at action 0.
        half: Change of the value at action 1.
        order: Index of each actuated joint among the environment's actions.
    """

    middle: FloatArray
    half: FloatArray
    order: Any

    def of(self, action: FloatArray) -> FloatArray:
        """Return the environment's action."""
        found = np.empty(len(action))
        found[self.order] = self.middle + self.half * action
        return found


def _control(env: Any, layout: PolicySpec, description: RobotDescription) -> _Control:
    A = len(layout.actuated)
    if getattr(env.unwrapped, "policy_spec", None) is not None:
        # Such an environment takes the policy's actions unchanged.
        return _Control(np.zeros(A), np.ones(A), np.arange(A))
    order = np.array([actuator_of(env.unwrapped.model, name) for name in layout.actuated])
    return _Control(centre(description), np.array(layout.action_scale), order)
