"""The command that installs an extra where deal-hw itself was installed from."""

from __future__ import annotations

import json
import shlex
from typing import Any
from urllib.parse import unquote, urlsplit


def install_line(extra: str = "") -> str:
    """Return a pip command that works for this installation.

    A checkout, a file and a repository are named as pip recorded them (``direct_url.json``, PEP 610); without
    such a record deal-hw came from an index.

    Args:
        extra: The extra wanted; none by default.
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
    """Return pip's record; a folder of sources that lies before the installation on the path has none."""
    import importlib.metadata

    for found in importlib.metadata.distributions(name="deal-hw"):
        if record := found.read_text("direct_url.json"):
            return dict(json.loads(record))
    return {}
