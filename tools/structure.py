"""Count lines, rooms, imports, circles and constants of a checkout, also beside those of an earlier one.

    python tools/structure.py                                  # this checkout, folder calib
    python tools/structure.py --root ../old --json old.json    # another checkout, counted by this tool
    python tools/structure.py --compare old.json               # before, now, and the ratio

Everything is read from the sources by their syntax tree; nothing of the checkout is imported or run. The
folders are those of ``package-dir`` in pyproject.toml (`deal_hw`, `drivers`, `policies`, `calib`).

Lines
    product lines: all lines of all ``.py`` files of these folders, blank lines, comments and docstrings among
        them. Templates, MJCF and other assets do not count. Tests and tools do not count either; their lines
        are shown beside, because code that moves there is moved, not saved.
    lines of a package: the files that lie directly in it, without those of its sub-packages.

Rooms of a folder (``--folder``, by default calib)
    A room is a direct sub-package, or a module that lies directly in the folder. The folder's own
    ``__init__.py`` is a room only where it imports a room of the folder or a room imports a name from it.
    An edge leads from room A to room B where a file of A imports a module of B, however often. Counted are
    imports at the top, inside functions and under ``TYPE_CHECKING``, absolute and relative; ``from
    deal_hw.calib import x`` is an import of module ``deal_hw.calib.x`` where there is one. Modules named as
    text (tables of names) are not counted.
    levels: rooms of the longest chain of imports. A circle of n rooms is n of them.

Closure of a verb (``--verb``, by default calibrate) inside the folder
    Start: the modules ``deal_hw.cli.VERB``, ``deal_hw.cli.VERB_`` and ``deal_hw.workflows.VERB``, those that
    exist. From there along imports through all product modules; counted are the modules of the folder that
    are reached, sub-packages among them. Imports by parent packages that Python adds are not followed, as a
    reader need not open those files.
    target: imports at the top and inside functions. This is what somebody opens who follows the verb.
    at load: imports at the top alone, which is what `import` loads.
    with tables: also modules named as text, so each method that a name can choose.

Circles
    Groups of more than one module that all reach each other by imports (strongly connected components), over
    all product modules. Imports at the top, inside functions and under ``TYPE_CHECKING`` count.
    Beside it: without ``TYPE_CHECKING``, and circles of rooms of the folder.

Numeric module constants of the folder
    Names of any case, bound at module level (also inside ``if`` and ``try`` there) to numbers: a literal
    number that is not a bool; arithmetic on numbers; a tuple, list, set or dict (values, keys of any kind) of
    numbers alone; a call of ``np``, ``numpy``, ``math``, ``float``, ``int``, ``frozenset``, ``tuple``,
    ``range`` or ``MappingProxyType`` on such; an index into such; or another numeric constant's name, of the
    same file or imported. One name counts once a file. Fields of dataclasses are settings and do not count;
    class attributes without annotation do not count. literal: those whose value is written with literals,
    arithmetic and containers alone. UPPER_CASE: how many are so written.

Settings of the folder
    `settings_count` defines settings classes, fields that nobody sets and what tests replace by name. Tests'
    replacements are those of the whole tree.

Own least-squares loops of the folder: candidates for a person to judge
    Functions that solve a linear system repeatedly: a loop or comprehension whose body calls a solver of
    numpy, scipy or torch: ``solve``, ``lstsq``, ``cho_solve``, ``lu_solve``, ``solve_triangular`` or
    ``pinv``. The call is direct or by one function in between (of the same file, of the same object, or
    imported by name).
    accepting: it is a ``for`` or ``while`` statement with an ``if`` in it that compares and then breaks,
    returns or continues.
    Read the list; its length alone means nothing. It contains a hand-written Levenberg-Marquardt loop, but
    also a Kalman filter and a Riccati equation. A loop whose solve is two calls away, or comes in as
    an argument, is not found.
"""

from __future__ import annotations

import argparse
import ast
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from import_graph import (
    Graph,
    SourceFile,
    circles,
    closure,
    contracted,
    imports,
    levels,
    module_graph,
    read_sources,
    targets,
)
from settings_count import replaced_by_tests, settings_classes

from deal_hw.bench.rows import describe_call

