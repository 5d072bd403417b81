"""``deal_hw.replay``: send a recording's commands again, through the safety filter."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args, get_type_hints

from deal_hw.data.files import episode_of
from deal_hw.data.recording.dataset_index import entry_of_episode
from deal_hw.data.recording.reader import read_metadata, read_trajectory
from deal_hw.errors import DealHwError
from deal_hw.motions.behaviours import ReplayBehaviour
from deal_hw.robots import driver_description
from deal_hw.types import Trajectory
from deal_hw.workflows.kinds import Arguments, InputKind, Kinds, field_names
from deal_hw.workflows.options import File, from_settings, refuse
from deal_hw.workflows.robot import carries_robot, name_of, user_robot
from deal_hw.workflows.robot_kinds import robot_kinds
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.settings import (
    B2RunOptions,
    CartpoleRunOptions,
    G1RunOptions,
    Go2RunOptions,
    H1RunOptions,
    RecordOptions,
    RunOptions,
    SimulationOptions,
    StandOptions,
    crane_of,
    legs_of,
    plan_options,
    refuse_unrecorded,
    require_simulation,
)
from deal_hw.workflows.running.supervised import dataset_folder, recording_folder, run_episodes
from deal_hw.workflows.running.view import RunView


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(RecordOptions):
    """What to replay, for every kind of robot."""

    episode: File = field(kw_only=False)
    """The recording (.mcap)."""

    robot: str = ""
    """The robot; by default the recorded one."""


@dataclass(frozen=True, kw_only=True)
class ReplaySettings(RunOptions, ReplayOptions):
    """Send a recording's commands again, through the safety filter, and record what happens."""

    record: bool = True
    """Record the replayed motion."""

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_unrecorded(self, self.record)


@dataclass(frozen=True, kw_only=True)
class ReplayCartpoleSettings(CartpoleRunOptions, ReplaySettings):
    """Send a recording's commands to a cart-pole again, and record what happens."""


@dataclass(frozen=True, kw_only=True)
class ReplayLeggedSettings(ReplaySettings):
    """Send a recording's commands to a robot with legs again, and record what happens."""

    legs: StandOptions = field(default_factory=StandOptions)
    """Options of a robot with legs."""


@dataclass(frozen=True, kw_only=True)
class ReplayGo2Settings(Go2RunOptions, ReplayLeggedSettings):
    """Send a recording's commands to a Go2 again, and record what happens."""


@dataclass(frozen=True, kw_only=True)
class ReplayB2Settings(B2RunOptions, ReplayLeggedSettings):
    """Send a recording's commands to a B2 again, and record what happens."""


@dataclass(frozen=True, kw_only=True)
class ReplayG1Settings(G1RunOptions, ReplaySettings):
    """Send a recording's commands to a G1 that hangs on a crane again, and record what happens."""


@dataclass(frozen=True, kw_only=True)
class ReplayH1Settings(H1RunOptions, ReplaySettings):
    """Send a recording's commands to an H1 that hangs on a crane again, and record what happens."""


@dataclass(frozen=True, kw_only=True)
class ReplaySimulatedSettings(ReplayOptions):
    """Send a recording's commands to your own robot in simulation, and record what happens."""

    simulation: SimulationOptions = field(default_factory=SimulationOptions)
    """The simulation; by default of the robot that the episode's dataset contains."""


_ROBOTS = robot_kinds(
    {
        "cartpole": ReplayCartpoleSettings,
        "go2": ReplayGo2Settings,
        "b2": ReplayB2Settings,
        "g1": ReplayG1Settings,
        "h1": ReplayH1Settings,
    },
    plain=ReplaySettings,
    legged=ReplayLeggedSettings,
    simulated=ReplaySimulatedSettings,
    example="--port {port}",
    simulated_example="--simulated",
)


def _table() -> dict[str, InputKind]:
    return {
        name: dataclasses.replace(
            kind,
            usage=f"EPISODE --robot {name}",
            example=f"runs/first/dataset/episodes/000000.mcap --robot {kind.example}",
        )
        for name, kind in _ROBOTS.table().items()
    }


