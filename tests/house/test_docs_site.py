"""The documentation site: pages that are made, links, nothing from other hosts."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import check_site
import docs_pages
import pytest
from refusals import Refusal
from syntax import walk

import deal_hw
from deal_hw import documentation
from deal_hw.calib import api as calib_api
from deal_hw.cli.verbs import VERBS

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
FOLDERS = ("deal_hw", "calib", "drivers", "policies")


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    """The pages that are made, by their place; that of errors is empty, because it takes seconds."""
    return docs_pages.pages([])


def test_documents_link_to_files_that_exist(pages: dict[str, str]) -> None:
    """Relative links in the README, CONTRIBUTING and docs lead to a file, or to a page that is made."""
    made = {(DOCS / place).resolve() for place in pages}
    broken = []
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8")):
            place = (path.parent / target).resolve()
            if not place.exists() and place not in made:
                broken.append(f"{path.relative_to(ROOT)}: {target}")
    assert broken == []


def test_each_page_is_in_the_navigation(pages: dict[str, str]) -> None:
    """Every page that is written or made has its place, and the navigation names no other."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = re.findall(r": ([\w/-]+\.md)$", text.partition("\nnav:")[2], flags=re.M)
    written = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}
    assert sorted(named) == sorted(written | set(pages))


def test_each_verb_is_in_the_reference(pages: dict[str, str]) -> None:
    """Each verb has its section with the line that runs, and its options have rows."""
    page = pages["reference/cli.md"]
    for name, verb in VERBS.items():
        assert f"\n## deal-hw {name}\n\n    deal-hw {verb.example}\n" in page
    assert "| `--latency FLOAT` | Total latency [s] if it is known" in page.replace("&#91;", "[")
    assert "\n### deal-hw data verify\n" in page
    assert "None}" not in page and "--help" not in page.partition("## deal-hw collect")[2]
    assert "| `--transport {dds,zenoh}` |" in page and "| `--record-wire, --no-record-wire` |" in page
    assert not re.search(r"`--[\w-]+\.|\{fixed\}|<function", page)


def test_each_refusal_is_on_the_page_of_errors() -> None:
    """Messages with exit status 2 are rows below their file; others are left out."""
    made = functools.partial(Refusal, line=1, column=0, last_line=1)
    page = docs_pages.errors_page(
        [
            made(path="a/b.py", function="f", kind="DatasetError", words="{x} | is <odd>", exit_code="2"),
            made(path="a/b.py", function="g", kind="ValueError", words="no", exit_code="-"),
            made(path="c.py", function="h", kind="KeyError", words="no", exit_code="-"),
        ]
    )
    assert page.endswith(
        "## a/b.py\n\n| error | message |\n|---|---|\n| `DatasetError` | … \\| is &lt;odd> |\n"
    )


def test_each_alarm_is_on_its_page(pages: dict[str, str]) -> None:
    """Alarms of all folders are found with their three parts, and causes beside them."""
    found = docs_pages.alarms()
    assert {path for path, *_ in found} >= {
        "calib/fit/intervals.py",
        "calib/validation/checks.py",
        "deal_hw/workflows/calibration/result_folder.py",
    }
    assert all(part.strip("… ") for row in found for part in row)
    page = pages["reference/alarms.md"]
    assert "| Residuals are …. | The model does not explain the recording: " in page
    assert "\n| backlash | play in the gear | " in page


def test_values_of_run_time_are_shortened() -> None:
    """Braces inside an expression do not end it; a page's name is known before."""
    assert docs_pages.shortened("{x}: {page('how-to/add.md')} shows") == "…: docs/how-to/add.md shows"
    assert docs_pages.shortened("a {', '.join({x})} b {y}") == "a … b …"


