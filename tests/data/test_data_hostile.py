"""Files that are damaged or made to harm: bounded work, bounded words, no sample that was not recorded."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from deal_hw.data import files
from deal_hw.data.recording import mcap_scan
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.mcap_scan import FoundRecord, Lost, messages, scan
from deal_hw.data.recording.reader import read_episode
from deal_hw.data.recording.recorder import LIBRARY
from deal_hw.data.recording.repair import repair, verify
from deal_hw.data.recording.schemas import EVENT, METADATA_NAME, STATE, message_type
from deal_hw.data.run_folder import RunFolder
from deal_hw.description import digest_of
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import DatasetError

WriteEpisode = Callable[..., Path]
MARK = b"\x04\0\0\0zstd"
NO_TIME = [HealthCheck.function_scoped_fixture]


def record(opcode: int, body: bytes, size: int | None = None) -> bytes:
    """Return an MCAP record, whose length may lie."""
    return struct.pack("<BQ", opcode, len(body) if size is None else size) + body


def chunk(plain: bytes, announced: int | None = None, packed: bytes | None = None) -> bytes:
    """Return a chunk with a right checksum; its size may lie."""
    packed = zstandard.compress(plain) if packed is None else packed
    size = len(plain) if announced is None else announced
    return record(
        6,
        struct.pack("<QQQI", 0, 0, size, zlib.crc32(plain)) + MARK + struct.pack("<Q", len(packed)) + packed,
    )


def overlapping_chunks(count: int) -> bytes:
    """Return chunks that each reach to the end, with lengths that agree and contents that do not unpack."""
    unit = record(6, bytes(28) + MARK + bytes(8) + b"\x28\xb5\x2f\xfd" + bytes(7))
    out = bytearray(unit * count)
    for at in range(0, len(out), len(unit)):
        size = len(out) - at - 9
        struct.pack_into("<Q", out, at + 1, size)
        struct.pack_into("<Q", out, at + 9 + 16, 100)
        struct.pack_into("<Q", out, at + 9 + 36, size - 44)
    return bytes(out)


def long_records_between_chunks(count: int) -> bytes:
    """Return metadata records that each reach to the end, a readable chunk behind each head."""
    unit = 9 + len(chunk(b""))
    return b"".join(record(12, chunk(b""), size=(count - i) * unit - 9) for i in range(count))


class Work:
    """Counts what the scanner looks at."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.heads = self.bytes = 0
        real = mcap_scan._PREFIX
        self.size = real.size
        self._unpack = real.unpack
        monkeypatch.setattr(mcap_scan, "_PREFIX", self)
        for name, at in (("_read_chunk", 0), ("_read_record", 1)):
            monkeypatch.setattr(mcap_scan, name, self._counted(getattr(mcap_scan, name), at))

    def unpack(self, data: bytes) -> tuple[int, ...]:
        self.heads += 1
        return self._unpack(data)

    def _counted(self, real: Callable[..., object], at: int) -> Callable[..., object]:
        def read(*values: Any) -> object:
            self.bytes += len(values[at])
            return real(*values)

        return read


@pytest.mark.parametrize(
    "junk",
    [
        bytes(100_000),
        record(0x80, b"") * 10_000,
        record(0x80, b"", size=50_000) * 10_000,
        MARK * 10_000,
        overlapping_chunks(2000),
        long_records_between_chunks(2000),
        (record(0x80, b"") + record(7, bytes(6))) * 5000,
        record(12, bytes(100_000)),
    ],
    ids=[
        "zeros",
        "unknown",
        "unknown-long",
        "marks",
        "overlapping",
        "long-between",
        "alternating",
        "metadata",
    ],
)
@pytest.mark.parametrize("where", ["in the middle", "at the end"])
def test_work_and_words_are_bounded(
    write_episode: WriteEpisode, monkeypatch: pytest.MonkeyPatch, junk: bytes, where: str
) -> None:
    """Whatever is inserted, each byte is looked at a few times, and the damage is one short line."""
    monkeypatch.setattr(mcap_scan, "MAX_CHUNK_BYTES", 20_000)
    path = write_episode(cycles=40, torn=True)
    data = path.read_bytes()
    cut = len(data) // 2 if where == "in the middle" else len(data)
    path.write_bytes(data[:cut] + junk + data[cut:])
    size = path.stat().st_size
    work = Work(monkeypatch)
    for _ in scan(path.read_bytes()):
        pass
    assert work.heads <= size // 4
    assert work.bytes <= 6 * size + 20_000
    words = verify(path).describe()
    assert len(words) < 500 + len(str(path)) and "\n" not in words
    assert len(repair(path).describe()) < 600 + 2 * len(str(path))
    assert verify(path).sound


