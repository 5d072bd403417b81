"""URDF files: they hold joints, links and limits, but no drives."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import mujoco

from deal_hw.errors import ConfigurationError
from deal_hw.sim.mjcf.flat import write_flat
from deal_hw.sim.mjcf.text import read_files
from deal_hw.sim.parameters.followers import natural_followers
from deal_hw.sim.parameters.kind import HINGE, SLIDE

REACH: Final = {HINGE: 0.2, SLIDE: 0.02}
"""Error of the position at which a servo to start from gives its whole effort [rad or m]: about that of hobby
servos at their stall torque."""
FREQUENCY_HZ: Final = 5.0
"""Natural frequency of a servo to start from whose effort limit is not known: that of a stiff arm."""
_HEADER = """Written by deal-hw from {name}, which holds no drives: each joint has a position servo here.
  Effort limits are those of the URDF, if it has any; kp and kv are not your robot's: write what you know.
"""


def is_urdf(path: Path) -> bool:
    """Return whether a file that MuJoCo compiles is a URDF; a text that only MuJoCo can read is none."""
    with contextlib.suppress(ConfigurationError):
        return read_files(path).root.tag == "robot"
    return False


def require_drives(path: Path, model: Any, commanded: Sequence[str]) -> None:
    """Refuse commands of a robot whose URDF holds no drives.

    Raises:
        ConfigurationError: It has none; the message says what writes them.
    """
    if commanded and not model.nu and is_urdf(path):
        raise ConfigurationError(
            f"{path} is a URDF, which holds no drives, but there are commands of {', '.join(commanded)}: "
            f"`deal-hw robot new {path}` writes {path.stem}.xml with a servo at each joint, from the URDF's "
            "effort limits and a PD to start from; look at its kp and kv, and name that file"
        )


def write_with_drives(path: Path, target: Path) -> None:
    """Write a URDF as an MJCF with a position servo at each hinge and slide.

    Args:
        path: The URDF.
        target: The file to write.

    Raises:
        ConfigurationError: MuJoCo cannot write it, or the file exists.
    """
    if target.exists():
        raise ConfigurationError(f"{target} exists; remove it, or make robot.yaml from it")
    write_flat(path, target, _add_drives)
    top = read_files(target)
    top.header = _HEADER.format(name=path.name)
    target.write_bytes(top.render())


def _add_drives(spec: Any) -> None:
    model = spec.compile()
    led = {follower.joint for follower in natural_followers(model)}
    for joint in range(model.njnt):
        kind = int(model.jnt_type[joint])
        if kind not in REACH or joint in led:
            continue
        inertia = float(model.dof_M0[model.jnt_dofadr[joint]])
        limit = float(model.jnt_actfrcrange[joint, 1]) if model.jnt_actfrclimited[joint] else 0.0
        stiffness = limit / REACH[kind] if limit > 0 else inertia * (2 * math.pi * FREQUENCY_HZ) ** 2
        servo = spec.add_actuator(name=model.joint(joint).name, target=model.joint(joint).name)
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        servo.gainprm[0], servo.biasprm[1] = stiffness, -stiffness
        servo.biasprm[2] = -2 * math.sqrt(stiffness * inertia)
