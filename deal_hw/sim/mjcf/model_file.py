"""The MJCF file of a model in memory; a calibration edits text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError


def mjcf_file(model: Any, folder: Path) -> Path:
    """Return the path of a model; a model in memory is written into a folder.

    Args:
        model: A path, an ``mujoco.MjSpec``, or the ``mujoco.MjModel`` that was compiled last. A compiled
            model has lost its text, and MuJoCo can write only that of the last one.
        folder: Output folder.

    Raises:
        ConfigurationError: It has another type, is XML text, or is not the last compiled model.
    """
    if isinstance(model, str) and model.lstrip().startswith("<"):
        raise ConfigurationError(
            "the model is XML text; give its file's path, or mujoco.MjSpec.from_string(text)"
        )
    if isinstance(model, str | Path):
        return Path(model)
    path = folder / "model.xml"
    if isinstance(model, mujoco.MjSpec):
        path.write_text(model.to_xml(), encoding="utf-8")
        return path
    if not isinstance(model, mujoco.MjModel):
        raise ConfigurationError(
            f"model is of type {type(model).__name__}; allowed are the path of an MJCF, an mujoco.MjSpec or "
            "an mujoco.MjModel"
        )
    try:
        mujoco.mj_saveLastXML(str(path), model)
        again = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigurationError(f"the MjModel has no MJCF any more ({error}); {_INSTEAD}") from error
    if not _same(model, again):
        raise ConfigurationError(f"the MjModel is not the one that was compiled last; {_INSTEAD}")
    return path


_INSTEAD = "give the path of its MJCF, or its mujoco.MjSpec"


def _same(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Return whether two models have the same joints and actuators, and equal masses (rounded)."""
    sizes = ("nq", "nv", "nu", "nbody", "njnt", "ngeom")
    if any(getattr(one, name) != getattr(other, name) for name in sizes) or one.names != other.names:
        return False
    return np.allclose(one.body_mass, other.body_mass, rtol=1e-5)
