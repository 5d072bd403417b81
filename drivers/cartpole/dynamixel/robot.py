"""The cart-pole on two Dynamixel servos: the belt servo follows targets, the pole servo is an encoder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.dynamixel.examine import DynamixelInfo, Examination
from deal_hw.drivers.cartpole.dynamixel.homing import Homing
from deal_hw.drivers.cartpole.dynamixel.servos import WATCHDOG_S, PoleAngle, Servos, part_of
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings, Goal
from deal_hw.drivers.servo_bus.bus import Bus
from deal_hw.drivers.servo_bus.polled_robot import MISSES, PolledRobot, status_of, two_servos
from deal_hw.drivers.servo_bus.registers import (
    PROFILE_ONGOING,
    RAD_S_PER_COUNT,
    UNTIL_RESTARTED,
    WATCHDOG_TRIPPED,
    Block,
    explain_hardware_error,
)
from deal_hw.drivers.servo_bus.samples import SampleGrid, TickClock
from deal_hw.errors import FrameError, SafetyError, TransportTimeoutError
from deal_hw.schema import from_values
from deal_hw.transport import Transport
from deal_hw.types import JointCommand, RobotState, Status

_CLEAR_NS = 500_000_000
_AT_STOP_M = 0.001


def _hardware_error(servo: int, block: Block) -> str:
    return f"servo {servo} reports: {explain_hardware_error(block.hardware_error)}; {UNTIL_RESTARTED}"


class _Sent(NamedTuple):
    """A sent command, and its reception by the belt servo's clock [ns]; -1 if the servo did not report it."""

    sequence: int
    sent_ns: int
    goal: Goal
    received_ns: int = -1


