"""``deal-hw robot lock``: writes a copy of an MJCF in which some joints stay where they are."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from deal_hw.data.files import write_bytes
from deal_hw.errors import ConfigurationError, shown
from deal_hw.workflows.kinds import InputKind, Kinds
from deal_hw.workflows.options import File, from_settings
from deal_hw.workflows.robot import user_robots


@dataclass(frozen=True, kw_only=True)
class LockJointsSettings:
    """Write a copy of an MJCF in which some joints stay where they are, such as those of a gripper."""

    model: File = field(kw_only=False)
    """The robot's MJCF."""

    joints: tuple[str, ...]
    """NAME or NAME=VALUE of each joint [rad or m]; without a value it stays as in the file. Actuators,
    tendons, equalities and sensors of these joints alone go, too."""

    out: File | None = None
    """The file to write; by default NAME_locked.xml beside the MJCF."""


LOCK_JOINTS = Kinds(
    noun="model",
    argument="model",
    table=lambda: {
        "mjcf": InputKind(
            LockJointsSettings, example="lock arm.xml --joints finger_left=0.04 finger_right=0.04"
        )
    },
    find=lambda arguments: "mjcf",
)
"""The one kind of :func:`lock_joints`."""


@dataclass(frozen=True, kw_only=True)
class LockedJoints:
    """A model whose joints were locked.

    Attributes:
        path: The file that was written.
        removed: What went with the joints, such as "actuator 'grip'".
    """

    path: Path
    removed: tuple[str, ...]


@from_settings(LOCK_JOINTS)
def lock_joints(settings: LockJointsSettings) -> LockedJoints:
    """Write a copy of an MJCF in which some joints stay where they are, as ``deal-hw robot lock``.

    A calibration needs the position of every joint and the command of every actuator. Lock the joints that
    were not recorded: ``lock_joints("panda.xml", joints=["finger_joint1=0.04", "finger_joint2=0.04"])``.

    Returns:
        The file, and what went with the joints.

    Raises:
        ConfigurationError: The MJCF cannot be used, a joint cannot be locked there, or the file exists.
        UnknownNameError: There is no such joint.
    """
    user_robots()
    from deal_hw.sim.mjcf import locking

    model = Path(settings.model)
    out = model.with_name(f"{model.stem}_locked.xml") if settings.out is None else Path(settings.out)
    if out.exists():
        raise ConfigurationError(f"{out} exists; name another file with --out, or remove it")
    found = locking.lock_joints(model, _places(settings.joints), out)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(out, found.xml.encode())
    return LockedJoints(path=out, removed=found.removed)


def _places(words: tuple[str, ...]) -> dict[str, float | None]:
    places: dict[str, float | None] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if name in places:
            raise ConfigurationError(f"--joints: joint {name!r} is named twice")
        places[name] = _number(text) if equals else None
        if equals and places[name] is None:
            raise ConfigurationError(
                f"--joints {shown(word)}: give NAME or NAME=VALUE, such as {name or 'finger'}=0.04 [rad or m]"
            )
    if not places:
        raise ConfigurationError("--joints: name at least one joint")
    return places


def _number(text: str) -> float | None:
    """Return a finite number; None for any other text."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
