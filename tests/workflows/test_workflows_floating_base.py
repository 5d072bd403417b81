"""Files of a robot with a free joint: its base's place, orientation and velocities, and its policy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import deal_hw
from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.paper.rollouts import control_ticks, recorded_states, rollout_population
from deal_hw.data.importing.columns import parse_column_map
from deal_hw.data.importing.load import load_tables
from deal_hw.errors import ConfigurationError, DatasetError, InsufficientDataError, UnknownNameError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.policies.demonstration import ASSETS, Demonstration, demonstration_policy
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.tangent_coordinates import to_quaternion
from deal_hw.sim.recordings.measured_base import turning_speed, with_measured_base
from deal_hw.sim.recordings.target import TargetRecording, record_target
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings
from deal_hw.workflows.import_export import ImportSettings, import_recordings
from deal_hw.workflows.own_robot.new import new_robot

POLICY = ASSETS / "ant_udr.onnx"
FACTORS = (1.5, 0.6)
"""True damping of hips and ankles over the model's."""
BASE = """\
orientation: {columns: [quaternion]}
gyro: {columns: [gyro]}
base_position: {columns: [place]}
base_velocity: {columns: [speed]}
"""


@dataclasses.dataclass(frozen=True)
class Ant:
    """An ant that its policy moved, and the files of it.

    Attributes:
        robot: The nominal model.
        space: Damping of hips and ankles.
        theta: Their true values.
        target: What was recorded.
        folder: rec.npz, columns.yaml, params.yaml.
    """

    robot: RobotModel
    space: ParameterSpace
    theta: FloatArray
    target: TargetRecording
    folder: Path

    def columns(self, name: str = "columns.yaml", base: str = BASE) -> Path:
        """Write a column map with these entries for the base."""
        joints = "".join(f"  - {joint}\n" for joint in self.robot.description.joint_names)
        path = self.folder / name
        path.write_text(f"time: time\nposition: q\nvelocity: dq\n{base}joints:\n{joints}", encoding="utf-8")
        return path

    def settings(self, **changes: Any) -> FilesSettings:
        """A calibration by distributions of motion; all that was recorded is exact."""
        names = (*self.robot.description.joint_names, "orientation", "gyro", "base_position", "base_velocity")
        values: dict[str, Any] = {
            "model": self.robot.description.mjcf,
            "data": (self.folder / "rec.npz",),
            "columns": self.columns(),
            "parameters": self.folder / "params.yaml",
            "policy": POLICY,
            "method": "mmd-unaligned",
            "physics_step": self.robot.step_s,
            "latency": 0.0,
            "residual_std": dict.fromkeys(names, 1e-6),
            "threads": 1,
        }
        return FilesSettings(**{**values, **changes})


@pytest.fixture(scope="module")
def ant(tmp_path_factory: pytest.TempPathFactory) -> Ant:
    """Five seconds of an ant with other dampings than its model's, without noise."""
    folder = tmp_path_factory.mktemp("ant")
    case = make_case("ant", "ideal", 3, 3.0, seconds=1.0)
    robot, description = case.robot, case.robot.description
    space = ParameterSpace(
        [
            Parameter.around(name, own.kind, own.elements, own.unit, own.nominal)
            for name, own in (("hips", case.space["hip.damping"]), ("ankles", case.space["ankle.damping"]))
        ]
    )
    theta = space.nominal * np.array(FACTORS)
    behaviour = Demonstration(demonstration_policy("ant"), description)
    rng = np.random.default_rng(0)
    target = record_target(robot, space, theta, behaviour, seconds=5.0, rng=rng)
    episode, rotation = target.episode, robot.rotation
    assert episode.reference is not None
    np.savez(
        folder / "rec.npz",
        time=episode.sample * episode.step_s,
        q=episode.position[:, robot.joints],
        dq=episode.velocity[:, robot.joints],
        place=episode.position[:, :3],
        speed=episode.velocity[:, :3],
        quaternion=to_quaternion(episode.position[:, rotation], episode.reference),
        gyro=episode.velocity[:, rotation],
        joint_names=np.array(description.joint_names),
    )
    entries = "".join(
        f"  - {{kind: {p.kind}, elements: [{', '.join(p.elements)}], group: together, name: {p.name}, "
        f"nominal: {p.nominal:g}, ratio: 3}}\n"
        for p in space
    )
    (folder / "params.yaml").write_text(f"parameters:\n{entries}", encoding="utf-8")
    return Ant(robot, space, theta, target, folder)


