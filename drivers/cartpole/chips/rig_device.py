"""A chip with the firmware on the mechanics of the emulated cart-pole, pin by pin."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from deal_hw.drivers.cartpole.chips.device import EmulatedDevice
from deal_hw.drivers.cartpole.plant.mechanics import Mechanics
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.link import Link
from deal_hw.types import Status


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


NOMINAL_RIG: Final = Rig()


class ChipOutputs(ctypes.Structure):
    """What a chip's pins did in the last millisecond; the chips add fields of their own.

    Attributes:
        pwm: Mean of the motor's PWM, negative to the left.
        armed: Whether the lamp "armed" is on.
        set_pole: Whether the lamp "set the pole upright" is on.
    """

    _fields_: ClassVar[Sequence[Any]] = (
        ("pwm", ctypes.c_double),
        ("armed", ctypes.c_int32),
        ("set_pole", ctypes.c_int32),
    )


BYTES_PER_TICK: Final = 99
"""One byte less than 1 Mbaud carries in 1 ms, so that no byte is left over."""


class RigChip:
    """A chip that a C library runs, one millisecond for each call.

    Attributes:
        outputs: Its outputs in the last millisecond.

    Args:
        run: The library's function for a millisecond.
        outputs: Where that function writes them.
        most: Bytes that the wire carries in a millisecond; None: all at once.
    """

    ARGUMENTS: ClassVar[Sequence[Any]] = (
        *[ctypes.c_int32] * 2,
        *[ctypes.c_int] * 2,
        *(ctypes.c_char_p, ctypes.c_uint32, ctypes.c_char_p, ctypes.c_void_p),
    )
    """Types of the function's arguments."""

    def __init__(self, run: Callable[..., int], outputs: ChipOutputs, most: int | None) -> None:
        self.outputs = outputs
        self._run, self._most = run, most
        self._out = ctypes.create_string_buffer(4096)
        self._inbox = b""

    def tick(
        self,
        cart_counts: int = 0,
        pole_counts: int = 0,
        switches: tuple[bool, bool] = (False, False),
        data: bytes = b"",
    ) -> bytes:
        """Run a millisecond; return the bytes or frames sent in it.

        Args:
            cart_counts: Motion of the cart's encoder.
            pole_counts: Motion of the pole's encoder.
            switches: Whether the left and the right limit switch are closed.
            data: From the host; it comes as fast as the wire carries it, also in later calls.

        Raises:
            ConfigurationError: The chip's program ended.
        """
        inbox = self._inbox + data
        most = len(inbox) if self._most is None else self._most
        data, self._inbox = inbox[:most], inbox[most:]
        length = self._run(
            cart_counts, pole_counts, *switches, data, len(data), self._out, ctypes.byref(self.outputs)
        )
        self._note()
        return self._out.raw[:length]

    def _note(self) -> None:
        """Store the outputs."""

    def close(self) -> None:
        """Free its memory."""


def delay_ticks(truth: CartpoleTruth) -> int:
    """Return a truth's mean latency in whole ticks, which a chip has between a command and its action."""
    return int(1e3 * truth.latency_s + 1e-6)


class RigDevice(EmulatedDevice):
    """A chip on a cart-pole.

    The chip sees only its pins: edges of two quadrature encoders, two limit switches, its wire. Its PWM,
    averaged over each millisecond, is the force on the cart. Noise and jitter of the profile have no effect,
    since encoders count exactly. The whole latency is between a command and its action.

    Attributes:
        chip: The chip.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        chip: The chip.
        link: Reads what the chip sends.
        start_angle_rad: Pole angle set by hand when homing [rad]; None: within +-0.03 rad, by the seed.
        build: Dimensions of the cart-pole.
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        chip: RigChip,
        link: Link,
        *,
        start_angle_rad: float | None = None,
        build: Rig = NOMINAL_RIG,
    ) -> None:
        super().__init__(Mechanics(truth, start_angle_rad=start_angle_rad))
        self.chip = chip
        self._build = build
        self._counted = self._counts()
        self._setting_pole = False
        self._link = link
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
        # The hand moves the pole along the shorter way, so the simulator's angle may jump by whole turns.
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
        # Without this prediction all edges would come a millisecond late, and the cart would seem lighter.
        motor = self._mechanics.motor()
        _, pole, _, pole_velocity = self._mechanics.truth_row()
        cart = motor.position + motor.velocity * 1e-3
        turns = (pole + pole_velocity * 1e-3 - math.pi) / math.tau * self._build.counts_per_turn
        return math.floor(cart / self._build.m_per_count + 0.5), math.floor(turns + 0.5)

    def _listen(self, data: bytes) -> None:
        for message in self._link.decode(data):
            if isinstance(message, protocol.State):
                self._status = Status(message.status)
