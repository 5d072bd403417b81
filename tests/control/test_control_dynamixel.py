"""A whole run over emulated Dynamixel servos: emulator, supervisor, control process, recorder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.cli.collect import Collect, collect
from deal_hw.cli.emulator_process import EmulatorProcess
from deal_hw.cli.link import LinkOptions
from deal_hw.control.loop import Outcome
from deal_hw.data.recording.dataset import Dataset
from deal_hw.types import Status

LINK = LinkOptions(transport="dynamixel")
PATIENT = "?answer_s=0.02"
"""A busy machine may take its time; a whole run is not a measurement."""


@pytest.mark.slow
def test_collect_records_a_whole_run(tmp_path: Path) -> None:
    """Homing by the stops, a chirp, states on the grid with commands in force, torque off at the end."""
    with EmulatorProcess(
        "cartpole", "--transport", "dynamixel", "--nominal", "--profile", "sensor"
    ) as emulator:
        report = collect(
            Collect(
                robot="cartpole", port=emulator.port + PATIENT, link=LINK, dataset=tmp_path / "set",
                profile="chirp", seconds=2.0, quiet=True,
            )
        )  # fmt: skip
    assert report.episodes[-1].outcome is Outcome.FINISHED
    assert report.episodes[-1].passive_confirmed
    recorded = Dataset.open(tmp_path / "set").read(0).trajectory
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
    with EmulatorProcess(
        "cartpole", "--transport", "dynamixel", "--nominal", "--profile", "sensor",
        "--servo-overload-after-s", "0.5",
    ) as emulator:  # fmt: skip
        report = collect(
            Collect(
                robot="cartpole", port=emulator.port + PATIENT, link=LINK, dataset=tmp_path / "set",
                profile="chirp", seconds=4.0, quiet=True,
            )
        )  # fmt: skip
    assert report.episodes[-1].outcome is Outcome.TRIPPED
    assert "servo 1 reports: overload" in report.episodes[-1].reason
    assert report.episodes[-1].passive_confirmed
    episode = Dataset.open(tmp_path / "set").read(0)
    assert any("overload" in event.message for event in episode.trajectory.events)
