"""Figures of benches: methods' errors beside no-data baselines, policies' errors, and returns in a target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deal_hw.bench.tables import method_name
from deal_hw.calib.pipeline.methods import NO_DATA_METHODS
from deal_hw.errors import MissingExtraError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = Mapping[str, Any]

POLICIES = {
    "udr": "uniform\nrandomisation",
    "retrained": "the calibrated\ndistribution",
    "oracle": "the truth",
}
"""The distribution of a policy's training, by the end of its fields' names."""


COLORS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Of range ratios, after Okabe and Ito (2008): distinct with any colour vision."""
MARKERS: Final = ("o", "s", "^", "D")
"""Of the same, for print without colours."""
SMALLEST: Final = 1e-3
"""Smallest drawn parameter error: an exact result has no place on a log scale."""
DECADES: Final = 10.0
"""Ratio of an axis's values above which it is logarithmic."""
WIDTH: Final = 5.6
"""Of a panel [inches]."""
HEIGHT: Final = 1.5
"""Of a panel's title and labels [inches]."""
MARK_HEIGHT: Final = 0.5
"""Additional height per method [inches]."""
DPI: Final = 110
"""Of the PNG."""
LINE_COLORS: Final = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7")
"""Of methods in lines over time, after the same source."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Panel:
    """One panel.

    Attributes:
        title: Name of the calibrated robot.
        field: The drawn field of a row.
        label: Label of the axis of values.
        mark: Meaning of a mark, with the range ratio.
        rows: The rows.
        baselines: Fields of the no-data baselines, by name.
        floor: Smallest drawn value.
    """

    title: str
    field: str
    label: str
    mark: str
    rows: Sequence[Row]
    baselines: Mapping[str, str]
    floor: float = 0.0

    def values(self, rows: Sequence[Row], field: str) -> Any:
        """Return a field of the rows that have it."""
        known = [row[field] for row in rows if row.get(field) is not None]
        return np.maximum(np.array(known, dtype=float), self.floor)


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw the rows of a bench: a panel for each task and profile, and one for policies, if there are any.

    Without any value (every prediction diverged), nothing is drawn.

    Args:
        path: The PNG.
        rows: Rows without errors, at least one.
    """
    panels = _panels(rows)
    trained = [row for row in rows if "angle_error_retrained" in row]
    count = len(panels) + bool(trained)
    if not count:
        return
    columns = min(count, 2)
    lines = -(-count // columns)
    marks = max(len({method_name(row) for row in rows}), len(POLICIES))
    height = HEIGHT + MARK_HEIGHT * marks
    figure = _figure()(figsize=(WIDTH * columns, height * lines), layout="constrained")
    places = [figure.add_subplot(lines, columns, number + 1) for number in range(count)]
    ratios = sorted({float(row["range_ratio"]) for row in rows})
    for panel, axes in zip(panels, places, strict=False):
        _methods(axes, panel, ratios)
    if trained:
        _policies(places[-1], trained)
    # One legend for all panels: a colour has the same meaning in each.
    named = [pair for axes in places for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    legend = {label: handle for handle, label in sorted(named, key=lambda pair: "no data" in pair[1])}
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=columns + 1, fontsize=9)
    figure.savefig(path, dpi=DPI)


def _figure() -> Any:
    """Return matplotlib's class of figures, which is an extra."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as err:
        raise MissingExtraError("matplotlib", "bench") from err
    return Figure


def _panels(rows: Sequence[Row]) -> list[_Panel]:
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.get("task", "cartpole"), row.get("split") or row["profile"]), []).append(row)
    panels = []
    for (task, what), part in found.items():
        if part[0]["bench"] == "real":
            panel = _Panel(
                title=f"{task}, held out: {what}",
                field="heldout_rmse_calibrated",
                label="held-out RMSE [rad or m]",
                mark="calibrated model",
                rows=part,
                baselines={"nominal model": "heldout_rmse_nominal", "nothing moves": "heldout_rmse_null"},
            )
        else:
            panel = _Panel(
                title=f"{task}, profile {what}",
                field="log_error_x100",
                label="100 x mean |ln(estimate / truth)|",
                mark="range ratio {:g}",
                rows=part,
                baselines={"midpoint of the range": "null_log_error_x100"},
                floor=SMALLEST,
            )
        if panel.values(part, panel.field).size:
            panels.append(panel)
    return panels


def _methods(axes: Axes, panel: _Panel, ratios: Sequence[float]) -> None:
    """Draw a line for each method, with its range ratios below each other."""
    names = list(dict.fromkeys(method_name(row) for row in panel.rows))
    numbers = set()
    for r, ratio in enumerate(ratios):
        color, marker = COLORS[r % len(COLORS)], MARKERS[r % len(MARKERS)]
        shift = 0.6 * ((r + 0.5) / len(ratios) - 0.5)
        mine = [row for row in panel.rows if row["range_ratio"] == ratio]
        word = panel.mark.format(ratio)
        for m, name in enumerate(names):
            values = panel.values([row for row in mine if method_name(row) == name], panel.field)
            if values.size:
                numbers.add(values.size)
                _spread(axes, m + shift, values, color, marker, word)
        for line, (baseline, field) in enumerate(panel.baselines.items()):
            if (values := panel.values(mine, field)).size:
                style, of = ("--", ":")[line % 2], f", {word}" if len(ratios) > 1 else ""
                axes.axvline(
                    np.median(values), color=color, ls=style, lw=1, label=f"{baseline}{of} (no data)"
                )
    marked = [f"{name}\n(no data)" if name in NO_DATA_METHODS else name for name in names]
    axes.set_yticks(range(len(names)), marked)
    axes.set_ylim(len(names) - 0.4, -0.6)
    cut = panel.floor and min(panel.values(panel.rows, panel.field)) <= panel.floor
    _finish(
        axes, panel.title, numbers, f"{panel.label}{f' (at least {panel.floor:g})' * bool(cut)}", "method"
    )


def _policies(axes: Axes, rows: Sequence[Row]) -> None:
    """Draw the pole's mean angle by policy; a thin line joins those of one robot."""
    table = np.array([[row[f"angle_error_{name}"] for name in POLICIES] for row in rows], dtype=float)
    axes.plot(table.T, range(len(POLICIES)), color="0.7", lw=0.8, zorder=0)
    for m, values in enumerate(table.T):
        _spread(axes, m, values, "black", "o", "_")
    axes.set_yticks(range(len(POLICIES)), list(POLICIES.values()))
    axes.set_ylim(len(POLICIES) - 0.6, -0.4)
    _finish(axes, "policies on the robot", {len(rows)}, "mean |pole angle| [rad]", "trained under")


def _spread(axes: Axes, y: float, values: Any, color: str, marker: str, label: str) -> None:
    """Draw each seed, and the median with a bar from the smallest to the largest."""
    axes.plot(values, np.full(len(values), y), marker, ms=4, alpha=0.35, color=color, mec="none")
    middle = float(np.median(values))
    axes.errorbar(
        middle,
        y,
        xerr=[[middle - values.min()], [values.max() - middle]],
        fmt=marker,
        ms=7,
        color=color,
        capsize=4,
        label=label,
    )


def _finish(axes: Axes, title: str, numbers: set[int], label: str, upwards: str) -> None:
    """Label the axes, and give the number of seeds."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axes.dataLim.intervalx
    if low > 0 and high / low > DECADES:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high / low > 100 else (1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_xlim(left=0)
    seeds = f"{min(numbers)} to {max(numbers)} seeds" if len(numbers) > 1 else f"{max(numbers)} seeds"
    what = "1 seed" if numbers == {1} else f"median, smallest, largest of {seeds}"
    axes.set_title(f"{title}\n{what}", fontsize=10)
    axes.set_xlabel(label)
    axes.set_ylabel(upwards)
    axes.grid(axis="x", color="0.9", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def draw_transfer(path: Path, rows: Sequence[Row]) -> None:
    """Draw a panel for each task, and two with the speeds of the Go2 of the first seed, if there is one.

    Args:
        path: The PNG.
        rows: Rows without errors, at least one.
    """
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    walked = [row for row in rows if "speed" in row]
    walked = [row for row in walked if row["seed"] == walked[0]["seed"]]
    axes_names = ("x", "y") if walked else ()
    count = len(tasks) + len(axes_names)
    columns = min(count, 2)
    lines = -(-count // columns)
    height = HEIGHT + MARK_HEIGHT * len({row["method"] for row in rows})
    figure = _figure()(figsize=(WIDTH * columns, max(height, 3.0) * lines), layout="constrained", dpi=DPI)
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
        color = LINE_COLORS[number % len(LINE_COLORS)]
        axes.plot(row["speed"]["time_s"], row["speed"][f"{axis}_m_s"], color=color, label=row["method"])
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"speed in {axis} [m/s]")
    axes.set_title(f"go2, seed {rows[0]['seed']}: speed in {axis}, mean of the robots", fontsize=10)
    axes.grid(color="0.9", lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, ncols=2)
