"""``deal-hw emulate`` of a humanoid on a crane: how it runs."""

from __future__ import annotations

import functools
import threading
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from deal_hw.errors import ConfigurationError
from deal_hw.robots import robot_entry
from deal_hw.workflows.emulation.common import choose_truth
from deal_hw.workflows.emulation.settings import EmulateG1Settings, EmulateHungSettings
from deal_hw.workflows.emulation.topics import emulate_on_topics, of_every_robot
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.drivers.unitree.emulated_humanoid import HumanoidTruth
    from deal_hw.drivers.unitree.hung_device import HungDevice


def emulate_hung(
    config: EmulateHungSettings, stop: threading.Event, cut: threading.Event, *, announce: Say, say: Say
) -> None:
    """Run the emulator until a stop or the given time; arguments as for :func:`emulate_on_topics`."""
    truth = _truth(config)
    emulate_on_topics(config, truth, lambda: _device(config, truth), stop, cut, announce=announce, say=say)


def _truth(config: EmulateHungSettings) -> HumanoidTruth:
    from deal_hw.drivers.unitree.emulated_humanoid import DEFAULT_RANGE_RATIO

    entry = robot_entry(config.robot)
    kind: type[HumanoidTruth] = entry.load(entry.truth)
    nominal = functools.partial(kind.nominal, robot=config.robot)
    draw = functools.partial(kind.draw, robot=config.robot)
    truth = choose_truth(config, nominal, draw, kind.from_json, DEFAULT_RANGE_RATIO)
    if truth.robot != config.robot:
        raise ConfigurationError(
            f"{config.truth_from} holds the truth of a {truth.robot}, not of a {config.robot}"
        )
    return truth


def _device(config: EmulateHungSettings, truth: Any) -> HungDevice[Any]:
    own, faults = config.own, {**of_every_robot(config), **asdict(config.own.faults)}
    common: dict[str, Any] = {
        "controller": "" if own.controller == "off" else own.controller,
        "remote": not own.no_remote,
        "tick_ms": own.tick_start_ms,
    }
    if isinstance(config, EmulateG1Settings):
        from deal_hw.drivers.g1.emulator.device import G1Device
        from deal_hw.drivers.g1.emulator.faults import G1FaultPlan

        return G1Device(truth, mode_machine=config.g1.mode_machine, plan=G1FaultPlan(**faults), **common)
    from deal_hw.drivers.h1.emulator import H1Device
    from deal_hw.drivers.h1.faults import H1FaultPlan

    return H1Device(truth, plan=H1FaultPlan(**faults), **common)
