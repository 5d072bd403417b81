"""The humanoid's task: walk along the world's x axis at a given speed, stepping to a clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.locomotion import (
    ANGULAR,
    GRAVITY,
    HEADING,
    HEIGHT,
    LocomotionEnv,
    base,
    joint_terms,
    locomotion_spec,
    vector_terms,
)
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import Mirror, check_task
from deal_hw.policy import CLOCK_AXES, ObservationTerm, PolicySpec
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.sim.engine.model import load_model
from deal_hw.types import FloatArray

SIDES: Final = ("right", "left")
STEPS: Final = (0.0, 0.5)
"""Phase of each foot's step, right and left [turns]."""
CALM: Final = ("abdomen_y", "abdomen_z", "abdomen_x", "hip_x", "hip_z", "shoulder1", "shoulder2", "elbow")
"""Joints that a straight walk does not need; their deviation from the upright pose costs."""

SPRING_NM_RAD: Final = {
    "abdomen_y": 100.0,
    "abdomen_z": 60.0,
    "abdomen_x": 100.0,
    "hip_x": 80.0,
    "hip_z": 40.0,
    "hip_y": 120.0,
    "knee": 100.0,
    "ankle_y": 40.0,
    "ankle_x": 30.0,
    "shoulder1": 15.0,
    "shoulder2": 15.0,
    "elbow": 15.0,
}
"""Stiffness that the policy adds to each joint [N·m/rad]; the joints have dampers of their own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StrideTask:
    """Settings of the task; the defaults are what the shipped policy was trained with.

    Attributes:
        ticks: Control periods in an episode.
        speed_m_s: Wanted speed along the world's x axis.
        clock_hz: Steps of each foot per second.
        swing_share: Share of a step in which the foot is in the air.
        swing_m: Height of the foot in the middle of a step.
        alive_reward: Reward of a tick without a fall.
        speed_weight: Reward of the wanted speed; falls linearly to 0 at rest.
        gait_weight: Reward of feet at the height that the clock wants, mean over the feet; feet that stay on
            the floor earn nothing on average.
        drift_weight: Cost of the squared speed to the side [s²/m²].
        heading_weight: Cost of 1 minus the cosine of the heading.
        tilt_weight: Cost of the squared horizontal part of gravity's direction.
        bounce_weight: Cost of the squared vertical velocity [s²/m²].
        roll_weight: Cost of the squared roll and pitch rates [s²/rad²].
        pose_weight: Cost of the squared deviation of trunk, arms and two hip axes from the upright pose
            [1/rad²].
        control_weight: Cost of the sum of squared actions.
        action_weight: Cost of the squared change of the action.
        fall_cost: Cost of falling.
        least_height_m: Torso height below which it has fallen.
        largest_tilt: Cosine of the torso's tilt below which it has fallen.
        start_noise_rad: Largest deviation of joints at the start.
        start_speed_m_s: Highest forward speed at the start; half of the episodes start at rest.
        spring_factor: Factor on the policy's springs (``SPRING_NM_RAD``).
    """

    ticks: int = 500
    speed_m_s: float = 1.0
    clock_hz: float = 1.25
    swing_share: float = 0.5
    swing_m: float = 0.08
    alive_reward: float = 1.0
    speed_weight: float = 3.0
    gait_weight: float = 6.0
    drift_weight: float = 1.0
    heading_weight: float = 2.0
    tilt_weight: float = 2.0
    bounce_weight: float = 0.5
    roll_weight: float = 0.05
    pose_weight: float = 0.2
    control_weight: float = 0.02
    action_weight: float = 0.01
    fall_cost: float = 10.0
    least_height_m: float = 0.9
    largest_tilt: float = 0.7
    start_noise_rad: float = 0.05
    start_speed_m_s: float = 1.0
    spring_factor: float = 1.0

    def __post_init__(self) -> None:
        check_task(self, "speed_m_s", "clock_hz", "swing_m")
        if not 0 < self.swing_share < 1:
            raise ConfigurationError(f"swing_share must lie in (0, 1), got {self.swing_share!r}")


def stride_spec(
    description: RobotDescription, trained_under: str = "", task: StrideTask | None = None
) -> PolicySpec:
    """Return the layout of observation and action: state without the place, clock, last action."""
    task = task or StrideTask()
    terms = [ObservationTerm("height", "z", 2.0), *vector_terms("gravity", 1.0)]
    terms += [*vector_terms("heading", 1.0), *vector_terms("linear_velocity", 0.5)]
    terms += [*vector_terms("angular_velocity", 0.2), *(ObservationTerm("clock", a, 1.0) for a in CLOCK_AXES)]
    terms += joint_terms(description, 0.1)
    scale = (1.0,) * len(description.actuated)
    return locomotion_spec(description, terms, scale, trained_under, clock_hz=task.clock_hz)


_REVERSED: Final[Mapping[str, tuple[str, ...]]] = {
    "gravity": ("y",),
    "heading": ("y",),
    "linear_velocity": ("y",),
    "angular_velocity": ("x", "z"),
    "clock": CLOCK_AXES,
}
"""Axes of base quantities that change their sign in a reflection; the clock moves on by half a turn."""


def _kind(joint: str) -> str:
    """Return the name of a joint without its side."""
    return joint.removeprefix("right_").removeprefix("left_")


def _other_side(joint: str) -> str:
    for side, other in (("right_", "left_"), ("left_", "right_")):
        if joint.startswith(side):
            return other + joint.removeprefix(side)
    return joint


def _joint_signs(model: Any, joints: Sequence[str]) -> dict[str, float]:
    """Return the sign with which each joint's angle becomes that of its counterpart in a reflection."""
    # A rotation about (x, y, z) is reflected to one about (-x, y, -z).
    axis = {name: model.jnt_axis[model.joint(name).id] for name in joints}
    return {name: float(np.sign(axis[_other_side(name)] @ (axis[name] * (-1, 1, -1)))) for name in joints}


