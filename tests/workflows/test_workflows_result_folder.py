"""A fit is never lost: it is on the disk before the checks, and what fails after it costs nothing."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.calib.design import advice
from deal_hw.calib.pipeline import stages
from deal_hw.calib.report import gather, page
from deal_hw.calib.validation import checks, metrics
from deal_hw.calibration import BEFORE_SEARCH, CalibrationResult, Progress, read_result
from deal_hw.cli.main import EXIT_OK, main
from deal_hw.errors import DatasetError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim import plain_model
from deal_hw.workflows.calibration.result_folder import BestSoFar, ResultFolder, unfinished
from deal_hw.workflows.train import read_distribution

PENDULUM = """<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="hub" axis="0 1 0" damping="{damping}" frictionloss="0.003" armature="1e-3"/>
      <inertial pos="0 0 -0.2" mass="0.2" diaginertia="1e-3 1e-3 1e-6"/>
    </body>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Arguments of a short calibration: a pendulum of half the model's damping, 100 Hz, noise of 1 mrad."""
    folder = tmp_path_factory.mktemp("swing")
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(damping=0.004))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[0] = 2.0
    time = np.arange(0.0, 5.0, 0.01)
    seen = np.empty(time.size)
    for k in range(time.size):
        seen[k] = data.qpos[0] + 1e-3 * rng.standard_normal()
        mujoco.mj_step(model, data, 5)
    columns = np.stack([time, seen], axis=1)
    np.savetxt(folder / "swing.csv", columns, delimiter=",", header="time,hub_pos", comments="")
    (folder / "pendulum.xml").write_text(PENDULUM.format(damping=0.008), encoding="utf-8")
    given = ["calibrate", "--model", str(folder / "pendulum.xml"), "--data", str(folder / "swing.csv")]
    return [*given, "--method", "local", "--threads", "1"]


def breaks(name: str) -> Callable[..., Any]:
    """Return a function that raises an error with a name."""

    def broken(*_: Any, **__: Any) -> Any:
        raise ValueError(f"{name} is broken")

    return broken


FAILING: dict[str, tuple[Any, str]] = {
    "the physics step": (checks, "with_step"),
    "two halves of the data": (checks, "check_split_half"),
    "the latency's range": (checks, "latency_alarms"),
    "the held-out error": (metrics.HeldOut, "errors"),
    "the next recording": (advice, "next_recordings"),
    "the model for MuJoCo alone": (plain_model, "plain_facts"),
    "the report": (gather, "gather"),
}
"""What follows a fit, by its name, and the function that does it."""


def test_what_fails_after_the_fit_is_named_and_costs_nothing(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    checks_may_fail: None,
) -> None:
    """All at once: no traceback, the table is printed, each is named there and in the file; never green."""
    for name, (where, function) in FAILING.items():
        monkeypatch.setattr(where, function, breaks(name))
    assert main([*words, "--out", str(tmp_path / "run")]) == EXIT_OK
    printed, reported = capsys.readouterr()
    found = read_result(tmp_path / "run" / "calibration")
    assert found.estimate[found.space.names.index("hub.damping")] == pytest.approx(0.004, rel=0.1)
    assert set(found.provenance["checks_failed"]) == set(FAILING)
    for name in FAILING:
        line = f"check of {name}: failed, ValueError: {name} is broken (test_workflows_result_folder.py, line"
        assert line in " ".join(printed.split())
        assert any(f"The check of {name} failed" in alarm.seen for alarm in found.alarms)
    assert "hub.damping" in printed and "Traceback" not in printed + reported
    values = json.loads((tmp_path / "run" / "calibration" / "result.json").read_text(encoding="utf-8"))
    assert values["verdict"] != "green" and values["unchecked"] is False
    assert not (tmp_path / "run" / "calibration" / "report.html").exists()


