"""Long verbs in a pipe: a line every ten seconds of where they stand."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from deal_hw.calibration import Progress
from deal_hw.cli import bench, calibrate_output, design_excitation, piped, show, train
from deal_hw.cli.piped import PipedProgress
from deal_hw.clock import VirtualClock
from deal_hw.control.process.channel import HOMING, MAKING_PASSIVE, RUNNING, Beat
from deal_hw.training import TrainingStatus
from deal_hw.workflows.say import Say


class Lines:
    """A progress whose time passes by request: ten seconds a line."""

    def __init__(self) -> None:
        self.printed: list[str] = []
        self.made: list[PipedProgress] = []
        self.clock = VirtualClock()

    def make(self, title: str, quiet: bool = False) -> PipedProgress:
        """Return what a verb makes; its thread ends at once."""
        made = PipedProgress(title, quiet, clock=self.clock, wait=lambda s: True, say=self.printed.append)
        self.made.append(made)
        return made

    def after_ten_seconds(self) -> str:
        """Let ten seconds pass; return the line."""
        turns = iter((False, True))

        def wait(seconds: float) -> bool:
            assert seconds == 10.0
            ended = next(turns)
            if not ended:
                self.clock.advance_ns(round(seconds * 1e9))
            return ended

        made = self.made[-1]
        made._wait = wait
        made.tell()
        return self.printed[-1]


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Lines:
    """What verbs in a pipe make instead of a progress in real time."""
    found = Lines()
    for module in (bench, calibrate_output, design_excitation, show, train):
        monkeypatch.setattr(module, "PipedProgress", found.make)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: False, raising=False)
    return found


def test_a_line_comes_every_ten_seconds_until_the_end() -> None:
    """With the time since the beginning and the newest of what was noted, unless the last line had it."""
    clock = VirtualClock()
    printed: list[str] = []
    notes = iter(("search 3/40", "search 3/40", "", "search 3/40", None))

    def wait(seconds: float) -> bool:
        clock.advance_ns(round(seconds * 1e9))
        text = next(notes)
        if text is not None:
            progress.at(text)
        return text is None

    progress = PipedProgress("calibrate", clock=clock, wait=wait, say=printed.append)
    progress.tell()
    assert printed == ["calibrate: 10 s, search 3/40", "calibrate: 30 s", "calibrate: 40 s, search 3/40"]


def test_the_thread_ends_with_the_block(capsys: pytest.CaptureFixture[str]) -> None:
    """Before ten seconds nothing is reported; quiet starts no thread."""
    with PipedProgress("train") as progress:
        thread = progress._thread
        assert thread is not None and thread.is_alive()
    thread.join(10.0)
    assert not thread.is_alive()
    with PipedProgress("train", quiet=True) as silent:
        assert silent._thread is None
    assert capsys.readouterr() == ("", "")


def test_the_default_goes_to_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    """Results in standard output stay whole."""
    turns = iter((False, True))
    PipedProgress("bench", wait=lambda seconds: next(turns)).tell()
    reported = capsys.readouterr()
    assert reported.err == "bench: 0 s\n" and not reported.out


def test_calibrate(lines: Lines) -> None:
    """Stage, how far it is, and its message."""
    with calibrate_output.show_progress("calibrate (deal)", quiet=False) as tell:
        tell(Progress("search", 3, 40, "loss 0.2"))
        assert lines.after_ten_seconds() == "calibrate (deal): 10 s, search 3/40, loss 0.2"
        tell(Progress("intervals", 1, 2))
        assert lines.after_ten_seconds() == "calibrate (deal): 20 s, intervals 1/2"
        for chi2 in ("chi2 2.1", "chi2 0.66"):
            tell(Progress("local fit", 1, 1, chi2))
        assert lines.printed[2:] == [f"calibrate (deal): {calibrate_output.CHI2}"]


@pytest.mark.parametrize("phase", [HOMING, RUNNING])
def test_runs_of_a_robot(lines: Lines, phase: str) -> None:
    """collect, deploy and replay: the phase, and in the run how far it is."""
    with show.Terminal().progress("deploy cartpole 1/1", 30.0) as on_beat:
        on_beat(Beat(stamp_ns=5 * 10**9, count=0, phase=phase, silence_s=1.0))
        on_beat(Beat(stamp_ns=17 * 10**9, count=10, phase=phase, silence_s=1.0))
        doing = "running, 12 of 30 s" if phase == RUNNING else HOMING
        assert lines.after_ten_seconds() == f"deploy cartpole 1/1: 10 s, {doing}"


def test_a_robot_that_is_not_passive_is_said_once_for_each_reason(
    lines: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    """The countdown of 30 s is no news each second."""
    with show.Terminal().progress("collect", 4.0) as on_beat:
        for why in ("no answer", "the link is lost (gone; check it)"):
            for second in range(3):
                text = (
                    f"{MAKING_PASSIVE}: {why}; passive command repeated for {second} s, {30 - second} s left"
                )
                on_beat(Beat(stamp_ns=10**9 * second, count=0, phase=text, silence_s=1.0))
    printed = capsys.readouterr().err.splitlines()
    assert [line.partition(" passive: ")[2].partition(";")[0] for line in printed] == [
        "no answer",
        "the link is lost (gone",
    ]


def test_train(lines: Lines, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps, return and the task's measures."""
    reported: list[str] = []

    def run(config: Any, follow: Callable[[TrainingStatus], None], say: Say) -> Any:
        follow(TrainingStatus(steps=500, total=2000, mean_return=12.3, measures={"velocity_error_m_s": 0.25}))
        reported.append(lines.after_ten_seconds())

    monkeypatch.setattr(train, "run", run)
    monkeypatch.setattr(train, "_print", lambda training: None)
    train.train(train.KINDS.settings())
    assert reported == ["train: 10 s, 500/2000 steps, return 12.3 velocity_error_m_s 0.25"]


