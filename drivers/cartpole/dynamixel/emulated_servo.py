"""One emulated X-series servo: its control table, and its answers to instructions."""

from __future__ import annotations

import struct

from deal_hw.drivers.cartpole.dynamixel.packets import ALERT, Error
from deal_hw.drivers.cartpole.dynamixel.registers import (
    BAUD_RATE,
    BAUD_RATES,
    BLOCK_ADDRESS,
    BLOCK_BYTES,
    BUS_WATCHDOG,
    CURRENT_LIMIT,
    DRIVE_MODE,
    FIRMWARE_VERSION,
    GOAL_CURRENT,
    GOAL_POSITION,
    GOAL_PWM,
    HARDWARE_ERROR,
    ID,
    LED,
    MODEL_NUMBER,
    OPERATING_MODE,
    POSITION_D_GAIN,
    POSITION_I_GAIN,
    POSITION_P_GAIN,
    PRESENT_INPUT_VOLTAGE,
    PRESENT_TEMPERATURE,
    PROFILE_VELOCITY,
    PROTOCOL_TYPE,
    PWM_LIMIT,
    REALTIME_TICK,
    RETURN_DELAY_TIME,
    RETURN_DELAY_UNIT_S,
    STATUS_RETURN_LEVEL,
    TICK_PERIOD_MS,
    TORQUE_ENABLE,
    WATCHDOG_TRIPPED,
    WATCHDOG_UNIT_S,
    Block,
    OperatingMode,
    Register,
)

TABLE_BYTES = 256
XL330_M077, FIRMWARE = 1190, 46
BOOT_NS = 300_000_000
"""How long a starting servo is silent [ns]."""
_FIRST_RAM = 64
_FIRST_READ_ONLY, _END_READ_ONLY = 120, 147
_READ_ONLY = {*range(7), 70, 69, *range(_FIRST_READ_ONLY, _END_READ_ONLY)}
_GOALS = {*range(100, 108), *range(116, 120)}
_RANGES: dict[Register, tuple[int, int]] = {
    ID: (0, 252),
    BAUD_RATE: (0, len(BAUD_RATES) - 1),
    RETURN_DELAY_TIME: (0, 254),
    TORQUE_ENABLE: (0, 1),
    LED: (0, 1),
    STATUS_RETURN_LEVEL: (0, 2),
    POSITION_D_GAIN: (0, 16383),
    POSITION_I_GAIN: (0, 16383),
    POSITION_P_GAIN: (0, 16383),
    PROFILE_VELOCITY: (0, 32767),
}
_DEFAULTS: dict[Register, int] = {
    PROTOCOL_TYPE: 2,
    PWM_LIMIT: 885,
    CURRENT_LIMIT: 1750,
    STATUS_RETURN_LEVEL: 2,
    POSITION_P_GAIN: 400,
    GOAL_PWM: 885,
    GOAL_CURRENT: 1750,
    PRESENT_INPUT_VOLTAGE: 50,
    PRESENT_TEMPERATURE: 31,
}


