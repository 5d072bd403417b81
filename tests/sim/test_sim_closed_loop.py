"""The one closed loop: what is sent moves a set-point at its limit, and acts late."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import ClosedLoop, on_physics_steps, reported
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.laws.commands import CommandLaws
from deal_hw.sim.laws.setpoints import delay, slew
from deal_hw.types import FloatArray

PERIODS, STEPS = 4, 5
ROBOT, SPACE = load_model(DESCRIPTION), k9_space()


class Sent:
    """A batch that keeps the set-points it is given and moves nothing."""

    def __init__(self, count: int) -> None:
        self._batch = ServoBatch(ROBOT, SPACE, count, threads=1)
        self.robot, self.count, self.lag_s = ROBOT, count, self._batch.lag_s
        self.commands = CommandLaws()
        self.path: list[FloatArray] = []

    def advance(self, setpoint: FloatArray, every: int = 0) -> tuple[FloatArray, FloatArray]:
        self.path.append(setpoint)
        return setpoint, setpoint


numbers = st.floats(-0.4, 0.4)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(numbers, st.lists(numbers, min_size=PERIODS, max_size=PERIODS), st.floats(0, 0.02)),
        min_size=1,
        max_size=3,
    ),
    st.floats(1e-4, 0.2),
    st.booleans(),
)
def test_setpoints_are_those_of_the_whole_path_slewed_and_then_delayed(
    members: list[tuple[float, list[float], float]], rate: float, whole: bool
) -> None:
    """Period by period the same as all at once: slew all targets, then delay the path."""
    count = len(members)
    start, latency = np.array([[m[0]] for m in members]), np.array([m[2] for m in members])
    targets = np.array([m[1] for m in members])[:, :, None]
    sent = Sent(count)
    loop = ClosedLoop(sent, STEPS, whole=whole)  # type: ignore[arg-type]
    loop.restart(start, latency)
    for period in range(PERIODS):
        loop.advance(targets[:, period], np.full((count, 1), rate))
    path = slew(start, np.repeat(targets, STEPS, axis=1), np.full((count, 1), rate))
    lag = latency / ROBOT.step_s
    late = delay(path, np.rint(lag) if whole else lag, start)
    np.testing.assert_allclose(np.concatenate(sent.path, axis=1), late, atol=1e-12)


def test_play_goes_on_from_period_to_period() -> None:
    """A play of 0.4 around targets of 1 and then 0.9: 0.8 comes out of the first, and stays."""
    sent = Sent(1)
    sent.commands = CommandLaws(play=np.full((1, 1), 0.4))
    loop = ClosedLoop(sent, STEPS, whole=True)  # type: ignore[arg-type]
    loop.restart(np.zeros((1, 1)), np.zeros(1))
    for target in (1.0, 0.9, 0.5):
        loop.advance(np.full((1, 1), target))
    path = np.concatenate(sent.path, axis=1)[0, ::STEPS, 0]
    np.testing.assert_allclose(path, [0.8, 0.8, 0.7])


def test_a_member_starts_anew_with_its_own_latency_and_leaves_the_others_alone() -> None:
    """One target of 1 from rest: it acts after 3 steps on one; the other starts anew at 0.5 and 8 steps."""
    sent = Sent(2)
    loop = ClosedLoop(sent, STEPS, whole=True)  # type: ignore[arg-type]
    loop.restart(np.zeros((2, 1)), np.full(2, 3 * ROBOT.step_s))
    loop.advance(np.ones((2, 1)))
    loop.restart(np.full((1, 1), 0.5), np.array([8 * ROBOT.step_s]), np.array([1]))
    for _ in range(2):
        loop.advance(np.ones((2, 1)))
    path = np.concatenate(sent.path, axis=1)[..., 0]
    assert path[0].tolist() == [0] * 3 + [1] * 12
    assert path[1].tolist() == [0] * 3 + [1] * 2 + [0.5] * 8 + [1] * 2


@pytest.mark.parametrize(
    ("step_s", "expected"), [(2e-3, [1, 1, 2, 2, 3, 3]), (1e-3, [1, 2, 3]), (5e-4, [1, 3])]
)
def test_setpoints_meet_physics_steps(step_s: float, expected: list[float]) -> None:
    """A physics step of 1 ms is half a period of 2 ms, one of 1 ms, or two of 0.5 ms."""
    path = np.array([[[1.0], [2.0], [3.0]]])
    assert on_physics_steps(Sent(1), path, step_s)[0, :, 0].tolist() == expected  # type: ignore[arg-type]


def test_an_encoder_rounds_where_it_has_steps() -> None:
    """Without noise 0.26 is 0.3 in steps of 0.1, and itself without; noise is drawn in the joints' order."""
    still = np.random.default_rng(0)
    assert reported(np.array([0.26, 0.26]), (0.0, 0.0), (0.1, 0.0), still).tolist() == [
        pytest.approx(0.3),
        0.26,
    ]
    drawn = np.random.default_rng(1).standard_normal(2)
    seen = reported(np.zeros(2), (1.0, 2.0), (), np.random.default_rng(1))
    np.testing.assert_array_equal(seen, drawn * [1, 2])
