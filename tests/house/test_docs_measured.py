"""Files of measured rows say which commit, command, versions and machine they come from."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from deal_hw.bench.rows import describe_call

ROOT = Path(__file__).resolve().parents[2]
MEASURED = ROOT / "docs" / "measured"
PAGE = (MEASURED / "README.md").read_text(encoding="utf-8")


def lacks(document: Any) -> set[str]:
    """Return the facts that the head of a file of rows lacks; each of several calls must have them."""
    if not isinstance(document, dict):
        return {"command", "commit", "machine", "versions"}
    if "calls" in document:
        return set().union(*map(lacks, document["calls"]))
    machine = document.get("machine") or {}
    commit = machine.get("git_commit") or ""
    printed = {
        "command": bool(document.get("argv")),
        "commit": bool(commit),
        "clean tree": not commit.endswith("-dirty"),
        "machine": {"platform", "processors", "load"} <= set(machine),
        "versions": bool(machine.get("versions")),
    }
    return {name for name, there in printed.items() if not there}


def reported() -> dict[str, set[str]]:
    """Return the facts that files lack, by the page."""
    table = PAGE.partition("| older file | lacks |")[2].partition("\n\n")[0]
    rows = [line.split("|") for line in table.splitlines()[2:]]
    return {row[1].strip(" `"): {word.strip() for word in row[2].split(",")} for row in rows}


@pytest.mark.parametrize("path", sorted(MEASURED.glob("*.json")), ids=lambda path: str(path.name))
def test_a_file_of_rows_says_where_it_comes_from(path: Path) -> None:
    """The page lists the missing facts of older files; a new file has all."""
    assert lacks(json.loads(path.read_text(encoding="utf-8"))) == reported().get(path.name, set())


def test_only_files_that_exist_are_excused() -> None:
    """The list of older files is counted, names no file that is gone, and excuses a changed tree alone."""
    counts = "No One Two Three Four Five Six Seven Eight Nine Ten Eleven Twelve".split()
    assert f"[{counts[len(reported())]} older files](#older-files)" in PAGE
    assert {name for name in reported() if not (MEASURED / name).is_file()} == set()
    assert set().union(*reported().values()) == {"clean tree"}


@pytest.mark.parametrize("path", sorted(MEASURED.glob("*.json")), ids=lambda path: str(path.name))
def test_a_file_of_rows_is_described(path: Path) -> None:
    """The page names each file, with or without its ending."""
    assert re.search(rf"`{re.escape(path.stem)}(?:\.json)?`", PAGE)


def test_what_is_measured_now_says_everything() -> None:
    """The head that benches and tools write is complete; only the tree may have been changed."""
    assert lacks(describe_call("tools/some.py")) <= {"clean tree"}


@pytest.mark.parametrize("path", sorted((ROOT / "tools").glob("*.py")), ids=lambda path: str(path.name))
def test_a_tool_that_writes_rows_writes_their_head(path: Path) -> None:
    """Each tool that writes figures as JSON also writes the description of its call."""
    text = path.read_text(encoding="utf-8")
    if path.name.startswith(("measure_", "dds_peer_")) and re.search(r'"--out"|out: Path', text):
        assert re.search(r"\b(?:Rows|head|run_cells)\(", text) or "fault_table" in text
