"""A motor and its link with an elastic transmission in a loop of mj_step, and MuJoCo's own two bodies."""

from __future__ import annotations

import mujoco
import numpy as np

from deal_hw.sim.engine.step_laws import StepLaws
from deal_hw.sim.engine.transmission import Transmissions, take_constant_torques
from deal_hw.sim.laws.transmission import Couplings, TransmissionLaw
from deal_hw.sim.parameters.fields import ModelFields

ROTOR, LINK = 0.02, 0.01
"""Inertias of the plate's motor and of the plate [kg·m²]: 1.5 kg / 3 (0.1² + 0.1²) m²."""

PLATE = """
<mujoco><option timestep="{step}" integrator="{integrator}" gravity="0 0 0"/><worldbody>
<body><joint name="plate" axis="0 1 0" armature="0.02"/><geom type="box" size=".1 .01 .1" mass="1.5"/></body>
</worldbody><actuator><motor name="plate" joint="plate"/></actuator></mujoco>"""

PENDULUM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="arm" axis="0 1 0" armature="0.02" damping="0.2"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4"/></body>
</worldbody><actuator>{actuator}</actuator></mujoco>"""

TORQUE = '<motor name="arm" joint="arm"/>'
POSITION = '<position name="arm" joint="arm" kp="{kp}" kv="0.6" forcerange="-2 2"/>'

TWO_BODIES = """
<mujoco><option timestep="0.0001" integrator="implicitfast"/><worldbody>
<body><joint name="arm" axis="0 1 0" damping="0.2"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4"/></body>
<body><joint name="rotor" axis="0 1 0" armature="0.02"/><geom size=".01" mass="1e-6"/></body>
</worldbody><tendon><fixed stiffness="{stiffness}" damping="{damping}" springlength="{low} {high}">
<joint joint="rotor" coef="1"/><joint joint="arm" coef="-1"/></fixed></tendon>
<actuator><motor name="rotor" joint="rotor"/></actuator></mujoco>"""


class SprungLoop:
    """One model with a transmission of its first actuator, in a loop of mj_step.

    Args:
        text: The model, in MJCF.
        at_motor: Whether the encoder is at the motor.
        rubs: Whether the joint's friction is at the motor.
        kinds: Values of the transmission's kinds, without their prefix.
    """

    def __init__(self, text: str, *, at_motor: bool = False, rubs: bool = False, **kinds: float) -> None:
        model = self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(model)
        name = model.actuator(0).name
        take_constant_torques(model, [name])
        values = {f"transmission_{kind}": [(name, np.array([value]))] for kind, value in kinds.items()}
        if at_motor:
            values["encoder_at_motor"] = [(name, np.ones(1))]
        if rubs:
            values["friction_at_motor"] = [(name, np.ones(1))]
        laws = StepLaws.of(ModelFields(model, model), lambda field: getattr(self.data, field)[None], values)
        assert laws is not None and laws.transmissions is not None
        self._laws, self.rotor = laws, laws.transmissions
        self._begun = False

    def begin(self) -> Transmissions:
        """Let the rotor's state follow from the link's; return it."""
        self._laws.begin(lambda: mujoco.mj_forward(self.model, self.data))
        self._begun = True
        return self.rotor

    def step(self, control: float) -> None:
        """Do one step."""
        self.data.ctrl[0] = control
        if not self._begun:
            self.begin()
        self._laws.write()
        mujoco.mj_step(self.model, self.data)
        self._laws.follow()


def plate(
    stiffness: float, step: float = 0.002, integrator: str = "implicitfast", **kinds: float
) -> SprungLoop:
    """Return the plate without gravity."""
    text = PLATE.format(step=step, integrator=integrator)
    return SprungLoop(text, at_motor=False, rubs=False, stiffness=stiffness, **kinds)


def transmission_law(**parts: float) -> TransmissionLaw:
    """Return the law of one joint with a step of 1 ms."""
    every = {"stiffness": 100.0, "damping": 0.0, "play": 0.0, "inertia": 0.02, "link_inertia": 0.01} | parts
    return TransmissionLaw(**{name: np.array([[value]]) for name, value in every.items()}, step_s=0.001)


def coupled(of: TransmissionLaw, *state: float, stiffness: float = 0.0, friction: float = 0.0) -> list[float]:
    """Return torque, inertia, own speed and the share that follows, of one joint.

    Args:
        of: Its law.
        state: Deflection, speeds of the motor and of the link, torque, and what it loses with the speed.
        stiffness: What it loses with the motor's angle.
        friction: Dry friction of the motor.
    """
    *now, resistance = (np.array([[value]]) for value in state)
    couplings = Couplings(of, resistance, np.array([[stiffness]]), np.array([[friction]]))
    torque, _ = couplings.couple(np.stack(now))
    own_speed, moving = np.empty((1, 1)), np.empty((1, 1))
    couplings.follow(np.zeros((1, 1)), own_speed)
    couplings.follow(np.ones((1, 1)), moving)
    parts = torque, couplings.inertia, own_speed, moving - own_speed
    return [float(part[0, 0]) for part in parts]
