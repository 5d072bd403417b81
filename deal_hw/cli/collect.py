"""``deal-hw collect``: record the robot during an informative motion."""

from __future__ import annotations

from dataclasses import dataclass, field

import tyro

from deal_hw.cli.show import Terminal
from deal_hw.control.loop.control_loop import Outcome
from deal_hw.motions.excitation.behaviours import RichConfig
from deal_hw.workflows.collect import CollectSettings, run
from deal_hw.workflows.running.report import RunReport


@dataclass(frozen=True, kw_only=True)
class Collect(CollectSettings):
    """Record the robot during an informative motion."""

    robot: tyro.conf.Positional[str]

    rich: tyro.conf.Suppress[RichConfig] = field(default_factory=RichConfig)

    quiet: bool = False
    """Print nothing but errors."""


def collect(config: Collect) -> RunReport:
    """Run the verb; see :func:`deal_hw.workflows.collect.collect`."""
    return run(config, Terminal(config.quiet))


def collect_and_say_next(config: Collect) -> RunReport:
    """Run the verb, and print the line that calibrates from the recordings."""
    report = collect(config)
    if report.outcome is Outcome.FINISHED and not config.quiet:
        print(f"next: deal-hw calibrate {report.dataset}")
    return report
