"""``deal-hw deploy``: run a policy on the robot behind the safety filter."""

from __future__ import annotations

from deal_hw.cli.piped import Quiet, is_quiet
from deal_hw.cli.show import Terminal
from deal_hw.workflows.deploy import DEPLOY, DeploySettings, run
from deal_hw.workflows.running.report import RunReport

KINDS = DEPLOY.with_options(Quiet)


def deploy(config: DeploySettings) -> RunReport:
    """Run the verb; see :func:`deal_hw.workflows.deploy.deploy`."""
    return run(config, Terminal(is_quiet(config)))
