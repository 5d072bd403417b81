#!/usr/bin/env python3
"""Count the corrupt frames that each codec takes for good ones.

    python tools/fuzz_frames.py --inputs 10000000 --out docs/measured/fuzz_frames.json

Each input is a sound frame with one fault: flipped bits, another byte, a byte lost or too many, an end cut
off, or a burst of random bytes. A codec accepts it if anything comes out that was not sent. A checksum of n
bits accepts 1 of 2^n random frames; this is the "expected" of a row, and few flipped bits are always found.
The C core runs its own fuzzers (firmware/host/fuzz.c, fuzz_can.c) under the address and undefined-behaviour
sanitizers. On CAN a target of three frames loses, repeats, mixes or changes them; a frame's own checksum is
the adapter's. Damaged frames of every wire, those with a right checksum too, are in tools/fuzz_files.py.
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from fakes.go2 import FakeGo2
from fuzz.cartpole_wires import blocks, read_answer
from fuzz.feetech_wires import answers, read_answers, read_requests, requests
from fuzz.wire import low_commands
from measuring import Rows
from rich.console import Console
from rich.progress import track

from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.go2.messages.low_command import decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.servo_bus import packets
from deal_hw.drivers.unitree.go_messages.frames import without_padding
from deal_hw.errors import FrameError, TransportTimeoutError


@dataclass(frozen=True, kw_only=True)
class FuzzFrames:
    """Count the corrupt frames that each codec takes for good ones."""

    inputs: int = 1_000_000
    """Inputs of each codec."""

    seed: int = 1
    """Seed of the faults."""

    codecs: tuple[str, ...] = ()
    """Names of codecs; by default all."""

    out: Path | None = None
    """Write the rows to this JSON file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Codec:
    """A codec with a checksum.

    Attributes:
        frames: Sound frames.
        contents: Returns what a receiver takes from some bytes, one entry a message.
        bits: Bits of the checksum.
    """

    frames: Sequence[bytes]
    contents: Callable[[bytes], list[bytes]]
    bits: int


def damaged(rng: random.Random, frame: bytes) -> bytes:
    """Return a frame with one fault; it may equal the frame."""
    data, at = bytearray(frame), rng.randrange(len(frame))
    match rng.randrange(6):
        case 0:
            for _ in range(rng.randint(1, 4)):
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case 1:
            data[at] ^= rng.randint(1, 255)
        case 2:
            del data[at]
        case 3:
            data.insert(at, rng.randrange(256))
        case 4:
            del data[at:]
        case _:
            burst = rng.randbytes(min(rng.randint(2, 16), len(data) - at))
            data[at : at + len(burst)] = burst
    return bytes(data)


def _serial(data: bytes) -> list[bytes]:
    return protocol.FrameDecoder().feed(b"\0" + data + b"\0")


def _dynamixel(data: bytes) -> list[bytes]:
    # The next packet's header ends one that lost its end.
    found = packets.PacketParser().feed(data + packets.HEADER)
    return [bytes([p.servo, p.instruction]) + p.params for p in found]


def _checked(decode: Callable[[bytes], object], name: str) -> Callable[[bytes], list[bytes]]:
    def contents(data: bytes) -> list[bytes]:
        try:
            decode(data)
        except FrameError:
            return []
        # Bytes between the fields have no meaning.
        return [without_padding(data, name)]

    return contents


def _answer(*, fast: bool) -> Callable[[bytes], list[bytes]]:
    def contents(data: bytes) -> list[bytes]:
        try:
            return [b"".join(read_answer(data, fast).values())]
        except (FrameError, TransportTimeoutError):
            return []

    return contents


def _feetech_answers(data: bytes) -> list[bytes]:
    try:
        return [b"".join(read_answers(data).values())]
    except (FrameError, TransportTimeoutError):
        return []


