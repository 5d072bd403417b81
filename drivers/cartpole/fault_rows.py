"""Fault tables of the cart-pole on its wires; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.robots.robot import to_target
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import CanLink
from deal_hw.drivers.cartpole.wire.link import SerialLink
from deal_hw.drivers.cartpole.wire.odrive_frames import Command, pack
from deal_hw.drivers.cartpole.wire.odrive_link import OdriveSettings
from deal_hw.drivers.servo_bus.faults import BusFaults
from deal_hw.motions.behaviours import position_command
from deal_hw.testing.fault_rows import (
    CLOCK_AHEAD,
    CLOCK_BACK,
    CONTROLLER_OFF,
    DUPLICATE,
    EXCHANGED,
    FOREIGN,
    NO_TIME_YET,
    NOT_ARMED,
    OUT_OF_RANGE,
    PLANNED_END,
    SHOWS_S,
    SOON_S,
    Act,
    Expected,
    FaultRig,
    FaultRow,
    FaultTable,
    Lacks,
    in_phases,
    joint_fault,
    killed_cells,
    sound_joints,
)

WATCHDOG_S: Final = 0.2
_PHASES: Final = {PLANNED_END: Lacks("nothing is to be lowered: the motor goes off where the cart is")}
_FOREIGN_HZ: Final = 47.0
"""No multiple of the control rate: in virtual time its commands would always come just before ours."""
_FOREIGN_S: Final = 1.0
"""How long it commands [s]."""
_ASIDE_M: Final = 0.1
"""Where another program wants the cart [m]."""
_NUMBER: Final = 1_000_000
"""First number of its commands."""


def is_stiff(device: Any) -> bool:
    """Return whether the motor has torque and follows targets."""
    return device.mode in ("armed", "homing") and device.armed


_PARTS: Final = OdriveSettings()
_HOMING_M_S: Final = 1.0
"""A second homing counts as a command of servos that a hand has let go: 0.4 m/s by the settings, and 1.0 of
the emulated servo, whose limits are drawn."""
_START_M_S: Final = 0.3
"""A run that holds the cart begins where it is."""


def _jump(seconds: float) -> Act:
    def act(rig: FaultRig) -> None:
        firmware = rig.device.firmware
        # An ODrive has no clock; that of the pole encoder beside it is used.
        getattr(firmware, "encoder", firmware).clock_us += round(seconds * 1e6)

    return act


def _other_host(encode: Callable[[protocol.Target], bytes], *, seen: bool) -> Act:
    """Return what lets another program send targets.

    Args:
        encode: Returns the bytes of a target.
        seen: Whether this host receives them, too.
    """

    def act(rig: FaultRig) -> None:
        numbers = itertools.count(_NUMBER)

        def send() -> None:
            target = to_target(position_command(DESCRIPTION, np.array([_ASIDE_M])), next(numbers))
            rig.world.inject(encode(target), seen=seen)

        rig.world.every(1.0 / _FOREIGN_HZ, send)

    return act


def _end_other(rig: FaultRig) -> None:
    rig.world.calm()


def _odrive_input(target: protocol.Target) -> bytes:
    turns = target.position_um / 1e6 / _PARTS.metres_per_turn
    return pack(_PARTS.drive, Command.SET_INPUT_POS, turns, 0, 0)


def _restart(rig: FaultRig) -> None:
    rig.device.reboot(rig.device.servos[1])


def _double(rig: FaultRig) -> None:
    rig.device.double()


def _let_write(rig: FaultRig) -> None:
    rig.device.let_write(BusFaults())


def _mend_bus(rig: FaultRig) -> None:
    rig.device.mend_bus()


def _table(wire: str, rows: Mapping[str, FaultRow | Lacks], **more: Any) -> FaultTable:
    common: dict[str, FaultRow | Lacks] = {
        EXCHANGED: Lacks("its two readings have other units, and other encoders"),
        CONTROLLER_OFF: Lacks("its firmware is its only controller; its restart is a jump of its clock"),
        CLOCK_AHEAD: FaultRow(begin=_jump(2.0), cells=_CLOCK_CELLS),
        CLOCK_BACK: FaultRow(begin=_jump(-5.0), cells=_CLOCK_CELLS),
    }
    usual = {"start_speed": _START_M_S, **more}
    return FaultTable(
        name=f"cartpole {wire}",
        stiff=is_stiff,
        watchdog_s=WATCHDOG_S,
        phases=_PHASES,
        rows={**common, **rows},
        **usual,
    )


_KILLED: Final = killed_cells(homes_by_motor=True)
_CLOCK_CELLS: Final = in_phases(
    _KILLED,
    connecting=NO_TIME_YET,
    homing=NOT_ARMED,
)


_FOREIGN_CELL: Final = Expected(
    end="passive",
    within_s=_FOREIGN_S + SOON_S,
    why="a motor that homes takes no target; on a bus it is seen before arming, else once one is followed",
)


def _foreign(encode: Callable[[protocol.Target], bytes], *, seen: bool) -> FaultRow:
    return FaultRow(
        begin=_other_host(encode, seen=seen),
        mend=_end_other,
        lasts_s=_FOREIGN_S,
        cells=in_phases(_KILLED, connecting=_FOREIGN_CELL, homing=_FOREIGN_CELL),
    )


SERIAL: Final = _table(
    "serial",
    {
        FOREIGN: _foreign(lambda target: SerialLink().encode(target), seen=False),
        DUPLICATE: Lacks("one device on a cable"),
    },
)
CAN: Final = _table(
    "can",
    {
        FOREIGN: _foreign(lambda target: CanLink().encode(target), seen=True),
        DUPLICATE: Lacks("a second node of one number is refused on connecting (test_cartpole_can_robot.py)"),
    },
)
_FROZEN_CELL: Final = Expected(
    end="passive", within_s=SHOWS_S, since="first command", why="homing takes it for the middle"
)
ODRIVE: Final = _table(
    "odrive",
    {
        FOREIGN: _foreign(_odrive_input, seen=True),
        DUPLICATE: Lacks("a second node of one number is refused on connecting (test_cartpole_odrive.py)"),
        OUT_OF_RANGE: FaultRow(
            begin=joint_fault(out_of_range_after_s=0.0),
            mend=sound_joints,
            cells=in_phases(_KILLED, connecting=_FROZEN_CELL, homing=_FROZEN_CELL),
        ),
    },
)
_RESTARTED_CELL: Final = Expected(
    end="passive",
    within_s=0.3 + SOON_S,
    why="it holds the middle; the arming waits for the servo, which is silent for 0.3 s as it starts",
)
DYNAMIXEL: Final = _table(
    "dynamixel",
    {
        FOREIGN: FaultRow(begin=_let_write, mend=_mend_bus, lasts_s=_FOREIGN_S, cells=_KILLED),
        DUPLICATE: FaultRow(begin=_double, mend=_mend_bus, cells=_KILLED),
        CLOCK_AHEAD: Lacks("a servo's clock of 16 bits can only begin anew, with the servo"),
        CLOCK_BACK: FaultRow(
            begin=_restart, cells=in_phases(_KILLED, homing=NOT_ARMED, arming=_RESTARTED_CELL)
        ),
    },
    start_speed=_HOMING_M_S,
)
