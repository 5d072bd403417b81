"""A training that starts from the networks of a policy which observes less."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.errors import CheckpointError
from deal_hw.policy import CLIMBED
from deal_hw.robots import recorded_description, training_task
from deal_hw.training import TrainingFiles
from deal_hw.workflows.shipped import policy_file, required_policy
from deal_hw.workflows.train import nominal_distribution

WALK = required_policy("go2").with_suffix(".safetensors")
TOLD = 2
"""Terms that a climb observes and a walk does not: distance and height of the platform."""


def climb(count: int = 4) -> Any:
    return training_task("go2", "climb").make(
        recorded_description("go2"), nominal_distribution("go2", "climb"), count
    )


def test_a_climb_starts_with_what_the_walk_does() -> None:
    """The walk's actions for the same observations, whatever is told; the new inputs have no weight."""
    from deal_hw.policies.checkpoint import read_checkpoint
    from deal_hw.policies.network_policy import NetworkPolicy
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.policies.ppo import PpoConfig, PpoLearner

    env = climb()
    learner = PpoLearner(env, PpoConfig())
    found = read_checkpoint(WALK, env.layout)
    learner.load(found, whole=False)
    assert found.notes["observed"] == len(env.layout.observation) - TOLD
    # Another task is explored anew; the same one goes on as it was.
    assert not found.notes["same_task"] and learner._exploration() == pytest.approx(PpoConfig().exploration)
    walk_env = training_task("go2").make(recorded_description("go2"), nominal_distribution("go2"), 1)
    same = PpoLearner(walk_env, PpoConfig())
    same.load(read_checkpoint(WALK, walk_env.layout), whole=False)
    assert same._exploration() < 0.3
    seen = np.random.default_rng(0).standard_normal((5, len(env.layout.observation))).astype(np.float32)
    policy = NetworkPolicy(learner.network(), env.layout)
    walk = OnnxPolicy(WALK.with_suffix(".onnx"))
    np.testing.assert_allclose(policy.act_batch(seen), walk.act_batch(seen[:, :-TOLD]), atol=1e-5)
    critic = learner._critic.state_dict()["mlp.0.weight"].numpy()
    before = found.tensors["critic.mlp.0.weight"].numpy()
    observed, more = before.shape[1], critic.shape[1] - before.shape[1] - TOLD
    at = len(walk.spec.observation)
    np.testing.assert_array_equal(critic[:, :at], before[:, :at])
    np.testing.assert_array_equal(critic[:, at + TOLD : observed + TOLD], before[:, at:])
    assert more == 15 and not critic[:, at : at + TOLD].any() and not critic[:, -more:].any()


def test_a_walk_does_not_start_from_a_policy_that_observes_more() -> None:
    """Terms may be added at the end, none may go, and a training that goes on observes what it observed."""
    from deal_hw.policies.checkpoint import read_checkpoint
    from deal_hw.policies.ppo import PpoConfig, PpoTrainer

    env = climb(1)
    fewer = dataclasses.replace(env.layout, observation=env.layout.observation[: -TOLD - 1])
    with pytest.raises(CheckpointError, match="policy with another observation"):
        read_checkpoint(WALK, fewer)
    env.layout = dataclasses.replace(
        env.layout, trained_under=read_checkpoint(WALK, env.layout).notes["trained_under"]
    )
    resumed = TrainingFiles(checkpoint=WALK, resume=True)
    with pytest.raises(CheckpointError, match="the actor has tensors"):
        PpoTrainer().train(env, PpoConfig(steps=10**9), np.random.default_rng(0), files=resumed)


@pytest.mark.parametrize("task", ["canter", "climb"])
def test_the_shipped_policies_of_further_tasks_belong_to_their_records(task: str) -> None:
    """Found by the task's name; the record is of this file, and a training may start from its checkpoint."""
    from deal_hw.policies.checkpoint import read_checkpoint
    from deal_hw.policies.onnx_runtime import OnnxPolicy

    path = policy_file("go2", task)
    assert path == required_policy("go2", task) and path.name == f"go2_{task}.onnx"
    policy = OnnxPolicy(path)
    record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert record["onnx_sha256"] == policy.digest and record["spec_digest"] == policy.spec.digest()
    env = training_task("go2", task).make(recorded_description("go2"), nominal_distribution("go2", task), 1)
    assert policy.spec.observation == env.layout.observation
    assert policy.spec.command_range == env.layout.command_range
    assert read_checkpoint(path.with_suffix(".safetensors"), env.layout).notes["same_task"]
    assert path.stat().st_size < 200_000
    if task == "climb":
        assert 0.04 <= policy.spec.training[CLIMBED] <= 0.22


def test_the_shipped_climb_with_adaptation_belongs_to_its_record() -> None:
    """It observes the climb's own terms and their history, and a training may start from its checkpoint."""
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.policies.rma import RmaConfig, RmaTrainer

    path = required_policy("go2", "climb_rma")
    policy = OnnxPolicy(path)
    record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert record["onnx_sha256"] == policy.digest and record["spec_digest"] == policy.spec.digest()
    assert (
        policy.spec.training["algorithm"] == "rma" and 0.0 < policy.spec.training["encoding_not_felt"] < 0.8
    )
    env = climb(2)
    learner = RmaTrainer().learner(env, RmaConfig())
    assert policy.spec.observation == env.layout.observation
    found = learner.read(path.with_suffix(".safetensors"), env.layout)
    learner.load(found, whole=False)
    assert found.notes["same_task"] and path.stat().st_size < 1_000_000
    seen = np.random.default_rng(0).standard_normal((5, len(env.layout.observation))).astype(np.float32)
    import torch

    with torch.no_grad():
        mine = learner.network()(torch.as_tensor(seen)).numpy()
    np.testing.assert_allclose(mine, policy.act_batch(seen), atol=1e-4)


def test_the_shipped_imitation_belongs_to_its_record() -> None:
    """It observes what the canter does; nothing of a gait was paid for."""
    from deal_hw.policies.amp import AmpConfig, AmpTrainer
    from deal_hw.policies.onnx_runtime import OnnxPolicy

    path = required_policy("go2", "canter_amp")
    policy = OnnxPolicy(path)
    record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert record["onnx_sha256"] == policy.digest and record["spec_digest"] == policy.spec.digest()
    assert policy.spec.training["algorithm"] == "amp" and 0.2 < policy.spec.training["style"] < 0.8
    assert record["task"]["schedule_weight"] == record["task"]["gait_weight"] == 0.0
    env = training_task("go2", "canter").make(
        recorded_description("go2"), nominal_distribution("go2", "canter"), 2
    )
    assert policy.spec.observation == env.layout.observation and path.stat().st_size < 200_000
    learner = AmpTrainer().learner(env, AmpConfig())
    learner.load(learner.read(path.with_suffix(".safetensors"), env.layout), whole=False)


def test_a_policy_is_a_file_or_a_task(tmp_path: Path) -> None:
    """A file of the name comes first; a name that is neither is a file that is missing."""
    assert policy_file("go2", None) == required_policy("go2")
    assert policy_file("go2", "gallop") == Path("gallop") and policy_file("so101", "canter") == Path("canter")
    (mine := tmp_path / "canter").touch()
    assert policy_file("go2", mine) == mine
