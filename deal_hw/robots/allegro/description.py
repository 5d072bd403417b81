"""Facts about the Allegro hand: 16 servos, palm up, and a cube that lies on it.

The cube moves freely, so it is the floating base of this robot; the hand's joints are not attached to it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.robots.prepared import simulated_limits

FINGERS: Final = ("index", "middle", "ring", "thumb")
NUMBERS: Final = range(4)
JOINTS: Final = tuple(f"{finger}_joint_{i}" for finger in FINGERS for i in NUMBERS)
LINKS: Final = tuple(f"{finger}_link_{i}" for finger in FINGERS for i in NUMBERS)
GEOMS: Final = ("palm", *(g for f in FINGERS for g in (*(f"{f}_link_{i}" for i in NUMBERS), f"{f}_tip")))
RANGE_RAD: Final = (
    *((-0.47, 0.47), (-0.196, 1.61), (-0.174, 1.709), (-0.227, 1.618)) * 3,
    *((0.263, 1.396), (-0.105, 1.163), (-0.189, 1.644), (-0.162, 1.719)),
)
HOLDING_RAD: Final = (*(0.0, 0.3, 0.7, 0.7) * 3, 0.9, 0.5, 0.3, 0.6)
"""Default pose: the fingers are bent enough that the cube stays on the palm."""
PRESS_RAD: Final = 0.3
"""Targets may lie this far beyond a joint's end, where fingers press [rad]."""
EFFORT_LIMIT_NM: Final = 0.7

JOINT_VALUES: Final[Mapping[str, tuple[str, str, float]]] = {
    "frictionloss": ("dof_frictionloss", "N·m", 0.01),
    "damping": ("dof_damping", "N·m·s/rad", 0.1),
    "armature": ("dof_armature", "kg·m²", 0.001),
    "stiffness": ("servo_stiffness", "N·m/rad", 3.0),
}
"""Kind, unit and value of a joint's rows in DEAL's Table 10; stiffness is read as the servo's gain."""
FINGER_MASS_KG: Final = (0.012, 0.065, 0.036, 0.031)
THUMB_MASS_KG: Final = (0.018, 0.012, 0.038, 0.060)
FRICTION: Final = 1.0
RESTITUTION: Final = 0.04
"""Table 10 has 0.01, which cannot be distinguished from 0.002 (see
``deal_hw.robots.ant.description.paper_space``)."""
PAPER_RESTITUTION: Final = 0.01

DESCRIPTION: Final = RobotDescription(
    name="allegro",
    joint_names=JOINTS,
    actuated=JOINTS,
    position_units=("rad",) * 16,
    default_position=HOLDING_RAD,
    stiffness=(JOINT_VALUES["stiffness"][2],) * 16,
    damping=(0.0,) * 16,
    effort_limit=(EFFORT_LIMIT_NM,) * 16,
    speed_limit=(math.inf,) * 16,
    control_rate_hz=50.0,
    device_rate_hz=200.0,
    state_rate_hz=50.0,
    limits=dataclasses.replace(
        simulated_limits((EFFORT_LIMIT_NM,) * 16),
        target=tuple((low - PRESS_RAD, high + PRESS_RAD) for low, high in RANGE_RAD),
        target_step=(0.5,) * 16,
        stiffness=(100.0,) * 16,
        damping=(10.0,) * 16,
    ),
    sensor=SensorModel(noise=(1e-3,) * 16, resolution=(2 * math.pi / 4096,) * 16, velocity_window_s=0.0),
    mjcf=Path(__file__).parent / "assets" / "allegro.xml",
    floating_base="cube",
    sources={
        "joint_names": "order of mujoco_menagerie wonik_allegro/right_hand.xml @ 28ffb48, names as in DEAL",
        "default_position": "ours: the cube stays on the palm",
        "stiffness": "DEAL, Table 10",
        "damping": "DEAL's Table 10 has the damping in the joint",
        "effort_limit": "the maker's data sheet: 0.70 N·m",
        "speed_limit": "the servo follows the set-point as it comes",
        "control_rate_hz": "DEAL, section 4.4: actions at 50 Hz",
        "device_rate_hz": "the physics step of the model",
        "state_rate_hz": "one state a control step, as in DEAL's environments",
        "limits": "a simulated robot: 0.3 rad beyond the joints' ends, and 0.5 rad a control period",
        "sensor": "assumed: 1 mrad noise, 12-bit encoders",
        "mjcf": "collision shapes and kinematics of the same menagerie file, values of DEAL's Table 10",
    },
)


def _mass(link: str) -> float:
    finger, _, number = link.rpartition("_link_")
    return (THUMB_MASS_KG if finger == "thumb" else FINGER_MASS_KG)[int(number)]


def _parameters(
    geoms: Mapping[str, tuple[str, ...]],
    joints: Mapping[str, tuple[str, ...]],
    links: Mapping[str, tuple[str, ...]],
    restitution: float,
) -> ParameterSpace:
    found = []
    for name, elements in geoms.items():
        found += [
            Parameter.around(f"{name}.friction", "geom_friction", elements, "-", FRICTION),
            Parameter.around(f"{name}.restitution", "geom_restitution", elements, "-", restitution),
        ]
    for name, elements in joints.items():
        for field, (kind, unit, value) in JOINT_VALUES.items():
            found.append(Parameter.around(f"{name}.{field}", kind, elements, unit, value))
    for name, elements in links.items():
        found.append(Parameter.around(f"{name}.mass", "body_mass", elements, "kg", _mass(elements[0])))
    return ParameterSpace(found)


def _alike(names: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return joints or links in groups: those of the three fingers form one group."""
    found: dict[str, tuple[str, ...]] = {}
    for name in names:
        finger, _, rest = name.partition("_")
        key = name if finger == "thumb" else f"finger_{rest}"
        found[key] = (*found.get(key, ()), name)
    return found


def parameter_space() -> ParameterSpace:
    """Return 42 parameters: one set for the three fingers, one for all shapes of the hand, no palm mass."""
    return _parameters({"hand": GEOMS}, _alike(JOINTS), _alike(LINKS), RESTITUTION)


def paper_space() -> ParameterSpace:
    """Return 122 of the 125 parameters of DEAL's Table 10, each searched independently.

    Three are left out. The table's 22nd contact (friction and restitution) is the cube's, but MuJoCo uses the
    values of the shape with the higher priority, here the hand's. The palm is fixed, so no motion shows its
    mass.
    """
    contacts, joints, links = ({name: (name,) for name in names} for names in (GEOMS, JOINTS, LINKS))
    return _parameters(contacts, joints, links, PAPER_RESTITUTION)


SPACES: Final = {"default": parameter_space, "paper": paper_space}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
