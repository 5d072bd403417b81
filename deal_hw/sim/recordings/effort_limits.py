"""Which drives reach their effort limit in recordings."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import SampledEpisode

AT_LIMIT = 0.01
"""Share of the samples from which on a drive's effort limit shows."""


def drives_at_limit(robot: RobotModel, episodes: Iterable[SampledEpisode]) -> tuple[str, ...]:
    """Return the actuators that often ask for more than their effort limit, by the model's gains."""
    joints = list(robot.description.actuated_index)
    drives = [(0.0, np.inf) if d is None else (abs(d.gain), d.effort_limit) for d in robot.drives]
    gain, limit = np.array(drives).reshape(-1, 2).T
    asks = []
    for e in episodes:
        rows = np.minimum(e.sample, len(e.target) - 1)
        error = np.abs(e.target[rows] - e.position[:, robot.joints][:, joints])
        servo = e.stiffness[rows] * error > e.effort_limit[rows]
        asks.append(np.where(robot.description.servos, servo, gain * np.abs(e.target[rows]) > limit))
    share = np.mean(np.concatenate(asks), axis=0)
    return tuple(name for name, each in zip(robot.actuator_names, share, strict=True) if each > AT_LIMIT)
