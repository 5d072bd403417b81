"""The humanoid's MJCF, prepared from dm_control's file (assets/README.md has its source and licence).

Changes: textures, sites, sensors and cameras are removed (textures make every copy of the model 12 MB). The
values of the parameter preset are written. The feet alone define their contacts, with friction. Bodies touch
the floor only.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from deal_hw.robots.prepared import PublishedModel, find

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
