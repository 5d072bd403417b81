"""What a servo's firmware makes of its error: by hand, beside a loop of mj_step, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.law_robots import GEARED, MOTOR, SERVO, batch, known, robot, swing

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.laws.servo import ServoLaw
from deal_hw.sim.parameters import check_space
from deal_hw.types import FloatArray

COUNT_RAD = 2 * math.pi / 4096


def law(**parts: float) -> ServoLaw:
    """Return the law of one servo; neutral in the parts that are not given."""
    every = {"resolution": 0.0, "dead_zone": 0.0, "punch": 0.0, "scale": 1.0, "bias": 0.0} | parts
    return ServoLaw(**{name: np.array([[value]]) for name, value in every.items()})


def acting(of: ServoLaw, goal: float, position: float, stiffness: float = 20.0) -> float:
    """Return the acting error of one servo."""
    found = of.acting_error(*(np.array([[x]]) for x in (goal, position, stiffness)))
    return float(found[0, 0])


def test_acting_errors_by_hand() -> None:
    """Dead zone 0.02 rad, punch 0.4 N·m at 20 N·m/rad: 0.02 rad more than what exceeds the zone."""
    of = law(dead_zone=0.02, punch=0.4)
    assert acting(of, 0.10, 0.0) == pytest.approx(0.08 + 0.02)
    assert acting(of, -0.10, 0.0) == pytest.approx(-0.08 - 0.02)
    assert acting(of, 0.315, 0.3) == 0.0
    # A punch of gain times dead zone: the whole error, or none.
    assert acting(law(dead_zone=0.02, punch=0.4), 0.0, 0.05) == pytest.approx(-0.05)


def test_goal_and_reading_are_counted() -> None:
    """Counts of 0.1: 0.26 and 0.14 are 3 and 1; with scale 2 and bias 0.03, 0.55 and 0.31 are 6 and 3."""
    assert acting(law(resolution=0.1), 0.26, 0.14) == pytest.approx(0.2)
    assert acting(law(resolution=0.1, scale=2.0, bias=0.03), 0.26, 0.14) == pytest.approx(0.3 / 2)


def test_an_error_of_as_many_counts_as_the_dead_zone_has_no_effort() -> None:
    """At every place of the turn, whatever rounding makes of their difference."""
    of = law(resolution=COUNT_RAD, dead_zone=COUNT_RAD, punch=0.1)
    for count in range(-2048, 2048, 7):
        at = count * COUNT_RAD
        assert acting(of, at + COUNT_RAD, at) == 0.0 == acting(of, at - COUNT_RAD, at)
        assert acting(of, at + 2 * COUNT_RAD, at) == pytest.approx(COUNT_RAD + 0.1 / 20)


KINDS = [
    {"servo_dead_zone": 0.03},
    {"servo_punch": 0.15},
    {"servo_resolution": 8 * COUNT_RAD},
    {"servo_dead_zone": 0.02, "servo_punch": 0.2, "servo_resolution": COUNT_RAD},
    {"servo_dead_zone": 0.02, "servo_punch": 0.2, "encoder_scale": 1.2, "encoder_bias": 0.05},
]


@pytest.mark.parametrize("kinds", KINDS, ids="+".join)
def test_a_batch_equals_a_loop_of_mj_step_with_the_law(tmp_path: Path, kinds: dict[str, float]) -> None:
    """The loop has no actuator: it applies the efforts. The goal goes beyond the servo's range."""
    model, steps = robot(tmp_path, GEARED), 500
    members = batch(model, *(known(kind, "shoulder", value) for kind, value in kinds.items()), count=2)
    path = 1.2 * swing(steps, 1)
    scale, bias = kinds.get("encoder_scale", 1.0), kinds.get("encoder_bias", 0.0)
    members.set_state(np.array([0.2 * scale + bias]), np.zeros(1))
    found, _ = members.advance(np.repeat(path, 2, axis=0), every=1)
    expected = moved(path[0, :, 0], kinds)
    np.testing.assert_allclose(found[0, :, 0], scale * expected + bias, atol=1e-9)
    np.testing.assert_array_equal(found[0], found[1])
    plain = batch(model)
    plain.set_state(np.array([0.2]), np.zeros(1))
    assert np.abs(plain.advance(path, every=1)[0][0, :, 0] - expected).max() > 1e-3


