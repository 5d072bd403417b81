"""The benches' robots: for each task, profile and seed a hidden truth, its recordings, and the true states.

The cart-pole is the emulated one, over its bytes in virtual time; the others are simulated targets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from deal_hw.bench.scores import check_truth
from deal_hw.calib.data.population_policy import PopulationPolicy
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION, SPACES
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.drivers.cartpole.plant.profiles import profile as find_profile
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, nominal_truth
from deal_hw.errors import CalibrationError, ConfigurationError, UnknownNameError
from deal_hw.motions.excitation.level import ATTEMPTS
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align, fill_gaps
from deal_hw.sim.recordings.target import Behaviour, TargetRecording, TargetSensing, record_target
from deal_hw.types import FloatArray
from deal_hw.workflows.emulation.virtual import VirtualCartpole, demonstrate
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.workflows.shipped import shipped_policy

DEMONSTRATION_S = 4.0
"""Default length of a demonstration, and length of every held-out motion [s]."""

TRUTH_PART = (0.1, 0.9)
"""Truths are drawn from this part of the range."""

LATENCY_S = (0.006, 0.024)
"""Range of a target's hidden latency in profile ``sensor`` [s]."""

SETTLE_S = 1.0
"""Time for which a target holds its start pose before its recording [s]."""

MOST_REDRAWS = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A seed's recordings, and the truth that only the bench knows.

    Attributes:
        task: Name of the task.
        profile: Name of the profile.
        seed: Seed of everything.
        robot: The nominal model.
        space: The searched parameters.
        theta: True values of the free parameters, (K,).
        latency_s: True total latency [s].
        fit: The demonstration.
        heldout: A recording of another motion family.
        fit_truth: Noise-free positions and velocities at the demonstration's samples, (T, C) each.
        heldout_truth: Noise-free positions at the held-out samples, (T, C).
        channel_std: True standard deviation of the measured channels, (M,); None without noise.
        refused: Number of drawn truths whose robot could not perform the demonstration.
        truth: The emulated robot's truth, if there is an emulator.
        policy: The policy that produced all commands of the demonstration; None for other commands.
        excitation_levels: Level of each attempt at a demonstration; the best one is used.
    """

    task: str
    profile: str
    seed: int
    robot: RobotModel
    space: ParameterSpace
    theta: FloatArray
    latency_s: float
    fit: SampledEpisode
    heldout: SampledEpisode
    fit_truth: tuple[FloatArray, FloatArray]
    heldout_truth: FloatArray
    channel_std: FloatArray | None
    refused: int
    truth: CartpoleTruth | None = None
    policy: PopulationPolicy | None = None
    excitation_levels: tuple[float, ...] = (0.0,)


@dataclass(frozen=True, slots=True)
class _Ask:
    profile: str
    seed: int
    range_ratio: float
    space: str
    centred: bool
    by_policy: bool
    checkpoint: Path | None
    seconds: float

    def ranges(self, table: Mapping[str, Callable[[], ParameterSpace]]) -> ParameterSpace:
        """Return the parameter set with its search ranges."""
        if self.space and self.space not in table:
            raise UnknownNameError("parameter set", self.space, table)
        space = table[self.space or next(iter(table))]()
        ratio = self.range_ratio
        return paper_ranges(space, ratio) if self.centred else space.with_ratio(ratio)


def paper_ranges(space: ParameterSpace, range_ratio: float) -> ParameterSpace:
    """Return the search ranges of DEAL's tables: from nominal / range_ratio to its product, linear."""
    return ParameterSpace(replace(p, scale="linear") for p in space.with_ratio(range_ratio).parameters)


