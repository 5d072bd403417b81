"""The kinds of a verb that takes a robot: those with settings of their own, plug-ins, and a robot.yaml."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from deal_hw.errors import DealHwError
from deal_hw.robots import (
    driven_entry,
    driven_robots,
    driver_description,
    has_hardware,
    is_file,
    robot_entry,
    robots,
)
from deal_hw.robots.file_robot import robot_yaml
from deal_hw.workflows.kinds import Arguments, InputKind, Kinds, KindTable

FILE = "robot.yaml"
"""The kind of a robot.yaml, and of a dataset that carries its robot."""
SIMULATED = "simulated"
"""The kind of the same in simulation."""


PORTS: Final[Mapping[str, str]] = MappingProxyType(
    {"serial": "/dev/ttyUSB0", "can": "can0", "dds": "enp2s0", "zenoh": "tcp/192.168.1.20:7447"}
)
"""Ports in examples, by transport."""


def robot_kinds(
    own: Mapping[str, type[Any]],
    *,
    plain: type[Any],
    legged: type[Any],
    simulated: type[Any] | None = None,
    nothing: type[Any] | None = None,
    example: str,
    simulated_example: str = "",
) -> Kinds:
    """Return the kinds of a verb whose first argument is a robot.

    Args:
        own: Robots with settings of their own -> the settings; those of a machine hold for all its robots.
        plain: Settings of another robot, such as one of a plug-in or of a robot.yaml with hardware.
        legged: Those of another robot with legs.
        simulated: Those of a robot.yaml in simulation; None where the verb does not simulate.
        nothing: Settings without a robot; None where the verb needs one.
        example: Options in the example of a robot; ``{port}`` becomes a port of its usual wire.
        simulated_example: Options in the example of a simulation.
    """
    others: dict[str, InputKind] = {} if nothing is None else {"": InputKind(nothing, example="")}
    others[FILE] = InputKind(plain, example=f"{FILE} {example.format(port=PORTS['serial'])}")
    if simulated is not None:
        usage, shown = f"{FILE} --simulated", f"{FILE} {simulated_example}"
        others[SIMULATED] = InputKind(simulated, usage=usage, example=shown)

    def names() -> tuple[str, ...]:
        return (*[""] * ("" in others), *driven_robots(), *(name for name in others if name))

    def make(name: str) -> InputKind | None:
        if name in others:
            return others[name]
        entry = robots().find(name)
        if entry is None or not entry.driven:
            return None
        # The same machine on the floor and on a stand has the same options.
        settings = own.get(name) or own.get(entry.machine)
        settings = settings or (plain if plain is legged or not has_legs(name) else legged)
        return InputKind(settings, example=f"{name} {example.format(port=usual_port(name))}")

    def table() -> Mapping[str, InputKind]:
        return KindTable(names, make)

    def find(arguments: Arguments) -> str:
        name = "" if arguments.first is None else str(arguments.first)
        return robot_kind(name, arguments.options, simulated is not None)

    return Kinds(noun="robot", argument="robot", table=table, find=find)


def robot_kind(name: str, options: Mapping[str, Any], simulates: bool) -> str:
    """Return the kind of a robot.

    Args:
        name: The robot: a name, a robot.yaml, or a dataset; empty if none is given.
        options: What was given beside it.
        simulates: Whether the verb may simulate a robot.yaml.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver.
    """
    if is_file(name):
        if simulates and ("simulated" in options or "simulation" in options):
            return SIMULATED
        if not robot_yaml(name).is_file() or has_hardware(name):
            return FILE
        if simulates and "port" not in options:
            return SIMULATED
        # Why it cannot be driven, or what is wrong with the file.
        driver_description(name)
        return FILE
    if name:
        driven_entry(name)
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