CODECS = {
    "cart-pole, serial": Codec(
        frames=[
            protocol.encode(protocol.Target(5, 100_000, 80_000, 8_000, 4_000, 1_000_000)),
            protocol.encode(protocol.State(6, 5_000_000, 1000, -2000, 3000, -4000, 500, 3, 5, 900)),
            protocol.encode(protocol.Arm(2)),
        ],
        contents=_serial,
        bits=16,
    ),
    "Dynamixel, requests": Codec(
        frames=[
            packets.instruction(packets.BROADCAST, packets.Instruction.SYNC_WRITE, bytes(range(64, 84))),
            packets.instruction(1, packets.Instruction.READ, b"\x84\0\x04\0"),
            packets.instruction(2, packets.Instruction.WRITE, b"\x40\0\xff\xff\xfd\x01"),
        ],
        contents=_dynamixel,
        bits=16,
    ),
    "Dynamixel, fast answers": Codec(frames=[blocks(fast=True)], contents=_answer(fast=True), bits=16),
    "Dynamixel, plain answers": Codec(frames=[blocks(fast=False)], contents=_answer(fast=False), bits=16),
    "Feetech, requests": Codec(frames=requests(), contents=read_requests, bits=8),
    "Feetech, answers": Codec(frames=[answers()], contents=_feetech_answers, bits=8),
    "Go2, LowCmd": Codec(frames=low_commands(), contents=_checked(decode_low_command, "LowCmd"), bits=32),
    "Go2, LowState": Codec(
        frames=[encode_low_state(FakeGo2().state())], contents=_checked(decode_low_state, "LowState"), bits=32
    ),
}
CORE = "cart-pole, the firmware's C core"
CORES = {CORE: "serial", f"{CORE} on CAN": "can"}
"""Fuzzers of the C core, and the wire of each."""


def fuzz(name: str, codec: Codec, inputs: int, seed: int) -> dict[str, Any]:
    """Return the row of a codec.

    Raises:
        RuntimeError: A sound frame is not taken.
    """
    sent = [codec.contents(frame) for frame in codec.frames]
    if any(len(found) != 1 for found in sent):
        raise RuntimeError(f"{name}: a sound frame is not taken")
    rng, corrupt, accepted, began = random.Random(seed), 0, 0, time.perf_counter()
    for _ in track(range(inputs), name, console=Console(stderr=True), disable=not sys.stderr.isatty()):
        number = rng.randrange(len(sent))
        data = damaged(rng, codec.frames[number])
        if data == codec.frames[number]:
            continue
        corrupt += 1
        accepted += any(found not in sent[number] for found in codec.contents(data))
    return {
        "codec": name,
        "inputs": inputs,
        "corrupt": corrupt,
        "accepted": accepted,
        "expected": round(corrupt / 2**codec.bits, 1),
        "seconds": round(time.perf_counter() - began, 1),
    }


def fuzz_core(name: str, inputs: int, seed: int) -> dict[str, Any]:
    """Return the row of the firmware's core; an assertion or a sanitizer ends the run with its message."""
    program, began = native.fuzzer(CORES[name]), time.perf_counter()
    done = subprocess.run([program, str(inputs), str(seed)], stdout=subprocess.PIPE, text=True, check=True)
    found = json.loads(done.stdout)
    corrupt = found["corrupt"] + found["garbage"]
    return {
        "codec": name,
        "inputs": inputs,
        "corrupt": corrupt,
        "accepted": found["accepted"] + found["garbage_accepted"],
        "expected": round(corrupt / 2**16, 1),
        "seconds": round(time.perf_counter() - began, 1),
    }


def main(config: FuzzFrames) -> int:
    """Print each row; return 1 if a codec accepts more than its checksum may by chance."""
    rows = Rows(__file__, config.out)
    for name in config.codecs or (*CORES, *CODECS):
        if name in CORES:
            row = fuzz_core(name, config.inputs, config.seed)
        else:
            row = fuzz(name, CODECS[name], config.inputs, config.seed)
        rows.add(row)
    # Four standard deviations of a Poisson count above what is expected.
    return int(
        any(row["accepted"] > row["expected"] + 4 * max(row["expected"], 1) ** 0.5 for row in rows.rows)
    )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(FuzzFrames, description=__doc__)))
