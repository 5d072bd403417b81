"""The index of a dataset, ``DIR/dataset.json``: read, checked and written."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from deal_hw.data.files import INDEX_NAME, write_json
from deal_hw.data.recording.episode_info import EXAMPLE, EpisodeInfo
from deal_hw.data.recording.reader import check_description
from deal_hw.description import digest_of
from deal_hw.errors import ConfigurationError, DatasetError, shown
from deal_hw.reading import MIB, read_json
from deal_hw.schema import STRICT

SCHEMA_VERSION = 1
_WHAT = "the index of a dataset"
_INDEX_BYTES = 64 * MIB
"""Largest index [B]; that of 10,000 episodes has some 30 MB."""


@dataclass(frozen=True, slots=True)
class _Version:
    """The part of an index that every version of deal-hw writes."""

    schema_version: int


@dataclass(frozen=True, slots=True)
class DatasetIndex:
    """``dataset.json``.

    Attributes:
        schema_version: Version of its layout.
        robot: The robot's name.
        digest: Digest of the description.
        description: ``RobotDescription.to_json()`` of the robot.
        episodes: An entry for each episode.

    Raises:
        ConfigurationError: The description is none or was changed, a file has two entries, or its name has no
            number.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = STRICT

    schema_version: int
    robot: str
    digest: str
    description: Mapping[str, Any]
    episodes: tuple[EpisodeInfo, ...]

    def __post_init__(self) -> None:
        check_description(self.description)
        if unnumbered := next((one.file for one in self.episodes if one.number < 0), ""):
            raise ConfigurationError(f"episode file {shown(unnumbered)} has no name such as {EXAMPLE}")
        named = Counter(episode.file for episode in self.episodes)
        if twice := next((file for file, count in named.items() if count > 1), ""):
            raise ConfigurationError(f"the index names {twice} twice")
        if self.digest != digest_of(self.description):
            raise ConfigurationError("the index was edited: its digest is not that of its description")


def read_index(folder: Path) -> DatasetIndex:
    """Return the index of a dataset.

    Raises:
        DatasetError: It is of another version, or cannot be read.
    """
    path = folder / INDEX_NAME
    version = read_json(path, _Version, _WHAT, most=_INDEX_BYTES).schema_version
    if version != SCHEMA_VERSION:
        raise DatasetError(
            f"{path} has schema version {version}, expected {SCHEMA_VERSION}; "
            "it was written by another version of deal-hw"
        )
    return read_json(path, DatasetIndex, _WHAT, most=_INDEX_BYTES)


def write_index(folder: Path, description: Mapping[str, Any], episodes: Sequence[EpisodeInfo]) -> None:
    """Write the index of a dataset.

    Raises:
        DatasetError: It cannot be written.
    """
    values = {
        "schema_version": SCHEMA_VERSION,
        "robot": description["name"],
        "digest": digest_of(description),
        "description": description,
        "episodes": [asdict(episode) for episode in episodes],
    }
    try:
        write_json(folder / INDEX_NAME, values)
    except OSError as error:
        raise DatasetError(f"{folder / INDEX_NAME} cannot be written: {error.strerror}") from error


def entry_of_episode(path: Path) -> EpisodeInfo | None:
    """Return the index's entry for an episode's file; None if no dataset that can be read has it."""
    path = Path(path).resolve()
    folder = path.parent.parent
    with contextlib.suppress(DatasetError):
        if path.parent.name == "episodes" and (folder / INDEX_NAME).is_file():
            return next(
                (one for one in read_index(folder).episodes if Path(one.file).name == path.name), None
            )
    return None
