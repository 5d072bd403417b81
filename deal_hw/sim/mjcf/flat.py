"""An MJCF written out in full: each element that a macro or another model makes has a text of its own."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import mujoco

from deal_hw.errors import ConfigurationError, short
from deal_hw.sim.mjcf.text import read_files

ROUNDED: Final = 1e-5
"""Relative difference between a file and what MuJoCo writes of it: it writes six digits."""


def write_flat(path: Path, target: Path, change: Callable[[Any], None] | None = None) -> None:
    """Write a model as one file without ``<attach>``, ``<replicate>``, ``<composite>`` or ``<include>``.

    MuJoCo writes it: with six digits, without comments, and with actuators as ``<general>``.

    Args:
        path: The model.
        target: The file to write; it names meshes and textures from its own folder.
        change: Changes the MjSpec before.

    Raises:
        ConfigurationError: MuJoCo cannot write it.
    """
    whole = os.path.abspath(path)
    try:
        spec = mujoco.MjSpec.from_file(whole)
        if change is not None:
            change(spec)
        spec.compile()
        target.write_text(spec.to_xml(), encoding="utf-8")
    except (ValueError, mujoco.FatalError) as err:
        raise ConfigurationError(f"{path} cannot be written out in full: {short(str(err))}") from err
    # MuJoCo writes the names of files as an attached model gives them, which count from that model's folder.
    files = [os.path.normpath(name) for name in mujoco.mju_getXMLDependencies(whole)]
    assets = {
        (tag, asset.name): (asset, kind)
        for tag, kind, found in (
            ("mesh", "meshdir", spec.meshes),
            ("hfield", "meshdir", spec.hfields),
            ("texture", "texturedir", spec.textures),
        )
        for asset in found
    }
    top = read_files(target)
    for element in top.elements:
        if element.tag == "compiler":
            element.set("meshdir", None)
            element.set("texturedir", None)
        asset, kind = assets.get((element.tag, element.get("name") or ""), (None, ""))
        if asset is not None and element.get("file"):
            element.set("file", _place(asset, kind, files, os.path.dirname(whole), target.parent))
    target.write_bytes(top.render())


def _place(asset: Any, kind: str, files: Sequence[str], beside: str, folder: Path) -> str:
    """Return the file of an asset, seen from a folder: one of the model's files, or one beside the model.

    MuJoCo lists no files of a URDF.
    """
    tail = os.path.normpath(os.path.join(getattr(asset.compiler, kind), asset.file))
    found = [name for name in files if name == tail or name.endswith(os.sep + tail)]
    return os.path.relpath(found[0] if found else os.path.join(beside, tail), os.path.abspath(folder))
