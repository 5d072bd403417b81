"""`deal_hw.calibrate`: recordings from files and from memory, what comes back, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.pipeline.methods import with_rates
from deal_hw.calibration import CalibrationResult
from deal_hw.errors import (
    ConfigurationError,
    DatasetError,
    DealHwError,
    InsufficientDataError,
    PolicyError,
    UnknownNameError,
)
from deal_hw.sim.mjcf.describe import Sampling
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.late_commands import late_commands
from deal_hw.workflows.calibration.recordings import one_rate
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
            r"data\[0\]: 'position' has shape \(1, 400\), but there are 400 times; .* its transpose",
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


TRUE = {"armature": 0.02, "damping": 0.3, "frictionloss": 0.05, "kp": 12.0, "kv": 0.6}
OWNERS = {"armature": 0.03, "damping": 0.3, "frictionloss": 0.08, "kp": 9.0, "kv": 0.9}


def servo(values: dict[str, float]) -> str:
    """Return a pendulum with a position servo, in plain MuJoCo."""
    return (
        '<mujoco model="servo"><option timestep="0.002"/><worldbody><body name="link" pos="0 0 1">'
        '<joint name="knee" axis="0 1 0" armature="{armature}" damping="{damping}" '
        'frictionloss="{frictionloss}"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8" '
        'contype="0" conaffinity="0"/></body></worldbody><actuator><position name="motor" joint="knee" '
        'kp="{kp}" kv="{kv}"/></actuator></mujoco>'
    ).format(**values)


def swing(rate_hz: float, seconds: float, seed: int) -> Arrays:
    """Return a recording of the true pendulum: samples and commands at a rate, 0.5 mrad of noise."""
    model = mujoco.MjModel.from_xml_string(servo(TRUE))
    substeps = max(round(1 / rate_hz / model.opt.timestep), 1)
    model.opt.timestep = 1 / rate_hz / substeps
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz
    hertz, phase = rng.uniform(0.4, 2.0, 3), rng.uniform(0, 6, 3)
    command = 0.35 * np.sin(2 * np.pi * hertz * time_s[:, None] + phase).sum(axis=1)
    position = np.empty(len(time_s))
    for k, target in enumerate(command):
        position[k] = data.qpos[0] + rng.normal(0, 5e-4)
        data.ctrl[0] = target
        mujoco.mj_step(model, data, substeps)
    return {"time": time_s, "knee_pos": position, "knee_cmd": command}


def roll_outs(rate_hz: float, count: int, seed: int) -> Arrays:
    """Return recordings of 0.7 to 1.5 s in one, with pauses of 0.1 to 4 s between them."""
    rng, parts, begin_s = np.random.default_rng(seed), list[Arrays](), 0.0
    for k in range(count):
        part = swing(rate_hz, rng.uniform(0.7, 1.5), 100 * seed + k)
        part["time"] = part["time"] + begin_s
        begin_s = part["time"][-1] + rng.uniform(0.1, 4.0)
        parts.append(part)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@pytest.fixture(scope="module")
def owners(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model of the pendulum's owner, with another gain, damping, friction and armature."""
    path = tmp_path_factory.mktemp("servo") / "servo.xml"
    path.write_text(servo(OWNERS))
    return path


def test_rates_and_roll_outs_fit_together(owners: Path) -> None:
    """Two rates and roll-outs give one result: each true value in its 90 % interval and within 6 %.

    The noise alone moves the least certain one, the friction, by about 2 %. The link's mass is known, which
    sets the scale of all forces. A recording of another rate judges.
    """
    said: list[str] = []
    found = deal_hw.calibrate(
        owners,
        [swing(193.0, 4.0, 11), swing(70.0, 4.0, 12), roll_outs(100.0, 8, 13)],
        holdout=[swing(50.0, 3.0, 14)],
        known={"link.mass": 0.8},
        threads=1,
        say=said.append,
    )
    assert found.colour == "green"
    rows = {row["parameter"]: row for row in found.rows()}
    for name, true in (
        ("knee.armature", TRUE["armature"]),
        ("knee.frictionloss", TRUE["frictionloss"]),
        ("motor.servo_stiffness", TRUE["kp"]),
        ("motor.servo_damping", TRUE["kv"]),
    ):
        assert rows[name]["low"] <= true <= rows[name]["high"], name
        assert rows[name]["estimate"] == pytest.approx(true, rel=0.06), name
    assert found.result.provenance["rates_hz"] == pytest.approx([50.0, 70.0, 100.0, 193.0])
    assert sum("4 rates: " in line for line in said) == 1
    assert sum("8 parts; 7 pauses between them are not fitted" in line for line in said) == 1
    assert found.result.heldout_nrmse["calibrated"] < 0.1 * found.result.heldout_nrmse["nominal"]


