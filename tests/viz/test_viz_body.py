"""What an inspected episode of a robot on legs holds, read back from the file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.standing_episode import standing_episode
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import SPACES
from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION as ON_STAND
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.overlay import Overlay, compute_overlay
from deal_hw.sim.recordings.standing import sensed_base
from deal_hw.types import BodyTrajectory, Trajectory
from deal_hw.viz.blueprint import inspect_blueprint
from deal_hw.viz.body_log import roll_pitch
from deal_hw.viz.episode_log import write_episode
from deal_hw.viz.summary import summary_markdown

SPACE = SPACES["default"]()


@pytest.fixture(scope="module")
def recording() -> Trajectory:
    """Half a second of a Go2 whose left legs bend, so that it leans."""
    targets = np.tile(DRIVER.default_position, (25, 1))
    targets[5:, [2, 8]] -= 0.3
    made = standing_episode(DRIVER, SPACE, SPACE.nominal, targets, height_m=0.35)
    body = made.body
    assert body is not None
    T = len(made.device_s)
    varied = dataclasses.replace(
        body,
        foot_force=np.arange(4.0) + np.arange(T)[:, None],
        acceleration=body.acceleration + 1e-3 * np.arange(T)[:, None],
    )
    return dataclasses.replace(made, body=varied)


@pytest.fixture(scope="module")
def overlay(recording: Trajectory) -> Overlay:
    """Predictions of two parameter sets."""
    sets = {"nominal": SPACE.nominal, "calibrated": 1.1 * SPACE.nominal}
    return compute_overlay(recording, DRIVER, SPACE, sets)


def body_of(trajectory: Trajectory) -> BodyTrajectory:
    """Return what was sensed of the body."""
    if trajectory.body is None:
        raise AssertionError("the recording has no body")
    return trajectory.body


@pytest.fixture(scope="module")
def columns(tmp_path_factory: pytest.TempPathFactory, recording: Trajectory, overlay: Overlay) -> Any:
    """Return a function that gives a column of an entity of the written file, or all entities."""
    from rerun.chunk import RrdReader

    path = tmp_path_factory.mktemp("viz") / "legs.rrd"
    write_episode(path, recording, DRIVER, overlay=overlay)
    chunks: dict[str, list[Any]] = {}
    for chunk in RrdReader(str(path)).stream():
        chunks.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())

    def read(entity: str = "", name: str = "Scalars:scalars") -> Any:
        if not entity:
            return set(chunks)
        rows = [
            row
            for batch in chunks[entity]
            if name in batch.schema.names
            for row in batch.column(name).to_pylist()
        ]
        return np.array([row[0] for row in rows])

    return read


def test_every_sense_is_there(columns: Any) -> None:
    """IMU by axis, feet by leg, temperatures by joint, the supply."""
    wanted = {
        *(f"/body/tilt/{name}" for name in ("roll", "pitch")),
        *(f"/body/{group}/{axis}" for group in ("gyro", "acceleration") for axis in "xyz"),
        *(f"/body/feet/{leg}" for leg in ("FL", "FR", "RL", "RR")),
        *(f"/body/temperature/{joint}" for joint in DRIVER.joint_names),
        *(f"/body/battery/{name}" for name in ("charge_%", "voltage_V", "current_A")),
    }
    found = {str(path).replace("\\", "") for path in columns() if str(path).startswith("/body/")}
    assert found == wanted


def test_the_numbers_are_what_was_sensed(columns: Any, recording: Trajectory) -> None:
    """Angles in degrees, charge in percent, the rest as it came; legs in the description's order."""
    body = body_of(recording)
    roll, pitch, _ = Rotation.from_quat(body.orientation, scalar_first=True).as_euler("xyz", degrees=True).T
    assert np.ptp(roll) > 1.0
    np.testing.assert_allclose(columns("/body/tilt/roll"), roll, atol=1e-9)
    np.testing.assert_allclose(columns("/body/tilt/pitch"), pitch, atol=1e-9)
    np.testing.assert_array_equal(columns("/body/gyro/y"), body.angular_velocity[:, 1])
    np.testing.assert_array_equal(columns("/body/acceleration/z"), body.acceleration[:, 2])
    np.testing.assert_array_equal(columns("/body/feet/RL"), body.foot_force[:, 2])
    np.testing.assert_array_equal(columns("/body/temperature/RR_calf_joint"), 41.0)
    np.testing.assert_allclose(columns("/body/battery/voltage_V"), 30.5)
    assert len(columns("/body/gyro/y")) == len(recording.device_s) == 250


