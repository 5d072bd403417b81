"""One emulated STS servo: its control table, its protections, and its answers to instructions.

What no source says, and so is assumed here:

- A value out of its range and a write to a read-only register change nothing; the confirmation is the same.
- After a restart the goal is the present position until a host writes one: LeRobot switches the torque on
  without a goal, and its users' arms stay where they are. Feetech's table says 0. A goal written before
  stays, and with torque the servo turns there: write the present position as goal first.
- In one-turn mode (Phase, bit 4 is 0) the position wraps around from 4095 to 0, after the homing offset.
- An overload or over-current ends when a host switches the torque off, or writes a goal on the other side of
  the present position, and with Reset and restart.
- Other protections switch the torque off, as their bits in Unloading Condition say, and show it in Torque
  Enable.
- Calibrating the middle keeps the homing offset over a restart, whatever Lock is, and the torque as it is.
- Modes other than position are stored, and move nothing.
"""

from __future__ import annotations

import struct
from typing import Final

from deal_hw.drivers.servo_bus.feetech import registers as r
from deal_hw.drivers.servo_bus.feetech import sts3215
from deal_hw.drivers.servo_bus.feetech.packets import Fault
from deal_hw.drivers.servo_bus.registers import Register
from deal_hw.drivers.servo_bus.servos_side import TWIN_TICKS

BOOT_NS: Final = 800_000_000
"""How long a starting servo is silent [ns]."""
_SHORTEST_DELAY: Final = 50
"""A shorter return delay that is not 0 counts as this."""
_LATCHED: Final = int(Fault.OVERLOAD | Fault.CURRENT)
_LOAD_MAGNITUDE: Final = (1 << r.SIGN_BITS[r.PRESENT_LOAD]) - 1
_POSITION_SIGN: Final = r.SIGN_BITS[r.PRESENT_POSITION]
_WORD: Final = struct.Struct("<H")
_SENSED: Final = struct.Struct("<HHBB2xB2xH")
"""Present Speed (58), load, voltage, temperature, Moving (66), Present Current (69)."""


