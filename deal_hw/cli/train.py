"""``deal-hw train``: train a policy under a parameter distribution."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from deal_hw.cli.options import Checked, Range, Seed
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.reading import read_json, reading

if TYPE_CHECKING:
    from deal_hw.description import SensorModel
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.training import TrainingProgress

ROBOTS = ("cartpole",)
UDR_RATIO = 5.0
UDR_LATENCY_S = (0.0, 0.03)
"""Total latencies that uniform domain randomisation covers [s]."""
POLICY_FILE = Path("policies") / "policy.onnx"


@dataclass(frozen=True, kw_only=True)
class Train(Checked):
    """Train a policy under the calibrated distribution, or under uniform domain randomisation."""

    robot: tyro.conf.Positional[str] = "cartpole"
    """The robot."""

    distribution: Path | None = None
    """distribution.json of a calibration: parameters, their uncertainty, latency."""

    udr: bool = False
    """Train under uniform domain randomisation instead: every parameter within a factor of 5 of nominal."""

    out: Path = Path("runs") / "train"
    """The .onnx file to write, or a run folder, which gets policies/policy.onnx."""

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
        ConfigurationError: Not exactly one distribution was asked for, or it cannot be read.
        UnknownNameError: There is no such robot.
    """
    if config.udr and config.distribution is not None:
        raise ConfigurationError("--udr and --distribution exclude each other: leave one of them out")
    if not config.udr and config.distribution is None:
        raise ConfigurationError(
            "say under what to train: --distribution FILE (`deal-hw calibrate` writes it) or --udr"
        )
    distribution = (
        udr_distribution(config.robot)
        if config.distribution is None
        else read_distribution(config.distribution)
    )
    path = config.out if config.out.suffix == ".onnx" else config.out / POLICY_FILE
    with _progress_bar(config.quiet) as bar:
        policy = train_policy(
            config.robot, distribution, path, seed=config.seed, steps=config.steps, members=config.members,
            progress=_follow(bar),
        )  # fmt: skip
    print(f"policy: {path}")
    print(f"record: {path.with_suffix('.json')}")
    return policy


def train_policy(
    robot: str,
    distribution: ParameterDistribution,
    path: Path,
    *,
    seed: int = 0,
    steps: int | None = None,
    members: int | None = None,
    sensor: SensorModel | None = None,
    progress: TrainingProgress | None = None,
) -> OnnxPolicy:
    """Train a policy by SAC and write it with its training record.

    Args:
        robot: The robot's name.
        distribution: What parameters and latency are drawn from.
        path: The .onnx file; the record goes beside it.
        seed: Decides everything random.
        steps: Environment steps; None for the default.
        members: Robots simulated at once; None for the default.
        sensor: The sensor model to train with; None for the description's.
        progress: Called as the training goes on.

    Returns:
        The policy, read back from its file.
    """
    import dataclasses
    import inspect

    from deal_hw.drivers import robot_description
    from deal_hw.policies.cartpole_env import MEMBERS, CartPoleEnv
    from deal_hw.policies.onnx_export import export_network
    from deal_hw.policies.sac import SacConfig
    from deal_hw.policies.trainers import make_trainer

    if robot not in ROBOTS:
        raise UnknownNameError("robot with a training environment", robot, ROBOTS)
    config = SacConfig() if steps is None else dataclasses.replace(SacConfig(), steps=steps)
    env = CartPoleEnv(robot_description(robot), distribution, members or MEMBERS, sensor=sensor)
    # Where it cannot be written that is known now and not after the training.
    path.parent.mkdir(parents=True, exist_ok=True)
    started, cpu = time.monotonic(), time.process_time()
    policy = make_trainer("sac").train(env, config, np.random.default_rng(seed), progress)
    record = {
        "format": "deal_hw.training/1",
        "robot": robot,
        "seed": seed,
        "training": dict(policy.spec.training),
        "task": dataclasses.asdict(env.task),
        "reward": inspect.cleandoc(CartPoleEnv.__doc__ or "").partition("\n\nArgs:")[0],
        "distribution": distribution.to_json(),
        "distribution_digest": distribution.digest(),
        "spec_digest": policy.spec.digest(),
        "seconds": time.monotonic() - started,
        "cpu_seconds": time.process_time() - cpu,
    }
    return export_network(policy.network, policy.spec, path, record)


def udr_distribution(robot: str) -> ParameterDistribution:
    """Return the distribution of uniform domain randomisation.

    Raises:
        UnknownNameError: There is no such robot.
    """
    return ParameterDistribution.uniform(_space(robot).with_ratio(UDR_RATIO), UDR_LATENCY_S)


def read_distribution(path: Path) -> ParameterDistribution:
    """Read what a calibration wrote.

    Raises:
        ConfigurationError: There is no such file, or it holds no distribution.
    """
    what, advice = "a parameter distribution", "`deal-hw calibrate` writes calibration/distribution.json"
    values = read_json(path, dict[str, Any], what, advice, error=ConfigurationError)
    with reading(path, what, advice, error=ConfigurationError):
        return ParameterDistribution.from_json(values)


def _space(robot: str) -> ParameterSpace:
    if robot not in ROBOTS:
        raise UnknownNameError("robot with a training environment", robot, ROBOTS)
    from deal_hw.drivers.cartpole.description import k9_space

    return k9_space()


def _progress_bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("training"), BarColumn(), TextColumn("{task.completed}/{task.total} steps"),
        TextColumn("return {task.fields[recent]:.1f}"), TimeElapsedColumn(), disable=quiet,
    )  # fmt: skip


def _follow(bar: Progress) -> Callable[[int, int, float], None]:
    row = bar.add_task("training", total=None, recent=0.0)

    def follow(done: int, total: int, recent: float) -> None:
        bar.update(row, completed=done, total=total, recent=recent)

    return follow
