"""The picture of the layout: all folders, all imports, upwards, and nothing over anything else."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
import tomllib
from draw_layout import BESIDE, TOP, boxes_of, draw, main
from import_graph import Graph, SourceFile, closure, contracted, module_graph, read_sources

ROOT = Path(__file__).resolve().parents[2]
SVG = "{http://www.w3.org/2000/svg}"


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle of the picture [px]."""

    left: float
    top: float
    right: float
    bottom: float

    def holds(self, other: Box) -> bool:
        """Return whether another box lies in this one."""
        inside = self.left <= other.left and other.right <= self.right
        return inside and self.top <= other.top and other.bottom <= self.bottom

    def meets(self, other: Box) -> bool:
        """Return whether the two have a point in common."""
        beside = self.right < other.left or other.right < self.left
        return not (beside or self.bottom < other.top or other.bottom < self.top)


def boxes(picture: ET.Element) -> dict[str, Box]:
    """Return the boxes by the folder's package."""
    found = {}
    for rect in picture.iter(f"{SVG}rect"):
        if name := rect.get("data-room"):
            left, top, width, height = (float(rect.attrib[key]) for key in ("x", "y", "width", "height"))
            found[name] = Box(left, top, left + width, top + height)
    return found


def arrows(picture: ET.Element) -> set[tuple[str, str]]:
    """Return (from, to) of each arrow."""
    paths = picture.iter(f"{SVG}path")
    return {
        (path.attrib["data-from"], path.attrib["data-to"]) for path in paths if "data-from" in path.attrib
    }


@pytest.fixture(scope="module")
def sources() -> dict[str, SourceFile]:
    """This checkout's sources; to read them takes seconds."""
    return read_sources(ROOT)


@pytest.fixture(scope="module")
def drawn(sources: Mapping[str, SourceFile]) -> str:
    """Draw this checkout."""
    return draw(sources)


@pytest.fixture(scope="module")
def modules(sources: Mapping[str, SourceFile]) -> Graph:
    """Read which module imports which."""
    return module_graph(sources, ("load", "call", "types"))


def test_the_committed_picture_is_drawn_from_this_tree(drawn: str) -> None:
    """After a change of folders, or of imports between them, somebody has to run the command again."""
    committed = (ROOT / "docs" / "images" / "layout.svg").read_text(encoding="utf-8")
    assert committed == drawn, "run `python tools/draw_layout.py` and commit docs/images/layout.svg"


def test_each_package_has_a_box(drawn: str) -> None:
    """The folders are those of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = set(project["tool"]["setuptools"]["packages"]) - {TOP, "deal_hw.docs"}
    assert packages == {name for name in boxes(ET.fromstring(drawn)) if BESIDE not in name}


def test_the_arrows_are_the_imports(drawn: str, modules: Graph) -> None:
    """Along the arrows of a folder, a box reaches those that import it, directly or by others."""
    found = arrows(ET.fromstring(drawn))
    names = set(boxes(ET.fromstring(drawn)))
    packages = {name for name in names if BESIDE not in name} | {TOP}
    for package in packages:
        imports = contracted(modules, boxes_of(modules, packages, package).get)
        shown = {name: frozenset(low for low, high in found if high == name) for name in imports}
        needs = {name: closure(imports, [name]) for name in imports}
        if len(imports) > 1:
            assert {name: closure(shown, [name]) for name in imports} == needs, package
    assert {end for arrow in found for end in arrow} <= names


def test_arrows_lead_up_and_boxes_do_not_overlap(drawn: str) -> None:
    """A reader sees an import's direction without its head, and reads every name."""
    picture = ET.fromstring(drawn)
    placed = boxes(picture)
    assert all(placed[low].top > placed[high].bottom for low, high in arrows(picture))
    for one, other in itertools.combinations(placed.values(), 2):
        assert one.holds(other) or other.holds(one) or not one.meets(other)
    for text in picture.iter(f"{SVG}text"):
        if text.get("text-anchor") == "middle":
            middle, base = float(text.attrib["x"]), float(text.attrib["y"])
            half = 6.5 * len(text.text or "") / 2
            around = Box(middle - half, base - 12, middle + half, base + 3)
            holding = [box for box in placed.values() if box.holds(around)]
            assert holding, f"{text.text} is wider than its box"
            assert not [b for b in placed.values() if b not in holding and b.meets(around)], text.text


def checkout(root: Path, files: dict[str, str]) -> Path:
    """Write a checkout of `deal_hw` with these files."""
    (root / "pyproject.toml").write_text(
        '[tool.setuptools.package-dir]\ndeal_hw = "deal_hw"\n', encoding="utf-8"
    )
    for name, text in files.items():
        path = root / "deal_hw" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        for folder in (path.parent, *path.parent.parents):
            if folder == root:
                break
            (folder / "__init__.py").touch()
        path.write_text(text, encoding="utf-8")
    return root


def test_imports_that_follow_have_no_arrow_and_files_are_a_box(tmp_path: Path) -> None:
    """Imports inside functions count; files on both sides of a folder are two boxes."""
    files = {
        "low/x.py": "",
        "high/base.py": "",
        "high/verb.py": "from deal_hw.high.room import y",
        "high/room/y.py": "from deal_hw.high import base\nfrom deal_hw.low import x",
        "top/z.py": "def f():\n    from deal_hw.high import verb\n    import deal_hw.low.x",
    }
    out = tmp_path / "layout.svg"
    assert main(["--root", str(checkout(tmp_path, files)), "--out", str(out)]) == 0
    assert arrows(ET.parse(out).getroot()) == {
        ("deal_hw.low", "deal_hw.high"),
        ("deal_hw.high", "deal_hw.top"),
        ("deal_hw.high:files", "deal_hw.high.room"),
        ("deal_hw.high.room", "deal_hw.high:files above"),
    }


def test_a_circle_of_folders_is_refused_by_name(tmp_path: Path) -> None:
    """There is no order to draw."""
    files = {"low/x.py": "import deal_hw.high.y", "high/y.py": "import deal_hw.low.x"}
    with pytest.raises(ValueError, match=r"import each other: \[\['deal_hw.high', 'deal_hw.low'\]\]"):
        draw(read_sources(checkout(tmp_path, files)))
