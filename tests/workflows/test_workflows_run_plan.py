"""The plan of a control process: plain JSON and back, and what is made of it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.motions.excitation.behaviours import RichConfig, Segment
from deal_hw.motions.posture import PostureBehaviour, PostureConfig
from deal_hw.motions.velocity import FixedVelocity, KeyboardVelocity, RemoteVelocity, ScriptVelocity
from deal_hw.transport import WireOptions
from deal_hw.types import RobotState, Status
from deal_hw.workflows.running.plan import RunPlan, make_behaviour

SEGMENT = Segment(**{f.name: getattr(RichConfig().segments[0], f.name) for f in dataclasses.fields(Segment)})
POSTURE = PostureConfig(fold_s=1.0, rise_s=2.0, settle_s=0.5, lie_s=1.5)
FULL = RunPlan(
    robot="go2",
    transport="zenoh",
    motion="rich",
    policy="p.onnx",
    recording="r.mcap",
    seconds=7.5,
    seed=3,
    dry_run=True,
    home=False,
    policy_digest="ab12",
    trust_calibration=True,
    rich=RichConfig(segments=(SEGMENT, SEGMENT)),
    excitation_level=1.5,
    excite="multisine",
    port="tls/192.168.123.18:7447",
    wire=WireOptions(
        domain=4,
        listen=True,
        mode="peer",
        insecure=True,
        ca=Path("/etc/a.pem"),
        certificate=Path("b.pem"),
        key=Path("c.pem"),
    ),
    target="poses.csv",
    velocity="0.3,0,-0.1",
    stand=True,
    posture=POSTURE,
    robot_settings={"stop_buttons": "R2+A"},
    hand_back=True,
    record_wire=False,
    realtime=False,
    passive_timeout_s=12.0,
    hold_heading=True,
    obstacle="1.0,0.15",
)


@pytest.mark.parametrize("plan", [FULL, RunPlan(robot="cartpole")], ids=["full", "default"])
def test_a_plan_survives_json(plan: RunPlan) -> None:
    """Paths, tuples and nested settings come back as they were; keys of others are ignored."""
    values = json.loads(json.dumps({**plan.to_json(), "port_fd": None, "status_fd": 5}))
    assert RunPlan.from_json(values) == plan


def test_every_field_of_the_full_plan_is_tested() -> None:
    """A field that is added later must be added above: none of these is its default."""
    usual = RunPlan(robot="cartpole")
    for field in dataclasses.fields(RunPlan):
        assert getattr(FULL, field.name) != getattr(usual, field.name), field.name
    for field in dataclasses.fields(WireOptions):
        assert getattr(FULL.wire, field.name) != field.default, field.name


def test_standing_up_and_lying_down_are_not_counted_in_the_seconds() -> None:
    """1 + 2 + 0.5 before, 0.6 + 1.5 after; a walk is slowed for 1 s; nothing without standing up."""
    hold = dataclasses.replace(FULL, motion="hold")
    assert hold.total_s == pytest.approx(7.5 + 3.5 + 0.6 + 1.5)
    assert dataclasses.replace(FULL, motion="balance").total_s == pytest.approx(hold.total_s + 1.0)
    # It is waited for 3 s until it is still, instead of 0.3 s.
    assert hold.longest_s == pytest.approx(hold.total_s + 2.7)
    lying = dataclasses.replace(FULL, stand=False)
    assert lying.total_s == lying.longest_s == 7.5


@pytest.mark.parametrize(
    ("velocity", "kind"),
    [("0.3,0,0", FixedVelocity), ("remote", RemoteVelocity), ("keyboard", KeyboardVelocity)],
)
def test_the_velocity_comes_from_where_it_is_said(velocity: str, kind: type) -> None:
    """Fixed numbers, the robot's remote, the operator's keys."""
    assert isinstance(dataclasses.replace(FULL, velocity=velocity).velocity_source(), kind)


def test_the_velocity_comes_from_a_script(tmp_path: Path) -> None:
    """A file of times and velocities."""
    path = tmp_path / "walk.csv"
    path.write_text("time_s,x,y,yaw\n0,0.1,0,0\n")
    assert isinstance(dataclasses.replace(FULL, velocity=str(path)).velocity_source(), ScriptVelocity)


def test_a_wrong_velocity_is_said_before_anybody_touches_the_robot() -> None:
    """Also where the profile does not walk."""
    plan = RunPlan(robot="go2", motion="hold", velocity="fast")
    with pytest.raises(ConfigurationError, match=r"--velocity 'fast': give x,y,yaw"):
        make_behaviour(plan, DRIVER)


def test_standing_up_is_wrapped_around_the_profile() -> None:
    """It rises, holds and lies down; its length is the run's."""
    plan = RunPlan(robot="go2", motion="hold", seconds=2.0, stand=True, posture=POSTURE)
    behaviour = make_behaviour(plan, DRIVER)
    assert isinstance(behaviour, PostureBehaviour)
    assert behaviour.duration_s == plan.total_s
    lying = np.array(DRIVER.rest_position)
    state = RobotState(lying, np.zeros(12), np.zeros(12), 0, 0, 0, -1, -1, Status.ARMED)
    standing = np.array(DRIVER.default_position)
    # At 5.8 s it has come to its default pose; with no motion in between, it lies down from 6.1 s on.
    for time_s, wanted in ((0.0, lying), (4.0, standing), (5.5, standing), (5.8, standing), (6.1, standing)):
        np.testing.assert_allclose(behaviour.command(state, time_s).position_target, wanted, atol=1e-12)
    for time_s, wanted in ((plan.total_s, lying),):
        np.testing.assert_allclose(behaviour.command(state, time_s).position_target, wanted, atol=1e-12)
    assert isinstance(make_behaviour(dataclasses.replace(plan, stand=False), DRIVER), HoldBehaviour)


def test_a_robot_without_legs_cannot_be_asked_to_stand_up() -> None:
    """The message names the robot."""
    with pytest.raises(ConfigurationError, match="'cartpole' has no rest pose"):
        make_behaviour(RunPlan(robot="cartpole", motion="hold", stand=True), CARTPOLE)


def test_profiles_and_lengths_that_cannot_be_are_refused() -> None:
    """The length of a run is a finite number above 0 s."""
    with pytest.raises(UnknownNameError, match="dance"):
        RunPlan(robot="go2", motion="dance")  # type: ignore[arg-type]
    for seconds in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ConfigurationError, match="finite number of seconds above 0"):
            RunPlan(robot="go2", seconds=seconds)
