"""The climb's measurement: a policy that stands climbs nothing, and the shipped walk takes a low edge."""

from __future__ import annotations

import measure_go2_climb
import numpy as np
import pytest

from deal_hw.bench import go2_tasks
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.types import FloatArray
from deal_hw.workflows.shipped import required_policy


class Still:
    """A policy of the walk's layout without motion."""

    def __init__(self, policy: OnnxPolicy) -> None:
        self.spec = policy.spec

    def act_batch(self, observations: FloatArray) -> FloatArray:
        """Return zeros; the observation has the size that the spec says."""
        assert observations.shape[1] == len(self.spec.observation)
        return np.zeros((len(observations), 12))


@pytest.mark.slow
def test_a_low_edge_is_taken_by_walking_and_not_by_standing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 2 cm most of six robots get; who stands still gets nowhere; the interval holds the share."""
    walk = OnnxPolicy(required_policy("go2"))
    row = measure_go2_climb.measure(walk, "box", 0.02, 1, 6, blind=False)
    assert row["climbed"] >= 3 and row["tries"] == 6 and not row["told"]
    assert row["interval"][0] < row["climbed"] / 6 <= row["interval"][1]
    assert row["scuffs_per_try"] > 0 and 2.0 < row["torque_rms_nm"] < 15.0
    monkeypatch.setattr(go2_tasks, "CLIMB_S", 1.0)
    still = measure_go2_climb.measure(Still(walk), "box", 0.02, 1, 6, blind=True)
    assert still["climbed"] == 0 and still["interval"][0] == 0.0 and still["scuffs_per_try"] == 0.0


def test_a_gentle_slope_is_walked_and_nobody_tells_of_it() -> None:
    """Over a ramp of 0.1 rad the shipped walk gets in most of four tries."""
    walk = OnnxPolicy(required_policy("go2"))
    row = measure_go2_climb.measure(walk, "slope", 0.1, 1, 4, blind=False)
    assert row["climbed"] >= 3 and row["slope_rad"] == 0.1 and not row["told"]
