"""What every policy trainer must do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.parameters import ParameterDistribution
from deal_hw.policy import Policy, PolicySpec
from deal_hw.training import PolicyTrainer

_SEED = 3
_SAME = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainerCase:
    """A trainer under test and its toy task.

    Attributes:
        trainer: The trainer.
        make_env: Makes a new environment of the toy task.
        layout: The layout that the environment trains for.
        distribution: What the environment draws physics from.
        config: Enough steps to learn the toy.
        short_config: As few steps as make an update at all.
        score: How well a policy does the toy; larger is better.
        learned: A score that no lucky policy reaches and a trained one exceeds with margin.
        export: Writes a policy and reads it back.
    """

    trainer: PolicyTrainer[Any, Any]
    make_env: Callable[[], Any]
    layout: PolicySpec
    distribution: ParameterDistribution
    config: Any
    short_config: Any
    score: Callable[[Policy], float]
    learned: float
    export: Callable[[Policy, Path], Policy]

    def train(
        self, config: Any, seed: int = _SEED, progress: Callable[[int, int, float], None] | None = None
    ) -> Policy:
        """Train on a new environment."""
        return self.trainer.train(self.make_env(), config, np.random.default_rng(seed), progress)


class TrainerSuite:
    """Contract of a trainer; inherit it and override ``case``, in class scope: training takes seconds."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> TrainerCase:
        """Return the trainer under test."""
        raise NotImplementedError("a TrainerSuite overrides the fixture `case`")

    @pytest.fixture(scope="class")
    @classmethod
    def short(cls, case: TrainerCase) -> Policy:
        """Return a policy after a few updates."""
        return case.train(case.short_config)

    def test_learns_the_toy_under_the_step_budget(self, case: TrainerCase) -> None:
        """Training does what it is there for, and a hardly trained policy does not pass the same bar."""
        assert case.score(case.train(case.config)) >= case.learned

    def test_a_hardly_trained_policy_does_not_pass(self, case: TrainerCase, short: Policy) -> None:
        """The bar of the test above is one that only learning reaches."""
        assert case.score(short) < case.learned

    def test_policy_carries_layout_and_digest(self, case: TrainerCase, short: Policy) -> None:
        """The policy says what it observes, what its action means and under what it was trained."""
        spec = short.spec
        assert spec.observation == case.layout.observation
        assert spec.action_scale == case.layout.action_scale
        assert spec.joint_names == case.layout.joint_names
        assert spec.trained_under == case.distribution.digest()
        assert spec.training["algorithm"] == case.trainer.name

    def test_export_equals_the_network(self, case: TrainerCase, short: Policy, tmp_path: Path) -> None:
        """The file computes what the trained network computes, and carries the same spec."""
        exported = case.export(short, tmp_path / "policy.onnx")
        rng = np.random.default_rng(0)
        for scale in (0.1, 1.0, 10.0):
            observation = (scale * rng.standard_normal(len(short.spec.observation))).astype(np.float32)
            np.testing.assert_allclose(
                exported.act(observation), short.act(observation), rtol=0.0, atol=_SAME
            )
        assert PolicySpec.from_json(exported.spec.to_json()) == PolicySpec.from_json(short.spec.to_json())

    def test_actions_have_their_shape_and_range(self, short: Policy) -> None:
        """An action is one number in [-1, 1] for each actuated joint, for any observation."""
        for value in (-100.0, 0.0, 100.0):
            action = short.act(np.full(len(short.spec.observation), value, dtype=np.float32))
            assert action.shape == (len(short.spec.actuated),)
            assert np.all(np.abs(action) <= 1.0)

    def test_same_seed_same_policy(self, case: TrainerCase, short: Policy) -> None:
        """The generator decides everything: the same one gives the same actions, another one others."""
        observation = np.linspace(-1.0, 1.0, len(short.spec.observation), dtype=np.float32)
        again = case.train(case.short_config)
        other = case.train(case.short_config, seed=_SEED + 1)
        np.testing.assert_array_equal(again.act(observation), short.act(observation))
        assert not np.array_equal(other.act(observation), short.act(observation))

    def test_progress_counts_up_to_the_budget(self, case: TrainerCase) -> None:
        """Progress rises and ends at the number of steps that were asked for."""
        calls: list[tuple[int, int]] = []
        case.train(case.short_config, progress=lambda done, total, _: calls.append((done, total)))
        done = [d for d, _ in calls]
        assert done == sorted(done)
        assert calls[-1] == (case.short_config.steps, case.short_config.steps)
