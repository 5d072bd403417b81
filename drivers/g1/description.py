"""Facts about the Unitree G1 that hangs on a crane: 29 or 23 joints, pelvis held in the air, feet free.

The crane is the only supported set-up. It must hold the pelvis level and still, because the model's pelvis
does not move. On the floor nothing here keeps the robot upright: its passive state is damping, and it falls.
Joint order here, in the model and in every array: the vendor's motor numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from deal_hw.description import LegLimits, RobotDescription, SafetyLimits, SensorModel
from deal_hw.drivers.g1.joints import JOINTS_23, JOINTS_29
from deal_hw.drivers.unitree.humanoid import mirrored_pose, mirrored_ranges, part_of, per_joint
from deal_hw.drivers.unitree.spaces import each, joint_space
from deal_hw.parameters import ParameterSpace

WIRE_HZ: Final = 500.0
RANGE_RAD: Final[Mapping[str, tuple[float, float]]] = {
    "hip_pitch": (-2.5307, 2.8798),
    "hip_roll": (-0.5236, 2.9671),
    "hip_yaw": (-2.7576, 2.7576),
    "knee": (-0.087267, 2.8798),
    "ankle_pitch": (-0.87267, 0.5236),
    "ankle_roll": (-0.2618, 0.2618),
    "waist_yaw": (-2.618, 2.618),
    "waist_roll": (-0.52, 0.52),
    "waist_pitch": (-0.52, 0.52),
    "shoulder_pitch": (-3.0892, 2.6704),
    "shoulder_roll": (-1.5882, 2.2515),
    "shoulder_yaw": (-2.618, 2.618),
    "elbow": (-1.0472, 2.0944),
    "wrist_roll": (-1.97222, 1.97222),
    "wrist_pitch": (-1.61443, 1.61443),
    "wrist_yaw": (-1.61443, 1.61443),
}
"""Mechanical range of each part on the left side; hip_roll and shoulder_roll are mirrored on the right."""
MIRRORED: Final = ("hip_roll", "shoulder_roll")
"""Parts whose range is not symmetric and has the other sign on the right side."""
EFFORT_LIMIT_NM: Final[Mapping[str, float]] = {
    **dict.fromkeys(("hip_pitch", "hip_roll", "hip_yaw", "waist_yaw"), 88.0),
    "knee": 139.0,
    **dict.fromkeys(("ankle_pitch", "ankle_roll", "waist_roll", "waist_pitch"), 50.0),
    **dict.fromkeys(("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll"), 25.0),
    **dict.fromkeys(("wrist_pitch", "wrist_yaw"), 5.0),
}
FULL_EFFORT: Final = ("waist_roll", "waist_pitch", "wrist_pitch", "wrist_yaw")
"""Parts that may use all of it; the others half."""
HUNG_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(RANGE_RAD, 0.0),
    "hip_pitch": -0.1,
    "hip_roll": 0.15,
    "knee": 0.3,
    "ankle_pitch": -0.2,
    "shoulder_roll": 0.35,
    "elbow": -0.2,
}
"""Default pose on the crane, left side: legs and arms a little apart, forearms ahead."""
STIFFNESS_NM_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(RANGE_RAD, 40.0),
    **dict.fromkeys(("hip_pitch", "hip_roll", "hip_yaw"), 60.0),
    "knee": 100.0,
    **dict.fromkeys(("waist_yaw", "waist_roll", "waist_pitch"), 200.0),
    **dict.fromkeys(("wrist_roll", "wrist_pitch", "wrist_yaw"), 20.0),
}
DAMPING_NMS_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(RANGE_RAD, 1.0),
    **dict.fromkeys(("hip_pitch", "hip_roll"), 6.0),
    "hip_yaw": 3.0,
    "knee": 4.0,
    **dict.fromkeys(("waist_yaw", "waist_roll", "waist_pitch"), 8.0),
    **dict.fromkeys(("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"), 2.0),
}
HIGHEST_STIFFNESS_NM_RAD: Final[Mapping[str, float]] = {
    **dict.fromkeys(("hip_pitch", "hip_roll", "hip_yaw"), 100.0),
    "knee": 150.0,
    **dict.fromkeys(("ankle_pitch", "ankle_roll"), 60.0),
    **dict.fromkeys(("waist_yaw", "waist_roll", "waist_pitch"), 300.0),
    **dict.fromkeys(("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"), 100.0),
    **dict.fromkeys(("wrist_roll", "wrist_pitch", "wrist_yaw"), 60.0),
}
REACH_RAD: Final[Mapping[str, float]] = {
    "hip_pitch": 0.3,
    "hip_roll": 0.1,
    "hip_yaw": 0.2,
    "knee": 0.3,
    "ankle_pitch": 0.25,
    "ankle_roll": 0.15,
    "waist_yaw": 0.25,
    "waist_roll": 0.1,
    "waist_pitch": 0.1,
    "shoulder_pitch": 0.25,
    "shoulder_roll": 0.12,
    "shoulder_yaw": 0.2,
    "elbow": 0.25,
    "wrist_roll": 0.4,
    "wrist_pitch": 0.2,
    "wrist_yaw": 0.2,
}
"""Largest distance of excitations from the default pose."""
PASSIVE_DAMPING_NMS_RAD: Final = 3.0
HIGHEST_DAMPING_NMS_RAD: Final = 10.0
JOINT_DAMPING_NMS_RAD: Final = 0.05
FRICTIONLOSS_NM: Final[Mapping[str, float]] = {
    **dict.fromkeys(RANGE_RAD, 0.2),
    **dict.fromkeys(("wrist_pitch", "wrist_yaw"), 0.1),
}
ARMATURE_KGM2: Final = 0.01
ENCODER_BIAS_RAD: Final = 0.1
MOTOR_HZ: Final = 1000.0
TRIP_VELOCITY_RAD_S: Final = 10.0
TRIP_MARGIN_RAD: Final = 0.15
CASING_C: Final = 85.0
WINDING_C: Final = 120.0
"""Highest temperature of a motor's winding; the driver checks it [°C]."""
HUNG_TILT_RAD: Final = 0.35
EASE_IN_S: Final = 3.0


