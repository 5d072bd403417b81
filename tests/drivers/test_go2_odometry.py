"""A Go2's walk by its own sensors, against the emulator's truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.control.process.channel import Outcome
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.emulator.truth import draw_truth
from deal_hw.motions.scores.velocity_error import VelocityError, velocity_error, wanted_velocity
from deal_hw.motions.velocity import ScriptVelocity
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.robots import walked
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.legged.weighing import standing_mass
from deal_hw.workflows.emulation.virtual_go2 import VirtualWalk, walk
from deal_hw.workflows.emulation.walk_script import write_script
from deal_hw.workflows.shipped import shipped_policy

SEED = 1
SECONDS = 7.0
TOLERANCE_M_S = 0.04
"""Mean velocities of a part: feet slide where they land."""


def walk_for(seconds: float, folder: Path) -> VirtualWalk:
    """Walk ahead, then to the left and turning, with a robot that has hidden physics."""
    script = ((0.0, (0.8, 0.0, 0.0)), (3.5, (0.0, 0.4, 0.6)))
    policy = OnnxPolicy(Path(str(shipped_policy("go2"))))
    source = ScriptVelocity(write_script(folder / "script.csv", script))
    metadata = {"robot": "go2", "seconds": seconds}
    return walk(draw_truth("realistic", SEED), policy, source, seconds, folder / "walk.mcap", metadata)


@pytest.fixture(scope="module")
def walking(tmp_path_factory: pytest.TempPathFactory) -> VirtualWalk:
    """Walk both parts."""
    return walk_for(SECONDS, tmp_path_factory.mktemp("walk"))


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> VirtualWalk:
    """Stand up, and walk for half a second."""
    return walk_for(0.5, tmp_path_factory.mktemp("begun"))


def by_truth(walking: VirtualWalk) -> VelocityError:
    """Return the errors by where the base really was."""
    assert walking.wanted is not None
    found = velocity_error(walking.track, walking.wanted)
    assert found is not None
    return found


@pytest.mark.slow
def test_legs_and_imu_tell_the_velocity_to_4_cm_a_second(walking: VirtualWalk) -> None:
    """Each part's mean velocity, and the whole walk's error, as the truth has it."""
    assert walking.report.outcome is Outcome.FINISHED
    assert walking.trajectory is not None
    track, wanted = walked("go2", walking.trajectory), wanted_velocity(walking.trajectory)
    assert track is not None and wanted is not None
    own, true = velocity_error(track, wanted), by_truth(walking)
    assert own is not None
    assert own.parts.keys() == true.parts.keys() == {"0.8,0,0", "0,0.4,0.6"}
    for name, part in true.parts.items():
        np.testing.assert_allclose(own.parts[name][2:4], part[2:4], atol=TOLERANCE_M_S)
        np.testing.assert_allclose(own.parts[name][4], part[4], atol=0.01)
    assert own.velocity_m_s == pytest.approx(true.velocity_m_s, abs=TOLERANCE_M_S)


def test_the_standing_robot_weighs_itself(begun: VirtualWalk) -> None:
    """Before it walks, by its motors' efforts: its hidden payload comes out to 0.3 kg."""
    recorded = begun.trajectory
    assert recorded is not None and recorded.body is not None
    wanted = wanted_velocity(recorded)
    assert wanted is not None
    since_s = recorded.receive_s - wanted.time_s[0]
    rows = (since_s > -0.35) & (since_s < 0.0)
    robot = load_model(DRIVER)
    mass = standing_mass(
        robot, recorded.body.orientation[rows], recorded.position[rows], recorded.effort[rows]
    )
    payload = draw_truth("realistic", SEED).payload_kg
    assert mass == pytest.approx(float(robot.model.body_mass.sum()) + payload, abs=0.3)


def test_a_robot_without_legs_does_not_walk(begun: VirtualWalk) -> None:
    """Nothing is computed for a cart-pole."""
    assert begun.trajectory is not None
    assert walked("cartpole", begun.trajectory) is None