def test_a_report_that_cannot_be_drawn_leaves_all_other_files(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, checks_may_fail: None
) -> None:
    """It fails while the files are written; they are written again without it."""
    monkeypatch.setattr(page, "write_report", breaks("the page"))
    assert main([*words, "--out", str(tmp_path), "--quiet", "--no-advise"]) == EXIT_OK
    found = read_result(tmp_path / "calibration")
    assert "the page is broken" in found.provenance["checks_failed"]["the report"]
    assert (tmp_path / "calibration" / "calibrated.xml").exists()
    assert not (tmp_path / "calibration" / "report.html").exists()


def test_an_error_after_the_first_fit_makes_that_fit_the_result(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    checks_may_fail: None,
) -> None:
    """The table is printed, the verdict claims no check, and the exit status is that of a failed check."""
    monkeypatch.setattr(stages, "first_outcome", breaks("the next stage"))
    assert main([*words, "--out", str(tmp_path)]) == 1
    printed, _ = capsys.readouterr()
    assert "hub.damping" in printed
    assert "ended by an error, ValueError: the next stage is broken" in " ".join(printed.split())
    found = read_result(tmp_path / "calibration")
    assert found.unchecked and found.method == "interrupted after local fit"
    assert found.estimate[found.space.names.index("hub.damping")] == pytest.approx(0.004, rel=0.1)
    values = json.loads((tmp_path / "calibration" / "result.json").read_text(encoding="utf-8"))
    assert (
        values["verdict"] in ("amber", "red")
        and "Checks of this result were not made" in values["verdict_reason"]
    )
    assert not (tmp_path / "calibration" / "so_far").exists()


