"""A robot on legs beside its recording: where it is drawn, and what is predicted of it."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from fakes.standing_episode import standing_episode

from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import SPACES
from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION as ON_STAND
from deal_hw.drivers.go2.motions import sway
from deal_hw.errors import InsufficientDataError
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.engine.scene import body_poses, read_scene
from deal_hw.sim.recordings.overlay import Overlay, compute_overlay
from deal_hw.sim.recordings.standing import sensed_base, tangent_base
from deal_hw.types import BodyTrajectory, FloatArray, Trajectory

SPACE = SPACES["default"]()
LATENCY_TICKS = 4


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    """The Go2 on the floor."""
    return load_model(DRIVER)


@pytest.fixture(scope="module")
def truth() -> FloatArray:
    """Drives up to 35 % off the nominal ones."""
    return SPACE.nominal * np.exp(np.random.default_rng(1).uniform(-0.3, 0.3, len(SPACE)))


@pytest.fixture(scope="module")
def recording(robot: RobotModel, truth: FloatArray) -> Trajectory:
    """A Go2 that sways over standing feet for two seconds, 8 ms late."""
    motion = sway(robot, np.random.default_rng(0), 2.0)
    targets = np.array([motion(np.zeros(12), np.zeros(12), k / 50) for k in range(100)])
    return standing_episode(DRIVER, SPACE, truth, targets, height_m=0.35, latency_ticks=LATENCY_TICKS)


@pytest.fixture(scope="module")
def overlay(recording: Trajectory, truth: FloatArray) -> Overlay:
    """The truth and the nominal model beside it."""
    sets = {"nominal": SPACE.nominal, "true": truth}
    return compute_overlay(recording, DRIVER, SPACE, sets, latency_s=0.008, smoothing_s=0.0)


def body_of(trajectory: Trajectory) -> BodyTrajectory:
    """Return what was sensed of the body."""
    if trajectory.body is None:
        raise AssertionError("the recording has no body")
    return trajectory.body


def test_truth_predicts_a_standing_robot(overlay: Overlay) -> None:
    """Base speed and height are estimates, so a little error stays: a hundredth of the range, not a tenth."""
    true, nominal = (overlay.predictions[name] for name in ("true", "nominal"))
    assert true.position_nrmse.max() < 0.015
    assert np.abs(overlay.position_error("true")).max() < 0.02
    assert nominal.position_nrmse.max() > 4 * true.position_nrmse.max()
    assert (true.position_nrmse < nominal.position_nrmse).all()


def test_latency_counts_for_legs_too(recording: Trajectory, truth: FloatArray, overlay: Overlay) -> None:
    """The truth 8 ms early errs twice as much."""
    early = compute_overlay(recording, DRIVER, SPACE, {"true": truth}, smoothing_s=0.0).predictions["true"]
    assert early.position_nrmse.mean() > 2 * overlay.predictions["true"].position_nrmse.mean()


def test_predictions_carry_the_base(recording: Trajectory, robot: RobotModel, overlay: Overlay) -> None:
    """A pose at each point: it begins where the body was sensed, and the truth keeps it there."""
    base = overlay.predictions["true"].base
    assert base is not None
    assert base.shape == (*overlay.sample.shape, 7)
    np.testing.assert_allclose(np.linalg.norm(base[..., 3:], axis=-1), 1.0, atol=1e-9)
    sensed = sensed_base(robot, recording)
    assert sensed is not None
    drawn = sensed[overlay.sample]
    # Orientations are smoothed over a few samples before they are started from.
    np.testing.assert_allclose(base[:, 0, 3:], drawn[:, 0, 3:], atol=2e-4)
    np.testing.assert_allclose(base[..., 3:], drawn[..., 3:], atol=0.01)
    np.testing.assert_allclose(base[..., 2], drawn[..., 2], atol=0.005)


def test_the_lowest_foot_is_on_the_floor(recording: Trajectory, robot: RobotModel) -> None:
    """No foot below it, one on it; orientation as sensed, place at the origin."""
    base = sensed_base(robot, recording)
    assert base is not None
    np.testing.assert_array_equal(base[:, 3:], body_of(recording).orientation)
    np.testing.assert_array_equal(base[:, :2], 0.0)
    model, data = robot.model, mujoco.MjData(robot.model)
    feet = [model.geom(name).id for name in DRIVER.feet]
    for t in range(0, len(base), 100):
        data.qpos[:7] = base[t]
        data.qpos[list(robot.qpos)] = recording.position[t]
        mujoco.mj_kinematics(model, data)
        clearance = data.geom_xpos[feet, 2] - model.geom_size[feet, 0]
        assert np.min(clearance) == pytest.approx(0.0, abs=1e-9)


def test_bodies_stand_where_the_base_is(robot: RobotModel) -> None:
    """The trunk's pose is the base's; a foot turns with it; what is not known is NaN."""
    joints = np.tile(DRIVER.default_position, (3, 1))
    half = np.sqrt(0.5)
    base = np.array([[1.0, 2.0, 0.3, 1, 0, 0, 0], [1.0, 2.0, 0.3, half, 0, 0, half], [np.nan] * 7])
    where, turned = body_poses(robot, joints, base)
    names = read_scene(robot).bodies
    trunk, calf = names.index("base"), names.index("FL_calf")
    np.testing.assert_allclose(where[0, trunk], [1, 2, 0.3], atol=1e-12)
    np.testing.assert_allclose(turned[1, trunk], [half, 0, 0, half], atol=1e-12)
    # A quarter turn left takes what was ahead to the left, and what was to the left behind.
    x, y, z = where[0, calf] - where[0, trunk]
    np.testing.assert_allclose(where[1, calf] - where[1, trunk], [-y, x, z], atol=1e-12)
    assert np.isnan(where[2]).all() and np.isnan(turned[2]).all()
    own, _ = body_poses(robot, joints[:1])
    np.testing.assert_allclose(own[0, trunk], robot.model.qpos0[:3], atol=1e-12)


def test_samples_without_a_body_are_not_drawn(recording: Trajectory, robot: RobotModel) -> None:
    """NaN orientation or joint, NaN pose; the samples around it stay."""
    orientation = body_of(recording).orientation.copy()
    orientation[3] = np.nan
    position = recording.position.copy()
    position[5, 2] = np.nan
    holed = dataclasses.replace(
        recording, position=position, body=dataclasses.replace(body_of(recording), orientation=orientation)
    )
    base = sensed_base(robot, holed)
    assert base is not None
    assert np.isnan(base[3, 2:]).all() and np.isnan(base[5, 2])
    whole = sensed_base(robot, recording)
    assert whole is not None
    np.testing.assert_array_equal(base[[2, 4, 6]], whole[[2, 4, 6]])
    where, _ = body_poses(robot, position, base)
    assert np.isnan(where[[3, 5]]).all() and np.isfinite(where[[2, 4, 6]]).all()


def test_nothing_is_sensed_where_nothing_floats(recording: Trajectory, robot: RobotModel) -> None:
    """A base that is held, and a recording from before bodies were recorded."""
    assert sensed_base(load_model(ON_STAND), recording) is None
    assert sensed_base(load_model(CARTPOLE), recording) is None
    assert sensed_base(robot, dataclasses.replace(recording, body=None)) is None


def test_without_a_body_there_are_no_predictions(recording: Trajectory, truth: FloatArray) -> None:
    """The reason is reported; a robot that hangs needs none."""
    bare = dataclasses.replace(recording, body=None)
    with pytest.raises(InsufficientDataError, match="lacks the floating base"):
        compute_overlay(bare, DRIVER, SPACE, {"true": truth})
    nameless = dataclasses.replace(DRIVER, feet=())
    with pytest.raises(InsufficientDataError, match="names of feet"):
        compute_overlay(recording, nameless, SPACE, {"true": truth})
    assert compute_overlay(bare, ON_STAND, SPACE, {"true": truth}).predictions["true"].base is None


def test_chart_coordinates_become_poses() -> None:
    """A quarter turn about x from a reference of another quarter turn is half a turn; joints are ignored."""
    half = np.sqrt(0.5)
    position = np.array([[1.0, 2.0, 3.0, np.pi / 2, 0, 0, 9.0, 9.0]])
    np.testing.assert_allclose(
        tangent_base(position, np.array([[half, half, 0, 0]])), [[1, 2, 3, 0, 1, 0, 0]], atol=1e-12
    )
