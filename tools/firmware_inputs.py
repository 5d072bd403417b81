"""The same inputs for each build of the cart-pole's firmware, and the arithmetic of its servo, written again.

A build is right if it answers bit for bit as the state machine in Python with :class:`IntegerServo` does. The
core for a Cortex-M3 is given what :class:`RecordedCore` recorded of the host's.
"""

from __future__ import annotations

import random
import struct
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.controller import Firmware, Mode
from deal_hw.drivers.cartpole.chips.host_firmware import CanHostFirmware, HostFirmware, Settings
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import FRAME, CanLink
from deal_hw.drivers.cartpole.wire.protocol import Target

Wire = tuple[Callable[[protocol.AnyMessage], bytes], Callable[[bytes], bytes]]
"""How a message is written, and 20 random bytes as what no host sends."""


def _can_garbage(noise: bytes) -> bytes:
    """Return any frame to or from node 1, and one part of a target."""
    part = FRAME.pack(0x21 + noise[10] % 3, 8, noise[11:19])
    return FRAME.pack(0x20 | noise[0] & 0x1F, noise[1] % 9, noise[2:10]) + part


SERIAL: Wire = (protocol.encode, lambda noise: noise + b"\0")
CAN: Wire = (CanLink().encode, _can_garbage)


def script(seed: int, ticks: int, wire: Wire = SERIAL) -> Iterator[tuple[bytes, Motor, Reading]]:
    """Yield what comes from host and sensors in each tick; all floats are exact, so every machine agrees."""
    encode, garbage = wire
    rng = random.Random(seed)
    sequence = request = 0
    cart = 0
    for tick in range(ticks):
        data = b""
        while rng.random() < 0.06:
            kind = rng.random()
            if kind < 0.6:
                sequence += rng.random() < 0.9
                data += encode(
                    protocol.Target(
                        sequence,
                        rng.randint(-500_000, 500_000),
                        rng.randint(0, 160_000),
                        rng.randint(0, 16_000),
                        rng.randint(0, 8_000),
                        rng.randint(0, 3_000_000),
                    )
                )
            elif kind < 0.65:
                data += garbage(rng.randbytes(20))
            else:
                request += rng.random() < 0.9
                choice = rng.choices(
                    (protocol.Arm, protocol.Home, protocol.Stop, protocol.Hello), (16, 2, 1, 1)
                )
                data += encode(choice[0](request % 256))
        step = rng.randint(-3000, 3000)
        cart = max(-400_000, min(400_000, cart + step))
        reading = Reading(
            cart, step * 1000, rng.randint(-4_000_000, 4_000_000), step, cart / 2**20, tick % 97 == 0
        )
        yield data, Motor(cart / 2**20, step / 2**10), reading


def outputs(
    firmware: Firmware, seed: int, ticks: int = 3000, wire: Wire = SERIAL
) -> Iterator[tuple[bytes, float, str]]:
    """Run a firmware on a script, homing after 100 ticks; yield bytes, force and mode of each tick."""
    since = 0
    for data, motor, reading in script(seed, ticks, wire):
        out = firmware.receive(data, motor) if data else b""
        force, report_due = firmware.control(motor)
        if report_due:
            out += firmware.report(reading)
        since = since + 1 if firmware.mode is Mode.HOMING else 0
        if since >= 100:
            firmware.finish_homing()
        yield out, force, firmware.mode.name


def cut(value: int, most: int) -> int:
    """Return a value within plus or minus the most."""
    return max(-most, min(most, value))


