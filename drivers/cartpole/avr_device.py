"""The firmware's AVR image under simavr, connected to the mechanics pin by pin: a device for the emulator."""

from __future__ import annotations

import ctypes
import functools
import math
import struct
from dataclasses import dataclass

from fastcrc import crc16

from deal_hw.drivers.cartpole import native, protocol
from deal_hw.drivers.cartpole.device import EmulatedDevice
from deal_hw.drivers.cartpole.host_firmware import Settings, settings_of
from deal_hw.drivers.cartpole.mechanics import Mechanics
from deal_hw.drivers.cartpole.profiles import profile as find_profile
from deal_hw.drivers.cartpole.truth import CartpoleTruth
from deal_hw.errors import ConfigurationError, ProtocolError
from deal_hw.types import Status

_BYTES_PER_TICK = 99
"""One byte less than 1 Mbaud carries in 1 ms, so that no byte is left over."""
_INSTALL = "apt-get install gcc libc6-dev gcc-avr avr-libc libsimavr-dev libelf-dev, or use --firmware python"


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """How the emulated cart-pole is built; as in firmware/rig.h.

    Attributes:
        m_per_count: Cart travel per count of its encoder [m].
        counts_per_turn: Counts of the pole's encoder for one turn.
        switch_m: Where the limit switches close, from the middle [m].
        full_force_n: Force on the cart with the PWM fully on [N].
        pwm_top: The PWM fully on.
    """

    m_per_count: float = 25e-6
    counts_per_turn: int = 4096
    switch_m: float = 0.395
    full_force_n: float = 16.0
    pwm_top: int = 799


class _Outputs(ctypes.Structure):
    _fields_ = [
        ("pwm", ctypes.c_double),
        ("armed", ctypes.c_int32),
        ("set_pole", ctypes.c_int32),
        ("longest_step", ctypes.c_uint32),
        ("asleep", ctypes.c_uint32),
        ("complaints", ctypes.c_uint32),
        ("crashed", ctypes.c_int32),
    ]


@functools.cache
def library() -> ctypes.CDLL:
    """Return the simulator's side, compiled on the first call.

    Raises:
        ConfigurationError: A compiler or simavr's library is missing.
    """
    command = (native.compiler(), *native.CFLAGS, "-shared", "-fPIC")
    path = native.build("avr.so", command, ("host/avr.c",), _INSTALL, ("-lsimavr", "-lelf"))
    try:
        board = ctypes.CDLL(str(path))
    except OSError as error:
        raise ConfigurationError(f"the simulator of the AVR cannot be loaded: {error}; {_INSTALL}") from error
    integer, number = ctypes.c_int32, ctypes.c_uint32
    board.board_open.restype = ctypes.c_void_p
    board.board_open.argtypes = [ctypes.c_char_p, ctypes.c_char_p, number]
    board.board_close.argtypes = [ctypes.c_void_p]
    board.board_tick.restype = number
    board.board_tick.argtypes = [
        ctypes.c_void_p,
        integer,
        integer,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_char_p,
        number,
        ctypes.c_char_p,
        ctypes.POINTER(_Outputs),
    ]
    return board


def eeprom(settings: Settings, full_force_n: float) -> bytes:
    """Return the contents of the chip's EEPROM: the settings with their CRC, little-endian."""
    data = struct.pack(
        "<5I2H",
        settings.stiffness_trim,
        settings.damping_trim,
        settings.effort_trim,
        settings.speed_trim,
        settings.unique_id,
        settings.delay_ticks,
        round(full_force_n * 1000),
    )
    return data + struct.pack("<H", crc16.ibm_3740(data))


class Chip:
    """An ATmega328P with the firmware's image: pins and bytes, one millisecond per call.

    Attributes:
        outputs: Mean PWM, lamps and cycles of the last millisecond.
        longest_step: Most cycles that a control step took so far, interrupts included.
        asleep: Cycles without anything to do so far.
        complaints: Errors in the simulator so far, such as a byte that arrived before the last one was read.

    Args:
        memory: Contents of its EEPROM, from address 0.

    Raises:
        ConfigurationError: avr-gcc, a C compiler or simavr is missing, or the image cannot be read.
    """

    def __init__(self, memory: bytes) -> None:
        self.outputs = _Outputs()
        self.longest_step = self.asleep = self.complaints = 0
        self._library = library()
        self._board = self._library.board_open(str(native.image()).encode(), memory, len(memory))
        if not self._board:
            raise ConfigurationError(f"simavr cannot run {native.image()}; remove that folder and try again")
        self._out = ctypes.create_string_buffer(1024)
        self._inbox = b""

    def tick(
        self,
        cart_counts: int = 0,
        pole_counts: int = 0,
        switches: tuple[bool, bool] = (False, False),
        data: bytes = b"",
    ) -> bytes:
        """Run a millisecond; return the bytes sent in it.

        Args:
            cart_counts: Motion of the cart's encoder.
            pole_counts: Motion of the pole's encoder.
            switches: Whether the left and the right limit switch are closed.
            data: Bytes from the host; they come as fast as 1 Mbaud carries them, also in later calls.

        Raises:
            ConfigurationError: The chip's program ended.
        """
        outputs, self._inbox = self.outputs, self._inbox + data
        rx, self._inbox = self._inbox[:_BYTES_PER_TICK], self._inbox[_BYTES_PER_TICK:]
        length = self._library.board_tick(
            self._board, cart_counts, pole_counts, *switches, rx, len(rx), self._out, ctypes.byref(outputs)
        )
        if outputs.crashed:
            raise ConfigurationError(
                "the chip's program ended, which is an error of the firmware; report "
                "it, or use --firmware python"
            )
        self.longest_step = max(self.longest_step, outputs.longest_step)
        self.asleep += outputs.asleep
        self.complaints += outputs.complaints
        return self._out.raw[:length]

    def close(self) -> None:
        """Free the simulator's memory."""
        self._library.board_close(self._board)
        self._board = None


