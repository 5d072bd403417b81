"""Compare two files of `deal-hw bench ... --out FILE.json`, cell by cell; exit 1 if the new one is worse.

    python tools/compare_rows.py docs/measured/tuning_cartpole_sensor.json new.json
    python tools/compare_rows.py old.json new.json --map eki=deal

A cell has one bench, task, parameter set (space), profile, demonstration, split, range ratio, method and
choice of refinement, with all its seeds. ``--map eki=deal`` compares a method of OLD with another one of NEW.
Some methods choose the refinement themselves (default, local, output-error, and those that ignore the data).
For these the row's refinement is not compared. Cells that only NEW has are named and not judged.

A cell is a loss if one of these holds. Figures are of the seeds that both files have without an error.

    missing     NEW lacks the cell, or a seed of it that OLD has without an error, or has an error there, or
                lacks a figure that OLD has.
    error       The median over seeds of `error_percent` or of `log_error_x100` is above 1.1 times the old one
                (--error-limit), and above the floor of 1e-3 (--error-floor): in percent, so 1e-5 of a value.
    held-out    The median over seeds of `heldout_nrmse_calibrated` is above 1.02 times the old one
                (--heldout-limit), and above the floor of 1e-5 (--heldout-floor), in shares of the signal's
                range. Real recordings: also `heldout_rmse_calibrated` and `heldout_pooled_calibrated`, in rad
                or m.
    coverage    The mean over seeds of `coverage90`, the share of parameters whose 90 % interval holds the
                truth, is below the old one and below --coverage-enough (by default 1). Or it is below 0.85
                (--coverage-least), if the model is right and the method claims intervals. The model is right
                except in profiles `realistic` and `real` and bench `mismatch`. Methods that claim intervals
                are `default`, `local`, `output-error` and those with refinement. Searches alone, baselines
                and no-data rows are compared with OLD only. Without a truth there is no coverage.

Alarms (seeds with one) and seconds (median) are shown. Seconds are judged with ``--seconds-limit`` only,
because only runs that were timed in turn on one machine can be compared. A seed that is much worse than it
was (twice, above the floor) is named, because a median hides one bad seed. Exit codes: 0 no loss, 1 a loss,
2 a file cannot be compared.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deal_hw.calib.pipeline.methods import NO_DATA_METHODS, divided
from deal_hw.ranges import option

WHOLE = frozenset({"default", "local", "output-error"})
"""Methods that choose the refinement themselves."""

KEY = (
    "bench",
    "task",
    "space",
    "profile",
    "demonstration",
    "demonstration_s",
    "checkpoint",
    "split",
    "range_ratio",
    "method",
    "refined",
)
MISSPECIFIED = frozenset({"realistic", "real"})
"""Profiles of robots with effects that the model lacks."""

ERRORS = ("error_percent", "log_error_x100")
HELDOUT = ("heldout_nrmse_calibrated", "heldout_rmse_calibrated", "heldout_pooled_calibrated")
MUCH_WORSE = 2.0

Key = tuple[str, ...]
Row = Mapping[str, Any]
Cells = dict[Key, dict[int, Row]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of a loss; ratios are new over old. The options have these names."""

    error_limit: float = 1.1
    error_floor: float = 1e-3
    heldout_limit: float = 1.02
    heldout_floor: float = 1e-5
    coverage_least: float = 0.85
    coverage_enough: float = 1.0
    seconds_limit: float | None = None


HELP = {
    "error_limit": "most a median parameter error may grow, new over old",
    "error_floor": "a median parameter error up to this is no loss [percent]",
    "heldout_limit": "most a median held-out error may grow, new over old",
    "heldout_floor": "a median held-out error up to this is no loss [nrmse, rad or m]",
    "coverage_least": "least coverage of 90 %% intervals where the model is right",
    "coverage_enough": "a coverage from this on is no loss, whatever the old one was",
    "seconds_limit": "most the median seconds may grow, new over old",
}
"""What each limit means."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """One cell of both files.

    Attributes:
        key: Its name.
        seeds: Number of compared seeds.
        figures: Name of a figure -> (old, new), each None if there is none.
        losses: Reasons why it is worse; empty if it is not.
        notes: Other remarks.
    """

    key: Key
    seeds: int
    figures: Mapping[str, tuple[float | None, float | None]]
    losses: tuple[str, ...]
    notes: tuple[str, ...]


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare two files, print the table and return the exit code."""
    given = _parser().parse_args(arguments)
    limits = Limits(**{name: getattr(given, name) for name in HELP})
    try:
        old, new = read_cells(given.old, dict(_pair(text) for text in given.map)), read_cells(given.new, {})
    except (OSError, ValueError) as err:
        print(f"compare_rows: {err}", file=sys.stderr)
        return 2
    compared = compare(old, new, limits)
    print_table(compared)
    for key in sorted(set(new) - set(old)):
        print(f"only in {given.new.name}: {cell_name(key)}")
    worse = [cell for cell in compared if cell.losses]
    print(f"\n{len(compared)} cells, {len(worse)} worse")
    return 1 if worse else 0


