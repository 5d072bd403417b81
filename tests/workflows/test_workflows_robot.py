"""A robot that deal-hw does not know: from MJCF and CSV files to an inspected calibration; refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

import deal_hw
from deal_hw.cli.main import EXIT_ERROR, EXIT_OK, main
from deal_hw.control.process.channel import Outcome
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.robots import robot_entry
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.workflows.robot import described, entry_of, load_robot
from deal_hw.workflows.running.supervised import InterruptedRunError


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a pendulum's robot.xml, robot.yaml, recordings, and a dataset of them."""
    folder = tmp_path_factory.mktemp("pendulum")
    write(make_robot("pendulum", seed=1), folder, seconds=4.0)
    assert main(["robot", "new", str(folder / "robot.xml"), "--name", "swing"]) == EXIT_OK
    files = [str(folder / name) for name in ("fit1.csv", "held-out.csv")]
    robot = ["--robot", str(folder / "robot.yaml")]
    assert main(["data", "import", *files, *robot, "--out", str(folder / "run" / "dataset")]) == EXIT_OK
    return folder


@pytest.mark.slow
def test_from_two_files_to_an_inspected_calibration(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """new, check, import, info, calibrate, inspect; nothing after the import names robot or model."""
    dataset = made / "run" / "dataset"
    assert main(["robot", "check", str(made / "robot.yaml")]) == EXIT_OK
    reported = capsys.readouterr().out
    assert "robot.yaml and MJCF agree" in reported and "holding for 1 s: stable" in reported
    assert "note velocity_limit: missing for" in reported
    assert main(["data", "info", str(dataset)]) == EXIT_OK
    assert "its robot" in capsys.readouterr().out
    assert main(["data", "verify", str(dataset)]) == EXIT_OK
    words = [str(dataset), "--holdout", "1", "--threads", "1", "--quiet"]
    assert main(["calibrate", *words]) == EXIT_OK
    result = json.loads((made / "run" / "calibration" / "result.json").read_text(encoding="utf-8"))
    assert result["method"].startswith("output-error")
    episode = dataset / "episodes" / "000001.mcap"
    shown = deal_hw.inspect(episode, calibration=made / "run" / "calibration")
    nominal, calibrated = (sum(v for v in row.values() if isinstance(v, float)) for row in shown.rows())
    assert shown.description.name == "swing" and calibrated < nominal


def test_files_and_names_become_entries_of_one_type(made: Path) -> None:
    """A robot.yaml and a dataset's robot have no wires; they are simulated and calibrated as any other."""
    for robot in (made / "robot.yaml", made / "run" / "dataset"):
        entry = entry_of(str(robot))
        assert (entry.recorded_description().name, entry.driven) == ("swing", False)
        assert len(entry.parameter_spaces()["default"]()) > 0
    assert entry_of("cartpole") is robot_entry("cartpole")


CART = """<mujoco model="cart"><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="cart"><geom type="box" size="0.05 0.04 0.03" mass="0.5"/>
<joint name="slide" type="slide" axis="1 0 0" range="-0.5 0.5" damping="2" frictionloss="0.3"/>
<body><joint name="pole" axis="0 1 0" damping="0.004"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.008" mass="0.12"/></body></body></worldbody>
<actuator><motor joint="slide" gear="{gear}" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("gear", [pytest.param(16, marks=pytest.mark.slow), 30])
def test_a_cart_with_a_motor_stays_on_its_track(gear: int, tmp_path: Path) -> None:
    """25 and 50 m/s2, trips at 2 m/s: each excitation is played to its end, and the cart does move."""
    (tmp_path / "cart.xml").write_text(CART.format(gear=gear), encoding="utf-8")
    robot = tmp_path / "robot.yaml"
    assert main(["robot", "new", str(tmp_path / "cart.xml"), "--out", str(robot)]) == EXIT_OK
    text = robot.read_text(encoding="utf-8").replace("velocity_limit: null", "velocity_limit: 2.0", 1)
    robot.write_text(text.replace("sensor_noise: 0.0", "sensor_noise: 0.0005"), encoding="utf-8")
    for seed, excite in enumerate(("multisine", "chirp", "")):
        simulation = deal_hw.SimulationOptions(simulated=True, truth_seed=seed)
        report = deal_hw.collect(
            str(robot), simulation=simulation, out=tmp_path / str(seed), seed=seed, excite=excite
        )
        (episode,) = report.episodes[-1:]
        assert episode.outcome is Outcome.FINISHED, episode.reason
        assert episode.motion is not None and episode.motion.position_range[0] > 0.03


def test_a_dataset_and_the_files_themselves_give_the_same(made: Path) -> None:
    """Recordings that went through a dataset are fitted as those that did not."""
    files = [made / "fit1.csv"], made / "held-out.csv"
    short: dict[str, Any] = {
        "population": 8,
        "generations": 2,
        "refine": False,
        "threads": 1,
    }
    one = deal_hw.calibrate(made / "robot.xml", files[0], holdout=files[1], **short)
    other = deal_hw.calibrate(dataset=made / "run" / "dataset", episodes=[0], holdout=[1], **short)
    assert one.result.space.names == other.result.space.names
    assert one.result.estimate == pytest.approx(other.result.estimate, rel=1e-6)


def test_parameters_of_a_carried_robot(made: Path, tmp_path: Path) -> None:
    """--write-parameters and --parameters work with its dataset, too."""
    dataset, path = str(made / "run" / "dataset"), tmp_path / "params.yaml"
    assert main(["calibrate", dataset, "--write-parameters", str(path)]) == EXIT_OK
    path.write_text("parameters:\n  - {kind: dof_damping, elements: joint1}\n", encoding="utf-8")
    names = described(dataset).joint_names
    path.write_text(path.read_text(encoding="utf-8").replace("joint1", names[0]), encoding="utf-8")
    found = deal_hw.calibrate(
        dataset=dataset, parameters=path, population=4, generations=1, refine=False, threads=1
    )
    assert found.result.space.names == (f"{names[0]}.damping",)


def test_a_dataset_of_an_mjcf_alone_carries_its_robot(made: Path, tmp_path: Path) -> None:
    """--model derives the robot: rates of the recordings, everything else of the MJCF."""
    words = [str(made / "fit1.csv"), "--model", str(made / "robot.xml"), "--out", str(tmp_path / "d")]
    assert main(["data", "import", *words]) == EXIT_OK
    found = described(str(tmp_path / "d"))
    assert found.name == "robot" and found.control_rate_hz == found.state_rate_hz == pytest.approx(200.0)
    assert load_robot(tmp_path / "d" / "robot" / "robot.yaml").file.name == "robot"


def test_a_carried_robot_leaves_with_its_shapes(made: Path, tmp_path: Path) -> None:
    """Foxglove's 3D panel gets the robot that the dataset carries, as inspect does."""
    words = ["data", "export", str(made / "run"), "--format", "foxglove", "--out", str(tmp_path / "out")]
    assert main(words) == EXIT_OK
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == sorted(path.name for path in (made / "run" / "dataset" / "episodes").iterdir())
    assert b"/scene" in (tmp_path / "out" / written[0]).read_bytes()


@pytest.fixture
def noisy(made: Path, tmp_path: Path) -> Path:
    """The pendulum's robot.yaml with a range and noise."""
    yaml = tmp_path / "robot.yaml"
    text = (made / "robot.yaml").read_text(encoding="utf-8").replace("robot.xml", str(made / "robot.xml"))
    text = text.replace("position_range: null", "position_range: [-1.0, 1.0]").replace(
        "sensor_noise: 0.0", "sensor_noise: 0.001"
    )
    yaml.write_text(text, encoding="utf-8")
    return yaml


def test_ctrl_c_ends_a_program_that_records_simulations(
    noisy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a robot, it is raised again after the recording is complete: a loop over `collect` ends."""
    write_record = EpisodeRecorder.write

    def interrupted(self: EpisodeRecorder, record: CycleRecord) -> None:
        write_record(self, record)
        if record.cycle == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(EpisodeRecorder, "write", interrupted)
    simulation = deal_hw.SimulationOptions(simulated=True)
    with pytest.raises(InterruptedRunError, match="stopped by the operator") as raised:
        deal_hw.collect(str(noisy), simulation=simulation, motion="chirp", episodes=2, out=tmp_path / "run")
    assert raised.value.report.exit_code == 130 and raised.value.signal == "SIGINT"
    (path,) = raised.value.report.paths
    assert len(deal_hw.inspect(path).episode.trajectory.sent_s) == 6


def test_a_rehearsal_without_a_robot(noisy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A simulated robot is recorded, again and by its dataset; what it hides is the seed's."""
    simulation = deal_hw.SimulationOptions(simulated=True, truth_seed=2, reveal_to=tmp_path / "truth.json")
    report = deal_hw.collect(
        str(noisy), simulation=simulation, motion="chirp", seconds=3.0, out=tmp_path / "run"
    )
    assert report.exit_code == 0 and report.episodes[0].states_recorded == 151
    truth = json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))
    assert truth["latency_s"] == 0.005 and len(truth["parameters"]) > 2
    dataset = tmp_path / "run" / "dataset"
    line = ["collect", str(dataset), "--simulated", "--out", str(tmp_path / "again"), "--seconds", "3"]
    assert main([*line, "--truth-seed", "2", "--motion", "chirp"]) == EXIT_OK
    # A sweep alone is held out, so that nothing is left to fit.
    recorded = tmp_path / "again" / "dataset"
    printed = capsys.readouterr().out
    assert "not enough for a calibration: nothing to fit" in printed and "next:" not in printed
    assert f"deal-hw calibrate {recorded} --episodes 0\n" in printed
    assert main([*line, "--truth-seed", "2"]) == EXIT_OK
    assert f"next: deal-hw calibrate {recorded}\n" in capsys.readouterr().out
    again = tmp_path / "again" / "dataset" / "episodes" / "000000.mcap"
    one, two = (deal_hw.inspect(path).episode.trajectory for path in (report.paths[0], again))
    assert (one.position == two.position).all()
    replayed = deal_hw.replay(again, simulation=simulation, out=tmp_path / "replayed")
    repeated = deal_hw.inspect(replayed.paths[0]).episode.trajectory
    assert (repeated.requested_position[:100] == two.requested_position[:100]).all()
    assert deal_hw.design_excitation(str(dataset), out=tmp_path / "e.json", family="steps").path.is_file()


