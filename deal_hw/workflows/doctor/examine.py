"""``deal_hw.doctor``: check this computer, the connection and the robot, and advise what to do."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.control.safety.safety import LINK_ERROR_SHARE
from deal_hw.data.checks.clock_rate import judge_clock
from deal_hw.errors import DealHwError, TransportTimeoutError
from deal_hw.findings import Finding, Severity
from deal_hw.load import Load
from deal_hw.ranges import Checked, Range
from deal_hw.robot import Robot
from deal_hw.robots import default_transport, plug_ins
from deal_hw.robots.connect import (
    make_robot,
    make_topic_transport,
    on_this_computer,
    other_wires,
    reached_over,
    spoilt_on_purpose,
)
from deal_hw.transport import WireOptions
from deal_hw.workflows.causes import corrupt_advice, late_advice
from deal_hw.workflows.doctor.machine import examine_machine
from deal_hw.workflows.options import from_settings, given, refuse
from deal_hw.workflows.robot_kinds import robot_kinds
from deal_hw.workflows.say import html_table
from deal_hw.workflows.unitree import Go2Link, UnitreeGoLink, UnitreeLink


@dataclass(frozen=True, kw_only=True)
class DoctorSettings(Checked):
    """Check this computer only; sends no command to a motor.

    The exit code is 1 if a check failed (FAIL), and 0 with notes and warnings only.
    """

    robot: str = field(default="", kw_only=False)
    """The robot to listen to, such as go2; without it only this computer is checked."""


@dataclass(frozen=True, kw_only=True)
class DoctorRobotSettings(DoctorSettings):
    """Check this computer, the connection and the robot; sends no command to a motor.

    The exit code is 1 if a check failed (FAIL), and 0 with notes and warnings only.
    """

    port: str
    """The robot's port, such as a serial port or an end point of a network."""

    transport: str = ""
    """Transport to the robot; by default the robot's usual one."""

    seconds: Annotated[float, Range(0.5, 600, "s")] = 3.0
    """How long to listen to the robot [s]."""


@dataclass(frozen=True, kw_only=True)
class DoctorCartpoleSettings(DoctorRobotSettings):
    """Check this computer, the connection and a cart-pole; sends no command to a motor.

    The exit code is 1 if a check failed (FAIL), and 0 with notes and warnings only.
    """

    port: str
    """The cart-pole's port: a serial port or a CAN bus."""

    transport: Literal["serial", "can", "odrive", "dynamixel"] = "serial"
    """Transport to the cart-pole."""


@dataclass(frozen=True, kw_only=True)
class DoctorUnitreeSettings(UnitreeLink, DoctorRobotSettings):
    """Check this computer, the connection and a robot of Unitree; sends no command to a motor.

    The exit code is 1 if a check failed (FAIL), and 0 with notes and warnings only.
    """

    port: str
    """The robot's port: a network interface (dds) or an end point (zenoh)."""


@dataclass(frozen=True, kw_only=True)
class DoctorG1Settings(DoctorUnitreeSettings):
    """Check this computer, the connection and a G1; sends no command to a motor.

    The exit code is 1 if a check failed (FAIL), and 0 with notes and warnings only.
    """


@dataclass(frozen=True, kw_only=True)
class DoctorB2Settings(UnitreeGoLink, DoctorUnitreeSettings):
    """Check this computer, the connection and a B2; sends no command to a motor.

    The exit code is 1 if a check failed (FAIL), and 0 with notes and warnings only.
    """


