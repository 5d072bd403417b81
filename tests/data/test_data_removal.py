"""Keeping, removing and putting back episodes of a dataset."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.dataset_index import entry_of_episode
from deal_hw.data.recording.removal import keep_episodes, remove_episodes, removed_numbers
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import DatasetError

WriteEpisode = Callable[..., Path]
TRIPPED = {"outcome": "tripped", "reason": "joint 'cart' is at 0.383 m", "flags": ["position"]}


@pytest.fixture
def dataset(tmp_path: Path, write_episode: WriteEpisode) -> Path:
    """A dataset of four episodes: 0 and 2 finished, 1 tripped, and 3 holds nothing."""
    folder, source = tmp_path / "dataset", write_episode()
    known: list[dict[str, Any]] = [{"outcome": "finished"}, TRIPPED, {}, {}]
    for number, facts in enumerate(known):
        with Dataset.create_or_open(folder, DESCRIPTION) as store:
            path = store.next_episode_path()
            shutil.copy(source if number < 3 else write_episode("silent.mcap", cycles=0), path)
            store.note_episode(path, facts)
    return folder


def edited(folder: Path, change: Callable[..., Any], *numbers: int) -> Any:
    """Change a dataset, and return what the change returned."""
    with Dataset.edit(folder) as dataset:
        return change(dataset, numbers)


def test_a_failed_run_is_left_out_until_it_is_kept(dataset: Path) -> None:
    """By its outcome, which datasets have had from the beginning; the decision is in the index."""
    output: list[str] = []
    empty = Dataset.open(dataset).info(3)
    assert Dataset.open(dataset).used(output.append) == (0, 2)
    assert output == [
        "episode 1 is left out: the safety module ended it (joint 'cart' is at 0.383 m); to use it all the "
        f"same: deal-hw data keep {dataset} 1",
        f"episode 3 is left out: it holds no state sample; also {empty.failed_checks[0]}",
    ]
    (info,) = edited(dataset, keep_episodes, 1)
    assert info.failure and not info.left_out
    assert Dataset.open(dataset).used(output.append) == (0, 1, 2)
    (same,) = edited(dataset, keep_episodes, 0, 0, -4)
    assert same.facts == {"outcome": "finished"} and Dataset.open(dataset).numbers == (0, 1, 2, 3)


@pytest.mark.parametrize(
    ("facts", "why"),
    [
        ({"outcome": "failed"}, "its run failed (for an unknown reason)"),
        ({"outcome": "failed", "reason": ["x"]}, "its run failed (['x'])"),
        ({"outcome": "stopped", "reason": "Ctrl-C"}, ""),
        ({"outcome": ["tripped"]}, ""),
        ({}, ""),
    ],
)
def test_what_fails_a_run(dataset: Path, facts: dict[str, Any], why: str) -> None:
    """An operator may stop a run, and what an import brings has no outcome."""
    info = replace(Dataset.open(dataset).info(0), facts=facts)
    assert (info.failure, info.left_out) == (why, why)


def test_removed_episodes_are_moved_and_numbers_stay(dataset: Path, write_episode: WriteEpisode) -> None:
    """The others keep their numbers, and no number is used twice."""
    removed = edited(dataset, remove_episodes, 1, 3, 1, -1)
    assert [info.number for info in removed] == [1, 3] and removed_numbers(dataset) == (1, 3)
    after = Dataset.open(dataset)
    assert after.numbers == (0, 2)
    assert (
        after.path(2).name == after.path(-1).name == "000002.mcap" and after.read(2).trajectory.device_s.size
    )
    assert not (dataset / "episodes" / "000001.mcap").exists()
    assert (dataset / "removed" / "000001.mcap").stat().st_size > 0
    with pytest.raises(
        DatasetError, match=r"has 2 episodes; there is no number 1 \(the first is 0, the last is 2"
    ):
        after.path(1)
    with Dataset.create_or_open(dataset, DESCRIPTION) as store:
        assert store.next_episode_path().name == "000004.mcap"


def test_a_removed_episode_is_put_back_as_it_was(dataset: Path) -> None:
    """With all that the index knew, and in its place; a failed one is then kept."""
    before = Dataset.open(dataset)
    edited(dataset, remove_episodes, 0, 1)
    edited(dataset, keep_episodes, 1, 0)
    after = Dataset.open(dataset)
    assert after.numbers == (0, 1, 2, 3) and after.info(0) == before.info(0)
    assert after.info(1).facts == {**TRIPPED, "kept": True}
    assert removed_numbers(dataset) == () and not list((dataset / "removed").iterdir())


def test_nothing_changes_where_one_cannot_be(dataset: Path) -> None:
    """An unknown number, or a folder that is in the way; a reader cannot change anything."""
    index = (dataset / "dataset.json").read_text()
    for change in (keep_episodes, remove_episodes):
        with pytest.raises(DatasetError, match="there is no number 7"):
            edited(dataset, change, 1, 7)
    with pytest.raises(DatasetError, match="cannot be used: it holds no state sample"):
        edited(dataset, keep_episodes, 1, 3)
    (dataset / "removed").touch()
    with pytest.raises(DatasetError, match="removed cannot be written"):
        edited(dataset, remove_episodes, 1)
    with pytest.raises(DatasetError, match=r"open for reading only.*Dataset\.edit"):
        keep_episodes(Dataset.open(dataset), (1,))
    assert (dataset / "dataset.json").read_text() == index and Dataset.open(dataset).path(1).is_file()


def test_a_dataset_in_use_is_not_changed(dataset: Path, tmp_path: Path) -> None:
    """A collector has it; and a folder without an index is none."""
    with (
        Dataset.create_or_open(dataset, DESCRIPTION),
        pytest.raises(DatasetError, match="in use by another collector"),
    ):
        Dataset.edit(dataset)
    with pytest.raises(DatasetError, match="is not a dataset"):
        Dataset.edit(tmp_path)


def test_a_removal_that_was_cut_off_leaves_the_episode(dataset: Path) -> None:
    """The index is written before the file moves, so the next opening takes the file in again."""
    with Dataset.edit(dataset) as store:
        store.change([info for info in store.episodes if info.number != 2])
    output: list[str] = []
    assert Dataset.open(dataset, output.append).numbers == (0, 1, 2, 3)
    assert "was not in the index; it was added" in output[0]


def test_a_foreign_entry_is_not_put_back(dataset: Path) -> None:
    """A file of another number would take that episode's place."""
    edited(dataset, remove_episodes, 0, 1)
    shutil.copy(dataset / "removed" / "000000.json", dataset / "removed" / "000001.json")
    with pytest.raises(DatasetError, match="is the entry of episode 0, not of 1"):
        edited(dataset, keep_episodes, 1)


