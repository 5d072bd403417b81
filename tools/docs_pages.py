"""Pages of the site that are made from the sources while `mkdocs build` runs (a hook of mkdocs.yml).

- ``reference/cli.md``: every verb and option, from the parser of the command line;
- ``reference/api.md`` and ``reference/api-*.md``: every public name of ``deal_hw``, then the contracts, for
  mkdocstrings;
- ``reference/alarms.md``: every alarm of a calibration, from the calls that make one;
- ``reference/errors.md``: every refusal, from the sources by tools/refusals.py;
- ``how-to/examples.md``: the files of examples/;
- ``contributing.md`` and ``changelog.md``: CONTRIBUTING.md and CHANGELOG.md with links for the site.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import itertools
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, cast

if str(Path(__file__).parent) not in sys.path:  # mkdocs loads a hook by its path.
    sys.path.append(str(Path(__file__).parent))

from refusals import EXIT_ERROR, Refusal, refusals, words
from syntax import dotted, walk

from deal_hw.workflows.kinds import Kinds

ROOT = Path(__file__).resolve().parents[1]
ALARM_FOLDERS = ("calib", "deal_hw")

API_NAMES = {
    "Calibrate": ("calibrate", "Calibration", "design_excitation"),
    "Record a robot": ("collect",),
    "Run a robot": ("deploy",),
    "Replay a recording": ("replay", "RunReport"),
    "Options of a run": (
        "LinkOptions",
        "Go2LinkOptions",
        "B2LinkOptions",
        "G1LinkOptions",
        "CraneOptions",
        "LegOptions",
        "SimulationOptions",
        "WireOptions",
    ),
    "Check a robot": ("doctor",),
    "Stop a robot": ("stop", "StopReport"),
    "Emulate a robot": ("emulate", "EmulatedRobot"),
    "Describe a robot": ("new_robot", "check_robot", "RobotCheck", "lock_joints", "LockedJoints"),
    "Train and inspect": ("train", "Training", "train_seeds", "SeedTrainings", "inspect", "Inspection"),
    "Policies of others": ("import_policy", "check_policy", "PolicyReport"),
}
"""Pages of the API with names of ``deal_hw`` itself."""

ENGINE_NAMES = {
    "Calibration problem": (
        "Problem",
        "WindowData",
        "MemberPrediction",
        "longest_windows",
        "part_of",
        "samples_in",
        "Kind",
        "default_space",
        "with_doubts",
        "HeldOut",
        "HeldoutErrors",
    ),
    "Residuals and solvers": (
        "Shooting",
        "Point",
        "Normal",
        "OwnResidual",
        "Following",
        "LeastSquares",
        "SolverSettings",
        "minimise",
        "value_bounds",
        "null_space",
        "NullSpace",
    ),
    "Fits and intervals": (
        "refine",
        "Refined",
        "refined_at",
        "at_parameters",
        "fit_output_error",
        "OutputErrorFit",
        "Recipe",
        "uncertainty_at",
        "uncertainty",
        "Uncertainty",
        "with_rows",
    ),
}
"""Pages of the API with names of ``deal_hw.calib.api``, without the contracts."""

API_MODULES = {
    "Types, errors, clock": ("types", "errors", "clock"),
    "Robot contracts": ("robot", "transport", "description"),
    "Policy contracts": ("policy", "training"),
    "Calibration contracts": ("parameters", "calibration"),
    "Test suites": (
        "testing.robot_suite",
        "testing.transport_suite",
        "testing.method_suite",
        "testing.trainer_suite",
    ),
}
"""Pages of the API with modules: what a new robot, transport, method or trainer uses and inherits."""

PLAIN = {"", "required"}
"""Defaults that are no values."""

Sections = dict[str, list[tuple[str, str, str]]]
"""Title of a group of options -> option, text, default."""


def cell(text: str) -> str:
    """Return text for a cell of a Markdown table: one line, without HTML, pages of the docs as links."""
    text = re.sub(r"\s+", " ", text).strip()
    text = (
        text.replace("&", "&amp;")
        .replace("<", "&lt;")
        .replace("|", "\\|")
        .replace("*", "\\*")
        .replace("[", "&#91;")
    )
    return re.sub(r"docs/((?:[\w-]+/)?([\w-]+))\.md", r"[\2](../\1.md)", text)


def code(text: str) -> str:
    """Return text as code in a cell of a Markdown table."""
    return "`" + re.sub(r"\s+", " ", text).replace("`", "'").replace("|", "\\|") + "`"


def options(parser: argparse.ArgumentParser) -> Sections:
    """Return the groups of a parser with a row for each argument and option."""
    sections: Sections = {}
    for group in parser._action_groups:
        for action in group._group_actions:
            if type(action).__name__ in {"_HelpAction", "_SubParsersAction"}:  # tyro has its own argparse.
                continue
            text = action.help or ""
            match = re.search(r"\s*\((required|on by default|default: .*)\)\s*$", text, flags=re.S)
            default = match[1].removeprefix("default: ") if match else ""
            long = [option for option in action.option_strings if option.startswith("--")]
            name = ", ".join(long) or action.dest.upper()
            name = f"{name} {action.metavar or ''}".strip() if action.option_strings else name
            title = "" if group.title in {"positional arguments", "options"} else str(group.title)
            sections.setdefault(title.removesuffix(" options"), []).append(
                (name, text[: match.start()] if match else text, default)
            )
    return sections


def verb_parser(settings: Any, prog: str) -> argparse.ArgumentParser:
    """Return the parser of a dataclass of settings, as the command line builds it."""
    import tyro

    from deal_hw.cli.parsing import CONFIG, Rules

    with warnings.catch_warnings():
        # tyro warns that this function will go; constraints.txt pins the version that has it.
        warnings.simplefilter("ignore", DeprecationWarning)
        found: Any = tyro.extras.get_parser(settings, prog=prog, config=CONFIG, registry=Rules().registry)
    return cast(argparse.ArgumentParser, found)


def describe(parser: argparse.ArgumentParser, level: int) -> Iterator[str]:
    """Yield the lines of a verb, or of a kind of its input: purpose, options."""
    for paragraph in re.split(r"\n\s*\n", (parser.description or "").strip()):
        yield from (cell(paragraph), "")
    for title, rows in options(parser).items():
        if title:
            yield from (f"{'#' * (level + 1)} {parser.prog}: {title} {{ data-toc-label='{title}' }}", "")
        yield from ("| option | meaning | default |", "|---|---|---|")
        yield from (
            f"| {code(name)} | {cell(text)} | {default if default in PLAIN else code(default)} |"
            for name, text, default in rows
        )
        yield ""


def cli_page() -> str:
    """Return the reference of the command line."""
    main: ModuleType = importlib.import_module("deal_hw.cli.main")
    table: ModuleType = importlib.import_module("deal_hw.cli.verbs")
    lines = [
        "# Command line",
        "",
        "This page is made from the command line's own parser. `deal-hw VERB --help-all` prints "
        "the same; `--help` explains the common options and names the others.",
        "",
        "| verb | what it does | extra |",
        "|---|---|---|",
    ]
    lines += [
        f"| [`{name}`](#deal-hw-{name}) | {cell(verb.help)} | {code(verb.extra) if verb.extra else ''} |"
        for name, verb in table.VERBS.items()
    ]
    lines += [
        "",
        "[Install](../how-to/install.md#only-what-a-computer-needs) has the extras. If one is missing, "
        "the verb prints the line that installs it. With each verb, `--traceback` shows where an error came "
        "from.",
        "",
        f"Exit status: {main.EXIT_OK} done; {main.EXIT_ERROR} refused, and one line says why; "
        f"{main.EXIT_INTERRUPTED} stopped by Ctrl-C; {main.EXIT_PIPE} the reader of the output closed it.",
        "",
    ]
    for name, verb in table.VERBS.items():
        settings = getattr(importlib.import_module(verb.module), verb.config)
        lines += [f"## deal-hw {name}", "", f"    deal-hw {verb.example}", ""]
        if not isinstance(settings, Kinds):
            lines += describe(verb_parser(settings, f"deal-hw {name}"), 2)
            continue
        lines += [cell(f"{verb.help[:1].upper()}{verb.help[1:]}."), ""]
        for types, kinds in itertools.groupby(settings.table().items(), key=lambda item: item[1].settings):
            usages = [f"deal-hw {name} {kind.usage or word}".rstrip() for word, kind in kinds]
            lines += [f"### {', '.join(usages)}", "", *describe(verb_parser(types, usages[0]), 3)]
    return "\n".join(lines)


def public_names(package: ModuleType) -> list[str]:
    """Return the full names of the functions and classes that a package offers."""
    values = [getattr(package, name) for name in dir(package) if not name.startswith("_")]
    own = [value for value in values if getattr(value, "__module__", "").startswith("deal_hw.")]
    functions = [value for value in own if not isinstance(value, type)]
    classes = [value for value in own if isinstance(value, type)]
    return [f"{value.__module__}.{value.__qualname__}" for value in (*functions, *classes)]


def api_place(title: str) -> str:
    """Return the place of a page of the API in the site."""
    return f"reference/api-{re.sub('[^a-z]+', '-', title.lower())}.md"


def api_pages() -> dict[str, str]:
    """Return the reference of the Python API, for mkdocstrings: a start page, and a page a subject."""
    import deal_hw
    from deal_hw.calib import api

    full = {name.rpartition(".")[2]: name for name in (*public_names(api), *public_names(deal_hw))}
    found = {"reference/api.md": api_start(full)}
    for title, names in API_NAMES.items():
        lines = [f"# {title}", "", "[All pages of the API](api.md)", ""]
        for name in names:
            lines += reference(full[name], f"deal_hw.{name}")
            settings = getattr(getattr(deal_hw, name), "settings", None)
            heading = f"Arguments of deal_hw.{name}"
            of_kinds: dict[type[Any], list[str]] = {settings: []} if isinstance(settings, type) else {}
            if isinstance(settings, Kinds):
                for word, kind in settings.table().items():
                    of_kinds.setdefault(kind.settings, []).append(word or "no robot")
            for one, robots in of_kinds.items():
                of_robots = f"{heading} for {', '.join(robots)}" if robots else heading
                lines += reference(f"{one.__module__}.{one.__qualname__}", of_robots, inherited=True)
        found[api_place(title)] = "\n".join(lines)
    for title, names in ENGINE_NAMES.items():
        lines = [f"# {title}", "", "[All pages of the API](api.md)", ""]
        for name in names:
            lines += reference(full[name], f"deal_hw.calib.api.{name}")
        found[api_place(title)] = "\n".join(lines)
    for title, modules in API_MODULES.items():
        lines = [f"# {title}", "", "[All pages of the API](api.md)", ""]
        for module in modules:
            lines += [f"::: deal_hw.{module}", "    options:", "      heading_level: 2", ""]
        found[api_place(title)] = "\n".join(lines)
    return found


def api_start(full: Mapping[str, str]) -> str:
    """Return the start page of the API: what is on which page.

    Args:
        full: The full name of each public name of ``deal_hw`` and ``deal_hw.calib.api``.
    """
    lines = [
        "# Python API",
        "",
        "[From Python](../how-to/python.md) shows how to use it, and [Your own residual, parameter or "
        "solver](../how-to/own-calibration-engine.md) the engine's pieces. These pages are made from the "
        "docstrings.",
        "",
        "| page | has |",
        "|---|---|",
    ]
    tables = ("deal_hw", API_NAMES), ("deal_hw.calib.api", ENGINE_NAMES)
    for package, title, names in ((of, *row) for of, table in tables for row in table.items()):
        place = Path(api_place(title)).name
        links = ", ".join(f"[`{package}.{name}`]({place}#{full[name]})" for name in names)
        lines.append(f"| [{title}]({place}) | {links} |")
    for title, modules in API_MODULES.items():
        place = Path(api_place(title)).name
        summaries = []
        for module in modules:
            source = importlib.import_module(f"deal_hw.{module}").__doc__ or ""
            summaries.append(
                f"[`deal_hw.{module}`]({place}#deal_hw.{module}): {cell(source.splitlines()[0])}"
            )
        lines.append(f"| [{title}]({place}) | {'<br>'.join(summaries)} |")
    return "\n".join(lines)


def reference(name: str, heading: str, *, inherited: bool = False) -> list[str]:
    """Return the lines by which mkdocstrings describes a function or class."""
    return [
        f"::: {name}",
        "    options:",
        f"      heading: {heading}",
        f"      toc_label: {heading}",
        "      heading_level: 2",
        *(["      members_order: source", "      inherited_members: true"] if inherited else []),
        "",
    ]


def errors_page(found: Iterable[Refusal]) -> str:
    """Return the page of the refusals that end a command, by file."""
    lines = [
        "# Error messages",
        "",
        "This page lists every message with which a command of deal-hw ends (exit status 2), by the file "
        "that raises it. Search it for a part of your message without values: `…` stands for a value. "
        "[Troubleshooting](../troubleshooting.md) explains the frequent messages.",
        "",
    ]
    ending = (one for one in found if one.exit_code == EXIT_ERROR and one.words)
    for path, group in itertools.groupby(ending, key=lambda one: one.path):
        rows = (f"| `{one.kind}` | {cell(shortened(one.words))} |" for one in group)
        lines += [f"## {path}", "", "| error | message |", "|---|---|", *rows, ""]
    return "\n".join(lines)


def shortened(text: str) -> str:
    """Return text with an ellipsis for each value that is known at run time only, and with pages by name."""
    text = re.sub(r"\{page\('([^']+)'\)\}", r"docs/\1", text)
    out, depth = [], 0
    for sign in text:
        depth += sign == "{"
        if not depth:
            out.append(sign)
        elif sign == "}":
            depth -= 1
            out += ["…"] if not depth else []
    return "".join(out)


def alarms() -> list[tuple[str, ...]]:
    """Return every alarm: the file that raises it, what was seen, what it means, what to do."""
    found = []
    for folder in ALARM_FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            for node in walk(ast.parse(text)) if "Finding.alarm" in text else ():
                if isinstance(node, ast.Call) and dotted(node.func) == "Finding.alarm" and node.args:
                    parts = [shortened(words(part)) for part in node.args]
                    # An alarm without a text of its own is copied from a file or from the table of causes.
                    if parts[0].strip("…"):
                        parts = [part if part.strip("…") else "(the message says it)" for part in parts]
                        found.append((path.relative_to(ROOT).as_posix(), *parts))
    return found


def alarms_page() -> str:
    """Return the page of alarms, causes of an unexplained residual behind them."""
    from deal_hw.calib.hypotheses.cause_words import LOOKS

    lines = [
        "# Alarms",
        "",
        "This page lists all alarms. An alarm is a reason to distrust a calibration. The terminal, the "
        "report and `result.json` show it in three parts: what was seen, what it means, what to do. `…` "
        "stands for a name or a number. [Calibration](../explanation/calibration.md#alarms) has the limits.",
        "",
        "| what was seen | what it means | what to do |",
        "|---|---|---|",
        *(f"| {cell(seen)} | {cell(means)} | {cell(do)} |" for _, seen, means, do in alarms()),
        "",
        "## Causes of a residual above the noise",
        "",
        "If the model does not explain the recording, deal-hw looks for a cause. The alarm names one of "
        "these causes, the joints, and the share of the residual that it explains.",
        "",
        "| cause | the residual looks like | what it means | what to do |",
        "|---|---|---|---|",
        *(
            f"| {cause} | {cell(looks)} | {cell(means)} | {cell(do.replace('{}', '…'))} |"
            for cause, (looks, means, do) in LOOKS.items()
        ),
    ]
    return "\n".join(lines)


def moved(name: str) -> str:
    """Return a page of the repository's root with links for the site."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return text.replace("](docs/", "](").replace("](CHANGELOG.md)", "](changelog.md)")


