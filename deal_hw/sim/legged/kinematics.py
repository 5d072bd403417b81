"""Joint targets that hold a legged robot's feet in place while its body moves."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.parameters.fields import element_id
from deal_hw.types import FloatArray

_ITERATIONS = 20
_CLOSE_M = 1e-6


def standing_targets(
    robot: RobotModel,
    feet: tuple[str, ...],
    shift: FloatArray,
    turn: FloatArray,
    pose: FloatArray,
) -> FloatArray:
    """Return joint positions at which the body has moved and the feet have not, (T, J).

    Args:
        robot: A robot with a floating base; each foot hangs on three joints.
        feet: Names of the feet's geoms.
        shift: Of the body, in its frame at rest, (T, 3) [m].
        turn: Rotation vector of the body from rest, (T, 3) [rad].
        pose: Joint positions at rest, (J,).

    Raises:
        ConfigurationError: A foot cannot stay in place: the body moves too far.
    """
    if robot.base is None:
        raise ConfigurationError(f"{robot.description.name}: its base is fixed, so no foot stands")
    model, data = robot.model, mujoco.MjData(robot.model)
    geoms = [element_id(model, "geom", name) for name in feet]
    at = robot.base[0]
    data.qpos[at : at + 7] = (0, 0, 0, 1, 0, 0, 0)
    jacobian = np.empty((3, model.nv))
    qpos, dofs = list(robot.qpos), list(robot.qvel)

    def place(joints: FloatArray) -> FloatArray:
        data.qpos[qpos] = joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return np.array([data.geom_xpos[g] for g in geoms])

    rest = place(pose)
    # Body moved by (R, d): a fixed foot has the position R^T (p - d) in the body's frame.
    wanted = Rotation.from_rotvec(turn).inv().as_matrix()[:, None] @ (rest - shift[:, None])[..., None]
    found, joints = np.empty((len(shift), len(pose))), np.array(pose, dtype=float)
    for t in range(len(shift)):
        for _ in range(_ITERATIONS):
            error = (wanted[t, ..., 0] - place(joints)).ravel()
            if np.max(np.abs(error)) < _CLOSE_M:
                break
            rows = []
            for g in geoms:
                mujoco.mj_jacGeom(model, data, jacobian, None, g)
                rows.append(jacobian[:, dofs].copy())
            joints = joints + np.linalg.lstsq(np.concatenate(rows), error, rcond=None)[0]
        else:
            raise ConfigurationError(
                f"no joint positions keep the feet in place when the body moves by {shift[t].round(3)} m, "
                f"{turn[t].round(3)} rad; move it less"
            )
        found[t] = joints
    return found
