"""``deal-hw train``: train a policy under a parameter distribution."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.policy import VERDICT
from deal_hw.reading import read_json, reading
from deal_hw.workflows.options import Checked, Range, Seed

if TYPE_CHECKING:
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.training import TrainingFiles, TrainingProgress, TrainingStatus

POLICY_FILE = Path("policies") / "policy.onnx"
SHOWN_MEASURES = 3
"""So many of a task's measures stand beside the progress bar; all are in TensorBoard's files."""


@dataclass(frozen=True, kw_only=True)
class Train(Checked):
    """Train a policy under the calibrated distribution, or under uniform domain randomisation."""

    robot: tyro.conf.Positional[str] = "cartpole"
    """The robot."""

    distribution: Path | None = None
    """distribution.json of a calibration: parameters, their uncertainty, latency."""

    udr: bool = False
    """Train under uniform domain randomisation instead: every parameter within a factor of its nominal value
    (5; for the Go2 1.75)."""

    nominal: bool = False
    """Train under the model's own values instead; latency as with --udr."""

    trainer: str | None = None
    """ppo or sac; by default what the robot's shipped policy was trained with."""

    out: Path = Path("runs") / "train"
    """The .onnx file to write, or a run folder, which gets policies/policy.onnx. Checkpoint (.safetensors),
    record (.json) and TensorBoard's files go beside it."""

    start: Path | None = None
    """A checkpoint (.safetensors) to fine-tune: its networks are where training starts."""

    resume: bool = False
    """Go on where the training that wrote this --out was stopped."""

    steps: Annotated[int | None, Range(1, 10**9)] = None
    """Environment steps; by default what the shipped policy was trained with."""

    members: Annotated[int | None, Range(1, 100_000)] = None
    """Robots simulated at once; by default what the shipped policy was trained with."""

    seed: Seed = 0
    """Decides everything random."""

    quiet: bool = False
    """No progress bar."""


def train(config: Train) -> OnnxPolicy:
    """Train a policy as the settings say and return it.

    Raises:
        KeyboardInterrupt: Ctrl-C, or a request to end: the training has ended, and what there is was written.
        ConfigurationError: Not exactly one distribution was asked for, it cannot be read, or there is nothing
            to go on from.
        UnknownNameError: There is no such robot or trainer.
        TrainingError: The training diverged, or a checkpoint does not fit.
    """
    path = config.out if config.out.suffix == ".onnx" else config.out / POLICY_FILE
    distribution = _distribution(config)
    checkpoint = path.with_suffix(".safetensors")
    if config.resume and config.start is not None:
        raise ConfigurationError("--start and --resume exclude each other: leave one of them out")
    if config.resume and not checkpoint.exists():
        raise ConfigurationError(
            f"nothing to resume: {checkpoint} does not exist; leave out --resume, or give the --out of the "
            "training that was stopped"
        )
    with _progress_bar(config.quiet) as bar, _stopped_by_signal() as stopped:
        from deal_hw.training import TrainingFiles

        files = TrainingFiles(
            checkpoint=checkpoint,
            start=config.start,
            resume=config.resume,
            log=path.with_name(path.stem + "_tensorboard"),
            stop=lambda: bool(stopped),
        )
        policy = train_policy(
            config.robot,
            distribution,
            path,
            trainer=config.trainer,
            seed=config.seed,
            steps=config.steps,
            members=config.members,
            progress=_follow(bar),
            files=files,
            verdict=_verdict(config),
        )
    print(f"policy: {path}")
    print(f"record: {path.with_suffix('.json')}")
    print(f"checkpoint: {checkpoint}")
    if stopped:
        print("stopped before the end; --resume goes on from the checkpoint")
        # A demo that trains must not go on to deploy what is half trained.
        raise KeyboardInterrupt
    return policy


def train_policy(
    robot: str,
    distribution: ParameterDistribution,
    path: Path,
    *,
    trainer: str | None = None,
    seed: int = 0,
    steps: int | None = None,
    members: int | None = None,
    progress: TrainingProgress | None = None,
    files: TrainingFiles | None = None,
    verdict: str = "",
) -> OnnxPolicy:
    """Train a policy and write it with its training record.

    Args:
        robot: The robot's name.
        distribution: What parameters and latency are drawn from.
        path: The .onnx file; the record goes beside it.
        trainer: The trainer's name; None for the robot's usual one.
        seed: Decides everything random.
        steps: Environment steps; None for the default.
        members: Robots simulated at once; None for the default.
        progress: Called as the training goes on.
        files: Checkpoint, TensorBoard files, and the word to stop.
        verdict: Colour of the calibration that the distribution is of; "" where it is of none.

    Returns:
        The policy, read back from its file.
    """
    import dataclasses
    import inspect

    from deal_hw.drivers import recorded_description
    from deal_hw.policies.onnx_export import export_network
    from deal_hw.policies.tasks import training_task

    task = training_task(robot)
    teacher, config = task.trainer_and_config(trainer, steps)
    env = task.make(recorded_description(robot), distribution, members or task.members[teacher.name])
    # Where it cannot be written that is known now and not after the training.
    path.parent.mkdir(parents=True, exist_ok=True)
    started, cpu = time.monotonic(), time.process_time()
    reached: list[TrainingStatus] = []

    def follow(status: TrainingStatus) -> None:
        reached[:] = [status]
        if progress is not None:
            progress(status)

    spent = _spent(path.with_suffix(".json")) if files is not None and files.resume else {}
    policy = teacher.train(env, config, np.random.default_rng(seed), follow, files)
    record = {
        "format": "deal_hw.training/1",
        "robot": robot,
        "seed": seed,
        "training": dict(policy.spec.training),
        "task": dataclasses.asdict(env.task),
        "reward": inspect.cleandoc(type(env).__doc__ or "").partition("\n\nArgs:")[0],
        "distribution": distribution.to_json(),
        "distribution_digest": distribution.digest(),
        "spec_digest": policy.spec.digest(),
        "reached": dataclasses.asdict(reached[0]) if reached else {},
        "started_from": str(files.start or "") if files is not None else "",
        "seconds": spent.get("seconds", 0.0) + time.monotonic() - started,
        "cpu_seconds": spent.get("cpu_seconds", 0.0) + time.process_time() - cpu,
        "resumed": bool(spent),
    }
    # Who deploys the policy is told what the calibration's verdict was.
    training = {**policy.spec.training, **({VERDICT: verdict} if verdict else {})}
    return export_network(policy.network, dataclasses.replace(policy.spec, training=training), path, record)