def make_case(
    task: str,
    profile: str,
    seed: int,
    range_ratio: float,
    space: str = "",
    *,
    centred: bool = False,
    by_policy: bool = False,
    checkpoint: Path | None = None,
    seconds: float = DEMONSTRATION_S,
) -> Case:
    """Draw a truth and record a demonstration and a held-out motion.

    Args:
        task: A name in `TASKS`.
        profile: "ideal", "sensor" or, for the cart-pole, "realistic".
        seed: Seed of everything.
        range_ratio: Ratio of the search range.
        space: Name of the parameter set; the task's default.
        centred: The truth is the nominal model and ranges are linear, as in DEAL's tables.
        by_policy: The shipped policy moves the robot, as in the paper, instead of motions with more
            excitation. The cart-pole's demonstration always begins with its policy.
        checkpoint: The file of another policy that demonstrates instead of the shipped one.
        seconds: Length of the demonstration [s]; a held-out motion has `DEMONSTRATION_S`.

    Raises:
        ConfigurationError: There is no such profile or parameter set for this task.
        ConfigurationError: The truth lies outside its search range.
        CalibrationError: No drawn robot could perform the demonstration.
    """
    case = TASKS[task].draw(_Ask(profile, seed, range_ratio, space, centred, by_policy, checkpoint, seconds))
    check_truth(case.space, dict(zip(case.space.names, case.theta, strict=True)))
    return case


def check_tasks(tasks: Iterable[str]) -> None:
    """Check names of tasks.

    Raises:
        UnknownNameError: There is no such task; the message lists all.
    """
    for task in tasks:
        if task not in TASKS:
            raise UnknownNameError("task", task, TASKS)


def _cartpole(ask: _Ask) -> Case:
    seed, profile = ask.seed, ask.profile
    space = ask.ranges(SPACES)
    truth = nominal_truth(profile, seed)
    if ask.centred:
        preset = {p.name: p.nominal for p in space.parameters}
        truth = replace(truth, parameters={**truth.parameters, **preset})
    else:
        truth = draw_truth(profile, seed, range_ratio=ask.range_ratio, space=space)
    virtual = VirtualCartpole(truth)
    plan = RunPlan(
        robot="cartpole",
        motion="balance" if ask.by_policy else "rich",
        seconds=ask.seconds,
        seed=seed,
        policy=str(ask.checkpoint or shipped_policy("cartpole") or ""),
    )
    # A second balancing attempt would be no stronger.
    shown, search = demonstrate(virtual, plan, 1 if ask.by_policy else ATTEMPTS)
    chirp = replace(plan, motion="chirp")
    recordings = (shown, virtual.run(make_behaviour(chirp, DESCRIPTION), DEMONSTRATION_S))
    fit, heldout = (fill_gaps(align(r.trajectory, DESCRIPTION)) for r in recordings)
    return Case(
        task="cartpole",
        profile=profile,
        seed=seed,
        robot=load_model(DESCRIPTION),
        space=space,
        theta=np.array([truth.parameters[name] for name in space.names]),
        latency_s=truth.latency_s,
        fit=fit,
        heldout=heldout,
        fit_truth=recordings[0].true_states(fit),
        heldout_truth=recordings[1].true_states(heldout)[0],
        channel_std=find_profile(profile).sensor.position_std,
        refused=truth.refused,
        truth=truth,
        policy=_population("cartpole", DESCRIPTION, ask.checkpoint) if ask.by_policy else None,
        excitation_levels=tuple(attempt.level for attempt in search.attempts),
    )


BAND_HZ: Final = (0.3, 2.5)
FAST_HZ: Final = (1.5, 4.0)
AMPLITUDE: Final = 0.9
"""Share of a motor's torque."""
SWING_RAD: Final = 0.2
"""Swing of a servo's target about the default pose [rad]."""
_TONES: Final = 3


def flail(
    rng: np.random.Generator, description: RobotDescription, band_hz: tuple[float, float] = BAND_HZ
) -> Callable[[FloatArray, FloatArray, float], FloatArray]:
    """Return a behaviour that drives all actuators with sums of sines, which makes an ant hop and slide.

    Args:
        rng: Draws frequencies and phases.
        description: The robot; targets of servos stay within its limits.
        band_hz: Lowest and highest frequency [Hz].
    """
    low, high = band_hz
    count = len(description.actuated)
    frequency = np.exp(rng.uniform(np.log(low), np.log(high), (count, _TONES)))
    phase = rng.uniform(0.0, 2 * np.pi, (count, _TONES))
    rest, swing = np.zeros(count), AMPLITUDE
    if description.actuation == "position":
        rest = np.array(description.default_position)[list(description.actuated_index)]
        swing = SWING_RAD
    least, most = np.array(description.limits.target).T

    def behaviour(position: FloatArray, velocity: FloatArray, at_s: float) -> FloatArray:
        wave = np.sin(2 * np.pi * frequency * at_s + phase).sum(axis=1)
        return np.asarray(np.clip(rest + swing * wave, least, most))

    return behaviour


