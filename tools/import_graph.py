"""Imports between modules, read from the sources, for the layer test and `tools/structure.py`.

Nothing is imported or run, so the sources may be those of another checkout.
"""

from __future__ import annotations

import ast
import contextlib
import gc
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import tomllib
from syntax import children, dotted

When = Literal["load", "call", "types", "text"]
"""Kind of an import: at the module's load, when a function runs, never (under ``TYPE_CHECKING``, for type
checkers only), or a module's name as text."""

MODULE_TEXT = re.compile(r"[A-Za-z_]\w*(?:\.\w+)+(?::\w+)?")
IMPORT_CALLS = frozenset({"import_module", "importlib.import_module", "__import__"})


@dataclass(frozen=True, slots=True)
class Import:
    """One import statement, or a module named as text.

    Attributes:
        line: Its line in the file.
        source: The module that it names; a relative one begins with dots.
        names: The imported names (``from source import names``); empty for the whole module.
        when: Kind of the import.
        by_call: The name is the argument of `importlib.import_module` or of its like.
    """

    line: int
    source: str
    names: tuple[str, ...] = ()
    when: When = "load"
    by_call: bool = False


def imports(tree: ast.AST) -> Iterator[Import]:
    """Yield all that a parsed file imports, at the top or inside functions, also by name as text.

    Text counts if it is a dotted name, such as ``"deal_hw.calib.deal:Deal"``. The caller checks whether the
    module exists.
    """
    waiting: list[tuple[ast.AST, When]] = [(tree, "load")]
    while waiting:
        node, when = waiting.pop()
        yield from _imports(node, when)
        waiting += reversed(_inside(node, when))


