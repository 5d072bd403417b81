"""`deal_hw.calibrate`: recordings from files and from memory, what comes back, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.errors import ConfigurationError, DatasetError, DealHwError, PolicyError, UnknownNameError
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.settings import FilesSettings
from deal_hw.workflows.calibration.space import searched_space

Arrays = dict[str, FloatArray]
T = np.arange(400) * 0.01


class Frame(dict[str, FloatArray]):
    """As much of a data frame as is asked of one: columns, and a column by its name."""

    @property
    def columns(self) -> list[str]:
        """Names of the columns."""
        return list(self)


def arrays_of(path: Path) -> Arrays:
    """Return the columns of a CSV file."""
    table = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
    return {name: table[name] for name in table.dtype.names or ()}


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A pendulum in plain MuJoCo: model, a recording to fit, one to judge by."""
    model, fit, other = write(make_robot("pendulum", 0), tmp_path_factory.mktemp("p"), seconds=2.5)
    return model, fit[0], other


@pytest.fixture(scope="module")
def found(pendulum: tuple[Path, Path, Path]) -> deal_hw.Calibration:
    """Its calibration from arrays."""
    model, fit, other = pendulum
    return deal_hw.calibrate(model, arrays_of(fit), holdout=arrays_of(other), threads=1)


@pytest.mark.slow
def test_arrays_are_calibrated_like_their_file(
    pendulum: tuple[Path, Path, Path], found: deal_hw.Calibration
) -> None:
    """The same estimates from the CSV file, through a path as text, and the truth inside its intervals."""
    model, fit, other = pendulum
    again = deal_hw.calibrate(str(model), [fit], holdout=[other], threads=1)
    np.testing.assert_allclose(again.result.estimate, found.result.estimate, rtol=1e-9)
    assert found.colour == "green"
    errors = found.result.heldout_nrmse
    assert errors["calibrated"] < errors["nominal"]


