"""Settings of ``deal_hw.emulate``."""

from __future__ import annotations

import abc
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Literal

from deal_hw.drivers.cartpole.emulator.faults import CanFaults, ServoFaults
from deal_hw.drivers.g1.emulator.faults import G1Faults
from deal_hw.drivers.go2.emulator.faults import Go2Faults
from deal_hw.drivers.h1.faults import H1Faults
from deal_hw.drivers.ros2.faults import ControllerFaults
from deal_hw.drivers.servo_arm.faults import ArmFaults
from deal_hw.drivers.unitree.hung_faults import HungFaults
from deal_hw.errors import ConfigurationError
from deal_hw.ranges import Checked, Range, check_ranges
from deal_hw.robots import driven_entry, emulated_robots, has_hardware, robot_entry
from deal_hw.robots.file_robot import has_servos, robot_yaml
from deal_hw.testing.joint_faults import JointFaults
from deal_hw.transport import NetworkOptions, WireOptions
from deal_hw.workflows.kinds import Arguments, InputKind, Kinds
from deal_hw.workflows.options import File, Ratio, Seed, Share, given, refuse
from deal_hw.workflows.robot import is_user_robot
from deal_hw.workflows.robot_kinds import FILE


@dataclass(frozen=True, kw_only=True)
class Go2Options(Checked):
    """Options of ``emulate go2`` and ``emulate b2``."""

    on_stand: bool = False
    """Hold the base in the air: no floor, no contact."""

    start: Literal["lying", "standing"] = "lying"
    """lying: limp on the floor; standing: sport mode in control."""

    terrain: str = ""
    """What is ahead on the floor: a platform, box:HEIGHT [m], three steps, steps:HEIGHT of one [m], or a
    ramp, slope:ANGLE [rad]. It begins 1 m ahead, or at a distance after a comma, such as box:0.2,1.5. By
    default the floor is flat."""

    sport: Literal["normal", "ai", "advanced", "mcf", "off"] = "normal"
    """The sport mode at power-up. It overrides other commands until it is released."""

    sport_silent: bool = False
    """Hide sport mode's own commands on rt/lowcmd."""

    remote_script: Path | None = None
    """JSON file with the remote's states and their start times: [{"at_s": 2.0, "buttons": "L2+B", "left_y":
    0.5}]"""

    no_remote: bool = False
    """Emulate no remote: its 40 bytes are zeros."""

    tick_start_ms: Annotated[int, Range(0, 2**32 - 1, "ms")] = 0
    """The robot's clock at the start [ms]; it wraps at 2**32."""

    track_to: Path | None = None
    """Write the true position of the base to this CSV file, at 100 Hz: time_s (the robot's clock), x, y [m],
    heading [rad]."""

    faults: Go2Faults = field(default_factory=Go2Faults)
    """Faults of the robot. Their times count from the first stiff command."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatorWireOptions(NetworkOptions):
    """How an emulated robot of Unitree joins its network, beyond the port."""

    mode: Literal["peer", "client"] = "peer"
    """Zenoh: peer waits for peers at the port, client connects to the router there."""

    def __post_init__(self) -> None:
        NetworkOptions.__post_init__(self)
        check_ranges(self)

    def on(self, transport: str) -> WireOptions:
        """Return the options of a transport."""
        shared = {one.name: getattr(self, one.name) for one in fields(NetworkOptions)}
        mode = "" if transport == "dds" and self.mode == "peer" else self.mode
        return WireOptions(**shared, listen=transport == "zenoh" and self.mode == "peer", mode=mode)


ON_CAN = ("can", "odrive")
"""Wires of the cart-pole with a CAN bus."""
WITH_FIRMWARE = ("serial", "can", "odrive")
"""Wires of the cart-pole with our firmware; their functions also take ``firmware=...``."""
CARTPOLE_RANGE_RATIO = 5.0


@dataclass(frozen=True, kw_only=True)
class EmulateSettings(Checked):
    """Emulate a robot in real time on its own port, with hidden physics."""

    robot: str = field(default="cartpole", kw_only=False)
    """The robot to emulate."""

    transport: str = ""
    """The wire; by default the robot's usual one."""

    profile: Literal["ideal", "sensor", "realistic"] = "realistic"
    """ideal: equations only; sensor: noise, quantisation and a hidden latency; realistic: also jitter,
    Stribeck friction and dropped frames, backlash (cart-pole), encoder bias and torque-speed limit (Go2)."""

    seed: Seed = 0
    """Seed of the hidden parameters, the noise and the start angles."""

    range_ratio: Annotated[float | None, Ratio] = None
    """Hidden parameters lie within this factor of the nominal ones; by default 5 for the cart-pole, 2 for the
    Go2 and the B2, 1.5 for the G1, the H1 and an arm."""

    nominal: bool = False
    """Use the nominal parameters and no latency instead of hidden ones."""

    truth_from: File | None = None
    """Use the truth in this JSON file (as --reveal-to wrote it) instead of drawing one."""

    reveal: bool = False
    """At the end print the truth and the events as one line of JSON."""

    reveal_to: File | None = None
    """At the end write the truth and the events to this JSON file."""

    duration_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Stop after this time [s]; without it, at Ctrl-C."""

    corrupt: Share = 0.0
    """Share of the device's frames with one changed byte."""

    drop: Share = 0.0
    """Share of the device's frames that are lost."""

    duplicate: Share = 0.0
    """Share of the device's frames that arrive twice."""

    freeze_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The firmware hangs this long after the first arming or command of the motor [s]."""

    cut_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The wire is cut this long after the first arming or command of the motor [s]; nothing passes in either
    direction. The signal SIGUSR1 cuts it at any moment."""

    cut_s: Annotated[float, Range(0, 1e7, "s")] = 1.0
    """How long the wire is cut [s]."""

    joints: JointFaults = field(default_factory=JointFaults)
    """Faults of its joints."""

    events_to: File | None = None
    """Append each received command to this file at once: lines of JSON with device time [ms], host time [ns]
    and the command."""

    parent: Annotated[int | None, Range(1, 2**22)] = None
    """Stop when the process with this id is no longer the parent. By default that is the process which
    started the emulator, such as a shell or a script: none is left behind. Started with nohup, it goes on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nominal and self.truth_from is not None:
            raise ConfigurationError("--nominal and --truth-from exclude each other")


@dataclass(frozen=True, kw_only=True)
class PseudoTerminalSettings(EmulateSettings):
    """An emulated robot behind a pseudo-terminal."""

    link: File | None = None
    """Make a symbolic link to the port here."""

    vanish_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The port vanishes this long after the first arming of the motor, as when its cable is pulled [s]."""

    return_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The port comes back under --link this long after it vanished [s]; by default the emulator ends when the
    port vanishes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.return_after_s is not None and (self.vanish_after_s is None or self.link is None):
            raise ConfigurationError(
                "--return-after-s needs --vanish-after-s and --link: the new port has another name"
            )


