"""The verb `calibrate`: what it refuses before any long work, and what it writes."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.calibration import read_result
from deal_hw.cli.calibrate import CalibrateDataset, CalibrateFiles, calibrate, calibrate_or_write_parameters
from deal_hw.cli.calibrate_output import print_files
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.errors import ConfigurationError, InsufficientDataError, UnknownNameError
from deal_hw.motions.behaviours import Behaviour, HoldBehaviour
from deal_hw.motions.excitation.behaviours import ChirpBehaviour, ChirpConfig, RichBehaviour, RichConfig
from deal_hw.workflows.calibration.episodes import choose_episodes
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.run import CalibrateReport
from deal_hw.workflows.calibration.space import without_speed_limits
from deal_hw.workflows.emulation.virtual import VirtualCartpole


def record(folder: Path, runs: list[tuple[str, Behaviour, float]], profile: str = "sensor") -> Path:
    """Record runs of a nominal robot into a dataset, through driver, bytes and recorder, in virtual time."""
    robot = VirtualCartpole(nominal_truth(profile, 4, actuation_ticks=9))
    with Dataset.create_or_open(folder, DESCRIPTION) as store:
        for motion, behaviour, seconds in runs:
            path = store.next_episode_path()
            robot.run(behaviour, seconds, path, {"motion": motion, "purpose": "collect", "robot": "cartpole"})
            store.note_episode(path)
    return folder


@pytest.mark.parametrize(("sent", "searched"), [(8.0, False), (1.0, True)])
def test_a_drive_whose_set_points_the_host_moves_has_no_speed_limit(sent: float, searched: bool) -> None:
    """Commands of an ODrive carry its own 8 m/s. 20 mm in the device's period of 1 ms are 20 m/s."""
    made = simulated_episode(DESCRIPTION, k9_space(), k9_space().nominal, seconds=1.0, seed=1)
    steps = np.linspace(0.0, 0.02 * (len(made.position_target) - 1), len(made.position_target))[:, None]
    recorded = dataclasses.replace(
        made, speed_limit=np.full_like(made.speed_limit, sent), position_target=steps
    )
    output: list[str] = []
    space = without_speed_limits(k9_space(), DESCRIPTION, [recorded], output.append)
    assert ("servo.speed_limit" in space.names) == searched
    assert space["servo.speed_limit"].nominal == pytest.approx(1.0 if searched else 20.0)
    assert len(output) == (not searched)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of random set-points and one second of a sweep."""
    rich = RichBehaviour(DESCRIPTION, None, RichConfig(duration_s=2.6, balance_s=0.0), 1)
    chirp = ChirpBehaviour(DESCRIPTION, ChirpConfig(duration_s=2.2))
    return record(tmp_path_factory.mktemp("run") / "dataset", [("rich", rich, 2.6), ("chirp", chirp, 2.2)])


@pytest.fixture(scope="module")
def realistic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """4 s of random set-points of a robot that the model does not explain."""
    rich = RichBehaviour(DESCRIPTION, None, RichConfig(duration_s=4.6, balance_s=0.0), 1)
    return record(tmp_path_factory.mktemp("realistic") / "dataset", [("rich", rich, 4.6)], "realistic")


def settings(folder: Path, **changes: object) -> CalibrateDataset:
    """Settings of a short calibration of two parameters."""
    values: dict[str, object] = {
        "dataset": folder,
        "free": ("cart.mass", "servo.stiffness"),
        "population": 30,
        "generations": 12,
        "quiet": True,
    }
    return CalibrateDataset(**{**values, **changes})  # type: ignore[arg-type]


def test_a_file_adds_parameters_to_a_robots_own_set(dataset: Path, tmp_path: Path) -> None:
    """Alarms advise to free an encoder's zero or a gear's play: also for robots with a driver."""
    extra = tmp_path / "extra.yaml"
    extra.write_text("parameters:\n  - {kind: encoder_bias, elements: cart}\n")
    space = calibration_input(settings(dataset, free=(), parameters=extra)).space
    assert space.names == (*k9_space().names, "cart.encoder_bias")
    freed = calibration_input(
        settings(dataset, free=("cart.mass", "cart.encoder_bias"), parameters=extra)
    ).space
    assert freed.names == ("cart.mass", "cart.encoder_bias")
    extra.write_text("parameters:\n  - {kind: dof_damping, elements: pole, name: twice}\n")
    with pytest.raises(ConfigurationError, match="both set dof_damping of 'pole'"):
        calibration_input(settings(dataset, free=(), parameters=extra))


@dataclasses.dataclass(frozen=True)
class Calibrated:
    """A calibration with --json: its report, and what it printed."""

    report: CalibrateReport
    out: str
    err: str


@pytest.fixture(scope="module")
def calibrated(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """Calibrate once for all tests that look at the same calibration."""
    out, err = io.StringIO(), io.StringIO()
    asked = settings(dataset, out=tmp_path_factory.mktemp("calibrated"), json=True, quiet=False)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        report = calibrate_or_write_parameters(asked)
    assert not isinstance(report, int)
    return Calibrated(report, out.getvalue(), err.getvalue())


def test_writes_everything_a_user_needs(calibrated: Calibrated) -> None:
    """Two parameters are found within 5 %; result, distribution and model are there and agree.

    With --json the output is one document, and the text is on the error output.
    """
    report = calibrated.report
    document = json.loads(calibrated.out)
    assert document.pop("files") == {name: str(path) for name, path in report.files.items()}
    assert document == json.loads(report.files["result.json"].read_text())
    assert "calibration by default" in calibrated.err and "written to" in calibrated.err
    found = dict(zip(report.result.space.names, report.result.estimate, strict=True))
    assert found["cart.mass"] == pytest.approx(0.3, rel=0.05)
    assert found["servo.stiffness"] == pytest.approx(80.0, rel=0.05)
    assert report.result.latency_s == pytest.approx(9e-3, abs=1.1e-3)
    assert report.result.heldout_nrmse["calibrated"] < report.result.heldout_nrmse["null"]
    again = read_result(report.files["result.json"].parent)
    np.testing.assert_allclose(again.estimate, report.result.estimate)
    model = mujoco.MjModel.from_xml_path(str(report.files["calibrated.xml"]))
    assert model.body("cart").mass[0] == pytest.approx(found["cart.mass"], rel=1e-4)
    provenance = json.loads(report.files["result.json"].read_text())["provenance"]
    assert provenance["episodes"] == [0] and provenance["holdout"] == [1]
    assert provenance["seed"] == 0 and "mujoco" in provenance["versions"]
    assert json.loads(report.files["distribution.json"].read_text())["latency_s"][0] <= 9e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("search", "words"), [(None, "an adversarial search follows (deal)"), ("eki", "a search follows (eki)")]
)
def test_a_realistic_robot_is_searched_adversarially(
    realistic: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], search: str | None, words: str
) -> None:
    """A latency that is not the robot's is no cause: after the local fit the search is announced."""
    asked = {"free": (), "population": 10, "generations": 2, "quiet": False, "latency": 0.0}
    report = calibrate(settings(realistic, **asked, search=search, out=tmp_path))
    reported = " ".join(capsys.readouterr().err.split())
    announced = f"before the search: the local fit leaves more than noise, so {words}"
    assert reported.index("local fit:") < reported.index(announced)
    provenance = report.result.provenance
    assert provenance["search"] == (search or "deal")
    assert provenance["settings"].get("trained", False) == (search is None)