def test_the_robot_stands_on_the_floor_and_leans(
    columns: Any, recording: Trajectory, overlay: Overlay
) -> None:
    """The real trunk is where the sensed base is; so are ghosts at windows' starts and outside."""
    base = sensed_base(load_model(DRIVER), recording)
    assert base is not None
    real = columns("/world/real/base", "Transform3D:translation")
    np.testing.assert_allclose(real, base[:, :3], atol=1e-6)
    turned = columns("/world/real/base", "Transform3D:quaternion")
    # Rerun's quaternions are x y z w.
    np.testing.assert_allclose(turned, np.roll(base[:, 3:], -1, axis=1), atol=1e-6)
    for name in ("nominal", "calibrated"):
        ghost = columns(f"/world/{name}/base", "Transform3D:translation")
        assert ghost.shape == real.shape
        starts = np.setdiff1d(overlay.sample[:, 0], overlay.sample[:, 1:])
        np.testing.assert_allclose(ghost[starts], real[starts], atol=1e-6)
        np.testing.assert_array_equal(ghost[:, :2], 0.0, err_msg="nobody measures where it went")
        assert np.ptp(ghost[:, 2] - real[:, 2]) > 1e-4
        outside = np.setdiff1d(np.arange(len(real)), overlay.sample)
        assert outside.size
        np.testing.assert_allclose(ghost[outside], real[outside], atol=1e-6)


def test_the_layout_has_a_tab_for_the_body(recording: Trajectory) -> None:
    """IMU, feet, temperatures, battery are on it; there is none where there is no body."""
    names = ["Position", "Velocity", "Commands", "Body", "Loop timing"]
    assert tabs(inspect_blueprint(recording, DRIVER)) == names
    bare = dataclasses.replace(recording, body=None)
    assert tabs(inspect_blueprint(bare, ON_STAND)) == [name for name in names if name != "Body"]


def test_a_leg_is_a_tab_of_three_rows(recording: Trajectory, overlay: Overlay) -> None:
    """Twelve joints are four tabs; each joint has its position, and beside it how far predictions are off."""
    position = inspect_blueprint(recording, DRIVER, overlay).root_container.contents[1].contents[0]
    assert [leg.name for leg in position.contents] == ["FL", "FR", "RL", "RR"]
    for leg in position.contents:
        assert leg.grid_columns == 2 and len(leg.contents) == 6
        assert leg.contents[0].name == f"{leg.name}_hip_joint position [rad]"
        assert leg.contents[1].name == f"{leg.name}_hip_joint: predicted - measured [rad]"


def test_what_was_not_sensed_has_no_plot(recording: Trajectory) -> None:
    """Of an imported recording's body only the IMU is known: no feet, temperatures and battery are drawn."""
    body = body_of(recording)
    unknown = np.full(len(recording.device_s), np.nan)
    bare = dataclasses.replace(
        body,
        foot_force=np.empty((len(unknown), 0)),
        temperature=np.empty((len(unknown), 0)),
        battery=unknown,
        voltage=unknown,
        current=unknown,
    )
    layout = inspect_blueprint(dataclasses.replace(recording, body=bare), DRIVER)
    (found,) = [tab for tab in layout.root_container.contents[1].contents if tab.name == "Body"]
    assert [view.name for view in found.contents[0].contents] == [
        "Roll, pitch [deg]",
        "Angular velocity [rad/s]",
        "Specific force [m/s²]",
    ]
    assert len(found.contents) == 1


def tabs(blueprint: Any) -> list[str]:
    """Return the names of the tabs at the right."""
    return [view.name for view in blueprint.root_container.contents[1].contents]


def test_an_episode_without_a_body_has_no_traces_of_one(recording: Trajectory, tmp_path: Path) -> None:
    """A robot that hangs, recorded before there was a channel for bodies."""
    from rerun.chunk import RrdReader

    path = tmp_path / "bare.rrd"
    write_episode(path, dataclasses.replace(recording, body=None), ON_STAND)
    entities = {str(chunk.entity_path) for chunk in RrdReader(str(path)).stream()}
    assert not any(entity.startswith("/body") for entity in entities)
    assert "/world/real/FL_calf" in entities


def test_a_hole_in_the_body_is_survived(recording: Trajectory, tmp_path: Path) -> None:
    """Samples without a body are NaN: no trace there, no error."""
    body = body_of(recording)
    orientation, force = body.orientation.copy(), body.foot_force.copy()
    orientation[3:6], force[3:6] = np.nan, np.nan
    holed = dataclasses.replace(body, orientation=orientation, foot_force=force)
    write_episode(tmp_path / "holed.rrd", dataclasses.replace(recording, body=holed), DRIVER)
    assert (tmp_path / "holed.rrd").stat().st_size > 0


def test_the_summary_has_a_row_for_each_joint(recording: Trajectory, overlay: Overlay) -> None:
    """Twelve columns would not fit: joints are rows, sets are columns."""
    text = summary_markdown(recording, DRIVER, overlay, None)
    assert "**go2, collect:** 0.50 s, 250 samples, 25 commands, 0 events" in text
    assert "| joint | nominal | calibrated |\n|---|---|---|\n| FL_hip_joint | " in text
    assert text.count("_joint | ") == 12
    assert "| latency | 0.0 ms | 0.0 ms |" in text


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_roll_and_pitch_by_scipy(roll: float, pitch: float, yaw: float) -> None:
    """Yaw first, then pitch, then roll; either sign of the quaternion."""
    q = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat(scalar_first=True)
    for sign in (1, -1):
        got = np.array(roll_pitch(sign * q[None]))[:, 0]
        np.testing.assert_allclose(got, [roll, pitch], atol=1e-6)
