"""A run's folder, its dataset and its only episode: each is found where another of them is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from deal_hw.data.files import dataset_of, episode_of
from deal_hw.errors import DatasetError


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a run with a dataset of one episode, as far as names go."""
    episodes = tmp_path / "first" / "dataset" / "episodes"
    episodes.mkdir(parents=True)
    (episodes.parent / "dataset.json").write_text("{}")
    (episodes / "000000.mcap").write_bytes(b"")
    return tmp_path / "first"


def test_a_run_stands_for_its_dataset(run: Path) -> None:
    """A dataset stands for itself, and so does what holds none."""
    assert dataset_of(run) == dataset_of(str(run / "dataset")) == run / "dataset"
    assert dataset_of(run / "nothing") == run / "nothing"
    # A dataset that has a folder of this name is still the dataset.
    (run / "dataset.json").write_text("{}")
    assert dataset_of(run) == run


def test_the_only_episode_is_found(run: Path) -> None:
    """By the run, by the dataset, by itself; a file that is not there is named as it was given."""
    wanted = run / "dataset" / "episodes" / "000000.mcap"
    assert episode_of(run) == episode_of(run / "dataset") == episode_of(wanted) == wanted
    assert episode_of("nothing.mcap") == Path("nothing.mcap")


def test_one_of_several_episodes_must_be_named(run: Path) -> None:
    """The message names the first; without any it shows how one is called."""
    (run / "dataset" / "episodes" / "000001.mcap").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"2 episodes; name one of them, such as .*000000\.mcap"):
        episode_of(run)
    with pytest.raises(DatasetError, match="without an episode"):
        episode_of(run / "dataset" / "episodes")
