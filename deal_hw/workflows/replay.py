"""``deal_hw.replay``: send a recording's commands again, through the safety filter."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from deal_hw.data.files import episode_of
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import ReplayBehaviour
from deal_hw.robots import driver_description
from deal_hw.types import Trajectory
from deal_hw.workflows.options import OWN_ROBOT, File, from_settings, refuse
from deal_hw.workflows.robot import carries_robot, user_robot
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.settings import RunOptions, plan_options, refuse_unrecorded
from deal_hw.workflows.running.simulated import (
    SimulationOptions,
    check_simulation,
    require_driver,
    run_simulated,
)
from deal_hw.workflows.running.supervised import recording_folder, run_episodes
from deal_hw.workflows.running.view import RunView


@dataclass(frozen=True, kw_only=True)
class ReplaySettings(RunOptions):
    """Settings of :func:`replay`."""

    episode: File = field(kw_only=False)
    """The recording (.mcap)."""

    robot: str = ""
    """The robot; by default the recorded one."""

    port: str = ""
    """The robot's port, as for `deal-hw collect`."""

    record: bool = True
    """Record the replayed motion."""

    simulation: Annotated[SimulationOptions, OWN_ROBOT] = field(default_factory=SimulationOptions)
    """Your own robot, in simulation; by default the one that the episode's dataset contains."""

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_unrecorded(self, self.record)


@from_settings(ReplaySettings)
def replay(settings: ReplaySettings) -> RunReport:
    """Send a recording's commands again, from the robot's start pose, as ``deal-hw replay``.

    :class:`ReplaySettings` and ``deal-hw replay --help`` describe the arguments:
    ``replay("runs/first/dataset/episodes/000000.mcap", port="/dev/ttyUSB0")``.

    Returns:
        How the replay went, with the path of the new recording.

    Raises:
        DatasetError: The recording cannot be read or holds no command.
        DealHwError: A setting is unusable, or the run failed; the robot is passive and the recording is
            complete.
        InterruptedRunError: Ctrl-C; the robot is passive.
    """
    return run(settings, RunView.of_python(settings.say))


def run(config: ReplaySettings, view: RunView) -> RunReport:
    """Replay a recording, as :func:`replay`, and show it."""
    check_simulation(config, ReplaySettings(config.episode))
    path = episode_of(config.episode)
    trajectory = read_trajectory(path)
    dataset = path.resolve().parent.parent
    recorded = str(dataset) if carries_robot(dataset) else str(trajectory.metadata.get("robot", ""))
    robot = config.robot or recorded
    if config.simulation.simulated:
        return _rehearse(config, view, robot, path, trajectory)
    require_driver(robot, config.port)
    behaviour = ReplayBehaviour(trajectory, driver_description(robot))
    legs = config.legs
    if trajectory.metadata.get("stand"):
        # The recording stands up and lies down itself. A robot that already stands would fall: its first
        # targets are those of a lying one.
        refuse(["--stand"] if legs.stand else [], "the recording stands up and lies down itself")
        legs = dataclasses.replace(legs, stand=False)
    plan = RunPlan(
        **plan_options(robot, config.link, legs, walks=False),
        motion="replay",
        recording=str(path.resolve()),
        seconds=behaviour.duration_s,
    )
    return run_episodes(
        plan,
        port=config.port,
        dataset=recording_folder(config.out, config.dataset, "replay", robot, record=config.record),
        episodes=1,
        purpose="replay",
        view=view,
    )


def _rehearse(
    config: ReplaySettings, view: RunView, robot: str, path: Path, trajectory: Trajectory
) -> RunReport:
    """Replay on a user's robot in simulation."""
    description = user_robot(robot).description()
    behaviour = ReplayBehaviour(trajectory, description)
    folder = recording_folder(config.out, config.dataset, "replay", description.name, record=config.record)
    if folder is None:
        raise ConfigurationError("--no-record: a simulated replay is always recorded; leave the option out")
    plan = RunPlan(robot=robot, motion="replay", recording=str(path.resolve()), seconds=behaviour.duration_s)
    return run_simulated(
        plan, robot, config.simulation, dataset=folder, episodes=1, purpose="replay", view=view
    )
