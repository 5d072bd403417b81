"""What policies observe of a floating base."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION
from deal_hw.errors import ConfigurationError
from deal_hw.policy import (
    ObservationBuilder,
    ObservationTerm,
    PolicySpec,
    base_features,
)
from deal_hw.rotations import in_base_frame, rotation_between, rotation_vector

J = len(DESCRIPTION.joint_names)


def spec(*terms: ObservationTerm) -> PolicySpec:
    return PolicySpec.of_robot(DESCRIPTION, terms, (0.5,) * J)


coordinate = st.floats(-4.0, 4.0)


@given(st.lists(coordinate, min_size=6, max_size=6))
def test_vectors_turn_as_scipy_turns_them(values: list[float]) -> None:
    """Any rotation vector, zero and beyond half a turn included."""
    turn, vector = np.array(values[:3]), np.array(values[3:])
    wanted = Rotation.from_rotvec(turn).inv().apply(vector)
    np.testing.assert_allclose(in_base_frame(turn, vector), wanted, atol=1e-9)


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4), st.floats(0.999, 1.001))
def test_rotation_vectors_are_scipys(values: list[float], size: float) -> None:
    """Any orientation, both signs, half a turn included; a unit quaternion as a wire rounds it."""
    quaternion = np.array(values)
    norm = np.linalg.norm(quaternion)
    assume(norm > 1e-3)
    quaternion /= norm
    got = rotation_vector(size * quaternion)
    wanted = Rotation.from_quat(quaternion, scalar_first=True).as_rotvec()
    # At half a turn both directions are right: what they do to vectors is compared, too.
    assert np.linalg.norm(got) <= np.pi + 1e-9
    np.testing.assert_allclose(
        Rotation.from_rotvec(got).as_matrix(), Rotation.from_rotvec(wanted).as_matrix(), atol=1e-9
    )
    if np.linalg.norm(wanted) < 3.1:
        np.testing.assert_allclose(got, wanted, atol=1e-9)


def test_rotation_vectors_by_hand() -> None:
    """None, a quarter turn left, and a turn so small that its sine is lost in the cosine's rounding."""
    half = np.sqrt(0.5)
    np.testing.assert_array_equal(rotation_vector(np.array([1.0, 0, 0, 0])), np.zeros(3))
    np.testing.assert_array_equal(rotation_vector(np.array([-1.0, 0, 0, 0])), np.zeros(3))
    np.testing.assert_allclose(rotation_vector(np.array([half, 0, 0, half])), [0, 0, np.pi / 2])
    np.testing.assert_allclose(rotation_vector(np.array([-half, 0, 0, -half])), [0, 0, np.pi / 2])
    np.testing.assert_allclose(rotation_vector(np.array([1.0, 1e-12, 0, 0])), [2e-12, 0, 0])
    assert np.isnan(rotation_vector(np.full(4, np.nan))).all()


def test_features_by_hand() -> None:
    """Turned left by 90 degrees and moving along the world's y axis: ahead is where it moves."""
    position, velocity = np.zeros(6), np.zeros(6)
    position[2], position[5] = 0.3, np.pi / 2
    velocity[:] = 0.0, 2.0, 0.0, 0.1, 0.2, 0.3
    # Gravity is below; the world's x axis is to the right, at -y; angular velocity is the base's own already.
    wanted = [0, 0, -1, 0, -1, 0, 0.1, 0.2, 0.3, 2, 0, 0, 0.3]
    np.testing.assert_allclose(base_features(position, velocity), wanted, atol=1e-12)


def test_terms_of_the_base_are_picked_scaled_and_remembered() -> None:
    """Height now, gravity a tick ago, the command, and a joint that the base in front does not shift."""
    builder = ObservationBuilder(
        spec(
            ObservationTerm("height", "z", 2.0),
            ObservationTerm("gravity", "y", 1.0, 1),
            ObservationTerm("command", "x", 10.0),
            ObservationTerm("position", DESCRIPTION.joint_names[0], 1.0),
        )
    )
    builder.command = np.array([0.4, 0.0, 0.0])
    position, velocity = np.zeros(6 + J), np.zeros(6 + J)
    position[2], position[6:] = 0.3, DESCRIPTION.default_position
    position[6] += 0.05
    np.testing.assert_allclose(builder.build(position, velocity), [0.6, 0.0, 4.0, 0.05], rtol=1e-6)
    # Rolled by 30 degrees: gravity has -sin(30) along y, seen a tick later.
    rolled = position.copy()
    rolled[3] = np.pi / 6
    assert builder.build(rolled, velocity)[1] == 0.0
    assert builder.build(position, velocity)[1] == pytest.approx(-0.5)


