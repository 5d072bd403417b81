"""Facts about the cart-pole: a 0.8 m rail, a 0.3 m pole, a PD position loop at 1 kHz in the device.

The numbers of the mechanics are a plausible bench build, not a measured one: the paper's Table 8 prints the
sizes (0.3 m, 0.1 kg, 0.3 kg) beside frictions and gains that no such cart could have (a pole friction of 0.1
N·m is two thirds of the pole's whole gravity torque), so those were replaced; each source notes it.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

from deal_hw.description import RobotDescription, SafetyLimits, SensorModel
from deal_hw.parameters import Parameter, ParameterSpace

POLE_LENGTH_M = 0.3
POLE_MASS_KG = 0.1
CART_MASS_KG = 0.3
POLE_FRICTIONLOSS_NM = 0.002
POLE_DAMPING_NMS = 0.002
POLE_ARMATURE_KGM2 = 0.001
CART_FRICTIONLOSS_N = 0.3
STIFFNESS_N_M = 80.0
DAMPING_NS_M = 8.0
EFFORT_LIMIT_N = 4.0
SPEED_LIMIT_M_S = 1.0

DESCRIPTION = RobotDescription(
    name="cartpole",
    joint_names=("cart", "pole"),
    actuated=("cart",),
    position_units=("m", "rad"),
    default_position=(0.0, 0.0),
    stiffness=(STIFFNESS_N_M,),
    damping=(DAMPING_NS_M,),
    effort_limit=(EFFORT_LIMIT_N,),
    speed_limit=(SPEED_LIMIT_M_S,),
    control_rate_hz=50.0,
    device_rate_hz=1000.0,
    state_rate_hz=200.0,
    limits=SafetyLimits(
        target=((-0.25, 0.25),),
        target_step=(0.5,),
        target_distance=(0.6,),
        trip_position=((-0.38, 0.38), (-math.inf, math.inf)),
        trip_velocity=(6.0, 60.0),
        stiffness=(200.0,),
        damping=(20.0,),
        effort=(8.0,),
        speed=(3.0,),
        state_age_s=0.06,
        action_age_s=0.04,
        ease_in_s=0.0,
    ),
    sensor=SensorModel(noise=(0.3e-3, 2e-3), resolution=(0.5e-3, 2 * math.pi / 4096), velocity_window_s=0.02),
    mjcf=Path(__file__).parent / "assets" / "cartpole.xml",
    sources={
        "joint_names": "slide along the rail, hinge at the cart; angle 0 is upright",
        "default_position": "middle of the rail, pole upright",
        "stiffness": "the cart settles on a set-point within 0.2 s; the paper's 0.1 N/m could not move it",
        "damping": "about 0.7 of critical for cart plus pole at that stiffness",
        "effort_limit": "ten times what 1 m/s^2 of cart and pole takes; the paper's 0.2 N is below friction",
        "speed_limit": "DEAL (Table 8): Cart Vel 1.0 m/s",
        "control_rate_hz": "DEAL, section 4.4: targets at 50 Hz",
        "device_rate_hz": "DEAL, section 4.4: PD loop at 1000 Hz",
        "state_rate_hz": "a 45-byte state frame at 1 Mbaud takes 0.45 ms; 200 Hz leaves the line 91 % idle",
        "limits": "rail of +-0.40 m between the stops; trips 20 mm before them; targets 0.15 m before them",
        "sensor": "0.3 mm / 2 mrad noise, 0.5 mm belt encoder, 12-bit pole encoder, differenced velocity",
        "mjcf": "own model of primitives; lengths and masses from DEAL (Table 8)",
    },
)


def parameter_space() -> ParameterSpace:
    """Return all 11 parameters (K11); search ranges are a factor 5 to either side of the nominal value.

    The four servo parameters are the device's behaviour at the description's default gains and limits; with
    other commanded values they scale in proportion.
    """
    return ParameterSpace(
        [
            Parameter.around("pole.length", "rod_length", ("pole",), "m", POLE_LENGTH_M),
            Parameter.around("pole.mass", "body_mass", ("pole",), "kg", POLE_MASS_KG),
            Parameter.around("cart.mass", "body_mass", ("cart",), "kg", CART_MASS_KG),
            Parameter.around("pole.frictionloss", "dof_frictionloss", ("pole",), "N·m", POLE_FRICTIONLOSS_NM),
            Parameter.around("pole.damping", "dof_damping", ("pole",), "N·m·s/rad", POLE_DAMPING_NMS),
            Parameter.around("pole.armature", "dof_armature", ("pole",), "kg·m²", POLE_ARMATURE_KGM2),
            Parameter.around("cart.frictionloss", "dof_frictionloss", ("cart",), "N", CART_FRICTIONLOSS_N),
            Parameter.around("servo.stiffness", "servo_stiffness", ("cart",), "N/m", STIFFNESS_N_M),
            Parameter.around("servo.damping", "servo_damping", ("cart",), "N·s/m", DAMPING_NS_M),
            Parameter.around("servo.effort_limit", "servo_effort_limit", ("cart",), "N", EFFORT_LIMIT_N),
            Parameter.around("servo.speed_limit", "servo_speed_limit", ("cart",), "m/s", SPEED_LIMIT_M_S),
        ]
    )


def k9_space() -> ParameterSpace:
    """Return K9: pole length and pole mass measured with ruler and scale, the other nine searched.

    Without these two the model is structurally unidentifiable: scaling all masses, frictions, gains and the
    effort limit together leaves every trajectory unchanged.
    """
    return parameter_space().with_known({"pole.length": POLE_LENGTH_M, "pole.mass": POLE_MASS_KG})


def laws_space() -> ParameterSpace:
    """Return K9 and dry friction of the cart that falls with speed, 11 searched.

    The excess at rest is searched up to five times the friction in motion; the speed at which it has fallen
    to 1/e from 2 to 200 mm/s.
    """
    laws = Parameter.friction_at_rest("cart", ("cart",), CART_FRICTIONLOSS_N, speed=0.02, units=("N", "m/s"))
    return ParameterSpace([*k9_space().parameters, *laws])


PAPER = {
    "pole.length": 0.3,
    "pole.mass": 0.1,
    "cart.mass": 0.3,
    "pole.frictionloss": 0.1,
    "pole.damping": 0.1,
    "pole.armature": 0.2,
    "cart.frictionloss": 0.1,
    "servo.stiffness": 0.1,
    "servo.damping": 0.1,
    "servo.effort_limit": 0.2,
    "servo.speed_limit": 1.0,
}
"""DEAL, Table 8."""


def paper_space() -> ParameterSpace:
    """Return all 11 parameters with the values of DEAL's Table 8.

    Most of them are odd for a cart-pole of these sizes: the pole's armature of 0.2 kg·m² is 60 times the
    pole's own inertia about its hinge (0.003 kg·m²); its dry friction of 0.1 N·m is two thirds of its whole
    gravity torque (0.15 N·m); a P gain of 0.1 N/m moves the cart with 0.01 N at an error of 10 cm, a tenth of
    the cart's own friction. The presets k9 and k11 have values of a bench build instead.
    """
    return ParameterSpace(
        dataclasses.replace(p, nominal=PAPER[p.name], low=PAPER[p.name] / 5, high=PAPER[p.name] * 5)
        for p in parameter_space().parameters
    )


SPACES = {"k9": k9_space, "k11": parameter_space, "laws": laws_space, "paper": paper_space}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
