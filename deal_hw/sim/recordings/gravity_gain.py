"""Servo gains from gravity: the deviation of a joint from its command, against the torque it carries.

A proportional servo that holds a load f is f / kp off its command. The mean of that over a recording gives
the gain within a factor of about two, and its sign. If the column map has a wrong sign for a joint, in
command and measurement alike, their correlation looks right. But the joint then seems to hang upwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

BLOCK_S = 1.0
"""Time over which means are taken [s]: motion and friction cancel, weight stays."""


@dataclass(frozen=True, slots=True, eq=False)
class GravityGain:
    """Static gains of the A servos.

    Attributes:
        gain: Torque carried over deviation from the command, (A,) [N·m/rad or N/m]; negative if the joint
            hangs against gravity.
        error: Standard error of 1 / gain, (A,) [rad/(N·m) or m/N].
        explained: Share of the mean square deviation that this gain explains, (A,).
        load: Root mean square torque carried, (A,) [N·m or N].
        deviation: Root mean square deviation from the command, (A,) [rad or m].
    """

    gain: FloatArray
    error: FloatArray
    explained: FloatArray
    load: FloatArray
    deviation: FloatArray


def gravity_gain(robot: RobotModel, episodes: list[SampledEpisode]) -> GravityGain | None:
    """Estimate static gains from the joints' deviations; None for motors alone and floating bases.

    Args:
        robot: The nominal model, whose masses and geometry are assumed right.
        episodes: Recordings.
    """
    description = robot.description
    if not any(description.servos) or robot.base is not None:
        return None
    model, data = robot.model, mujoco.MjData(robot.model)
    index = list(description.actuated_index)
    # A constant effort of the actuator carries its part without any deviation.
    offset = np.array([0.0 if drive is None else drive.offset for drive in robot.drives])
    loads, deviations = [], []
    for episode in episodes:
        length = max(round(BLOCK_S / episode.period_s), 1)
        command = episode.target[np.clip(episode.sample - 1, 0, len(episode.target) - 1)]
        for first in range(0, len(episode.sample) - length + 1, length):
            rows = slice(first, first + length)
            mean = episode.position[rows].mean(axis=0)
            data.qpos[:], data.qvel[:] = model.qpos0, 0.0
            robot.place(data.qpos, mean)
            mujoco.mj_forward(model, data)
            carried = data.qfrc_bias - data.qfrc_passive
            loads.append(carried[list(robot.qvel)][index] - offset)
            deviations.append(command[rows].mean(axis=0) - mean[index])
    load, off = np.array(loads).reshape(-1, len(index)), np.array(deviations).reshape(-1, len(index))
    both, power = np.sum(load * off, axis=0), np.sum(load**2, axis=0)
    compliance = both / np.where(power > 0, power, 1.0)
    square = np.sum(off**2, axis=0)
    left = np.sum((off - compliance * load) ** 2, axis=0)
    # A joint without load does not deviate: its gain stays open.
    with np.errstate(divide="ignore"):
        gain = np.where(compliance != 0, 1.0 / compliance, np.inf)
    explained = np.where(square > 0, 1 - left / np.where(square > 0, square, 1.0), 0.0)
    count = max(len(load), 1)
    error = np.sqrt(left / np.where(power > 0, power, np.inf) / max(count - 1, 1))
    return GravityGain(gain, error, explained, np.sqrt(power / count), np.sqrt(square / count))
