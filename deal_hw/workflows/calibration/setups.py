"""Set-ups of a calibration: the file that describes them, and recordings marked with theirs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from deal_hw.errors import ConfigurationError
from deal_hw.workflows.calibration.settings import CalibrateSettings, DatasetSettings
from deal_hw.workflows.calibration.source import Source
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.sim.recordings.setups import Setups

ONE_MODEL = ("mujoco-sysid",)
"""Methods that simulate all recordings with one model."""


def given_setups(settings: CalibrateSettings) -> Setups | None:
    """Return the set-ups of the settings, or of the dataset; None if there are none."""
    from deal_hw.sim.recordings.setups import FILE, read_setups

    if settings.setups is not None:
        return read_setups(Path(settings.setups))
    if isinstance(settings, DatasetSettings):
        file = Path(settings.dataset) / FILE
        return read_setups(file) if file.exists() else None
    return None


def in_setups(source: Source, setups: Setups, method: str, say: Say) -> Source:
    """Return a source with the robot in every set-up, and unknown payloads among the parameters.

    Args:
        source: The source.
        setups: The set-ups.
        method: The method of the calibration.
        say: Called with a sentence on the recordings of each set-up.

    Raises:
        ConfigurationError: A set-up cannot be used, or the method has one model for all.
    """
    from deal_hw.sim.recordings.setups import BASE, with_setups

    if method in ONE_MODEL:
        raise ConfigurationError(
            f"{method} simulates all recordings with one model, so it cannot fit several set-ups; leave out "
            "--method, or the set-ups"
        )
    names = [one.name for one in (*source.fitted, *source.held)]
    setups.check_used(names, source.robot.description)
    robot = setups.robot(source.robot, source.space)
    space = with_setups(source.space, robot, setups)
    if not len(space):
        raise ConfigurationError(
            f"{setups.source}: every parameter is known, and so is every payload, so there is nothing to "
            "search; give a payload a `range` instead of a `mass`"
        )
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(setups.of(name) or BASE, []).append(name)
    for setup, members in groups.items():
        say(f"set-up {setup}: {', '.join(dict.fromkeys(members))}")
    provenance = {**source.provenance, "setups": {name: list(members) for name, members in groups.items()}}
    return dataclasses.replace(source, robot=robot, space=space, setups=setups, provenance=provenance)
