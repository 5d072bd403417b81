"""The suspended Go2 from its wire to a calibration, in virtual time; excitations that keep its legs apart."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.virtual_runs import record_run

from deal_hw.cli.calibrate import CalibrateDataset, calibrate
from deal_hw.cli.design_excitation import KINDS as DESIGN_EXCITATION
from deal_hw.cli.design_excitation import design_excitation
from deal_hw.clock import VirtualClock
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as SIMULATED
from deal_hw.drivers.go2.descriptions.floor import LEGS
from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import Go2Truth, draw_truth
from deal_hw.drivers.go2.robot import Go2OnStandRobot
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.errors import ConfigurationError
from deal_hw.motions.excitation.limits import room
from deal_hw.motions.excitation.plan import ExcitationDesign, make_plan, read_plan
from deal_hw.robots import parameter_spaces
from deal_hw.workflows.calibration.run import CalibrateReport
from deal_hw.workflows.running.plan import RunPlan

HIPS = tuple(f"{leg}_hip_joint.{name}" for leg in LEGS for name in ("stiffness", "damping"))


def record(device: Go2Device, dataset: Dataset, plan: RunPlan) -> None:
    """Record a run of an emulated robot in virtual time."""
    clock = VirtualClock(10**9)
    record_run(Go2OnStandRobot(VirtualTopics(device, clock), clock), clock, dataset, plan)


@pytest.fixture(scope="module")
def truth() -> Go2Truth:
    """Return hidden parameters whose hips alone differ from the model."""
    drawn = draw_truth("sensor", 5)
    hip = np.arange(12) % 3 == 0
    ones = np.ones(12)
    return dataclasses.replace(
        drawn,
        stiffness=tuple(np.where(hip, drawn.stiffness, ones)),
        damping=tuple(np.where(hip, drawn.damping, ones)),
        joint_damping=(0.6,) * 12,
        frictionloss=(0.2,) * 12,
        armature=(0.01,) * 12,
        latency_ms=6,
    )


@pytest.fixture(scope="module")
def dataset(truth: Go2Truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset with a multisine and a chirp of the suspended robot."""
    folder = tmp_path_factory.mktemp("run") / "dataset"
    with Dataset.create_or_open(folder, DESCRIPTION.to_json()) as store:
        for kind, seconds in (("multisine", 4.0), ("chirp", 2.4)):
            device = Go2Device(truth, on_stand=True, sport="")
            plan = RunPlan(robot="go2_on_stand", motion="excite", excite=kind, seconds=seconds)
            record(device, store, plan)
    return folder


@pytest.fixture(scope="module")
def calibrated(dataset: Path) -> CalibrateReport:
    """Calibrate the hips."""
    config = CalibrateDataset(
        dataset=dataset,
        holdout=(1,),
        method="local",
        sample_hz=100.0,
        free=HIPS,
        threads=1,
        report=False,
        advise=False,
        quiet=True,
    )
    return calibrate(config)


def test_the_recording_has_states_at_500_hz_and_commands_at_50(dataset: Path) -> None:
    """Every state knows its command; the driver fills in what the wire does not say."""
    trajectory = Dataset.open(dataset).read(0).trajectory
    assert np.median(np.diff(trajectory.device_s)) == pytest.approx(2e-3)
    assert len(trajectory.sent_sequence) == 200
    numbers, counts = np.unique(trajectory.command_sequence[20:-20], return_counts=True)
    assert np.median(counts) == 10
    assert (np.diff(numbers) == 1).all()


@pytest.mark.slow
def test_hidden_gains_and_latency_are_found_over_the_wire(
    calibrated: CalibrateReport, truth: Go2Truth
) -> None:
    """Gains to 3 %; the latency is the emulator's 6 ms plus the millisecond in which a message waits."""
    result = calibrated.result
    true = truth.parameters(DESCRIPTION.stiffness[0], DESCRIPTION.damping[0])
    wanted = np.array([true[name] for name in result.space.names])
    assert set(result.space.names) == set(HIPS)
    assert np.max(np.abs(result.estimate / wanted - 1.0)) < 0.03
    assert 0.0055 <= result.latency_s <= 0.0075


@pytest.mark.slow
def test_held_out_motion_is_predicted_four_times_better(calibrated: CalibrateReport) -> None:
    """The chirp was not fitted."""
    rmse = calibrated.result.provenance["heldout_rmse"]["mean"]
    assert rmse["calibrated"] < 0.25 * rmse["nominal"]


def test_parameter_sets_of_the_suspended_robot() -> None:
    """Gains, friction and armature of each joint; encoder biases, shared values, knee friction on request."""
    counts = {name: len(make()) for name, make in parameter_spaces("go2_on_stand").items()}
    assert counts == {"default": 48, "biased": 60, "shared": 12, "linkage": 56, "laws": 21}


