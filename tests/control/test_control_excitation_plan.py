"""Excitation plans: inside the safety limits whatever the design, continuous, and only for their robot."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.so101.description import DESCRIPTION as ARM
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.motions.behaviours import HoldBehaviour, centre
from deal_hw.motions.excitation.limits import fit_to_limits, predicted_effort, room
from deal_hw.motions.excitation.plan import (
    FAMILIES,
    ExcitationBehaviour,
    ExcitationDesign,
    ExcitationPlan,
    make_plan,
    read_plan,
)
from deal_hw.motions.excitation.waveforms import Tones
from deal_hw.types import FloatArray, RobotState, Status

DESIGNS = st.builds(
    ExcitationDesign,
    family=st.sampled_from(FAMILIES),
    seconds=st.floats(6.0, 12.0),
    amplitude=st.floats(0.05, 1.0),
    low_hz=st.floats(0.1, 1.0),
    high_hz=st.floats(3.0, 10.0),
    tilt=st.floats(0.0, 1.0),
    law=st.sampled_from(("linear", "log")),
    arrangement=st.sampled_from(("one-by-one", "staggered")),
    balance_s=st.sampled_from((0.0, 0.6)),
    split=st.floats(0.1, 1.0),
    effort=st.tuples(st.floats(0.1, 1.0), st.floats(0.1, 1.0)),
    seed=st.integers(0, 10**6),
)


def state(position: FloatArray) -> RobotState:
    """Return a state at rest."""
    zeros = np.zeros_like(position)
    return RobotState(position, zeros, zeros, 0, 0, 0, -1, -1, Status.ARMED)


@given(design=DESIGNS, robot=st.sampled_from((DESCRIPTION, ARM)))
@settings(max_examples=25, deadline=None)
def test_no_design_is_clipped_where_the_robot_follows(
    design: ExcitationDesign, robot: RobotDescription
) -> None:
    """The safety filter has nothing to clip, run on a robot that follows like its gains say."""
    plan = make_plan(robot, design)
    hold = HoldBehaviour(robot)
    behaviour = ExcitationBehaviour(plan, robot, hold if design.balance_s else None)
    gate = SafetyFilter(robot)
    index = list(robot.actuated_index)
    position = np.array(robot.default_position)
    previous, lag = position[index], np.array(robot.stiffness) / np.maximum(robot.damping, 1e-3)
    for k in range(round(plan.seconds * robot.control_rate_hz)):
        wanted = behaviour.command(state(position), k / robot.control_rate_hz)
        sent, clipped = gate.clip(wanted, previous, position[index], np.zeros(len(index)))
        assert clipped == ()
        previous = sent.position_target
        follow = -np.expm1(-lag / robot.control_rate_hz)
        position[index] += follow * (previous - position[index])


@given(design=DESIGNS)
@settings(max_examples=30, deadline=None)
def test_amplitude_is_a_share_of_the_largest(design: ExcitationDesign) -> None:
    """Half the share, half the signal; the largest signal stays in the room there is."""
    whole = make_plan(ARM, dataclasses.replace(design, amplitude=1.0))
    half = make_plan(ARM, dataclasses.replace(design, amplitude=0.5))
    t = np.arange(design.balance_s, design.seconds, 0.02)
    np.testing.assert_allclose(half.offsets(t), 0.5 * whole.offsets(t), atol=1e-12)
    assert np.all(np.abs(whole.offsets(t)) <= room(ARM) + 1e-12)


@pytest.mark.parametrize("family", FAMILIES)
def test_plan_survives_its_file(family: str, tmp_path: Path) -> None:
    """What is read is what was written."""
    design = ExcitationDesign(family=family, effort=(1.0, 0.2), speed=(1.0, 2.0), seed=4)  # type: ignore[arg-type]
    plan = dataclasses.replace(make_plan(DESCRIPTION, design), predicted={"cart.mass": 0.004})
    plan.write(tmp_path / "deep" / "plan.json")
    assert read_plan(tmp_path / "deep" / "plan.json") == plan
    assert "0.2 times the effort limit and 2 times the speed limit from 50% to 100%" in plan.words


def test_first_sample_is_continuous_and_the_last_fades() -> None:
    """From the balancing's last set-point of 0.1 m the target moves on by less than 10 mm a command."""
    plan = make_plan(DESCRIPTION, ExcitationDesign(balance_s=0.6, seconds=4.0))
    behaviour = ExcitationBehaviour(plan, DESCRIPTION, HoldBehaviour(DESCRIPTION, np.array([0.1])))
    asked = [behaviour.command(state(np.zeros(2)), k / 50).position_target[0] for k in range(201)]
    assert asked[:30] == [0.1] * 30
    assert asked[30] == pytest.approx(0.1, abs=1e-9)
    assert abs(asked[31] - asked[30]) < 0.01
    assert asked[200] == pytest.approx(0.0, abs=1e-9)
    behaviour.reset()
    assert behaviour.command(state(np.zeros(2)), 0.0).position_target[0] == 0.1


def test_limits_of_the_segment_are_sent() -> None:
    """4 N and 1 m/s at first, 0.15 x 4 N and 2.5 x 1 m/s in the second half."""
    plan = make_plan(DESCRIPTION, ExcitationDesign(effort=(1.0, 0.15), speed=(1.0, 2.5)))
    behaviour = ExcitationBehaviour(plan, DESCRIPTION)
    first, second = (behaviour.command(state(np.zeros(2)), t) for t in (1.98, 2.0))
    assert (first.effort_limit[0], first.speed_limit[0]) == (4.0, 1.0)
    assert (second.effort_limit[0], second.speed_limit[0]) == pytest.approx((0.6, 2.5))