@dataclass(frozen=True, kw_only=True)
class DoctorGo2Settings(Go2Link, DoctorUnitreeSettings):
    """Check this computer, the connection and a Go2; sends no command to a motor.

    The exit code is 1 if a check failed (FAIL), and 0 with notes and warnings only.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.simulator != "none":
            refuse(given(self, DoctorGo2Settings, ("state_check",)), f"{self.simulator} has no checksums")


@dataclass(frozen=True, kw_only=True)
class DoctorH1Settings(UnitreeGoLink, DoctorUnitreeSettings):
    """Check this computer, the connection and an H1; sends no command to a motor.

    The exit code is 1 if a check failed (FAIL), and 0 with notes and warnings only.
    """


DOCTOR = robot_kinds(
    {
        "cartpole": DoctorCartpoleSettings,
        "go2": DoctorGo2Settings,
        "b2": DoctorB2Settings,
        "g1": DoctorG1Settings,
        "h1": DoctorH1Settings,
    },
    plain=DoctorRobotSettings,
    legged=DoctorRobotSettings,
    nothing=DoctorSettings,
    example="--port {port}",
)
"""The kinds of :func:`doctor`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorReport:
    """What was found.

    Attributes:
        findings: All findings, in the order of the checks.
    """

    findings: tuple[Finding, ...]

    def _repr_html_(self) -> str:
        rows = [(f.code, f.severity.value, f.seen, f.do) for f in self.findings]
        return html_table(("area", "level", "what", "what to do"), rows)

    @property
    def exit_code(self) -> int:
        """For the shell: 0, or 1 if a check failed."""
        return int(any(finding.severity is Severity.FAIL for finding in self.findings))


@from_settings(DOCTOR)
def doctor(settings: DoctorSettings) -> DoctorReport:
    """Check this computer, the connection and the robot, as ``deal-hw doctor``.

    ``deal-hw doctor ROBOT --help`` describes the arguments: ``doctor("go2", port="enp2s0")``. Without a robot
    only this computer is checked. No command is sent to a motor.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: The robot is not reached that way.
    """
    return DoctorReport(findings=tuple(examine(settings)))


def examine(config: DoctorSettings) -> Iterator[Finding]:
    """Yield each finding at once; see :func:`doctor`."""
    from deal_hw.workflows.doctor.can import list_adapters

    yield from examine_machine()
    yield from list_plug_ins()
    yield from list_adapters()
    yield from judge_interfaces(config.port if isinstance(config, DoctorRobotSettings) else "")
    if not isinstance(config, DoctorRobotSettings):
        return
    name = config.transport or default_transport(config.robot)
    clock = MonotonicClock()
    try:
        yield from _examine_link(config, name, clock)
    except DealHwError as error:
        yield Finding("link", Severity.FAIL, str(error))
        yield from other_wires(config.robot, config.port, name, clock)


def _examine_link(config: DoctorRobotSettings, name: str, clock: Clock) -> Iterator[Finding]:
    """Yield findings on a robot and its wire; what is looked at beside the robot is the wire's."""
    from deal_hw.drivers.transports.can_transport import open_can
    from deal_hw.workflows.doctor.can import listen_to_bus

    entry, wire = reached_over(config.robot, name)
    network, own = WireOptions(), dict[str, str]()
    if isinstance(config, UnitreeLink):
        network, own = config.wire, config.driver_settings()
    if wire.doctor:
        link = make_topic_transport(wire.transport, config.port, clock, network)
        yield from entry.load(wire.doctor)(link, clock, config.seconds, **own).run()
        return
    if wire.bus:
        bus, nodes = entry.load(wire.bus)(config.port)
        yield from listen_to_bus(open_can(bus, clock), clock, min(1.0, config.seconds), *nodes)
    if wire.examine:
        yield from entry.load(wire.examine)(config.port, clock)
    robot = make_robot(config.robot, name, config.port, clock)
    local = on_this_computer(name, config.port)
    spoilt = spoilt_on_purpose(name, config.port, network).held
    yield from examine_robot(config.robot, robot, clock, config.seconds, local, spoilt)


def list_plug_ins() -> Iterator[Finding]:
    """Yield the installed plug-ins, and why those are left out that cannot be used."""
    for one in plug_ins():
        if one.problem:
            yield Finding("plug-ins", Severity.WARN, one.problem)
        else:
            yield Finding("plug-ins", Severity.OK, f"{one.kind} {one.name} ({one.origin})")


