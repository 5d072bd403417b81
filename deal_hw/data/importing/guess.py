"""Guesses a column map from the names of the channels; the caller prints the guess."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.data.importing.channels import Channels
from deal_hw.data.importing.columns import POSITION_UNITS, ColumnMap, JointColumns, TimeColumn
from deal_hw.errors import DatasetError, short
from deal_hw.types import FloatArray

_WORDS = {
    "position": "pos position positions q qpos angle angles meas measured measurement actual state states "
    "observation obs encoder present",
    "target": "target targets cmd cmds command commands commanded des desired ref reference setpoint goal "
    "action actions sent",
    "velocity": "vel velocity velocities dq qd qvel speed speeds",
    "effort": "effort efforts torque torques tau load current force forces",
}
_ROLE = {word: role for role, words in _WORDS.items() for word in words.split()}
_FILLERS = {"dof", "joint", "joints", "motor", "motors"}
_UNITS = {"rad": "rad", "radians": "rad", "deg": "deg", "degrees": "deg", "mm": "mm"}
_TIME_NAMES = ("time", "timestamp", "timestamps", "t", "stamp", "log_time")
_TIME_SUFFIXES = {"s": "s", "sec": "s", "seconds": "s", "ms": "ms", "us": "us", "ns": "ns"}
_COMMAND_TIMES = ("command_time", "time_command", "target_time", "command_time_s")
_SPLIT = re.compile(r"[^A-Za-z0-9]+")


@dataclass(frozen=True, slots=True)
class _Guess:
    """What the name of a channel says.

    Attributes:
        channel: Its name.
        stem: The remaining words, lower case: the joint; empty for an array of all joints.
        original: The same in the file's spelling.
        role: "position", "target", "velocity", "effort", or "" for none of them.
        unit: One of the units of position; "" if the name has none.
    """

    channel: str
    stem: tuple[str, ...]
    original: str
    role: str
    unit: str


def guess_columns(
    channels: Channels,
    joints: Sequence[str] | None = None,
    time: TimeColumn | None = None,
    followers: Collection[str] = (),
) -> ColumnMap:
    """Guess what the channels of a file mean.

    Known layouts: one channel per joint, with the joint's name and a word such as ``_pos``, ``_target``,
    ``_cmd``, ``_vel``, ``_effort``; or arrays with one column per joint, such as ``dof_pos`` and
    ``des_dof_pos``, ``observation.state`` and ``action``, ``/joint_states.position`` and
    ``/joint_command.position``.

    Args:
        channels: The file's channels.
        joints: Names of the model's joints; None: the file's names.
        time: The time; None: guessed, too.
        followers: Those of these joints that a file may lack.

    Raises:
        DatasetError: No time or no joint can be found; the message names the channels.
    """
    time = time or guess_time(channels)
    if time is None:
        raise unguessed(
            channels, "which channel is the time (if there is none, add one with the time of each sample)"
        )
    guesses = [_read_name(name, joints or ()) for name in channels.arrays]
    arrays = {
        guess.role: guess
        for guess in guesses
        if guess.role and not guess.stem and channels.is_wide(guess.channel)
    }
    if "position" in arrays:
        return _from_arrays(channels, time, arrays, joints, followers)
    return _from_columns(channels, time, guesses, joints)


def _read_name(channel: str, joints: Iterable[str]) -> _Guess:
    words = [word for word in _SPLIT.split(channel) if word]
    lower = [word.lower() for word in words]
    joint = _joint_in(lower, joints)
    rest = list(range(len(words)))
    if joint is not None:
        begin, length = joint
        rest = [i for i in rest if not begin <= i < begin + length]
    roles = {_ROLE[lower[i]] for i in rest if lower[i] in _ROLE}
    units = [_UNITS[lower[i]] for i in rest if lower[i] in _UNITS]
    left = [i for i in rest if lower[i] not in _ROLE and lower[i] not in _UNITS and lower[i] not in _FILLERS]
    if joint is not None:
        # Other words beside the joint's name have an unknown meaning.
        role = "" if left else _role(roles)
        begin, length = joint
        return _Guess(channel, tuple(lower[begin : begin + length]), "", role, units[0] if units else "")
    named = [i for i in rest if lower[i] not in _ROLE and lower[i] not in _UNITS]
    stem = tuple(lower[i] for i in left)
    return _Guess(
        channel, stem, "_".join(words[i] for i in named), _role(roles, bool(stem)), units[0] if units else ""
    )


def _role(roles: set[str], bare: bool = True) -> str:
    """Return the one role of a channel; a joint's bare name is its position, "target velocity" is no role."""
    if "target" in roles and roles <= {"target", "position"}:
        return "target"
    if len(roles - {"position"}) == 1:
        return next(iter(roles - {"position"})) if "target" not in roles else ""
    return "position" if roles == {"position"} or (not roles and bare) else ""


