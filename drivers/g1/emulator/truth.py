"""The hidden truth of an emulated G1; for the emulator and for benches, never for a calibrator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

from deal_hw.drivers.g1.description import (
    ARMATURE_KGM2,
    DESCRIPTION,
    DESCRIPTION_23,
    FRICTIONLOSS_NM,
    JOINT_DAMPING_NMS_RAD,
)
from deal_hw.drivers.unitree.emulated_humanoid import EmulatedHumanoid, HumanoidTruth

G1: Final = EmulatedHumanoid(
    kind="G1",
    stream=0x61,
    descriptions={one.name: one for one in (DESCRIPTION, DESCRIPTION_23)},
    frictionloss=FRICTIONLOSS_NM,
    joint_damping=JOINT_DAMPING_NMS_RAD,
    armature=ARMATURE_KGM2,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class G1Truth(HumanoidTruth):
    """Hidden parameters of a G1 with 29 or 23 joints."""

    machine: ClassVar[EmulatedHumanoid] = G1


nominal_truth: Final = G1Truth.nominal
draw_truth: Final = G1Truth.draw
