"""The package of examples/thirdparty, installed beside deal-hw: its robot and its transport in every verb."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plug_in import installed

from deal_hw.data.recording.reader import read_trajectory
from deal_hw.workflows.emulation.process import EmulatorProcess

pytestmark = pytest.mark.real_time

SOURCE = Path(__file__).resolve().parents[2] / "examples" / "thirdparty"
ROBOT = "bench_cartpole"


@pytest.fixture(scope="module", name="installed")
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Install the package into a folder on the path of child processes; this process does not see it."""
    with installed(SOURCE, tmp_path_factory.mktemp("installed")) as target:
        yield target


def deal_hw(*words: object) -> str:
    """Run a verb in its own process and return what it prints; it must succeed."""
    command = [sys.executable, "-m", "deal_hw", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@dataclass(frozen=True)
class Recorded:
    """A dataset of the robot, and the emulator's report of the same run."""

    dataset: Path
    truth: dict[str, Any]


@pytest.fixture(scope="module")
def recorded(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Emulate the robot, and record it with the real control process."""
    out = tmp_path_factory.mktemp("run")
    with EmulatorProcess(ROBOT, "--seed", "1", "--reveal") as emulator:
        checked = deal_hw("doctor", ROBOT, "--port", emulator.port, "--seconds", 3)
        assert f"{ROBOT} answers" in checked and "states a second of 50" in checked
        assert f"robot {ROBOT} (deal-hw-bench-cartpole 0.1.0)" in checked
        motion = ["--excite", "multisine", "--seconds", 6]
        deal_hw("collect", ROBOT, "--port", emulator.port, "--out", out, *motion)
        output, _ = emulator.stop()
    return Recorded(out / "dataset", json.loads(output.splitlines()[-1]))


@pytest.mark.slow
def test_it_is_emulated_examined_and_recorded(recorded: Recorded) -> None:
    """The emulated motor followed the commands and was switched off; the recording holds the run."""
    modes = [what for _, _, what in recorded.truth["changes"]]
    assert modes[0] == "homing" and "armed" in modes
    assert recorded.truth["last_mode"] == "idle"
    shown = deal_hw("data", "info", recorded.dataset)
    assert ROBOT in shown


@pytest.mark.slow
def test_its_recording_is_calibrated(recorded: Recorded) -> None:
    """Mass and friction of the cart are those that the emulator had hidden."""
    deal_hw("calibrate", recorded.dataset, "--threads", 1)
    result = json.loads((recorded.dataset.parent / "calibration" / "result.json").read_text())
    found = {name: entry["estimate"] for name, entry in result["parameters"].items()}
    assert found["cart.damping"] == pytest.approx(recorded.truth["friction"], rel=0.05)
    assert found["cart.mass"] == pytest.approx(recorded.truth["cart_kg"], rel=0.1)


@pytest.mark.slow
def test_its_policy_swings_the_pole_up(installed: Path, tmp_path: Path) -> None:
    """The control process runs the shipped policy on the emulator; the motor's output is off at the end.

    The pole stands for 3 s at least. On a busy machine it may fall, and is swung up again.
    """
    with EmulatorProcess(ROBOT, "--seed", "1", "--reveal") as emulator:
        deal_hw("deploy", ROBOT, "--port", emulator.port, "--seconds", 16, "--out", tmp_path)
        output, _ = emulator.stop()
    report = json.loads(output.splitlines()[-1])
    # This firmware is "enabled" from the command that switches its output on to the one that switches it off.
    assert report["state_length"] > 31
    modes = [what for _, _, what in report["changes"]]
    assert "enabled" in modes and "armed" in modes
    assert report["last_mode"] == "idle"
    run = read_trajectory(tmp_path / "dataset" / "episodes" / "000000.mcap")
    fallen_s = run.device_s[np.cos(run.position[:, 1]) < np.cos(0.3)]
    assert np.diff(np.append(fallen_s, run.device_s[-1])).max() > 3.0


@pytest.mark.slow
def test_a_policy_of_its_task_is_trained(installed: Path, tmp_path: Path) -> None:
    """The verb finds the task of the package; a few steps give a file that may run on the robot."""
    path = tmp_path / "short.onnx"
    trained = ["--udr", "--trainer", "ppo", "--steps", 48, "--members", 2, "--out", path]
    assert f"next: deal-hw deploy {ROBOT} " in deal_hw("train", ROBOT, *trained)
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["robot"] == ROBOT and record["task"]["end_position_m"] == 0.18
    deal_hw("policy", "check", path, "--robot", ROBOT)


@pytest.mark.slow
def test_its_transport_reaches_the_robot(installed: Path, tmp_path: Path) -> None:
    """The same bytes through TCP; the control process goes on with the connection that its parent opened."""
    link = str(tmp_path / "cart")
    with EmulatorProcess(ROBOT, "--seed", "2", "--link", link) as emulator, forwarded(emulator.port) as port:
        assert emulator.port == link
        wire = ["--transport", "tcp", "--port", port]
        assert f"{ROBOT} answers" in deal_hw("doctor", ROBOT, *wire, "--seconds", 3)
        deal_hw("collect", ROBOT, *wire, "--out", tmp_path, "--motion", "hold", "--seconds", 1)
    assert [path.name for path in (tmp_path / "dataset" / "episodes").iterdir()] == ["000000.mcap"]


@pytest.mark.slow
def test_its_own_tests_pass(installed: Path) -> None:
    """They inherit deal-hw's contract suites."""
    command = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--import-mode=importlib"]
    command += ["-p", "no:cacheprovider", "--rootdir", str(SOURCE), str(SOURCE / "tests")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


@contextlib.contextmanager
def forwarded(serial_port: str) -> Iterator[str]:
    """Serve a serial port on TCP, one connection after the other, as a serial server does."""
    fd = os.open(serial_port, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(fd)
    end, wake = socket.socketpair()
    with socket.create_server(("127.0.0.1", 0)) as listener, end, wake:

        def serve() -> None:
            link: socket.socket | None = None
            while True:
                sources: list[Any] = [end, listener, fd, *([link] if link else [])]
                ready = select.select(sources, [], [])[0]
                if end in ready:
                    break
                if listener in ready:
                    link = listener.accept()[0]
                if fd in ready and (data := os.read(fd, 4096)) and link is not None:
                    with contextlib.suppress(OSError):
                        link.sendall(data)
                if link is not None and link in ready:
                    received = b""
                    with contextlib.suppress(OSError):
                        received = link.recv(4096)
                    if received:
                        os.write(fd, received)
                    else:
                        link.close()
                        link = None
            if link is not None:
                link.close()

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"127.0.0.1:{listener.getsockname()[1]}"
        finally:
            wake.send(b"x")
            thread.join()
            os.close(fd)
