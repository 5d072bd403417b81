"""Messages of a running workflow: it passes each sentence to a function."""

from __future__ import annotations

import html
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

Say = Callable[[str], None]
"""Called with a sentence for the user."""


def silent(text: str) -> None:
    """Drop the sentence."""


def to_stderr(text: str) -> None:
    """Print the sentence on standard error."""
    print(text, file=sys.stderr)


def html_table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table for notebooks."""
    lines = [f"<tr>{''.join(f'<th>{html.escape(name)}</th>' for name in head)}</tr>"]
    lines += [f"<tr>{''.join(f'<td>{html.escape(str(cell))}</td>' for cell in row)}</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>"


def text_table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table as text."""
    lines = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