def joint_ranges(joints: Sequence[str]) -> tuple[tuple[float, float], ...]:
    """Return the mechanical range of each joint [rad]."""
    return mirrored_ranges(RANGE_RAD, MIRRORED, joints)


def hung_pose(joints: Sequence[str]) -> tuple[float, ...]:
    """Return the default pose on the crane, (J,) [rad]."""
    return mirrored_pose(HUNG_RAD, MIRRORED, joints)


def _leg_limits(joints: Sequence[str]) -> LegLimits:
    count = len(joints)
    return LegLimits(
        effort=tuple(
            limit * (1.0 if part_of(joint) in FULL_EFFORT else 0.5)
            for joint, limit in zip(joints, per_joint(EFFORT_LIMIT_NM, joints), strict=True)
        ),
        tilt=HUNG_TILT_RAD,
        tumble=6.0,
        free_fall=0.0,
        free_fall_s=0.15,
        flail_velocity=(TRIP_VELOCITY_RAD_S,) * count,
        flail_s=0.1,
        temperature=CASING_C,
        lost_rate=math.inf,
        battery=0.0,
        battery_low=0.0,
        voltage=0.0,
        command_age_s=0.05,
    )


def _limits(joints: Sequence[str]) -> SafetyLimits:
    count, margin = len(joints), 0.05
    ranges = joint_ranges(joints)
    return SafetyLimits(
        target=tuple((low + margin, high - margin) for low, high in ranges),
        target_step=(0.2,) * count,
        target_distance=(0.6,) * count,
        trip_position=tuple((low - TRIP_MARGIN_RAD, high + TRIP_MARGIN_RAD) for low, high in ranges),
        trip_velocity=(TRIP_VELOCITY_RAD_S,) * count,
        stiffness=per_joint(HIGHEST_STIFFNESS_NM_RAD, joints),
        damping=(HIGHEST_DAMPING_NMS_RAD,) * count,
        effort=per_joint(EFFORT_LIMIT_NM, joints),
        speed=(math.inf,) * count,
        state_age_s=0.04,
        action_age_s=0.04,
        ease_in_s=EASE_IN_S,
        silence_s=0.2,
        legs=_leg_limits(joints),
    )