def _parser() -> argparse.ArgumentParser:
    default = Limits()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old", type=Path, metavar="OLD", help="rows before")
    parser.add_argument("new", type=Path, metavar="NEW", help="rows after")
    parser.add_argument(
        "--map", action="append", default=[], metavar="OLD=NEW",
        help="compare this method of OLD with that one of NEW; may be given again",
    )  # fmt: skip
    for name, text in HELP.items():
        value = getattr(default, name)
        shown = "not judged" if value is None else "%(default)s"
        parser.add_argument(option(name), type=float, default=value, help=f"{text} (default: {shown})")
    return parser


def _pair(text: str) -> tuple[str, str]:
    old, equals, new = text.partition("=")
    if not (old and equals and new):
        raise ValueError(f"--map {text!r}: give a method of OLD and one of NEW, such as eki=deal")
    return old, new


def read_cells(path: Path, methods: Mapping[str, str]) -> Cells:
    """Return the rows of a file by cell and seed.

    Args:
        path: A file of `deal-hw bench`.
        methods: Name of a method -> the name that it is compared under.

    Raises:
        ValueError: It is no such file, a row is no calibration's, or two rows have the same cell and seed.
    """
    values = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(values, dict) or not isinstance(values.get("rows"), list):
        raise ValueError(f"{path} has no rows; name a file that `deal-hw bench ... --out` wrote")
    cells: Cells = {}
    for number, row in enumerate(values["rows"]):
        if not isinstance(row, dict):
            raise ValueError(f"{path}: row {number} is no object")
        if lacking := [name for name in ("bench", "task", "method", "seed") if name not in row]:
            raise ValueError(
                f"{path}: row {number} has no {lacking[0]!r}, so it is not of a calibration bench"
            )
        seeds = cells.setdefault(cell_key(row, methods), {})
        if row["seed"] in seeds:
            name = cell_name(cell_key(row, methods))
            raise ValueError(
                f"{path} has two rows for seed {row['seed']} of {name}; keep one, or put methods "
                "that are mapped to one name into files of their own"
            )
        seeds[row["seed"]] = row
    return cells


def whole(method: str) -> bool:
    """Return whether a method, also with its search's name, chooses the refinement itself."""
    return divided(method)[0] in WHOLE


def cell_key(row: Row, methods: Mapping[str, str]) -> Key:
    """Return the name of a row's cell, as texts in the order of `KEY`; "" if one does not apply."""
    method = methods.get(str(row["method"]), str(row["method"]))
    optional = not whole(method) and method not in NO_DATA_METHODS
    known = {
        **{name: str(row.get(name, "")) for name in KEY},
        "demonstration": str(row.get("demonstration", "excite")),
        "demonstration_s": f"{float(row.get('demonstration_s', 4.0)):g}" if "task" in row else "",
        "range_ratio": f"{float(row['range_ratio']):g}" if row.get("range_ratio") is not None else "",
        "method": method,
        "refined": "refined" if row.get("refined") and optional else "",
    }
    return tuple(known[name] for name in KEY)


def cell_name(key: Key) -> str:
    """Return a cell's short name for a reader: only unusual settings, in one line."""
    known = dict(zip(KEY, key, strict=True))
    known["demonstration"] = "" if known["demonstration"] == "excite" else known["demonstration"]
    known["demonstration_s"] = (
        "" if known["demonstration_s"] in ("", "4") else known["demonstration_s"] + " s"
    )
    known["range_ratio"] = f"ratio {known['range_ratio']}" if known["range_ratio"] else ""
    return " ".join(text for text in known.values() if text)


def compare(old: Cells, new: Cells, limits: Limits) -> list[Comparison]:
    """Return the comparison of every cell of OLD, in the order of their names."""
    return [compare_cell(key, old[key], new.get(key), limits) for key in sorted(old)]


