"""Draw the layout of the product as SVG: its folders as boxes in boxes, and the imports between them.

    python tools/draw_layout.py                                # docs/images/layout.svg
    python tools/draw_layout.py --out /tmp/layout.svg

Read from the sources, as by `tools/structure.py`; nothing is imported or run. A folder stands above all that
it imports, and each arrow leads up, from a folder to one that imports it. An import that follows from others
has no arrow: where A imports B and B imports C, A may import C. Files that lie beside folders are one box.
They are two boxes where some of them import the folders and others are imported by them.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from import_graph import Graph, SourceFile, circles, closure, contracted, module_graph, read_sources

TOP = "deal_hw"
ENTRY = frozenset({"__init__", "__main__"})
"""Files of the top folder that load everything; the picture leaves them out."""
BESIDE = ":files"
"""End of the name of a box of files that lie beside folders; :data:`ABOVE` for those that import folders."""
ABOVE = ":files above"
GAP, ROW_GAP, LANE, PAD = 14.0, 24.0, 12.0, 12.0
"""Distance of boxes in a row and of rows, width of an arrow's way past a row, and margin in a box [px]."""
NAMES = 90
"""Letters in a line of the names of files that lie in the top folder."""
LINE, NAME_LINE = 16.0, 20.0
"""Height of a line of text and of a name [px]."""
LETTER = 7.3
"""Width that is planned for a letter [px]; fonts differ, so it is more than that of most."""
LEGEND = (
    "An arrow leads up, from a folder to one that imports it.",
    "Imports that follow from others have no arrow.",
    "Yellow: files that lie beside folders.",
)
STYLE = """
text { font-family: Helvetica, Arial, sans-serif; font-size: 13px; fill: #1f2933; }
.name { font-size: 14px; font-weight: bold; }
.note { fill: #52606d; }
rect { stroke-width: 1.3; }
.depth0 { fill: #eef4fb; stroke: #33658a; }
.depth1 { fill: #ffffff; stroke: #33658a; }
.depth2 { fill: #eef4fb; stroke: #33658a; }
.files { fill: #f5f2e9; stroke: #8a7433; }
.arrow { fill: none; stroke: #33658a; stroke-width: 1.5; marker-end: url(#head); }
"""


@dataclass(slots=True)
class Room:
    """One box.

    Attributes:
        name: The folder's package, or that of a box of files with :data:`BESIDE` or :data:`ABOVE` after it.
        title: Its name in the picture.
        lines: What stands below the name.
        rows: The boxes in it, the lowest row first; an empty name is the way of an arrow past the row.
        arrows: Ways of the imports in it, each from the lower box to the upper one.
        floor: Lower edge of its row [px].
        left: Left edge [px].
        top: Upper edge [px].
        width: Its width [px].
        height: Its height [px].
    """

    name: str
    title: str = ""
    lines: tuple[str, ...] = ()
    rows: list[list[Room]] = field(default_factory=list)
    arrows: list[list[Room]] = field(default_factory=list)
    floor: float = 0.0
    left: float = 0.0
    top: float = 0.0
    width: float = 0.0
    height: float = 0.0

    @property
    def middle(self) -> float:
        """Its middle from the left [px]."""
        return self.left + self.width / 2

    @property
    def bottom(self) -> float:
        """Its lower edge [px]."""
        return self.top + self.height


def boxes_of(modules: Graph, packages: Collection[str], package: str) -> dict[str, str]:
    """Return the box of each module of a package: a folder in it, or its own files, whole or as two boxes.

    Raises:
        ValueError: Folders import each other, so no order can be drawn.
    """
    inside = {name for name in modules if name.startswith(f"{package}.")}
    if package == TOP:
        inside -= {f"{TOP}.{name}" for name in ENTRY}
    direct = {name: ".".join(name.split(".")[: package.count(".") + 2]) for name in inside}
    found = {name: top if top in packages else package + BESIDE for name, top in direct.items()}
    if circles(contracted(modules, found.get)):
        files = {name for name, box in found.items() if box == package + BESIDE}
        found |= {name: package + ABOVE for name in files if closure(modules, [name]) & (inside - files)}
    if rings := circles(contracted(modules, found.get)):
        raise ValueError(f"folders of {package} import each other: {rings}")
    return found


def reduced(graph: Graph) -> Graph:
    """Return the graph without the edges that follow from others."""
    kept = {}
    for node, needs in graph.items():
        further = {other for need in needs for other in closure(graph, [need]) - {need}}
        kept[node] = frozenset(needs - further)
    return kept


