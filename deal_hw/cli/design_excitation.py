"""``deal-hw design-excitation``: compute the most informative motion to play on a robot."""

from __future__ import annotations

import sys

from deal_hw.cli.piped import PipedProgress, Quiet, is_quiet
from deal_hw.workflows.design_excitation import DESIGN_EXCITATION, ExcitationReport, ExcitationSettings, run

KINDS = DESIGN_EXCITATION.with_options(Quiet)


def design_excitation(config: ExcitationSettings) -> ExcitationReport:
    """Run the verb; see :func:`deal_hw.workflows.design_excitation.design_excitation`."""
    if is_quiet(config) or sys.stderr.isatty():
        report = run(config, None if is_quiet(config) else note)
    else:
        with PipedProgress("design-excitation") as piped:
            report = run(config, lambda done, total, text: piped.at(f"{done}/{total} {text}"))
    if not is_quiet(config):
        print_design(config.robot, report)
    return report


def note(done: int, total: int, text: str) -> None:
    """Show the progress of a search."""
    print(f"\r{done}/{total} {text:<60.60}", end="" if done < total else "\n", file=sys.stderr, flush=True)


def print_design(robot: str, report: ExcitationReport) -> None:
    """Print a motion and, after a search, its predicted standard deviations beside those of plain motions."""
    if report.optimum is not None:
        _print_optimum(report)
    print(report.plan.words)
    print(
        f"written: {report.path}; play it with "
        f"`deal-hw collect {robot} --excite {report.path} --port PORT --out FOLDER`"
    )


def _print_optimum(report: ExcitationReport) -> None:
    from rich.console import Console
    from rich.table import Table

    optimum = report.optimum
    if optimum is None or report.space is None:
        return
    table = Table(title="predicted standard deviation (% of the value; in the unit on a linear scale)")
    table.add_column("parameter")
    columns = {"optimal": optimum.prediction, **optimum.references}
    for name in columns:
        table.add_column(name, justify="right")
    for k, p in enumerate(report.space):
        factor = 100.0 if p.scale == "log" else 1.0
        cells = [f"{factor * c.std[k]:.2f}" if c.usable else "-" for c in columns.values()]
        table.add_row(p.name, *cells)
    table.add_row(
        "information [nats]", *[f"{c.gain:.1f}" if c.usable else c.tripped for c in columns.values()]
    )
    Console().print(table)
    discarded = sum(optimum.tripped.values())
    reasons = "; ".join(f"{count} x {why}" for why, count in optimum.tripped.items())
    print(
        f"{optimum.tried} candidates, {discarded} discarded"
        + (f" ({reasons})" if reasons else "")
        + (f"; {report.refused} draws of parameters refused" if report.refused else "")
    )
