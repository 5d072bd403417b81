"""Facts about the Unitree B2 on the floor and with its base on a stand: 12 joints under PD control.

It has the Go2's joints, messages and motor numbers, and other limits, masses and gains. Joint order here, in
the model and in every array: FL, FR, RL, RR, each hip, thigh, calf.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from deal_hw.description import LegLimits, RobotDescription, SafetyLimits, SensorModel
from deal_hw.drivers.go2.descriptions.floor import JOINTS, LEGS, PARTS, by_part, per_joint
from deal_hw.drivers.unitree.leg_geometry import LegGeometry
from deal_hw.drivers.unitree.spaces import each, gain_space, joint_space, walk_space
from deal_hw.drivers.unitree.supply import Supply
from deal_hw.drivers.unitree.support import SupportConfig
from deal_hw.parameters import ParameterSpace

SERVO_MODE: Final = 0x0A
"""Mode of a motor that follows commands, as in the vendor's C++ example; its Python example sends 0x01."""
RANGE_RAD: Final[Mapping[str, tuple[float, float]]] = {
    "hip": (-0.87, 0.87),
    "thigh": (-0.94, 4.69),
    "calf": (-2.82, -0.43),
}
EFFORT_LIMIT_NM: Final = {"hip": 200.0, "thigh": 200.0, "calf": 300.0}
VELOCITY_LIMIT_RAD_S: Final = {"hip": 23.0, "thigh": 23.0, "calf": 14.0}
FLAIL_RAD_S: Final = {"hip": 15.3, "thigh": 15.3, "calf": 9.3}
STANDING_RAD: Final = {"hip": 0.0, "thigh": 0.8, "calf": -1.5}
RESTING_RAD: Final = {"hip": 0.0, "thigh": 1.36, "calf": -2.65}
REACH_RAD: Final = {"hip": 0.2, "thigh": 0.4, "calf": 0.5}
"""Largest distance of excitations from the standing pose on a stand."""
STIFFNESS_NM_RAD, DAMPING_NMS_RAD = 500.0, 10.0
STAND_STIFFNESS_NM_RAD, STAND_DAMPING_NMS_RAD = 160.0, 5.0
HIGHEST_STIFFNESS_NM_RAD: Final = 1000.0
HIGHEST_DAMPING_NMS_RAD: Final = 10.0
JOINT_DAMPING_NMS_RAD: Final = 1.0
FRICTIONLOSS_NM: Final = 1.5
ARMATURE_KGM2: Final = 0.1
ENCODER_BIAS_RAD: Final = 0.1
FLOOR_FRICTION: Final = 0.8
TRUNK_KG: Final = 41.4371
WIRE_HZ, CONTROL_HZ, MOTOR_HZ = 500.0, 50.0, 1000.0
TRIP_MARGIN_RAD: Final = 0.15
HELD_TILT_RAD: Final = 0.35
"""Largest tilt of a body on a stand [rad]."""

GEOMETRY: Final = LegGeometry(
    link_m=0.35, side_m=0.11973, foot_m=0.032, hip_m=(0.3285, 0.072), weight_n=732.0
)
"""Legs as in ``assets/b2.xml``; the weight is that of its 74.6 kg."""
SUPPORT: Final = SupportConfig(legs=GEOMETRY, level_rad=HELD_TILT_RAD, held_reach_m=0.26, lying_reach_m=0.205)
"""The Go2's limits between floor and stand, times 1.64, the ratio of the legs. Feet of a robot that lies in
the vendor's rest pose reach 0.17 m."""
SUPPLY: Final = Supply(
    kind="B2",
    lowest=40.0,
    highest=60.0,
    other="it may be a Go2, which has the same messages; take robot `go2` if it is one",
)
"""14 cells, 58.8 V when charged; a Go2 has at most 33.6 V."""

LEG_LIMITS: Final = LegLimits(
    effort=(200.0,) * len(JOINTS),
    tilt=0.8,
    tumble=6.0,
    free_fall=2.0,
    free_fall_s=0.15,
    flail_velocity=per_joint(FLAIL_RAD_S),
    flail_s=0.1,
    temperature=85.0,
    lost_rate=20.0,
    battery=0.2,
    battery_low=0.1,
    voltage=43.4,
    arm_voltage=49.0,
    command_age_s=0.05,
)


