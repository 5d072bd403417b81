"""The firmware in Python: recorded outputs, on inputs that no simulator makes."""

import hashlib
import random
import struct
from collections.abc import Iterator

import pytest

from deal_hw.drivers.cartpole import protocol
from deal_hw.drivers.cartpole.controller import Controller, Firmware, Mode
from deal_hw.drivers.cartpole.description import parameter_space
from deal_hw.drivers.cartpole.sensor import Motor, Reading
from deal_hw.drivers.cartpole.servo import Servo

NOMINAL = {p.name: p.nominal for p in parameter_space().parameters}


def script(seed: int, ticks: int) -> Iterator[tuple[bytes, Motor, Reading]]:
    """Yield what comes from host and sensors in each tick; all floats are exact, so every machine agrees."""
    rng = random.Random(seed)
    sequence = request = 0
    cart = 0
    for tick in range(ticks):
        data = b""
        while rng.random() < 0.06:
            kind = rng.random()
            if kind < 0.6:
                sequence += rng.random() < 0.9
                data += protocol.encode(
                    protocol.Target(
                        sequence, rng.randint(-500_000, 500_000), rng.randint(0, 160_000),
                        rng.randint(0, 16_000), rng.randint(0, 8_000), rng.randint(0, 3_000_000),
                    )
                )  # fmt: skip
            elif kind < 0.65:
                data += rng.randbytes(20) + b"\0"
            else:
                request += rng.random() < 0.9
                choice = rng.choices(
                    (protocol.Arm, protocol.Home, protocol.Stop, protocol.Hello), (16, 2, 1, 1)
                )
                data += protocol.encode(choice[0](request % 256))
        step = rng.randint(-3000, 3000)
        cart = max(-400_000, min(400_000, cart + step))
        reading = Reading(
            cart, step * 1000, rng.randint(-4_000_000, 4_000_000), step, cart / 2**20, tick % 97 == 0
        )
        yield data, Motor(cart / 2**20, step / 2**10), reading


def outputs(firmware: Firmware, seed: int, ticks: int = 3000) -> Iterator[tuple[bytes, float, str]]:
    """Run a firmware on a script, homing after 100 ticks; yield bytes, force and mode of each tick."""
    since = 0
    for data, motor, reading in script(seed, ticks):
        out = firmware.receive(data, motor) if data else b""
        force, report_due = firmware.control(motor)
        if report_due:
            out += firmware.report(reading)
        since = since + 1 if firmware.mode is Mode.HOMING else 0
        if since >= 100:
            firmware.finish_homing()
        yield out, force, firmware.mode.name


@pytest.mark.parametrize(
    ("seed", "recorded"), [(0, "e4b52a0a03a95585"), (1, "ddf512606437f997"), (2, "28e61e054e37046d")],
)  # fmt: skip
def test_outputs_are_the_recorded_ones(seed: int, recorded: str) -> None:
    """Bytes, forces and modes of 3000 ticks of commands, garbage and watchdog stops are as recorded."""
    delays = random.Random(seed)
    firmware = Controller(Servo(NOMINAL, 0.001), 7, lambda: delays.randint(5, 8))
    digest = hashlib.sha256()
    armed = 0
    for out, force, mode in outputs(firmware, seed):
        digest.update(out + struct.pack("<d", force) + mode.encode())
        armed += mode == "ARMED"
    assert armed > 200
    assert digest.hexdigest()[:16] == recorded
