"""Facts about dm_control's humanoid: a free torso and 21 joints with torque motors, as in DEAL's Table 11.

:data:`DESCRIPTION` is made on first access, because its model is prepared in the user's cache.
"""

from __future__ import annotations

import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.robots.prepared import PublishedModel, find, simulated_limits

STEP_S: Final = 0.005
HOME_HEIGHT_M: Final = 1.29
"""Height of the torso at which the feet just touch the floor [m]."""
SIDES: Final = ("right", "left")
ABDOMEN: Final = ("abdomen_z", "abdomen_y", "abdomen_x")
LEG: Final = ("hip_x", "hip_z", "hip_y", "knee", "ankle_y", "ankle_x")
ARM: Final = ("shoulder1", "shoulder2", "elbow")
JOINTS: Final = (
    *ABDOMEN,
    *(f"{side}_{joint}" for side in SIDES for joint in LEG),
    *(f"{side}_{joint}" for side in SIDES for joint in ARM),
)
FEET: Final = ("right_right_foot", "left_right_foot", "left_left_foot", "right_left_foot")
"""Each foot has two capsules."""
FIELDS: Final = ("frictionloss", "damping", "armature", "stiffness")
_LOOKS: Final = ("include", "statistic", "sensor")
_MARKS: Final = ("site", "camera", "light")


def joint_type(joint: str) -> str:
    """Return the name of a joint without its side."""
    return joint.removeprefix("right_").removeprefix("left_")


def _prepare(root: ET.Element, values: Mapping[str, float]) -> None:
    for name in _LOOKS:
        for element in root.findall(name):
            root.remove(element)
    for parent in list(root.iter()):
        for element in [
            e for e in parent if e.tag in _MARKS or (e.tag == "default" and e.get("class") == "touch")
        ]:
            parent.remove(element)
    option = find(root, "option")
    option.set("integrator", "implicitfast")
    option.set("timestep", repr(STEP_S))
    damping_ratio = values["contact.damping_ratio"]
    for geom in root.iter("geom"):
        geom.attrib.pop("material", None)
        geom.set("group", "1")
        geom.set("contype", "1")
        geom.set("conaffinity", "1" if geom.get("name") == "floor" else "0")
    find(root, ".//geom[@name='floor']").set("contype", "0")
    for name in FEET:
        foot = find(root, f".//geom[@name='{name}']")
        foot.set("priority", "1")
        # The geom with the higher priority decides alone; the file's feet have 1, which is no friction.
        foot.set("condim", "3")
        foot.set("friction", f"{values['contact.friction']!r} 0.005 0.0001")
        foot.set("solref", f"{0.02 / damping_ratio!r} {damping_ratio!r}")
    # The file drops it from 0.2 m above the floor.
    find(root, ".//body[@name='torso']").set("pos", f"0 0 {HOME_HEIGHT_M!r}")
    for name in JOINTS:
        joint = find(root, f".//joint[@name='{name}']")
        for field in FIELDS:
            joint.set(field, repr(values[f"{joint_type(name)}.{field}"]))
    if {motor.attrib["joint"] for motor in find(root, "actuator")} != set(JOINTS):
        raise KeyError("a motor for each of 21 joints")
    key = ET.SubElement(ET.SubElement(root, "keyframe"), "key")
    key.set("name", "home")
    key.set("qpos", f"0 0 {HOME_HEIGHT_M!r} 1 0 0 0 " + " ".join("0" * len(JOINTS)))


MODEL: Final = PublishedModel(
    robot="humanoid",
    file=lambda: Path(__file__).parent / "assets" / "humanoid.xml",
    change=_prepare,
    source="humanoid.xml of dm_control 1.0.50",
)
"""The MJCF, prepared from dm_control's file (assets/README.md has its source and licence).

Changes: textures, sites, sensors and cameras are removed (textures make every copy of the model 12 MB). The
values of the parameter preset are written. The feet alone define their contacts, with friction. Bodies touch
the floor only.
"""


