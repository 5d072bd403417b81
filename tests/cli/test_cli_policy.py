"""``deal-hw policy``: what was imported is printed and tried; what fails is not written, or asked about."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fakes import foreign_policy
from fakes.foreign_policy import DESCRIPTION, Foreign

import deal_hw
from deal_hw.cli.main import main
from deal_hw.drivers.go2.messages.wire import WIRE_JOINTS
from deal_hw.errors import ConfigurationError, PolicyError
from deal_hw.policies import walking_trial
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.workflows.running.plan import RunPlan, check_plan
from deal_hw.workflows.running.view import RunView
from deal_hw.workflows.shipped import required_policy


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """A walk half as long, of one robot for each command, shows the same."""
    trial = walking_trial.WalkingTrial(seconds=3.0, robots=1)
    monkeypatch.setattr(
        walking_trial, "try_walking", functools.partial(walking_trial.try_walking, trial=trial)
    )


@pytest.fixture
def verb(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return what imports a folder of unitree_rl_lab, and returns exit code, output and error output."""

    def run(values: Any = None, *more: str) -> tuple[int, str, str]:
        folder = foreign_policy.lab_folder(tmp_path / "run", Foreign(), values)
        words = ["policy", "import", str(folder), "--robot", "go2", "--out", str(tmp_path / "walk.onnx")]
        code = main([*words, "--clock-at-rest", "runs", *more])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return run


def plan(path: Path, **more: Any) -> RunPlan:
    """Return the plan of a run."""
    return RunPlan(robot="go2", transport="dds", policy=str(path), velocity="0.3,0,0", **more)