def test_an_episode_finds_its_entry(dataset: Path, tmp_path: Path) -> None:
    """Of a file elsewhere, or of a damaged index, nothing is known."""
    found = entry_of_episode(dataset / "episodes" / "000001.mcap")
    assert found is not None and found.number == 1 and found.failure
    shutil.copy(dataset / "episodes" / "000001.mcap", tmp_path / "copy.mcap")
    assert entry_of_episode(tmp_path / "copy.mcap") is None
    (dataset / "dataset.json").write_text("{")
    assert entry_of_episode(dataset / "episodes" / "000001.mcap") is None


@pytest.mark.parametrize("name", ["1.mcap", "0000001.mcap", "000001a.mcap", "00001\u0662.mcap"])
def test_an_episode_has_one_name_for_its_number(
    dataset: Path, write_episode: WriteEpisode, name: str
) -> None:
    """A file of another name is left out, and named."""
    shutil.copy(write_episode(), dataset / "episodes" / name)
    output: list[str] = []
    assert Dataset.open(dataset, output.append).numbers == (0, 1, 2, 3)
    assert len(output) == 1 and "is left out" in output[0] and "such as episodes/000007.mcap" in output[0]
    with Dataset.create_or_open(dataset, DESCRIPTION, output.append) as store:
        with pytest.raises(DatasetError, match="has no name such as"):
            store.note_episode(dataset / "episodes" / name)
        (dataset / "removed").mkdir()
        for suffix in (".mcap", ".json"):
            (dataset / "removed" / name).with_suffix(suffix).touch()
        assert removed_numbers(dataset) == () and store.next_episode_path().name == "000004.mcap"
    index = dataset / "dataset.json"
    index.write_text(index.read_text().replace("000003.mcap", name.replace("\u0662", "a")))
    with pytest.raises(DatasetError, match="has no name such as"):
        Dataset.open(dataset)
