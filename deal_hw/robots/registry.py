"""The one table of robots, and that of transports: built-in entries, and those of installed plug-ins.

A plug-in is a distribution with an entry point in the group ``deal_hw.robots`` or ``deal_hw.transports``: its
name is the robot's or the transport's, its value ``module:ENTRY`` leads to a :class:`RobotEntry` or a
:class:`TransportEntry`. A plug-in that cannot be used is one line of text, and all others go on working.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from deal_hw.errors import ConfigurationError, UnknownNameError, short
from deal_hw.robots import built_in
from deal_hw.robots.entry import API_VERSION, RobotEntry, TransportEntry, WireEntry
from deal_hw.robots.file_robot import file_entry, is_robot_file, machine_of, no_driver

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from deal_hw.description import RobotDescription
    from deal_hw.motions.scores.balance import BalanceResult
    from deal_hw.motions.scores.velocity_error import Track
    from deal_hw.parameters import ParameterSpace
    from deal_hw.policies.tasks import TrainingTask
    from deal_hw.types import Trajectory

ROBOT_GROUP: Final = "deal_hw.robots"
TRANSPORT_GROUP: Final = "deal_hw.transports"

EntryT = TypeVar("EntryT", bound=RobotEntry | TransportEntry)


@dataclass(frozen=True, slots=True)
class PlugIn:
    """An installed plug-in.

    Attributes:
        kind: "robot" or "transport".
        name: The name of its entry point.
        origin: Its distribution and version.
        problem: Why it is left out, as one line; "" if it can be used.
    """

    kind: str
    name: str
    origin: str
    problem: str


class Registry(Generic[EntryT]):
    """A table of entries by name.

    Args:
        kind: "robot" or "transport".
        group: The group of entry points.
        entry: The entries' class.
        own: The built-in entries.
    """

    def __init__(self, kind: str, group: str, entry: type[EntryT], own: Iterable[EntryT]) -> None:
        self._kind, self._group, self._class = kind, group, entry
        self._own: dict[str, EntryT] = {one.name: one for one in own}
        self._points: list[EntryPoint] | None = None
        self._loaded: dict[int, EntryT | str] = {}

    def __contains__(self, name: str) -> bool:
        """Whether there is an entry of that name; plug-ins are listed only if none of deal-hw's has it."""
        return name in self._own or name in self.names()

    def find(self, name: str) -> EntryT | None:
        """Return an entry; None if there is none of that name. A plug-in is loaded only if it is named.

        Raises:
            ConfigurationError: It is a plug-in's that cannot be used.
        """
        if name in self._own:
            return self._own[name]
        for number, point in enumerate(self._entry_points()):
            if point.name == name:
                found = self._load(number)
                if isinstance(found, str):
                    raise ConfigurationError(found)
                return found
        return None

    def named(self, name: str) -> EntryT:
        """Return an entry.

        Raises:
            UnknownNameError: There is none of that name.
            ConfigurationError: It is a plug-in's that cannot be used.
        """
        found = self.find(name)
        if found is None:
            raise UnknownNameError(self._kind, name, self.names())
        return found

    def names(self) -> tuple[str, ...]:
        """Return all names, the built-in ones first; no plug-in is loaded."""
        return (*self._own, *dict.fromkeys(p.name for p in self._entry_points() if p.name not in self._own))

    def entries(self) -> tuple[EntryT, ...]:
        """Return all entries that can be used, the built-in ones first."""
        found = list(self._own.values())
        for number in range(len(self._entry_points())):
            entry = self._load(number)
            if not isinstance(entry, str):
                found.append(entry)
        return tuple(found)

    def plug_ins(self) -> tuple[PlugIn, ...]:
        """Return the installed plug-ins, and why those are left out that cannot be used."""
        return tuple(
            PlugIn(self._kind, point.name, _origin(point), found if isinstance(found, str) else "")
            for number, point in enumerate(self._entry_points())
            for found in [self._load(number)]
        )

    def _entry_points(self) -> list[EntryPoint]:
        if self._points is None:
            from importlib.metadata import entry_points

            # Of two plug-ins with one name the first by distribution counts, on every computer the same.
            self._points = sorted(
                entry_points(group=self._group), key=lambda point: (point.name, _origin(point))
            )
        return self._points

    def _load(self, number: int) -> EntryT | str:
        """Return a plug-in's entry, or why it cannot be used."""
        if number not in self._loaded:
            point = self._entry_points()[number]
            found = self._checked(number, point)
            if isinstance(found, str):
                found = short(
                    f"plug-in {self._kind} {point.name!r} ({_origin(point)}) is left out: {found}", 600
                )
            self._loaded[number] = found
        return self._loaded[number]

    def _checked(self, number: int, point: EntryPoint) -> EntryT | str:
        if point.name in self._own:
            return f"deal-hw has a {self._kind} of this name; the plug-in must choose another"
        if number and (before := self._entry_points()[number - 1]).name == point.name:
            return f"{_origin(before)} has a {self._kind} of this name; uninstall one of the two"
        try:
            entry: Any = point.load()
        except Exception as error:
            # Whatever the code of others raises must not stop the other robots.
            return f"{point.value} cannot be imported: {type(error).__name__}: {error}"
        version = getattr(entry, "api_version", None)
        if version != API_VERSION:
            return (
                f"its entry declares API version {version}, and this deal-hw has version {API_VERSION}; "
                "install versions of the two that fit"
            )
        if not isinstance(entry, self._class):
            return f"{point.value} is a {type(entry).__name__}, expected a {self._class.__name__}"
        if entry.name != point.name:
            return f"its entry has the name {entry.name!r}; give both the same"
        return replace(entry, origin=_origin(point))


