"""One simulated robot with legs, on the floor or held in the air, driven by explicit efforts step by step."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from deal_hw.sim.legged.terrain import Terrain, add_terrain, terrain_geoms
from deal_hw.sim.parameters.fields import element_id
from deal_hw.types import FloatArray

_TOUCH = 1.5
"""Radius of a foot's touch sensor over the foot's own radius [-]."""


class LeggedSimulation:
    """A MuJoCo model without its actuators: the caller is the motors and holds an effort for one step.

    Measurements belong to the state before the last step, because MuJoCo computes accelerations and contact
    forces there. Arrays follow ``joints`` (J) and ``feet`` (F).

    Args:
        mjcf: The model.
        joints: The hinge joints, in the caller's order.
        feet: Sphere geoms of the feet.
        timestep_s: Length of one step [s].
        base: The body that carries the legs, with a free joint of the same name or none.
        terrain: What is ahead on the floor; None for a flat floor.
    """

    def __init__(
        self,
        mjcf: Path,
        joints: Sequence[str],
        feet: Sequence[str],
        timestep_s: float,
        base: str = "base",
        terrain: Terrain | None = None,
    ) -> None:
        spec = mujoco.MjSpec.from_file(str(mjcf))
        _add_touch_sensors(spec, feet)
        if terrain is not None:
            add_terrain(spec, terrain)
        spec.option.timestep = timestep_s
        model = spec.compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        ids = [element_id(model, "joint", name) for name in joints]
        body = element_id(model, "body", base)
        self._model, self._data = model, mujoco.MjData(model)
        self._q = np.array([model.jnt_qposadr[i] for i in ids])
        self._v = np.array([model.jnt_dofadr[i] for i in ids])
        self._body = body
        self._free = bool(model.body_dofnum[body])
        self._base_q = int(model.jnt_qposadr[model.body_jntadr[body]]) if self._free else 0
        self._base_v = int(model.body_dofadr[body]) if self._free else 0
        self._gravity = np.array(model.opt.gravity)
        self._feet = [element_id(model, "geom", name) for name in feet]
        mujoco.mj_forward(model, self._data)

    @property
    def free(self) -> bool:
        """Whether the base can move."""
        return self._free

    def position(self) -> FloatArray:
        """Return the joint positions, (J,) [rad]."""
        return np.asarray(self._data.qpos[self._q])

    def velocity(self) -> FloatArray:
        """Return the joint velocities, (J,) [rad/s]."""
        return np.asarray(self._data.qvel[self._v])

    def acceleration(self) -> FloatArray:
        """Return the joint accelerations of the last step, (J,) [rad/s²]."""
        return np.asarray(self._data.qacc[self._v])

    def base_position(self) -> FloatArray:
        """Return the position of the base's frame in the world, (3,) [m]."""
        at = self._base_q
        return np.array(self._data.qpos[at : at + 3] if self._free else self._data.xpos[self._body])

    def base_velocity(self) -> FloatArray:
        """Return the velocity of the base's frame in the world, (3,) [m/s]."""
        return np.array(self._data.qvel[self._base_v : self._base_v + 3]) if self._free else np.zeros(3)

    def orientation(self) -> FloatArray:
        """Return the base's orientation in the world, a unit quaternion wxyz, (4,)."""
        at = self._base_q
        return np.array(self._data.qpos[at + 3 : at + 7] if self._free else self._data.xquat[self._body])

    def angular_velocity(self) -> FloatArray:
        """Return the base's angular velocity in its own frame, (3,) [rad/s]."""
        return np.array(self._data.qvel[self._base_v + 3 : self._base_v + 6]) if self._free else np.zeros(3)

    def specific_force(self) -> FloatArray:
        """Return the reading of an ideal accelerometer at the base's origin, in its frame, (3,) [m/s²]."""
        felt = -self._gravity
        if self._free:
            felt = felt + self._data.qacc[self._base_v : self._base_v + 3]
        out = np.empty(3)
        back = np.empty(4)
        mujoco.mju_negQuat(back, self.orientation())
        mujoco.mju_rotVecQuat(out, felt, back)
        return out

    def foot_force(self) -> FloatArray:
        """Return the normal force on each foot, (F,) [N]."""
        return np.array(self._data.sensordata)

    def foot_position(self) -> FloatArray:
        """Return the positions of the feet's centres in the base's frame, (F, 3) [m]."""
        rotation = self._data.xmat[self._body].reshape(3, 3)
        return np.asarray((self._data.geom_xpos[self._feet] - self._data.xpos[self._body]) @ rotation)

    def set_dofs(
        self,
        *,
        damping: FloatArray | None = None,
        frictionloss: FloatArray | None = None,
        armature: FloatArray | None = None,
    ) -> None:
        """Set damping, dry friction and armature of the joints, (J,) each [N·m·s/rad, N·m, kg·m²]."""
        if damping is not None:
            self._model.dof_damping[self._v] = damping
        if frictionloss is not None:
            self._model.dof_frictionloss[self._v] = frictionloss
        if armature is not None:
            self._model.dof_armature[self._v] = armature
            self._derive()

    def add_payload(self, mass_kg: float) -> None:
        """Add mass to the base; its inertia scales, as for the same shape and more density."""
        mass = self._model.body_mass[self._body]
        self._model.body_inertia[self._body] *= 1.0 + mass_kg / mass
        self._model.body_mass[self._body] = mass + mass_kg
        self._derive()

    def set_floor_friction(self, friction: float, floor: str = "floor") -> None:
        """Set the sliding friction of the floor geom, if the model has one, and of its terrain."""
        index = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_GEOM, floor)
        ground = [index] if index >= 0 else []
        self._model.geom_friction[ground + terrain_geoms(self._model), 0] = friction

    def _derive(self) -> None:
        """Derive constants of masses and armatures; positions stay."""
        # Constraint regularisation depends on inverse weights that only mj_setConst derives; it overwrites
        # qpos.
        before = np.array(self._data.qpos)
        mujoco.mj_setConst(self._model, self._data)
        self._data.qpos[:] = before

    def set_frictionloss(self, frictionloss: FloatArray) -> None:
        """Set the joints' friction, (J,) [N·m]; cheap enough for every step."""
        self._model.dof_frictionloss[self._v] = frictionloss

    def set_damping(self, damping: FloatArray) -> None:
        """Set the joints' damping, (J,) [N·m·s/rad], integrated implicitly; cheap enough for every step."""
        self._model.dof_damping[self._v] = damping

    def set_pose(self, position: FloatArray, height_m: float | None = None) -> None:
        """Set an upright pose at rest, and clear the solver's warm start.

        Args:
            position: Of the joints, (J,) [rad].
            height_m: Of the base's frame [m]; None keeps it. A held base does not move.
        """
        self._data.qpos[self._q] = position
        self._data.qvel[:] = 0.0
        self._data.qacc_warmstart[:] = 0.0
        if self._free and height_m is not None:
            self._data.qpos[self._base_q : self._base_q + 7] = (0.0, 0.0, height_m, 1.0, 0.0, 0.0, 0.0)

    def digest(self) -> bytes:
        """Return a digest of model and state: two simulations with the same one move alike."""
        model = np.empty(mujoco.mj_sizeModel(self._model), np.uint8)
        mujoco.mj_saveModel(self._model, None, model)
        part = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self._model, part))
        mujoco.mj_getState(self._model, self._data, state, part)
        return hashlib.sha256(model.tobytes() + state.tobytes()).digest()

    def save(self) -> mujoco.MjData:
        """Return a copy of all that a step changes, for :meth:`load`."""
        return copy.copy(self._data)

    def load(self, saved: mujoco.MjData) -> None:
        """Continue where a simulation of the same model was saved."""
        self._data = copy.copy(saved)

    def push(self, force: Sequence[float]) -> None:
        """Push at the base from now on, (3,) [N] in the world; zeros end the push."""
        self._data.xfrc_applied[self._body, :3] = force

    def step(self, effort: FloatArray) -> None:
        """Hold these joint efforts, (J,) [N·m], for one step."""
        self._data.qfrc_applied[self._v] = effort
        mujoco.mj_step(self._model, self._data)


def _add_touch_sensors(spec: mujoco.MjSpec, feet: Sequence[str]) -> None:
    """Give each foot a site around it and a sensor that sums the normal forces inside."""
    for name in feet:
        geom = spec.geom(name)
        site = f"{name}_touch"
        geom.parent.add_site(
            name=site, pos=geom.pos, size=[_TOUCH * geom.size[0]] * 3, type=mujoco.mjtGeom.mjGEOM_SPHERE
        )
        spec.add_sensor(
            name=site, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site
        )
