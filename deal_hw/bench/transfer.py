"""The transfer bench: DEAL's Figure 4, the return in a hidden target after training under each estimate.

One row per task, seed and method. A target is drawn in the range of uniform domain randomisation (UDR). One
policy a task, trained under UDR, demonstrates in it. Each method estimates the parameters from this
demonstration, and the policy is fine-tuned under the estimate: by the same trainer, for the same steps, with
the same seed. Three rows read no demonstration: `udr` (more of the same training), `nominal` (the model as it
is) and `oracle` (the truth).
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.bench.figures import draw_transfer
from deal_hw.bench.loop import calibration_row
from deal_hw.bench.rows import Cells, Row, RowTable, describe_call, noted_in
from deal_hw.bench.scores import error_percent, log_error_x100
from deal_hw.bench.settings import Transfer
from deal_hw.bench.tasks import TASKS, Case, check_tasks, make_case
from deal_hw.bench.transfer_target import WORKS, judged, speed_profile, truth_of
from deal_hw.calib.pipeline.methods import check_method, is_default, usual_budget
from deal_hw.data.run_folder import git_commit
from deal_hw.errors import CalibrationError, ConfigurationError, PolicyError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.robots import training_task
from deal_hw.training import TrainingFiles
from deal_hw.workflows.say import Say, silent
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import nominal_distribution, train_policy, udr_distribution

WITHOUT_DATA: Final = ("udr", "nominal", "oracle")
"""Methods that read no demonstration."""

SHORTEST_S: Final = 0.5
"""A shorter demonstration is none [s]."""

KEY: Final = (
    *("task", "seed", "method", "train_steps", "demonstration_s", "base"),
    *("population", "generations"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What all rows of a task have in common.

    Attributes:
        task: Name of the task.
        steps: Steps of each fine-tune.
        seconds: Length of the demonstration [s].
        base: The base policy (.onnx), its checkpoint (.safetensors) beside it; None: the bench trains it.
        folder: Folder of the policies.
    """

    task: str
    steps: int
    seconds: float
    base: Path | None
    folder: Path

    @property
    def range_ratio(self) -> float:
        """Ratio of the search range: that of the base policy's training."""
        return training_task(self.task).udr_ratio


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenTarget:
    """A hidden robot, its demonstration, and the base policy in it.

    Attributes:
        case: The truth and its recordings.
        truth: The truth as a distribution.
        base: The base policy.
        returns: Its returns in the target.
        seconds: Time of drawing, demonstrating and judging [s].
    """

    case: Case
    truth: ParameterDistribution
    base: OnnxPolicy
    returns: Row
    seconds: float


def table(settings: Transfer) -> RowTable:
    """Return the bench: its cells, seed by seed, by :func:`transfer_row`.

    Raises:
        UnknownNameError: There is no such task or method.
        ConfigurationError: There are too few steps, or a base policy does not fit; raised before long work.
    """
    check_tasks(settings.task)
    for method in settings.methods:
        if method not in WITHOUT_DATA:
            check_method(method)
    given = _given(settings.checkpoint, settings.task)
    common = [
        Setting(
            task=task,
            steps=settings.steps or TASKS[task].train_steps,
            seconds=settings.demonstration_seconds,
            base=given.get(task),
            folder=settings.beside("policies"),
        )
        for task in settings.task
    ]
    for one in common:
        # The trainer refuses too few steps.
        training_task(one.task).trainer_and_config(steps=one.steps)
    # First, so that no other row has to train the oracle for its share, and the oracle's row again.
    methods = sorted(settings.methods, key=lambda method: method != "oracle")
    budget = (settings.population, settings.generations)
    run = partial(
        transfer_row,
        population=settings.population,
        generations=settings.generations,
        threads=settings.threads,
        say=silent if settings.quiet else print_now,
    )
    args = [
        (
            (one.task, seed, method, one.steps, one.seconds, _base_name(one), *budget),
            (one, seed, method),
        )
        for one, seed, method in itertools.product(common, settings.seeds, methods)
    ]
    return RowTable(
        cells=Cells(names=KEY, run=run, args=args), line=line, summary=print_summary, draw=draw_transfer
    )


def print_now(text: str) -> None:
    """Print a sentence on the progress, at once: the next one may take hours."""
    print(text, flush=True)


def _base_name(setting: Setting) -> str:
    return setting.base.stem if setting.base else ""


def _given(checkpoints: Sequence[Path], tasks: Sequence[str]) -> dict[str, Path]:
    """Return base policies by task, after their checks."""
    found: dict[str, Path] = {}
    for path in checkpoints:
        spec = OnnxPolicy(path).spec
        if spec.robot not in tasks or spec.robot in found:
            what = "a second policy" if spec.robot in found else "a policy"
            raise ConfigurationError(
                f"--checkpoint {path} is {what} of {spec.robot}; this bench runs {', '.join(tasks)} and "
                "takes one policy for each"
            )
        check_base(spec.robot, path)
        found[spec.robot] = path
    return found