@pytest.mark.slow
def test_an_import_is_printed_tried_and_deploys(
    tmp_path: Path, verb: Callable[..., tuple[int, str, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    """Tables in the network's order, the walk, the file; a run takes it without a question."""
    code, out, err = verb()
    assert (code, err) == (0, "")
    path = tmp_path / "walk.onnx"
    rows = [line.split() for line in out.splitlines()]
    assert ["0", "FL_hip_joint", "0.1", "0.1", "0.125", "31.5", "1"] in rows
    assert ["8", "FL_calf_joint", "-1.5", "-1.5", "0.2", "32.5", "1"] in rows
    for part in (
        "47 observations, 12 joints of go2, 50 Hz, from unitree_rl_lab (policy.onnx)",
        "commands: x [m/s] -0.6 to 1, y [m/s] -0.5 to 0.5, yaw [rad/s] -1 to 1",
        "clock: 2.5 turns per second; always runs",
        "turn right 0.6 rad/s",
        f"written: {path}",
        f"next: deal-hw deploy go2 --port PORT --policy {path}",
    ):
        assert part in out
    assert OnnxPolicy(path).spec.training["calibration_verdict"] == "green"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["run", "walk.onnx"]

    view = RunView(say=pytest.fail)
    assert check_plan(plan(path), DESCRIPTION, view).policy_digest == OnnxPolicy(path).digest

    assert main(["policy", "show", str(path)]) == 0
    shown = capsys.readouterr().out
    assert shown.strip() in out.replace("\r", "")
    assert main(["policy", "check", str(path)]) == 0
    assert "followed" in capsys.readouterr().out


def exchanged_legs() -> Any:
    """Return the side file with the two front legs exchanged."""
    values = Foreign().deploy_yaml()
    slots = {WIRE_JOINTS.index(name): name for name in WIRE_JOINTS}
    other = {"FL": "FR", "FR": "FL"}
    values["joint_ids_map"] = [
        WIRE_JOINTS.index(other.get(slots[slot][:2], slots[slot][:2]) + slots[slot][2:])
        for slot in values["joint_ids_map"]
    ]
    return values


def wrong_sign() -> Any:
    """Return the side file with the gyro's sign wrong."""
    values = Foreign().deploy_yaml()
    values["observations"]["base_ang_vel"]["scale"] = [-0.2] * 3
    return values


@pytest.mark.parametrize(
    "values", [pytest.param(exchanged_legs(), marks=pytest.mark.slow), wrong_sign()], ids=["legs", "sign"]
)
def test_what_would_fall_is_not_written(
    tmp_path: Path, verb: Callable[..., tuple[int, str, str]], values: Any
) -> None:
    """Before any motor moves: exit code 1, and no file."""
    code, out, err = verb(values)
    assert (code, err) == (1, "")
    assert "a robot that stands still stays up for 3.0 s" in out
    assert "A joint order, a sign, a scale or a history may be wrong" in out
    assert "not written; --force" in out and "written: " not in out
    assert sorted(file.name for file in tmp_path.iterdir()) == ["run"]


@pytest.mark.slow
def test_a_forced_import_is_asked_about(
    tmp_path: Path, verb: Callable[..., tuple[int, str, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    """The file has a red verdict: deploy refuses where nobody can answer, and asks an operator."""
    code, out, _ = verb(wrong_sign(), "--force")
    path = tmp_path / "walk.onnx"
    assert code == 0 and f"written: {path}" in out and "fault: " in out
    said = r"imported although it failed in the simulator \(.* falls after .*\): a joint order, a sign"
    with pytest.raises(PolicyError, match=said + r".*import it again.*--trust-calibration"):
        check_plan(plan(path), DESCRIPTION)

    class Operator(RunView):
        answer = False

        def confirm(self, warning: str, question: str) -> bool | None:
            assert "failed in the simulator" in warning
            return self.answer

    with pytest.raises(PolicyError, match="not run; import it again"):
        check_plan(plan(path), DESCRIPTION, Operator())
    Operator.answer = True
    check_plan(plan(path), DESCRIPTION, Operator())
    check_plan(plan(path, trust_calibration=True), DESCRIPTION)
    assert main(["policy", "check", str(path)]) == 1
    capsys.readouterr()


def test_what_could_not_be_tried_is_told(tmp_path: Path, verb: Callable[..., tuple[int, str, str]]) -> None:
    """A policy that follows no velocity has no walk; deploying it warns the operator."""
    values = copy.deepcopy(Foreign().deploy_yaml())
    del values["observations"]["velocity_commands"], values["observations"]["gait_phase"]
    folder = foreign_policy.lab_folder(tmp_path / "other", Foreign(), values)
    model = foreign_policy.without(Foreign().model(), Foreign(), ("velocity_commands", "gait_phase"))
    (folder / "exported" / "policy.onnx").write_bytes(model.SerializeToString())
    said: list[str] = []
    report = deal_hw.import_policy(folder, robot="go2", out=tmp_path / "stand.onnx", say=said.append)
    assert report.untried == "the policy follows no commanded velocity" and report.exit_code == 0
    assert any("not tried in the simulator" in line for line in said)
    warned: list[str] = []
    check_plan(plan(tmp_path / "stand.onnx"), DESCRIPTION, RunView(warned.append))
    assert "could not be tried in the simulator (the policy follows no commanded velocity)" in warned[0]
    check_plan(plan(tmp_path / "stand.onnx", trust_calibration=True), DESCRIPTION, RunView(pytest.fail))


def test_the_report_of_python(tmp_path: Path) -> None:
    """The same as the verb, as an object; nothing is printed."""
    report = deal_hw.check_policy(required_policy("go2"))
    assert report.faults == () and report.exit_code == 0 and report.walk is not None
    assert "FL_hip_joint" in report.table() and "ahead 0.5 m/s" in report.table()
    assert "FL_hip_joint" in report._repr_html_()
    with pytest.raises(ConfigurationError, match=r"--out .*policy\.bin: the file to write is an \.onnx file"):
        deal_hw.import_policy("x.onnx", robot="go2", out=tmp_path / "policy.bin")


def test_the_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    """With an example, and with every option that answers what a file does not say."""
    with pytest.raises(SystemExit):
        main(["policy", "import", "--help"])
    text = capsys.readouterr().out
    assert "deal-hw policy import exported/policy.onnx" in text
    for option in (
        "--joints",
        "--observation-scales",
        "--history",
        "--command-range",
        "--clock-at-rest",
        "--force",
    ):
        assert option in text
