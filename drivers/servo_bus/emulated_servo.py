"""One emulated X-series servo: its control table, and its answers to instructions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus import xl330
from deal_hw.drivers.servo_bus.packets import ALERT, Error
from deal_hw.drivers.servo_bus.registers import (
    BAUD_RATES,
    BLOCK_ADDRESS,
    BLOCK_BYTES,
    PULSES,
    RETURN_DELAY_UNIT_S,
    TICK_PERIOD_MS,
    WATCHDOG_TRIPPED,
    WATCHDOG_UNIT_S,
    Block,
    OperatingMode,
    Register,
)
from deal_hw.drivers.servo_bus.servos_side import TWIN_TICKS

BOOT_NS: Final = 300_000_000
"""How long a starting servo is silent [ns]."""
KEEP_ID, KEEP_ID_AND_BAUD, RESET_ALL = 1, 2, 0xFF
"""What a factory reset keeps."""
_ONE_TURN_OFFSET: Final = 1024
"""A larger homing offset is ignored in position control mode (e-Manual, Homing Offset)."""
_VOLTAGE_ERROR: Final = 1
OVERLOAD_ERROR: Final = 1 << 5
"""Bit of Hardware Error Status."""
_INDIRECT = range(r.INDIRECT_DATA.address, r.INDIRECT_DATA.address + r.INDIRECT_COUNT)


class EmulatedServo:
    """A servo's registers, with the rules by which they may be read and written.

    It is set up as it leaves the factory, except for id, baud rate, operating mode and return delay (0).

    Attributes:
        present: False for an unplugged servo.
        protocol: 2, or 1 for an old firmware with protocol 1.0 only.

    Args:
        servo: Its id.
        baud_rate: Its baud rate.
        mode: Its operating mode.
        model: Its model number.
    """

    def __init__(
        self,
        servo: int,
        baud_rate: int,
        *,
        mode: int = OperatingMode.EXTENDED_POSITION,
        model: int = xl330.MODEL,
    ) -> None:
        self.present, self.protocol = True, 2
        self._table = bytearray(xl330.TABLE_BYTES)
        self._registered: tuple[int, bytes] | None = None
        self._start_ns = self._silent_until_ns = self._heard_ns = 0
        self._shaft = self._base = 0
        for register, value in (
            *xl330.EEPROM.items(),
            (r.MODEL_NUMBER, model),
            (r.ID, servo),
            (r.BAUD_RATE, BAUD_RATES.index(baud_rate)),
            (r.RETURN_DELAY_TIME, 0),
            (r.OPERATING_MODE, mode),
        ):
            self.put(register, value)
        self._start()

    def twin(self) -> EmulatedServo:
        """Return another servo with the same id, without torque, which stands elsewhere."""
        twin = EmulatedServo(
            self.id, self.baud_rate, mode=self.get(r.OPERATING_MODE), model=self.get(r.MODEL_NUMBER)
        )
        twin.sense(self._shaft + TWIN_TICKS)
        twin.forget_turns()
        return twin

    def get(self, register: Register) -> int:
        """Return a register, with its sign if a host may write negative values."""
        return _integer(self._table, register)

    def put(self, register: Register, value: int) -> None:
        """Set a register, without the rules for hosts."""
        data = (value % (1 << 8 * register.size)).to_bytes(register.size, "little")
        self._table[register.address : register.address + register.size] = data

    @property
    def id(self) -> int:
        """Its id."""
        return self.get(r.ID)

    @property
    def baud_rate(self) -> int:
        """Its baud rate."""
        return BAUD_RATES[self.get(r.BAUD_RATE)]

    @property
    def return_delay_s(self) -> float:
        """Delay before its answers [s]."""
        return self.get(r.RETURN_DELAY_TIME) * RETURN_DELAY_UNIT_S

    @property
    def watchdog_tripped(self) -> bool:
        """Whether its watchdog has stopped it."""
        return self.get(r.BUS_WATCHDOG) % 256 == WATCHDOG_TRIPPED

    @property
    def alert(self) -> int:
        """Alert bit of every status packet."""
        return ALERT if self.get(r.HARDWARE_ERROR) else 0

    @property
    def block(self) -> Block:
        """The registers that a driver may read with every sample."""
        return Block.unpack(bytes(self._table[BLOCK_ADDRESS : BLOCK_ADDRESS + BLOCK_BYTES]))

    def awake(self, now_ns: int) -> bool:
        """Whether it receives packets."""
        return self.present and now_ns >= self._silent_until_ns

    def answers(self, *, read: bool) -> bool:
        """Whether it answers, by its Status Return Level."""
        return self.get(r.STATUS_RETURN_LEVEL) >= (1 if read else 2)

    # The shaft.

    @property
    def goal_shaft(self) -> int:
        """Goal Position as a position of the shaft [pulses]."""
        return self.get(r.GOAL_POSITION) - self._offset + self._base

    def sense(
        self,
        shaft: int,
        *,
        velocity: int = 0,
        current: int = 0,
        pwm: int = 0,
        trajectory: tuple[int, int] | None = None,
        status: int = 0,
    ) -> None:
        """Set the registers of what the servo measures and wants.

        Args:
            shaft: Position of the shaft, over all its turns [pulses].
            velocity: [0.229 rev/min].
            current: [mA on an XL330].
            pwm: [1/885 of the voltage].
            trajectory: Position of the shaft and velocity that the profile asks for; None: those measured.
            status: Moving Status.
        """
        self._shaft = shaft
        self._show_position()
        wanted, wanted_velocity = trajectory or (shaft, velocity)
        most = self.get(r.PWM_LIMIT)
        moving = abs(velocity) > self.get(r.MOVING_THRESHOLD) or status & r.PROFILE_ONGOING
        for register, value in (
            (r.PRESENT_VELOCITY, velocity),
            (r.PRESENT_CURRENT, current),
            (r.PRESENT_PWM, min(max(pwm, -most), most)),
            (r.POSITION_TRAJECTORY, wanted - self._base + self._offset),
            (r.VELOCITY_TRAJECTORY, wanted_velocity),
            (r.MOVING, int(bool(moving))),
            (r.MOVING_STATUS, status),
        ):
            self.put(register, value)

    def forget_turns(self) -> None:
        """Count from the present revolution; the goal moves with the position."""
        turns = (self._shaft - self._base) // PULSES * PULSES
        self._base += turns
        self.put(r.GOAL_POSITION, self.get(r.GOAL_POSITION) - turns)
        self._show_position()

    @property
    def _offset(self) -> int:
        offset = self.get(r.HOMING_OFFSET)
        ignored = self.get(r.OPERATING_MODE) == OperatingMode.POSITION and abs(offset) > _ONE_TURN_OFFSET
        return 0 if ignored else offset

    def _show_position(self) -> None:
        self.put(r.PRESENT_POSITION, self._shaft - self._base + self._offset)

    # Restarts and faults.

    def reboot(self, now_ns: int) -> None:
        """Restart: registers outside the EEPROM are reset, hardware errors and turns too."""
        self._base += (self._shaft - self._base) // PULSES * PULSES
        self._start()
        self._silent_until_ns = self._start_ns = now_ns + BOOT_NS

    def factory_reset(self, keep: int, now_ns: int) -> None:
        """Set the EEPROM to its factory values, except what is kept, and restart."""
        kept = {KEEP_ID: (r.ID,), KEEP_ID_AND_BAUD: (r.ID, r.BAUD_RATE)}.get(keep, ())
        for register, value in xl330.EEPROM.items():
            if register not in (r.MODEL_NUMBER, r.FIRMWARE_VERSION, *kept):
                self.put(register, value)
        self.reboot(now_ns)

    def fail(self, bits: int) -> None:
        """Report a hardware error; the torque goes off if Shutdown has one of its bits."""
        self.put(r.HARDWARE_ERROR, self.get(r.HARDWARE_ERROR) | bits)
        if bits & self.get(r.SHUTDOWN):
            self.put(r.TORQUE_ENABLE, 0)

    def tick(self, now_ns: int, silence_ns: int) -> None:
        """Advance its clock, its protections and its watchdog.

        Args:
            now_ns: Present time [ns].
            silence_ns: Time without a packet on the bus [ns]; an absent or starting servo receives none.
        """
        if self.awake(now_ns):
            self._heard_ns = now_ns - silence_ns
        self.put(r.REALTIME_TICK, max(0, now_ns - self._start_ns) // 1_000_000 % TICK_PERIOD_MS)
        if not self.get(r.MIN_VOLTAGE_LIMIT) <= xl330.VOLTAGE <= self.get(r.MAX_VOLTAGE_LIMIT):
            self.fail(_VOLTAGE_ERROR)
        limit = self.get(r.BUS_WATCHDOG)
        silence_ns = now_ns - self._heard_ns
        if self.get(r.TORQUE_ENABLE) and limit > 0 and silence_ns > limit * WATCHDOG_UNIT_S * 1e9:
            self.put(r.BUS_WATCHDOG, WATCHDOG_TRIPPED)

    def _start(self) -> None:
        self._table[xl330.FIRST_RAM :] = bytes(xl330.TABLE_BYTES - xl330.FIRST_RAM)
        for register, value in xl330.RAM.items():
            self.put(register, value)
        self._registered = None
        self._reset_goals()

    def _reset_goals(self) -> None:
        self.put(r.GOAL_PWM, self.get(r.PWM_LIMIT))
        self.put(r.GOAL_CURRENT, self.get(r.CURRENT_LIMIT))
        self._show_position()
        self.put(r.GOAL_POSITION, self.block.present_position)

    # What hosts read and write.

    def read(self, address: int, size: int) -> tuple[int, bytes]:
        """Return the error and the bytes of some registers."""
        if address + size > xl330.TABLE_BYTES or not size:
            return Error.ACCESS, b""
        return Error.NONE, bytes(self._table[at] for at in self._places(address, size))

    def write(self, address: int, data: bytes) -> int:
        """Write registers as a host; return the error, after which nothing was written."""
        error = self._refusal(address, data)
        if error is not Error.NONE:
            return error
        mode, goals = self.get(r.OPERATING_MODE), False
        for at, value in zip(list(self._places(address, len(data))), data, strict=True):
            self._table[at] = value
            goals |= at in xl330.GOALS
        if self.get(r.OPERATING_MODE) != mode:
            for register, value in xl330.GAINS.items():
                self.put(register, value)
            self._reset_goals()
        if goals and self.get(r.DRIVE_MODE) & r.TORQUE_BY_GOAL and not self.get(r.HARDWARE_ERROR):
            self.put(r.TORQUE_ENABLE, 1)
        self._show_position()
        return Error.NONE

    def register_write(self, address: int, data: bytes) -> int:
        """Keep a write for :meth:`act`."""
        error = self._refusal(address, data)
        if error is Error.NONE:
            self._registered = (address, data)
            self.put(r.REGISTERED_INSTRUCTION, 1)
        return error

    def act(self) -> bool:
        """Do the kept write; return whether there was one."""
        kept, self._registered = self._registered, None
        self.put(r.REGISTERED_INSTRUCTION, 0)
        return kept is not None and self.write(*kept) == Error.NONE

    def _places(self, address: int, size: int) -> Iterable[int]:
        """Return where some bytes lie; indirect data lie where their indirect addresses say."""
        for at in range(address, address + size):
            if at in _INDIRECT:
                at = self.get(xl330.INDIRECT_ADDRESSES[at - _INDIRECT.start])
            yield at

    def _refusal(self, address: int, data: bytes) -> Error:
        if not data:
            return Error.DATA_LENGTH
        if address + len(data) > xl330.TABLE_BYTES:
            return Error.ACCESS
        places = list(self._places(address, len(data)))
        touched = set(places)
        if not xl330.READ_ONLY.isdisjoint(touched):
            return Error.ACCESS
        if self.get(r.TORQUE_ENABLE) and min(touched) < xl330.FIRST_RAM:
            return Error.ACCESS
        if self.watchdog_tripped and not xl330.GOALS.isdisjoint(touched):
            return Error.DATA_RANGE
        after = bytearray(self._table)
        for at, value in zip(places, data, strict=True):
            after[at] = value
        for register, (low, high) in xl330.RANGES.items():
            if _touches(register, touched) and not low <= _integer(after, register) <= high:
                return Error.DATA_RANGE
        return self._meaning_refusal(touched, after)

    def _meaning_refusal(self, touched: set[int], after: bytearray) -> Error:
        mode = _integer(after, r.OPERATING_MODE)
        if _touches(r.OPERATING_MODE, touched) and mode not in xl330.MODES:
            return Error.DATA_RANGE
        if _touches(r.DRIVE_MODE, touched) and after[r.DRIVE_MODE.address] & ~xl330.DRIVE_MODE_BITS:
            return Error.DATA_RANGE
        for goal, limit in xl330.LIMITED:
            if _touches(goal, touched) and abs(_integer(after, goal)) > _integer(after, limit):
                return Error.DATA_LIMIT
        if _touches(r.TORQUE_ENABLE, touched) and after[r.TORQUE_ENABLE.address] and self.alert:
            return Error.ACCESS
        if not _touches(r.GOAL_POSITION, touched):
            return Error.NONE
        position = _integer(after, r.GOAL_POSITION)
        if mode == OperatingMode.POSITION:
            low, high = self.get(r.MIN_POSITION_LIMIT), self.get(r.MAX_POSITION_LIMIT)
            return Error.NONE if low <= position <= high else Error.DATA_LIMIT
        return Error.NONE if abs(position) <= xl330.MULTI_TURN else Error.DATA_RANGE


def _touches(register: Register, touched: set[int]) -> bool:
    return any(at in touched for at in range(register.address, register.address + register.size))


def _integer(table: bytearray, register: Register) -> int:
    data = table[register.address : register.address + register.size]
    return int.from_bytes(data, "little", signed=register in xl330.SIGNED)
