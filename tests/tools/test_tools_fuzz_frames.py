"""Corrupt frames: counted per codec, and too many of them end the tool with 1."""

from __future__ import annotations

import math
import random
from pathlib import Path

import fuzz_frames
import pytest
from fuzz_frames import CODECS, CORE, Codec, FuzzFrames, damaged, fuzz, main

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize("name", CODECS)
def test_no_codec_takes_a_corrupt_frame(name: str) -> None:
    """Of 2000 frames with one fault none comes out, but by chance (16 bits: 0.03; Feetech's 8 bits: 8)."""
    row = fuzz(name, CODECS[name], 2000, seed=3)
    by_chance = 2000 / 2 ** CODECS[name].bits
    assert row["corrupt"] > 1900 and row["accepted"] <= by_chance + 5 * math.sqrt(by_chance)


def test_a_codec_without_a_check_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Every corrupt frame that is taken counts, and the tool ends with 1."""
    bare = Codec(frames=[bytes(range(40))], contents=lambda data: [data], bits=16)
    monkeypatch.setitem(fuzz_frames.CODECS, "bare", bare)
    row = fuzz("bare", bare, 500, seed=0)
    assert row["accepted"] == row["corrupt"] > 450
    assert main(FuzzFrames(inputs=500, codecs=("bare",), out=tmp_path / "rows.json")) == 1
    assert main(FuzzFrames(inputs=500, codecs=("cart-pole, serial",))) == 0
    assert (tmp_path / "rows.json").is_file() and CORE not in CODECS


def test_a_codec_that_takes_nothing_is_no_codec() -> None:
    """Otherwise it would pass: nothing corrupt comes out of it, either."""
    with pytest.raises(RuntimeError, match="a sound frame is not taken"):
        fuzz("deaf", Codec(frames=[b"abc"], contents=lambda data: [], bits=16), 10, seed=0)


def test_each_fault_changes_a_frame() -> None:
    """Lengths: one byte less, one more, cut short, or the same with other bytes."""
    rng, frame = random.Random(0), bytes(range(30))
    found = [damaged(rng, frame) for _ in range(600)]
    assert {len(data) - 30 for data in found} >= {-29, -1, 0, 1}
    assert sum(data == frame for data in found) < 10
