"""Laws that act between the engine's steps: friction, effort by speed, servos' firmware, transmissions.

Before each step friction, effort limits and constant efforts are written into the model's fields, from the
state at the beginning of the step and the torques during the step before. MuJoCo solves friction as a
constraint, so a joint that friction holds stays at rest, with any step. Rotors of elastic transmissions move
after each step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from deal_hw.sim.engine.servo_firmware import ServoFirmware
from deal_hw.sim.engine.transmission import Transmissions
from deal_hw.sim.laws.friction import FrictionLaw
from deal_hw.sim.laws.motor import effort_range
from deal_hw.sim.parameters.fields import Fields, as_slice, element_id
from deal_hw.sim.parameters.laws import FREE_SPEED, FRICTION_KINDS, STRIBECK_SPEED
from deal_hw.sim.parameters.values import KindValues
from deal_hw.types import FloatArray, IntArray

LEAST_FRICTION = 1e-9
"""Friction that is written at least [N·m or N]. MuJoCo has a row of friction only where it is above 0."""


Outputs: TypeAlias = Callable[[str], FloatArray]
"""Returns the live values of an MjData field of N simulations, (N, ...)."""


class StepLaws:
    """The laws of N simulations.

    Args:
        fields: Their model fields.
        outputs: Their states and torques.
        dof: Degrees of freedom with a friction law, D of them.
        friction: Their law; its Coulomb part is that of the fields.
        actuator: Actuators with a speed without load, B of them.
        free_speed: These speeds, (N, B) [rad/s or m/s].
        firmware: What servos make of the errors of their positions; None for servos without such a law.
        transmissions: Springs between motors and links; None without any.

    Attributes:
        firmware: The same.
        transmissions: The same.
    """

    def __init__(
        self,
        fields: Fields,
        outputs: Outputs,
        dof: list[int],
        friction: dict[str, FloatArray],
        actuator: list[int],
        free_speed: FloatArray,
        firmware: ServoFirmware | None = None,
        transmissions: Transmissions | None = None,
    ) -> None:
        model = self._model = fields.model
        driven = [int(model.jnt_dofadr[model.actuator_trnid[a, 0]]) for a in actuator]
        self._dof, self._actuator, self._driven = as_slice(dof), as_slice(actuator), as_slice(driven)
        self._free_speed, self.firmware, self.transmissions = free_speed, firmware, transmissions
        # An actuator behind a negative gear turns the other way than its joint.
        self._turns = np.sign(model.actuator_gear[actuator, 0])
        self._friction: FrictionLaw | None = None
        if dof:
            self._loss = fields.get("dof_frictionloss")
            self._friction = FrictionLaw(coulomb=self._loss[:, dof].copy(), **friction)
        self._limited = bool(actuator)
        if self._limited:
            self._range = fields.get("actuator_forcerange")
            self._read_limits()
        # Transmissions whose servos have a firmware.
        self._served: list[int] = []
        if transmissions is not None and firmware is not None:
            self._served = np.flatnonzero(np.isin(transmissions.actuator, firmware.actuator)).tolist()
        self._qpos, self._qvel = outputs("qpos"), outputs("qvel")
        if self.loaded:
            # Outputs that are bound are copied after every step.
            self._bias, self._torque = outputs("qfrc_bias"), outputs("qfrc_actuator")

    @classmethod
    def of(cls, fields: Fields, outputs: Outputs, values: KindValues) -> StepLaws | None:
        """Return the laws that values by kind set; None where they set none."""
        model = fields.model
        found: dict[int, dict[str, FloatArray]] = {}
        for kind, coefficients in FRICTION_KINDS.items():
            for joint, value in values.get(kind, ()):
                dof = int(model.jnt_dofadr[element_id(model, "joint", joint)])
                found.setdefault(dof, {}).update(dict.fromkeys(coefficients, value))
        firmware = ServoFirmware.of(fields, outputs, values)
        transmissions = Transmissions.of(fields, outputs, values)
        # The limits of a motor behind a spring fall with its own speed, not with the joint's.
        behind = () if transmissions is None else transmissions.names
        free = {
            element_id(model, "actuator", name): value
            for name, value in values.get(FREE_SPEED, ())
            if name not in behind
        }
        if not found and not free and firmware is None and transmissions is None:
            return None
        count = len(outputs("qvel"))
        friction = {
            name: _columns([law.get(name, np.full(count, neutral)) for law in found.values()], count)
            for name, neutral in COEFFICIENTS.items()
        }
        speeds = _columns(list(free.values()), count)
        return cls(fields, outputs, list(found), friction, list(free), speeds, firmware, transmissions)

    @property
    def friction(self) -> FrictionLaw | None:
        """The law of friction; None without any."""
        return self._friction

    @property
    def dof(self) -> IntArray:
        """Degrees of freedom with a friction law, (D,)."""
        return np.arange(self._model.nv)[self._dof]

    @property
    def limits(self) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray] | None:
        """Actuators with a speed without load and their degrees of freedom, (B,) each; None without any.

        Then the signs of their gears, (B,), efforts at standstill and speeds without load, (N, B) each.
        """
        if not self._limited:
            return None
        actuator, dof = np.arange(self._model.nu)[self._actuator], np.arange(self._model.nv)[self._driven]
        return actuator, dof, self._turns, self._stall, self._free_speed

    @property
    def written(self) -> set[str]:
        """Names of the model fields that the laws write."""
        parts = {
            "dof_frictionloss": self._friction is not None,
            "actuator_forcerange": self._limited,
            "actuator_biasprm": self.firmware is not None,
        }
        return {name for name, writes in parts.items() if writes}

    @property
    def loaded(self) -> bool:
        """Whether any friction depends on a load, so that the torques of the step before count."""
        return self._friction is not None and self._friction.loaded

    def restore(self) -> None:
        """Write the model's own values where laws have written."""
        if self._friction is not None:
            self._loss[:, self._dof] = self._model.dof_frictionloss[self._dof]
        if self._limited:
            self._range[:, self._actuator] = self._model.actuator_forcerange[self._actuator]
        if self.firmware is not None:
            self.firmware.restore()
        if self.transmissions is not None:
            self.transmissions.restore()

    def restore_sent(self) -> None:
        """Write the gains, and the effort limits at standstill, where laws have written."""
        if self._limited:
            self._range[:, self._actuator, 0] = -self._stall
            self._range[:, self._actuator, 1] = self._stall
        if self.transmissions is not None:
            self.transmissions.restore_sent()

    def read_sent(self) -> None:
        """Take effort limits in the fields as those at standstill, and gains of servos as those that act."""
        if self._limited:
            self._read_limits()
        if self.firmware is not None:
            self.firmware.read_gains()
        if self.transmissions is not None:
            self.transmissions.read_sent()

    def restart(self, where: npt.NDArray[np.intp] | slice = slice(None)) -> None:
        """Forget what laws keep from step to step, of the members in ``where``, whose states are new."""
        if self.transmissions is not None:
            self.transmissions.restart(where)

    def _read_limits(self) -> None:
        self._stall = self._range[:, self._actuator, 1].copy()

    def begin(self, forward: Callable[[], None]) -> None:
        """Compute what laws take from the step before, where there was none: that of this state.

        Args:
            forward: Computes the torques of all simulations.
        """
        rotors = self.transmissions
        if not self.loaded and (rotors is None or not rotors.fresh.any()):
            return
        if self.firmware is not None:
            self.firmware.write(self._measured())
        if rotors is None:
            forward()
        else:
            rotors.begin(forward, self._served)

    def _measured(self) -> FloatArray | None:
        """Return positions as encoders measure them, (N, nq); None where all are at the joints."""
        if self.transmissions is None or not self.transmissions.at_motor:
            return None
        found = self._qpos.copy()
        self.transmissions.report("qpos", found)
        return found

    def report(self, name: str, values: FloatArray) -> None:
        """Put what encoders at motors measure into a field of MjData.

        Args:
            name: The field; those other than "qpos" and "qvel" stay.
            values: Its values now, (N, ...).
        """
        if self.transmissions is not None:
            self.transmissions.report(name, values)

    def write(self) -> None:
        """Write friction, limits and the servos' efforts for the next step, whose controls are set."""
        if self._friction is not None:
            dof, law = self._dof, self._friction
            if law.loaded:
                budget = law.budget(self._qvel[:, dof], self._torque[:, dof], -self._bias[:, dof])
            else:
                budget = law.budget(self._qvel[:, dof])
            self._loss[:, dof] = np.maximum(budget, LEAST_FRICTION)
        if self._limited:
            low, high = effort_range(self._qvel[:, self._driven] * self._turns, self._stall, self._free_speed)
            self._range[:, self._actuator, 0], self._range[:, self._actuator, 1] = low, high
        if self.firmware is not None:
            self.firmware.write(self._measured())
        if self.transmissions is not None:
            self.transmissions.write(self._served)

    def follow(self) -> None:
        """Move what laws keep from step to step, after the engine's step."""
        if self.transmissions is not None:
            self.transmissions.follow()


