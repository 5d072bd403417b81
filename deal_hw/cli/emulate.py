"""``deal-hw emulate``: a robot on the wire without a robot."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from deal_hw.errors import ConfigurationError, MissingExtraError, UnknownNameError

if TYPE_CHECKING:
    from deal_hw.drivers.cartpole.emulator import CartpoleEmulator, Hazards
    from deal_hw.drivers.cartpole.truth import Truth

ROBOTS = ("cartpole",)
TRANSPORTS = ("serial",)
_PARENT_CHECK_STEPS = 100
_FIFO_PRIORITY = 40
"""Below that of a control process: the host must not wait for the emulator."""


@dataclass(frozen=True, kw_only=True)
class Emulate:
    """Emulate a robot in real time on a port of its own, with physics that nobody can look inside."""

    robot: tyro.conf.Positional[str] = "cartpole"
    """The robot to emulate."""

    transport: str = "serial"
    """The wire to speak on; "serial" makes a pseudo-terminal."""

    profile: Literal["ideal", "sensor", "realistic"] = "realistic"
    """ideal: equations only; sensor: noise, quantisation and a hidden latency; realistic: also jitter,
    Stribeck friction, backlash and dropped frames."""

    seed: int = 0
    """Decides the hidden parameters, the noise and the start angles."""

    xi: float = 5.0
    """Hidden parameters lie within this ratio of the nominal ones."""

    nominal: bool = False
    """Use the nominal parameters and no latency instead of hidden ones."""

    truth_from: Path | None = None
    """Use the truth in this JSON file (as --reveal-to wrote it) instead of drawing one."""

    link: Path | None = None
    """Make a symbolic link to the port here."""

    reveal: bool = False
    """Print the truth as one line of JSON at the end."""

    reveal_to: Path | None = None
    """Write the truth to this JSON file at the end."""

    duration_s: float | None = None
    """Stop after this time [s]; without it, at Ctrl-C."""

    corrupt: float = 0.0
    """Share of frames from the device in which a byte is changed."""

    drop: float = 0.0
    """Share of frames from the device that are lost."""

    duplicate: float = 0.0
    """Share of frames from the device that come twice."""

    freeze_after_s: float | None = None
    """The firmware hangs this long after the motor was first armed [s]."""

    vanish_after_s: float | None = None
    """The port vanishes this long after the motor was first armed [s]."""

    parent: int | None = None
    """Stop when the process with this id is no longer the parent (for programs that start an emulator)."""

    def __post_init__(self) -> None:
        if self.robot not in ROBOTS:
            raise UnknownNameError("robot to emulate", self.robot, ROBOTS)
        if self.transport not in TRANSPORTS:
            raise UnknownNameError("transport to emulate on", self.transport, TRANSPORTS)
        if self.nominal and self.truth_from is not None:
            raise ConfigurationError("--nominal and --truth-from exclude each other")
        for name in ("duration_s", "freeze_after_s", "vanish_after_s"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ConfigurationError(f"{name} must be 0 or more seconds, got {value}")


def emulate(config: Emulate) -> int:
    """Run the emulator until a signal, the time given, or until the port vanished; return the exit status.

    The first line on standard output is ``port PATH``.
    """
    try:
        from deal_hw.drivers.cartpole.device import CartpoleDevice
        from deal_hw.drivers.cartpole.emulator import CartpoleEmulator
    except ModuleNotFoundError as error:
        if error.name in ("mujoco", "scipy"):
            raise MissingExtraError(error.name, "sim") from error
        raise
    stop = threading.Event()
    _stop_on_signals(stop)
    truth = _truth(config)
    emulator = CartpoleEmulator(CartpoleDevice(truth), link=config.link, hazards=_hazards(config))
    try:
        print(f"port {emulator.open()}", flush=True)
        print(
            f"profile {truth.profile}, seed {truth.seed}, {truth.refused} draws refused; Ctrl-C ends",
            flush=True,
        )
        with _realtime_priority():
            _run(emulator, config, stop)
    finally:
        emulator.close()
        _reveal(config, truth)
    print(f"emulator: {emulator.slips} stalls, {emulator.dropped} writes dropped", file=sys.stderr)
    return 0


def _run(emulator: CartpoleEmulator, config: Emulate, stop: threading.Event) -> None:
    from deal_hw.clock import MonotonicClock

    clock = MonotonicClock()
    end_ns = None if config.duration_s is None else clock.now_ns() + round(config.duration_s * 1e9)
    count = 0
    while not stop.is_set() and emulator.step():
        count += 1
        if end_ns is not None and clock.now_ns() >= end_ns:
            return
        if config.parent is not None and count % _PARENT_CHECK_STEPS == 0 and os.getppid() != config.parent:
            return


@contextlib.contextmanager
def _realtime_priority() -> Iterator[None]:
    """Run ahead of ordinary processes where permitted: a real robot does not share the host's processor."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, *before)


def _stop_on_signals(stop: threading.Event) -> None:
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())


def _truth(config: Emulate) -> Truth:
    from deal_hw.drivers.cartpole.oracle import draw_truth
    from deal_hw.drivers.cartpole.truth import Truth, nominal_truth

    if config.nominal:
        return nominal_truth(config.profile, config.seed)
    if config.truth_from is not None:
        return Truth.from_json(json.loads(config.truth_from.read_text(encoding="utf-8")))
    return draw_truth(config.profile, config.seed, xi=config.xi)


def _hazards(config: Emulate) -> Hazards:
    import numpy as np

    from deal_hw.drivers.cartpole.emulator import Hazards
    from deal_hw.testing.faults import FaultRates, FrameFaults

    rates = FaultRates(corrupt=config.corrupt, drop=config.drop, duplicate=config.duplicate)
    return Hazards(
        freeze_after_s=config.freeze_after_s,
        vanish_after_s=config.vanish_after_s,
        faults=FrameFaults(rates, np.random.default_rng([config.seed, 0xFA]))
        if rates != FaultRates()
        else None,
    )


def _reveal(config: Emulate, truth: Truth) -> None:
    text = json.dumps(truth.to_json())
    if config.reveal:
        print(text, flush=True)
    if config.reveal_to is not None:
        config.reveal_to.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(emulate(tyro.cli(Emulate, description=Emulate.__doc__)))
