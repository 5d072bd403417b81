"""Make stored rows of `deal-hw bench` again and compare them, bit for bit or by what counts as a loss.

    python tools/remake_rows.py docs/measured/*.json --longest 60 --each 2 --folder remade
    python tools/remake_rows.py docs/measured/speed.json --list      # the commands only

For a change that must not alter results: make rows at the old commit, then at the new one, and compare the
folders. ``--python`` is the interpreter of the old checkout, ``--against`` the folder of its rows. Without it
each row is compared with the stored one, which may be of a much older commit; then a row that differs is only
judged by `compare_rows`.

Of each file the cheapest rows are made again, at most ``--each``, of different methods, tasks and faults as
far as there are; rows below a second come last, as most of them try no search. Left out are rows with an
error, rows that took longer than ``--longest`` [s], and rows that need a file that is not in the repository
(recordings, policies); these are counted.

Verdicts:
    same      every figure has the same bits. Times, loads, commits and commands are no figures.
    agrees    figures differ, and `compare_rows` calls none of it a loss.
    LOSS      `compare_rows` says what is worse.
    failed    the command ended with an error, which is shown.

Exit code: 0 if no row is a loss or failed, 1 otherwise.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import compare_rows
from measuring import Row, parser, read_rows

from deal_hw.bench.rows import load_rows
from deal_hw.bench.settings import BENCHES

OPTIONS = {
    "seed": "--seeds",
    "task": "--task",
    "method": "--methods",
    "range_ratio": "--range-ratio",
    "space": "--space",
    "profile": "--profile",
    "demonstration": "--demonstration",
    "demonstration_s": "--demonstration-seconds",
    "population": "--population",
    "generations": "--generations",
}
"""Fields of rows, and the options that give them."""
PROBLEMS = {"seed": "--seeds", "task": "--problems", "fault": "--faults"}
"""The same for benches of several small robots."""
NO_FIGURES = ("second", "cpu", "load", "bare_step", "commit", "command")
"""Parts of names of fields that a seed does not decide: times, and where they come from."""
RATIOS_OF_TIMES = frozenset({"ratio", "seconds_ratio", "cpu_ratio"})


@dataclass(frozen=True)
class Remake:
    """A row that is made again.

    Attributes:
        name: Name of its file, without its end.
        stored: The row.
        command: Arguments after `deal-hw`, without ``--out``.
    """

    name: str
    stored: Row
    command: tuple[str, ...]

    def cell(self) -> str:
        """Return bench, task, method or fault, ratio and seed."""
        names = ("bench", "task", "method", "fault", "range_ratio", "seed")
        return " ".join(f"{self.stored[name]}" for name in names if self.stored.get(name, "") != "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the rows, print a line each; return the exit code."""
    options = _parser().parse_args(arguments)
    found, left = choose(options.files, options.longest, options.each)
    print(f"{len(found)} rows of {len({one.name for one in found})} files", end="")
    print(f", {math.fsum(_seconds(one.stored) for one in found):.0f} s when they were stored", end="")
    print("".join(f"; {count} {why}" for why, count in sorted(left.items())), flush=True)
    if options.list:
        print(*(" ".join(["deal-hw", *one.command]) for one in found), sep="\n")
        return 0
    verdicts: Counter[str] = Counter()
    for number, one in enumerate(found):
        verdict, why = _remade(
            one, options.folder / f"{one.name}_{number}.json", options.python, options.against
        )
        verdicts[verdict] += 1
        print(f"{number + 1}/{len(found)} {verdict:6} {one.name}: {one.cell()} {why}".rstrip(), flush=True)
    print(", ".join(f"{count} {verdict}" for verdict, count in verdicts.items()))
    return 1 if verdicts["LOSS"] or verdicts["failed"] else 0


def _parser() -> argparse.ArgumentParser:
    made = parser(__doc__, out=False)
    made.add_argument("files", type=Path, nargs="+", metavar="FILE", help="files of rows")
    made.add_argument("--longest", type=float, default=300.0, help="longest time of a row [s] (default: 300)")
    made.add_argument("--each", type=int, default=2, help="most rows of a file (default: 2)")
    made.add_argument("--folder", type=Path, default=Path("remade"), help="for the new rows")
    made.add_argument("--against", type=Path, metavar="FOLDER", help="compare with the rows in this folder")
    made.add_argument("--python", default=sys.executable, help="interpreter that runs the benches")
    made.add_argument("--list", action="store_true", help="print the commands, make nothing")
    return made


def choose(files: Sequence[Path], longest: float, each: int) -> tuple[list[Remake], Counter[str]]:
    """Return the rows to make, and how many are left out, by reason."""
    left: Counter[str] = Counter()
    found: list[Remake] = []
    for path in files:
        document = json.loads(path.read_text(encoding="utf-8"))
        rows = document.get("rows", []) if isinstance(document, dict) else []
        able = []
        for row in rows:
            why = _left_out(row, longest)
            left[why] += bool(why)
            if not why:
                able.append(row)
        argv = [str(word) for word in document.get("argv", [])] if able else []
        found += [Remake(path.stem, row, command(row, argv)) for row in _varied(able)[:each]]
    return found, +left


