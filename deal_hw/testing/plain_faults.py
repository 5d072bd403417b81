"""Faults of the robots in plain MuJoCo: names, sizes with their sources, and what names each of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

Fault = Literal[
    "friction",
    "load-friction",
    "friction-rise",
    "backlash",
    "motor-play",
    "lag",
    "free-speed",
    "servo-dead-zone",
    "motor-dead-zone",
    "motor-asymmetry",
    "encoder-scale",
    "blind-encoder",
    "zeros",
    "jitter",
    "mass",
    "no-friction",
    "no-rotor",
    "bare",
    "sign",
]
RightModel = Literal["encoders"]
SharedFault = Literal[
    "mirrored", "swapped", "fast-clock", "slow-clock", "degrees", "doubled", "doubled-joint"
]

FAULTS: Mapping[Fault, str] = {
    "friction": "dry friction is four times as high at rest and falls with speed (Stribeck)",
    "load-friction": "dry friction grows by a fifth of the motor's torque",
    "friction-rise": "dry friction is 0 at rest and rises with speed (tanh), as in a harmonic drive",
    "backlash": "a gear with a play of 0.06 rad between servo and joint",
    "motor-play": "a gear with a play of 1 degree in the last joint, behind the motor's encoder of 12 bits",
    "lag": "servos follow their set-points with a first-order lag of 30 ms",
    "free-speed": "the servos' largest torque falls with speed, to 0 at 6.1 rad/s",
    "servo-dead-zone": "servos have no torque up to an error of 0.29 degrees",
    "motor-dead-zone": "motors have no torque for commands up to 5 % of the largest one",
    "motor-asymmetry": "motors do 12 % more to one side, and 12 % less to the other",
    "encoder-scale": "the encoder of the last joint, which has no motor, reports 4.3 % more than its angle",
    "blind-encoder": "the recorded encoder of the last joint is blind in 15 degrees",
    "zeros": "the zeros of the encoders are others in each recording",
    "jitter": "the delay of each command is between none and twice the mean",
    "mass": "the last link weighs 50 % more than in the model",
    "no-friction": "the model has no dry friction, as one made from a URDF",
    "no-rotor": "the model has no inertia of rotors",
    "bare": "the model has no dry friction, no damping and no inertia of rotors",
    "sign": "the last servo turns the other way",
}
"""Faults by name, with their descriptions."""

RIGHT_MODELS: Mapping[RightModel, str] = {
    "encoders": "the model is right; encoders of 12 bits, a PD at 1 kHz, physics steps of 2 ms in the model",
}
"""Robots inside the model's class by name, with their descriptions."""

WITH_ENCODERS = ("encoders", "motor-play")
"""Robots whose only noise is the rounding of their encoders: 1 degree of play would hide in white noise."""

WITH_MOTORS = ("motor-dead-zone", "motor-asymmetry")
"""Robots whose commands are torques: they have motors in place of servos."""

WITH_STEPS = ("free-speed",)
"""Robots whose set-points have steps: a servo that never saturates has its full torque at every speed."""

TURNING = ("free-speed", "friction-rise")
"""Faults of drives that turn: their sizes are in radians."""

WITHOUT: Mapping[str, tuple[str, ...]] = {
    "no-friction": ("frictionloss",),
    "no-rotor": ("armature",),
    "bare": ("frictionloss", "damping", "armature"),
}
"""Attributes of joints that a model has as 0, where that is the fault."""

SHARED: Mapping[SharedFault, tuple[str, ...]] = {
    "mirrored": (
        "the last joint has the other sign",
        "the sign of {last}",
        "{last} deviates from its command against gravity",
    ),
    "swapped": ("the last two joints are swapped", "{before} and {last} were swapped"),
    "fast-clock": ("the clock runs twice as fast", "the clock were 2 times too fast"),
    "slow-clock": ("the clock runs half as fast", "the clock were 2 times too slow"),
    "degrees": (
        "the last joint is in degrees",
        "positions of {last} were in degrees",
        "{last}: positions reach",
    ),
    "doubled": ("all positions are doubled", "{all} were multiplied by 2"),
    "doubled-joint": ("the last joint's positions are doubled", "positions of {last} were multiplied by 2"),
}
"""Faults of recordings that commands and measurements share: description, and the words of the message."""

CAUSES: Mapping[Fault, tuple[str, ...]] = {
    "friction": ("friction",),
    "backlash": ("backlash",),
    "motor-play": ("backlash",),
    "zeros": ("zero",),
    "jitter": ("delay",),
    "mass": ("mass",),
}
"""Causes of the calibration's diagnosis that name the fault."""

