"""Output of `deal-hw calibrate`: a progress bar, then the result."""

from __future__ import annotations

import contextlib
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from deal_hw.calibration import FAILED_CHECKS, CalibrationResult, Progress, ProgressCallback
from deal_hw.cli.piped import PipedProgress
from deal_hw.findings import Finding
from deal_hw.workflows.calibration.settings import HELDOUT_WINDOW_S

TABLE_WIDTH = 100
ALARM_LINES = 20
"""Most lines of alarms and verdict: they fit a terminal of 24 lines, above the prompt."""
CHI2 = "chi2 is the squared prediction error over that of the sensor noise; chi2 1: sensor noise only"


@contextlib.contextmanager
def show_progress(title: str, quiet: bool) -> Iterator[ProgressCallback]:
    """Show a progress bar on a terminal; elsewhere a line every ten seconds. Explain chi2 once."""
    explained = False

    def explain(p: Progress, say: Callable[[str], None]) -> None:
        nonlocal explained
        if not explained and "chi2" in p.message:
            explained = True
            say(CHI2)

    if quiet or not sys.stderr.isatty():
        with PipedProgress(title, quiet) as piped:

            def note(p: Progress) -> None:
                explain(p, piped.say)
                piped.at(f"{p.stage} {p.done}/{p.total}" + (f", {p.message}" if p.message else ""))

            yield note
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None, note="")

        def report(p: Progress) -> None:
            explain(p, bar.console.print)
            bar.update(
                task, description=f"{title}: {p.stage}", completed=p.done, total=p.total, note=p.message
            )

        yield report


def print_files(files: Mapping[str, Path]) -> None:
    """Print the written files, each folder once, and which to open."""
    folders: dict[Path, list[str]] = {}
    for path in files.values():
        folders.setdefault(path.parent, []).append(path.name)
    for folder, names in folders.items():
        print(f"written to {folder}: {', '.join(names)}")
    if "report.html" in files:
        print(f"see all results: open {files['report.html']} in a browser")


def print_lost(result: CalibrationResult) -> None:
    """Print the laws of actuators that the tables of other simulators cannot express, if there are any."""
    from deal_hw.sim.mjcf.exports import laws_without_a_field

    if lost := laws_without_a_field(result):
        print(
            f"Isaac Lab, mjlab and a URDF have no field for {', '.join(lost)}: their tables are without "
            "(`cannot_express`); calibrated.xml with deal_hw.sim.actuators.ActuatorLaws has them"
        )


def print_plain(result: CalibrationResult) -> None:
    """Print what the calibrated model for MuJoCo alone has of the laws, if there is one."""
    from deal_hw.sim.plain_model import FACTS, PLAIN_MODEL, difference_words

    facts = result.provenance.get(FACTS, {})
    if "error" in facts:
        print(f"there is no {PLAIN_MODEL}: {facts['error']}")
        return
    if not (facts.get("has") or facts.get("lacks")):
        return
    has, lacks = ("; ".join(facts[name]) or "none" for name in ("has", "lacks"))
    words = difference_words(facts)
    print(
        f"{PLAIN_MODEL} is the model for MuJoCo without deal-hw. Laws in it: {has}. Not in it: "
        f"{lacks}.{words and ' ' + words[0].upper() + words[1:] + '.'}"
    )


