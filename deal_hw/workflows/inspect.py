"""``deal_hw.inspect``: the real, the nominal and the calibrated motion beside each other."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Protocol

from deal_hw.calibration import CalibrationResult, percent, read_result
from deal_hw.data.checks.following import followed_part, what_is_cut
from deal_hw.data.files import episode_of
from deal_hw.data.recording.reader import Episode, read_episode
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.parameters import LONGEST_LATENCY_S, ParameterSpace
from deal_hw.ranges import Checked, Range
from deal_hw.sim.recordings.overlay import DEFAULT_WINDOW_S, Overlay, compute_overlay
from deal_hw.workflows.options import File, from_settings
from deal_hw.workflows.robot import recorded_robot
from deal_hw.workflows.say import html_table


class HasResult(Protocol):
    """The attribute of a calibration that is shown; :class:`~deal_hw.workflows.calibrate.Calibration`."""

    @property
    def result(self) -> CalibrationResult:
        """The result."""
        ...


@dataclass(frozen=True, kw_only=True)
class InspectSettings(Checked):
    """Settings of :func:`inspect`."""

    episode: File = field(kw_only=False)
    """The recording, such as runs/first/dataset/episodes/000000.mcap."""

    calibration: File | CalibrationResult | HasResult | None = None
    """Result of `deal-hw calibrate` to compare with: the folder, or its result.json. From Python also the
    return value of :func:`deal_hw.calibrate`."""

    window: Annotated[float, Range(1e-3, 600, "s")] = DEFAULT_WINDOW_S
    """Predictions restart from the measured state after this time [s]."""

    latency: Annotated[float | None, Range(0, LONGEST_LATENCY_S, "s")] = None
    """Total latency in the predictions [s]; by default the calibration's, or 0."""


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """A recording with predictions beside it.

    Attributes:
        path: The recording.
        episode: Its contents.
        description: The robot.
        result: The shown calibration, or None.
        overlay: The predictions; None if the recording allows none.
        note: Why there is no prediction, or why it ends before the recording; empty otherwise.
    """

    path: Path
    episode: Episode
    description: RobotDescription
    result: CalibrationResult | None
    overlay: Overlay | None
    note: str

    def rows(self) -> list[dict[str, str | float]]:
        """Return one row per model: its name, and each joint's position RMSE over the signal's range."""
        if self.overlay is None:
            return []
        return [
            {
                "model": name,
                **dict(zip(self.overlay.joint_names, map(float, prediction.position_nrmse), strict=True)),
            }
            for name, prediction in self.overlay.predictions.items()
        ]

    def table(self) -> str:
        """Return the prediction errors as text."""
        if self.overlay is None:
            return self.note
        lines = []
        for name, prediction in self.overlay.predictions.items():
            shares = ", ".join(
                f"{joint} {percent(share)}"
                for joint, share in zip(self.overlay.joint_names, prediction.position_nrmse, strict=True)
            )
            window_s = self.overlay.window_s
            lines.append(f"{name:>10}: position error over {window_s:.2f} s, of the range: {shares}")
        return "\n".join([*lines, *filter(None, [self.note])])

    def verdict(self) -> str:
        """Return the calibration's verdict as markdown; empty without a calibration."""
        if self.result is None:
            return ""
        from deal_hw.calib.report.verdict import trust

        found = trust(self.result)
        return f"**{found.colour}:** {found.seen} {found.means} **{found.do}**"

    def save(self, path: File) -> Path:
        """Write a rerun recording (.rrd) and return its path.

        Raises:
            ConfigurationError: The path is a folder, or has another suffix.
        """
        from deal_hw.viz.episode_log import write_episode

        path = Path(path)
        check_file(path, ".rrd")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_episode(
            path,
            self.episode.trajectory,
            self.description,
            cycles=self.episode.cycles,
            overlay=self.overlay,
            result=self.result,
            verdict=self.verdict(),
            name=f"{self.path.parent.parent.name}/{self.path.stem}",
            note=self.note,
        )
        return path

    def screenshot(self, path: File, at_s: float | None = None, *, rrd: Path | None = None) -> Path:
        """Write a picture (.png) and return its path; needs a Vulkan renderer, but no desktop.

        Args:
            path: The file.
            at_s: Shown device time [s]; by default the moment of the nominal model's largest error.
            rrd: The file that :meth:`save` wrote, if any.

        Raises:
            ConfigurationError: The path is a folder, or has another suffix; or there is no renderer.
        """
        from deal_hw.viz.screenshot import save_screenshot

        check_file(Path(path), ".png")
        if at_s is None and self.overlay is not None:
            at_s = self.overlay.worst_moment_s("nominal")
        with self.saved(rrd) as file:
            save_screenshot(file, Path(path), at_s=at_s)
        return Path(path)

    def show(self) -> None:
        """Open a window.

        Raises:
            ConfigurationError: This machine has no desktop.
        """
        from deal_hw.viz.serve import check_display, open_window

        check_display()
        with self.saved() as file:
            open_window(file)

    @contextmanager
    def saved(self, rrd: Path | None = None) -> Iterator[Path]:
        """Yield a rerun recording: the one given, or a temporary one."""
        if rrd is not None:
            yield rrd
            return
        with tempfile.TemporaryDirectory(prefix="deal-hw-") as folder:
            yield self.save(Path(folder) / "episode.rrd")

    def _repr_html_(self) -> str:
        rows = self.rows()
        cells = [[v if isinstance(v, str) else percent(v) for v in row.values()] for row in rows]
        return html_table(list(rows[0]), cells) if rows else html_table((self.note,), [])


