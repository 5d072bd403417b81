"""`deal-hw data`."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from deal_hw.cli.data import InfoSettings, Repair, Verify, data
from deal_hw.cli.data_info import _position_ranges
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.episode_info import EpisodeInfo
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import DatasetError

WriteEpisode = Callable[..., Path]


@pytest.fixture
def dataset(tmp_path: Path, write_episode: WriteEpisode) -> Path:
    """A dataset of one sound episode."""
    folder = tmp_path / "dataset"
    with Dataset.create_or_open(folder, DESCRIPTION) as collection:
        path = collection.next_episode_path()
        shutil.copy(write_episode("source.mcap"), path)
        collection.note_episode(path, {"motion": "rich", "excitation_level": 1.5})
    return folder


def test_info_of_a_dataset(
    dataset: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On 80 columns the table has every head and value in one line: motion, level, counts, what moved."""
    monkeypatch.setenv("COLUMNS", "80")
    assert data(InfoSettings(path=dataset)) == 0
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    (heads,) = (line for line in lines if "checks" in line)
    assert all(words in heads for words in ("no.", "motion", "states", "sent", "moves by"))
    (row,) = (line for line in lines if "rich" in line)
    assert "test rich" in row and "level +1.5" in printed
    # 600 samples of 1 mm each, and a pole that goes to and fro by 0.49 rad.
    assert all(words in printed for words in ("600", "150", "0.60 m", "0.49 rad", "cartpole"))
    assert max(map(len, lines)) <= 80


def test_of_many_joints_the_widest_is_shown() -> None:
    """Twelve ranges would not fit."""
    episode = EpisodeInfo(
        file="episodes/000000.mcap",
        purpose="collect",
        policy_digest="",
        wall_utc="",
        duration_s=1.0,
        states=1,
        commands=1,
        cycles=1,
        verdicts=(),
        excitation={"position_range": [0.1, 0.9, 0.3]},
        clock=None,
    )
    facts = {"joint_names": ["a", "b", "c"], "position_units": ["rad"] * 3}
    assert _position_ranges(episode, facts) == "0.90 rad (b)"
    assert _position_ranges(dataclasses.replace(episode, excitation=None), facts) == ""
    two = dataclasses.replace(episode, excitation={"position_range": [0.1, 0.9]})
    assert _position_ranges(two, facts) == "0.10, 0.90 rad"
    assert _position_ranges(two, {**facts, "position_units": ["m", "rad"]}) == "0.10 m, 0.90 rad"


