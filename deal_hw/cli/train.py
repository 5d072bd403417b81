"""``deal-hw train``: train a policy under a parameter distribution."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from deal_hw.cli.piped import PipedProgress, Quiet, is_quiet
from deal_hw.documentation import page
from deal_hw.errors import ConfigurationError, TrainingError
from deal_hw.robots import driven_robots
from deal_hw.training import TrainingProgress, TrainingStatus
from deal_hw.workflows.options import RayPlace, Seeds
from deal_hw.workflows.say import silent, to_stderr
from deal_hw.workflows.train import TRAIN, InterruptedTrainingError, Training, TrainSettings, run
from deal_hw.workflows.train_seeds import SeedTrainings, run_seeds

SHOWN_MEASURES = 3
"""Number of a task's measures beside the progress; TensorBoard's files have all."""


@dataclass(frozen=True, kw_only=True)
class ShownTraining(Quiet):
    """What only the command line has, and what it has in place of Python's."""

    distribution: Path | None = None
    """distribution.json of a calibration: parameters, their uncertainty, latency."""

    seeds: Seeds = ()
    """Train a policy with each of these seeds instead of --seed: numbers and ranges, as 0-4. Each writes into
    a folder of its own, such as seed_0, in --out."""

    ray: RayPlace = None
    """Where the trainings of --seeds run: local, local:N, HOST:PORT or auto (docs/how-to/cluster.md); by
    default here, one after the other."""


KINDS = TRAIN.with_options(ShownTraining)


def train(config: TrainSettings) -> Training:
    """Run the verb; see :func:`deal_hw.workflows.train.train`."""
    try:
        if is_quiet(config) or sys.stdout.isatty():
            training = _with_bar(config)
        else:
            with PipedProgress("train") as piped:
                training = run(config, lambda status: piped.at(_words(status)), to_stderr)
    except InterruptedTrainingError as stopped:
        _print(stopped.training)
        print("stopped before the end; --resume continues from the checkpoint")
        raise
    _print(training)
    return training


def train_and_say_next(config: TrainSettings) -> Training | SeedTrainings:
    """Train, and print the line that runs the policy.

    Raises:
        TrainingError: A training of several ended by a fault; the others were done.
    """
    done: Training | SeedTrainings
    if isinstance(config, ShownTraining) and (config.seeds or config.ray is not None):
        done = _train_seeds(config, config.seeds, config.ray)
    else:
        done = train(config)
    training = done.best if isinstance(done, SeedTrainings) else done
    if training is not None and not is_quiet(config) and config.robot in driven_robots():
        print(f"next: deal-hw deploy {config.robot} --port PORT --policy {training.path}")
    if isinstance(done, SeedTrainings) and done.failed:
        raise TrainingError(
            f"seeds {', '.join(map(str, done.failed))} failed; the others are in {config.out}"
        )
    return done


def _train_seeds(config: TrainSettings, seeds: Sequence[int], ray: str | None) -> SeedTrainings:
    """Train with each seed, and print what each reached."""
    if not seeds:
        raise ConfigurationError(f"--ray {ray} shares the trainings of several seeds: give --seeds, as 0-4")
    if config.seed:
        raise ConfigurationError("--seed and --seeds exclude each other: keep one of them")

    def one(own: TrainSettings) -> Training:
        print(f"seed {own.seed}:")
        return train(own)

    if ray is None:
        done = run_seeds(config, seeds, train=one)
    else:
        with PipedProgress("train", is_quiet(config)) as piped:
            ended = 0

            def follow(seed: int, result: Training | str) -> None:
                nonlocal ended
                ended += 1
                piped.say(f"seed {seed}: {_outcome(result)} ({ended}/{len(seeds)})")

            piped.at(f"{len(seeds)} trainings in workers")
            try:
                done = run_seeds(config, seeds, ray=ray, ended=follow)
            except KeyboardInterrupt:
                print("stopped before the end; --resume continues each seed from its last checkpoint")
                raise
    print(done.table())
    return done


def _outcome(result: Training | str) -> str:
    if isinstance(result, str):
        return result
    return "done" if result.status is None else _words(result.status)


def _print(training: Training) -> None:
    print(f"policy: {training.path}")
    print(f"record: {training.record}")
    print(f"checkpoint: {training.checkpoint}")
    reached = None if training.status is None else training.status.mean_return
    if training.status is not None and reached is not None and training.first_return is not None:
        share = training.status.measures.get("time_up")
        up = "" if share is None else f"; {share:.0%} of an episode's time passes before a fall"
        print(
            f"return: {reached:.1f}, at first {training.first_return:.1f}{up} (means of "
            f"up to 100 episodes; {page('how-to/training.md')} says what is good)"
        )


def _with_bar(config: TrainSettings) -> Training:
    bar = Progress(
        TextColumn("training"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} steps"),
        TextColumn("{task.fields[reached]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        disable=is_quiet(config),
    )
    try:
        return run(config, _follow(bar), silent if is_quiet(config) else to_stderr)
    finally:
        if bar.live.is_started:
            bar.stop()


def _words(status: TrainingStatus) -> str:
    return f"{status.steps}/{status.total} steps, {_reached(status)}".rstrip(", ")


def _reached(status: TrainingStatus) -> str:
    """Return the mean return, once an episode has ended, and some measures."""
    reached = "" if status.mean_return is None else f"return {status.mean_return:.1f} "
    shown = [*status.measures.items()][:SHOWN_MEASURES]
    return reached + ", ".join(f"{name} {value:.2f}" for name, value in shown)


def _follow(bar: Progress) -> TrainingProgress:
    row = bar.add_task("training", total=None, reached="")

    def follow(status: TrainingStatus) -> None:
        # Not before, since a refused training has no bar.
        bar.start()
        bar.update(row, completed=status.steps, total=status.total, reached=_reached(status))

    return follow
