"""The robot inside a dataset, DATASET/robot: robot.yaml, the MJCF and its files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import mujoco

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, DatasetError, short
from deal_hw.reading import read_json, reading
from deal_hw.schema import from_values

if TYPE_CHECKING:
    from deal_hw.sim.robots.user_robot import UserRobot

FOLDER: Final = "robot"
"""Its folder in a dataset."""
INDEX: Final = "files.json"
"""SHA-256 of each file, by its path in the folder."""
AGAIN: Final = "copy the folder back, or import the recordings again with --robot robot.yaml"


def store_robot(robot: UserRobot, dataset: Path) -> None:
    """Copy a robot into a dataset; an existing one must be the same.

    Raises:
        ConfigurationError: The MJCF names a file by an absolute path.
        DatasetError: The dataset holds another robot, or cannot be written.
    """
    dataset = Path(dataset)
    try:
        with tempfile.TemporaryDirectory(dir=dataset, prefix=".robot-") as scratch:
            staged = Path(scratch) / FOLDER
            digests = _copy(robot, staged)
            kept = dataset / FOLDER
            if not kept.exists():
                os.rename(staged, kept)
                return
            has = _digests(kept)
            if has != digests:
                names = sorted(name for name in {*has, *digests} if has.get(name) != digests.get(name))
                raise DatasetError(
                    f"dataset {dataset} holds another robot: {', '.join(names)} differ; name another folder"
                )
    except OSError as error:
        raise DatasetError(f"{dataset / FOLDER} cannot be written: {error.strerror}") from error


def stored_description(dataset: Path, values: Mapping[str, Any]) -> RobotDescription:
    """Return the description of a dataset's recordings, with the dataset's MJCF.

    Args:
        dataset: The dataset's folder.
        values: ``RobotDescription.to_json()`` of its index, or of an episode.

    Raises:
        DatasetError: The robot is missing, or one of its files is missing or changed.
    """
    folder = Path(dataset) / FOLDER
    if not (folder / INDEX).is_file():
        raise DatasetError(
            f"robot {short(str(values['name']))!r} is none of deal-hw's own, and the dataset does not hold "
            f"it: there is no {folder / INDEX}. If the folder was moved, {AGAIN}"
        )
    digests = _digests(folder)
    for name, digest in digests.items():
        file = folder / name
        if not file.is_file():
            raise DatasetError(f"{file} is missing; the dataset's robot needs it: {AGAIN}")
        if _digest(file) != digest:
            raise DatasetError(
                f"{file} was changed after the recordings were imported; {AGAIN}. For a changed model make "
                "new recordings, or use --model and --data"
            )
    top = [name for name, digest in digests.items() if digest == values["mjcf"]]
    if not top:
        raise DatasetError(f"{folder} holds another model than the recordings name; {AGAIN}")
    with reading(folder, "a robot's description", AGAIN):
        return from_values(RobotDescription, {**values, "mjcf": str(folder / top[0])})


def _copy(robot: UserRobot, folder: Path) -> dict[str, str]:
    """Copy robot.yaml, the MJCF and its files; return their digests."""
    files = _files(robot.mjcf)
    root = Path(os.path.commonpath([str(file.parent) for file in files]))
    folder.mkdir(parents=True)
    for file in files:
        target = folder / file.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)
    name = str(Path(os.path.abspath(robot.mjcf)).relative_to(root))
    outside = [file for file in _files(folder / name) if not file.is_relative_to(os.path.abspath(folder))]
    if outside:
        raise ConfigurationError(
            f"model {robot.mjcf} names {outside[0]} by an absolute path, so the dataset cannot hold a copy "
            "of it; write it relative to the MJCF"
        )
    from deal_hw.sim.robots.robot_file import FILE_NAME, write_robot_file

    text = write_robot_file(dataclasses.replace(robot.file, mjcf=name))
    (folder / FILE_NAME).write_text(text, encoding="utf-8")
    found = {
        str(file.relative_to(folder)): _digest(file) for file in sorted(folder.rglob("*")) if file.is_file()
    }
    (folder / INDEX).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return found


def _files(mjcf: Path) -> list[Path]:
    """Return the model's file and all its files, absolute."""
    found = mujoco.mju_getXMLDependencies(os.path.abspath(mjcf))
    return [Path(os.path.normpath(name)) for name in found]


def _digests(folder: Path) -> dict[str, str]:
    return read_json(folder / INDEX, dict[str, str], "the list of a robot's files", AGAIN)


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
