"""Elastic transmissions: by hand, beside two bodies with a tendon, stiff springs, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.law_robots import GEARED, MOTOR, SERVO, batch, known, robot, swing
from fakes.sprung_loop import (
    LINK,
    PENDULUM,
    POSITION,
    ROTOR,
    TORQUE,
    TWO_BODIES,
    SprungLoop,
    coupled,
    plate,
    transmission_law,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import ClosedLoop
from deal_hw.sim.engine.warp_support import choose_engine
from deal_hw.sim.parameters import check_space
from deal_hw.types import FloatArray


def test_a_soft_spring_by_hand() -> None:
    """100 N·m/rad, bent by 0.03 rad: 3 N·m; the rotor, 1 rad/s, loses 3 N·m and gains 2 N·m for 1 ms."""
    speed = 1.0 + (2.0 - 3.0) * 0.001 / 0.02
    assert coupled(transmission_law(), 0.03, 1.0, 0.5, 2.0, 0.0) == pytest.approx([3.0, 0.0, speed, 0.0])


def test_a_damper_by_hand() -> None:
    """0.5 N·m·s/rad, half of it at the end: the rotor, 0.02 kg·m² in 1 ms, is 20, so 0.25/20.25 follow."""
    torque, inertia, speed, follows = coupled(transmission_law(damping=0.5), 0.03, 1.0, 0.5, 2.0, 0.0)
    assert follows == pytest.approx(0.25 / 20.25)
    # The spring's 3 N·m and half of the damper's 0.5 (1 - 0.5) N·m are those at the beginning.
    push = 3.0 + 0.25 * (1.0 - 0.5)
    assert speed == pytest.approx((20.0 + 2.0 - push) / 20.25)
    assert torque == pytest.approx(push + 0.25 * (speed + follows * 0.5 - 0.5))
    assert inertia == pytest.approx(0.001 * 0.25 * 20 / 20.25)


def test_a_motors_resistance_by_hand() -> None:
    """4 N·m·s/rad, half of it at the end: 22 w' = 18 w + 2 N·m less the spring's 3 N·m."""
    speed = (18.0 * 1.0 + 2.0 - 3.0) / 22.0
    assert coupled(transmission_law(), 0.03, 1.0, 0.5, 2.0, 4.0) == pytest.approx([3.0, 0.0, speed, 0.0])


def test_a_strong_damper_does_not_ring() -> None:
    """200 N·m·s/rad on a rotor of 20: a tenth counts at the beginning, and it stops in one step."""
    assert coupled(transmission_law(), 0.0, 1.0, 0.0, 0.0, 200.0) == pytest.approx([0.0, 0.0, 0.0, 0.0])


def test_a_stiff_servo_at_the_motor_by_hand() -> None:
    """4e4 N·m/rad on 0.02 kg·m²: twice what 1 ms bears, so half a step of it, 20 N·m·s/rad, is at the end."""
    speed = (20.0 * 1.0 + 2.0 - 3.0) / (20.0 + 4e4 * 0.001 / 2)
    assert coupled(transmission_law(), 0.03, 1.0, 0.5, 2.0, 0.0, stiffness=4e4) == pytest.approx(
        [3.0, 0.0, speed, 0.0]
    )


def test_a_stiff_spring_adds_the_rotor_to_the_link() -> None:
    """1e9 N·m/rad: the link has 0.02 kg·m² more, and 1 ms of the motor's 3 N·m·s/rad."""
    torque, inertia, speed, follows = coupled(transmission_law(stiffness=1e9), 0.0, 0.5, 0.5, 2.0, 3.0)
    assert inertia == pytest.approx(0.02 + 0.003, rel=1e-4)
    assert torque == pytest.approx(2.0 - 3.0 * 0.5, rel=1e-4)
    assert [speed, follows] == pytest.approx([0.0, 1.0], abs=1e-4)


