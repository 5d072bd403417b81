"""Memory of the cart-pole's firmware, and cycles under simavr: the tables of docs/how-to/firmware.md.

python tools/measure_firmware.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from measuring import markdown

from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.avr_device import Chip, eeprom
from deal_hw.drivers.cartpole.chips.host_firmware import Settings
from deal_hw.drivers.cartpole.wire import protocol

CYCLES_PER_TICK = 16_000


def armed_chip() -> Chip:
    """Return a chip that was homed and armed by hand."""
    chip = Chip(eeprom(Settings(65536, 65536, 65536, 65536, 1, 0), 16.0))
    plan: list[tuple[int, bytes, int, int, bool]] = [
        (20, b"", 0, 0, False),
        (10, b"\0" + protocol.encode(protocol.Home(1)), 0, 0, False),
        (10, b"", 0, 0, True),
        (395, b"", 40, 0, False),
        (50, b"", 0, 0, False),
        (128, b"", 0, 16, False),
        (400, b"", 0, 0, False),
        (10, protocol.encode(protocol.Arm(2)), 0, 0, False),
    ]
    for ticks, data, cart, pole, left in plan:
        for _ in range(ticks):
            chip.tick(cart, pole, (left, False), data)
            data = b""
    if not chip.outputs.armed:
        raise RuntimeError("the chip could not be armed")
    chip.longest_step = chip.asleep = 0
    return chip


def row(name: str, period: int, cart: int, pole: int, ticks: int = 1000) -> list[str]:
    """Return the cells of a line: ticks between targets, counts of both encoders in each."""
    chip, plain = armed_chip(), 0
    for tick in range(ticks):
        data = b""
        if tick % period == 0:
            target = protocol.Target(tick, 1000 * (tick % 100), 80_000, 8_000, 4_000, 1_000_000)
            data = protocol.encode(target)
        # There and back, within the rail.
        there = 1 if tick % 200 < 100 else -1
        sent = chip.tick(there * cart, there * pole, (False, False), data)
        plain = plain if sent else max(plain, chip.outputs.longest_step)
    left = 100 * (1 - chip.longest_step / CYCLES_PER_TICK)
    asleep = 100 * chip.asleep / CYCLES_PER_TICK / ticks
    cycles, less = (f"{count:,}".replace(",", " ") for count in (chip.longest_step, plain))
    chip.close()
    return [name, cycles, less, f"{left:.0f} %", f"{asleep:.0f} %"]


def main() -> None:
    """Print the tables."""
    with tempfile.TemporaryDirectory() as folder:
        print(native.write_image(Path(folder)))
        print(native.write_stm32_image(Path(folder)), end="\n\n")
    lines = [
        row("armed, at rest, targets at 50 Hz", 20, 0, 0),
        row("armed, at rest, targets at 200 Hz", 5, 0, 0),
        row("1 m/s, pole at 2 turns a second, 50 Hz", 20, 40, 8),
        row("2 m/s, pole at 4 turns a second, 50 Hz", 20, 80, 16),
        row("2.5 m/s, pole at 5 turns a second, 50 Hz", 20, 100, 20),
    ]
    print(markdown(("situation", "with a state frame", "without", "left of 16 000", "asleep"), lines))


if __name__ == "__main__":
    main()
