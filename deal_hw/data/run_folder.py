"""A run: one folder with settings, seeds, versions, recordings and results."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any

from typing_extensions import Self

from deal_hw.data.files import write_json
from deal_hw.errors import DatasetError
from deal_hw.reading import read_json

_PACKAGES = (
    "deal-hw",
    "numpy",
    "mujoco",
    "torch",
    "scipy",
    "onnxruntime",
    "stable-baselines3",
    "mcap",
    "rerun-sdk",
)


class RunFolder:
    """``runs/<name>/`` with ``run.json``, ``dataset/``, ``calibration/`` and ``policies/``.

    ``run.json`` is written at the start with status "running" and again at the end. So a killed run keeps the
    status "running".

    Args:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._record: dict[str, Any] = {}

    @property
    def dataset(self) -> Path:
        """Recordings of this run."""
        return self.path / "dataset"

    @property
    def calibration(self) -> Path:
        """Result, distribution, calibrated model, report."""
        return self.path / "calibration"

    @property
    def policies(self) -> Path:
        """Trained policies."""
        return self.path / "policies"

    @property
    def summary(self) -> Path:
        """The summary that the run ends with."""
        return self.path / "summary.json"

    def start(
        self, settings: Mapping[str, Any], seeds: Mapping[str, int], argv: Sequence[str] | None = None
    ) -> None:
        """Create the folders and write the settings of the run.

        Args:
            settings: Plain JSON values.
            seeds: Every used seed, by its purpose.
            argv: The command line; this process's by default.

        Raises:
            DatasetError: The folder cannot be written.
        """
        self._record = {
            "status": "running",
            "argv": list(sys.argv if argv is None else argv),
            "settings": dict(settings),
            "seeds": dict(seeds),
            "start_utc": _now(),
            "versions": versions(),
            "platform": platform.platform(),
            "machine": platform.machine(),
            "processors": len(os.sched_getaffinity(0)),
            "git_commit": git_commit(),
        }
        try:
            for folder in (self.dataset, self.calibration, self.policies):
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DatasetError(f"run folder {self.path} cannot be made: {error.strerror}") from error
        self._save()

    def finish(self, status: str = "finished", **results: Any) -> None:
        """Write the result of the run.

        Args:
            status: "finished", "failed" or "interrupted".
            results: Plain JSON values to keep in ``run.json``, such as seconds for each stage.
        """
        self._record.update(status=status, end_utc=_now(), **results)
        self._save()

    def read(self) -> dict[str, Any]:
        """Return ``run.json``.

        Raises:
            DatasetError: The folder is not a run.
        """
        return read_json(self.path / "run.json", dict[str, Any], "the record of a run", "name a run's folder")

    def write(self, name: str, values: Any) -> Path:
        """Write plain JSON values to a file inside the folder, atomically; return its path."""
        path = self.path / name
        write_json(path, values)
        return path

    def _save(self) -> None:
        try:
            write_json(self.path / "run.json", self._record)
        except OSError as error:
            raise DatasetError(f"{self.path / 'run.json'} cannot be written: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._record.get("status") != "running":
            return
        if error is None:
            self.finish()
        elif isinstance(error, KeyboardInterrupt):
            self.finish("interrupted")
        else:
            self.finish("failed", error=f"{type(error).__name__}: {error}")


def versions() -> dict[str, str]:
    """Return the versions of installed packages, without importing them."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def git_commit() -> str | None:
    """Return the commit of the checkout that this package runs from; None outside one."""
    folder = Path(__file__).resolve().parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=5.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip() or None


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
