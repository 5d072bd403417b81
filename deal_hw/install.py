"""The command that installs an extra, from the source of the installed deal-hw."""

from __future__ import annotations

import json
import shlex
from typing import Any
from urllib.parse import unquote, urlsplit


def install_line(extra: str = "") -> str:
    """Return a pip command that works for this installation.

    Checkouts, files and repositories are named as in pip's record (``direct_url.json``, PEP 610). Without a
    record deal-hw came from an index.

    Args:
        extra: The extra; none by default.
    """
    wanted = f"[{extra}]" if extra else ""
    origin = _origin()
    url = origin.get("url", "")
    if "vcs_info" in origin:
        return f"pip install 'deal-hw{wanted} @ {origin['vcs_info'].get('vcs', 'git')}+{url}'"
    if url.startswith("file:"):
        editable = "--editable " if origin.get("dir_info", {}).get("editable") else ""
        return f"pip install {editable}{shlex.quote(unquote(urlsplit(url).path) + wanted)}"
    return f"pip install 'deal-hw{wanted}'"


def _origin() -> dict[str, Any]:
    """Return pip's record; a source folder earlier on the path than the installation has none."""
    import importlib.metadata

    for found in importlib.metadata.distributions(name="deal-hw"):
        if record := found.read_text("direct_url.json"):
            return dict(json.loads(record))
    return {}