LAWS: Mapping[Fault, tuple[str, ...]] = {
    "friction": ("friction that falls with speed",),
    "backlash": ("play in the gears",),
    "motor-play": ("play in the gears",),
    "load-friction": ("friction that grows with the motor's torque", "friction that grows with load"),
    "friction-rise": ("friction that rises with speed",),
    "lag": ("drives that lag",),
    "free-speed": ("effort that falls with speed",),
    "servo-dead-zone": ("servos with a dead zone",),
    "motor-dead-zone": ("motors with a dead zone",),
    "motor-asymmetry": ("motors that do more to one side",),
    "encoder-scale": ("encoders with another scale",),
    "no-friction": ("dry friction that is 0 in the model",),
    "no-rotor": ("a rotor's inertia that is 0 in the model",),
    "bare": ("several quantities that are 0 in the model",),
}
"""The laws that name the fault where the result has one or an alarm names it.

A cause alone does not tell them from others, but for faults with a cause of their own (`CAUSES`). A load
comes from outside and is held by the motor, so its two laws are one fault.
"""

SIGN_WORDS = ("sign", "wrong way", "other way", "against")
"""A refusal or warning with one of these words names a servo that turns the other way."""

STRIBECK_SPEED = 0.15
"""Speed at which the extra dry friction has fallen to 1/e [rad/s or m/s]."""

STRIBECK_EXTRA = 3.0
PLAY = 0.06
MOTOR_PLAY = {"hinge": math.radians(1.0), "slide": 2e-3}
"""Play behind the encoder of the motor [rad or m]."""
COUNTS = {"hinge": 2 * math.pi / 4096, "slide": 1.0 / 4096}
"""A count of an encoder of 12 bits, of a turn or of 1 m [rad or m]."""
CONTROL_S = 0.001
"""Period of the PD that holds its torque, of the robot with encoders [s]."""
FINE_S = 0.00025
"""Physics step of that robot [s]."""
COARSE_S = 0.002
"""Physics step of its model [s]: no divisor of the sampling period, as in many published models."""

LOAD_FRICTION = 0.2
"""Dry friction a motor torque [-]. Identified servos have 0.198 (MX-106), 0.267 (XL330) and 0.311 (MX-64):
model M6 of BAM, commit 1b5a1cee, bam/params."""

RISE = 5.1181 / 2
"""Factor of the speed in the hyperbolic tangent of friction that rises with it [s/rad or s/m]: half of phi_2
of the first joint of a Franka Emika Panda, whose friction is a sigmoid (Gaz et al., "Dynamic Identification
of the Franka Emika Panda Robot", 2019). Its other joints have up to 17.1 / 2."""

LAG_S = 0.03
"""Time constant of a servo's set-point [s]: the shortest smoothing time (lookahead_time of servoj, 0.03 to
0.2 s) of the script manual of Universal Robots."""

SATURATION = 0.18
"""Error of the position at which a servo has its largest torque, and free speed of its motor [rad, rad/s]. An
STS3215 at 7.4 V: 3.25 N·m over 17.8 N·m/rad, and 7.4 V over 1.212 N·m/A (model M1 of BAM, as above)."""
FREE_SPEED = 6.1

STEP_S, STEP = 1.0, 0.4
"""Time between two steps of the set-points, and the largest set-point after one [s, rad]."""

SERVO_DEAD_ZONE = math.radians(0.29)
"""Largest error without torque [rad]: the compliance margin of a Dynamixel AX-12A as it is delivered, one
count of 0.29 degrees (e-manual, control table, addresses 26 and 27)."""

MOTOR_DEAD_ZONE = 0.05
"""The same of a motor's command, of the largest one [-]: a bridge that loses 0.5 V (TB6612FNG, saturation
voltage at 1 A) of a supply of 10 V."""

ASYMMETRY = 0.12
"""Share by which a motor does more to one side [-]: a thruster with 5.25 kgf forward and 4.1 kgf backward
(T200 at 16 V), (5.25 - 4.1) / (5.25 + 4.1)."""

ENCODER_SCALE = 4271 / 4096
"""Reported over true angle [-]: the potentiometer of a public cart-pole has 4271 counts a turn, and its
recordings count 4096."""

BLIND = (0.1, 0.1 + math.radians(15.0))
"""Angles between which an encoder reports the last one before them [rad]. A potentiometer of 345 degrees that
turns over and over is blind in 15."""

MOST_ZERO = 0.1
"""Largest zero [rad or m]: a larger one is seen by eye."""

NOISE = 1e-3
"""Standard deviation of a position sample [rad or m]."""
