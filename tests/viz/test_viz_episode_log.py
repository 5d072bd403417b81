"""What an inspected episode holds, read back from the file."""

from __future__ import annotations

import dataclasses
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.types import Trajectory
from deal_hw.viz import palette
from deal_hw.viz.episode_log import write_episode
from deal_hw.viz.viewer import program

Array = npt.NDArray[np.float64]


class Rrd:
    """An .rrd file, read back through rerun's own reader."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(str(path))
        self.blueprints = reader.blueprints()
        self.batches: dict[tuple[str, bool], list[Any]] = {}
        for chunk in reader.stream():
            self.batches.setdefault((str(chunk.entity_path), chunk.is_static), []).append(
                chunk.to_record_batch()
            )

    def entities(self) -> set[str]:
        """Return the paths of all entities."""
        return {path for path, _ in self.batches}

    def column(self, path: str, name: str, *, static: bool = False) -> list[Any]:
        """Return all values of a column of an entity, in the order of writing."""
        found = []
        for batch in self.batches[path, static]:
            if name in batch.schema.names:
                column = batch.column(name)
                column = column.cast("int64") if name in {"device_time", "host_time"} else column
                found += column.to_pylist()
        return found

    def scalars(self, path: str) -> tuple[Array, Array, Array]:
        """Return device times [s], host times [s] and values of an entity's scalars."""
        device, host = (np.array(self.column(path, name)) * 1e-9 for name in ("device_time", "host_time"))
        values = np.array([row[0] for row in self.column(path, "Scalars:scalars")])
        return device, host, values


@pytest.fixture(scope="module")
def rrd(shown: Any) -> Rrd:
    """The shown episode, read back."""
    return Rrd(shown.rrd)