def _find(arguments: Arguments) -> str:
    """Return the kind of the robot that is named or, without a name, was recorded."""
    if arguments.first is None:
        return ""
    robot = str(arguments.options.get("robot") or "")
    if not robot:
        with contextlib.suppress(DealHwError):
            path = episode_of(arguments.first)
            robot = _robot_of(path, read_metadata(path))
    if not robot:
        # The verb will report that the recording cannot be read; until then any options fit.
        fitting = (name for name, kind in _table().items() if _takes(kind.settings, arguments.options))
        return next(fitting, "cartpole")
    return _ROBOTS.find(Arguments(robot, arguments.options))


def _takes(settings: Any, options: Mapping[str, Any]) -> bool:
    """Return whether settings take the options, and the transport on the command line, too."""
    if not set(options) <= field_names(settings):
        return False
    link = settings.__dataclass_fields__.get("link")
    transports = get_args(get_type_hints(link.default_factory)["transport"]) if link is not None else ()
    return "transport" not in options or not transports or options["transport"] in transports


def _doubt(arguments: Arguments) -> str:
    """Return why the robot of a recording is not known; empty if it is."""
    if arguments.first is None or arguments.options.get("robot"):
        return ""
    try:
        path = episode_of(arguments.first)
        known = _robot_of(path, read_metadata(path))
    except DealHwError as error:
        return str(error)
    return "" if known else f"{path} does not name its robot (--robot)"


REPLAY = Kinds(noun="episode", argument="episode", table=_table, find=_find, doubt=_doubt)
"""The kinds of :func:`replay`."""


@from_settings(REPLAY)
def replay(settings: ReplaySettings | ReplaySimulatedSettings) -> RunReport:
    """Send a recording's commands again, from the robot's start pose, as ``deal-hw replay``.

    ``deal-hw replay EPISODE --help`` describes the arguments:
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


def run(config: ReplaySettings | ReplaySimulatedSettings, view: RunView) -> RunReport:
    """Replay a recording, as :func:`replay`, and show it."""
    path = episode_of(config.episode)
    trajectory = read_trajectory(path)
    robot = config.robot or _robot_of(path, trajectory.metadata)
    entry = entry_of_episode(path)
    if entry is not None and entry.failure:
        view.warn(f"warning: {path} is of a failed run: {entry.failure}; its commands may do that again")
    if isinstance(config, ReplaySimulatedSettings):
        return _rehearse(config, view, robot, path, trajectory)
    behaviour = ReplayBehaviour(trajectory, driver_description(robot))
    legs = legs_of(config)
    if legs is not None and trajectory.metadata.get("stand"):
        # The recording stands up and lies down itself. A robot that already stands would fall: its first
        # targets are those of a lying one.
        refuse(["--stand"] if legs.stand else [], "the recording stands up and lies down itself")
        legs = dataclasses.replace(legs, stand=False)
    plan = RunPlan(
        **plan_options(robot, config.link, legs, crane=crane_of(config), walks=False),
        motion="replay",
        recording=str(path.resolve()),
        seconds=behaviour.duration_s,
    )
    return run_episodes(
        plan,
        port=config.port,
        dataset=recording_folder(config.out, config.dataset, "replay", name_of(robot), record=config.record),
        episodes=1,
        purpose="replay",
        view=view,
    )


def _robot_of(path: Path, metadata: Mapping[str, Any]) -> str:
    """Return the robot of a recording: its dataset, where that carries the robot, or else a name."""
    dataset = path.resolve().parent.parent
    return str(dataset) if carries_robot(dataset) else str(metadata.get("robot", ""))


def _rehearse(
    config: ReplaySimulatedSettings, view: RunView, robot: str, path: Path, trajectory: Trajectory
) -> RunReport:
    """Replay on a user's robot in simulation."""
    from deal_hw.workflows.running.simulated import run_simulated

    require_simulation(robot, config.simulation)
    description = user_robot(robot).description()
    behaviour = ReplayBehaviour(trajectory, description)
    default = Path("runs") / f"replay_{description.name}"
    named = config.out is not None or config.dataset is not None
    folder = dataset_folder(config.out if named else default, config.dataset)
    plan = RunPlan(robot=robot, motion="replay", recording=str(path.resolve()), seconds=behaviour.duration_s)
    return run_simulated(
        plan, robot, config.simulation, dataset=folder, episodes=1, purpose="replay", view=view
    )
