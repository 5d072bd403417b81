"""What a supervisor does with the robot after the death of its control process."""

from __future__ import annotations

from deal_hw.clock import Clock
from deal_hw.control.process.channel import CONNECTING, HANDING_BACK, HOMING, LOADING, STARTING
from deal_hw.control.safety.passive import PassiveConfig, Progress, make_passive, nothing
from deal_hw.robot import Robot


def passive_after(
    phase: str, robot: Robot, clock: Clock, config: PassiveConfig, progress: Progress = nothing
) -> bool:
    """Make the robot passive after the death of its control process, if that had begun to command it.

    Args:
        phase: The last phase that the control process reported.
        robot: The supervisor's own driver.
        clock: For the waiting.
        config: How the passive command is repeated.
        progress: As for :func:`~deal_hw.control.safety.passive.make_passive`.

    Returns:
        Whether the robot confirmed it; also True for one that was not touched.
    """
    untouched = (STARTING, LOADING, CONNECTING, HANDING_BACK, *(() if robot.homes_by_motor else (HOMING,)))
    return phase in untouched or make_passive(robot, clock, config, progress=progress)