@dataclass(frozen=True, kw_only=True)
class EmulateCartpoleSettings(PseudoTerminalSettings):
    """Emulate a cart-pole in real time on its own port, with hidden physics."""

    transport: Literal["serial", "can", "odrive", "dynamixel"] = "serial"
    """The wire; each is on a pseudo-terminal."""

    firmware: Literal["auto", "host", "python", "avr"] = "auto"
    """On serial or CAN, and an ODrive's pole encoder: the firmware's C core compiled for this computer
    (host), a copy in Python, or the image for the ATmega328P under simavr (avr, serial only). auto: host, or
    python without a C compiler."""

    can: CanFaults = field(default_factory=CanFaults)
    """The CAN bus."""

    servo: ServoFaults = field(default_factory=ServoFaults)
    """The servos."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.transport not in ON_CAN:
            refuse(given(self.can, CanFaults()), "only `--transport can` and `odrive` have a CAN bus")
        if self.transport != "dynamixel":
            refuse(given(self.servo, ServoFaults()), "only `--transport dynamixel` has servos")
        if self.transport not in WITH_FIRMWARE:
            refuse(
                given(self, EmulateCartpoleSettings, ["firmware"]),
                "only `--transport serial`, `can` and `odrive` have this firmware",
            )
        if self.transport in ON_CAN and self.firmware == "avr":
            raise ConfigurationError(
                "the ATmega328P has no CAN controller; use --firmware host or python, or --transport serial"
            )


@dataclass(frozen=True, kw_only=True)
class EmulatePlugInSettings(PseudoTerminalSettings):
    """Emulate a robot of a plug-in in real time on its own port, with hidden physics."""

    port: str | None = None
    """Where an emulator on a network listens; by default the port that the plug-in names."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if is_user_robot(self.robot) and not has_hardware(self.robot):
            # What is wrong with the file is said by its reader.
            return
        entry = robot_entry(self.robot)
        name = self.transport or entry.emulated_on[0]
        if entry.wire(name).emulator_port:
            refuse(
                given(self, EmulatePlugInSettings, ["link", "vanish_after_s", "return_after_s"]),
                f"the emulator of {self.robot!r} on {name} listens at --port, it has no pseudo-terminal",
            )
        else:
            refuse(
                given(self, EmulatePlugInSettings, ["port"]),
                f"the emulator of {self.robot!r} on {name} makes a pseudo-terminal; --link names it",
            )


