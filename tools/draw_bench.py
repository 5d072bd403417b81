"""Draw the figures of a bench again from its rows, without measuring.

    python tools/draw_bench.py docs/measured/loop_sensor.json docs/measured/loop_realistic.json

Each figure is written beside its rows, as a PNG of the same name.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from deal_hw.bench.figures import draw, draw_transfer
from deal_hw.bench.rows import load_rows


def draw_again(path: Path) -> Path | None:
    """Draw a file's figure and return it; None if every cell failed."""
    good = [row for row in load_rows(path) if not row["error"]]
    if not good:
        return None
    figure = path.with_suffix(".png")
    (draw_transfer if good[0].get("bench") == "transfer" else draw)(figure, good)
    return figure


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rows", type=Path, nargs="+", help="rows that `deal-hw bench --out` wrote (.json)")
    config = parser.parse_args()
    for path in config.rows:
        figure = draw_again(path)
        print(f"written: {figure}" if figure else f"{path}: every cell failed; there is nothing to draw")


if __name__ == "__main__":
    main()
