"""Goals that servos show: ours, however many commands are lost, or another master's."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from deal_hw.drivers.servo_bus.master_watch import KEPT, WINDOW_NS, MasterWatch
from deal_hw.drivers.servo_bus.registers import BLOCK_ADDRESS, BLOCK_BYTES, GOAL_POSITION

PERIOD_NS = 20_000_000
OURS, ODD, OTHER = 2000, 2500, 2600


class Bus:
    """Servos 1 and 2 whose goals are written and read, 50 times a second."""

    def __init__(self) -> None:
        self.watch = MasterWatch(GOAL_POSITION, lambda data: int.from_bytes(data, "little", signed=True))
        self.now_ns = 0
        self.read(1500)

    def write(self, goal: int) -> None:
        """Write both servos' goals, after a period."""
        self.now_ns += PERIOD_NS
        data = goal.to_bytes(4, "little", signed=True)
        self.watch.wrote(GOAL_POSITION.address, {1: data, 2: data})

    def read(self, first: int, second: int | None = None) -> bool:
        """Read a block that has these goals; return whether another master is known."""
        found = {}
        for servo, goal in ((1, first), (2, first if second is None else second)):
            block = bytearray(BLOCK_BYTES)
            at = GOAL_POSITION.address - BLOCK_ADDRESS
            block[at : at + 4] = goal.to_bytes(4, "little", signed=True)
            found[servo] = bytes(block)
        self.watch.read(BLOCK_ADDRESS, found, self.watch.commands, self.now_ns)
        return self.watch.sign is not None


@given(st.lists(st.tuples(st.integers(0, 4095), st.booleans(), st.booleans()), max_size=KEPT))
def test_lost_commands_are_no_other_master(commands: list[tuple[int, bool, bool]]) -> None:
    """Each servo has one of our goals or the one before them, whichever commands it missed."""
    bus, goals = Bus(), [1500, 1500]
    for goal, *taken in commands:
        bus.write(goal)
        goals = [goal if took else old for took, old in zip(taken, goals, strict=True)]
        assert not bus.read(*goals)


def test_one_goal_that_nobody_sent_is_none() -> None:
    """It may be a corrupt byte: in an answer it is gone with the next, in a command with the next command."""
    bus = Bus()
    bus.write(OURS)
    for _ in range(4):
        assert not bus.read(ODD)
    bus.write(OURS)
    assert not bus.read(OURS)


def test_two_goals_that_nobody_sent_are_another_master() -> None:
    """Two different ones, without a command of ours between them."""
    bus = Bus()
    bus.write(OURS)
    assert not bus.read(OURS, ODD)
    assert bus.read(OURS, OTHER)
    sign = bus.watch.sign
    assert sign is not None and (sign.servo, sign.goal) == (2, OTHER)
    text = sign.text("elbow")
    assert text.startswith("another program commands this bus: servo 2 (elbow) has the goal 2600 ticks")
    assert "torque" in text and "end it" in text


def test_the_same_goal_after_a_newer_command_is_another_master() -> None:
    """As of a program that holds one pose; commands that do not write goals do not count."""
    bus = Bus()
    bus.write(OURS)
    assert not bus.read(ODD)
    bus.watch.wrote(64, {1: b"\1", 2: b"\1"})
    assert not bus.read(ODD)
    bus.write(OURS)
    assert bus.read(ODD)


def test_the_same_goal_after_the_newest_command_was_taken_is_another_master() -> None:
    """No command of ours can have become it. Once may still be a corrupt answer."""
    bus = Bus()
    bus.write(OURS)
    assert not bus.read(OURS)
    assert not bus.read(OURS, ODD)
    assert bus.read(OURS, ODD)


def test_a_second_sign_comes_within_some_seconds() -> None:
    """On a line that passes a corrupt byte now and then no run trips."""
    bus = Bus()
    for _ in range(3):
        bus.write(OURS)
        assert not bus.read(ODD)
        bus.now_ns += WINDOW_NS


def test_a_goal_that_was_ours_long_ago_is_anothers() -> None:
    """A servo that showed a newer goal does not go back by itself."""
    bus = Bus()
    for goal in range(KEPT + 2):
        bus.write(goal)
        bus.read(goal)
    assert not bus.read(0)
    assert bus.read(1500)


def test_goals_count_from_the_first_write_on() -> None:
    """Before it a servo has any goal; and again after the motors were made passive."""
    bus = Bus()
    assert not bus.read(ODD) and not bus.read(OTHER)
    bus.write(OURS)
    bus.watch.restart()
    assert not bus.read(1) and not bus.read(2)


def test_two_packets_that_nobody_sent_are_another_master() -> None:
    """Where the adapter receives them."""
    bus = Bus()
    bus.watch.request("a packet (sync write) to all servos", 0)
    assert bus.watch.sign is None
    bus.watch.request("a packet (sync write) to all servos", PERIOD_NS)
    assert bus.watch.sign is not None
    assert "on the bus came a packet (sync write) to all servos, which this run did not send" in (
        bus.watch.sign.text()
    )