def _simulated(ask: _Ask, task: str, settle_s: float = SETTLE_S) -> Case:
    """Return a case of a robot that exists only in simulators and reports its whole state."""
    from deal_hw.robots import parameter_spaces, robot_description

    if ask.profile != "ideal":
        raise ConfigurationError(f"the {task} has no sensors, so no profile {ask.profile!r}; use ideal")
    description = robot_description(task)

    def motions(rng: np.random.Generator) -> tuple[Behaviour, Behaviour]:
        shown = _policy(task, description, ask.checkpoint) if ask.by_policy else flail(rng, description)
        return shown, flail(rng, description, FAST_HZ)

    space = ask.ranges(parameter_spaces(task))
    return _target(task, load_model(description), space, ask, motions, None, settle_s)


def _go2(ask: _Ask) -> Case:
    from deal_hw.drivers.go2.descriptions import floor
    from deal_hw.drivers.go2.motions import FEET, sway
    from deal_hw.robots import driver_description

    if ask.profile == "realistic":
        raise ConfigurationError("the Go2 target has the profiles ideal and sensor")
    # `deal-hw train go2` makes policies for the driver's limits; the shipped one has half the motors' effort.
    description = driver_description("go2") if ask.checkpoint else floor.DESCRIPTION
    robot = load_model(description)
    sensing = TargetSensing(
        joint_std=floor.DESCRIPTION.sensor.noise,
        joint_resolution=floor.DESCRIPTION.sensor.resolution,
        orientation_std=floor.ORIENTATION_NOISE_RAD,
        gyro_std=floor.GYRO_NOISE_RAD_S,
        feet=FEET,
    )

    def motions(rng: np.random.Generator) -> tuple[Behaviour, Behaviour]:
        fast = sway(robot, rng, DEMONSTRATION_S, (1.5, 4.0))
        if ask.by_policy:
            return _policy("go2", description, ask.checkpoint), fast
        return sway(robot, rng, ask.seconds), fast

    space = ask.ranges(floor.SPACES)
    return _target("go2", robot, space, ask, motions, None if ask.profile == "ideal" else sensing)


FORWARD_M_S = 0.4
"""Commanded speed of a demonstration policy, if it observes one [m/s]."""


WANTED = (FORWARD_M_S, 0.0, 0.0)


def _policy(robot: str, description: RobotDescription, checkpoint: Path | None) -> Behaviour:
    from deal_hw.policies.demonstration import Demonstration, demonstration_policy

    return Demonstration(demonstration_policy(robot, checkpoint), description, WANTED)


def _population(robot: str, description: RobotDescription, checkpoint: Path | None) -> PopulationPolicy:
    from deal_hw.policies.demonstration import PopulationDemonstration, demonstration_policy

    return PopulationDemonstration(demonstration_policy(robot, checkpoint), description, WANTED)


