"""A whole run over emulated Dynamixel servos: emulator, supervisor, control process, recorder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.collect import collect
from deal_hw.control.process.channel import Outcome
from deal_hw.data.recording.dataset import Dataset
from deal_hw.types import Status, Trajectory
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.report import EpisodeReport
from deal_hw.workflows.running.settings import LinkOptions

pytestmark = pytest.mark.real_time

LINK = LinkOptions(transport="dynamixel")
PATIENT = "?answer_s=0.02"
"""A busy machine may take its time; a whole run is not a measurement."""


def record(folder: Path, seconds: float, *faults: str) -> tuple[EpisodeReport, Trajectory]:
    """Record a chirp on an emulator in a process of its own; return how it ended and what was recorded."""
    profile = ("--nominal", "--profile", "sensor")
    with EmulatorProcess("cartpole", "--transport", "dynamixel", *profile, *faults) as emulator:
        report = collect(
            COLLECT.settings(
                robot="cartpole",
                port=emulator.port + PATIENT,
                link=LINK,
                dataset=folder / "set",
                motion="chirp",
                seconds=seconds,
                quiet=True,
            )
        )
    return report.episodes[-1], Dataset.open(folder / "set").read(0).trajectory


@pytest.mark.slow
def test_collect_records_a_whole_run(tmp_path: Path) -> None:
    """Homing by the stops, a chirp, states on the grid with commands in force, torque off at the end."""
    report, recorded = record(tmp_path, 2.0)
    assert report.outcome is Outcome.FINISHED
    assert report.passive_confirmed
    armed = (recorded.status & int(Status.ARMED)) != 0
    assert armed.sum() > 200
    # Samples are 5 ms apart on the servo's clock, or a multiple where one was lost.
    steps = np.diff(recorded.device_s[armed][1:]) / 0.005
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.ptp(recorded.position[armed, 0]) > 0.05
    assert (recorded.command_sequence[armed][5:] >= 0).all()


@pytest.mark.slow
def test_an_overload_trips_the_run(tmp_path: Path) -> None:
    """The run is tripped with the servo's name, the motor is off, and the recording is whole."""
    report, recorded = record(tmp_path, 4.0, "--servo-overload-after-s", "0.5")
    assert report.outcome is Outcome.TRIPPED
    assert "servo 1 reports: overload" in report.reason
    assert report.passive_confirmed
    assert any("overload" in event.message for event in recorded.events)
