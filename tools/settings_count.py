"""Settings classes of a folder: their fields, who sets them, and what tests replace by name.

`tools/structure.py` counts with these functions; they read sources by the syntax tree.

A settings class is a dataclass whose name ends in Settings, Config or Options.
A field counts as set where code outside the class gives it a value:
    by a keyword (or in order) in a call of the class or of a class derived from it, also in ``partial``;
    by ``replace(x, field=...)`` in a file that names the class or its module;
    by the command line, for a class under ``workflows/`` or ``cli/`` (tyro sets its fields), and for a class
        that is the type of a field there;
    by text of the user, for a class in a call ``from_values(Class, ...)``: all its fields;
    by a dict of the product whose keys are fields, for a class that another one names as its ``config``: the
        tables of the training tasks.
A field that nobody sets is a constant written as a setting.

Replaced by tests: ``monkeypatch.setattr`` on a name in capitals or on a settings class of the product.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from import_graph import SourceFile

ENDINGS = ("Settings", "Config", "Options")


@dataclass(slots=True)
class SettingsClass:
    """One settings class.

    Attributes:
        name: Its name.
        file: Its file, from the root of the checkout.
        fields: Names of its own fields, in order.
        bases: Names of the classes it derives from.
        set_by: Field -> places (``product``, ``tests``, ``tools``, ``command line``,
            ``text``) that give it a value.
    """

    name: str
    file: str
    fields: list[str]
    bases: list[str]
    set_by: dict[str, set[str]] = field(default_factory=dict)

    @property
    def unset(self) -> list[str]:
        """Fields that nobody sets."""
        return [name for name in self.fields if name not in self.set_by]

    def as_row(self) -> dict[str, Any]:
        """Return it as a row of JSON."""
        return {
            "class": self.name,
            "file": self.file,
            "fields": {name: sorted(self.set_by.get(name, ())) for name in self.fields},
        }


def settings_classes(
    inside: Mapping[str, SourceFile], sources: Mapping[str, SourceFile], root: Path
) -> list[SettingsClass]:
    """Return the settings classes of a folder with the places that set their fields."""
    found = {}
    for file in inside.values():
        for node in file.tree.body:
            if isinstance(node, ast.ClassDef) and node.name.endswith(ENDINGS) and _is_dataclass(node):
                found[node.name] = _read_class(node, str(file.path))
    product = {str(file.path): file.tree for file in sources.values()}
    others = {place: _trees_below(root / place, root) for place in ("tests", "tools", "examples")}
    for place, trees in (("product", product), *others.items()):
        for tree in trees.values():
            _note_uses(tree, found, "tools" if place == "examples" else place)
    typed = {
        name for file in sources.values() if _is_shown(str(file.path)) for name in _field_types(file.tree)
    }
    tables = [keys for tree in product.values() for keys in _keys(tree)]
    configs = {name for tree in product.values() for name in _configs(tree)}
    for one in found.values():
        if _is_shown(one.file) or one.name in typed:
            _note([one], one.fields, "command line")
        if one.name in configs:
            _note([one], (key for keys in tables if keys <= set(one.fields) for key in keys), "product")
    return list(found.values())


def _is_shown(path: str) -> bool:
    """Return whether the command line takes its options from a file's settings."""
    return any(part in path for part in ("workflows/", "cli/"))


def _field_types(tree: ast.Module) -> Iterator[str]:
    """Yield the names in the types of dataclasses' fields."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and _is_dataclass(node):
            types = (part.annotation for part in node.body if isinstance(part, ast.AnnAssign))
            yield from (name.id for one in types for name in ast.walk(one) if isinstance(name, ast.Name))


def _keys(tree: ast.Module) -> Iterator[set[str]]:
    """Yield the keys of a file's dicts whose keys are all text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Dict):
            named = [ast.literal_eval(key) for key in node.keys if isinstance(key, ast.Constant)]
            if all(isinstance(name, str) for name in named):
                yield set(named)


def _configs(tree: ast.Module) -> Iterator[str]:
    """Yield the classes that a class of the file names as its ``config``."""
    for node in (part for one in tree.body if isinstance(one, ast.ClassDef) for part in one.body):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "config":
            yield ast.unparse(node.value)


def replaced_by_tests(sources: Mapping[str, SourceFile], root: Path) -> list[str]:
    """Return ``file:line name`` of each constant or settings class of ours that a test replaces."""
    trees = [*(file.tree for file in sources.values()), *_trees_below(root / "tools", root).values()]
    ours = {name for tree in trees for name in _names(tree)}
    rows = []
    for path, tree in _trees_below(root / "tests", root).items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("monkeypatch.setattr"):
                name = _replaced_name(node)
                last = name.rpartition(".")[2].strip("'\"")
                if last in ours and (last.isupper() or last.endswith(ENDINGS)):
                    rows.append(f"{path}:{node.lineno} {name}")
    return sorted(rows)


def _names(tree: ast.Module) -> Iterator[str]:
    """Yield the names that a module defines by a class or an assignment."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (part.id for one in targets for part in ast.walk(one) if isinstance(part, ast.Name))


def _replaced_name(call: ast.Call) -> str:
    """Return the name that ``setattr(module, "NAME", ...)`` or ``setattr("module.NAME", ...)`` sets."""
    texts = [str(arg.value) if isinstance(arg, ast.Constant) else ast.unparse(arg) for arg in call.args]
    return texts[0] if len(texts) < 3 else f"{texts[0]}.{texts[1]}"


def _is_dataclass(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)


def _read_class(node: ast.ClassDef, path: str) -> SettingsClass:
    fields = [
        part.target.id
        for part in node.body
        if isinstance(part, ast.AnnAssign)
        and isinstance(part.target, ast.Name)
        and not ast.unparse(part.annotation).startswith("ClassVar")
    ]
    return SettingsClass(node.name, path, fields, [ast.unparse(base) for base in node.bases])


def _trees_below(folder: Path, root: Path) -> dict[str, ast.Module]:
    return {
        path.relative_to(root).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(folder.rglob("*.py"))
    }


def _note_uses(tree: ast.Module, found: Mapping[str, SettingsClass], place: str) -> None:
    """Add a place to the fields that a file's calls set."""
    named = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    named |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        called = ast.unparse(call.func).rpartition(".")[2]
        args = call.args
        if called == "partial" and args:
            called, args = ast.unparse(args[0]).rpartition(".")[2], args[1:]
        keywords = [keyword.arg for keyword in call.keywords if keyword.arg]
        if called in found:
            lineage = list(_lineage(found[called], found))
            ordered = [name for one in reversed(lineage) for name in one.fields][: len(args)]
            _note(lineage, [*keywords, *ordered], place)
        elif called == "from_values" and args and (one := found.get(ast.unparse(args[0]))):
            _note([one], one.fields, "text")
        elif called == "replace":
            _note((one for one in found.values() if one.name in named), keywords, place)


def _lineage(one: SettingsClass, found: Mapping[str, SettingsClass]) -> Iterator[SettingsClass]:
    yield one
    for base in one.bases:
        if base in found:
            yield from _lineage(found[base], found)


def _note(classes: Iterable[SettingsClass], names: Iterable[str], place: str) -> None:
    wanted = set(names)
    for one in classes:
        for name in wanted & set(one.fields):
            one.set_by.setdefault(name, set()).add(place)
