"""Policy specs and observations: what fits a robot, and what a policy gets to see."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import ConfigurationError, PolicyError, PolicyMismatchError
from deal_hw.policy import ObservationBuilder, ObservationTerm, PolicySpec

SPEC = PolicySpec(
    robot="cartpole",
    joint_names=("cart", "pole"),
    actuated=("cart",),
    observation=(
        ObservationTerm("position", "cart", 2.0),
        ObservationTerm("sin_position", "pole", 1.0),
        ObservationTerm("velocity", "pole", 0.5, 1),
        ObservationTerm("action", "cart", 1.0, 1),
        ObservationTerm("action", "cart", 1.0, 2),
    ),
    action_scale=(0.25,),
    default_position=(0.0, 0.0),
    stiffness=(80.0,),
    damping=(8.0,),
    effort_limit=(4.0,),
    speed_limit=(1.0,),
    control_rate_hz=50.0,
)


def test_observation_by_hand() -> None:
    """Scales, sine, a velocity of one period ago and the last two actions, in the order of the spec."""
    builder = ObservationBuilder(SPEC)
    first = builder.build(np.array([0.1, np.pi / 6]), np.array([0.0, 2.0]))
    np.testing.assert_allclose(first, [0.2, 0.5, 1.0, 0.0, 0.0], rtol=1e-6)
    builder.record_action(np.array([0.7]))
    second = builder.build(np.array([0.2, 0.0]), np.array([0.0, 4.0]))
    np.testing.assert_allclose(second, [0.4, 0.0, 1.0, 0.7, 0.0], rtol=1e-6)
    builder.record_action(np.array([-0.3]))
    third = builder.build(np.array([0.2, 0.0]), np.array([0.0, 6.0]))
    np.testing.assert_allclose(third, [0.4, 0.0, 2.0, -0.3, 0.7], rtol=1e-6)
    builder.reset()
    again = builder.build(np.array([0.1, 0.0]), np.array([0.0, 8.0]))
    np.testing.assert_allclose(again, [0.2, 0.0, 4.0, 0.0, 0.0], rtol=1e-6)


def test_batch_builds_what_single_robots_build() -> None:
    """A batch of three, one of which is reset on the way, equals three builders of one."""
    rng = np.random.default_rng(0)
    batch, singles = ObservationBuilder(SPEC, (3,)), [ObservationBuilder(SPEC) for _ in range(3)]
    for tick in range(6):
        if tick == 3:
            batch.reset(np.array([False, True, False]))
            singles[1].reset()
        x, v, a = rng.normal(size=(3, 2)), rng.normal(size=(3, 2)), rng.uniform(-1, 1, (3, 1))
        together = batch.build(x, v)
        alone = np.stack([one.build(x[i], v[i]) for i, one in enumerate(singles)])
        np.testing.assert_array_equal(together, alone)
        batch.record_action(a)
        for i, one in enumerate(singles):
            one.record_action(a[i])


def test_spec_there_and_back() -> None:
    """A spec comes back from its text; other text is refused."""
    assert PolicySpec.from_json(SPEC.to_json()) == SPEC
    for text in ("", "[]", "{}", '{"robot": "x", "observation": 3}'):
        with pytest.raises(PolicyError, match="not a policy spec"):
            PolicySpec.from_json(text)


def test_fit_is_checked_field_by_field() -> None:
    """A fitting policy passes; every field that differs is named with both values."""
    SPEC.check_fits(DESCRIPTION)
    wrong = dataclasses.replace(SPEC, robot="go2", control_rate_hz=100.0, stiffness=(500.0,))
    with pytest.raises(PolicyMismatchError) as caught:
        wrong.check_fits(DESCRIPTION)
    words = str(caught.value)
    assert "'go2'" in words and "100.0" in words and "500.0" in words and "joint_names" not in words


def test_impossible_terms_are_refused() -> None:
    """A joint that is not there, and an action that has not been taken yet."""
    with pytest.raises(ConfigurationError, match="wheel"):
        dataclasses.replace(SPEC, observation=(ObservationTerm("position", "wheel", 1.0),))
    with pytest.raises(ConfigurationError, match="field delay is 0; allowed: 1 to 100 control periods"):
        dataclasses.replace(SPEC, observation=(ObservationTerm("action", "cart", 1.0, 0),))


def test_description_digest_changes_with_facts_not_with_sources() -> None:
    """A mended source leaves recordings and policies valid; a changed limit does not."""
    assert dataclasses.replace(DESCRIPTION, sources={}).digest() == DESCRIPTION.digest()
    assert dataclasses.replace(DESCRIPTION, stiffness=(81.0,)).digest() != DESCRIPTION.digest()
    with pytest.raises(ConfigurationError, match="stiffness has 2 entries, expected 1"):
        dataclasses.replace(DESCRIPTION, stiffness=(1.0, 2.0))
    with pytest.raises(ConfigurationError, match="wheel"):
        dataclasses.replace(DESCRIPTION, actuated=("wheel",))