def test_a_gap_by_hand() -> None:
    """A gap of 0.04 rad: nothing at 0.019 rad, 100 N·m/rad beyond 0.02 rad to either side."""
    of = transmission_law(play=0.04)
    assert coupled(of, 0.019, 1.0, 0.0, 2.0, 0.0) == pytest.approx([0.0, 0.0, 1.1, 0.0])
    assert coupled(of, 0.05, 0.0, 0.0, 0.0, 0.0)[0] == pytest.approx(3.0)
    assert coupled(of, -0.05, 0.0, 0.0, 0.0, 0.0)[0] == pytest.approx(-3.0)
    assert of.deflection(np.array([[-3.0]]))[0, 0] == pytest.approx(-0.05)


@pytest.mark.parametrize("play", [0.0, 0.05])
def test_deflection_at_rest_is_torque_over_stiffness(play: float) -> None:
    """A pendulum of 0.4 kg, 0.15 m, held by 0.3 N·m at 20 N·m/rad: 0.015 rad, and half of the gap."""
    loop = SprungLoop(PENDULUM.format(actuator=TORQUE), stiffness=20.0, damping=0.1, play=play)
    for _ in range(5000):
        loop.step(0.3)
    link = float(loop.data.qpos[0])
    assert math.sin(link) == pytest.approx(0.3 / (0.4 * 9.81 * 0.15), rel=1e-4)
    assert loop.rotor.angle[0, 0] - link == pytest.approx(0.3 / 20 + play / 2, rel=1e-4)


@pytest.mark.parametrize("integrator", ["Euler", "implicit", "implicitfast"])
@pytest.mark.parametrize("stiffness", [10.0, 100.0, 700.0])
def test_frequency_of_a_free_oscillation(integrator: str, stiffness: float) -> None:
    """Root of k (1/J + 1/Jl) to 2 %, up to 51 Hz at 2 ms; nothing damps it, and momentum stays 0."""
    loop = plate(stiffness, integrator=integrator)
    loop.data.qvel[0] = 1.0
    loop.begin().speed[:] = -LINK / ROTOR
    speed = np.empty(4000)
    for step in range(len(speed)):
        loop.step(0.0)
        speed[step] = loop.data.qvel[0]
    turns = np.flatnonzero(np.diff(np.sign(speed)))
    period = 2 * 0.002 * (turns[-1] - turns[0]) / (len(turns) - 1)
    assert 2 * math.pi / period == pytest.approx(math.sqrt(stiffness * (1 / ROTOR + 1 / LINK)), rel=0.02)
    assert np.abs(speed[-500:]).max() == pytest.approx(1.0, rel=0.06)
    assert LINK * speed[-1] + ROTOR * loop.rotor.speed[0, 0] == pytest.approx(0.0, abs=1e-12)


def test_a_gap_passes_no_torque() -> None:
    """The motor turns from one end of the gap towards the other: the link stays, to the last bit."""
    loop = plate(1e4, play=0.1)
    # Without a torque it begins in the middle.
    loop.begin()
    for step in range(30):
        loop.step(0.4 if step < 15 else -0.4)
        assert loop.data.qpos[0] == 0.0 == loop.data.qvel[0] == loop.data.qfrc_actuator[0]
    # 0.4 N·m on 0.02 kg·m² are 20 rad/s², for 15 steps forth and 15 back.
    assert loop.rotor.angle[0, 0] == pytest.approx(15**2 * 0.002**2 * 20, rel=1e-9)


@settings(max_examples=30, deadline=None)
@given(
    stiffness=st.floats(1.0, 1e5),
    step=st.sampled_from([0.002, 0.005]),
    integrator=st.sampled_from(["Euler", "implicit", "implicitfast"]),
    damping=st.sampled_from([0.0, 0.01, 1.0, 100.0]),
    play=st.sampled_from([0.0, 0.002, 0.05]),
)
def test_no_spring_blows_up(
    stiffness: float, step: float, integrator: str, damping: float, play: float
) -> None:
    """Bodies that hit each other at 3 rad/s never move much faster than that, and momentum stays."""
    loop = plate(stiffness, step, integrator, damping=damping, play=play)
    loop.data.qvel[0] = 1.0
    loop.begin().speed[:] = -2.0
    momentum = LINK * 1.0 - ROTOR * 2.0
    for _ in range(300):
        loop.step(0.0)
        assert abs(loop.data.qvel[0] - loop.rotor.speed[0, 0]) < 1.5 * 3.0
    total = LINK * loop.data.qvel[0] + ROTOR * loop.rotor.speed[0, 0]
    assert total == pytest.approx(momentum, abs=1e-9)