def test_predicted_effort_by_hand() -> None:
    """Kp 80 N/m, kd 8 N s/m: corner 10 1/s. A step of 0.1 m asks for 8 N, 20 ms later exp(-0.2) of it."""
    found = predicted_effort(DESCRIPTION, np.full((3, 1), 0.1))
    np.testing.assert_allclose(found[:, 0], 8.0 * np.exp([0.0, -0.2, -0.4]))


def test_effort_scales_a_signal_down() -> None:
    """A jump to 0.2 m would ask for 16 N; 8 N may be sent: half. Steps are not scaled for effort."""
    jump = np.full((5, 1), 0.2)
    assert fit_to_limits(DESCRIPTION, jump, smooth=True)[0] <= 0.5
    assert fit_to_limits(DESCRIPTION, jump, smooth=False)[0] == 1.0
    assert centre(DESCRIPTION)[0] == 0.0


def test_plan_for_another_robot_is_refused(tmp_path: Path) -> None:
    """By name, and by the description's digest; and a behaviour that should balance needs a policy."""
    plan = make_plan(DESCRIPTION, ExcitationDesign(balance_s=0.5))
    with pytest.raises(ConfigurationError, match=r"made for robot 'cartpole'.*'so101'"):
        ExcitationBehaviour(plan, ARM)
    other = dataclasses.replace(DESCRIPTION, stiffness=(81.0,))
    with pytest.raises(ConfigurationError, match="make a new one with `deal-hw design-excitation`"):
        ExcitationBehaviour(plan, other)
    with pytest.raises(ConfigurationError, match="there is no policy"):
        ExcitationBehaviour(plan, DESCRIPTION)


@pytest.mark.parametrize(
    "changes",
    [
        {"amplitude": 0.0},
        {"amplitude": 1.1},
        {"balance_s": 4.0},
        {"split": 0.0},
        {"effort": (1.0, 2.1)},
        {"speed": (3.1, 1.0)},
        {"effort": (0.0, 1.0)},
    ],
)
def test_designs_outside_the_limits_are_refused(changes: dict[str, object]) -> None:
    """8 N and 3 m/s may be sent, twice and thrice the defaults."""
    with pytest.raises(ConfigurationError):
        make_plan(DESCRIPTION, ExcitationDesign(**changes))  # type: ignore[arg-type]


def test_unknown_family_and_broken_files_are_refused(tmp_path: Path) -> None:
    """The message says what there is, or what is wrong with the file."""
    with pytest.raises(UnknownNameError, match=r"square.*multisine"):
        ExcitationDesign(family="square")  # type: ignore[arg-type]
    file = tmp_path / "plan.json"
    with pytest.raises(ConfigurationError, match="multisine, chirp, or a file"):
        read_plan(file)
    good = make_plan(DESCRIPTION, ExcitationDesign()).to_json()
    for broken, words in (
        ("[1]", "should be an object"),
        ("{", "a file that `deal-hw design-excitation`"),
        (json.dumps({**good, "format": "x"}), "format is 'x'"),
        (json.dumps({k: v for k, v in good.items() if k != "wave"}), "field wave is missing"),
        (json.dumps({**good, "segments": [{"start": 1.0, "stop": 0.0}]}), "segment"),
        (
            json.dumps({**good, "segments": [{"start": 0.0, "stop": 1.0, "damping": math.inf}]}),
            "finite number",
        ),
        (json.dumps({**good, "robot": ["cartpole"]}), "field robot is"),
        (json.dumps({**good, "seconds": math.nan}), "field seconds is nan"),
        (
            json.dumps({**good, "wave": {**good["wave"], "amplitude": [[[1.0]]]}}),
            "field wave.tones.amplitude",
        ),
        (
            json.dumps({**good, "wave": {"wave": "steps", "begin_s": [0, 1], "value": [[1], []]}}),
            "as many values",
        ),
        ("[" * 100_000, "recursion limit"),
    ):
        file.write_text(broken)
        with pytest.raises(ConfigurationError, match=words.replace("[", r"\[")):
            read_plan(file)
    assert ExcitationPlan.from_json(good).words.startswith("4 s of a multisine")


@pytest.mark.parametrize(("joints", "size"), [(1, 1e308), (2, 1.0)])
def test_a_signal_that_cannot_be_played_is_refused(joints: int, size: float) -> None:
    """One that overflows, and one for more joints than the robot has, never start."""
    good = make_plan(DESCRIPTION, ExcitationDesign())
    wave = Tones(
        frequency_hz=((1.0, 1.1),) * joints, amplitude=((size, size),) * joints, phase=((1.5, 1.5),) * joints
    )
    with pytest.raises(ConfigurationError, match=f"has offsets for {joints} joints"):
        dataclasses.replace(good, wave=wave).check_fits(DESCRIPTION)


def test_a_robot_without_room_is_refused() -> None:
    """The default pose at the end of the target range leaves nothing to move in."""
    limits = dataclasses.replace(DESCRIPTION.limits, target=((0.0, 0.25),))
    with pytest.raises(ConfigurationError, match="no joint of 'cartpole' has room"):
        make_plan(dataclasses.replace(DESCRIPTION, limits=limits), ExcitationDesign())