class IntegerServo(Servo):
    """The arithmetic of servo.c, written again from docs/how-to/firmware.md."""

    def __init__(self, settings: Settings) -> None:
        self._trims = settings
        self._nm = 0
        self.reset(0.0)

    def reset(self, position: float) -> None:
        """Start over at a position [m], without gains."""
        self._nm = self._target_nm = cut(round(position * 1e9), 10**9)
        self.setpoint = self._nm / 1e9
        self._step_nm = 0
        self._sent = self._real = (0, 0, 0)

    def accept(self, target: Target) -> None:
        """Let a target act."""

        def trim(value: int, trim: int, most: int) -> int:
            return min((value * trim + 2**15) // 2**16, most)

        def gains(stiffness: int, damping: int, limit_un: int) -> tuple[int, int, int]:
            damping_un = damping * 1000 if damping <= 2_147_483 else 2**31 - 1
            return min(stiffness, 2**31 - 1), damping_un, limit_un * 10**6

        t, most = self._trims, 2**31 - 1
        self._target_nm = cut(target.position_um, 400_000) * 1000
        self._step_nm = trim(target.speed_limit_um_s, t.speed_trim, 500_000_000)
        limit_un = target.effort_limit_mn * 1000
        self._sent = gains(target.stiffness_mn_m, target.damping_mns_m, limit_un)
        self._real = gains(
            trim(target.stiffness_mn_m, t.stiffness_trim, most),
            trim(target.damping_mns_m, t.damping_trim, most),
            trim(limit_un, t.effort_trim, 2**32 - 1),
        )

    def update(self, position: float, velocity: float) -> float:
        """Run one period; return the force on the cart [N]."""
        self._nm += cut(self._target_nm - self._nm, self._step_nm)
        self.setpoint = self._nm / 1e9
        error = self._nm - cut(cut(round(position * 1e9), 2**31 - 1), 10**9)
        return cut(self._demand(self._real, error, round(velocity * 1e6)), self._real[2]) * 1e-12

    @property
    def slewing(self) -> bool:
        """Whether the speed limit keeps the set-point from its target."""
        return self._nm != self._target_nm

    def estimate(self, setpoint: float, position: float, velocity: float) -> tuple[float, bool]:
        """Return the demand by the commanded gains [N], and whether the limit cut it."""
        limit = self._sent[2]
        error = cut(round(setpoint * 1e9), 10**9) - cut(round(position * 1e6), 10**6) * 1000
        demand = self._demand(self._sent, error, round(velocity * 1e6))
        micro = cut((cut(demand, limit) + 2**19) >> 20, 2**31 - 1)
        return ((micro * 4503600 + 2**31) >> 32) / 1e3, limit > 0 and abs(demand) >= limit

    @staticmethod
    def _demand(gains: tuple[int, int, int], error_nm: int, velocity_um_s: int) -> int:
        return gains[0] * error_nm - gains[1] * cut(velocity_um_s, 2**25 - 1)


MACHINE = ("qemu-system-arm", "-M", "stm32vldiscovery", "-display", "none", "-monitor", "none")
"""QEMU's nearest chip: an STM32F100, with the same core, memory map, timer SysTick and UART."""
INSTALL_QEMU = "apt-get install --no-install-recommends qemu-system-arm"


class RecordedCore:
    """The host's core, which keeps each call and its result for another build of the core.

    Attributes:
        calls: The calls so far, as firmware/host/qemu.c reads them.
        results: What the calls returned.

    Args:
        settings: Trims, serial number and delay.
        can: Whether it is on CAN, as node 1.
        encoder: Whether it is a pole encoder node.
    """

    def __init__(self, settings: Settings, *, can: bool, encoder: bool = False) -> None:
        ticks = int(settings.delay_ticks)
        self._core = (
            CanHostFirmware(settings, lambda: ticks, 1, encoder=encoder)
            if can
            else HostFirmware(settings, lambda: ticks)
        )
        self._letters = (b"r", b"s") if can else (b"R", b"S")
        self.calls = b"I" + bytes(settings) + struct.pack("<3I", 1, protocol.VERSION, encoder)
        self.results = b""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._core, name)

    def receive(self, data: bytes, motor: Motor) -> bytes:
        """Handle the host's bytes."""
        self.calls += self._letters[0] + struct.pack("<I", len(data)) + data + _motor(motor)
        self.results += (out := self._core.receive(data, motor))
        return out

    def control(self, motor: Motor) -> tuple[float, bool]:
        """Run one tick."""
        self.calls += b"C" + _motor(motor)
        force, due = self._core.control(motor)
        self.results += struct.pack("<Iq", due, round(force * 1e12)) + bytes(self._core._looked)
        return force, due

    def report(self, reading: Reading) -> bytes:
        """Return the frames of a state."""
        setpoint = round(reading.setpoint * 1e9)
        self.calls += self._letters[1] + struct.pack("<6i", *reading[:4], setpoint, reading.at_end_stop)
        self.results += (out := self._core.report(reading))
        return out

    def finish_homing(self) -> None:
        """The cart is in the middle and the pole upright."""
        self.calls += b"F"
        self._core.finish_homing()


def results_under_qemu(calls: bytes, folder: Path) -> bytes:
    """Return the results of recorded calls of the core on an emulated Cortex-M3.

    Args:
        calls: What :class:`RecordedCore` recorded.
        folder: An empty folder for the inputs and outputs.

    Raises:
        ConfigurationError: The compiler for the Cortex-M3 is missing, or it refuses the sources.
    """
    (folder / "inputs").write_bytes(calls)
    semihosting = ("-semihosting-config", "enable=on,target=native")
    core = native.arm_build("core.elf", native.QEMU_CORE, "-DCARTPOLE_QUEUE=32")
    command = (*MACHINE, "-serial", "none", *semihosting, "-kernel", str(core))
    subprocess.run(command, cwd=folder, check=True, timeout=120)
    return (folder / "outputs").read_bytes()


def _motor(motor: Motor) -> bytes:
    return struct.pack("<2i", round(motor.position * 1e9), round(motor.velocity * 1e6))
