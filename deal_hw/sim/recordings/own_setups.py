"""Recordings as set-ups of their own, for parameters that act in one recording only.

Such as the zero of an incremental encoder, which is wherever the robot was when it was switched on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import SampledEpisode

OWN = "@"
"""Begins the name of a recording's own set-up."""


def recording_of(name: str) -> str:
    """Return the recording to which a part between gaps belongs."""
    return name.partition(", part ")[0]


def recordings_of(names: Iterable[str]) -> list[str]:
    """Return the recordings to which parts belong, each once."""
    return list(dict.fromkeys(map(recording_of, names)))


def own_setup(recording: str) -> str:
    """Return the set-up that is a recording's own."""
    return OWN + recording


def in_own_setups(
    robot: RobotModel, episodes: Sequence[SampledEpisode], space: ParameterSpace
) -> tuple[RobotModel, Sequence[SampledEpisode]]:
    """Return a robot and recordings with a set-up for each recording that has parameters of its own.

    Another set-up in which a recording was made goes on to act there.

    Args:
        robot: The robot.
        episodes: The recordings.
        space: The parameters.
    """
    named = {p.setup for p in space.parameters if p.setup.startswith(OWN)}
    if not named:
        return robot, episodes
    setups, found = dict(robot.setups), list[SampledEpisode]()
    for episode in episodes:
        name, before = own_setup(recording_of(episode.name)), episode.setup
        if name in named and before != name:
            made_in = robot.in_setup(before)
            setups.setdefault(name, dataclasses.replace(made_in, setups={}, own=made_in.own | {name}))
            episode = dataclasses.replace(episode, setup=name)
        found.append(episode)
    return dataclasses.replace(robot, setups=setups), found
