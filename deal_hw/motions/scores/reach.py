"""How near an arm comes to the poses that it is to reach, from a recording."""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.errors import DatasetError
from deal_hw.types import FloatArray, Trajectory

JUDGED_S: Final = 0.5
"""The last part of a pose's time, in which the arm is judged [s]."""


def settled(trajectory: Trajectory, time_s: FloatArray) -> list[FloatArray]:
    """Return the recorded positions of the actuated joints at the end of each pose's time, (S, A) each [rad].

    Args:
        trajectory: The recording of a policy that follows poses.
        time_s: When each pose began, (P,) [s] since the first command.

    Raises:
        DatasetError: The recording ended before the last pose's end could be judged, or has no command.
    """
    if not trajectory.sent_s.size:
        raise DatasetError("the recording contains no command, so no pose was to be reached")
    since_s = trajectory.device_s - trajectory.sent_s[0]
    columns = [trajectory.joint_names.index(name) for name in trajectory.actuated]
    ends = np.append(time_s[1:], since_s[-1])
    found = [trajectory.position[(since_s > end - JUDGED_S) & (since_s <= end)][:, columns] for end in ends]
    if any(len(positions) == 0 for positions in found) or ends[-1] - time_s[-1] < JUDGED_S:
        raise DatasetError(
            f"the recording has {since_s[-1]:.1f} s of motion and ended before all {len(time_s)} poses"
        )
    return found
