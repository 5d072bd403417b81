"""`deal-hw data`: show, verify, repair, import and export recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from deal_hw.data.files import INDEX_NAME, dataset_of
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.episode_info import EpisodeInfo, motion_of, summarize
from deal_hw.data.recording.repair import RepairReport, repair, verify
from deal_hw.errors import DatasetError
from deal_hw.workflows.import_export import (
    ExportSettings,
    ImportSettings,
    export_recordings,
    import_recordings,
)
from deal_hw.workflows.kinds import InputKind, sub_verbs
from deal_hw.workflows.robot import carried_problems, carries_robot
from deal_hw.workflows.say import to_stderr

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

EXIT_OK, EXIT_UNSOUND = 0, 1
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


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
        "import": InputKind(Import, example="import rec.csv --robot robot.yaml --out runs/mine/dataset"),
        "export": InputKind(Export, example="export runs/first/dataset --out exported"),
    }
)


def data(config: InfoSettings | Verify | Repair | Import | Export) -> int:
    """Run the verb.

    Returns:
        0, or 1 where a file is torn or damaged and was not repaired.

    Raises:
        DatasetError: The path is neither a dataset nor an episode, or cannot be read or written.
    """
    if isinstance(config, InfoSettings):
        return _info(replace(config, path=dataset_of(config.path)))
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
    config = replace(config, path=dataset_of(config.path))
    reports, errors = _each(_episode_files(config.path), isinstance(config, Repair))
    errors += carried_problems(config.path)
    if config.json:
        values = [{**asdict(report), "sound": report.sound} for report in reports]
        print(json.dumps({"files": values, "errors": errors}, indent=2, default=str))
    else:
        for report in reports:
            print(report.describe())
        for error in errors:
            print(f"error: {error}")
    if isinstance(config, Repair) and (config.path / INDEX_NAME).is_file():
        # Opening also indexes new episodes, such as that of a killed collector.
        Dataset.open(config.path)
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


def _info(config: InfoSettings) -> int:
    from rich.console import Console

    console = Console()
    if not config.path.is_dir():
        episode, recorded = summarize(config.path, f"episodes/{config.path.name}")
        if config.json:
            print(json.dumps(asdict(episode), indent=2))
        else:
            _print_episode(console, episode)
            if recorded is not None:
                console.print(_motion_table(episode.excitation or {}, recorded.description))
        return EXIT_OK
    notes: list[str] = []
    dataset = Dataset.open(config.path, notes.append)
    if config.json:
        values = {
            "folder": str(dataset.folder),
            "robot": dataset.description["name"],
            "digest": dataset.digest,
            "carries_robot": carries_robot(dataset.folder),
            "episodes": [asdict(episode) for episode in dataset.episodes],
            "notes": notes,
        }
        print(json.dumps(values, indent=2))
        return EXIT_OK
    for note in notes:
        console.print(note, style="yellow", markup=False)
    console.print(_dataset_table(dataset))
    if carries_robot(dataset.folder):
        console.print(f"its robot: {dataset.folder / 'robot' / 'robot.yaml'}", markup=False)
    for problem in carried_problems(dataset.folder):
        console.print(problem, style="red", markup=False)
    for episode in dataset.episodes:
        _print_problems(console, episode)
    return EXIT_OK


def _dataset_table(dataset: Dataset) -> Table:
    from rich.text import Text

    # Text, since words from a file could look like markup.
    title = Text(f"{dataset.folder}: {dataset.description['name']}, description {dataset.digest}")
    table = _plain_table(title)
    table.add_column("no.", justify="right", no_wrap=True)
    table.add_column("motion")
    table.add_column("UTC", no_wrap=True)
    for name in ("s", "states", "sent"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("moves by", no_wrap=True)
    table.add_column("checks", no_wrap=True)
    for episode in dataset.episodes:
        table.add_row(
            str(int(Path(episode.file).stem)),
            Text(_motion(episode)),
            Text(episode.wall_utc[5:16].replace("T", " ")),
            f"{episode.duration_s:.1f}",
            str(episode.states),
            str(episode.commands),
            Text(_position_ranges(episode, dataset.description)),
            _worst(episode),
        )
    return table


def _plain_table(title: Text) -> Table:
    """Return a table without vertical lines, which would take a quarter of 80 columns."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    return Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))


