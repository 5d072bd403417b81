"""`deal-hw data`: show, verify, repair, keep, remove, import and export recordings."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deal_hw.cli.data_info import print_info
from deal_hw.cli.show import Terminal
from deal_hw.data.files import INDEX_NAME, dataset_of
from deal_hw.data.recording.dataset import REMOVED_FOLDER, Dataset
from deal_hw.data.recording.episode_info import EpisodeInfo, motion_of
from deal_hw.data.recording.removal import keep_episodes, remove_episodes
from deal_hw.data.recording.repair import RepairReport, repair, verify
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.ranges import Checked, Range
from deal_hw.workflows.import_export import (
    ExportSettings,
    ImportSettings,
    export_recordings,
    import_recordings,
)
from deal_hw.workflows.kinds import InputKind, sub_verbs
from deal_hw.workflows.robot import carried_problems
from deal_hw.workflows.say import to_stderr

EXIT_OK, EXIT_UNSOUND = 0, 1
Numbers = Annotated[tuple[int, ...], Range(0, 1_000_000)]
"""Numbers of episodes; the first is 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InfoSettings:
    """Show the contents of a dataset or an episode."""

    path: tyro.conf.Positional[Path]
    """A dataset (DIR) or an episode (DIR/episodes/000000.mcap)."""
    json: bool = False
    """Print JSON instead of tables."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verify:
    """Check files and their checksums, without changes; exit code 1 if a file is torn or damaged."""

    path: tyro.conf.Positional[Path]
    """A dataset (DIR) or an episode (DIR/episodes/000000.mcap)."""
    json: bool = False
    """Print JSON instead of sentences."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Repair:
    """Repair torn or damaged files and print what was lost; other files stay unchanged."""

    path: tyro.conf.Positional[Path]
    """A dataset (DIR) or an episode (DIR/episodes/000000.mcap)."""
    json: bool = False
    """Print JSON instead of sentences."""


@dataclass(frozen=True, kw_only=True)
class Keep(Checked):
    """Use episodes although their run tripped or failed, and put removed ones back."""

    path: tyro.conf.Positional[Path]
    """A dataset (DIR)."""
    episodes: tyro.conf.Positional[Numbers]
    """Numbers of the episodes; `deal-hw data info DIR` shows them."""


@dataclass(frozen=True, kw_only=True)
class Remove(Checked):
    """Take episodes out of a dataset; their files move to DIR/removed."""

    path: tyro.conf.Positional[Path]
    """A dataset (DIR)."""
    episodes: tyro.conf.Positional[Numbers]
    """Numbers of the episodes; `deal-hw data info DIR` shows them. Those of the others stay as they are."""
    yes: bool = False
    """Do not ask."""


@dataclass(frozen=True, kw_only=True)
class Import(ImportSettings):
    """Make a dataset from plausible recordings of any robot."""

    paths: tyro.conf.Positional[tuple[Path, ...]]


@dataclass(frozen=True, kw_only=True)
class Export(ExportSettings):
    """Write the episodes of a dataset for other software."""

    path: tyro.conf.Positional[Path]


KINDS = sub_verbs(
    **{
        "info": InputKind(InfoSettings, example="info runs/first/dataset"),
        "verify": InputKind(Verify, example="verify runs/first/dataset"),
        "repair": InputKind(Repair, example="repair runs/first/dataset"),
        "keep": InputKind(Keep, example="keep runs/first/dataset 0"),
        "remove": InputKind(Remove, example="remove runs/first/dataset 0"),
        "import": InputKind(Import, example="import rec.csv --robot robot.yaml --out runs/mine/dataset"),
        "export": InputKind(Export, example="export runs/first/dataset --out exported"),
    }
)


