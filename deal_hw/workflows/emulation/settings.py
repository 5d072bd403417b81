"""Settings of ``deal_hw.emulate``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from deal_hw.drivers.cartpole.emulator.faults import CanFaults, ServoFaults
from deal_hw.drivers.go2.emulator.faults import Go2Faults
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.ranges import Checked, Range, check_ranges
from deal_hw.robots import emulated_robots, robot_entry
from deal_hw.transport import WireOptions
from deal_hw.workflows.options import CARTPOLE, File, Only, Ratio, Seed, Share, given, refuse, refuse_others
from deal_hw.workflows.robot import is_user_robot

GO2 = Only(("go2",))


@dataclass(frozen=True, kw_only=True)
class Go2Options(Checked):
    """Options of ``emulate go2`` alone."""

    on_stand: bool = False
    """Hold the base in the air: no floor, no contact."""

    start: Literal["lying", "standing"] = "lying"
    """lying: limp on the floor; standing: sport mode in control."""

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

    domain: Annotated[int, Range(0, 232)] = 0
    """DDS domain."""

    mode: Literal["peer", "client"] = "peer"
    """Zenoh: peer waits for peers at the port, client connects to the router there."""

    insecure: bool = False
    """Zenoh: allow plain TCP beyond this machine."""

    ca: Path | None = None
    """Zenoh over TLS: the authority that signed the peers' certificates (PEM)."""

    certificate: Path | None = None
    """Zenoh over TLS: this side's certificate (PEM)."""

    key: Path | None = None
    """Zenoh over TLS: its private key (PEM)."""

    faults: Go2Faults = field(default_factory=Go2Faults)
    """Faults of the Go2. Their times count from the first stiff command."""

    def wire(self, transport: str) -> WireOptions:
        """Return how the emulator joins the wire."""
        return WireOptions(
            domain=self.domain,
            listen=transport == "zenoh" and self.mode == "peer",
            mode="" if transport == "dds" and self.mode == Go2Options.mode else self.mode,
            insecure=self.insecure,
            ca=self.ca,
            certificate=self.certificate,
            key=self.key,
        )


ON_CAN = ("can", "odrive")
"""Wires of the cart-pole with a CAN bus."""
WITH_FIRMWARE = ("serial", "can", "odrive")
"""Wires of the cart-pole with our firmware; their functions also take ``firmware=...``."""
CARTPOLE_RANGE_RATIO = 5.0


@dataclass(frozen=True, kw_only=True)
class EmulateSettings:
    """Settings of :func:`deal_hw.emulate`."""

    robot: str = field(default="cartpole", kw_only=False)
    """The robot to emulate: cartpole or go2."""

    transport: str | None = None
    """The wire. Cart-pole: "serial" (the default), "can", "odrive" or "dynamixel", each on a pseudo-terminal.
    Go2: "dds" (the default) or "zenoh"."""

    port: Annotated[str | None, GO2] = None
    """Go2: network interface or its address (dds), or end point to listen at (zenoh; port 0: any free one).
    By default reachable on this machine only."""

    profile: Literal["ideal", "sensor", "realistic"] = "realistic"
    """ideal: equations only; sensor: noise, quantisation and a hidden latency; realistic: also jitter,
    Stribeck friction and dropped frames, backlash (cart-pole), encoder bias and torque-speed limit (Go2)."""

    seed: Seed = 0
    """Seed of the hidden parameters, the noise and the start angles."""

    range_ratio: Annotated[float | None, Ratio] = None
    """Hidden parameters lie within this factor of the nominal ones; by default 5 for the cart-pole, 2 for the
    Go2."""

    nominal: bool = False
    """Use the nominal parameters and no latency instead of hidden ones."""

    truth_from: File | None = None
    """Use the truth in this JSON file (as --reveal-to wrote it) instead of drawing one."""

    firmware: Annotated[Literal["auto", "host", "python", "avr"], CARTPOLE] = "auto"
    """Cart-pole on serial or CAN, and an ODrive's pole encoder: the firmware's C core compiled for this
    computer (host), a copy in Python, or the image for the ATmega328P under simavr (avr, serial only). auto:
    host, or python without a C compiler."""

    link: Annotated[File | None, CARTPOLE] = None
    """Make a symbolic link to the port here."""

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

    vanish_after_s: Annotated[float | None, Range(0, 1e7, "s"), CARTPOLE] = None
    """The port vanishes this long after the first arming of the motor, as when its cable is pulled [s]."""

    return_after_s: Annotated[float | None, Range(0, 1e7, "s"), CARTPOLE] = None
    """The port comes back under --link this long after it vanished [s]; by default the emulator ends when the
    port vanishes."""

    events_to: File | None = None
    """Append each received command to this file at once: lines of JSON with device time [ms], host time [ns]
    and the command."""

    parent: Annotated[int | None, Range(1, 2**22)] = None
    """Stop when the process with this id is no longer the parent. For programs that start an emulator."""

    can: Annotated[CanFaults, CARTPOLE] = field(default_factory=CanFaults)
    """The CAN bus of a cart-pole."""

    servo: Annotated[ServoFaults, CARTPOLE] = field(default_factory=ServoFaults)
    """The servos of a cart-pole."""

    go2: Annotated[Go2Options, GO2] = field(default_factory=Go2Options)
    """Options of the Go2 alone."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if is_user_robot(self.robot):
            raise ConfigurationError(
                f"{self.robot}: deal-hw has no driver for this robot, so there is nothing to emulate; "
                "`deal-hw collect robot.yaml --simulated` records its simulation"
            )
        wires = emulated_wires(self.robot)
        if self.transport is not None and self.transport not in wires:
            raise UnknownNameError("transport to emulate on", self.transport, wires)
        refuse_others(self, "emulate", self.robot)
        wire = self.transport or wires[0]
        if wire not in ON_CAN:
            refuse(given(self.can, CanFaults()), "only `--transport can` and `odrive` have a CAN bus")
        if wire != "dynamixel":
            refuse(given(self.servo, ServoFaults()), "only `--transport dynamixel` has servos")
        if wire not in WITH_FIRMWARE:
            refuse(
                given(self, EmulateSettings, ["firmware"]),
                "only `--transport serial`, `can` and `odrive` have this firmware",
            )
        if wire in ON_CAN and self.firmware == "avr":
            raise ConfigurationError(
                "the ATmega328P has no CAN controller; use --firmware host or python, or --transport serial"
            )
        if self.nominal and self.truth_from is not None:
            raise ConfigurationError("--nominal and --truth-from exclude each other")
        if self.return_after_s is not None and (self.vanish_after_s is None or self.link is None):
            raise ConfigurationError(
                "--return-after-s needs --vanish-after-s and --link: the new port has another name"
            )


def emulated_wires(robot: str) -> tuple[str, ...]:
    """Return the wires on which a robot can be emulated; the first is the default.

    Raises:
        UnknownNameError: It has no emulator.
    """
    if robot not in (known := emulated_robots()):
        raise UnknownNameError("robot to emulate", robot, known)
    return robot_entry(robot).emulated_on
