"""The Go2 as its driver has it: facts that agree with the simulated robot's, each limit with its source."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from deal_hw.description import LegLimits, RobotDescription
from deal_hw.drivers.go2.descriptions import on_stand, on_stand_recording
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.sim.engine.model import load_model
from deal_hw.workflows.shipped import shipped_policy

BOTH = pytest.mark.parametrize("description", [DRIVER, on_stand.DESCRIPTION], ids=lambda d: d.name)


@BOTH
def test_every_limit_for_legs_has_a_source(description: RobotDescription) -> None:
    """Assumptions are called assumptions."""
    assert description.limits.legs is not None
    for field in dataclasses.fields(LegLimits):
        assert description.sources[f"legs.{field.name}"]
    for name in ("repeat_rate_hz", "passive_damping", "rest_position", "state_rate_hz", "silence_s"):
        assert description.sources[name]


@BOTH
def test_the_rest_pose_can_be_commanded_and_measured(description: RobotDescription) -> None:
    """Targets reach it; a robot that lies on its stops, calves at -2.81 rad, does not trip."""
    rest = np.array(description.rest_position)
    low, high = np.array(description.limits.target).T
    assert ((low <= rest) & (rest <= high)).all()
    lying = np.tile([0.33, 1.29, -2.811], 4)
    low, high = np.array(description.limits.trip_position).T
    assert ((low <= lying) & (lying <= high)).all()


@BOTH
def test_the_models_step_is_the_motors_period(description: RobotDescription) -> None:
    """Simulated at the rate of the motors, whatever the shared model's own step."""
    robot = load_model(description)
    assert math.isclose(robot.step_s * description.device_rate_hz, 1.0)
    assert description.steps_per_control == {"go2": 10, "go2_on_stand": 20}[description.name]
    for foot in description.feet:
        robot.model.geom(foot)


def test_the_recording_on_a_stand_keeps_its_own_step() -> None:
    """The same file, 400 Hz."""
    assert on_stand.DESCRIPTION.mjcf == on_stand_recording.DESCRIPTION.mjcf
    assert load_model(on_stand_recording.DESCRIPTION).step_s == 0.0025


def test_the_shipped_policy_fits_the_driven_robot() -> None:
    """Trained on the simulated description, it meets the same names, poses, gains and rate."""
    path = shipped_policy("go2")
    assert path is not None
    OnnxPolicy(path).spec.check_fits(DRIVER)
    assert (DRIVER.name, DRIVER.stiffness, DRIVER.damping) == (
        DESCRIPTION.name,
        DESCRIPTION.stiffness,
        DESCRIPTION.damping,
    )


def test_the_robot_on_a_stand_stays_level() -> None:
    """Its stand is level, as the model's base; free fall does not trip it, everything else does."""
    legs, floor = on_stand.DESCRIPTION.limits.legs, DRIVER.limits.legs
    assert legs is not None and floor is not None
    assert (legs.tilt, legs.free_fall) == (0.35, 0.0)
    assert dataclasses.replace(legs, tilt=floor.tilt, free_fall=floor.free_fall) == floor
