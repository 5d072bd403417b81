"""The ant's MJCF, prepared from the file in the installed gymnasium; the file is not copied here.

Changes: feet, actuators and default pose get names; the parameter preset's values are written; the floor
alone determines contacts; textures are removed (a 1278-pixel cube map makes every copy of the model 29 MB).
"""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Final

from deal_hw.robots.prepared import PublishedModel, find, package_file

LEG_NUMBERS: Final = (1, 2, 3, 4)
STEP_S: Final = 0.005
GEAR_NM: Final = 15.0
HOME_HEIGHT_M: Final = 0.55
ANKLE_HOME_RAD: Final = {1: 1.0, 2: -1.0, 3: -1.0, 4: 1.0}


def _prepare(root: ET.Element, values: Mapping[str, float]) -> None:
    root.remove(find(root, "asset"))
    root.remove(find(root, "custom"))
    # Runge-Kutta with a 10 ms step costs four evaluations per step; the damping needs an implicit integrator.
    option = find(root, "option")
    option.set("integrator", "implicitfast")
    option.set("timestep", repr(STEP_S))
    floor = find(root, ".//geom[@name='floor']")
    floor.set("priority", "1")
    floor.set("friction", f"{values['contact.friction']!r} 0.5 0.5")
    damping_ratio = values["contact.damping_ratio"]
    floor.set("solref", f"{0.02 / damping_ratio!r} {damping_ratio!r}")
    for geom in root.iter("geom"):
        geom.attrib.pop("material", None)
        geom.set("group", "1")
    find(root, ".//geom[@name='torso_geom']").set("mass", repr(values["torso.mass"]))
    for i in LEG_NUMBERS:
        leg = find(root, f".//body[@name='aux_{i}']")
        foot = find(leg, "body")
        foot.set("name", f"foot_{i}")
        find(leg, "geom").set("mass", repr(values["leg.mass"]))
        find(foot, "geom").set("mass", repr(values["foot.mass"]))
        for part in ("hip", "ankle"):
            joint = find(root, f".//joint[@name='{part}_{i}']")
            for field in ("frictionloss", "damping", "armature"):
                joint.set(field, repr(values[f"{part}.{field}"]))
    for motor in find(root, "actuator"):
        motor.set("name", motor.attrib["joint"])
        motor.set("gear", repr(GEAR_NM))
    pose = " ".join(f"0 {ANKLE_HOME_RAD[i]!r}" for i in LEG_NUMBERS)
    key = ET.SubElement(ET.SubElement(root, "keyframe"), "key")
    key.set("name", "home")
    key.set("qpos", f"0 0 {HOME_HEIGHT_M!r} 1 0 0 0 {pose}")


MODEL: Final = PublishedModel(
    robot="ant",
    file=functools.partial(package_file, "gymnasium", "envs/mujoco/assets/ant.xml", "train"),
    change=_prepare,
    source="ant.xml of gymnasium 1.x",
)
