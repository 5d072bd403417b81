"""Recordings and maps that are damaged or hostile: one line, in bounded time and memory."""

from __future__ import annotations

import io
import json
import os
import resource
import struct
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from deal_hw.data.importing import csv_source, mcap_source
from deal_hw.data.importing.columns import read_column_map
from deal_hw.data.importing.csv_source import read_csv
from deal_hw.data.importing.load import load_tables
from deal_hw.data.importing.mcap_source import read_mcap
from deal_hw.data.importing.npz_source import read_npz
from deal_hw.errors import ConfigurationError, DatasetError, DealHwError
from deal_hw.policies.importing.unitree_rl_lab import read_deploy_yaml
from deal_hw.reading import RECORDING_BYTES, YAML_BYTES, parse_yaml, reading
from deal_hw.sim.parameters.yaml_space import read_space
from deal_hw.sim.recordings.setups import read_setups
from deal_hw.sim.robots.robot_file import read_robot_file

TWISTED = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=12,
)


def refusal(read: Callable[[], object], path: Path) -> str:
    """Return the one line with which a file is refused."""
    with pytest.raises(DealHwError) as caught:
        read()
    text = str(caught.value)
    assert str(path) in text and "\n" not in text and len(text) < 600 + len(str(path))
    return text


def peak() -> int:
    """Return the most memory that this process has used [B]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def lying_npz(path: Path, header: str, size: int = 480) -> Path:
    """Write an archive of one array whose header says something else than what follows it."""
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(size)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("time.npy", array)
    return path


@pytest.mark.parametrize(
    "shape",
    ["(1000000000000,)", "(4611686018427387904, 2)", "(9223372036854775808,)", "(-1,)", "(1, " * 40 + ")"],
)
def test_an_array_that_lies_about_its_size_takes_no_memory(tmp_path: Path, shape: str) -> None:
    """The header is believed only as far as the file reaches."""
    path = lying_npz(tmp_path / "a.npz", f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}\n")
    before = peak()
    refusal(lambda: load_tables(path), path)
    assert peak() - before < 200 << 20


def test_a_decompression_bomb_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """As many zeros as would be two gigabytes of numbers, in a quarter of a megabyte of file."""
    header = "{'descr': '|u1', 'fortran_order': False, 'shape': (268435456,)}\n"
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("time.npy", "w") as member:
        member.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode())
        for _ in range(256):
            member.write(bytes(1 << 20))
    before = peak()
    assert "more than 134217728 numbers" in refusal(lambda: read_npz(path), path)
    assert peak() - before < 200 << 20


def test_what_is_not_wanted_is_not_read(tmp_path: Path) -> None:
    """Pictures, objects and archives inside are left out by their headers, and reported."""
    path = tmp_path / "a.npz"
    np.savez(
        path, time=np.arange(3.0), picture=np.zeros((2, 2, 3), np.uint8), thing=np.array([{}], dtype=object)
    )
    found = read_npz(path)
    assert list(found.arrays) == ["time"]
    assert sorted(found.notes) == [
        "picture is left out: uint8 (2, 2, 3)",
        "thing is left out: Python objects, which could run anything",
    ]


@pytest.mark.parametrize("mutation", range(60))
def test_a_damaged_archive_is_read_or_refused(tmp_path: Path, mutation: int) -> None:
    """Whatever byte is another: numbers, or one line."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, time=np.arange(50.0), a_pos=np.ones(50), a_cmd=np.ones(50))
    data = bytearray(buffer.getvalue())
    rng = np.random.default_rng(mutation)
    for at in rng.integers(0, len(data), 3):
        data[at] = rng.integers(256)
    path = tmp_path / "a.npz"
    path.write_bytes(data)
    try:
        load_tables(path)
    except DatasetError as error:
        assert str(path) in str(error) and "\n" not in str(error)


@pytest.mark.parametrize(
    "cell",
    ["[[1], 2]", '["1", 2]', "[1, null]", '{"a": 1}', "[" * 5000, "[1]", "[1, 1e999, 2]", "x" * 10_000],
)
def test_a_list_of_something_else_names_line_and_column(tmp_path: Path, cell: str) -> None:
    """A cell in a column of lists that is no list of as many numbers."""
    path = tmp_path / "a.csv"
    path.write_text(f"time;pos\n0;[1, 2]\n1;{cell}\n2;[1, 2]\n", encoding="utf-8")
    text = refusal(lambda: read_csv(path), path)
    assert "line 3, column 'pos' contains" in text and "not a list of 2 numbers" in text


