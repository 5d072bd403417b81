"""``deal-hw emulate g1``: how it runs."""

from __future__ import annotations

import functools
import threading
from dataclasses import asdict
from typing import TYPE_CHECKING

from deal_hw.drivers.g1.emulator.faults import G1FaultPlan
from deal_hw.errors import ConfigurationError
from deal_hw.workflows.emulation.common import choose_truth
from deal_hw.workflows.emulation.settings import EmulateG1Settings
from deal_hw.workflows.emulation.topics import emulate_on_topics, of_every_robot
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.drivers.g1.emulator.device import G1Device
    from deal_hw.drivers.g1.emulator.truth import G1Truth


def emulate_g1(
    config: EmulateG1Settings, stop: threading.Event, cut: threading.Event, *, announce: Say, say: Say
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


def _truth(config: EmulateG1Settings) -> G1Truth:
    from deal_hw.drivers.g1.emulator.truth import G1Truth, draw_truth, nominal_truth
    from deal_hw.drivers.unitree.emulated_humanoid import DEFAULT_RANGE_RATIO

    nominal = functools.partial(nominal_truth, robot=config.robot)
    draw = functools.partial(draw_truth, robot=config.robot)
    truth = choose_truth(config, nominal, draw, G1Truth.from_json, DEFAULT_RANGE_RATIO)
    if truth.robot != config.robot:
        raise ConfigurationError(
            f"{config.truth_from} holds the truth of a {truth.robot}, not of a {config.robot}"
        )
    return truth


def _device(config: EmulateG1Settings, truth: G1Truth) -> G1Device:
    from deal_hw.drivers.g1.emulator.device import G1Device

    own = config.g1
    plan = G1FaultPlan(**of_every_robot(config), **asdict(own.faults))
    return G1Device(
        truth,
        controller="" if own.controller == "off" else own.controller,
        mode_machine=own.mode_machine,
        remote=not own.no_remote,
        plan=plan,
        tick_ms=own.tick_start_ms,
    )
