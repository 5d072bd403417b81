"""A viewer that waits for data: rerun's own window, or a page in the browser, both on this machine only."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from deal_hw.viz.viewer import LOOPBACK, WINDOW, free_port, run_viewer, wait_until_listening, web_address

_START_S = 20.0


@contextlib.contextmanager
def live_viewer() -> Iterator[tuple[str, str]]:
    """Run a viewer until the block ends: a window if there is a desktop, else a server for a browser.

    Yields:
        The address that receives data, and the address to open in a browser ("" for a window).

    Raises:
        ConfigurationError: The viewer does not start.
    """
    port = free_port()
    data = f"rerun+http://{LOOPBACK}:{port}/proxy"
    arguments = ["--bind", LOOPBACK, "--port", str(port)]
    address = ""
    ports = [port]
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        web = free_port()
        arguments += ["--serve-web", "--web-viewer-port", str(web)]
        address = web_address(web, data)
        ports.append(web)
    else:
        arguments += WINDOW
    with run_viewer(arguments) as viewer:
        for wanted in ports:
            wait_until_listening(viewer, wanted, _START_S)
        yield data, address
