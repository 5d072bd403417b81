"""The firmware's port to the STM32F103 with the chip's registers in memory, on the cart-pole's mechanics.

``stm32/main.c`` or ``encoder.c`` is compiled for this host. ``host/stm32.c`` stands in for timers, pins,
UART and CAN.
"""

from __future__ import annotations

import ctypes
import functools

from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.host_firmware import flash_page, settings_of
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
from deal_hw.drivers.cartpole.wire.can_link import CanLink
from deal_hw.drivers.cartpole.wire.link import SerialLink

_INSTALL = "apt-get install gcc libc6-dev, or set CC"


class _Outputs(ChipOutputs):
    _fields_ = (
        ("unserved_ms", ctypes.c_uint32),
        ("filtered", ctypes.c_uint32),
        ("bit_rate", ctypes.c_uint32),
    )


@functools.cache
def library(*, encoder: bool = False) -> ctypes.CDLL:
    """Return the port with its registers, compiled on the first call.

    Args:
        encoder: Return the pole encoder node's program.

    Raises:
        ConfigurationError: There is no compiler, or it refuses the sources.
    """
    command = (native.compiler(), *native.CFLAGS, "-shared", "-fPIC", *(("-DENCODER",) if encoder else ()))
    chip = ctypes.CDLL(
        str(native.build("stm32.so", command, ("host/stm32.c", "rig.c", *native.CORE), _INSTALL))
    )
    number = ctypes.c_uint32
    chip.chip_start.restype, chip.chip_start.argtypes = None, [ctypes.c_char_p, number, ctypes.c_int]
    chip.chip_bus.restype, chip.chip_bus.argtypes = None, [ctypes.c_int, number, ctypes.c_int]
    chip.chip_tick.restype, chip.chip_tick.argtypes = number, RigChip.ARGUMENTS
    return chip


class Stm32Chip(RigChip):
    """The port with its registers in memory; only the one that started last lives.

    Attributes:
        outputs: Mean PWM, lamps, milliseconds without service of the watchdog, frames that the filter kept
            out, bit rate [bit/s].

    Args:
        page: Contents of the last page of its flash.
        can: Whether the jumper BOOT1 chooses CAN; bytes are then frames of
            :data:`~deal_hw.drivers.cartpole.wire.can_link.FRAME`.
        encoder: Whether it has the pole encoder node's program, which is always on CAN.

    Raises:
        ConfigurationError: There is no C compiler.
    """

    def __init__(self, page: bytes, *, can: bool = True, encoder: bool = False) -> None:
        self._library = library(encoder=encoder)
        self._library.chip_start(page, len(page), can)
        super().__init__(self._library.chip_tick, _Outputs(), None if can else BYTES_PER_TICK)

    def bus(self, *, silent: bool = False, errors: int = 0, overrun: bool = False) -> None:
        """Let the bus fail.

        Args:
            silent: Nobody acknowledges a frame.
            errors: The controller's register of errors (ESR).
            overrun: A frame from the host found the controller full.
        """
        self._library.chip_bus(silent, errors, overrun)


class Stm32Device(RigDevice):
    """An STM32F103 on a cart-pole.

    Attributes:
        chip: The chip.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        can: Whether it is on CAN, otherwise serial.
        start_angle_rad: Pole angle set by hand when homing [rad]; None: within +-0.03 rad, by the seed.
        build: Dimensions of the cart-pole.

    Raises:
        ConfigurationError: There is no C compiler.
    """

    chip: Stm32Chip

    def __init__(
        self,
        truth: CartpoleTruth,
        *,
        can: bool,
        start_angle_rad: float | None = None,
        build: Rig = NOMINAL_RIG,
    ) -> None:
        page = flash_page(settings_of(truth, delay_ticks(truth)), build.full_force_n)
        link = CanLink() if can else SerialLink()
        super().__init__(truth, Stm32Chip(page, can=can), link, start_angle_rad=start_angle_rad, build=build)
