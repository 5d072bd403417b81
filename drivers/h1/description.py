"""Facts about the Unitree H1 that hangs on a crane: 19 joints, pelvis held in the air, feet free.

The crane is the only supported set-up. It must hold the pelvis level and still, because the model's pelvis
does not move. On the floor nothing here keeps the robot upright: its passive state is damping, and it falls.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from deal_hw.description import LegLimits, RobotDescription, SafetyLimits, SensorModel
from deal_hw.drivers.h1.joints import JOINTS
from deal_hw.drivers.unitree.humanoid import mirrored_pose, mirrored_ranges, part_of, per_joint
from deal_hw.drivers.unitree.spaces import each, joint_space
from deal_hw.parameters import ParameterSpace

WIRE_HZ, CONTROL_HZ, MOTOR_HZ = 500.0, 50.0, 1000.0
RANGE_RAD: Final[Mapping[str, tuple[float, float]]] = {
    "hip_yaw": (-0.43, 0.43),
    "hip_roll": (-0.43, 0.43),
    "hip_pitch": (-3.14, 2.53),
    "knee": (-0.26, 2.05),
    "ankle": (-0.87, 0.52),
    "torso": (-2.35, 2.35),
    "shoulder_pitch": (-2.87, 2.87),
    "shoulder_roll": (-0.34, 3.11),
    "shoulder_yaw": (-1.3, 4.45),
    "elbow": (-1.25, 2.61),
}
"""Mechanical range of each part on the left side."""
MIRRORED: Final = ("hip_yaw", "hip_roll", "shoulder_roll", "shoulder_yaw")
"""Parts that have the other sign on the right side."""
EFFORT_LIMIT_NM: Final[Mapping[str, float]] = {
    **dict.fromkeys(("hip_yaw", "hip_roll", "hip_pitch", "torso"), 200.0),
    "knee": 300.0,
    **dict.fromkeys(("ankle", "shoulder_pitch", "shoulder_roll"), 40.0),
    **dict.fromkeys(("shoulder_yaw", "elbow"), 18.0),
}
FULL_EFFORT: Final = ("shoulder_yaw", "elbow")
"""Parts that may use all of it; the others half."""
VELOCITY_LIMIT_RAD_S: Final[Mapping[str, float]] = {
    **dict.fromkeys(("hip_yaw", "hip_roll", "hip_pitch", "torso"), 23.0),
    "knee": 14.0,
    **dict.fromkeys(("ankle", "shoulder_pitch", "shoulder_roll"), 9.0),
    **dict.fromkeys(("shoulder_yaw", "elbow"), 20.0),
}
HUNG_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(RANGE_RAD, 0.0),
    "hip_roll": 0.12,
    "hip_pitch": -0.1,
    "knee": 0.3,
    "ankle": -0.2,
    "shoulder_roll": 0.35,
    "elbow": 0.2,
}
"""Default pose on the crane, left side: legs and arms a little apart."""
STRONG: Final = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "torso")
STIFFNESS_NM_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(RANGE_RAD, 60.0),
    **dict.fromkeys(STRONG, 200.0),
}
DAMPING_NMS_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(("hip_roll", "hip_pitch", "torso"), 10.0),
    **dict.fromkeys(("hip_yaw", "knee"), 8.0),
    **dict.fromkeys(("shoulder_pitch", "shoulder_roll"), 5.0),
    **dict.fromkeys(("ankle", "shoulder_yaw", "elbow"), 3.0),
}
HIGHEST_STIFFNESS_NM_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(("hip_yaw", "hip_roll", "hip_pitch", "knee"), 200.0),
    "torso": 300.0,
    "ankle": 60.0,
    **dict.fromkeys(("shoulder_pitch", "shoulder_roll"), 100.0),
    **dict.fromkeys(("shoulder_yaw", "elbow"), 60.0),
}
HIGHEST_DAMPING_NMS_RAD: Final = 10.0
PASSIVE_DAMPING_NMS_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(RANGE_RAD, 1.5),
    **dict.fromkeys(STRONG, 5.0),
}
REACH_RAD: Final[Mapping[str, float]] = {
    "hip_yaw": 0.15,
    "hip_roll": 0.08,
    "hip_pitch": 0.25,
    "knee": 0.3,
    "ankle": 0.25,
    "torso": 0.25,
    "shoulder_pitch": 0.25,
    "shoulder_roll": 0.15,
    "shoulder_yaw": 0.2,
    "elbow": 0.25,
}
"""Largest distance of excitations from the default pose."""
JOINT_DAMPING_NMS_RAD: Final = 1.0
FRICTIONLOSS_NM: Final[Mapping[str, float]] = {**dict.fromkeys(RANGE_RAD, 0.2), **dict.fromkeys(STRONG, 0.5)}
ARMATURE_KGM2: Final = 0.1
ENCODER_BIAS_RAD: Final = 0.1
TRIP_MARGIN_RAD: Final = 0.15
GUARD_RAD_S: Final = 10.0
"""Speed of a joint at which the vendor's protections of a G1 end a run [rad/s]."""
HUNG_TILT_RAD: Final = 0.35
TRIP_VELOCITY_RAD_S: Final = tuple(
    min(GUARD_RAD_S, speed) for speed in per_joint(VELOCITY_LIMIT_RAD_S, JOINTS)
)


