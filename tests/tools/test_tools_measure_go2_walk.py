"""The shipped policy walks the emulated Go2 through driver, wire, filter and loop, in virtual time."""

from __future__ import annotations

import dataclasses
import json

import measure_go2_walk
import numpy as np
import pytest

from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.errors import CheckpointError
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policy import ObservationBuilder
from deal_hw.workflows.emulation.walk_script import Walk
from deal_hw.workflows.shipped import shipped_policy


@pytest.fixture(scope="module")
def policy() -> OnnxPolicy:
    """Return the policy that is deployed by default."""
    path = shipped_policy("go2")
    assert path is not None
    return OnnxPolicy(path)


@pytest.mark.slow
def test_the_shipped_policy_walks_where_it_is_told(policy: OnnxPolicy) -> None:
    """A hidden robot of the profile `realistic`: no trip, ahead at 1 m/s within 0.2 m/s and 0.2 rad/s."""
    script = Walk(((0.0, (0.0, 0.0, 0.0)), (1.5, (1.0, 0.0, 0.0))), 4.5)
    row = measure_go2_walk.measure(policy, "realistic", 0, 1, script, ("stand", "ahead"))
    assert (row["outcome"], row["reason"]) == ("finished", "the run is over")
    assert row["parts"]["ahead"]["ahead"] == pytest.approx(1.0, abs=0.2)
    assert row["velocity_error_m_s"] < 0.2 and row["yaw_error_rad_s"] < 0.2
    assert abs(row["parts"]["stand"]["ahead"]) < 0.15


def test_policy_record_and_checkpoint_belong_together(policy: OnnxPolicy) -> None:
    """The record is of this file; the checkpoint's networks, to fine-tune from, are those of the policy."""
    from deal_hw.policies.checkpoint import read_checkpoint

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


@pytest.mark.parametrize("field", ["clock_hz", "observation"])
def test_a_task_of_another_clock_or_command_scale_is_not_fine_tuned(policy: OnnxPolicy, field: str) -> None:
    """The networks would read another gait, or commands of another size: the message names what differs."""
    from deal_hw.policies.checkpoint import read_checkpoint

    spec = policy.spec
    scaled = tuple(
        dataclasses.replace(term, scale=2.0 * term.scale) if term.quantity == "command" else term
        for term in spec.observation
    )
    other = dataclasses.replace(spec, **({"clock_hz": 2.0} if field == "clock_hz" else {field: scaled}))
    with pytest.raises(CheckpointError, match=f"of a policy with another {field}"):
        read_checkpoint(policy.path.with_suffix(".safetensors"), other)


def test_a_policy_walks_by_the_clock_and_the_scale_of_its_own_spec(policy: OnnxPolicy) -> None:
    """Deployed, a policy of another clock or command scale observes those: nothing of them is the robot's."""
    spec = policy.spec
    terms = [(term.quantity, term.joint) for term in spec.observation]
    slow = dataclasses.replace(
        spec,
        clock_hz=1.0,
        observation=tuple(
            dataclasses.replace(term, scale=0.5) if term.quantity == "command" else term
            for term in spec.observation
        ),
    )
    slow.check_fits(DRIVER)
    builder = ObservationBuilder(slow)
    builder.command = np.array([0.8, 0.0, 0.0])
    position = np.concatenate([np.zeros(6), DRIVER.default_position])
    first, second = (builder.build(position, np.zeros(18)).copy() for _ in range(2))
    assert first[terms.index(("command", "x"))] == pytest.approx(0.4)
    sine, cosine = terms.index(("clock", "sin")), terms.index(("clock", "cos"))
    turned = [np.arctan2(seen[sine], seen[cosine]) for seen in (first, second)]
    assert turned[1] - turned[0] == pytest.approx(2 * np.pi * 1.0 / DRIVER.control_rate_hz, abs=1e-6)