@settings(max_examples=80, deadline=None)
@given(text=st.text(alphabet="time,;\t\n0123456789.-+einfa[]{}\"'#\0", max_size=200))
def test_any_text_is_a_table_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    """No text ends in a traceback."""
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    path.write_text(text, encoding="utf-8")
    try:
        load_tables(path)
    except DatasetError as error:
        assert "\n" not in str(error)


def test_limits_of_a_table(tmp_path: Path) -> None:
    """Lines, columns, numbers and the file itself have limits."""
    path = tmp_path / "a.csv"
    path.write_text(",".join(f"c{i}" for i in range(5000)), encoding="utf-8")
    assert "has 5000 columns; 4096 are allowed" in refusal(lambda: read_csv(path), path)
    path.write_text("a,b\n" + "1" * (csv_source.LINE + 1), encoding="utf-8")
    assert "a line of 1048576 characters or more" in refusal(lambda: read_csv(path), path)
    path.write_text("a;b\n" + "1;2\n" * 4, encoding="utf-8")
    assert read_csv(path, 8).arrays["a"].size == 4
    path.write_text("a;b\n" + "1;2\n" * 5, encoding="utf-8")
    assert "'a' has more than 4 numbers" in refusal(lambda: read_csv(path, 8), path)
    path.write_text("a;b\n;\n;\n[1, 2, 3];1\n", encoding="utf-8")
    assert "line 4, column 'a' contains" in refusal(lambda: read_csv(path, 8), path)
    # A file with a hole takes no space.
    os.truncate(path, RECORDING_BYTES + 1)
    assert "MiB" in refusal(lambda: read_csv(path), path)


def test_a_pipe_is_no_recording(tmp_path: Path) -> None:
    """A pipe that nobody writes to would be waited for without end."""
    readers: dict[str, Callable[[Path], object]] = dict.fromkeys(("a.csv", "a.npz", "a.mcap"), load_tables)
    readers["columns.yaml"] = read_column_map
    for name, read in readers.items():
        path = tmp_path / name
        os.mkfifo(path)
        assert "a pipe or a device" in refusal(partial(read, path), path)


def bomb(levels: int) -> str:
    """Return lists that each name the one before nine times."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text",
    [
        bomb(8),
        "a: &a [*a]",
        "[" * 4000,
        "a: " + "x" * 20_000,
        "a: " + ":".join(["1"] * 5000),
        "x: &x {a: 1}\ny: {<<: [*x, *nothing]}",
        "a: !!python/object/apply:os.getcwd []",
        "- " * 3000,
        "\0",
        "a: ]",
    ],
    ids=range(10),
)
def test_hostile_yaml_is_one_short_line(tmp_path: Path, text: str) -> None:
    """An alias bomb printed 312 MB; deep, endless and executable YAML are refused alike."""
    path = tmp_path / "columns.yaml"
    path.write_text(text, encoding="utf-8")
    refusal(lambda: read_column_map(path), path)


def test_honest_aliases_are_read() -> None:
    """A block that is written once and used twice stays possible, merge keys included."""
    text = "a: &a {sign: -1}\nb: *a\nc: {<<: *a, x: 2}"
    assert parse_yaml(text) == {"a": {"sign": -1}, "b": {"sign": -1}, "c": {"sign": -1, "x": 2}}
    with pytest.raises(ConfigurationError, match="characters of YAML"):
        parse_yaml(" " * (YAML_BYTES + 1))


READERS: dict[str, Callable[[Path], object]] = {
    "robot.yaml": read_robot_file,
    "columns.yaml": read_column_map,
    "params.yaml": lambda path: read_space(path, None),
    "setups.yaml": read_setups,
    "deploy.yaml": read_deploy_yaml,
}
"""Every reader of YAML, by the name of its file."""


@pytest.mark.parametrize("name", READERS)
def test_a_key_that_is_written_twice_is_refused(tmp_path: Path, name: str) -> None:
    """PyYAML takes the last value without a word: a limit further up would not hold."""
    path = tmp_path / name
    path.write_text("joints:\n- name: hub\n  limit: 1\n  unit: rad\n  limit: 2\n", encoding="utf-8")
    assert "key 'limit' is written twice, in lines 3 and 5" in refusal(lambda: READERS[name](path), path)


@pytest.mark.parametrize("text", ['{a: 1, "a": 2}', "a: {1: x, 1: y}", "x: &x {a: 1}\ny: {<<: *x, <<: *x}"])
def test_every_spelling_of_a_key_counts(text: str) -> None:
    """With quotes, as a number, and the merge key itself."""
    with pytest.raises(ConfigurationError, match=r"is written twice, in line \d; keep one"):
        parse_yaml(text)


def test_a_merge_may_be_overridden() -> None:
    """Keys of a merged block are no doubles, in whatever order blocks are made."""
    text = "x: &x {s: 1, t: 1}\na: {q: &y {<<: *x, s: 2}}\nc: {<<: *y, t: 3}"
    assert parse_yaml(text)["c"] == {"s": 2, "t": 3} and parse_yaml(text)["a"] == {"q": {"s": 2, "t": 1}}


@settings(max_examples=150, deadline=None)
@given(values=TWISTED)
def test_any_values_are_a_column_map_or_refused(
    tmp_path_factory: pytest.TempPathFactory, values: Any
) -> None:
    """JSON is YAML: whatever its structure, one line says what is wrong."""
    path = tmp_path_factory.mktemp("map") / "columns.yaml"
    good: dict[str, Any] = {"time": "t", "position": "p", "joints": ["a"]}
    for key in (None, "time", "joints", "orientation", "unit"):
        path.write_text(json.dumps(values if key is None else {**good, key: values}), encoding="utf-8")
        try:
            read_column_map(path)
        except ConfigurationError as error:
            assert "\n" not in str(error) and len(str(error)) < 1500


def ros(path: Path, name: str, schema: str, data: bytes, compression: CompressionType) -> Path:
    """Write an MCAP file of one ROS 2 message."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=compression)
        writer.start(library="fuzz")
        number = writer.register_schema(name, "ros2msg", schema.encode())
        channel = writer.register_channel("/t", "cdr", number)
        writer.add_message(channel, log_time=1, data=data, publish_time=1, sequence=0)
        writer.finish()
    return path