SOURCES: Final[Mapping[str, str]] = {
    "joint_names": "unitree_sdk2_python @ 37116c5, g1_low_level_example.py: motor numbers",
    "default_position": (
        "own: legs as in unitree_rl_gym @ 276801e (-0.1, 0.3, -0.2), hips 0.15 rad and shoulders 0.35 rad "
        "apart and forearms ahead, so that excitations touch nothing"
    ),
    "stiffness": (
        "unitree_sdk2_python @ 37116c5, g1_low_level_example.py, which moves a hung robot; waist 200 as in "
        "unitree_rl_lab @ e72a072 (with the example's 40 the torso falls over by its own weight), wrists 20 "
        "as in unitree_rl_gym @ 276801e"
    ),
    "damping": (
        "own: 0.3 to 0.6 of critical damping for the hung limbs of this model (the example's 1 is 0.06 at "
        "the hips: excitations would swing up); unitree_rl_lab sends up to 10"
    ),
    "effort_limit": "unitree_mujoco @ c598f10, g1_29dof.xml: actuatorfrcrange",
    "speed_limit": "the motors follow the set-point as it comes: there is no set-point generator",
    "control_rate_hz": "unitree_rl_gym and unitree_rl_lab: targets at 50 Hz",
    "device_rate_hz": "1 kHz as the emulator's motors; the rate of the robot's own is not published",
    "state_rate_hz": "rt/lowstate comes at 500 Hz, its tick counts 2 ms",
    "repeat_rate_hz": "g1_low_level_example.py: a command every 2 ms",
    "passive_damping": "unitree_rl_lab @ e72a072, state Passive of the G1: kd 3 (unitree_rl_gym 8)",
    "excitation_range": (
        "4000 draws and corners inside it: least distance of two links of this model's lines 3 cm; their "
        "thicknesses are estimates"
    ),
    "limits": (
        "ranges of the same g1_29dof.xml; highest gains among unitree_rl_gym @ 276801e, unitree_rl_lab @ "
        "e72a072 and the vendor's example (up to 60 at ankles and wrists)"
    ),
    "target_step": "assumed: 10 rad/s, at which unitree_sdk2's protections end a run, in a control period",
    "trip_velocity": "unitree_sdk2 @ 21d0a3b, g1/common/terminations.hpp: 10 rad/s",
    "ease_in_s": "g1_low_level_example.py: 3 s to the first pose",
    "legs.tilt": "assumed: the model's pelvis is level; the vendor's terminations.hpp ends at 1.0 rad",
    "legs.tumble": "unitree_sdk2 @ 21d0a3b, g1/common/terminations.hpp: 6 rad/s",
    "legs.effort": (
        "assumed: half of the motors' limits, as nothing is lifted but the robot's own limbs; all of it at "
        "the waist, which carries the torso, and at the wrists, whose motors are small"
    ),
    "legs.free_fall": "no limit: the pelvis is held",
    "legs.flail_velocity": "as trip_velocity",
    "legs.temperature": "terminations.hpp: 85 °C at the casing; the driver trips at 120 °C of a winding",
    "legs.lost_rate": "no limit: unitree_hg has no counter of lost commands",
    "legs.battery": "no limit: LowState has no battery, which is a message of its own",
    "legs.voltage": "no limit: the states have the motors' voltages, of which no lowest one is published",
    "legs.command_age_s": "assumed: 25 repeats that were not sent",
    "silence_s": "assumed: ten control periods; the robot holds its last target meanwhile",
    "sensor": "assumed: 1 mrad joint noise, 15-bit joint encoder",
    "mjcf": "own model of lines; kinematics and inertials from unitree_mujoco @ c598f10 (BSD-3-Clause)",
}


def _description(name: str, joints: Sequence[str]) -> RobotDescription:
    count = len(joints)
    pose = hung_pose(joints)
    reach = per_joint(REACH_RAD, joints)
    return RobotDescription(
        name=name,
        joint_names=tuple(joints),
        actuated=tuple(joints),
        position_units=("rad",) * count,
        default_position=pose,
        stiffness=per_joint(STIFFNESS_NM_RAD, joints),
        damping=per_joint(DAMPING_NMS_RAD, joints),
        effort_limit=per_joint(EFFORT_LIMIT_NM, joints),
        speed_limit=(math.inf,) * count,
        control_rate_hz=50.0,
        device_rate_hz=MOTOR_HZ,
        state_rate_hz=WIRE_HZ,
        repeat_rate_hz=WIRE_HZ,
        limits=_limits(joints),
        sensor=SensorModel(
            noise=(1e-3,) * count, resolution=(2 * math.pi / 32768,) * count, velocity_window_s=0.0
        ),
        mjcf=Path(__file__).parent / "assets" / f"{name}.xml",
        passive_damping=(PASSIVE_DAMPING_NMS_RAD,) * count,
        excitation_range=tuple((middle - way, middle + way) for middle, way in zip(pose, reach, strict=True)),
        sources=SOURCES,
    )


DESCRIPTION: Final = _description("g1", JOINTS_29)
DESCRIPTION_23: Final = _description("g1_23dof", JOINTS_23)


def _space(joints: Sequence[str], *, bias: bool) -> ParameterSpace:
    return joint_space(
        each(joints),
        stiffness=per_joint(STIFFNESS_NM_RAD, joints),
        damping=[kd + JOINT_DAMPING_NMS_RAD for kd in per_joint(DAMPING_NMS_RAD, joints)],
        frictionloss=per_joint(FRICTIONLOSS_NM, joints),
        armature=(ARMATURE_KGM2,) * len(joints),
        bias=joints if bias else (),
        bias_rad=ENCODER_BIAS_RAD,
    )


def parameter_space() -> ParameterSpace:
    """Return 116 parameters: stiffness, damping, frictionloss and armature of each of the 29 joints.

    Damping is the damping at the joint: the sum of the motor's and of the joint's viscous friction. No
    recording determines the two alone.
    """
    return _space(JOINTS_29, bias=False)


def biased_space() -> ParameterSpace:
    """Return the 116 parameters and an encoder bias of each joint, 145 in all."""
    return _space(JOINTS_29, bias=True)


def parameter_space_23() -> ParameterSpace:
    """Return 92 parameters: stiffness, damping, frictionloss and armature of each of the 23 joints."""
    return _space(JOINTS_23, bias=False)


def biased_space_23() -> ParameterSpace:
    """Return the 92 parameters and an encoder bias of each joint, 115 in all."""
    return _space(JOINTS_23, bias=True)


SPACES: Final = {"default": parameter_space, "biased": biased_space}
SPACES_23: Final = {"default": parameter_space_23, "biased": biased_space_23}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
