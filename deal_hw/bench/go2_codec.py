"""The bench of the Go2's messages: time to write and read them."""

from __future__ import annotations

import gc
import statistics
import timeit
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from deal_hw.bench.rows import describe_machine, write_rows
from deal_hw.bench.settings import Go2Codec
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import nominal_truth
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state

BATCHES: Final = 200
BATCH: Final = 200
TARGETS_US: Final[Mapping[str, float]] = {"encode LowCmd with CRC": 5.0, "decode LowState": 2.0}
"""Budget of the control loop, medians [us]."""


def bench_codec(settings: Go2Codec, batches: int = BATCHES) -> int:
    """Measure the codec; print the figures, and write them to a file if one is named or JSON is printed.

    Args:
        settings: File of the rows, and what to print.
        batches: Number of timed batches of :data:`BATCH` calls.

    Returns:
        0 if every median is within its target, else 1.
    """
    rows = [_row(name, call, batches) for name, call in _calls().items()]
    machine = describe_machine()
    if not settings.quiet:
        processors, load = machine["processors"], machine["load"][0]
        print(f"{machine['platform']}, {processors} processors, load {load:.1f}, numpy {np.__version__}")
        print(f"microseconds a call, {batches} batches of {BATCH} calls")
        for row in rows:
            target = f"  target {row['target_us']:g}" if row["target_us"] is not None else ""
            print(
                f"{row['operation']:28} median {row['median_us']:6.2f}  lowest {row['lowest_us']:6.2f}"
                f"  p99 {row['p99_us']:6.2f}{target}"
            )
    if settings.json or settings.out is not None:
        write_rows(settings.file, rows)
        if not settings.quiet:
            print(f"written: {settings.file}")
    return (
        1 if any(row["target_us"] is not None and row["median_us"] > row["target_us"] for row in rows) else 0
    )


def _calls() -> dict[str, Callable[[], object]]:
    rng = np.random.default_rng(0)
    parts = rng.normal(size=(5, 12))
    command = LowCommand(*parts)
    encoder, (_, state_bytes) = LowCommandEncoder(), Go2Device(nominal_truth(), sport="").tick()[0]
    command_bytes, state = encoder.encode(command), decode_low_state(state_bytes).values()
    return {
        "encode LowCmd with CRC": lambda: encoder.encode(command),
        "decode LowState": lambda: decode_low_state(state_bytes, strict=False),
        "decode LowState with CRC": lambda: decode_low_state(state_bytes),
        "encode LowState with CRC": lambda: encode_low_state(state),
        "decode LowCmd with CRC": lambda: decode_low_command(command_bytes),
    }


def _row(operation: str, call: Callable[[], object], batches: int) -> dict[str, Any]:
    timer = timeit.Timer(call)
    timer.timeit(BATCH)
    gc.collect()
    times = sorted(timer.timeit(BATCH) / BATCH * 1e6 for _ in range(batches))
    return {
        "bench": "go2-codec",
        "operation": operation,
        "median_us": statistics.median(times),
        "lowest_us": times[0],
        "p99_us": times[min(len(times) - 1, int(0.99 * len(times)))],
        "target_us": TARGETS_US.get(operation),
        "error": "",
    }
