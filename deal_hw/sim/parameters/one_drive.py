"""One drive a joint: what an MJCF says of it in several places stands in one actuator while we work with it.

A file may limit a joint's effort by ``actuatorfrcrange`` of the joint, and write a servo as a ``<position>``
beside a ``<velocity>``. :func:`gather` moves both into the actuator that takes the commands, in the compiled
model: the motion stays the same, and gains and limits are searched as those of any servo. :func:`scatter`
puts calibrated values back to where the file has them.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from deal_hw.sim.parameters.kind import joint_of

_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)
_NO_DYNAMICS = int(mujoco.mjtDyn.mjDYN_NONE)
_SAME = 1e-9
"""Relative difference up to which a value was not changed: rounding of a gear."""


def gather(model: Any) -> None:
    """Move what drives a joint into one actuator, in place; a gathered model stays as it is."""
    for servo, brake in _pairs(model):
        ratio = model.actuator_gear[brake, 0] / model.actuator_gear[servo, 0]
        model.actuator_biastype[servo] = _AFFINE
        model.actuator_biasprm[servo, 2] += model.actuator_biasprm[brake, 2] * ratio**2
        model.actuator_gainprm[brake, 0] = model.actuator_biasprm[brake, 2] = 0.0
    for joint, actuator in _limited(model):
        # A force acts by the gear, which may turn it round.
        ends = np.sort(model.jnt_actfrcrange[joint] / model.actuator_gear[actuator, 0])
        if model.actuator_forcelimited[actuator]:
            own = model.actuator_forcerange[actuator]
            ends = np.array([max(ends[0], own[0]), min(ends[1], own[1])])
        if ends[0] <= 0.0 <= ends[1]:
            model.actuator_forcerange[actuator] = ends
            model.actuator_forcelimited[actuator] = True
            model.jnt_actfrclimited[joint] = False


def scatter(model: Any, file: Any) -> None:
    """Put gains and limits of a gathered model back to where its file has them, in place.

    The dampings of a pair keep their ratio. Where joint and actuator both have a limit, and it changed, both
    get the new one.

    Args:
        model: The model.
        file: The file as MuJoCo compiles it.
    """
    before = copy.copy(file)
    gather(before)
    for servo, brake in _pairs(file):
        factor = model.actuator_biasprm[servo, 2] / before.actuator_biasprm[servo, 2]
        factor = 1.0 if abs(factor - 1.0) < _SAME else factor
        model.actuator_biasprm[servo, 2] = file.actuator_biasprm[servo, 2] * factor
        model.actuator_gainprm[brake, 0] = file.actuator_gainprm[brake, 0] * factor
        model.actuator_biasprm[brake, 2] = file.actuator_biasprm[brake, 2] * factor
    for joint, actuator in _limited(file):
        if before.jnt_actfrclimited[joint]:
            continue
        model.jnt_actfrclimited[joint] = True
        ends, own = model.actuator_forcerange[actuator].copy(), before.actuator_forcerange[actuator]
        if np.allclose(ends, own, rtol=_SAME, atol=0.0):
            model.actuator_forcerange[actuator] = file.actuator_forcerange[actuator]
        else:
            model.jnt_actfrcrange[joint] = np.sort(ends * model.actuator_gear[actuator, 0])
        if not file.actuator_forcelimited[actuator]:
            model.actuator_forcelimited[actuator] = False
            model.actuator_forcerange[actuator] = file.actuator_forcerange[actuator]


def brakes(model: Any) -> frozenset[int]:
    """Return the velocity servos of a gathered model whose damping is that of a position servo beside."""
    idle = [i for i in range(model.nu) if joint_of(model, i) >= 0 and _speed_alone(model, i, 0.0)]
    joints = [joint_of(model, i) for i in range(model.nu)]
    return frozenset(i for i in idle if joints.count(joints[i]) == 2)


def _pairs(model: Any) -> Iterator[tuple[int, int]]:
    """Yield a position servo and the velocity servo beside it, of joints with these two actuators.

    A force limit of one of them cuts its part alone, so such pairs are no single drive.
    """
    for joint in range(model.njnt):
        found = [i for i in range(model.nu) if joint_of(model, i) == joint]
        if len(found) != 2 or any(model.actuator_forcelimited[i] for i in found):
            continue
        if any(int(model.actuator_dyntype[i]) != _NO_DYNAMICS for i in found):
            continue
        if np.ptp(model.actuator_delay[found]):
            continue
        for servo, brake in (found, found[::-1]):
            position = int(model.actuator_biastype[servo]) == _AFFINE and model.actuator_biasprm[servo, 1] < 0
            if position and model.actuator_gainprm[brake, 0] > 0 and _speed_alone(model, brake):
                yield servo, brake


def _speed_alone(model: Any, actuator: int, gain: float | None = None) -> bool:
    """Return whether an actuator takes speeds alone: its gain is its damping, and it has nothing else."""
    if int(model.actuator_biastype[actuator]) != _AFFINE or int(model.actuator_gaintype[actuator]) != _FIXED:
        return False
    own, bias = float(model.actuator_gainprm[actuator, 0]), model.actuator_biasprm[actuator]
    same = own == -bias[2] and not bias[:2].any()
    return bool(same and (gain is None or own == gain))


def _limited(model: Any) -> Iterator[tuple[int, int]]:
    """Yield each joint that limits the effort of its drive, and the actuator that is this drive.

    Gravity that the joint's actuator compensates counts at the joint's limit, but not at an actuator's.
    """
    idle = brakes(model) | {brake for _, brake in _pairs(model)}
    for joint in np.flatnonzero(model.jnt_actfrclimited).tolist():
        found = [i for i in range(model.nu) if joint_of(model, i) == joint and i not in idle]
        if len(found) == 1 and not model.jnt_actgravcomp[joint] and model.actuator_gear[found[0], 0]:
            yield joint, found[0]