def test_an_error_before_the_first_fit_stays_an_error(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no fit that could be the result."""
    monkeypatch.setattr(stages, "local_fit", breaks("the fit"))
    with pytest.raises(ValueError, match="the fit is broken"):
        main([*words, "--out", str(tmp_path), "--quiet"])
    assert not (tmp_path / "calibration").exists()


KILLED = """if 1:
    import os, signal, sys
    from deal_hw.{module} import {where}
    from deal_hw.cli.main import main
    {where}.{function} = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
    main(sys.argv[1:])
"""


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("module", "where", "function"),
    [
        ("calib.validation", "checks", "judge"),
        pytest.param("calib.design", "advice", "next_recordings", marks=pytest.mark.slow),
    ],
)
def test_a_kill_in_a_check_leaves_the_fit_on_the_disk(
    words: list[str], tmp_path: Path, module: str, where: str, function: str
) -> None:
    """Values and intervals, marked as unchecked; the terminal has said where; inspect and train read them."""
    program = KILLED.format(module=module, where=where, function=function)
    done = subprocess.run(
        [sys.executable, "-c", program, *words, "--out", str(tmp_path)], capture_output=True, text=True
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    kept = tmp_path / "calibration" / "so_far"
    assert f"the best fit so far is in {kept}, not checked" in done.stderr
    found = read_result(kept)
    damping = found.space.names.index("hub.damping")
    assert found.unchecked and found.estimate[damping] == pytest.approx(0.004, rel=0.1)
    assert found.interval[damping, 0] > found.space.low[damping]
    assert "intervals are those of the fit" in found.alarms[0].means
    assert "run the same command again" in found.alarms[0].do
    values = json.loads((kept / "result.json").read_text(encoding="utf-8"))
    assert values["verdict"] != "green" and "not finished" in values["verdict_reason"]
    assert read_distribution(kept / "distribution.json").space.names == found.space.names


SPACE = ParameterSpace([Parameter.around("a", "body_mass", ["a"], "kg", 1.0)])


def fit(stage: str, value: float, chi2: float) -> Progress:
    """Return the progress that offers a fit."""
    return Progress(stage, 1, 1, estimate=np.array([value]), latency_s=0.0, values={"chi2": chi2})


def test_the_terminal_and_the_file_say_one_thing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before the search nothing can be resumed; once there is a state, the file is written again."""
    folder = ResultFolder(path=tmp_path / "calibration")
    kept: list[CalibrationResult] = []

    def keep(result: CalibrationResult) -> Path:
        kept.append(result)
        return folder.so_far

    best = BestSoFar(SPACE, None, keep=keep, next_step=lambda: folder.next_step)
    best(fit("local fit", 1.1, 2.0))
    best(Progress(BEFORE_SEARCH, 1, 1, "a search follows"))

    def told() -> str:
        with pytest.raises(KeyboardInterrupt), folder.resumable():
            raise KeyboardInterrupt
        return capsys.readouterr().err

    assert len(kept) == 1 and "there is no state to --resume" in kept[0].alarms[0].do
    assert kept[0].alarms[0].do in told()
    folder.path.mkdir()
    folder.checkpoint.write_bytes(b"state")
    best(Progress("search", 1, 9))
    assert len(kept) == 2 and f"{folder.checkpoint}: the same command with --resume" in kept[1].alarms[0].do
    assert kept[1].alarms[0].do in told()
    assert kept[1].estimate == kept[0].estimate
    best(Progress("search", 2, 9))
    assert len(kept) == 2


def test_the_fit_of_the_result_takes_the_place_of_a_better_one() -> None:
    """Its intervals and checks are of that fit; errors of the same values are computed once."""
    asked: list[float] = []

    def judge(theta: Any, *_: Any) -> dict[str, float]:
        asked.append(float(theta[0]))
        return {"nominal": 0.5, "calibrated": 0.1 * float(theta[0])}

    best = BestSoFar(SPACE, judge)
    best(fit("local fit", 1.1, 2.0))
    fitted = CalibrationResult(
        method="last fit",
        space=SPACE,
        estimate=np.array([1.2]),
        interval=np.array([[1.1, 1.3]]),
        covariance=np.array([[1e-3]]),
        chi2=1.0,
    )
    best(Progress("after the fit", 1, 1, fitted=fitted))
    best.take(fitted)
    assert asked == [1.1, 1.2]
    assert best.result is not None and best.result.estimate == 1.2 and best.result.unchecked
    assert best.result.method == "interrupted after last fit"
    assert best.result.heldout_nrmse["calibrated"] == pytest.approx(0.12)


def test_who_receives_the_progress_can_stop_the_calibration(words: list[str]) -> None:
    """An error of the caller's is the caller's: it is no failed check, and no fit takes its place."""

    def stop(progress: Progress) -> None:
        if progress.estimate is not None:
            raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        deal_hw.calibrate(model=words[2], data=[words[4]], method="local", threads=1, progress=stop)


def test_a_full_disk_does_not_end_the_calibration() -> None:
    """That the fit cannot be kept is said, each time, and the next one is tried."""
    said: list[str] = []

    def keep(_: CalibrationResult) -> Path:
        raise DatasetError("so_far cannot be written: No space left on device")

    best = BestSoFar(SPACE, None, said.append, keep=keep)
    best(fit("local fit", 1.1, 2.0))
    assert any("cannot be kept: so_far cannot be written: No space left" in text for text in said)
    assert best.result is not None


def test_an_unchecked_result_is_read_again(tmp_path: Path) -> None:
    """The mark and its reason survive the file, and the verdict says no more than is known."""
    found = CalibrationResult(
        method="m", space=SPACE, estimate=np.array([1.0]), interval=np.array([[0.9, 1.1]]), chi2=1.0,
        heldout_nrmse={"nominal": 0.5, "calibrated": 0.1},
    )  # fmt: skip
    marked = unfinished(found, "was stopped", "Go on.")
    again = CalibrationResult.from_json(json.loads(json.dumps(marked.to_json())))
    assert again.unchecked and again.alarms[0].seen == "The calibration was stopped."
    assert deal_hw.calibration.CalibrationResult is CalibrationResult
    from deal_hw.calib.report.verdict import trust

    assert trust(found).colour == "green"
    verdict = trust(again)
    assert (
        verdict.colour == "amber" and "No interval was computed" in verdict.means and verdict.do == "Go on."
    )
