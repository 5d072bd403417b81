"""The column map: which channel of a file is the time, position or target of which joint.

A YAML file such as::

    time: {column: timestamp, unit: us}
    position: "{joint}_pos"          # one channel a joint, or one array for all: dof_pos
    target: "{joint}_cmd"
    unit: deg
    joints:
      - shoulder                     # the same name in the file and in the model
      - {name: elbow_joint, column: elbow, sign: -1, offset: 0.1}
      - {name: jaw, normalised: {from: [0, 100], to: [-0.17, 1.75]}}

A value x of the file becomes ``sign * scale(x) + offset`` in rad or m; offset and sign convert the file's
zero and direction to the model's, for position and target alike; velocity, effort and a motor's target,
which is an effort, use the sign only.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from deal_hw.documentation import page
from deal_hw.errors import QUOTED, ConfigurationError, UnknownNameError, short, shown
from deal_hw.reading import NAMES, number, read_yaml, reading

TIME_UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Unit of time -> seconds."""
POSITION_UNITS: Mapping[str, float] = {"rad": 1.0, "deg": math.pi / 180, "m": 1.0, "mm": 1e-3}
"""Unit of position -> radians or metres."""
EFFORT_UNITS: Mapping[str, float] = {"N": 1.0, "Nm": 1.0}
"""Unit of a motor's target -> newtons or newton metres."""
SPEED_UNITS: Mapping[str, float] = {f"{unit}/s": factor for unit, factor in POSITION_UNITS.items()}
"""Unit of a velocity servo's target -> radians or metres a second."""
MOST_SHIFT_S = 2.0
"""Largest shift of commands [s]; a longer one is another clock."""
QUATERNION_ORDERS = ("wxyz", "xyzw")
FRAMES = ("world", "base")


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeColumn:
    """A channel of time.

    Attributes:
        column: The channel.
        unit: One of :data:`TIME_UNITS`.
    """

    column: str
    unit: str = "s"

    def __post_init__(self) -> None:
        if self.unit not in TIME_UNITS:
            raise UnknownNameError("unit of time", self.unit, TIME_UNITS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalised:
    """A linear scale without unit, such as 0..1 or -100..100 of a joint's travel.

    Attributes:
        file: Two values in the file.
        robot: The same two in rad or m.
    """

    file: tuple[float, float]
    robot: tuple[float, float]

    def __post_init__(self) -> None:
        values = (*self.file, *self.robot)
        if not all(map(math.isfinite, values)) or self.file[0] == self.file[1]:
            raise ConfigurationError(
                f"normalised: from {list(self.file)} to {list(self.robot)} is no scale; give two different "
                "values of the file and their two positions [rad or m]"
            )

    @property
    def slope(self) -> float:
        """Radians or metres in one unit of the file."""
        return (self.robot[1] - self.robot[0]) / (self.file[1] - self.file[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class JointColumns:
    """The channels of one joint and their conversion to SI.

    Attributes:
        name: The joint's name in the model.
        column: Its name in the file, which replaces ``{joint}`` in patterns; "" for the same.
        index: Its column in arrays with one column per joint; None: by label, else by its place in the list.
        position, target, velocity, effort: Channels; None: by the map's pattern.
        unit: Unit of position and target, one of :data:`POSITION_UNITS`.
        target_unit: Unit of the target if it differs, also one of :data:`EFFORT_UNITS` or, for a velocity
            servo, of :data:`SPEED_UNITS`; "" for the same, or for what the joint's actuator takes, in SI.
        normalised: Replaces ``unit`` if the file's values have none.
        target_normalised: The same for the target if it differs.
        sign: 1 or -1.
        offset: Added after sign and scale [rad or m].
        slides: The joint's unit is m; only needed with ``normalised``, and without a model.
        motor: Effort of the motor that drives the joint in the model, at its highest command [N or N·m];
            None: no motor, or no model. No entry of a file.
        speed_gain: Effort an error of the speed, of the velocity servo that drives the joint in the model
            [N·s/m or N·m·s/rad]: its target, a speed, becomes an effort by it. None: there is none. No entry
            of a file.
    """

    name: str
    column: str = ""
    index: int | None = None
    position: str | None = None
    target: str | None = None
    velocity: str | None = None
    effort: str | None = None
    unit: str = "rad"
    target_unit: str = ""
    normalised: Normalised | None = None
    target_normalised: Normalised | None = None
    sign: float = 1.0
    offset: float = 0.0
    slides: bool = False
    motor: float | None = None
    speed_gain: float | None = None

    def __post_init__(self) -> None:
        if self.unit not in POSITION_UNITS:
            raise UnknownNameError("unit of position", self.unit, POSITION_UNITS)
        units = {**POSITION_UNITS, **EFFORT_UNITS, **SPEED_UNITS}
        if self.target_unit and self.target_unit not in units:
            raise UnknownNameError("unit of a target", self.target_unit, units)
        if self.slides and self.unit == "deg":
            raise ConfigurationError(f"joint {self.name!r} slides, but its unit is deg; write m or mm")
        if self.speed_gain is not None and (self.target_unit or "rad/s") not in SPEED_UNITS:
            raise ConfigurationError(
                f"joint {self.name!r}: target_unit {self.target_unit}, but a velocity servo of the model "
                f"drives it, so its target is a speed; write target_unit: {self.si_unit}/s, or give the "
                "model a <position> or a <motor>"
            )
        if self.motor is not None and POSITION_UNITS.get(self.target_unit, 1.0) != 1.0:
            raise ConfigurationError(
                f"joint {self.name!r}: target_unit {self.target_unit}, but a motor of the model drives it, "
                f"so its target is an effort; write target_unit: {self.effort_unit}, or give the model a "
                "<position>"
            )
        if self.sign not in (1.0, -1.0) or not math.isfinite(self.offset):
            raise ConfigurationError(
                f"joint {self.name!r}: sign {self.sign:g}, offset {self.offset:g}; sign is 1 or -1, "
                "offset in rad or m"
            )

    @property
    def si_unit(self) -> str:
        """Unit of the position after conversion, "rad" or "m"."""
        return "m" if self.slides or self.unit in ("m", "mm") else "rad"

    @property
    def effort_unit(self) -> str:
        """Unit of the joint's effort, one of :data:`EFFORT_UNITS`."""
        return "N" if self.si_unit == "m" else "Nm"

    @property
    def takes_effort(self) -> bool:
        """Whether the target is an effort, not a position."""
        return not (self.motor is None and self.speed_gain is None) or self.target_unit in EFFORT_UNITS

    @property
    def unit_unsaid(self) -> bool:
        """Whether a motor's commands may be efforts as well as a share of its full power."""
        return self.motor is not None and not (self.target_normalised or self.target_unit in EFFORT_UNITS)

    def scale(self, target: bool = False) -> tuple[float, float]:
        """Return slope and constant of the conversion from a file's value to rad or m, or N or N·m."""
        if target and self.speed_gain is None and self.target_unit in SPEED_UNITS:
            raise ConfigurationError(
                f"joint {self.name!r}: target_unit {self.target_unit} is a speed, but no velocity servo of a "
                "model drives it; name the column of commanded positions or efforts, or give the model a "
                "<velocity>"
            )
        if target and self.speed_gain is not None and self.target_normalised is None:
            unit = SPEED_UNITS[self.target_unit] if self.target_unit else 1.0
            return self.sign * unit * self.speed_gain, 0.0
        if target and self.takes_effort:
            scale = self.target_normalised
            slope = 1.0 if scale is None else scale.slope
            constant = 0.0 if scale is None else scale.robot[0] - slope * scale.file[0]
            sign = self.sign * (1.0 if self.speed_gain is None else self.speed_gain)
            return sign * slope, sign * constant
        both = self.target_normalised if target and self.target_normalised else self.normalised
        if both is not None and not (target and self.target_unit and not self.target_normalised):
            slope = both.slope
            constant = both.robot[0] - slope * both.file[0]
        else:
            slope, constant = POSITION_UNITS[(target and self.target_unit) or self.unit], 0.0
        return self.sign * slope, self.sign * constant + self.offset


@dataclass(frozen=True, slots=True, kw_only=True)
class Vector:
    """Three or four channels that form a vector.

    Attributes:
        columns: The channels; a single one is an array with all of them.
        order: "wxyz" or "xyzw" for a quaternion.
        unit: "rad" or "deg" (a second) for a gyroscope; "m" or "mm" (a second) for a base.
        frame: Axes of a velocity, one of :data:`FRAMES`.
    """

    columns: tuple[str, ...]
    order: str = "wxyz"
    unit: str = "rad"
    frame: str = "world"

    def __post_init__(self) -> None:
        if self.order not in QUATERNION_ORDERS:
            raise UnknownNameError("order of a quaternion", self.order, QUATERNION_ORDERS)
        if self.frame not in FRAMES:
            raise UnknownNameError("frame of a velocity", self.frame, FRAMES)
        if self.unit not in POSITION_UNITS:
            raise UnknownNameError("unit of a vector", self.unit, POSITION_UNITS)


@dataclass(frozen=True, slots=True, kw_only=True)
class JointKinds:
    """What a model says of its joints.

    Attributes:
        slides: Those that slide; the others turn.
        motors: Those driven by a motor, each with its effort at its highest command [N or N·m].
        speeds: Those driven by a velocity servo, each with its effort an error of the speed [N·s/m or
            N·m·s/rad].
        followers: Those that need no reading, as an equality of the model moves them with others.
    """

    slides: frozenset[str] = frozenset()
    motors: Mapping[str, float] = field(default_factory=dict)
    speeds: Mapping[str, float] = field(default_factory=dict)
    followers: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnMap:
    """What the channels of a file mean.

    Attributes:
        time: Time of the measured samples; None: the channel with the name of a time, such as LeRobot's
            timestamp.
        joints: The joints, in the order of the file's arrays.
        position: Channel pattern: with ``{joint}`` one channel per joint, without it one array for all.
        target: The same for commanded positions.
        velocity: The same; None where there is none.
        effort: The same; None where there is none.
        command_time: Time of the commands if they have their own stamps.
        command_shift_s: Added to the stamps of the commands [s]: minus one period where each command is in
            the row after the one in which it was sent.
        orientation: Quaternion of the base.
        gyro: Angular velocity of the base in its own frame.
        base_position: Place of the base in the world: the origin of the free joint's body.
        base_velocity: Its velocity.
        source: Origin of the map: a file, or a guess.
    """

    time: TimeColumn | None
    joints: tuple[JointColumns, ...]
    position: str | None = None
    target: str | None = None
    velocity: str | None = None
    effort: str | None = None
    command_time: TimeColumn | None = None
    command_shift_s: float = 0.0
    orientation: Vector | None = None
    gyro: Vector | None = None
    base_position: Vector | None = None
    base_velocity: Vector | None = None
    source: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        names = [joint.name for joint in self.joints]
        if not 0 < len(names) <= NAMES or len(set(names)) != len(names):
            raise ConfigurationError(
                f"column map: joints {short(names)}; name each joint once, at least one and at most {NAMES}"
            )

    def for_model(self, kinds: JointKinds) -> ColumnMap:
        """Return the map with what a model says of its joints: which slide, and what their actuators take.

        Raises:
            ConfigurationError: A joint that slides has angles, or a motor's target is a position.
        """
        joints = []
        for joint in self.joints:
            slides = joint.name in kinds.slides or joint.slides
            unit = "m" if slides and joint.unit == "rad" else joint.unit
            motor, speed_gain = kinds.motors.get(joint.name), kinds.speeds.get(joint.name)
            joints.append(
                dataclasses.replace(joint, slides=slides, unit=unit, motor=motor, speed_gain=speed_gain)
            )
        return dataclasses.replace(self, joints=tuple(joints))


def read_column_map(path: Path) -> ColumnMap:
    """Read a column map.

    Raises:
        ConfigurationError: It cannot be read or has an entry that a column map cannot have.
    """
    described = f"{page('how-to/import.md')} describes it"
    with reading(path, "a column map", described, error=ConfigurationError):
        return parse_column_map(read_yaml(Path(path)), (f"column map {Path(path).name}",))


def parse_column_map(values: Any, source: tuple[str, ...] = ()) -> ColumnMap:
    """Return the column map in plain YAML values; errors as :func:`read_column_map`."""
    entries = {field.name for field in fields(ColumnMap)} - {"source"}
    top = _mapping("column map", values, entries | {"unit", "target_unit"})
    if "joints" not in top:
        raise ConfigurationError(
            f"column map: 'joints' is missing; it has {', '.join(sorted(top)) or 'nothing'}"
        )
    if not isinstance(top["joints"], list):
        raise ConfigurationError("column map: joints is a list of names or of mappings with a name")
    defaults = {name: str(top[name]) for name in ("unit", "target_unit") if top.get(name) is not None}
    command_time = top.get("command_time")
    patterns = {name: _text(name, top.get(name)) for name in _CHANNELS}
    return ColumnMap(
        time=None if top.get("time") is None else _time("time", top["time"]),
        command_time=None if command_time is None else _time("command_time", command_time),
        command_shift_s=number(
            top.get("command_shift_s", 0.0), "command_shift_s", -MOST_SHIFT_S, MOST_SHIFT_S
        ),
        joints=tuple(_joint(entry, defaults) for entry in top["joints"]),
        orientation=_vector("orientation", top.get("orientation"), 4),
        gyro=_vector("gyro", top.get("gyro"), 3),
        base_position=_vector("base_position", top.get("base_position"), 3, ("m", "mm")),
        base_velocity=_vector("base_velocity", top.get("base_velocity"), 3, ("m", "mm")),
        source=source,
        **patterns,
    )


def _mapping(what: str, values: Any, allowed: set[str]) -> dict[str, Any]:
    if not isinstance(values, dict):
        raise ConfigurationError(
            f"{what} is {shown(values)}, not a mapping; it has {', '.join(sorted(allowed))}"
        )
    for key in values:
        if key not in allowed:
            raise UnknownNameError(f"entry of {what}", str(key), sorted(allowed))
    return values


def _text(what: str, value: Any) -> str | None:
    if value is not None and not (isinstance(value, (str, int)) and len(str(value)) <= QUOTED):
        raise ConfigurationError(f"{what} is {shown(value)}; name a channel, or a pattern with {{joint}}")
    return None if value is None else str(value)


def _time(what: str, value: Any) -> TimeColumn:
    if isinstance(value, (str, int)):
        return TimeColumn(column=str(value))
    values = _mapping(what, value, {"column", "unit"})
    if "column" not in values:
        raise ConfigurationError(f"{what} names no column, such as {what}: {{column: timestamp, unit: us}}")
    return TimeColumn(column=str(values["column"]), unit=str(values.get("unit", "s")))


_CHANNELS = ("position", "target", "velocity", "effort")


def _joint(entry: Any, defaults: Mapping[str, str]) -> JointColumns:
    if isinstance(entry, (str, int)):
        entry = {"name": str(entry)}
    values = _mapping("joint", entry, {f.name for f in fields(JointColumns)} - {"motor", "speed_gain"})
    if "name" not in values:
        raise ConfigurationError(f"joint {shown(values)} has no name; give its name in the model")
    name = str(_text("name of a joint", values["name"]))
    index = values.get("index")
    if index is not None and (not isinstance(index, int) or index < 0):
        raise ConfigurationError(f"joint {name!r}: index {shown(index)} is not a column number, from 0")
    texts = {key: _text(f"joint {name!r}: {key}", values.get(key)) for key in _CHANNELS}
    settings: dict[str, Any] = {**defaults, **texts}
    settings.update({key: str(values[key]) for key in ("unit", "target_unit", "column") if key in values})
    for key in ("sign", "offset"):
        if key in values:
            settings[key] = number(values[key], f"joint {name!r}: {key}")
    for key in ("normalised", "target_normalised"):
        if values.get(key) is not None:
            settings[key] = _normalised(f"joint {name!r}: {key}", values[key])
    return JointColumns(name=name, index=index, slides=bool(values.get("slides", False)), **settings)


def _normalised(what: str, value: Any) -> Normalised:
    values = _mapping(what, value, {"from", "to"})
    pairs = []
    for key in ("from", "to"):
        pair = values.get(key)
        if not isinstance(pair, list) or len(pair) != 2:
            raise ConfigurationError(
                f"{what}: {key} is {shown(pair)}; give two numbers, such as {{from: [0, 1], to: [-0.2, 1.7]}}"
            )
        pairs.append((number(pair[0], what), number(pair[1], what)))
    return Normalised(file=pairs[0], robot=pairs[1])


def _vector(what: str, value: Any, size: int, units: tuple[str, ...] = ("rad", "deg")) -> Vector | None:
    if value is None:
        return None
    if isinstance(value, str):
        value = {"column": value}
    values = _mapping(what, value, {"column", "columns", "order", "unit", "frame"})
    columns: Sequence[Any] = values.get("columns") or [values.get("column")]
    if len(columns) not in (1, size) or any(not isinstance(name, (str, int)) for name in columns):
        raise ConfigurationError(f"{what}: name {size} columns, or one array of {size}")
    unit = str(values.get("unit", units[0])).removesuffix("/s")
    if unit not in units:
        raise UnknownNameError(f"unit of {what}", unit, units)
    return Vector(
        columns=tuple(map(str, columns)),
        order=str(values.get("order", "wxyz")),
        unit=unit,
        frame=str(values.get("frame", "world")),
    )
