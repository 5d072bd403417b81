"""One simulated mechanism whose joints are driven by explicit efforts, one physics step at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco

from deal_hw.errors import ConfigurationError
from deal_hw.sim.parameters.fields import element_id


class SingleSimulation:
    """A MuJoCo model without its actuators: the caller is the controller and holds an effort for one step.

    It is only for mechanisms of slide and hinge joints, where positions and velocities have equal length (J).

    Args:
        mjcf: The model.
    """

    def __init__(self, mjcf: Path) -> None:
        self._model = mujoco.MjModel.from_xml_path(str(mjcf))
        if self._model.nq != self._model.nv:
            raise ConfigurationError(
                f"{mjcf}: only slide and hinge joints (got nq {self._model.nq}, nv {self._model.nv})"
            )
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self._data = mujoco.MjData(self._model)
        self._qpos, self._qvel = self._data.qpos, self._data.qvel
        self._applied = self._data.qfrc_applied
        self._frictionloss = self._model.dof_frictionloss

    @property
    def timestep_s(self) -> float:
        """Length of one step [s]."""
        return float(self._model.opt.timestep)

    def set_body_mass(self, body: str, mass: float) -> None:
        """Set a body's mass [kg]; its inertia scales along, as for the same shape of another density."""
        index = element_id(self._model, "body", body)
        self._model.body_inertia[index] *= mass / self._model.body_mass[index]
        self._model.body_mass[index] = mass
        self._refresh()

    def set_dof(
        self,
        joint: str,
        *,
        damping: float | None = None,
        frictionloss: float | None = None,
        armature: float | None = None,
    ) -> None:
        """Set damping, dry friction and armature of a joint; SI units of sliding or turning joints."""
        index = element_id(self._model, "joint", joint)
        if damping is not None:
            self._model.dof_damping[index] = damping
        if frictionloss is not None:
            self._model.dof_frictionloss[index] = frictionloss
        if armature is not None:
            self._model.dof_armature[index] = armature
            self._refresh()

    def set_frictionloss(self, index: int, frictionloss: float) -> None:
        """Set the frictionloss of the joint at this index; cheap enough for every step."""
        self._frictionloss[index] = frictionloss

    def position(self) -> list[float]:
        """Return the joint positions, J floats [m or rad]."""
        values: list[float] = self._qpos.tolist()
        return values

    def velocity(self) -> list[float]:
        """Return the joint velocities, J floats [m/s or rad/s]."""
        values: list[float] = self._qvel.tolist()
        return values

    def set_state(self, position: Sequence[float], velocity: Sequence[float]) -> None:
        """Set the state, and clear the solver's warm start."""
        self._qpos[:] = position
        self._qvel[:] = velocity
        self._data.qacc_warmstart[:] = 0.0

    def step(self, effort: Sequence[float]) -> None:
        """Hold these joint efforts, (J,) [N or N*m], for one step."""
        self._applied[:] = effort
        mujoco.mj_step(self._model, self._data)

    def _refresh(self) -> None:
        # Constraint regularisation depends on inverse weights that only mj_setConst derives; it overwrites
        # qpos.
        position, velocity = self.position(), self.velocity()
        mujoco.mj_setConst(self._model, self._data)
        self.set_state(position, velocity)
