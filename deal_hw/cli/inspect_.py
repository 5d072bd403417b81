"""``deal-hw inspect``: see the real, the nominal and the calibrated motion on one screen."""

from __future__ import annotations

import contextlib
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deal_hw.data.files import episode_of
from deal_hw.data.recording.reader import read_episode
from deal_hw.ranges import Range
from deal_hw.sim.recordings.overlay import Overlay
from deal_hw.viz.serve import DEFAULT_WEB_PORT, check_display, open_window, serve_web
from deal_hw.viz.viewer import from_elsewhere
from deal_hw.workflows.inspect import InspectSettings, check_file, predicted
from deal_hw.workflows.options import refuse


@dataclass(frozen=True, kw_only=True)
class Inspect(InspectSettings):
    """See the real, the nominal and the calibrated motion on one screen.

    Without --save, --screenshot and --web a window opens.
    """

    episode: tyro.conf.Positional[Path]

    calibration: Path | None = None
    """Result of `deal-hw calibrate` to compare with: the folder, or its result.json."""

    save: Path | None = None
    """Write a rerun recording (.rrd)."""

    screenshot: Path | None = None
    """Write a picture (.png). Needs a Vulkan renderer, but no desktop."""

    web: bool = False
    """Show the view in a browser on this machine, until Ctrl-C."""

    web_port: Annotated[int, Range(0, 65535)] = DEFAULT_WEB_PORT
    """Port to which the browser connects; 0: any free one."""

    at: Annotated[float | None, Range(0, 1e6, "s")] = None
    """Device time of the screenshot [s]; by default the moment of the nominal model's largest error."""

    quiet: bool = False
    """Print nothing but errors and the address to open."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.web_port != DEFAULT_WEB_PORT and not self.web:
            refuse(["--web-port"], "only --web opens a port")
        if self.at is not None and self.screenshot is None:
            refuse(["--at"], "only --screenshot shows a single moment")


@dataclass(frozen=True, kw_only=True)
class InspectReport:
    """The recording that was shown.

    Attributes:
        overlay: The predictions; None if the recording allows none.
        note: Why there is no prediction, or why it ends before the recording; empty otherwise.
        files: The written files.
    """

    overlay: Overlay | None
    note: str
    files: tuple[Path, ...]


def inspect(config: Inspect) -> InspectReport:
    """Show a recording with predictions: as a file, in a browser, as a picture or in a window.

    Raises:
        DatasetError: The recording cannot be read.
        ConfigurationError: A setting cannot be used, or this machine cannot show the view; the message names
            another way.
    """
    for file, suffix in ((config.save, ".rrd"), (config.screenshot, ".png")):
        if file is not None:
            check_file(file, suffix)
    path = episode_of(config.episode)
    episode = read_episode(path)
    window = not (config.save or config.screenshot or config.web)
    if window:
        check_display()
    found = predicted(config, path, episode)
    if not config.quiet:
        # Before the view, which stays until it is closed.
        print(found.table(), flush=True)
    with found.saved(None if config.save is None else found.save(config.save)) as rrd:
        if config.screenshot:
            found.screenshot(config.screenshot, config.at, rrd=rrd)
        if config.web:
            _serve(rrd, config.web_port, config.quiet)
        elif window:
            open_window(rrd)
    files = tuple(file for file in (config.save, config.screenshot) if file)
    if not config.quiet:
        for file in files:
            print(f"written: {file}")
    return InspectReport(overlay=found.overlay, note=found.note, files=files)


def _serve(rrd: Path, port: int, quiet: bool) -> None:
    # By default SIGTERM would end this process and leave the server running.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with contextlib.suppress(KeyboardInterrupt), serve_web(rrd, port=port) as (address, server):
            print(f"open {address}  (Ctrl-C ends it)", flush=True)
            if not quiet:
                print(f"on another computer, run there first: {from_elsewhere(address)}", flush=True)
            server.process.wait()
            server.check()
    finally:
        signal.signal(signal.SIGTERM, before)
