"""Converts between SI units in floats and the integers of the wire."""

from __future__ import annotations

import math

import numpy as np

from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.errors import SafetyError
from deal_hw.types import JointCommand, RobotState, Status

_U16, _U32, _I32 = 0xFFFF, 0xFFFF_FFFF, 0x7FFF_FFFF


def to_target(command: JointCommand, sequence: int) -> protocol.Target:
    """Round a command to the wire's integers; a value beyond its field's range is clipped.

    Raises:
        SafetyError: A value is not finite.
    """
    return protocol.Target(
        sequence=sequence,
        position_um=_integer(command.position_target, 1e6, -_I32, _I32, "position_target"),
        stiffness_mn_m=_integer(command.stiffness, 1e3, 0, _U32, "stiffness"),
        damping_mns_m=_integer(command.damping, 1e3, 0, _U32, "damping"),
        effort_limit_mn=_integer(command.effort_limit, 1e3, 0, _U16, "effort_limit"),
        speed_limit_um_s=_integer(command.speed_limit, 1e6, 0, _U32, "speed_limit"),
    )


def from_target(target: protocol.Target) -> JointCommand:
    """Return a target as a command in SI units; quantities that the wire does not carry are 0."""
    return JointCommand(
        position_target=np.array([target.position_um / 1e6]),
        velocity_target=np.zeros(1),
        stiffness=np.array([target.stiffness_mn_m / 1e3]),
        damping=np.array([target.damping_mns_m / 1e3]),
        effort=np.zeros(1),
        effort_limit=np.array([target.effort_limit_mn / 1e3]),
        speed_limit=np.array([target.speed_limit_um_s / 1e6]),
    )


def to_robot_state(state: protocol.State, receive_ns: int) -> RobotState:
    """Return a state frame in SI units."""
    known = state.command_sequence != protocol.NO_COMMAND
    return RobotState(
        position=np.array([state.cart_um / 1e6, state.pole_urad / 1e6]),
        velocity=np.array([state.cart_um_s / 1e6, state.pole_urad_s / 1e6]),
        effort=np.array([state.effort_mn / 1e3, 0.0]),
        receive_ns=receive_ns,
        device_ns=state.device_us * 1000,
        sequence=state.sequence,
        command_sequence=state.command_sequence if known else -1,
        command_age_ns=state.command_age_us * 1000 if known else -1,
        status=Status(state.status),
    )


def _integer(
    values: np.ndarray[tuple[int, ...], np.dtype[np.float64]], scale: float, low: int, high: int, name: str
) -> int:
    value = float(values[0])
    if not math.isfinite(value):
        raise SafetyError(f"cartpole: {name} is {value}; nothing was sent")
    return min(max(round(value * scale), low), high)
