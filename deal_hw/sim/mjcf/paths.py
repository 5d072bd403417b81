"""File names inside an MJCF whose text is written to another folder: includes, meshes, textures."""

from __future__ import annotations

import os
from pathlib import Path

from deal_hw.sim.mjcf.text import Element, SourceFile

_MESH_DIR = ("mesh", "hfield", "skin", "flexcomp")
"""Elements whose file lies in the compiler's meshdir."""


class Relocation:
    """Keeps a model's references valid when its text is written to another folder.

    Unchanged included files stay in place and are referred to there; changed ones are written beside the
    output.

    Args:
        top: The model's files.
        target: The main file to write.
    """

    def __init__(self, top: SourceFile, target: Path) -> None:
        self.top = top
        self.target = Path(os.path.abspath(target))
        self.folder = self.target.parent
        self.source = top.path.parent
        self._names: dict[Path, str] = {}

    def adapt(self) -> None:
        """Rewrite the references to meshes, textures and attached models, once."""
        if self.folder == self.source:
            return
        compilers = [e for e in self.top.root.spliced() if e.tag == "compiler"]
        given = {n for e in compilers for n in ("assetdir", "meshdir", "texturedir") if n in e.given}
        for compiler in compilers:
            for name in given & set(compiler.given):
                compiler.set(name, self._moved(compiler.given[name]))
        for name, tags in (("meshdir", _MESH_DIR), ("texturedir", ("texture",))):
            needed = any(e.tag in tags and _files(e) for e in self.top.root.walk())
            if needed and not given & {name, "assetdir"}:
                self._compiler(compilers).set(name, self._moved(""))
        for element in self.top.root.walk():
            if element.tag == "model" and "file" in element.given:
                element.set("file", self._moved(element.given["file"]))

    def files(self) -> dict[Path, SourceFile]:
        """Return the files to write by path, included ones first, and point the includes to them."""
        found: dict[Path, SourceFile] = {}
        self._settle(self.top, found)
        found[self.target] = self.top
        return found

    def _settle(self, file: SourceFile, found: dict[Path, SourceFile]) -> bool:
        for element, included in file.includes:
            if self._settle(included, found):
                name = self._name(included.path)
                found[self.folder / name] = included
                element.set("file", name)
            elif os.path.abspath(self.folder / element.given["file"]) != str(included.path):
                element.set("file", os.path.relpath(included.path, self.folder))
        if file.changed:
            for element in file.elements:
                if element.tag in (*_MESH_DIR, "texture"):
                    self._beside_include(file, element)
        return file.changed

    def _name(self, path: Path) -> str:
        if path not in self._names:
            name, number = f"{self.target.stem}_{path.name}", 2
            while name in self._names.values():
                name, number = f"{self.target.stem}_{number}_{path.name}", number + 1
            self._names[path] = name
        return self._names[path]

    def _moved(self, reference: str) -> str:
        if os.path.isabs(reference):
            return reference
        return os.path.relpath(self.source / reference, self.folder)

    def _compiler(self, compilers: list[Element]) -> Element:
        if not compilers:
            compilers.append(Element("compiler"))
            self.top.root.inside.insert(0, compilers[-1])
        return compilers[-1]

    def _directory(self, element: Element) -> Path:
        """Return the folder of an asset's relative file names."""
        own = "texturedir" if element.tag == "texture" else "meshdir"
        found = ""
        for compiler in self.top.root.spliced():
            if compiler.tag == "compiler":
                found = compiler.given.get(own, compiler.given.get("assetdir", found))
        return self.source / found

    def _beside_include(self, file: SourceFile, element: Element) -> None:
        # MuJoCo looks in the asset folder first, then beside the file of the element (tested on 3.17). The
        # second place is lost when that file is copied, so it is written out.
        folder = self._directory(element)
        for name in _files(element):
            beside = file.path.parent / element.given[name]
            if not (folder / element.given[name]).is_file() and beside.is_file():
                element.set(name, os.path.relpath(beside, folder))


def _files(element: Element) -> list[str]:
    return [name for name in element.given if name.startswith("file") and element.given[name]]
