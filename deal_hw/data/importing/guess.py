"""Guesses a column map from the names of the channels; the caller prints the guess."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.data.importing.channels import Channels
from deal_hw.data.importing.columns import (
    EFFORT_UNITS,
    POSITION_UNITS,
    SPEED_UNITS,
    ColumnMap,
    JointColumns,
    TimeColumn,
)
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
"""Words of a name that are a unit."""
_GIVEN_UNITS = _UNITS | {
    **dict.fromkeys(("radian", "rads"), "rad"),
    **dict.fromkeys(("°", "degree"), "deg"),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    "millimeters": "mm",
    **dict.fromkeys(("nm", "n*m", "n·m", "n m", "n.m"), "Nm"),
    "n": "N",
    **{
        f"{name}/s": f"{unit}/s"
        for name, unit in (("rad", "rad"), ("deg", "deg"), ("°", "deg"), ("m", "m"), ("mm", "mm"))
    },
    **dict.fromkeys(("", "-", "1"), ""),
}
"""Units in brackets behind a name, or in a line of units, in lower case."""
_TIME_NAMES = (
    *("time", "timestamp", "timestamps", "t", "stamp", "log_time", "time_stamp", "datetime", "date_time"),
    *("sim_time", "elapsed", "elapsed_time"),
)
_TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanosecond", "nanoseconds"), "ns"),
}
"""Names of units of time, in lower case."""
_IN_BRACKETS = re.compile(r"\s*[\[({]\s*([^\[\](){}]*?)\s*[\])}]\s*")
"""A unit behind a name."""
_TIME_AND_UNIT = re.compile(r"(.+?)[\s_]*(?:[\[({/,]\s*([a-zµμ]+)\s*[\])}]?|[_ ]([a-zµμ]+))")
_COMMAND_TIMES = ("command_time", "time_command", "target_time")
_SPLIT = re.compile(r"[^A-Za-z0-9]+")


@dataclass(frozen=True, slots=True)
class _Guess:
    """What the name of a channel says.

    Attributes:
        channel: Its name.
        stem: The remaining words, lower case: the joint; empty for an array of all joints.
        original: The same in the file's spelling.
        role: "position", "target", "velocity", "effort", or "" for none of them.
        unit: In the spelling of column maps, or as it is written if that is unknown; "" if none is given.
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
    guesses = _read_names(channels, joints)
    arrays = {
        guess.role: guess
        for guess in guesses
        if guess.role and not guess.stem and channels.is_wide(guess.channel)
    }
    if "position" in arrays:
        return _from_arrays(channels, time, arrays, joints, followers)
    return _from_columns(channels, time, guesses, joints)


def _read_names(channels: Channels, joints: Iterable[str] | None) -> list[_Guess]:
    guesses = []
    for name, values in channels.arrays.items():
        given = channels.units.get(name, ()) if values.ndim == 1 else ()
        guesses.append(_read_name(name, joints or (), *given[:1]))
    return guesses


def _read_name(channel: str, joints: Iterable[str], given: str = "") -> _Guess:
    """Return what a channel's name says; a unit that the file gives comes before that of the name."""
    stem = channel
    if (match := _IN_BRACKETS.search(channel)) and match.end() == len(channel) and not match[1].isdigit():
        stem, given = channel[: match.start()], given or match[1]
    found = _read_words(channel, stem, joints)
    if not given:
        return found
    return dataclasses.replace(found, unit=_GIVEN_UNITS.get(given.lower(), given))


def _read_words(channel: str, words_of: str, joints: Iterable[str]) -> _Guess:
    words = [word for word in _SPLIT.split(words_of) if word]
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
    else:
        command_time = _named_command_time(channels)
    if topic.startswith("/"):
        time = _guess_time(channels, channels.arrays, (f"{topic}.",)) or time
        command_time = _guess_command_time(channels, arrays["target"].channel) if "target" in arrays else None
    unit = arrays["position"].unit or "rad"
    units = tuple(_GIVEN_UNITS.get(given.lower(), given) for given in channels.units.get(array, ()))
    units = units * width if len(units) == 1 else units
    if strange := [given for given in units if given and given not in POSITION_UNITS]:
        raise DatasetError(
            f"{channels.path}: the unit of {array!r} is {short(strange[0], 160)}; known are "
            f"{', '.join(POSITION_UNITS)}. Or write each joint's scale into a column map (unit or normalised)"
        )
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
    guesses = _read_names(channels, joints)
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
            or channels.width(guess.channel) > 1
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
    return ColumnMap(
        time=time,
        command_time=_named_command_time(channels),
        joints=tuple(_joint(channels, name, found[name]) for name in ordered),
        source=("guessed",),
    )


def _has_role_word(channel: str) -> bool:
    return any(word.lower() in _ROLE for word in _SPLIT.split(channel))