def moved(goal: FloatArray, kinds: dict[str, float]) -> FloatArray:
    """Return true positions, (S,), under the effort of the law: 24 N·m/rad, at most 3 N·m."""
    m = mujoco.MjModel.from_xml_string(GEARED)
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    d = mujoco.MjData(m)
    d.qpos[0] = 0.2
    scale, bias = kinds.get("encoder_scale", 1.0), kinds.get("encoder_bias", 0.0)
    zone, count = kinds.get("servo_dead_zone", 0.0), kinds.get("servo_resolution", 0.0)
    found = np.empty(len(goal))
    for step, sent in enumerate(goal):
        # The set-point of the joint is -1/4 of ctrl, so ctrl's range from -1 to 0.8 is one from -0.2 to 0.25.
        inside = min(max((sent - bias) / scale, -0.2), 0.25)
        want, read = scale * inside + bias, scale * d.qpos[0] + bias
        if count:
            error = (round(want / count) - round(read / count)) * count
        else:
            error = want - read
        effort = 0.0
        if abs(error) > zone:
            # The model's 24 N·m/rad act on the reading, so the true position has the scale times as many.
            effort = 24 * (abs(error) - zone) + kinds.get("servo_punch", 0.0)
        # The constant effort of the file, -2 * 0.1 N·m at the joint, counts towards the limit, too.
        d.qfrc_applied[0] = min(max(math.copysign(effort, error) - 0.2, -3.0), 3.0)
        mujoco.mj_step(m, d)
        found[step] = d.qpos[0]
    return found


def test_a_punch_stays_when_the_host_sends_another_gain(tmp_path: Path) -> None:
    """An error of 0.1 rad behind a zone of 0.05: 0.2 N·m and 0.05 times the gain, 24 or 12 N·m/rad."""
    members = batch(
        robot(tmp_path, GEARED),
        known("servo_dead_zone", "shoulder", 0.05),
        known("servo_punch", "shoulder", 0.2),
    )
    effort = members.batch.bind("qfrc_actuator")
    for stiffness in (24.0, 12.0):
        members.set_sent(np.array([stiffness]), np.zeros(1), np.array([3.0]))
        members.set_state(np.zeros(1), np.zeros(1))
        members.advance(np.full((1, 1, 1), 0.1), every=1)
        assert effort[0, 0] == pytest.approx(0.2 + 0.05 * stiffness - 0.2)


def test_firmware_ends_with_the_parameters_that_set_it(tmp_path: Path) -> None:
    """New values start from the model's own constant effort; a window does not depend on the one before."""
    model = robot(tmp_path, GEARED)
    members = batch(model, known("servo_punch", "shoulder", 0.2), known("dof_friction_load", "shoulder", 0.1))
    runs = []
    for _ in range(2):
        members.set_parameters(np.array([[0.3]]))
        members.set_state(np.zeros(1), np.zeros(1))
        runs.append(members.advance(swing(150, 1), every=5)[0])
    np.testing.assert_array_equal(runs[0], runs[1])


def searched(kind: str, element: str, low: float, high: float) -> ParameterSpace:
    """Return a space with one parameter that is searched."""
    parameter = Parameter(
        name="p", kind=kind, elements=(element,), unit="rad", nominal=high / 2, low=low, high=high,
        scale="linear",
    )  # fmt: skip
    return ParameterSpace([parameter])


@pytest.mark.parametrize(
    ("text", "space", "message"),
    [
        (
            MOTOR,
            searched("servo_dead_zone", "wheel", 0, 0.1),
            "'wheel' is no position servo.*command_dead_zone",
        ),
        (SERVO, searched("servo_dead_zone", "elbow", -0.1, 0.1), r"range \[-0.1, 0.1\].*\[0, inf\]; narrow"),
        (SERVO, searched("servo_punch", "elbow", -1, 1), "exceeds what servo_punch allows"),
        (
            SERVO,
            searched("servo_resolution", "elbow", 0.001, 0.01),
            "no search can find their size; give.*known",
        ),
        (
            SERVO.replace("implicitfast", "RK4"),
            searched("servo_punch", "elbow", 0, 1),
            "integrator RK4 changes the effort.*one of Euler, implicit, implicitfast",
        ),
    ],
    ids=["motor", "negative zone", "negative punch", "searched counts", "RK4"],
)
def test_what_cannot_be_is_refused(tmp_path: Path, text: str, space: ParameterSpace, message: str) -> None:
    """With what is allowed, and what to do."""
    with pytest.raises(ConfigurationError, match=message):
        check_space(robot(tmp_path, text).model, space)