def levels(graph: Graph) -> dict[str, int]:
    """Return the row of each box: above all that it imports, and close below the first that imports it."""
    found: dict[str, int] = {}
    while len(found) < len(graph):
        for node, needs in graph.items():
            if needs <= set(found):
                found[node] = 1 + max((found[need] for need in needs), default=-1)
    for node in sorted(graph, key=lambda name: -found[name]):
        importers = [found[other] for other, needs in graph.items() if node in needs]
        found[node] = min(importers, default=found[node] + 1) - 1
    return found


def build(modules: Graph, packages: Collection[str], package: str = TOP) -> Room:
    """Return a package's box with all boxes in it, in rows and measured, not yet placed."""
    room = Room(package, package.rpartition(".")[2] or package)
    box_of = boxes_of(modules, packages, package)
    if not set(box_of.values()) <= {package + BESIDE}:
        graph = contracted(modules, box_of.get)
        boxes = {name: build(modules, packages, name) for name in graph if BESIDE not in name}
        for name in set(graph) - set(boxes):
            files = sorted(module.rpartition(".")[2] for module, box in box_of.items() if box == name)
            lines = textwrap.wrap(" · ".join(files), NAMES) if package == TOP else ["files"]
            boxes[name] = Room(name, "", tuple(lines))
            _measure(boxes[name])
        _arrange(room, boxes, graph)
    _measure(room)
    return room


def _arrange(room: Room, boxes: Mapping[str, Room], graph: Graph) -> None:
    """Put boxes into rows, with a way for each arrow that passes a row, so that few arrows cross."""
    level = levels(graph)
    rows: list[list[Room]] = [[] for _ in range(max(level.values()) + 1)]
    for name, box in sorted(boxes.items()):
        rows[level[name]].append(box)
    for importer, needs in sorted(reduced(graph).items()):
        for need in sorted(needs):
            lanes = [Room("", width=LANE) for _ in range(level[need] + 1, level[importer])]
            for number, lane in enumerate(lanes, level[need] + 1):
                rows[number].append(lane)
            room.arrows.append([boxes[need], *lanes, boxes[importer]])
    room.rows = rows
    for _ in range(4):
        for number in [*range(len(rows)), *reversed(range(len(rows)))]:
            rows[number] = list(
                min(itertools.permutations(rows[number]), key=lambda row: _cost(room, number, list(row)))
            )


def _cost(room: Room, number: int, row: Sequence[Room]) -> tuple[float, float]:
    """Return how many arrows cross, and how far they lead aside, with a row in this order."""
    rows = [*room.rows[:number], row, *room.rows[number + 1 :]]
    place = {}
    for others in rows:
        at = -sum(box.width + GAP for box in others) / 2
        for box in others:
            place[id(box)] = at + box.width / 2
            at += box.width + GAP
    steps = [pair for way in room.arrows for pair in itertools.pairwise(way)]
    ends = [(place[id(low)], place[id(high)]) for low, high in steps]
    of_row = {id(box): at for at, others in enumerate(rows) for box in others}
    crossing = sum(
        (a[0] - b[0]) * (a[1] - b[1]) < 0
        for (one, a), (two, b) in itertools.combinations(zip(steps, ends, strict=True), 2)
        if of_row[id(one[0])] == of_row[id(two[0])]
    )
    return crossing, sum(abs(low - high) for low, high in ends)


def _measure(room: Room) -> None:
    """Set a box's width and height from its text and the boxes in it."""
    inner = [sum(box.width for box in row) + GAP * (len(row) - 1) for row in room.rows]
    room.width = 2 * PAD + max(
        [*inner, LETTER * 1.15 * len(room.title), *(LETTER * len(line) for line in room.lines)]
    )
    heights = [max(box.height for box in row) for row in room.rows]
    text = NAME_LINE * bool(room.title) + LINE * len(room.lines)
    room.height = text + PAD + sum(heights) + ROW_GAP * max(len(heights) - 1, 0) + PAD * bool(heights)


def put(room: Room, left: float, top: float) -> None:
    """Place a box, and the boxes in it, in the middle of its rows."""
    room.left, room.top = left, top
    top += PAD / 2 + NAME_LINE * bool(room.title) + LINE * len(room.lines) + PAD / 2
    for row in reversed(room.rows):
        height = max(box.height for box in row)
        spare = room.width - 2 * PAD - sum(box.width for box in row) - GAP * (len(row) - 1)
        left = room.left + PAD + spare / 2
        for box in row:
            put(box, left, top)
            box.floor = top + height
            left += box.width + GAP
        top += height + ROW_GAP