class DynamixelCartpole(PolledRobot[Bus]):
    """A cart-pole on two X-series servos.

    A state needs both servos. Every sample holds the belt servo's goals: a command counts as in force once
    the servo shows it. The command's message also requests the servo's clock. This computer's own time stamps
    contain delays of its scheduler and of the adapter. A calibration would read these as motion.

    There are two watchdogs. The belt servo's own (Bus Watchdog) stops it when this computer falls silent. The
    driver switches the torque off when states are read but no commands are sent.

    Attributes:
        info: The servos found on the bus; None before ``connect``.

    Args:
        transport: A byte stream at the servos' baud rate.
        clock: The clock of the transport's stamps.
        settings: Wiring and gearing, as plain values or made.
    """

    description: ClassVar[RobotDescription] = DESCRIPTION
    watchdog_s: ClassVar[float] = WATCHDOG_S
    info: DynamixelInfo | None

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        settings: DynamixelSettings | Mapping[str, Any] | None = None,
    ) -> None:
        if settings is None or isinstance(settings, Mapping):
            settings = from_values(DynamixelSettings, dict(settings or {}))
        self.settings = settings
        bus = Bus(transport, clock, settings.baud_rate, settings.answer_s)
        rate_hz = self.description.state_rate_hz
        super().__init__(transport, clock, bus, rate_hz, "that both servos are powered, and the cable")
        self._servos = (settings.cart_id, settings.pole_id)
        self._turns = dict.fromkeys(self._servos, 0)
        self.servos = Servos(self._bus, clock, settings)
        self._forget()

    def _forget(self) -> None:
        super()._forget()
        self._ticks = {servo: TickClock() for servo in self._servos}
        self._grid = SampleGrid(round(self._period_ns / 1e6))
        self._in_force: tuple[int, int] | None = None
        self._written: Goal | None = None
        self._stamping = False
        self._pair_misses = 0
        self._misses = dict.fromkeys(self._servos, 0)
        self._spoilt = dict.fromkeys(self._servos, 0)
        self._zero = 0
        self._pole = PoleAngle(self.settings)
        self._stopped = False

    def _examine(self) -> DynamixelInfo:
        """Find both servos, check their settings, and switch their torque off."""
        examination = Examination(self._bus, self.settings, self._clock, self._where)
        info = examination.run(self.description.state_rate_hz)
        self.servos.fast, self.servos.most_effort = info.fast_sync_read, info.effort_limit
        return info

    def home(self, timeout_s: float) -> None:
        """Find the middle of the rail, move the cart there, then wait until a hand has set the pole upright.

        The pole servo's LED is lit while this waits for the hand. The torque is off afterwards.

        Raises:
            TransportTimeoutError: The pole was not set, or the servos fell silent.
            SafetyError: The rail is not as long as the settings say, or a servo reports an error.
        """
        self._homed = False
        self.passive()
        self._clear_faults()
        self._homing = True
        try:
            self._zero = Homing(self.servos, self._clock, self.settings, self.description).run(timeout_s)
        finally:
            self._homing = False
            self.passive()
        self._pole.restart()
        self._homed = True

    def arm(self, timeout_s: float) -> None:
        """Switch the belt servo's torque on, with zero gains until the first command; the watchdogs start.

        Raises:
            SafetyError: It was never homed, or a servo reports an error.
        """
        if not self._homed:
            raise SafetyError(
                "cartpole: the servos were not homed since they were connected; call home() first"
            )
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        self._clear_faults()
        cart, _ = self.servos.read(deadline_ns)
        self.servos.torque_on(Goal(0, 0, 0, 1, cart.present_position), deadline_ns)
        self._written = None
        self._states.clear()
        self._asked, self._stamping, self._stopped = (), False, False
        while Status.ARMED not in (state := self.read_state(self._left_s(deadline_ns))).status:
            continue
        self._states.append(state)
        self._armed, self._anchored, self._alive_ns = True, False, self._clock.now_ns()
        self._sent.clear()

    def _clear_faults(self) -> None:
        """Clear a fault if the servos report none now."""
        deadline_ns = self._clock.now_ns() + _CLEAR_NS
        for servo, block in zip(self._servos, self.servos.read(deadline_ns), strict=True):
            if block.hardware_error:
                raise SafetyError(_hardware_error(servo, block))
        self._fault, self._watchdog = "", False
        for clock in self._ticks.values():
            clock.restarted = False
        self._grid.begin()

    def _anchor(self, deadline_ns: int) -> None:
        super()._anchor(deadline_ns)
        self._grid.begin()

    def _whom(self) -> tuple[int, ...]:
        if self._pair_misses < MISSES:
            return self._servos
        servo = min(self._servos, key=lambda servo: self._turns[servo])
        self._turns[servo] += 1
        return (servo,)

    def _request(self, servos: tuple[int, ...]) -> int:
        return self.servos.ask(servos)

    @property
    def _expects(self) -> bool:
        return bool(self._asked) or self._stamping

    def _expect_nothing(self) -> None:
        super()._expect_nothing()
        self._stamping = False

    def _take_stamp(self, deadline_ns: int) -> None:
        """Receive the belt servo's clock at its newest command."""
        try:
            tick_ms = self.servos.take_tick(deadline_ns)
        except (TransportTimeoutError, FrameError):
            self._stamping = False
            return
        if tick_ms is None:
            return
        self._stamping, sent = False, self._sent[-1]
        time_ms = self._ticks[self._servos[0]].read(tick_ms, sent.sent_ns)
        # Ticks are whole milliseconds: the command arrived within this one.
        self._sent[-1] = sent._replace(received_ns=time_ms * 1_000_000 + 500_000)

    def _take(self, deadline_ns: int) -> None:
        if not self._asked:
            self._take_stamp(deadline_ns)
            return
        try:
            blocks = self.servos.take(deadline_ns)
        except (TransportTimeoutError, FrameError) as error:
            self._latch(self.servos.foreign)
            self._miss(isinstance(error, FrameError))
            return
        if blocks is None:
            return
        asked, self._asked = self._asked, ()
        self._poller.answered()
        for servo in asked:
            self._misses[servo] = self._spoilt[servo] = 0
        if len(asked) == 2 or not any(self._misses.values()):
            self._pair_misses = 0
        if len(asked) == 2 or (self._stopped and asked == self._servos[:1]):
            self._receive(blocks)

    def _miss(self, spoilt: bool) -> None:
        """Count an answer that is missing, or spoilt; name the servo of which this is known."""
        asked, self._asked = self._asked, ()
        if len(asked) == 2:
            self._pair_misses += 1
            if self._pair_misses == MISSES:
                # Until each has answered alone, neither is known to be present.
                self._misses = dict.fromkeys(self._servos, 1)
                self._spoilt = dict.fromkeys(self._servos, 0)
                self._turns = dict.fromkeys(self._servos, 0)
            return
        servo = asked[0]
        self._misses[servo] += 1
        self._spoilt[servo] += spoilt
        if self._misses[servo] > MISSES:
            part = part_of(servo, self.settings)
            self._latch(
                two_servos(servo, part)
                if self._spoilt[servo] >= MISSES
                else f"servo {servo} ({part}) stopped answering: it restarted, or lost its supply or its "
                "cable. Check both, then start again"
            )

    def _receive(self, blocks: Mapping[int, Block]) -> None:
        times = {
            servo: self._ticks[servo].read(b.tick_ms, self._poller.asked_ns) for servo, b in blocks.items()
        }
        self._judge(blocks)
        self._latch(self.servos.foreign)
        cart, time_ms = blocks[self._servos[0]], times[self._servos[0]]
        shift_ms = self._grid.place(time_ms)
        if shift_ms is None:
            return
        device_ns = (time_ms + shift_ms) * 1_000_000
        self._follow(cart, time_ms * 1_000_000, device_ns)
        s = self.settings
        cart_m_s = cart.present_velocity * s.metres_s_per_count * s.cart_direction
        cart_m = (cart.present_position - self._zero) * s.metres_per_pulse + cart_m_s * shift_ms * 1e-3
        pole = blocks.get(self._servos[1])
        # Only a passive robot gets here without its pole servo: then only the torque matters.
        pole_rad = pole_rad_s = math.nan
        if pole is not None:
            pole_rad_s = pole.present_velocity * RAD_S_PER_COUNT * s.pole_direction
            pole_rad = self._pole.read(pole.present_position) + pole_rad_s * shift_ms * 1e-3
        effort = (
            cart.present_current * s.effort_per_current * s.cart_direction if s.mode == "current" else 0.0
        )
        sequence, received_ns = self._in_force or (-1, 0)
        self._states.append(
            RobotState(
                position=np.array([cart_m, pole_rad]),
                velocity=np.array([cart_m_s, pole_rad_s]),
                effort=np.array([effort, 0.0]),
                receive_ns=self.servos.stamp_ns,
                device_ns=device_ns,
                sequence=self._grid.number,
                command_sequence=sequence,
                command_age_ns=device_ns - received_ns if self._in_force else -1,
                status=self._status(cart, cart_m),
            )
        )

    def _judge(self, blocks: Mapping[int, Block]) -> None:
        """Latch a servo's reported error, restart or lost torque."""
        for servo, block in blocks.items():
            if block.hardware_error:
                self._latch(_hardware_error(servo, block))
            if self._ticks[servo].restarted:
                self._lose_position(
                    f"servo {servo} restarted: its torque is off and its position is lost. Check the supply "
                    "(a motor that starts may pull it down). Start again; the servos are then homed again"
                )
        if self._armed and not blocks[self._servos[0]].torque_enable:
            self._lose_position(
                f"servo {self._servos[0]} lost its torque: it restarted, or another program uses the bus. "
                "End other programs, then start again"
            )

    def _lose_position(self, fault: str) -> None:
        self._homed = self._armed = False
        self._latch(fault)

    def _follow(self, cart: Block, sampled_ns: int, device_ns: int) -> None:
        """Find the command that the belt servo follows, and its reception time on the servo's clock."""
        goal = self.settings.read_goal(cart)
        asked = [sent for sent in self._sent if sent.sent_ns <= self._poller.asked_ns]
        if not asked:
            return
        found = next((sent for sent in reversed(asked) if sent.goal == goal), None)
        if found is not asked[-1] and asked[-1].sequence != self._missed_command:
            self._missed_command = asked[-1].sequence
            self._lost_commands += 1
            self._written = None
        if found is None or (self._in_force is not None and self._in_force[0] == found.sequence):
            return
        received_ns = found.received_ns
        if received_ns < 0:
            received_ns = min(sampled_ns - (self._poller.asked_ns - found.sent_ns), device_ns)
        if received_ns > device_ns:
            # The sample was moved back to its point on the grid, before the command arrived.
            return
        self._in_force = (found.sequence, received_ns)
        while self._sent[0] is not found:
            self._sent.popleft()

    def _status(self, cart: Block, cart_m: float) -> Status:
        return status_of(
            {
                Status.ARMED: cart.torque_enable,
                Status.HOMED: self._homed,
                Status.HOMING: self._homing,
                Status.WATCHDOG: self._watchdog or cart.bus_watchdog == WATCHDOG_TRIPPED,
                Status.EFFORT_CLAMPED: self.settings.mode == "current"
                and 0 < cart.goal_current <= abs(cart.present_current),
                Status.SPEED_CLAMPED: cart.torque_enable and cart.moving_status & PROFILE_ONGOING,
                Status.AT_END_STOP: self._homed and abs(cart_m) >= 0.5 * self.settings.rail_m - _AT_STOP_M,
                Status.FAULT: self._fault,
            }
        )

    def send_command(self, command: JointCommand) -> JointCommand:
        """Send a position target; no register takes a velocity target or a feed-forward effort.

        Raises:
            SafetyError: A value is not finite.
        """
        goal = self.settings.to_goal(command, self._zero, self.servos.most_effort)
        sent_ns = self.servos.send(goal, self._written, stamped=True, behind=bool(self._asked))
        self._stamping = True
        self._written, self._alive_ns = goal, sent_ns
        self._sequence += 1
        self._sent.append(_Sent(self._sequence, sent_ns, goal))
        return self.settings.from_goal(goal, self._zero)

    def passive(self) -> None:
        """Switch the torque of both servos off; sent once, never waits.

        States received before are discarded, and so is an answer that is still expected.
        """
        self._disarm()
        self._stopped = True
        self.servos.torque_off()
