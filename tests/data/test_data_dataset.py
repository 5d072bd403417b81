"""Datasets: the index, its lock, and what a killed collector leaves behind."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from deal_hw.data.recording.dataset import Dataset
from deal_hw.description import digest_of
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import DatasetError

WriteEpisode = Callable[..., Path]


@pytest.fixture
def notes() -> list[str]:
    """What the dataset printed for its user."""
    return []


def collect(folder: Path, source: Path, notes: list[str], facts: dict[str, str] | None = None) -> Path:
    """Append one finished recording to a dataset."""
    with Dataset.create_or_open(folder, DESCRIPTION, notes.append) as dataset:
        path = dataset.next_episode_path()
        shutil.copy(source, path)
        dataset.note_episode(path, facts)
    return path


def test_digest_is_the_descriptions_own() -> None:
    """The digest over JSON equals RobotDescription.digest(), before and after a file."""
    assert digest_of(DESCRIPTION.to_json()) == DESCRIPTION.digest()
    assert digest_of(json.loads(json.dumps(DESCRIPTION.to_json()))) == DESCRIPTION.digest()


def test_episodes_are_indexed(tmp_path: Path, write_episode: WriteEpisode, notes: list[str]) -> None:
    """Two recordings: names, counts, durations and checks are in the index, and reading gives the arrays."""
    source = write_episode(cycles=150)
    folder = tmp_path / "dataset"
    collect(folder, source, notes, {"outcome": "finished"})
    collect(folder, source, notes)
    dataset = Dataset.open(folder, notes.append)
    assert [episode.file for episode in dataset.episodes] == ["episodes/000000.mcap", "episodes/000001.mcap"]
    first = dataset.episodes[0]
    assert (first.purpose, first.states, first.commands, first.cycles) == ("test", 600, 150, 150)
    assert first.duration_s == pytest.approx(0.005 * 599)
    assert first.facts == {"outcome": "finished"}
    assert first.clock is not None and first.excitation is not None
    assert {verdict["name"] for verdict in first.verdicts} >= {"length", "gaps", "clock"}
    assert dataset.read(-1).trajectory.device_s.size == 600
    assert notes == []
    values = json.loads((folder / "dataset.json").read_text())
    assert values["schema_version"] == 1
    assert values["digest"] == DESCRIPTION.digest()
    with pytest.raises(DatasetError, match="has 2 episodes; there is no number 2"):
        dataset.path(2)


def test_two_collectors_cannot_append(tmp_path: Path, notes: list[str]) -> None:
    """The second is refused while the first is at work and let in afterwards; readers always are."""
    first = Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append)
    with pytest.raises(DatasetError, match="in use by another collector"):
        Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append)
    Dataset.open(tmp_path, notes.append)
    first.close()
    first.close()
    Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append).close()


def test_another_robot_is_refused(tmp_path: Path, notes: list[str]) -> None:
    """Another name or another number in the description is refused; the differing field is named."""
    Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append).close()
    with pytest.raises(DatasetError, match="recordings of 'cartpole', not of 'go2'"):
        Dataset.create_or_open(tmp_path, replace(DESCRIPTION, name="go2"), notes.append)
    with pytest.raises(DatasetError, match=r"stiffness differ\); name another folder"):
        Dataset.create_or_open(tmp_path, replace(DESCRIPTION, stiffness=(81.0,)), notes.append)
    Dataset.create_or_open(tmp_path, replace(DESCRIPTION, sources={}), notes.append).close()


def test_episode_of_a_killed_collector_is_taken_in(
    tmp_path: Path, write_episode: WriteEpisode, notes: list[str]
) -> None:
    """A torn recording that no index names is repaired and indexed at the next open, which says so."""
    folder = tmp_path / "dataset"
    collect(folder, write_episode("whole.mcap"), notes)
    shutil.copy(write_episode("torn.mcap", torn=True), folder / "episodes" / "000001.mcap")
    dataset = Dataset.open(folder, notes.append)
    assert len(notes) == 2
    assert "no footer" in notes[0] and "it was added, with" in notes[1]
    assert dataset.episodes[1].states > 580
    assert "its collector was killed" in dataset.episodes[1].note
    notes.clear()
    with Dataset.create_or_open(folder, DESCRIPTION, notes.append) as again:
        assert again.next_episode_path().name == "000002.mcap"
    assert notes == []


def test_running_collector_is_left_alone(
    tmp_path: Path, write_episode: WriteEpisode, notes: list[str]
) -> None:
    """A reader neither repairs nor indexes the recording that a collector is writing."""
    folder = tmp_path / "dataset"
    with Dataset.create_or_open(folder, DESCRIPTION, notes.append) as writer:
        path = writer.next_episode_path()
        shutil.copy(write_episode(torn=True), path)
        before = path.read_bytes()
        assert Dataset.open(folder, notes.append).episodes == ()
        assert path.read_bytes() == before
    assert notes == []


def test_empty_episode_is_indexed_with_a_failed_check(
    tmp_path: Path, write_episode: WriteEpisode, notes: list[str]
) -> None:
    """A recording without samples, or of 0 bytes, is in the index and says so."""
    folder = tmp_path / "dataset"
    collect(folder, write_episode("silent.mcap", cycles=0), notes)
    (tmp_path / "zero").touch()
    collect(folder, tmp_path / "zero", notes)
    for episode in Dataset.open(folder, notes.append).episodes:
        assert episode.states == 0
        assert [verdict["severity"] for verdict in episode.verdicts] == ["fail"]


def test_unreadable_stray_does_not_block_the_dataset(tmp_path: Path, notes: list[str]) -> None:
    """A file that is no recording is left out and named; its number is not used again."""
    Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append).close()
    (tmp_path / "episodes" / "000000.mcap").write_text("not a recording")
    with Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append) as dataset:
        assert dataset.next_episode_path().name == "000001.mcap"
    assert len(notes) == 1
    assert "left out" in notes[0]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", r"dataset\.json .*: Invalid JSON"),
        ('{"schema_version": 7}', "schema version 7, expected 1"),
        ('{"schema_version": 1}', r"dataset\.json .*: field robot is missing"),
    ],
)
def test_broken_index_is_said(tmp_path: Path, notes: list[str], content: str, words: str) -> None:
    """An index that cannot be read is an error for readers and collectors, and locks nobody out."""
    (tmp_path / "dataset.json").write_text(content)
    with pytest.raises(DatasetError, match=words):
        Dataset.open(tmp_path, notes.append)
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(DatasetError, match=words):
        Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append)
    assert len(os.listdir("/proc/self/fd")) == before


def test_edited_index_is_refused(tmp_path: Path, notes: list[str]) -> None:
    """A description changed by hand does not fit its digest; an episode outside the folder is not read."""
    Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append).close()
    path = tmp_path / "dataset.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "description": {**values["description"], "stiffness": [90.0]}}))
    with pytest.raises(DatasetError, match="was edited"):
        Dataset.open(tmp_path, notes.append)
    episode = {
        "file": "../../etc/passwd",
        "purpose": "",
        "policy_digest": "",
        "wall_utc": "",
        "duration_s": 0,
    }
    episode |= {"states": 0, "commands": 0, "cycles": 0, "verdicts": [], "excitation": None, "clock": None}
    path.write_text(json.dumps({**values, "episodes": [episode]}))
    with pytest.raises(DatasetError, match="not inside the dataset"):
        Dataset.open(tmp_path, notes.append)


def test_reader_cannot_append_and_strangers_are_refused(tmp_path: Path, notes: list[str]) -> None:
    """Appending needs the lock; a folder without an index is not a dataset; a file elsewhere is not taken."""
    with pytest.raises(DatasetError, match=r"it has no dataset\.json"):
        Dataset.open(tmp_path, notes.append)
    with Dataset.create_or_open(tmp_path, DESCRIPTION, notes.append) as dataset:
        with pytest.raises(DatasetError, match="is not in"):
            dataset.note_episode(tmp_path / "elsewhere.mcap")
    with pytest.raises(DatasetError, match="open for reading only"):
        Dataset.open(tmp_path, notes.append).next_episode_path()
