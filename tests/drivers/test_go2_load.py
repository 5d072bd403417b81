"""What an emulated Go2 carries, what it stands on, and the file of where it is."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deal_hw.drivers.go2.descriptions.floor import JOINTS, TRUNK_KG, walk_space
from deal_hw.drivers.go2.descriptions.on_stand import on_floor
from deal_hw.drivers.go2.descriptions.on_stand_recording import parameter_space
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import Go2Truth, draw_truth, nominal_truth
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.workflows.emulation.go2 import read_track, tracking

GRAVITY = 9.81


def standing_force(truth: Go2Truth) -> float:
    """Return what the floor bears of a standing robot, by the foot sensors of its simulation [N]."""
    device = Go2Device(truth, start="standing")
    forces = []
    for _ in range(200):
        device.tick()
        forces.append(device._sim.foot_force().sum())
    return float(np.mean(forces))


def test_the_floor_bears_the_payload() -> None:
    """2 kg more are 2 kg more under the feet."""
    plain, loaded = nominal_truth(), nominal_truth(payload_kg=2.0)
    assert standing_force(loaded) - standing_force(plain) == pytest.approx(2.0 * GRAVITY, rel=0.02)


def test_only_the_realistic_profile_hides_payload_and_floor() -> None:
    """Between 0 and 2 kg and 0.5 and 1.1; the other draws stay what they were without."""
    drawn = [draw_truth("realistic", seed) for seed in range(20)]
    assert {t.payload_kg for t in (draw_truth("sensor", 1), draw_truth("ideal", 1))} == {0.0}
    assert all(0.0 <= t.payload_kg <= 2.0 and 0.5 <= t.floor_friction <= 1.1 for t in drawn)
    assert len({t.payload_kg for t in drawn}) == 20
    assert draw_truth("realistic", 3).stiffness == draw_truth("sensor", 3).stiffness


def test_a_truth_comes_back_from_its_file() -> None:
    """With payload and floor; a payload below nothing is refused."""
    truth = draw_truth("realistic", 4)
    assert Go2Truth.from_json(truth.to_json()) == truth
    with pytest.raises(ConfigurationError, match="payload_kg"):
        Go2Truth.from_json({**truth.to_json(), "payload_kg": -1.0})


def test_the_truth_has_the_names_of_what_a_walk_tells() -> None:
    """Each parameter of the set `walk` has its true value; the nominal robot has the nominal ones."""
    space = walk_space()
    true = nominal_truth().walk_parameters()
    np.testing.assert_allclose([true[p.name] for p in space], space.nominal, rtol=1e-12)
    loaded = dataclasses.replace(nominal_truth(), payload_kg=1.0, floor_friction=0.6).walk_parameters()
    assert loaded["base.mass"] == TRUNK_KG + 1.0 and loaded["floor.friction"] == 0.6


def test_what_the_stand_tells_is_carried_over_to_the_floors_gains() -> None:
    """A motor that doubles its gains does so with those of the floor; shares of the damping grow with it."""
    space = parameter_space()
    truth = dataclasses.replace(nominal_truth(), stiffness=(2.0,) * 12, damping=(1.2,) * 12)
    mean = np.array([truth.parameters(20.0, 1.5)[p.name] for p in space])
    found = ParameterDistribution(
        space=space, mean=mean, covariance=0.01 * np.eye(len(space)), latency_s=(0.004, 0.006)
    )
    floor = on_floor(found)
    values = dict(zip(floor.space.names, floor.mean, strict=True))
    true = truth.walk_parameters()
    for joint in JOINTS:
        for gain in ("stiffness", "damping"):
            assert values[f"{joint}.{gain}"] == pytest.approx(true[f"{joint}.{gain}"])
    assert floor.covariance is not None
    share = np.sqrt(np.diag(floor.covariance))
    stiffness, damping = (
        floor.space.names.index(f"{JOINTS[0]}.stiffness"),
        floor.space.names.index(f"{JOINTS[0]}.damping"),
    )
    assert share[stiffness] == pytest.approx(0.1)
    assert share[damping] == pytest.approx(0.1 * 2.4 / 1.8)


def test_the_file_of_the_track_says_where_the_base_is(tmp_path: Path) -> None:
    """A row each 10 ms of the robot's clock, with the tick that it began at."""
    device = Go2Device(nominal_truth(), start="standing")
    file = tmp_path / "track.csv"
    with tracking(file, device, 5000) as track:
        for _ in range(100):
            device.tick()
            track()
    found = read_track(file)
    np.testing.assert_allclose(np.diff(found.time_s), 0.01, atol=1e-9)
    assert 5.0 <= found.time_s[0] < 5.02
    np.testing.assert_allclose(found.place[-1], device.base_position[:2], atol=1e-3)
    np.testing.assert_allclose(found.heading, 0.0, atol=0.02)
    file.write_text("t,x,y\n1,2,3\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="time_s,x,y,heading"):
        read_track(file)
