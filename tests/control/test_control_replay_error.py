"""How far a replay's motion is from the recorded one, on trajectories made by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.motions.scores.replay_error import replay_error
from deal_hw.types import Trajectory

COMMANDS = 50


def trajectory(shift_s: float = 0.0, offset: float = 0.0, seconds: float = 2.0) -> Trajectory:
    """Return a cart that moves at 1 m/s, a pole at rest, 100 samples a second; commands begin at a shift."""
    time_s = np.arange(round(100 * (seconds + shift_s))) / 100
    sent_s = shift_s + np.arange(COMMANDS) * seconds / COMMANDS
    position = np.stack([time_s - shift_s + offset, np.zeros_like(time_s)], axis=1)
    flat = np.zeros((COMMANDS, 1))
    return Trajectory(
        joint_names=("cart", "pole"),
        actuated=("cart",),
        receive_s=time_s,
        device_s=time_s,
        position=position,
        velocity=np.zeros_like(position),
        effort=np.zeros_like(position),
        status=np.zeros(len(time_s), np.int64),
        command_sequence=np.zeros(len(time_s), np.int64),
        command_age_s=np.zeros(len(time_s)),
        sent_s=sent_s,
        sent_sequence=np.arange(COMMANDS),
        requested_position=flat,
        position_target=flat,
        stiffness=flat,
        damping=flat,
        effort_limit=flat,
        speed_limit=flat,
        events=(),
        metadata={},
    )


@pytest.mark.parametrize("before_s", [0.0, 0.5])
def test_the_same_motion_has_no_error(before_s: float) -> None:
    """Whenever its commands began, and after standing up."""
    replayed = trajectory(shift_s=0.3 + before_s)
    replayed = dataclasses.replace(replayed, sent_s=replayed.sent_s - before_s)
    found = replay_error(trajectory(0.1), replayed, before_s)
    assert found is not None
    np.testing.assert_allclose(found.position, (0.0, 0.0), atol=1e-9)
    assert found.seconds == pytest.approx(1.96, abs=0.05)


def test_an_offset_is_the_error() -> None:
    """0.02 m in each sample: 0.02 m root mean square."""
    found = replay_error(trajectory(), trajectory(offset=0.02))
    assert found is not None and found.joint_names == ("cart", "pole")
    np.testing.assert_allclose(found.position, (0.02, 0.0), atol=1e-9)


def test_nothing_in_common_is_no_error() -> None:
    """A replay without commands, or that ended at once."""
    whole = trajectory()
    none = dataclasses.replace(whole, sent_s=np.zeros(0))
    assert replay_error(whole, none) is replay_error(none, whole) is None
    early = dataclasses.replace(whole, receive_s=whole.receive_s - 5.0)
    assert replay_error(whole, early) is None
