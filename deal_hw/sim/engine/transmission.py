"""Elastic transmissions between the engine's steps: rotors that MuJoCo's model does not have.

A joint's ``dof_armature`` is the rotor's inertia. It is taken out of the model, and the rotor gets an angle
and a speed of its own. The actuator's gains, constant effort and limit give the motor's torque: from the
position where the encoder is, of the link or of the motor, and the speed of the motor. In the model the
actuator is a constant torque, which is written before each step, and the armature is what the link feels of
the rotor. So ``qfrc_actuator`` is what the transmission passes. Where friction is at the motor, the joint's
dry friction and damping are taken out of the model, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.sim.laws.motor import effort_range
from deal_hw.sim.laws.transmission import Couplings, TransmissionLaw, within
from deal_hw.sim.parameters.fields import Fields, as_slice, element_id
from deal_hw.sim.parameters.laws import FREE_SPEED
from deal_hw.sim.parameters.transmission import (
    ENCODER_AT_MOTOR,
    FRICTION_AT_MOTOR,
    TRANSMISSION_DAMPING,
    TRANSMISSION_PLAY,
    TRANSMISSION_STIFFNESS,
)
from deal_hw.sim.parameters.values import KindValues
from deal_hw.types import FloatArray

Outputs = Callable[[str], FloatArray]

Mask = npt.NDArray[np.bool_]

_RUBS = ("dof_frictionloss", "dof_damping")
"""What of a joint acts on the motor where its friction is there."""

_FIELDS = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")

_SETTLING = 2
"""Times that a link's start position follows from its load there. Each leaves a share of the error: what the
load changes with the position over the transmission's stiffness, 1/65 for the arm of the tests."""


def check_engine(space: ParameterSpace, engine: EngineName) -> None:
    """Refuse transmissions on MuJoCo Warp.

    Raises:
        ConfigurationError: The engine is not MuJoCo, and a parameter is a transmission's stiffness.
    """
    if engine == "mujoco":
        return
    for p in space.parameters:
        if p.kind == TRANSMISSION_STIFFNESS:
            raise ConfigurationError(
                f"MuJoCo Warp does not simulate the elastic transmission of {p.name!r} ({p.kind}); use "
                "--engine mujoco"
            )


def take_constant_torques(model: mujoco.MjModel, names: Sequence[str]) -> None:
    """Let actuators add the constant torque of their biasprm, which those without a bias type ignore."""
    affine = int(mujoco.mjtBias.mjBIAS_AFFINE)
    for name in names:
        actuator = element_id(model, "actuator", name)
        if int(model.actuator_biastype[actuator]) != affine:
            model.actuator_biastype[actuator] = affine
            model.actuator_biasprm[actuator] = 0.0


