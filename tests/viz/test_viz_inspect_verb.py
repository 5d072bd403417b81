"""The verb: a recorded episode in, a file out, and a clear error for what cannot be."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import deal_hw
from deal_hw.calibration import CalibrationResult
from deal_hw.cli.inspect_ import Inspect, inspect
from deal_hw.clock import VirtualClock
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.types import RobotState, Status, Trajectory


@pytest.fixture
def calibration(tmp_path: Path, result: CalibrationResult) -> Path:
    """A folder with the result."""
    folder = tmp_path / "calibration"
    folder.mkdir()
    (folder / "result.json").write_text(json.dumps(result.to_json()), encoding="utf-8")
    return folder


def test_episode_is_shown_beside_its_calibration(
    episode_file: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The truth fits the recording, at the latency of the result; nominal does not; the file is named."""
    rrd = tmp_path / "new" / "episode.rrd"
    report = inspect(Inspect(episode=episode_file, calibration=calibration, save=rrd))
    assert report.files == (rrd,) and rrd.stat().st_size > 100_000
    assert report.overlay is not None
    found = report.overlay.predictions
    assert found["calibrated"].latency_s == pytest.approx(0.008)
    assert (found["calibrated"].position_nrmse < 0.2 * found["nominal"].position_nrmse).all()
    printed = capsys.readouterr().out
    assert f"written: {rrd}" in printed and "calibrated: position error over 0.20 s" in printed


def test_result_file_is_as_good_as_its_folder(episode_file: Path, calibration: Path, tmp_path: Path) -> None:
    """--calibration takes result.json, and --window and --latency reach the predictions."""
    report = inspect(
        Inspect(
            episode=episode_file,
            calibration=calibration / "result.json",
            save=tmp_path / "a.rrd",
            window=0.1,
            latency=0.0,
            quiet=True,
        )
    )
    assert report.overlay is not None
    assert report.overlay.window_s == pytest.approx(0.1)
    assert report.overlay.predictions["calibrated"].latency_s == 0.0


def test_without_a_calibration_the_nominal_model_is_shown(episode_file: Path, tmp_path: Path) -> None:
    """The nominal model alone, without latency."""
    report = inspect(Inspect(episode=episode_file, save=tmp_path / "a.rrd", quiet=True))
    assert report.overlay is not None
    assert list(report.overlay.predictions) == ["nominal"]


