"""Checkpoints: what is packed comes out again, what is damaged or foreign is refused."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from deal_hw.calib.data.resume import SearchCheckpoint, digest, pack, restore_generator, unpack
from deal_hw.errors import ConfigurationError, DatasetError

KEYS = st.text(max_size=8).filter(lambda key: key != "__array__")
PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
KINDS = st.one_of(
    npst.boolean_dtypes(),
    npst.integer_dtypes(endianness="<"),
    npst.unsigned_integer_dtypes(endianness="<"),
    npst.floating_dtypes(endianness="<", sizes=(32, 64)),
)
ARRAYS = npst.arrays(KINDS, npst.array_shapes(min_dims=0, min_side=0, max_dims=3, max_side=3))
TREES = st.recursive(
    PLAIN | ARRAYS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=10,
)
STATES = st.dictionaries(KEYS, TREES, max_size=4)


def check_same(a: Any, b: Any) -> None:
    """Check that two trees are equal to the last bit, not-a-numbers and kinds included."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            check_same(a[key], b[key])
    elif isinstance(a, list):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            check_same(x, y)
    else:
        assert a == b or (a != a and b != b)


@given(STATES)
@settings(max_examples=100, deadline=None)
def test_what_is_packed_comes_out(state: dict[str, Any]) -> None:
    """Any tree of plain values and arrays survives, bit for bit."""
    check_same(unpack(pack(state)), state)


@given(STATES, st.data())
@settings(max_examples=100, deadline=None)
def test_damaged_bytes_are_refused_or_harmless(state: dict[str, Any], data: st.DataObject) -> None:
    """A file that was cut or had a byte changed is refused, or is still the same state."""
    whole = pack(state)
    at = data.draw(st.integers(0, len(whole) - 1))
    changed = whole[:at] + bytes([whole[at] ^ 0x41]) + whole[at + 1 :]
    for damaged in (whole[:at], changed):
        try:
            found = unpack(damaged)
        except DatasetError:
            continue
        check_same(found, state)


@given(st.binary(max_size=64))
@settings(max_examples=100, deadline=None)
def test_random_bytes_are_refused(data: bytes) -> None:
    """Nothing but a checkpoint passes for one."""
    with pytest.raises(DatasetError, match="cannot be read as deal_hw"):
        unpack(data)


def test_tuples_come_back_as_lists_and_numpy_numbers_as_numbers() -> None:
    """What JSON has no word for becomes its nearest kin."""
    assert unpack(pack({"a": (1, 2), "b": np.float64(0.5)})) == {"a": [1, 2], "b": 0.5}


@pytest.mark.parametrize(
    "state",
    [
        {"a": np.array([object()])},
        {"a": np.array(["text"])},
        {"a": object()},
    ],
)
def test_what_cannot_be_kept_is_refused(state: dict[str, Any]) -> None:
    """Objects would need pickles."""
    with pytest.raises(TypeError):
        pack(state)


def test_pickles_are_never_loaded() -> None:
    """An NPZ file with a pickled object in it is no checkpoint."""
    buffer = io.BytesIO()
    np.savez(buffer, state=np.array([{"a": 1}], dtype=object))
    with pytest.raises(DatasetError, match="cannot be read as deal_hw"):
        unpack(buffer.getvalue())


def test_generator_goes_on_where_it_was() -> None:
    """A restored generator draws what the first one would have drawn; another kind of state is refused."""
    rng = np.random.default_rng(3)
    rng.standard_normal(5)
    state = unpack(pack(rng.bit_generator.state))
    wanted = rng.standard_normal(4)
    again = np.random.default_rng(8)
    restore_generator(again, state)
    np.testing.assert_array_equal(again.standard_normal(4), wanted)
    with pytest.raises(ConfigurationError, match="generator"):
        restore_generator(np.random.Generator(np.random.MT19937(0)), state)


def test_file_is_replaced_whole_and_removed(tmp_path: Path) -> None:
    """Each save replaces the last; nothing else is left in the folder, and nothing after the end."""
    kept = SearchCheckpoint(tmp_path / "run" / "checkpoint.npz", "mine")
    assert kept.load() is None
    for number in range(3):
        kept.save({"number": number})
    assert SearchCheckpoint(kept.path, "mine").load() == {"number": 2}
    assert [path.name for path in kept.path.parent.iterdir()] == ["checkpoint.npz"]
    kept.remove()
    assert kept.load() is None


def test_fresh_run_does_not_read_the_file_that_it_replaces(tmp_path: Path) -> None:
    """Without resume an earlier state is not continued, but it is there until the first generation."""
    path = tmp_path / "checkpoint.npz"
    SearchCheckpoint(path, "mine").save({"number": 1})
    fresh = SearchCheckpoint(path, "yours", fresh=True)
    assert fresh.load() is None
    assert SearchCheckpoint(path, "mine").load() == {"number": 1}
    fresh.save({"number": 2})
    assert fresh.load() == {"number": 2}


def test_file_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    """A folder in the way is named."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DatasetError, match="cannot be written"):
        SearchCheckpoint(tmp_path / "file" / "checkpoint.npz", "mine").save({})


def test_digest_tells_apart_what_differs() -> None:
    """A value, its kind, its shape and its place all count; copies do not."""
    values: list[Any] = [
        1,
        1.0,
        "1",
        True,
        None,
        [1],
        [[1]],
        {"a": 1},
        {"b": 1},
        np.zeros(4),
        np.zeros((2, 2)),
        np.zeros(4, dtype=np.float32),
        [1, [2]],
        [[1], 2],
    ]
    assert len({digest(value) for value in values}) == len(values)
    assert digest({"a": np.arange(3)}) == digest({"a": np.arange(3)})
    with pytest.raises(TypeError, match="has no digest"):
        digest(print)