GEAR_NM: Final[Mapping[str, float]] = {
    **dict.fromkeys(("abdomen_y", "abdomen_z", "abdomen_x", "hip_x", "hip_z", "elbow"), 40.0),
    **dict.fromkeys(("ankle_x", "ankle_y", "shoulder1", "shoulder2"), 20.0),
    "hip_y": 120.0,
    "knee": 80.0,
}
TABLE_11: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "abdomen_y": (0.01, 5.0, 0.02, 20.0),
    "abdomen_z": (0.01, 5.0, 0.01, 20.0),
    "abdomen_x": (0.01, 5.0, 0.01, 10.0),
    "hip_x": (0.01, 5.0, 0.01, 10.0),
    "hip_z": (0.01, 5.0, 0.01, 10.0),
    "hip_y": (0.01, 5.0, 0.01, 20.0),
    "knee": (0.01, 0.1, 0.007, 5.0),
    "ankle_x": (0.01, 1.0, 0.006, 2.0),
    "ankle_y": (0.01, 1.0, 0.006, 2.0),
    "shoulder1": (0.01, 5.0, 0.01, 10.0),
    "shoulder2": (0.01, 5.0, 0.01, 10.0),
    "elbow": (0.01, 1.0, 0.006, 2.0),
}
"""DEAL, Table 11: dry friction [N·m], damping [N·m·s/rad], armature [kg·m²], stiffness [N·m/rad]."""
FRICTION: Final = 1.0
RESTITUTION: Final = 0.04
"""Table 11 has 0.01; motion does not distinguish 0.002 (``deal_hw.robots.ant.description.paper_space``)."""
PAPER_RESTITUTION: Final = 0.01
KINDS: Final = {
    "frictionloss": ("dof_frictionloss", "N·m"),
    "damping": ("dof_damping", "N·m·s/rad"),
    "armature": ("dof_armature", "kg·m²"),
    "stiffness": ("joint_stiffness", "N·m/rad"),
}

if TYPE_CHECKING:
    DESCRIPTION: RobotDescription


def __getattr__(name: str) -> Any:
    if name == "DESCRIPTION":
        return description()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@functools.cache
def description() -> RobotDescription:
    """Return the facts about the humanoid.

    Raises:
        ConfigurationError: No folder for the prepared model can be written.
    """
    count = len(JOINTS)
    gear = tuple(GEAR_NM[joint_type(name)] for name in JOINTS)
    restitution = math.log(RESTITUTION)
    values = {
        "contact.friction": FRICTION,
        "contact.damping_ratio": -restitution / math.hypot(math.pi, restitution),
        **{
            f"{joint}.{field}": x
            for joint, row in TABLE_11.items()
            for field, x in zip(FIELDS, row, strict=True)
        },
    }
    return RobotDescription(
        name="humanoid",
        joint_names=JOINTS,
        actuated=JOINTS,
        position_units=("rad",) * count,
        default_position=(0.0,) * count,
        stiffness=(0.0,) * count,
        damping=(0.0,) * count,
        effort_limit=gear,
        speed_limit=(math.inf,) * count,
        control_rate_hz=50.0,
        device_rate_hz=1 / STEP_S,
        state_rate_hz=50.0,
        limits=simulated_limits(gear),
        sensor=SensorModel(
            noise=(1e-3,) * count, resolution=(2 * math.pi / 4096,) * count, velocity_window_s=0.0
        ),
        mjcf=MODEL.prepared_path(values),
        actuation="motor",
        floating_base="root",
        sources={
            "joint_names": "dm_control, suite/humanoid.xml; the order of its joints",
            "default_position": "upright, as the file has it",
            "effort_limit": "gears of the same file",
            "control_rate_hz": "DEAL, section 4.4: actions at 50 Hz; dm_control's task has 40",
            "device_rate_hz": "the file's step, with an implicit integrator",
            "state_rate_hz": "one state a control step, as in DEAL's environments",
            "limits": "a simulated robot: actions in -1..1 and nothing else",
            "sensor": "assumed: 1 mrad noise, 12-bit encoders",
            "mjcf": "dm_control's humanoid.xml without textures and sites; joint values of DEAL's Table 11",
        },
    )


def _parameters(
    contacts: Mapping[str, tuple[str, ...]], joints: Mapping[str, tuple[str, ...]], bounce: float
) -> ParameterSpace:
    found = [
        Parameter.around(f"{n}.friction", "geom_friction", e, "-", FRICTION) for n, e in contacts.items()
    ]
    found += [
        Parameter.around(f"{n}.restitution", "geom_restitution", e, "-", bounce) for n, e in contacts.items()
    ]
    for name, elements in joints.items():
        for field, value in zip(FIELDS, TABLE_11[joint_type(name)], strict=True):
            kind, unit = KINDS[field]
            found.append(Parameter.around(f"{name}.{field}", kind, elements, unit, value))
    return ParameterSpace(found)


def parameter_space() -> ParameterSpace:
    """Return 50 parameters: left and right joints share theirs, and so do all feet."""
    joints = {t: tuple(j for j in JOINTS if joint_type(j) == t) for t in TABLE_11}
    return _parameters({"feet": FEET}, joints, RESTITUTION)


def paper_space() -> ParameterSpace:
    """Return the 92 parameters of DEAL's Table 11: each joint and each capsule of the feet has its own.

    The paper searches symmetric parameters independently (its section A.7). We read its "Contact x 4" as the
    four capsules.
    """
    return _parameters({name: (name,) for name in FEET}, {j: (j,) for j in JOINTS}, PAPER_RESTITUTION)


SPACES: Final = {"default": parameter_space, "paper": paper_space}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
