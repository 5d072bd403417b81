"""Rerun's own program as a child process: on loopback, without usage statistics, ended with its block."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import socket
import subprocess
import tempfile
import time
import urllib.parse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from deal_hw.errors import ConfigurationError, MissingExtraError

LOOPBACK = "127.0.0.1"
"""Rerun's default is every interface: a recording would be readable from the whole network."""
WINDOW = ("--persist-state",) if platform.system() == "Linux" else ()
"""Arguments of a window. Without this one rerun reads no settings, and its theme is the desktop's or dark. On
other systems we cannot choose the folder of its settings, so the user's own are used unchanged.
"""
_STOP_S = 5.0


@dataclass(slots=True)
class Viewer:
    """A running rerun program.

    Attributes:
        process: The child.
        log: File with its output.
    """

    process: subprocess.Popen[bytes]
    log: Path

    @property
    def output(self) -> str:
        """Its output so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def check(self) -> None:
        """Check that it runs.

        Raises:
            ConfigurationError: It ended; the message holds its last lines.
        """
        if (code := self.process.poll()) is not None:
            last = "\n".join(self.output.strip().splitlines()[-5:])
            raise ConfigurationError(f"rerun ended with exit code {code}:\n{last}")


def program() -> Path:
    """Return rerun's program.

    Raises:
        MissingExtraError: It is not installed.
    """
    spec = importlib.util.find_spec("rerun_cli")
    for folder in (spec.submodule_search_locations or []) if spec else []:
        path = Path(folder) / "rerun"
        if path.exists():
            return path
    raise MissingExtraError("rerun-sdk", "viz")


def free_port() -> int:
    """Return a TCP port that is free on the loopback interface now."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def check_recording(rrd: Path) -> None:
    """Check that a recording is there.

    Raises:
        ConfigurationError: It is not.
    """
    if not rrd.is_file():
        raise ConfigurationError(f"{rrd}: no such recording")


def check_port(port: int) -> None:
    """Check that a TCP port is free on the loopback interface.

    Raises:
        ConfigurationError: It is in use.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as err:
            raise ConfigurationError(
                f"port {port} of {LOOPBACK} cannot be opened ({err.strerror}); choose another with --web-port"
            ) from err


@contextlib.contextmanager
def run_viewer(
    arguments: Sequence[str], extra_environment: Mapping[str, str] | None = None
) -> Iterator[Viewer]:
    """Run rerun's program until the block ends.

    It gets a settings folder of its own. So it reports no usage and looks the same on every machine, and the
    user's own settings stay unchanged.
    """
    binary = str(program())
    with tempfile.TemporaryDirectory(prefix="deal-hw-rerun-") as home:
        environment = {**os.environ, **(extra_environment or {})}
        environment.update(XDG_CONFIG_HOME=home, XDG_DATA_HOME=home)
        environment.setdefault("XDG_RUNTIME_DIR", home)
        subprocess.run([binary, "analytics", "disable"], env=environment, check=True, capture_output=True)
        _write_settings(Path(home) / "rerun")
        log = Path(home) / "log.txt"
        with log.open("wb") as file:
            process = subprocess.Popen(
                [binary, *arguments], env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=file
            )
        try:
            yield Viewer(process, log)
        finally:
            _stop(process)


def _write_settings(folder: Path) -> None:
    """Write the settings that a window starts with; rerun takes none that another version wrote."""
    settings = {
        "egui": "(options:(theme_preference:Light))",
        "app": "(app_options:(check_for_updates_on_startup:false))",
        "rerun.version": importlib.metadata.version("rerun-sdk"),
    }
    folder.mkdir(exist_ok=True)
    (folder / "app.ron").write_text(json.dumps(settings), encoding="utf-8")


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def web_address(port: int, data: str) -> str:
    """Return the address to open in a browser, in the light theme."""
    return f"http://{LOOPBACK}:{port}?url={urllib.parse.quote(data, safe='')}&theme=light"


def from_elsewhere(address: str) -> str:
    """Return the command that makes an address of this machine open on another computer.

    Args:
        address: As :func:`web_address` returns it; it names the ports of the page and of the data.
    """
    ports = re.findall(rf"{re.escape(LOOPBACK)}:(\d+)", urllib.parse.unquote(address))
    return f"ssh {' '.join(f'-L {port}:{LOOPBACK}:{port}' for port in ports)} {platform.node()}"


def wait_until_listening(viewer: Viewer, port: int, timeout_s: float) -> None:
    """Wait until the program accepts connections on a port.

    Raises:
        ConfigurationError: It ended, or does not listen in time.
    """
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        viewer.check()
        with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), timeout=1.0):
            return
        time.sleep(0.05)
    raise ConfigurationError(
        f"rerun did not listen on port {port} within {timeout_s:g} s:\n{viewer.output[-500:]}"
    )