def test_zeros_are_one_place(write_episode: WriteEpisode) -> None:
    """Zeros between two chunks cost no message; zeros over some chunks cost these."""
    path = write_episode()
    data = path.read_bytes()
    total = verify(path).messages
    offsets = [item.offset for item in scan(data) if isinstance(item, FoundRecord) and item.contents]
    at = offsets[20]
    path.write_bytes(data[:at] + bytes(4096) + data[at:])
    report = verify(path)
    assert report.damaged == (f"zeros where a record should be at byte {at}",)
    assert (report.lost_bytes, report.messages, report.torn) == (4096, total, False)
    stop = offsets[25]
    path.write_bytes(data[:at] + bytes(stop - at) + data[stop:])
    report = repair(path)
    assert (report.places, report.holes, report.lost_bytes) == (1, 1, stop - at)
    assert "a hole of" in report.describe()
    assert read_episode(path).trajectory.device_s.size < 600


def test_many_places_are_counted(write_episode: WriteEpisode) -> None:
    """Of damage in every second chunk three places are named and the others counted, holes likewise."""
    path = write_episode()
    data = bytearray(path.read_bytes())
    offsets = [item.offset for item in scan(bytes(data)) if isinstance(item, FoundRecord) and item.contents]
    for offset in offsets[1::2]:
        data[offset + 80] ^= 1
    path.write_bytes(data)
    report = repair(path)
    words = report.describe()
    assert report.places == len(offsets[1::2]) > 20
    assert f"{report.places - 3} more damaged places" in words
    assert f"{report.holes} holes, together of {report.missing_s:.3f} s" in words
    assert words.count("damaged chunk") == 3 and len(words) < 700 + 2 * len(str(path))


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (chunk(b"x", announced=1 << 40), "announces 1099511627776 bytes"),
        (chunk(bytes((1 << 21) + (1 << 20))), "announces 3145728 bytes"),
        (chunk(bytes(100), announced=200), "sizes contradict"),
        (chunk(b"", announced=100, packed=zstandard.compress(bytes(1 << 26))), "sizes contradict"),
    ],
)
def test_bombs_are_not_unpacked(bad: bytes, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chunk that grows too much, or whose sizes disagree, is refused before any memory is taken for it."""
    monkeypatch.delattr(zstandard, "ZstdDecompressor")
    (lost, end) = scan(MCAP0_MAGIC + bad)
    assert isinstance(lost, Lost) and words in lost.reason
    assert isinstance(end, Lost) and end.torn


def test_many_small_bombs_are_bounded() -> None:
    """Chunks that each hold 261 kB in a hundred bytes are read until the file has grown 256-fold."""
    data = MCAP0_MAGIC + chunk(bytes(9 * 29_000)) * 500
    found = [item for item in scan(data) if isinstance(item, FoundRecord)]
    assert len(found) == (256 * len(data) + (2 << 20)) // (9 * 29_000) < 60


def contents(data: bytes) -> set[tuple[int, bytes]]:
    """Return every message of a file."""
    found = [item for item in scan(data) if isinstance(item, FoundRecord)]
    return {(message.log_time, message.data) for item in found for message in messages(item)}


DAMAGE = st.lists(
    st.tuples(
        st.sampled_from(["flip", "insert", "delete", "repeat", "zero", "cut"]),
        st.floats(0, 1),
        st.binary(min_size=1, max_size=300),
    ),
    min_size=1,
    max_size=4,
)


def apply(data: bytes, damage: list[tuple[str, float, bytes]]) -> bytes:
    """Return damaged bytes."""
    out = bytearray(data)
    for how, share, noise in damage:
        at, size = round(share * len(out)), len(noise)
        if how == "flip" and at < len(out):
            out[at] ^= noise[0] or 1
        elif how == "insert":
            out[at:at] = noise
        elif how == "delete":
            del out[at : at + size]
        elif how == "repeat":
            out[at:at] = out[at : at + 40 * size]
        elif how == "zero":
            out[at : at + 40 * size] = bytes(len(out[at : at + 40 * size]))
        elif how == "cut":
            del out[at:]
    return bytes(out)


@settings(max_examples=80, deadline=None, suppress_health_check=NO_TIME)
@given(damage=DAMAGE)
def test_no_damage_invents_a_sample(
    write_episode: WriteEpisode, damage: list[tuple[str, float, bytes]]
) -> None:
    """Every damaged file is refused in one line or mended into one whose samples were all recorded."""
    path = write_episode("damaged.mcap", cycles=25)
    whole = path.read_bytes()
    path.write_bytes(apply(whole, damage))
    try:
        assert "\n" not in repair(path).describe()
        assert contents(path.read_bytes()) <= contents(whole)
        assert verify(path).sound
        read_episode(path)
    except DatasetError as error:
        assert "\n" not in str(error)
    for file in path.parent.glob("damaged.mcap*"):
        file.unlink()


@settings(max_examples=40, deadline=None, suppress_health_check=NO_TIME)
@given(junk=st.binary(max_size=400), zeros=st.integers(0, 5000))
def test_bytes_behind_the_end_cost_nothing(write_episode: WriteEpisode, junk: bytes, zeros: int) -> None:
    """Whatever follows a whole recording, no message of it is lost."""
    path = write_episode("appended.mcap", cycles=25)
    whole = path.read_bytes()
    path.write_bytes(whole + bytes(zeros) + junk)
    assert verify(path).sound == (zeros + len(junk) == 0) and not verify(path).torn
    assert repair(path).messages == verify(path).messages
    assert contents(path.read_bytes()) == contents(whole)
    for file in path.parent.glob("appended.mcap*"):
        file.unlink()


def test_stray_with_zeros_leaves_a_small_index(tmp_path: Path, write_episode: WriteEpisode) -> None:
    """What a power cut left is taken in at the next `collect`, in two lines, and the index stays small."""
    source = write_episode(torn=True)
    notes: list[str] = []
    Dataset.create_or_open(tmp_path / "dataset", DESCRIPTION, notes.append).close()
    stray = tmp_path / "dataset" / "episodes" / "000000.mcap"
    data = source.read_bytes()
    stray.write_bytes(data[:-3000] + bytes(400_000))
    with Dataset.create_or_open(tmp_path / "dataset", DESCRIPTION, notes.append) as dataset:
        assert dataset.episodes[0].states > 500
    assert len(notes) == 2 and all(len(note) < 600 and "\n" not in note for note in notes)
    assert (tmp_path / "dataset" / "dataset.json").stat().st_size < 10_000


def test_what_is_no_episode_is_said_at_once(tmp_path: Path) -> None:
    """A file beyond the limit, a folder and a pipe are refused by what they are, and not read."""
    huge = tmp_path / "huge.mcap"
    huge.touch()
    os.truncate(huge, files.MAX_EPISODE_BYTES + 1)
    with pytest.raises(DatasetError, match=r"it has 4096\.0 MiB; files of this kind may have 4096 MiB"):
        verify(huge)
    os.mkfifo(tmp_path / "pipe.mcap")
    for name in ("", "pipe.mcap"):
        with pytest.raises(DatasetError, match="; name an ordinary file"):
            read_episode(tmp_path / name)


GOOD = {"name": "cartpole", "joint_names": ["cart", "pole"], "actuated": ["cart"]}
ROW = np.zeros(2)


def episode_of(
    path: Path, description: str = json.dumps(GOOD), metadata: str = "{}", event: str = "{}", joints: int = 2
) -> Path:
    """Write an episode of one sample and one event by hand."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library=LIBRARY)
        printed = {"description": description, "metadata": metadata, "wall_utc": "now", "host_ns": "0"}
        writer.add_metadata(METADATA_NAME, printed)
        values = np.zeros(joints)
        for topic, data in (
            ("/state", STATE.encode(1, 1, 1, -1, -1, 0, values, ROW, ROW)),
            ("/events", EVENT.encode(1, "kind", "message", event)),
        ):
            kind = message_type(topic)
            schema = writer.register_schema(kind.name, "ros2msg", kind.definition.encode())
            writer.add_message(writer.register_channel(topic, "cdr", schema), 1, data, 1, 1)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"description": "[" * 100_000}, "recursion limit"),
        ({"description": "[]"}, "should be an object"),
        (
            {"description": json.dumps({**GOOD, "joint_names": 2})},
            "joint_names are 2; wanted: a list of names",
        ),
        ({"description": json.dumps({**GOOD, "name": None})}, "names no robot with joints"),
        ({"metadata": "{"}, "Invalid JSON"),
        ({"event": '{"a":' * 100_000}, "recursion limit"),
        ({"joints": 3}, "a row has 3 numbers, expected 2"),
    ],
)
def test_episode_of_a_wrong_shape_is_refused(tmp_path: Path, content: dict[str, Any], words: str) -> None:
    """The checksums are right, what is inside is not: one line with the file's name."""
    assert read_episode(episode_of(tmp_path / "good.mcap")).trajectory.device_s.size == 1
    path = episode_of(tmp_path / "bad.mcap", **content)
    assert verify(path).sound
    with pytest.raises(DatasetError, match=words) as caught:
        read_episode(path)
    text = str(caught.value)
    assert str(path) in text and "\n" not in text and len(text) < 400 + len(str(path))