@pytest.mark.parametrize(
    ("stiffness", "damping", "play", "tolerance"),
    [(20.0, 0.05, 0.0, 0.004), (200.0, 0.2, 0.0, 0.004), (200.0, 0.0, 0.03, 0.004), (1e4, 1.0, 0.0, 0.004)],
)
def test_motion_is_that_of_two_bodies(
    stiffness: float, damping: float, play: float, tolerance: float
) -> None:
    """MuJoCo's own rotor, link and tendon at 0.1 ms, under the same torques, within a share of the motion."""
    loop = SprungLoop(PENDULUM.format(actuator=TORQUE), stiffness=stiffness, damping=damping, play=play)
    ends = {"low": -play / 2, "high": play / 2}
    model = mujoco.MjModel.from_xml_string(TWO_BODIES.format(stiffness=stiffness, damping=damping, **ends))
    data = mujoco.MjData(model)
    found, expected = np.empty((2, 1000)), np.empty((2, 1000))
    loop.begin()
    for step in range(1000):
        torque = 0.5 * math.sin(2 * math.pi * 0.9 * 0.002 * step) + 0.1
        loop.step(torque)
        data.ctrl[0] = torque
        mujoco.mj_step(model, data, 20)
        found[:, step] = loop.data.qpos[0], loop.rotor.angle[0, 0]
        expected[:, step] = data.qpos
    assert np.all(np.abs(found - expected).max(axis=1) < tolerance * np.ptp(expected, axis=1))


@pytest.mark.parametrize("at_motor", [False, True], ids=["link", "motor"])
@pytest.mark.parametrize("limit", [10.0, 0.7])
def test_a_servo_reads_its_encoder_and_is_damped_at_the_motor(limit: float, at_motor: bool) -> None:
    """Two bodies: 15 N·m/rad of the error, 0.6 N·m·s/rad of the motor's speed, then the limit."""
    text = POSITION.format(kp=15).replace("-2 2", f"-{limit} {limit}")
    loop = SprungLoop(PENDULUM.format(actuator=text), at_motor=at_motor, stiffness=60.0, damping=0.05)
    model = mujoco.MjModel.from_xml_string(TWO_BODIES.format(stiffness=60, damping=0.05, low=0, high=0))
    data = mujoco.MjData(model)
    found, expected = np.empty((2, 800)), np.empty((2, 800))
    for step in range(800):
        goal = 0.5 * math.sin(2 * math.pi * 1.2 * 0.002 * step)
        loop.step(goal)
        for _ in range(20):
            torque = 15 * (goal - data.qpos[int(at_motor)]) - 0.6 * data.qvel[1]
            data.ctrl[0] = min(max(torque, -limit), limit)
            mujoco.mj_step(model, data)
        found[:, step] = loop.data.qpos[0], loop.rotor.angle[0, 0]
        expected[:, step] = data.qpos
    np.testing.assert_allclose(found, expected, atol=0.01 * np.ptp(expected))
    assert np.ptp(expected[1] - expected[0]) > 0.01