def test_no_document_of_a_calibration_that_does_not_run(tmp_path: Path) -> None:
    """--write-parameters writes a file and calibrates nothing."""
    config = CalibrateFiles(model=tmp_path / "arm.xml", write_parameters=tmp_path / "p.yaml", json=True)
    with pytest.raises(ConfigurationError, match="--json would have no effect: --write-parameters"):
        calibrate_or_write_parameters(config)


def test_the_folder_of_the_files_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    """And what to open, where there is a report; eight absolute paths on a line before."""
    folder = Path("runs/arm/calibration")
    files = {name: folder / name for name in ("result.json", "report.html")}
    print_files(files)
    reported = capsys.readouterr().out.splitlines()
    assert reported == [
        f"written to {folder}: result.json, report.html",
        f"see all results: open {folder / 'report.html'} in a browser",
    ]
    print_files({"result.json": folder / "result.json"})
    assert capsys.readouterr().out == f"written to {folder}: result.json\n"


@pytest.mark.slow
def test_same_seed_same_result(dataset: Path, calibrated: Calibrated, tmp_path: Path) -> None:
    """Everything random comes from the seed."""
    again = calibrate(settings(dataset, out=tmp_path)).result
    np.testing.assert_array_equal(again.estimate, calibrated.report.result.estimate)
    np.testing.assert_array_equal(again.interval, calibrated.report.result.interval)


