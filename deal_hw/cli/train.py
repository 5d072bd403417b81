"""``deal-hw train``: train a policy under a parameter distribution."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from deal_hw.training import TrainingProgress, TrainingStatus
from deal_hw.workflows.train import InterruptedTrainingError, Training, TrainSettings, run

SHOWN_MEASURES = 3
"""So many of a task's measures stand beside the progress bar; all are in TensorBoard's files."""


@dataclass(frozen=True, kw_only=True)
class Train(TrainSettings):
    """Train a policy under the calibrated distribution, or under uniform domain randomisation."""

    robot: tyro.conf.Positional[str] = "cartpole"

    distribution: Path | None = None
    """distribution.json of a calibration: parameters, their uncertainty, latency."""

    quiet: bool = False
    """No progress bar."""


def train(config: Train) -> Training:
    """Run the verb; see :func:`deal_hw.workflows.train.train`."""
    bar = _progress_bar(config.quiet)
    try:
        try:
            training = run(config, _follow(bar))
        finally:
            if bar.live.is_started:
                bar.stop()
    except InterruptedTrainingError as stopped:
        _print(stopped.training)
        print("stopped before the end; --resume goes on from the checkpoint")
        raise
    _print(training)
    return training


def _print(training: Training) -> None:
    print(f"policy: {training.path}")
    print(f"record: {training.record}")
    print(f"checkpoint: {training.checkpoint}")


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
        # Not before: what is refused has no bar.
        bar.start()
        shown = [f"{name} {value:.2f}" for name, value in status.measures.items()][:SHOWN_MEASURES]
        bar.update(
            row,
            completed=status.steps,
            total=status.total,
            recent=status.mean_return,
            measures=", ".join(shown),
        )

    return follow
