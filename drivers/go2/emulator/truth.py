"""The hidden truth of an emulated Go2; for the emulator and for benches, never for a calibrator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

from deal_hw.drivers.go2.descriptions.floor import (
    DAMPING_NMS_RAD,
    DESCRIPTION,
    EFFORT_LIMIT_NM,
    FLOOR_FRICTION,
    FRICTIONLOSS_NM,
    JOINTS,
    LEGS,
    STIFFNESS_NM_RAD,
    TRUNK_KG,
    VELOCITY_LIMIT_RAD_S,
    per_joint,
)
from deal_hw.drivers.go2.descriptions.on_stand_recording import DESCRIPTION as RECORDED
from deal_hw.drivers.unitree.emulated_profile import REALISTIC, SENSOR
from deal_hw.drivers.unitree.emulated_quadruped import (
    BatteryFacts,
    EmulatedQuadruped,
    QuadrupedProfile,
    QuadrupedTruth,
    SportGains,
)
from deal_hw.drivers.unitree.motor_command import MODE_SERVO

JOINT_DAMPING_NMS_RAD: Final = 0.6
ARMATURE_KGM2: Final = 0.01
HANGING: Final = (0.0, 0.34, -0.85) * len(LEGS)
"""Pose of limp legs in the air, without the hips: the calf's weight opens the knee to its stop."""

_FLOOR: Final = (FLOOR_FRICTION, FLOOR_FRICTION)
PROFILES: Final = {
    "ideal": QuadrupedProfile(name="ideal", floor_friction=_FLOOR),
    "sensor": QuadrupedProfile(name="sensor", floor_friction=_FLOOR, **SENSOR),
    "realistic": QuadrupedProfile(
        name="realistic", payload_kg=(0.0, 2.0), floor_friction=(0.5, 1.1), **REALISTIC
    ),
}
"""Differences from ideal mechanics and sensors, in three steps of realism. We know of no published figures of
a real Go2's sensors: these are assumptions."""

GO2: Final = EmulatedQuadruped(
    robot="go2",
    kind="Go2",
    stream=0x602,
    joints=JOINTS,
    floor_mjcf=DESCRIPTION.mjcf,
    stand_mjcf=RECORDED.mjcf,
    effort_limit=per_joint(EFFORT_LIMIT_NM),
    no_load=per_joint(VELOCITY_LIMIT_RAD_S),
    servo_modes=(MODE_SERVO,),
    heat_k_nm2=0.25,
    hanging=HANGING,
    standing_m=0.34,
    lying_m=0.13,
    # Gains of unitree_sdk2_python's go2_stand_example.
    sport=SportGains(stiffness=60.0, damping=5.0, released=3.0),
    battery=BatteryFacts(cells=8, capacity_ah=15.0, idle_a=1.2, loss_w_nm2=0.3, resistance_ohm=0.05),
    trunk_kg=TRUNK_KG,
    gains=(STIFFNESS_NM_RAD, DAMPING_NMS_RAD),
    stand_gains=(RECORDED.stiffness[0], RECORDED.damping[0]),
    joint_damping=(JOINT_DAMPING_NMS_RAD,) * len(JOINTS),
    frictionloss=(FRICTIONLOSS_NM,) * len(JOINTS),
    armature=(ARMATURE_KGM2,) * len(JOINTS),
    floor_friction=FLOOR_FRICTION,
    profiles=PROFILES,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Go2Truth(QuadrupedTruth):
    """Hidden parameters of a Go2."""

    machine: ClassVar[EmulatedQuadruped] = GO2


nominal_truth: Final = Go2Truth.nominal
draw_truth: Final = Go2Truth.draw
