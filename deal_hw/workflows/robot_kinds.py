"""The kinds of a verb that takes a robot: those with settings of their own, plug-ins, and a robot.yaml."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from deal_hw.errors import ConfigurationError, DealHwError
from deal_hw.robots import driven_robots, driver_description, robot_entry
from deal_hw.workflows.kinds import Arguments, InputKind, Kinds
from deal_hw.workflows.robot import is_user_robot

FILE = "robot.yaml"
"""The kind of a robot.yaml, and of a dataset that carries its robot."""


PORTS: Final[Mapping[str, str]] = MappingProxyType(
    {"serial": "/dev/ttyUSB0", "can": "can0", "dds": "enp2s0", "zenoh": "tcp/192.168.1.20:7447"}
)
"""Ports in examples, by transport."""

NO_DRIVER = (
    "deal-hw has no driver for this robot; record its simulation with --simulated, or import recordings of "
    "it: deal-hw data import"
)


def robot_kinds(
    own: Mapping[str, type[Any]],
    *,
    plain: type[Any],
    legged: type[Any],
    file: type[Any] | None = None,
    no_file: str = "",
    nothing: type[Any] | None = None,
    example: str,
    file_example: str = "",
) -> Kinds:
    """Return the kinds of a verb whose first argument is a robot.

    Args:
        own: Robots with settings of their own -> the settings; those of a machine hold for all its robots.
        plain: Settings of another robot, such as one of a plug-in.
        legged: Those of another robot with legs.
        file: Those of a robot.yaml; None where the verb takes none.
        no_file: What such a robot is told then, behind "deal-hw has no driver for this robot".
        nothing: Settings without a robot; None where the verb needs one.
        example: Options in the example of a robot; ``{port}`` becomes a port of its usual wire.
        file_example: Options in the example of a robot.yaml.
    """

    def table() -> Mapping[str, InputKind]:
        found = {} if nothing is None else {"": InputKind(nothing, example="")}
        for name in driven_robots():
            # The same machine on the floor and on a stand has the same options.
            settings = own.get(name) or own.get(robot_entry(name).machine)
            settings = settings or (legged if has_legs(name) else plain)
            found[name] = InputKind(settings, example=f"{name} {example.format(port=usual_port(name))}")
        return found if file is None else {**found, FILE: InputKind(file, example=f"{FILE} {file_example}")}

    def find(arguments: Arguments) -> str:
        if file is not None and "port" in arguments.options and is_user_robot(str(arguments.first or "")):
            raise ConfigurationError(f"{arguments.first}: {NO_DRIVER}")
        return robot_kind("" if arguments.first is None else str(arguments.first), file is not None, no_file)

    return Kinds(noun="robot", argument="robot", table=table, find=find)


def robot_kind(name: str, files: bool, no_file: str = "") -> str:
    """Return the kind of a robot.

    Args:
        name: The robot: a name, a robot.yaml, or a dataset; empty if none is given.
        files: Whether the verb takes a robot.yaml.
        no_file: See :func:`robot_kinds`.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver; or it is a file that the verb does not take.
    """
    if is_user_robot(name):
        if not files:
            raise ConfigurationError(f"{name}: deal-hw has no driver for this robot{no_file}")
        return FILE
    if name and name not in driven_robots():
        driver_description(name)
    return name


def usual_port(name: str) -> str:
    """Return how a port of a robot may look, for examples."""
    return PORTS.get(robot_entry(name).wires[0].transport, "PORT")


def has_legs(name: str) -> bool:
    """Return whether a robot has a rest pose, from which it stands up."""
    try:
        return bool(driver_description(name).rest_position)
    except DealHwError:
        # A plug-in that cannot be imported is reported where it is used.
        return False
