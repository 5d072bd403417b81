"""Check the built site: it loads nothing from other hosts, and its links are valid.

    python tools/check_site.py build/site

No network is used: for a link to another host only the form is checked. Exit status 1: there is a fault.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {
    "script": ("src",),
    "img": ("src",),
    "source": ("src",),
    "video": ("src", "poster"),
    "audio": ("src",),
    "iframe": ("src",),
    "embed": ("src",),
    "object": ("data",),
}
"""Elements whose attribute makes a browser fetch; of `link` it depends on `rel`."""
FETCHING_RELATIONS = {
    "stylesheet",
    "icon",
    "preload",
    "modulepreload",
    "prefetch",
    "preconnect",
    "dns-prefetch",
}
LOCAL_HOSTS = {"localhost", "127.0.0.1"}
STYLE_LOADS = re.compile(r"@import\s+(?:url\()?['\"]?(\S+?)['\")\s;]|url\(\s*['\"]?([^'\")]+)")


@dataclass(slots=True, kw_only=True)
class Page:
    """References of a page of the site.

    Attributes:
        anchors: Its ids and names.
        links: Targets of its links.
        loads: Addresses that a browser fetches to show it.
    """

    anchors: set[str] = field(default_factory=set)
    links: list[str] = field(default_factory=list)
    loads: list[str] = field(default_factory=list)


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.page = Page()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value for name, value in attrs if value is not None}
        self.page.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.page.links.append(values["href"])
        self.page.loads += [values[name] for name in LOADED.get(tag, ()) if name in values]
        if tag == "link" and FETCHING_RELATIONS & set(values.get("rel", "").split()):
            self.page.loads.append(values.get("href", ""))
        if "style" in values:
            self.page.loads += style_loads(values["style"])


def style_loads(text: str) -> list[str]:
    """Return the addresses that a browser fetches for a style sheet."""
    return [first or second for first, second in STYLE_LOADS.findall(text)]


def read(text: str) -> Page:
    """Return the references of a page."""
    reader = _Reader()
    reader.feed(text)
    return reader.page


def is_foreign(address: str) -> bool:
    """Whether a browser would fetch this from another host."""
    parts = urlsplit(address)
    return bool(parts.netloc) or parts.scheme in {"http", "https"}


def malformed(address: str) -> str:
    """Return the fault in the form of a link to another host; "" if there is none."""
    parts = urlsplit(address)
    host = parts.hostname or ""
    if host in LOCAL_HOSTS:
        return ""
    if parts.scheme != "https":
        return "is not https"
    if not re.fullmatch(r"(?:[a-z0-9-]+\.)+[a-z]{2,}", host):
        return "has no host name"
    return "has a space in it" if re.search(r"\s|%20", address) else ""


def complaints(root: Path) -> list[str]:
    """Return the faults of a site, a line each.

    Args:
        root: The folder that holds its index.html.
    """
    pages = {path.resolve(): read(path.read_text(encoding="utf-8")) for path in sorted(root.rglob("*.html"))}
    found = []
    for path, page in pages.items():
        place = path.relative_to(root.resolve())
        found += [f"{place}: loads {load} from another host" for load in page.loads if is_foreign(load)]
        # The page for missing addresses has links from the root of a server.
        links = [] if place.name == "404.html" else [*page.links, *page.loads]
        for link in dict.fromkeys(links):
            parts = urlsplit(link)
            if is_foreign(link):
                if link in page.links and (wrong := malformed(link)):
                    found.append(f"{place}: {link} {wrong}")
            elif not parts.scheme:
                target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
                target = target / "index.html" if target.is_dir() else target
                if not target.is_file():
                    found.append(f"{place}: {link} leads nowhere")
                elif parts.fragment and target in pages:
                    if unquote(parts.fragment) not in pages[target].anchors:
                        found.append(f"{place}: {link} names no heading of that page")
    for sheet in sorted(root.rglob("*.css")):
        found += [
            f"{sheet.relative_to(root)}: loads {load} from another host"
            for load in style_loads(sheet.read_text(encoding="utf-8"))
            if is_foreign(load)
        ]
    return found if pages else [f"{root} holds no page; build the site first: make docs"]


def main(arguments: list[str]) -> int:
    """Print the faults of the site in the given folder."""
    found = complaints(Path(arguments[0]))
    print("\n".join(found) if found else f"{arguments[0]}: links and loads are in order")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