def _target(
    task: str,
    robot: RobotModel,
    space: ParameterSpace,
    ask: _Ask,
    motions: Callable[[np.random.Generator], tuple[Behaviour, Behaviour]],
    sensing: TargetSensing | None,
    settle_s: float = SETTLE_S,
) -> Case:
    seed = ask.seed
    rng = np.random.default_rng([seed, sum(task.encode())])
    low, high = (round(t / robot.step_s) for t in LATENCY_S)
    draws = 1 if ask.centred else MOST_REDRAWS
    for refused in range(draws):  # noqa: B007
        theta = space.unnormalize(rng.uniform(*TRUTH_PART, len(space)))
        if ask.centred:
            theta = space.nominal
        latency_s = 0.0 if sensing is None else int(rng.integers(low, high + 1)) * robot.step_s
        try:
            fit, heldout = (
                record_target(
                    robot,
                    space,
                    theta,
                    motion,
                    seconds=seconds,
                    latency_s=latency_s,
                    sensing=sensing,
                    rng=rng,
                    settle_s=settle_s,
                )
                for motion, seconds in zip(motions(rng), (ask.seconds, DEMONSTRATION_S), strict=True)
            )
        except CalibrationError:
            continue
        if all(_stands(task, r) for r in (fit, heldout)):
            break
    else:
        what = "the preset's robot falls" if ask.centred else f"all {draws} drawn robots fall"
        raise CalibrationError(
            f"{task}, seed {seed}: {what}, so there is no demonstration; use another --space or --range-ratio"
        )
    std = None if sensing is None else _channel_std(robot, sensing)
    return Case(
        task=task,
        profile=ask.profile,
        seed=seed,
        robot=robot,
        space=space,
        theta=theta,
        latency_s=latency_s,
        fit=fit.episode,
        heldout=heldout.episode,
        fit_truth=(fit.position, fit.velocity),
        heldout_truth=heldout.position,
        channel_std=std,
        refused=refused,
        policy=_population(task, robot.description, ask.checkpoint) if ask.by_policy else None,
    )


def _stands(task: str, recording: TargetRecording) -> bool:
    return bool(np.all(recording.position[:, 2] > TASKS[task].fallen_m))


def _channel_std(robot: RobotModel, sensing: TargetSensing) -> FloatArray:
    joints = np.array(sensing.joint_std)
    if sensing.joint_resolution:
        joints = np.sqrt(joints**2 + np.square(sensing.joint_resolution) / 12)
    # Channels in order: rotation, joints, angular velocity.
    return np.concatenate([np.full(3, sensing.orientation_std), joints, np.full(3, sensing.gyro_std)])


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchTask:
    """What the benches do with one robot. These numbers are the benches' own, no facts of the robot.

    Attributes:
        draw: Draws a case.
        train_steps: Steps of a fine-tune in `transfer`. On seed 0 the oracle's return on the cart-pole is 11
            after 2000 steps, 157 after 16 000 and 212 after 24 000; on the ant it rises from 284 to 479. The
            Go2 has those of `go2-loop`. Those of humanoid and hand are not tuned.
        paper_s: DEAL on an i5-14600KF and an RTX 4060 Ti, 50 generations of 200 members (Table 3) [s].
        fallen_m: Height of a base below which it has fallen [m]. A demonstration of a Go2 on its trunk, or of
            a hand without its cube, has little information. Ant and humanoid may lie.
        base_seed: Training seed of a base policy that the bench trains itself.
        shown_by_shipped: The shipped demonstration policy moves the target, not the base policy.
        upright: Added to the reward in each tick without a failure, whose cost is then left out; None: the
            task's reward is taken as it is.
        walks: It follows commanded velocities: it is judged by its speeds, too, and not pushed or loaded.
    """

    draw: Callable[[_Ask], Case]
    train_steps: int
    paper_s: float
    fallen_m: float = 0.0
    base_seed: int = 0
    shown_by_shipped: bool = False
    upright: float | None = None
    walks: bool = False


TASKS: Mapping[str, BenchTask] = {
    "cartpole": BenchTask(
        draw=_cartpole,
        train_steps=24_000,
        paper_s=75.0,
        # As the shipped policy.
        base_seed=1,
        # Its reward lies in (-1, 0]. So a return of 0 is a pole that falls at once, and shares of returns
        # have a meaning.
        upright=1.0,
    ),
    "allegro": BenchTask(draw=partial(_simulated, task="allegro"), train_steps=60_000, paper_s=3245.0),
    "ant": BenchTask(draw=partial(_simulated, task="ant"), train_steps=60_000, paper_s=98.0),
    "go2": BenchTask(
        draw=_go2,
        train_steps=300_000,
        paper_s=303.0,
        fallen_m=0.12,
        # The walking policy asks for more torque than the model of its calibration allows.
        shown_by_shipped=True,
        walks=True,
    ),
    "humanoid": BenchTask(
        # Without torque it falls within a second, so a demonstration begins upright.
        draw=partial(_simulated, task="humanoid", settle_s=0.0),
        train_steps=60_000,
        paper_s=103.0,
    ),
}
