"""Runs of a robot from Python: what comes back, what is reported, and that nothing is printed."""

from __future__ import annotations

import ast
import dataclasses
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import deal_hw
from deal_hw.control.process.channel import Outcome
from deal_hw.data.recording.excitation import Excitation
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.emulator.faults import CanFaults
from deal_hw.errors import ConfigurationError, PolicyMismatchError, TransportError
from deal_hw.motions.excitation.level import ExcitationLevelSearch
from deal_hw.parameters import ParameterDistribution
from deal_hw.policy import VERDICT
from deal_hw.workflows.emulation.common import next_line
from deal_hw.workflows.emulation.process import arguments
from deal_hw.workflows.emulation.settings import EmulateCartpoleSettings, EmulateGo2Settings, Go2Options
from deal_hw.workflows.running import supervised
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import EpisodeReport
from deal_hw.workflows.running.view import RunView
from deal_hw.workflows.say import silent
from deal_hw.workflows.shipped import required_policy

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 0.6


@pytest.mark.slow
def test_a_robot_is_emulated_recorded_and_replayed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Paths, outcome and truth come back; sentences go to `say` alone; a path may be a string."""
    output: list[str] = []
    with deal_hw.emulate("cartpole", nominal=True, profile="sensor", seed=3) as robot:
        port = robot.port
        assert port in repr(robot) and not robot.truth
        run = deal_hw.collect(
            "cartpole", port=port, out=str(tmp_path), motion="hold", seconds=SECONDS, say=output.append
        )
        again = deal_hw.replay(run.paths[0], port=port, dataset=str(tmp_path / "again"))
        dry = deal_hw.deploy("cartpole", port=port, seconds=SECONDS, dry_run=True)
        monkeypatch.chdir(tmp_path)
        kept = deal_hw.replay(run.paths[0], port=port)
        lost = deal_hw.replay(run.paths[0], port=port, record=False)
    assert run.outcome is again.outcome is dry.outcome is Outcome.FINISHED
    assert run.dataset == tmp_path / "dataset" and run.paths[0].is_file()
    assert again.paths[0].parent == tmp_path / "again" / "episodes" and dry.paths == ()
    assert kept.dataset == Path("runs/replay_cartpole/dataset") and kept.paths[0].is_file()
    assert lost.dataset is None and lost.paths == ()
    assert any("too short: `deal-hw calibrate`" in text for text in output)
    assert "finished: the run is over" in output
    for shown in (run._repr_html_(), run.table()):
        assert str(run.paths[0]) in shown and "finished" in shown
    assert robot.truth["seed"] == 3 and robot.truth["parameters"]
    assert capfd.readouterr() == ("", "")


def test_warnings_reach_the_operator_of_a_silent_program(capsys: pytest.CaptureFixture[str]) -> None:
    """What the operator must know goes to standard error, unless the program takes sentences itself."""
    lost = EpisodeReport(
        path=None,
        outcome=Outcome.TRIPPED,
        reason="the connection is lost",
        passive_confirmed=False,
        warnings=("switch it off by hand",),
    )
    output: list[str] = []
    for view in (RunView.of_python(silent), RunView.of_python(output.append), RunView()):
        view.ended(lost)
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "warning: switch it off by hand\n")
    assert output == ["tripped: the connection is lost", "warning: switch it off by hand"]
    # The reason of a failure follows as the error.
    assert dataclasses.replace(lost, outcome=Outcome.FAILED).lines() == ["failed"]
    kept = dataclasses.replace(lost, path=Path("000003.mcap"))
    assert kept.lines()[-1].startswith("  to see why: deal-hw inspect 000003.mcap (docs/troubleshooting.md)")
    assert kept.lines()[-2] == "  calibrate leaves this episode out"


@pytest.mark.parametrize(
    ("flag", "confirmed", "gentler"),
    [
        ("position", True, True),
        ("velocity", True, True),
        ("position", False, False),
        ("state_stale", True, False),
        ("action_late", True, False),
        ("transport_errors", True, False),
        ("operator_stop", True, False),
    ],
)
def test_a_gentler_motion_is_advised_where_it_can_help(flag: str, confirmed: bool, gentler: bool) -> None:
    """Not after a lost connection, on a busy computer, or for an operator who pressed a button."""
    search = ExcitationLevelSearch(0.0, 4, rearm=False)
    plan = RunPlan(robot="cartpole", motion="rich", policy="", seconds=4.0, seed=0)
    moved = Excitation(4.0, (0.4, 4.0), (2.0, 8.0), (1.0, 3.0), (9, 9), (0.4,), (40,))
    ended = EpisodeReport(
        path=None,
        outcome=Outcome.TRIPPED,
        reason="joint 'cart' is at 0.39 m",
        passive_confirmed=confirmed,
        motion=moved,
        flags=(flag,),
    )
    assert not supervised._to_repeat(search, plan, ended, DESCRIPTION)
    assert ("--excitation-level -1" in search.words) is gentler


def test_a_policy_for_another_robot_is_refused_before_the_port(tmp_path: Path) -> None:
    """As on the command line: the error is that of the policy, not of a port that is not there."""
    with pytest.raises(PolicyMismatchError):
        deal_hw.deploy("cartpole", port=str(tmp_path / "none"), policy=required_policy("go2"))


def test_an_emulator_that_does_not_start_says_why(tmp_path: Path) -> None:
    """Its own words come with the error."""
    missing = tmp_path / "truth.json"
    with pytest.raises(TransportError, match=r"did not start: .*truth\.json cannot be read"):
        deal_hw.emulate("cartpole", truth_from=missing).start()
    with pytest.raises(
        ConfigurationError, match="--reveal would have no effect: the robot's attribute truth"
    ):
        deal_hw.emulate("cartpole", reveal=True)
    with pytest.raises(ConfigurationError, match="--parent would have no effect"):
        deal_hw.emulate("cartpole", parent=1)


def test_an_emulator_says_how_to_reach_it() -> None:
    """The line can be pasted into another terminal."""
    settings = EmulateCartpoleSettings("cartpole", transport="can")
    line = next_line(settings, "/dev/pts/3").partition(": ")[2]
    assert line == "deal-hw doctor cartpole --port /dev/pts/3 --transport can"


def test_settings_become_options_of_the_command_line() -> None:
    """What differs from the defaults, switches that are off among it, and groups inside."""
    settings = EmulateCartpoleSettings(
        "cartpole", transport="can", seed=2, nominal=True, can=CanFaults(node=3, no_acknowledge=True)
    )
    assert arguments(settings, EmulateCartpoleSettings("cartpole")) == [
        "--transport",
        "can",
        "--seed",
        "2",
        "--nominal",
        "--node",
        "3",
        "--no-acknowledge",
    ]
    go2 = EmulateGo2Settings("go2", go2=Go2Options(remote_script=Path("r.json")))
    assert arguments(go2, EmulateGo2Settings("go2")) == ["--remote-script", "r.json"]
    link = deal_hw.LinkOptions(record_wire=False)
    assert arguments(link, deal_hw.LinkOptions()) == ["--no-record-wire"]


@dataclass(frozen=True)
class Found:
    """As much of a calibration as training asks for."""

    distribution: ParameterDistribution
    colour: str


def test_a_policy_is_trained_under_what_a_calibration_found(tmp_path: Path) -> None:
    """The result itself instead of its file: the policy carries digest and verdict."""
    space = k9_space()
    distribution = ParameterDistribution(
        space=space, mean=space.nominal, covariance=0.01 * np.eye(len(space)), latency_s=(0.01, 0.012)
    )
    reached: list[int] = []
    training = deal_hw.train(
        "cartpole",
        distribution=Found(distribution, "amber"),
        out=str(tmp_path),
        steps=1_200,
        members=8,
        progress=lambda status: reached.append(status.steps),
    )
    spec = training.policy.spec
    assert spec.trained_under == distribution.digest() and spec.training[VERDICT] == "amber"
    assert training.path == tmp_path / "policies" / "policy.onnx" and training.checkpoint.is_file()
    assert json.loads(training.record.read_text(encoding="utf-8"))["robot"] == "cartpole"
    assert training.status is not None and training.status.steps == reached[-1] == 1_200
    assert str(training.path) in training._repr_html_() and "mean return" in training.table()


def test_functions_for_a_robot_load_neither_torch_nor_mujoco() -> None:
    """The robot's own computer has neither."""
    code = (
        "import sys, deal_hw\n"
        "for name in ('collect', 'deploy', 'replay', 'emulate', 'design_excitation', 'train'):\n"
        "    getattr(deal_hw, name)\n"
        "print([n for n in ('mujoco', 'torch', 'scipy', 'rich', 'tyro') if n in sys.modules])"
    )
    reported = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert reported == "[]\n"


def test_no_workflow_prints_asks_or_ends_the_program() -> None:
    """It tells through `say`, and leaves the rest to who called it; the control process is a program."""
    found = []
    for path in sorted((ROOT / "deal_hw" / "workflows").rglob("*.py")):
        if path.name in ("say.py", "control_process.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in (
                "print",
                "input",
                "exit",
                "sys.exit",
                "sys.stdout.write",
                "sys.stderr.write",
            ):
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node.func)}")
    assert not found
