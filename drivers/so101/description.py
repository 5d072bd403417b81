"""Facts about the SO-101 arm: six Feetech STS3215 servos in position mode, proportional control only.

Joint names are those of mujoco_menagerie and LeRobot.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from deal_hw.description import RobotDescription, SafetyLimits, SensorModel
from deal_hw.parameters import Parameter, ParameterSpace

JOINTS: Final = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
WEIGHTED: Final = ("shoulder_lift", "elbow_flex", "wrist_flex")
"""The joints that carry weight."""
RANGE_RAD: Final = (
    (-1.91986, 1.91986),
    (-1.7453293, 1.7453293),
    (-1.69, 1.69),
    (-1.658063, 1.658063),
    (-2.7438473, 2.7438473),
    (-0.174533, 2.1633),
)
TICK_RAD: Final = 2 * math.pi / 4096
STIFFNESS_NM_RAD: Final = 11.0
JOINT_DAMPING_NMS_RAD: Final = 0.6
FRICTIONLOSS_NM: Final = 0.052
ARMATURE_KGM2: Final = 0.028
EFFORT_LIMIT_NM: Final = 2.94
ENCODER_BIAS_RAD: Final = 0.15
EMULATED_BIAS_RAD: Final = 0.05
"""Largest error of an emulated arm's calibrated middle (assumed): 3 degrees, 33 ticks."""

DESCRIPTION: Final = RobotDescription(
    name="so101",
    joint_names=JOINTS,
    actuated=JOINTS,
    position_units=("rad",) * 6,
    default_position=(0.0,) * 6,
    stiffness=(STIFFNESS_NM_RAD,) * 6,
    damping=(0.0,) * 6,
    effort_limit=(EFFORT_LIMIT_NM,) * 6,
    speed_limit=(math.inf,) * 6,
    control_rate_hz=50.0,
    device_rate_hz=500.0,
    state_rate_hz=50.0,
    limits=SafetyLimits(
        target=tuple((low + 0.05, high - 0.05) for low, high in RANGE_RAD),
        target_step=(0.3,) * 6,
        target_distance=(0.6,) * 6,
        trip_position=tuple((low - 0.1, high + 0.1) for low, high in RANGE_RAD),
        trip_velocity=(8.0,) * 6,
        stiffness=(1000.0,) * 6,
        damping=(10.0,) * 6,
        effort=(EFFORT_LIMIT_NM,) * 6,
        speed=(math.inf,) * 6,
        state_age_s=0.1,
        action_age_s=0.04,
        ease_in_s=1.0,
        # It closes on objects with its whole torque.
        may_be_blocked=("gripper",),
    ),
    sensor=SensorModel(noise=(0.5e-3,) * 6, resolution=(TICK_RAD,) * 6, velocity_window_s=0.04),
    mjcf=Path(__file__).parent / "assets" / "so101.xml",
    sources={
        "joint_names": "mujoco_menagerie robotstudio_so101/so101.xml @ 191a7ba; LeRobot uses the same",
        "default_position": "middle of each calibrated travel",
        "stiffness": "static sag of a real arm at P = 16; the published 998 N·m/rad is 90 times as much",
        "damping": "the servo takes no D gain; its back-EMF is joint damping in the model",
        "effort_limit": "forcerange of the same so101.xml: the servo's stall torque",
        "speed_limit": "the servo follows the set-point as it comes",
        "control_rate_hz": "nearest whole rate to the public recordings' 49.8 Hz",
        "device_rate_hz": "assumed; the servo's loop rate is not published",
        "state_rate_hz": "nearest whole rate to the public recordings' 49.8 Hz",
        "limits": "joint ranges of the same so101.xml; the gripper's from 1524 recorded ticks",
        "sensor": "12-bit encoder, a tick is 1.5 mrad; speeds are differenced: the servo's own are coarse",
        "mjcf": "own model of lines; kinematics and inertials from the same so101.xml",
    },
)

TARGET_RAD_S: Final = 3.6
"""Largest speed of targets: 0.7 of the 5.2 rad/s (3400 ticks/s) that an STS3215 turns at 7.4 V."""
TRIP_RAD_S: Final = 8.0
"""A loaded joint that falls is faster than its motor drives it."""
DRIVEN: Final = dataclasses.replace(
    DESCRIPTION,
    state_rate_hz=100.0,
    limits=dataclasses.replace(
        DESCRIPTION.limits,
        target_step=(TARGET_RAD_S / DESCRIPTION.control_rate_hz,) * 6,
        trip_velocity=(TRIP_RAD_S,) * 6,
        stiffness=(2 * STIFFNESS_NM_RAD,) * 6,
        damping=(0.0,) * 6,
    ),
    sources={
        **DESCRIPTION.sources,
        "state_rate_hz": "own choice: a sample of six servos and a command take 2 ms of the bus",
        "limits": "as there; targets slower than the servo turns; twice the gain is the factory's P of 32",
    },
)
"""The arm on its own wire, as deal-hw drives and records it."""


def _rows() -> list[Parameter]:
    rows = (
        ("stiffness", "servo_stiffness", "N·m/rad", STIFFNESS_NM_RAD),
        ("damping", "dof_damping", "N·m·s/rad", JOINT_DAMPING_NMS_RAD),
        ("frictionloss", "dof_frictionloss", "N·m", FRICTIONLOSS_NM),
        ("armature", "dof_armature", "kg·m²", ARMATURE_KGM2),
    )
    return [
        Parameter.around(f"{joint}.{name}", kind, (joint,), unit, value)
        for name, kind, unit, value in rows
        for joint in JOINTS
    ]


def parameter_space() -> ParameterSpace:
    """Return 27 parameters: servo stiffness, damping, frictionloss, armature, and the bias of three joints.

    Frictionloss, damping and armature start from the published model, whose authors call them guesses.
    Gravity has no effect at shoulder_pan and wrist_roll. There the recordings determine only the ratios of
    these and the stiffness well; the links' own inertia adds little. The bias is the calibrated zero (middle
    of the travel) minus the model's. It shows only where a joint carries weight.
    """
    return ParameterSpace([*_rows(), *_biases(WEIGHTED, ENCODER_BIAS_RAD)])


def unbiased_space() -> ParameterSpace:
    """Return the 24 parameters without the encoder biases."""
    return ParameterSpace(_rows())


def laws_space() -> ParameterSpace:
    """Return the 24 parameters without biases, and laws of friction by speed and by load, 42 in all."""
    return unbiased_space().with_friction_laws([(joint, (joint,)) for joint in JOINTS], FRICTIONLOSS_NM)


def biased_space() -> ParameterSpace:
    """Return 30 parameters, with the encoder bias of each joint, also where no recording shows it."""
    return ParameterSpace([*_rows(), *_biases(JOINTS, ENCODER_BIAS_RAD)])


def emulated_space() -> ParameterSpace:
    """Return the parameters of an emulated arm: those of the set "biased", with smaller biases."""
    return ParameterSpace([*_rows(), *_biases(JOINTS, EMULATED_BIAS_RAD)])


def _biases(joints: Iterable[str], most: float) -> list[Parameter]:
    return [Parameter.encoder_bias(joint, most) for joint in joints]


SPACES: Final = {
    "default": parameter_space,
    "unbiased": unbiased_space,
    "biased": biased_space,
    "laws": laws_space,
}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
