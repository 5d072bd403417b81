"""``deal-hw replay``: send a recording's commands again, through the safety filter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from deal_hw.cli.show import Terminal
from deal_hw.workflows.replay import ReplaySettings, run
from deal_hw.workflows.running.report import RunReport


@dataclass(frozen=True, kw_only=True)
class Replay(ReplaySettings):
    """Send a recording's commands again, through the safety filter, and record what happens."""

    episode: tyro.conf.Positional[Path]

    quiet: bool = False
    """Print nothing but errors."""


def replay(config: Replay) -> RunReport:
    """Run the verb; see :func:`deal_hw.workflows.replay.replay`."""
    return run(config, Terminal(config.quiet))