FORMAT = "deal_hw.structure/1"
SOLVERS = frozenset({"solve", "lstsq", "cho_solve", "lu_solve", "solve_triangular", "pinv"})
NUMERIC_ROOTS = frozenset({"np", "numpy", "math"})
NUMERIC_CALLS = frozenset({"float", "int", "frozenset", "tuple", "range", "MappingProxyType"})
LOOPS = (ast.For, ast.While, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def main(arguments: Sequence[str] | None = None) -> int:
    """Count, print, and write or compare if requested; return 0, or 2 if a file cannot be read."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    here = Path(__file__).resolve().parents[1]
    parser.add_argument("--root", type=Path, default=here, help="checkout to count; by default this one")
    parser.add_argument(
        "--folder", default="calib", help="folder whose rooms are counted, such as calib or sim"
    )
    parser.add_argument("--verb", default="calibrate", help="verb whose closure is counted")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the counts to this file")
    parser.add_argument(
        "--compare", type=Path, metavar="OTHER.json", help="show an earlier file's counts beside"
    )
    given = parser.parse_args(arguments)
    try:
        counted = count(given.root, given.folder, given.verb)
        before = json.loads(given.compare.read_text(encoding="utf-8")) if given.compare else None
        if before is not None and before.get("format") != FORMAT:
            raise ValueError(
                f"{given.compare} is no file of --json: format {before.get('format')!r}, not {FORMAT!r}"
            )
    except (OSError, ValueError, KeyError, SyntaxError) as err:
        print(f"structure: {err}", file=sys.stderr)
        return 2
    if before is None:
        print_counts(counted)
    else:
        print_comparison(before, counted)
    if given.json:
        described = counted | describe_call("tools/structure.py")
        given.json.write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    return 0


def count(root: Path, folder: str = "calib", verb: str = "calibrate") -> dict[str, Any]:
    """Return all counts of a checkout, as the module's text defines them.

    Raises:
        ValueError: There is no such folder or verb.
    """
    sources = read_sources(root)
    package = _package_of(sources, folder)
    inside = {m: f for m, f in sources.items() if m == package or m.startswith(f"{package}.")}
    seen = module_graph(sources, ("load", "call"))
    typed = module_graph(sources, ("load", "call", "types"))
    rooms = room_graph(typed, package)
    starts = [
        m
        for m in (f"deal_hw.cli.{verb}", f"deal_hw.cli.{verb}_", f"deal_hw.workflows.{verb}")
        if m in sources
    ]
    if not starts:
        raise ValueError(
            f"{root} has no verb {verb!r}: no deal_hw/cli/{verb}.py and no deal_hw/workflows/{verb}.py"
        )
    closures = {
        "target": closure(seen, starts),
        "at_load": closure(module_graph(sources, ("load",)), starts),
        "with_tables": closure(module_graph(sources, ("load", "call", "text")), starts),
    }
    constants = numeric_constants(inside, sources)
    candidates = solve_loops(inside, sources)
    settings = settings_classes(inside, sources, root)
    replaced = replaced_by_tests(sources, root)
    return {
        "format": FORMAT,
        "folder": folder,
        "verb": verb,
        "summary": {
            "product lines": sum(map(_lines, sources.values())),
            f"{folder}/ lines": sum(map(_lines, inside.values())),
            f"{folder}/ files": len(inside),
            f"{folder}/ rooms": len(rooms),
            f"{folder}/ edges between rooms": sum(map(len, rooms.values())),
            f"{folder}/ levels": levels(rooms),
            f"{folder}/ files behind {verb}": len(closures["target"] & set(inside)),
            f"{folder}/ files behind {verb}, at load": len(closures["at_load"] & set(inside)),
            f"{folder}/ files behind {verb}, with tables": len(closures["with_tables"] & set(inside)),
            "circles of modules": len(circles(typed)),
            "circles of modules, without TYPE_CHECKING": len(circles(seen)),
            f"{folder}/ circles of rooms": len(circles(rooms)),
            f"{folder}/ numeric module constants": len(constants),
            f"{folder}/ numeric module constants, literal": sum(c["literal"] for c in constants),
            f"{folder}/ numeric module constants, UPPER_CASE": sum(c["name"].isupper() for c in constants),
            f"{folder}/ settings classes": len(settings),
            f"{folder}/ settings classes that nobody gives an argument": sum(not s.set_by for s in settings),
            f"{folder}/ settings fields": sum(len(s.fields) for s in settings),
            f"{folder}/ settings fields that nobody sets": sum(len(s.unset) for s in settings),
            "constants and settings that tests replace": len(replaced),
            f"{folder}/ least-squares candidates": len(candidates),
            f"{folder}/ least-squares candidates, accepting": sum(c["accepting"] for c in candidates),
            "lines of tools/": _lines_below(root / "tools"),
            "lines of tests/": _lines_below(root / "tests"),
        },
        "lines_by_package": lines_by_package(sources),
        "rooms": {room: sorted(needs) for room, needs in sorted(rooms.items())},
        "closure": {name: sorted(found & set(inside)) for name, found in closures.items()},
        "circles": circles(typed),
        "circles_without_types": circles(seen),
        "circles_of_rooms": circles(rooms),
        "numeric_constants": constants,
        "settings": [one.as_row() for one in settings],
        "replaced_by_tests": replaced,
        "least_squares_candidates": candidates,
    }


def _package_of(sources: Mapping[str, SourceFile], folder: str) -> str:
    """Return the package that lies in a folder, which may be named from the root or from inside deal_hw."""
    wanted = folder.strip("/")
    for file in sources.values():
        if file.path.name == "__init__.py" and str(file.path.parent) in {wanted, f"deal_hw/{wanted}"}:
            return file.module
    raise ValueError(f"there is no package in folder {folder!r}; name one such as calib, drivers/go2 or sim")


def _lines(file: SourceFile) -> int:
    return len(file.text.splitlines())


def _lines_below(folder: Path) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py"))


def lines_by_package(sources: Mapping[str, SourceFile]) -> dict[str, int]:
    """Return lines of the files that lie directly in each folder, by the folder's path."""
    found: dict[str, int] = {}
    for file in sources.values():
        folder = str(file.path.parent)
        found[folder] = found.get(folder, 0) + _lines(file)
    return dict(sorted(found.items()))


def room_graph(graph: Graph, package: str) -> Graph:
    """Return the edges between the rooms of a package."""

    def room_of(module: str) -> str | None:
        if module == package:
            return "__init__"
        return module[len(package) + 1 :].split(".")[0] if module.startswith(f"{package}.") else None

    rooms = dict(contracted(graph, room_of))
    if not rooms.get("__init__") and not any("__init__" in needs for needs in rooms.values()):
        rooms.pop("__init__", None)
    return rooms


def numeric_constants(
    inside: Mapping[str, SourceFile], sources: Mapping[str, SourceFile]
) -> list[dict[str, Any]]:
    """Return the module-level names that are bound to numbers, with file and value."""
    names: dict[str, set[str]] = {}
    found: dict[tuple[str, str], dict[str, Any]] = {}
    # Repeated until nothing is added, because a constant may use another file's.
    while True:
        before = len(found)
        for file in inside.values():
            known = names.setdefault(file.module, set())
            for (theirs, ours), origin in _imported_names(file, sources):
                if theirs in names.get(origin, ()):
                    known.add(ours)
            for name, value in _bindings(file.tree.body):
                if _is_numeric(value, known, literal=False):
                    known.add(name)
                    found[(str(file.path), name)] = {
                        "file": str(file.path),
                        "name": name,
                        "value": ast.unparse(value)[:100],
                        "literal": _is_numeric(value, set(), literal=True),
                    }
        if len(found) == before:
            return [found[key] for key in sorted(found)]


def _imported_names(
    file: SourceFile, sources: Mapping[str, SourceFile]
) -> Iterator[tuple[tuple[str, str], str]]:
    """Yield ((name there, name here), module) of each `from module import name` at the top of a file."""
    for node in file.tree.body:
        if isinstance(node, ast.ImportFrom):
            for found in imports(node):
                for origin in targets(found, file.package, sources):
                    yield from (((alias.name, alias.asname or alias.name), origin) for alias in node.names)


def _bindings(body: Sequence[ast.stmt]) -> Iterator[tuple[str, ast.expr]]:
    """Yield each name that statements at module level bind, with its value."""
    for node in body:
        if isinstance(node, ast.If):
            yield from _bindings([*node.body, *node.orelse])
        elif isinstance(node, ast.Try):
            yield from _bindings([*node.body, *node.orelse, *node.finalbody])
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
            yield node.target.id, node.value
        elif isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Name):
                    yield target.id, node.value
                elif isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    for one, value in zip(target.elts, node.value.elts, strict=False):
                        if isinstance(one, ast.Name):
                            yield one.id, value


