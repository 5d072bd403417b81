"""What a Python program can ask for wrongly, where no command line leads to it: error and words.

Beside `tests/cli/test_cli_refusals.py`. All sites: python tools/refusals.py.
"""

from __future__ import annotations

import dataclasses
import errno
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from deal_hw.clock import MonotonicClock, VirtualClock
from deal_hw.data.export.lerobot import export_lerobot
from deal_hw.data.importing.channels import digest_of_file
from deal_hw.data.importing.grid import to_trajectories
from deal_hw.data.importing.store import minimal_description
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.record import CycleRecord, encode
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.data.run_folder import RunFolder
from deal_hw.data.table import Table
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.drivers.go2.emulator.sport_service import SportMode
from deal_hw.drivers.go2.emulator.truth import GO2
from deal_hw.errors import (
    ConfigurationError,
    DatasetError,
    DealHwError,
    InsufficientDataError,
    PolicyError,
    TransportError,
    UnknownNameError,
)
from deal_hw.motions.excitation.waveforms import Sweep, random_steps
from deal_hw.parameters import Parameter
from deal_hw.reading import object_of, texts
from deal_hw.robots.connect import make_topic_transport, make_transport
from deal_hw.schema import from_values
from deal_hw.sim.engine.single import SingleSimulation
from deal_hw.sim.mjcf.changes import differences
from deal_hw.sim.mjcf.describe import sampling
from deal_hw.sim.mjcf.text import read_files
from deal_hw.testing.faults import FaultRates
from deal_hw.transport import WireOptions
from deal_hw.viz.screenshot import save_screenshot
from deal_hw.viz.serve import serve_web
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running import supervised
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.workflows.train import train_policy, udr_distribution

PLAN = RunPlan(robot="cartpole")
RNG = np.random.default_rng(0)
BALL = "<mujoco><worldbody><body><joint name='j' type='ball'/><geom size='0.1'/></body></worldbody></mujoco>"
HINGE = BALL.replace("ball", "hinge")
DIFFERENT = HINGE.replace("</body>", "</body><body><geom size='0.1'/></body>")
CYCLE = CycleRecord(
    cycle=7,
    deadline_ns=0,
    start_ns=0,
    states=(),
    action=None,
    requested=None,
    sent=None,
    sent_sequence=0,
    sent_ns=0,
    state_age_ns=0,
    safety_state="",
    flags=0,
    events=(),
    wire=(),
    lost=0,
)


def parameter(**changes: Any) -> Parameter:
    """Return a sound parameter with some fields changed."""
    fields: dict[str, Any] = {
        "name": "a.b",
        "kind": "k",
        "elements": ("a",),
        "unit": "kg",
        "nominal": 1.0,
        "low": 0.5,
        "high": 2.0,
    }
    return Parameter(**{**fields, **changes})


SETTINGS: list[tuple[Callable[[], object], type[Exception], str]] = [
    (
        lambda: Sweep(amplitude=(1.0,), duration_s=1.0, low_hz=1.0, high_hz=2.0, arrangement="x"),  # type: ignore[arg-type]
        UnknownNameError,
        "unknown arrangement 'x'; known: ",
    ),
    (
        lambda: random_steps(np.ones(1), 1.0, (0.5, 0.1), RNG),
        ConfigurationError,
        "hold times of 0.5 to 0.1 s",
    ),
    (lambda: parameter(scale="cubic"), UnknownNameError, "unknown scale of parameter 'a.b' 'cubic'"),
    (lambda: object_of(3, "a table"), ConfigurationError, "a table was expected, got 3"),
    (lambda: texts([1], "names"), ConfigurationError, "names must be a list of texts, got [1]"),
    (lambda: from_values(dict, {"a": object()}), ConfigurationError, "not plain JSON values: "),
    (lambda: sampling(0.01, 0.0, 1.0), ConfigurationError, "physics step must be above 0, got 0 s"),
    (lambda: sampling(0.01, 0.001, 0.0), ConfigurationError, "window must be above 0, got 0 s"),
    (lambda: FaultRates(drop=2.0), ConfigurationError, "drop is a probability from 0 to 1, got 2"),
    (lambda: WireOptions(mode="router"), ConfigurationError, "wire mode 'router': allowed are peer"),
    (lambda: make_topic_transport("serial", "p", MonotonicClock()), UnknownNameError, "known: dds, zenoh"),
    (
        lambda: make_transport("serial", "p", MonotonicClock(), WireOptions(domain=3, mode="peer")),
        ConfigurationError,
        "--domain, --mode would have no effect: transport 'serial' is no network",
    ),
    (lambda: SportMode(GO2, "moonwalk"), UnknownNameError, "unknown sport mode 'moonwalk'"),
    (lambda: draw_truth("nosuch", 0), UnknownNameError, "unknown profile 'nosuch'"),
    (
        lambda: supervised.run_episodes(PLAN, port="p", dataset=None, episodes=0, purpose="x"),
        ConfigurationError,
        "--episodes 0: give at least 1",
    ),
    (
        lambda: train_policy("go2_suspended", udr_distribution("cartpole"), Path("p.onnx")),
        UnknownNameError,
        "unknown robot with a training environment 'go2_suspended'; known: allegro, ant, cartpole, go2",
    ),
    (lambda: make_behaviour(PLAN, DESCRIPTION), PolicyError, "give --policy FILE"),
    (lambda: EmulatorProcess("cartpole").pid, TransportError, "the emulator is not running"),
    (lambda: VirtualClock().advance_ns(-1), ValueError, "a monotonic clock cannot go back: delta_ns=-1"),
    (lambda: minimal_description([], "r", ("rad",), 50.0), ConfigurationError, "no recording to describe"),
    (lambda: encode(dataclasses.replace(CYCLE, cycle=2**70)), ConfigurationError, "does not fit the record"),
]