_TARGET_UNITS = [*POSITION_UNITS, *EFFORT_UNITS, *SPEED_UNITS]


def _joint(channels: Channels, name: str, roles: dict[str, _Guess]) -> JointColumns:
    unit = roles["position"].unit or "rad"
    target = roles.get("target")
    for guess, known in ((roles["position"], [*POSITION_UNITS]), (target, _TARGET_UNITS)):
        if guess is not None and guess.unit and guess.unit not in known:
            raise DatasetError(
                f"{channels.path}: the unit of {guess.channel!r} is {short(guess.unit, 40)!r}; known are "
                f"{', '.join(known)}. Convert it, or write its scale into a column map, such as "
                f"joints: [{{name: {name}, normalised: {{from: [0, 1], to: [0, 6.2832]}}}}]"
            )
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
    stamps = {name: values for name in names if (values := channels.arrays[name]).size == len(values)}
    named: dict[str, list[tuple[str, str]]] = {}
    for name in stamps:
        for base, unit in _readings_of_time(name.lower()):
            named.setdefault(base, []).append((name, unit))
    for prefix in prefixes:
        for base in ("header.stamp", *_TIME_NAMES, *_TIME_UNITS):
            for name, unit in named.get(f"{prefix}{base}", ()):
                known = "s" if base in ("header.stamp", "log_time") else unit or _TIME_UNITS.get(base, "")
                if base != "header.stamp" or np.ptp(stamps[name]) > 0:
                    return _time_column(channels, name, known)
    stamped = [name for name in stamps if name.lower().endswith((".header.stamp", ".log_time"))]
    if stamped:
        return TimeColumn(column=stamped[0])
    inside = [
        _time_column(channels, name, unit)
        for name in stamps
        for base, unit in _readings_of_time(name.lower().rpartition(".")[2])
        if base in _TIME_NAMES and "." in name and not name.startswith("/")
    ]
    if len(inside) == 1:
        return inside[0]
    # A single channel in a unit of time needs no name.
    timed = {name: given[0].lower() for name in stamps if (given := channels.units.get(name, ()))}
    timed = {name: _TIME_UNITS[unit] for name, unit in timed.items() if unit in _TIME_UNITS}
    return TimeColumn(column=next(iter(timed)), unit=next(iter(timed.values()))) if len(timed) == 1 else None


def _time_column(channels: Channels, name: str, unit: str) -> TimeColumn:
    """Return a channel of time: in a unit that is known by its name, else by the file, else by its steps."""
    given = (*channels.units.get(name, ()), "")[0].lower()
    known = unit or _TIME_UNITS.get(given, "")
    return TimeColumn(column=name, unit=known or _unit_of(np.ravel(channels.arrays[name])))


def _readings_of_time(name: str) -> list[tuple[str, str]]:
    """Return a channel's name, and the same without a unit of time at its end and with that unit."""
    readings = [(name, "")]
    if match := _TIME_AND_UNIT.fullmatch(name):
        unit = _TIME_UNITS.get(match[2] or match[3], "")
        if unit:
            readings.append((match[1], unit))
    return readings


def _guess_command_time(channels: Channels, target: str) -> TimeColumn | None:
    topic = target.rpartition(".")[0]
    if topic.startswith("/"):
        return _guess_time(channels, channels.arrays, (f"{topic}.",))
    if (named := _named_command_time(channels)) is not None:
        return named
    rows = len(channels.arrays[target]) if target in channels.arrays else 0
    other = f", which has {rows} rows and not those of the time" if rows else ""
    raise unguessed(channels, f"which channel is the time of {target!r}{other}")


def _named_command_time(channels: Channels) -> TimeColumn | None:
    """Return the channel whose name says that it is the time of the commands."""
    for name in channels.arrays:
        for base, unit in _readings_of_time(name.lower()):
            if base in _COMMAND_TIMES:
                return _time_column(channels, name, unit)
    return None


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
    noted = f"; {short('; '.join(channels.notes), 300)}" if channels.notes else ""
    return DatasetError(
        f"{channels.path}: cannot tell {what} (channels: {channels.listed()}{noted}); write it into a column "
        "map, columns.yaml, and name that by --columns (in Python: columns=)"
    )


def check_rows(channels: Channels) -> None:
    """Check that each array of a recording with one clock has a row for each time.

    Raises:
        DatasetError: The rows of one are its columns.
    """
    time = guess_time(channels)
    if time is None:
        return
    rows = len(channels.arrays[time.column])
    for name, values in channels.arrays.items():
        if values.ndim == 2 and values.shape[0] != rows == values.shape[1]:
            raise DatasetError(
                f"{channels.path}: {name!r} has shape {values.shape}, but there are {rows} times; a row is a "
                "sample and a column a joint: give its transpose, .T"
            )