def joint_ranges() -> tuple[tuple[float, float], ...]:
    """Return the mechanical range of each of the 12 joints [rad]."""
    return tuple(RANGE_RAD[part] for _ in LEGS for part in PARTS)


def _limits(legs: LegLimits) -> SafetyLimits:
    margin, count = 0.05, len(JOINTS)
    ranges = joint_ranges()
    return SafetyLimits(
        target=tuple((low + margin, high - margin) for low, high in ranges),
        target_step=(0.46,) * count,
        target_distance=(0.4,) * count,
        trip_position=tuple((low - TRIP_MARGIN_RAD, high + TRIP_MARGIN_RAD) for low, high in ranges),
        trip_velocity=per_joint(VELOCITY_LIMIT_RAD_S),
        stiffness=(HIGHEST_STIFFNESS_NM_RAD,) * count,
        damping=(HIGHEST_DAMPING_NMS_RAD,) * count,
        effort=per_joint(EFFORT_LIMIT_NM),
        speed=(math.inf,) * count,
        state_age_s=0.04,
        action_age_s=0.04,
        ease_in_s=1.0,
        silence_s=0.2,
        legs=legs,
    )


SOURCES: Final[Mapping[str, str]] = {
    "joint_names": "unitree_ros @ d6f13aa, b2_description.urdf; model order",
    "default_position": "rl_sar @ 0c40ba5, policy/b2/base.yaml: hip 0, thigh 0.8, calf -1.5",
    "stiffness": (
        "own: half of the 1000 of the vendor's stand example. With 300, the most that deployed policies use "
        "(unitree_rl_lab 160, rl_sar 200 to 300), 4 of 6 emulated robots that only stand fall over"
    ),
    "damping": "kd of the vendor's stand example; deployed policies use 3 to 5",
    "effort_limit": (
        "ctrlrange of unitree_mujoco @ c598f10, b2.xml: 200 N·m hip and thigh, 300 N·m calf; the URDF has 320"
    ),
    "speed_limit": "the motors follow the set-point as it comes: there is no set-point generator",
    "control_rate_hz": "as the Go2's: targets at 50 Hz",
    "device_rate_hz": "low-level commands and states come at 500 Hz",
    "state_rate_hz": "assumed: rt/lowstate at 500 Hz as a Go2's; the vendor's example writes every 2 ms",
    "repeat_rate_hz": "unitree_sdk2 @ 21d0a3b, b2_stand_example.cpp: a command every 2 ms",
    "passive_damping": (
        "10, the highest kd that the vendor's examples send to a B2; what its own damping state sends is not "
        "published"
    ),
    "rest_position": "unitree_sdk2 @ 21d0a3b, b2_stand_example.cpp: hip 0, thigh 1.36, calf -2.65",
    "limits": (
        "ranges and speeds (23, 14 rad/s) of the same URDF; measured positions may be 0.15 rad outside, as "
        "on a Go2; highest gains are those of the vendor's stand example"
    ),
    "target_step": "motion of a hip or thigh at its top speed, 23 rad/s, in a control period of 20 ms",
    "silence_s": "assumed: ten control periods; the robot holds its last target meanwhile",
    "sensor": "assumed: 1 mrad joint noise, 15-bit joint encoder",
    "mjcf": "own model of primitives; kinematics and inertials of the same URDF (BSD-3-Clause), 74.6 kg",
    "legs.effort": "the hips' and thighs' limit for every joint; the calves could give 300 N·m",
    "legs.tilt": "as the Go2's: 0.8 rad of roll or pitch",
    "legs.tumble": "unitree_rl_lab @ e72a072, protections of the G1: 6 rad/s",
    "legs.free_fall": "assumed: a fifth of gravity, as the Go2's",
    "legs.free_fall_s": "a fall of 0.11 m takes 0.15 s",
    "legs.flail_velocity": "two thirds of the motors' speed",
    "legs.flail_s": "assumed: as the Go2's",
    "legs.temperature": "assumed: 85 °C, as unitree_rl_lab's protections of the G1",
    "legs.lost_rate": "assumed: 4 % of the commands at 500 Hz",
    "legs.battery": "assumed: as the Go2's",
    "legs.battery_low": "assumed: half of that",
    "legs.voltage": "14 cells at 3.1 V, under load; a data sheet of the B2 has 50.4 V, 58.8 V when charged",
    "legs.arm_voltage": "14 cells at 3.5 V, as the Go2's data sheet has for its 8",
    "legs.command_age_s": "assumed: 25 repeats that were not sent",
}

