"""``deal-hw replay``: send a recording's commands again, through the safety filter."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from deal_hw.cli.episode_report import RunReport
from deal_hw.cli.link import LegOptions, LinkOptions, plan_options
from deal_hw.cli.run_plan import RunPlan
from deal_hw.cli.supervised import dataset_folder, run_episodes
from deal_hw.control.behaviours import ReplayBehaviour
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.drivers import driver_description


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Send a recording's commands again, through the safety filter, and record what happens."""

    episode: tyro.conf.Positional[Path]
    """The recording (.mcap)."""

    port: str
    """Where the robot is: a serial port such as /dev/ttyUSB0, a network interface (dds) or an endpoint such
    as tcp/127.0.0.1:7447 (zenoh)."""

    link: tyro.conf.OmitArgPrefixes[LinkOptions] = field(default_factory=LinkOptions)
    """How the robot is reached, beyond the port."""

    legs: tyro.conf.OmitArgPrefixes[LegOptions] = field(default_factory=LegOptions)
    """What a robot with legs needs to be told."""

    out: Path | None = None
    """Run folder; the episode goes to OUT/dataset. Without OUT and DATASET nothing is recorded."""

    dataset: Path | None = None
    """Dataset folder instead of OUT/dataset."""

    robot: str = ""
    """The robot; by default the one that was recorded."""

    quiet: bool = False
    """Print nothing but errors."""


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
