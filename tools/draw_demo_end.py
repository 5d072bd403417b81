"""Draw the end of `deal-hw demo` as the terminal shows it, from its run folder.

deal-hw demo --out runs/demo
python tools/draw_demo_end.py runs/demo --out docs/images/demo-end.svg
"""

from __future__ import annotations

import argparse
import io
import json
import re
from pathlib import Path

from rich.console import Console
from rich.terminal_theme import DEFAULT_TERMINAL_THEME

from deal_hw.calibration import read_result
from deal_hw.cli.demo import END_WIDTH, print_end


def draw(run: Path) -> str:
    """Return the picture of a run folder's end, as SVG."""
    console = Console(width=END_WIDTH, record=True, file=io.StringIO(), force_terminal=True)
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    print_end(console, summary, read_result(run / "calibration"), run)
    picture = console.export_svg(title="deal-hw demo", theme=DEFAULT_TERMINAL_THEME, unique_id="demo")
    # Rich names fonts on another host; the docs load nothing from there.
    return re.sub(r"@font-face \{.*?\}", "", picture, flags=re.DOTALL)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="run folder of `deal-hw demo`")
    parser.add_argument("--out", type=Path, required=True, help="picture to write (.svg)")
    config = parser.parse_args()
    config.out.write_text(draw(config.run), encoding="utf-8")


if __name__ == "__main__":
    main()
