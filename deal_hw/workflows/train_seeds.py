"""``deal_hw.train_seeds``: train a policy with each of several seeds, here or in Ray's workers."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from deal_hw.errors import ConfigurationError, TaskLostError, TrainingError
from deal_hw.scale.tasks import task_map
from deal_hw.scale.where import check_device
from deal_hw.training import TrainingStatus
from deal_hw.workflows.say import html_table, text_table
from deal_hw.workflows.train import (
    TRAIN,
    Training,
    TrainRobotSettings,
    TrainSettings,
    distribution_of,
    policy_path,
    run,
)


@dataclass(frozen=True, kw_only=True)
class SeedTrainings:
    """What the trainings of several seeds made.

    Attributes:
        trainings: The training of each seed that ended.
        failed: What ended the others, by seed.
    """

    trainings: Mapping[int, Training]
    failed: Mapping[int, str]

    @property
    def best(self) -> Training | None:
        """The training with the highest mean return at its end; None if none has one."""
        reached = [one for one in self.trainings.values() if _return(one) is not None]
        return max(reached, key=lambda one: _return(one) or 0.0, default=None)

    def table(self) -> str:
        """Return each seed's mean returns and policy, as text."""
        return text_table(*self._rows())

    def _repr_html_(self) -> str:
        return html_table(*self._rows())

    def _rows(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        def shown(value: float | None) -> str:
            return "" if value is None else f"{value:.4g}"

        rows: list[tuple[str, ...]] = [
            (str(seed), shown(_return(one)), shown(one.first_return), str(one.path))
            for seed, one in self.trainings.items()
        ]
        rows += [(str(seed), "", "", why) for seed, why in self.failed.items()]
        return ("seed", "mean return", "at first", "policy"), rows


Trainer = Callable[[TrainSettings], Training]
"""Trains one policy."""


def train_seeds(
    *values: Any,
    seeds: Sequence[int],
    ray: str | None = None,
    ended: Callable[[int, Training | str], None] | None = None,
    **named: Any,
) -> SeedTrainings:
    """Train a policy with each of several seeds, as ``deal-hw train --seeds``.

    ``train_seeds("go2", seeds=range(5), ray="local", udr=True, out="runs/walk")`` writes
    runs/walk/seed_0/policies/policy.onnx and so on; an ``out`` of walk.onnx becomes walk_seed_0.onnx.

    Args:
        values: As of :func:`deal_hw.train`.
        named: As of :func:`deal_hw.train`.
        seeds: The seeds.
        ray: Where trainings run: "local", "local:4", HOST:PORT or "auto"; None: here, one after the other.
        ended: Called with a seed and its training, or with what ended it, as each ends.

    Raises:
        InterruptedTrainingError: Ctrl-C during a training in this process; its policy so far was written.
        ClusterError: The workers cannot be used.
        ConfigurationError: As of :func:`deal_hw.train`; or seeds are missing or twice.
    """
    return run_seeds(TRAIN.make("train_seeds", *values, **named), seeds, ray=ray, ended=ended)


def run_seeds(
    config: TrainSettings,
    seeds: Sequence[int],
    *,
    ray: str | None = None,
    ended: Callable[[int, Training | str], None] | None = None,
    train: Trainer | None = None,
) -> SeedTrainings:
    """Train as :func:`train_seeds`; ``train`` does one training in this process, by default silently."""
    if not seeds or len({*seeds}) < len(seeds):
        raise ConfigurationError(
            f"seeds {', '.join(map(str, seeds)) or 'none'}: give one or more, each once, such as 0-4"
        )
    engine = config.engine if isinstance(config, TrainRobotSettings) else "mujoco"
    threads = config.threads if isinstance(config, TrainRobotSettings) else 1
    check_device(ray, engine, "trainings")
    distribution_of(config)
    found: dict[int, Training] = {}
    failed: dict[int, str] = {}
    with task_map(ray, threads) as tasks:
        if tasks.here:
            work = partial(_train, config, train or _alone)
        else:
            work = partial(_train, _plain(config), _packed)
        each = tasks.completed(work, seeds, _lost)
        with contextlib.closing(each) as completed:
            for index, result in completed:
                seed = seeds[index]
                one = (
                    result.here(policy_path(of_seed(config, seed).out))
                    if isinstance(result, _Sent)
                    else result
                )
                if isinstance(one, Training):
                    found[seed] = one
                else:
                    failed[seed] = one
                if ended is not None:
                    ended(seed, one)
    return SeedTrainings(trainings={s: found[s] for s in seeds if s in found}, failed=failed)


def of_seed(config: TrainSettings, seed: int) -> TrainSettings:
    """Return the settings of one seed's training, with an ``out`` of its own.

    A training that was never begun is begun where others resume.
    """
    out = Path(config.out)
    name = f"seed_{seed}"
    out = out.with_stem(f"{out.stem}_{name}") if out.suffix == ".onnx" else out / name
    resume = config.resume and policy_path(out).with_suffix(".safetensors").exists()
    return dataclasses.replace(config, seed=seed, out=out, resume=resume)


@dataclass(frozen=True, slots=True)
class _Sent:
    """A training as a worker sends it back, which may be on another machine.

    Attributes:
        files: Contents of the policy, record and checkpoint, by name.
        status: Progress at the end.
        first_return: Mean return of the first episodes.
    """

    files: Mapping[str, bytes]
    status: TrainingStatus | None
    first_return: float | None

    @classmethod
    def of(cls, training: Training) -> _Sent:
        beside = training.path.parent.glob(f"{training.path.stem}*")
        files = {path.name: path.read_bytes() for path in sorted(beside) if path.is_file()}
        return cls(files, training.status, training.first_return)

    def here(self, path: Path) -> Training:
        """Return the training with its files on this machine; those of a shared folder are there already."""
        from deal_hw.policies.onnx_runtime import OnnxPolicy

        path.parent.mkdir(parents=True, exist_ok=True)
        for name, content in self.files.items():
            file = path.with_name(name)
            if not file.exists() or file.read_bytes() != content:
                file.write_bytes(content)
        return Training(
            policy=OnnxPolicy(path),
            path=path,
            status=self.status,
            first_return=self.first_return,
        )


def _train(
    config: TrainSettings, train: Callable[[TrainSettings], Training | _Sent], seed: int
) -> Training | _Sent | str:
    """Train with one seed; return what ended it, if it could not go on."""
    try:
        return train(of_seed(config, seed))
    except TrainingError as err:
        return str(err)


def _alone(config: TrainSettings) -> Training:
    return run(config, config.progress)


def _packed(config: TrainSettings) -> _Sent:
    return _Sent.of(_alone(config))


def _lost(seed: int, why: TaskLostError) -> str:
    return str(why)


def _plain(config: TrainSettings) -> TrainSettings:
    """Return the settings without the options that only the command line has, whose class cannot be sent."""
    kinds = {kind.settings for kind in TRAIN.table().values()}
    plain = next(base for base in type(config).__mro__ if base in kinds)
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(plain)}
    made: TrainSettings = plain(**values)
    return made


def _return(training: Training) -> float | None:
    return None if training.status is None else training.status.mean_return
