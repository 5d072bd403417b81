"""``deal-hw stop``: make a robot passive from any terminal."""

from __future__ import annotations

import sys

from deal_hw.workflows.say import to_stderr
from deal_hw.workflows.stopping.robot import StopReport, run_stop
from deal_hw.workflows.stopping.settings import STOP, StopSettings

KINDS = STOP


def stop(config: StopSettings) -> StopReport:
    """Run the verb; see :func:`deal_hw.workflows.stop.stop`."""
    report = run_stop(config, to_stderr)
    print(report.words, file=sys.stdout if report.passive else sys.stderr)
    return report