class AvrDevice(EmulatedDevice):
    """A chip on a cart-pole.

    The chip sees only its pins: edges of two quadrature encoders, two limit switches, the UART. Its PWM,
    averaged over each millisecond, is the force on the cart. Noise and jitter of the profile have no effect,
    since encoders count exactly. The whole latency is between a command and its action.

    Attributes:
        chip: The chip.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        start_angle_rad: Pole angle set by hand when homing [rad]; None: within +-0.03 rad, by the seed.
        build: Dimensions of the cart-pole.

    Raises:
        ConfigurationError: avr-gcc, a C compiler or simavr is missing, or the image cannot be read.
    """

    def __init__(
        self, truth: CartpoleTruth, *, start_angle_rad: float | None = None, build: Rig = Rig()
    ) -> None:
        super().__init__(Mechanics(truth, start_angle_rad=start_angle_rad))
        self._build = build
        profile = find_profile(truth.profile)
        jitter = (profile.actuation_jitter_ticks + profile.sensing_jitter_ticks) // 2
        delay = truth.actuation_ticks + truth.sensing_ticks + jitter
        self.chip = Chip(eeprom(settings_of(truth, delay), build.full_force_n))
        self._counted = self._counts()
        self._setting_pole = False
        self._decoder = protocol.FrameDecoder()
        self._status = Status.NONE

    @property
    def armed(self) -> bool:
        """Whether the motor follows targets: the lamp is on."""
        return bool(self.chip.outputs.armed)

    @property
    def mode(self) -> str:
        """State of the motor: without torque in "idle" and "held", with torque in "homing" and "armed"."""
        if self._mechanics.held:
            return "held"
        return "armed" if self.armed else "homing" if Status.HOMING in self._status else "idle"

    @property
    def watchdog(self) -> bool:
        """Whether the last state frame reported missing commands."""
        return Status.WATCHDOG in self._status

    def tick(self) -> bytes:
        """Run one millisecond of chip and mechanics; return the bytes sent in it.

        Raises:
            ConfigurationError: The chip's program ended.
        """
        mechanics, build, outputs = self._mechanics, self._build, self.chip.outputs
        counts = self._counts()
        cart, _ = mechanics.position
        turns = counts[1] - self._counted[1]
        # The hand moves the pole the short way, so the simulator's angle may jump by whole turns.
        turns = (turns + build.counts_per_turn // 2) % build.counts_per_turn - build.counts_per_turn // 2
        data, self._inbox = self._inbox, b""
        switches = (cart <= -build.switch_m, cart >= build.switch_m)
        out = self.chip.tick(counts[0] - self._counted[0], turns, switches, data)
        self._counted = counts
        self._tick += 1
        if outputs.armed or (mechanics.homing and not outputs.set_pole):
            mechanics.release()
        if outputs.set_pole and not self._setting_pole:
            mechanics.begin_homing()
        self._setting_pole = bool(outputs.set_pole)
        mechanics.step(outputs.pwm / build.pwm_top * build.full_force_n)
        self._listen(out)
        return out

    def close(self) -> None:
        """Free the simulator's memory."""
        self.chip.close()

    def _counts(self) -> tuple[int, int]:
        """Return the encoders' counts at the end of this millisecond without a force."""
        # Without this prediction all edges would come a millisecond late, with the effect of a lighter cart.
        motor = self._mechanics.motor()
        _, pole, _, pole_velocity = self._mechanics.truth_row()
        cart = motor.position + motor.velocity * 1e-3
        turns = (pole + pole_velocity * 1e-3 - math.pi) / math.tau * self._build.counts_per_turn
        return math.floor(cart / self._build.m_per_count + 0.5), math.floor(turns + 0.5)

    def _listen(self, data: bytes) -> None:
        for payload in self._decoder.feed(data):
            try:
                message = protocol.decode(payload)
            except ProtocolError:
                continue
            if isinstance(message, protocol.State):
                self._status = Status(message.status)
