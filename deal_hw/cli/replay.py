"""``deal-hw replay``: send a recording's commands again, through the safety filter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from deal_hw.cli.episode_report import RunReport
from deal_hw.cli.link import RunOptions, plan_options
from deal_hw.cli.run_plan import RunPlan
from deal_hw.cli.supervised import dataset_folder, run_episodes
from deal_hw.control.behaviours import ReplayBehaviour
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.drivers import driver_description


@dataclass(frozen=True, kw_only=True)
class Replay(RunOptions):
    """Send a recording's commands again, through the safety filter, and record what happens."""

    episode: tyro.conf.Positional[Path]
    """The recording (.mcap)."""

    robot: str = ""
    """The robot; by default the one that was recorded."""


def replay(config: Replay) -> RunReport:
    """Replay a recording from the robot's start pose and return how it went.

    Raises:
        DatasetError: The recording cannot be read or holds no command.
        DealHwError: What made it fail; the robot is passive and what was recorded is whole.
    """
    trajectory = read_trajectory(config.episode)
    robot = config.robot or str(trajectory.metadata.get("robot", ""))
    behaviour = ReplayBehaviour(trajectory, driver_description(robot))
    plan = RunPlan(
        **plan_options(robot, config.link, config.legs, walks=False),
        profile="replay",
        recording=str(config.episode.resolve()),
        seconds=behaviour.duration_s,
    )
    return run_episodes(
        plan,
        port=config.port,
        dataset=dataset_folder(config.out, config.dataset, required=False),
        episodes=1,
        purpose="replay",
        quiet=config.quiet,
    )
