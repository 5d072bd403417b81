"""Real processes and a real network: a Go2 stands up, lies down, and ends damped whatever dies."""

from __future__ import annotations

import dataclasses
import json
import os
import pty
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.logind import FakeLogind

from deal_hw.cli.show import Terminal
from deal_hw.control.process.channel import RUNNING, Beat, Outcome
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.unitree.command_log import DAMPING, STIFF
from deal_hw.errors import SafetyError
from deal_hw.motions.planned_end import ENDING_EVENT
from deal_hw.motions.posture import PostureConfig
from deal_hw.signals import reason
from deal_hw.types import Status
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.sleep_lock import ASLEEP
from deal_hw.workflows.running.supervised import InterruptedRunError, run_episodes

pytestmark = pytest.mark.real_time

PLAN = RunPlan(
    robot="go2",
    transport="zenoh",
    motion="hold",
    seconds=1.0,
    stand=True,
    posture=PostureConfig(fold_s=0.4, rise_s=0.8, settle_s=0.2, lie_s=0.8),
)
MOST_S = 60.0


@dataclass
class Rig:
    """An emulated Go2 in a process of its own, and what it tells at its end."""

    process: EmulatorProcess
    truth: Path

    def run(
        self, folder: Path, at_beat: int = -1, act: Callable[[], None] = lambda: None, plan: RunPlan = PLAN
    ) -> RunReport:
        """Record an episode and act once, so many heartbeats into it."""
        beats = 0

        def on_beat(beat: Beat) -> None:
            nonlocal beats
            if beat.phase == RUNNING:
                beats += 1
                if beats == at_beat:
                    act()

        return run_episodes(
            plan,
            port=self.process.port,
            dataset=folder,
            episodes=1,
            purpose="collect",
            view=Terminal(quiet=False),
            on_beat=on_beat,
        )

    def finish(self) -> dict[str, Any]:
        """End the emulator and return its report."""
        self.process.stop()
        report: dict[str, Any] = json.loads(self.truth.read_text())
        return report


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    """A nominal Go2 on the floor, with ideal sensors, that anybody on this machine reaches over Zenoh."""
    truth = tmp_path / "truth.json"
    process = EmulatorProcess(
        "go2",
        "--transport",
        "zenoh",
        "--port",
        "tcp/127.0.0.1:0",
        "--nominal",
        "--profile",
        "ideal",
        "--reveal-to",
        str(truth),
    )
    with process:
        yield Rig(process, truth)


def control_pid() -> int:
    """Return the pid of the control process."""
    for pid in Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split():
        if "deal_hw.workflows.running.control_process" in Path(f"/proc/{pid}/cmdline").read_text().split(
            "\0"
        ):
            return int(pid)
    raise AssertionError("there is no control process")


def kinds(report: dict[str, Any]) -> list[str]:
    """Return the kinds of command that the emulator received, in order, each change once."""
    return [kind for _, _, kind in report["commands"]["changes"]]


def finished(rig: Rig, tmp_path: Path) -> tuple[Path, RunReport]:
    """Return the dataset and the report of a run that the machine did not hold up: three may be needed."""
    for attempt in range(3):
        folder = tmp_path / f"dataset_{attempt}"
        try:
            report = rig.run(folder)
        except SafetyError as error:
            # The supervisor found the control process stalled.
            if attempt == 2 or "no heartbeat" not in str(error):
                raise
            continue
        if report.outcome is Outcome.FINISHED or attempt == 2:
            break
        assert "ms" in report.episodes[0].reason, report.episodes[0].reason
    return folder, report