def _mirror(pairs: Sequence[tuple[int, float]]) -> Mirror:
    source, sign = zip(*pairs, strict=True)
    return Mirror(source, sign)


class HumanoidEnv(LocomotionEnv):
    """Walk along the world's x axis at a given speed, stepping to a clock; it starts standing.

    The reward of a tick, from the true state after it, with angular velocities in the torso's frame, is::

        alive_reward + speed_weight max(-1, 1 - |vx - speed| / speed)
        + gait_weight max(-1, 1 - pi / swing_m mean over feet of |h - wanted h|)
        - drift_weight vy² - heading_weight (1 - cos heading) - tilt_weight (gx² + gy²)
        - bounce_weight vz² - roll_weight (wx² + wy²) - pose_weight |q_calm|²
        - control_weight |a|² - action_weight |a - a_before|²

    and -fall_cost in the tick in which the torso tilts or sinks too far, which ends the episode. q_calm are
    the joints of trunk and arms and those that spread or turn the legs. The wanted height of a foot is half a
    sine in its swing and zero else. A start with some speed asks for steps: a humanoid that has learnt to
    stand still loses much by a fall, and hardly tries to step.

    Args:
        description: The humanoid.
        distribution: Distribution of each member's parameters and latency.
        count: Members N.
        task: The settings.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.
    """

    settle_s = 0.0

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        count: int,
        *,
        task: StrideTask | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
    ) -> None:
        self.task = task = task or StrideTask()
        self.failure_reward = -task.fall_cost
        self._sums: dict[str, float] = {}
        super().__init__(
            description,
            distribution,
            stride_spec(description, distribution.digest(), task=task),
            count,
            ticks=task.ticks,
            start_noise=task.start_noise_rad,
            threads=threads,
            engine=engine,
        )
        model = load_model(description).model
        names = [model.geom(k).name for k in range(model.ngeom)]
        # Each foot has two capsules.
        self._capsules = [names.index(n) for side in SIDES for n in names if n.endswith(f"_{side}_foot")]
        self._radius = float(model.geom_size[self._capsules[0], 0])
        self._places = self.loop.batch.engine.bind("geom_xpos")
        self._calm = [6 + i for i, name in enumerate(description.joint_names) if _kind(name) in CALM]

    def feedback(self) -> FloatArray:
        """Return springs about the upright pose: a network then learns poses instead of torques."""
        found = super().feedback()
        for row, name in enumerate(self.layout.actuated):
            column = self.layout.observation.index(ObservationTerm("position", name, 1.0))
            gear = self.description.effort_limit[row]
            found[row, column] = -self.task.spring_factor * SPRING_NM_RAD[_kind(name)] / gear
        return found

    def mirror(self) -> tuple[Mirror, Mirror]:
        """Return the reflections in the vertical plane ahead: left and right change places."""
        terms, description = self.layout.observation, self.description
        signs = _joint_signs(load_model(description).model, description.joint_names)
        found: list[tuple[int, float]] = []
        for k, term in enumerate(terms):
            if term.joint in signs:
                other = dataclasses.replace(term, joint=_other_side(term.joint))
                found.append((terms.index(other), signs[term.joint]))
            else:
                found.append((k, -1.0 if term.joint in _REVERSED.get(term.quantity, ()) else 1.0))
        actuated = self.layout.actuated
        actions = [(actuated.index(_other_side(name)), signs[name]) for name in actuated]
        return _mirror(found), _mirror(actions)

    def begin_episodes(self, where: BoolArray, rng: np.random.Generator) -> None:
        """Draw the clocks' phases of the restarted members: either foot may begin."""
        self._builder.clock[where] = 0.5 * rng.integers(2, size=int(where.sum()))

    def start_state(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Draw standing robots, half of them with a forward speed."""
        position, velocity = super().start_state(rng, count)
        velocity[:, 0] = np.maximum(rng.uniform(-1.0, 1.0, count), 0.0) * self.task.start_speed_m_s
        return position, velocity

    def forward_speed(self) -> FloatArray:
        """Return the speeds along the world's x axis, (N,) [m/s]."""
        return self.loop.velocity[:, 0]

    def wanted_speed(self) -> FloatArray:
        """Return the wanted speeds along the world's x axis, (N,) [m/s]."""
        return np.full(self.num_envs, self.task.speed_m_s)

    def foot_heights(self) -> FloatArray:
        """Return the heights of the feet's soles, right and left, (N, 2) [m]; mean of a foot's capsules."""
        heights = self._places[:, self._capsules, 2] - self._radius
        return np.asarray(heights.reshape(-1, 2, 2).mean(axis=2))

    def wanted_heights(self) -> FloatArray:
        """Return the heights that the clocks want, (N, 2) [m]: half a sine in the first part of a step."""
        share = ((self._builder.clock[:, None] + STEPS) % 1.0) / self.task.swing_share
        return np.where(share < 1.0, self.task.swing_m * np.sin(np.pi * share), 0.0)

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        task, seen = self.task, base(position, velocity)
        speed = 1.0 - np.abs(velocity[:, 0] - task.speed_m_s) / task.speed_m_s
        lag = np.abs(self.foot_heights() - self.wanted_heights()).mean(axis=1)
        gait = np.maximum(1.0 - np.pi * lag / task.swing_m, -1.0)
        reward = task.alive_reward + task.speed_weight * np.maximum(speed, -1.0) + task.gait_weight * gait
        reward -= task.drift_weight * np.square(velocity[:, 1])
        reward -= task.heading_weight * (1.0 - seen[:, HEADING][:, 0])
        reward -= task.tilt_weight * np.square(seen[:, GRAVITY][:, :2]).sum(axis=1)
        reward -= task.bounce_weight * np.square(velocity[:, 2])
        reward -= task.roll_weight * np.square(seen[:, ANGULAR][:, :2]).sum(axis=1)
        reward -= task.pose_weight * np.square(position[:, self._calm]).sum(axis=1)
        reward -= task.control_weight * np.square(action).sum(axis=1)
        reward -= task.action_weight * np.square(action - before).sum(axis=1)
        # Without the members that diverged in this tick.
        self._note(speed_m_s=np.nanmean(velocity[:, 0]), gait=np.nanmean(gait))
        return np.asarray(reward)

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return which robots fell."""
        seen = base(position, velocity)
        tilted = -seen[:, GRAVITY][:, 2] < self.task.largest_tilt
        return np.asarray(tilted | (seen[:, HEIGHT] < self.task.least_height_m))

    def measures(self) -> dict[str, float]:
        """Return the share of time up, and the mean speed [m/s] and gait reward since the last call."""
        ticks = self._sums.pop("ticks", 0.0)
        sums, self._sums = self._sums, {}
        return {**super().measures(), **{name: total / ticks for name, total in sums.items()}}

    def _note(self, **values: Any) -> None:
        self._sums["ticks"] = self._sums.get("ticks", 0.0) + 1.0
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + float(value)
