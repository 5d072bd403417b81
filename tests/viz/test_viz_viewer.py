"""Rerun's program as a child: where it listens, its arguments, how it ends."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import re
import socket
import sys
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from PIL import Image

from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.install import install_line
from deal_hw.viz import palette
from deal_hw.viz.screenshot import RENDERER_INSTALL, save_screenshot
from deal_hw.viz.serve import open_window, serve_web
from deal_hw.viz.viewer import (
    LOOPBACK,
    free_port,
    from_elsewhere,
    run_viewer,
    wait_until_listening,
    web_address,
)


def test_web_is_served_on_loopback_only(shown: Any) -> None:
    """Every port that the server listens on is on 127.0.0.1; the page is there; it is gone afterwards."""
    with serve_web(shown.rrd, port=0) as (address, server):
        child = psutil.Process(server.process.pid)
        listening = [c.laddr for c in child.net_connections(kind="inet") if c.status == psutil.CONN_LISTEN]
        assert len(listening) == 2
        assert {where.ip for where in listening} == {LOOPBACK}
        assert (
            address.startswith(f"http://{LOOPBACK}:") and "url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A" in address
        )
        with urllib.request.urlopen(address, timeout=10) as page:
            assert page.status == 200 and b"<html>" in page.read()
    assert server.process.poll() is not None
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((LOOPBACK, int(address.split(":")[2].split("?")[0])), timeout=1)


def test_windows_and_pages_are_light() -> None:
    """A window's settings choose the light theme and no look for updates; a page has these in its address."""
    port = free_port()
    with run_viewer(["--serve-grpc", "--bind", LOOPBACK, "--port", str(port)]) as viewer:
        wait_until_listening(viewer, port, 20)
        home = Path(psutil.Process(viewer.process.pid).environ()["XDG_DATA_HOME"])
        settings = json.loads((home / "rerun" / "app.ron").read_text(encoding="utf-8"))
    assert settings["egui"] == "(options:(theme_preference:Light))"
    assert settings["app"] == "(app_options:(check_for_updates_on_startup:false))"
    # Rerun forgets settings of another version.
    assert settings["rerun.version"] == importlib.metadata.version("rerun-sdk")
    assert web_address(1, "rerun+http://a/proxy").endswith("?url=rerun%2Bhttp%3A%2F%2Fa%2Fproxy&theme=light")


def test_another_computer_gets_page_and_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page alone would show an empty viewer: the data come over a port of their own."""
    monkeypatch.setattr("platform.node", lambda: "robot")
    line = from_elsewhere(web_address(9090, f"rerun+http://{LOOPBACK}:9876/proxy"))
    assert line == f"ssh -L 9090:{LOOPBACK}:9090 -L 9876:{LOOPBACK}:9876 robot"


def test_a_taken_port_is_named(shown: Any) -> None:
    """A port that somebody has is refused before anything starts."""
    with socket.socket() as other:
        other.bind((LOOPBACK, 0))
        other.listen()
        port = other.getsockname()[1]
        with (
            pytest.raises(ConfigurationError, match=f"port {port} of 127.0.0.1"),
            serve_web(shown.rrd, port=port),
        ):
            pass


def test_usage_statistics_are_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whatever the user's settings say, the child's say no; the user's own are not touched."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    port = free_port()
    with run_viewer(["--serve-grpc", "--bind", LOOPBACK, "--port", str(port)]) as viewer:
        wait_until_listening(viewer, port, 20)
        home = Path(psutil.Process(viewer.process.pid).environ()["XDG_CONFIG_HOME"])
        settings = json.loads((home / "rerun" / "analytics.json").read_text(encoding="utf-8"))
        assert settings["analytics_enabled"] is False
    assert list(tmp_path.iterdir()) == []
    assert not home.exists()


def test_a_viewer_that_ends_is_reported() -> None:
    """A program that stops at once is not waited for; its last words are in the error."""
    with run_viewer(["--no-such-option"]) as viewer:
        viewer.process.wait(20)
        with pytest.raises(ConfigurationError, match="no-such-option"):
            wait_until_listening(viewer, 1, 20)


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    """No viewer is started for a file that is not there."""
    gone = tmp_path / "gone.rrd"
    with pytest.raises(ConfigurationError, match=r"gone\.rrd: no such recording"):
        save_screenshot(gone, tmp_path / "picture.png")
    with pytest.raises(ConfigurationError, match=r"gone\.rrd: no such recording"):
        open_window(gone)


def test_screenshot_shows_the_traces_or_says_what_is_missing(shown: Any, tmp_path: Path) -> None:
    """A renderer's picture is light and has all three colours; without one, what installs it is named."""
    picture = tmp_path / "pictures" / "episode.png"
    try:
        save_screenshot(shown.rrd, picture, at_s=0.3, size=(1200, 800))
    except ConfigurationError as err:
        assert RENDERER_INSTALL in str(err)
        return
    with Image.open(picture) as image:
        assert image.format == "PNG" and image.width == 1200 and 700 < image.height < 800
        colors = image.convert("RGB").getcolors(maxcolors=1_000_000)
    assert colors is not None
    (_, most) = max(colors)
    assert most == (255, 255, 255), "the theme is light"
    for wanted in (palette.REAL, palette.NOMINAL, palette.CALIBRATED):
        # Thin lines are blended with the background, so a palette keeps their colour nearly, not exactly.
        near = sum(count for count, rgb in colors if np.abs(np.subtract(rgb, wanted)).max() < 25)
        assert near > 100, wanted
    assert picture.stat().st_size < 300_000


def test_without_a_renderer_the_package_is_named(
    shown: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where Vulkan finds no driver, the error names the command that installs one."""
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, str(tmp_path / "no_driver.json"))
    with pytest.raises(ConfigurationError, match="apt-get install -y mesa-vulkan-drivers"):
        save_screenshot(shown.rrd, tmp_path / "picture.png")
    assert not (tmp_path / "picture.png").exists()


def test_without_rerun_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where rerun is not installed, the error names the extra."""
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "deal_hw.viz.backend")
    with pytest.raises(MissingExtraError, match=re.escape(install_line("viz"))):
        importlib.import_module("deal_hw.viz.backend")
