"""Contract of a plug-in's emulator, and a runner that puts a device on a pseudo-terminal in real time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

from deal_hw.testing.faults import FaultRates


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatorRequest:
    """What ``deal-hw emulate`` asks for; the emulator of a plug-in is called ``emulator(request)``.

    Attributes:
        wire: The wire.
        profile: "ideal" (equations only), "sensor" or "realistic".
        seed: Seed of the hidden parameters and of the noise.
        range_ratio: Hidden parameters lie within this factor of the nominal ones; None: the robot's usual.
        nominal: Whether to use the nominal parameters.
        truth: Hidden parameters as a former emulation reported them; None to draw some.
        rates: Faults of the frames that the device sends.
        freeze_after_s: The firmware hangs this long after the first command; None: never [s].
        cut_after_s: The wire is cut this long after the first command; None: never [s].
        cut_s: How long it is cut [s].
    """

    wire: str
    profile: str = "realistic"
    seed: int = 0
    range_ratio: float | None = None
    nominal: bool = False
    truth: Mapping[str, Any] | None = None
    rates: FaultRates = field(default_factory=FaultRates)
    freeze_after_s: float | None = None
    cut_after_s: float | None = None
    cut_s: float = 1.0


class Emulation(Protocol):
    """An emulated robot that has its port in real time; not opened when it is made."""

    @property
    def changes(self) -> Sequence[tuple[int, int, str]]:
        """What happened so far: device time [ms], host time [ns] and the event."""
        ...

    def open(self) -> str:
        """Make the port and return it."""
        ...

    def step(self) -> bool:
        """Serve the port for a few milliseconds; return whether it still exists."""
        ...

    def cut(self) -> None:
        """Cut the wire for a while."""
        ...

    def close(self) -> None:
        """Remove the port."""
        ...

    def report(self) -> Mapping[str, Any]:
        """Return the hidden parameters and what happened, as plain JSON values."""
        ...


class SteppedDevice(Protocol):
    """A device in virtual device time: bytes in, bytes out. It also fits a ``VirtualTransport``."""

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        ...

    @property
    def armed(self) -> bool:
        """Whether the motor follows commands; times of faults count from its first moment."""
        ...

    @property
    def mode(self) -> str:
        """State of the motor, one word."""
        ...

    @property
    def watchdog(self) -> bool:
        """Whether the device stopped its motor because no commands came."""
        ...

    @property
    def trouble(self) -> str:
        """Current fault; "" for none."""
        ...

    @property
    def received_bytes(self) -> int:
        """Number of bytes from the host."""
        ...

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        ...

    def advance_to(self, device_ns: int) -> bytes:
        """Run every tick up to and including a time [ns]; return the bytes sent meanwhile."""
        ...


def on_pseudo_terminal(
    device: SteppedDevice, request: EmulatorRequest, truth: Mapping[str, Any]
) -> Emulation:
    """Return a device behind a pseudo-terminal, with the faults of the request.

    Args:
        device: The device.
        request: What was asked for.
        truth: The hidden parameters, for the report at the end.
    """
    import numpy as np

    from deal_hw.drivers.cartpole.emulator.emulator import CartpoleEmulator
    from deal_hw.drivers.cartpole.emulator.faults import Hazards
    from deal_hw.testing.faults import FrameFaults

    faults = None
    if request.rates != FaultRates():
        faults = FrameFaults(request.rates, np.random.default_rng([request.seed, 0xFA]), None)
    hazards = Hazards(
        freeze_after_s=request.freeze_after_s,
        cut_after_s=request.cut_after_s,
        cut_s=request.cut_s,
        faults=faults,
    )

    class OnPseudoTerminal(CartpoleEmulator):
        """The runner of the cart-pole's emulators, with the truth in its report."""

        def report(self) -> dict[str, Any]:
            """Return the truth and what happened."""
            return {**truth, **super().report()}

    # It uses what `SteppedDevice` has, and nothing else of its own devices.
    return OnPseudoTerminal(cast(Any, device), None, hazards)
