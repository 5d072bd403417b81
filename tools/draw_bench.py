"""Draw the figures of a bench again from its rows, without measuring.

    python tools/draw_bench.py docs/measured/loop_sensor.json docs/measured/loop_realistic.json
    python tools/draw_bench.py docs/measured/searches_sensor.json --name deal-paper=deal-paper-replay

Each figure is written beside its rows, as a PNG of the same name. Methods of older rows get their present
names, as in compare_rows.py.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from compare_rows import METHODS

from deal_hw.bench.figures import draw
from deal_hw.bench.rows import load_rows


def draw_again(path: Path, names: Mapping[str, str]) -> Path | None:
    """Draw a file's figure and return it; None if every cell failed.

    Args:
        path: The rows.
        names: Present names of methods, by those in the rows.
    """
    rows = [row | {"method": names.get(row["method"], row["method"])} for row in load_rows(path)]
    good = [row for row in rows if not row["error"]]
    if not good:
        return None
    figure = path.with_suffix(".png")
    draw(figure, good)
    return figure


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rows", type=Path, nargs="+", help="rows that `deal-hw bench --out` wrote (.json)")
    parser.add_argument(
        "--name", nargs="+", default=[], metavar="OLD=NEW", help="draw a method by another name"
    )
    config = parser.parse_args()
    pairs = [text.partition("=") for text in config.name]
    if wrong := [old for old, _, new in pairs if not (old and new)]:
        parser.error(
            f"--name {wrong[0]}: give a method of the rows and its name, such as deal-paper=deal-paper-replay"
        )
    for path in config.rows:
        figure = draw_again(path, METHODS | {old: new for old, _, new in pairs})
        print(f"written: {figure}" if figure else f"{path}: every cell failed; there is nothing to draw")


if __name__ == "__main__":
    main()
