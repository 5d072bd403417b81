"""Tries a walking policy in the simulator, beside a robot that stands still, before it may move a robot.

A policy of another trainer can be sound and still wrong for a robot: two legs exchanged, an axis with the
wrong sign, a factor left out. Its answers are finite then, and look like others. So it walks on simulated
robots behind the safety filter, at a few commands of its training range. It must stay up as long as robots
that stand still, and at each command come nearer to the commanded velocity than they do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol

import numpy as np

from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.description import RobotDescription
from deal_hw.motions.behaviours import ActionMap, position_command
from deal_hw.parameters import ParameterSpace
from deal_hw.policies.servo_loop import BoolArray, ServoLoop
from deal_hw.policy import AXES, Observation, ObservationBuilder, PolicySpec, base_features
from deal_hw.sim.legged.floor import on_floor
from deal_hw.types import FloatArray, JointCommand

UNCOUNTED_S: Final = 1.5
"""First part of a walk, in which the robot gets up to speed; only falls count there [s]."""
SETTLING_S: Final = 1.0
"""Time in which the robots settle in their default pose before [s]."""
UNHUNG_SETTLING_S: Final = 0.2
"""The same of robots that are set on a floor: humanoids fall soon without a policy [s]."""
SPEED: Final = 0.5
TURN: Final = 0.6
"""Commands of the trial, where the training range has them [m/s, rad/s]."""
LEAST: Final = 0.1
"""Commands shorter than this are not told apart from standing."""
LATENCY_S: Final = (0.002, 0.012)
ORIENTATION_NOISE_RAD: Final = 4e-3
GYRO_NOISE_RAD_S: Final = 0.02
SPEED_NOISE_RAD_S: Final = 0.05
TILT_RAD: Final = 0.8
SUNK: Final = 0.5
"""Share of its height at the start below which a base has fallen."""
LEAST_FOLLOWED: Final = 0.3
"""Least share of a command that is followed; standing still has 0."""
LEAST_UP: Final = 0.02
"""Time up may be this much shorter than that of standing still, as share of the walk."""

_GRAVITY_Z, _LINEAR, _TURN_RATE = 2, slice(9, 11), 8
"""Columns of :func:`deal_hw.policy.base_features`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkingTrial:
    """Size of a trial.

    Attributes:
        seconds: Length of a walk [s].
        robots: Robots for each command; they differ in latency and noise.
        seed: Seeds latency and noise.
    """

    seconds: float = 6.0
    robots: int = 4
    seed: int = 0


class TriedPolicy(Protocol):
    """A policy that acts for many robots at once."""

    @property
    def spec(self) -> PolicySpec:
        """What the policy observes and what its action means."""
        ...

    def reset(self) -> None:
        """Clear the memory."""
        ...

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions, (B, A), for observations, (B, O)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkAtCommand:
    """How robots did at one command.

    Attributes:
        command: The commanded velocity, x, y [m/s] and yaw rate [rad/s].
        velocity: The mean velocity of those that stayed up, in the base's frame; NaN if none did.
        up: Share of the time before a fall, mean over the robots.
        followed: Share of the command that was followed: 1 is all of it, 0 is standing still, below 0 is
            worse. A robot that falls counts as 0 at best. 0 for the command to stand.
    """

    command: tuple[float, float, float]
    velocity: tuple[float, float, float]
    up: float
    followed: float


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkingReport:
    """Result of a trial.

    Attributes:
        walks: The policy at each command.
        standing: The same of robots that hold their default pose.
        clipped: Share of the time in which the safety filter changed a target.
        seconds: Length of each walk [s].
    """

    walks: tuple[WalkAtCommand, ...]
    standing: tuple[WalkAtCommand, ...]
    clipped: float
    seconds: float

    @property
    def up(self) -> float:
        """Share of the time before a fall, mean over all robots."""
        return float(np.mean([walk.up for walk in self.walks]))

    def faults(self) -> tuple[str, ...]:
        """Return what is wrong, as sentences; empty if the policy may be used."""
        found = []
        for walk, still in zip(self.walks, self.standing, strict=True):
            name = describe_command(walk.command)
            if walk.up < still.up - LEAST_UP:
                found.append(
                    f"{name}: it falls after {walk.up * self.seconds:.1f} s of {self.seconds:g} s (mean); "
                    f"a robot that stands still stays up for {still.up * self.seconds:.1f} s"
                )
            elif any(walk.command) and walk.followed < LEAST_FOLLOWED:
                reached = ", ".join(f"{value:.2f}" for value in walk.velocity)
                found.append(
                    f"{name}: it reaches {reached} (x, y [m/s], yaw [rad/s]), which follows "
                    f"{walk.followed:.0%} of the command; standing still 0%, needed are {LEAST_FOLLOWED:.0%}"
                )
        return tuple(found)


