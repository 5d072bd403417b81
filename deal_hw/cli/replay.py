"""``deal-hw replay``: send a recording's commands again, through the safety filter."""

from __future__ import annotations

from deal_hw.cli.piped import Quiet, is_quiet
from deal_hw.cli.show import Terminal
from deal_hw.workflows.replay import REPLAY, ReplaySettings, ReplaySimulatedSettings, run
from deal_hw.workflows.running.report import RunReport

KINDS = REPLAY.with_options(Quiet)


def replay(config: ReplaySettings | ReplaySimulatedSettings) -> RunReport:
    """Run the verb; see :func:`deal_hw.workflows.replay.replay`."""
    return run(config, Terminal(is_quiet(config)))
