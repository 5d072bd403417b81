"""``deal-hw stop``: make a robot passive from any terminal."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import tyro

from deal_hw.workflows.say import to_stderr
from deal_hw.workflows.stop import StopReport, StopSettings, run_stop


@dataclass(frozen=True, kw_only=True)
class StopRobot(StopSettings):
    """Make a robot passive at once, from any terminal: motor off, or damping. Nothing is asked.

    A run on this computer gets a request to end and makes its robot passive itself. Without a run, give
    --port: this program then does it. It sends nothing while another program or the robot's own controller
    has the robot. The exit code is 0 only if the robot confirmed that it is passive.
    """

    robot: tyro.conf.Positional[str]


def stop(config: StopRobot) -> StopReport:
    """Run the verb; see :func:`deal_hw.workflows.stop.stop`."""
    report = run_stop(config, to_stderr)
    print(report.words, file=sys.stdout if report.passive else sys.stderr)
    return report
