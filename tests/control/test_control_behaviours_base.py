"""Policies that observe a floating base, on the states that a real robot reports."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fakes.linear_policy import feedback_spec
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.errors import PolicyError, PolicyMismatchError
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.motions.velocity import FixedVelocity
from deal_hw.policy import Observation, ObservationBuilder, ObservationTerm, PolicySpec
from deal_hw.types import BodyState, FloatArray, RobotState, Status

AXES = ("x", "y", "z")
SENSED = tuple(
    ObservationTerm(quantity, axis, 1.0)
    for quantity in ("gravity", "angular_velocity", "command")
    for axis in AXES
)
JOINTS = tuple(ObservationTerm("position", name, 1.0) for name in DRIVER.joint_names[:2])


class Ear:
    """A policy that stands still and remembers what it observed."""

    def __init__(self, *terms: ObservationTerm) -> None:
        self.spec: PolicySpec = dataclasses.replace(feedback_spec(DRIVER), observation=terms)
        self.received: list[Observation] = []

    def reset(self) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> FloatArray:
        """Return nothing but zeros."""
        self.received.append(observation.copy())
        return np.zeros(12)


def state(orientation: FloatArray, angular_velocity: FloatArray, offset: float = 0.0) -> RobotState:
    """Return the default pose, each joint off by so much, on a base that turns."""
    body = BodyState(
        orientation=orientation,
        angular_velocity=angular_velocity,
        acceleration=np.array([0.0, 0.0, 9.81]),
        foot_force=np.zeros(4),
        temperature=np.full(12, 30.0),
        lost=np.zeros(12, dtype=np.int64),
        battery=0.9,
        voltage=30.0,
        current=1.0,
        sticks=np.zeros(4),
        buttons=0,
    )
    position = np.array(DRIVER.default_position) + offset
    return RobotState(position, np.zeros(12), np.zeros(12), 0, 0, 0, -1, -1, Status.ARMED, body)


def wxyz(turn: Rotation) -> FloatArray:
    """Return a rotation as the IMU reports it."""
    return np.asarray(turn.as_quat(scalar_first=True))


def test_gravity_turning_and_command_by_hand() -> None:
    """Rolled right by 30 degrees: gravity is down and to the right, (0, -1/2, -cos 30)."""
    ear = Ear(*SENSED, *JOINTS)
    behaviour = PolicyBehaviour(ear, DRIVER, FixedVelocity((0.3, -0.1, 0.2)))
    turn = Rotation.from_rotvec([np.pi / 6, 0, 0])
    command = behaviour.command(state(wxyz(turn), np.array([0.1, 0.2, 0.3]), 0.05), 0.0)
    half = np.sqrt(3) / 2
    np.testing.assert_allclose(
        ear.received[0], [0, -0.5, -half, 0.1, 0.2, 0.3, 0.3, -0.1, 0.2, 0.05, 0.05], atol=1e-6
    )
    np.testing.assert_array_equal(command.position_target, DRIVER.default_position)
    assert ear.received[0].dtype == np.float32


def test_a_command_beyond_the_training_is_clipped_to_it() -> None:
    """Trained for -0.2 to 0.5 m/s ahead: asked for -1, it gets -0.2; what lies inside passes."""
    ear = Ear(*SENSED)
    ear.spec = dataclasses.replace(ear.spec, command_range=((-0.2, 0.5), (-0.3, 0.3), (-1.0, 1.0)))
    behaviour = PolicyBehaviour(ear, DRIVER, FixedVelocity((-1.0, 0.1, 1.0)))
    behaviour.command(state(wxyz(Rotation.identity()), np.zeros(3)), 0.0)
    np.testing.assert_allclose(ear.received[0][-3:], [-0.2, 0.1, 1.0], atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), st.booleans())
def test_any_orientation_gives_gravity_as_scipy_has_it(values: list[float], negated: bool) -> None:
    """Both quaternions of a rotation are the same orientation; turning about the vertical changes nothing."""
    turn, gyro = Rotation.from_rotvec(values[:3]), np.array(values[3:])
    ear = Ear(*SENSED)
    behaviour = PolicyBehaviour(ear, DRIVER)
    quaternion = wxyz(turn)
    behaviour.command(state(-quaternion if negated else quaternion, gyro), 0.0)
    turned = Rotation.from_rotvec([0, 0, 1.0]) * turn
    behaviour.command(state(wxyz(turned), gyro), 0.02)
    wanted = [*turn.inv().apply([0, 0, -1.0]), *gyro, 0, 0, 0]
    np.testing.assert_allclose(ear.received, [wanted, wanted], atol=2e-6)


def test_on_the_robot_as_in_training() -> None:
    """The same builder, fed with a simulator's whole coordinates, gives the same observation."""
    terms = (*SENSED, *JOINTS, ObservationTerm("gravity", "y", 2.0, 1), ObservationTerm("heading", "x", 1.0))
    ear = Ear(*terms)
    behaviour = PolicyBehaviour(ear, DRIVER, FixedVelocity((0.5, 0.0, 0.0)))
    trained = ObservationBuilder(ear.spec)
    trained.command = np.array([0.5, 0.0, 0.0])
    rng = np.random.default_rng(3)
    for _ in range(3):
        turn, gyro = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)), rng.normal(size=3)
        behaviour.command(state(wxyz(turn), gyro, 0.1), 0.0)
        # A simulator also knows where the base is and how fast it moves along.
        x = np.concatenate([rng.normal(size=3), turn.as_rotvec(), np.array(DRIVER.default_position) + 0.1])
        v = np.concatenate([rng.normal(size=3), gyro, np.zeros(12)])
        np.testing.assert_allclose(ear.received[-1], trained.build(x, v), atol=1e-6)
        trained.record_action(np.zeros(12))


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (ObservationTerm("linear_velocity", "x", 1.0), "observes linear_velocity of the base"),
        (ObservationTerm("height", "z", 1.0), "observes height of the base"),
        (ObservationTerm("place", "x", 1.0), "observes place of the base"),
    ],
)
def test_what_no_sensor_reports_is_refused(term: ObservationTerm, words: str) -> None:
    """Before the robot is touched, not in the first cycle."""
    with pytest.raises(PolicyMismatchError, match=f"{words}, which no sensor of 'go2' reports"):
        PolicyBehaviour(Ear(*SENSED, term), DRIVER)


def test_states_without_a_body_are_an_error() -> None:
    """Zeros in its place would be an upright base, whatever the robot does."""
    bare = dataclasses.replace(state(np.array([1.0, 0, 0, 0]), np.zeros(3)), body=None)
    with pytest.raises(
        PolicyError, match="observes the base's orientation, which this robot's states do not"
    ):
        PolicyBehaviour(Ear(*SENSED), DRIVER).command(bare, 0.0)
    blind = Ear(*JOINTS)
    PolicyBehaviour(blind, DRIVER).command(bare, 0.0)
    np.testing.assert_array_equal(blind.received, [[0.0, 0.0]])
