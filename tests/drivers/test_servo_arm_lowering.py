"""An arm of servos that is raised goes to rest slowly at a planned end and at Ctrl-C."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm_rig import BUSES, Rig

from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import HOMING, LOWERING, MAKING_PASSIVE, Outcome
from deal_hw.control.safety.passive import make_passive
from deal_hw.control.safety.safety import Safety
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.types import JointCommand, RobotState


@pytest.fixture(params=BUSES)
def bus(request: pytest.FixtureRequest) -> str:
    """The bus."""
    return str(request.param)


def lowered(tmp_path: Path, bus: str) -> Rig:
    """Return an arm with a rest pose."""
    servos = Rig(tmp_path, bus).file.servo_bus
    assert servos is not None
    rests = tuple(
        dataclasses.replace(servo, rest=at) for servo, at in zip(servos.servos, (1.0, -0.5), strict=True)
    )
    return Rig(tmp_path, bus, servos=rests)


class Interrupted(HoldBehaviour):
    """Holds the start pose; the operator asks for the end in its fifth cycle."""

    def __init__(self, rig: Rig, *, gently: bool) -> None:
        super().__init__(rig.description)
        self._rig, self._gently, self._cycles = rig, gently, 0

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        self._cycles += 1
        if self._cycles == 5:
            self._rig.loop.request_stop("stopped by a test", gently=self._gently)
        return super().command(state, time_s)


def played(rig: Rig, behaviour: HoldBehaviour | None = None, **settings: Any) -> LoopReport:
    """Hold the start pose for a while by the control loop."""
    config = LoopConfig(duration_s=0.5, **settings)
    loop = ControlLoop(
        rig.robot,
        behaviour or HoldBehaviour(rig.description),
        Safety(rig.description),
        rig.clock,
        lambda record: True,
        config,
        progress=lambda phase, silence_s: rig.phases.append(phase),
    )
    rig.loop = loop
    return loop.run()


def test_a_planned_end_lowers_the_arm_first(tmp_path: Path, bus: str) -> None:
    """It moves to the rest pose, slowly, and then the motors go off."""
    rig = lowered(tmp_path, bus)
    report = played(rig)
    assert (report.outcome, report.passive_confirmed) == (Outcome.FINISHED, True)
    assert rig.phases.index(LOWERING) < rig.phases.index(MAKING_PASSIVE)
    np.testing.assert_allclose(rig.true_position(), [1.0, -0.5], atol=0.15)
    assert rig.device.mode == ("idle" if bus == "dynamixel" else "braking")


class Weak(HoldBehaviour):
    """Holds the start pose with a part of each drive's stiffness and limit, as an excitation may end."""

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        held = super().command(state, time_s)
        return dataclasses.replace(
            held, stiffness=0.15 * held.stiffness, effort_limit=0.02 * held.effort_limit
        )


def test_an_arm_that_is_weak_at_the_end_is_lowered_with_its_nominal_gains(tmp_path: Path, bus: str) -> None:
    """The last command's gains and limits could not move it: it would be "not following", and drop."""
    rig = lowered(tmp_path, bus)
    assert played(rig, Weak(rig.description)).outcome is Outcome.FINISHED
    np.testing.assert_allclose(rig.true_position(), [1.0, -0.5], atol=0.15)


def test_a_stop_on_the_way_down_makes_it_passive_at_once(tmp_path: Path, bus: str) -> None:
    """Ctrl-C does not wait for the rest pose."""
    rig = lowered(tmp_path, bus)
    goals = rig.robot._family.goals

    def interrupted(ticks: Any) -> Any:
        if rig.phases[-1:] == [LOWERING] and rig.true_position()[0] > 0.3:
            rig.loop.request_stop("stopped by a test")
        return goals(ticks)

    rig.robot._family.goals = interrupted  # type: ignore[method-assign]
    report = played(rig)
    assert (report.outcome, report.reason) == (Outcome.STOPPED, "stopped by a test")
    assert report.passive_confirmed
    assert rig.device.mode == ("idle" if bus == "dynamixel" else "braking")
    assert rig.true_position()[0] < 0.6