def _is_numeric(node: ast.expr, known: set[str], *, literal: bool) -> bool:
    """Return whether an expression is made of numbers; if asked, without names and calls."""

    def all_numeric(parts: Sequence[ast.expr]) -> bool:
        return bool(parts) and all(_is_numeric(part, known, literal=literal) for part in parts)

    match node:
        case ast.Constant(value=value):
            return isinstance(value, int | float | complex) and not isinstance(value, bool)
        case ast.UnaryOp(operand=operand):
            return all_numeric([operand])
        case ast.BinOp(left=left, right=right):
            return all_numeric([left, right])
        case ast.Tuple(elts=parts) | ast.List(elts=parts) | ast.Set(elts=parts) | ast.Dict(values=parts):
            return all_numeric(parts)
    if literal:
        return False
    match node:
        case ast.Name(id=name):
            return name in known
        case ast.Starred(value=inner) | ast.Subscript(value=inner):
            return all_numeric([inner])
        case ast.Attribute():
            return ast.unparse(node).split(".")[0] in NUMERIC_ROOTS
        case ast.Call(func=func, args=args, keywords=keywords):
            called = ast.unparse(func)
            if called not in NUMERIC_CALLS and called.split(".")[0] not in NUMERIC_ROOTS:
                return False
            return all_numeric([*args, *(k.value for k in keywords if k.arg != "dtype")])
    return False