def every(room: Room) -> Iterator[tuple[int, Room]]:
    """Yield a box and all boxes in it with their depth, the outer ones first."""
    waiting = [(0, room)]
    while waiting:
        depth, one = waiting.pop()
        yield depth, one
        waiting += [(depth + 1, box) for row in one.rows for box in row if box.name]


def svg(modules: Graph, packages: Collection[str]) -> str:
    """Return the picture."""
    top = build(modules, packages)
    put(top, 0.0, LINE * len(LEGEND))
    legend = [
        f'<text class="note" x="{PAD:g}" y="{LINE * k:g}">{line}</text>' for k, line in enumerate(LEGEND, 1)
    ]
    boxes = [(depth, room) for depth, room in every(top) if depth]
    drawn = [_box(depth, room) for depth, room in boxes]
    drawn += [_arrow(way, _ends(one, way)) for one in (top, *(r for _, r in boxes)) for way in one.arrows]
    width, height = f"{top.width:.0f}", f"{top.bottom:.0f}"
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}">',
            "<title>Folders of deal-hw; each arrow leads up from a folder to one that imports it</title>",
            f"<style>{STYLE}</style>",
            '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="6" markerHeight="6" '
            'orient="auto"><path d="M0 0 L10 5 L0 10 z" fill="#33658a"/></marker></defs>',
            f'<rect width="{width}" height="{height}" fill="white"/>',
            *legend,
            *drawn,
            "</svg>\n",
        ]
    )


def _box(depth: int, room: Room) -> str:
    kind = "files" if BESIDE in room.name else f"depth{(depth - 1) % 3}"
    left, width, height = round(room.left, 1), round(room.width, 1), round(room.height, 1)
    rows = [
        f'<rect class="{kind}" data-room="{room.name}" x="{left:g}" y="{room.top:g}" width="{width:g}" '
        f'height="{height:g}" rx="5"/>'
    ]
    baseline = room.top + PAD / 2
    for kind, line in [("name", room.title), *(("note", line) for line in room.lines)]:
        if line:
            baseline += NAME_LINE if kind == "name" else LINE
            rows.append(
                f'<text class="{kind}" x="{room.middle:.1f}" y="{baseline - 3:g}" text-anchor="middle">'
                f"{escape(line)}</text>"
            )
    return "\n".join(rows)


def _ends(room: Room, way: list[Room]) -> tuple[float, float]:
    """Return where an arrow leaves its lower box and meets its upper one [px], beside the others there."""
    out = sorted((w for w in room.arrows if w[0] is way[0]), key=lambda w: w[1].middle)
    into = sorted((w for w in room.arrows if w[-1] is way[-1]), key=lambda w: w[-2].middle)
    return _share(way[0], out.index(way), len(out)), _share(way[-1], into.index(way), len(into))


def _share(box: Room, number: int, count: int) -> float:
    """Return the place of one of several arrows at a box, around its middle [px]."""
    return box.middle + (number - (count - 1) / 2) * min(0.7 * box.width / count, 40.0)


def _arrow(way: Sequence[Room], ends: tuple[float, float]) -> str:
    """Return the line from the top of one box to below another, straight up where it passes a row."""
    x, y = ends[0], way[0].top
    path = [f"M{x:.1f} {y:g}"]
    for lane in way[1:-1]:
        path += [_curve(x, y, lane.middle, lane.floor), f"L{lane.middle:.1f} {lane.top:g}"]
        x, y = lane.middle, lane.top
    path += [_curve(x, y, ends[1], way[-1].floor), f"L{ends[1]:.1f} {way[-1].bottom:g}"]
    return f'<path class="arrow" data-from="{way[0].name}" data-to="{way[-1].name}" d="{" ".join(path)}"/>'


def _curve(x: float, y: float, to_x: float, to_y: float) -> str:
    bend = min((y - to_y) / 2, 30.0)
    return f"C{x:.1f} {y - bend:g} {to_x:.1f} {to_y + bend:g} {to_x:.1f} {to_y:g}"


def draw(sources: Mapping[str, SourceFile]) -> str:
    """Return the picture of a checkout's sources by their modules."""
    packages = {file.module for file in sources.values() if file.path.name == "__init__.py"}
    return svg(module_graph(sources, ("load", "call", "types")), packages)


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw; return 0."""
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=root / "docs" / "images" / "layout.svg", help="the SVG file"
    )
    parser.add_argument("--root", type=Path, default=root, help="checkout to draw; by default this one")
    given = parser.parse_args(arguments)
    given.out.write_text(draw(read_sources(given.root)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