class Transmissions:
    """The transmissions of B actuators of N simulations, with the states of their rotors.

    Args:
        fields: Their model fields, with the rotors' inertias as armature. The simulated model has been passed
            to :func:`take_constant_torques`.
        outputs: Returns the live values of an MjData field, (N, ...).
        values: Values by kind; each actuator has a stiffness.

    Attributes:
        names: Names of the actuators, B of them.
        actuator: Their numbers.
        at_motor: Whether any encoder is at the motor.
        fresh: Whether the rotors of a member follow from its state at the next beginning, (N,).
        angle: Angles of the motors, (N, B) [rad or m].
        speed: Their speeds, (N, B) [rad/s or m/s].
    """

    def __init__(self, fields: Fields, outputs: Outputs, values: KindValues) -> None:
        model = self._model = fields.model
        given = {
            kind: dict(values.get(kind, ()))
            for kind in (TRANSMISSION_STIFFNESS, TRANSMISSION_DAMPING, TRANSMISSION_PLAY)
        }
        names = self.names = list(given[TRANSMISSION_STIFFNESS])
        actuator = self.actuator = [element_id(model, "actuator", name) for name in names]
        joint = model.actuator_trnid[actuator, 0]
        # Transmissions with the encoder at the motor, (B,), and where their joints have positions and speeds.
        turned = {name for name, _ in values.get(ENCODER_AT_MOTOR, ())}
        self._turned = np.array([model.joint(int(j)).name in turned for j in joint])
        # Those whose joints' friction is at the motor, (B,).
        rubbing = {name for name, _ in values.get(FRICTION_AT_MOTOR, ())}
        self._rubbing = np.array([model.joint(int(j)).name in rubbing for j in joint])
        self.at_motor = bool(self._turned.any())
        dof, place = model.jnt_dofadr[joint].tolist(), model.jnt_qposadr[joint].tolist()
        self._actuator, self._dof, self._place = as_slice(actuator), as_slice(dof), as_slice(place)
        self._reported = {
            name: as_slice(np.array(of)[self._turned].tolist())
            for name, of in (("qpos", place), ("qvel", dof))
        }
        self._qpos, self._qvel = outputs("qpos"), outputs("qvel")
        self._control, self._torque, self._qacc = outputs("ctrl"), outputs("qfrc_actuator"), outputs("qacc")
        self._gain, self._bias, self._range = (fields.get(name) for name in _FIELDS)
        self._armature = fields.get("dof_armature")
        self._rubs = {name: fields.get(name) for name in _RUBS if self._rubbing.any()}
        self._rubbing_dof = np.array(dof)[self._rubbing]
        # MuJoCo takes the inertia of a body that moves alone ("simple") as it was derived, with the armature.
        self._simple = np.flatnonzero(np.array(model.dof_simplenum)[dof] > 0)
        self._simple_dof = [dof[k] for k in self._simple]
        self._derived = fields.get("dof_M0")
        self._alone = self._derived[:, self._simple_dof] - self._armature[:, self._simple_dof]
        self._nominal = [np.array(getattr(model, name)[actuator]) for name in _FIELDS]
        self._nominal[1][model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE] = 0.0
        shape = len(self._qvel), len(names)

        def of(kind: str) -> FloatArray:
            found = given[kind]
            return np.stack([found.get(name, np.zeros(shape[0])) for name in names], axis=1)

        rotor = self._armature[:, self._dof].copy()
        # Dry friction and damping of the joints that act on the motors, (N, B) each.
        self._friction, self._damping = (
            np.where(self._rubbing, self._rubs[name][:, self._dof], 0.0) if self._rubs else np.zeros(shape)
            for name in _RUBS
        )
        self._constraint = outputs("qfrc_constraint") if self._rubs else None
        # The inertia at the joint in the model's first pose, with all other joints free.
        whole = 1 / fields.get("dof_invweight0")[:, self._dof]
        self.law = TransmissionLaw(
            stiffness=of(TRANSMISSION_STIFFNESS),
            damping=of(TRANSMISSION_DAMPING),
            play=of(TRANSMISSION_PLAY),
            inertia=rotor,
            link_inertia=np.maximum(whole - rotor, 1e-6 * whole),
            step_s=float(model.opt.timestep),
        )
        self._gear = np.tile(model.actuator_gear[actuator, 0], (shape[0], 1))
        self._limited = np.array(model.actuator_forcelimited[actuator], dtype=bool)
        self._any_limited = bool(self._limited.any())
        self._control_range = np.where(
            model.actuator_ctrllimited[actuator], model.actuator_ctrlrange[actuator].T, [[-np.inf], [np.inf]]
        )
        self._free_speed: FloatArray | None = None
        if FREE_SPEED in values:
            known = dict(values[FREE_SPEED])
            never = np.full(shape[0], np.inf)
            self._free_speed = np.stack([known.get(name, never) for name in names], axis=1)
        self._bounded = bool(np.isfinite(self._control_range).any())
        # Deflection, motor's speed, link's speed and motor's torque.
        self._state = np.zeros((4, *shape))
        self.angle, self.speed = np.zeros(shape), self._state[1]
        # The torque that the transmissions pass.
        self._passed = np.zeros(shape)
        self.fresh: Mask = np.ones(shape[0], dtype=bool)
        self._moves = False
        self.read_sent()

    @classmethod
    def of(cls, fields: Fields, outputs: Outputs, values: KindValues) -> Transmissions | None:
        """Return the transmissions that values by kind set; None where they set none."""
        return cls(fields, outputs, values) if TRANSMISSION_STIFFNESS in values else None

    def restart(self, where: npt.NDArray[np.intp] | slice = slice(None)) -> None:
        """Let rotors of members follow from their states at the next beginning."""
        self.fresh[where] = True

    def read_sent(self) -> None:
        """Take gains and limits in the fields as those of the motors, and put the transmissions there."""
        at = self._actuator
        self._own = self._gain[:, at, 0].copy(), self._bias[:, at, :3].copy(), self._range[:, at].copy()
        gain, bias, limits = self._own
        ends = np.sort(self._gear[..., None] * limits, axis=-1)
        ends[:, ~self._limited] = -np.inf, np.inf
        self._least, self._most = (np.ascontiguousarray(ends[..., k]) for k in (0, 1))
        self._per_control, self._constant = self._gear * gain, self._gear * bias[..., 0]
        self._per_position, self._resistance = (-(self._gear**2) * bias[..., k] for k in (1, 2))
        own = np.where(self._turned, self._per_position, 0.0)
        self._couplings = Couplings(self.law, self._resistance, own, self._friction, self._damping)
        self._write_motors(np.zeros(len(self.fresh), dtype=bool))

    def restore_sent(self) -> None:
        """Write the motors' gains and limits, and the rotors' inertias, where transmissions stand."""
        self._write_motors(np.ones(len(self.fresh), dtype=bool))

    def restore(self) -> None:
        """Write the model's own values where transmissions stand; derived inertias are as they were."""
        at = self._actuator
        self._put_inertia(self.law.inertia)
        for field, own in zip((self._gain, self._bias, self._range), self._nominal, strict=True):
            field[:, at] = own
        self._armature[:, self._dof] = self._model.dof_armature[self._dof]
        for name, field in self._rubs.items():
            field[:, self._rubbing_dof] = getattr(self._model, name)[self._rubbing_dof]

    def _write_motors(self, rows: npt.NDArray[np.bool_]) -> None:
        """Write the motors as they are in the members of ``rows``, (N,), and transmissions in the others."""
        at, there = self._actuator, rows[:, None]
        gain, bias, limits = self._own
        self._gain[:, at, 0] = np.where(there, gain, 0.0)
        self._bias[:, at, :3] = np.where(there[..., None], bias, 0.0)
        self._bias[:, at, 0] = np.where(there, bias[..., 0], self._passed / self._gear)
        self._range[:, at] = np.where(there[..., None], limits, (-np.inf, np.inf))
        self._put_inertia(np.where(there, self.law.inertia, self._couplings.inertia))
        self._put_friction(there)

    def _put_inertia(self, inertia: FloatArray) -> None:
        """Write what the links have beside their own inertia, (N, B)."""
        self._armature[:, self._dof] = inertia
        if self._simple_dof:
            self._derived[:, self._simple_dof] = self._alone + inertia[:, self._simple]

    def _put_friction(self, rows: npt.NDArray[np.bool_]) -> None:
        """Write motors' friction as their joints' in the members of ``rows``, (N, 1), and 0 in the others."""
        if not self._rubs:
            return
        for name, own in zip(_RUBS, (self._friction, self._damping), strict=True):
            self._rubs[name][:, self._rubbing_dof] = np.where(rows, own[:, self._rubbing], 0.0)

    def begin(self, forward: Callable[[], None], served: list[int]) -> None:
        """Set the states of fresh rotors: they move with their links, and their springs pass what is needed.

        That is the motor's torque less what accelerates the rotor together with its link. The position in
        the state is that of the encoder. Where it is the motor's, the link gets its own one: that at which
        its load bends the spring as much.

        Args:
            forward: Computes torques and accelerations of all simulations.
            served: Places in B of servos whose firmware has just written their constant efforts.
        """
        rows, link = self.fresh[:, None], self._qvel[:, self._dof]
        read = self._qpos[:, self._place].copy()
        np.copyto(self.speed, link, where=rows)
        np.copyto(self.angle, read, where=rows)
        held = self._drive(read, served)
        lost = self._resistance if held is None else np.where(held, 0.0, self._resistance)
        acting = self._state[3] - lost * link
        self._write_motors(np.zeros_like(self.fresh))
        # Members that go on pass the torque of their last step.
        self._bias[:, self._actuator, 0] = np.where(rows, acting, self._passed) / self._gear
        self._put_inertia(np.where(rows, self.law.inertia, self._couplings.inertia))
        # Rotors and links of fresh members move as one, so that friction holds both.
        self._put_friction(rows)
        bent = self._bent(forward)
        if self.at_motor:
            at, motors = self._reported["qpos"], self._turned
            for _ in range(_SETTLING):
                there = read[:, motors] - bent[:, motors]
                self._qpos[:, at] = np.where(rows, there, self._qpos[:, at])
                bent = self._bent(forward)
            bent[:, motors] = read[:, motors] - self._qpos[:, at]
        np.copyto(self.angle, self._qpos[:, self._place] + bent, where=rows)
        self.fresh[:] = False
        self._write_motors(self.fresh)

    def _bent(self, forward: Callable[[], None]) -> FloatArray:
        """Return how far transmissions bend that move rotors and links as one in this state, (N, B)."""
        forward()
        passed = self._torque[:, self._dof] - self.law.inertia * self._qacc[:, self._dof]
        if self._constraint is not None:
            # What friction takes from the motor passes no spring. A constraint beyond it is the link's.
            passed = passed + within(self._constraint[:, self._dof], self._friction)
            passed -= self._damping * self._qvel[:, self._dof]
        return self.law.deflection(passed)

    def report(self, name: str, values: FloatArray) -> None:
        """Put what encoders at motors measure into positions or speeds of the simulations.

        Args:
            name: The field of MjData, "qpos" or "qvel"; others stay.
            values: Its values, (N, ...).
        """
        if self.at_motor and name in self._reported:
            at = self._reported[name]
            motors = (self.angle if name == "qpos" else self.speed)[:, self._turned]
            # A fresh state is as it was set: by what the encoder has measured.
            values[:, at] = np.where(self.fresh[:, None], values[:, at], motors)

    def write(self, served: list[int]) -> None:
        """Write torques and inertias for the next step, whose controls are set.

        Args:
            served: Places in B of servos whose firmware has just written their constant efforts.
        """
        # Operations on parts of rows cost more than a copy.
        link, state = self._qpos[:, self._place].copy(), self._state
        held = self._drive(link, served)
        np.subtract(self.angle, link, out=state[0])
        state[2] = self._qvel[:, self._dof]
        self._passed, changed = self._couplings.couple(state, held)
        self._bias[:, self._actuator, 0] = self._passed / self._gear
        if changed:
            self._put_inertia(self._couplings.inertia)
        self._moves = True

    def _drive(self, link: FloatArray, served: list[int]) -> Mask | None:
        """Put the motors' torques into the state; return where they are at their limits, (N, B).

        The torques are those at standstill, before what the motors lose with their speeds, or the limits.

        Args:
            link: Positions of the links, (N, B).
            served: As in :meth:`write`.

        Returns:
            None for nowhere.
        """
        if served:
            efforts = self._bias[:, [self.actuator[k] for k in served], 0]
            self._constant[:, served] = self._gear[:, served] * efforts
        control = self._control[:, self._actuator].copy()
        if self._bounded:
            low, high = self._control_range
            control = np.minimum(np.maximum(control, low), high)
        read = np.where(self._turned, self.angle, link) if self.at_motor else link
        torque = self._state[3]
        np.multiply(self._per_control, control, out=torque)
        torque += self._constant
        torque -= self._per_position * read
        if not self._any_limited:
            return None
        least, most = self._limits()
        acting = self._resistance * self.speed
        np.subtract(torque, acting, out=acting)
        able = np.minimum(np.maximum(acting, least), most)
        beyond: Mask = able != acting
        if not np.count_nonzero(beyond):
            return None
        np.copyto(torque, able, where=beyond)
        return beyond

    def _limits(self) -> tuple[FloatArray, FloatArray]:
        """Return the least and largest torque of the motors at their speeds, (N, B) each."""
        if self._free_speed is None:
            return self._least, self._most
        return effort_range(self.speed, self._most, self._free_speed)

    def follow(self) -> None:
        """Move the rotors by the step that the engine has done."""
        if self._moves:
            self._couplings.follow(self._qvel[:, self._dof].copy(), self.speed)
            self.angle += self.law.step_s * self.speed