def leg_distance(joints: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Return the least distance between shapes of two legs [m]."""
    model = mujoco.MjModel.from_xml_path(str(SIMULATED.mjcf))
    data = mujoco.MjData(model)
    for name, value in zip(SIMULATED.joint_names, joints, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    of_leg: dict[str, list[int]] = {leg: [] for leg in LEGS}
    for geom in range(model.ngeom):
        body = model.body(model.geom_bodyid[geom]).name
        if body[:2] in of_leg:
            of_leg[body[:2]].append(geom)
    pairs = [
        (a, b)
        for i, one in enumerate(LEGS)
        for other in LEGS[i + 1 :]
        for a in of_leg[one]
        for b in of_leg[other]
    ]
    return float(min(mujoco.mj_geomDistance(model, data, a, b, 0.5, None) for a, b in pairs))


def test_legs_stay_apart_wherever_an_excitation_takes_them() -> None:
    """Corners of the range: at least 2.5 cm; beyond it, both hips inwards by 0.9 rad, legs cross."""
    low, high = np.array(DESCRIPTION.excitation_range).T
    rng = np.random.default_rng(0)
    corners = [np.where(rng.integers(0, 2, 12) == 1, high, low) for _ in range(80)]
    assert min(leg_distance(c) for c in corners) > 0.025
    crossed = np.array(SIMULATED.default_position)
    crossed[[0, 3]] = -0.9, 0.9
    assert leg_distance(crossed) < 0


@pytest.mark.parametrize("family", ["multisine", "chirp", "steps"])
@pytest.mark.parametrize("seed", range(3))
def test_all_families_keep_the_range(family: str, seed: int) -> None:
    """All twelve joints at once."""
    design = ExcitationDesign(family=family, seconds=8.0, seed=seed)  # type: ignore[arg-type]
    plan = make_plan(DESCRIPTION, design)
    targets = np.array(DESCRIPTION.default_position) + plan.offsets(np.arange(0.0, 8.0, 0.02))
    low, high = np.array(DESCRIPTION.excitation_range).T
    assert ((low <= targets) & (targets <= high)).all()
    assert (np.ptp(targets, axis=0) > 0.1).all()


def test_a_range_beyond_the_limits_does_not_count() -> None:
    """The limits hold whatever the range."""
    wide = dataclasses.replace(DESCRIPTION, excitation_range=((-9.0, 9.0),) * 12)
    assert np.array_equal(room(wide), room(dataclasses.replace(DESCRIPTION, excitation_range=())))


def test_a_range_of_the_wrong_length_is_refused() -> None:
    """One pair for each actuated joint."""
    with pytest.raises(ConfigurationError, match="excitation_range has 2 entries, expected 12"):
        dataclasses.replace(DESCRIPTION, excitation_range=((-1.0, 1.0),) * 2)


def test_swaying_is_planned_for_the_driven_robot_and_keeps_its_limits(tmp_path: Path) -> None:
    """The file fits the robot on the wire; feet would slip if joints were scaled one by one."""
    path = tmp_path / "sway.json"
    design_excitation(
        DESIGN_EXCITATION.settings(robot="go2", out=path, family="sway", seconds=3.0, high_hz=3.0, quiet=True)
    )
    plan = read_plan(path)
    plan.check_fits(DRIVER)
    targets = np.array(DRIVER.default_position) + plan.offsets(np.arange(0.0, 3.0, 0.02))
    low, high = np.array(DRIVER.limits.target).T
    assert ((low <= targets) & (targets <= high)).all()
    assert np.ptp(targets, axis=0).min() > 0.02
    assert np.abs(np.diff(targets, axis=0)).max() < np.array(DRIVER.limits.target_step).min()


def test_only_robots_on_their_feet_sway(tmp_path: Path) -> None:
    """A suspended robot has no standing feet."""
    with pytest.raises(ConfigurationError, match=r"stand on feet \(go2, b2\)"):
        design_excitation(
            DESIGN_EXCITATION.settings(
                robot="go2_on_stand", out=tmp_path / "x.json", family="sway", quiet=True
            )
        )


def test_playing_a_planned_sway_needs_no_simulator(tmp_path: Path) -> None:
    """The robot's computer reads a table."""
    path = tmp_path / "sway.json"
    design_excitation(
        DESIGN_EXCITATION.settings(robot="go2", out=path, family="sway", seconds=1.0, quiet=True)
    )
    code = (
        "import json, sys\n"
        "from deal_hw.workflows.running.plan import RunPlan, make_behaviour\n"
        "from deal_hw.drivers.go2.descriptions.driver import DRIVER\n"
        f"plan = RunPlan(robot='go2', motion='excite', excite={str(path)!r}, seconds=1.0)\n"
        "make_behaviour(plan, DRIVER)\n"
        "print(json.dumps([n for n in ('mujoco', 'torch', 'scipy') if n in sys.modules]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
