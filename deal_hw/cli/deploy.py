"""``deal-hw deploy``: run a policy on the robot behind the safety filter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deal_hw.cli.episode_report import RunReport
from deal_hw.cli.link import RunOptions, plan_options
from deal_hw.cli.run_plan import RunPlan
from deal_hw.cli.supervised import dataset_folder, run_episodes
from deal_hw.workflows.options import Range, RunSeconds, Seed
from deal_hw.workflows.shipped import shipped_policy


@dataclass(frozen=True, kw_only=True)
class Deploy(RunOptions):
    """Run a policy on the robot behind the safety filter, and record it."""

    robot: tyro.conf.Positional[str]
    """The robot, such as cartpole."""

    policy: Path | None = None
    """The policy (.onnx); by default the one shipped for the robot."""

    seconds: RunSeconds = 10.0
    """Length of an episode [s]."""

    episodes: Annotated[int, Range(1, 10_000)] = 1
    """How many episodes."""

    seed: Seed = 0
    """Noted in the recording; the policy itself is not random."""

    task: str = ""
    """What the policy is to do, in words, for the recording."""

    trust_calibration: bool = False
    """Run a policy that was trained under a calibration whose verdict is red, without asking."""

    dry_run: bool = False
    """Compute everything and send nothing: the robot is neither homed nor armed."""


def deploy(config: Deploy) -> RunReport:
    """Run the policy and return how it went.

    Raises:
        PolicyMismatchError: The policy was made for another robot; the message names what differs.
        DealHwError: What made it fail; the robot is passive and what was recorded is whole.
    """
    policy = config.policy or shipped_policy(config.robot)
    plan = RunPlan(
        **plan_options(config.robot, config.link, config.legs),
        profile="balance",
        policy=str(policy or ""),
        seconds=config.seconds,
        seed=config.seed,
        dry_run=config.dry_run,
        trust_calibration=config.trust_calibration,
        home=not config.dry_run,
    )
    return run_episodes(
        plan,
        port=config.port,
        dataset=dataset_folder(config.out, config.dataset, required=False),
        episodes=config.episodes,
        purpose="deploy",
        task=config.task,
        quiet=config.quiet,
    )
