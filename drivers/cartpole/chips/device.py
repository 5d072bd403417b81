"""The emulated device: firmware and mechanics in virtual device time. Bytes in, bytes out."""

from __future__ import annotations

import abc
from array import array
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from deal_hw.drivers.cartpole.chips.controller import Controller, Firmware, Mode
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.plant.mechanics import Mechanics
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, unique_id
from deal_hw.testing.joint_faults import FaultyJoints, JointFaults
from deal_hw.types import FloatArray

TICK_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class TrueTrajectory:
    """The true motion, for benches; never sent over the wire or to a calibrator.

    Attributes:
        tick: Device ticks, (T,).
        position: Cart and pole before each tick's physics step, (T, 2) [m, rad].
        velocity: (T, 2) [m/s, rad/s].
        force: Force on the cart held during the tick, (T,) [N].
        setpoint: Set-point of the servo, (T,) [m].
    """

    tick: np.ndarray[tuple[int], np.dtype[np.int64]]
    position: FloatArray
    velocity: FloatArray
    force: FloatArray
    setpoint: FloatArray


def python_firmware(truth: CartpoleTruth, mechanics: Mechanics) -> Firmware:
    """Return the firmware in Python, with the truth's servo, on serial frames."""
    servo = Servo(truth.parameters, mechanics.timestep_s)
    return Controller(servo, unique_id(truth), mechanics.command_delay)


class EmulatedDevice(abc.ABC):
    """A device on the mechanics of the emulated cart-pole, in device time: bytes in, bytes out.

    Attributes:
        received_bytes: Number of bytes from the host.

    Args:
        mechanics: The mechanics.
        keep_truth: Whether to keep the true trajectory for :meth:`true_trajectory`.
    """

    def __init__(self, mechanics: Mechanics, *, keep_truth: bool = False) -> None:
        self.received_bytes = 0
        self._mechanics = mechanics
        self._inbox = b""
        self._tick = 0
        self._kept: array[float] | None = array("d") if keep_truth else None

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        return self._tick * TICK_NS

    @property
    def true_position(self) -> tuple[float, float]:
        """True cart position and pole angle now [m, rad]; never on the wire."""
        return self._mechanics.position

    @property
    @abc.abstractmethod
    def armed(self) -> bool:
        """Whether the motor follows targets."""

    @property
    @abc.abstractmethod
    def mode(self) -> str:
        """State of the motor: "idle" and "held" without torque, "homing" and "armed" with torque."""

    @property
    @abc.abstractmethod
    def watchdog(self) -> bool:
        """Whether the motor was stopped because no commands came."""

    @property
    def trouble(self) -> str:
        """Current fault of its wire or its motors; "" for none."""
        return self._mechanics.joint_faults.now

    @property
    def joint_faults(self) -> FaultyJoints:
        """Faults of the joints; may be given at any time."""
        return self._mechanics.joint_faults

    def break_joints(self, faults: JointFaults) -> None:
        """Give the joints faults, whose times count from the first arming."""
        d = DESCRIPTION
        self._mechanics.joint_faults = FaultyJoints(faults, d.joint_names, d.actuated_index)

    def receive(self, data: bytes) -> None:
        """Take bytes from the host; the next tick handles them."""
        self._inbox += data
        self.received_bytes += len(data)

    def advance_to(self, device_ns: int) -> bytes:
        """Run every tick up to and including ``device_ns``; return the bytes sent meanwhile."""
        out = bytearray()
        while self.device_ns <= device_ns:
            out += self.tick()
        return bytes(out)

    @abc.abstractmethod
    def tick(self) -> bytes:
        """Run the next tick; return the bytes sent in it."""

    def true_trajectory(self) -> TrueTrajectory:
        """Return the true states of all ticks so far; none from a device made with ``keep_truth=False``."""
        rows = np.array(self._kept or []).reshape(-1, 7)
        return TrueTrajectory(rows[:, 0].astype(np.int64), rows[:, 1:3], rows[:, 3:5], rows[:, 5], rows[:, 6])

    def _keep(self, force_n: float, setpoint_m: float) -> None:
        if self._kept is not None:
            self._kept.extend((self._tick, *self._mechanics.truth_row(), force_n, setpoint_m))


class CartpoleDevice(EmulatedDevice):
    """Firmware and mechanics of an emulated cart-pole.

    Control tick k, at device time k ms: (1) handle received bytes, let due commands act; (2) slew the
    set-point; (3) force from the state at the start of the tick; (4) one physics step with that force. A
    state frame at tick k reports the state before step (4). Tick k runs when :meth:`advance_to` passes k ms,
    so bytes that arrive at exactly k ms are handled in tick k + 1.

    Until armed the motor is off: the pole hangs, or is held upright by a hand after homing. Between arming
    and the first target the force is zero, because gains come only with targets.

    Attributes:
        firmware: The firmware.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        keep_truth: Whether to keep the true trajectory for :meth:`true_trajectory`.
        start_angle_rad: Pole angle set by hand when homing [rad]; None: within +-0.03 rad, by the seed.
        firmware: Makes the firmware for these mechanics; the one in Python, on serial frames, by default.
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        *,
        keep_truth: bool = False,
        start_angle_rad: float | None = None,
        firmware: Callable[[CartpoleTruth, Mechanics], Firmware] = python_firmware,
    ) -> None:
        super().__init__(Mechanics(truth, start_angle_rad=start_angle_rad), keep_truth=keep_truth)
        self.firmware = firmware(truth, self._mechanics)

    @property
    def armed(self) -> bool:
        """Whether the motor follows targets."""
        return self.firmware.mode is Mode.ARMED

    @property
    def mode(self) -> str:
        """State of the motor: "idle" and "held" without torque, "homing" and "armed" with torque."""
        return "held" if self._mechanics.held else self.firmware.mode.name.lower()

    @property
    def watchdog(self) -> bool:
        """Whether the motor was stopped because no commands came, since it was last armed."""
        return self.firmware.watchdog

    @property
    def frame_errors(self) -> int:
        """Corrupt frames received so far."""
        return self.firmware.frame_errors

    def tick(self) -> bytes:
        """Run one control tick; return the bytes sent in it."""
        mechanics, firmware, out = self._mechanics, self.firmware, b""
        motor = mechanics.motor()
        if self._inbox:
            (data, self._inbox), homings, armings = (self._inbox, b""), firmware.homings, firmware.armings
            out = firmware.receive(data, motor)
            if firmware.armings != armings:
                mechanics.release()
            for _ in range(firmware.homings - homings):
                mechanics.begin_homing()
                motor = mechanics.motor()
            if mechanics.homing and firmware.mode is not Mode.HOMING:
                mechanics.release()
        force, report_due = firmware.control(motor)
        mechanics.observe(firmware.setpoint)
        self._keep(force, firmware.setpoint)
        if report_due:
            frame = firmware.report(mechanics.read())
            out += b"" if mechanics.loses_frame() else frame
        if mechanics.step(force):
            firmware.finish_homing()
        self._tick += 1
        return out