def check_base(task: str, path: Path) -> None:
    """Check that a policy can be the base of a task's rows.

    Raises:
        ConfigurationError: It was trained under another distribution than the task's UDR, or its checkpoint
            is missing.
    """
    if not _trained_under_udr(task, path):
        raise ConfigurationError(
            f"{path} was trained under another distribution than {task}'s uniform randomisation within a "
            f"factor {training_task(task).udr_ratio:g}, in which the targets are drawn; train one by "
            f"`deal-hw train {task} --udr`"
        )
    if not path.with_suffix(".safetensors").exists():
        raise ConfigurationError(
            f"{path.with_suffix('.safetensors')} is missing: a fine-tune starts from the checkpoint beside "
            f"the policy; `deal-hw train {task} --udr` writes both"
        )


def _trained_under_udr(task: str, path: Path) -> bool:
    return OnnxPolicy(path).spec.trained_under == udr_distribution(task).digest()


def base_policy(setting: Setting, say: Say = silent) -> Path:
    """Return a task's base policy: the one given, else the shipped one, else one that is trained here.

    The shipped one needs its checkpoint beside it. A trained one is kept beside the rows; a training that was
    stopped goes on.
    """
    task = setting.task
    if setting.base is not None:
        return setting.base
    shipped = required_policy(task)
    if shipped.with_suffix(".safetensors").exists() and _trained_under_udr(task, shipped):
        return shipped
    path = setting.folder / f"{task}_udr.onnx"
    if not path.exists():
        say(f"{task}: training the base policy of all rows under uniform randomisation, once: {path}")
        checkpoint = path.with_suffix(".safetensors")
        files = TrainingFiles(checkpoint=checkpoint, resume=checkpoint.exists())
        seed = TASKS[task].base_seed
        train_policy(task, udr_distribution(task), path, seed=seed, files=files)
    check_base(task, path)
    return path


@lru_cache(maxsize=1)
def draw_target(setting: Setting, seed: int, base: Path) -> HiddenTarget:
    """Draw a target and let a policy demonstrate in it; rows of one seed share it.

    Raises:
        CalibrationError: No policy can demonstrate in it.
    """
    began = time.monotonic()
    case = make_case(
        setting.task,
        "ideal",
        seed,
        setting.range_ratio,
        by_policy=True,
        checkpoint=None if TASKS[setting.task].shown_by_shipped else base,
        seconds=setting.seconds,
    )
    lasted_s = float(case.fit.time_s[-1] - case.fit.time_s[0])
    if lasted_s < SHORTEST_S:
        raise CalibrationError(
            f"{setting.task}, seed {seed}: the base policy fails after {lasted_s:.2f} s in this target, so "
            f"there is no demonstration (at least {SHORTEST_S:g} s); use another seed, or name a better "
            "policy (--checkpoint)"
        )
    policy = OnnxPolicy(base)
    truth = truth_of(case)
    returns = judged(setting.task, truth, policy, seed)
    return HiddenTarget(
        case=case, truth=truth, base=policy, returns=returns, seconds=time.monotonic() - began
    )


def transfer_row(
    setting: Setting,
    seed: int,
    method: str,
    *,
    population: int | None,
    generations: int,
    threads: int | None,
    say: Say = silent,
) -> Row:
    """Run one cell; an error goes into the row, so that the other cells still run.

    Args:
        setting: What all rows of the task have in common.
        seed: Seed of the target, of the search and of the training.
        method: Name of the method.
        population: Members of a search; None for the method's own.
        generations: Most generations of a search.
        threads: Simulation threads of the search.
        say: Called with the progress.
    """
    task, head = setting.task, f"{setting.task} seed {seed} {method}"
    row: Row = {
        "bench": "transfer",
        "task": task,
        "profile": "ideal",
        "seed": seed,
        "method": method,
        "range_ratio": setting.range_ratio,
        "train_steps": setting.steps,
        "demonstration_s": setting.seconds,
        "base": _base_name(setting),
        "population": population,
        "generations": generations,
        "commit": git_commit(),
        "command": " ".join(describe_call("deal-hw")["argv"]),
        "error": "",
    }
    with noted_in(row):
        base = base_policy(setting, say)
        target = draw_target(setting, seed, base)
        row |= _base_part(target)
        budget = usual_budget(method, population, generations, refine=is_default(method))
        if method not in WITHOUT_DATA:
            say(f"{head}: estimating")
        part, distribution = _estimate(
            target, method, partial(calibration_row, budget=budget, threads=threads)
        )
        row |= part
        say(f"{head}: training, {setting.steps} steps")
        row |= _trained_part(setting, seed, method, target, distribution)
        oracle = _oracle_return(setting, seed, target)
        row["return_oracle"] = oracle
        row["share_of_oracle"] = row["return"] / oracle if oracle > 0 else None
    return row