def print_result(result: CalibrationResult, advice: str, name: str = "") -> None:
    """Print the parameters, what the data do not determine, what to record next, and the held-out error.

    Args:
        result: The result.
        advice: How to get a held-out recording if there is none.
        name: Name under which `deal-hw collect` records this robot; "" if it cannot.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from deal_hw.calib.design.advice import next_step
    from deal_hw.calib.fit.intervals import MISMATCH_CHI2

    table = Table(
        title=f"calibration by {result.method}: {result.seconds:.0f} s, chi2 {result.chi2:.3g}",
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for heading, align in (
        ("parameter", "left"),
        ("nominal", "right"),
        ("estimate", "right"),
        ("90 % interval", "left"),
        ("verdict", "left"),
    ):
        table.add_column(heading, justify="right" if align == "right" else "left")
    for k, p in enumerate(result.space):
        low, high = result.interval[k]
        verdict: str = result.verdicts[k] if result.verdicts else "-"
        if p.name in result.biased:
            verdict += f", biased by {result.biased[p.name]}"
        table.add_row(
            Text(f"{p.name} [{p.unit}]"),
            f"{p.nominal:.4g}",
            result.estimate_text(p.name),
            f"{low:.4g} .. {high:.4g}",
            verdict,
        )
    low_ms, high_ms = (1e3 * v for v in result.latency_interval_s)
    latency = (f"{1e3 * result.latency_s:.2f}", f"{low_ms:.2f} .. {high_ms:.2f}")
    bias = f"biased by {result.biased['latency']}" if "latency" in result.biased else ""
    own_ms = 1e3 * result.provenance.get("model_latency_s", 0.0)
    table.add_row(Text("latency [ms]"), f"{own_ms:.4g}", *latency, bias)
    console = Console()
    # A row of long names is broken by the terminal, which is easier to read than cells that are broken.
    Console(width=max(console.width, TABLE_WIDTH)).print(table)
    for words in result.null_directions:
        console.print(f"the data do not determine: {words}")
    for words in result.prior_directions:
        console.print(words)
    dataset = result.provenance.get("dataset", "runs/first/dataset")
    # What a recording would tell was predicted by a model that does not explain this one.
    first = "next, after the causes that alarms name" if result.chi2 > MISMATCH_CHI2 else "next"
    for number, line in enumerate(next_step(result.advice, name, dataset)):
        # A command must not be wrapped: users copy it.
        console.print(line if number else f"{first}: {line}", soft_wrap=line.startswith(" "))
    for check, why in result.provenance.get(FAILED_CHECKS, {}).items():
        console.print(f"check of {check}: failed, {why}")
    for check, why in result.provenance.get("checks_left_out", {}).items():
        console.print(f"check of {check}: {why} (--checks all)")
    step = result.provenance.get("physics_step", {})
    if "note" in step:
        console.print(f"check of the physics step, {1e3 * step['step_s']:g} ms: {step['note']}")
    if not result.heldout_nrmse:
        console.print(f"no held-out recording: the result was not tested on other motion; {advice}")
        return
    window_s = result.provenance.get("heldout_window_s", HELDOUT_WINDOW_S)
    errors = ", ".join(f"{name} {value:.4f}" for name, value in result.heldout_nrmse.items())
    console.print(f"held-out error over the signal's range ({window_s:g} s windows): {errors}")
    rmse = result.provenance.get("heldout_rmse", {}).get("mean", {})
    if rmse:
        errors = ", ".join(
            f"{name} {'diverged' if value is None else f'{value:.4g}'}" for name, value in rmse.items()
        )
        console.print(f"held-out RMSE in rad or m, mean over the joints: {errors}")


def print_verdict(result: CalibrationResult) -> None:
    """Print the alarms, then the verdict: the last lines above the prompt are what matters most.

    Alarms take at most `ALARM_LINES` lines. Of all but the first, only what was seen is printed. Those with
    the same remedy are one entry.
    """
    from rich.console import Console
    from rich.markup import escape

    from deal_hw.calib.report.verdict import trust

    console = Console()
    width = max(console.width, 40)
    overall = trust(result)
    last = wrapped(f"{overall.colour}: {overall.sentence}", width, "")
    if result.alarms and result.alarms[0].seen not in overall.sentence:
        first = result.alarms[0]
        last += wrapped(f"first alarm: {first.seen} {first.means}", width, "  ")
        last += wrapped(f"do: {first.do}", width, "  ")
    for line in (*other_alarms(result.alarms[1:], width, ALARM_LINES - len(last)), *last):
        console.print(escape(line), highlight=False, soft_wrap=True)


def other_alarms(alarms: Sequence[Finding], width: int, room: int) -> list[str]:
    """Return what alarms saw in at most ``room`` lines, the most important one last.

    Alarms with the same remedy are one entry. What finds no room is counted, and stands in the report.
    """
    from deal_hw.calib.report.verdict import grouped

    lines: list[str] = []
    hidden = 0
    for group in grouped(alarms):
        entry = wrapped(f"alarm: {' '.join(dict.fromkeys(alarm.seen for alarm in group))}", width, "")
        if hidden or len(lines) + len(entry) + 1 > room:
            hidden += len(group)
        else:
            lines = entry + lines
    if hidden:
        lines = [f"{hidden} more alarm{'s' * (hidden > 1)}: see result.json or the report", *lines]
    return lines


def wrapped(text: str, width: int, indent: str) -> list[str]:
    """Return a text in lines; all but the first are indented by two more spaces."""
    return textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=f"{indent}  ")