def examples_page() -> str:
    """Return the page of examples: each script, and a link to each notebook's page."""
    lines = ["# Examples", "", "The files of `examples/`. The tests run all of them.", ""]
    for path in sorted((ROOT / "examples").glob("*.py")):
        lines += [f"## {path.name}", "", "```python", path.read_text(encoding="utf-8").rstrip(), "```", ""]
    for path in sorted((ROOT / "examples").glob("*.ipynb")):
        name = path.stem.replace("_", "-")
        lines += [f"## {path.name}", "", f"[The notebook with its output](../tutorials/{name}.md).", ""]
    return "\n".join(lines)


def pages(refused: list[Refusal]) -> dict[str, str]:
    """Return every page that is made: its place in the site and its Markdown.

    Args:
        refused: What the page of errors lists.
    """
    return {
        "reference/cli.md": cli_page(),
        **api_pages(),
        "reference/alarms.md": alarms_page(),
        "reference/errors.md": errors_page(refused),
        "how-to/examples.md": examples_page(),
        "contributing.md": moved("CONTRIBUTING.md"),
        "changelog.md": moved("CHANGELOG.md"),
    }


def on_env(env: Any, config: Any, files: Any) -> Any:
    """Use our own script for the search in pages on disk, because the plugin's is on another host."""
    config.extra["polyfills"] = ["assets/search_worker.js"]
    return env


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Show names in docstrings as names, and keep options whole where code wraps.

    mkdocstrings does not know Sphinx's roles. A browser breaks a line after the first hyphen of ``--out``.
    """
    html = re.sub(r":(?:class|func|meth|mod|attr|data|exc):(<code>)~?", r"\1", html)
    whole = r'<span class="option">\g<0></span>'
    return re.sub(
        r"<code>.*?</code>", lambda code: re.sub(r"(?<=[\s>])--[a-z][\w-]*", whole, code[0]), html, flags=re.S
    )


def on_files(files: Any, config: Any) -> Any:
    """Add the pages; mkdocs calls this once it has listed docs/."""
    from mkdocs.structure.files import File

    for place, text in pages(refusals(ROOT)).items():
        files.append(File.generated(config, place, content=text))
    return files
