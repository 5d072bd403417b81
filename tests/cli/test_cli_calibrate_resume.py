"""The verb `calibrate` stopped by Ctrl-C, resumed, and watched."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw import calibration
from deal_hw.calib.report import page
from deal_hw.calibration import CalibrationResult, Progress, ProgressCallback
from deal_hw.cli import calibrate as verb
from deal_hw.cli.main import EXIT_ERROR, EXIT_INTERRUPTED, EXIT_OK, main
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.motions.excitation.behaviours import RichBehaviour, RichConfig
from deal_hw.workflows.calibration.result_folder import BestSoFar
from deal_hw.workflows.emulation.virtual import VirtualCartpole


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of random set-points."""
    folder = tmp_path_factory.mktemp("run") / "dataset"
    behaviour = RichBehaviour(DESCRIPTION, None, RichConfig(duration_s=2.2, balance_s=0.0), 1)
    with Dataset.create_or_open(folder, DESCRIPTION) as store:
        path = store.next_episode_path()
        VirtualCartpole(nominal_truth("sensor", 4, actuation_ticks=9)).run(
            behaviour, 2.2, path, {"motion": "rich", "purpose": "collect", "robot": "cartpole"}
        )
        store.note_episode(path)
    return folder


SEARCH_ALONE = ("--search", "eki", "--no-refine")


def command(dataset: Path, out: Path, *more: str, method: Sequence[str] = SEARCH_ALONE) -> list[str]:
    """Return the arguments of a short calibration of two parameters."""
    words = ["calibrate", str(dataset), "--out", str(out), "--free", "cart.mass", "servo.stiffness"]
    words += ["--latency", "0.009", "--population", "12", "--generations", "8", "--quiet"]
    return [*words, *method, *more]


def stop_after(monkeypatch: pytest.MonkeyPatch, calls: int) -> None:
    """Let a Ctrl-C come in while the progress is reported for the n-th time."""

    @contextlib.contextmanager
    def watching(*_: Any) -> Iterator[ProgressCallback]:
        left = calls

        def progress(_: Progress) -> None:
            nonlocal left
            left -= 1
            if left == 0:
                raise KeyboardInterrupt

        yield progress

    monkeypatch.setattr(verb, "watching", watching)