def _origin(point: EntryPoint) -> str:
    """Return name and version of the distribution that an entry point comes from."""
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else "no distribution"


@functools.cache
def robots() -> Registry[RobotEntry]:
    """Return the table of robots."""
    return Registry("robot", ROBOT_GROUP, RobotEntry, built_in.ROBOTS)


@functools.cache
def transports() -> Registry[TransportEntry]:
    """Return the table of transports."""
    return Registry("transport", TRANSPORT_GROUP, TransportEntry, built_in.TRANSPORTS)


def plug_ins() -> tuple[PlugIn, ...]:
    """Return all installed plug-ins."""
    return (*robots().plug_ins(), *transports().plug_ins())


def is_known(name: str) -> bool:
    """Return whether a name is that of a robot in the table."""
    return name in robots()


def robot_entry(name: str) -> RobotEntry:
    """Return a robot's entry: from the table, or made of a robot.yaml.

    Args:
        name: Its name; or the path of a robot.yaml, or of a dataset with one.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It is a plug-in's that cannot be used, or a robot.yaml that cannot be read.
    """
    return file_entry(name) if is_file(name) else robots().named(name)


def driven_entry(name: str) -> RobotEntry:
    """Return the entry of a robot with a driver; the name as in :func:`robot_entry`.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver; or it is a plug-in's that cannot be used.
    """
    if is_file(name):
        entry = file_entry(name)
        if not entry.driven:
            raise ConfigurationError(no_driver(name))
        return entry
    found = robots().find(name)
    if found is None:
        raise UnknownNameError("robot", name, driven_robots())
    if not found.driven:
        raise ConfigurationError(
            f"robot {name!r} can be simulated and calibrated from recordings, but has no driver yet; "
            f"robots that can be driven: {', '.join(driven_robots())}"
        )
    return found


def driven_robots() -> tuple[str, ...]:
    """Return the names of the robots with a driver."""
    return tuple(entry.name for entry in robots().entries() if entry.driven)


def emulated_robots() -> tuple[str, ...]:
    """Return the names of the robots with an emulator."""
    return tuple(entry.name for entry in robots().entries() if entry.emulated_on)


def transport_entry(name: str) -> TransportEntry:
    """Return a transport's entry.

    Raises:
        UnknownNameError: There is no such transport.
        ConfigurationError: It is a plug-in's that cannot be used.
    """
    return transports().named(name)


