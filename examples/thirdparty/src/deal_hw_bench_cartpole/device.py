"""The emulated robot: firmware and mechanics in virtual device time. Bytes in, bytes out."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Mapping
from typing import Any, Final

import mujoco
import numpy as np

from deal_hw_bench_cartpole import protocol
from deal_hw_bench_cartpole.description import (
    CART_FRICTION_NS_M,
    CART_KG,
    COUNTS_M,
    COUNTS_RAD,
    DESCRIPTION,
    TRACK_M,
)
from deal_hw_bench_cartpole.protocol import Command, Splitter, State

TICK_NS: Final = 1_000_000
TURN: Final = 2 * np.pi * COUNTS_RAD
"""Counts of a full turn, where the potentiometer begins again at 0."""
NEAR_END: Final = 20
"""A command towards an end of the track has no effect within these counts of it."""
FIRMWARES: Final = (31, 36, 40)
"""Lengths of a state's frame, which name the firmware's layout [bytes]."""
CALIBRATION_MS: Final = 1510
"""No multiple of the control period, so that its end lies between two states."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What the emulated robot really is; it never leaves the emulator before its end.

    Attributes:
        cart_kg: Mass of the cart.
        friction: Viscous friction of the cart [N·s/m].
        hanging: The encoder's count where the pole hangs.
        start_m: Where the cart stands at power-on.
        start_rad: Angle of the pole from hanging at power-on.
        noise: Whether the encoders are noisy.
        seed: Of the noise.
        state_length: Length of its states' frames [bytes]: 31 for firmware of 2024, 36 and 40 for later ones.
    """

    cart_kg: float = CART_KG
    friction: float = CART_FRICTION_NS_M
    hanging: float = 1068.0
    start_m: float = 0.0
    start_rad: float = 0.0
    noise: bool = False
    seed: int = 0
    state_length: int = 31


def draw_truth(profile: str, seed: int, range_ratio: float) -> Truth:
    """Return a truth: mass and friction within a factor of their usual values, firmware by turns."""
    rng = np.random.default_rng(seed)
    cart, friction = range_ratio ** rng.uniform(-1.0, 1.0, 2)
    return Truth(
        cart_kg=float(CART_KG * cart),
        friction=float(CART_FRICTION_NS_M * friction),
        hanging=float(rng.uniform(910.0, 1250.0)),
        start_m=float(rng.uniform(-0.05, 0.05)),
        start_rad=float(rng.uniform(-0.05, 0.05)),
        noise=profile != "ideal",
        seed=seed,
        state_length=FIRMWARES[seed % len(FIRMWARES)],
    )


class Device:
    """Firmware and mechanics. A command takes effect at the next control tick.

    Attributes:
        received_bytes: Number of bytes from the host.

    Args:
        truth: The mechanics, and the layout of the firmware.
    """

    def __init__(self, truth: Truth) -> None:
        self.received_bytes = 0
        self._truth = truth
        self._rng = np.random.default_rng(truth.seed)
        self._model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
        cart = self._model.body("cart").id
        self._model.body_inertia[cart] *= truth.cart_kg / self._model.body_mass[cart]
        self._model.body_mass[cart] = truth.cart_kg
        self._model.dof_damping[0] = truth.friction
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = truth.start_m, np.pi + truth.start_rad
        self._origin_m = truth.start_m
        self._splitter, self._inbox = Splitter(), b""
        self._tick, self._period = 0, 20
        self._streaming = self._enabled = False
        self._motor = self._next_motor = 0
        self._calibrating = 0

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        return self._tick * TICK_NS

    @property
    def armed(self) -> bool:
        """Whether the motor has had a command."""
        return self._motor != 0

    @property
    def mode(self) -> str:
        """State of the motor. Later firmware is "enabled" while its output is on without a command."""
        if self._calibrating:
            return "homing"
        return "armed" if self._motor else "enabled" if self._enabled else "idle"

    @property
    def watchdog(self) -> bool:
        """Always False: the robot holds its last command."""
        return False

    @property
    def trouble(self) -> str:
        """No fault of its own."""
        return ""

    @property
    def position(self) -> tuple[float, float]:
        """True positions of cart and pole [m, rad]."""
        return float(self._data.qpos[0]), float(self._data.qpos[1])

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        self.received_bytes += len(data)
        self._inbox += data

    def advance_to(self, device_ns: int) -> bytes:
        """Run every tick up to and including ``device_ns``; return the bytes sent meanwhile."""
        out = b""
        while self.device_ns <= device_ns:
            out += self.tick()
        return out

    def tick(self) -> bytes:
        """Run the next millisecond; return the bytes sent in it."""
        inbox, self._inbox = self._inbox, b""
        out = b"".join(self._obey(data) for data in self._splitter.feed(inbox))
        if self._calibrating:
            out += self._calibrate()
        if self._tick % self._period == 0:
            self._motor = self._next_motor
            if self._streaming:
                out += protocol.encode_state(self._sense())
        self._data.ctrl[0] = self._force()
        mujoco.mj_step(self._model, self._data)
        self._tick += 1
        return out

    def _obey(self, data: bytes) -> bytes:
        command, payload = data[1], data[3:-1]
        if command == Command.PING:
            return data
        if command == Command.STREAM:
            self._streaming = bool(payload[0])
        elif command == Command.CALIBRATE:
            self._calibrating, self._next_motor = CALIBRATION_MS, 0
        elif command == Command.CONFIGURE:
            self._period = max(1, struct.unpack_from("<H", payload)[0])
        elif command == Command.PC_CONTROL and self._truth.state_length > 31:
            self._enabled, self._next_motor = bool(payload[0]), 0
        elif command == Command.MOTOR and not self._calibrating:
            (counts,) = struct.unpack("<i", payload)
            allowed = self._enabled or self._truth.state_length == 31
            self._next_motor = counts if allowed else 0
        return b""

    def _calibrate(self) -> bytes:
        """Bring the cart to the centre of its track; the real firmware touches both ends first."""
        self._calibrating -= 1
        if self._calibrating:
            return b""
        self._origin_m = 0.0
        return protocol.frame(Command.CALIBRATE, struct.pack("<b", 1))

    def _sense(self) -> State:
        x, angle = self.position
        noise = self._rng.normal(size=2) * DESCRIPTION.sensor.noise if self._truth.noise else np.zeros(2)
        counts = self._truth.hanging + (angle - np.pi + noise[1]) * COUNTS_RAD
        return State(
            angle=round(counts % TURN),
            position=round((x - self._origin_m + noise[0]) * COUNTS_M),
            motor=self._motor,
            time_us=self._tick * 1000,
            length=self._truth.state_length,
        )

    def _force(self) -> float:
        """Return the share of the motor's force that acts now."""
        x, speed = self._data.qpos[0], self._data.qvel[0]
        if self._calibrating:
            return float(np.clip(-20.0 * x - 2.0 * speed, -0.3, 0.3))
        share = float(np.clip(self._motor / protocol.LARGEST_COMMAND, -1.0, 1.0))
        towards_end = (TRACK_M - abs(x)) * COUNTS_M < NEAR_END and share * x > 0
        return 0.0 if towards_end else share


def truth_from(values: Mapping[str, Any]) -> Truth:
    """Return the truth of a file that ``deal-hw emulate --reveal-to`` wrote."""
    known = {field.name for field in dataclasses.fields(Truth)}
    return Truth(**{name: value for name, value in values.items() if name in known})
