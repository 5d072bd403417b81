"""Options of collect, deploy and replay that depend on the robot."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.motions.posture import PostureConfig
from deal_hw.robots.connect import make_robot
from deal_hw.transport import WireOptions
from deal_hw.types import Trajectory
from deal_hw.workflows import replay
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.settings import Go2LinkOptions, LegOptions, LinkOptions, plan_options


@pytest.mark.parametrize(
    ("robot", "transport", "stand"),
    [("cartpole", "serial", False), ("go2", "dds", True), ("go2_on_stand", "dds", False)],
)
def test_defaults_follow_from_the_robot(robot: str, transport: str, stand: bool) -> None:
    """A robot on legs stands up first, unless it hangs in the air; each is reached its usual way."""
    plan = RunPlan(**plan_options(robot, LinkOptions(), LegOptions()))
    assert (plan.robot, plan.transport, plan.stand) == (robot, transport, stand)
    assert plan == RunPlan(robot=robot, transport=transport, stand=stand)


def test_what_is_given_wins() -> None:
    """Every option reaches the plan."""
    wire = WireOptions(domain=7, listen=True, insecure=True, ca=Path("ca.pem"))
    posture = PostureConfig(fold_s=1.0)
    plan = RunPlan(
        **plan_options(
            "go2",
            Go2LinkOptions(transport="zenoh", record_wire=False, wire=wire),
            LegOptions(
                stand=True,
                velocity="remote",
                hand_back=True,
                posture=posture,
                stop_buttons="R2+A",
                support_check=False,
            ),
        )
    )
    assert plan == RunPlan(
        robot="go2",
        transport="zenoh",
        record_wire=False,
        wire=wire,
        stand=True,
        velocity="remote",
        hand_back=True,
        posture=posture,
        robot_settings={"stop_buttons": "R2+A", "support_check": False},
    )


def test_a_robot_without_a_driver_is_refused() -> None:
    """It has a description only; one that nobody knows is unknown."""
    with pytest.raises(ConfigurationError, match="has no driver"):
        plan_options("go2_suspended", LinkOptions(), LegOptions())
    with pytest.raises(UnknownNameError, match="go3"):
        plan_options("go3", LinkOptions(), LegOptions())


def test_the_drivers_own_settings_are_carried_where_they_were_given() -> None:
    """As the driver's keyword arguments; a robot whose driver knows no such setting refuses them."""
    options = plan_options("go2", Go2LinkOptions(state_check="length"), LegOptions(support_check=False))
    settings = options["robot_settings"]
    assert settings == {"support_check": False, "state_check": "length"}
    clock = VirtualClock()
    link = Go2LinkOptions(simulator="unitree_mujoco")
    simulated = plan_options("go2", link, LegOptions())["robot_settings"]
    assert simulated == {"simulator": "unitree_mujoco"}
    assert make_robot("go2", "zenoh", "tcp/127.0.0.1:7447", clock, None, simulated).notice
    assert make_robot("go2", "zenoh", "tcp/127.0.0.1:7447", clock, None, settings).info is None  # type: ignore[attr-defined]
    with pytest.raises(ConfigurationError, match="--support-check, --state-check would have no effect"):
        make_robot("cartpole", "serial", "/dev/ttyUSB0", clock, None, settings)


def test_a_recording_that_stands_up_is_replayed_without_standing_up(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its first targets are those of a lying robot: one that already stands would fall."""
    empty, none, column = np.empty(0), np.empty(0, dtype=np.int64), np.ones((3, 12))
    recording = Trajectory(
        joint_names=DRIVER.joint_names,
        actuated=DRIVER.actuated,
        receive_s=empty,
        device_s=empty,
        position=empty,
        velocity=empty,
        effort=empty,
        status=none,
        command_sequence=none,
        command_age_s=empty,
        sent_s=np.array([0.0, 0.02, 0.04]),
        sent_sequence=np.arange(3),
        requested_position=column,
        position_target=column,
        stiffness=column,
        damping=column,
        effort_limit=column,
        speed_limit=column,
        metadata={"robot": "go2", "stand": True},
    )
    lying = dataclasses.replace(recording, metadata={"robot": "go2", "stand": False})
    plans: list[RunPlan] = []
    monkeypatch.setattr(replay, "run_episodes", lambda plan, **more: plans.append(plan))
    path = tmp_path / "000000.mcap"
    path.touch()

    def replayed(found: Trajectory, **more: Any) -> bool:
        monkeypatch.setattr(replay, "read_trajectory", lambda path: found)
        replay.replay(path, port="127.0.0.1", legs=LegOptions(**more))
        return plans[-1].stand

    assert replayed(lying) and not replayed(recording) and not replayed(recording, stand=False)
    with pytest.raises(ConfigurationError, match="the recording stands up and lies down itself"):
        replayed(recording, stand=True)
