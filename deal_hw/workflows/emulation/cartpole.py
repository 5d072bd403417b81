"""``deal-hw emulate cartpole``: how it runs."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.drivers.cartpole.emulator.faults import Hazards
from deal_hw.drivers.cartpole.plant.profiles import profile
from deal_hw.errors import MissingExtraError
from deal_hw.robots import robot_entry
from deal_hw.workflows.emulation.common import choose_truth, serve
from deal_hw.workflows.emulation.settings import (
    CARTPOLE_RANGE_RATIO,
    ON_CAN,
    WITH_FIRMWARE,
    EmulateCartpoleSettings,
)
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
    from deal_hw.testing.pseudo_terminal import PseudoTerminal


def emulate_cartpole(
    config: EmulateCartpoleSettings, stop: threading.Event, cut: threading.Event, *, announce: Say, say: Say
) -> None:
    """Run the emulator until a stop, the given time or the end of its port.

    Args:
        config: What to emulate.
        stop: Ends it.
        cut: Cuts the wire.
        announce: Called with the port first, and with the truth at the end.
        say: Called with a summary at the end.
    """
    entry = robot_entry(config.robot)
    wire = entry.wire(config.transport)
    try:
        make = entry.load(wire.emulator)
    except ModuleNotFoundError as error:
        if error.name in ("mujoco", "scipy"):
            raise MissingExtraError(error.name, "sim") from error
        raise
    truth = _truth(config)
    own: dict[str, str] = {}
    runs = ""
    if wire.name in WITH_FIRMWARE:
        from deal_hw.drivers.cartpole.chips.firmwares import usable_firmware

        own["firmware"] = usable_firmware(config.firmware)
        runs = f", firmware: {own['firmware']}"
    link = None if config.link is None else Path(config.link)
    emulator: PseudoTerminal = make(truth, link=link, hazards=_hazards(config), **own)
    what = f"profile {truth.profile}, seed {truth.seed}{runs}"

    def report() -> dict[str, Any]:
        return {**truth.to_json(), **emulator.report()}

    loses = profile(truth.profile).drop_probability > 0
    serve(emulator, config, what, stop, cut, announce=announce, report=report, loses=loses)
    say(
        f"emulator: this computer stalled it {emulator.slips} times; {emulator.dropped} frames came while no "
        "program read the port"
    )


def _truth(config: EmulateCartpoleSettings) -> CartpoleTruth:
    from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
    from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, nominal_truth

    return choose_truth(config, nominal_truth, draw_truth, CartpoleTruth.from_json, CARTPOLE_RANGE_RATIO)


def _hazards(config: EmulateCartpoleSettings) -> Hazards:
    import numpy as np

    from deal_hw.testing.faults import FaultRates, FrameFaults

    # A frame of a serial CAN adapter is a line; servos send a packet at a time.
    end = b"\r" if config.transport in ON_CAN else None if config.transport == "dynamixel" else b"\0"
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
        can=config.can,
        servo=config.servo,
        joints=config.joints,
    )
