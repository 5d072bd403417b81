"""List every refusal of the product: function, type and message.

    python tools/refusals.py                        # print the table; two checkouts' tables can be compared
    python tools/refusals.py --unreached COV.json   # those that no test ran, by a report of `coverage json`

A refusal is a call that makes an error: of a class of deal_hw/errors.py or of its subclasses; of
`deal_hw.schema.refusal`; or any call directly after `raise`, including helpers that make the error.
`raise error` and a bare `raise` do not count, because the error was made elsewhere. The sources are read by
their syntax tree; nothing of the product is imported.

A line of the table has function, type, exit code of `deal-hw` and the words, with `{...}` for a value and
` | ` between several arguments. Exit code "-": no error of deal-hw. Either a reader puts the words into its
own message, or it is a programmer's mistake and gives a traceback.
"""

from __future__ import annotations

import argparse
import ast
import builtins
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from syntax import children, walk

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("deal_hw", "drivers", "policies", "calib")
ERRORS = Path("deal_hw/errors.py")
EXIT_ERROR = "2"


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Refusal:
    """A call that makes an error.

    Attributes:
        path: The source, relative to the checkout.
        function: Its function, as ``Class.method``; "" at module level.
        kind: The called name: an error's class or a helper.
        words: Its arguments.
        exit_code: Exit code of `deal-hw` if nothing catches the error; "-" for none of its own.
        line: First line of the call.
        column: Column of the call.
        last_line: Its last line.
    """

    path: str
    function: str
    kind: str
    words: str
    exit_code: str
    line: int
    column: int
    last_line: int

    def text(self) -> str:
        """Return the line of the table."""
        return f"    {self.function or '(module)'}  {self.kind} {self.exit_code}  {self.words}".rstrip()


def error_classes(root: Path = ROOT) -> frozenset[str]:
    """Return the names of the classes of the error tree, those outside of errors.py among them."""
    return _error_classes(_parsed(path) for path in _sources(root))


def _error_classes(trees: Iterable[ast.Module]) -> frozenset[str]:
    bases: dict[str, set[str]] = {}
    for tree in trees:
        for node in walk(tree):
            if isinstance(node, ast.ClassDef):
                bases.setdefault(node.name, set()).update(map(_last_name, node.bases))
    known = {"DealHwError"}
    while more := {name for name, above in bases.items() if above & known} - known:
        known |= more
    return frozenset(known)


def refusals(root: Path = ROOT) -> list[Refusal]:
    """Return all refusals of a checkout, in the table's order."""
    trees = {path.relative_to(root): _parsed(path) for path in _sources(root)}
    known = _error_classes(trees.values())
    return sorted(found for path, tree in trees.items() for found in of_file(path, tree, known))


def of_file(relative: Path, tree: ast.Module, known: frozenset[str]) -> Iterator[Refusal]:
    """Yield the refusals of one source, given its path from the root."""
    for call, function in calls(tree, known, relative == ERRORS):
        kind = _last_name(call.func)
        yield Refusal(
            path=relative.as_posix(),
            function=function,
            kind=function.split(".")[0] if kind == "__init__" else kind,
            words=" | ".join(_arguments(call)),
            exit_code=EXIT_ERROR if _ends_the_command(kind, known) else "-",
            line=call.lineno,
            column=call.col_offset,
            last_line=call.end_lineno or call.lineno,
        )


def calls(tree: ast.Module, known: frozenset[str], defines: bool) -> Iterator[tuple[ast.Call, str]]:
    """Yield each call that makes an error, and the name of the function that it stands in.

    Args:
        tree: A module.
        known: Names of error classes.
        defines: It is errors.py, where a class passes its words to its base class.
    """
    waiting: list[tuple[ast.AST, str, bool]] = [(tree, "", False)]
    while waiting:
        node, function, raised = waiting.pop()
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            function = f"{function}.{node.name}".lstrip(".")
        if isinstance(node, ast.Call):
            name = _last_name(node.func)
            if raised or name in known or name == "refusal" or (defines and name == "__init__"):
                yield node, function
        chosen: list[ast.AST | None] = []
        if isinstance(node, ast.Raise):
            chosen = [node.exc]
        elif raised and isinstance(node, ast.IfExp):
            chosen = [node.body, node.orelse]
        elif raised and isinstance(node, ast.BoolOp):
            chosen = [*node.values]
        waiting += [(child, function, child in chosen) for child in reversed(children(node))]


def table(found: list[Refusal]) -> str:
    """Return the table as text."""
    lines, path = [], ""
    for refusal in found:
        if refusal.path != path:
            path = refusal.path
            lines.append(path)
        lines.append(refusal.text())
    return "\n".join(lines) + "\n"


def unreached(found: list[Refusal], coverage: Path) -> list[Refusal]:
    """Return the refusals of which no line was run, by a report of ``coverage json``."""
    files = json.loads(coverage.read_text(encoding="utf-8"))["files"]
    ran = {path: set(file["executed_lines"]) for path, file in files.items()}
    return [one for one in found if not ran.get(one.path, set()) & set(range(one.line, one.last_line + 1))]


def _ends_the_command(kind: str, known: frozenset[str]) -> bool:
    outside = getattr(builtins, kind, None)
    if isinstance(outside, type):
        # Refusals of the system end in one line, too.
        return issubclass(outside, OSError)
    # Helpers behind `raise`, and classes in variables, make errors of the tree.
    return kind in known or not kind[:1].isupper()


def _sources(root: Path) -> Iterator[Path]:
    for folder in FOLDERS:
        yield from sorted((root / folder).rglob("*.py"))


def _parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def _last_name(node: ast.AST) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ast.unparse(node)


def _arguments(call: ast.Call) -> Iterator[str]:
    for argument in call.args:
        yield words(argument)
    for keyword in call.keywords:
        yield f"{keyword.arg}={words(keyword.value)}"


def words(node: ast.AST) -> str:
    """Return the text of an argument, with `{...}` for values of the run time."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return " ".join(f"x{node.value}x".split())[1:-1]
    if isinstance(node, ast.JoinedStr):
        return "".join(words(part) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return words(node.left) + words(node.right)
    value = node.value if isinstance(node, ast.FormattedValue) else node
    return "{" + " ".join(ast.unparse(value).split()) + "}"


def main() -> int:
    """Print the table, or the refusals that no test reaches."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout")
    parser.add_argument("--unreached", type=Path, metavar="COV.json", help="a report of `coverage json`")
    given = parser.parse_args()
    found = refusals(given.root)
    if given.unreached is not None:
        left = unreached(found, given.unreached)
        sys.stdout.write(table(left))
        print(f"# {len(left)} of {len(found)} refusals: not reached by the tests that were measured")
    else:
        sys.stdout.write(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