class StsServo:
    """A servo's registers, with the rules by which they may be read and written.

    It is set up as it leaves the factory, except for id and baud rate. Positions of the shaft are ticks over
    all turns, before the homing offset: Present Position = shaft - offset.

    Attributes:
        present: False for an unplugged servo.

    Args:
        servo: Its id.
        baud_rate: Its baud rate.
        model: Its model number.
    """

    def __init__(self, servo: int, baud_rate: int, *, model: int = r.STS3215) -> None:
        self.present = True
        self._has_goal = False
        self._table = bytearray(sts3215.TABLE_BYTES)
        self._registered: tuple[int, bytes] | None = None
        self._silent_until_ns = 0
        self._shaft = self._base = 0
        self._load_side = self._now_ns = 0
        self._overload_ns: int | None = None
        self._current_ns: int | None = None
        self._forced = 0
        for register, value in (
            *sts3215.EEPROM.items(),
            (r.MODEL_NUMBER, model),
        ):
            self.put(register, value)
        self._kept = self._backup = bytes(self._table[: r.FIRST_RAM])
        self.keep(r.ID, servo)
        self.keep(r.BAUD_RATE, r.BAUD_RATES.index(baud_rate))
        self._start()

    def twin(self) -> StsServo:
        """Return another servo with the same id, without torque, which stands elsewhere."""
        twin = StsServo(self.id, self.baud_rate, model=self.get(r.MODEL_NUMBER))
        twin.sense(self._shaft + TWIN_TICKS)
        twin.forget_turns()
        return twin

    def get(self, register: Register) -> int:
        """Return a register, with its sign if it has one."""
        return r.decode(register, self._bytes(register))

    def put(self, register: Register, number: int) -> None:
        """Set a register, without the rules for hosts; in the EEPROM until the next restart, as with Lock."""
        data = r.encode(register, number)
        self._has_goal |= register == r.GOAL_POSITION
        self._table[register.address : register.address + register.size] = data

    def keep(self, register: Register, number: int) -> None:
        """Set a register of the EEPROM, also for the time after a restart."""
        self.put(register, number)
        self._keep(range(register.address, register.address + register.size))

    @property
    def id(self) -> int:
        """Its id."""
        return self.get(r.ID)

    @property
    def baud_rate(self) -> int:
        """Its baud rate."""
        return r.BAUD_RATES[self.get(r.BAUD_RATE)]

    @property
    def return_delay_s(self) -> float:
        """Delay before its answers [s]."""
        delay = self.get(r.RETURN_DELAY)
        return (max(delay, _SHORTEST_DELAY) if delay else 0) * r.RETURN_DELAY_UNIT_S

    @property
    def error(self) -> int:
        """Error byte of its answers: the register Status."""
        return self.get(r.STATUS)

    @property
    def block(self) -> r.StsBlock:
        """The registers that a driver may read with every sample."""
        return r.StsBlock.unpack(bytes(self._table[r.BLOCK_ADDRESS : r.BLOCK_ADDRESS + r.BLOCK_BYTES]))

    def awake(self, now_ns: int) -> bool:
        """Whether it receives requests."""
        return self.present and now_ns >= self._silent_until_ns

    def answers(self, *, read: bool) -> bool:
        """Whether it answers, by its Response Level; pings and reads always."""
        return read or self.get(r.RESPONSE_LEVEL) > 0

    # What the motor is asked to do.

    @property
    def torque_mode(self) -> r.TorqueMode:
        """Whether the motor holds its goal, damps, or is off."""
        return r.TorqueMode(self.get(r.TORQUE_ENABLE))

    @property
    def mode(self) -> r.StsMode:
        """Operating mode; only the position mode moves here."""
        return r.StsMode(self.get(r.OPERATING_MODE))

    @property
    def goal(self) -> int:
        """Goal of the shaft [ticks], over all its turns and before the homing offset.

        It is Goal Position within Min and Max Position Limit (both 0: no limits), plus the homing offset. In
        one-turn mode the servo does not turn over the wrap-around.
        """
        return self._shaft + self._limited_goal() - self.get(r.PRESENT_POSITION)

    @property
    def p_gain(self) -> int:
        """P Coefficient."""
        return self.get(r.P_GAIN)

    @property
    def d_gain(self) -> int:
        """D Coefficient."""
        return self.get(r.D_GAIN)

    @property
    def i_gain(self) -> int:
        """I Coefficient."""
        return self.get(r.I_GAIN)

    @property
    def torque_limit(self) -> int:
        """Largest duty [0.1 %]: Torque Limit, or Protective Torque after an overload."""
        limit = self.get(r.TORQUE_LIMIT)
        protects = self.error & self.get(r.UNLOAD_CONDITIONS) & Fault.OVERLOAD
        return min(limit, 10 * self.get(r.PROTECTIVE_TORQUE)) if protects else limit

    @property
    def goal_speed(self) -> int:
        """Largest speed of its motion [ticks/s]; 0: no limit."""
        return self.get(r.GOAL_SPEED)

    @property
    def acceleration(self) -> int:
        """Acceleration of its motion [100 ticks/s^2]; 0: no limit."""
        return self.get(r.ACCELERATION)

    # What the motor does.

    def sense(
        self,
        position: int,
        speed: int = 0,
        load: int = 0,
        voltage: int = sts3215.VOLTAGE,
        temperature: int = sts3215.TEMPERATURE,
        current: int = 0,
        moving: int | bool = 0,
    ) -> None:
        """Set the registers of what the servo measures.

        Args:
            position: Of the shaft, over all its turns and before the homing offset [ticks].
            speed: [ticks/s].
            load: Duty of the motor's PWM, positive towards larger positions [0.1 %].
            voltage: [0.1 V].
            temperature: [degrees Celsius].
            current: [6.5 mA]; its sign is not shown.
            moving: Whether it moves to its goal.
        """
        self._shaft = position
        self._load_side = (load > 0) - (load < 0)
        self._show_position()
        _SENSED.pack_into(
            self._table,
            r.PRESENT_SPEED.address,
            _magnitude(speed, r.SIGN_BITS[r.PRESENT_SPEED]),
            _magnitude(load, r.SIGN_BITS[r.PRESENT_LOAD]),
            min(max(voltage, 0), 255),
            min(max(temperature, 0), 255),
            bool(moving),
            min(abs(current), 0xFFFF),
        )
        self._report(self._latched)

    def tick(self, now_ns: int) -> None:
        """Apply the protections at a time [ns]; the bus calls it when its time is set.

        Overload: the load is at least Overload Torque for Protection Time. Current: above Protection Current
        for Over Current Protection Time. Voltage and temperature: outside their limits, at once.
        """
        self._now_ns = now_ns
        # Each control step runs this for each servo, so it reads the table's bytes.
        table = self._table
        on = bool(table[r.TORQUE_ENABLE.address])
        load = _word(table, r.PRESENT_LOAD) & _LOAD_MAGNITUDE
        overloaded = on and load >= 10 * table[r.OVERLOAD_TORQUE.address]
        drawing = on and _word(table, r.PRESENT_CURRENT) > _word(table, r.PROTECTION_CURRENT)
        if not (overloaded or drawing or self._overload_ns or self._current_ns) and not (
            table[r.STATUS.address] or self._forced
        ):
            return
        self._overload_ns = self._since(self._overload_ns, overloaded)
        self._current_ns = self._since(self._current_ns, drawing)
        latched = self._latched
        if self._lasts(self._overload_ns, r.PROTECTION_TIME):
            latched |= Fault.OVERLOAD
        if self._lasts(self._current_ns, r.OVERCURRENT_TIME):
            latched |= Fault.CURRENT
        self._report(latched)

    def fail(self, bits: int, *, lasting: bool = False) -> None:
        """Report faults; the torque goes off as Unloading Condition says.

        They end with Reset and a restart.

        Args:
            bits: The faults.
            lasting: Whether that holds for overload and current, too; else they end as if the servo had found
                them.
        """
        self._forced |= bits if lasting else bits & ~_LATCHED
        self._report(self._latched | bits & _LATCHED)

    @property
    def _latched(self) -> int:
        return self._table[r.STATUS.address] & _LATCHED

    def _since(self, since_ns: int | None, holds: bool) -> int | None:
        return (self._now_ns if since_ns is None else since_ns) if holds else None

    def _lasts(self, since_ns: int | None, register: Register) -> bool:
        if since_ns is None:
            return False
        return self._now_ns - since_ns >= self.get(register) * r.PROTECTION_TIME_UNIT_S * 1e9

    def _report(self, latched: int) -> None:
        """Show the faults in Status, and switch the torque off for those that ask for it."""
        found, table = latched | self._forced, self._table
        voltage = table[r.PRESENT_VOLTAGE.address]
        if not table[r.MIN_VOLTAGE.address] <= voltage <= table[r.MAX_VOLTAGE.address]:
            found |= Fault.VOLTAGE
        if table[r.PRESENT_TEMPERATURE.address] > table[r.MAX_TEMPERATURE.address]:
            found |= Fault.TEMPERATURE
        table[r.STATUS.address] = found
        # After an overload the servo holds with Protective Torque.
        if found & table[r.UNLOAD_CONDITIONS.address] & ~Fault.OVERLOAD:
            table[r.TORQUE_ENABLE.address] = r.TorqueMode.OFF

    def _end_overload(self) -> None:
        self._overload_ns = None
        self.put(r.STATUS, self.error & ~_LATCHED)

    # The position.

    def _show_position(self) -> None:
        position = self._shaft - self._base - self.get(r.HOMING_OFFSET)
        if not self._table[r.PHASE.address] & r.MULTI_TURN:
            position %= r.TICKS
        shown = _magnitude(position, _POSITION_SIGN)
        _WORD.pack_into(self._table, r.PRESENT_POSITION.address, shown)
        if not self._has_goal and not self._table[r.TORQUE_ENABLE.address]:
            _WORD.pack_into(self._table, r.GOAL_POSITION.address, shown)

    def _limited_goal(self) -> int:
        goal, low, high = self.get(r.GOAL_POSITION), self.get(r.MIN_POSITION), self.get(r.MAX_POSITION)
        return goal if low == high == 0 else max(low, min(goal, high))

    def forget_turns(self) -> None:
        """Count from the present revolution."""
        self._base += (self._shaft - self._base) // r.TICKS * r.TICKS
        self._show_position()

    def calibrate(self, position: int = r.MIDDLE) -> None:
        """Set the homing offset so that the present position is this one [ticks]."""
        half = r.TICKS // 2
        offset = (self._shaft - position + half) % r.TICKS - half
        self.keep(r.HOMING_OFFSET, max(-sts3215.MAX_OFFSET, min(offset, sts3215.MAX_OFFSET)))
        self._show_position()

    # Restarts.

    def reboot(self, now_ns: int) -> None:
        """Restart: registers outside the EEPROM are reset, and those in it that were written with Lock 1."""
        self._table[: r.FIRST_RAM] = self._kept
        self._start()
        self._silent_until_ns = now_ns + BOOT_NS

    def factory_reset(self) -> None:
        """Set the EEPROM to the values of the last backup, at first the factory's; the id stays."""
        servo = self.id
        self._table[: r.FIRST_RAM] = self._kept = self._backup
        self.keep(r.ID, servo)
        self._show_position()

    def back_up(self) -> None:
        """Keep the EEPROM's values for :meth:`factory_reset`."""
        self._backup = bytes(self._table[: r.FIRST_RAM])

    def reset_status(self) -> None:
        """Clear the faults and the turns (the instruction Reset)."""
        self._forced = 0
        self._end_overload()
        self.forget_turns()

    def _start(self) -> None:
        self._table[r.FIRST_RAM :] = bytes(len(self._table) - r.FIRST_RAM)
        for register, value in sts3215.RAM.items():
            self.put(register, value)
        self.put(r.TORQUE_LIMIT, self.get(r.MAX_TORQUE))
        self._registered, self._has_goal = None, False
        self._forced = 0
        self._overload_ns = self._current_ns = None
        self.forget_turns()

    # What hosts read and write.

    def read(self, address: int, size: int) -> bytes | None:
        """Return the bytes of some registers; None if the table has no such addresses."""
        if not size or address + size > sts3215.TABLE_BYTES:
            return None
        return bytes(self._table[address : address + size])

    def write(self, address: int, data: bytes) -> None:
        """Write registers as a host."""
        touched = range(address, min(address + len(data), sts3215.TABLE_BYTES))
        after = bytearray(self._table)
        after[touched.start : touched.stop] = data[: len(touched)]
        if r.TORQUE_ENABLE.address in touched and after[r.TORQUE_ENABLE.address] == r.CALIBRATE_MIDDLE:
            self.calibrate()
            after[r.HOMING_OFFSET.address : r.HOMING_OFFSET.address + 2] = self._bytes(r.HOMING_OFFSET)
        # A write to Lock acts on the registers in the same request, too.
        changed = [x for x in sts3215.RANGES if _touches(x, touched) and _allowed(x, after)]
        for register in changed:
            place = slice(register.address, register.address + register.size)
            self._table[place] = after[place]
        for register in changed:
            if register.address < r.FIRST_RAM and self.get(r.LOCK) == r.UNLOCKED:
                self._keep(range(register.address, register.address + register.size))
        self._follow(changed)

    def register_write(self, address: int, data: bytes) -> None:
        """Keep a write for :meth:`act`."""
        self._registered = (address, data)
        self.put(r.ASYNC_WRITE, 1)

    def act(self) -> None:
        """Do the kept write, if there is one."""
        kept, self._registered = self._registered, None
        self.put(r.ASYNC_WRITE, 0)
        if kept is not None:
            self.write(*kept)

    def _follow(self, changed: list[Register]) -> None:
        """Do what follows from a change of registers."""
        switched_on = r.TORQUE_ENABLE in changed and self.torque_mode is not r.TorqueMode.OFF
        self._has_goal |= r.GOAL_POSITION in changed or switched_on
        self._show_position()
        self.put(r.TARGET_POSITION, self._limited_goal())
        if r.TORQUE_ENABLE in changed and self.torque_mode is r.TorqueMode.OFF:
            self._end_overload()
        if r.GOAL_POSITION in changed and (self.goal - self._shaft) * self._load_side <= 0:
            self._end_overload()
        self._report(self._latched)

    def _keep(self, places: range) -> None:
        kept = bytearray(self._kept)
        kept[places.start : places.stop] = self._table[places.start : places.stop]
        self._kept = bytes(kept)

    def _bytes(self, register: Register) -> bytes:
        return bytes(self._table[register.address : register.address + register.size])


def _touches(register: Register, touched: range) -> bool:
    return register.address < touched.stop and touched.start < register.address + register.size


def _allowed(register: Register, table: bytearray) -> bool:
    low, high = sts3215.RANGES[register]
    data = table[register.address : register.address + register.size]
    return low <= int.from_bytes(data, "little") <= high


def _magnitude(number: int, bit: int) -> int:
    """Return the nearest number that the bits below a sign bit can hold, as a register has it."""
    return min(abs(number), (1 << bit) - 1) | (number < 0) << bit


def _word(table: bytearray, register: Register) -> int:
    found: int = _WORD.unpack_from(table, register.address)[0]
    return found
