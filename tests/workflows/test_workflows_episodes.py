"""Which episodes of a dataset a calibration uses: failed runs do not block it, and nothing promises more."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from fakes.virtual_runs import Motion, record_cartpole

import deal_hw
from deal_hw.cli.main import parse
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.removal import keep_episodes, remove_episodes
from deal_hw.errors import (
    ConfigurationError,
    DatasetError,
    DealHwError,
    InsufficientDataError,
    TransportError,
)
from deal_hw.workflows.calibration.episodes import choose_episodes, refusal
from deal_hw.workflows.calibration.intake import CalibrationInput, calibration_input
from deal_hw.workflows.calibration.settings import DriverDatasetSettings
from deal_hw.workflows.import_export import (
    ExportSettings,
    ImportSettings,
    export_recordings,
    import_recordings,
)

TRIPPED = {"outcome": "tripped", "reason": "joint 'cart' is at 0.383 m", "motion": "rich"}
SHORT, SOUND, UNFOLLOWED = 0, 1, 3


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trip after 1 s, a finished run, a sweep that tripped, a cart that did not follow and tripped."""
    folder = tmp_path_factory.mktemp("run") / "dataset"
    record_cartpole(folder, seconds=1.0, facts=TRIPPED)
    record_cartpole(folder, facts={"outcome": "finished", "motion": "rich"})
    record_cartpole(folder, "chirp", 2.2, facts={**TRIPPED, "motion": "chirp"})
    record_cartpole(folder, seconds=4.0, facts=TRIPPED, unfollowed_s=0.8)
    return folder


@pytest.fixture
def dataset(recorded: Path, tmp_path: Path) -> Path:
    """Return a copy of it, which a test may change."""
    return Path(shutil.copytree(recorded, tmp_path / "dataset"))


def kept(folder: Path, *numbers: int) -> None:
    """Keep episodes, as `deal-hw data keep`."""
    with Dataset.edit(folder) as dataset:
        keep_episodes(dataset, numbers)


def removed(folder: Path, *numbers: int) -> None:
    """Remove episodes, as `deal-hw data remove`."""
    with Dataset.edit(folder) as dataset:
        remove_episodes(dataset, numbers)


def read(folder: Path, output: list[str], **settings: object) -> CalibrationInput:
    """Read a dataset as `calibrate` does."""
    return calibration_input(DriverDatasetSettings(dataset=folder, **settings), say=output.append)  # type: ignore[arg-type]


def names(found: CalibrationInput) -> list[str]:
    """Return the files of the fitted episodes."""
    return [episode.name for episode in found.episodes]


def test_failed_runs_are_left_out_and_named(dataset: Path) -> None:
    """Each with its reason, and with the line that uses it where one can; a tripped sweep judges nothing."""
    output: list[str] = []
    found = read(dataset, output)
    assert names(found) == ["000001.mcap"] and not found.holdout
    short, sweep, unfollowed = output
    why = "is left out: the safety module ended it (joint 'cart' is at 0.383 m)"
    assert short.startswith(f"episode 0 {why}; also 1.00 s, ") and "data keep" not in short
    assert sweep == f"episode 2 {why}; to use it all the same: deal-hw data keep {dataset} 2"
    assert unfollowed == f"episode 3 {why}; to use it all the same: deal-hw data keep {dataset} 3"
    assert sum("left out" in line for line in found.telemetry) == 3
    assert found.provenance["episodes"] == [1]


def test_the_followed_part_of_a_kept_episode_is_fitted(dataset: Path) -> None:
    """3.2 of 4 s; the sweep is held out again once it is kept."""
    kept(dataset, 2, UNFOLLOWED)
    output: list[str] = []
    found = read(dataset, output)
    assert names(found) == ["000001.mcap", "000003.mcap"]
    assert found.episodes[1].time_s[-1] == pytest.approx(3.2, abs=0.02)
    assert [episode.name for episode in found.holdout] == ["000002.mcap"]
    cut = "episode 3: the last 0.8 s are left out: joint cart did not follow its commands; check power"
    assert output[1].startswith(cut) and len(output) == 2


def test_a_named_episode_is_used_without_being_kept(dataset: Path) -> None:
    """To be fitted or to judge; one that no fit can use is refused, since the user wants it."""
    output: list[str] = []
    found = read(dataset, output, episodes=(UNFOLLOWED,), holdout=(2,))
    assert names(found) == ["000003.mcap"] and len(found.holdout) == 1
    assert not any("data keep" in line for line in output)
    with pytest.raises(InsufficientDataError, match=r"episode 0 of .* too short; .*name others \(--episodes"):
        read(dataset, output, episodes=(SHORT, SOUND))


def test_a_kept_episode_that_cannot_be_used_does_not_block(dataset: Path) -> None:
    """It is left out by its own check, which no decision replaces."""
    kept(dataset, SHORT)
    output: list[str] = []
    assert names(read(dataset, output)) == ["000001.mcap"]
    assert any(re.match(r"episode 0 is left out: 1\.00 s, .* too short", line) for line in output)


