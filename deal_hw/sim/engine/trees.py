"""Kinematic trees of a robot that move independently of each other: two arms on one table, legs on a stand.

A parameter of one arm changes nothing of the other, so one simulation shows the effect of a parameter of
each (Curtis, Powell and Reid, "On the Estimation of Sparse Jacobian Matrices", 1974). Trees that an equality,
a tendon or a contact joins count as one.
"""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.parameters import find_kind
from deal_hw.sim.parameters.fields import element_id
from deal_hw.sim.parameters.kind import OF_JOINT, Element, joint_of
from deal_hw.types import FloatArray, IntArray

Mask = npt.NDArray[np.bool_]


def independent_trees(robot: RobotModel, positions: FloatArray) -> IntArray:
    """Return the number of each coordinate's tree, (C,), equal where trees act on each other.

    All are equal where it is not known that trees are independent.

    Args:
        robot: The robot.
        positions: Tangent coordinates of a recording, (T, C): in none of these states do bodies of two
            independent trees touch.
    """
    model = robot.model
    of_joints = model.dof_treeid[list(robot.qvel)]
    single = robot.base is not None or model.ntree < 2
    # A tree without a recorded joint, such as a box on the table, is where nobody knows.
    if single or len(np.unique(of_joints)) < model.ntree or not _separate(model):
        return np.zeros(len(robot.coordinates), dtype=np.int64)
    number = np.arange(model.ntree)
    for one, other in _touching(robot, positions):
        number[number == number[other]] = number[one]
    return np.asarray(number[of_joints], dtype=np.int64)


def reached(robot: RobotModel, space: ParameterSpace, trees: IntArray) -> Mask:
    """Return which coordinates each free parameter can move, (K, C).

    Args:
        robot: The robot.
        space: The parameters; one without elements moves nothing.
        trees: From :func:`independent_trees`, (C,).
    """

    def of(p: Parameter) -> Mask:
        element = find_kind(p.kind).element
        bodies = [_body_of(robot.model, element, element_id(robot.model, element, n)) for n in p.elements]
        own = robot.model.body_treeid[[b for b in bodies if b is not None]]
        if len(own) < len(bodies) or (own < 0).any():
            return np.ones(len(trees), dtype=bool)
        joints = robot.model.dof_treeid[list(robot.qvel)]
        return np.isin(trees, trees[np.isin(joints, own)])

    several = len(np.unique(trees)) > 1
    rows = [of(p) if several else np.full(len(trees), bool(p.elements)) for p in space]
    return np.array(rows, dtype=bool).reshape(-1, len(trees))


def sharing(reach: Mask) -> IntArray:
    """Return the number of a simulation for each change, (N,): no two changes in one move a coordinate.

    Args:
        reach: Which coordinates each change can move, (N, C).
    """
    taken: list[Mask] = []
    found = []
    for row in reach:
        number = next((k for k, used in enumerate(taken) if not (used & row).any()), len(taken))
        taken[number : number + 1] = [row | used for used in taken[number : number + 1]] or [row]
        found.append(number)
    return np.array(found, dtype=np.int64)


def _separate(model: mujoco.MjModel) -> bool:
    """Return whether nothing but contacts can join two trees."""
    if model.nflex or model.nplugin or (model.tendon_treenum > 1).any():
        return False
    if not all(int(t) in (*OF_JOINT, int(mujoco.mjtTrn.mjTRN_TENDON)) for t in model.actuator_trntype):
        return False
    ends = np.stack([model.eq_obj1id, model.eq_obj2id], axis=1)
    for kind, of, pair in zip(model.eq_type, model.eq_objtype, ends, strict=True):
        if int(kind) == int(mujoco.mjtEq.mjEQ_JOINT):
            bodies = model.jnt_bodyid[pair[pair >= 0]]
        elif int(of) == int(mujoco.mjtObj.mjOBJ_BODY):
            bodies = pair
        elif int(of) == int(mujoco.mjtObj.mjOBJ_SITE):
            bodies = model.site_bodyid[pair]
        else:
            return False
        if len(set(model.body_treeid[bodies]) - {-1}) > 1:
            return False
    return True


def _touching(robot: RobotModel, positions: FloatArray) -> set[tuple[int, int]]:
    """Return the pairs of trees whose bodies touch in one of these states, (T, C)."""
    model, found = robot.model, set[tuple[int, int]]()
    if not _can_touch(model):
        return found
    data = mujoco.MjData(model)
    for position in positions:
        robot.place(data.qpos, position)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        trees = model.body_treeid[model.geom_bodyid[data.contact.geom]].reshape(-1, 2)
        apart = trees[(trees[:, 0] != trees[:, 1]) & (trees >= 0).all(axis=1)]
        found.update((int(one), int(other)) for one, other in apart)
    return found


def _can_touch(model: mujoco.MjModel) -> bool:
    """Return whether the model lets geoms of two trees collide, somewhere."""
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return False
    trees = model.body_treeid[model.geom_bodyid]
    apart = (trees[:, None] != trees) & (trees[:, None] >= 0) & (trees >= 0)
    meets = (model.geom_contype[:, None] & model.geom_conaffinity) != 0
    pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
    return bool((apart & (meets | meets.T)).any() or any(apart[one, other] for one, other in pairs))


def _body_of(model: mujoco.MjModel, element: Element, index: int) -> int | None:
    """Return a body of an element's tree; None for a tendon of several or no trees."""
    match element:
        case "body":
            return index
        case "joint":
            return int(model.jnt_bodyid[index])
        case "geom":
            return int(model.geom_bodyid[index])
        case "actuator":
            joint = joint_of(model, index)
            return int(model.jnt_bodyid[joint]) if joint >= 0 else None
        case "tendon":
            return None