def _joint_in(words: list[str], joints: Iterable[str]) -> tuple[int, int] | None:
    """Return the place of the longest joint name among a channel's words: first word, number of words."""
    best: tuple[int, int] | None = None
    for name in joints:
        whole = [word.lower() for word in _SPLIT.split(name) if word]
        for parts in (whole, [word for word in whole if word not in _FILLERS]):
            for begin in range(len(words) - len(parts) + 1 if parts else 0):
                if words[begin : begin + len(parts)] == parts and (best is None or len(parts) > best[1]):
                    best = begin, len(parts)
    return best


def _key(name: str) -> tuple[str, ...]:
    """Return the words of a joint's name without words common to all joints."""
    words = [word.lower() for word in _SPLIT.split(name) if word]
    return tuple(word for word in words if word not in _FILLERS) or tuple(words)


def _from_arrays(
    channels: Channels,
    time: TimeColumn,
    arrays: dict[str, _Guess],
    joints: Sequence[str] | None,
    followers: Collection[str],
) -> ColumnMap:
    array = arrays["position"].channel
    width = channels.arrays[array].shape[1]
    own = channels.labels.get(array, ()) or channels.joint_names
    names = [name.removesuffix(".pos") for name in own]
    by_order = not names
    if len(names) != width:
        leaders = [name for name in joints or () if name not in followers]
        fits = leaders if len(leaders) == width else list(joints or ())
        if names or len(fits) != width:
            model = (
                "" if joints is None else f" (the model has {len(joints)}: {short(', '.join(joints), 80)})"
            )
            raise unguessed(channels, f"which joints the {width} columns of {array!r} are{model}")
        names = fits
    found = match_joints(channels, names, joints)
    topic = array.rpartition(".")[0]
    command_time = None
    if "target" in arrays and len(channels.arrays[arrays["target"].channel]) != len(channels.arrays[array]):
        command_time = _guess_command_time(channels, arrays["target"].channel)
    elif any(name in channels.arrays for name in _COMMAND_TIMES):
        command_time = _guess_command_time(channels, "")
    if topic.startswith("/"):
        time = _guess_time(channels, channels.arrays, (f"{topic}.",)) or time
        command_time = _guess_command_time(channels, arrays["target"].channel) if "target" in arrays else None
    unit = arrays["position"].unit or "rad"
    units = channels.units.get(array, ())
    units = units if len(units) == width and set(units) <= set(POSITION_UNITS) else (unit,) * width
    by_role = {role: guess.channel for role, guess in arrays.items()}
    return ColumnMap(
        time=time,
        command_time=command_time,
        position=by_role["position"],
        target=by_role.get("target"),
        velocity=_of_same_rows(channels, by_role, "velocity"),
        effort=_of_same_rows(channels, by_role, "effort"),
        joints=tuple(
            JointColumns(name=model, column=name, index=index if by_order else None, unit=units[index])
            for model, name, index in found
        ),
        source=("guessed",),
    )


def _of_same_rows(channels: Channels, fits: dict[str, str], role: str) -> str | None:
    array = fits.get(role)
    if array is None or channels.arrays[array].shape != channels.arrays[fits["position"]].shape:
        return None
    return array


def match_joints(
    channels: Channels, names: list[str], joints: Sequence[str] | None
) -> list[tuple[str, str, int]]:
    """Return name in the model, name in the file and column of each joint of the file that the model has.

    Raises:
        DatasetError: It has none of them; the message shows what to write in a column map.
    """
    if joints is None:
        return [(name, name, index) for index, name in enumerate(names)]
    by_key = {_key(name): name for name in joints}
    found = [(by_key[_key(name)], name, index) for index, name in enumerate(names) if _key(name) in by_key]
    if not found:
        pairs = ", ".join(f"{{name: {m}, column: {n}}}" for m, n in zip(joints, names, strict=False))
        raise unguessed(
            channels,
            f"which of the model's joints ({short(', '.join(joints), 80)}) the file's "
            f"({short(', '.join(names), 80)}) are (such as joints: [{short(pairs, 120)}])",
        )
    return found


def channels_of_joints(
    channels: Channels, time: TimeColumn | None, joints: Sequence[str] | None = None
) -> dict[str, dict[str, str]]:
    """Return the channels with a joint's name and a known quantity: by joint, then quantity."""
    guesses = [_read_name(name, joints or ()) for name in channels.arrays]
    found = _by_joint(channels, time, guesses, joints)
    return {name: {role: g.channel for role, g in roles.items()} for name, roles in found.items()}