@pytest.mark.parametrize(("call", "kind", "words"), SETTINGS, ids=[words[:40] for *_, words in SETTINGS])
def test_a_call_that_cannot_be_is_refused(
    call: Callable[[], object], kind: type[Exception], words: str
) -> None:
    """One thing is wrong with each."""
    with pytest.raises(kind) as caught:
        call()
    assert words in str(caught.value)


FILES: list[tuple[Callable[[Path], object], type[DealHwError], str]] = [
    (lambda p: Dataset.create_or_open(p / "text.txt", DESCRIPTION), DatasetError, "cannot be written: "),
    (lambda p: RunFolder(p / "text.txt").start({}, {}), DatasetError, "text.txt cannot be made: "),
    (lambda p: digest_of_file(p), DatasetError, "cannot be read: Is a directory"),
    (lambda p: save_screenshot(p / "no.rrd", p / "a.png"), ConfigurationError, "no.rrd: no such recording"),
    (lambda p: serve_web(p / "no.rrd", port=0).__enter__(), ConfigurationError, "no.rrd: no such recording"),
    (lambda p: SingleSimulation(p / "ball.xml"), ConfigurationError, "only slide and hinge joints (got nq 4"),
    (lambda p: SingleSimulation(p / "hinge.xml").set_body_mass("leg", 1.0), UnknownNameError, "'leg'; kn"),
    (lambda p: read_files(p / "wide.xml"), ConfigurationError, "wide.xml is in UTF-16; save it as UTF-8"),
    (lambda p: read_files(p / "no.xml"), ConfigurationError, "no.xml cannot be read: No such file"),
    (
        lambda p: differences(
            mujoco.MjModel.from_xml_string(HINGE), mujoco.MjModel.from_xml_string(DIFFERENT)
        ),
        ConfigurationError,
        "the calibrated model has other elements than the file: ",
    ),
    (lambda p: export_lerobot([], p / "out", "r", "t"), InsufficientDataError, "no recording to export"),
]


@pytest.mark.parametrize(("call", "kind", "words"), FILES, ids=[words[:40] for *_, words in FILES])
def test_a_file_that_cannot_be_is_refused(
    call: Callable[[Path], object], kind: type[DealHwError], words: str, tmp_path: Path
) -> None:
    """A file of another kind, or none."""
    for name, text in (("text.txt", "hello"), ("ball.xml", BALL), ("hinge.xml", HINGE)):
        (tmp_path / name).write_text(text)
    (tmp_path / "wide.xml").write_text(HINGE, encoding="utf-16")
    time_s = np.arange(50) * 0.02
    for name, joint in (("a", "hip"), ("b", "knee")):
        rows = np.stack([time_s, np.sin(time_s), np.cos(time_s)], axis=1)
        head = f"time,{joint}_pos,{joint}_cmd"
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header=head, comments="")
    with pytest.raises(kind) as caught:
        call(tmp_path)
    assert words in str(caught.value)


def test_samples_that_never_follow_each_other_are_no_recording() -> None:
    """Two samples in 1000 s, on the grid of another recording."""
    table = Table(
        joint_names=("a",),
        actuated=("a",),
        units=("rad",),
        time_s=np.array([0.0, 500.0, 1000.0]),
        position=np.zeros((3, 1)),
        velocity=None,
        effort=None,
        command_s=np.zeros(1),
        target=np.zeros((1, 1)),
        orientation=None,
        gyro=None,
        source={"file": "rec.csv", "part": "", "kind": "csv", "sha256": ""},
    )
    with pytest.raises(DatasetError, match=r"rec\.csv: the pauses between all samples are longer than"):
        to_trajectories(table, period_s=0.01)


def test_a_full_disk_ends_the_recording_and_says_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`close` and `flush` alike: what was written is kept, and where to look at it."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    for step in ("flush", "close"):
        recorder = EpisodeRecorder(tmp_path / f"{step}.mcap", DESCRIPTION.to_json(), {}, VirtualClock())
        recorder.open()
        recorder.write(CYCLE)
        with monkeypatch.context() as patch:
            patch.setattr("os.write", full)
            with pytest.raises(
                DatasetError, match=r"No space left .* check the file with: deal-hw data info"
            ):
                getattr(recorder, step)()


def test_a_port_that_somebody_has_is_said() -> None:
    """Before the viewer is started."""
    import socket

    from deal_hw.viz.viewer import LOOPBACK, check_port

    with socket.socket() as taken:
        taken.bind((LOOPBACK, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(
            ConfigurationError, match=rf"port {port} of {LOOPBACK} cannot be opened .*; choose"
        ):
            check_port(port)


def test_a_viewer_that_ended_is_said(tmp_path: Path) -> None:
    """With the last thing that it wrote."""
    from deal_hw.viz.viewer import Viewer

    (tmp_path / "log").write_text("no graphics\n")
    process = subprocess.Popen(["sh", "-c", "exit 3"])
    process.wait()
    with pytest.raises(ConfigurationError, match=r"rerun ended with exit code 3:\nno graphics"):
        Viewer(process, tmp_path / "log").check()
