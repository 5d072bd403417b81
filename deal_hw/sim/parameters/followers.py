"""Joints that an equality of the model moves with another one, such as the second finger of a gripper.

They need no reading: their positions follow from those of the joints that lead them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.polynomial import polynomial

from deal_hw.sim.parameters.kind import joint_of
from deal_hw.types import FloatArray

_JOINT = int(mujoco.mjtEq.mjEQ_JOINT)
_NO_EQUALITY = int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)


@dataclass(frozen=True, slots=True, eq=False)
class Follower:
    """A hinge or slide that follows another one.

    Attributes:
        joint: Its number.
        leader: The joint that leads it; -1 for one that an equality holds at a position.
        coefficients: Its position from that in the model, as a polynomial of the leader's, lowest power
            first, (5,).
    """

    joint: int
    leader: int
    coefficients: FloatArray

    def follow(self, model: Any, qpos: FloatArray, qvel: FloatArray | None = None) -> None:
        """Write its position and speed into (..., nq) and (..., nv), where those of its leader stand."""
        at, dof = int(model.jnt_qposadr[self.joint]), int(model.jnt_dofadr[self.joint])
        lead = 0.0 * qpos[..., at]
        if self.leader >= 0:
            place = int(model.jnt_qposadr[self.leader])
            lead = qpos[..., place] - model.qpos0[place]
        qpos[..., at] = model.qpos0[at] + polynomial.polyval(lead, self.coefficients)
        if qvel is not None:
            slope = polynomial.polyval(lead, polynomial.polyder(self.coefficients))
            speed = 0.0 if self.leader < 0 else qvel[..., model.jnt_dofadr[self.leader]]
            qvel[..., dof] = slope * speed


def followers_of(model: Any, known: Collection[int]) -> tuple[Follower, ...]:
    """Return the joints without an actuator whose positions follow from those of others, leaders first.

    Args:
        model: The MjModel.
        known: Joints whose positions are known; none of these is among the result.
    """
    taken, found = {*known, *_driven(model)}, list[Follower]()
    while more := next(_next(model, taken), None):
        found.append(more)
        taken.add(more.joint)
    return tuple(found)


def natural_followers(model: Any) -> tuple[Follower, ...]:
    """Return the joints of a model that need no reading, whatever was recorded.

    Of two joints of which neither has an actuator, the equality's second one leads.
    """
    first = {joint for joint, _, _ in _equalities(model)}
    second = {leader for _, leader, _ in _equalities(model)}
    others = set(range(model.njnt)) - first - second
    found = followers_of(model, others)
    leaders = second - first - {follower.joint for follower in found}
    return followers_of(model, others | leaders)


def _driven(model: Any) -> set[int]:
    return {joint_of(model, actuator) for actuator in range(model.nu)} - {-1}


def _equalities(model: Any) -> Iterator[tuple[int, int, FloatArray]]:
    """Yield follower, leader and coefficients of the active equalities of joints."""
    if model.opt.disableflags & _NO_EQUALITY:
        return
    for e in range(model.neq):
        if int(model.eq_type[e]) == _JOINT and model.eq_active0[e]:
            yield int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e, :5].copy()


def _next(model: Any, known: Collection[int]) -> Iterator[Follower]:
    for joint, leader, coefficients in _equalities(model):
        if joint not in known and (leader < 0 or leader in known):
            yield Follower(joint, leader, coefficients)
        elif leader >= 0 and leader not in known and joint in known:
            # The equality may name them the other way round; a curve has no unique inverse.
            constant, slope = coefficients[:2]
            if slope and not coefficients[2:].any():
                yield Follower(leader, joint, np.array([-constant / slope, 1 / slope, 0.0, 0.0, 0.0]))