def joint_ranges() -> tuple[tuple[float, float], ...]:
    """Return the mechanical range of each of the 19 joints [rad]."""
    return mirrored_ranges(RANGE_RAD, MIRRORED, JOINTS)


def hung_pose() -> tuple[float, ...]:
    """Return the default pose on the crane, (19,) [rad]."""
    return mirrored_pose(HUNG_RAD, MIRRORED, JOINTS)


def _leg_limits() -> LegLimits:
    return LegLimits(
        effort=tuple(
            limit * (1.0 if part_of(joint) in FULL_EFFORT else 0.5)
            for joint, limit in zip(JOINTS, per_joint(EFFORT_LIMIT_NM, JOINTS), strict=True)
        ),
        tilt=HUNG_TILT_RAD,
        tumble=6.0,
        free_fall=0.0,
        free_fall_s=0.15,
        flail_velocity=TRIP_VELOCITY_RAD_S,
        flail_s=0.1,
        temperature=85.0,
        lost_rate=20.0,
        battery=0.0,
        battery_low=0.0,
        voltage=0.0,
        command_age_s=0.05,
    )


def _limits() -> SafetyLimits:
    count, margin = len(JOINTS), 0.05
    ranges = joint_ranges()
    return SafetyLimits(
        target=tuple((low + margin, high - margin) for low, high in ranges),
        target_step=tuple(speed / CONTROL_HZ for speed in TRIP_VELOCITY_RAD_S),
        target_distance=(0.6,) * count,
        trip_position=tuple((low - TRIP_MARGIN_RAD, high + TRIP_MARGIN_RAD) for low, high in ranges),
        trip_velocity=TRIP_VELOCITY_RAD_S,
        stiffness=per_joint(HIGHEST_STIFFNESS_NM_RAD, JOINTS),
        damping=(HIGHEST_DAMPING_NMS_RAD,) * count,
        effort=per_joint(EFFORT_LIMIT_NM, JOINTS),
        speed=(math.inf,) * count,
        state_age_s=0.04,
        action_age_s=0.04,
        ease_in_s=3.0,
        silence_s=0.2,
        legs=_leg_limits(),
    )


