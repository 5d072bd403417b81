"""Sending the command in force again."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import Repeater
from deal_hw.drivers.cartpole.description import DESCRIPTION

MS = 1_000_000


class Wire:
    """Counts what a robot would send again; a Robot as far as the repeater looks."""

    def __init__(self, rate_hz: float, clock: VirtualClock) -> None:
        self.description = dataclasses.replace(DESCRIPTION, repeat_rate_hz=rate_hz)
        self.stamps: list[int] = []
        self._clock = clock

    def repeat(self) -> None:
        self.stamps.append(self._clock.now_ns())


@pytest.fixture
def rig() -> SimpleNamespace:
    """A repeater of 500 Hz at time 0."""
    clock = VirtualClock()
    wire = Wire(500.0, clock)
    return SimpleNamespace(clock=clock, wire=wire, repeater=Repeater(cast(Any, wire), clock))


def test_nothing_is_repeated_before_the_first_command(rig: SimpleNamespace) -> None:
    """No command, nothing due, and the loop may sleep to its deadline."""
    rig.clock.advance_ns(100 * MS)
    rig.repeater.repeat_if_due()
    assert rig.wire.stamps == []
    assert (rig.repeater.sent_ns, rig.repeater.wake_ns(7)) == (-1, 7)


def test_a_command_is_repeated_every_period(rig: SimpleNamespace) -> None:
    """After a command at 0, repeats are due at 2, 4, 6 ms."""
    rig.repeater.note_sent(0)
    while rig.clock.now_ns() < 7 * MS:
        rig.clock.sleep_until_ns(rig.repeater.wake_ns(7 * MS))
        rig.repeater.repeat_if_due()
    assert rig.wire.stamps == [2 * MS, 4 * MS, 6 * MS]
    assert rig.repeater.sent_ns == 6 * MS


def test_missed_periods_are_skipped_and_the_grid_stays(rig: SimpleNamespace) -> None:
    """One repeat after a stall of 7 ms, and the next at 8 ms, on the old grid."""
    rig.repeater.note_sent(0)
    rig.clock.advance_ns(7 * MS)
    rig.repeater.repeat_if_due()
    assert rig.wire.stamps == [7 * MS]
    assert rig.repeater.wake_ns(100 * MS) == 8 * MS


def test_stopped_it_repeats_nothing(rig: SimpleNamespace) -> None:
    """After stop only a new command starts it again."""
    rig.repeater.note_sent(0)
    rig.repeater.stop()
    rig.clock.advance_ns(10 * MS)
    rig.repeater.repeat_if_due()
    assert rig.wire.stamps == []
    rig.repeater.note_sent(rig.clock.now_ns())
    assert rig.repeater.wake_ns(100 * MS) == 12 * MS


def test_a_robot_that_wants_no_repeats_gets_none() -> None:
    """Rate 0: each command is sent once."""
    clock = VirtualClock()
    wire = Wire(0.0, clock)
    repeater = Repeater(cast(Any, wire), clock)
    repeater.note_sent(0)
    clock.advance_ns(1000 * MS)
    repeater.repeat_if_due()
    assert wire.stamps == []
    assert repeater.wake_ns(5) == 5
