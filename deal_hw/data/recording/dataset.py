"""A dataset: ``DIR/dataset.json`` and ``DIR/episodes/000000.mcap``, ...; one robot, one description."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from typing_extensions import Self

from deal_hw.data.files import INDEX_NAME, write_bytes
from deal_hw.data.recording.dataset_index import read_index, write_index
from deal_hw.data.recording.episode_info import EXAMPLE, EpisodeInfo, number_in, summarize
from deal_hw.data.recording.reader import Episode, read_episode
from deal_hw.description import RobotDescription, digest_of
from deal_hw.errors import DatasetError, EmptyRecordingError

POLICY_FOLDER = "policies"
REMOVED_FOLDER = "removed"
"""Folder of removed episodes; see :mod:`deal_hw.data.recording.removal`."""
_LOCK_NAME = ".lock"
_SHOWN = 5
"""Most episodes that one message lists."""
Notify = Callable[[str], None]


class Dataset:
    """A folder of episodes; made by :meth:`create_or_open`, :meth:`open` or :meth:`edit`.

    A collector closes it or uses it in a ``with`` block; until then no other collector can append to it.

    Attributes:
        folder: Where it is.
        description: ``RobotDescription.to_json()`` of its robot.
        digest: Digest of the description.
        episodes: Entry of the index for each episode, in order. Its place there is not its number where
            episodes were removed.
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
        self._next = 0

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
        with _locked(folder, make=True) as lock:
            if (folder / INDEX_NAME).exists():
                dataset = cls._load(folder, lock, notify)
                _refuse_other(folder, dataset.description, facts)
            else:
                dataset = cls(folder, facts, (), lock, notify)
                write_index(folder, facts, ())
            dataset._adopt()
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
        folder = _existing(folder)
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
    def edit(cls, folder: Path, notify: Notify = print) -> Self:
        """Open a dataset to keep or remove episodes; it is locked until closed.

        Args:
            folder: The dataset.
            notify: Called with a sentence for each repair.

        Raises:
            DatasetError: It is not a dataset, a collector has it open, or it cannot be read or written.
        """
        folder = _existing(folder)
        with _locked(folder) as lock:
            dataset = cls._load(folder, lock, notify)
            dataset._adopt()
        return dataset

    @classmethod
    def _load(cls, folder: Path, lock: int, notify: Notify) -> Self:
        index = read_index(folder)
        return cls(folder, index.description, index.episodes, lock, notify)

    @property
    def numbers(self) -> tuple[int, ...]:
        """The episodes' numbers, in order; a removed episode leaves a gap."""
        return tuple(episode.number for episode in self.episodes)

    def info(self, number: int) -> EpisodeInfo:
        """Return the index's entry for an episode; negative numbers count from the end.

        Raises:
            DatasetError: There is no such episode.
        """
        found = [episode for episode in self.episodes if episode.number == number]
        if not found and -len(self.episodes) <= number < 0:
            found = [self.episodes[number]]
        if not found:
            last = f", the last is {self.numbers[-1]}" if self.episodes else ""
            raise DatasetError(
                f"dataset {self.folder} has {len(self.episodes)} episodes; there is no number {number} (the "
                f"first is {self.numbers[0] if self.episodes else 0}{last})"
            )
        return found[0]

    def path(self, number: int) -> Path:
        """Return the file of an episode; numbers and errors as :meth:`info`."""
        return self.folder / self.info(number).file

    def read(self, number: int) -> Episode:
        """Read an episode; errors as :func:`~deal_hw.data.recording.reader.read_episode` and :meth:`path`."""
        return read_episode(self.path(number))

    def why_left_out(self, info: EpisodeInfo) -> str:
        """Return why an episode is left out, and how to use it all the same, as text; "" if it is used."""
        if not info.left_out:
            return ""
        text = f"episode {info.number} is left out: {info.left_out}"
        if info.failed_checks:
            return f"{text}; also {'; '.join(info.failed_checks)}"
        return f"{text}; to use it all the same: deal-hw data keep {self.folder} {info.number}"

    def used(self, notify: Notify) -> tuple[int, ...]:
        """Return the numbers of the episodes that are used.

        Args:
            notify: Called with a sentence for each that is left out.

        Raises:
            DatasetError: All are left out.
        """
        left_out = [text for info in self.episodes if (text := self.why_left_out(info))]
        if left_out and len(left_out) == len(self.episodes):
            more = f". {len(left_out) - _SHOWN} more" if len(left_out) > _SHOWN else ""
            raise DatasetError(f"dataset {self.folder}: {'. '.join(left_out[:_SHOWN])}{more}")
        for text in left_out:
            notify(text)
        return tuple(info.number for info in self.episodes if not info.left_out)

    def change(self, episodes: Sequence[EpisodeInfo]) -> None:
        """Write another list of episodes to the index.

        Raises:
            DatasetError: The dataset was not opened for changes, or cannot be written.
        """
        self._require_lock()
        self.episodes = tuple(sorted(episodes, key=lambda episode: episode.number))
        write_index(self.folder, self.description, self.episodes)

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
        if Path(path).resolve() != (self.folder / file).resolve() or number_in(file) < 0:
            raise DatasetError(
                f"{path} is not in {self.folder / 'episodes'}, or has no name such as {EXAMPLE}"
            )
        info, episode = self._take(file, "", facts)
        self.change((*self.episodes, info))
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
        found = [f"episodes/{path.name}" for path in sorted((self.folder / "episodes").glob("[0-9]*.mcap"))]
        added = []
        for file in found:
            if file in known:
                continue
            try:
                if number_in(file) < 0:
                    raise DatasetError(f"it has no name such as {EXAMPLE}; rename it")
                info, _ = self._take(file, "added to the index after its collector was killed")
            except DatasetError as error:
                self._notify(f"{self.folder / file} is left out: {error}")
                continue
            self._notify(
                f"{self.folder / file} was not in the index; it was added, with {info.states} state samples"
            )
            added.append(info)
        if added:
            self.change((*self.episodes, *added))
        removed = [f"episodes/{path.name}" for path in (self.folder / REMOVED_FOLDER).glob("*.mcap")]
        # A number is never used twice, or results would name another episode than the one they are from.
        self._next = max([-1, *map(number_in, (*found, *removed)), *self.numbers]) + 1

    def _require_lock(self) -> None:
        if self._lock < 0:
            raise DatasetError(
                f"dataset {self.folder} is open for reading only; a collector uses Dataset.create_or_open, "
                "a change of its episodes Dataset.edit"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _existing(folder: Path) -> Path:
    """Return the folder of a dataset that is there.

    Raises:
        DatasetError: It is not a dataset.
    """
    folder = Path(folder)
    if not (folder / INDEX_NAME).is_file():
        raise DatasetError(
            f"{folder} is not a dataset: it has no {INDEX_NAME}; `deal-hw collect` makes one, and "
            "`deal-hw data import` makes one from files"
        )
    return folder


@contextlib.contextmanager
def _locked(folder: Path, *, make: bool = False) -> Iterator[int]:
    """Lock a dataset, and keep the lock unless the block raises.

    Args:
        folder: The dataset.
        make: Make its folders first.

    Yields:
        The descriptor of the lock.

    Raises:
        DatasetError: It cannot be written, or another process holds the lock.
    """
    try:
        if make:
            (folder / "episodes").mkdir(parents=True, exist_ok=True)
        lock = _lock(folder)
    except OSError as error:
        raise DatasetError(f"dataset {folder} cannot be written: {error.strerror}") from error
    if lock < 0:
        raise DatasetError(
            f"dataset {folder} is in use by another collector; wait for it or name another folder"
        )
    try:
        yield lock
    except BaseException:
        os.close(lock)
        raise


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
