"""``deal-hw inspect``: see the real, the nominal and the calibrated motion on one screen."""

from __future__ import annotations

import contextlib
import signal
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deal_hw.calibration import CalibrationResult, read_result
from deal_hw.data.recording.reader import Episode, read_episode
from deal_hw.description import RobotDescription
from deal_hw.drivers import recorded_description
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.parameters import LONGEST_LATENCY_S, ParameterSpace
from deal_hw.sim.recordings.overlay import DEFAULT_WINDOW_S, Overlay, compute_overlay
from deal_hw.viz.episode_log import write_episode
from deal_hw.viz.screenshot import save_screenshot
from deal_hw.viz.serve import DEFAULT_WEB_PORT, check_display, open_window, serve_web
from deal_hw.workflows.options import Range, check_ranges, refuse


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """See the real, the nominal and the calibrated motion on one screen.

    Without --save, --screenshot and --web a window opens.
    """

    episode: tyro.conf.Positional[Path]
    """The recording, such as runs/first/dataset/episodes/000000.mcap."""

    calibration: Path | None = None
    """Result of `deal-hw calibrate` to show beside it: the folder, or its result.json."""

    save: Path | None = None
    """Write a rerun recording (.rrd)."""

    screenshot: Path | None = None
    """Write a picture (.png); needs a Vulkan renderer, but no desktop."""

    web: bool = False
    """Serve it to a browser on this machine until Ctrl-C."""

    web_port: Annotated[int, Range(0, 65535)] = DEFAULT_WEB_PORT
    """Where the browser connects; 0 for any free port."""

    window: Annotated[float, Range(1e-3, 600, "s")] = DEFAULT_WINDOW_S
    """Predictions restart from the measured state after this time [s]."""

    latency: Annotated[float | None, Range(0, LONGEST_LATENCY_S, "s")] = None
    """Total latency in the predictions [s]; by default the calibration's, or 0."""

    at: Annotated[float | None, Range(0, 1e6, "s")] = None
    """Device time that the screenshot shows [s]; by default where the nominal model errs most."""

    quiet: bool = False
    """Print nothing but errors and the address to open."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.web_port != DEFAULT_WEB_PORT and not self.web:
            refuse(["--web-port"], "only --web opens a port")
        if self.at is not None and self.screenshot is None:
            refuse(["--at"], "only --screenshot shows a single moment")


@dataclass(frozen=True, kw_only=True)
class InspectReport:
    """What was shown.

    Attributes:
        overlay: The predictions; None where the recording allows none.
        note: Why there is none; empty otherwise.
        files: The files written.
    """

    overlay: Overlay | None
    note: str
    files: tuple[Path, ...]


def inspect(config: Inspect) -> InspectReport:
    """Write, serve, picture or open a recording with predictions beside it.

    Raises:
        DatasetError: The recording cannot be read.
        ConfigurationError: A setting cannot be used, or this machine cannot show it; the message says what
            would do.
    """
    episode = read_episode(config.episode)
    if not (config.save or config.screenshot or config.web):
        check_display()
    description = recorded_description(str(episode.description["name"]))
    result = read_result(config.calibration) if config.calibration else None
    overlay, note = _overlay(config, episode, description, result)
    with contextlib.ExitStack() as stack:
        rrd = config.save
        if rrd is None:
            rrd = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="deal-hw-"))) / "episode.rrd"
        _prepare(rrd)
        write_episode(
            rrd,
            episode.trajectory,
            description,
            cycles=episode.cycles,
            overlay=overlay,
            result=result,
            name=f"{config.episode.parent.parent.name}/{config.episode.stem}",
            note=note,
        )
        if config.screenshot:
            save_screenshot(rrd, config.screenshot, at_s=_moment(config, overlay))
        _show(config, rrd)
    files = tuple(file for file in (config.save, config.screenshot) if file)
    if not config.quiet:
        _print(overlay, note, files)
    return InspectReport(overlay=overlay, note=note, files=files)


def _overlay(
    config: Inspect, episode: Episode, description: RobotDescription, result: CalibrationResult | None
) -> tuple[Overlay | None, str]:
    space = ParameterSpace([]) if result is None else result.space
    sets = {"nominal": space.nominal}
    if result is not None:
        sets["calibrated"] = result.estimate
    latency_s = config.latency
    if latency_s is None:
        latency_s = 0.0 if result is None else result.latency_s
    try:
        overlay = compute_overlay(
            episode.trajectory, description, space, sets, latency_s=latency_s, window_s=config.window
        )
    except InsufficientDataError as err:
        return None, f"No predictions: {err}."
    return overlay, ""


def _moment(config: Inspect, overlay: Overlay | None) -> float | None:
    if config.at is not None or overlay is None:
        return config.at
    return overlay.worst_moment_s("nominal")


def _prepare(file: Path) -> None:
    if file.is_dir():
        raise ConfigurationError(f"{file} is a folder; name a file, such as {file / 'episode.rrd'}")
    file.parent.mkdir(parents=True, exist_ok=True)


def _show(config: Inspect, rrd: Path) -> None:
    if not config.web:
        if not (config.save or config.screenshot):
            open_window(rrd)
        return
    # By default SIGTERM would end us without a word to the server, which would stay behind.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with (
            contextlib.suppress(KeyboardInterrupt),
            serve_web(rrd, port=config.web_port) as (address, server),
        ):
            print(f"open {address}  (this machine only; Ctrl-C ends it)", flush=True)
            server.process.wait()
            server.check()
    finally:
        signal.signal(signal.SIGTERM, before)


def _print(overlay: Overlay | None, note: str, files: tuple[Path, ...]) -> None:
    if note:
        print(note)
    if overlay is not None:
        for name, prediction in overlay.predictions.items():
            shares = ", ".join(
                f"{joint} {100 * share:.2g} %"
                for joint, share in zip(overlay.joint_names, prediction.position_nrmse, strict=True)
            )
            print(f"{name:>10}: position error over {overlay.window_s:.2f} s, of the range: {shares}")
    for file in files:
        print(f"written: {file}")