JSON_BOMBS = [
    (b"[" * 100_000, "recursion limit"),
    (b'{"a":' * 100_000, "recursion limit"),
    (b'"\\ud800"', "Invalid JSON"),
    (b"\xff{}", "Invalid JSON"),
    (b"[1]", "should be an object"),
    (b"", "Invalid JSON"),
    (b"1" * 5000, "number out of range"),
]


@pytest.mark.parametrize(("content", "words"), JSON_BOMBS)
def test_json_of_any_shape_is_refused_in_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    """dataset.json and run.json that hold something else; the message names the file."""
    for name in ("dataset.json", "run.json"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DatasetError, match=words) as caught:
            Dataset.open(tmp_path) if name == "dataset.json" else RunFolder(tmp_path).read()
        assert name in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("episodes", 3, "field episodes is 3"),
        ("episodes", [{}], r"field episodes\[0\]\.file is missing"),
        ("episodes", {"verdicts": 1}, r"field episodes\[0\]\.verdicts is 1"),
        ("episodes", {"verdicts": [{"severity": "ok"}]}, "which is no verdict"),
        ("episodes", {"clock": {"offset_s": 1.0}}, "field clock"),
        ("episodes", {"excitation": {"speed_max": ["x"]}}, "field excitation"),
        ("episodes", {"duration_s": "1"}, r"field episodes\[0\]\.duration_s is '1'"),
        ("episodes", {"file": "episodes/../../x"}, "not inside the dataset"),
        ("episodes", {"more": 1}, r"episodes\[0\]\.more"),
        (
            "description",
            {"name": "cartpole", "joint_names": "cart", "actuated": []},
            "wanted: a list of names",
        ),
        ("description", {"joint_names": [], "actuated": []}, "names no robot"),
        ("digest", "0", "was edited"),
    ],
)
def test_index_with_a_wrong_field_is_refused(tmp_path: Path, place: str, value: Any, words: str) -> None:
    """The field is named, and a collector is refused as a reader is."""
    Dataset.create_or_open(tmp_path, DESCRIPTION).close()
    index = tmp_path / "dataset.json"
    values = json.loads(index.read_text())
    episode = {
        "file": "episodes/000000.mcap",
        "purpose": "",
        "policy_digest": "",
        "wall_utc": "",
        "duration_s": 0.0,
        "states": 0,
        "commands": 0,
        "cycles": 0,
        "verdicts": [],
        "excitation": None,
        "clock": None,
    }
    values[place] = [{**episode, **value}] if place == "episodes" and isinstance(value, dict) else value
    if place == "description":
        values["digest"] = digest_of(value)
    index.write_text(json.dumps(values))
    for opened in (Dataset.open, lambda folder: Dataset.create_or_open(folder, DESCRIPTION)):
        with pytest.raises(DatasetError, match=words) as caught:
            opened(tmp_path)
        assert str(index) in str(caught.value) and "\n" not in str(caught.value)