def compare_cell(
    key: Key, old: Mapping[int, Row], new: Mapping[int, Row] | None, limits: Limits
) -> Comparison:
    """Compare one cell; `new` is None if there is none."""
    done = [seed for seed in sorted(old) if not old[seed].get("error")]
    notes = [f"seed {seed} had an error in OLD: not compared" for seed in sorted(old) if seed not in done]
    if new is None:
        return Comparison(key=key, seeds=0, figures={}, losses=("missing in NEW",), notes=tuple(notes))
    losses = [f"seed {seed} is missing in NEW" for seed in done if seed not in new]
    losses += [
        f"seed {seed}: {new[seed]['error']}" for seed in done if seed in new and new[seed].get("error")
    ]
    shared = [seed for seed in done if seed in new and not new[seed].get("error")]
    before, after = [old[seed] for seed in shared], [new[seed] for seed in shared]

    for name in (*ERRORS, *HELDOUT, "coverage90"):
        lacking = [s for s in shared if old[s].get(name) is not None and new[s].get(name) is None]
        losses += [f"{name} is missing in NEW for seed {seed}" for seed in lacking]
    figures = {name: (_median(before, name), _median(after, name)) for name in (*ERRORS, *HELDOUT, "seconds")}
    figures["coverage90"] = (_mean(before, "coverage90"), _mean(after, "coverage90"))
    figures["flagged"] = (_flagged(before), _flagged(after))

    for names, limit, floor in (
        (ERRORS, limits.error_limit, limits.error_floor),
        (HELDOUT, limits.heldout_limit, limits.heldout_floor),
    ):
        for name in names:
            was, now = figures[name]
            if was is not None and now is not None and not now <= max(limit * was, floor):
                losses.append(f"median {name} {was:.4g} -> {now:.4g}, more than {limit:g} times")
        notes += _bad_seeds(names[0], shared, old, new, floor)
    losses += _coverage_losses(key, *figures["coverage90"], limits)
    was, now = figures["seconds"]
    if (
        limits.seconds_limit is not None
        and was is not None
        and now is not None
        and now > limits.seconds_limit * was
    ):
        losses.append(f"median seconds {was:.1f} -> {now:.1f}, more than {limits.seconds_limit:g} times")
    return Comparison(key=key, seeds=len(shared), figures=figures, losses=tuple(losses), notes=tuple(notes))


def _coverage_losses(key: Key, was: float | None, now: float | None, limits: Limits) -> Iterator[str]:
    known = dict(zip(KEY, key, strict=True))
    if now is None:
        return
    # Means of the same shares in another order differ in their last digits.
    if was is not None and not now >= min(was, limits.coverage_enough) - 1e-9:
        yield f"coverage {was:.3f} -> {now:.3f}"
    right = known["profile"] not in MISSPECIFIED and known["bench"] != "mismatch"
    claims = whole(known["method"]) or bool(known["refined"])
    if right and claims and not now >= limits.coverage_least - 1e-9:
        yield f"coverage {now:.3f} is below {limits.coverage_least:g} though the model is right"


def _bad_seeds(
    name: str, shared: Sequence[int], old: Mapping[int, Row], new: Mapping[int, Row], floor: float
) -> Iterator[str]:
    for seed in shared:
        was, now = old[seed].get(name), new[seed].get(name)
        if was is not None and now is not None and not now <= max(MUCH_WORSE * was, floor):
            yield f"seed {seed}: {name} {was:.4g} -> {now:.4g}"


def _values(rows: Sequence[Row], name: str) -> list[float]:
    return [float(row[name]) for row in rows if row.get(name) is not None]


def _median(rows: Sequence[Row], name: str) -> float | None:
    values = _values(rows, name)
    # A value that is no number counts as the worst, because a median cannot order it.
    return statistics.median(math.inf if math.isnan(value) else value for value in values) if values else None


def _mean(rows: Sequence[Row], name: str) -> float | None:
    values = _values(rows, name)
    return statistics.fmean(values) if values else None


def _flagged(rows: Sequence[Row]) -> float | None:
    return float(sum(bool(row.get("alarms")) for row in rows))


def print_table(compared: Sequence[Comparison]) -> None:
    """Print one line for each cell, then losses and notes."""
    width = max((len(cell_name(cell.key)) for cell in compared), default=4)
    print(
        f"{'':5s} {'cell':{width}s} seeds  {'error [%]: old, new, ratio':26s}  "
        f"{'held-out: old, new, ratio':26s}  {'coverage':11s}  {'alarms':6s}  seconds"
    )
    for cell in compared:
        coverage = "/".join(_number(value, ".3f") for value in cell.figures.get("coverage90", (None, None)))
        alarms = "/".join(_number(value, ".0f") for value in cell.figures.get("flagged", (None, None)))
        seconds = "/".join(_number(value, ".1f") for value in cell.figures.get("seconds", (None, None)))
        print(
            f"{'WORSE' if cell.losses else '':5s} {cell_name(cell.key):{width}s} {cell.seeds:5d}  "
            f"{_ratio(cell, 'error_percent'):26s}  {_ratio(cell, 'heldout_nrmse_calibrated'):26s}  "
            f"{coverage:11s}  {alarms:6s}  {seconds}"
        )
    for cell in compared:
        if cell.losses or cell.notes:
            print(f"\n{cell_name(cell.key)}")
            print(
                "\n".join([f"  worse: {text}" for text in cell.losses] + [f"  {text}" for text in cell.notes])
            )


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _ratio(cell: Comparison, name: str) -> str:
    was, now = cell.figures.get(name, (None, None))
    ratio = now / was if was and now is not None else None
    return f"{_number(was, '.3g'):>9s} {_number(now, '.3g'):>9s} {_number(ratio, '.2f'):>6s}"


if __name__ == "__main__":
    sys.exit(main())
