"""The figure of the transfer bench: returns in the target by method, and the Go2's speeds over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.bench.figures import DPI, HEIGHT, MARK_HEIGHT, WIDTH
from deal_hw.errors import MissingExtraError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = Mapping[str, Any]

COLOURS = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7")
"""Of methods, after Okabe and Ito (2008)."""


def draw_transfer(path: Path, rows: Sequence[Row]) -> None:
    """Draw a panel for each task, and two with the speeds of the Go2 of the first seed, if there is one.

    Args:
        path: The PNG.
        rows: Rows without errors, at least one.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as err:
        raise MissingExtraError("matplotlib", "bench") from err
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    walked = [row for row in rows if "speed" in row]
    walked = [row for row in walked if row["seed"] == walked[0]["seed"]]
    axes_names = ("x", "y") if walked else ()
    count = len(tasks) + len(axes_names)
    columns = min(count, 2)
    lines = -(-count // columns)
    height = HEIGHT + MARK_HEIGHT * len({row["method"] for row in rows})
    figure = Figure(figsize=(WIDTH * columns, max(height, 3.0) * lines), layout="constrained", dpi=DPI)
    places = [figure.add_subplot(lines, columns, number + 1) for number in range(count)]
    for task, axes in zip(tasks, places, strict=False):
        _returns(axes, task, [row for row in rows if row["task"] == task])
    for axis, axes in zip(axes_names, places[len(tasks) :], strict=True):
        _speeds(axes, axis, walked)
    figure.savefig(path, dpi=DPI)


def _returns(axes: Axes, task: str, rows: Sequence[Row]) -> None:
    """Draw a line for each method: each seed, the mean, and from the worst seed to the best."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for place, method in enumerate(methods):
        values = np.array([row["return"] for row in rows if row["method"] == method])
        axes.plot(values, np.full(len(values), place), "o", ms=4, alpha=0.4, color="#0072b2", mec="none")
        mean = float(values.mean())
        bars = [[mean - values.min()], [values.max() - mean]]
        axes.errorbar(mean, place, xerr=bars, fmt="o", ms=7, color="#0072b2", capsize=4)
    base = float(np.mean(list({row["seed"]: row["return_base"] for row in rows}.values())))
    axes.axvline(base, ls="--", lw=1, color="0.4", label="base policy, not fine-tuned")
    axes.set_yticks(range(len(methods)), methods)
    axes.set_ylim(len(methods) - 0.4, -0.6)
    axes.set_xlabel("return in the target")
    steps = "/".join(f"{n}" for n in sorted({row["train_steps"] for row in rows}))
    seeds = len({row["seed"] for row in rows})
    what = "1 seed" if seeds == 1 else f"mean, worst and best of {seeds} seeds"
    axes.set_title(f"{task}: {steps} steps of fine-tuning\n{what}", fontsize=10)
    axes.grid(axis="x", color="0.9", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, loc="best")


def _speeds(axes: Axes, axis: str, rows: Sequence[Row]) -> None:
    """Draw commanded and true speeds of a method's robots over time."""
    first = rows[0]["speed"]
    axes.step(first["time_s"], first[f"wanted_{axis}_m_s"], where="mid", color="0.6", lw=3, label="commanded")
    for number, row in enumerate(rows):
        colour = COLOURS[number % len(COLOURS)]
        axes.plot(row["speed"]["time_s"], row["speed"][f"{axis}_m_s"], color=colour, label=row["method"])
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"speed in {axis} [m/s]")
    axes.set_title(f"go2, seed {rows[0]['seed']}: speed in {axis}, mean of the robots", fontsize=10)
    axes.grid(color="0.9", lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, ncols=2)