def _left_out(row: Row, longest: float) -> str:
    if row.get("bench") not in BENCHES:
        return "of other programs"
    if (
        row["bench"] in ("real", "go2-codec")
        or row.get("checkpoint")
        or row.get("base")
        or row.get("skipped")
    ):
        return "that need files or a device, or are times"
    if row["error"]:
        return "with an error"
    return "that take longer" if _seconds(row) > longest else ""


def _seconds(row: Row) -> float:
    """Return all time [s] of a row that is noted."""
    return math.fsum(
        value for name, value in row.items() if "seconds" in name and isinstance(value, (int, float))
    )


def _varied(rows: Sequence[Row]) -> list[Row]:
    """Return rows with the cheapest of each kind first, then the second of each kind, and so on."""

    def kind(row: Row) -> tuple[str, ...]:
        return tuple(str(row.get(name)) for name in ("bench", "task", "method", "fault"))

    kinds: dict[tuple[str, ...], list[Row]] = {}
    for row in sorted(rows, key=lambda row: (_seconds(row) < 1, _seconds(row))):
        kinds.setdefault(kind(row), []).append(row)
    turns = itertools.zip_longest(*kinds.values())
    return [row for turn in turns for row in turn if row is not None]


def command(row: Row, argv: Sequence[str]) -> tuple[str, ...]:
    """Return the command of one row: that of its file, with the row's own values.

    Args:
        row: The stored row.
        argv: The stored command of the file, with the program before it. Words before the first option are
            not used: the bench is the row's.
    """
    settings = BENCHES[row["bench"]]
    known = {f"--{one.name.replace('_', '-')}" for one in fields(settings)}
    names = PROBLEMS if "--problems" in known else OPTIONS
    given = {option: [str(row[name])] for name, option in names.items() if row.get(name, "") != ""}
    if row.get("fault") == "":
        given["--faults"] = ["none"]
    words = {option: values for option, values in _options(argv) if option.replace("--no-", "--") in known}
    words = {**words, **{option: values for option, values in given.items() if option in known}}
    if row.get("refined") and not compare_rows.whole(str(row["method"])) and "--refine-all" in known:
        words["--refine-all"] = []
    words |= {"--threads": ["1"], "--quiet": []}
    words.pop("--out", None)
    listed = [[option, *values] for option, values in words.items()]
    return ("bench", str(row["bench"]), *itertools.chain.from_iterable(listed))


def _options(argv: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    starts = [number for number, word in enumerate(argv) if word.startswith("--")]
    for start, end in itertools.pairwise([*starts, len(argv)]):
        yield argv[start], list(argv[start + 1 : end])


def _remade(one: Remake, out: Path, python: str, against: Path | None) -> tuple[str, str]:
    out.parent.mkdir(parents=True, exist_ok=True)
    words = [str(Path(python).absolute()), "-m", "deal_hw", *one.command, "--out", out.name]
    # Python looks for modules in the current folder first: that must not be a checkout of another commit.
    done = subprocess.run(words, cwd=out.parent, capture_output=True, text=True, check=False)
    if not out.is_file():
        return "failed", (done.stderr.strip() or done.stdout.strip())[-300:]
    [row] = load_rows(out)
    if row["error"]:
        return "failed", str(row["error"])
    if against is None:
        return judge(one.stored, row)
    path = against / out.name
    return judge(read_rows(path)[0], row) if path.is_file() else ("failed", f"{path} is missing")


def judge(old: Row, new: Row) -> tuple[str, str]:
    """Return the verdict about a row that was made again, and what it rests on."""
    names = [name for name in sorted(old.keys() | new.keys()) if is_figure(name)]
    other = [name for name in names if not _equal(old.get(name), new.get(name))]
    if not other:
        return "same", ""
    shown = ", ".join(f"{name} {_short(old.get(name))} -> {_short(new.get(name))}" for name in other[:6])
    if old.get("colour") != new.get("colour") or old.get("named") != new.get("named"):
        return "LOSS", shown
    if "method" not in old or "error_percent" not in old:
        return "agrees", shown
    [compared] = compare_rows.compare(_cells(old), _cells(new), compare_rows.Limits())
    return ("LOSS", "; ".join(compared.losses)) if compared.losses else ("agrees", shown)


def is_figure(name: str) -> bool:
    """Return whether a field of a row is a result that a seed decides."""
    timed = name in RATIOS_OF_TIMES or name.endswith("_s") or any(part in name for part in NO_FIGURES)
    return not timed


def _cells(row: Row) -> compare_rows.Cells:
    return {compare_rows.cell_key(row, {}): {int(row["seed"]): row}}


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return one == other or (math.isnan(one) and math.isnan(other))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_equal(one[name], other[name]) for name in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_equal, one, other))
    return bool(one == other)


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else f"{value}"[:40]


if __name__ == "__main__":
    sys.exit(main())