def test_a_simulated_trip_advises_as_a_real_one(noisy: Path, tmp_path: Path) -> None:
    """A joint that is too fast asks for a gentler motion; the episode keeps the flag."""
    text = re.sub(r"velocity_limit: [\w.]+", "velocity_limit: 0.1", noisy.read_text(encoding="utf-8"))
    noisy.write_text(text, encoding="utf-8")
    output: list[str] = []
    simulation = deal_hw.SimulationOptions(simulated=True)
    report = deal_hw.collect(str(noisy), simulation=simulation, out=tmp_path / "run", say=output.append)
    assert report.outcome is Outcome.TRIPPED and report.episodes[0].flags == ("velocity",)
    assert any("record again with --excitation-level -1" in text for text in output)
    assert "  calibrate leaves this episode out" in output
    (episode,) = Dataset.open(tmp_path / "run" / "dataset").episodes
    assert episode.left_out.startswith("the safety module ended it (joint 'pivot' moves at")


REFUSED: list[tuple[str, str]] = [
    ("calibrate {made}/run/dataset --search deal-paper", "and for a dataset with its own robot.yaml"),
    ("robot new {made}/robot.xml", "robot.yaml exists; name another file with --out, or remove it"),
    (
        "robot new {made}/robot.xml --out o.yaml --name so101",
        "'so101' is the name of a robot of deal-hw; choose",
    ),
    ("robot new none.xml", "model none.xml does not exist"),
    ("robot check none.yaml", "there is no such file; `deal-hw robot new robot.xml` writes one"),
    (
        "data import {made}/fit1.csv --robot {made}/robot.yaml --name x --out d",
        "--name would have no effect: --robot",
    ),
    (
        "data import {made}/fit1.csv --robot {made}/robot.yaml --model m.xml --out d",
        "--model would have no effect",
    ),
    (
        "data import {made}/other.csv --robot {made}/robot.yaml --out d",
        "cannot tell which channels are the joints'",
    ),
    (
        "calibrate {made}/run/dataset --columns c.yaml",
        "`deal-hw calibrate own-robot` has no such option",
    ),
    ("calibrate {made}/run/dataset --space k9", "--space: `deal-hw calibrate own-robot` has no"),
    (
        "calibrate {made}/run/dataset --holdout 1 --holdout-part 0.5",
        "give --holdout or --holdout-part, not both",
    ),
    (
        "collect {made}/robot.yaml --out r",
        "or record its simulation with --simulated",
    ),
    (
        "collect {made}/robot.yaml --simulated --out r --excite chirp",
        "is unknown, so no excitation can be planned; write its position_range",
    ),
    (
        "collect cartpole --simulated --out r",
        "--simulated: `deal-hw collect cartpole` has no such option; `collect robot.yaml --simulated` has it",
    ),
    ("collect nosuch --out r", "unknown robot 'nosuch'; known: "),
    ("collect cartpole --out r", "`deal-hw collect cartpole` needs --port; --port is: The robot's port"),
    (
        "replay {made}/run/dataset/episodes/000000.mcap --port p",
        "deal-hw has no driver for this robot",
    ),
    (
        "deploy {made}/robot.yaml --port p",
        "write the section `hardware` into its robot.yaml",
    ),
    ("design-excitation {made}/none --out e.json", "unknown robot"),
]


