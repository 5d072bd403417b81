"""The walking task of the Go2: follow a commanded velocity behind the safety filter, without falling."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np

from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterDistribution
from deal_hw.policies.locomotion import (
    ANGULAR,
    GRAVITY,
    LINEAR,
    LocomotionEnv,
    base,
    joint_terms,
    locomotion_spec,
    vector_terms,
)
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import check_task
from deal_hw.policy import AXES, CLOCK_AXES, Observation, ObservationTerm, PolicySpec
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.parameters.fields import element_id
from deal_hw.types import FloatArray, JointCommand

ACTION_SCALE_RAD: Final = {"hip": 0.3, "thigh": 0.6, "calf": 0.6}
"""Largest distance of targets from the standing pose: enough for a trot, and within the ranges."""
TROT: Final = (0.0, 0.5, 0.5, 0.0)
"""Phase of each leg's step, FL, FR, RL, RR [turns]: diagonal legs step together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkTask:
    """Settings of the task; the defaults are what the shipped policy was trained with.

    Attributes:
        ticks: Control periods in an episode.
        physics_step_s: Physics step [s].
        clock_hz: Steps of each leg per second.
        swing_share: Share of a step in which the foot is in the air.
        swing_m: Height of the foot in the middle of a step.
        command_range: Lowest and highest commanded velocity: ahead, left [m/s], turn [rad/s], (3, 2).
        command_ticks: Mean number of control periods between two commands.
        standing: Share of commands to stand.
        zeroed: Share of zero components of a command.
        tracking_weight: Reward of following the commanded velocity ahead and to the left.
        tracking_width: Squared error of the velocity at which that reward falls to 1/e [m²/s²].
        turn_weight: Reward of following the commanded yaw rate.
        turn_width: Squared error of the yaw rate at which that reward falls to 1/e [rad²/s²].
        gait_weight: Reward of feet at the height that the clock wants, mean over the feet; zero at an error
            of ``swing_m``.
        alive_reward: Reward of a tick without a fall.
        tilt_weight: Cost of the squared horizontal part of gravity's direction.
        height_weight: Cost of the squared deviation from ``height_m`` [1/m²].
        height_m: Wanted height of the base.
        bounce_weight: Cost of the squared vertical velocity [s²/m²].
        roll_weight: Cost of the squared roll and pitch rates [s²/rad²].
        slip_weight: Cost of the squared horizontal speed of feet that should stand [s²/m²].
        hip_weight: Cost of the squared deviation of the hips from the default pose [1/rad²].
        pose_weight: The same of all joints while the command is to stand [1/rad²].
        action_weight: Cost of the squared change of the action.
        clip_weight: Cost of the squared change of a target by the safety filter [1/rad²].
        speed_weight: Cost of the squared excess of the joint speed, as share of the safety module's trip
            speed, over ``calm_share``, summed over the joints.
        calm_share: See ``speed_weight``.
        fall_cost: Cost of falling.
        lowest_m: Height of the base below which it has fallen.
        largest_tilt: Cosine of the tilt below which it has fallen; the safety module trips at 0.8 rad.
        start_noise_rad: Largest deviation of joints at the start.
        start_speed: Largest speed of the base at the start, each axis [m/s].
        host_delay_s: Lowest and highest delay of the host, added to the latency [s].
        orientation_noise_rad: Noise of the reported orientation, each axis.
        gyro_noise_rad_s: Noise of the reported angular velocity.
        velocity_noise_rad_s: Noise of the reported joint velocities.
        encoder_bias_rad: Largest bias of joint encoders.
        friction: Lowest and highest friction of the floor.
        payload_kg: Lowest and highest mass added to the trunk.
        push_ticks: Mean number of control periods between two pushes.
        push_m_s: Largest change of the base's horizontal velocity by a push, each axis.
    """

    ticks: int = 500
    physics_step_s: float = 0.004
    clock_hz: float = 2.5
    swing_share: float = 0.5
    swing_m: float = 0.06
    command_range: tuple[tuple[float, float], ...] = ((-0.6, 1.0), (-0.5, 0.5), (-1.0, 1.0))
    command_ticks: int = 200
    standing: float = 0.1
    zeroed: float = 0.25
    tracking_weight: float = 1.5
    tracking_width: float = 0.2
    turn_weight: float = 0.8
    turn_width: float = 0.2
    gait_weight: float = 2.0
    alive_reward: float = 0.3
    tilt_weight: float = 3.0
    height_weight: float = 20.0
    height_m: float = 0.27
    bounce_weight: float = 0.5
    roll_weight: float = 0.03
    slip_weight: float = 0.1
    hip_weight: float = 0.3
    pose_weight: float = 0.3
    action_weight: float = 0.03
    clip_weight: float = 1.0
    speed_weight: float = 5.0
    calm_share: float = 0.6
    fall_cost: float = 10.0
    lowest_m: float = 0.15
    largest_tilt: float = 0.7
    start_noise_rad: float = 0.05
    start_speed: float = 0.3
    host_delay_s: tuple[float, float] = (0.0, 0.006)
    orientation_noise_rad: float = 4e-3
    gyro_noise_rad_s: float = 0.02
    velocity_noise_rad_s: float = 0.05
    encoder_bias_rad: float = 0.02
    friction: tuple[float, float] = (0.4, 1.2)
    payload_kg: tuple[float, float] = (-0.5, 2.0)
    push_ticks: int = 200
    push_m_s: float = 0.5

    def __post_init__(self) -> None:
        positive = "tracking_width turn_width swing_m physics_step_s clock_hz command_ticks push_ticks"
        check_task(self, *positive.split())
        for name, pair in (
            *((f"command_range[{i}]", pair) for i, pair in enumerate(self.command_range)),
            ("host_delay_s", self.host_delay_s),
            ("friction", self.friction),
            ("payload_kg", self.payload_kg),
        ):
            if not pair[0] <= pair[1]:
                raise ConfigurationError(f"{name} must be (low, high) with low <= high, got {pair}")
        for name in ("standing", "zeroed", "swing_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigurationError(f"{name} must lie in [0, 1], got {getattr(self, name)!r}")


def walk_spec(
    description: RobotDescription, trained_under: str = "", task: WalkTask | None = None
) -> PolicySpec:
    """Return the layout of observation and action: joints, gyro, gravity, command, clock, the last action.

    Only what a real Go2 measures: no base velocity, no height.
    """
    task = task or WalkTask()
    terms = [*vector_terms("gravity", 1.0), *vector_terms("angular_velocity", 0.25)]
    terms += [*vector_terms("command", 1.0), *(ObservationTerm("clock", axis, 1.0) for axis in CLOCK_AXES)]
    terms += joint_terms(description, 0.05)
    scale = [ACTION_SCALE_RAD[name.split("_")[1]] for name in description.actuated]
    # A robot that was also trained to stand may be asked for less than the slowest velocity.
    reach = [
        (min(low, 0.0), max(high, 0.0)) if task.standing else (low, high) for low, high in task.command_range
    ]
    more = {"clock_hz": task.clock_hz, "command_range": tuple(reach)}
    return locomotion_spec(description, terms, scale, trained_under, **more)


class Go2Env(LocomotionEnv):
    """Follow a velocity that changes now and then, trotting to a clock, behind the safety filter.

    Targets pass the filter of deploying, with the reported state, before they are sent. The reward of a tick,
    from the true state after it, with velocities in the base's frame, is::

        tracking_weight exp(-|v_xy - command_xy|² / tracking_width)
        + turn_weight exp(-(wz - command_z)² / turn_width)
        + gait_weight mean over feet of (1 - |h - wanted h| / swing_m) + alive_reward
        - tilt_weight (gx² + gy²) - height_weight (z - height_m)²
        - bounce_weight vz² - roll_weight (wx² + wy²)
        - slip_weight sum over feet that should stand of their squared horizontal speed
        - hip_weight |q_hips - default|² - pose_weight |q - default|² where the command is to stand
        - action_weight |a - a_before|² - clip_weight |target sent - target requested|²
        - speed_weight sum over joints of max(0, |joint speed| / trip speed - calm_share)²

    and -fall_cost in the tick in which the base tilts or sinks too far, which ends the episode.

    Args:
        description: The robot's description of its driver: with feet, and with limits for legs.
        distribution: Distribution of each member's parameters and latency.
        count: Members N.
        task: The settings.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.

    Raises:
        ConfigurationError: The description does not name four feet.
    """

    task_type: ClassVar[type[WalkTask]] = WalkTask
    """Class of the settings; its defaults where none are given."""

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        count: int,
        *,
        task: WalkTask | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
    ) -> None:
        self.task = task = task or self.task_type()
        self.failure_reward = -task.fall_cost
        if len(description.feet) != len(TROT):
            raise ConfigurationError(
                f"robot {description.name!r} has {len(description.feet)} feet in its description; walking "
                f"needs {len(TROT)}: give the driver's description"
            )
        self._filter = SafetyFilter(description)
        layout = self.spec_of(description, distribution.digest(), task)
        zeros = np.zeros((count, len(layout.actuated)))

        def every(values: Sequence[float]) -> FloatArray:
            return np.tile(values, (count, 1))

        self._template = JointCommand(
            position_target=zeros,
            velocity_target=zeros,
            effort=zeros,
            stiffness=every(layout.stiffness),
            damping=every(layout.damping),
            effort_limit=every(layout.effort_limit),
            speed_limit=every(layout.speed_limit),
        )
        self._sent, self._cut = zeros.copy(), zeros
        self._sums: dict[str, float] = {}
        super().__init__(
            description,
            distribution,
            layout,
            count,
            ticks=task.ticks,
            start_noise=task.start_noise_rad,
            host_delay_s=task.host_delay_s,
            threads=threads,
            engine=engine,
            step_s=task.physics_step_s,
        )
        model = self.loop.batch.robot.model
        self._feet = [element_id(model, "geom", name) for name in description.feet]
        self._radius = model.geom_size[self._feet, 0]
        self._places = self.loop.batch.engine.bind("geom_xpos")
        self._feet_before = np.full((count, len(TROT), 3), np.nan)
        self._hips = [i for i, name in enumerate(description.joint_names) if "hip" in name]

    @staticmethod
    def spec_of(description: RobotDescription, trained_under: str, task: WalkTask) -> PolicySpec:
        """Return the layout of observation and action."""
        return walk_spec(description, trained_under, task)

    @property
    def command(self) -> FloatArray:
        """The commanded velocity of each member's base: x, y [m/s] and yaw rate [rad/s], (N, 3)."""
        return self._builder.command

    def surroundings(self) -> Sequence[Parameter]:
        """Return the parameters of floor, payload and encoders."""
        task = self.task
        trunk = str(self.description.floating_base)
        mass = float(load_model(self.description).model.body(trunk).mass[0])
        low, high = task.payload_kg
        bias = (-task.encoder_bias_rad, task.encoder_bias_rad)
        return [
            _drawn("geom_friction", "floor", "-", task.friction),
            _drawn("body_mass", trunk, "kg", (mass + low, mass + high)),
            *(_drawn("encoder_bias", joint, "rad", bias) for joint in self.description.joint_names),
        ]

    def wanted_speed(self) -> FloatArray:
        """Return the commanded forward speeds, (N,) [m/s]."""
        return self.command[:, 0]

    def begin_episodes(self, where: BoolArray, rng: np.random.Generator) -> None:
        """Draw the commands and the clocks' phases of the restarted members."""
        self._draw_commands(where, rng)
        self._builder.clock[where] = rng.random(int(where.sum()))
        self._sent[where] = self._default
        # After a state is set, its feet are known one step later; until then none slips.
        self._feet_before[where] = np.nan

    def base_height(self, position: FloatArray) -> FloatArray:
        """Return the heights of bases over their ground, (N,) [m], at coordinates (N, C)."""
        return np.asarray(position[:, 2])

    def start_state(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Draw settled robots with a small motion of their bases."""
        position, velocity = super().start_state(rng, count)
        velocity[:, :2] = rng.uniform(-1.0, 1.0, (count, 2)) * self.task.start_speed
        return position, velocity

    def limited(self, action: FloatArray, before: FloatArray) -> FloatArray:
        """Return the actions unchanged: the policy observes its own request, as when deployed."""
        return action

    def target(self, action: FloatArray) -> FloatArray:
        """Return the targets after the safety filter; lowered gains are set."""
        wanted = dataclasses.replace(self._template, position_target=super().target(action))
        joints = self.loop.batch.robot.joints
        measured, velocity = (
            x[:, joints] for x in (self.loop.reported_position, self.loop.reported_velocity)
        )
        command, _ = self._filter.clip(wanted, self._sent, measured, velocity)
        self.loop.batch.set_sent(command.stiffness, command.damping, command.effort_limit)
        self._cut = command.position_target - wanted.position_target
        self._sent = command.position_target
        return self._sent

    def sensed(self) -> tuple[FloatArray, FloatArray]:
        """Return the reported state, with the noise of the inertial sensor and of joint velocities."""
        task, rng = self.task, self.np_random
        position, velocity = self.loop.reported_position.copy(), self.loop.reported_velocity.copy()
        position[:, 3:6] += rng.standard_normal((self.num_envs, 3)) * task.orientation_noise_rad
        velocity[:, 3:6] += rng.standard_normal((self.num_envs, 3)) * task.gyro_noise_rad_s
        velocity[:, 6:] += rng.standard_normal(velocity[:, 6:].shape) * task.velocity_noise_rad_s
        return position, velocity

    def privileged(self) -> FloatArray:
        """Return the true velocity and height of the bases, and the heights of the feet, (N, P)."""
        seen = base(self.loop.position, self.loop.velocity)
        feet = 10.0 * (self._feet_now()[..., 2] - self._radius)
        return np.hstack([seen[:, LINEAR], 4.0 * self.base_height(self.loop.position)[:, None], feet])

    def motion_names(self) -> tuple[str, ...]:
        """Return the names of the features of :meth:`motion`."""
        vectors = [f"{name}_{axis}" for name in ("gravity", "velocity", "turn") for axis in AXES]
        joints = self.description.joint_names
        return (*vectors, "height", *joints, *(f"{name}_velocity" for name in joints))

    def motion(self) -> FloatArray:
        """Return what the bodies do, (N, F): gravity and velocities in the base's frame, height, joints."""
        position, velocity = self.loop.position, self.loop.velocity
        seen = base(position, velocity)
        vectors = [seen[:, GRAVITY], seen[:, LINEAR], seen[:, ANGULAR], self.base_height(position)[:, None]]
        return np.hstack([*vectors, position[:, 6:], velocity[:, 6:]])

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        task, seen = self.task, base(position, velocity)
        linear, angular, command = seen[:, LINEAR], seen[:, ANGULAR], self.command
        error = np.square(linear[:, :2] - command[:, :2]).sum(axis=1)
        turn = np.square(angular[:, 2] - command[:, 2])
        moving = np.any(command != 0.0, axis=1)
        feet = self._feet_now()
        wanted = self._wanted_heights() * moving[:, None]
        gait = 1.0 - self._foot_errors(feet[..., 2] - self._radius - wanted).mean(axis=1)
        speed = (feet - self._feet_before)[..., :2] * self.description.control_rate_hz
        slip = np.nan_to_num(np.square(speed).sum(axis=2) * (wanted == 0.0)).sum(axis=1)
        self._feet_before = feet.copy()
        pose = np.square(position[:, 6:] - self.description.default_position)
        reward = task.tracking_weight * np.exp(-error / task.tracking_width) + task.alive_reward
        reward += task.turn_weight * np.exp(-turn / task.turn_width)
        reward += task.gait_weight * gait
        reward -= task.tilt_weight * np.square(seen[:, GRAVITY][:, :2]).sum(axis=1)
        height = self.base_height(position)
        reward -= task.height_weight * np.square(height - task.height_m)
        reward -= task.bounce_weight * np.square(linear[:, 2])
        reward -= task.roll_weight * np.square(angular[:, :2]).sum(axis=1)
        reward -= task.slip_weight * slip
        reward -= task.hip_weight * pose[:, self._hips].sum(axis=1)
        reward -= task.pose_weight * pose.sum(axis=1) * ~moving
        reward -= task.clip_weight * np.square(self._cut).sum(axis=1)
        reward -= task.action_weight * np.square(action - before).sum(axis=1)
        share = np.abs(velocity[:, 6:]) / self.description.limits.trip_velocity
        fast = np.square(np.maximum(share - task.calm_share, 0.0)).sum(axis=1)
        reward -= task.speed_weight * fast
        self._note(
            # Without the members that diverged in this tick.
            velocity_error_m_s=np.nanmean(np.sqrt(error)),
            yaw_error_rad_s=np.nanmean(np.sqrt(turn)),
            clipped=np.any(np.abs(self._cut) > 1e-9, axis=1).mean(),
            height_m=np.nanmean(height),
            gait=np.nanmean(gait),
            slip=slip.mean(),
        )
        return np.asarray(reward)

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return which robots fell."""
        seen = base(position, velocity)
        tilted = -seen[:, GRAVITY][:, 2] < self.task.largest_tilt
        return np.asarray(tilted | (self.base_height(position) < self.task.lowest_m))

    def step(
        self, actions: FloatArray
    ) -> tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Push some members and draw new commands for some; the rest is as in every environment."""
        rng, task = self.np_random, self.task
        pushed = np.flatnonzero(rng.random(self.num_envs) < 1.0 / task.push_ticks)
        if pushed.size:
            position, velocity = self.loop.position[pushed], self.loop.velocity[pushed]
            velocity[:, :2] += rng.uniform(-1.0, 1.0, (pushed.size, 2)) * task.push_m_s
            self.loop.set_state(position, velocity, pushed)
        self._draw_commands(rng.random(self.num_envs) < 1.0 / task.command_ticks, rng)
        result = super().step(actions)
        self._note(falls=float(result[2].sum()))
        return result

    def measures(self) -> dict[str, float]:
        """Return the mean errors of the velocity, and falls per minute."""
        ticks = self._sums.pop("ticks", 0.0)
        sums, self._sums = self._sums, {}
        if not ticks:
            return {}
        found = {name: total / ticks for name, total in sums.items()}
        minutes = self.num_envs / (60.0 * self.description.control_rate_hz)
        falls = found.pop("falls")
        return {**found, "falls_a_minute": falls / minutes}

    def _note(self, **values: Any) -> None:
        if "falls" in values:
            self._sums["ticks"] = self._sums.get("ticks", 0.0) + 1.0
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + float(value)

    def _draw_commands(self, where: BoolArray, rng: np.random.Generator) -> None:
        count = int(where.sum())
        if not count:
            return
        low, high = np.array(self.task.command_range).T
        drawn = rng.uniform(low, high, (count, 3))
        drawn[rng.random((count, 3)) < self.task.zeroed] = 0.0
        drawn[rng.random(count) < self.task.standing] = 0.0
        self._builder.command[where] = drawn

    def _feet_now(self) -> FloatArray:
        return np.asarray(self._places[:, self._feet])

    def _foot_errors(self, error: FloatArray) -> FloatArray:
        """Return the unitless errors of the feet's heights, (N, 4), of those in [m]."""
        return np.asarray(np.abs(error) / self.task.swing_m)

    def _wanted_heights(self) -> FloatArray:
        """Return the wanted heights of the feet, (N, 4) [m]: half a sine in the first part of a step."""
        share = ((self._builder.clock[:, None] + TROT) % 1.0) / self.task.swing_share
        return np.where(share < 1.0, self.task.swing_m * np.sin(np.pi * share), 0.0)


def _drawn(kind: str, element: str, unit: str, ends: tuple[float, float]) -> Parameter:
    """Return a parameter that is uniform between the ends; known if they are equal."""
    low, high = ends
    room = 0.0 if low < high else 1.0
    return Parameter(
        name=f"{element}.{kind}",
        kind=kind,
        elements=(element,),
        unit=unit,
        nominal=0.5 * (low + high),
        low=low - room,
        high=high + room,
        scale="linear",
        known=low == high,
    )
