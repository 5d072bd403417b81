"""The firmware's C core, compiled for this host, in place of the one in Python."""

from __future__ import annotations

import ctypes
import functools
import struct
from collections.abc import Callable

from fastcrc import crc16

from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.controller import Mode
from deal_hw.drivers.cartpole.description import (
    DAMPING_NS_M,
    EFFORT_LIMIT_N,
    SPEED_LIMIT_M_S,
    STIFFNESS_N_M,
)
from deal_hw.drivers.cartpole.plant.mechanics import Mechanics
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading, fit
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, unique_id
from deal_hw.drivers.cartpole.wire import protocol

_MODES = (Mode.IDLE, Mode.HOMING, Mode.ARMED)
_ONE = 65536
_DRAW = ctypes.CFUNCTYPE(ctypes.c_uint16)
_MOST_ANSWERS = 5
"""Frames of the longest answer on CAN, an info."""
_INSTALL = "apt-get install gcc libc6-dev, or set CC, or use --firmware python"


class Settings(ctypes.Structure):
    """``cartpole_settings`` of cartpole.h."""

    _fields_ = [
        ("stiffness_trim", ctypes.c_uint32),
        ("damping_trim", ctypes.c_uint32),
        ("effort_trim", ctypes.c_uint32),
        ("speed_trim", ctypes.c_uint32),
        ("unique_id", ctypes.c_uint32),
        ("delay_ticks", ctypes.c_uint16),
    ]


def settings_of(truth: CartpoleTruth, delay_ticks: int) -> Settings:
    """Return the settings of a device with this truth; its trims are factors that the host does not know."""
    nominal = {
        "stiffness": STIFFNESS_N_M,
        "damping": DAMPING_NS_M,
        "effort_limit": EFFORT_LIMIT_N,
        "speed_limit": SPEED_LIMIT_M_S,
    }
    trims = [round(truth.parameters[f"servo.{name}"] / value * _ONE) for name, value in nominal.items()]
    return Settings(*trims, unique_id(truth), delay_ticks)


def stored(settings: Settings, *more: int) -> bytes:
    """Return settings and more 16-bit numbers with their CRC, little-endian, as a chip keeps them."""
    known = [getattr(settings, name) for name, *_ in Settings._fields_]
    data = struct.pack(f"<5I{1 + len(more)}H", *known, *more)
    return data + struct.pack("<H", crc16.ibm_3740(data))


def flash_page(
    settings: Settings, full_force_n: float, node: int = 1, can_kbit: int = 500, drive: int = 0
) -> bytes:
    """Return the settings for the last page of the chip's flash, with their CRC, little-endian.

    Args:
        settings: Trims, serial number, delay.
        full_force_n: Force on the cart with the PWM fully on [N].
        node: Number on the CAN bus.
        can_kbit: Bit rate of the CAN bus: 250, 500 or 1000 [kbit/s].
        drive: Number of the motor drive beside a pole encoder node.
    """
    return stored(settings, round(full_force_n * 1000), node, can_kbit, drive)


@functools.cache
def library() -> ctypes.CDLL:
    """Return the core, compiled on the first call.

    Raises:
        ConfigurationError: There is no compiler, or it refuses the sources.
    """
    command = (native.compiler(), *native.CFLAGS, "-DCARTPOLE_QUEUE=256", "-shared", "-fPIC")
    core = ctypes.CDLL(str(native.build("core.so", command, (*native.CORE, "host/core.c"), _INSTALL)))
    device, integer, number, data = ctypes.c_char_p, ctypes.c_int32, ctypes.c_uint32, ctypes.c_char_p
    can = ctypes.c_char_p
    for name, result, arguments in (
        ("host_size", number, []),
        ("host_can_size", number, []),
        ("host_init", None, [device, ctypes.POINTER(Settings), _DRAW]),
        ("host_can_init", None, [device, can, number, number, ctypes.c_int]),
        ("host_can_receive", number, [device, can, data, number, integer, integer, data]),
        ("host_can_report", number, [device, can, *[integer] * 5, ctypes.c_int, data]),
        ("host_can_errors", number, [can]),
        ("host_receive", number, [device, data, number, integer, integer, data]),
        ("host_control", ctypes.c_int, [device, integer, integer, ctypes.POINTER(ctypes.c_int64)]),
        ("host_report", number, [device, *[integer] * 5, ctypes.c_int, data]),
        ("host_look", None, [device, integer * 6]),
    ):
        function = getattr(core, name)
        function.restype, function.argtypes = result, arguments
    return core


