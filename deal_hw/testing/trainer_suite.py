"""Contract of every policy trainer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.errors import CheckpointError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policy import Policy, PolicySpec
from deal_hw.training import PolicyTrainer, TrainingFiles, TrainingProgress, TrainingStatus

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
        short_config: Just enough steps for an update.
        score: Score of a policy on the toy task; larger is better.
        learned: A score that no random policy reaches and a trained one exceeds with margin.
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
        self,
        config: Any,
        seed: int = _SEED,
        progress: TrainingProgress | None = None,
        files: TrainingFiles | None = None,
    ) -> Policy:
        """Train on a new environment."""
        return self.trainer.train(self.make_env(), config, np.random.default_rng(seed), progress, files)


@dataclass(frozen=True, slots=True)
class KeptTraining:
    """A short training with the seed of ``short``.

    Its policy, its reports, its checkpoint as bytes, and the names that it left in the temporary directory.
    """

    policy: Policy
    reports: tuple[tuple[int, int], ...]
    checkpoint: bytes
    leftovers: tuple[str, ...]


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

    @pytest.fixture(scope="class")
    @classmethod
    def second(cls, case: TrainerCase, tmp_path_factory: pytest.TempPathFactory) -> KeptTraining:
        """Return a second short training, with reports and a checkpoint."""
        file = tmp_path_factory.mktemp("second") / "checkpoint.safetensors"
        temporary = tmp_path_factory.mktemp("temporary")
        reports: list[tuple[int, int]] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("tempfile.tempdir", str(temporary))
            policy = case.train(
                case.short_config,
                progress=lambda status: reports.append((status.steps, status.total)),
                files=TrainingFiles(checkpoint=file),
            )
        left = tuple(entry.name for entry in temporary.iterdir())
        return KeptTraining(policy, tuple(reports), file.read_bytes(), left)

    def test_learns_the_toy_under_the_step_budget(self, case: TrainerCase) -> None:
        """A trained policy exceeds the score `learned`; a hardly trained one does not."""
        assert case.score(case.train(case.config)) >= case.learned

    def test_a_hardly_trained_policy_does_not_pass(self, case: TrainerCase, short: Policy) -> None:
        """The score of the test above is reached only by learning."""
        assert case.score(short) < case.learned

    def test_policy_carries_layout_and_digest(self, case: TrainerCase, short: Policy) -> None:
        """The policy's spec has its observations, its action and the parameters of its training.

        A trainer may add terms after those of the task.
        """
        spec = short.spec
        assert spec.observation[: len(case.layout.observation)] == case.layout.observation
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

    def test_same_seed_same_policy(self, case: TrainerCase, short: Policy, second: KeptTraining) -> None:
        """The generator decides everything: the same one gives the same actions, another one others."""
        observation = np.linspace(-1.0, 1.0, len(short.spec.observation), dtype=np.float32)
        other = case.train(case.short_config, seed=_SEED + 1)
        np.testing.assert_array_equal(second.policy.act(observation), short.act(observation))
        assert not np.array_equal(other.act(observation), short.act(observation))

    def test_nothing_is_left_in_the_temporary_directory(self, second: KeptTraining) -> None:
        """A training writes the requested files only."""
        assert second.leftovers == ()

    def test_progress_counts_up_to_the_budget(self, case: TrainerCase, second: KeptTraining) -> None:
        """Progress rises and ends at the requested number of steps."""
        done = [steps for steps, _ in second.reports]
        assert done == sorted(done)
        assert second.reports[-1] == (case.short_config.steps, case.short_config.steps)

    def test_a_stopped_training_goes_on_where_it_was(self, case: TrainerCase, tmp_path: Path) -> None:
        """Stopped after its first episodes it leaves a checkpoint; resumed, it does the remaining steps.

        No episode has ended by the resumed training's first report: it has the return of the checkpoint.
        """
        file = tmp_path / "checkpoint.safetensors"
        reports: list[TrainingStatus] = []
        stop = TrainingFiles(
            checkpoint=file,
            log=tmp_path / "log",
            stop=lambda: bool(reports) and reports[-1].mean_return is not None,
        )
        case.train(case.config, progress=reports.append, files=stop)
        assert reports[0].mean_return is None
        stopped = reports[-1]
        assert 0 < stopped.steps < case.config.steps and list((tmp_path / "log").iterdir())
        config = dataclasses.replace(case.config, steps=stopped.steps + case.short_config.steps)
        resumed: list[TrainingStatus] = []
        case.train(config, progress=resumed.append, files=TrainingFiles(checkpoint=file, resume=True))
        assert stopped.steps < resumed[0].steps and resumed[-1].steps == config.steps
        assert resumed[0].mean_return == stopped.mean_return

    def test_a_fine_tune_starts_from_the_networks_of_a_checkpoint(
        self, case: TrainerCase, second: KeptTraining, tmp_path: Path
    ) -> None:
        """Stopped at once, it acts as the policy of its start checkpoint."""
        file = tmp_path / "checkpoint.safetensors"
        file.write_bytes(second.checkpoint)
        started = case.train(case.config, seed=_SEED + 1, files=TrainingFiles(start=file, stop=lambda: True))
        observation = np.linspace(-1.0, 1.0, len(second.policy.spec.observation), dtype=np.float32)
        fresh = case.train(case.config, seed=_SEED + 1, files=TrainingFiles(stop=lambda: True))
        first = second.policy.act(observation)
        gap = np.abs(started.act(observation) - first).max()
        assert gap < np.abs(fresh.act(observation) - first).max()

    def test_checkpoints_that_do_not_fit_are_refused(
        self, case: TrainerCase, second: KeptTraining, tmp_path: Path
    ) -> None:
        """Damaged, or of networks of another size: the message names the file."""
        file = tmp_path / "checkpoint.safetensors"
        file.write_bytes(second.checkpoint)
        other = dataclasses.replace(case.short_config, hidden=(8,))
        with pytest.raises(CheckpointError, match=r"checkpoint\.safetensors: hidden is"):
            case.train(other, files=TrainingFiles(start=file))
        file.write_bytes(file.read_bytes()[:100])
        with pytest.raises(CheckpointError, match=r"checkpoint\.safetensors cannot be read"):
            case.train(case.short_config, files=TrainingFiles(checkpoint=file, resume=True))
