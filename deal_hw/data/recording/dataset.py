"""A dataset: ``DIR/dataset.json`` and ``DIR/episodes/000000.mcap``, ...; one robot, one description."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

from typing_extensions import Self

from deal_hw.data.files import INDEX_NAME, write_bytes, write_json
from deal_hw.data.recording.episode_info import EpisodeInfo, summarize
from deal_hw.data.recording.reader import Episode, check_description, read_episode
from deal_hw.description import RobotDescription, digest_of
from deal_hw.errors import ConfigurationError, DatasetError, EmptyRecordingError
from deal_hw.reading import MIB, read_json
from deal_hw.schema import STRICT

SCHEMA_VERSION = 1
POLICY_FOLDER = "policies"
_WHAT = "the index of a dataset"
_INDEX_BYTES = 64 * MIB
"""Largest index [B]; that of 10,000 episodes has some 30 MB."""
_LOCK_NAME = ".lock"
Notify = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class _Version:
    """The part of an index that every version of deal-hw writes."""

    schema_version: int


@dataclass(frozen=True, slots=True)
class _Index:
    """``dataset.json``."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = STRICT

    schema_version: int
    robot: str
    digest: str
    description: Mapping[str, Any]
    episodes: tuple[EpisodeInfo, ...]

    def __post_init__(self) -> None:
        check_description(self.description)
        if self.digest != digest_of(self.description):
            raise ConfigurationError("the index was edited: its digest is not that of its description")


