"""Laws of servos' firmware between the engine's steps: what they make of the error of their position.

MuJoCo's servo has the effort ``k (goal - q) - d w``. Before each step its constant part, ``biasprm[0]``, is
written such that the error at the beginning of the step counts as the law has it. Gains, damping and effort
limit act as before, so the limit bounds the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from deal_hw.sim.laws.servo import ServoLaw
from deal_hw.sim.parameters.drive import setpoint_ratio
from deal_hw.sim.parameters.fields import Fields, as_slice, element_id
from deal_hw.sim.parameters.laws import SERVO_LAW_KINDS
from deal_hw.sim.parameters.sensor import ENCODER_BIAS, ENCODER_SCALE
from deal_hw.sim.parameters.values import KindValues
from deal_hw.types import FloatArray, IntArray


class ServoFirmware:
    """The firmware of B servos of N simulations.

    Args:
        fields: Their model fields.
        outputs: Returns the live values of an MjData field, (N, ...).
        actuator: The servos, (B,).
        law: Their law, of (N, B).

    Attributes:
        actuator: The servos, (B,).
        law: Their law.
        gear: Their gears, (B,).
        per_ctrl: Goal of the joint at a ``ctrl`` of 1, (B,).
        offset: Their own constant efforts before the gear, (B,).
        control_range: Ends of their ``ctrl``, (2, B); infinite where MuJoCo does not clip it.
        place: Places of their joints in qpos, (B,).
    """

    def __init__(
        self, fields: Fields, outputs: Callable[[str], FloatArray], actuator: list[int], law: ServoLaw
    ) -> None:
        model = fields.model
        self.actuator: IntArray = np.array(actuator)
        self.law = law
        self.gear = np.array(model.actuator_gear[actuator, 0])
        self.per_ctrl = np.array([setpoint_ratio(model, a) for a in actuator]) / self.gear
        self.offset = np.array(model.actuator_biasprm[actuator, 0])
        self.control_range = np.where(
            model.actuator_ctrllimited[actuator], model.actuator_ctrlrange[actuator].T, [[-np.inf], [np.inf]]
        )
        self.place: IntArray = model.jnt_qposadr[model.actuator_trnid[actuator, 0]].astype(int)
        self._rows, self._columns = as_slice(actuator), as_slice(self.place.tolist())
        self._limited = bool(np.isfinite(self.control_range).any())
        self._bias = fields.get("actuator_biasprm")
        self._control, self._qpos = outputs("ctrl"), outputs("qpos")
        self.read_gains()

    @classmethod
    def of(
        cls, fields: Fields, outputs: Callable[[str], FloatArray], values: KindValues
    ) -> ServoFirmware | None:
        """Return the firmware that values by kind set; None where they set none."""
        model, count = fields.model, len(outputs("qpos"))
        names = list(dict.fromkeys(name for kind in SERVO_LAW_KINDS for name, _ in values.get(kind, ())))
        if not names:
            return None
        actuator = [element_id(model, "actuator", name) for name in names]
        joints = [model.joint(int(j)).name for j in model.actuator_trnid[actuator, 0]]

        def of(kind: str, elements: Sequence[str], neutral: float) -> FloatArray:
            found = dict(values.get(kind, ()))
            return np.stack([found.get(name, np.full(count, neutral)) for name in elements], axis=1)

        law = ServoLaw(
            **{part: of(kind, names, 0.0) for kind, part in SERVO_LAW_KINDS.items()},
            scale=of(ENCODER_SCALE, joints, 1.0),
            bias=of(ENCODER_BIAS, joints, 0.0),
        )
        return cls(fields, outputs, actuator, law)

    def read_gains(self) -> None:
        """Take the gains in the fields as those that act."""
        gain = -self._bias[:, self._rows, 1]
        self._stiffness, self._push = gain * self.gear**2, gain * self.gear

    def restore(self) -> None:
        """Write the model's own constant efforts where the law has written."""
        self._bias[:, self._rows, 0] = self.offset

    def write(self, measured: FloatArray | None = None) -> None:
        """Write constant efforts for the next step, from the controls and positions at its beginning.

        Args:
            measured: The state's positions as encoders measure them, (N, nq); by default those of the joints.
        """
        goal = self._control[:, self._rows]
        if self._limited:
            goal = np.clip(goal, *self.control_range)
        goal, position = (
            goal * self.per_ctrl,
            (self._qpos if measured is None else measured)[:, self._columns],
        )
        missing = self.law.acting_error(goal, position, self._stiffness) - (goal - position)
        self._bias[:, self._rows, 0] = self.offset + self._push * missing
