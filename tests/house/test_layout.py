"""The picture of the layout in the documentation."""

from __future__ import annotations

from pathlib import Path

from draw_layout import draw

ROOT = Path(__file__).resolve().parents[2]


def test_the_committed_picture_is_drawn_from_this_tree() -> None:
    """After a change of folders, or of imports between them, somebody has to run the command again."""
    committed = (ROOT / "docs" / "images" / "layout.svg").read_text(encoding="utf-8")
    assert committed == draw(ROOT), "run `python tools/draw_layout.py` and commit docs/images/layout.svg"
