"""What a user decides on episodes of a dataset: keep one whose run failed, remove one, put it back.

A removed episode moves to ``DIR/removed``: its file, and beside it its entry of the index (JSON). At no time
does the index name a file that is not there: a crash in between leaves the episode in the dataset.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from deal_hw.data.files import write_json
from deal_hw.data.recording.dataset import REMOVED_FOLDER, Dataset
from deal_hw.data.recording.episode_info import KEPT, EpisodeInfo, number_in
from deal_hw.errors import DatasetError
from deal_hw.reading import read_json


def removed_numbers(folder: Path) -> tuple[int, ...]:
    """Return the numbers of the episodes that were removed from a dataset and can be put back."""
    files = (Path(folder) / REMOVED_FOLDER).glob("*.mcap")
    found = (number_in(f"episodes/{file.name}") for file in files if file.with_suffix(".json").is_file())
    return tuple(sorted(number for number in found if number >= 0))


def remove_episodes(dataset: Dataset, numbers: Iterable[int]) -> tuple[EpisodeInfo, ...]:
    """Move episodes out of a dataset that was opened by :meth:`Dataset.edit`; return their entries.

    Raises:
        DatasetError: There is no such episode, or a file cannot be written; then none is removed.
    """
    removed = {info.number: info for info in map(dataset.info, numbers)}
    try:
        (dataset.folder / REMOVED_FOLDER).mkdir(exist_ok=True)
        for number, info in removed.items():
            write_json(_entry(dataset.folder, number), asdict(info))
        dataset.change([info for info in dataset.episodes if info.number not in removed])
        for number, info in removed.items():
            os.replace(dataset.folder / info.file, _file(dataset.folder, number))
    except OSError as error:
        raise DatasetError(
            f"{dataset.folder / REMOVED_FOLDER} cannot be written: {error.strerror}; what is not there stays "
            "in the dataset"
        ) from error
    return tuple(removed.values())


def keep_episodes(dataset: Dataset, numbers: Sequence[int]) -> tuple[EpisodeInfo, ...]:
    """Use episodes although their runs failed, and put removed ones back; return their entries.

    Args:
        dataset: Opened by :meth:`Dataset.edit`.
        numbers: The episodes.

    Raises:
        DatasetError: There is no such episode, or it cannot be used or put back; then nothing is changed.
    """
    removed = set(removed_numbers(dataset.folder)) - set(dataset.numbers)
    back = {number: _removed(dataset.folder, number) for number in numbers if number in removed}
    found = [back.get(number) or dataset.info(number) for number in numbers]
    kept = {
        one.number: replace(one, facts={**one.facts, KEPT: True}) if one.failure else one for one in found
    }
    for number, info in kept.items():
        if info.left_out:
            raise DatasetError(f"episode {number} of {dataset.folder} cannot be used: {info.left_out}")
    try:
        for number in back:
            os.replace(_file(dataset.folder, number), dataset.folder / kept[number].file)
    except OSError as error:
        raise DatasetError(f"{dataset.folder / 'episodes'} cannot be written: {error.strerror}") from error
    dataset.change([*(info for info in dataset.episodes if info.number not in kept), *kept.values()])
    for number in back:
        _entry(dataset.folder, number).unlink(missing_ok=True)
    return tuple(kept.values())


def _removed(folder: Path, number: int) -> EpisodeInfo:
    """Return the entry of a removed episode.

    Raises:
        DatasetError: It cannot be read, or is that of another episode.
    """
    path = _entry(folder, number)
    info = read_json(path, EpisodeInfo, "the entry of a removed episode")
    if info.number != number:
        raise DatasetError(f"{path} is the entry of episode {info.number}, not of {number}")
    return info


def _file(folder: Path, number: int) -> Path:
    return folder / REMOVED_FOLDER / f"{number:06d}.mcap"


def _entry(folder: Path, number: int) -> Path:
    return folder / REMOVED_FOLDER / f"{number:06d}.json"