@settings(max_examples=30, deadline=None)
@given(
    stiffness=st.floats(1.0, 1e5),
    gain=st.floats(1.0, 1e5),
    rotor=st.sampled_from([1e-5, 1e-3, 0.02]),
    play=st.sampled_from([0.0, 0.05]),
)
def test_no_servo_that_reads_its_motor_blows_up(
    stiffness: float, gain: float, rotor: float, play: float
) -> None:
    """From 0.2 rad beside its goal without any damping, the motor never goes much further from it."""
    text = PENDULUM.replace("0.02", f"{rotor}", 1).format(actuator=POSITION.format(kp=gain))
    text = text.replace('kv="0.6" forcerange="-2 2"', "")
    loop = SprungLoop(text, at_motor=True, stiffness=stiffness, play=play)
    loop.data.qpos[0] = 0.2
    for _ in range(300):
        loop.step(0.0)
        assert abs(loop.rotor.angle[0, 0]) < 0.5


def test_a_servo_with_firmware_moves_a_stiff_transmission_as_the_rigid_one(tmp_path: Path) -> None:
    """Dead zone and punch behind a gear that turns the other way, an effort limit, an encoder's scale.

    Whether the encoder is at the link or at the motor, which move as one.
    """
    firmware = {"servo_dead_zone": 0.02, "servo_punch": 0.2, "encoder_scale": 1.1}
    kinds = [known(kind, "shoulder", value) for kind, value in firmware.items()]
    spring, at_motor = known("transmission_stiffness", "shoulder", 1e7), known(*AT_MOTOR)
    model, path = robot(tmp_path, GEARED), 1.2 * swing(500, 1)
    runs = []
    for law in ([], kinds, [*kinds, spring], [*kinds, spring, at_motor]):
        members = batch(model, *law)
        members.set_state(np.array([0.2]), np.zeros(1))
        runs.append(members.advance(path, every=1)[0])
    np.testing.assert_allclose(runs[2], runs[1], atol=1e-3)
    np.testing.assert_allclose(runs[3], runs[1], atol=1e-3)
    assert np.abs(runs[1] - runs[0]).max() > 0.02


def test_the_effort_limit_falls_with_the_speed_of_the_motor(tmp_path: Path) -> None:
    """1 N·m at standstill, none at 8 rad/s: the wheel ends there, on the way of a body without a spring."""
    laws = {"motor_free_speed": 8.0, "transmission_stiffness": 50.0, "transmission_damping": 0.05}
    members = batch(robot(tmp_path, MOTOR), *(known(kind, "wheel", v) for kind, v in laws.items()))
    _, velocity = members.advance(np.ones((1, 5000, 1)), every=100)
    assert velocity[0, -1, 0] == pytest.approx(8.0, rel=1e-3)
    # Rotor and wheel, a cylinder of 0.5 kg about its cross axis, and 1/8 N·m·s/rad of lost effort.
    inertia = 0.01 + 0.5 * (3 * 0.1**2 + 0.04**2) / 12
    late = np.arange(1, 6) * 0.2
    expected = 8 * (1 - np.exp(-late / (inertia * 8)))
    np.testing.assert_allclose(velocity[0, :5, 0], expected, rtol=0.01)


@pytest.mark.parametrize("stiffness", [1e5, 1e8])
def test_a_stiff_transmission_moves_as_the_rigid_model(tmp_path: Path, stiffness: float) -> None:
    """Two servos with friction and limits, to 0.3 mrad of 1 rad."""
    model = robot(tmp_path, SERVO)
    path = swing(500, 2)
    springs = [known("transmission_stiffness", name, stiffness) for name in ("shoulder", "elbow")]
    runs = []
    for members in (batch(model), batch(model, *springs)):
        members.set_state(np.array([0.2, -0.1]), np.zeros(2))
        runs.append(members.advance(path, every=1)[0])
    np.testing.assert_allclose(runs[1], runs[0], atol=3e-4)


AT_MOTOR = ("encoder_at_motor", "shoulder", 1.0)


