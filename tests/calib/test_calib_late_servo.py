"""A servo whose damping acts on an older speed: its signature, and its name on a recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import with_rows
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.hypotheses.diagnosis import diagnose
from deal_hw.calib.hypotheses.signatures import signatures
from deal_hw.drivers.cartpole.chips.controller import Controller
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.drivers.cartpole.plant.mechanics import Mechanics
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, unique_id
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import align, fill_gaps
from deal_hw.workflows.emulation.virtual import VirtualCartpole, demonstrate
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.shipped import required_policy


class LateServo(Servo):
    """A servo whose speed is some periods old."""

    def __init__(self, parameters: Mapping[str, float], period_s: float, late: int) -> None:
        super().__init__(parameters, period_s)
        self._seen = deque([0.0] * (late + 1), maxlen=late + 1)

    def update(self, position: float, velocity: float) -> float:
        """Run one period with an older velocity."""
        self._seen.append(velocity)
        return super().update(position, self._seen[0])


def problem_of(truth: CartpoleTruth, late: int) -> Problem:
    """Return the problem of a demonstration with a servo whose speed is ``late`` ms old."""

    def firmware(truth: CartpoleTruth, mechanics: Mechanics) -> Controller:
        servo = LateServo(truth.parameters, mechanics.timestep_s, late)
        return Controller(servo, unique_id(truth), mechanics.command_delay)

    virtual = VirtualCartpole(truth, CartpoleDevice(truth, firmware=firmware))
    policy = str(required_policy("cartpole"))
    run, _ = demonstrate(virtual, RunPlan(robot="cartpole", motion="rich", seconds=4.0, policy=policy))
    episode = fill_gaps(align(run.trajectory, DESCRIPTION))
    return Problem(load_model(DESCRIPTION), k9_space().with_ratio(5.0), [episode], threads=1)


@pytest.mark.slow
def test_a_servo_whose_damping_acts_late_is_named() -> None:
    """10 ms late: the only cause, at the cart, and not its inertia; the pole has no servo."""
    truth = draw_truth("sensor", 4, range_ratio=5.0)
    problem = problem_of(truth, late=10)
    theta = np.array([truth.parameters[name] for name in problem.space.names])
    fit = with_rows(refine(problem, theta, truth.latency_s))
    (found,) = diagnose(problem, fit).causes
    # Inertia and latency have taken its place: with chi2 1.24 little of it is left.
    assert found.code == "lag" and found.subject == ("cart",) and found.share > 0.05
    assert "speed of cart" in found.do
    assert [s.where for s in signatures(problem, fit) if s.cause == "lag"] == ["cart"]
