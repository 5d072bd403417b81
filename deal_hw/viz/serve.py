"""Showing a recording: in a browser, served to this machine only, or in rerun's own window."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from deal_hw.errors import ConfigurationError
from deal_hw.viz.viewer import (
    LOOPBACK,
    WINDOW,
    Viewer,
    check_port,
    check_recording,
    free_port,
    run_viewer,
    wait_until_listening,
    web_address,
)

DEFAULT_WEB_PORT = 9090
_START_S = 20.0


@contextlib.contextmanager
def serve_web(rrd: Path, *, port: int = DEFAULT_WEB_PORT) -> Iterator[tuple[str, Viewer]]:
    """Serve rerun's web viewer with a recording on the loopback interface until the block ends.

    Args:
        rrd: The recording.
        port: Port for the browser; 0 for any free one. The data come over another free port.

    Yields:
        The address to open, and the server.

    Raises:
        ConfigurationError: No such file, the port is taken, or the server does not start.
    """
    check_recording(rrd)
    web_port = port or free_port()
    check_port(web_port)
    data_port = free_port()
    arguments = [str(rrd), "--serve-web", "--bind", LOOPBACK]
    arguments += ["--web-viewer-port", str(web_port), "--port", str(data_port)]
    with run_viewer(arguments) as viewer:
        for wanted in (web_port, data_port):
            wait_until_listening(viewer, wanted, _START_S)
        yield web_address(web_port, f"rerun+http://{LOOPBACK}:{data_port}/proxy"), viewer


def check_display() -> None:
    """Check that there is a desktop to open a window on.

    Raises:
        ConfigurationError: There is none.
    """
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigurationError(
            "no desktop was found (neither DISPLAY nor WAYLAND_DISPLAY is set), so no window can open. Add "
            "--web (a browser here, or on another computer over ssh), --save FILE.rrd (to open it elsewhere: "
            "rerun FILE.rrd), or --screenshot FILE.png"
        )


def open_window(rrd: Path) -> None:
    """Show a recording in rerun's own window and return when it is closed.

    Raises:
        ConfigurationError: No such file, there is no desktop, or the viewer failed.
    """
    check_recording(rrd)
    check_display()
    with run_viewer([str(rrd), "--bind", LOOPBACK, "--port", str(free_port()), *WINDOW]) as viewer:
        if viewer.process.wait():
            viewer.check()
