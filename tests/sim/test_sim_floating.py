"""Floating bases: charts of orientation, exact restarts, odometry of the legs, and simulated targets."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from deal_hw.drivers.go2.descriptions.floor import (
    DESCRIPTION,
    GYRO_NOISE_RAD_S,
    ORIENTATION_NOISE_RAD,
    parameter_space,
)
from deal_hw.drivers.go2.motions import FEET, sway
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_quaternion, to_vector
from deal_hw.sim.legged.kinematics import standing_targets
from deal_hw.sim.legged.leg_odometry import leg_odometry, smooth_orientation
from deal_hw.sim.recordings.target import TargetRecording, TargetSensing, record_target
from deal_hw.sim.recordings.windows import cut_windows, predict_windows, setpoints
from deal_hw.types import FloatArray

VECTORS = hnp.arrays(np.float64, (5, 3), elements=st.floats(-1.7, 1.7))
SENSING = TargetSensing(
    joint_std=DESCRIPTION.sensor.noise,
    joint_resolution=DESCRIPTION.sensor.resolution,
    orientation_std=ORIENTATION_NOISE_RAD,
    gyro_std=GYRO_NOISE_RAD_S,
    feet=FEET,
)


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    """Return the Go2 on the floor."""
    return load_model(DESCRIPTION)


@pytest.fixture(scope="module")
def space() -> ParameterSpace:
    """Return its 24 parameters."""
    return parameter_space().with_ratio(3.0)


@pytest.fixture(scope="module")
def theta(space: ParameterSpace) -> FloatArray:
    """Return a truth that is not the nominal model."""
    return space.unnormalize(np.random.default_rng(4).uniform(0.3, 0.7, len(space)))


def record(
    robot: RobotModel, space: ParameterSpace, theta: FloatArray, sensing: TargetSensing | None
) -> TargetRecording:
    """Record two seconds of swaying."""
    rng = np.random.default_rng(8)
    return record_target(
        robot, space, theta, sway(robot, rng, 2.0), seconds=2.0, latency_s=0.010, sensing=sensing, rng=rng
    )


@given(vector=VECTORS, around=VECTORS)
def test_charts_are_inverse_to_each_other(vector: FloatArray, around: FloatArray) -> None:
    """A rotation vector comes back from the orientation it leads to, around any reference."""
    reference = to_quaternion(around, IDENTITY)
    back = to_vector(to_quaternion(vector, reference), reference)
    np.testing.assert_allclose(back, vector, atol=1e-9)


@settings(deadline=None)
@given(hnp.arrays(float, (5, 4), elements=st.floats(-1, 1)), st.booleans())
def test_single_precision_has_the_same_vectors(quaternion: FloatArray, around: bool) -> None:
    """Those of a GPU: to seven digits, around the identity and around other references."""
    quaternion[0] = IDENTITY
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    quaternion = np.where(length > 0.1, quaternion / np.maximum(length, 0.1), IDENTITY)
    reference = np.array([0.6, 0.0, 0.8, 0.0]) if around else IDENTITY
    found = to_vector(quaternion.astype(np.float32), reference)
    exact = to_vector(quaternion, reference)
    # Half a turn has two vectors.
    turned = np.minimum(np.abs(found - exact), np.abs(found + exact))
    half = np.abs(np.linalg.norm(exact, axis=1) - np.pi) < 1e-3
    np.testing.assert_allclose(np.where(half[:, None], turned, found - exact), 0.0, atol=4e-6)
    assert found.dtype == np.float32


def test_a_quarter_turn_about_the_vertical_is_the_quaternion_everybody_knows() -> None:
    """Rotation by 90 degrees about z is (sqrt 1/2, 0, 0, sqrt 1/2), scalar first."""
    quaternion = to_quaternion(np.array([0.0, 0.0, np.pi / 2]), IDENTITY)
    np.testing.assert_allclose(quaternion, [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-12)


def test_a_diverged_orientation_is_not_a_number() -> None:
    """A quaternion that is not finite gives a rotation vector that is not, and leaves the others alone."""
    found = to_vector(np.array([[np.nan, 0, 0, 0], [1.0, 0, 0, 0]]), IDENTITY)
    assert np.isnan(found[0]).all()
    np.testing.assert_array_equal(found[1], 0.0)


def test_a_fixed_base_has_no_base_coordinates() -> None:
    """The cart-pole's coordinates are its joints."""
    from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE

    model = load_model(CARTPOLE)
    assert model.coordinates == CARTPOLE.joint_names
    assert model.base is None


