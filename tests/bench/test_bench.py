"""The verb `bench`: rows, resuming, and the benches with a known truth."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Literal

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from deal_hw.bench import calibration, tasks
from deal_hw.bench.rows import write_rows
from deal_hw.bench.scores import check_truth
from deal_hw.bench.settings import FixedRange, Loop, Mismatch, Paper
from deal_hw.bench.tables import method_name
from deal_hw.bench.tasks import make_case
from deal_hw.cli.bench import bench
from deal_hw.drivers.cartpole.description import SPACES
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.errors import CalibrationError, ConfigurationError, DatasetError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine import warp_support
from deal_hw.workflows.shipped import required_policy, shipped_policy

FIELDS = {
    "bench",
    "task",
    "profile",
    "method",
    "refined",
    "range_ratio",
    "seed",
    "error_percent",
    "log_error_x100",
    "null_error_percent",
    "null_log_error_x100",
    "coverage90",
    "width90",
    "heldout_nrmse_nominal",
    "heldout_nrmse_calibrated",
    "latency_true",
    "latency_found",
    "steps",
    "seconds",
    "flagged",
    "error",
}


def test_rows_have_the_fields_of_the_benchmark_and_are_not_run_twice(tmp_path: Path) -> None:
    """The midpoint of the range scores its own null error; a second run recomputes nothing."""
    out = tmp_path / "loop.json"
    settings = Loop(profile="sensor", seeds=(0,), methods=("midpoint",), out=out, threads=1, quiet=True)
    assert bench(settings) == 0
    values = json.loads(out.read_text())
    (row,) = values["rows"]
    assert set(row) >= FIELDS
    assert row["error"] == "" and row["refined"] is False
    assert row["error_percent"] == pytest.approx(row["null_error_percent"])
    assert row["heldout_nrmse_calibrated"] > 0
    assert "processors" in values["machine"] and "mujoco" in values["machine"]["versions"]
    assert out.with_suffix(".png").stat().st_size > 1000
    with out.with_suffix(".csv").open() as file:
        assert [r["method"] for r in csv.DictReader(file)] == ["midpoint"]
    before = row["seconds"]
    assert bench(settings) == 0
    assert json.loads(out.read_text())["rows"][0]["seconds"] == before


def test_rows_name_files_but_no_folder_of_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command stands in the file as it was given, without the folders of its files."""
    words = ["--out", str(tmp_path / "a.json"), f"--data={tmp_path / 'b.csv'},c/d.csv", "--method eki", "3"]
    monkeypatch.setattr("sys.argv", ["/bin/tool.py", *words])
    write_rows(tmp_path / "a.json", [{"error": ""}], program="tools/tool.py")
    values = json.loads((tmp_path / "a.json").read_text())
    assert values["argv"] == ["tools/tool.py", "--out", "a.json", "--data=b.csv,d.csv", "--method eki", "3"]
    assert values["rows"] == [{"error": ""}]


def test_unknown_method_is_refused_before_anything_runs(tmp_path: Path) -> None:
    """The methods are listed."""
    with pytest.raises(UnknownNameError, match="eki"):
        bench(Loop(methods=("magic",), out=tmp_path / "loop.json"))


def test_foreign_file_is_not_overwritten(tmp_path: Path) -> None:
    """A file that is no bench file stays as it is."""
    out = tmp_path / "notes.json"
    out.write_text('{"a": 1}')
    with pytest.raises(DatasetError, match="cannot be read as rows of a bench"):
        bench(Loop(methods=("midpoint",), out=out))
    assert out.read_text() == '{"a": 1}'


@pytest.mark.slow
def test_honest_rows_for_every_task(tmp_path: Path) -> None:
    """Cells are tasks by methods; no-data baselines score the centre's error everywhere."""
    out = tmp_path / "honest.json"
    settings = FixedRange(
        task=("cartpole", "ant", "go2"),
        profile="ideal",
        seeds=(3,),
        methods=("midpoint", "nominal"),
        range_ratio=(3.0,),
        out=out,
        threads=1,
        quiet=True,
    )
    assert bench(settings) == 0
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == 3 * 2
    for row in rows:
        assert set(row) >= FIELDS and row["bench"] == "fixed-range" and not row["refined"]
        assert row["log_error_x100"] == pytest.approx(row["null_log_error_x100"])
        assert row["log_error_x100"] > 10, "an honest truth is not the midpoint"
    assert bench(settings) == 0
    assert json.loads(out.read_text())["rows"] == rows


def test_the_papers_protocol_is_won_by_the_empty_predictor(tmp_path: Path) -> None:
    """With the target at its place the nominal row scores 0 and every row says what that means."""
    out = tmp_path / "paper.json"
    settings = Paper(
        task=("ant",),
        profile="ideal",
        seeds=(3,),
        methods=("midpoint", "nominal"),
        out=out,
        quiet=True,
    )
    assert bench(settings) == 0
    rows = {row["method"]: row for row in json.loads(out.read_text())["rows"]}
    assert rows["nominal"]["error_percent"] == 0.0
    # The centre of a linear range [p / 5, 5 p] is 2.6 p.
    assert rows["midpoint"]["error_percent"] == pytest.approx(160.0)
    assert "error of 0" in rows["midpoint"]["note"]


