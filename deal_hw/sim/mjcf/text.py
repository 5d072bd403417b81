"""MJCF files as text: attributes are changed in place, and every other byte stays as the user wrote it.

expat gives the byte position of each tag, so an edit replaces bytes inside one start tag. Comments, attribute
order, quotes and indentation of everything else stay. Included files are read with the file that includes
them. MuJoCo looks for them beside the main file first, then beside the file that includes them (tested on
3.17).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import escape

from deal_hw.errors import ConfigurationError

_ATTRIBUTE = re.compile(rb"""\s+([^\s=<>/]+)\s*=\s*("[^"]*"|'[^']*')""")


@dataclass(slots=True, eq=False)
class Element:
    """One element of an MJCF file, with its changes.

    Attributes:
        tag: Its name.
        given: Attributes in the file.
        start: Byte position of its start tag; -1 for a new element.
        end: Byte position of its end tag.
        children: Elements inside; those of an ``<include>`` are those of the included file's root.
        changes: Attributes to set; None to remove.
        rename: A new tag.
        inside: New elements before its first child.
        last: New elements before its end tag.
    """

    tag: str
    given: dict[str, str] = field(default_factory=dict)
    start: int = -1
    end: int = -1
    children: list[Element] = field(default_factory=list)
    changes: dict[str, str | None] = field(default_factory=dict)
    rename: str = ""
    inside: list[Element] = field(default_factory=list)
    last: list[Element] = field(default_factory=list)

    def get(self, name: str) -> str | None:
        """Return an attribute with its change."""
        return self.changes[name] if name in self.changes else self.given.get(name)

    def set(self, name: str, value: str | None) -> None:
        """Set an attribute; None removes it."""
        self.changes[name] = value

    @property
    def name(self) -> str:
        """The tag with its change."""
        return self.rename or self.tag

    @property
    def changed(self) -> bool:
        """Whether the element itself changes."""
        return (
            any(self.given.get(k) != v for k, v in self.changes.items())
            or bool(self.rename)
            or bool(self.inside or self.last)
        )

    def walk(self) -> Iterator[Element]:
        """Yield this element and all inside, in document order, included ones too."""
        yield self
        for child in self.children:
            yield from child.walk()

    def text(self, indent: bytes) -> bytes:
        """Return a new element as text; ``indent`` is the white space at the beginning of its line."""
        attributes = b"".join(
            b" %s=%s" % (k.encode(), quoted(v)) for k, v in self.changes.items() if v is not None
        )
        tag = self.name.encode()
        if not self.last:
            return b"<" + tag + attributes + b"/>"
        deeper = indent + b"  "
        inner = b"".join(deeper + child.text(deeper) for child in self.last)
        return b"<" + tag + attributes + b">" + inner + indent + b"</" + tag + b">"

    def spliced(self) -> Iterator[Element]:
        """Yield the children with included ones in place of the ``<include>``."""
        for child in self.children:
            if child.tag == "include":
                yield from child.spliced()
            else:
                yield child


def new_element(tag: str, inside: Iterable[Element] = (), **attributes: str) -> Element:
    """Return an element that no file has, with others inside."""
    element = Element(tag, last=list(inside))
    for name, value in attributes.items():
        element.set(name, value)
    return element


