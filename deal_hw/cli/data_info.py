"""`deal-hw data info`: the contents of a dataset or an episode, as tables or JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.data.recording.dataset import REMOVED_FOLDER, Dataset
from deal_hw.data.recording.dataset_index import entry_of_episode
from deal_hw.data.recording.episode_info import EpisodeInfo, motion_of, summarize
from deal_hw.data.recording.removal import removed_numbers
from deal_hw.workflows.robot import carried_problems, carries_robot

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def print_info(path: Path, as_json: bool) -> None:
    """Print the contents of a dataset or an episode.

    Args:
        path: A dataset's folder, or an episode's file.
        as_json: Print JSON instead of tables.

    Raises:
        DatasetError: It is neither, or cannot be read.
    """
    from rich.console import Console

    console = Console()
    if not path.is_dir():
        _print_file(console, path, as_json)
        return
    notes: list[str] = []
    dataset = Dataset.open(path, notes.append)
    removed = removed_numbers(dataset.folder)
    if as_json:
        values = {
            "folder": str(dataset.folder),
            "robot": dataset.description["name"],
            "digest": dataset.digest,
            "carries_robot": carries_robot(dataset.folder),
            "episodes": [_values(episode, episode.left_out) for episode in dataset.episodes],
            "removed": removed,
            "notes": notes,
        }
        print(json.dumps(values, indent=2))
        return
    for note in notes:
        console.print(note, style="yellow", markup=False)
    console.print(_dataset_table(dataset))
    if carries_robot(dataset.folder):
        console.print(f"its robot: {dataset.folder / 'robot' / 'robot.yaml'}", markup=False)
    for problem in carried_problems(dataset.folder):
        console.print(problem, style="red", markup=False)
    for episode in dataset.episodes:
        _print_problems(console, episode)
        # Lines with a command are not wrapped: a path that is broken cannot be copied.
        if text := dataset.why_left_out(episode):
            console.print(text, style=_COLOURS["fail"], markup=False, soft_wrap=True)
        elif episode.failure:
            text = f"episode {episode.number} is kept: {episode.failure}"
            console.print(text, style=_COLOURS["warn"], markup=False, soft_wrap=True)
    if removed:
        console.print(
            f"removed: {', '.join(map(str, removed))}, to {dataset.folder / REMOVED_FOLDER}; to put back: "
            f"deal-hw data keep {dataset.folder} {removed[0]}",
            markup=False,
            soft_wrap=True,
        )


def _print_file(console: Console, path: Path, as_json: bool) -> None:
    # In a folder of a dataset, its index knows how the run ended.
    noted = entry_of_episode(path)
    episode, recorded = summarize(path, f"episodes/{path.name}" if noted is None else noted.file)
    left_out = "" if noted is None else noted.left_out
    if as_json:
        print(json.dumps(_values(episode, left_out), indent=2))
        return
    _print_episode(console, episode)
    if recorded is not None:
        console.print(_motion_table(episode.excitation or {}, recorded.description))
    if left_out:
        console.print(f"left out: {left_out}", style=_COLOURS["fail"], markup=False)


def _values(episode: EpisodeInfo, left_out: str) -> dict[str, Any]:
    """Return an entry as plain JSON values, with its number and why it is left out."""
    return {"number": episode.number, "left_out": left_out, **asdict(episode)}


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
            str(episode.number),
            Text(_motion(episode)),
            Text(episode.wall_utc[5:16].replace("T", " ")),
            f"{episode.duration_s:.1f}",
            str(episode.states),
            str(episode.commands),
            Text(_position_ranges(episode, dataset.description)),
            _state(episode),
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


def _state(episode: EpisodeInfo) -> str:
    """Return the worst check of an episode, and whether it is left out or kept."""
    if not episode.failure:
        return _worst(episode)
    return f"{'[red]left out[/]' if episode.left_out else '[yellow]kept[/]'}\n{_worst(episode)}"


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