def rollout(
    batch: Batch, laws: StepLaws, control: FloatArray, spec: int, recorded: Mapping[str, int]
) -> dict[str, FloatArray]:
    """Advance as ``Batch.rollout`` does, with laws before each step.

    Args:
        batch: The simulations.
        laws: Their laws.
        control: What acts at each step, (N, S, size of ``spec``).
        spec: The state components that it sets.
        recorded: MjData fields to return, and the steps from one record to the next.

    Returns:
        These fields after steps every, 2 every, ..., (N, S // every, ...) each.
    """
    count, steps, _ = control.shape
    fields = {name: batch.bind(name) for name in recorded}
    record = {
        name: np.empty((count, steps // recorded[name], *field.shape[1:])) for name, field in fields.items()
    }
    ctrl, applied = batch.bind("ctrl"), batch.bind("qfrc_applied")
    nu = ctrl.shape[1]
    pushed = bool(spec & int(mujoco.mjtState.mjSTATE_QFRC_APPLIED))
    ctrl[:] = control[:, 0, :nu]
    # A member that diverged has no numbers, and is found by the engine.
    with np.errstate(over="ignore", invalid="ignore"):
        laws.begin(batch.forward)
        for step in range(steps):
            ctrl[:] = control[:, step, :nu]
            laws.write()
            if pushed:
                applied[:] = control[:, step, nu:]
            batch.step()
            laws.follow()
            for name, field in fields.items():
                index, between = divmod(step + 1, recorded[name])
                if not between:
                    record[name][:, index - 1] = field
                    laws.report(name, record[name][:, index - 1])
    return record


def _columns(values: list[FloatArray], count: int) -> FloatArray:
    return np.stack(values, axis=1) if values else np.zeros((count, 0))


COEFFICIENTS = {
    "stribeck": 0.0,
    "stribeck_speed": STRIBECK_SPEED,
    "motor": 0.0,
    "external": 0.0,
    "motor_stribeck": 0.0,
    "external_stribeck": 0.0,
}
"""Coefficients of friction that parameters set, and their values where none does."""
