"""How far the model for MuJoCo alone is from the laws: measured on recordings, and said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fakes.law_robots import SERVO, batch, known, robot

from deal_hw.sim.mjcf.calibrated import write_calibrated_mjcf
from deal_hw.sim.mjcf.plain import BEND
from deal_hw.sim.plain_model import difference_words, plain_facts
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

COLUMNS = """
time: time
joints:
  - {name: shoulder, position: shoulder, target: shoulder.command, unit: rad}
  - {name: elbow, position: elbow, target: elbow.command, unit: rad}
"""


def recorded(tmp_path: Path, hz: float, size: float) -> tuple[SampledEpisode, ...]:
    """Return a recording of both joints that follow set-points at 100 Hz."""
    time = np.arange(1200) * 0.01
    command = np.stack([size * np.sin(2 * np.pi * f * hz * time) for f in (1.0, 1.4)], axis=1)
    # They lag, and encoders have noise.
    position = np.roll(command, 5, axis=0)[5:] + 1e-3 * np.random.default_rng(0).normal(size=(1195, 2))
    columns = {"shoulder": position[:, 0], "elbow": position[:, 1], "time": time[5:]}
    columns |= {"shoulder.command": command[5:, 0], "elbow.command": command[5:, 1]}
    np.savez(tmp_path / "swing.npz", allow_pickle=False, **columns)
    (tmp_path / "columns.yaml").write_text(COLUMNS)
    (tmp_path / "arm.xml").write_text(SERVO)
    work = calibration_input(
        FilesSettings(
            model=tmp_path / "arm.xml", data=(tmp_path / "swing.npz",), columns=tmp_path / "columns.yaml"
        )
    )
    return tuple(work.episodes)


def facts(tmp_path: Path, kinds: dict[str, float], hz: float = 0.1, size: float = 0.3) -> dict[str, object]:
    """Return the facts of an arm with laws at the shoulder and a latency of 9.5 ms."""
    members = batch(robot(tmp_path, SERVO), *(known(kind, "shoulder", v) for kind, v in kinds.items()))

    def write(path: Path) -> object:
        return write_calibrated_mjcf(members.robot, members.space, members.space.nominal, path, 0.0095)

    return plain_facts(members.robot, write, recorded(tmp_path, hz, size))


def test_laws_that_mujoco_has_make_no_difference(tmp_path: Path) -> None:
    """Latency and lag: both models move alike, and the sentence says so."""
    found = facts(tmp_path, {"command_lag": 0.02})
    assert found["has"] == ["latency: a delay of 9.5 ms", "lag of shoulder: a filter of 20 ms"]
    assert found["lacks"] == [] and not found["bristles"]
    difference = found["difference"]
    assert isinstance(difference, dict) and max(difference.values()) < 1e-9
    assert "by under 0.001 % of the range at most" in difference_words(found)


def test_a_law_that_mujoco_lacks_is_measured(tmp_path: Path) -> None:
    """Play of 0.03 rad in a motion of 0.6 rad: 1 to 5 % of it at the shoulder."""
    found = facts(tmp_path, {"servo_play": 0.03})
    difference = found["difference"]
    assert found["lacks"] == ["play of shoulder (0.03)"] and isinstance(difference, dict)
    assert 0.01 < difference["shoulder"] < 0.05 and difference["shoulder"] > 3 * difference["elbow"]
    assert "(shoulder)" in difference_words(found)


def test_bristles_are_taken_where_they_are_nearer(tmp_path: Path) -> None:
    """Slow motion with much friction at rest: nearer than constant friction, so the model has them."""
    found = facts(tmp_path, {"dof_friction_stribeck": 0.2, "dof_stribeck_speed": 0.3})
    difference = found["difference"]
    assert found["bristles"] and found["lacks"] == [] and isinstance(difference, dict)
    assert max(difference.values()) < 2e-3


def test_bristles_that_are_farther_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same law with bristles that bend by half a radian, so that they are a spring."""
    monkeypatch.setattr("deal_hw.sim.mjcf.plain.BEND", dict.fromkeys(BEND, 0.5))
    found = facts(tmp_path, {"dof_friction_stribeck": 0.2, "dof_stribeck_speed": 0.3}, hz=0.7, size=0.6)
    assert not found["bristles"]
    assert found["lacks"] == ["dof_friction_stribeck of shoulder (0.2)"]


def test_without_recordings_nothing_is_compared(tmp_path: Path) -> None:
    """Then friction by speed is left out, as nobody knows how near bristles are."""
    kinds = {"dof_friction_stribeck": 0.2}
    members = batch(robot(tmp_path, SERVO), *(known(kind, "shoulder", v) for kind, v in kinds.items()))

    def write(path: Path) -> object:
        return write_calibrated_mjcf(members.robot, members.space, members.space.nominal, path, 0.0)

    found = plain_facts(members.robot, write, ())
    assert found["difference"] is None and not found["bristles"] and difference_words(found) == ""


def test_a_model_that_cannot_be_written_is_an_error_in_the_facts(tmp_path: Path) -> None:
    """The reason stands there, and nothing is raised."""
    taken = SERVO.replace('<position name="elbow"', '<position name="shoulder.friction"')
    members = batch(robot(tmp_path, taken), known("dof_friction_stribeck", "shoulder", 0.2))

    def write(path: Path) -> object:
        return write_calibrated_mjcf(members.robot, members.space, members.space.nominal, path, 0.0)

    found = plain_facts(members.robot, write, recorded(tmp_path, 0.1, 0.3))
    assert "does not compile" in str(found["error"])
