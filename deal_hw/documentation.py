"""Where a page of the documentation lies on this computer."""

from __future__ import annotations

import re
from pathlib import Path


def folder() -> Path:
    """Return the folder of the documentation: the checkout's, or the copy inside an installed package."""
    package = Path(__file__).resolve().parent
    installed = package / "docs"
    return installed if installed.is_dir() else package.parent / "docs"


def page(name: str) -> str:
    """Return how a message names a page, so that the user can open it.

    Args:
        name: The page below docs/, such as ``how-to/import.md``.

    Returns:
        ``docs/how-to/import.md`` where the working folder is the checkout, else the file's full path.
    """
    place = folder() / name
    near = Path("docs", name)
    try:
        return str(near) if near.samefile(place) else str(place)
    except OSError:
        # No such file from here, or the working folder is gone.
        return str(place)


def with_places(text: str) -> str:
    """Return a help text whose pages, written as ``docs/how-to/import.md``, are named as by :func:`page`."""
    return re.sub(r"\bdocs/((?:[\w-]+/)?[\w-]+\.md)\b", lambda found: page(found[1]), text)
