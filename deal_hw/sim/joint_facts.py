"""Names, units and limits of the joints of any MJCF: what a recording is compared with before it is used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class JointFacts:
    """The joints of a model that have one coordinate each, in the model's order.

    Attributes:
        names: (J,).
        units: "rad" or "m", (J,).
        limits: Lowest and highest position, (J, 2) [rad or m]; infinite where free.
        left_out: Free and ball joints, which a recording gives no single position of.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    limits: FloatArray
    left_out: tuple[str, ...]


def joint_facts(mjcf: Path) -> JointFacts:
    """Read the joints of a model.

    Raises:
        ConfigurationError: The file does not exist or does not compile, or has no hinge or slide.
    """
    if not Path(mjcf).is_file():
        raise ConfigurationError(f"model {mjcf} does not exist")
    try:
        model = mujoco.MjModel.from_xml_path(str(mjcf))
    except ValueError as error:
        raise ConfigurationError(f"model {mjcf} does not compile: {error}") from error
    names, units, limits, left_out = [], [], [], []
    for index in range(model.njnt):
        joint = model.joint(index)
        kind = mujoco.mjtJoint(int(joint.type[0]))
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            left_out.append(joint.name or f"joint {index}")
            continue
        if not joint.name:
            raise ConfigurationError(
                f"model {mjcf}: joint {index} has no name; name it, recordings need names"
            )
        names.append(joint.name)
        units.append("m" if kind == mujoco.mjtJoint.mjJNT_SLIDE else "rad")
        limits.append(joint.range if bool(joint.limited[0]) else (-np.inf, np.inf))
    if not names:
        raise ConfigurationError(f"model {mjcf} has no hinge or slide joint")
    return JointFacts(tuple(names), tuple(units), np.array(limits, dtype=np.float64), tuple(left_out))
