"""Laws of a calibrated robot in your own MuJoCo loop: what its MJCF says beside MuJoCo's own fields.

A calibrated MJCF has values that no field of MuJoCo holds: latency, friction by speed and load, a lag of the
drives, encoder biases. They stand in ``<custom>``. MuJoCo reads that section and does nothing with it::

    model = mujoco.MjModel.from_xml_path("calibrated.xml")
    data = mujoco.MjData(model)
    laws = ActuatorLaws(model, data)
    while True:
        laws.step(command)            # instead of data.ctrl[:] = command; mujoco.mj_step(model, data)
        position = laws.reported()    # as the robot's encoders would report it

The equations are those of :mod:`deal_hw.sim.laws`, as in calibration and training.
"""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine.batch import COMMAND_DELAY, command_laws
from deal_hw.sim.engine.model import command_scale, drop_command_laws, filters_of
from deal_hw.sim.engine.step_laws import StepLaws
from deal_hw.sim.engine.transmission import take_constant_torques
from deal_hw.sim.laws.setpoints import delay, slew
from deal_hw.sim.mjcf.calibrated import custom_latency_s, custom_name, custom_values
from deal_hw.sim.mjcf.plain import PLAIN_TEXT
from deal_hw.sim.parameters import DEVICE_KINDS, KIND_TABLE
from deal_hw.sim.parameters.drive import find_drive
from deal_hw.sim.parameters.fields import ModelFields, element_id, element_names
from deal_hw.sim.parameters.kind import joint_of
from deal_hw.sim.parameters.one_drive import gather
from deal_hw.sim.parameters.sensor import ENCODER_BIAS, ENCODER_SCALE
from deal_hw.sim.parameters.transmission import TRANSMISSION_STIFFNESS
from deal_hw.sim.parameters.values import spread
from deal_hw.types import FloatArray


class ActuatorLaws:
    """The laws of one model and its data; all of them are read from ``<custom>`` once.

    The model's friction, effort limits and, for an encoder's scale, servo gains are written, and filters of
    its actuators are taken over from the engine. A change of these by other code is not seen. With an
    encoder's scale, joints must be hinges or slides. Set-points are those of joints: in the file of a servo
    with a gear or a scaled set-point, ``ctrl`` is another number.

    Args:
        model: A calibrated model.
        data: Its data. Call :meth:`restart` after a reset.

    Raises:
        ConfigurationError: A law names a joint or actuator that the model lacks, or the model has the laws
            itself (:mod:`deal_hw.sim.mjcf.plain`).
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, PLAIN_TEXT) >= 0:
            raise ConfigurationError(
                "this model has laws as MuJoCo's own elements, and they would act twice; give the calibrated "
                "model from which it was made (calibrated.xml), or call mujoco.mj_step"
            )
        listed = {kind: custom_values(model, custom_name(kind)) for kind in DEVICE_KINDS}
        values = {
            kind: [(name, np.array([value])) for name, value in found.items()]
            for kind, found in listed.items()
            if found
        }
        actuators, joints = element_names(model, "actuator"), element_names(model, "joint")
        gather(model)

        def of(kind: str, names: list[str], neutral: float) -> FloatArray:
            found = spread(values, kind, names, neutral, 1)
            return np.full(len(names), neutral) if found is None else found[0]

        for kind, elements in values.items():
            for name, _ in elements:
                element_id(model, KIND_TABLE[kind].element, name)
        # What drives no joint is no servo: its -1 stands for none.
        self._joint = [joint_of(model, actuator) for actuator in range(model.nu)]
        drives = [find_drive(model, i) for i in range(model.nu)]
        self._servo = np.array([d is not None and d.takes == "position" for d in drives], dtype=bool)
        self._per_ctrl = command_scale(model, range(model.nu))
        filters = filters_of(model, range(model.nu), self._per_ctrl)
        drop_command_laws(model)
        self._rate = of("servo_speed_limit", actuators, np.inf) * model.opt.timestep
        late_s = of(COMMAND_DELAY, actuators, 0.0) + custom_latency_s(model)
        self._lag = late_s[None] / model.opt.timestep
        self._commands = command_laws(values, actuators, 1, filters if filters.lag_s.any() else None)
        self._bias, self._scale = of(ENCODER_BIAS, joints, 0.0), of(ENCODER_SCALE, joints, 1.0)
        gain = np.where(self._servo, self._scale[self._joint], 1.0)
        model.actuator_gainprm[:, 0] *= gain
        model.actuator_biasprm[:, 1] *= gain
        model.actuator_biasprm[:, 2] *= gain
        take_constant_torques(model, [name for name, _ in values.get(TRANSMISSION_STIFFNESS, ())])
        self._laws = StepLaws.of(ModelFields(model, model), lambda name: getattr(data, name)[None], values)
        self._path = np.zeros((1, int(np.ceil(self._lag.max(initial=0.0))) + 2, model.nu))
        self._memory = np.zeros((1, 2, model.nu))
        self.restart(self._held())

    def restart(self, command: npt.ArrayLike) -> None:
        """Begin anew, with a command that has acted for long: servos' set-points or motors' efforts, (A,).

        Positions in the data are those at the encoders. Where one is at the motor, behind an elastic
        transmission, the first step puts the link to where its load bends that.
        """
        held = np.asarray(command, dtype=float)[None]
        self._path[:] = held[:, None]
        self._memory = self._commands.memory(held)
        self._began = False
        if self._laws is not None:
            self._laws.restart()

    def step(self, command: npt.ArrayLike) -> None:
        """Advance by one physics step with a command, (A,), as it is sent to the robot."""
        ahead = np.asarray(command, dtype=float)[None, None]
        if np.isfinite(self._rate).any():
            ahead = slew(self._path[:, -1], ahead, np.where(self._servo, self._rate, np.inf)[None])
        self._path = np.concatenate([self._path[:, 1:], ahead], axis=1)
        late = delay(self._path, self._lag, self._path[:, 0])[:, -1:]
        acting, self._memory = self._commands.act(late, self._memory, self._model.opt.timestep)
        # A servo compares its set-point with the reading.
        joint = self._joint
        read = (acting[0, 0] - self._bias[joint]) / self._scale[joint]
        self._data.ctrl[:] = np.where(self._servo, read, acting[0, 0]) / self._per_ctrl
        if self._laws is not None:
            if not self._began:
                self._laws.begin(lambda: mujoco.mj_forward(self._model, self._data))
            self._laws.write()
        self._began = True
        mujoco.mj_step(self._model, self._data)
        if self._laws is not None:
            self._laws.follow()

    def reported(self) -> FloatArray:
        """Return the positions of all hinges and slides as their encoders report them, (J,) [rad or m]."""
        one = self._one_dof
        measured = self._data.qpos.copy()
        if self._laws is not None:
            self._laws.report("qpos", measured[None])
        at = self._model.jnt_qposadr[one]
        return np.asarray(self._scale[one] * measured[at] + self._bias[one])

    @property
    def _one_dof(self) -> npt.NDArray[np.intp]:
        kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        return np.flatnonzero(np.isin(self._model.jnt_type, kinds))

    def _held(self) -> FloatArray:
        """Return the command at which servos rest in the model's pose, and motors are off."""
        at = self._data.qpos[self._model.jnt_qposadr[self._joint]]
        return np.where(self._servo, self._scale[self._joint] * at + self._bias[self._joint], 0.0)