TRIAL: Final = WalkingTrial()
"""The trial of an import: measured to find nearly all exchanged joints and signs (docs/measured)."""


def can_try(spec: PolicySpec, description: RobotDescription, feet: Sequence[str] = ()) -> str:
    """Return why a policy cannot be tried by walking; "" if it can.

    Args:
        spec: The policy's spec.
        description: The robot.
        feet: Geoms of the feet of a robot that hangs in its own model.
    """
    if (description.floating_base is None and not feet) or description.actuation != "position":
        return f"robot {description.name!r} does not walk"
    if not any(term.quantity == "command" for term in spec.observation):
        return "the policy follows no commanded velocity"
    return ""


def trial_commands(spec: PolicySpec) -> list[tuple[float, float, float]]:
    """Return the commands of a trial: standing, and each direction that the training range has."""
    low, high = np.array(spec.command_range or ((-SPEED, SPEED), (-SPEED, SPEED), (-TURN, TURN))).T
    found = [np.zeros(3)]
    for axis, most in enumerate((SPEED, SPEED, TURN)):
        for wanted in (most, -most):
            command = np.clip(np.eye(3)[axis] * wanted, low, high)
            if np.linalg.norm(command) >= LEAST and not any(np.allclose(command, c) for c in found):
                found.append(command)
    return [(float(x), float(y), float(z)) for x, y, z in found]


def describe_command(command: Sequence[float]) -> str:
    """Return a command in words."""
    names = (("ahead", "back", "m/s"), ("left", "right", "m/s"), ("turn left", "turn right", "rad/s"))
    parts = [
        f"{forward if value > 0 else backward} {abs(value):.2g} {unit}"
        for value, (forward, backward, unit) in zip(command, names, strict=True)
        if abs(value) > 1e-9
    ]
    return ", ".join(parts) or "stand"


def try_walking(
    policy: TriedPolicy,
    description: RobotDescription,
    trial: WalkingTrial = TRIAL,
    *,
    feet: Sequence[str] = (),
    threads: int | None = None,
) -> WalkingReport:
    """Let simulated robots walk with a policy, and others stand still.

    A robot that hangs in its own model is set on a floor, in the policy's default pose and with its gains:
    the robot's own are those for limbs in the air.

    Args:
        policy: The policy.
        description: The robot, as its driver describes it; :func:`can_try` must allow it.
        trial: How many robots walk for how long.
        feet: Geoms of the feet of a robot that hangs in its own model; () for one that stands there.
        threads: Threads of the physics; None for all CPUs.
    """
    commands = trial_commands(policy.spec)
    run = _Run(policy.spec, description, commands, trial, feet, threads)
    walks = run.walks(policy)
    clipped = run.clipped
    return WalkingReport(walks=walks, standing=run.walks(None), clipped=clipped, seconds=trial.seconds)