def test_states_go_in_and_come_out_unchanged(robot: RobotModel, space: ParameterSpace) -> None:
    """The base's place and turn and the joints survive the way through MuJoCo's qpos."""
    batch = ServoBatch(robot, space, 2, threads=1)
    rng = np.random.default_rng(0)
    position, velocity = rng.uniform(-0.3, 0.3, (2, 18)), rng.uniform(-1, 1, (2, 18))
    batch.set_state(position, velocity)
    np.testing.assert_allclose(batch.position, position, atol=1e-12)
    np.testing.assert_array_equal(batch.velocity, velocity)


@pytest.mark.parametrize("at_once", [1, 3])
def test_windows_of_the_truth_repeat_the_recording(
    robot: RobotModel, space: ParameterSpace, theta: FloatArray, at_once: int
) -> None:
    """Restarted at reported states, the truth predicts an exact recording to rounding, contacts and all."""
    episode = record(robot, space, theta, None).episode
    batch = ServoBatch(robot, space, 1, threads=1)
    vars(batch.engine)["windows"] = at_once
    batch.set_parameters(theta[None])
    windows = cut_windows(episode, 10)
    path = setpoints(batch, episode, np.array([0.010]))
    x, v = predict_windows(
        batch, episode, windows, episode.position[windows.start], episode.velocity[windows.start], path
    )
    # A warm start of the contact solver is not part of a state: what it leaves is below its tolerance.
    np.testing.assert_allclose(x[0], episode.position[windows.samples()], atol=1e-7)
    np.testing.assert_allclose(v[0], episode.velocity[windows.samples()], atol=1e-5)


def test_feet_stay_where_they_are_when_the_body_sways(robot: RobotModel) -> None:
    """Joint targets for a moved body put each foot where it was, seen in the world."""
    shift, turn = np.array([[0.02, -0.01, 0.015]]), np.array([[0.05, -0.04, 0.08]])
    pose = np.array(DESCRIPTION.default_position)
    joints = standing_targets(
        robot, FEET, np.concatenate([0 * shift, shift]), np.concatenate([0 * turn, turn]), pose
    )
    feet = []
    for moved, turned, q in zip(
        np.concatenate([0 * shift, shift]), np.concatenate([0 * turn, turn]), joints, strict=True
    ):
        data = mujoco.MjData(robot.model)
        data.qpos[:3], data.qpos[3:7] = moved, to_quaternion(turned, IDENTITY)
        data.qpos[list(robot.qpos)] = q
        mujoco.mj_kinematics(robot.model, data)
        feet.append([data.geom(name).xpos.copy() for name in FEET])
    np.testing.assert_allclose(joints[0], pose, atol=1e-12)
    np.testing.assert_allclose(feet[1], feet[0], atol=1e-5)


def test_a_body_that_moves_too_far_is_refused(robot: RobotModel) -> None:
    """Feet that no joint positions can reach are an error that says by how much the body was to move."""
    with pytest.raises(ConfigurationError, match="move it less"):
        standing_targets(
            robot, FEET, np.array([[0.0, 0.0, 0.5]]), np.zeros((1, 3)), np.array(DESCRIPTION.default_position)
        )


