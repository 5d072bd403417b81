"""Entries of the tables of robots and transports: plain facts, and references that are imported on use.

An entry says where each part of a robot is, and loads nothing. So naming a robot loads its driver alone, and
a table of many robots costs nothing: not even numpy is loaded, so that ``deal-hw stop`` acts at once. A
reference is text, ``"module:attribute"``, or a function without arguments that returns the object (for a
robot that a file describes).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from deal_hw.errors import ConfigurationError, DealHwError, UnknownNameError

if TYPE_CHECKING:
    from deal_hw.description import RobotDescription
    from deal_hw.parameters import ParameterSpace

API_VERSION: Final = 1
"""Version of the entries' fields and of how their references are called. It grows with an incompatible
change. An entry of a plug-in declares the version that it was written for."""

Reference: TypeAlias = str | Callable[[], Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class TransportEntry:
    """A transport: how it is made, and how its ports are named.

    Attributes:
        name: Its name, as after ``--transport``.
        api_version: The :data:`API_VERSION` that the entry was written for.
        transport: Called ``transport(port, clock=clock)``; of topics ``transport(port, clock, options)``.
            Returns a :class:`~deal_hw.transport.Transport`, of topics a
            :class:`~deal_hw.transport.TopicTransport`, not opened.
        adopt: Called ``adopt(fd, clock=clock, port=port)`` with the descriptor of an open port, which a child
            process inherited. "": the connection cannot be inherited, and each process opens its own.
        topics: Whether it carries messages with topics.
        options: The fields of :class:`~deal_hw.transport.WireOptions` that it takes.
        claim: Called ``claim(port, options)``; returns one name for all spellings of a port, under which a
            run claims it on this computer. "": the port as it is written.
        local: Called ``local(port)``; returns whether the port leads to a program on this computer, such as
            an emulator. "": never.
        needs: What pip installs for it, such as ``"deal-hw[zenoh]"``; named where an import fails.
        origin: The distribution of a plug-in and its version; "" for a transport of deal-hw.
    """

    name: str
    api_version: int
    transport: Reference
    adopt: Reference = ""
    topics: bool = False
    options: tuple[str, ...] = ()
    claim: Reference = ""
    local: Reference = ""
    needs: str = ""
    origin: str = ""

    def load(self, reference: Reference) -> Any:
        """Return what a reference of this entry names; see :func:`load`."""
        return load(reference, f"transport {self.name!r}", self.origin, self.needs)


@dataclass(frozen=True, slots=True, kw_only=True)
class WireEntry:
    """One wire of a robot: its driver and its emulator.

    Attributes:
        name: The wire, as after ``--transport``.
        transport: The transport that carries it.
        driver: Its driver, if it is not the entry's. With ``opens_port`` called ``driver(port, clock,
            fd=None, can_send=True)``, else ``driver(transport, clock)``; both with the driver's own settings
            as further keywords. Returns a :class:`~deal_hw.robot.Robot` and does no I/O.
        opens_port: Whether the driver makes its transport itself. ``fd`` is the descriptor of the port that a
            parent process opened.
        emulator: The emulator on this wire, called as the robot's verb does: a plug-in's as
            :class:`~deal_hw.robots.emulation.EmulatorRequest` says. "": none.
        emulator_port: Port at which the emulator listens by default; "": it makes a pseudo-terminal.
        claim: Called ``claim(transport, clock, holder)`` with a transport of topics. Returns a claim with
            ``acquire`` and ``release``, which other programs on the wire see. "": the port is exclusive.
        bus: Called ``bus(port)``; returns the CAN bus of a port and the numbers of the devices there.
        examine: Called ``examine(port, clock)`` by doctor, before it listens to the robot; yields findings.
        doctor: Called ``doctor(transport, clock, seconds, **settings)``; ``run()`` yields the findings, in
            place of doctor's own check of a robot.
    """

    name: str
    transport: str
    driver: Reference = ""
    opens_port: bool = False
    emulator: Reference = ""
    emulator_port: str = ""
    claim: Reference = ""
    bus: Reference = ""
    examine: Reference = ""
    doctor: Reference = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotEntry:
    """A robot: where its description, drivers, emulators, tasks and scores are, and what it can do.

    What is missing cannot be done with this robot: without wires it is simulated and calibrated only, without
    a task not trained.

    Attributes:
        name: Its name on the command line and in recordings.
        api_version: The :data:`API_VERSION` that the entry was written for.
        driver: The :class:`~deal_hw.robot.Robot` class; its ``description`` has the rates of the real wire.
        wires: How it is reached; the first is the usual one.
        description: The :class:`~deal_hw.description.RobotDescription` for simulation and calibration, if it
            is not the driver's.
        recorded: The driver's own description, where a module has it without the driver. "": that of the
            driver.
        spaces: Parameter sets by name, each a function that returns the
            :class:`~deal_hw.parameters.ParameterSpace`; the first is the default.
        simulators: Drivers for simulators of others in place of the robot, by the simulator's name.
        machine: The machine that it is, where several entries are the same one: a run of one is a run of all.
            "": its name.
        odometry: Called with a recording; returns the walked track by the robot's own sensors.
        balance: Called with a recording; returns how well a policy held the pole up.
        sway: Makes the motion in which a standing robot sways, called ``sway(model, rng, seconds, band_hz,
            amplitude)``.
        other_wires: Called ``other_wires(port, wire, clock)`` by doctor if nothing answers; yields findings
            on what else the port carries.
        task: The training task, a :class:`~deal_hw.policies.tasks.TrainingTask`.
        environment: Gymnasium's name of the task, such as ``"deal_hw/Ant-v0"``.
        policy: The shipped policy, ``"package:file"``.
        tasks: Further training tasks, as ``task``, by name.
        policies: Further shipped policies, as ``policy``: those of these tasks by their names, and others.
        truth: The class of the hidden parameters of its emulator, where that also emulates other robots: a
            :class:`~deal_hw.drivers.unitree.emulated_truth.JointTruth`.
        motors: The joints in the order of the vendor's motor numbers, by which policies of other trainers
            name them.
        feet: Geoms of the model's feet, for a robot that is driven only hung in the air: a policy of another
            trainer is tried on a floor all the same.
        needs: What pip installs for it; named where an import fails.
        origin: The distribution of a plug-in and its version; "" for a robot of deal-hw.
    """

    name: str
    api_version: int
    driver: Reference = ""
    wires: tuple[WireEntry, ...] = ()
    description: Reference = ""
    recorded: Reference = ""
    spaces: Reference = ""
    simulators: Mapping[str, Reference] = field(default_factory=dict)
    machine: str = ""
    odometry: Reference = ""
    balance: Reference = ""
    sway: Reference = ""
    other_wires: Reference = ""
    task: Reference = ""
    environment: str = ""
    policy: str = ""
    tasks: Mapping[str, Reference] = field(default_factory=dict)
    policies: Mapping[str, str] = field(default_factory=dict)
    truth: Reference = ""
    motors: Reference = ""
    feet: tuple[str, ...] = ()
    needs: str = ""
    origin: str = ""

    def load(self, reference: Reference) -> Any:
        """Return what a reference of this entry names; see :func:`load`."""
        return load(reference, f"robot {self.name!r}", self.origin, self.needs)

    @property
    def driven(self) -> bool:
        """Whether there is a driver, so that the robot itself can be commanded."""
        return bool(self.wires)

    @property
    def emulated_on(self) -> tuple[str, ...]:
        """The wires with an emulator."""
        return tuple(wire.name for wire in self.wires if wire.emulator)

    def wire(self, name: str) -> WireEntry:
        """Return a wire.

        Raises:
            UnknownNameError: The robot has no such wire.
        """
        for wire in self.wires:
            if wire.name == name:
                return wire
        raise UnknownNameError(f"transport of robot {self.name!r}", name, [wire.name for wire in self.wires])

    def driver_of(self, wire: WireEntry) -> Any:
        """Return the driver on a wire, a class or a function."""
        return self.load(wire.driver or self.driver)

    def model_description(self) -> RobotDescription:
        """Return the facts for simulation and calibration."""
        found: RobotDescription = (
            self.load(self.description) if self.description else self.driver_description()
        )
        return found

    def driver_description(self) -> RobotDescription:
        """Return the facts in the driver, with the rates of the real wire."""
        found: RobotDescription = (
            self.load(self.recorded) if self.recorded else self.load(self.driver).description
        )
        return found

    def recorded_description(self) -> RobotDescription:
        """Return the facts under which recordings are made: the driver's, where there is one."""
        return self.driver_description() if self.driven else self.model_description()

    def motor_joints(self) -> tuple[str, ...]:
        """Return the joints in the order of the vendor's motor numbers; () if that is not known."""
        return tuple(self.load(self.motors)) if self.motors else ()

    def parameter_spaces(self) -> Mapping[str, Callable[[], ParameterSpace]]:
        """Return the parameter sets by name; the first is the default.

        Raises:
            ConfigurationError: The entry has none.
        """
        if not self.spaces:
            raise ConfigurationError(
                f"robot {self.name!r} ({self.origin}) has no parameter sets; give one with --parameters FILE"
            )
        found: Mapping[str, Callable[[], ParameterSpace]] = self.load(self.spaces)
        return found


def load(reference: Reference, owner: str, origin: str = "", needs: str = "") -> Any:
    """Return what a reference names.

    Args:
        reference: ``"module:attribute"``, or a function that returns the object.
        owner: Whose it is, for messages.
        origin: The plug-in's distribution; "" for a part of deal-hw, whose own errors say more.
        needs: What pip installs for it.

    Raises:
        ConfigurationError: The part of a plug-in cannot be loaded.
    """
    if not isinstance(reference, str):
        return reference()
    module, _, attribute = reference.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for name in attribute.split("."):
            found = getattr(found, name)
    except DealHwError:
        raise
    except Exception as error:
        if not origin:
            raise
        # Whatever the code of others raises is one line: the run must not end in a traceback.
        advice = f"; install {needs}" if needs and isinstance(error, ImportError) else ""
        raise ConfigurationError(
            f"{owner} ({origin}): {reference} cannot be loaded: {type(error).__name__}: {error}{advice}"
        ) from error
    return found