@dataclass(slots=True, eq=False)
class SourceFile:
    """One file of a model.

    Attributes:
        path: The file.
        text: Its bytes.
        elements: Its own elements in document order, the root first.
        includes: Its included files, with the element that includes each.
        header: Comment to put before the root element.
    """

    path: Path
    text: bytes
    elements: list[Element]
    includes: list[tuple[Element, SourceFile]] = field(default_factory=list)
    header: str = ""

    @property
    def root(self) -> Element:
        """The root element, ``<mujoco>`` or, in an included file, ``<mujocoinclude>``."""
        return self.elements[0]

    def every(self) -> Iterator[SourceFile]:
        """Yield this file and all its included files."""
        yield self
        for _, included in self.includes:
            yield from included.every()

    @property
    def changed(self) -> bool:
        """Whether any of its own elements changes."""
        return any(element.changed for element in self.elements)

    def render(self) -> bytes:
        """Return the file with all changes."""
        pieces: list[tuple[int, int, bytes]] = []
        for element in self.elements:
            if element.changed:
                pieces.extend(self._edits(element))
        if self.header:
            # Two hyphens end a comment, and the text holds the user's names.
            words = self.header.replace("--", "- -").encode()
            pieces.append((self.root.start, self.root.start, b"<!-- " + words + b" -->\n"))
        text = self.text
        for start, stop, replacement in sorted(pieces, key=lambda p: p[:2], reverse=True):
            text = text[:start] + replacement + text[stop:]
        return text

    def _edits(self, element: Element) -> Iterator[tuple[int, int, bytes]]:
        at = element.start + 1 + len(element.tag.encode())
        if element.rename:
            yield element.start + 1, at, element.rename.encode()
        left = {k: v for k, v in element.changes.items() if element.given.get(k) != v}
        while (match := _ATTRIBUTE.match(self.text, at)) is not None:
            name = match[1].decode()
            if name in left:
                value = left.pop(name)
                if value is None:
                    yield match.start(), match.end(), b""
                else:
                    yield match.start(2), match.end(2), quoted(value)
            at = match.end()
        added = b"".join(b" %s=%s" % (k.encode(), quoted(v)) for k, v in left.items() if v is not None)
        close = self.text.index(b">", at)
        alone = self.text[close - 1 : close] == b"/"
        tag, indent = element.name.encode(), self._indent(element)
        own = [child for child in element.children if element.tag != "include"]
        deeper = self._indent(own[0]) if own else indent + b"  " if indent else b""
        if alone and (element.inside or element.last):
            inner = b"".join(deeper + new.text(deeper) for new in (*element.inside, *element.last))
            yield at, close + 1, added + b">" + inner + indent + b"</" + tag + b">"
            return
        if added:
            yield at, at, added
        if element.inside and own:
            # Before the first child: a comment after the start tag stays in place.
            first = own[0].start
            yield first, first, b"".join(new.text(deeper) + deeper for new in element.inside)
        elif element.inside:
            yield close + 1, close + 1, b"".join(deeper + new.text(deeper) for new in element.inside)
        if element.last:
            # After the last child, before the white space of the end tag.
            last = len(self.text[: element.end].rstrip())
            yield last, last, b"".join(deeper + new.text(deeper) for new in element.last)
        if element.rename and not alone:
            yield element.end + 2, element.end + 2 + len(element.tag.encode()), tag

    def _indent(self, element: Element) -> bytes:
        """Return line break and white space before an element; empty within a line."""
        at = element.start
        while at > 0 and self.text[at - 1 : at] in (b" ", b"\t"):
            at -= 1
        if self.text[at - 1 : at] == b"\n":
            crlf = self.text[at - 2 : at - 1] == b"\r"
            return self.text[at - 1 - crlf : element.start]
        return b"\n" if element is self.root else b""


def quoted(value: str) -> bytes:
    """Return an attribute's value in quotes."""
    return b'"' + escape(value, {'"': "&quot;"}).encode() + b'"'


def read_files(path: Path) -> SourceFile:
    """Read a model's file and all its included files.

    Raises:
        ConfigurationError: A file is missing or not well-formed.
    """
    # Not resolved: MuJoCo looks beside a link, not beside its target.
    absolute = Path(os.path.abspath(path))
    return _read(absolute, absolute.parent)


def _read(path: Path, top: Path) -> SourceFile:
    try:
        text = path.read_bytes()
    except OSError as err:
        raise ConfigurationError(f"{path} cannot be read: {err.strerror}") from err
    file = SourceFile(path, text, _parse(path, text))
    for element in file.elements:
        reference = element.given.get("file")
        if element.tag == "include" and reference is not None:
            beside_top = top / reference
            found = beside_top if beside_top.is_file() else path.parent / reference
            included = _read(Path(os.path.abspath(found)), top)
            file.includes.append((element, included))
            element.children = included.root.children
    return file


def _parse(path: Path, text: bytes) -> list[Element]:
    if text[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise ConfigurationError(f"{path} is in UTF-16; save it as UTF-8")
    parser = expat.ParserCreate()
    elements: list[Element] = []
    stack: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, parser.CurrentByteIndex)
        elements.append(element)
        if stack:
            stack[-1].children.append(element)
        stack.append(element)

    def end(tag: str) -> None:
        stack.pop().end = parser.CurrentByteIndex

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(text, True)
    except expat.ExpatError as err:
        raise ConfigurationError(
            f"{path} is not well-formed XML ({err}), so it cannot be changed in place; MuJoCo's reader "
            "accepts more: correct that line"
        ) from err
    return elements