@pytest.mark.parametrize("firmware", [{}, {"servo_dead_zone": 0.02, "servo_punch": 0.1}], ids=["", "zone"])
@pytest.mark.parametrize("play", [0.0, 0.02])
def test_a_window_begins_where_the_motor_was_measured(
    tmp_path: Path, firmware: dict[str, float], play: float
) -> None:
    """A servo holds an arm of 0.7 kg: a state from its readings goes on, and its link hangs lower.

    The load is that of the link's own position; it holds still from the first step on.
    """
    kinds = SPRING | {"transmission_play": play} | firmware
    text = SERVO.replace('frictionloss="0.1"', "").replace('frictionloss="0.05"', "")
    members = batch(
        robot(tmp_path, text), known(*AT_MOTOR), *(known(k, "shoulder", v) for k, v in kinds.items())
    )
    link, goal = members.batch.bind("qpos"), np.array([0.6, 0.2])
    members.set_state(goal, np.zeros(2))
    members.advance(np.tile(goal, (1, 8000, 1)))
    settled, at = members.position.copy(), link.copy()
    members.set_state(settled[0], np.zeros(2))
    np.testing.assert_array_equal(members.position, settled)
    found, _ = members.advance(np.tile(goal, (1, 200, 1)), every=1)
    np.testing.assert_allclose(found[0], np.tile(settled, (200, 1)), atol=2e-5)
    np.testing.assert_allclose(link, at, atol=2e-5)
    load = 9.81 * (
        0.4 * 0.15 * math.sin(at[0, 0]) + 0.3 * (0.3 * math.sin(at[0, 0]) + 0.15 * math.sin(at.sum()))
    )
    assert settled[0, 0] - at[0, 0] == pytest.approx(load / 60 + play / 2, rel=1e-3)


SPRING = {"transmission_stiffness": 60.0, "transmission_damping": 0.1, "transmission_play": 0.01}


def sprung(
    tmp_path: Path, count: int = 1, text: str = SERVO, name: str = "shoulder", *more: Parameter
) -> ServoBatch:
    """Return members with an elastic transmission."""
    return batch(
        robot(tmp_path, text), *(known(kind, name, v) for kind, v in SPRING.items()), *more, count=count
    )


@pytest.mark.parametrize(
    "facts",
    [(), ("encoder_at_motor",), ("friction_at_motor",), ("encoder_at_motor", "friction_at_motor")],
    ids=["at link", "encoder at motor", "friction at motor", "both at motor"],
)
@pytest.mark.parametrize(("text", "name"), [(SERVO, "shoulder"), (MOTOR, "wheel")], ids=["servo", "motor"])
def test_a_window_does_not_depend_on_the_one_before(
    tmp_path: Path, text: str, name: str, facts: tuple[str, ...]
) -> None:
    """States that are set anew have rotors that follow from them, also in windows and with new values."""
    more = [known(fact, name, 1.0) for fact in facts]
    members = sprung(tmp_path, 2, text, name, *more)
    joints = 2 if text == SERVO else 1
    start, path = np.full(joints, 0.2), np.repeat(swing(200, joints), 2, axis=0)
    runs = []
    for before in (0, 130):
        if before:
            members.set_parameters(np.array([[0.3], [0.4]]))
            members.set_state(np.full(joints, 1.0), np.full(joints, 3.0))
            members.advance(np.repeat(swing(before, joints), 2, axis=0))
        members.set_parameters(np.array([[0.05], [0.06]]))
        members.set_state(start, np.zeros(joints))
        runs.append(members.advance(path, every=10)[0])
    np.testing.assert_array_equal(runs[0], runs[1])
    starts = np.broadcast_to(start, (2, 2, joints)), np.zeros((2, 2, joints))
    windows, _ = members.advance_windows(starts, np.repeat(path[:, None], 2, axis=1), 10)
    np.testing.assert_array_equal(windows, np.stack([runs[0], runs[0]], axis=1))


def periods(members: ServoBatch, again: int | None = None) -> FloatArray:
    """Return positions after twenty periods of ten steps in a closed loop, (2, 20, 2).

    Args:
        members: Two members.
        again: Period in which the second one is put to its start state again; None for never.
    """
    members.set_state(np.full(2, 0.1), np.zeros(2))
    loop = ClosedLoop(members, 10)
    loop.restart(np.zeros((2, 2)), np.zeros(2))
    found = []
    for k, target in enumerate(swing(200, 2)[0, ::10]):
        if k == again:
            members.set_state(np.full(2, 0.1), np.zeros(2), np.array([1]))
        found.append(loop.advance(np.tile(target, (2, 1)))[0][:, 0])
    return np.stack(found, axis=1)