def test_rotations_to_a_target_by_hand() -> None:
    """From a quarter turn left to a roll; none; and the shorter way round for turns of 3 and -3 rad."""
    quarter = np.pi / 2
    present = np.array([[0, 0, quarter], [0.1, 0.2, 0.3], [0, 0, 3.0]])
    wanted = np.array([[0, 0, -quarter / 2], [0.1, 0.2, 0.3], [0, 0, -3.0]])
    found = rotation_between(present, wanted)
    by_hand = np.array([[0.0, 0.0, -1.5 * quarter], [0.0] * 3, [0.0, 0.0, 2 * np.pi - 6]])
    np.testing.assert_allclose(found, by_hand, atol=1e-12)
    # In the world's frame: a base that heads along y rolls about the world's x axis.
    ahead_y = np.array([0.0, 0.0, quarter])
    rolled = Rotation.from_rotvec([0.2, 0, 0]) * Rotation.from_rotvec(ahead_y)
    np.testing.assert_allclose(rotation_between(ahead_y, rolled.as_rotvec()), [0.2, 0, 0], atol=1e-12)


def test_place_and_target_are_observed() -> None:
    """The place in the world, and the rotation that is left, a tick ago too."""
    builder = ObservationBuilder(
        spec(
            ObservationTerm("place", "y", 2.0),
            ObservationTerm("target_rotation", "z", 1.0),
            ObservationTerm("target_rotation", "z", 1.0, 1),
        )
    )
    builder.target = np.array([0.0, 0.0, 0.5])
    position = np.zeros(6 + J)
    position[1] = 0.1
    np.testing.assert_allclose(builder.build(position, position * 0), [0.2, 0.5, 0.5], rtol=1e-6)
    position[5] = 0.2
    np.testing.assert_allclose(builder.build(position, position * 0), [0.2, 0.3, 0.5], rtol=1e-6)


def test_terms_without_the_base_need_no_base() -> None:
    """Joint terms read the joints, whether the state comes with a base or not."""
    position = np.arange(6.0 + J)
    first, second = (
        ObservationBuilder(spec(ObservationTerm("position", "FL_hip_joint", 1.0))).build(x, x)
        for x in (position, position[6:])
    )
    np.testing.assert_array_equal(first, second)


def test_a_state_without_a_base_is_refused() -> None:
    """The message says how many coordinates are needed and were given."""
    builder = ObservationBuilder(spec(ObservationTerm("height", "z", 1.0)))
    with pytest.raises(ConfigurationError, match=r"'go2' observes the base and needs 6 \+ 12 .* got 12"):
        builder.build(np.zeros(J), np.zeros(J))


@pytest.mark.parametrize(
    ("quantity", "axis", "known"), [("gravity", "FL_hip_joint", "'x', 'y', 'z'"), ("height", "x", "'z'")]
)
def test_axes_that_are_not_there_are_refused(quantity: str, axis: str, known: str) -> None:
    """The message lists the axes of the quantity."""
    with pytest.raises(
        ConfigurationError, match=f"joint is '{axis}'; allowed: an axis of '{quantity}': {known}"
    ):
        spec(ObservationTerm(quantity, axis, 1.0))  # type: ignore[arg-type]


def test_terms_of_the_base_survive_json() -> None:
    """A spec that observes the base comes back from its text."""
    made = spec(ObservationTerm("gravity", "z", 1.0), ObservationTerm("command", "y", 0.5))
    assert PolicySpec.from_json(made.to_json()) == made
    assert made.observes_base
    assert not dataclasses.replace(made, observation=made.observation[1:]).observes_base