def _base_part(target: HiddenTarget) -> Row:
    returns, case = target.returns, target.case
    return {
        "return_base": returns["return"],
        "return_base_worst": returns["return_worst"],
        "time_up_base": returns["time_up"],
        "base_works": returns["time_up"] >= WORKS,
        "demonstrated_s": float(case.fit.time_s[-1] - case.fit.time_s[0]),
        "refused_truths": case.refused,
        "seconds_demonstrate": target.seconds,
    }


def _estimate(
    target: HiddenTarget, method: str, calibrate: Callable[..., tuple[Row, Any]]
) -> tuple[Row, ParameterDistribution]:
    """Return a method's part of the row, and the distribution of the training."""
    case = target.case
    if method in WITHOUT_DATA:
        if method == "oracle":
            under = target.truth
        else:
            under = udr_distribution(case.task) if method == "udr" else nominal_distribution(case.task)
        row: Row = {
            "error_percent": error_percent(under.mean, case.theta),
            "log_error_x100": log_error_x100(under.mean, case.theta),
            "seconds": 0.0,
        }
        return row, under
    part, result = calibrate(case, method)
    kept = (
        "error_percent",
        "log_error_x100",
        "heldout_nrmse_nominal",
        "heldout_nrmse_calibrated",
        "latency_true",
        "latency_found",
        "steps",
        "seconds",
        "flagged",
        "alarms",
        "per_parameter",
    )
    return {name: part[name] for name in kept}, result.distribution()


def _policy_file(setting: Setting, seed: int, method: str) -> Path:
    return setting.folder / f"{setting.task}_{seed}_{setting.steps}_{_base_name(setting)}_{method}.onnx"


def _fine_tuned(
    setting: Setting, seed: int, method: str, target: HiddenTarget, distribution: ParameterDistribution
) -> OnnxPolicy:
    file = _policy_file(setting, seed, method)
    files = TrainingFiles(start=target.base.path.with_suffix(".safetensors"))
    return train_policy(setting.task, distribution, file, seed=seed, steps=setting.steps, files=files)


def _trained_part(
    setting: Setting, seed: int, method: str, target: HiddenTarget, distribution: ParameterDistribution
) -> Row:
    policy = _fine_tuned(setting, seed, method, target, distribution)
    began = time.monotonic()
    row = judged(setting.task, target.truth, policy, seed)
    if TASKS[setting.task].walks:
        row |= speed_profile(setting.task, target.truth, policy, seed)
    record = json.loads(policy.path.with_suffix(".json").read_text(encoding="utf-8"))
    return row | {
        "seconds_train": record["seconds"],
        "cpu_seconds_train": record["cpu_seconds"],
        "seconds_judge": time.monotonic() - began,
    }


def _oracle_return(setting: Setting, seed: int, target: HiddenTarget) -> float:
    """Return the oracle's return; its policy is trained by the first row of a seed, and kept."""
    file = _policy_file(setting, seed, "oracle")
    try:
        policy = OnnxPolicy(file)
    except PolicyError:
        policy = _fine_tuned(setting, seed, "oracle", target, target.truth)
    return float(judged(setting.task, target.truth, policy, seed)["return"])


def line(row: Row) -> str:
    """Return a row in words."""
    head = f"transfer {row['task']} seed {row['seed']} {row['method']}"
    if row["error"]:
        return f"{head}: {row['error']}"
    share = row["share_of_oracle"]
    return (
        f"{head}: parameter error {row['error_percent']:.1f} %, return {row['return']:.1f} (base "
        f"{row['return_base']:.1f}{'' if row['base_works'] else ', which falls here'}), "
        f"{'-' if share is None else f'{100 * share:.0f} %'} of the oracle's; {row['seconds']:.0f} s to "
        f"estimate, {row['seconds_train']:.0f} s to train"
    )


def print_summary(rows: Sequence[Row]) -> None:
    """Print the return of each task and method: mean, worst seed, share of the oracle's."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="return in the target after fine-tuning: mean over seeds (worst seed)")
    left = ("task", "method")
    for name in (*left, "seeds", "error %", "return", "base", "worst episode", "share of oracle", "seconds"):
        table.add_column(name, justify="left" if name in left else "right")
    for group in dict.fromkeys((row["task"], row["method"]) for row in rows):
        part = [row for row in rows if (row["task"], row["method"]) == group]
        shares = [row["share_of_oracle"] for row in part if row["share_of_oracle"] is not None]
        table.add_row(
            *group,
            str(len(part)),
            f"{np.median([row['error_percent'] for row in part]):.1f}",
            _mean_and_worst(part, "return"),
            _mean_and_worst(part, "return_base"),
            f"{min(row['return_worst'] for row in part):.1f}",
            f"{np.median(shares):.2f} ({min(shares):.2f})" if shares else "-",
            f"{np.median([row['seconds'] + row['seconds_train'] for row in part]):.0f}",
        )
    Console(width=130).print(table)


def _mean_and_worst(rows: Sequence[Row], name: str) -> str:
    values = [row[name] for row in rows]
    return f"{np.mean(values):.1f} ({min(values):.1f})"