def _motion(episode: EpisodeInfo) -> str:
    """Return the purpose of an episode and its motion; a changed excitation level is a line of its own."""
    level = float(episode.facts.get("excitation_level") or 0.0)
    words = " ".join(filter(None, (episode.purpose, motion_of(episode.facts))))
    return f"{words}\nlevel {level:+g}" if level else words


def _position_ranges(episode: EpisodeInfo, description: Mapping[str, Any]) -> str:
    """Return the range of each joint's positions; with more than two joints only the widest range."""
    ranges = (episode.excitation or {}).get("position_range") or ()
    units, names = description.get("position_units") or (), description.get("joint_names") or ()
    parts = [f"{value:.2f} {unit}" for value, unit in zip(ranges, units, strict=False)]
    if len(parts) == 2 and len(set(units)) == 1:
        # The unit once, so that the row fits its line.
        return ", ".join(parts).replace(f" {next(iter(units))},", ",")
    if len(parts) <= 2:
        return ", ".join(parts)
    widest = max(range(len(parts)), key=lambda index: ranges[index])
    return f"{parts[widest]} ({names[widest]})"


def _clock_texts(episode: EpisodeInfo) -> tuple[str, str]:
    clock: dict[str, Any] = dict(episode.clock or {})
    if clock.get("offset_s") is None or clock.get("drift_ppm") is None:
        return "-", "-"
    offset, drift = f"{clock['offset_s'] * 1e3:+.3f} ms", f"{clock['drift_ppm']:+.0f} ppm"
    if clock["offset_uncertainty_s"] is not None:
        offset += f" +-{clock['offset_uncertainty_s'] * 1e3:.3f}"
    if clock["drift_uncertainty_ppm"] is not None:
        drift += f" +-{clock['drift_uncertainty_ppm']:.0f}"
    return offset, drift


def _worst(episode: EpisodeInfo) -> str:
    severities = [verdict["severity"] for verdict in episode.verdicts]
    for severity in ("fail", "warn"):
        if severity in severities:
            return f"[{_COLOURS[severity]}]{severities.count(severity)} {severity}[/]"
    return "[green]ok[/]"


def _print_problems(console: Console, episode: EpisodeInfo) -> None:
    if episode.note:
        console.print(f"{episode.file}: {episode.note}", style="yellow", markup=False)
    for verdict in episode.verdicts:
        if verdict["severity"] != "ok":
            text = f"{episode.file}: {verdict['severity']} {verdict['name']}: {verdict['message']}"
            console.print(text, style=_COLOURS[verdict["severity"]], markup=False)


def _print_episode(console: Console, episode: EpisodeInfo) -> None:
    from rich.text import Text

    table = _plain_table(Text(f"{episode.file}: {episode.purpose} {episode.wall_utc[:19]} UTC"))
    table.add_column("check", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    table.add_column("finding")
    for verdict in episode.verdicts:
        colour = _COLOURS[verdict["severity"]]
        table.add_row(verdict["name"], f"[{colour}]{verdict['severity']}[/]", Text(verdict["message"]))
    offset, drift = _clock_texts(episode)
    table.add_row("clocks", "", f"host minus device {offset}, drift {drift}")
    console.print(table)


def _motion_table(excitation: Mapping[str, Any], description: Mapping[str, Any]) -> Table:
    """Return how far and how fast each joint moved, and how its targets changed."""
    from rich.text import Text

    names, actuated = description["joint_names"], description["actuated"]
    units = description.get("position_units") or [""] * len(names)
    table = _plain_table(Text("motion of each joint; speeds are in units per second"))
    table.add_column("joint")
    for column in (
        "unit",
        "moves by",
        "max speed",
        "RMS speed",
        "reversals",
        "target range",
        "target changes",
    ):
        table.add_column(column, justify="right")
    for joint, (name, unit) in enumerate(zip(names, units, strict=False)):
        cells = [f"{excitation[key][joint]:.3g}" for key in ("position_range", "speed_max", "speed_rms")]
        cells.append(str(excitation["reversals"][joint]))
        if name in actuated:
            target = actuated.index(name)
            cells += [f"{excitation['target_range'][target]:.3g}", str(excitation["target_changes"][target])]
        table.add_row(Text(name), unit, *cells)
    return table
