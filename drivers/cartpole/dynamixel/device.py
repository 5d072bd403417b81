"""Two emulated X-series servos on one bus, and the cart-pole on their shafts. Bytes in, bytes out."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.device import TICK_NS, EmulatedDevice
from deal_hw.drivers.cartpole.dynamixel.emulated_servo import EmulatedServo
from deal_hw.drivers.cartpole.dynamixel.packets import (
    BROADCAST,
    Error,
    Instruction,
    Packet,
    PacketParser,
    fast_status,
    protocol_1_requests,
    protocol_1_status,
    status,
)
from deal_hw.drivers.cartpole.dynamixel.registers import (
    HARDWARE_ERROR,
    ID,
    MOVING_STATUS,
    OPERATING_MODE,
    PRESENT_CURRENT,
    PRESENT_POSITION,
    PRESENT_VELOCITY,
    PROFILE_ONGOING,
    PULSES,
    RAD_S_PER_COUNT,
    Block,
)
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.faults import ServoFaults
from deal_hw.drivers.cartpole.mechanics import Mechanics
from deal_hw.drivers.cartpole.protocol import Target
from deal_hw.drivers.cartpole.sensor import Motor
from deal_hw.drivers.cartpole.servo import Servo
from deal_hw.drivers.cartpole.truth import CartpoleTruth

OVERLOAD = 1 << 5
_BITS_PER_BYTE = 10
_VELOCITY_MODE = 1
_NO_LIMIT_M_S = 1000.0
_FREE_M = 10.0
"""A servo does not know the rail, so its goals may lie beyond the stops."""


class DynamixelDevice(EmulatedDevice):
    """Two servos and the cart-pole that they drive and measure.

    Control tick k, at device time k ms: set-point, force from the state at its start, one physics step.
    Packets are handled on arrival. An answer leaves after the time of request and answer on a wire of the
    servo's baud rate, plus its return delay.

    The pole servo's LED asks a hand to set the pole upright for homing; the hand releases it when the belt
    servo gets torque.

    Attributes:
        servos: Belt servo and pole servo.
        fast_read: Whether they know Fast Sync and Bulk Read; older firmware does not.
        host_baud_rate: Rate of the host's port; a servo with another rate receives noise. None: the same.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        settings: Wiring and gearing, as in the driver.
        faults: The faults.
        keep_truth: Whether to keep the true trajectory for :meth:`true_trajectory`.
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        settings: DynamixelSettings | None = None,
        faults: ServoFaults | None = None,
        *,
        keep_truth: bool = False,
    ) -> None:
        super().__init__(Mechanics(truth, read_rate_hz=DESCRIPTION.device_rate_hz), keep_truth=keep_truth)
        self.fast_read = True
        self.host_baud_rate: int | None = None
        self._settings = s = settings or DynamixelSettings()
        self._faults = faults or ServoFaults()
        self._loop = Servo(truth.parameters, self._mechanics.timestep_s, reach_m=_FREE_M)
        rng = np.random.default_rng([truth.seed, 0xD12])
        self._cart = EmulatedServo(s.cart_id, s.baud_rate, mode=s.operating_mode)
        self._pole = EmulatedServo(s.pole_id, s.baud_rate)
        self.servos = [self._cart, self._pole]
        # At its start a servo knows its position within a revolution, but not the number of revolutions.
        self._cart_base = int(rng.integers(0, PULSES))
        self._pole_base = s.pole_zero
        self._parser = PacketParser()
        self._replies: deque[tuple[int, bytes]] = deque()
        self._targets: deque[tuple[int, Target]] = deque()
        self._now_ns = 0
        self._alive_ns = 0
        self._torque = self._lit = self._let_go = self._stopped = False
        self._told: Target | None = None
        self._told_ns = -1
        self._first_ns: int | None = None
        motor = self._mechanics.motor()
        self._mechanics.observe(motor.position)
        self._sense(motor)
        for servo in self.servos:
            self._forget_turns(servo)
        self._set_up_badly()

    @property
    def device_ns(self) -> int:
        """Device time of the next tick or answer [ns]."""
        tick_ns = self._tick * TICK_NS
        return min(tick_ns, max(self._replies[0][0], self._now_ns)) if self._replies else tick_ns

    @property
    def armed(self) -> bool:
        """Whether the motor follows targets and no hand holds the pole."""
        return self.mode == "armed"

    @property
    def mode(self) -> str:
        """State of the motor: without torque in "idle" and "held"; "stopped" holds its position."""
        if self._mechanics.held:
            return "held"
        if not self._torque:
            return "homing" if self._mechanics.homing else "idle"
        if self._cart.watchdog_tripped:
            return "stopped"
        return "armed" if self._let_go else "homing"

    @property
    def watchdog(self) -> bool:
        """Whether the belt servo's watchdog has stopped it."""
        return self._cart.watchdog_tripped

    @property
    def trouble(self) -> str:
        """Current fault of the servos; "" for none."""
        if not self._pole.present:
            return "pole servo absent"
        if not self._cart.awake(self._now_ns):
            return "belt servo restarts"
        return "overload" if self._cart.get(HARDWARE_ERROR) else ""

    @property
    def frame_errors(self) -> int:
        """Corrupt packets received so far."""
        return self._parser.errors

    def receive(self, data: bytes) -> None:
        """Take bytes from the host and handle the packets that they complete."""
        self.received_bytes += len(data)
        for servo in self.servos:
            if servo.protocol == 1 and self._hears(servo):
                for request in protocol_1_requests(data):
                    self._answer_protocol_1(servo, *request)
        if not any(self._hears(servo) for servo in self.servos):
            return
        for packet in self._parser.feed(data):
            self._alive_ns = self._now_ns
            self._handle(packet)

    def advance_to(self, device_ns: int) -> bytes:
        """Run all ticks and answers up to and including ``device_ns``; return the bytes sent meanwhile."""
        out = super().advance_to(device_ns)
        self._now_ns = max(self._now_ns, device_ns)
        return out

    def tick(self) -> bytes:
        """Run the next tick or answer; return the bytes sent."""
        self._now_ns = max(self._now_ns, self.device_ns)
        if self._replies and self._replies[0][0] <= self._now_ns < self._tick * TICK_NS + TICK_NS:
            return self._replies.popleft()[1]
        self._run_tick()
        return b""

    def reboot(self, servo: EmulatedServo) -> None:
        """Restart a servo, as after a dip of its supply."""
        servo.reboot(self._now_ns)
        self._forget_turns(servo)

    def _set_up_badly(self) -> None:
        f = self._faults
        if f.servo_duplicate_id:
            self._pole.put(ID, self._cart.id)
        if f.servo_wrong_mode:
            self._cart.put(OPERATING_MODE, _VELOCITY_MODE)
        self._pole.protocol = f.servo_protocol

    # What the mechanics do.

    def _run_tick(self) -> None:
        now_ns = self._tick * TICK_NS
        for servo in self.servos:
            servo.tick(now_ns, now_ns - self._alive_ns)
        mechanics, loop = self._mechanics, self._loop
        motor = mechanics.motor()
        self._follow_torque(motor)
        self._follow_hand()
        while self._targets and self._targets[0][0] <= self._tick:
            loop.accept(self._targets.popleft()[1])
        force = loop.update(motor.position, motor.velocity) if self._torque else 0.0
        mechanics.observe(loop.setpoint)
        self._keep(force, loop.setpoint)
        self._sense(motor)
        mechanics.step(force)
        self._tick += 1
        self._fail()

    def _follow_hand(self) -> None:
        lit = bool(self._pole.block.led) and self._pole.awake(self._now_ns)
        if lit and not self._lit and not self._mechanics.held and not self._torque:
            self._mechanics.begin_homing()
            self._let_go = False
        self._lit = lit

    def _follow_torque(self, motor: Motor) -> None:
        """Switch the motor according to the belt servo's registers."""
        block = self._cart.block
        if bool(block.torque_enable) != self._torque:
            self._torque = bool(block.torque_enable)
            self._loop.reset(motor.position)
            self._targets.clear()
            self._told = None
            self._let_go = self._torque and self._mechanics.held
            if self._torque:
                self._mechanics.release()
                self._loop.accept(self._target(block))
                if self._let_go and self._first_ns is None:
                    self._first_ns = self._now_ns
        stopped = self._cart.watchdog_tripped
        if stopped and not self._stopped:
            # "The DYNAMIXEL will stop": it holds its position with its gains.
            self._targets.clear()
            here = dataclasses.replace(self._target(block), position_um=round(motor.position * 1e6))
            self._loop.reset(motor.position)
            self._loop.accept(here)
        self._stopped = stopped

    def _target(self, block: Block) -> Target:
        """Return the target in the belt servo's registers."""
        s, goal = self._settings, self._settings.read_goal(block)
        # A profile velocity of 0 is no limit.
        speed = goal.profile_velocity * s.metres_s_per_count if goal.profile_velocity else _NO_LIMIT_M_S
        return Target(
            sequence=0,
            position_um=round((goal.position - self._cart_base) * s.metres_per_pulse * 1e6),
            stiffness_mn_m=round(goal.p_gain * s.stiffness_per_gain * 1e3),
            damping_mns_m=round(goal.d_gain * s.damping_per_gain * 1e3),
            effort_limit_mn=round(goal.effort * s.effort_per_unit * 1e3),
            speed_limit_um_s=round(speed * 1e6),
        )

    def _sense(self, motor: Motor) -> None:
        """Write the sensors' values into the registers."""
        s, reading = self._settings, self._mechanics.read()
        pulses = round(reading.cart_um * 1e-6 / s.metres_per_pulse)
        self._cart.put(PRESENT_POSITION, self._cart_base + pulses)
        self._cart.put(
            PRESENT_VELOCITY, round(reading.cart_um_s * 1e-6 / s.metres_s_per_count) * s.cart_direction
        )
        effort = 0.0
        if self._torque:
            effort, _ = self._loop.estimate(reading.setpoint, motor.position, motor.velocity)
        self._cart.put(PRESENT_CURRENT, round(effort / s.effort_per_current) * s.cart_direction)
        self._cart.put(MOVING_STATUS, PROFILE_ONGOING if self._torque and self._loop.slewing else 0)
        turns = s.pole_direction * reading.pole_urad * 1e-6 / (2 * math.pi)
        self._pole.put(PRESENT_POSITION, self._pole_base + round(turns * PULSES))
        self._pole.put(
            PRESENT_VELOCITY, s.pole_direction * round(reading.pole_urad_s * 1e-6 / RAD_S_PER_COUNT)
        )

    def _forget_turns(self, servo: EmulatedServo) -> None:
        whole = servo.block.present_position // PULSES * PULSES
        if servo is self._cart:
            self._cart_base -= whole
        elif servo is self._pole:
            self._pole_base -= whole
        servo.put(PRESENT_POSITION, servo.block.present_position - whole)

    def _fail(self) -> None:
        """Apply due faults."""
        if self._first_ns is None:
            return
        passed_s = (self._now_ns - self._first_ns) / 1e9
        f = self._faults
        if f.servo_reboot_after_s is not None and passed_s > f.servo_reboot_after_s:
            self._faults = f = dataclasses.replace(f, servo_reboot_after_s=None)
            self.reboot(self._cart)
        if f.servo_overload_after_s is not None and passed_s > f.servo_overload_after_s:
            self._faults = f = dataclasses.replace(f, servo_overload_after_s=None)
            self._cart.fail(OVERLOAD)
        if f.servo_absent_after_s is not None and passed_s > f.servo_absent_after_s:
            self._pole.present = False

    # What the host asks for.

    def _hears(self, servo: EmulatedServo) -> bool:
        return servo.awake(self._now_ns) and self.host_baud_rate in (None, servo.baud_rate)

    def _listeners(self, servo: int) -> list[EmulatedServo]:
        return [s for s in self.servos if s.protocol == 2 and self._hears(s) and servo in (s.id, BROADCAST)]

    def _handle(self, packet: Packet) -> None:
        params = packet.params
        match packet.instruction:
            case Instruction.PING:
                for servo in sorted({s.id for s in self._listeners(packet.servo)}):
                    self._reply(packet, servo, lambda s: (Error.NONE, s.read(0, 2)[1] + s.read(6, 1)[1]))
            case Instruction.READ if len(params) == 4:
                address, size = _words(params)
                if not self._loses(address, size):
                    self._reply(packet, packet.servo, lambda s: s.read(address, size))
            case Instruction.WRITE | Instruction.REG_WRITE if len(params) > 2:
                self._write_one(packet)
            case Instruction.ACTION:
                # Not answered: the SDK does not wait for it, and would take it for its next answer.
                for s in self._listeners(packet.servo):
                    s.act()
                self._schedule()
            case Instruction.REBOOT | Instruction.CLEAR:
                self._reply(packet, packet.servo, lambda s: (Error.NONE, b""), read=False)
                for s in self._listeners(packet.servo):
                    if packet.instruction == Instruction.REBOOT:
                        self.reboot(s)
                    else:
                        self._forget_turns(s)
            case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ if len(params) > 4:
                address, size = _words(params)
                self._read_group(packet, [(servo, address, size) for servo in params[4:]])
            case Instruction.BULK_READ | Instruction.FAST_BULK_READ if len(params) % 5 == 0:
                groups = [params[k : k + 5] for k in range(0, len(params), 5)]
                self._read_group(packet, [(g[0], *_words(g[1:])) for g in groups])
            case Instruction.SYNC_WRITE if len(params) > 4:
                address, size = _words(params)
                step = size + 1
                for k in range(4, len(params) - size, step):
                    self._write(params[k], address, params[k + 1 : k + step])
            case Instruction.BULK_WRITE:
                self._write_bulk(params)
            case _:
                self._reply(packet, packet.servo, lambda s: (Error.INSTRUCTION, b""), read=False)

    def _write_one(self, packet: Packet) -> None:
        address, data = int.from_bytes(packet.params[:2], "little"), packet.params[2:]
        errors = {}
        for s in self._listeners(packet.servo):
            kept = packet.instruction == Instruction.REG_WRITE
            errors[s] = s.register_write(address, data) if kept else s.write(address, data)
        self._schedule()
        self._reply(packet, packet.servo, lambda s: (errors.get(s, Error.NONE), b""), read=False)

    def _write(self, servo: int, address: int, data: bytes) -> None:
        for s in self._listeners(servo):
            s.write(address, data)
        self._schedule()

    def _write_bulk(self, params: bytes) -> None:
        at = 0
        while at + 5 < len(params):
            address, size = _words(params[at + 1 : at + 5])
            self._write(params[at], address, params[at + 5 : at + 5 + size])
            at += 5 + size

    def _schedule(self) -> None:
        """Apply the belt servo's writes after its latency; writes of one time act at one time."""
        target = self._target(self._cart.block)
        if not self._torque or not self._cart.block.torque_enable or target == self._told:
            return
        self._told = target
        if self._targets and self._told_ns == self._now_ns:
            self._targets[-1] = (self._targets[-1][0], target)
            return
        self._told_ns = self._now_ns
        due = self._tick + self._mechanics.command_delay()
        self._targets.append((max(due, self._targets[-1][0]) if self._targets else due, target))

    def _loses(self, address: int, size: int) -> bool:
        position = PRESENT_POSITION.address
        return address <= position < address + size and self._mechanics.loses_frame()

    def _read_group(self, packet: Packet, wanted: Sequence[tuple[int, int, int]]) -> None:
        fast = packet.instruction in (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
        if not wanted or self._loses(*wanted[0][1:]) or (fast and not self.fast_read):
            return
        parts: list[tuple[int, int, bytes]] = []
        speaker = None
        for servo, address, size in wanted:
            listeners = self._listeners(servo) if servo != BROADCAST else []
            if not listeners:
                # Each waits for the answer of the servo before it, which never comes.
                break
            speaker = listeners[0]
            error, data = speaker.read(address, size)
            if error:
                return
            parts.append((servo, error | speaker.alert, data))
        if speaker is None:
            return
        if fast:
            self._send(packet, speaker, fast_status(parts, sum(size + 4 for _, _, size in wanted)))
            return
        for part in parts:
            self._send(packet, speaker, status(*part))

    def _reply(
        self,
        packet: Packet,
        servo: int,
        answer: Callable[[EmulatedServo], tuple[int, bytes]],
        *,
        read: bool = True,
    ) -> None:
        """Send the answers of servos with an id; two with the same id answer at the same time."""
        if servo == BROADCAST:
            return
        pinged = packet.instruction == Instruction.PING
        answers = []
        for s in self._listeners(servo):
            if pinged or s.answers(read=read):
                error, data = answer(s)
                answers.append((s, status(servo, error | s.alert, data)))
        if answers:
            # On the open line a 0 wins over a 1.
            mixed = bytes(map(_and, zip(*(data for _, data in answers), strict=False)))
            self._send(packet, answers[0][0], mixed)

    def _send(self, packet: Packet, servo: EmulatedServo, data: bytes) -> None:
        wire_s = _BITS_PER_BYTE * (packet.size + len(data)) / servo.baud_rate
        start_ns = max(self._now_ns, self._replies[-1][0] if self._replies else 0)
        self._replies.append((start_ns + round((wire_s + servo.return_delay_s) * 1e9), data))

    def _answer_protocol_1(self, servo: EmulatedServo, wanted: int, code: int, params: bytes) -> None:
        if wanted != servo.id or code not in (Instruction.PING, Instruction.READ):
            return
        data = servo.read(params[0], params[1])[1] if code == Instruction.READ and len(params) == 2 else b""
        self._replies.append((self._now_ns, protocol_1_status(servo.id, data)))


def _and(values: tuple[int, ...]) -> int:
    result = 0xFF
    for value in values:
        result &= value
    return result


def _words(data: bytes) -> tuple[int, int]:
    """Return the two 16-bit numbers at the beginning."""
    return int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little")