def transport_of(wire: str) -> TransportEntry:
    """Return the transport that carries a wire: the one of that name, or that of the robots' wire.

    Raises:
        UnknownNameError: There is no such wire.
    """
    found = transports().find(wire)
    if found is not None:
        return found
    for one in wires():
        if one.name == wire:
            return transport_entry(one.transport)
    raise UnknownNameError(
        "transport", wire, dict.fromkeys((*transports().names(), *(w.name for w in wires())))
    )


def wires() -> tuple[WireEntry, ...]:
    """Return the wires of all robots."""
    return tuple(wire for entry in robots().entries() for wire in entry.wires)


def driver_description(name: str) -> RobotDescription:
    """Return the facts about a robot in its driver, with the rates of its real wire.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver.
    """
    return driven_entry(name).driver_description()


def recorded_description(name: str) -> RobotDescription:
    """Return the facts under which a robot's recordings were made: its driver's, where it has one.

    Raises:
        UnknownNameError: There is no such robot.
    """
    return robot_entry(name).recorded_description()


def robot_description(name: str) -> RobotDescription:
    """Return the facts about a robot, whether it has a driver or not.

    Raises:
        UnknownNameError: There is no such robot.
        MissingExtraError: The package that carries the robot's model is not installed.
    """
    return robot_entry(name).model_description()


def parameter_spaces(name: str) -> Mapping[str, Callable[[], ParameterSpace]]:
    """Return a robot's parameter sets by name; the first is the default.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: A plug-in's robot has none.
    """
    return robot_entry(name).parameter_spaces()


def default_space(name: str) -> ParameterSpace:
    """Return a robot's usual parameter set. Raises as :func:`parameter_spaces`."""
    return next(iter(parameter_spaces(name).values()))()


def default_transport(name: str) -> str:
    """Return the transport that usually reaches a robot.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver.
    """
    return driven_entry(name).wires[0].name


def same_machine(one: str, other: str) -> bool:
    """Return whether two names are entries of one machine: a Go2 on a stand is a Go2.

    A name may be that of a robot which is not installed any more, as in the note of a run.
    """
    return _machine(one) == _machine(other)


def walked(name: str, trajectory: Trajectory) -> Track | None:
    """Return a robot's path by its own sensors; None if it does not walk or has no odometry."""
    entry = robot_entry(name)
    found: Track | None = entry.load(entry.odometry)(trajectory) if entry.odometry else None
    return found


def balanced(name: str, trajectory: Trajectory) -> BalanceResult | None:
    """Return how well a robot's pole was held up; None without a pole, or without a duration."""
    entry = robot_entry(name)
    found: BalanceResult | None = entry.load(entry.balance)(trajectory) if entry.balance else None
    return found


def training_task(name: str, task: str = "") -> TrainingTask:
    """Return a robot's training task.

    Args:
        name: The robot.
        task: The name of one of its further tasks; "" for its usual one.

    Raises:
        UnknownNameError: There is none; the message lists the robots, or the robot's further tasks.
    """
    if not has_task(name):
        raise UnknownNameError("robot with a training environment", name, trained_robots())
    entry = robot_entry(name)
    if task and task not in entry.tasks:
        raise UnknownNameError(f"task of robot {name!r}", task, tuple(entry.tasks))
    found: TrainingTask = entry.load(entry.tasks[task] if task else entry.task)
    return found


def has_task(name: str) -> bool:
    """Return whether a robot has a training task."""
    return is_known(name) and bool(robot_entry(name).task)


def trained_robots() -> tuple[str, ...]:
    """Return the names of the robots with a training task."""
    return tuple(sorted(entry.name for entry in robots().entries() if entry.task))


def is_file(name: str) -> bool:
    """Return whether a name is the path of a robot.yaml or a dataset, and none of the table."""
    return is_robot_file(name, is_known)


def _machine(name: str) -> str:
    if is_file(name):
        # The file may be gone: a run's note keeps its path.
        return machine_of(name)
    return (robot_entry(name).machine if is_known(name) else "") or name