def test_a_go2_stands_up_holds_and_lies_down(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Over the network into a dataset: every command, every state with its body, and damping at the end."""
    folder, report = finished(rig, tmp_path)
    # What deal-hw cannot help, such as the death of both its processes, is reported at the start.
    assert "holds its last command" in capsys.readouterr().err
    reported = rig.finish()
    (episode,) = report.episodes
    assert (episode.outcome, episode.error) == (Outcome.FINISHED, ""), episode.reason
    assert episode.passive_confirmed
    # 0.4 + 0.8 + 0.2 s up, 1 s held, 0.3 + 0.3 s (at most 3.3 s) until it stands still, 0.8 s down, at 50 Hz.
    assert 160 + 30 - 5 <= episode.cycles_sent <= 160 + 165
    assert kinds(reported)[-3:] == [DAMPING, STIFF, DAMPING]
    assert reported["commands"]["last_kind"] == DAMPING
    assert reported["commands"]["refused"] == 0
    # Repeats in between: far more commands are received than cycles were run.
    assert reported["commands"]["accepted"] > 5 * episode.cycles_sent
    assert reported["sport"] == ""

    read = Dataset.open(folder).read(0)
    trajectory, body = read.trajectory, read.trajectory.body
    assert read.metadata["stand"] is True
    assert len(trajectory.sent_s) == episode.cycles_sent
    assert len(trajectory.device_s) == episode.states_recorded > 1000
    assert body is not None
    assert np.isfinite(body.orientation).all() and np.isfinite(body.temperature).all()
    assert (trajectory.status & int(Status.ARMED)).all()
    # The calves are folded when it lies, and at -1.8 rad when it stands.
    calf = trajectory.position[:, trajectory.joint_names.index("FL_calf_joint")]
    assert calf.max() > -2.1
    assert calf[0] < -2.4 and calf[-1] < -2.4


def test_a_killed_control_process_leaves_the_robot_damped(rig: Rig, tmp_path: Path) -> None:
    """The robot would hold its last target for ever: the supervisor's own path is open, and damps it."""
    # A machine under load may take longer to bury it than its next heartbeat would have taken.
    with pytest.raises(SafetyError, match=r"died by signal 9 \(SIGKILL\)|was killed: it sent no heartbeat"):
        rig.run(tmp_path / "dataset", at_beat=80, act=lambda: os.kill(control_pid(), signal.SIGKILL))
    reported = rig.finish()
    assert kinds(reported) == [DAMPING, STIFF, DAMPING]
    assert reported["commands"]["last_kind"] == DAMPING
    info = Dataset.open(tmp_path / "dataset").episodes[0]
    assert info.facts["passive_confirmed"] is True
    read = Dataset.open(tmp_path / "dataset").read(0)
    assert len(read.trajectory.sent_s) > 40
    assert read.trajectory.body is not None


@pytest.mark.slow
def test_the_end_key_lays_the_robot_down(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run of a minute ends 30 cycles after it stands, by a key on a terminal: stand, lie down, damping."""
    operator, program = pty.openpty()
    plan = dataclasses.replace(PLAN, seconds=60.0, velocity="keyboard")
    with os.fdopen(operator, "wb", buffering=0) as keys, os.fdopen(program) as stdin:

        def press() -> None:
            keys.write(b"p")

        monkeypatch.setattr("sys.stdin", stdin)
        report = rig.run(tmp_path / "dataset", at_beat=100, act=press, plan=plan)
    (episode,) = report.episodes
    assert (episode.outcome, episode.reason) == (Outcome.STOPPED, "ended by the operator's key")
    assert episode.passive_confirmed
    events = Dataset.open(tmp_path / "dataset").read(0).trajectory.events
    assert [event.message for event in events if event.kind == ENDING_EVENT] == [
        "ended by the operator's key",
        "it comes to its default pose",
        "it stands still, and lies down",
    ]
    assert kinds(rig.finish())[-3:] == [DAMPING, STIFF, DAMPING]


@pytest.mark.parametrize(
    "numbers",
    [(signal.SIGHUP,), pytest.param((signal.SIGTERM, signal.SIGHUP), marks=pytest.mark.slow)],
)
def test_a_session_that_ends_leaves_the_robot_damped(
    rig: Rig, tmp_path: Path, numbers: tuple[signal.Signals, ...]
) -> None:
    """A lost ssh connection, under systemd: to all processes."""

    def hang_up() -> None:
        children = Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split()
        for number in numbers:
            for pid in (os.getpid(), *map(int, children)):
                # The emulator in its process of its own is no part of the session.
                if pid != rig.process.pid:
                    os.kill(pid, number)

    with pytest.raises(InterruptedRunError) as raised:
        rig.run(tmp_path / "dataset", at_beat=80, act=hang_up)
    reported = rig.finish()
    assert kinds(reported) == [DAMPING, STIFF, DAMPING]
    (episode,) = raised.value.report.episodes
    assert episode.passive_confirmed
    assert episode.reason in [reason(number) for number in numbers]
    assert len(Dataset.open(tmp_path / "dataset").read(0).trajectory.sent_s) > 40


@pytest.mark.slow
def test_a_run_ends_damped_before_this_computer_sleeps(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only a delay is granted; the sleep is announced while the robot stands: damped, then the lock goes."""
    with FakeLogind(tmp_path, refuse=("block",)) as logind:
        monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", logind.address)
        report = rig.run(tmp_path / "dataset", at_beat=80, act=logind.prepare_for_sleep)
        assert logind.released("delay")
    reported = rig.finish()
    assert kinds(reported) == [DAMPING, STIFF, DAMPING]
    (episode,) = report.episodes
    assert (episode.outcome, episode.reason) == (Outcome.STOPPED, ASLEEP)
    assert episode.passive_confirmed
    assert len(Dataset.open(tmp_path / "dataset").read(0).trajectory.sent_s) > 40
