"""``deal-hw collect``: record the robot while it moves in a way that tells much."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from deal_hw.cli.run_plan import RunPlan, shipped_policy
from deal_hw.cli.supervised import RunReport, dataset_folder, run_episodes
from deal_hw.control.excitation import RichConfig


@dataclass(frozen=True, kw_only=True)
class Collect:
    """Record the robot while it moves in a way that tells much."""

    robot: tyro.conf.Positional[str]
    """The robot, such as cartpole."""

    port: str
    """Where the robot is, such as /dev/ttyUSB0."""

    transport: str = "serial"
    """How the robot is reached."""

    out: Path | None = None
    """Run folder; the episodes go to OUT/dataset."""

    dataset: Path | None = None
    """Dataset folder instead of OUT/dataset; new episodes are added to those that are there."""

    profile: Literal["rich", "chirp", "balance", "hold"] = "rich"
    """rich: balance, then random set-points; chirp: a sine sweep (for held-out data); balance: the policy all
    the time; hold: the start pose."""

    policy: Path | None = None
    """Policy that balances (.onnx); by default the one shipped for the robot."""

    seconds: float = 4.0
    """Length of an episode [s]."""

    episodes: int = 1
    """How many episodes."""

    seed: int = 0
    """Fixes the random set-points; episode k uses SEED + k."""

    rich: tyro.conf.Suppress[RichConfig] = field(default_factory=RichConfig)
    """Settings of the profile `rich`; its length is SECONDS."""

    quiet: bool = False
    """Print nothing but errors."""


def collect(config: Collect) -> RunReport:
    """Record episodes and return how they went.

    Raises:
        DealHwError: What made it fail; the robot is passive and what was recorded is whole.
    """
    policy = config.policy or shipped_policy(config.robot)
    plan = RunPlan(
        robot=config.robot,
        transport=config.transport,
        profile=config.profile,
        policy=str(policy or ""),
        seconds=config.seconds,
        seed=config.seed,
        rich=config.rich,
    )
    return run_episodes(
        plan,
        port=config.port,
        dataset=dataset_folder(config.out, config.dataset),
        episodes=config.episodes,
        purpose="collect",
        quiet=config.quiet,
    )
