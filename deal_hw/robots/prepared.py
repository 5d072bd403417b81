"""Prepares models that others published, and keeps the results in the user's cache."""

from __future__ import annotations

import hashlib
import importlib.util
import math
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from deal_hw.description import SafetyLimits
from deal_hw.errors import ConfigurationError, MissingExtraError


def package_file(package: str, inside: str, extra: str) -> Path:
    """Return a file of an installed package; the package is not imported.

    Args:
        package: Its name.
        inside: The file's path inside of it.
        extra: Our extra that installs the package.

    Raises:
        MissingExtraError: The package is not installed.
        ConfigurationError: It is installed, but has no such file.
    """
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtraError(package, extra)
    path = Path(spec.submodule_search_locations[0]) / inside
    if not path.is_file():
        raise ConfigurationError(f"{path} is missing; another version of {package} contains it")
    return path


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedModel:
    """An MJCF that others published, and the change that makes it a robot's.

    Attributes:
        robot: First part of the prepared file's name.
        file: Function that returns the path of the published file; raises MissingExtraError if it belongs to
            a package that is not installed (:func:`package_file`).
        change: Function that changes its tree, given parameter name -> value; raises KeyError or
            AttributeError if a part is missing.
        source: The file and the version that the change was written for.
    """

    robot: str
    file: Callable[[], Path]
    change: Callable[[ET.Element, Mapping[str, float]], None]
    source: str

    def prepare(self, text: str, values: Mapping[str, float]) -> str:
        """Return the published MJCF after the change.

        Raises:
            ConfigurationError: The file is not the one that the change was written for.
        """
        root = ET.fromstring(text)
        try:
            self.change(root, values)
        except (AttributeError, KeyError) as err:
            raise ConfigurationError(
                f"the MJCF is not as expected ({err!r}); deal-hw was written for {self.source}"
            ) from err
        ET.indent(root)
        return ET.tostring(root, encoding="unicode") + "\n"

    def prepared_path(self, values: Mapping[str, float]) -> Path:
        """Return the prepared MJCF in the user's cache folder; it is written if missing.

        Raises:
            MissingExtraError: The file's package is not installed.
            ConfigurationError: The file is missing or not as expected, or no folder can be written.
        """
        return cached(self.robot, self.prepare(self.file().read_text(encoding="utf-8"), values))


def find(root: ET.Element, path: str) -> ET.Element:
    """Return the element at a path.

    Raises:
        KeyError: There is none.
    """
    found = root.find(path)
    if found is None:
        raise KeyError(path)
    return found


def cached(robot: str, text: str) -> Path:
    """Return a file in the user's cache folder with this content; it is written if missing.

    Args:
        robot: First part of its name.
        text: The MJCF.

    Raises:
        ConfigurationError: No folder can be written.
    """
    name = f"{robot}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.xml"
    for folder in _folders():
        path = folder / name
        try:
            if not path.is_file() or path.read_text(encoding="utf-8") != text:
                folder.mkdir(parents=True, exist_ok=True)
                # Written under another name and moved, so that a second process never reads half a file.
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


def simulated_limits(effort: Sequence[float]) -> SafetyLimits:
    """Return the limits of a robot that exists in a simulator only: actions in -1..1 and nothing else.

    Args:
        effort: Effort of each motor at action 1 [N·m].
    """
    count = len(effort)
    return SafetyLimits(
        target=((-1.0, 1.0),) * count,
        target_step=(2.0,) * count,
        target_distance=(math.inf,) * count,
        trip_position=((-math.inf, math.inf),) * count,
        trip_velocity=(math.inf,) * count,
        stiffness=(0.0,) * count,
        damping=(0.0,) * count,
        effort=tuple(effort),
        speed=(math.inf,) * count,
        state_age_s=0.06,
        action_age_s=0.04,
        ease_in_s=0.0,
    )


def _folders() -> list[Path]:
    home = os.environ.get("XDG_CACHE_HOME")
    cache = Path(home) if home else Path.home() / ".cache"
    return [cache / "deal-hw", Path(tempfile.gettempdir()) / f"deal-hw-{os.getuid()}"]
