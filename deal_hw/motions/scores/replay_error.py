"""Difference between a replayed motion and the recorded one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.types import FloatArray, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayError:
    """The difference of two recordings of the same commands.

    Attributes:
        joint_names: The J joints.
        position: Root mean square of the difference of each joint's positions, (J,) [rad, or m].
        seconds: The time compared [s].
    """

    joint_names: tuple[str, ...]
    position: FloatArray
    seconds: float


def replay_error(recorded: Trajectory, replayed: Trajectory, before_s: float = 0.0) -> ReplayError | None:
    """Compare positions from the first command on, by the host's clock.

    Args:
        recorded: The original recording.
        replayed: The recording of the replay.
        before_s: Duration of standing up in the replay [s].

    Returns:
        None if the two have fewer than two samples in common.
    """
    if not all(
        one.size for one in (recorded.sent_s, replayed.sent_s, recorded.receive_s, replayed.receive_s)
    ):
        return None
    before, after = (
        recorded.receive_s - recorded.sent_s[0],
        replayed.receive_s - replayed.sent_s[0] - before_s,
    )
    end_s = min(before[-1], after[-1], recorded.sent_s[-1] - recorded.sent_s[0])
    common = (after >= max(0.0, before[0])) & (after <= end_s)
    if np.count_nonzero(common) < 2:
        return None
    there = np.stack([np.interp(after[common], before, column) for column in recorded.position.T], axis=1)
    difference = replayed.position[common] - there
    return ReplayError(
        joint_names=replayed.joint_names,
        position=np.sqrt(np.mean(np.square(difference), axis=0)),
        seconds=float(after[common][-1] - after[common][0]),
    )
