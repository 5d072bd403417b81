"""Feed damaged and hostile inputs to every reader, and count the results.

Each input must be read or refused with one of our errors, in one line, in bounded time and memory. Any other
result is a failure: it is printed with its number, and the exit code is 1. Input n of a seed is always the
same:

    python tools/fuzz_files.py --kind mcap --count 100000 --seed 0
    python tools/fuzz_files.py --kind mcap --seed 0 --only 4711     # one input again, its traceback in full
    python tools/fuzz_files.py --list

The kinds are tables, one module a group in ``tools/fuzz/``: add a module with ``KINDS`` and its name to
``GROUPS``.
"""

from __future__ import annotations

import importlib
import sys
import time
import warnings
from pathlib import Path

from fuzz.kind import FileKind, Kind
from fuzz.run import make_input, run
from measuring import parser

GROUPS = ("recordings", "wire", "cartpole_wires", "feetech_wires", "calibration")


def kinds() -> dict[str, Kind]:
    """Return every kind by its name.

    Raises:
        ValueError: Two groups have a kind of the same name.
    """
    found: dict[str, Kind] = {}
    for group in GROUPS:
        table: dict[str, Kind] = importlib.import_module(f"fuzz.{group}").KINDS
        if double := found.keys() & table.keys():
            raise ValueError(f"fuzz/{group}.py names {', '.join(double)} again")
        found.update(table)
    return found


def main() -> int:
    options = parser(__doc__, out=False)
    options.add_argument("--kind", action="append", help="a kind of input; may be repeated (default: all)")
    options.add_argument("--count", type=int, default=1000, help="inputs of each kind")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--only", type=int, help="read this one input, without guards")
    options.add_argument("--limit-s", type=float, default=10.0, help="processor time for one input [s]")
    options.add_argument("--limit-mb", type=int, default=1024, help="memory for one input [MiB]")
    options.add_argument("--list", action="store_true", help="name the kinds and end")
    given = options.parse_args()
    warnings.simplefilter("ignore")
    table = kinds()
    if given.list:
        print("\n".join(table))
        return 0
    failed = False
    for name in given.kind or table:
        if name not in table:
            options.error(f"no kind {name!r}; there are {', '.join(table)}")
        if given.only is not None:
            _only(table[name], given.seed, given.only)
            continue
        start_s = time.perf_counter()
        found = run(table[name], given.count, given.seed, given.limit_s, given.limit_mb << 20)
        elapsed_s = time.perf_counter() - start_s
        print(f"{name}: {found.pop('read')} read, {found.pop('refused')} refused, {elapsed_s:.0f} s")
        for what, times in found.most_common():
            print(f"    {times} x {what}")
        failed = failed or bool(found)
    return int(failed)


def _only(kind: Kind, seed: int, number: int) -> None:
    """Read one input in this process, in a folder that stays."""
    folder = Path(f"fuzz-{seed}-{number}")
    if isinstance(kind, FileKind):
        (folder / "make").mkdir(parents=True)
        path = folder / "read" / kind.name
        path.parent.mkdir(parents=True)
        path.write_bytes(make_input(kind, list(kind.make(folder / "make")), seed, number))
        print(f"input {number}: {path}")
        print(kind.read(path))
    else:
        data = make_input(kind, list(kind.make()), seed, number)
        print(f"input {number}: {data.hex()}")
        print(kind.read(data))


if __name__ == "__main__":
    sys.exit(main())