def settings_of(owners: Path, *data: Arrays, **more: Any) -> FilesSettings:
    """Return settings of recordings in memory."""
    return FilesSettings(model=owners, data=data, threads=1, **more)


def test_windows_last_equally_long_at_all_rates(owners: Path) -> None:
    """Windows of 20 samples at 50 Hz have 40 at 100 and 200 at 500 Hz; each is simulated on its own grid."""
    every = [swing(rate_hz, 3.0, 5) for rate_hz in (500.0, 50.0, 100.0)]
    work = calibration_input(settings_of(owners, *every, holdout_part=0.0))
    problem = Problem(work.robot, work.space, work.episodes, threads=1)
    assert problem.period_s == pytest.approx(0.02) and problem.rates == 3
    lengths = {e.period_s: 0 for e in problem.episodes}
    for data in problem.windows(20):
        lengths[problem.episodes[data.episode].period_s] = data.windows.length
        episode = problem.episodes[data.episode]
        assert problem.batch(1, data.episode).robot.step_s == pytest.approx(episode.step_s)
        start = data.windows.start[0], data.windows.start[0] + data.windows.length
        assert np.ptp(episode.time_s[list(start)]) == pytest.approx(0.4)
    assert {round(1 / period_s): n for period_s, n in lengths.items()} == {500: 200, 50: 20, 100: 40}
    theta = problem.space.nominal[None]
    errors = [
        np.std(problem.predict(theta, np.zeros(1), data).observed[0] - data.measured)
        for data in problem.windows(5)
    ]
    # The owner's values err by as much in recordings of the same motion, whatever their rate.
    assert max(errors) < 1.5 * min(errors)


def test_a_short_recording_is_one_window_beside_longer_ones(owners: Path) -> None:
    """Windows of 1 s: a recording of 0.8 s is not left out; without a longer one there is no such window."""
    long, short = swing(100.0, 3.0, 6), swing(100.0, 0.8, 7)
    work = calibration_input(settings_of(owners, long, short, holdout_part=0.0))
    problem = Problem(work.robot, work.space, work.episodes, threads=1)
    lengths = [data.windows.length for data in problem.windows(100)]
    assert lengths[0] == 100 and lengths[-1] == 79
    assert len(problem.windows(100, shorter=False)) == len(lengths) - 1
    alone = problem.on([problem.episodes[-1]], None)
    with pytest.raises(InsufficientDataError, match=r"1\.00 s"):
        alone.windows(100)


@pytest.mark.parametrize(
    ("seconds", "fitted", "held"), [([0.8], 1, 0), ([1.7], 1, 1), ([1.0] * 8, 6, 2), ([4.0], 2, 1)]
)
def test_what_of_short_recordings_is_held_out(
    owners: Path, seconds: list[float], fitted: int, held: int
) -> None:
    """A quarter of each; of eight short ones two as a whole; of one that is too short nothing."""
    data = [swing(100.0, s, 20 + k) for k, s in enumerate(seconds)]
    said: list[str] = []
    work = calibration_input(settings_of(owners, *data), say=said.append)
    assert (len(work.episodes), len(work.holdout)) == (fitted, held)
    assert any("held out as a whole" in line for line in said) == (len(seconds) == 8)
    assert any("no held-out error is known" in line for line in said) == (not held)


def test_rows_of_several_rates_are_not_moved(owners: Path) -> None:
    """Commands one row late are one shift at one rate only: at two nothing is tried or named."""
    work = calibration_input(settings_of(owners, swing(100.0, 3.0, 8), swing(50.0, 3.0, 9)))
    problem = Problem(work.robot, work.space, work.episodes, threads=1)
    result = cast(CalibrationResult, SimpleNamespace(latency_s=0.0, chi2=50.0))
    assert late_commands(problem, result) == () and not problem.steps


def test_a_policy_in_the_loop_needs_one_rate() -> None:
    """Its simulators have one control period."""
    rates = [Sampling(period_s=1 / hz, substeps=5, samples_per_tick=2) for hz in (100.0, 100.0, 70.0)]
    assert one_rate(rates[:2]) is rates[0]
    with pytest.raises(ConfigurationError, match=r"several rates \(70, 100 Hz\)"):
        one_rate(rates)


def test_a_search_for_several_rates() -> None:
    """Pipelines search by `eki`; a search that compares sample with sample is refused alone."""
    assert with_rates("default") == "default+eki" and with_rates("output-error") == "output-error+eki"
    assert with_rates("local") == "local"
    with pytest.raises(ConfigurationError, match="recordings of one rate"):
        with_rates("deal")
