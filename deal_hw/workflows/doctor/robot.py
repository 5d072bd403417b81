"""Checks of `deal-hw doctor` on a robot other than the Go2: identity, states, transport errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from deal_hw.clock import Clock
from deal_hw.control.safety.safety import SafetyConfig
from deal_hw.data.checks.clock_rate import judge_clock
from deal_hw.errors import TransportTimeoutError
from deal_hw.findings import Finding, Severity
from deal_hw.robot import Robot
from deal_hw.workflows.causes import Load, corrupt_advice, late_advice

_FEW_ERRORS = 0.01
"""Accepted share of corrupt and missing states."""
_TRIPS = SafetyConfig().link_error_share
"""Share of errors among the states due at which the safety module ends a run: no work is possible."""
_SLOW = 0.9
_PATIENCE_S = 1.0


def examine_robot(
    name: str, robot: Robot, clock: Clock, seconds: float, local: bool = False
) -> Iterator[Finding]:
    """Yield findings on a robot without motor commands; connecting may switch the motors off.

    Args:
        name: The robot's name.
        robot: Its driver, not connected.
        clock: The clock of its stamps.
        seconds: How long to listen [s].
        local: It is a program on this computer, such as an emulator.

    Raises:
        DealHwError: It cannot be reached, or it is another device.
    """
    silent = "see what the emulator says" if local else "check the device's power and the cable"
    with robot:
        yield Finding("link", Severity.OK, f"{name} answers{_info_text(getattr(robot, 'info', None))}")
        errors = robot.transport_errors
        host_ns: list[int] = []
        device_ns: list[int] = []
        end_ns = clock.now_ns() + round(seconds * 1e9)
        while clock.now_ns() < end_ns:
            try:
                state = robot.read_state(min(_PATIENCE_S, seconds))
            except TransportTimeoutError as error:
                yield Finding("states", Severity.FAIL, str(error), silent)
                return
            host_ns.append(state.receive_ns)
            device_ns.append(state.device_ns)
        errors = robot.transport_errors - errors
    wanted_hz = robot.description.state_rate_hz
    rate_hz = (len(host_ns) - 1) / max((host_ns[-1] - host_ns[0]) * 1e-9, 1e-9)
    yield Finding.judged(
        "states",
        rate_hz < _SLOW * wanted_hz,
        f"{rate_hz:.0f} states a second of {wanted_hz:.0f}",
        late_advice(local, Load.now()),
    )
    share = errors / (errors + len(host_ns))
    text = f"{errors} of {errors + len(host_ns)} states corrupt or lost ({share:.1%})"
    # The measure of the safety module: errors among the states that were due.
    due = max((host_ns[-1] - host_ns[0]) * 1e-9, _PATIENCE_S) * wanted_hz
    if errors > _TRIPS * due:
        advice = corrupt_advice(local, Load.now())
        yield Finding("states", Severity.FAIL, f"{text}; a run trips at {_TRIPS:.0%}", advice)
    else:
        yield Finding.judged("states", share > _FEW_ERRORS, text, corrupt_advice(local, Load.now()))
    yield judge_clock(np.array(host_ns), np.array(device_ns))


def _info_text(info: Any) -> str:
    """Return a robot's own information as text, if it is a dataclass."""
    if not dataclasses.is_dataclass(info) or isinstance(info, type):
        return ""
    words = (f"{name.replace('_', ' ')} {value}" for name, value in dataclasses.asdict(info).items())
    return f": {', '.join(words)}"