def test_what_comes_back_is_shown_and_written(
    found: deal_hw.Calibration, pendulum: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    """Rows, text, HTML, distribution, model and report agree with the result."""
    rows = {row["parameter"]: row for row in found.rows()}
    assert set(rows) == {*found.result.space.names, "latency"}
    for p, value in zip(found.result.space, found.result.estimate, strict=True):
        assert rows[p.name]["estimate"] == value
        assert p.name in found.table() and p.name in found._repr_html_()
    assert "green" in found.table() and "green" in repr(found)
    noted = found.result.provenance
    assert (noted["seed"], noted["heldout_window_s"], noted["latency_range_s"]) == (0, 0.2, [0.0, 0.04])
    assert "mujoco" in noted["versions"] and noted["recordings"]
    assert found.distribution.digest() == found.result.distribution().digest()
    path = found.save_model(tmp_path / "calibrated.xml")
    written = mujoco.MjModel.from_xml_path(str(path))
    damping = next(name for name in rows if name.endswith(".damping"))
    assert written.dof_damping[0] == pytest.approx(rows[damping]["estimate"], rel=1e-4)
    assert found.report(tmp_path) == tmp_path / "report.html"
    assert "<html" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert set(found.save(tmp_path / "all")) >= {"result.json", "distribution.json", "calibrated.xml"}
    with pytest.raises(ConfigurationError, match="is the model itself"):
        found.save_model(pendulum[0])


def test_models_in_memory(pendulum: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """A spec and the last compiled model are taken, an older model is refused, and so is anything else."""
    model, fit, _ = pendulum
    data = Frame(arrays_of(fit))
    settings: dict[str, Any] = {"method": "nominal", "threads": 1, "holdout_part": 0.25}
    by_spec = deal_hw.calibrate(mujoco.MjSpec.from_file(str(model)), data, **settings)
    compiled = mujoco.MjModel.from_xml_path(str(model))
    by_model = deal_hw.calibrate(compiled, [data], **settings)
    np.testing.assert_allclose(by_model.result.estimate, by_spec.result.estimate)
    assert by_model.save_model(tmp_path / "out.xml").is_file()
    mujoco.MjModel.from_xml_string("<mujoco><worldbody><light/></worldbody></mujoco>")
    with pytest.raises(ConfigurationError, match="give the path of its MJCF"):
        deal_hw.calibrate(compiled, data, **settings)
    with pytest.raises(ConfigurationError, match="model is of type int"):
        deal_hw.calibrate(7, data, **settings)
    with pytest.raises(ConfigurationError, match=r"mujoco.MjSpec.from_string\(text\)"):
        deal_hw.calibrate(model.read_text(encoding="utf-8"), data, **settings)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([3.0], r"data\[0\] is of type float; a recording is a file's path"),
        ([{}], r"data\[0\] is empty"),
        ([{"time": ["a", "b"]}], r"data\[0\]\['time'\] has shape \(2,\) and type <U1"),
        ([{"time": np.zeros((2, 2, 2))}], r"has shape \(2, 2, 2\)"),
        ([{"speed": np.zeros(5)}], "which channel is the time"),
        ([], "needs recordings to fit"),
        (
            [{"time": T, "position": np.zeros((400, 1)), "target": np.zeros((399, 1))}],
            "which channel is the time of 'target', which has 399 rows and not those of the time",
        ),
        (
            [{"time": T, "position": np.zeros((1, 400)), "target": np.zeros((1, 400))}],
            r"data\[0\]\['position'\] has shape \(1, 400\), but there are 400 times; .* its transpose",
        ),
        (
            [{"time": T, "position": np.zeros((400, 3)), "target": np.zeros((400, 3))}],
            r"which joints the 3 columns of 'position' are \(the model has 1: pivot\)",
        ),
        (
            [{"time": T, "position": np.zeros((400, 1)), "target": np.zeros((400, 1)), "joints": ["elbow"]}],
            r"which of the model's joints \(pivot\) the file's \(elbow\) are",
        ),
        (
            [{"time": T, "position": np.sin(T)[:, None]}],
            "no commanded positions, so nothing can be predicted; name them",
        ),
        (
            [{"time": T, "position": 40 * np.sin(T)[:, None], "target": 40 * np.sin(T)[:, None]}],
            r"units: pivot: positions reach 40 rad, the joint .* rad \(degrees",
        ),
    ],
)
def test_recordings_that_are_none_are_refused(
    pendulum: tuple[Path, Path, Path], data: list[Any], words: str
) -> None:
    """Each says which recording, what was given and what is allowed."""
    with pytest.raises(DealHwError, match=words):
        deal_hw.calibrate(pendulum[0], data)


def test_what_the_model_has_as_zero_is_said(pendulum: tuple[Path, Path, Path]) -> None:
    """It is not searched by default; the user's own list of parameters says all by itself."""
    model = mujoco.MjModel.from_xml_path(str(pendulum[0]))
    model.dof_frictionloss[:] = 0
    printed: list[str] = []
    searched_space(FilesSettings(model=pendulum[0]), model, printed.append)
    assert printed == [
        "0 in the model: dof_frictionloss of pivot. They are not searched at first, but tried where the "
        "model explains too little. If the robot has them, write values above 0 into the MJCF"
    ]


def test_a_copy_is_neither_fitted_twice_nor_held_out(
    pendulum: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    """By its samples, whatever its name and format: a copy would judge itself, and narrow the intervals."""
    model, fit, _ = pendulum
    data: dict[str, Any] = dict(arrays_of(fit))
    copy = tmp_path / "other.npz"
    np.savez(copy, **data)
    with pytest.raises(ConfigurationError, match=r"holdout\[0\] is a copy of data\[0\]; .* fitted and held"):
        deal_hw.calibrate(model, data, holdout=data)
    with pytest.raises(ConfigurationError, match=r"other.npz is a copy of .*csv; a copy counts twice"):
        deal_hw.calibrate(model, [fit, copy])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"known": ["pivot.damping"]}, "known={"),
        ({"known": {"pivot.damping": "soft"}}, "could not convert string to float: 'soft'"),
        ({"range": {"pivot.damping": (1, 2, 3)}}, "range={"),
        ({"leave_out": ("rec.csv", 1, 2)}, "leave_out="),
        ({"free": "pivot.dampin"}, "unknown parameter 'pivot.dampin'"),
        ({"holdout": 1}, "--holdout 1: with --model give recordings; episode numbers go with a dataset"),
    ],
)
def test_arguments_of_another_shape_are_refused(
    pendulum: tuple[Path, Path, Path], given: dict[str, Any], words: str
) -> None:
    """The message shows the right shape."""
    with pytest.raises(DealHwError, match=words):
        deal_hw.calibrate(pendulum[0], pendulum[1], **given)