def test_messages_name_pages_by_their_file() -> None:
    """Each page that the product names is a file of docs/: by `page(...)` in messages, `docs/...` in help."""
    named = set()
    for path in (file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in walk(ast.parse(text)) if re.search("page|docs/", text, flags=re.I) else ():
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not re.search(r"\bpages? '", node.value, flags=re.I), f"{path.name}: {node.value}"
                named |= set(re.findall(r"\bdocs/([\w-]+/[\w-]+\.md)", node.value))
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "page":
                named |= {str(part.value) for part in node.args if isinstance(part, ast.Constant)}
    assert "how-to/import.md" in named
    assert [name for name in named if not (DOCS / name).is_file()] == []


def test_a_page_is_named_so_that_it_opens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the checkout by docs/..., from elsewhere by its full path; help texts follow the same rule."""
    monkeypatch.chdir(ROOT)
    assert documentation.page("how-to/import.md") == "docs/how-to/import.md"
    monkeypatch.chdir(tmp_path)
    full = str(DOCS / "how-to/import.md")
    assert documentation.page("how-to/import.md") == full
    # Another project's docs/ is not ours.
    (tmp_path / "docs/how-to").mkdir(parents=True)
    (tmp_path / "docs/how-to/import.md").touch()
    assert documentation.page("how-to/import.md") == full
    assert documentation.with_places("see docs/how-to/import.md.") == f"see {full}."


def test_readme_is_short() -> None:
    """It has at most 100 lines; results live in docs/results."""
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 100


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Return a site of two pages whose links hold."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "index.html").write_text('<a href="sub/a.html#x">a</a><a href="https://example.org/b">b</a>')
    (tmp_path / "sub" / "a.html").write_text('<h1 id="x">x</h1><a href="../index.html">home</a>')
    return tmp_path


def test_a_site_in_order_has_no_complaint(site: Path) -> None:
    """Links between pages, to headings and to other hosts are accepted."""
    assert check_site.complaints(site) == []


@pytest.mark.parametrize(
    ("html", "complaint"),
    [
        ('<a href="b.html">', "b.html leads nowhere"),
        ('<a href="sub/a.html#y">', "sub/a.html#y names no heading of that page"),
        ('<a href="http://example.org">', "http://example.org is not https"),
        ('<a href="https://example">', "https://example has no host name"),
        (
            '<script src="https://cdn.example.org/x.js">',
            "loads https://cdn.example.org/x.js from another host",
        ),
        ('<link rel="stylesheet" href="//a.org/f.css">', "loads //a.org/f.css from another host"),
        ('<p style="background: url(https://a.org/f.png)">', "loads https://a.org/f.png from another host"),
        ('<img src="none.png">', "none.png leads nowhere"),
    ],
)
def test_what_is_wrong_with_a_site_is_said(site: Path, html: str, complaint: str) -> None:
    """Each kind of broken link or foreign load has its line."""
    (site / "index.html").write_text(html)
    assert check_site.complaints(site) == [f"index.html: {complaint}"]


def test_a_style_sheet_loads_nothing_foreign(site: Path) -> None:
    """Fonts of other hosts are found in style sheets, too."""
    (site / "a.css").write_text("@import url('https://fonts.example.org/css'); a { background: url(a.png) }")
    assert check_site.complaints(site) == ["a.css: loads https://fonts.example.org/css from another host"]


def test_no_site_is_a_complaint(tmp_path: Path) -> None:
    """An empty folder does not pass for a site."""
    assert "make docs" in check_site.complaints(tmp_path)[0]


def test_the_reference_has_the_arguments_of_each_function(pages: dict[str, str]) -> None:
    """A function of settings shows in a signature that it takes settings; its arguments are the class's."""
    text = "\n".join(text for place, text in pages.items() if place.startswith("reference/api"))
    for name in ("collect", "deploy", "train", "emulate", "inspect", "replay", "design_excitation"):
        assert re.search(rf"heading: Arguments of deal_hw\.{name}( for .*)?\n", text)
    assert "::: deal_hw.workflows.collect.CollectGo2Settings\n" in text


def test_each_public_name_is_on_one_page_of_the_api(pages: dict[str, str]) -> None:
    """The start page lists all of them; no page has everything."""
    api = {place: text for place, text in pages.items() if place.startswith("reference/api")}
    start = api.pop("reference/api.md")
    assert "::: " not in start and len(api) >= 8
    described = [line for text in api.values() for line in text.splitlines() if line.startswith("::: ")]
    assert len(described) == len(set(described))
    names = docs_pages.public_names(deal_hw)
    assert {f"::: {name}" for name in names} <= set(described)
    for name in names:
        assert f"#{name})" in start
    assert max(text.count("::: ") for text in api.values()) <= 12


def test_the_pages_have_each_piece_of_the_calibration_engine(pages: dict[str, str]) -> None:
    """What `deal_hw.calib.api` names is on a page: classes and functions one by one, contracts by module."""
    text = "\n".join(text for place, text in pages.items() if place.startswith("reference/api"))
    contracts = {"Parameter", "ParameterSpace"}
    aliases = {"Member", "Residual"}
    described = {name for names in docs_pages.ENGINE_NAMES.values() for name in names}
    assert described | contracts | aliases == set(calib_api.__all__)
    for name in described:
        assert f"heading: deal_hw.calib.api.{name}\n" in text
    assert "::: deal_hw.parameters\n" in text


def test_names_in_docstrings_are_names() -> None:
    """Sphinx's roles of the docstrings are not shown."""
    shown = docs_pages.on_page_content(
        "of :class:<code>~deal_hw.robot.Robot</code> and :meth:<code>x</code>", None, None, None
    )
    assert shown == "of <code>deal_hw.robot.Robot</code> and <code>x</code>"


def test_options_stay_whole_in_wrapped_commands() -> None:
    """A command's options are marked, and text outside of code is not."""
    shown = docs_pages.on_page_content(
        "<p>a --b</p><pre><code>c --out-dir d\n--e</code></pre>", None, None, None
    )
    whole = '<span class="option">{}</span>'.format
    assert shown == f"<p>a --b</p><pre><code>c {whole('--out-dir')} d\n{whole('--e')}</code></pre>"
