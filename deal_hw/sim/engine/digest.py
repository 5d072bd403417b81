"""A digest of a compiled model: same digest, same simulation (of one version of MuJoCo)."""

from __future__ import annotations

import hashlib

import mujoco
import numpy as np

from deal_hw.sim.engine.model import RobotModel


def model_digest(robot: RobotModel) -> str:
    """Return the SHA-256 of the nominal model's compiled form, meshes and physics step included."""
    buffer = np.empty(mujoco.mj_sizeModel(robot.model), dtype=np.uint8)
    mujoco.mj_saveModel(robot.model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
