"""Facts about gymnasium's ant: a free torso and eight joints with torque motors.

:data:`DESCRIPTION` is made on first use, since it needs the model of the installed gymnasium.
"""

from __future__ import annotations

import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.robots.prepared import PublishedModel, find, package_file, simulated_limits

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
"""The MJCF, prepared from the file in the installed gymnasium; the file is not copied here.

Changes: feet, actuators and default pose get names; the parameter preset's values are written; the floor
alone determines contacts; textures are removed (a 1278-pixel cube map makes every copy of the model 29 MB).
"""


JOINTS: Final = tuple(f"{part}_{i}" for i in LEG_NUMBERS for part in ("hip", "ankle"))
HIPS: Final = tuple(f"hip_{i}" for i in LEG_NUMBERS)
ANKLES: Final = tuple(f"ankle_{i}" for i in LEG_NUMBERS)
LEGS: Final = tuple(f"aux_{i}" for i in LEG_NUMBERS)
FEET: Final = tuple(f"foot_{i}" for i in LEG_NUMBERS)

DEFAULT: Final[Mapping[str, float]] = {
    "contact.friction": 1.0,
    "contact.restitution": 0.04,
    "hip.frictionloss": 0.2,
    "hip.damping": 0.3,
    "hip.armature": 0.1,
    "ankle.frictionloss": 0.1,
    "ankle.damping": 0.2,
    "ankle.armature": 0.1,
    "foot.mass": 0.1,
    "leg.mass": 0.2,
    "torso.mass": 1.0,
}
"""The default preset: the paper's values, except friction and restitution (see :func:`paper_space`)."""

PAPER: Final[Mapping[str, float]] = {**DEFAULT, "contact.friction": 1.5, "contact.restitution": 0.01}
"""DEAL, Table 7."""

_ROWS: Final[tuple[tuple[str, str, tuple[str, ...], str], ...]] = (
    ("contact.friction", "geom_friction", ("floor",), "-"),
    ("contact.restitution", "geom_restitution", ("floor",), "-"),
    ("hip.frictionloss", "dof_frictionloss", HIPS, "N·m"),
    ("hip.damping", "dof_damping", HIPS, "N·m·s/rad"),
    ("hip.armature", "dof_armature", HIPS, "kg·m²"),
    ("ankle.frictionloss", "dof_frictionloss", ANKLES, "N·m"),
    ("ankle.damping", "dof_damping", ANKLES, "N·m·s/rad"),
    ("ankle.armature", "dof_armature", ANKLES, "kg·m²"),
    ("foot.mass", "body_mass", FEET, "kg"),
    ("leg.mass", "body_mass", LEGS, "kg"),
    ("torso.mass", "body_mass", ("torso",), "kg"),
)

if TYPE_CHECKING:
    DESCRIPTION: RobotDescription


def __getattr__(name: str) -> Any:
    if name == "DESCRIPTION":
        return description()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@functools.cache
def description() -> RobotDescription:
    """Return the facts about the ant.

    Raises:
        MissingExtraError: gymnasium, which contains the model, is not installed.
    """
    restitution = math.log(DEFAULT["contact.restitution"])
    damping_ratio = -restitution / math.hypot(math.pi, restitution)
    values = {**DEFAULT, "contact.damping_ratio": damping_ratio}
    return RobotDescription(
        name="ant",
        joint_names=JOINTS,
        actuated=JOINTS,
        position_units=("rad",) * 8,
        default_position=tuple(x for i in LEG_NUMBERS for x in (0.0, ANKLE_HOME_RAD[i])),
        stiffness=(0.0,) * 8,
        damping=(0.0,) * 8,
        effort_limit=(GEAR_NM,) * 8,
        speed_limit=(math.inf,) * 8,
        control_rate_hz=50.0,
        device_rate_hz=1 / STEP_S,
        state_rate_hz=50.0,
        limits=simulated_limits((GEAR_NM,) * 8),
        sensor=SensorModel(noise=(1e-3,) * 8, resolution=(2 * math.pi / 4096,) * 8, velocity_window_s=0.0),
        mjcf=MODEL.prepared_path(values),
        actuation="motor",
        floating_base="root",
        sources={
            "joint_names": "gymnasium, envs/mujoco/assets/ant.xml; leg by leg, hip before ankle",
            "default_position": "the same file, init_qpos",
            "effort_limit": "gear 15, as ants of small armature have; gymnasium's is 150, armature 1",
            "control_rate_hz": "DEAL, section 4.4: actions at 50 Hz",
            "device_rate_hz": "half of gymnasium's step, with an implicit integrator",
            "state_rate_hz": "one state a control step, as in DEAL's environments",
            "limits": "a simulated robot: actions in -1..1 and nothing else",
            "sensor": "assumed: 1 mrad noise, 12-bit encoders",
            "mjcf": "gymnasium's ant.xml with names, masses and joint values of the default preset",
        },
    )


def _space(values: Mapping[str, float]) -> ParameterSpace:
    if missing := [name for name, *_ in _ROWS if name not in values]:
        raise ConfigurationError(f"the ant's preset lacks {missing}")
    return ParameterSpace(
        Parameter.around(name, kind, elements, unit, values[name]) for name, kind, elements, unit in _ROWS
    )


def parameter_space() -> ParameterSpace:
    """Return the 11 parameters of DEAL's Table 7; the four legs share theirs.

    Contact friction and restitution are the floor's, which determines every contact (geom priority). "Motor
    friction" is dry friction of the joint. "Leg" is the link between hip and ankle, "foot" the one after it.
    """
    return _space(DEFAULT)


def paper_space() -> ParameterSpace:
    """Return the same with the values of DEAL's Table 7.

    Two of them are unusual. With a restitution of 0.01 a body bounces to 1/10000 of its height. MuJoCo has no
    restitution: it becomes damping of the contact (see ``geom_restitution``), and 0.01 gives nearly the same
    damping as 0.002 or 0.05. The default preset has 0.04, so that a factor 20 to either side stays below 1. A
    friction of 1.5 is that of rubber on rubber; the default preset has 1, gymnasium's own value.
    """
    return _space(PAPER)


SPACES: Final = {"default": parameter_space, "paper": paper_space}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
