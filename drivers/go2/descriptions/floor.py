"""Facts about the Unitree Go2 on the floor: 12 joints under PD control, a free base.

Joint order here, in the model and in every array: FL, FR, RL, RR, each hip, thigh, calf. The robot's own wire
order is FR, FL, RR, RL.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from deal_hw.description import RobotDescription, SafetyLimits, SensorModel
from deal_hw.drivers.unitree.spaces import Groups, gain_space
from deal_hw.drivers.unitree.spaces import walk_space as unitree_walk_space
from deal_hw.parameters import ParameterSpace

LEGS: Final = ("FL", "FR", "RL", "RR")
PARTS: Final = ("hip", "thigh", "calf")
JOINTS: Final = tuple(f"{leg}_{part}_joint" for leg in LEGS for part in PARTS)
RANGE_RAD: Final[Mapping[str, tuple[float, float]]] = {
    "front_hip": (-1.0472, 1.0472),
    "front_thigh": (-1.5708, 3.4907),
    "front_calf": (-2.7227, -0.83776),
    "rear_hip": (-1.0472, 1.0472),
    "rear_thigh": (-0.5236, 4.5379),
    "rear_calf": (-2.7227, -0.83776),
}
EFFORT_LIMIT_NM: Final = {"hip": 23.7, "thigh": 23.7, "calf": 45.43}
VELOCITY_LIMIT_RAD_S: Final = {"hip": 30.1, "thigh": 30.1, "calf": 15.7}
STANDING_RAD: Final = {"hip": 0.0, "thigh": 0.9, "calf": -1.8}
STIFFNESS_NM_RAD: Final = 40.0
DAMPING_NMS_RAD: Final = 1.0
PAPER_STIFFNESS_NM_RAD: Final = 0.5
PAPER_DAMPING_NMS_RAD: Final = 20.0
ORIENTATION_NOISE_RAD: Final = 4e-3
GYRO_NOISE_RAD_S: Final = 0.02


def per_joint(table: Mapping[str, float]) -> tuple[float, ...]:
    """Return a value for each of the 12 joints from one for each part of a leg."""
    return tuple(table[part] for _ in LEGS for part in PARTS)


def by_part() -> Groups:
    """Return the hips, the thighs and the calves."""
    return tuple((part, tuple(f"{leg}_{part}_joint" for leg in LEGS)) for part in PARTS)


def joint_ranges() -> tuple[tuple[float, float], ...]:
    """Return the mechanical range of each of the 12 joints [rad]."""
    return tuple(
        RANGE_RAD[f"{'front' if leg.startswith('F') else 'rear'}_{part}"] for leg in LEGS for part in PARTS
    )


def safety_limits() -> SafetyLimits:
    """Return limits for the 12 joints: targets stay 0.05 rad inside the range, half the motors' effort."""
    margin = 0.05
    return SafetyLimits(
        target=tuple((low + margin, high - margin) for low, high in joint_ranges()),
        target_step=(0.5,) * 12,
        target_distance=(0.8,) * 12,
        trip_position=joint_ranges(),
        trip_velocity=per_joint(VELOCITY_LIMIT_RAD_S),
        stiffness=(80.0,) * 12,
        damping=(5.0,) * 12,
        effort=tuple(0.5 * limit for limit in per_joint(EFFORT_LIMIT_NM)),
        speed=(math.inf,) * 12,
        state_age_s=0.04,
        action_age_s=0.04,
        ease_in_s=1.0,
    )


DESCRIPTION: Final = RobotDescription(
    name="go2",
    joint_names=JOINTS,
    actuated=JOINTS,
    position_units=("rad",) * 12,
    default_position=per_joint(STANDING_RAD),
    stiffness=(STIFFNESS_NM_RAD,) * 12,
    damping=(DAMPING_NMS_RAD,) * 12,
    effort_limit=per_joint(EFFORT_LIMIT_NM),
    speed_limit=(math.inf,) * 12,
    control_rate_hz=50.0,
    device_rate_hz=500.0,
    state_rate_hz=50.0,
    limits=safety_limits(),
    sensor=SensorModel(noise=(1e-3,) * 12, resolution=(2 * math.pi / 32768,) * 12, velocity_window_s=0.0),
    mjcf=Path(__file__).parents[1] / "assets" / "go2.xml",
    floating_base="base",
    sources={
        "joint_names": "iit-DLSLab/sim2real-robot-identification, go2.xml @ 06739ea; model order",
        "default_position": "mujoco_menagerie unitree_go2, key frame home: hip 0, thigh 0.9, calf -1.8",
        "stiffness": "upper end of what deployed Go2 policies use (20 to 40); DEAL's Table 9 prints 0.5",
        "damping": "upper end of what deployed Go2 policies use (0.5 to 1); DEAL's Table 9 prints 20",
        "effort_limit": "ctrlrange of the same go2.xml: 23.7 N·m hip and thigh, 45.43 N·m calf",
        "speed_limit": "the motors follow the set-point as it comes: there is no set-point generator",
        "control_rate_hz": "DEAL, section 4.4: targets at 50 Hz",
        "device_rate_hz": "low-level commands and states of the robot come at 500 Hz",
        "state_rate_hz": "one state a control step, as in DEAL's environments; the robot sends 500 Hz",
        "limits": "ranges of the same go2.xml; speeds of unitree_ros go2_description (30.1, 15.7 rad/s)",
        "sensor": "assumed: 1 mrad joint noise, 15-bit joint encoder; IMU noise see the module's constants",
        "mjcf": "own model of primitives; inertials, ranges and collision shapes from the same go2.xml",
    },
)


def parameter_space(stiffness: float = STIFFNESS_NM_RAD, damping: float = DAMPING_NMS_RAD) -> ParameterSpace:
    """Return the 24 parameters of DEAL's Table 9: stiffness and damping of each joint's motor.

    They are the true gains at the description's default gains. The joints' own viscous friction
    (0.6 N·m·s/rad) adds to the motor's damping and stays fixed: motion determines only their sum.
    """
    return gain_space(JOINTS, stiffness, damping)


def paper_space() -> ParameterSpace:
    """Return the same with the values of DEAL's Table 9 as printed: damping 20, stiffness 0.5.

    They look swapped (unitree_rl_gym's go2_config.py has stiffness 20, damping 0.5): with them the robot
    cannot hold itself up. Kept for comparison with the paper only; ``default`` has 40 and 1.
    """
    return parameter_space(PAPER_STIFFNESS_NM_RAD, PAPER_DAMPING_NMS_RAD)


FRICTIONLOSS_NM: Final = 0.2
TRUNK_KG: Final = 6.921
FLOOR_FRICTION: Final = 0.8


def walk_space() -> ParameterSpace:
    """Return the parameters for a walk: the 24 gains, the trunk and its load, friction of joints and floor.

    Dry friction is one number for all hips, one for all thighs and one for all calves.
    """
    return unitree_walk_space(
        parameter_space(),
        by_part(),
        trunk_kg=TRUNK_KG,
        floor_friction=FLOOR_FRICTION,
        frictionloss=FRICTIONLOSS_NM,
    )


def swapped_paper_space() -> ParameterSpace:
    """Return the same with the two columns of Table 9 swapped: stiffness 20, damping 0.5."""
    return parameter_space(PAPER_DAMPING_NMS_RAD, PAPER_STIFFNESS_NM_RAD)


SPACES: Final = {
    "default": parameter_space,
    "walk": walk_space,
    "paper": paper_space,
    "paper-swapped": swapped_paper_space,
}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