def test_ctrl_c_lowers_a_raised_arm(tmp_path: Path, bus: str) -> None:
    """As a planned end does; the run was stopped all the same."""
    rig = lowered(tmp_path, bus)
    report = played(rig, Interrupted(rig, gently=True))
    assert (report.outcome, report.reason) == (Outcome.STOPPED, "stopped by a test")
    assert report.passive_confirmed and LOWERING in rig.phases
    np.testing.assert_allclose(rig.true_position(), [1.0, -0.5], atol=0.15)
    assert rig.device.mode == ("idle" if bus == "dynamixel" else "braking")


def test_any_other_signal_makes_it_passive_at_once(tmp_path: Path, bus: str) -> None:
    """Such as `deal-hw stop`, which is for emergencies."""
    rig = lowered(tmp_path, bus)
    begun_ns = rig.clock.now_ns()
    report = played(rig, Interrupted(rig, gently=False))
    assert report.outcome is Outcome.STOPPED and report.passive_confirmed and LOWERING not in rig.phases
    assert rig.clock.now_ns() - begun_ns < 5e9


def test_ctrl_c_on_the_way_to_the_start_pose_lowers_the_arm(tmp_path: Path, bus: str) -> None:
    """It does not drop half-way up: it goes back to where it was found limp."""
    rig = Rig(tmp_path, bus)
    start = np.array([0.9, -0.7])
    rig.device._batch.set_state(start[None], np.zeros((1, 2)))
    goals = rig.robot._family.goals
    asked: list[float] = []

    def interrupted(ticks: Any) -> Any:
        if rig.phases[-1:] == [HOMING] and not asked and rig.true_position()[0] < 0.5:
            asked.append(1)
            rig.loop.request_stop("stopped by a test", gently=True)
        return goals(ticks)

    rig.robot._family.goals = interrupted  # type: ignore[method-assign]
    report = played(rig)
    assert report.outcome is Outcome.STOPPED and report.passive_confirmed
    np.testing.assert_allclose(rig.true_position(), start, atol=0.15)


def test_an_arm_without_a_rest_pose_goes_back_to_where_it_was_found_limp(tmp_path: Path, bus: str) -> None:
    """That it lay there without torque shows that it may."""
    rig = Rig(tmp_path, bus)
    start = np.array([0.8, -0.6])
    rig.device._batch.set_state(start[None], np.zeros((1, 2)))
    report = played(rig)
    assert report.outcome is Outcome.FINISHED and report.warnings == ()
    np.testing.assert_allclose(rig.true_position(), start, atol=0.15)


def test_an_arm_that_was_stiff_holds_its_pose_at_the_end(tmp_path: Path, bus: str) -> None:
    """As after a killed run: no pose is known in which it may go limp, so it does not drop."""
    rig = Rig(tmp_path, bus)
    rig.armed()
    rig.run(60, target=0.5)
    rig.robot.disconnect()
    report = played(rig)
    assert report.outcome is Outcome.FINISHED and report.passive_confirmed
    assert "holds its pose with stiff motors" in report.warnings[0]
    assert "deal-hw stop ROBOT --port" in report.warnings[0]
    rig.virtual.open()
    rig.advance(3.0)
    assert rig.device.mode == "armed"
    np.testing.assert_allclose(rig.true_position(), [0.0, 0.0], atol=0.1)
    rig.robot.connect()
    assert make_passive(rig.robot, rig.clock)
    assert rig.device.mode == ("idle" if bus == "dynamixel" else "braking")


def test_an_arm_that_cannot_be_lowered_goes_off_all_the_same(tmp_path: Path, bus: str) -> None:
    """A servo that fails on the way down is noted; the run itself is over."""
    rig = lowered(tmp_path, bus)
    goals = rig.robot._family.goals

    def failing(ticks: Any) -> Any:
        if rig.phases[-1:] == [LOWERING]:
            rig.servos[0].fail(1 << 2)
        return goals(ticks)

    rig.robot._family.goals = failing  # type: ignore[method-assign]
    report = played(rig)
    assert report.outcome is Outcome.FINISHED and report.passive_confirmed
