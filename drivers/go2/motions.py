"""Motions that excite a standing Go2 or B2 without moving its feet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from deal_hw.motions.excitation.limits import fit_to_limits
from deal_hw.motions.excitation.plan import ExcitationPlan
from deal_hw.motions.excitation.waveforms import Steps
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.legged.kinematics import standing_targets
from deal_hw.types import FloatArray

FEET = tuple(f"{leg}_foot" for leg in ("FL", "FR", "RL", "RR"))

SHIFT_M = (0.04, 0.04, 0.03)
TURN_RAD = (0.12, 0.10, 0.15)
"""Largest shift and turn of the body: forward, left, up; roll, pitch, yaw."""

BAND_HZ = (0.4, 3.0)
EASE_S = 0.5
_TONES = 3


def sway(
    robot: RobotModel, rng: np.random.Generator, seconds: float, band_hz: tuple[float, float] = BAND_HZ
) -> Callable[[FloatArray, FloatArray, float], FloatArray]:
    """Return a behaviour that sways the body in all six directions over standing feet.

    Args:
        robot: The robot's model.
        rng: Draws frequencies and phases.
        seconds: Length [s].
        band_hz: Lowest and highest frequency [Hz].
    """
    rate = robot.description.control_rate_hz
    time = np.arange(round(seconds * rate) + 2) / rate
    low, high = band_hz
    frequency = np.exp(rng.uniform(np.log(low), np.log(high), (6, _TONES)))
    phase = rng.uniform(0.0, 2 * np.pi, (6, _TONES))
    waves = np.sin(2 * np.pi * frequency * time[:, None, None] + phase).mean(axis=2)
    # Starts from rest: a step of the targets could throw the robot over.
    moved = np.minimum(time / EASE_S, 1.0)[:, None] * waves * (*SHIFT_M, *TURN_RAD)
    pose = np.array(robot.description.default_position)
    targets = standing_targets(robot, FEET, moved[:, :3], moved[:, 3:], pose)

    def behaviour(position: FloatArray, velocity: FloatArray, at_s: float) -> FloatArray:
        return np.asarray(targets[min(round(at_s * rate), len(targets) - 1)])

    return behaviour


def sway_plan(
    robot: RobotModel,
    rng: np.random.Generator,
    seconds: float,
    band_hz: tuple[float, float] = BAND_HZ,
    amplitude: float = 1.0,
) -> ExcitationPlan:
    """Return the same as a table of targets, which the robot's computer plays without a simulator.

    Args:
        robot: The robot's model, with the description that the plan is for.
        rng: Draws frequencies and phases.
        seconds: Length [s].
        band_hz: Lowest and highest frequency [Hz].
        amplitude: Share of the largest sway that keeps the limits.

    Raises:
        ConfigurationError: A foot cannot stay where it is.
    """
    description = robot.description
    pose, nobody = np.array(description.default_position), np.zeros(len(description.joint_names))
    behaviour = sway(robot, rng, seconds, band_hz)
    times = np.arange(round(seconds * description.control_rate_hz)) / description.control_rate_hz
    offsets = np.stack([behaviour(nobody, nobody, t) for t in times]) - pose
    # One factor for all joints: with one for each the feet would slip.
    offsets *= amplitude * float(np.min(fit_to_limits(description, offsets, smooth=True)))
    rows = tuple(tuple(map(float, row)) for row in offsets)
    return ExcitationPlan(
        robot=description.name,
        digest=description.digest(),
        seconds=seconds,
        balance_s=0.0,
        ease_s=min(EASE_S, 0.25 * seconds),
        wave=Steps(begin_s=tuple(map(float, times)), value=rows),
        words=f"{seconds:g} s of swaying over standing feet, {band_hz[0]:.2g} to {band_hz[1]:.2g} Hz",
    )
