"""``deal_hw.stop``: make a robot passive, whoever of deal-hw commands it, and ask nothing."""

from __future__ import annotations

from deal_hw.workflows.options import from_settings
from deal_hw.workflows.stopping.robot import StopReport, run_stop
from deal_hw.workflows.stopping.settings import STOP, StopSettings

__all__ = ["StopReport", "stop"]


@from_settings(STOP)
def stop(settings: StopSettings) -> StopReport:
    """Make a robot passive, as ``deal-hw stop``: motor off, or damping. Nothing is asked.

    ``deal-hw stop ROBOT --help`` describes the arguments: ``stop("go2", port="enp2s0")``. A run on this
    computer gets a request to end, and makes its robot passive itself: two writers would fight. One whose
    processes are stopped is continued, and one that hangs is killed. If no run commands the robot, this
    program does it: it listens for other commanders first, and sends nothing while another program or the
    robot's own controller has it.

    Returns:
        Whether the robot confirmed that it is passive.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: An option would have no effect.
    """
    return run_stop(settings, settings.say)