def test_legs_tell_the_bases_velocity_where_feet_stand(robot: RobotModel, space: ParameterSpace) -> None:
    """From true joint and turning speeds the legs tell the base's velocity, as far as contacts hold."""
    seen = record(robot, space, space.nominal, None)
    orientation = seen.episode.reference
    assert orientation is not None
    legs = leg_odometry(
        robot, FEET, orientation, seen.velocity[:, 3:6], seen.position[:, 6:], seen.velocity[:, 6:]
    )
    error, moved = legs.velocity - seen.velocity[:, :3], np.abs(seen.velocity[:, :3])
    assert np.median(moved[:, 2]) > 0.02
    assert np.median(np.abs(error)) < 0.005
    np.testing.assert_allclose(legs.height, seen.position[:, 2], atol=3e-3)


def test_a_fixed_base_has_no_odometry() -> None:
    """A robot that is bolted down is refused by name."""
    from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE

    with pytest.raises(ConfigurationError, match="cartpole"):
        leg_odometry(load_model(CARTPOLE), (), *(np.zeros((1, 4)),) * 4)


def test_smoothing_orientations_leaves_a_steady_turn_alone() -> None:
    """A turn at constant speed is a straight line in the chart, which any polynomial keeps."""
    steady = to_quaternion(np.linspace(0, 1, 30)[:, None] * [0.0, 0.0, 1.0], IDENTITY)
    smooth = smooth_orientation(steady, np.full(5, 0.2))
    np.testing.assert_allclose(to_vector(smooth, steady), 0.0, atol=1e-12)


def test_a_target_is_reported_as_its_sensors_see_it(
    robot: RobotModel, space: ParameterSpace, theta: FloatArray
) -> None:
    """Joints and IMU are measured with their noise; the base's place and speed are estimates."""
    seen = record(robot, space, theta, SENSING)
    episode = seen.episode
    assert [robot.coordinates[c] for c in episode.channels if c < 18][:3] == ["base.rx", "base.ry", "base.rz"]
    assert len(episode.channels) == 3 + 12 + 3
    joints = episode.position[:, 6:] - seen.position[:, 6:]
    assert joints.std() == pytest.approx(1e-3, rel=0.1)
    gyro = episode.velocity[:, 3:6] - seen.velocity[:, 3:6]
    assert gyro.std() == pytest.approx(GYRO_NOISE_RAD_S, rel=0.15)
    assert episode.estimate_std is not None
    error = episode.velocity[:, :3] - seen.velocity[:, :3]
    assert np.median(np.abs(error)) < episode.estimate_std[18]
    assert np.median(np.abs(episode.position[:, 2] - seen.position[:, 2])) < episode.estimate_std[2]


def test_an_encoder_bias_moves_what_is_reported_and_what_the_servo_holds(robot: RobotModel) -> None:
    """A servo with a biased encoder holds the biased reading, so the joint itself ends up off by the bias."""
    from deal_hw.parameters import Parameter

    biased = ParameterSpace(
        [
            Parameter(
                name="FL_calf.bias",
                kind="encoder_bias",
                elements=("FL_calf_joint",),
                unit="rad",
                nominal=0.0,
                low=-0.1,
                high=0.1,
                scale="linear",
            )
        ]
    )
    batch = ServoBatch(robot, biased, 2, threads=1)
    batch.set_parameters(np.array([[0.0], [0.05]]))
    pose = np.array(DESCRIPTION.default_position)
    start = np.concatenate([[0, 0, 0.5, 0, 0, 0], pose])
    batch.set_state(start, np.zeros(18))
    np.testing.assert_allclose(batch.position[:, 8], pose[2], atol=1e-12)
    true = batch.batch.bind("qpos")[:, robot.qpos[2]]
    assert true[1] - true[0] == pytest.approx(-0.05)
    # In free fall the servo keeps the reading at the target, so the true joint keeps its distance.
    position, _ = batch.advance(np.broadcast_to(pose, (2, 50, 12)))
    assert position[1, 0, 8] == pytest.approx(position[0, 0, 8], abs=5e-3)
