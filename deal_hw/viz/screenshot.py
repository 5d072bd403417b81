"""A picture of a recording without a desktop: rerun's headless viewer on a software renderer."""

from __future__ import annotations

import io
import time
from pathlib import Path
from typing import Any

from PIL import Image

from deal_hw.errors import ConfigurationError
from deal_hw.viz.columns import DEVICE_TIMELINE
from deal_hw.viz.viewer import LOOPBACK, Viewer, free_port, run_viewer, wait_until_listening

DEFAULT_SIZE = (1600, 1000)
RENDERER_INSTALL = "apt-get install -y mesa-vulkan-drivers"
_MENU_BAR_PX = 36
_START_S = 30.0
_LOAD_S = 30.0
_SETTLE_S = 1.0


def save_screenshot(
    rrd: Path, picture: Path, *, at_s: float | None = None, size: tuple[int, int] = DEFAULT_SIZE
) -> None:
    """Save a picture of a recording as its own layout shows it.

    Args:
        rrd: The recording.
        picture: The PNG file to write.
        at_s: Device time of the cursor [s]; None for the start.
        size: Width and height of the viewer's window [px].

    Raises:
        ConfigurationError: No such recording, no Vulkan renderer on this machine (the message says how to get
            one), or the viewer shows nothing in time.
    """
    if not rrd.is_file():
        raise ConfigurationError(f"{rrd}: no such recording")
    port = free_port()
    arguments = [str(rrd), "--headless", "--bind", LOOPBACK, "--port", str(port), "--renderer=vulkan"]
    arguments += ["--window-size", f"{size[0]}x{size[1]}"]
    # Messages at lower levels would be shown as bubbles on top of the traces.
    with run_viewer(arguments, {"RUST_LOG": "error"}) as viewer:
        try:
            wait_until_listening(viewer, port, _START_S)
            client = _wait_until_loaded(viewer, port)
            if at_s is not None:
                client.set_time(DEVICE_TIMELINE, duration=at_s, play_state="paused")
            png = _settled(client)
        except (ConfigurationError, ConnectionError, RuntimeError, TimeoutError) as err:
            raise ConfigurationError(_explain(viewer, err)) from err
    _write(png, picture)


def _wait_until_loaded(viewer: Viewer, port: int) -> Any:
    """Return a client of the viewer once it shows a recording."""
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + _LOAD_S
    problem = "no answer"
    while time.monotonic() < deadline:
        viewer.check()
        try:
            client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
            state = client.get_state()
        except (ConnectionError, RuntimeError, TimeoutError) as err:
            problem = str(err)
        else:
            if state.views and any(recording.timelines for recording in state.recordings):
                return client
            problem = "it loaded no recording"
        time.sleep(0.1)
    raise ConfigurationError(f"rerun's headless viewer was not ready within {_LOAD_S:g} s: {problem}")


def _settled(client: Any) -> bytes:
    """Return a screenshot that is the same as the one before it: all is loaded and drawn."""
    last = b""
    for _ in range(10):
        time.sleep(_SETTLE_S)
        now: bytes = client.take_screenshot()
        if now == last:
            break
        last = now
    return last


def _explain(viewer: Viewer, err: Exception) -> str:
    output = viewer.output
    words = ("adapter", "vulkan", "wgpu", "graphics")
    if viewer.process.poll() is not None and any(word in output.lower() for word in words):
        return (
            "there is no Vulkan renderer for the picture; a software one will do. On Debian and Ubuntu: "
            f"{RENDERER_INSTALL} - or look at the recording with --web"
        )
    return f"no picture: {err}\nrerun said: {output.strip()[-400:] or '(nothing)'}"


def _write(png: bytes, picture: Path) -> None:
    """Write the picture without the viewer's menu bar, in a palette: a third of the size, looks the same."""
    with Image.open(io.BytesIO(png)) as image:
        body = image.convert("RGB").crop((0, _MENU_BAR_PX, image.width, image.height))
        picture.parent.mkdir(parents=True, exist_ok=True)
        body.quantize(256, dither=Image.Dither.NONE).save(picture, format="PNG", optimize=True)