LEVELS = (
    "\n".join(f"{'=' * 80}\nMSG: p/msg/L{i}\nL{i + 1} a\nL{i + 1} b" for i in range(40))
    + f"\n{'=' * 80}\nMSG: p/msg/L40\nuint8[0] a"
)


@pytest.mark.parametrize(
    ("schema", "words"),
    [
        ("E[] e\n" + "=" * 80 + "\nMSG: p/msg/E\nuint8[0] x", "is a list of messages"),
        ("L0 a\n" + LEVELS, "more than 4096 fields"),
        ("M a", "fields"),
    ],
)
def test_a_schema_without_bytes_does_not_run_for_ever(tmp_path: Path, schema: str, words: str) -> None:
    """Lists of empty messages, and messages that double with each level, are left out by their schema."""
    data = b"\0\1\0\0" + struct.pack("<I", 0xFFFFFFFF) + bytes(64)
    path = ros(tmp_path / "a.mcap", "p/msg/M", schema, data, CompressionType.NONE)
    found = read_mcap(path)
    assert not found.arrays and words in found.notes[0]


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_that_unpacks_to_too_much_is_refused(tmp_path: Path, compression: CompressionType) -> None:
    """A chunk is unpacked as far as the limit, whatever its header says."""
    data = b"\0\1\0\0" + bytes(mcap_source.CHUNK_BYTES)
    path = ros(tmp_path / "a.mcap", "p/msg/M", "uint8[] a", data, compression)
    assert path.stat().st_size < 1 << 20
    assert "a chunk of more than 64 MiB" in refusal(lambda: read_mcap(path), path)


@pytest.mark.parametrize(
    "error",
    [
        KeyError("a"),
        RecursionError(),
        MemoryError(),
        ValueError("two\nlines"),
        OverflowError("x" * 5000),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "bad"),
        NotImplementedError(),
    ],
)
def test_whatever_a_parser_raises_is_one_line(error: Exception) -> None:
    """The file, what it should be, what is wrong, what to do; the cause stays for --traceback."""
    with pytest.raises(DatasetError, match=r"^f cannot be read as JSON: .+; write another$") as caught:
        with reading("f", "JSON", "write another"):
            raise error
    assert caught.value.__cause__ is error and "\n" not in str(caught.value) and len(str(caught.value)) < 300
