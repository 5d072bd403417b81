"""Tables in the docs name what the code has."""

from __future__ import annotations

import enum
import functools
import re
from pathlib import Path
from typing import get_args

import pytest

from deal_hw.cli.verbs import JOBS
from deal_hw.control.safety.machine import SAFETY_FLAGS
from deal_hw.data.recording.record import CycleFlag
from deal_hw.data.recording.schemas import CHANNELS, STANDARD
from deal_hw.policy import Quantity
from deal_hw.types import Status

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("deal_hw", "drivers", "calib", "policies")
DATA_FORMAT = (ROOT / "docs" / "reference" / "data-format.md").read_text(encoding="utf-8")


@functools.cache
def words_in_sources() -> frozenset[str]:
    """Return every word of the Makefile and of the product's sources."""
    paths = [
        path for folder in FOLDERS for kind in ("*.py", "*.[ch]") for path in (ROOT / folder).rglob(kind)
    ]
    texts = (path.read_text(encoding="utf-8") for path in [ROOT / "Makefile", *paths])
    return frozenset(word for text in texts for word in re.findall(r"\w+", text))


def test_every_quantity_of_an_observation_has_its_unit() -> None:
    """The table of policies from elsewhere names exactly the known quantities."""
    page = (ROOT / "docs" / "how-to" / "add.md").read_text(encoding="utf-8").partition("| quantity | of |")[2]
    rows = [line.split("|") for line in page.partition("\n\n")[0].splitlines()[2:]]
    assert sorted(re.findall(r"`(\w+)`", " ".join(row[1] for row in rows))) == sorted(get_args(Quantity))
    assert all(row[3].strip() for row in rows)


@pytest.mark.parametrize("topic", CHANNELS)
def test_topic_is_described_with_its_fields(topic: str) -> None:
    """Each topic has a row that names exactly its fields, or points to the topic that has the same."""
    (row,) = [
        line
        for line in DATA_FORMAT.splitlines()
        if line.startswith("| `/") and f"`{topic}`" in line.split("|")[1]
    ]
    if topic in STANDARD:
        assert f"`{CHANNELS[topic].name.replace('/msg', '')}`" in row.split("|")[2]
        return
    cell = row.split("|")[3]
    if cell.strip() == "as `/command`":
        assert CHANNELS[topic] is CHANNELS["/command"]
        return
    named = re.findall(r"`([a-z_]+)`", cell)
    assert named == [name for _, name in CHANNELS[topic].fields]


@pytest.mark.parametrize("flag", [*Status, *CycleFlag])
def test_bit_is_described(flag: enum.IntFlag) -> None:
    """Each bit has a row with its value and name."""
    assert re.search(rf"^\| {flag.value} `{flag.name}` \|", DATA_FORMAT, flags=re.M)


def test_each_safety_flag_is_described() -> None:
    """The tables of docs/explanation/safety.md have a row for each flag, and none for others."""
    page = (ROOT / "docs" / "explanation" / "safety.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \|", page[page.index("## What trips") :], flags=re.M)
    assert sorted(rows) == sorted(SAFETY_FLAGS)


def test_readme_shows_each_job() -> None:
    """The README's lines for the five jobs are those of the help, in its order."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    places = [readme.index(f"    deal-hw {verb.example}\n") for verb in JOBS.values()]
    assert places == sorted(places)


def names_in_docs() -> list[tuple[str, str]]:
    """Return every source file, class, method and constant that the docs name, with the document.

    What was measured names the sources of its own commit.
    """
    paths = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
    paths = tuple(path for path in paths if path.parent.name != "measured")
    found = {
        (path.name, name)
        for path in paths
        for name in re.findall(
            r"`((?:[a-z_]+/)+[a-z_]+\.py|_*[A-Z]\w+(?:\._?\w+)?)`", path.read_text(encoding="utf-8")
        )
    }
    return sorted(found)


@pytest.mark.parametrize(("document", "name"), names_in_docs())
def test_name_in_docs_exists(document: str, name: str) -> None:
    """Each name in a document is in the sources."""
    if name.endswith(".py"):
        assert (ROOT / name).is_file()
        return
    for word in name.split("."):
        assert word in words_in_sources(), f"{document} names {name}"


def test_the_paper_is_mapped_line_by_line() -> None:
    """The page maps all lines of Algorithm 1 and all equations, to functions and files that exist."""
    page = (ROOT / "docs" / "explanation" / "deal-paper.md").read_text(encoding="utf-8")
    algorithm, _, rest = page.partition("## Algorithm 1")[2].partition("## Equations")
    equations = rest.partition("\n## ")[0]
    for table, last in ((algorithm, 17), (equations, 23)):
        cells = re.findall(r"^\| ([\d, ]+) \|", table, flags=re.M)
        assert sorted(int(n) for cell in cells for n in cell.split(",")) == list(range(1, last + 1))
    named = set(re.findall(r"`([\w./]+)`", algorithm + equations))
    files = {name for name in named if name.endswith((".py", "/"))}
    assert {
        name for name in files if not ((ROOT / name).exists() or (ROOT / "calib" / "paper" / name).exists())
    } == set()
    words = {part for name in named - files for part in name.split(".")}
    assert words - words_in_sources() == set()


def test_the_files_that_follow_a_verb_have_what_the_page_says() -> None:
    """Twelve files a verb, in order; each defines the name that the table gives."""
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    part = page.partition("## Follow a verb\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (\d+) \| `([\w/.]+)`, `(\w+)` \|", part, re.MULTILINE)
    assert [int(number) for number, _, _ in rows] == [*range(1, 13)] * 2
    for _, file, name in rows:
        text = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"^(def|class) {name}\b", text, re.MULTILINE), (file, name)
    others = re.findall(r"`([\w/]+/[\w/]+\.py)`", part)
    assert len(others) > 24 and all((ROOT / file).is_file() for file in others)
