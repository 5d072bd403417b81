"""``deal-hw emulate`` of a robot whose emulator a plug-in brings: how it runs."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deal_hw.drivers.ros2.faults import ControllerFaults
from deal_hw.drivers.servo_arm.faults import ArmFaults
from deal_hw.robots import robot_entry
from deal_hw.robots.connect import reached_over
from deal_hw.robots.emulation import Emulation, EmulatorRequest
from deal_hw.testing.faults import FaultRates
from deal_hw.workflows.emulation.common import read_truth, serve
from deal_hw.workflows.emulation.settings import EmulateArmSettings, EmulatePlugInSettings
from deal_hw.workflows.say import Say


def emulate_plug_in(
    config: EmulatePlugInSettings, stop: threading.Event, cut: threading.Event, *, announce: Say
) -> None:
    """Run the emulator until a stop, the given time or the end of its port.

    Args:
        config: What to emulate.
        stop: Ends it.
        cut: Cuts the wire.
        announce: Called with the port first, and with the truth at the end.

    Raises:
        ConfigurationError: The robot has no emulator on this wire.
    """
    wire = config.transport or robot_entry(config.robot).emulated_on[0]
    entry, chosen = reached_over(config.robot, wire)
    emulation: Emulation = entry.load(chosen.emulator)(request_of(config, wire))
    what = f"profile {config.profile}, seed {config.seed}"
    serve(emulation, config, what, stop, cut, announce=announce, report=emulation.report)


def request_of(config: EmulatePlugInSettings, wire: str) -> EmulatorRequest:
    """Return what is asked of the emulator."""
    truth: Mapping[str, Any] | None = None
    if config.truth_from is not None:
        truth = read_truth(Path(config.truth_from), dict)
    return EmulatorRequest(
        wire=wire,
        profile=config.profile,
        seed=config.seed,
        range_ratio=config.range_ratio,
        nominal=config.nominal,
        truth=truth,
        rates=FaultRates(corrupt=config.corrupt, drop=config.drop, duplicate=config.duplicate),
        freeze_after_s=config.freeze_after_s,
        cut_after_s=config.cut_after_s,
        cut_s=config.cut_s,
        port=config.port or "",
        link=None if config.link is None else Path(config.link),
        vanish_after_s=config.vanish_after_s,
        return_after_s=config.return_after_s,
        joints=config.joints,
        servos=config.servos if isinstance(config, EmulateArmSettings) else ArmFaults(),
        controller=config.controller if isinstance(config, EmulateArmSettings) else ControllerFaults(),
    )
