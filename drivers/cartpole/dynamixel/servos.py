"""Reads the register blocks of both servos in one request, and writes goals and torque."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from deal_hw.clock import Clock
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings, Goal
from deal_hw.drivers.servo_bus.bus import Bus
from deal_hw.drivers.servo_bus.registers import (
    BLOCK_ADDRESS,
    BLOCK_BYTES,
    BUS_WATCHDOG,
    FEEDFORWARD_2ND,
    GOAL_CURRENT,
    GOAL_PWM,
    LED,
    POSITION_D_GAIN,
    PROFILE_ACCELERATION,
    PULSES,
    REALTIME_TICK,
    TORQUE_ENABLE,
    WATCHDOG_UNIT_S,
    Block,
)
from deal_hw.errors import FrameError, TransportTimeoutError

WATCHDOG_S = 0.2
"""The belt servo stops itself if it receives nothing for this long [s]."""
_WATCHDOG = round(WATCHDOG_S / WATCHDOG_UNIT_S)


class Servos:
    """Reads and commands both servos.

    Attributes:
        fast: Whether both answer in one packet.
        most_effort: The belt servo's own limit, in the unit of its register.

    Args:
        bus: The bus.
        clock: For waiting.
        settings: Ids and modes of the servos.
    """

    def __init__(self, bus: Bus, clock: Clock, settings: DynamixelSettings) -> None:
        self.fast, self.most_effort = True, 0
        self._bus, self._clock, self._settings = bus, clock, settings
        self._effort = GOAL_CURRENT if settings.mode == "current" else GOAL_PWM

    @property
    def foreign(self) -> str:
        """That another program commands the servos, and what to do; "" if none does."""
        sign = self._bus.watch.sign
        if sign is None:
            return ""
        return sign.text("" if sign.servo is None else part_of(sign.servo, self._settings))

    @property
    def stamp_ns(self) -> int:
        """Arrival time of the newest bytes [ns]."""
        return self._bus.stamp_ns

    def ask(self, servos: Sequence[int]) -> int:
        """Request the blocks of some servos; return the time of the request [ns]."""
        return self._bus.ask(servos, BLOCK_ADDRESS, BLOCK_BYTES, fast=self.fast and len(servos) > 1)

    def take(self, deadline_ns: int) -> dict[int, Block] | None:
        """Return the requested blocks, by id; as :meth:`Bus.take`."""
        found = self._bus.take(deadline_ns)
        return None if found is None else {servo: Block.unpack(data) for servo, data in found.items()}

    def read(self, deadline_ns: int) -> tuple[Block, Block]:
        """Return the blocks of belt and pole servo; repeat the request until they arrive.

        Raises:
            TransportTimeoutError: They did not arrive before the deadline.
        """
        pair = (self._settings.cart_id, self._settings.pole_id)
        while True:
            self.ask(pair)
            try:
                if (blocks := self.take(deadline_ns)) is not None:
                    return blocks[pair[0]], blocks[pair[1]]
            except (TransportTimeoutError, FrameError) as error:
                if self._clock.now_ns() >= deadline_ns:
                    raise TransportTimeoutError(
                        f"cartpole: {error}; check that both servos are powered, and the cable"
                    ) from error
                self._bus.settle()
            else:
                raise TransportTimeoutError("cartpole: the servos' answer did not arrive in time")

    def take_tick(self, deadline_ns: int) -> int | None:
        """Return the belt servo's clock at the reception of a goal [ms]; as :meth:`Bus.take`."""
        found = self._bus.take(deadline_ns)
        return None if found is None else int.from_bytes(found[self._settings.cart_id], "little")

    def send(
        self, goal: Goal, before: Goal | None = None, *, stamped: bool = False, behind: bool = False
    ) -> int:
        """Write a goal, with changed gains and effort limit only; return the time of sending [ns].

        Args:
            goal: The new goal of the belt servo.
            before: Its present goal.
            stamped: Request the servo's clock in the same message; :meth:`take_tick` returns the answer.
            behind: That answer comes after another expected one.
        """
        cart = self._settings.cart_id
        writes = []
        if before is None or (goal.d_gain, goal.p_gain) != (before.d_gain, before.p_gain):
            writes.append((POSITION_D_GAIN.address, {cart: struct.pack("<3H", goal.d_gain, 0, goal.p_gain)}))
        if before is None or goal.effort != before.effort:
            writes.append((self._effort.address, {cart: struct.pack("<H", goal.effort)}))
        motion = struct.pack("<IIi", 0, goal.profile_velocity, goal.position)
        writes.append((PROFILE_ACCELERATION.address, {cart: motion}))
        if not stamped:
            return self._bus.post(writes)
        tick = REALTIME_TICK
        return self._bus.ask((cart,), tick.address, tick.size, fast=False, writes=writes, behind=behind)

    def torque_on(self, goal: Goal, deadline_ns: int) -> None:
        """Give the belt servo a goal, then torque, with its watchdog running.

        Raises:
            TransportTimeoutError: It does not show them before the deadline.
            ProtocolError: It refuses a value.
        """
        cart = self._settings.cart_id
        while True:
            self._bus.post([(TORQUE_ENABLE.address, {cart: b"\0"}), (BUS_WATCHDOG.address, {cart: b"\0"})])
            self._bus.post([(FEEDFORWARD_2ND.address, {cart: bytes(4)})])
            self.send(goal)
            self._bus.post([(BUS_WATCHDOG.address, {cart: bytes([_WATCHDOG])})])
            block, _ = self.read(deadline_ns)
            shown = (block.bus_watchdog, block.i_gain, self._settings.read_goal(block))
            if shown == (_WATCHDOG, 0, goal):
                break
            if self._clock.now_ns() >= deadline_ns:
                raise TransportTimeoutError(f"cartpole: servo {cart} does not confirm its settings: {shown}")
        while True:
            try:
                self._bus.write(cart, TORQUE_ENABLE, 1)
                return
            except (TransportTimeoutError, FrameError):
                if self._clock.now_ns() >= deadline_ns:
                    raise

    def torque_off(self) -> None:
        """Switch the torque of both servos off; never waits."""
        off = dict.fromkeys((self._settings.cart_id, self._settings.pole_id), b"\0")
        self._bus.post([(TORQUE_ENABLE.address, off)])

    def light(self, on: bool) -> None:
        """Switch the pole servo's LED; never waits."""
        self._bus.post([(LED.address, {self._settings.pole_id: bytes([on])})])


def part_of(servo: int, settings: DynamixelSettings) -> str:
    """Return the part of the cart-pole that a servo has, by its id."""
    return "belt" if servo == settings.cart_id else "pole"


class PoleAngle:
    """Counts the pole's turns, because the servo's own count may restart.

    Args:
        settings: The pole servo's zero and sign.
    """

    def __init__(self, settings: DynamixelSettings) -> None:
        self._settings = settings
        self._raw, self._pulses = settings.pole_zero, 0

    def restart(self) -> None:
        """Forget the turns: the next angle is within half a turn of upright."""
        self._raw, self._pulses = self._settings.pole_zero, 0

    def read(self, raw: int) -> float:
        """Return the angle [rad] for a position; 0 is upright, positive towards +x."""
        self._pulses += (raw - self._raw + PULSES // 2) % PULSES - PULSES // 2
        self._raw = raw
        return self._settings.pole_direction * self._pulses * 2 * math.pi / PULSES