def test_the_free_joint_gets_the_recorded_base(ant: Ant) -> None:
    """In every simulator with the true values the policy repeats two thirds of a second of the file."""
    work = calibration_input(ant.settings())
    problem = Problem(
        work.robot,
        work.space,
        work.episodes,
        threads=1,
        policy=work.policy,
        fixed_latency_s=0.0,
        known_std=work.known_std,
    )
    assert work.policy is not None
    population = Members(np.stack([ant.theta, ant.space.nominal]), np.zeros(2))
    for index in range(len(work.episodes)):
        ticks = control_ticks(problem, index, 33, work.policy.history, ran_before=True)
        position, velocity, action = rollout_population(problem, population, index, ticks)
        places, speeds = recorded_states(problem, index, ticks.sample)
        assert np.abs(position[0] - places).max() < 1e-9 and np.abs(velocity[0] - speeds).max() < 1e-8
        wanted = problem.episodes[index].target[ticks.action]
        assert np.abs(action[0] - wanted).max() < 1e-9
        assert np.abs(position[1] - places).max() > 1e-2


@pytest.mark.slow
def test_distributions_of_the_whole_state_find_the_truth(ant: Ant) -> None:
    """Both dampings within 10 % from drawn start states, where the model's are 33 and 67 % off."""
    settings = ant.settings(population=40, generations=25, starts="drawn")
    names = [field.name for field in dataclasses.fields(settings) if field.name not in ("model", "data")]
    values = {name: getattr(settings, name) for name in names}
    found = deal_hw.calibrate(settings.model, settings.data, **values)
    assert found.result.provenance["start_states"] == "drawn"
    np.testing.assert_allclose(found.result.estimate, ant.theta, rtol=0.1)


def test_axes_units_and_order_of_the_base(ant: Ant) -> None:
    """Millimetres, a velocity along the base's axes and a quaternion that ends with w are the same base."""
    with np.load(ant.folder / "rec.npz") as stored:
        arrays = dict(stored)
    plain = load_tables(ant.folder / "rec.npz", parse_column_map(_map(ant, BASE)))[0]
    w, axis = arrays["quaternion"][:, :1], -arrays["quaternion"][:, 1:]
    turned = np.cross(axis, arrays["speed"])
    arrays["speed"] = arrays["speed"] + 2 * (w * turned + np.cross(axis, turned))
    arrays["place"] = 1e3 * arrays["place"]
    arrays["quaternion"] = arrays["quaternion"][:, [1, 2, 3, 0]]
    np.savez(ant.folder / "other.npz", **arrays)
    text = BASE.replace("[place]", "[place], unit: mm").replace("[speed]", "[speed], frame: base")
    text = text.replace("[quaternion]", "[quaternion], order: xyzw")
    other = load_tables(ant.folder / "other.npz", parse_column_map(_map(ant, text)))[0]
    for name in ("base_position", "base_velocity", "orientation", "gyro"):
        np.testing.assert_allclose(getattr(other, name), getattr(plain, name), atol=1e-12)
    with pytest.raises(DatasetError, match="no orientation to turn them"):
        lines = [line for line in text.splitlines() if "orientation" not in line]
        load_tables(ant.folder / "other.npz", parse_column_map(_map(ant, "\n".join(lines))))


