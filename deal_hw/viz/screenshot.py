"""A picture of a recording without a desktop: rerun's headless viewer on a software renderer."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

from PIL import Image

from deal_hw.errors import ConfigurationError
from deal_hw.viz.columns import DEVICE_TIMELINE
from deal_hw.viz.viewer import (
    LOOPBACK,
    Viewer,
    check_recording,
    free_port,
    program,
    run_viewer,
    wait_until_listening,
)

DEFAULT_SIZE = (1280, 800)
RENDERER_INSTALL = "apt-get install -y mesa-vulkan-drivers"
_MENU_BAR_PX = 36
_CONTROL = {
    "protocolVersion": "2024-11-05",
    "capabilities": {},
    "clientInfo": {"name": "deal-hw", "version": "0"},
}
_LIGHT_BUTTON = {"content_contains": "Light", "role": "Button"}
_START_S = 30.0
_LOAD_S = 30.0
_SETTLE_S = 1.0
_CLICK_S = 20.0


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
    check_recording(rrd)
    port = free_port()
    arguments = [str(rrd), "--headless", "--bind", LOOPBACK, "--port", str(port), "--renderer=vulkan"]
    arguments += ["--window-size", f"{size[0]}x{size[1]}"]
    # Messages at lower levels would be shown as bubbles on top of the traces.
    with run_viewer(arguments, {"RUST_LOG": "error"}) as viewer:
        try:
            wait_until_listening(viewer, port, _START_S)
            client = _wait_until_loaded(viewer, port)
            _choose_light_theme(client, port)
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


def _choose_light_theme(client: Any, port: int) -> None:
    """Click "Light" on the settings page: the headless viewer reads no settings and has no option for it.

    Rerun's own control program finds the button by its text. Where another version of rerun lacks it, the
    picture is dark.
    """
    place = client.get_location()
    client.run_command("ui.open_settings")
    calls: tuple[dict[str, Any], ...] = (
        {"method": "initialize", "params": _CONTROL},
        {"method": "tools/call", "params": {"name": "click", "arguments": _LIGHT_BUTTON}},
        # The pointer is drawn; at the top it is cut off with the menu.
        {"method": "tools/call", "params": {"name": "hover", "arguments": {"pos": {"x": 600, "y": 2}}}},
    )
    command = [str(program()), "viewer-mcp", "--endpoint", f"http://{LOOPBACK}:{port}"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as control:
        assert control.stdin is not None and control.stdout is not None
        late = threading.Timer(_CLICK_S, control.kill)
        late.start()
        with contextlib.suppress(BrokenPipeError):
            for number, call in enumerate(calls):
                print(json.dumps({"jsonrpc": "2.0", "id": number, **call}), file=control.stdin, flush=True)
                control.stdout.readline()
                if number == 0:
                    ready = {"jsonrpc": "2.0", "method": "notifications/initialized"}
                    print(json.dumps(ready), file=control.stdin, flush=True)
            control.stdin.close()
        control.wait()
        late.cancel()
    client.set_location(place)


def _settled(client: Any) -> bytes:
    """Return a screenshot that equals the one before it, so that all is loaded and drawn."""
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
            "there is no Vulkan renderer for the picture; a software renderer is enough. On Debian and "
            "Ubuntu: "
            f"{RENDERER_INSTALL} - or look at the recording with --web"
        )
    return f"no picture: {err}\nrerun printed: {output.strip()[-400:] or '(nothing)'}"


def _write(png: bytes, picture: Path) -> None:
    """Write the picture without the viewer's menu bar, in a palette: a third of the size, looks the same."""
    with Image.open(io.BytesIO(png)) as image:
        body = image.convert("RGB").crop((0, _MENU_BAR_PX, image.width, image.height))
        picture.parent.mkdir(parents=True, exist_ok=True)
        body.quantize(256, dither=Image.Dither.NONE).save(picture, format="PNG", optimize=True)