def solve_loops(inside: Mapping[str, SourceFile], sources: Mapping[str, SourceFile]) -> list[dict[str, Any]]:
    """Return the functions that solve linear systems in a loop or comprehension."""
    functions = {(m, node.name): node for m, file in sources.items() for node in _functions(file.tree)}
    solving = {key for key, node in functions.items() if any(_is_solve(n) for n in ast.walk(node))}
    found = []
    for module, file in inside.items():
        here = {name: key for key in solving for name in (key[1], f"self.{key[1]}") if key[0] == module}
        for (theirs, ours), origin in _imported_names(file, sources):
            if (origin, theirs) in solving:
                here[ours] = (origin, theirs)
        for function in _functions(file.tree):
            loops = [n for n in ast.walk(function) if isinstance(n, LOOPS)]
            solvers = {call for loop in loops for call in _solve_calls(loop, here, function.name)}
            if solvers:
                found.append(
                    {
                        "function": f"{file.path}:{function.name}",
                        "line": function.lineno,
                        "solves_by": sorted(solvers),
                        "accepting": any(
                            _accepts(n) for n in loops if list(_solve_calls(n, here, function.name))
                        ),
                    }
                )
    return sorted(found, key=lambda row: (row["function"], row["line"]))


def _functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    return (node for node in ast.walk(tree) if isinstance(node, FUNCTIONS))


def _is_solve(node: ast.AST) -> bool:
    """Return whether a node calls a linear solver of a library; a bare ``solve`` may be ours."""
    if not isinstance(node, ast.Call):
        return False
    called = ast.unparse(node.func)
    root, _, name = called.rpartition(".")
    if name not in SOLVERS:
        return False
    return "linalg" in root or (not root and name in SOLVERS - {"solve"})


def _solve_calls(loop: ast.AST, here: Mapping[str, tuple[str, str]], own: str) -> Iterator[str]:
    """Yield the solving calls in a loop; recursive calls are ignored."""
    for node in ast.walk(loop):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if _is_solve(node) or (called in here and called.removeprefix("self.") != own):
                yield called


def _accepts(loop: ast.AST) -> bool:
    """Return whether a loop leaves or skips on a comparison."""
    return isinstance(loop, ast.For | ast.While) and any(
        isinstance(node, ast.If)
        and any(isinstance(part, ast.Compare) for part in ast.walk(node.test))
        and any(isinstance(part, ast.Break | ast.Return | ast.Continue) for part in ast.walk(node))
        for node in ast.walk(loop)
    )


def print_counts(counted: Mapping[str, Any]) -> None:
    """Print the summary."""
    for name, value in counted["summary"].items():
        print(f"{value:8d}  {name}")
    print("\nlines of packages")
    for name, value in counted["lines_by_package"].items():
        print(f"{value:8d}  {name}")
    for title, key in (
        ("circles of modules", "circles"),
        ("circles of modules, without TYPE_CHECKING", "circles_without_types"),
        (f"circles of rooms of {counted['folder']}/", "circles_of_rooms"),
    ):
        print(f"\n{title}")
        print("\n".join(f"  {', '.join(circle)}" for circle in counted[key]) or "  none")
    print("\nsettings fields that nobody sets")
    for row in counted["settings"]:
        unset = [name for name, places in row["fields"].items() if not places]
        if unset:
            print(f"  {row['file']} {row['class']}: {', '.join(unset)}")
    print("\nreplaced by tests")
    print("\n".join(f"  {row}" for row in counted["replaced_by_tests"]) or "  none")
    print("\nleast-squares candidates, for a person to judge")
    for row in counted["least_squares_candidates"]:
        mark = "accepting" if row["accepting"] else ""
        print(f"  {mark:9s}  {row['function']} (line {row['line']}) by {', '.join(row['solves_by'])}")


def print_comparison(before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Print two summaries side by side; a missing value shows a dash."""
    names = list(dict.fromkeys([*before["summary"], *now["summary"]]))
    width = max(map(len, names))
    print(f"{'':{width}s} {'before':>8s} {'now':>8s}  ratio")
    for name in names:
        old, new = before["summary"].get(name), now["summary"].get(name)
        ratio = f"{new / old:6.2f}" if old and new is not None else ""
        shown = ["-" if value is None else str(value) for value in (old, new)]
        print(f"{name:{width}s} {shown[0]:>8s} {shown[1]:>8s} {ratio}")


if __name__ == "__main__":
    sys.exit(main())