def _map(ant: Ant, base: str) -> Any:
    import yaml

    joints = list(ant.robot.description.joint_names)
    return {"time": "time", "position": "q", "velocity": "dq", "joints": joints, **yaml.safe_load(base)}


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("base_position: {columns: [place], unit: deg}", "unit of base_position 'deg'"),
        ("base_velocity: {columns: [speed], frame: body}", "frame of a velocity 'body'"),
        ("gyro: {columns: [gyro], unit: mm}", "unit of gyro 'mm'"),
    ],
)
def test_other_units_and_frames_are_refused(ant: Ant, entry: str, words: str) -> None:
    """The message lists those that there are."""
    with pytest.raises(UnknownNameError, match=words):
        parse_column_map(_map(ant, entry))


@pytest.mark.parametrize(
    ("without", "words"),
    [
        ("base_position", "observes a base, whose state rec.npz does not hold; name base_position"),
        ("orientation", "observes a base, whose state rec.npz does not hold; name base_position"),
    ],
)
def test_a_base_that_the_policy_saw_and_the_file_lacks_is_refused(ant: Ant, without: str, words: str) -> None:
    """Before anything is simulated, with the entry that is missing."""
    base = "".join(f"{line}\n" for line in BASE.splitlines() if not line.startswith(without))
    with pytest.raises(ConfigurationError, match=words):
        calibration_input(ant.settings(columns=ant.columns(f"{without}.yaml", base)))


def test_a_start_state_that_is_missing_is_refused(ant: Ant) -> None:
    """A place without an orientation, feet beside a place; and neither place nor feet."""
    with np.load(ant.folder / "rec.npz") as stored:
        arrays = dict(stored)
    np.savez(ant.folder / "commands.npz", **arrays, u=np.tile(np.sin(arrays["time"])[:, None], (1, 8)))
    plain = {"policy": None, "method": "", "search": "eki", "residual_std": (), "force": True}
    for name, base, feet, words in (
        ("place", "base_position: {columns: [place]}\n", (), "without its orientation at every sample"),
        ("feet", BASE, ("floor",), "--feet would have no effect"),
        ("nothing", "", (), "name base_position and orientation of motion capture"),
    ):
        columns = ant.columns(f"{name}.yaml", f"{base}target: u\n")
        settings = ant.settings(data=(ant.folder / "commands.npz",), columns=columns, feet=feet, **plain)
        with pytest.raises(ConfigurationError, match=words):
            calibration_input(settings)


def test_velocities_that_were_not_recorded_come_from_the_poses(ant: Ant) -> None:
    """Angular ones from orientations, within 5 % of a steady turn; a short recording is refused."""
    angle = 0.8 * np.arange(50) * 0.02
    quaternion = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
    np.testing.assert_allclose(turning_speed(quaternion, 0.02), np.tile([0, 0, 0.8], (50, 1)), atol=1e-9)
    base = "orientation: {columns: [quaternion]}\nbase_position: {columns: [place]}\n"
    work = calibration_input(ant.settings(columns=ant.columns("poses.yaml", base), residual_std=()))
    episode = work.episodes[0]
    assert work.shown is not None and episode.measured is not None
    assert np.flatnonzero(episode.measured).size == 14 + 3
    assert np.isfinite(episode.velocity[:, 3:]).all()
    short = dataclasses.replace(episode, sample=episode.sample[:3])
    with pytest.raises(InsufficientDataError, match="at least 7; record longer"):
        with_measured_base(short, work.robot, work.shown)


def test_a_dataset_says_that_it_does_not_hold_the_place(ant: Ant, tmp_path: Path) -> None:
    """It holds orientation and gyro; the place is used from the file."""
    said: list[str] = []
    yaml = new_robot(ant.robot.description.mjcf, out=tmp_path / "robot.yaml", name="walker")
    config = ImportSettings(
        paths=(ant.folder / "rec.npz",),
        out=tmp_path / "dataset",
        robot=yaml,
        columns=ant.columns(),
        policy=POLICY,
        dry_run=True,
    )
    import_recordings(config, said.append)
    assert any("base_position" in line and "--model" in line for line in said)
