"""The ant's MJCF, prepared from the file that the installed gymnasium carries; nothing of it is copied here.

What is changed: feet, actuators and default pose get names; the values of the parameter preset are written;
the floor alone rules contacts; textures go (a 1278-pixel cube map makes every copy of the model 29 MB).
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from deal_hw.errors import ConfigurationError, MissingExtraError

LEG_NUMBERS: Final = (1, 2, 3, 4)
STEP_S: Final = 0.005
GEAR_NM: Final = 15.0
HOME_HEIGHT_M: Final = 0.55
ANKLE_HOME_RAD: Final = {1: 1.0, 2: -1.0, 3: -1.0, 4: 1.0}


def source_path() -> Path:
    """Return gymnasium's ant.xml.

    Raises:
        MissingExtraError: gymnasium is not installed.
        ConfigurationError: It is, but carries no ant.xml.
    """
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError("gymnasium", "train")
    path = Path(spec.submodule_search_locations[0]) / "envs" / "mujoco" / "assets" / "ant.xml"
    if not path.is_file():
        raise ConfigurationError(f"{path} is not there; gymnasium >= 1.0 carries the ant's model")
    return path


def prepare(text: str, values: Mapping[str, float]) -> str:
    """Return gymnasium's MJCF with names for everything and the preset's values.

    Args:
        text: Content of ant.xml.
        values: Parameter name -> value, as in ``drivers.ant.description``; all 11.

    Raises:
        ConfigurationError: The file is not the one this was written for.
    """
    root = ET.fromstring(text)
    try:
        _prepare(root, values)
    except (AttributeError, KeyError) as err:
        raise ConfigurationError(
            f"gymnasium's ant.xml is not as expected ({err!r}); deal-hw was written for that of gymnasium 1.x"
        ) from err
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _find(root: ET.Element, path: str) -> ET.Element:
    found = root.find(path)
    if found is None:
        raise KeyError(path)
    return found


def _prepare(root: ET.Element, values: Mapping[str, float]) -> None:
    root.remove(_find(root, "asset"))
    root.remove(_find(root, "custom"))
    # Runge-Kutta with a 10 ms step costs four evaluations a step; the damping wants an implicit integrator.
    option = _find(root, "option")
    option.set("integrator", "implicitfast")
    option.set("timestep", repr(STEP_S))
    floor = _find(root, ".//geom[@name='floor']")
    floor.set("priority", "1")
    floor.set("friction", f"{values['contact.friction']!r} 0.5 0.5")
    damping_ratio = values["contact.damping_ratio"]
    floor.set("solref", f"{0.02 / damping_ratio!r} {damping_ratio!r}")
    for geom in root.iter("geom"):
        geom.attrib.pop("material", None)
        geom.set("group", "1")
    _find(root, ".//geom[@name='torso_geom']").set("mass", repr(values["torso.mass"]))
    for i in LEG_NUMBERS:
        leg = _find(root, f".//body[@name='aux_{i}']")
        foot = _find(leg, "body")
        foot.set("name", f"foot_{i}")
        _find(leg, "geom").set("mass", repr(values["leg.mass"]))
        _find(foot, "geom").set("mass", repr(values["foot.mass"]))
        for part in ("hip", "ankle"):
            joint = _find(root, f".//joint[@name='{part}_{i}']")
            for field in ("frictionloss", "damping", "armature"):
                joint.set(field, repr(values[f"{part}.{field}"]))
    for motor in _find(root, "actuator"):
        motor.set("name", motor.attrib["joint"])
        motor.set("gear", repr(GEAR_NM))
    pose = " ".join(f"0 {ANKLE_HOME_RAD[i]!r}" for i in LEG_NUMBERS)
    key = ET.SubElement(ET.SubElement(root, "keyframe"), "key")
    key.set("name", "home")
    key.set("qpos", f"0 0 {HOME_HEIGHT_M!r} 1 0 0 0 {pose}")


def prepared_path(values: Mapping[str, float]) -> Path:
    """Return the prepared MJCF in the user's cache folder, written if it is not there yet.

    Raises:
        MissingExtraError: gymnasium is not installed.
        ConfigurationError: gymnasium's file is missing or not as expected.
    """
    text = prepare(source_path().read_text(encoding="utf-8"), values)
    name = f"ant-{hashlib.sha256(text.encode()).hexdigest()[:16]}.xml"
    for folder in _folders():
        path = folder / name
        try:
            if not path.is_file() or path.read_text(encoding="utf-8") != text:
                folder.mkdir(parents=True, exist_ok=True)
                # Written under another name and moved: a second process never reads half a file.
                handle, temporary = tempfile.mkstemp(dir=folder, suffix=".tmp")
                with os.fdopen(handle, "w", encoding="utf-8") as file:
                    file.write(text)
                os.replace(temporary, path)
        except OSError:
            continue
        return path
    raise ConfigurationError(
        f"cannot write {name} to any of {[str(f) for f in _folders()]}; "
        "set XDG_CACHE_HOME to a writable folder"
    )


def _folders() -> list[Path]:
    home = os.environ.get("XDG_CACHE_HOME")
    cache = Path(home) if home else Path.home() / ".cache"
    return [cache / "deal-hw", Path(tempfile.gettempdir()) / f"deal-hw-{os.getuid()}"]
