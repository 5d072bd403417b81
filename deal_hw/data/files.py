"""Writes files completely or not at all; finds episodes, and reads them up to a maximum size."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from mcap.writer import MCAP0_MAGIC

from deal_hw.errors import DatasetError, EmptyRecordingError
from deal_hw.reading import check_size, reading

INDEX_NAME = "dataset.json"
"""File name of a dataset's index."""
MAX_EPISODE_BYTES = 4 << 30
"""Largest episode, since its samples are kept in memory; a Go2 with its raw bytes records at most 0.7 MB/s
[B]."""
_WINDOW_BYTES = 1 << 20


def sha256_of(path: Path) -> hashlib._Hash:
    """Return the SHA-256 hash of a file's contents; the file is read in parts.

    Raises:
        OSError: It cannot be read.
    """
    found = hashlib.sha256()
    with open(path, "rb") as file:
        while part := file.read(1 << 20):
            found.update(part)
    return found


class EpisodeFile:
    """The bytes of a file, read where they are needed; slices and :meth:`find` work as those of ``bytes``.

    Args:
        path: Its name in messages.
        file: An ordinary file, open for reading.
    """

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self._path = path
        self._descriptor = file.fileno()
        self._size = os.fstat(self._descriptor).st_size
        self._start = 0
        self._window = b""

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        start, stop, _ = part.indices(self._size)
        wanted = max(stop - start, 0)
        try:
            found = os.pread(self._descriptor, wanted, start)
        except OSError as error:
            raise DatasetError(f"{self._path} cannot be read: {error.strerror}") from error
        if len(found) < wanted:
            raise DatasetError(f"{self._path} became shorter while it was read; read it again")
        return found

    def find(self, mark: bytes, start: int) -> int:
        """Return where a few bytes stand first, at or after ``start``; -1 if they do not."""
        while start + len(mark) <= self._size:
            # Places may be close together, so a part of the file is kept.
            if not self._start <= start <= self._start + len(self._window) - len(mark):
                self._start, self._window = start, self[start : start + _WINDOW_BYTES]
            at = self._window.find(mark, start - self._start)
            if at >= 0:
                return self._start + at
            start = self._start + len(self._window) - len(mark) + 1
        return -1


@contextlib.contextmanager
def opened_episode(path: Path) -> Iterator[EpisodeFile]:
    """Open an MCAP file for reading.

    Raises:
        EmptyRecordingError: It has 0 bytes.
        DatasetError: It cannot be read, is too large, or does not begin like an MCAP file.
    """
    with contextlib.ExitStack() as stack:
        with reading(path, "an episode"):
            check_size(Path(path), MAX_EPISODE_BYTES)
            file = stack.enter_context(open(path, "rb"))
        data = EpisodeFile(Path(path), file)
        head = data[: len(MCAP0_MAGIC)]
        if not head:
            raise EmptyRecordingError(
                f"{path} is empty (0 bytes): nothing was recorded, so it cannot be repaired; record again"
            )
        if not MCAP0_MAGIC.startswith(head):
            raise DatasetError(
                f"{path} is not an MCAP file, it starts with {head!r}; episodes are files such as "
                "DIR/episodes/000000.mcap"
            )
        yield data


def write_json(path: Path, values: Any) -> None:
    """Write plain JSON values as :func:`write_bytes` does."""
    write_bytes(path, f"{json.dumps(values, indent=2)}\n".encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file: to a temporary one beside it, onto the disk, then renamed over."""
    path = Path(path)
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(fresh, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)
    _sync_folder(path.parent)


@contextlib.contextmanager
def published_together(folder: Path) -> Iterator[Path]:
    """Yield a folder to write into; at the end its files move to another one.

    If the block raises, nothing moves and the other folder stays unchanged. Both folders have the same
    parent, so relative paths are the same in both. Files of the same name are replaced, other files stay.
    Ctrl-C during the moves takes effect after them.

    Args:
        folder: Destination of the files; made if missing.

    Raises:
        OSError: A folder or a file cannot be written.
    """
    # Links are followed first, since the parent of a link is not the parent of its folder.
    folder = Path(os.path.realpath(folder))
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as waiting:
        yield Path(waiting)
        for file in sorted(Path(waiting).iterdir()):
            _sync(file)
        with interrupts_deferred():
            for file in sorted(Path(waiting).iterdir()):
                # Not os.replace, since the folder may be on another file system.
                shutil.move(file, folder / file.name)
    _sync_folder(folder)


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM take effect at the end of the block; only in the main thread.

    Raises:
        KeyboardInterrupt: At the end, if there was a Ctrl-C, or a SIGTERM in a verb of the command line.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    before = {
        number: signal.signal(number, lambda number, frame: pressed.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if pressed:
            # Passed to the previous handler, which may be another block of this kind.
            signal.raise_signal(pressed[0])


def _sync(file: Path) -> None:
    with open(file, "rb") as opened:
        os.fsync(opened.fileno())


def _sync_folder(folder: Path) -> None:
    """Write a rename to the disk, so that it survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def dataset_of(folder: Path | str) -> Path:
    """Return the folder of a named dataset, or of a named run's dataset; else the name itself."""
    folder = Path(folder)
    inside = folder / "dataset"
    return inside if not (folder / INDEX_NAME).exists() and (inside / INDEX_NAME).is_file() else folder


def episode_of(path: Path | str) -> Path:
    """Return the named recording, or the only episode of a named dataset or run.

    Raises:
        DatasetError: It is a folder without an episode, or with several.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    files = sorted((dataset_of(path) / "episodes").glob("*.mcap"))
    if len(files) == 1:
        return files[0]
    if not files:
        raise DatasetError(f"{path} is a folder without an episode; record one with `deal-hw collect`")
    raise DatasetError(f"{path} is a folder with {len(files)} episodes; name one of them, such as {files[0]}")
