"""``deal-hw emulate``: a robot on the wire without a robot."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from deal_hw.cli.emulate_common import (
    cut_on_signal,
    happenings,
    read_truth,
    realtime_priority,
    reveal,
    run_until,
    stop_on_signals,
)
from deal_hw.cli.emulate_go2 import DEFAULT_PORTS, Go2Options, emulate_go2
from deal_hw.cli.options import Range, Ratio, Seed, Share, check_ranges
from deal_hw.errors import ConfigurationError, MissingExtraError, UnknownNameError

if TYPE_CHECKING:
    from deal_hw.drivers.cartpole.emulator import Hazards
    from deal_hw.drivers.cartpole.truth import Truth

TRANSPORTS = {"cartpole": ("serial",), "go2": tuple(DEFAULT_PORTS)}
"""Robots to emulate and the wires that each speaks on; the first is the default."""
CARTPOLE_XI = 5.0


@dataclass(frozen=True, kw_only=True)
class Emulate:
    """Emulate a robot in real time on a port of its own, with physics that nobody can look inside."""

    robot: tyro.conf.Positional[str] = "cartpole"
    """The robot to emulate."""

    transport: str | None = None
    """The wire to speak on. Cart-pole: "serial", a pseudo-terminal. Go2: "dds" (the default) or "zenoh"."""

    port: str | None = None
    """Go2: network interface or its address (dds), or end point to listen at (zenoh; number 0: a free
    one). By default on this machine alone."""

    profile: Literal["ideal", "sensor", "realistic"] = "realistic"
    """ideal: equations only; sensor: noise, quantisation and a hidden latency; realistic: also jitter,
    Stribeck friction and dropped frames, backlash (cart-pole), encoder bias and torque-speed limit (Go2)."""

    seed: Seed = 0
    """Decides the hidden parameters, the noise and the start angles."""

    xi: Annotated[float | None, Ratio] = None
    """Hidden parameters lie within this ratio of the nominal ones; 5 for the cart-pole, 2 for the Go2."""

    nominal: bool = False
    """Use the nominal parameters and no latency instead of hidden ones."""

    truth_from: Path | None = None
    """Use the truth in this JSON file (as --reveal-to wrote it) instead of drawing one."""

    link: Path | None = None
    """Make a symbolic link to the port here."""

    reveal: bool = False
    """Print the truth and what happened as one line of JSON at the end."""

    reveal_to: Path | None = None
    """Write the same to this JSON file at the end."""

    duration_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Stop after this time [s]; without it, at Ctrl-C."""

    corrupt: Share = 0.0
    """Share of frames from the device in which a byte is changed."""

    drop: Share = 0.0
    """Share of frames from the device that are lost."""

    duplicate: Share = 0.0
    """Share of frames from the device that come twice."""

    freeze_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The firmware hangs this long after the motor was first armed, or commanded [s]."""

    cut_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The wire is cut this long after the motor was first armed, or commanded [s]: nothing goes out and
    nothing is heard. The signal SIGUSR1 cuts it at any moment."""

    cut_s: Annotated[float, Range(0, 1e7, "s")] = 1.0
    """How long the wire is cut [s]."""

    vanish_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The port vanishes this long after the motor was first armed, like a cable that is pulled [s]."""

    return_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The port comes back under --link so long after it vanished [s]; without it the emulator ends there."""

    events_to: Path | None = None
    """Append to this file what the robot is told, while it happens: lines of JSON with device time [ms], host
    time [ns] and what it was."""

    parent: Annotated[int | None, Range(1, 2**22)] = None
    """Stop when the process with this id is no longer the parent (for programs that start an emulator)."""

    go2: tyro.conf.OmitArgPrefixes[Go2Options] = field(default_factory=Go2Options)
    """Options of the Go2 alone."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.robot not in TRANSPORTS:
            raise UnknownNameError("robot to emulate", self.robot, TRANSPORTS)
        if self.transport is not None and self.transport not in TRANSPORTS[self.robot]:
            raise UnknownNameError("transport to emulate on", self.transport, TRANSPORTS[self.robot])
        if foreign := self._foreign():
            raise ConfigurationError(f"emulate {self.robot} has no {', '.join(foreign)}")
        if self.nominal and self.truth_from is not None:
            raise ConfigurationError("--nominal and --truth-from exclude each other")
        if self.return_after_s is not None and (self.vanish_after_s is None or self.link is None):
            raise ConfigurationError(
                "--return-after-s needs --vanish-after-s and --link: the new port has another name"
            )

    def _foreign(self) -> list[str]:
        """Return the flags given that belong to another robot."""
        if self.robot == "cartpole":
            return self.go2.given() + (["--port"] if self.port is not None else [])
        own = {
            "--link": self.link,
            "--vanish-after-s": self.vanish_after_s,
            "--return-after-s": self.return_after_s,
        }
        return [flag for flag, value in own.items() if value is not None]


def emulate(config: Emulate) -> int:
    """Run the emulator until a signal, the time given, or until the port vanished; return the exit status.

    The first line on standard output is ``port PATH``.
    """
    if config.robot == "go2":
        return emulate_go2(config)
    try:
        from deal_hw.drivers.cartpole.device import CartpoleDevice
        from deal_hw.drivers.cartpole.emulator import CartpoleEmulator
    except ModuleNotFoundError as error:
        if error.name in ("mujoco", "scipy"):
            raise MissingExtraError(error.name, "sim") from error
        raise
    stop, cut = stop_on_signals(), cut_on_signal()
    truth = _truth(config)
    emulator = CartpoleEmulator(CartpoleDevice(truth), link=config.link, hazards=_hazards(config))
    try:
        print(f"port {emulator.open()}", flush=True)
        print(
            f"profile {truth.profile}, seed {truth.seed}, {truth.refused} draws refused; Ctrl-C ends",
            flush=True,
        )
        with realtime_priority(), happenings(config.events_to, emulator.changes) as tell:

            def step() -> bool:
                if cut.is_set():
                    cut.clear()
                    emulator.cut()
                going_on = emulator.step()
                tell()
                return going_on

            run_until(step, stop, config.duration_s, config.parent)
    finally:
        emulator.close()
        report = {**truth.to_json(), **emulator.report()}
        reveal(report, on_stdout=config.reveal, path=config.reveal_to)
    print(f"emulator: {emulator.slips} stalls, {emulator.dropped} writes dropped", file=sys.stderr)
    return 0


def _truth(config: Emulate) -> Truth:
    from deal_hw.drivers.cartpole.oracle import draw_truth
    from deal_hw.drivers.cartpole.truth import Truth, nominal_truth

    if config.nominal:
        return nominal_truth(config.profile, config.seed)
    if config.truth_from is not None:
        return read_truth(config.truth_from, Truth.from_json)
    return draw_truth(config.profile, config.seed, xi=CARTPOLE_XI if config.xi is None else config.xi)


def _hazards(config: Emulate) -> Hazards:
    import numpy as np

    from deal_hw.drivers.cartpole.emulator import Hazards
    from deal_hw.testing.faults import FaultRates, FrameFaults

    rates = FaultRates(corrupt=config.corrupt, drop=config.drop, duplicate=config.duplicate)
    return Hazards(
        freeze_after_s=config.freeze_after_s,
        cut_after_s=config.cut_after_s,
        cut_s=config.cut_s,
        vanish_after_s=config.vanish_after_s,
        return_after_s=config.return_after_s,
        faults=FrameFaults(rates, np.random.default_rng([config.seed, 0xFA]))
        if rates != FaultRates()
        else None,
    )


if __name__ == "__main__":
    sys.exit(emulate(tyro.cli(Emulate, description=Emulate.__doc__)))