def judge_interfaces(port: str) -> Iterator[Finding]:
    """Yield findings on this computer's network interfaces; that of the port must have a link."""
    from deal_hw.drivers.transports.interfaces import list_interfaces

    for interface in list_interfaces():
        level, remedy = Severity.OK, ""
        if port in (interface.name, *interface.addresses) and not interface.carrier:
            level, remedy = Severity.FAIL, "check the cable, and that the robot is switched on"
        elif not interface.multicast and not interface.loopback and interface.up:
            level = Severity.WARN
            remedy = f"DDS finds its peers by multicast: ip link set {interface.name} multicast on"
        elif (
            not interface.multicast and interface.loopback and port in (interface.name, *interface.addresses)
        ):
            level = Severity.NOTE
            remedy = (
                "deal-hw's own programs find each other; programs on the vendor's SDK need `ip link set "
                f"{interface.name} multicast on`"
            )
        yield Finding("interfaces", level, str(interface), remedy)


_FEW_ERRORS = 0.01
"""Accepted share of corrupt and missing states."""
_TRIPS = LINK_ERROR_SHARE
"""Share of errors among the states due at which the safety module ends a run: no work is possible."""
_SLOW = 0.9
_PATIENCE_S = 1.0


def examine_robot(
    name: str, robot: Robot, clock: Clock, seconds: float, local: bool = False, spoilt: bool = False
) -> Iterator[Finding]:
    """Yield findings on a robot without motor commands; connecting may switch the motors off.

    Args:
        name: The robot's name.
        robot: Its driver, not connected.
        clock: The clock of its stamps.
        seconds: How long to listen [s].
        local: It is a program on this computer, such as an emulator.
        spoilt: It says that it spoils frames on purpose.

    Raises:
        DealHwError: It cannot be reached, or it is another device.
    """
    silent = "see what the emulator says" if local else "check the device's power and the cable"
    with robot:
        yield Finding("link", Severity.OK, f"{name} answers{_info_text(getattr(robot, 'info', None))}")
        errors = robot.transport_errors
        host_ns: list[int] = []
        device_ns: list[int] = []
        end_ns = clock.now_ns() + round(seconds * 1e9)
        while clock.now_ns() < end_ns:
            try:
                state = robot.read_state(min(_PATIENCE_S, seconds))
            except TransportTimeoutError as error:
                yield Finding("states", Severity.FAIL, str(error), silent)
                return
            host_ns.append(state.receive_ns)
            device_ns.append(state.device_ns)
        errors = robot.transport_errors - errors
    wanted_hz = robot.description.state_rate_hz
    rate_hz = (len(host_ns) - 1) / max((host_ns[-1] - host_ns[0]) * 1e-9, 1e-9)
    yield Finding.judged(
        "states",
        rate_hz < _SLOW * wanted_hz,
        f"{rate_hz:.0f} states a second of {wanted_hz:.0f}",
        late_advice(local, Load.now()),
    )
    share = errors / (errors + len(host_ns))
    text = f"{errors} of {errors + len(host_ns)} states corrupt or lost ({share:.1%})"
    # The measure of the safety module: errors among the states that were due.
    due = max((host_ns[-1] - host_ns[0]) * 1e-9, _PATIENCE_S) * wanted_hz
    advice = corrupt_advice(local, Load.now(), spoilt)
    if errors > _TRIPS * due:
        yield Finding("states", Severity.FAIL, f"{text}; a run trips at {_TRIPS:.0%}", advice)
    else:
        yield Finding.judged("states", share > _FEW_ERRORS, text, advice)
    yield judge_clock(np.array(host_ns), np.array(device_ns))


def _info_text(info: Any) -> str:
    """Return a robot's own information as text, if it is a dataclass."""
    if not dataclasses.is_dataclass(info) or isinstance(info, type):
        return ""
    words = (f"{name.replace('_', ' ')} {value}" for name, value in dataclasses.asdict(info).items())
    return f": {', '.join(words)}"
