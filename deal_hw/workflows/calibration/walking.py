"""Recordings of a walking robot: their walking part, and the robot's weight."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from deal_hw.parameters import ParameterSpace
from deal_hw.types import Trajectory
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import SampledEpisode

GAIT_SMOOTHING_S = 0.04
"""Landing feet change joint velocities within about 10 ms; longer smoothing biases the states there [s]."""
WALK_TELLS = (
    "a walk shows the joints' gains and the floor's friction, but hardly their dry friction, not their "
    "armature, and masses only if the motors' efforts weigh the robot"
)
WEIGHING_S = 0.35
"""Time that a robot stands still before it walks [s]."""


def all_walk(robot: RobotModel, recordings: Iterable[Trajectory]) -> bool:
    """Return whether all recordings are of a policy that walks."""
    if robot.base is None:
        return False
    from deal_hw.motions.scores.velocity_error import wanted_velocity

    return all(wanted_velocity(r) is not None for r in recordings)


def while_walking(episode: SampledEpisode, trajectory: Trajectory) -> SampledEpisode:
    """Return the episode; of a walk, without standing up and lying down."""
    from deal_hw.motions.scores.velocity_error import wanted_velocity

    wanted = wanted_velocity(trajectory)
    if wanted is None:
        return episode
    rows = slice(episode.first_row, episode.first_row + len(episode.sample))
    host_s = trajectory.device_s[rows] + np.median(trajectory.receive_s - trajectory.device_s)
    walks = (host_s >= wanted.time_s[0]) & (host_s <= wanted.end_s)
    return dataclasses.replace(episode, usable=episode.usable & walks)


def weighed(space: ParameterSpace, robot: RobotModel, trajectory: Trajectory, say: Say) -> ParameterSpace:
    """Return the space with the trunk's mass, if it is searched, as weighed by the motors' efforts.

    No motion on feet can separate masses from gains, since all forces scale together. The motors' efforts
    can, in the last moments before the robot walks.
    """
    from deal_hw.motions.scores.velocity_error import wanted_velocity
    from deal_hw.sim.legged.weighing import standing_mass

    trunk, wanted, body = robot.description.floating_base, wanted_velocity(trajectory), trajectory.body
    names = [p.name for p in space if p.kind == "body_mass" and p.elements == (trunk,)]
    if not names or wanted is None or body is None:
        return space
    since_s = trajectory.receive_s - wanted.time_s[0]
    rows = (since_s > -WEIGHING_S) & (since_s < 0) & np.isfinite(trajectory.effort).all(axis=1)
    if not rows.any() or not trajectory.effort[rows].any():
        return space
    whole = standing_mass(robot, body.orientation[rows], trajectory.position[rows], trajectory.effort[rows])
    mass = whole - float(robot.model.body_mass.sum() - robot.model.body(trunk).mass[0])
    say(
        f"{names[0]}: {mass:.2f} kg, weighed by the motors' efforts while the robot stands (whole robot "
        f"{whole:.2f} kg); it is not fitted; to set another mass: --known {names[0]} KG"
    )
    return space.with_known({names[0]: mass})