@pytest.mark.parametrize("more", [(), (AT_MOTOR,)], ids=["at link", "at motor"])
def test_rotors_go_on_from_one_control_period_to_the_next(
    tmp_path: Path, more: tuple[tuple[str, str, float], ...]
) -> None:
    """Twenty periods of a closed loop are one path."""
    laws = [known(*law) for law in more]
    whole = sprung(tmp_path, 2, SERVO, "shoulder", *laws)
    whole.set_state(np.full(2, 0.1), np.zeros(2))
    path = np.repeat(swing(200, 2)[:, ::10], 10, axis=1)
    expected, _ = whole.advance(np.repeat(path, 2, axis=0), every=10)
    members = sprung(tmp_path, 2, SERVO, "shoulder", *laws)
    np.testing.assert_allclose(periods(members), expected, atol=1e-12)
    np.testing.assert_array_equal(members.position, expected[:, -1])


def test_a_member_does_not_feel_that_another_begins_anew(tmp_path: Path) -> None:
    """With friction by load, which takes the torques of the step before, and a firmware."""
    kinds = {"dof_friction_load": 0.1, "servo_dead_zone": 0.02, "encoder_at_motor": 1.0}
    laws = [known(kind, "shoulder", value) for kind, value in kinds.items()]
    one, other = (periods(sprung(tmp_path, 2, SERVO, "shoulder", *laws), again) for again in (None, 12))
    np.testing.assert_array_equal(one[0], other[0])
    assert np.abs(one[1, 12:] - other[1, 12:]).max() > 1e-2


@pytest.mark.parametrize("more", [(), (AT_MOTOR,)], ids=["at link", "at motor"])
def test_reported_speeds_are_those_of_reported_positions(
    tmp_path: Path, more: tuple[tuple[str, str, float], ...]
) -> None:
    """A step moves a position by the speed at its end, of the link or of the motor, in an encoder's scale."""
    laws = [known(*law) for law in (*more, ("encoder_scale", "shoulder", 1.1))]
    members = sprung(tmp_path, 1, SERVO, "shoulder", *laws)
    members.set_state(np.full(2, 0.1), np.zeros(2))
    position, velocity = members.advance(swing(200, 2), every=1)
    np.testing.assert_allclose(np.diff(position[0], axis=0) / 0.002, velocity[0, 1:], atol=1e-9)
    np.testing.assert_array_equal(members.velocity, velocity[:, -1])
    assert np.ptp(velocity[0, :, 0]) > 1.0


def test_gains_that_the_host_sends_act_at_the_motor(tmp_path: Path) -> None:
    """Without gains the arm falls; with them again it moves as before."""
    members = sprung(tmp_path)
    runs = []
    for gain in (20.0, 0.0, 20.0):
        sent = np.array([gain, 10.0]), np.array([gain / 20, 0.5]), np.array([4.0, 3.0])
        members.set_sent(*sent)
        members.set_state(np.array([0.3, 0.0]), np.zeros(2))
        runs.append(members.advance(np.zeros((1, 300, 2)), every=300)[0][0, 0, 0])
    assert runs[0] == runs[2] and abs(runs[0] - runs[1]) > 0.05


def space(*given: tuple[str, str, float] | Parameter) -> ParameterSpace:
    """Return parameters; those that are known by kind, element and value."""
    return ParameterSpace([p if isinstance(p, Parameter) else known(*p) for p in given])


def rotor(least: float) -> Parameter:
    """Return the rotor's inertia, which is searched."""
    return Parameter(
        name="rotor", kind="dof_armature", elements=("shoulder",), unit="kg·m²", nominal=0.01, low=least,
        high=1.0, scale="linear",
    )  # fmt: skip


