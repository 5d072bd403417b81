"""The emulated B2: the Go2's emulator with a B2's numbers, and its hidden truth.

Motors follow commands of mode 0x0A and of mode 0x01, because the vendor's C++ and Python examples for the B2
send one each. Gains of sport mode are those of its stand example. Not published, and assumed: the loss and
warming of the motors (the Go2's at the same share of the torque), the battery's inner resistance, the largest
payload of the profile realistic, friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

from deal_hw.drivers.b2.description import (
    ARMATURE_KGM2,
    DAMPING_NMS_RAD,
    DESCRIPTION,
    EFFORT_LIMIT_NM,
    FLOOR_FRICTION,
    FRICTIONLOSS_NM,
    HIGHEST_DAMPING_NMS_RAD,
    JOINT_DAMPING_NMS_RAD,
    ON_STAND,
    SERVO_MODE,
    STAND_DAMPING_NMS_RAD,
    STAND_STIFFNESS_NM_RAD,
    STIFFNESS_NM_RAD,
    TRUNK_KG,
    VELOCITY_LIMIT_RAD_S,
)
from deal_hw.drivers.go2.descriptions.floor import JOINTS, LEGS, per_joint
from deal_hw.drivers.unitree.emulated_profile import REALISTIC, SENSOR
from deal_hw.drivers.unitree.emulated_quadruped import (
    BatteryFacts,
    EmulatedQuadruped,
    QuadrupedProfile,
    QuadrupedTruth,
    SportGains,
)
from deal_hw.drivers.unitree.motor_command import MODE_SERVO

_FLOOR: Final = (FLOOR_FRICTION, FLOOR_FRICTION)
B2: Final = EmulatedQuadruped(
    robot="b2",
    kind="B2",
    stream=0xB2,
    joints=JOINTS,
    floor_mjcf=DESCRIPTION.mjcf,
    stand_mjcf=ON_STAND.mjcf,
    effort_limit=per_joint(EFFORT_LIMIT_NM),
    no_load=per_joint(VELOCITY_LIMIT_RAD_S),
    servo_modes=(SERVO_MODE, MODE_SERVO),
    heat_k_nm2=0.0035,
    hanging=(0.0, 0.2, -0.43) * len(LEGS),
    standing_m=0.6,
    lying_m=0.16,
    sport=SportGains(stiffness=1000.0, damping=10.0, released=HIGHEST_DAMPING_NMS_RAD),
    battery=BatteryFacts(cells=14, capacity_ah=45.0, idle_a=2.0, loss_w_nm2=0.0042, resistance_ohm=0.03),
    trunk_kg=TRUNK_KG,
    gains=(STIFFNESS_NM_RAD, DAMPING_NMS_RAD),
    stand_gains=(STAND_STIFFNESS_NM_RAD, STAND_DAMPING_NMS_RAD),
    joint_damping=(JOINT_DAMPING_NMS_RAD,) * len(JOINTS),
    frictionloss=(FRICTIONLOSS_NM,) * len(JOINTS),
    armature=(ARMATURE_KGM2,) * len(JOINTS),
    floor_friction=FLOOR_FRICTION,
    profiles={
        "ideal": QuadrupedProfile(name="ideal", floor_friction=_FLOOR),
        "sensor": QuadrupedProfile(name="sensor", floor_friction=_FLOOR, **SENSOR),
        "realistic": QuadrupedProfile(
            name="realistic", payload_kg=(0.0, 10.0), floor_friction=(0.5, 1.1), **REALISTIC
        ),
    },
)


@dataclass(frozen=True, slots=True, kw_only=True)
class B2Truth(QuadrupedTruth):
    """Hidden parameters of a B2."""

    machine: ClassVar[EmulatedQuadruped] = B2