class HostFirmware:
    """The C core behind the interface of the emulator.

    Args:
        settings: Trims and serial number.
        command_delay: Called for every accepted target: it acts that many ticks after it was received.

    Raises:
        ConfigurationError: There is no compiler, or it refuses the sources.
    """

    def __init__(self, settings: Settings, command_delay: Callable[[], int]) -> None:
        self._core = library()
        self._device = ctypes.create_string_buffer(self._core.host_size())
        self._draw = _DRAW(command_delay)  # The core keeps its address.
        self._core.host_init(self._device, ctypes.byref(settings), self._draw)
        self._force = ctypes.c_int64()
        self._frame = ctypes.create_string_buffer(128)
        self._looked = (ctypes.c_int32 * 6)()
        self._look()

    @classmethod
    def of(cls, truth: CartpoleTruth, mechanics: Mechanics) -> HostFirmware:
        """Return the firmware of an emulated device."""
        return cls(settings_of(truth, 0), mechanics.command_delay)

    @property
    def mode(self) -> Mode:
        """State of the motor."""
        return _MODES[self._looked[0]]

    @property
    def watchdog(self) -> bool:
        """Whether the motor was stopped because no commands came, since it was last armed."""
        return bool(self._looked[1])

    @property
    def frame_errors(self) -> int:
        """Corrupt frames received so far."""
        return self._looked[2]

    @property
    def homings(self) -> int:
        """How often homing began."""
        return self._looked[3]

    @property
    def armings(self) -> int:
        """How often the motor was armed."""
        return self._looked[4]

    @property
    def setpoint(self) -> float:
        """Set-point of the servo [m]."""
        return self._looked[5] / 1e9

    def receive(self, data: bytes, motor: Motor) -> bytes:
        """Handle what the host sent before this tick; return the answers."""
        out = ctypes.create_string_buffer((len(data) // 5 + 2) * 65)
        length = self._core.host_receive(self._device, data, len(data), *_integers(motor), out)
        self._look()
        return out.raw[:length]

    def control(self, motor: Motor) -> tuple[float, bool]:
        """Run one tick; return the force on the cart [N], and whether a state frame is due."""
        due = self._core.host_control(self._device, *_integers(motor), ctypes.byref(self._force))
        self._look()
        return self._force.value * 1e-12, bool(due)

    def report(self, reading: Reading) -> bytes:
        """Return the state frame of the tick that :meth:`control` ran last."""
        length = self._core.host_report(self._device, *_values(reading), self._frame)
        return self._frame.raw[:length]

    def finish_homing(self) -> None:
        """Note that the cart is in the middle and the pole upright; only has an effect while homing."""
        self._core.cartpole_finish_homing(self._device)
        self._look()

    def _look(self) -> None:
        self._core.host_look(self._device, self._looked)


class CanHostFirmware(HostFirmware):
    """The C core on CAN frames, in the layout of :data:`~deal_hw.drivers.cartpole.wire.can_link.FRAME`.

    Args:
        settings: Trims and serial number.
        command_delay: As for :class:`HostFirmware`.
        node: Number of the device, 1 to 62.
        version: Version of the protocol that it speaks.
        encoder: Whether it is a pole encoder node, without a motor.

    Raises:
        ConfigurationError: There is no compiler, or it refuses the sources.
    """

    def __init__(
        self,
        settings: Settings,
        command_delay: Callable[[], int],
        node: int,
        version: int = protocol.VERSION,
        *,
        encoder: bool = False,
    ) -> None:
        super().__init__(settings, command_delay)
        self._can = ctypes.create_string_buffer(self._core.host_can_size())
        self._core.host_can_init(self._device, self._can, node, version, encoder)

    @property
    def frame_errors(self) -> int:
        """Corrupt or unknown frames and messages received so far."""
        return int(self._core.host_can_errors(self._can))

    def receive(self, data: bytes, motor: Motor) -> bytes:
        """Handle the host's frames before this tick; return the frames of the answers."""
        out = ctypes.create_string_buffer(_MOST_ANSWERS * len(data))
        length = self._core.host_can_receive(self._device, self._can, data, len(data), *_integers(motor), out)
        self._look()
        return out.raw[:length]

    def report(self, reading: Reading) -> bytes:
        """Return the frames of the state of the tick that :meth:`control` ran last."""
        length = self._core.host_can_report(self._device, self._can, *_values(reading), self._frame)
        return self._frame.raw[:length]


def _integers(motor: Motor) -> tuple[int, int]:
    return fit(motor.position * 1e9), fit(motor.velocity * 1e6)


def _values(reading: Reading) -> tuple[int, ...]:
    return (*reading[:4], fit(reading.setpoint * 1e9), reading.at_end_stop)
