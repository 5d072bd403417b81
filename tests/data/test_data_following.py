"""Joints that do not follow their commands end the part of a recording that is used."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from fakes.virtual_runs import record_cartpole

from deal_hw.cli.main import main
from deal_hw.data.checks.following import check_following, followed_part, followed_until_s, what_is_cut
from deal_hw.data.checks.suite import check
from deal_hw.data.importing.load import load_tables
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.excitation import excitation
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.findings import Severity
from deal_hw.types import NOT_FOLLOWING, Event, Trajectory
from deal_hw.workflows.inspect import inspect

CUT = "the last 0.8 s are left out: joint cart did not follow its commands"


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """4 s of random set-points; in the last 0.8 s the cart does not follow them."""
    return record_cartpole(tmp_path_factory.mktemp("run") / "dataset", seconds=4.0, unfollowed_s=0.8)


@pytest.fixture(scope="module")
def recorded(episode: Path) -> Trajectory:
    """Return its samples, commands and events."""
    return read_trajectory(episode)


def with_event(trajectory: Trajectory, **data: object) -> Trajectory:
    """Return a recording with one event, 3.5 s after its first sample."""
    start_ns = trajectory.metadata["start_ns"]
    event = Event(start_ns + 3_500_000_000, NOT_FOLLOWING, "", data)
    return dataclasses.replace(trajectory, events=(event,))


def test_a_recording_is_used_until_its_joints_do_not_follow(recorded: Trajectory) -> None:
    """200 samples and 50 commands a second, for 3.2 s; the event itself came 0.1 s later."""
    assert followed_until_s(recorded) == pytest.approx(3.2)
    part = followed_part(recorded)
    assert (part.device_s.size, part.sent_s.size) == (640, 160)
    np.testing.assert_array_equal(part.position, recorded.position[:640])
    np.testing.assert_array_equal(part.position_target, recorded.position_target[:160])
    assert part.receive_s[-1] < 3.2 <= recorded.receive_s[640]
    assert what_is_cut(recorded) == CUT
    assert followed_part(part) is not recorded and not what_is_cut(part)


def test_a_recording_that_was_followed_stays_whole(recorded: Trajectory) -> None:
    """Without the event nothing is cut, and the check is content."""
    followed = dataclasses.replace(recorded, events=())
    assert followed_until_s(followed) == math.inf and followed_part(followed) is followed
    assert check_following(followed).severity is Severity.OK


def test_the_checks_and_the_motion_are_those_of_the_used_part(recorded: Trajectory) -> None:
    """What the cart did afterwards is neither judged nor measured."""
    far = recorded.position.copy()
    far[640:] = np.nan
    broken = dataclasses.replace(recorded, position=far)
    assert not [found for found in check(broken) if found.severity is Severity.FAIL]
    assert excitation(broken) == excitation(followed_part(recorded))
    assert excitation(broken).duration_s == pytest.approx(3.195)
    assert check(broken)[-1].message.startswith(f"{CUT}; check power")


@pytest.mark.parametrize(
    ("since_s", "failed"), [(-1.0, "0 state samples"), (0.0, "0 state samples"), (1.0, "too short")]
)
def test_too_short_a_part_cannot_be_used(recorded: Trajectory, since_s: float, failed: str) -> None:
    """The check of the length fails, and the reason stands beside it."""
    since_ns = recorded.metadata["start_ns"] + round(since_s * 1e9)
    found = check(with_event(recorded, since_ns=since_ns, joints=["cart", "pole"]))
    (fail,) = [one for one in found if one.severity is Severity.FAIL]
    assert fail.code == "length" and failed in fail.message
    assert "joints cart, pole did not follow their commands" in found[-1].message


@pytest.mark.parametrize("data", [{}, {"since_ns": "soon", "joints": 7}, {"since_ns": 2**80, "joints": []}])
def test_a_damaged_event_counts_from_its_own_stamp(recorded: Trajectory, data: dict[str, object]) -> None:
    """A file may hold anything."""
    damaged = with_event(recorded, **data)
    assert followed_until_s(damaged) == pytest.approx(3.5)
    assert what_is_cut(damaged) == "the last 0.5 s are left out: a joint did not follow its commands"


def test_the_index_and_data_info_say_it(episode: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The entry measures the used part; its length in the table is that of the file."""
    folder = episode.parent.parent
    (info,) = Dataset.open(folder).episodes
    assert info.duration_s == pytest.approx(4.0) and info.excitation is not None
    assert info.excitation["duration_s"] == pytest.approx(3.195) and not info.failed_checks
    assert main(["data", "info", str(folder)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert f"episodes/000000.mcap: warn following: {CUT}" in printed and "1 warn" in printed


def test_an_episode_that_is_read_as_a_file_is_cut(episode: Path) -> None:
    """As by `calibrate --model --data`, and by an import with another model."""
    output: list[str] = []
    (table,) = load_tables(episode, say=output.append)
    assert table.time_s.size == 640 and table.command_s[-1] < 3.2
    assert f"000000.mcap: {CUT}" in output


def test_an_exported_episode_is_cut(
    episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A policy that learns from it must not learn from commands without effect."""
    pytest.importorskip("pyarrow")
    out = tmp_path / "lerobot"
    assert main(["data", "export", str(episode.parent.parent), "--out", str(out)]) == 0
    assert f"000000.mcap: {CUT}" in capsys.readouterr().err
    frames = json.loads((out / "meta" / "info.json").read_text())["total_frames"]
    # The first samples come before the first command arrives.
    assert 630 < frames <= 640


def test_predictions_end_where_the_joints_do_not_follow(episode: Path, tmp_path: Path) -> None:
    """The measured motion is shown to the end."""
    found = inspect(episode)
    assert found.overlay is not None and found.overlay.sample.max() < 640
    assert found.note == f"Of the predictions {CUT}." and found.note in found.table()
    assert found.save(tmp_path / "a.rrd").stat().st_size > 0