SOURCES: Final[Mapping[str, str]] = {
    "joint_names": "unitree_mujoco @ c598f10, h1.xml; model order",
    "default_position": (
        "own: knees a little bent, hips 0.12 rad and shoulders 0.35 rad apart, so that excitations touch "
        "nothing"
    ),
    "stiffness": (
        "unitree_sdk2_python @ 37116c5, h1_low_level_example.py: 200 at hips, knees and torso, 60 at ankles "
        "and arms"
    ),
    "damping": (
        "own: 0.3 to 0.6 of critical damping for the hung limbs of this model (the example's 5 and 1.5 are "
        "0.2 at the hips)"
    ),
    "effort_limit": "unitree_mujoco @ c598f10, h1.xml: ctrlrange",
    "speed_limit": "the motors follow the set-point as it comes: there is no set-point generator",
    "control_rate_hz": "unitree_rl_gym @ 276801e, h1.yaml: targets at 50 Hz",
    "device_rate_hz": "1 kHz as the emulator's motors; the rate of the robot's own is not published",
    "state_rate_hz": "assumed: rt/lowstate at 500 Hz as a Go2's, whose message it is",
    "repeat_rate_hz": "assumed: 500 Hz as for the G1; the vendor's example writes every 10 ms",
    "passive_damping": "kd of the vendor's example: 5 at hips, knees and torso, 1.5 at ankles and arms",
    "excitation_range": (
        "own: least distance of two links of this model's lines 3 cm in draws and corners inside it; their "
        "thicknesses are estimates"
    ),
    "limits": (
        "ranges of the same h1.xml; highest stiffness among unitree_rl_gym @ 276801e and the vendor's "
        "example, highest damping assumed"
    ),
    "target_step": "motion at the speed that trips, in a control period of 20 ms",
    "trip_velocity": (
        "unitree_sdk2 @ 21d0a3b, terminations.hpp of the G1: 10 rad/s; ankles and shoulders 9, the motors' "
        "speed in unitree_ros @ d6f13aa, h1.urdf"
    ),
    "ease_in_s": "assumed: 3 s as for the G1; the vendor's example takes 10 s",
    "silence_s": "assumed: ten control periods; the robot holds its last target meanwhile",
    "sensor": "assumed: 1 mrad joint noise, 15-bit joint encoder",
    "mjcf": (
        "own model of lines; kinematics and inertials from unitree_mujoco @ c598f10 (BSD-3-Clause), 51.6 kg"
    ),
    "legs.tilt": "assumed: the model's pelvis is level",
    "legs.tumble": "terminations.hpp of the G1: 6 rad/s",
    "legs.effort": (
        "assumed: half of the motors' limits, as nothing is lifted but the robot's own limbs; all of it at "
        "the forearms, whose motors are small"
    ),
    "legs.free_fall": "no limit: the pelvis is held",
    "legs.flail_velocity": "as trip_velocity",
    "legs.temperature": "assumed: 85 °C, as unitree_rl_lab's protections of the G1",
    "legs.lost_rate": "assumed: 4 % of the commands at 500 Hz, as the Go2's",
    "legs.battery": "no limit: whether an H1 reports its battery as a Go2 does is not published",
    "legs.voltage": "no limit: the same of its supply",
    "legs.command_age_s": "assumed: 25 repeats that were not sent",
}

DESCRIPTION: Final = RobotDescription(
    name="h1",
    joint_names=JOINTS,
    actuated=JOINTS,
    position_units=("rad",) * len(JOINTS),
    default_position=hung_pose(),
    stiffness=per_joint(STIFFNESS_NM_RAD, JOINTS),
    damping=per_joint(DAMPING_NMS_RAD, JOINTS),
    effort_limit=per_joint(EFFORT_LIMIT_NM, JOINTS),
    speed_limit=(math.inf,) * len(JOINTS),
    control_rate_hz=CONTROL_HZ,
    device_rate_hz=MOTOR_HZ,
    state_rate_hz=WIRE_HZ,
    repeat_rate_hz=WIRE_HZ,
    limits=_limits(),
    sensor=SensorModel(
        noise=(1e-3,) * len(JOINTS),
        resolution=(2 * math.pi / 32768,) * len(JOINTS),
        velocity_window_s=0.0,
    ),
    mjcf=Path(__file__).parent / "assets" / "h1.xml",
    passive_damping=per_joint(PASSIVE_DAMPING_NMS_RAD, JOINTS),
    excitation_range=tuple(
        (middle - way, middle + way)
        for middle, way in zip(hung_pose(), per_joint(REACH_RAD, JOINTS), strict=True)
    ),
    sources=SOURCES,
)


def _space(bias: tuple[str, ...] = ()) -> ParameterSpace:
    return joint_space(
        each(JOINTS),
        stiffness=DESCRIPTION.stiffness,
        damping=[kd + JOINT_DAMPING_NMS_RAD for kd in DESCRIPTION.damping],
        frictionloss=per_joint(FRICTIONLOSS_NM, JOINTS),
        armature=(ARMATURE_KGM2,) * len(JOINTS),
        bias=bias,
        bias_rad=ENCODER_BIAS_RAD,
    )


def parameter_space() -> ParameterSpace:
    """Return 76 parameters: stiffness, damping, frictionloss and armature of each of the 19 joints.

    Damping is the damping at the joint: the sum of the motor's and of the joint's viscous friction.
    """
    return _space()


def biased_space() -> ParameterSpace:
    """Return the 76 parameters and an encoder bias of each joint, 95 in all."""
    return _space(JOINTS)


SPACES: Final = {"default": parameter_space, "biased": biased_space}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