@pytest.mark.parametrize(
    ("task", "space"), [("cartpole", "paper"), ("ant", "paper"), ("go2", "paper-swapped")]
)
def test_presets_of_the_paper_are_the_truth_there(task: str, space: str) -> None:
    """The hidden robot has the values of Tables 7 to 9, inside the range around them."""
    case = make_case(task, "ideal", 3, 5.0, space, centred=True)
    np.testing.assert_array_equal(case.theta, case.space.nominal)
    assert np.all((case.space.low < case.theta) & (case.theta < case.space.high))


@pytest.mark.parametrize(("task", "space"), [("cartpole", "paper"), ("cartpole", "k11"), ("ant", "paper")])
def test_a_truth_is_drawn_in_the_space_that_is_searched(task: str, space: str) -> None:
    """All parameters are off their middle, and inside their range, whatever the parameter set."""
    case = make_case(task, "ideal", 3, 5.0, space)
    unit = case.space.normalize(case.theta)
    assert np.all((unit > 0.1 - 1e-9) & (unit < 0.9 + 1e-9))
    assert np.all(case.theta != case.space.nominal)


@pytest.mark.slow
def test_a_truth_outside_its_range_is_refused_in_every_calibration_bench(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A robot of K9 searched in the paper's ranges: no search can find it, so its error means nothing."""

    def drawn(profile: str, seed: int, *, range_ratio: float, space: ParameterSpace) -> CartpoleTruth:
        return draw_truth(profile, seed, range_ratio=range_ratio)

    monkeypatch.setattr(tasks, "draw_truth", drawn)
    for settings in (
        FixedRange(profile="ideal", methods=("midpoint",), seeds=(3,), space="paper"),
        Mismatch(methods=("midpoint",), seeds=(3,), space="paper"),
    ):
        (cell,) = calibration.make_cells(settings)
        row = calibration.run_cell(cell, population=4, generations=1, threads=1)
        assert "ConfigurationError: the true" in row["error"]
        assert "outside its search range" in row["error"] and "--space" in row["error"]
        assert "error_percent" not in row
    monkeypatch.undo()
    row = calibration.run_cell(cell, population=4, generations=1, threads=1)
    assert row["error"] == "" and row["null_error_percent"] < 400


def test_methods_with_such_a_search_are_on_the_engine_that_is_named() -> None:
    """Their rows say so and are cells of their own; a row of mujoco's is that of before."""
    methods = ("default", "eki", "easi", "midpoint")
    asked = FixedRange(methods=methods, seeds=(3,), engine="warp")
    assert [cell.engine for cell in calibration.make_cells(asked)] == ["warp", "warp", "", ""]
    before = calibration.make_cells(dataclasses.replace(asked, engine="mujoco"))
    assert {cell.engine for cell in before} == {""}
    row = {"method": "eki", "refined": True, "engine": "warp"}
    assert method_name(row) == "eki + refinement on warp"


def test_a_row_names_why_its_engine_cannot_simulate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search gets the cell's engine: without a GPU the row has the line with its remedy."""
    monkeypatch.setattr(warp_support, "check_installed", lambda: None)
    monkeypatch.setattr(warp_support, "gpu_problem", lambda: "no NVIDIA driver is installed")
    (cell,) = calibration.make_cells(FixedRange(methods=("eki",), seeds=(3,), engine="warp"))
    row = calibration.run_cell(cell, population=4, generations=1, threads=1)
    assert row["engine"] == "warp"
    assert "--engine warp needs a GPU, and no NVIDIA driver is installed" in row["error"]


def test_workers_do_not_share_a_device() -> None:
    """Each would measure its free memory for itself alone."""
    with pytest.raises(ConfigurationError, match=r"--ray with --engine warp: .*leave one of the two out"):
        FixedRange(ray="local", engine="warp")
    assert FixedRange(ray="local").engine == "mujoco"


def test_the_ends_of_a_range_belong_to_it() -> None:
    """Rounding in the logarithm refuses nobody, a thousandth of the range does."""
    space = SPACES["k9"]().with_ratio(5.0)
    for end in (space.low, space.high):
        check_truth(space, dict(zip(space.names, end * (1 + 1e-13), strict=True)))
    low = dict(zip(space.names, space.low, strict=True)) | {"cart.mass": 0.05}
    with pytest.raises(ConfigurationError, match=r"true cart.mass, 0.05 kg, .* 0.06 to 1.5, so no search"):
        check_truth(space, low)
    check_truth(space, {"another": 1e9})


def test_a_preset_that_cannot_stand_is_said() -> None:
    """Table 9 as printed: motors of 0.5 N·m/rad do not hold a Go2."""
    with pytest.raises(CalibrationError, match="the preset's robot falls"):
        make_case("go2", "ideal", 3, 5.0, "paper", centred=True)


@pytest.mark.slow
def test_rows_of_the_paper_need_a_policys_demonstration(tmp_path: Path) -> None:
    """On motions that excite the row says so; on the policy's own motion it runs."""
    errors = {}
    shown: Literal["excite", "policy"]
    for shown in ("excite", "policy"):
        out = tmp_path / f"{shown}.json"
        settings = FixedRange(
            profile="ideal",
            seeds=(3,),
            methods=("deal-paper",),
            population=4,
            generations=1,
            demonstration=shown,
            out=out,
            threads=1,
            quiet=True,
        )
        bench(settings)
        (row,) = json.loads(out.read_text())["rows"]
        errors[shown] = row["error"]
    assert "needs the policy that produced all commands" in errors["excite"] and errors["policy"] == ""


def test_a_profile_that_a_task_lacks_is_kept_in_the_row(tmp_path: Path) -> None:
    """One cell's error does not stop the others, and the exit code says that one failed."""
    out = tmp_path / "mismatch.json"
    settings = Mismatch(
        task=("ant", "cartpole"), seeds=(3,), methods=("midpoint",), out=out, threads=1, quiet=True
    )
    assert bench(settings) == 1
    errors = {row["task"]: row["error"] for row in json.loads(out.read_text())["rows"]}
    assert "no profile 'realistic'" in errors["ant"] and errors["cartpole"] == ""


def test_an_unknown_task_is_refused(tmp_path: Path) -> None:
    """The tasks are listed."""
    with pytest.raises(UnknownNameError, match="go2"):
        bench(FixedRange(task=("biped",), out=tmp_path / "honest.json"))


@pytest.mark.parametrize("task", ["cartpole", "ant"])
def test_a_demonstration_is_as_long_as_is_asked_and_the_held_out_motion_stays(task: str) -> None:
    """2 s and 4 s: DEAL's Figure 5 shortens what is shown, not what judges."""
    case = make_case(task, "ideal", 3, 5.0, seconds=2.0, by_policy=True)
    seconds = [episode.steps * episode.step_s for episode in (case.fit, case.heldout)]
    assert seconds == pytest.approx([2.0, 4.0], abs=0.1)


def test_a_bench_of_another_demonstration_is_not_taken_for_done() -> None:
    """Its length is part of what tells cells apart."""
    (short,), (long,) = (
        calibration.make_cells(Paper(seeds=(3,), demonstration_seconds=seconds)) for seconds in (2.0, 4.0)
    )
    assert short.key != long.key


def test_a_policy_of_train_demonstrates_with_a_go2() -> None:
    """It asks for the motors' whole effort, which the driver's limits allow; at 0.4 m/s it walks for 4 s."""
    walk = required_policy("go2")
    case = make_case("go2", "ideal", 1000, 1.5, centred=True, by_policy=True, checkpoint=walk)
    position, _ = case.fit_truth
    assert 1.2 < position[-1, 0] - position[0, 0] < 2.4


def test_a_checkpoint_demonstrates_and_names_its_rows(tmp_path: Path) -> None:
    """DEAL's Table 5: another policy moves the robot, and closed-loop methods run that policy, too."""
    shipped = shipped_policy("cartpole")
    assert shipped is not None
    early = tmp_path / "early.onnx"
    model = onnx.load(str(shipped))
    for tensor in model.graph.initializer:
        weak = 0.5 * numpy_helper.to_array(tensor)
        tensor.CopyFrom(numpy_helper.from_array(weak.astype(np.float32), tensor.name))
    onnx.save(model, str(early))
    settings = Paper(
        profile="ideal", methods=("midpoint",), range_ratio=(3.0,), seeds=(3,), demonstration="policy"
    )
    (cell,), (other,) = (
        calibration.make_cells(dataclasses.replace(settings, checkpoint=paths)) for paths in ((), (early,))
    )
    assert (cell.checkpoint, other.checkpoint) == ("", "early")
    commands, shown = [], []
    for path in (None, early):
        case = make_case("cartpole", "ideal", 3, 3.0, centred=True, by_policy=True, checkpoint=path)
        policy = case.policy
        assert policy is not None
        before = np.zeros((policy.history, 2))
        policy.restart(1, before, before, before[:, :1], policy.history)
        commands.append(policy(np.full((1, 2), 0.05), np.zeros((1, 2))))
        shown.append(case.fit.target)
    assert abs(commands[0] - commands[1]).max() > 1e-4 < abs(shown[0] - shown[1]).max()
    with pytest.raises(ConfigurationError, match="--demonstration policy"):
        Paper(checkpoint=(early,))
    row = calibration.run_cell(other, population=4, generations=1, threads=1)
    assert row["error"] == "" and row["checkpoint"] == "early" and "policy" not in row