def test_the_command_of_a_refusal_works(dataset: Path) -> None:
    """Only a tripped episode is left: the refusal names it, its reason, and a command that is accepted."""
    removed(dataset, SOUND)
    with pytest.raises(ConfigurationError, match="nothing to fit") as refused:
        read(dataset, [])
    text = str(refused.value)
    assert "episode 0: the safety module ended it (joint 'cart' is at 0.383 m); 1.00 s, " in text
    line = text.rpartition("To fit what is there: deal-hw ")[2]
    assert line == f"calibrate {dataset} --episodes 2 3"
    verb, *words = shlex.split(line)
    settings, _ = parse(verb, words)
    assert names(calibration_input(settings)) == ["000002.mcap", "000003.mcap"]


@pytest.mark.parametrize(
    ("runs", "why"),
    [
        ([("rich", 1.0, {})], "1.00 s, 201 state samples"),
        ([("rich", 1.0, TRIPPED)], "the safety module ended it"),
        ([("hold", 2.5, {})], "the position target changed"),
        ([("hold", 2.5, TRIPPED)], "the safety module ended it"),
    ],
)
def test_what_is_not_enough_is_known_before_the_calibration(
    tmp_path: Path, runs: list[tuple[Motion, float, dict[str, str]]], why: str
) -> None:
    """`collect` does not name a next step that is refused; it names one that helps."""
    for motion, seconds, facts in runs:
        record_cartpole(tmp_path, motion, seconds, facts=facts)
    text = refusal(Dataset.open(tmp_path))
    assert why in text
    assert f"Record one: deal-hw collect cartpole --port PORT --motion rich --dataset {tmp_path}" in text


def test_nothing_is_refused_that_a_calibration_takes(dataset: Path) -> None:
    """The index decides as the samples do; of a sweep alone the command is named."""
    assert refusal(Dataset.open(dataset)) == ""
    removed(dataset, SHORT, SOUND, UNFOLLOWED)
    kept(dataset, 2)
    text = refusal(Dataset.open(dataset))
    assert "episode 2: it is held out" in text and text.endswith(f"calibrate {dataset} --episodes 2")
    with pytest.raises(DealHwError, match=re.escape(text)):
        read(dataset, [])
    assert names(read(dataset, [], episodes=(2,))) == ["000002.mcap"]


def test_a_damaged_episode_is_named_before_the_calibration(dataset: Path) -> None:
    """The run itself is over, so that this is no error of it."""
    file = dataset / "episodes" / "000001.mcap"
    file.write_bytes(b"no episode")
    assert f"{file} is not an MCAP file" in refusal(Dataset.open(dataset))


def test_a_repetition_that_failed_does_not_replace_the_recording_before(dataset: Path) -> None:
    """A weak recording, then a stronger attempt that tripped: the weak one is all there is."""
    record = dataset.parent / "again"
    for attempt, facts in enumerate(({}, TRIPPED)):
        record_cartpole(record, facts=facts, metadata={"attempt": attempt, "seed": 0, "seconds": 2.6})
    assert choose_episodes(Dataset.open(record), (), ()) == ((0,), ())
    kept(record, 1)
    output: list[str] = []
    assert choose_episodes(Dataset.open(record), (), (), output.append) == ((1,), ())
    assert "episodes [0] hardly moved" in output[0]


def test_an_import_of_a_dataset_leaves_failed_runs_out(dataset: Path, tmp_path: Path) -> None:
    """What is kept or named goes with what its index knows, so that it is marked there as here."""
    kept(dataset, UNFOLLOWED)
    output: list[str] = []
    taken = import_recordings(
        ImportSettings(paths=(dataset,), out=tmp_path / "all", force=True), output.append
    )
    assert taken is not None and len(taken.episodes) == 2
    assert sum("is left out: the safety module ended it" in line for line in output) == 2
    assert taken.info(1).failure and not taken.info(1).left_out
    named = ImportSettings(paths=(dataset / "episodes" / "000002.mcap",), out=tmp_path / "one", force=True)
    alone = import_recordings(named)
    assert alone is not None and alone.info(0).left_out == alone.info(0).failure != ""
    with pytest.raises(DatasetError, match=r"episode 0 is left out: .* deal-hw data keep .*one 0"):
        import_recordings(ImportSettings(paths=(tmp_path / "one",), out=tmp_path / "none", force=True))


def test_an_export_for_learning_leaves_failed_runs_out(dataset: Path, tmp_path: Path) -> None:
    """One that is kept or named is written; to look at, all are."""
    pytest.importorskip("pyarrow")
    output: list[str] = []
    assert export_recordings(ExportSettings(path=dataset, out=tmp_path / "a"), output.append)[0] == 1
    assert sum("is left out: the safety module ended it" in line for line in output) == 3
    tripped = dataset / "episodes" / "000002.mcap"
    assert export_recordings(ExportSettings(path=tripped, out=tmp_path / "b"))[0] == 1
    assert export_recordings(ExportSettings(path=dataset, out=tmp_path / "c", format="foxglove"))[0] == 4


def test_the_commands_of_a_failed_run_are_replayed_with_a_warning(dataset: Path, tmp_path: Path) -> None:
    """Before the port is opened."""
    output: list[str] = []
    for number in (SOUND, SHORT):
        path = dataset / "episodes" / f"{number:06d}.mcap"
        with pytest.raises(TransportError):
            deal_hw.replay(
                path, robot="cartpole", port=str(tmp_path / "none"), record=False, say=output.append
            )
    (warning,) = output
    assert (
        "000000.mcap is of a failed run: the safety module ended it (joint 'cart' is at 0.383 m)" in warning
    )