def _by_joint(
    channels: Channels, time: TimeColumn | None, guesses: list[_Guess], joints: Sequence[str] | None
) -> dict[str, dict[str, _Guess]]:
    names = {_key(name): name for name in joints} if joints is not None else {}
    found: dict[str, dict[str, _Guess]] = {}
    with_target = {guess.stem for guess in guesses if guess.role == "target"}
    for guess in guesses:
        if (
            (time is not None and guess.channel == time.column)
            or not guess.role
            or not guess.stem
            or channels.is_wide(guess.channel)
        ):
            continue
        key = _key(" ".join(guess.stem))
        # Without a model any column could be a position; only those with a target or a known word count.
        if joints is None and guess.stem not in with_target and not _has_role_word(guess.channel):
            continue
        if joints is not None and key not in names:
            continue
        name = names.get(key) or next((g.original for g in guesses if g.stem == guess.stem), guess.original)
        found.setdefault(name, {}).setdefault(guess.role, guess)
    return found


def _from_columns(
    channels: Channels, time: TimeColumn, guesses: list[_Guess], joints: Sequence[str] | None
) -> ColumnMap:
    found = _by_joint(channels, time, guesses, joints)
    found = {name: roles for name, roles in found.items() if "position" in roles}
    if not found:
        raise unguessed(channels, "which channels are the joints' positions")
    ordered = [name for name in (joints or found) if name in found]
    own_time = any(name in channels.arrays for name in _COMMAND_TIMES)
    return ColumnMap(
        time=time,
        command_time=_guess_command_time(channels, "") if own_time else None,
        joints=tuple(_joint(name, found[name]) for name in ordered),
        source=("guessed",),
    )


def _has_role_word(channel: str) -> bool:
    return any(word.lower() in _ROLE for word in _SPLIT.split(channel))


def _joint(name: str, roles: dict[str, _Guess]) -> JointColumns:
    unit = roles["position"].unit or "rad"
    target = roles.get("target")
    chosen: dict[str, Any] = {role: guess.channel for role, guess in roles.items()}
    return JointColumns(
        name=name,
        unit=unit,
        target_unit=target.unit if target is not None and target.unit else "",
        **chosen,
    )


def guess_time(channels: Channels) -> TimeColumn | None:
    """Return the channel of time; None if no name is known."""
    return _guess_time(channels, channels.arrays, ("",))


def _guess_time(channels: Channels, names: Iterable[str], prefixes: tuple[str, ...]) -> TimeColumn | None:
    """Return the time channel under one of the prefixes, with its unit by its name, else by its steps."""
    by_lower = {name.lower(): name for name in names if channels.arrays[name].ndim == 1}
    for prefix in prefixes:
        for base in ("header.stamp", *_TIME_NAMES):
            if (name := by_lower.get(f"{prefix}{base}")) is not None:
                known = "s" if base in ("header.stamp", "log_time") else ""
                if base != "header.stamp" or np.ptp(channels.arrays[name]) > 0:
                    return TimeColumn(column=name, unit=known or _unit_of(channels.arrays[name]))
            for suffix, unit in _TIME_SUFFIXES.items():
                for joined in (
                    f"{prefix}{base}_{suffix}",
                    f"{prefix}{base} [{suffix}]",
                    f"{prefix}{base}[{suffix}]",
                ):
                    if (name := by_lower.get(joined)) is not None:
                        return TimeColumn(column=name, unit=unit)
    stamped = [name for name in by_lower.values() if name.endswith((".header.stamp", ".log_time"))]
    return TimeColumn(column=stamped[0]) if stamped else None


def _guess_command_time(channels: Channels, target: str) -> TimeColumn | None:
    topic = target.rpartition(".")[0]
    if topic.startswith("/"):
        return _guess_time(channels, channels.arrays, (f"{topic}.",))
    for name in _COMMAND_TIMES:
        if name in channels.arrays:
            unit = "s" if name.endswith("_s") else _unit_of(channels.arrays[name])
            return TimeColumn(column=name, unit=unit)
    rows = len(channels.arrays[target]) if target in channels.arrays else 0
    other = f", which has {rows} rows and not those of the time" if rows else ""
    raise unguessed(channels, f"which channel is the time of {target!r}{other}")


def _unit_of(stamps: FloatArray) -> str:
    """Return the unit of time in which a recording has between 5 and 5000 samples a second."""
    steps = np.diff(stamps[np.isfinite(stamps)])
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    for unit, longest in (("s", 0.2), ("ms", 200.0), ("us", 2e5)):
        if step <= longest:
            return unit
    return "ns"


def is_target(name: str) -> bool:
    """Return whether a word of a topic's or channel's name means a command."""
    return any(_ROLE.get(word.lower()) == "target" for word in _SPLIT.split(name))


def unguessed(channels: Channels, what: str) -> DatasetError:
    """Return the error that names what cannot be guessed, and the channels."""
    return DatasetError(
        f"{channels.path}: cannot tell {what} (channels: {channels.listed()}); write it into a column map, "
        "columns.yaml, and name that by --columns (in Python: columns=)"
    )