def test_design_excitation(lines: Lines, monkeypatch: pytest.MonkeyPatch) -> None:
    """Candidates tried."""
    reported: list[str] = []

    def run(config: Any, note: Callable[[int, int, str], None]) -> None:
        note(3, 60, "42.0 nats")
        reported.append(lines.after_ten_seconds())

    monkeypatch.setattr(design_excitation, "run", run)
    monkeypatch.setattr(design_excitation, "print_design", lambda robot, report: None)
    design_excitation.design_excitation(design_excitation.KINDS.settings(robot="cartpole", out=Path("o")))
    assert reported == ["design-excitation: 10 s, 3/60 42.0 nats"]


def test_bench(lines: Lines, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Rows done."""
    from deal_hw.bench import loop
    from deal_hw.bench.rows import Cells, RowTable
    from deal_hw.bench.settings import Loop

    reported: list[str] = []

    def rows() -> Iterator[dict[str, Any]]:
        yield {"seed": 0, "error": ""}
        reported.append(lines.after_ten_seconds())
        yield {"seed": 1, "error": ""}

    made = rows()
    cells = Cells(names=("seed",), run=lambda: next(made), args=[((seed,), ()) for seed in (0, 1)])
    table = RowTable(cells=cells, line=str, summary=lambda rows: None)
    monkeypatch.setattr(loop, "table", lambda settings: table)
    assert bench.bench(Loop(out=tmp_path / "rows.json")) == 0
    assert reported == ["bench loop: 10 s, 1/2 rows done"]


def test_on_a_terminal_there_is_a_bar_instead(lines: Lines, monkeypatch: pytest.MonkeyPatch) -> None:
    """No lines beside it."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with calibrate_output.show_progress("calibrate", quiet=False) as tell:
        tell(Progress("search", 3, 40))
    assert lines.made == [] and piped.EVERY_S == 10.0