@pytest.mark.parametrize(("line", "words"), REFUSED, ids=[words[:50] for _, words in REFUSED])
def test_refusals(
    made: Path,
    line: str,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One line, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    renamed = (made / "fit1.csv").read_text(encoding="utf-8").split("\n", 1)
    columns = renamed[0].split(",")
    (made / "other.csv").write_text(
        ",".join(["time", "alpha", "alpha.command", *columns[3:]]) + "\n" + renamed[1], encoding="utf-8"
    )
    assert main(line.format(made=made).split()) == EXIT_ERROR
    reported = capsys.readouterr()
    assert words in reported.err.splitlines()[-1] and not list(tmp_path.iterdir())


def test_a_dataset_without_its_robot(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """inspect, calibrate and verify name the file that they miss."""
    import shutil

    dataset = tmp_path / "dataset"
    shutil.copytree(made / "run" / "dataset", dataset)
    (dataset / "robot" / "robot.xml").write_text("<mujoco/>", encoding="utf-8")
    with pytest.raises(DatasetError, match=r"robot.xml was changed after the recordings were imported"):
        deal_hw.inspect(dataset / "episodes" / "000000.mcap")
    assert main(["data", "verify", str(dataset)]) == 1
    assert "robot.xml was changed" in capsys.readouterr().out
    shutil.rmtree(dataset / "robot")
    for call in (
        lambda: deal_hw.inspect(dataset / "episodes" / "000000.mcap"),
        lambda: deal_hw.calibrate(dataset=dataset),
    ):
        with pytest.raises(DatasetError, match=r"robot 'swing' is none of deal-hw's own.*robot/files.json"):
            call()


def test_python_writes_and_checks(made: Path, tmp_path: Path) -> None:
    """The same as on the command line."""
    path = deal_hw.new_robot(made / "robot.xml", out=tmp_path / "r.yaml", control_rate=100.0, name="mine")
    found = deal_hw.check_robot(path)
    assert found.exit_code == 0 and found.robot.file.control_rate_hz == 100.0
    assert found.robot.mjcf.resolve() == (made / "robot.xml").resolve()
    with pytest.raises(ConfigurationError, match=r"allowed are 0\.001 to 100000 Hz"):
        deal_hw.new_robot(made / "robot.xml", control_rate=0.0)
