"""Mending torn and damaged recordings."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory

from deal_hw.data.recording.mcap_scan import FoundRecord, messages, scan
from deal_hw.data.recording.reader import read_episode, read_trajectory
from deal_hw.data.recording.repair import repair, verify
from deal_hw.errors import DatasetError, EmptyRecordingError, TornRecordingError

WriteEpisode = Callable[..., Path]


def chunk_offsets(path: Path) -> list[int]:
    """Return where the chunks of a file start."""
    found = [item for item in scan(path.read_bytes()) if isinstance(item, FoundRecord)]
    return [item.offset for item in found if isinstance(item.record, Chunk)]


def count_with_mcap_ros2(path: Path) -> int:
    """Return how many messages an independent reader decodes, checksums validated."""
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_summary() is not None
        return sum(1 for _ in reader.iter_decoded_messages())


def test_a_sound_file_is_left_alone(write_episode: WriteEpisode) -> None:
    """Neither verify nor repair touch a file that is whole."""
    path = write_episode()
    before = path.read_bytes()
    report = repair(path)
    assert report.sound and not report.repaired
    assert report == verify(path)
    assert report.messages == 15 * 150 + 3
    assert path.read_bytes() == before


def test_torn_file_is_restored_completely(write_episode: WriteEpisode, tmp_path: Path) -> None:
    """A file cut between chunks holds everything up to the cut, for every reader; no stray file is left."""
    path = write_episode(torn=True)
    assert verify(path).torn
    report = repair(path)
    assert report.repaired and report.torn and not report.damaged
    assert "no footer" in report.describe()
    assert verify(path).sound
    assert count_with_mcap_ros2(path) == report.messages
    trajectory = read_trajectory(path)
    np.testing.assert_array_equal(trajectory.effort[:, 0], 0.5 * np.arange(trajectory.effort.shape[0]))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.2, 1.0))
def test_cut_anywhere_loses_only_the_last_chunk(write_episode: WriteEpisode, share: float) -> None:
    """Whatever byte a file ends at, every whole chunk before it is restored."""
    whole = write_episode(f"{share.hex()}.mcap")
    offsets, data = chunk_offsets(whole), whole.read_bytes()
    expected = sum(1 for item in scan(data) if isinstance(item, FoundRecord) for _ in messages(item))
    cut = round(share * (len(data) - 1))
    whole.write_bytes(data[:cut])
    report = repair(whole)
    assert report.repaired and report.torn
    assert report.chunks >= sum(end <= cut for end in offsets[1:])
    assert report.messages <= expected
    assert count_with_mcap_ros2(whole) == report.messages
    whole.unlink()


def test_flipped_byte_costs_one_chunk(write_episode: WriteEpisode) -> None:
    """Damage inside chunk 20 loses that chunk alone, and the report names the hole."""
    path = write_episode()
    offsets = chunk_offsets(path)
    lost = damage_one_chunk(path, offsets[20] + 80)
    with pytest.raises(TornRecordingError, match=r"is damaged at byte .*deal-hw data repair"):
        read_episode(path)
    before = path.read_bytes()
    report = repair(path)
    assert report.repaired and not report.torn
    assert len(report.damaged) == 1
    assert report.messages == 15 * 150 + 3 - lost
    assert len(report.lost_spans_s) == 1
    assert report.original is not None and report.original.read_bytes() == before
    assert count_with_mcap_ros2(path) == report.messages
    assert read_episode(path).trajectory.metadata["hand_over_losses"] == 3


def damage_one_chunk(path: Path, offset: int) -> int:
    """Flip a bit inside a chunk; return how many messages it held."""
    data = bytearray(path.read_bytes())
    chunks = [item for item in scan(bytes(data)) if isinstance(item, FoundRecord) and item.contents]
    hit = max((item for item in chunks if item.offset <= offset), key=lambda item: item.offset)
    data[offset] ^= 0x10
    path.write_bytes(data)
    return sum(1 for _ in messages(hit))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1), bit=st.integers(0, 7))
def test_any_flipped_bit_costs_at_most_one_chunk(write_episode: WriteEpisode, share: float, bit: int) -> None:
    """Wherever a bit flips after the preamble, verify notices and repair loses one chunk at most."""
    path = write_episode(f"{share.hex()}.{bit}.mcap", cycles=40)
    data = bytearray(path.read_bytes())
    sizes = [sum(1 for _ in messages(item)) for item in scan(bytes(data)) if isinstance(item, FoundRecord)]
    total = sum(sizes)
    first = chunk_offsets(path)[0]
    data[first + round(share * (len(data) - first - 1))] ^= 1 << bit
    path.write_bytes(data)
    assert not verify(path).sound
    report = repair(path)
    assert report.messages >= total - max(sizes)
    assert verify(path).sound
    assert count_with_mcap_ros2(path) == report.messages
    read_trajectory(path)
    for file in path.parent.glob(f"{path.name}*"):
        file.unlink()


def test_damaged_first_chunk_does_not_take_the_names_along(write_episode: WriteEpisode) -> None:
    """Schemas and channels stand in the first chunk only; a torn file that lost it is still restored."""
    path = write_episode(torn=True)
    damage_one_chunk(path, chunk_offsets(path)[0] + 80)
    report = repair(path)
    assert report.damaged and report.torn
    trajectory = read_trajectory(path)
    assert trajectory.device_s.size >= 4 * 147
    np.testing.assert_array_equal(trajectory.effort[:, 0], 0.5 * np.arange(trajectory.effort.shape[0]))


def test_second_repair_keeps_both_originals(write_episode: WriteEpisode) -> None:
    """Each damaged original is kept under a name of its own."""
    path = write_episode()
    kept = []
    for chunk in (10, 20):
        damage_one_chunk(path, chunk_offsets(path)[chunk] + 80)
        kept.append(repair(path).original)
    assert [file.name for file in kept if file is not None] == ["episode.mcap.torn", "episode.mcap.torn.1"]


def test_full_disk_leaves_the_original(write_episode: WriteEpisode) -> None:
    """A repair that cannot write says so and changes nothing."""
    import resource

    path = write_episode(torn=True)
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))
    try:
        with pytest.raises(
            DatasetError, match="cannot be repaired: File too large; the original is unchanged"
        ):
            repair(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_hopeless_files_are_refused(tmp_path: Path) -> None:
    """Empty files, files of another kind and MCAP files of others are named as such and not touched."""
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(EmptyRecordingError, match="cannot be repaired"):
        repair(tmp_path / "empty.mcap")
    (tmp_path / "text.mcap").write_text("not a recording")
    with pytest.raises(DatasetError, match="not an MCAP file"):
        repair(tmp_path / "text.mcap")
    with open(tmp_path / "foreign.mcap", "wb") as file:
        Writer(file).start(library="somebody else")
    with pytest.raises(DatasetError, match="somebody else"):
        repair(tmp_path / "foreign.mcap")


def test_rerun_converts_a_repaired_file(write_episode: WriteEpisode, tmp_path: Path) -> None:
    """A torn file is refused by rerun; after repair it reads the states."""
    pytest.importorskip("rerun")
    tool = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if tool is None:
        pytest.skip("the rerun command is not installed")
    path = write_episode(torn=True)
    states = 4 * 148
    repair(path)
    target = tmp_path / "episode.rrd"
    subprocess.run([tool, "mcap", "convert", str(path), "-o", str(target)], check=True, capture_output=True)
    printed = subprocess.run([tool, "rrd", "print", str(target)], check=True, capture_output=True, text=True)
    assert "/state" in printed.stdout
    assert target.stat().st_size > 10 * states
