"""``deal_hw.doctor``: check this computer, the connection and the robot, and advise what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.errors import ConfigurationError, DealHwError
from deal_hw.findings import Finding, Severity
from deal_hw.ranges import Checked, Range
from deal_hw.robots import (
    default_transport,
    make_robot,
    make_topic_transport,
    on_this_computer,
    other_wires,
    reached_over,
)
from deal_hw.transport import WireOptions
from deal_hw.workflows.doctor.machine import examine_machine
from deal_hw.workflows.doctor.robot import examine_robot
from deal_hw.workflows.options import GO2, from_settings, given, refuse, refuse_others
from deal_hw.workflows.robot import is_user_robot
from deal_hw.workflows.say import html_table


@dataclass(frozen=True, kw_only=True)
class DoctorSettings(Checked):
    """Settings of :func:`doctor`."""

    robot: str = field(default="", kw_only=False)
    """The robot to listen to, such as go2."""

    port: str = ""
    """The robot's port: a network interface (dds), an end point (zenoh), a serial port or a CAN bus."""

    transport: str = ""
    """Transport to the robot, such as serial, can, dds or zenoh; by default the robot's usual one."""

    state_check: Annotated[Literal["strict", "length"], GO2] = "strict"
    """How to check a Go2's state messages: strict (length, head and checksum), or length alone."""

    simulator: Annotated[Literal["none", "unitree_mujoco"], GO2] = "none"
    """Simulator in place of a real Go2: unitree_mujoco."""

    seconds: Annotated[float, Range(0.5, 600, "s")] = 3.0
    """How long to listen to the robot [s]."""

    wire: Annotated[WireOptions, GO2] = field(default_factory=WireOptions)
    """Network options."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if is_user_robot(self.robot):
            raise ConfigurationError(
                f"{self.robot}: deal-hw has no driver for this robot, so there is no connection to check; "
                "`deal-hw robot check robot.yaml` checks its description"
            )
        if bool(self.robot) != bool(self.port):
            raise ConfigurationError(
                "name a robot and its port, such as `deal-hw doctor go2 --port enp2s0`, or neither"
            )
        if self.robot:
            refuse_others(self, "doctor", self.robot)


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


@from_settings(DoctorSettings)
def doctor(settings: DoctorSettings) -> DoctorReport:
    """Check this computer, the connection and the robot, as ``deal-hw doctor``.

    :class:`DoctorSettings` describes the arguments: ``doctor("go2", port="enp2s0")``. Without a robot only
    this computer is checked. No command is sent to a motor.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: The robot is not reached that way.
    """
    return DoctorReport(findings=tuple(examine(settings)))


def examine(config: DoctorSettings) -> Iterator[Finding]:
    """Yield each finding at once; see :func:`doctor`."""
    from deal_hw.workflows.doctor.can import list_adapters

    name = _transport(config)
    yield from examine_machine()
    yield from list_adapters()
    yield from judge_interfaces(config.port)
    if not config.robot:
        return
    clock = MonotonicClock()
    try:
        yield from _examine_link(config, name, clock)
    except DealHwError as error:
        yield Finding("link", Severity.FAIL, str(error))
        yield from other_wires(config.robot, config.port, name, clock)


def _examine_link(config: DoctorSettings, name: str, clock: Clock) -> Iterator[Finding]:
    """Yield findings on a robot and its wire; what is looked at beside the robot is the wire's."""
    from deal_hw.drivers.transports.can_transport import open_can
    from deal_hw.workflows.doctor.can import listen_to_bus

    entry, wire = reached_over(config.robot, name)
    if wire.doctor:
        link = make_topic_transport(wire.transport, config.port, clock, config.wire)
        doctor = entry.load(wire.doctor)
        yield from doctor(link, clock, config.seconds, config.state_check, config.simulator).run()
        return
    if wire.bus:
        bus, nodes = entry.load(wire.bus)(config.port)
        yield from listen_to_bus(open_can(bus, clock), clock, min(1.0, config.seconds), *nodes)
    if wire.examine:
        yield from entry.load(wire.examine)(config.port, clock)
    robot = make_robot(config.robot, name, config.port, clock, config.wire)
    local = on_this_computer(name, config.port)
    yield from examine_robot(config.robot, robot, clock, config.seconds, local)


def _transport(config: DoctorSettings) -> str:
    """Return the name of the transport; "" without a robot.

    Raises:
        ConfigurationError: An option would have no effect.
    """
    default = DoctorSettings()
    if not config.robot:
        options = ("transport", "state_check", "simulator", "seconds", "wire")
        refuse(given(config, default, options), "without a robot only this computer is checked")
        return ""
    name = config.transport or default_transport(config.robot)
    if config.simulator != "none":
        refuse(given(config, default, ("state_check",)), f"{config.simulator} has no checksums")
    return name


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
