"""The firmware's AVR image under simavr, connected to the mechanics pin by pin: a device for the emulator."""

from __future__ import annotations

import ctypes
import functools

from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.host_firmware import Settings, settings_of, stored
from deal_hw.drivers.cartpole.chips.rig_device import (
    BYTES_PER_TICK,
    NOMINAL_RIG,
    ChipOutputs,
    Rig,
    RigChip,
    RigDevice,
    delay_ticks,
)
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.cartpole.wire.link import SerialLink
from deal_hw.errors import ConfigurationError

_INSTALL = "apt-get install gcc libc6-dev gcc-avr avr-libc libsimavr-dev libelf-dev, or use --firmware python"


class _Outputs(ChipOutputs):
    _fields_ = (
        ("longest_step", ctypes.c_uint32),
        ("asleep", ctypes.c_uint32),
        ("complaints", ctypes.c_uint32),
        ("crashed", ctypes.c_int32),
    )


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
    board.board_open.restype = ctypes.c_void_p
    board.board_open.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32]
    board.board_close.argtypes = [ctypes.c_void_p]
    board.board_tick.restype = ctypes.c_uint32
    board.board_tick.argtypes = [ctypes.c_void_p, *RigChip.ARGUMENTS]
    return board


def eeprom(settings: Settings, full_force_n: float) -> bytes:
    """Return the contents of the chip's EEPROM: the settings with their CRC, little-endian."""
    return stored(settings, round(full_force_n * 1000))


class Chip(RigChip):
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

    outputs: _Outputs

    def __init__(self, memory: bytes) -> None:
        self.longest_step = self.asleep = self.complaints = 0
        self._library = library()
        self._board = self._library.board_open(str(native.image()).encode(), memory, len(memory))
        if not self._board:
            raise ConfigurationError(f"simavr cannot run {native.image()}; remove that folder and try again")
        run = functools.partial(self._library.board_tick, self._board)
        super().__init__(run, _Outputs(), BYTES_PER_TICK)

    def _note(self) -> None:
        outputs = self.outputs
        if outputs.crashed:
            raise ConfigurationError(
                "the chip's program ended, which is an error of the firmware; report "
                "it, or use --firmware python"
            )
        self.longest_step = max(self.longest_step, outputs.longest_step)
        self.asleep += outputs.asleep
        self.complaints += outputs.complaints

    def close(self) -> None:
        """Free the simulator's memory."""
        self._library.board_close(self._board)
        self._board = None


class AvrDevice(RigDevice):
    """An ATmega328P on a cart-pole.

    Attributes:
        chip: The chip.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        start_angle_rad: Pole angle set by hand when homing [rad]; None: within +-0.03 rad, by the seed.
        build: Dimensions of the cart-pole.

    Raises:
        ConfigurationError: avr-gcc, a C compiler or simavr is missing, or the image cannot be read.
    """

    chip: Chip

    def __init__(
        self, truth: CartpoleTruth, *, start_angle_rad: float | None = None, build: Rig = NOMINAL_RIG
    ) -> None:
        chip = Chip(eeprom(settings_of(truth, delay_ticks(truth)), build.full_force_n))
        super().__init__(truth, chip, SerialLink(), start_angle_rad=start_angle_rad, build=build)