def _imports(node: ast.AST, when: When) -> Iterator[Import]:
    """Yield what a node itself imports."""
    if isinstance(node, ast.Import):
        yield from (Import(node.lineno, alias.name, (), when) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        source = "." * node.level + (node.module or "")
        yield Import(node.lineno, source, tuple(alias.name for alias in node.names), when)
    elif isinstance(node, ast.Call) and (called := _named_by_call(node)):
        yield Import(node.lineno, called, (), when, by_call=True)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        if MODULE_TEXT.fullmatch(node.value):
            yield Import(node.lineno, node.value.partition(":")[0], (), "text")


def _inside(node: ast.AST, when: When) -> list[tuple[ast.AST, When]]:
    """Return the nodes below a node that may import, each with its kind."""
    if isinstance(node, ast.If) and dotted(node.test) in {"TYPE_CHECKING", "typing.TYPE_CHECKING"}:
        return [*((child, "types") for child in node.body), *((child, when) for child in node.orelse)]
    if isinstance(node, ast.Call) and _named_by_call(node):
        # The name is not counted again as text.
        return [(child, when) for child in (*node.args[1:], *node.keywords)]
    if when == "load" and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
        when = "call"
    return [(child, when) for child in children(node)]


def _named_by_call(node: ast.Call) -> str:
    """Return the module that `importlib.import_module` or its like gets as text, or ""."""
    if not (node.args and dotted(node.func) in IMPORT_CALLS):
        return ""
    first = node.args[0]
    return first.value if isinstance(first, ast.Constant) and isinstance(first.value, str) else ""


@dataclass(frozen=True, slots=True)
class SourceFile:
    """One Python file of a package.

    Attributes:
        path: Its path from the root of the checkout.
        module: The name under which it is installed.
        text: Its content.
        tree: The same, parsed.
    """

    path: PurePosixPath
    module: str
    text: str
    tree: ast.Module

    @property
    def package(self) -> str:
        """Name of the file's package; for an ``__init__.py`` its own name."""
        return self.module if self.path.name == "__init__.py" else self.module.rpartition(".")[0]


def package_folders(root: Path) -> dict[str, str]:
    """Return folder -> package name of a checkout, as ``package-dir`` of its pyproject.toml has it."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    return {folder: name for name, folder in project["tool"]["setuptools"]["package-dir"].items()}


def module_name(path: PurePosixPath, packages: Mapping[str, str]) -> str:
    """Return the name under which a file is installed; outside of all packages, its path with dots."""
    parts = path.with_suffix("").parts
    parts = parts[:-1] if parts[-1] == "__init__" else parts
    for length in range(len(parts), 0, -1):
        package = packages.get("/".join(parts[:length]))
        if package:
            return ".".join((package, *parts[length:]))
    return ".".join(parts)


def read_sources(root: Path) -> dict[str, SourceFile]:
    """Return every Python file of a checkout's packages, by its module."""
    packages = package_folders(root)
    found = {}
    with without_garbage_collection():
        for top in sorted({folder.split("/")[0] for folder in packages}):
            for file in sorted((root / top).rglob("*.py")):
                path = PurePosixPath(file.relative_to(root).as_posix())
                text = file.read_text(encoding="utf-8")
                module = module_name(path, packages)
                found[module] = SourceFile(path, module, text, ast.parse(text, str(path)))
    return found


@contextlib.contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Search for no garbage: all nodes are kept, and to visit them takes three times as long as to parse."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def absolute(source: str, package: str) -> str:
    """Return a module's full name, as a file of that package names it; relative ones begin with dots."""
    name = source.lstrip(".")
    ups = len(source) - len(name)
    if not ups:
        return name
    base = package.split(".")
    return ".".join([*base[: len(base) - ups + 1], *([name] if name else [])])


def targets(found: Import, package: str, modules: Iterable[str]) -> set[str]:
    """Return which of these modules an import names.

    ``from package import x`` names the module ``package.x`` if it exists, otherwise the package itself.
    """
    source = absolute(found.source, package)
    names = [f"{source}.{name}" for name in found.names] or [source]
    return {name if name in modules else source for name in names} & set(modules)


Graph = Mapping[str, frozenset[str]]
"""Node -> the nodes that it imports."""


def module_graph(sources: Mapping[str, SourceFile], when: Iterable[When]) -> Graph:
    """Return which module imports which by imports of these kinds; no module imports itself."""
    kinds = frozenset(when)
    return {
        module: frozenset(
            target
            for found in imports(file.tree)
            if found.when in kinds
            for target in targets(found, file.package, sources)
            if target != module
        )
        for module, file in sources.items()
    }


def contracted(graph: Graph, room_of: Callable[[str], str | None]) -> Graph:
    """Return the graph between groups of nodes; a node without a group, and edges inside a group, go."""
    edges: dict[str, set[str]] = {}
    for node, needs in graph.items():
        room = room_of(node)
        if room is None:
            continue
        edges.setdefault(room, set()).update(
            other for need in needs if (other := room_of(need)) is not None and other != room
        )
    return {room: frozenset(needs) for room, needs in edges.items()}


def closure(graph: Graph, starts: Iterable[str]) -> set[str]:
    """Return the nodes that can be reached from these, themselves among them."""
    seen: set[str] = set()
    waiting = list(starts)
    while waiting:
        node = waiting.pop()
        if node not in seen:
            seen.add(node)
            waiting += graph[node]
    return seen


def components(graph: Graph) -> list[frozenset[str]]:
    """Return the strongly connected components; one of several nodes is a circle.

    Computed from the nodes that each node reaches: quadratic, but short, and fast enough for some hundred
    modules.
    """
    reach = {node: closure(graph, [node]) for node in graph}
    return sorted(
        {frozenset(other for other in reach[node] if node in reach[other]) for node in graph}, key=sorted
    )


def circles(graph: Graph) -> list[list[str]]:
    """Return the circles: each group of nodes that all reach each other."""
    return [sorted(group) for group in components(graph) if len(group) > 1]


def levels(graph: Graph) -> int:
    """Return the length of the longest chain of imports, in nodes; a circle of n nodes counts as n."""
    group_of = {node: group for group in components(graph) for node in group}
    depth: dict[frozenset[str], int] = {}

    def level(group: frozenset[str]) -> int:
        if group not in depth:
            below = {group_of[need] for node in group for need in graph[node]} - {group}
            depth[group] = len(group) + max(map(level, below), default=0)
        return depth[group]

    return max(map(level, group_of.values()), default=0)