class Dataset:
    """A folder of episodes; made by :meth:`create_or_open` or :meth:`open`.

    A collector closes it or uses it in a ``with`` block; until then no other collector can append to it.

    Attributes:
        folder: Where it is.
        description: ``RobotDescription.to_json()`` of its robot.
        digest: Digest of the description.
        episodes: Entry of the index for each episode, in order.
    """

    def __init__(
        self,
        folder: Path,
        description: Mapping[str, Any],
        episodes: tuple[EpisodeInfo, ...],
        lock: int,
        notify: Notify,
    ) -> None:
        self.folder = folder
        self.description = description
        self.digest = digest_of(description)
        self.episodes = episodes
        self._lock = lock
        self._notify = notify
        self._next = len(episodes)

    @classmethod
    def create_or_open(
        cls, folder: Path, description: RobotDescription | Mapping[str, Any], notify: Notify = print
    ) -> Self:
        """Open a dataset for a collector; it is created if missing, and locked until closed.

        Args:
            folder: The dataset.
            description: Description of the robot to record, or its plain JSON values.
            notify: Called with a sentence for each repair.

        Raises:
            DatasetError: It belongs to another robot or description, another collector has it open, or it
                cannot be read or written.
        """
        folder = Path(folder)
        facts = description.to_json() if isinstance(description, RobotDescription) else dict(description)
        try:
            (folder / "episodes").mkdir(parents=True, exist_ok=True)
            lock = _lock(folder)
        except OSError as error:
            raise DatasetError(f"dataset {folder} cannot be written: {error.strerror}") from error
        if lock < 0:
            raise DatasetError(
                f"dataset {folder} is in use by another collector; wait for it or name another folder"
            )
        try:
            if (folder / INDEX_NAME).exists():
                dataset = cls._load(folder, lock, notify)
                _refuse_other(folder, dataset.description, facts)
            else:
                dataset = cls(folder, facts, (), lock, notify)
                dataset._save()
            dataset._adopt()
        except BaseException:
            os.close(lock)
            raise
        return dataset

    @classmethod
    def open(cls, folder: Path, notify: Notify = print) -> Self:
        """Open a dataset for reading; recordings of a killed collector are repaired, unless one is recording.

        Args:
            folder: The dataset.
            notify: Called with a sentence for each repair.

        Raises:
            DatasetError: It is not a dataset or cannot be read.
        """
        folder = Path(folder)
        if not (folder / INDEX_NAME).is_file():
            raise DatasetError(
                f"{folder} is not a dataset: it has no {INDEX_NAME}; `deal-hw collect` makes one, and "
                "`deal-hw data import` makes one from files"
            )
        try:
            lock = _lock(folder)
        except OSError:
            lock = -1  # A read-only copy can still be read.
        try:
            dataset = cls._load(folder, lock, notify)
            if lock >= 0:
                dataset._adopt()
        finally:
            if lock >= 0:
                os.close(lock)
        dataset._lock = -1
        return dataset

    @classmethod
    def _load(cls, folder: Path, lock: int, notify: Notify) -> Self:
        path = folder / INDEX_NAME
        version = read_json(path, _Version, _WHAT, most=_INDEX_BYTES).schema_version
        if version != SCHEMA_VERSION:
            raise DatasetError(
                f"{path} has schema version {version}, expected {SCHEMA_VERSION}; "
                "it was written by another version of deal-hw"
            )
        index = read_json(path, _Index, _WHAT, most=_INDEX_BYTES)
        return cls(folder, index.description, index.episodes, lock, notify)

    def path(self, index: int) -> Path:
        """Return the file of an episode; negative numbers count from the end.

        Raises:
            DatasetError: There is no such episode.
        """
        if not -len(self.episodes) <= index < len(self.episodes):
            raise DatasetError(
                f"dataset {self.folder} has {len(self.episodes)} episodes; there is no number {index} (the "
                "first is 0)"
            )
        return self.folder / self.episodes[index].file

    def read(self, index: int) -> Episode:
        """Read an episode; errors as :func:`~deal_hw.data.recording.reader.read_episode` and :meth:`path`."""
        return read_episode(self.path(index))

    def policy_path(self, digest: str) -> Path:
        """Return the path of a kept policy; ``digest`` is its file's SHA-256 or the first 16 digits of it."""
        return self.folder / POLICY_FOLDER / f"{digest[:16]}.onnx"

    def keep_policy(self, file: Path, digest: str) -> Path:
        """Keep a copy of the policy that moves the robot; an existing copy is not changed.

        Args:
            file: The policy's file.
            digest: SHA-256 of its bytes.

        Raises:
            DatasetError: It cannot be copied, or the file was changed since it was checked.
        """
        self._require_lock()
        path = self.policy_path(digest)
        if path.is_file():
            return path
        try:
            content = file.read_bytes()
            if hashlib.sha256(content).hexdigest() != digest:
                raise DatasetError(f"{file} was changed after it was checked; start again")
            path.parent.mkdir(exist_ok=True)
            write_bytes(path, content)
        except OSError as error:
            raise DatasetError(f"{path} cannot be written: {error.strerror}") from error
        return path

    def next_episode_path(self) -> Path:
        """Return the path of the next episode for a recorder to create; then call :meth:`note_episode`."""
        self._require_lock()
        path = self.folder / "episodes" / f"{self._next:06d}.mcap"
        self._next += 1
        return path

    def note_episode(
        self, path: Path, facts: Mapping[str, Any] | None = None
    ) -> tuple[EpisodeInfo, Episode | None]:
        """Add a finished recording to the index; it is repaired first if its recorder was killed.

        Args:
            path: Path returned by :meth:`next_episode_path`.
            facts: Plain JSON values to keep with it: outcome, loop_timing, task, ...

        Returns:
            The index's entry, and the recording; None if it contains no sample.

        Raises:
            DatasetError: It is not in this dataset's folder or cannot be read.
        """
        self._require_lock()
        file = f"episodes/{Path(path).name}"
        if Path(path).resolve() != (self.folder / file).resolve():
            raise DatasetError(f"{path} is not in {self.folder / 'episodes'}")
        info, episode = self._take(file, "", facts)
        self.episodes = (*self.episodes, info)
        self._save()
        return info, episode

    def close(self) -> None:
        """Release the dataset for other collectors; idempotent."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def _take(
        self, file: str, note: str, facts: Mapping[str, Any] | None = None
    ) -> tuple[EpisodeInfo, Episode | None]:
        path = self.folder / file
        with contextlib.suppress(EmptyRecordingError):
            from deal_hw.data.recording.repair import repair

            report = repair(path)
            if report.repaired:
                self._notify(report.describe())
                note = f"{note}; {report.describe()}" if note else report.describe()
        return summarize(path, file, note, facts)

    def _adopt(self) -> None:
        """Add recordings that the index does not name, because their collector was killed."""
        known = {episode.file for episode in self.episodes}
        found = sorted((self.folder / "episodes").glob("[0-9]*.mcap"))
        strays = [f"episodes/{path.name}" for path in found if f"episodes/{path.name}" not in known]
        for file in strays:
            try:
                info, _ = self._take(file, "added to the index after its collector was killed")
            except DatasetError as error:
                self._notify(f"{self.folder / file} is left out: {error}")
                continue
            self._notify(
                f"{self.folder / file} was not in the index; it was added, with {info.states} state samples"
            )
            self.episodes = (*self.episodes, info)
        if strays:
            self._save()
        numbers = [int(path.stem) for path in found if path.stem.isdigit()]
        self._next = max([len(self.episodes), *(number + 1 for number in numbers)])

    def _save(self) -> None:
        values = {
            "schema_version": SCHEMA_VERSION,
            "robot": self.description["name"],
            "digest": self.digest,
            "description": self.description,
            "episodes": [asdict(episode) for episode in self.episodes],
        }
        try:
            write_json(self.folder / INDEX_NAME, values)
        except OSError as error:
            raise DatasetError(f"{self.folder / INDEX_NAME} cannot be written: {error.strerror}") from error

    def _require_lock(self) -> None:
        if self._lock < 0:
            raise DatasetError(
                f"dataset {self.folder} is open for reading only; a collector uses Dataset.create_or_open"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _lock(folder: Path) -> int:
    """Return the descriptor of the lock, or -1 if another process holds it.

    The kernel drops the lock when its holder dies, so a killed collector does not block others.
    """
    descriptor = os.open(folder / _LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return -1
    return descriptor


def _refuse_other(folder: Path, has: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    if has["name"] != given["name"]:
        raise DatasetError(
            f"dataset {folder} holds recordings of {has['name']!r}, not of {given['name']!r}; "
            "name another folder"
        )
    if digest_of(has) != digest_of(given):
        differ = sorted(key for key in {*has, *given} if _plain(has.get(key)) != _plain(given.get(key)))
        names = ", ".join(key for key in differ if key != "sources")
        raise DatasetError(
            f"dataset {folder} was recorded with another description of {has['name']!r} "
            f"({digest_of(has)}, now {digest_of(given)}; {names} differ); name another folder"
        )


def _plain(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
