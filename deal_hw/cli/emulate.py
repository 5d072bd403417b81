"""``deal-hw emulate``: a robot on the wire without a robot."""

from __future__ import annotations

import dataclasses
import importlib
import sys
import threading
from typing import TYPE_CHECKING, Any, Protocol

import tyro

from deal_hw.cli.emulate_common import (
    happenings,
    read_truth,
    realtime_priority,
    reveal,
    run_until,
    signalled,
)
from deal_hw.cli.emulate_go2 import emulate_go2
from deal_hw.cli.emulate_settings import CARTPOLE_EMULATORS, CARTPOLE_RANGE_RATIO, ON_CAN, Emulate
from deal_hw.errors import MissingExtraError

if TYPE_CHECKING:
    from deal_hw.drivers.cartpole.emulator import Hazards
    from deal_hw.drivers.cartpole.truth import Truth


class CartpoleOnAWire(Protocol):
    """What the verb needs of an emulated cart-pole, whatever its wire."""

    slips: int
    dropped: int
    changes: list[tuple[int, int, str]]

    def open(self) -> str:
        """Make the port; return what a host gives as ``--port``."""
        ...

    def close(self) -> None:
        """Remove the port."""
        ...

    def step(self) -> bool:
        """Run until the next tick; return whether there is still a port."""
        ...

    def cut(self) -> None:
        """Cut the wire from now on, for as long as the hazards say."""
        ...

    def report(self) -> dict[str, Any]:
        """Return what happened, as plain JSON values."""
        ...


def emulate(config: Emulate) -> int:
    """Run the emulator until a signal, the time given, or until the port vanished; return the exit status.

    The first line on standard output is ``port PATH``.
    """
    with signalled() as (stop, cut):
        if config.robot == "go2":
            return emulate_go2(config, stop, cut)
        return _emulate_cartpole(config, stop, cut)


def _emulate_cartpole(config: Emulate, stop: threading.Event, cut: threading.Event) -> int:
    module, _, function = CARTPOLE_EMULATORS[config.transport or "serial"].partition(":")
    try:
        make = getattr(importlib.import_module(module), function)
    except ModuleNotFoundError as error:
        if error.name in ("mujoco", "scipy"):
            raise MissingExtraError(error.name, "sim") from error
        raise
    truth = _truth(config)
    own = {"firmware": config.firmware} if config.firmware != "python" else {}
    emulator: CartpoleOnAWire = make(truth, link=config.link, hazards=_hazards(config), **own)
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
    return draw_truth(
        config.profile,
        config.seed,
        range_ratio=CARTPOLE_RANGE_RATIO if config.range_ratio is None else config.range_ratio,
    )


def _hazards(config: Emulate) -> Hazards:
    import numpy as np

    from deal_hw.drivers.cartpole.emulator import CanFaults, Hazards, ServoFaults
    from deal_hw.testing.faults import FaultRates, FrameFaults

    # A frame of a serial CAN adapter is a line; servos send a packet at a time.
    end = b"\r" if config.transport in ON_CAN else None if config.transport == "dynamixel" else b"\0"
    servo = {name.removeprefix("servo_"): value for name, value in dataclasses.asdict(config.servo).items()}
    rates = FaultRates(corrupt=config.corrupt, drop=config.drop, duplicate=config.duplicate)
    return Hazards(
        freeze_after_s=config.freeze_after_s,
        cut_after_s=config.cut_after_s,
        cut_s=config.cut_s,
        vanish_after_s=config.vanish_after_s,
        return_after_s=config.return_after_s,
        faults=FrameFaults(rates, np.random.default_rng([config.seed, 0xFA]), end)
        if rates != FaultRates()
        else None,
        can=CanFaults(**dataclasses.asdict(config.can)),
        servo=ServoFaults(**servo),
    )


if __name__ == "__main__":
    sys.exit(emulate(tyro.cli(Emulate, description=Emulate.__doc__)))
