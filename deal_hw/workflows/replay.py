"""``deal_hw.replay``: send a recording's commands again, through the safety filter."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from deal_hw.control.behaviours import ReplayBehaviour
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.drivers import driver_description
from deal_hw.workflows.options import File, from_settings
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.settings import RunOptions, plan_options, refuse_unrecorded
from deal_hw.workflows.running.supervised import recording_folder, run_episodes
from deal_hw.workflows.running.view import RunView


@dataclass(frozen=True, kw_only=True)
class ReplaySettings(RunOptions):
    """Settings of :func:`replay`."""

    episode: File = field(kw_only=False)
    """The recording (.mcap)."""

    robot: str = ""
    """The robot; by default the one that was recorded."""

    record: bool = True
    """Record what happens; --no-record where nothing is to be kept."""

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_unrecorded(self, self.record)


@from_settings(ReplaySettings)
def replay(settings: ReplaySettings) -> RunReport:
    """Send a recording's commands again, from the robot's start pose; what ``deal-hw replay`` does.

    The arguments are those of :class:`ReplaySettings`, which has a text under each, and ``deal-hw replay
    --help`` shows them: ``replay("runs/first/dataset/episodes/000000.mcap", port="/dev/ttyUSB0")``.

    Returns:
        How it went, with the path of the new recording.

    Raises:
        DatasetError: The recording cannot be read or holds no command.
        DealHwError: A setting is unusable, or what made it fail; the robot is passive and what was recorded
            is whole.
        InterruptedRunError: Ctrl-C; the robot is passive.
    """
    return run(settings, RunView.of_python(settings.say))


def run(config: ReplaySettings, view: RunView) -> RunReport:
    """Replay a recording, as :func:`replay`, and show it."""
    path = Path(config.episode)
    trajectory = read_trajectory(path)
    robot = config.robot or str(trajectory.metadata.get("robot", ""))
    behaviour = ReplayBehaviour(trajectory, driver_description(robot))
    plan = RunPlan(
        **plan_options(robot, config.link, config.legs, walks=False),
        profile="replay",
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
