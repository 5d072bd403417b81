"""``deal-hw deploy``: run a policy on the robot behind the safety filter."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from deal_hw.cli.show import Terminal
from deal_hw.workflows.deploy import DeploySettings, run
from deal_hw.workflows.running.report import RunReport


@dataclass(frozen=True, kw_only=True)
class Deploy(DeploySettings):
    """Run a policy on the robot behind the safety filter, and record it."""

    robot: tyro.conf.Positional[str]

    quiet: bool = False
    """Print nothing but errors."""


def deploy(config: Deploy) -> RunReport:
    """Run the verb; see :func:`deal_hw.workflows.deploy.deploy`."""
    return run(config, Terminal(config.quiet))