DESCRIPTION: Final = RobotDescription(
    name="b2",
    joint_names=JOINTS,
    actuated=JOINTS,
    position_units=("rad",) * len(JOINTS),
    default_position=per_joint(STANDING_RAD),
    stiffness=(STIFFNESS_NM_RAD,) * len(JOINTS),
    damping=(DAMPING_NMS_RAD,) * len(JOINTS),
    effort_limit=per_joint(EFFORT_LIMIT_NM),
    speed_limit=(math.inf,) * len(JOINTS),
    control_rate_hz=CONTROL_HZ,
    device_rate_hz=WIRE_HZ,
    state_rate_hz=WIRE_HZ,
    repeat_rate_hz=WIRE_HZ,
    limits=_limits(LEG_LIMITS),
    sensor=SensorModel(
        noise=(1e-3,) * len(JOINTS),
        resolution=(2 * math.pi / 32768,) * len(JOINTS),
        velocity_window_s=0.0,
    ),
    mjcf=Path(__file__).parent / "assets" / "b2.xml",
    floating_base="base",
    passive_damping=(HIGHEST_DAMPING_NMS_RAD,) * len(JOINTS),
    rest_position=per_joint(RESTING_RAD),
    feet=tuple(f"{leg}_foot" for leg in LEGS),
    sources=SOURCES,
)
ON_STAND: Final = dataclasses.replace(
    DESCRIPTION,
    name="b2_on_stand",
    stiffness=(STAND_STIFFNESS_NM_RAD,) * len(JOINTS),
    damping=(STAND_DAMPING_NMS_RAD,) * len(JOINTS),
    device_rate_hz=MOTOR_HZ,
    limits=_limits(dataclasses.replace(LEG_LIMITS, tilt=HELD_TILT_RAD, free_fall=0.0)),
    mjcf=Path(__file__).parent / "assets" / "b2_on_stand.xml",
    floating_base=None,
    excitation_range=tuple(
        (middle - way, middle + way)
        for middle, way in zip(per_joint(STANDING_RAD), per_joint(REACH_RAD), strict=True)
    ),
    sources={
        **SOURCES,
        "stiffness": "unitree_rl_lab @ e72a072, UNITREE_B2_CFG: 160",
        "damping": "the same: 5",
        "device_rate_hz": "1 kHz as the emulator's motors; the rate of the robot's own is not published",
        "excitation_range": "4000 corners and draws inside it: least distance of two legs' shapes 5 cm",
        "legs.tilt": "assumed: the model's base is level; at 0.35 rad a third of a leg's weight pulls aside",
        "legs.free_fall": "no limit: the base is held",
    },
)


def parameter_space() -> ParameterSpace:
    """Return 24 parameters of the robot on the floor: stiffness and damping of each joint's motor."""
    return gain_space(JOINTS, STIFFNESS_NM_RAD, DAMPING_NMS_RAD)


def walking_space() -> ParameterSpace:
    """Return the parameters for a walk: 24 gains, the trunk and its load, friction of joints and floor."""
    return walk_space(
        parameter_space(),
        by_part(),
        trunk_kg=TRUNK_KG,
        floor_friction=FLOOR_FRICTION,
        frictionloss=FRICTIONLOSS_NM,
    )


def _stand_space(bias: tuple[str, ...] = ()) -> ParameterSpace:
    count = len(JOINTS)
    return joint_space(
        each(JOINTS),
        stiffness=(STAND_STIFFNESS_NM_RAD,) * count,
        damping=(STAND_DAMPING_NMS_RAD + JOINT_DAMPING_NMS_RAD,) * count,
        frictionloss=(FRICTIONLOSS_NM,) * count,
        armature=(ARMATURE_KGM2,) * count,
        bias=bias,
        bias_rad=ENCODER_BIAS_RAD,
    )


def stand_space() -> ParameterSpace:
    """Return 48 parameters on a stand: stiffness, damping, frictionloss and armature of each joint.

    Damping is that at the joint for kd = 5: the sum of the motor's and of the joint's viscous friction.
    """
    return _stand_space()


def biased_stand_space() -> ParameterSpace:
    """Return the 48 parameters and an encoder bias of each joint, 60 in all."""
    return _stand_space(JOINTS)


SPACES: Final = {"default": parameter_space, "walk": walking_space}
STAND_SPACES: Final = {"default": stand_space, "biased": biased_stand_space}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
