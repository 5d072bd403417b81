"""``deal-hw emulate h1``: how it runs."""

from __future__ import annotations

import threading
from dataclasses import asdict
from typing import TYPE_CHECKING

from deal_hw.drivers.h1.faults import H1FaultPlan
from deal_hw.workflows.emulation.common import choose_truth
from deal_hw.workflows.emulation.settings import EmulateH1Settings
from deal_hw.workflows.emulation.topics import emulate_on_topics, of_every_robot
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.drivers.h1.emulator import H1Device, H1Truth


def emulate_h1(
    config: EmulateH1Settings, stop: threading.Event, cut: threading.Event, *, announce: Say, say: Say
) -> None:
    """Run the emulator until a stop or the given time.

    Args:
        config: What to emulate.
        stop: Ends it.
        cut: Cuts the wire.
        announce: Called with the port first, and with the truth at the end.
        say: Called with a summary at the end.
    """
    truth = _truth(config)
    what = f"profile {truth.profile}, seed {truth.seed}"
    emulate_on_topics(config, lambda: _device(config, truth), what, stop, cut, announce=announce, say=say)


def _truth(config: EmulateH1Settings) -> H1Truth:
    from deal_hw.drivers.h1.emulator import H1Truth
    from deal_hw.drivers.unitree.emulated_humanoid import DEFAULT_RANGE_RATIO

    return choose_truth(config, H1Truth.nominal, H1Truth.draw, H1Truth.from_json, DEFAULT_RANGE_RATIO)


def _device(config: EmulateH1Settings, truth: H1Truth) -> H1Device:
    from deal_hw.drivers.h1.emulator import H1Device

    own = config.h1
    return H1Device(
        truth,
        controller="" if own.controller == "off" else own.controller,
        remote=not own.no_remote,
        plan=H1FaultPlan(**of_every_robot(config), **asdict(own.faults)),
        tick_ms=own.tick_start_ms,
    )