def test_from_python_predictions_come_back(
    episode_file: Path, result: CalibrationResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows, text, HTML and file of the same predictions; nothing is printed, and no window opens."""
    found = deal_hw.inspect(str(episode_file), calibration=result)
    nominal, calibrated = found.rows()
    assert (nominal["model"], calibrated["model"]) == ("nominal", "calibrated")
    assert found.overlay is not None
    for joint, error in zip(
        found.overlay.joint_names, found.overlay.predictions["nominal"].position_nrmse, strict=True
    ):
        assert nominal[joint] == error and f"{joint} {100 * error:.2g} %" in found.table()
        assert f"{100 * error:.2g} %" in found._repr_html_()
    assert found.save(str(tmp_path / "new" / "a.rrd")).stat().st_size > 100_000
    assert capsys.readouterr().out == ""


def test_unarmed_recordings_are_shown_without_predictions(
    trajectory: Trajectory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where nothing can be predicted, what was measured is shown, and the reason is given."""
    path = tmp_path / "episodes" / "000000.mcap"
    states = tuple(
        RobotState(
            trajectory.position[i],
            np.zeros(2),
            np.zeros(2),
            5_000_000 * i,
            5_000_000 * i,
            i,
            -1,
            -1,
            Status.NONE,
        )
        for i in range(50)
    )
    with EpisodeRecorder(path, DESCRIPTION.to_json(), {"robot": "cartpole"}, VirtualClock(0)) as recorder:
        recorder.write(CycleRecord(cycle=0, deadline_ns=0, start_ns=0, states=states))
    report = inspect(Inspect(episode=path, save=tmp_path / "a.rrd"))
    assert report.overlay is None and "no armed samples" in report.note
    assert "No predictions" in capsys.readouterr().out


def test_without_a_desktop_other_ways_are_named(episode_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No window without a desktop: --web, --save and --screenshot are offered before anything is computed."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigurationError, match=r"--web .* --save FILE\.rrd .* or --screenshot FILE\.png"):
        inspect(Inspect(episode=episode_file))
    with pytest.raises(ConfigurationError, match=r"--web .* --save FILE\.rrd .* or --screenshot FILE\.png"):
        deal_hw.inspect(episode_file).show()


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_web_ends_with_its_server(episode_file: Path, number: signal.Signals) -> None:
    """Ctrl-C and SIGTERM end the verb in peace, and rerun's server with it."""
    command = [sys.executable, "-m", "deal_hw", "inspect", str(episode_file), "--web", "--web-port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        # The errors come before the page, which stays until it is ended.
        assert process.stdout.readline().startswith("   nominal: position error")
        assert process.stdout.readline().startswith("open http://127.0.0.1:")
        assert process.stdout.readline().startswith("on another computer, run there first: ssh -L ")
        (server,) = psutil.Process(process.pid).children()
        process.send_signal(number)
        process.communicate(timeout=30)
    left = server.is_running()
    if left:
        server.kill()
    assert not left
    assert process.returncode == 0


def test_wrong_files_are_named(episode_file: Path, tmp_path: Path) -> None:
    """A missing recording, a missing or foreign result, and a folder to save to are one line each."""
    save = tmp_path / "a.rrd"
    with pytest.raises(DatasetError, match=r"none\.mcap"):
        inspect(Inspect(episode=tmp_path / "none.mcap", save=save))
    with pytest.raises(DatasetError, match=r"none\.json cannot be read.*deal-hw calibrate"):
        inspect(Inspect(episode=episode_file, calibration=tmp_path / "none.json", save=save))
    (tmp_path / "other.json").write_text('{"a": 1}', encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"other\.json: not a calibration result"):
        inspect(Inspect(episode=episode_file, calibration=tmp_path / "other.json", save=save))
    with pytest.raises(ConfigurationError, match="is a folder"):
        inspect(Inspect(episode=episode_file, save=tmp_path))
    assert not save.exists()


def test_files_are_called_what_they_are(episode_file: Path, tmp_path: Path) -> None:
    """A picture is a PNG and a recording an RRD: other endings are refused before anything is computed."""
    gone = tmp_path / "none.mcap"
    with pytest.raises(ConfigurationError, match=r"a\.jpg does not end in \.png; name it .*a\.png"):
        inspect(Inspect(episode=gone, screenshot=tmp_path / "a.jpg"))
    with pytest.raises(ConfigurationError, match=r"a\.mp4 does not end in \.rrd; name it .*a\.rrd"):
        inspect(Inspect(episode=gone, save=tmp_path / "a.mp4"))
    found = deal_hw.inspect(episode_file)
    with pytest.raises(ConfigurationError, match=r"does not end in \.png"):
        found.screenshot(tmp_path / "a.jpg")
    with pytest.raises(ConfigurationError, match=r"is a folder; name a file, such as .*episode\.png"):
        found.screenshot(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_verdict_is_that_of_the_calibration(episode_file: Path, result: CalibrationResult) -> None:
    """The colour comes first, what to do last; without a calibration there is none."""
    found = deal_hw.inspect(episode_file, calibration=result)
    assert found.verdict().startswith("**amber:** ") and found.verdict().endswith("**")
    assert deal_hw.inspect(episode_file).verdict() == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"latency": -1.0}, "--latency .*: allowed are 0 to 1 s"),
        ({"at": float("nan")}, "--at .*: allowed are 0 to 1000000 s"),
        ({"web_port": 70_000}, "--web-port 70000: allowed are 0 to 65535"),
    ],
)
def test_settings_are_checked(changes: dict[str, Any], words: str) -> None:
    """A setting out of range is refused when it is given."""
    with pytest.raises(ConfigurationError, match=words):
        dataclasses.replace(Inspect(episode=Path("x.mcap")), **changes)