class EmulatedServo:
    """A servo's registers, with the rules by which they may be read and written.

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
        model: int = XL330_M077,
    ) -> None:
        self.present, self.protocol = True, 2
        self._table = bytearray(TABLE_BYTES)
        self._registered: tuple[int, bytes] | None = None
        self._start_ns = self._silent_until_ns = 0
        for register, value in (
            (MODEL_NUMBER, model),
            (FIRMWARE_VERSION, FIRMWARE),
            (ID, servo),
            (BAUD_RATE, BAUD_RATES.index(baud_rate)),
            (OPERATING_MODE, mode),
            (DRIVE_MODE, 0),
            *_DEFAULTS.items(),
        ):
            self.put(register, value)

    def get(self, register: Register) -> int:
        """Return a register, without sign."""
        return int.from_bytes(self._table[register.address : register.address + register.size], "little")

    def put(self, register: Register, value: int) -> None:
        """Set a register, without the rules for hosts."""
        data = (value % (1 << 8 * register.size)).to_bytes(register.size, "little")
        self._table[register.address : register.address + register.size] = data

    @property
    def id(self) -> int:
        """Its id."""
        return self.get(ID)

    @property
    def baud_rate(self) -> int:
        """Its baud rate."""
        return BAUD_RATES[self.get(BAUD_RATE)]

    @property
    def return_delay_s(self) -> float:
        """Delay before its answers [s]."""
        return self.get(RETURN_DELAY_TIME) * RETURN_DELAY_UNIT_S

    @property
    def watchdog_tripped(self) -> bool:
        """Whether its watchdog has stopped it."""
        return self.get(BUS_WATCHDOG) == WATCHDOG_TRIPPED

    @property
    def alert(self) -> int:
        """Alert bit of every status packet."""
        return ALERT if self.get(HARDWARE_ERROR) else 0

    @property
    def block(self) -> Block:
        """The registers that the driver reads with every sample."""
        return Block.unpack(bytes(self._table[BLOCK_ADDRESS : BLOCK_ADDRESS + BLOCK_BYTES]))

    def awake(self, now_ns: int) -> bool:
        """Whether it receives packets."""
        return self.present and now_ns >= self._silent_until_ns

    def answers(self, *, read: bool) -> bool:
        """Whether it answers, by its Status Return Level."""
        return self.get(STATUS_RETURN_LEVEL) >= (1 if read else 2)

    def reboot(self, now_ns: int) -> None:
        """Restart: registers outside the EEPROM are reset, hardware errors too."""
        self._table[_FIRST_RAM:] = bytes(TABLE_BYTES - _FIRST_RAM)
        for register, value in _DEFAULTS.items():
            if register.address >= _FIRST_RAM:
                self.put(register, value)
        self._registered = None
        self._silent_until_ns = self._start_ns = now_ns + BOOT_NS

    def fail(self, bits: int) -> None:
        """Report a hardware error and switch the torque off, according to Shutdown."""
        self.put(HARDWARE_ERROR, self.get(HARDWARE_ERROR) | bits)
        self.put(TORQUE_ENABLE, 0)

    def tick(self, now_ns: int, silence_ns: int) -> None:
        """Advance by a millisecond; ``silence_ns`` is the time without a packet [ns]."""
        self.put(REALTIME_TICK, max(0, now_ns - self._start_ns) // 1_000_000 % TICK_PERIOD_MS)
        limit = self.get(BUS_WATCHDOG)
        if (
            self.get(TORQUE_ENABLE)
            and 0 < limit < WATCHDOG_TRIPPED
            and silence_ns > limit * WATCHDOG_UNIT_S * 1e9
        ):
            self.put(BUS_WATCHDOG, WATCHDOG_TRIPPED)

    def read(self, address: int, size: int) -> tuple[int, bytes]:
        """Return the error and the bytes of some registers."""
        if address + size > TABLE_BYTES or not size:
            return Error.ACCESS, b""
        return Error.NONE, bytes(self._table[address : address + size])

    def write(self, address: int, data: bytes) -> int:
        """Write registers as a host; return the error, after which nothing was written."""
        error = self._refusal(address, data)
        if error is Error.NONE:
            self._table[address : address + len(data)] = data
        return error

    def register_write(self, address: int, data: bytes) -> int:
        """Keep a write for :meth:`act`."""
        error = self._refusal(address, data)
        if error is Error.NONE:
            self._registered = (address, data)
        return error

    def act(self) -> bool:
        """Do the kept write; return whether there was one."""
        kept, self._registered = self._registered, None
        return kept is not None and self.write(*kept) == Error.NONE

    def _refusal(self, address: int, data: bytes) -> Error:
        touched = range(address, address + len(data))
        if not data:
            return Error.DATA_LENGTH
        if touched.stop > TABLE_BYTES or not _READ_ONLY.isdisjoint(touched):
            return Error.ACCESS
        if address < _FIRST_RAM and self.get(TORQUE_ENABLE):
            return Error.ACCESS
        if self.watchdog_tripped and not _GOALS.isdisjoint(touched):
            return Error.DATA_RANGE
        after = bytearray(self._table)
        after[address : touched.stop] = data
        for register, (low, high) in _RANGES.items():
            if register.address in touched:
                value = int.from_bytes(after[register.address : register.address + register.size], "little")
                if not low <= value <= high:
                    return Error.DATA_RANGE
        return self._goal_refusal(touched, after)

    def _goal_refusal(self, touched: range, after: bytearray) -> Error:
        for goal, limit in ((GOAL_PWM, PWM_LIMIT), (GOAL_CURRENT, CURRENT_LIMIT)):
            (value,) = struct.unpack_from("<h", after, goal.address)
            if goal.address in touched and abs(value) > self.get(limit):
                return Error.DATA_LIMIT
        (watchdog,) = struct.unpack_from("<b", after, BUS_WATCHDOG.address)
        if BUS_WATCHDOG.address in touched and watchdog < 0:
            return Error.DATA_RANGE
        if TORQUE_ENABLE.address in touched and after[TORQUE_ENABLE.address] and self.get(HARDWARE_ERROR):
            return Error.ACCESS
        (position,) = struct.unpack_from("<i", after, GOAL_POSITION.address)
        if GOAL_POSITION.address in touched and abs(position) > 1_048_575:
            return Error.DATA_RANGE
        return Error.NONE