@dataclass(frozen=True, kw_only=True)
class EmulateArmSettings(EmulatePlugInSettings):
    """Emulate an arm of servos in real time on its own port, with hidden physics."""

    servos: ArmFaults = field(default_factory=ArmFaults)
    """Faults of its servos."""

    controller: ControllerFaults = field(default_factory=ControllerFaults)
    """Faults of its controller."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if is_user_robot(self.robot) and not has_servos(self.robot):
            refuse(given(self.servos, ArmFaults()), "only a robot whose `hardware` has a bus has servos")
        if not is_user_robot(self.robot) or has_servos(self.robot):
            refuse(
                given(self.controller, ControllerFaults()),
                "only a robot whose `hardware` is ros2_control has such a controller",
            )


@dataclass(frozen=True, kw_only=True)
class EmulateOnTopicsSettings(EmulateSettings):
    """Emulate a robot in real time on its own network, with hidden physics."""

    transport: Literal["dds", "zenoh"] = "dds"
    """The wire."""

    port: str | None = None
    """Network interface or its address (dds), or end point to listen at (zenoh; port 0: any free one). By
    default reachable on this machine only."""

    wire: EmulatorWireOptions = field(default_factory=EmulatorWireOptions)
    """How it joins its network."""


@dataclass(frozen=True, kw_only=True)
class EmulateGo2Settings(EmulateOnTopicsSettings):
    """Emulate a Go2 in real time on its own network, with hidden physics."""

    go2: Go2Options = field(default_factory=Go2Options)
    """Options of a robot with four legs."""


@dataclass(frozen=True, kw_only=True)
class EmulateB2Settings(EmulateGo2Settings):
    """Emulate a B2 in real time on its own network, with hidden physics."""


@dataclass(frozen=True, kw_only=True)
class HungOptions(Checked):
    """Options of an emulated humanoid that hangs on a crane."""

    controller: Literal["ai", "normal", "advanced", "off"] = "ai"
    """Mode of the robot's own controller at power-up. It overrides other commands until it is released."""

    no_remote: bool = False
    """Emulate no remote: its 40 bytes are zeros."""

    tick_start_ms: Annotated[int, Range(0, 2**32 - 1, "ms")] = 0
    """The robot's clock at the start [ms]; it wraps at 2**32."""

    faults: HungFaults
    """Faults of the robot. Their times count from the first stiff command."""


@dataclass(frozen=True, kw_only=True)
class G1Options(HungOptions):
    """Options of ``emulate g1`` alone."""

    mode_machine: Annotated[int | None, Range(0, 255)] = None
    """Version of the G1 that the states report; by default 5 (29 joints) or 4 (23 joints)."""

    faults: G1Faults = field(default_factory=G1Faults)
    """Faults of the G1. Their times count from the first stiff command."""


@dataclass(frozen=True, kw_only=True)
class H1Options(HungOptions):
    """Options of ``emulate h1`` alone."""

    faults: H1Faults = field(default_factory=H1Faults)
    """Faults of the H1. Their times count from the first stiff command."""


@dataclass(frozen=True, kw_only=True)
class EmulateHungSettings(EmulateOnTopicsSettings, abc.ABC):
    """Emulate a humanoid that hangs on a crane, in real time on its own network, with hidden physics."""

    @property
    @abc.abstractmethod
    def own(self) -> HungOptions:
        """The options of this robot."""


@dataclass(frozen=True, kw_only=True)
class EmulateG1Settings(EmulateHungSettings):
    """Emulate a G1 that hangs on a crane, in real time on its own network, with hidden physics."""

    g1: G1Options = field(default_factory=G1Options)
    """Options of the G1 alone."""

    @property
    def own(self) -> G1Options:
        """The options of this robot."""
        return self.g1


@dataclass(frozen=True, kw_only=True)
class EmulateH1Settings(EmulateHungSettings):
    """Emulate an H1 that hangs on a crane, in real time on its own network, with hidden physics."""

    h1: H1Options = field(default_factory=H1Options)
    """Options of the H1 alone."""

    @property
    def own(self) -> H1Options:
        """The options of this robot."""
        return self.h1


_SETTINGS: dict[str, type[EmulateSettings]] = {
    "cartpole": EmulateCartpoleSettings,
    "go2": EmulateGo2Settings,
    "b2": EmulateB2Settings,
    "g1": EmulateG1Settings,
    "h1": EmulateH1Settings,
    "so101": EmulateArmSettings,
}


_HELP = {
    "so101": "Emulate an SO-101 in real time on a port of its own: its servos' bytes, with hidden physics."
}


def _table() -> dict[str, InputKind]:
    found = {}
    for name in emulated_robots():
        settings = _SETTINGS.get(name) or _SETTINGS.get(robot_entry(name).machine) or EmulatePlugInSettings
        found[name] = InputKind(settings, _HELP.get(name, ""), example=f"{name} --seed 0")
    what = "Emulate the robot of a robot.yaml: its bytes on a port of its own, with hidden physics."
    return {**found, FILE: InputKind(EmulateArmSettings, what, example=f"{FILE} --seed 0")}


def _find(arguments: Arguments) -> str:
    name = "cartpole" if arguments.first is None else str(arguments.first)
    if is_user_robot(name):
        if robot_yaml(name).is_file() and not has_hardware(name):
            driven_entry(name)
        return FILE
    return name


EMULATE = Kinds(noun="robot to emulate", argument="robot", table=_table, find=_find)
"""The kinds of :func:`deal_hw.emulate`; without a robot it emulates a cart-pole."""
