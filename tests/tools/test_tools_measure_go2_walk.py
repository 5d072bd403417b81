"""The shipped policy walks the emulated Go2 through driver, wire, filter and loop, in virtual time."""

from __future__ import annotations

import json

import measure_go2_walk
import numpy as np
import pytest

from deal_hw.cli.run_plan import shipped_policy
from deal_hw.policies.checkpoint import read_checkpoint
from deal_hw.policies.onnx_runtime import OnnxPolicy


@pytest.fixture(scope="module")
def policy() -> OnnxPolicy:
    """Return the policy that is deployed by default."""
    path = shipped_policy("go2")
    assert path is not None
    return OnnxPolicy(path)


@pytest.mark.slow
def test_the_shipped_policy_walks_where_it_is_told(
    policy: OnnxPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hidden robot of the profile `realistic`: no trip, ahead at 1 m/s within 0.2 m/s and 0.2 rad/s."""
    monkeypatch.setattr(measure_go2_walk, "PROFILE", ((0.0, (0.0, 0.0, 0.0)), (1.5, (1.0, 0.0, 0.0))))
    monkeypatch.setattr(measure_go2_walk, "PROFILE_S", 4.5)
    monkeypatch.setattr(measure_go2_walk, "NAMES", ("stand", "ahead"))
    row = measure_go2_walk.measure(policy, "realistic", 0, 1)
    assert (row["outcome"], row["reason"]) == ("finished", "the run is over")
    assert row["parts"]["ahead"]["ahead"] == pytest.approx(1.0, abs=0.2)
    assert row["velocity_error_m_s"] < 0.2 and row["yaw_error_rad_s"] < 0.2
    assert abs(row["parts"]["stand"]["ahead"]) < 0.15


def test_policy_record_and_checkpoint_belong_together(policy: OnnxPolicy) -> None:
    """The record is of this file; the checkpoint's networks, to fine-tune from, are those of the policy."""
    record = json.loads(policy.path.with_suffix(".json").read_text(encoding="utf-8"))
    assert record["onnx_sha256"] == policy.digest and record["spec_digest"] == policy.spec.digest()
    assert policy.path.stat().st_size < 200_000
    found = read_checkpoint(policy.path.with_suffix(".safetensors"), policy.spec)
    rng = np.random.default_rng(0)
    value = rng.standard_normal((5, len(policy.spec.observation))).astype(np.float32)
    wanted = policy.act_batch(value)
    layers = sorted({int(name.split(".")[2]) for name in found.tensors if name.startswith("actor.mlp.")})
    for layer in layers:
        weight, bias = (found.tensors[f"actor.mlp.{layer}.{part}"].numpy() for part in ("weight", "bias"))
        value = value @ weight.T + bias
        if layer != layers[-1]:
            value = np.where(value > 0, value, np.expm1(value))
    np.testing.assert_allclose(np.clip(value, -1.0, 1.0), wanted, atol=1e-5)
