"""An install hint names the source from which deal-hw was installed."""

from __future__ import annotations

import importlib.metadata
import json
from typing import Any

import pytest

from deal_hw.install import install_line

INDEX: dict[str, Any] = {}
CHECKOUT = {"url": "file:///a/deal-hw", "dir_info": {"editable": True}}
FOLDER = {"url": "file:///a/my%20robots", "dir_info": {}}
WHEEL = {"url": "file:///a/deal_hw-1.whl", "archive_info": {}}
REPOSITORY = {"url": "ssh://host/deal-hw", "vcs_info": {"vcs": "git", "commit_id": "1"}}


@pytest.mark.parametrize(
    ("origin", "plain", "line"),
    [
        (INDEX, "pip install 'deal-hw'", "pip install 'deal-hw[viz]'"),
        (CHECKOUT, "pip install --editable /a/deal-hw", "pip install --editable '/a/deal-hw[viz]'"),
        (FOLDER, "pip install '/a/my robots'", "pip install '/a/my robots[viz]'"),
        (WHEEL, "pip install /a/deal_hw-1.whl", "pip install '/a/deal_hw-1.whl[viz]'"),
        (
            REPOSITORY,
            "pip install 'deal-hw @ git+ssh://host/deal-hw'",
            "pip install 'deal-hw[viz] @ git+ssh://host/deal-hw'",
        ),
    ],
)
def test_an_extra_comes_from_where_the_package_came_from(
    origin: dict[str, Any], plain: str, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From an index, a checkout, a folder, a wheel, a repository."""
    record = json.dumps(origin) if origin else None
    monkeypatch.setattr(importlib.metadata.PathDistribution, "read_text", lambda self, name: record)
    assert (install_line(), install_line("viz")) == (plain, line)