def check_file(path: Path, suffix: str) -> None:
    """Check that a path can be the file to write.

    Args:
        path: The file.
        suffix: The required suffix, such as ".png".

    Raises:
        ConfigurationError: It is a folder, or has another suffix.
    """
    if path.is_dir():
        raise ConfigurationError(f"{path} is a folder; name a file, such as {path / ('episode' + suffix)}")
    if path.suffix.lower() != suffix:
        raise ConfigurationError(f"{path} does not end in {suffix}; name it {path.with_suffix(suffix)}")


@from_settings(InspectSettings)
def inspect(settings: InspectSettings) -> Inspection:
    """Predict a recording with the nominal and the calibrated model, as ``deal-hw inspect``.

    :class:`InspectSettings` describes the arguments: ``inspect(episode,
    calibration="runs/first/calibration")``.

    Returns:
        The predictions, with methods to show and save them.

    Raises:
        DatasetError: The recording cannot be read.
        ConfigurationError: A setting cannot be used.
    """
    path = episode_of(settings.episode)
    return predicted(settings, path, read_episode(path))


def predicted(settings: InspectSettings, path: Path, episode: Episode) -> Inspection:
    """Return a recording with predictions; see :func:`inspect`."""
    description = recorded_robot(episode.description, path.resolve().parent.parent)
    result = _result(settings.calibration)
    overlay, note = _overlay(settings, episode, description, result)
    return Inspection(
        path=path, episode=episode, description=description, result=result, overlay=overlay, note=note
    )


def _result(source: File | CalibrationResult | HasResult | None) -> CalibrationResult | None:
    if isinstance(source, str | Path):
        return read_result(Path(source))
    return source if source is None or isinstance(source, CalibrationResult) else source.result


def _overlay(
    settings: InspectSettings,
    episode: Episode,
    description: RobotDescription,
    result: CalibrationResult | None,
) -> tuple[Overlay | None, str]:
    space = ParameterSpace([]) if result is None else result.space
    sets = {"nominal": space.nominal}
    if result is not None:
        sets["calibrated"] = result.estimate
    latency_s = settings.latency
    if latency_s is None:
        latency_s = 0.0 if result is None else result.latency_s
    cut = what_is_cut(episode.trajectory)
    part = followed_part(episode.trajectory)
    try:
        overlay = compute_overlay(
            part, description, space, sets, latency_s=latency_s, window_s=settings.window
        )
    except InsufficientDataError as err:
        return None, f"No predictions: {err}{cut and f'; {cut}'}."
    return overlay, cut and f"Of the predictions {cut}."