def _spent(record: Path) -> dict[str, float]:
    """Return what the training that is resumed had taken, by its record; nothing where there is none."""
    if not record.exists():
        return {}
    values = read_json(
        record, dict[str, Any], "a training record", "`deal-hw train` writes it", error=ConfigurationError
    )
    return {name: float(values[name]) for name in ("seconds", "cpu_seconds")}


def _distribution(config: Train) -> ParameterDistribution:
    wanted = {
        "--distribution": config.distribution is not None,
        "--udr": config.udr,
        "--nominal": config.nominal,
    }
    given = [name for name, is_given in wanted.items() if is_given]
    if len(given) > 1:
        raise ConfigurationError(f"{' and '.join(given)} exclude each other: leave one of them")
    if not given:
        raise ConfigurationError(
            "say under what to train: --distribution FILE (`deal-hw calibrate` writes it), --udr or --nominal"
        )
    if config.distribution is not None:
        return read_distribution(config.distribution)
    return udr_distribution(config.robot) if config.udr else nominal_distribution(config.robot)


def udr_distribution(robot: str) -> ParameterDistribution:
    """Return the distribution of uniform domain randomisation.

    Raises:
        UnknownNameError: There is no such robot.
    """
    from deal_hw.policies.tasks import training_task

    task = training_task(robot)
    return ParameterDistribution.uniform(_space(robot).with_ratio(task.udr_ratio), task.udr_latency_s)


def nominal_distribution(robot: str) -> ParameterDistribution:
    """Return the distribution of the model's own values; only the latency is drawn.

    Raises:
        UnknownNameError: There is no such robot.
    """
    from deal_hw.policies.tasks import training_task

    task, space = training_task(robot), _space(robot)
    K = len(space)
    return ParameterDistribution(
        space=space, mean=space.nominal, covariance=np.zeros((K, K)), latency_s=task.udr_latency_s
    )


def read_distribution(path: Path) -> ParameterDistribution:
    """Read what a calibration wrote.

    Raises:
        ConfigurationError: There is no such file, or it holds no distribution.
    """
    what, advice = "a parameter distribution", "`deal-hw calibrate` writes calibration/distribution.json"
    values = read_json(path, dict[str, Any], what, advice, error=ConfigurationError)
    with reading(path, what, advice, error=ConfigurationError):
        return ParameterDistribution.from_json(values)


def _verdict(config: Train) -> str:
    """Return the colour that the calibration noted beside its distribution; "" where there is none."""
    if config.distribution is None:
        return ""
    what, advice = "a parameter distribution", "`deal-hw calibrate` writes calibration/distribution.json"
    values = read_json(config.distribution, dict[str, Any], what, advice, error=ConfigurationError)
    return str(values.get("verdict", ""))


def _space(robot: str) -> ParameterSpace:
    from deal_hw.drivers import parameter_spaces

    return next(iter(parameter_spaces(robot).values()))()


@contextlib.contextmanager
def _stopped_by_signal() -> Iterator[list[int]]:
    """Yield a list that the first SIGINT or SIGTERM goes into; a second one acts as usual."""
    seen: list[int] = []
    try:
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

        def note(number: int, frame: Any) -> None:
            seen.append(number)
            signal.signal(number, before[signal.Signals(number)])

        for number in before:
            signal.signal(number, note)
    except ValueError:
        # Not the main thread: signals are somebody else's.
        before = {}
    try:
        yield seen
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _progress_bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("training"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} steps"),
        TextColumn("return {task.fields[recent]:.1f} {task.fields[measures]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        disable=quiet,
    )


def _follow(bar: Progress) -> TrainingProgress:
    row = bar.add_task("training", total=None, recent=0.0, measures="")

    def follow(status: TrainingStatus) -> None:
        shown = [f"{name} {value:.2f}" for name, value in status.measures.items()][:SHOWN_MEASURES]
        bar.update(
            row,
            completed=status.steps,
            total=status.total,
            recent=status.mean_return,
            measures=", ".join(shown),
        )

    return follow