def test_info_as_json(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """JSON of a dataset and of an episode hold the same episode."""
    assert data(InfoSettings(path=dataset, json=True)) == 0
    whole = json.loads(capsys.readouterr().out)
    assert whole["robot"] == "cartpole"
    assert data(InfoSettings(path=dataset / "episodes" / "000000.mcap", json=True)) == 0
    # What the collector knew is in the index alone.
    assert json.loads(capsys.readouterr().out) == whole["episodes"][0] | {"facts": {}}


def test_info_of_an_episode_shows_checks(
    dataset: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each check has its row, and the clocks theirs."""
    monkeypatch.setenv("COLUMNS", "80")
    assert data(InfoSettings(path=dataset / "episodes" / "000000.mcap")) == 0
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 80
    for words in ("clamped_by_us", "host minus device"):
        assert words in printed
    cart, pole = (line.split() for line in printed.splitlines()[-3:-1])
    # The pole has no motor, so it has no targets.
    assert (cart[:2], len(cart), pole[:2], len(pole)) == (["cart", "m"], 8, ["pole", "rad"], 6)


def test_episodes_are_kept_and_removed(
    dataset: Path,
    write_episode: WriteEpisode,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As a person does it after a trip: look, keep, remove after a question, put back; files stay."""
    from deal_hw.cli.main import main

    monkeypatch.setenv("COLUMNS", "80")
    with Dataset.create_or_open(dataset, DESCRIPTION) as collection:
        path = collection.next_episode_path()
        shutil.copy(write_episode("tripped.mcap"), path)
        collection.note_episode(path, {"motion": "rich", "outcome": "tripped", "reason": "too fast"})

    def printed(line: str, code: int = 0) -> str:
        assert main(["data", *line.split()]) == code
        output = capsys.readouterr()
        return " ".join((output.err + output.out).split())

    shown = printed(f"info {dataset}")
    assert "left out" in shown and f"deal-hw data keep {dataset} 1" in shown
    assert "left out: the safety module ended it (too fast)" in printed(
        f"info {dataset}/episodes/000001.mcap"
    )
    assert printed(f"keep {dataset} 1") == "episode 1 is used although the safety module ended it (too fast)"
    assert "episode 1 is kept: the safety module ended it (too fast)" in printed(f"info {dataset}")
    assert "nobody can answer here; add --yes" in printed(f"remove {dataset} 1", 2)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: "n")
    asked = printed(f"remove {dataset} 1", 1)
    assert "episode 1: test rich, 3.0 s, the safety module ended it" in asked
    assert asked.endswith("nothing was removed") and Dataset.open(dataset).numbers == (0, 1)
    monkeypatch.setattr("builtins.input", lambda question: "y")
    assert f"to put back: deal-hw data keep {dataset} 1" in printed(f"remove {dataset} 1")
    assert Dataset.open(dataset).numbers == (0,)
    document = json.loads(printed(f"info {dataset} --json"))
    assert document["removed"] == [1] and [one["number"] for one in document["episodes"]] == [0]
    assert f"removed: 1, to {dataset}/removed" in printed(f"info {dataset}")
    assert "episode 1 is put back, and used" in printed(f"keep {dataset} 1")
    printed(f"remove {dataset} 0 1 --yes")
    assert Dataset.open(dataset).numbers == () and len(list((dataset / "removed").iterdir())) == 4


def test_info_of_a_file_with_any_name(
    write_episode: WriteEpisode, capsys: pytest.CaptureFixture[str]
) -> None:
    """A copy elsewhere has no number and no index."""
    assert data(InfoSettings(path=write_episode("copy.mcap"), json=True)) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["number"], shown["left_out"], shown["file"]) == (-1, "", "episodes/copy.mcap")


def test_verify_then_repair(
    dataset: Path, write_episode: WriteEpisode, capsys: pytest.CaptureFixture[str]
) -> None:
    """Verify finds the torn episode and exits with 1, repair mends it and indexes it, verify is content."""
    shutil.copy(write_episode("torn.mcap", torn=True), dataset / "episodes" / "000001.mcap")
    assert data(Verify(path=dataset)) == 1
    assert "no footer" in capsys.readouterr().out
    assert data(Repair(path=dataset)) == 0
    assert "Rewritten" in capsys.readouterr().out
    assert data(Verify(path=dataset, json=True)) == 0
    assert [file["sound"] for file in json.loads(capsys.readouterr().out)["files"]] == [True, True]
    assert len(Dataset.open(dataset).episodes) == 2


def test_unreadable_file_does_not_hide_the_others(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An empty file is named as an error; the sound one is still reported."""
    (dataset / "episodes" / "000001.mcap").touch()
    assert data(Repair(path=dataset)) == 1
    printed = capsys.readouterr().out
    assert "000000.mcap: sound" in printed
    assert "000001.mcap is empty" in printed


def test_wrong_path_is_said(tmp_path: Path) -> None:
    """A folder without episodes and an absent file are errors with their paths."""
    with pytest.raises(DatasetError, match="is no dataset"):
        data(Verify(path=tmp_path))
    with pytest.raises(DatasetError, match=r"it has no dataset\.json"):
        data(InfoSettings(path=tmp_path))
    with pytest.raises(DatasetError, match="cannot be read"):
        data(InfoSettings(path=tmp_path / "absent.mcap"))


def test_command_line_reaches_the_verbs(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`deal-hw data verify DIR` is understood."""
    from deal_hw.cli.main import main

    assert main(["data", "verify", str(dataset)]) == 0
    assert "sound" in capsys.readouterr().out
