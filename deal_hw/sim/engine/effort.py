"""Effort sensors of N members: what a robot would report of its motors' torques."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters.effort import EFFORT_KINDS
from deal_hw.sim.parameters.values import KindValues, spread
from deal_hw.types import FloatArray

TORQUE = "qfrc_actuator"
"""MuJoCo's field of the actuators' generalised forces, before friction and armature."""

_NAMES = tuple(kind.name for kind in EFFORT_KINDS)


def effort_joints(description: RobotDescription, space: ParameterSpace) -> tuple[int, ...]:
    """Return the columns of the joints whose effort a space compares, in ascending order, (E,)."""
    joints = description.joint_names
    return tuple(
        sorted({joints.index(name) for p in space.parameters if p.kind in _NAMES for name in p.elements})
    )


class EffortSensors:
    """The effort sensors of E joints of N members.

    Args:
        names: The joints, (E,).
        dofs: Their degrees of freedom, (E,).
        values: Gains, biases and delays by kind.
        count: Members N.
    """

    def __init__(self, names: Sequence[str], dofs: Sequence[int], values: KindValues, count: int) -> None:
        self._dofs = list(dofs)

        def of(kind: str, neutral: float) -> FloatArray:
            found = spread(values, kind, names, neutral, count)
            return np.full((count, len(names)), neutral) if found is None else found

        self._gain, self._bias = of("effort_gain", 1.0), of("effort_bias", 0.0)
        self._delay_s = of("effort_delay", 0.0)

    def report(self, torque: FloatArray, every: int, step_s: float) -> FloatArray:
        """Return what is reported at steps every, 2 every, ..., (N, S // every, E).

        The torque during a step is that of its beginning. So a report without delay is that of the last step
        before the sample. Before the first step nothing is known: there the first torque stands.

        Args:
            torque: Torques on all degrees of freedom during each step, (N, S, V).
            every: Steps from one report to the next.
            step_s: Step [s].
        """
        steps = torque.shape[1]
        late = np.arange(every, steps + 1, every)[None, :, None] - 1 - self._delay_s[:, None] / step_s
        late = np.clip(late, 0, steps - 1)
        before = np.floor(late).astype(int)
        part = late - before
        own = torque[..., self._dofs]
        found = (1 - part) * np.take_along_axis(own, before, axis=1)
        found += part * np.take_along_axis(own, np.minimum(before + 1, steps - 1), axis=1)
        return np.asarray(self._gain[:, None] * found + self._bias[:, None])