def searched_place() -> Parameter:
    """Return the place of an encoder, which is searched."""
    return Parameter(
        name="place", kind="encoder_at_motor", elements=("shoulder",), unit="-", nominal=1.0, low=0.0,
        high=1.0, scale="linear",
    )  # fmt: skip


STIFF = ("transmission_stiffness", "shoulder", 100.0)
RUBS = ("friction_at_motor", "shoulder", 1.0)


@pytest.mark.parametrize(
    ("text", "parameters", "message"),
    [
        (
            SERVO.replace('armature="0.01"', ""),
            space(STIFF),
            r"'shoulder' needs inertia.*0 in the model; write",
        ),
        (SERVO, space(STIFF, rotor(0.0)), r"dof_armature is 0 at its lowest.*range above 0"),
        (
            SERVO,
            space(STIFF, ("servo_play", "shoulder", 1.0)),
            r"second play of 'shoulder'.*leave it out: transmission_play",
        ),
        (SERVO, space(STIFF, ("effort_gain", "shoulder", 1.0)), r"effort_gain.*transmission.*leave one out"),
        (
            SERVO,
            space(("transmission_play", "elbow", 1.0)),
            r"spring that 'elbow' does not have; add .*kind:",
        ),
        (SERVO, space(AT_MOTOR), r"'shoulder' has no elastic transmission.*add transmission_stiffness"),
        (SERVO, space(STIFF, searched_place()), r"is searched, and the place.*`known: true`"),
        (SERVO, space(STIFF, (*RUBS[:2], 2.0)), r"is 2, and the place of friction.*`known: true`"),
        (
            SERVO,
            space(STIFF, RUBS, ("dof_friction_load", "shoulder", 1.0)),
            r"dof_friction_load.*at the link.*'shoulder' is at the motor.*leave one out",
        ),
        (SERVO, space(STIFF, (*AT_MOTOR[:2], 2.0)), r"is 2, and the place.*`known: true`"),
        (SERVO.replace("implicitfast", "RK4"), space(STIFF), r"RK4 changes the torque of a.*Euler"),
        (
            SERVO.replace('kv="1"', 'kv="1" armature="0.01"'),
            space(STIFF),
            r"armature of its own; write it as",
        ),
        (
            SERVO.replace('axis="0 1 0"', 'axis="0 1 0" actuatorfrcrange="-3 3" actuatorgravcomp="true"'),
            space(STIFF),
            r"as forcerange",
        ),
        (
            SERVO.replace('"elbow" kp', '"shoulder" kp'),
            space(STIFF),
            r"2 actuators \('shoulder', 'elbow'\).*one",
        ),
    ],
    ids=(
        "bare,rotor of 0,play,effort,no spring,rigid,searched,rubs,rubs twice,no fact,RK4,own rotor,limit,two"
    ).split(","),
)
def test_what_cannot_be_is_refused(text: str, parameters: ParameterSpace, message: str) -> None:
    """With what is allowed, and what to do."""
    with pytest.raises(ConfigurationError, match=message):
        check_space(mujoco.MjModel.from_xml_string(text), parameters)


def test_a_gpu_has_no_transmissions(tmp_path: Path) -> None:
    """A search on it is refused, and one that may choose takes MuJoCo and says why."""
    model, parameters = robot(tmp_path, SERVO), space(STIFF, rotor(0.01))
    reason = r"not simulate the elastic.*'shoulder.*use --engine mujoco"
    with pytest.raises(ConfigurationError, match=reason):
        ServoBatch(model, parameters, 1, threads=1, engine="warp-cpu")
    with pytest.raises(ConfigurationError, match=reason):
        choose_engine("warp", model, 256, "the search", print, space=parameters)
    said: list[str] = []
    assert choose_engine("auto", model, 256, "the search", said.append, space=parameters) == "mujoco"
    assert "elastic transmission of 'shoulder.transmission_stiffness'" in said[0]
