"""Faults of an emulated controller of ros2_control; the command line has them as options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from deal_hw.ranges import Checked, Range


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerFaults(Checked):
    """Faults of the controller of ros2_control, whose times count from the first command."""

    controller_off_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """ros2_control: the controller is deactivated after this time; its drives hold their set-points [s]."""

    controller_off_s: Annotated[float, Range(0, 1e7, "s")] = 2.0
    """ros2_control: how long it is inactive [s]."""

    silent_manager: bool = False
    """ros2_control: the controller_manager says nothing of its controllers, as before ROS 2 Jazzy."""
