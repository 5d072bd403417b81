"""Contract of a plug-in's emulator, and a runner that puts a device on a pseudo-terminal in real time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from deal_hw.drivers.ros2.faults import ControllerFaults
from deal_hw.drivers.servo_arm.faults import ArmFaults
from deal_hw.testing.faults import FaultRates, FrameFaults
from deal_hw.testing.joint_faults import JointFaults
from deal_hw.testing.pseudo_terminal import PortFaults, PseudoTerminal, SteppedDevice


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
        port: Where to listen, as after ``--port``; "": at the wire's ``emulator_port``, or at a
            pseudo-terminal.
        link: A symbolic link to make to the pseudo-terminal; None for none.
        vanish_after_s: The pseudo-terminal vanishes this long after the first command; None: never [s].
        return_after_s: It comes back under the link this long after that; None: it does not [s].
        servos: Faults of the servos of an arm.
        joints: Faults of the joints.
        controller: Faults of a controller of ros2_control.
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
    port: str = ""
    link: Path | None = None
    vanish_after_s: float | None = None
    return_after_s: float | None = None
    servos: ArmFaults = field(default_factory=ArmFaults)
    joints: JointFaults = field(default_factory=JointFaults)
    controller: ControllerFaults = field(default_factory=ControllerFaults)


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


def on_pseudo_terminal(
    device: SteppedDevice, request: EmulatorRequest, truth: Mapping[str, Any]
) -> Emulation:
    """Return a device behind a pseudo-terminal, with the faults of the request.

    Args:
        device: The device.
        request: What was asked for.
        truth: The hidden parameters, for the report at the end.
    """
    faults = None
    if request.rates != FaultRates():
        faults = FrameFaults(request.rates, np.random.default_rng([request.seed, 0xFA]), None)
    hazards = PortFaults(
        freeze_after_s=request.freeze_after_s,
        cut_after_s=request.cut_after_s,
        cut_s=request.cut_s,
        vanish_after_s=request.vanish_after_s,
        return_after_s=request.return_after_s,
        faults=faults,
    )
    return _OnPseudoTerminal(device, truth, request.link, hazards)


class _OnPseudoTerminal(PseudoTerminal):
    """A device behind a pseudo-terminal, with its truth in the report."""

    def __init__(
        self, device: SteppedDevice, truth: Mapping[str, Any], link: Path | None, hazards: PortFaults
    ) -> None:
        super().__init__(device, link, hazards)
        self._truth = truth

    def report(self) -> dict[str, Any]:
        """Return the truth and what happened."""
        return {**self._truth, **super().report()}
