"""Friction of a motor before its elastic transmission: by hand, beside a rotor that rubs, held loads."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from fakes.sprung_loop import PENDULUM, PLATE, TORQUE, TWO_BODIES, SprungLoop, coupled, transmission_law

from deal_hw.sim.laws.transmission import Couplings, TransmissionLaw


def test_dry_friction_of_a_motor_by_hand() -> None:
    """1.5 N·m: it slides from 1 rad/s on; at rest it holds 2 N·m against 3 N·m of the spring."""
    sliding = (20.0 + 2.0 - 3.0 - 1.5) / 20.0
    assert coupled(transmission_law(), 0.03, 1.0, 0.5, 2.0, 0.0, friction=1.5) == pytest.approx(
        [3.0, 0.0, sliding, 0.0]
    )
    assert coupled(transmission_law(), 0.03, 0.0, 0.5, 2.0, 0.0, friction=1.5) == pytest.approx(
        [3.0, 0.0, 0.0, 0.0]
    )
    # Within a gap of 0.04 rad it loses 1.5 N·m for 1 ms, or holds against 1 N·m.
    of = transmission_law(play=0.04)
    assert coupled(of, 0.0, 1.0, 0.0, 0.0, 0.0, friction=1.5) == pytest.approx([0.0, 0.0, 0.925, 0.0])
    assert coupled(of, 0.0, 0.0, 0.0, 1.0, 0.0, friction=1.5) == pytest.approx([0.0, 0.0, 0.0, 0.0])


def test_a_joint_without_friction_does_not_feel_that_of_another() -> None:
    """At rest beside one that is held, its motor follows its link as it does alone."""
    every = {"stiffness": 1e4, "damping": 0.5, "play": 0.0, "inertia": 0.02, "link_inertia": 0.01}
    of = TransmissionLaw(**{name: np.full((1, 2), value) for name, value in every.items()}, step_s=0.001)
    rest, friction = np.zeros((4, 1, 2)), np.array([[0.0, 5.0]])
    found = []
    for rubs in (None, friction):
        couplings = Couplings(of, np.zeros((1, 2)), friction=rubs)
        couplings.couple(rest.copy())
        moving = np.empty((1, 2))
        couplings.follow(np.ones((1, 2)), moving)
        found.append((couplings.inertia[0], moving[0]))
    (inertia, speed), (rubbing, held) = found
    assert (rubbing[0], held[0]) == (inertia[0], speed[0]) and speed[0] > 0.1
    assert held[1] == 0.0 and rubbing[1] > inertia[1]


def test_a_held_motor_is_the_fixed_end_of_a_spring_by_hand() -> None:
    """4e4 N·m/rad and 2 N·m·s/rad, with all of both at the end of 1 ms: 42 N·m·s/rad of the link's speed."""
    of = transmission_law(stiffness=4e4, damping=2.0, link_inertia=1e-9)
    torque, inertia, speed, follows = coupled(of, 1e-4, 0.0, 0.5, 0.0, 0.0, friction=100.0)
    # 4 N·m of the bent spring; of the link's 0.5 rad/s nothing counts at the beginning.
    assert torque == pytest.approx(4.0 - 42.0 * 0.5, rel=1e-4)
    assert [inertia, speed, follows] == pytest.approx([0.042, 0.0, 0.0], rel=1e-4)


@pytest.mark.parametrize(
    ("stiffness", "damping", "play", "tolerance", "elsewhere"),
    [(20.0, 0.05, 0.0, 0.008, 0.04), (200.0, 0.0, 0.03, 0.02, 0.08), (1e4, 1.0, 0.03, 0.03, 0.1)],
)
def test_friction_at_the_motor_is_that_of_a_rotor(
    stiffness: float, damping: float, play: float, tolerance: float, elsewhere: float
) -> None:
    """0.2 N·m and 0.2 N·m·s/rad of MuJoCo's own rotor; at the link they move both otherwise."""
    rubbing = 'damping="0.2" frictionloss="0.2"'
    text = TWO_BODIES.format(stiffness=stiffness, damping=damping, low=-play / 2, high=play / 2)
    text = text.replace('axis="0 1 0" damping="0.2"', 'axis="0 1 0"')
    # A constraint that creeps little.
    stiff = 'armature="0.02" solimpfriction="0.99 0.9999 0.001 0.5 2" '
    model = mujoco.MjModel.from_xml_string(text.replace('armature="0.02"', stiff + rubbing))
    data, own = mujoco.MjData(model), PENDULUM.format(actuator=TORQUE).replace('damping="0.2"', rubbing)
    loops = [
        SprungLoop(own, rubs=rubs, stiffness=stiffness, damping=damping, play=play) for rubs in (True, False)
    ]
    found, expected = np.empty((2, 2, 1500)), np.empty((2, 1500))
    for loop in loops:
        loop.begin()
    for step in range(1500):
        torque = 0.5 * math.sin(2 * math.pi * 0.9 * 0.002 * step) + 0.1
        for k, loop in enumerate(loops):
            loop.step(torque)
            found[k, :, step] = loop.data.qpos[0], loop.rotor.angle[0, 0]
        data.ctrl[0] = torque
        mujoco.mj_step(model, data, 20)
        expected[:, step] = data.qpos
    error = np.abs(found - expected).max(axis=2) / np.ptp(expected, axis=1)
    assert np.all(error[0] < tolerance) and error[1].max() > elsewhere


def test_a_motor_that_friction_holds_stays_to_the_last_bit() -> None:
    """The link swings on its spring, sqrt(100/0.01) = 100 rad/s, and 1 N·m of it do not move the motor."""
    text = PLATE.format(step=0.0005, integrator="implicitfast")
    loop = SprungLoop(
        text.replace('armature="0.02"', 'armature="0.02" frictionloss="2"'), rubs=True, stiffness=100.0
    )
    loop.begin()
    loop.data.qvel[0] = 1.0
    place = np.empty(2000)
    for step in range(len(place)):
        loop.step(0.0)
        place[step] = loop.data.qpos[0]
        assert loop.rotor.angle[0, 0] == 0.0 == loop.rotor.speed[0, 0]
    turns = np.flatnonzero(np.diff(np.sign(place)))
    period = 2 * 0.0005 * (turns[-1] - turns[0]) / (len(turns) - 1)
    assert 2 * math.pi / period == pytest.approx(100.0, rel=0.01)
    assert np.abs(place).max() == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize("play", [0.0, 0.05])
def test_friction_holds_a_load_from_the_start(play: float) -> None:
    """A level arm pulls by 0.589 N·m, a spring of 60 N·m/rad bends by it, friction of 0.8 N·m holds both."""
    rubbing = 'damping="0.2" frictionloss="0.8"'
    text = PENDULUM.format(actuator=TORQUE).replace('damping="0.2"', rubbing)
    loop = SprungLoop(text, rubs=True, stiffness=60.0, damping=0.2, play=play)
    loop.data.qpos[0] = math.pi / 2
    loop.begin()
    motor = float(loop.rotor.angle[0, 0])
    load = 0.4 * 9.81 * 0.15
    # MuJoCo's own friction, which holds both at the start, gives way by 4 % of the load.
    assert motor - math.pi / 2 == pytest.approx(load / 60 + play / 2, abs=0.04 * load / 60)
    for _ in range(500):
        loop.step(0.0)
    assert loop.rotor.angle[0, 0] == motor
    assert motor - loop.data.qpos[0] == pytest.approx(load / 60 + play / 2, rel=1e-4)