class _Run:
    """Robots that walk at the commands, or stand."""

    def __init__(
        self,
        spec: PolicySpec,
        description: RobotDescription,
        commands: Sequence[tuple[float, float, float]],
        trial: WalkingTrial,
        feet: Sequence[str],
        threads: int | None,
    ) -> None:
        hangs = bool(feet)
        if hangs:
            description = dataclasses.replace(
                description,
                default_position=spec.default_position,
                stiffness=spec.stiffness,
                damping=spec.damping,
            )
        self._spec, self._description, self._commands = spec, description, commands
        self._settling_s = UNHUNG_SETTLING_S if hangs else SETTLING_S
        legs = description.limits.legs
        # The limit of a robot that hangs is that of its crane.
        self._tilt = TILT_RAD if hangs or legs is None else min(legs.tilt, TILT_RAD)
        self._robots, self._seed = trial.robots, trial.seed
        self._wanted = np.repeat(np.array(commands), trial.robots, axis=0)
        self._count = len(self._wanted)
        scene = partial(on_floor, feet=feet) if hangs else None
        self._loop = ServoLoop(description, ParameterSpace([]), self._count, threads=threads, scene=scene)
        self._map = ActionMap.of_robot(spec, description)
        self._filter = SafetyFilter(description)
        self._ticks = round(trial.seconds * description.control_rate_hz)
        self.clipped = 0.0

    def walks(self, policy: TriedPolicy | None) -> tuple[WalkAtCommand, ...]:
        """Return how the robots do with a policy; without one they hold their default pose."""
        rng = np.random.default_rng(self._seed)
        loop, description, count = self._loop, self._description, self._count
        home = np.repeat(np.array(description.default_position)[None], count, axis=0)
        stand = home[:, list(description.actuated_index)]
        self._start(stand, rng)
        height = loop.position[:, 2].copy()
        builder = ObservationBuilder(self._spec, (count,))
        builder.command = self._wanted.copy()
        if policy is not None:
            policy.reset()
        command = self._repeated(self._spec if policy is not None else description)
        sent, up = stand, np.ones(count, dtype=bool)
        lasted, total, ticks, clips = np.zeros(count), np.zeros((count, 3)), 0, 0.0
        for tick in range(self._ticks):
            if policy is None:
                wanted = stand
            else:
                action = self._map.action(policy.act_batch(builder.build(*self._sensed(rng))))
                builder.record_action(action)
                wanted = self._map.target(action)
            sent, lowered = self._filtered(command, wanted, sent)
            clips += float(np.any(np.abs(sent - wanted) > 1e-9, axis=1)[up].mean()) if up.any() else 0.0
            loop.batch.set_sent(lowered.stiffness, lowered.damping, lowered.effort_limit)
            up &= ~loop.step(sent, rng)
            seen = base_features(loop.position[:, :6], loop.velocity[:, :6])
            up &= (-seen[:, _GRAVITY_Z] > np.cos(self._tilt)) & (seen[:, 12] > SUNK * height)
            lasted += up
            if (tick + 1) / description.control_rate_hz > UNCOUNTED_S:
                total += np.where(up[:, None], np.column_stack([seen[:, _LINEAR], seen[:, _TURN_RATE]]), 0.0)
                ticks += 1
        self.clipped = clips / self._ticks
        return self._judged(lasted / self._ticks, up, total / max(ticks, 1))

    def _start(self, stand: FloatArray, rng: np.random.Generator) -> None:
        """Settle the robots in their default pose."""
        loop, description, count = self._loop, self._description, self._count
        everyone: BoolArray = np.ones(count, dtype=bool)
        start = self._home()
        latency = rng.uniform(*LATENCY_S, count)
        none = np.empty((count, 0))
        command = self._repeated(description)
        loop.batch.set_sent(command.stiffness, command.damping, command.effort_limit)
        loop.restart(everyone, none, latency, start, np.zeros_like(start), rng, stand)
        for _ in range(round(self._settling_s * description.control_rate_hz)):
            loop.step(stand, rng)

    def _home(self) -> FloatArray:
        robot, model = self._loop.batch.robot, self._loop.batch.robot.model
        start = np.zeros_like(self._loop.batch.position)
        start[:, :3] = model.qpos0[robot.base[0] : robot.base[0] + 3] if robot.base is not None else 0.0
        start[:, robot.joints] = self._description.default_position
        return start

    def _sensed(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return the reported state, with the noise of the inertial sensor and of joint velocities."""
        position, velocity = self._loop.reported_position.copy(), self._loop.reported_velocity.copy()
        position[:, 3:6] += rng.standard_normal((self._count, 3)) * ORIENTATION_NOISE_RAD
        velocity[:, 3:6] += rng.standard_normal((self._count, 3)) * GYRO_NOISE_RAD_S
        velocity[:, 6:] += rng.standard_normal(velocity[:, 6:].shape) * SPEED_NOISE_RAD_S
        return position, velocity

    def _filtered(
        self, command: JointCommand, wanted: FloatArray, before: FloatArray
    ) -> tuple[FloatArray, JointCommand]:
        joints = self._loop.batch.robot.joints
        measured, velocity = (
            values[:, joints][:, list(self._description.actuated_index)]
            for values in (self._loop.reported_position, self._loop.reported_velocity)
        )
        made, _ = self._filter.clip(
            dataclasses.replace(command, position_target=wanted), before, measured, velocity
        )
        return made.position_target, made

    def _repeated(self, source: PolicySpec | RobotDescription) -> JointCommand:
        one = position_command(source, np.zeros(len(source.actuated)))
        return JointCommand(
            **{
                entry.name: np.repeat(getattr(one, entry.name)[None], self._count, axis=0)
                for entry in dataclasses.fields(one)
            }
        )

    def _judged(self, lasted: FloatArray, up: BoolArray, velocity: FloatArray) -> tuple[WalkAtCommand, ...]:
        found = []
        for i, command in enumerate(self._commands):
            mine = slice(i * self._robots, (i + 1) * self._robots)
            size = float(np.linalg.norm(command))
            shares = np.zeros(self._robots)
            if size:
                error = np.linalg.norm(velocity[mine] - np.array(command), axis=1)
                shares = np.where(up[mine], 1.0 - error / size, 0.0)
            mean = velocity[mine][up[mine]].mean(axis=0) if up[mine].any() else np.full(len(AXES), np.nan)
            found.append(
                WalkAtCommand(
                    command=command,
                    velocity=(float(mean[0]), float(mean[1]), float(mean[2])),
                    up=float(lasted[mine].mean()),
                    followed=float(shares.mean()),
                )
            )
        return tuple(found)