@pytest.mark.slow
def test_stopped_calibration_says_how_to_go_on_and_does(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit status 130 and the way to resume; then the numbers of a run that was never stopped."""
    # A search with a refinement, which always runs.
    refined = ("--method", "deal-paper-replay")
    assert main(command(dataset, tmp_path / "whole", method=refined)) == EXIT_OK
    checkpoint = tmp_path / "parts" / "calibration" / "checkpoint.npz"
    with pytest.MonkeyPatch.context() as patch:
        stop_after(patch, 4)
        assert main(command(dataset, tmp_path / "parts", method=refined)) == EXIT_INTERRUPTED
    reported = capsys.readouterr().err
    assert str(checkpoint) in reported and "--resume" in reported
    assert checkpoint.exists()
    assert main(command(dataset, tmp_path / "parts", "--resume", method=refined)) == EXIT_OK
    assert not checkpoint.exists()
    whole, parts = (
        json.loads((tmp_path / name / "calibration" / "result.json").read_text())
        for name in ("whole", "parts")
    )
    for part in (whole, parts):
        del part["seconds"], part["provenance"]["search_seconds"]
    assert parts == whole


def test_stopped_before_the_first_generation_keeps_nothing(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then there is nothing to resume, and both the stop and the attempt say so."""
    stop_after(monkeypatch, 1)
    assert main(command(dataset, tmp_path)) == EXIT_INTERRUPTED
    assert "there is no state to --resume" in capsys.readouterr().err
    assert main(command(dataset, tmp_path, "--resume")) == EXIT_ERROR
    assert "nothing to resume" in capsys.readouterr().err


def test_other_settings_are_not_resumed(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another seed is another run: its checkpoint is refused and kept; without --resume it is replaced."""
    checkpoint = tmp_path / "calibration" / "checkpoint.npz"
    with pytest.MonkeyPatch.context() as patch:
        stop_after(patch, 3)
        assert main(command(dataset, tmp_path)) == EXIT_INTERRUPTED
    before = checkpoint.read_bytes()
    assert main(command(dataset, tmp_path, "--resume", "--seed", "1")) == EXIT_ERROR
    assert "cannot be resumed" in capsys.readouterr().err
    assert checkpoint.read_bytes() == before
    assert main(command(dataset, tmp_path, "--seed", "1")) == EXIT_OK
    assert not checkpoint.exists()


def test_view_of_the_search_is_written(dataset: Path, tmp_path: Path) -> None:
    """`--watch-save` writes a recording of population, trace and motion, and changes no number."""
    pytest.importorskip("rerun")
    view = tmp_path / "view" / "search.rrd"
    assert main(command(dataset, tmp_path / "watched", "--watch-save", str(view))) == EXIT_OK
    assert main(command(dataset, tmp_path / "plain")) == EXIT_OK
    data = view.read_bytes()
    assert data[:3] == b"RRF"
    watched, plain = (
        json.loads((tmp_path / name / "calibration" / "result.json").read_text())["parameters"]
        for name in ("watched", "plain")
    )
    assert watched == plain


def test_the_best_fit_so_far_is_said_and_kept(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C after the local fit: the fit is written, the range its interval; a result replaces it."""

    @contextlib.contextmanager
    def watching(*_: Any) -> Iterator[ProgressCallback]:
        def progress(reported: Progress) -> None:
            if reported.stage == "latency":
                raise KeyboardInterrupt

        yield progress

    words = [w for w in command(dataset, tmp_path) if w not in ("--quiet", *SEARCH_ALONE)]
    latency = words.index("--latency")
    del words[latency : latency + 2]
    with monkeypatch.context() as patch:
        patch.setattr(verb, "watching", watching)
        assert main(words) == EXIT_INTERRUPTED
    reported = capsys.readouterr().err
    assert "s, local fit: residuals" in reported and "best so far" in reported
    kept = tmp_path / "calibration" / "so_far"
    found = CalibrationResult.from_json(json.loads((kept / "result.json").read_text()))
    assert found.method == "interrupted after local fit"
    assert (kept / "calibrated.xml").exists()
    low_high = [(found.space.low[k], found.space.high[k]) for k in range(2)]
    assert found.interval == pytest.approx(np.array(low_high))
    assert main([*words, "--no-report", "--no-advise"]) == EXIT_OK
    assert not kept.exists()


def test_a_worse_fit_does_not_replace_the_best() -> None:
    """The third fit is worse than the second; the fourth is kept, but too little better to be reported."""
    space = k9_space().with_free(("cart.mass", "servo.stiffness"))
    errors = iter((0.2, 0.1, 0.15, 0.098))
    reported: list[str] = []
    best = BestSoFar(
        space, lambda *_: {"nominal": 0.5, "calibrated": next(errors), "null": 1.0}, reported.append
    )
    best(Progress("search", 1, 9))
    assert best.result is None
    for stage in ("local fit", "search", "refinement", "latency"):
        best(Progress(stage, 1, 1, estimate=space.nominal, latency_s=0.01, values={"chi2": 2.0}))
        assert best.result is not None
        assert best.result.method == "interrupted after " + ("search" if stage == "refinement" else stage)
    assert best.result is not None
    assert best.result.heldout_nrmse == {"nominal": 0.5, "calibrated": 0.098, "null": 1.0}
    assert (
        len(reported) == 2
        and "held-out error 10 % of the signal's range (your own model: 50 %)" in reported[1]
    )


FILES = {"result.json", "distribution.json", "trace.npz", "calibrated.xml", "plain_mujoco.xml", "report.html"}
FILES |= {"actuators.yaml", "urdf.yaml", "values.yaml", "bam.json"}


@pytest.mark.parametrize(
    ("moment", "number"),
    [
        ("report.html", signal.SIGTERM),
        ("moving", signal.SIGINT),
        pytest.param("moving", signal.SIGTERM, marks=pytest.mark.slow),
    ],
)
def test_an_interrupt_at_the_end_leaves_whole_results(
    dataset: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    moment: str,
    number: signal.Signals,
) -> None:
    """A real signal while a file is written: all files are there, that is reported, and the status is 130."""
    hooks = {"report.html": (page, "write_report"), "moving": (shutil, "move")}
    where, name = hooks[moment]
    real = getattr(where, name)
    pressed: list[Any] = []

    def interrupted(*arguments: Any, **named: Any) -> Any:
        # While the calibration runs, its best fit moves into so_far.
        if not pressed and "so_far" not in f"{arguments}":
            pressed.append(True)
            os.kill(os.getpid(), number)
        return real(*arguments, **named)

    monkeypatch.setattr(where, name, interrupted)
    assert main(command(dataset, tmp_path)) == EXIT_INTERRUPTED
    assert pressed
    reported = capsys.readouterr().err
    assert (
        f"the results in {tmp_path / 'calibration'} are complete" in reported and "--resume" not in reported
    )
    assert {file.name for file in (tmp_path / "calibration").iterdir()} == FILES
    assert [file.name for file in tmp_path.iterdir()] == ["calibration"]
    assert calibration.read_result(tmp_path / "calibration").method == "eki"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
