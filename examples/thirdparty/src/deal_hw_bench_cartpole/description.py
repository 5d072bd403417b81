"""Facts about the robot, each with its source, and the parameters that a calibration may search."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from deal_hw.description import RobotDescription, SafetyLimits, SensorModel
from deal_hw.parameters import Parameter, ParameterSpace

TRACK_M: Final = 0.198
"""From the centre to either end."""
COUNTS_M: Final = 4164 / 0.396
"""Counts of the cart's encoder a metre."""
COUNTS_RAD: Final = 4271.34 / (2 * math.pi)
"""Counts of the pole's potentiometer a radian."""
CART_KG: Final = 0.230
POLE_KG: Final = 0.087
POLE_M: Final = 0.395
CART_FRICTION_NS_M: Final = 3.22
POLE_FRICTION_NMS: Final = 5e-5
FORCE_N: Final = 1.77

DESCRIPTION: Final = RobotDescription(
    name="bench_cartpole",
    joint_names=("cart", "pole"),
    actuated=("cart",),
    position_units=("m", "rad"),
    default_position=(0.0, math.pi),
    stiffness=(0.0,),
    damping=(0.0,),
    effort_limit=(FORCE_N,),
    speed_limit=(math.inf,),
    control_rate_hz=50.0,
    device_rate_hz=1000.0,
    state_rate_hz=50.0,
    limits=SafetyLimits(
        target=((-1.0, 1.0),),
        target_step=(2.0,),
        target_distance=(math.inf,),
        trip_position=((-0.19, 0.19), (-math.inf, math.inf)),
        trip_velocity=(2.0, 60.0),
        stiffness=(0.0,),
        damping=(0.0,),
        effort=(FORCE_N,),
        speed=(math.inf,),
        state_age_s=0.1,
        action_age_s=0.1,
        ease_in_s=0.0,
    ),
    sensor=SensorModel(noise=(1e-5, 1e-3), resolution=(1 / COUNTS_M, 1 / COUNTS_RAD), velocity_window_s=0.02),
    mjcf=Path(__file__).parent / "assets" / "bench_cartpole.xml",
    actuation="motor",
    sources={
        "joint_names": "slide along the track, hinge at the cart; angle 0 is upright",
        "default_position": "middle of the track, pole hanging: so it is after calibrating",
        "effort_limit": "CartPoleSimulation (MIT), cartpole_physical_parameters.yml: u_max",
        "control_rate_hz": "physical-cartpole, globals.py: 20 ms for a controller on the PC",
        "device_rate_hz": "the physics step of the model; the motor is held for a control period",
        "state_rate_hz": "the firmware sends one state a control period",
        "limits": "8 mm before the ends of the track; the motor's own terminal speed is 0.6 m/s",
        "sensor": "one count of each encoder; noise assumed; velocities are differences",
        "mjcf": "own model of primitives; masses, length and friction of CartPoleSimulation (MIT)",
    },
)


def parameter_space() -> ParameterSpace:
    """Return the masses and frictions; weigh the pole and measure its length.

    The force of the motor is known from its data sheet. Without one known force or mass only their ratios
    show in a recording.
    """
    space = ParameterSpace(
        [
            Parameter.around("pole.mass", "body_mass", ("pole",), "kg", POLE_KG),
            Parameter.around("cart.mass", "body_mass", ("cart",), "kg", CART_KG),
            Parameter.around("cart.damping", "dof_damping", ("cart",), "N·s/m", CART_FRICTION_NS_M),
        ]
    )
    return space.with_known({"pole.mass": POLE_KG})


SPACES: Final = {"default": parameter_space}
