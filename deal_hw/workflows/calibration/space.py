"""The parameters that a calibration searches: of a robot with a driver, and of any model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calibration import listed
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, UnknownNameError, short
from deal_hw.parameters import ParameterSpace
from deal_hw.robots import parameter_spaces
from deal_hw.types import Trajectory
from deal_hw.workflows.calibration.settings import FilesSettings, OwnDatasetSettings, UserRobotSettings
from deal_hw.workflows.robot import described
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import SampledEpisode


def named_space(robot: str, name: str = "") -> ParameterSpace:
    """Return a parameter set of a robot; "": its first.

    Raises:
        UnknownNameError: There is no such set; the message lists them.
    """
    table = parameter_spaces(robot)
    name = name or next(iter(table))
    if name not in table:
        raise UnknownNameError("parameter set", name, table)
    return table[name]()


def extended(space: ParameterSpace, file: Path, robot: RobotModel) -> ParameterSpace:
    """Return a parameter set with those of a file beside it."""
    from deal_hw.sim.parameters import check_space
    from deal_hw.sim.parameters.yaml_space import read_space

    found = ParameterSpace([*space.parameters, *read_space(file, robot.model).parameters])
    check_space(robot.model, found)
    return found


def without_speed_limits(
    space: ParameterSpace, description: RobotDescription, trajectories: Iterable[Trajectory], say: Say
) -> ParameterSpace:
    """Return the space without the speed limits of servos whose set-points the host moves (ODrive).

    The commands to such a drive carry its own limit, which is above the range of a servo's. Its set-point
    jumps with each command. The known value is so high that the model's does, too.
    """
    every = list(trajectories)
    numbers = {joint: number for number, joint in enumerate(description.actuated)}
    known = {}
    for p in space:
        if p.kind != "servo_speed_limit":
            continue
        columns = [numbers[joint] for joint in p.elements]
        sent = np.concatenate([t.speed_limit[:, columns].ravel() for t in every])
        if sent.size and np.nanmin(sent) > p.high:
            steps = [np.abs(np.diff(t.position_target[:, columns], axis=0)).max(initial=0.0) for t in every]
            known[p.name] = max(float(np.nanmin(sent)), description.device_rate_hz * float(np.nanmax(steps)))
    if known:
        say(f"{listed(list(known))}: not searched, because the host limits the speed of these set-points")
    return space.with_known(known)


def searched_space(settings: UserRobotSettings, model: Any, say: Say) -> ParameterSpace:
    """Return the parameters to search of a user's model, with the usual doubts as priors.

    What is not searched at first, as it is 0 in the model, is reported.

    Raises:
        ConfigurationError: The parameter file, or a change of the parameters, cannot be used.
    """
    from deal_hw.sim.parameters import check_space, with_doubts
    from deal_hw.sim.parameters.default_space import default_space, left_at_zero
    from deal_hw.sim.parameters.fields import element_names
    from deal_hw.sim.parameters.yaml_space import read_space

    if settings.parameters is None:
        zero = [f"{kind} of {short(', '.join(names))}" for kind, names in left_at_zero(model).items()]
        if zero:
            say(
                f"0 in the model: {'; '.join(zero)}. They are not searched at first, but tried where the "
                "model explains too little. If the robot has them, write values above 0 into the MJCF"
            )
        # Which drives reach their limits is seen in the recordings; see `without_idle_limits`.
        space = default_space(model, element_names(model, "actuator"))
    else:
        space = read_space(Path(settings.parameters), model)
    space = with_doubts(settings.searched(space))
    check_space(model, space)
    return space


def without_idle_limits(
    space: ParameterSpace,
    settings: UserRobotSettings,
    robot: RobotModel,
    episodes: Sequence[SampledEpisode],
) -> ParameterSpace:
    """Return the space without effort limits that no recording reaches, and what shows only there.

    A file's parameters, and those that the settings name, stay.
    """
    if settings.parameters is not None:
        return space
    from deal_hw.sim.parameters.default_space import default_space
    from deal_hw.sim.recordings.effort_limits import drives_at_limit

    names = {p.name for p in default_space(robot.model, drives_at_limit(robot, episodes)).parameters}
    names |= {str(name) for name, *_ in (*dict(settings.known).items(), *settings.range)}
    names |= set(settings.free)
    return ParameterSpace(p for p in space.parameters if p.name in names)


def write_parameters(settings: OwnDatasetSettings | FilesSettings, path: Path) -> Path:
    """Write a commented parameter file for the model of a user's robot and return its path.

    Args:
        settings: They name the model, or a dataset with its own robot.yaml.
        path: The file.

    Raises:
        ConfigurationError: The file exists, or the model cannot be used.
    """
    if path.exists():
        raise ConfigurationError(f"{path} exists; name another file, or remove it")
    from deal_hw.sim.engine.compiling import compile_mjcf
    from deal_hw.sim.parameters.template import template

    if isinstance(settings, FilesSettings):
        model = Path(settings.model)
    else:
        model = described(str(settings.dataset)).mjcf
    text = template(compile_mjcf(model), model.name)
    path.write_text(text, encoding="utf-8")
    return path
