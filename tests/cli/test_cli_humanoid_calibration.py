"""A G1 and an H1 on a crane, from the wire to a calibration and a replay, in virtual time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.virtual_runs import record_run

from deal_hw.cli.calibrate import CalibrateDataset, calibrate
from deal_hw.clock import VirtualClock
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.g1.emulator.device import G1Device
from deal_hw.drivers.g1.emulator.truth import G1Truth
from deal_hw.drivers.g1.robot import G1Robot
from deal_hw.drivers.h1.emulator import H1Device, H1Truth
from deal_hw.drivers.h1.robot import H1Robot
from deal_hw.drivers.transports.virtual_topics import TopicCore, VirtualTopics
from deal_hw.drivers.unitree.emulated_humanoid import HumanoidTruth
from deal_hw.motions.scores.replay_error import replay_error
from deal_hw.transport import TopicTransport
from deal_hw.types import Trajectory
from deal_hw.workflows.calibration.run import CalibrateReport
from deal_hw.workflows.running.plan import RunPlan

HIDDEN = ("left_knee_joint", "left_elbow_joint")
"""Joints that differ from the model: of both kinds of an H1's motors."""
NAMES = ("stiffness", "damping")
LATENCY_MS = 6


@dataclass(frozen=True, kw_only=True)
class Humanoid:
    """A robot to calibrate.

    Attributes:
        name: Its name.
        truth: Its hidden parameters.
        device: Makes the emulated robot.
        driver: Makes the driver.
        seconds: Length of the multisine, which needs more time for more joints [s].
    """

    name: str
    truth: type[HumanoidTruth]
    device: Callable[[HumanoidTruth], TopicCore]
    driver: Callable[[TopicTransport, VirtualClock], G1Robot | H1Robot]
    seconds: float

    def hidden(self) -> HumanoidTruth:
        """Return hidden parameters of some joints; the others are the model's."""
        middle = self.truth.nominal("sensor", 5, robot=self.name, latency_ms=LATENCY_MS)
        drawn = self.truth.draw("sensor", 5, robot=self.name)
        chosen = np.isin(middle.joints, HIDDEN)
        own: dict[str, Any] = {
            entry: tuple(np.where(chosen, getattr(drawn, entry), getattr(middle, entry)).tolist())
            for entry in NAMES
        }
        return dataclasses.replace(middle, **own)

    def record(self, dataset: Dataset, seconds: float, **motion: str) -> Path:
        """Record a run of a new robot with the same hidden parameters."""
        clock = VirtualClock(10**9)
        robot = self.driver(VirtualTopics(self.device(self.hidden()), clock), clock)
        return record_run(robot, clock, dataset, RunPlan(robot=self.name, seconds=seconds, **motion))  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """The recordings of a robot.

    Attributes:
        robot: The robot.
        dataset: The folder: a multisine, a chirp.
        chirp: The chirp.
        replayed: Its replay.
    """

    robot: Humanoid
    dataset: Path
    chirp: Trajectory
    replayed: Trajectory


G1 = Humanoid(
    name="g1",
    truth=G1Truth,
    device=lambda truth: G1Device(truth),  # type: ignore[arg-type]
    driver=lambda topics, clock: G1Robot(topics, clock, hung_on_crane=True),
    seconds=7.0,
)
H1 = Humanoid(
    name="h1",
    truth=H1Truth,
    device=lambda truth: H1Device(truth),  # type: ignore[arg-type]
    driver=lambda topics, clock: H1Robot(topics, clock, hung_on_crane=True),
    seconds=5.0,
)


OF_AN_H1 = pytest.mark.parametrize("recorded", [H1], ids=["h1"], indirect=True)
"""A G1's calibration, of 29 joints and a longer multisine, takes more than three minutes."""


@pytest.fixture(scope="module", params=[G1, H1], ids=lambda robot: robot.name)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Collect a multisine and a chirp, and replay the chirp."""
    robot: Humanoid = request.param
    folder = tmp_path_factory.mktemp(robot.name)
    description = robot.truth.require(robot.name).to_json()
    with Dataset.create_or_open(folder / "dataset", description) as store:
        robot.record(store, robot.seconds, motion="excite", excite="multisine")
        chirp = robot.record(store, 4.0, motion="excite", excite="chirp")
    with Dataset.create_or_open(folder / "replay", description) as store:
        robot.record(store, 4.0, motion="replay", recording=str(chirp))
    return Recorded(
        robot=robot,
        dataset=folder / "dataset",
        chirp=Dataset.open(folder / "dataset").read(1).trajectory,
        replayed=Dataset.open(folder / "replay").read(0).trajectory,
    )


@pytest.fixture(scope="module")
def calibrated(recorded: Recorded) -> CalibrateReport:
    """Calibrate the hidden joints from the multisine."""
    return calibrate(
        CalibrateDataset(
            dataset=recorded.dataset,
            holdout=(1,),
            method="local",
            sample_hz=50.0,
            laws=False,
            free=tuple(f"{joint}.{name}" for joint in HIDDEN for name in NAMES),
            threads=1,
            report=False,
            advise=False,
            quiet=True,
        )
    )


def test_a_replay_moves_as_the_recording(recorded: Recorded) -> None:
    """To 5 mrad in each joint: noise of 1 mrad in both, and another phase of the motors' cycle."""
    found = replay_error(recorded.chirp, recorded.replayed)
    assert found is not None and found.seconds > 3.5
    assert found.position.max() < 0.005, dict(zip(found.joint_names, found.position, strict=True))
    np.testing.assert_allclose(
        recorded.replayed.position_target[-100:], recorded.chirp.position_target[-100:], atol=1e-6
    )


@pytest.mark.slow
@OF_AN_H1
def test_hidden_parameters_and_latency_are_found_over_the_wire(
    calibrated: CalibrateReport, recorded: Recorded
) -> None:
    """Gains to 3 %; the latency is the emulator's and the millisecond in which a message waits."""
    result = calibrated.result
    true = recorded.robot.hidden().parameters()
    wanted = np.array([true[name] for name in result.space.names])
    assert len(wanted) == len(HIDDEN) * len(NAMES)
    assert np.max(np.abs(result.estimate / wanted - 1.0)) < 0.03
    assert np.max(np.abs(result.space.nominal / wanted - 1.0)) > 0.1
    assert 1e-3 * LATENCY_MS - 5e-4 <= result.latency_s <= 1e-3 * LATENCY_MS + 1.5e-3


@pytest.mark.slow
@OF_AN_H1
@pytest.mark.usefixtures("recorded")
def test_held_out_motion_is_predicted_better(calibrated: CalibrateReport) -> None:
    """The chirp was not fitted; most joints are the model's already."""
    rmse = calibrated.result.provenance["heldout_rmse"]["mean"]
    assert rmse["calibrated"] < 0.7 * rmse["nominal"]