def test_unknown_parameter_lists_the_names(dataset: Path) -> None:
    """A wrong name is answered with the right ones."""
    with pytest.raises(UnknownNameError, match=r"cart\.weight.*cart\.mass.*servo\.speed_limit"):
        calibrate(settings(dataset, free=("cart.weight",)))


@pytest.mark.parametrize(("low", "high"), [(0.3, 0.3), (0.5, 0.1)])
def test_equal_or_reversed_bounds_are_refused(dataset: Path, low: float, high: float) -> None:
    """The error names the parameter and the range."""
    with pytest.raises(ConfigurationError, match=r"cart\.mass.*low < high"):
        calibrate(settings(dataset, range=(("cart.mass", low, high),)))


def test_range_without_the_nominal_value_is_refused(dataset: Path) -> None:
    """A range that leaves the nominal value out is a mistake until the user says otherwise."""
    with pytest.raises(ConfigurationError, match=r"nominal value 0\.3 lies outside"):
        calibrate(settings(dataset, range=(("cart.mass", 0.4, 0.9),)))


def test_unknown_method_lists_the_methods(dataset: Path) -> None:
    """A wrong method is answered with the right ones."""
    with pytest.raises(UnknownNameError, match=r"gradient.*eki"):
        calibrate(settings(dataset, method="gradient"))


def test_ratio_of_one_is_refused(dataset: Path) -> None:
    """The ratio must be above 1."""
    with pytest.raises(ConfigurationError, match="--range-ratio 1"):
        calibrate(settings(dataset, range_ratio=1.0))


def test_robot_that_stood_still_is_refused(tmp_path: Path) -> None:
    """The message says what to record instead."""
    folder = record(tmp_path / "dataset", [("hold", HoldBehaviour(DESCRIPTION), 2.0)])
    with pytest.raises(InsufficientDataError, match="collect"):
        calibrate(settings(folder))


def test_recording_that_is_too_short_is_refused(tmp_path: Path) -> None:
    """Half a second is not enough, and the message says how much is."""
    rich = RichBehaviour(DESCRIPTION, None, RichConfig(duration_s=0.5, balance_s=0.0), 1)
    folder = record(tmp_path / "dataset", [("rich", rich, 0.5)])
    with pytest.raises(InsufficientDataError, match="collect"):
        calibrate(settings(folder))


def test_episode_cannot_be_fitted_and_held_out(dataset: Path) -> None:
    """A held-out episode must not be seen."""
    with pytest.raises(ConfigurationError, match=r"episodes \[0\] are both fitted and held out"):
        calibrate(settings(dataset, episodes=(0,), holdout=(0,)))


def test_an_episode_that_is_named_twice_counts_once(dataset: Path) -> None:
    """Twice the same data would narrow every interval."""
    assert choose_episodes(Dataset.open(dataset), (0, 0), (1, 1)) == ((0,), (1,))


def test_dataset_of_held_out_episodes_only_is_refused(tmp_path: Path) -> None:
    """A sweep alone leaves nothing to fit."""
    chirp = ChirpBehaviour(DESCRIPTION, ChirpConfig(duration_s=2.2))
    folder = record(tmp_path / "dataset", [("chirp", chirp, 2.2)])
    with pytest.raises(ConfigurationError, match="nothing to fit"):
        calibrate(settings(folder))


def test_parameter_sets_and_known_values(dataset: Path) -> None:
    """k11 frees everything; a weighed cart is known; an unknown set lists the sets."""
    assert len(calibration_input(settings(dataset, free=(), space="k11")).space) == 11
    space = calibration_input(settings(dataset, free=(), known=(("cart.mass", 0.41),))).space
    assert space.known["cart.mass"] == 0.41 and len(space) == 8
    with pytest.raises(UnknownNameError, match=r"k7.*k9, k11"):
        calibration_input(settings(dataset, free=(), space="k7"))