def data(config: InfoSettings | Verify | Repair | Keep | Remove | Import | Export) -> int:
    """Run the verb.

    Returns:
        0, or 1 where a file is torn or damaged and was not repaired, or nothing was removed.

    Raises:
        DatasetError: The path is neither a dataset nor an episode, or cannot be read or written.
        ConfigurationError: Nobody can answer whether to remove episodes.
    """
    if isinstance(config, Import):
        dataset = import_recordings(config, to_stderr)
        if dataset is not None:
            count = len(dataset.episodes)
            print(f"{dataset.folder}: {count} episode{'s' * (count != 1)} of {dataset.description['name']}")
        return EXIT_OK
    if isinstance(config, Export):
        count, robot = export_recordings(config, to_stderr)
        layout = {"lerobot": "LeRobot", "foxglove": "Foxglove"}[config.format]
        print(f"{config.out}: {count} {layout} episode{'s' * (count != 1)} of {robot}")
        return EXIT_OK
    path = dataset_of(config.path)
    if isinstance(config, InfoSettings):
        print_info(path, config.json)
        return EXIT_OK
    if isinstance(config, Keep):
        return _keep(path, config.episodes)
    if isinstance(config, Remove):
        return _remove(path, config.episodes, config.yes)
    return _verify(path, isinstance(config, Repair), config.json)


def _keep(path: Path, numbers: tuple[int, ...]) -> int:
    with Dataset.edit(path, to_stderr) as dataset:
        before = {info.number: info for info in dataset.episodes}
        for info in keep_episodes(dataset, numbers):
            back = "put back, and used" if info.number not in before else "used"
            why = f" although {info.failure}" if info.failure else ""
            print(f"episode {info.number} is {back}{why}")
            if info.failed_checks:
                print(f"  but calibrate still leaves it out: {'; '.join(info.failed_checks)}")
    return EXIT_OK


def _remove(path: Path, numbers: tuple[int, ...], yes: bool) -> int:
    dataset = Dataset.open(path, to_stderr)
    chosen = [dataset.info(number) for number in dict.fromkeys(numbers)]
    if not yes:
        question = f"move {'it' if len(chosen) == 1 else 'them'} to {path / REMOVED_FOLDER}?"
        answer = Terminal().confirm("\n".join(map(_described, chosen)), question)
        if answer is None:
            raise ConfigurationError("nothing was removed: nobody can answer here; add --yes")
        if not answer:
            print("nothing was removed")
            return EXIT_UNSOUND
    with Dataset.edit(path, to_stderr) as dataset:
        removed = " ".join(str(info.number) for info in remove_episodes(dataset, numbers))
    print(f"removed: {removed}, to {path / REMOVED_FOLDER}; to put back: deal-hw data keep {path} {removed}")
    return EXIT_OK


def _described(info: EpisodeInfo) -> str:
    words = " ".join(filter(None, (info.purpose, motion_of(info.facts))))
    return f"episode {info.number}: {words}, {info.duration_s:.1f} s{info.failure and f', {info.failure}'}"


def _verify(path: Path, mend: bool, as_json: bool) -> int:
    """Check files, or repair them; return the exit code."""
    reports, errors = _each(_episode_files(path), mend)
    errors += carried_problems(path)
    if as_json:
        values = [{**asdict(report), "sound": report.sound} for report in reports]
        print(json.dumps({"files": values, "errors": errors}, indent=2, default=str))
    else:
        for report in reports:
            print(report.describe())
        for error in errors:
            print(f"error: {error}")
    if mend and (path / INDEX_NAME).is_file():
        # Opening also indexes new episodes, such as that of a killed collector.
        Dataset.open(path)
    return (
        EXIT_OK if not errors and all(report.sound or report.repaired for report in reports) else EXIT_UNSOUND
    )


def _each(files: list[Path], mend: bool) -> tuple[list[RepairReport], list[str]]:
    """Return the findings of each file; an unreadable file does not stop the check of the next one."""
    reports, errors = [], []
    for path in files:
        try:
            reports.append(repair(path) if mend else verify(path))
        except DatasetError as error:
            errors.append(str(error))
    return reports, errors


def _episode_files(path: Path) -> list[Path]:
    if not path.exists():
        raise DatasetError(
            f"{path} does not exist; name a dataset (DIR) or an episode (DIR/episodes/000000.mcap)"
        )
    if not path.is_dir():
        return [path]
    folder = path if path.name == "episodes" else path / "episodes"
    files = sorted(folder.glob("*.mcap"))
    if not files and not (path / INDEX_NAME).is_file():
        raise DatasetError(
            f"{path} is no dataset: it has neither {INDEX_NAME} nor episodes/*.mcap; name a "
            "dataset (DIR) or an episode (DIR/episodes/000000.mcap)"
        )
    return files