def test_file_is_whole(shown: Any) -> None:
    """Rerun's own check finds nothing wrong."""
    done = subprocess.run(
        [program(), "rrd", "verify", shown.rrd], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "1 file verified without error" in done.stdout + done.stderr


def test_samples_stand_on_both_clocks(rrd: Rrd, shown: Any) -> None:
    """Positions, velocities and effort come back to the nanosecond, on the device's clock and the host's."""
    t = shown.trajectory
    for j, joint in enumerate(t.joint_names):
        for quantity in ("position", "velocity"):
            device, host, values = rrd.scalars(f"/joints/{joint}/{quantity}/measured")
            np.testing.assert_allclose(device, t.device_s, atol=1e-9)
            np.testing.assert_allclose(host, t.receive_s, atol=1e-9)
            np.testing.assert_array_equal(values, getattr(t, quantity)[:, j])
    np.testing.assert_array_equal(rrd.scalars("/joints/cart/effort")[2], t.effort[:, 0])
    assert "/joints/pole/effort" not in rrd.entities(), "a joint without a motor has no effort"


def test_predictions_break_between_windows(rrd: Rrd, shown: Any) -> None:
    """Each window is its start, 40 predictions and a NaN; times rise, microseconds off the samples."""
    overlay = shown.overlay
    windows = len(overlay.sample)
    for name in ("nominal", "calibrated"):
        device, _, values = rrd.scalars(f"/joints/pole/position/predicted/{name}")
        assert len(values) == windows * 42 + 2
        inner = values[1:-1].reshape(windows, 42)
        np.testing.assert_array_equal(inner[:, :41], overlay.predictions[name].position[:, :, 1])
        assert np.isnan(inner[:, 41]).all() and np.isnan(values[[0, -1]]).all()
        assert (np.diff(device) > 0).all()
        np.testing.assert_allclose(device[1:-1].reshape(windows, 42)[:, :41], overlay.device_s, atol=3e-6)
        assert device[0] == 0 and device[-1] == pytest.approx(shown.trajectory.device_s[-1], abs=1e-5)


def test_errors_are_predicted_minus_measured(rrd: Rrd, shown: Any) -> None:
    """The truth's error is nil, the nominal one's is what the overlay says."""
    _, _, wrong = rrd.scalars("/joints/cart/error/nominal")
    expected = shown.overlay.predictions["nominal"].position - shown.overlay.position
    np.testing.assert_allclose(wrong[np.isfinite(wrong)], expected[:, :, 0].ravel(), atol=1e-15)
    assert np.abs(wrong[np.isfinite(wrong)]).max() > 1e-3
    _, _, right = rrd.scalars("/joints/cart/error/calibrated")
    assert np.nanmax(np.abs(right)) < 1e-9
    assert len(rrd.scalars("/joints/pole/velocity_error/nominal")[2]) == len(wrong)


def test_commands_stand_where_the_device_received_them(rrd: Rrd, shown: Any) -> None:
    """Targets stand at their reception on the device's clock: every 20 ms, 0.4 ms after a sample."""
    t = shown.trajectory
    device, host, sent = rrd.scalars("/commands/cart/sent")
    np.testing.assert_allclose(device, 0.02 * np.arange(len(sent)) + 0.4e-3, atol=1e-9)
    np.testing.assert_allclose(host, t.sent_s, atol=1e-9)
    np.testing.assert_array_equal(sent, t.position_target[:, 0])
    np.testing.assert_array_equal(rrd.scalars("/commands/cart/requested")[2], t.requested_position[:, 0])


def test_loop_timing_is_in_milliseconds(rrd: Rrd) -> None:
    """Periods, lateness and the age of the state are there in ms."""
    for name, expected in (
        ("command_period", 20.002),
        ("state_period", 5.0005),
        ("lateness", 0.2),
        ("state_age", 1.1),
    ):
        np.testing.assert_allclose(rrd.scalars(f"/loop_timing/{name}")[2], expected, rtol=1e-6)


def test_status_is_written_where_it_changes(rrd: Rrd) -> None:
    """The speed clamp lasts from sample 100 to 120; bits that are always as they should be are left out."""
    states = [row[0] for row in rrd.column("/status/speed_clamped", "StateChange:state")]
    assert states == ["off", "on", "off"]
    times = [1e-9 * stamp for stamp in rrd.column("/status/speed_clamped", "device_time")]
    assert times == pytest.approx([0.0, 0.5, 0.6])
    assert not {"/status/armed", "/status/homed", "/status/watchdog"} & rrd.entities()
    assert [row[0] for row in rrd.column("/status/safety", "StateChange:state")] == ["active", "passive"]
    assert rrd.column("/status/safety", "host_time") == [200_000, 1_500_200_000]


def test_events_are_a_text_log(rrd: Rrd) -> None:
    """Events stand at their time since the first sample; what stops the robot is a warning."""
    assert [row[0] for row in rrd.column("/events", "TextLog:text")] == [
        "armed: the motors follow commands",
        "passive: operator stop",
    ]
    assert [row[0] for row in rrd.column("/events", "TextLog:level")] == ["INFO", "WARN"]
    assert rrd.column("/events", "host_time") == [0, 1_500_000_000]
    # The host's clock runs 0.01 % fast and a sample takes 0.3 ms: 1.5 s / 1.0001 - 0.3 ms / 1.0001.
    assert rrd.column("/events", "device_time")[1] * 1e-9 == pytest.approx(1.49955004, abs=2e-8)


def test_robot_moves_in_3d(rrd: Rrd, shown: Any) -> None:
    """The real cart stands where it was measured, ghosts where predicted, outside windows with it."""
    t = shown.trajectory
    real = np.array([row[0] for row in rrd.column("/world/real/cart", "Transform3D:translation")])
    np.testing.assert_allclose(real[:, 0], t.position[:, 0], atol=1e-6)
    pole = np.array([row[0] for row in rrd.column("/world/real/pole", "Transform3D:quaternion")])
    # A turn by an angle about +y is (0, sin(angle / 2), 0, cos(angle / 2)) in rerun's order x y z w.
    np.testing.assert_allclose(pole[:, 1], np.sin(t.position[:, 1] / 2), atol=1e-6)
    ghost = np.array([row[0] for row in rrd.column("/world/nominal/cart", "Transform3D:translation")])
    window = shown.overlay.sample[3, 1:]
    np.testing.assert_allclose(
        ghost[window, 0], shown.overlay.predictions["nominal"].position[3, 1:, 0], atol=1e-6
    )
    outside = np.setdiff1d(np.arange(len(t.device_s)), shown.overlay.sample)
    assert outside.size
    np.testing.assert_allclose(ghost[outside, 0], t.position[outside, 0], atol=1e-6)
    assert {"/world/real/cart/cart", "/world/nominal/pole/pole", "/world/surroundings/rail"} <= rrd.entities()


def test_colours_are_the_palette(rrd: Rrd) -> None:
    """Measured traces are blue, nominal ones orange, calibrated ones green, in plots as in 3D."""
    for paths, (red, green, blue) in (
        (("/joints/cart/position/measured", "/world/real/cart/cart"), palette.REAL),
        (("/joints/cart/error/nominal", "/world/nominal/cart/cart"), palette.NOMINAL),
        (("/joints/cart/error/calibrated", "/world/calibrated/cart/cart"), palette.CALIBRATED),
    ):
        packed = red << 24 | green << 16 | blue << 8 | 255
        assert rrd.column(paths[0], "SeriesLines:colors", static=True) == [[packed]]
        assert rrd.column(paths[1], "Boxes3D:colors", static=True) == [[packed]]


def test_verdict_and_alarms_are_a_line_each(rrd: Rrd, shown: Any) -> None:
    """Above the fold stands what was seen; what it means and what to do is in the details."""
    (text,) = rrd.column("/verdict", "TextDocument:text", static=True)[0]
    nominal = 100 * shown.overlay.predictions["nominal"].position_nrmse.mean()
    assert text.startswith("**amber:** look at it") and f"nominal {nominal:.2g} %" in text
    assert "\n1. backlash of 2 mm\n" in text and "play in the gear" not in text


def test_summary_lists_errors_and_parameters(rrd: Rrd, shown: Any) -> None:
    """Every parameter is there with nominal value, estimate and interval; alarms, too."""
    (text,) = rrd.column("/summary", "TextDocument:text", static=True)[0]
    assert "**cartpole, collect:**" in text and "restarted every 0.20 s" in text
    # cart.mass: nominal 0.3 kg, estimate 0.6 x 0.3 = 0.18 kg, interval 0.162 to 0.198 kg, weak.
    assert "| cart.mass [kg] | 0.3 | 0.18 | 0.162 to 0.198 | weak |" in text
    assert all(name in text for name in shown.result.space.names)
    assert "latency 8.0 ms (7.0 to 9.0)" in text and "pole.length 0.3 m" in text
    assert (
        "1. backlash of 2 mm play in the gear **mend it**" in text
        and "not determined by the data: all masses together" in text
    )


def test_layout_travels_with_the_file(rrd: Rrd) -> None:
    """The file holds its own blueprint."""
    assert len(rrd.blueprints) == 1


def test_episode_without_predictions(trajectory: Trajectory, tmp_path: Path) -> None:
    """A recording that allows no predictions is shown with the reason, even without commands."""
    none = np.zeros((0, 1))
    bare = dataclasses.replace(
        trajectory,
        status=np.zeros_like(trajectory.status),
        command_sequence=np.full_like(trajectory.command_sequence, -1),
        command_age_s=np.full_like(trajectory.command_age_s, np.nan),
        sent_s=np.zeros(0),
        sent_sequence=np.zeros(0, dtype=np.int64),
        requested_position=none,
        position_target=none,
        events=(),
    )
    write_episode(tmp_path / "bare.rrd", bare, DESCRIPTION, note="No predictions: never armed.")
    got = Rrd(tmp_path / "bare.rrd")
    assert "No predictions: never armed." in got.column("/verdict", "TextDocument:text", static=True)[0][0]
    assert not any("predicted" in path or path.startswith("/world/nominal") for path in got.entities())
    assert len(got.scalars("/joints/cart/position/measured")[2]) == len(bare.device_s)
