"""Set-ups of a robot: recordings with a payload, other gains or another MJCF, fitted together.

A file, mostly setups.yaml, says which recordings were made with which change of the robot. Each recording is
simulated with its own set-up; a parameter has one value in all of them. docs/reference/setups.md describes
the file.
"""

from __future__ import annotations

import dataclasses
import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.documentation import page
from deal_hw.errors import ConfigurationError, short, shown
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.physical import check_amount
from deal_hw.reading import YAML_BYTES, number, parse_yaml, read_bytes, reading
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.engine.model import RobotModel, actuator_of
from deal_hw.sim.parameters import KIND_TABLE, check_space
from deal_hw.sim.parameters.fields import ELEMENTS, element_id, element_names, unknown_name
from deal_hw.sim.parameters.one_drive import gather
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.own_setups import OWN, recording_of

FILE: Final = "setups.yaml"
"""Name of the file in a dataset's folder."""
BASE: Final = "model"
"""Name of the robot as its MJCF has it: recordings of no set-up."""

_KEYS: Final = ("recordings", "mjcf", "payload", "stiffness", "damping", "encoder_bias")
_PAYLOAD_KEYS: Final = ("body", "name", "at", "mass", "range", "radius")
_GAINS: Final = ("stiffness", "damping")
_WIDER_UNIT: Final = {"stiffness": "N/m", "damping": "N·s/m", "encoder_bias": "rad"}
"""Of a hinge's and a slide's unit that with the wider bound: a pattern may name both."""
_RADIUS_M: Final = 0.02
_RANGE_KG: Final = (0.001, 5.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Payload:
    """A ball that is fixed to a body.

    Attributes:
        body: The body that carries it.
        name: Its name, and that of its body in the model.
        at: Its centre in the carrier's frame [m].
        mass: [kg]; None: it is searched.
        range: Range of the search [kg].
        radius: Radius, for its inertia [m].
    """

    body: str
    name: str = "payload"
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mass: float | None = None
    range: tuple[float, float] = _RANGE_KG
    radius: float = _RADIUS_M

    @property
    def modelled_kg(self) -> float:
        """Mass in the model [kg]: the known one, or the centre of the range on a log scale."""
        return float(np.sqrt(self.range[0] * self.range[1])) if self.mass is None else self.mass

    @property
    def parameter(self) -> Parameter:
        """Its mass as a parameter."""
        return Parameter(
            name=f"{self.name}.mass",
            kind="body_mass",
            elements=(self.name,),
            unit="kg",
            nominal=self.modelled_kg,
            low=self.range[0],
            high=self.range[1],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """One set-up.

    Attributes:
        name: Its name.
        recordings: Names of its recordings, or patterns with `*`.
        mjcf: Its own MJCF, with the same joints and actuators; None: the robot's.
        payload: What it carries.
        stiffness: Gains that the host or the servo had, by actuated joint or pattern; others are the
            recordings' own.
        damping: Likewise.
        encoder_bias: Largest offset of a joint's zero in these recordings, by joint or pattern [rad or m]:
            such joints get a bias of their own here, which is searched to both sides.
    """

    name: str
    recordings: tuple[str, ...]
    mjcf: Path | None = None
    payload: tuple[Payload, ...] = ()
    stiffness: Mapping[str, float] = field(default_factory=dict)
    damping: Mapping[str, float] = field(default_factory=dict)
    encoder_bias: Mapping[str, float] = field(default_factory=dict)

    def biases(self, description: RobotDescription) -> list[Parameter]:
        """Return the searched zeros of its recordings."""
        found = dict[str, Parameter]()
        for pattern, most in self.encoder_bias.items():
            for joint, unit in zip(description.joint_names, description.position_units, strict=True):
                if fnmatch.fnmatchcase(joint, pattern):
                    found[joint] = Parameter.encoder_bias(joint, most, unit=unit, setup=self.name)
        return list(found.values())


@dataclass(frozen=True, slots=True)
class Setups:
    """The set-ups of a calibration.

    Attributes:
        setups: By name.
        source: The file, for messages.
    """

    setups: Mapping[str, Setup]
    source: str

    def parameters(self, description: RobotDescription) -> tuple[Parameter, ...]:
        """Return the unknown payload masses, each once, and the zeros of single set-ups."""
        found = {p.name: p for s in self.setups.values() for p in s.payload if p.mass is None}
        biases = [p for s in self.setups.values() for p in s.biases(description)]
        return (*(payload.parameter for payload in found.values()), *biases)

    def of(self, recording: str) -> str:
        """Return the name of a recording's set-up; "" for none.

        Args:
            recording: Its name: a file's, an episode's number, or one with its part.

        Raises:
            ConfigurationError: Two set-ups claim it.
        """
        names = _names_of(recording)
        found = [s.name for s in self.setups.values() if any(_match(p, names) for p in s.recordings)]
        if len(found) > 1:
            raise ConfigurationError(
                f"{self.source}: set-ups {' and '.join(found)} both claim recording {recording}; a recording "
                "was made with one set-up: name it in one `recordings` only"
            )
        return found[0] if found else ""

    def robot(self, robot: RobotModel, space: ParameterSpace) -> RobotModel:
        """Return the robot with the model of every set-up.

        Args:
            robot: The robot.
            space: The parameters; they are checked against all models.

        Raises:
            ConfigurationError: A set-up has other joints, carries something on a body that does not exist, or
                changes what a parameter sets for all recordings.
        """
        models = {name: self._model(setup, robot) for name, setup in self.setups.items()}
        for name, model in models.items():
            self._check(name, robot.model, model, space)
        own = {name: _elements(model) for name, model in models.items()}
        base = _elements(robot.model)
        every = base.union(*own.values())
        return dataclasses.replace(
            robot,
            setups={name: _robot_of(robot, name, model, every - own[name]) for name, model in models.items()},
            absent=every - base,
        )

    def with_gains(self, episode: SampledEpisode, robot: RobotModel) -> SampledEpisode:
        """Return a recording marked with its set-up, with the gains of that."""
        name = self.of(episode.name)
        if not name:
            return episode
        setup, joints = self.setups[name], robot.description.actuated
        changed: dict[str, Any] = {}
        for gain in _GAINS:
            values = getattr(episode, gain).copy()
            for pattern, value in getattr(setup, gain).items():
                values[:, [i for i, joint in enumerate(joints) if fnmatch.fnmatchcase(joint, pattern)]] = (
                    value
                )
            changed[gain] = values
        return dataclasses.replace(episode, setup=name, **changed)

    def check_used(self, recordings: Sequence[str], description: RobotDescription) -> None:
        """Check that every set-up has a recording, and that its gains are those of servos.

        Args:
            recordings: Names of all recordings.
            description: The robot.

        Raises:
            ConfigurationError: A set-up has no recording, two claim one, or a gain names no servo.
        """
        used, joints = {self.of(name) for name in recordings}, description.actuated
        for setup in self.setups.values():
            if setup.name not in used:
                raise ConfigurationError(
                    f"{self.source}: no recording belongs to set-up {setup.name!r} "
                    f"(recordings: {', '.join(setup.recordings)}); there are "
                    f"{short(', '.join(dict.fromkeys(recordings)))}"
                )
            if description.actuation != "position" and (setup.stiffness or setup.damping):
                raise ConfigurationError(
                    f"{self.source}, set-up {setup.name!r}: motors that take efforts have no gains; remove "
                    "`stiffness` and `damping`"
                )
            given = [(p, joints) for p in (*setup.stiffness, *setup.damping)]
            given += [(p, description.joint_names) for p in setup.encoder_bias]
            for pattern, known in given:
                if not any(fnmatch.fnmatchcase(joint, pattern) for joint in known):
                    error = unknown_name("joint", pattern, known)
                    error.args = (f"{self.source}, set-up {setup.name!r}: {error}",)
                    raise error

    def _model(self, setup: Setup, robot: RobotModel) -> mujoco.MjModel:
        path = robot.description.mjcf if setup.mjcf is None else setup.mjcf
        if setup.mjcf is not None:
            compile_mjcf(path)
        spec = mujoco.MjSpec.from_file(str(path))
        for payload in setup.payload:
            carrier = spec.body(payload.body)
            if carrier is None or payload.body == "world":
                names = [name for name in element_names(robot.model, "body") if name not in ("", "world")]
                error = unknown_name("body", payload.body, names)
                error.args = (f"{self.source}, payload of set-up {setup.name!r}: {error}",)
                raise error
            if spec.body(payload.name) is not None:
                raise ConfigurationError(
                    f"{self.source}, set-up {setup.name!r}: the model has a body {payload.name!r} already; "
                    "give the payload another `name`"
                )
            mass = payload.modelled_kg
            ball = carrier.add_body(name=payload.name, pos=payload.at)
            ball.mass, ball.explicitinertial = mass, True
            ball.ipos, ball.inertia = [0, 0, 0], [0.4 * mass * payload.radius**2] * 3
        model = spec.compile()
        gather(model)
        model.opt.timestep = robot.step_s
        return model

    def _check(self, name: str, base: Any, model: Any, space: ParameterSpace) -> None:
        for p in space.parameters:
            kind = KIND_TABLE[p.kind]
            if kind.baseline is None:
                continue
            both = set(element_names(base, kind.element)) & set(element_names(model, kind.element))
            for element in both & set(p.elements):
                here, there = (kind.baseline(m, element_id(m, kind.element, element)) for m in (base, model))
                if not np.isclose(here, there, rtol=1e-6, atol=1e-12):
                    raise ConfigurationError(
                        f"{self.source}: set-up {name!r} has another {p.kind} of {element!r} ({there:g} "
                        f"{p.unit}) than the model ({here:g} {p.unit}), but parameter {p.name!r} sets one "
                        f"value for all recordings. Give {element!r} another name in the MJCF of {name!r}, "
                        f"or remove the parameter"
                    )


def read_setups(path: Path) -> Setups:
    """Return the set-ups of a file.

    Raises:
        ConfigurationError: It cannot be used; the message names the entry and what to write instead.
    """
    described = f"{page('reference/setups.md')} describes it"
    with reading(path, "set-ups", described, error=ConfigurationError):
        text = read_bytes(path, YAML_BYTES).decode("utf-8")
    return parse_setups(text, source=str(path), folder=path.parent)


def parse_setups(text: str, source: str = FILE, folder: Path = Path()) -> Setups:
    """Return the set-ups of YAML text; see :func:`read_setups`.

    Args:
        text: The YAML text.
        source: Name of the text in messages.
        folder: Folder of the MJCF files that it names.
    """
    with reading(source, "YAML", error=ConfigurationError):
        content = parse_yaml(text)
    if not isinstance(content, Mapping) or list(content) != ["setups"]:
        raise ConfigurationError(f"{source} must hold one key, `setups`, with a mapping of names to set-ups")
    entries = content["setups"]
    if not isinstance(entries, Mapping) or not entries:
        raise ConfigurationError(f"{source}: `setups` must have at least one name with its set-up")
    found: dict[str, Setup] = {}
    for name, entry in entries.items():
        if str(name).startswith(OWN):
            raise ConfigurationError(f"{source}: set-up {str(name)!r}: a name must not begin with {OWN!r}")
        try:
            found[str(name)] = _setup(str(name), entry, folder)
        except ConfigurationError as err:
            err.args = (f"{source}, set-up {str(name)!r}: {err}",)
            raise
    _check_payloads(found, source)
    return Setups(found, source)


def _setup(name: str, entry: Any, folder: Path) -> Setup:
    entry = _mapping(entry, _KEYS, "a set-up")
    recordings = entry.get("recordings")
    listed = [recordings] if isinstance(recordings, str | int) else recordings
    if not isinstance(listed, Sequence) or not listed or not all(isinstance(x, str | int) for x in listed):
        raise ConfigurationError(
            "`recordings` must name the recordings of this set-up: a file, an episode's number, a pattern "
            f"such as 'loaded_*', or a list of them; got {shown(recordings)}"
        )
    mjcf = entry.get("mjcf")
    if mjcf is not None and not isinstance(mjcf, str):
        raise ConfigurationError(f"`mjcf` must be a path, got {shown(mjcf)}")
    payload = entry.get("payload", [])
    return Setup(
        name=name,
        recordings=tuple(map(str, listed)),
        mjcf=None if mjcf is None else folder / mjcf,
        payload=tuple(map(_payload, payload if isinstance(payload, list) else [payload])),
        **{key: _gains(entry.get(key, {}), key) for key in (*_GAINS, "encoder_bias")},
    )


def _payload(entry: Any) -> Payload:
    entry = _mapping(entry, _PAYLOAD_KEYS, "a payload")
    if not isinstance(entry.get("body"), str):
        raise ConfigurationError(
            f"a payload needs the `body` that carries it, got {shown(entry.get('body'))}"
        )
    if "mass" in entry and "range" in entry:
        raise ConfigurationError("a payload has a known `mass`, or a `range` to search it in; give one")
    low, high = _floats(entry.get("range", list(_RANGE_KG)), 2, "range")
    mass = None if entry.get("mass") is None else number(entry["mass"], "payload's mass")
    for kg in (high, mass or 0.0):
        check_amount("payload's mass", kg, "kg")
    if not (0 < low < high and (mass is None or mass > 0)):
        raise ConfigurationError(
            "a payload's mass is above 0 kg, and its range begins with the lower value; for a recording "
            "without payload leave `payload` out"
        )
    radius = number(entry.get("radius", _RADIUS_M), "payload's radius")
    check_amount("payload's radius", radius, "m")
    if not radius > 0:
        raise ConfigurationError(f"a payload's radius is above 0 m, got {radius:g}")
    x, y, z = _floats(entry.get("at", [0.0, 0.0, 0.0]), 3, "at")
    for metres in (x, y, z):
        check_amount("payload's at", metres, "m")
    return Payload(
        body=entry["body"],
        name=str(entry.get("name", "payload")),
        at=(x, y, z),
        mass=mass,
        range=(low, high),
        radius=radius,
    )


def _check_payloads(setups: Mapping[str, Setup], source: str) -> None:
    """Check that a payload of one name is the same thing in all set-ups."""
    first: dict[str, tuple[str, Payload]] = {}
    for setup in setups.values():
        for payload in setup.payload:
            where, known = first.setdefault(payload.name, (setup.name, payload))
            for what in ("mass", "range", "radius"):
                if getattr(payload, what) != getattr(known, what):
                    raise ConfigurationError(
                        f"{source}: payload {payload.name!r} has another {what} in set-up {setup.name!r} "
                        f"({getattr(payload, what)}) than in {where!r} ({getattr(known, what)}); give "
                        "different things different names (`name`), or write the same"
                    )


def _elements(model: mujoco.MjModel) -> frozenset[tuple[str, str]]:
    return frozenset((kind, name) for kind in ELEMENTS for name in element_names(model, kind))


def _robot_of(
    robot: RobotModel, name: str, model: mujoco.MjModel, absent: frozenset[tuple[str, str]]
) -> RobotModel:
    """Return the robot with another model of the same joints and actuators."""
    description = robot.description
    joints = [element_id(model, "joint", name) for name in description.joint_names]
    actuator = tuple(actuator_of(model, name) for name in description.actuated)
    base = robot.base
    if description.floating_base is not None:
        free = element_id(model, "joint", description.floating_base)
        base = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
    return dataclasses.replace(
        robot,
        model=model,
        qpos=tuple(int(model.jnt_qposadr[j]) for j in joints),
        qvel=tuple(int(model.jnt_dofadr[j]) for j in joints),
        actuator=actuator,
        base=base,
        setups={},
        absent=absent,
        own=frozenset({name}),
    )


def with_setups(space: ParameterSpace, robot: RobotModel, setups: Setups) -> ParameterSpace:
    """Return the parameters with the unknown payload masses beside them.

    Raises:
        ConfigurationError: A parameter has no element in any set-up.
    """
    found = ParameterSpace([*space.parameters, *setups.parameters(robot.description)])
    for name, variant in robot.setups.items():
        part = ParameterSpace(p for p in variant.acting(found).parameters if p.elements)
        try:
            check_space(variant.model, part)
        except ConfigurationError as err:
            err.args = (f"{setups.source}, set-up {name!r}: {err}",)
            raise
    return found


def _names_of(recording: str) -> tuple[str, ...]:
    """Return the names by which a recording may be called: its file's, its stem, an episode's number."""
    file = recording_of(recording)
    stem = Path(file).stem
    number_of = (str(int(stem)),) if stem.isdigit() else ()
    return (recording, file, Path(file).name, stem, *number_of)


def _match(pattern: str, names: Sequence[str]) -> bool:
    return any(name == pattern or fnmatch.fnmatchcase(name, pattern) for name in names)


def _mapping(value: Any, keys: Sequence[str], what: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigurationError(f"{what} must have keys ({', '.join(keys)}), got {shown(value)}")
    for key in value:
        if key not in keys:
            raise unknown_name("key", str(key), keys)
    return value


def _gains(value: Any, what: str) -> dict[str, float]:
    if not isinstance(value, Mapping):
        raise ConfigurationError(
            f"`{what}` must have a value for each joint or pattern, such as {{'*': 12}}; got {shown(value)}"
        )
    found = {str(name): number(gain, f"{what} of {name}") for name, gain in value.items()}
    if any(gain < 0 for gain in found.values()):
        raise ConfigurationError(f"`{what}` has a value below 0: {shown(dict(value))}")
    for name, gain in found.items():
        check_amount(f"{what} of {name}", gain, _WIDER_UNIT[what])
    return found


def _floats(value: Any, count: int, what: str) -> tuple[float, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != count:
        raise ConfigurationError(f"`{what}` must be a list of {count} numbers, got {shown(value)}")
    return tuple(number(one, what) for one in value)
