"""A walk in the simulator tells a sound policy from one with exchanged joints or a wrong sign."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fakes.wrong_policy import ERRORS, WrongPolicy

from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.walking_trial import (
    WalkingReport,
    WalkingTrial,
    can_try,
    describe_command,
    trial_commands,
    try_walking,
)
from deal_hw.policy import Observation, PolicySpec
from deal_hw.robots import robot_entry
from deal_hw.types import FloatArray
from deal_hw.workflows.shipped import required_policy

SHIPPED = OnnxPolicy(required_policy("go2"))


SHORT = WalkingTrial(seconds=3.0, robots=1)
"""A walk half as long, of one robot for each command, shows the same."""


def test_the_shipped_policy_walks() -> None:
    """It stays up at all commands, and follows them."""
    report = try_walking(SHIPPED, DRIVER, WalkingTrial(seconds=3.0, robots=2))
    assert report.faults() == ()
    assert report.up == 1.0 and report.clipped < 0.1
    assert [walk.up for walk in report.standing] == [1.0] * 7
    followed = [walk.followed for walk in report.walks[1:]]
    assert min(followed) > 0.5
    # A robot that stands still follows nothing: the score's zero.
    assert max(abs(walk.followed) for walk in report.standing) < 0.05


@pytest.mark.parametrize(
    "error",
    [
        "front legs exchanged",
        *(
            pytest.param(error, marks=pytest.mark.slow)
            for error in ("left legs exchanged", "sides exchanged", "velocities")
        ),
        "gyro",
        "hips",
    ],
)
def test_exchanged_legs_and_wrong_signs_are_caught(error: str) -> None:
    """They fall, or do not go where they should, at several commands; all errors are in docs/measured."""
    faults = try_walking(ERRORS[error](SHIPPED), DRIVER, SHORT).faults()
    assert len(faults) >= 2
    assert all("falls after" in fault or "of the command" in fault for fault in faults)


def test_one_flipped_axis_of_the_command_is_caught() -> None:
    """The robot walks well, and turns the wrong way."""
    report = try_walking(ERRORS["yaw of the command"](SHIPPED), DRIVER, SHORT)
    assert report.up == 1.0
    assert len(report.faults()) == 2 and all(fault.startswith("turn") for fault in report.faults())


def test_a_policy_that_stands_still_follows_nothing() -> None:
    """It never falls; the score against standing still is zero."""

    class Still(WrongPolicy):
        def act_batch(self, observations: Observation) -> FloatArray:
            return np.zeros((len(observations), 12))

    report = try_walking(Still(SHIPPED), DRIVER, SHORT)
    assert report.up == 1.0 and len(report.faults()) == 6


def test_the_same_trial_gives_the_same_result() -> None:
    """Its draws are fixed."""

    def walk() -> WalkingReport:
        return try_walking(SHIPPED, DRIVER, WalkingTrial(seconds=1.0, robots=2), threads=1)

    assert walk() == walk()


@pytest.mark.parametrize(
    ("ranges", "wanted"),
    [
        (
            ((-1.0, 1.0), (-0.4, 0.4), (0.0, 0.0)),
            ["stand", "ahead 0.5 m/s", "back 0.5 m/s", "left 0.4 m/s", "right 0.4 m/s"],
        ),
        (((0.2, 0.3), (0.0, 0.0), (0.0, 0.0)), ["stand", "ahead 0.3 m/s", "ahead 0.2 m/s"]),
        (((0.0, 0.0),) * 3, ["stand"]),
    ],
)
def test_commands_stay_in_the_training_range(
    ranges: tuple[tuple[float, float], ...], wanted: list[str]
) -> None:
    """A direction that was not trained is not asked for."""
    spec = dataclasses.replace(SHIPPED.spec, command_range=ranges)
    assert [describe_command(command) for command in trial_commands(spec)] == wanted


def test_who_cannot_walk_is_not_tried() -> None:
    """A robot with a fixed base, and a policy that follows no velocity."""
    still = dataclasses.replace(
        SHIPPED.spec,
        observation=tuple(t for t in SHIPPED.spec.observation if t.quantity != "command"),
    )
    cases: list[tuple[PolicySpec, RobotDescription, str]] = [
        (SHIPPED.spec, DRIVER, ""),
        (still, DRIVER, "the policy follows no commanded velocity"),
        (SHIPPED.spec, CARTPOLE, "robot 'cartpole' does not walk"),
    ]
    for spec, description, said in cases:
        assert can_try(spec, description) == said


def test_a_robot_that_hangs_is_set_on_a_floor() -> None:
    """An H1's policy that holds its pose falls as soon as robots that stand still, and follows no command."""
    entry = robot_entry("h1")
    description = entry.recorded_description()
    spec = dataclasses.replace(
        SHIPPED.spec,
        robot="h1",
        joint_names=description.joint_names,
        actuated=description.actuated,
        default_position=description.default_position,
        action_scale=(0.25,) * len(description.actuated),
        stiffness=description.stiffness,
        damping=description.damping,
        effort_limit=description.effort_limit,
        speed_limit=description.speed_limit,
        position_units=description.position_units,
        clock_hz=0.0,
        observation=tuple(t for t in SHIPPED.spec.observation if t.quantity == "command"),
    )
    assert can_try(spec, description) == "robot 'h1' does not walk"
    assert can_try(spec, description, entry.feet) == ""

    class Holding:
        def __init__(self) -> None:
            self.spec = spec

        def reset(self) -> None:
            """It has no memory."""

        def act_batch(self, observations: Observation) -> FloatArray:
            return np.zeros((len(observations), len(spec.actuated)))

    report = try_walking(Holding(), description, SHORT, feet=entry.feet, threads=1)
    for walk, still in zip(report.walks, report.standing, strict=True):
        assert 0.1 < walk.up < 0.9
        assert walk.up == pytest.approx(still.up, abs=0.05)
    assert len(report.faults()) == 6