def test_settings_are_checked_before_anything_long(pendulum: tuple[Path, Path, Path]) -> None:
    """Unknown names are answered with the known ones."""
    model, fit, _ = pendulum
    with pytest.raises(ConfigurationError, match="name a dataset"):
        deal_hw.calibrate()
    with pytest.raises(ConfigurationError, match="not both"):
        deal_hw.calibrate(model, fit, dataset="runs/first/dataset")
    with pytest.raises(UnknownNameError, match=r"unknown argument of calibrate model 'episodes'.* have it"):
        deal_hw.calibrate(model, fit, episodes=[0])
    with pytest.raises(
        UnknownNameError, match=r"argument of calibrate dataset 'feet'.*`calibrate model` has"
    ):
        deal_hw.calibrate(dataset="d", feet=["FL"])
    with pytest.raises(ConfigurationError, match=r"--holdout r\.csv: with a dataset give episode numbers"):
        deal_hw.calibrate(dataset="d", holdout="r.csv")
    with pytest.raises(PolicyError, match=r"no such policy file: pi\.onnx"):
        deal_hw.calibrate(model, fit, search="eki", policy="pi.onnx")
    with pytest.raises(ConfigurationError, match="which is unknown for --model"):
        deal_hw.calibrate(model, fit, search="deal-paper")
    with pytest.raises(UnknownNameError, match="output-error"):
        deal_hw.calibrate(model, fit, method="gradient")
    with pytest.raises(ConfigurationError, match="--search eki --no-refine runs it alone"):
        deal_hw.calibrate(model, fit, method="eki")
    with pytest.raises(
        ConfigurationError, match="--search would have no effect: --method local has no search"
    ):
        deal_hw.calibrate(model, fit, method="local", search="deal")
    with pytest.raises(UnknownNameError, match="pivot"):
        deal_hw.calibrate(model, fit, residual_std={"elbow": 0.01})
    with pytest.raises(ConfigurationError, match="allowed are"):
        deal_hw.calibrate(model, fit, residual_std=-1.0)
    with pytest.raises(DatasetError, match="does not exist"):
        deal_hw.calibrate(model, "missing.csv")


def test_importing_the_package_loads_nothing() -> None:
    """Neither MuJoCo, torch, scipy nor numpy before a workflow is called."""
    code = (
        "import sys, deal_hw; "
        "print([n for n in ('mujoco', 'torch', 'scipy', 'numpy', 'tyro') if n in sys.modules], dir(deal_hw))"
    )
    reported = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert reported.startswith("[] ") and "'calibrate'" in reported
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        deal_hw.calibrat  # noqa: B018


@pytest.mark.parametrize(
    ("engine", "words"),
    [
        ("auto", "mujoco simulates the search: --engine auto simulates the populations of --search deal"),
        ("warp", "the method nominal has none; leave it out"),
    ],
)
def test_an_engine_is_chosen_before_the_run(
    pendulum: tuple[Path, Path, Path], capsys: pytest.CaptureFixture[str], engine: Any, words: str
) -> None:
    """A method without a search: auto says that MuJoCo does it, and a wish for a GPU is refused."""
    model, fit, other = pendulum
    said: list[str] = []

    def run() -> None:
        deal_hw.calibrate(
            model, arrays_of(fit), holdout=arrays_of(other), method="nominal", engine=engine, say=said.append
        )

    if engine == "warp":
        with pytest.raises(ConfigurationError, match=words):
            run()
    else:
        run()
        assert any(words in line for line in said)
