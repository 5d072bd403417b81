"""A policy that must not run is refused by the command before anybody looks for the robot."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
from fakes.faulty_policy import faulty_policy

from deal_hw.cli.main import main
from deal_hw.cli.show import Terminal
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import PolicyError
from deal_hw.policies.onnx_export import write_policy
from deal_hw.policies.onnx_runtime import SPEC_KEY, OnnxPolicy
from deal_hw.policy import VERDICT
from deal_hw.workflows.running.plan import RunPlan, check_plan
from deal_hw.workflows.shipped import shipped_policy

REFUSED = 2


@pytest.fixture
def deploy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return what deploys a policy to a port that is not there, and returns what the operator reads."""

    def run(policy: Path, *arguments: str) -> str:
        verb = arguments or ("deploy", "cartpole")
        assert main([*verb, "--port", str(tmp_path / "no-port"), "--policy", str(policy)]) == REFUSED
        printed = capsys.readouterr().err.strip()
        assert "Traceback" not in printed and "\n" not in printed
        return printed

    return run


def edited(path: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    """Write the shipped policy with a changed spec."""
    model = onnx.load(str(shipped_policy("cartpole")))
    (entry,) = [entry for entry in model.metadata_props if entry.key == SPEC_KEY]
    spec = json.loads(entry.value)
    edit(spec)
    entry.value = json.dumps(spec)
    path.write_bytes(model.SerializeToString())
    return path


def test_a_sound_policy_comes_as_far_as_the_port(deploy: Callable[..., str]) -> None:
    """So the refusals below come before it."""
    assert "no-port" in deploy(Path(str(shipped_policy("cartpole"))))


@pytest.mark.parametrize("quantity", ["torque", "velocty"])
def test_an_unknown_quantity_never_reaches_a_robot(
    tmp_path: Path, deploy: Callable[..., str], quantity: str
) -> None:
    """It was read as joint position and drove the robot."""
    path = edited(tmp_path / "p.onnx", lambda spec: spec["observation"][5].update(quantity=quantity))
    printed = deploy(path)
    assert f"field observation[5].quantity is '{quantity}'" in printed and "'velocity'" in printed
    assert "no-port" not in printed


@pytest.mark.parametrize("name", ["stiffness", "damping", "action_scale", "default_position"])
@pytest.mark.parametrize("value", [[], ["1"], [None], [float("nan")], [1.0, 1.0, 1.0], "1", None])
def test_wrong_numbers_are_refused_with_their_field(tmp_path: Path, name: str, value: object) -> None:
    """Text, null, NaN, too many, none: they came as far as the armed robot, or ended in a traceback."""
    path = edited(tmp_path / "p.onnx", lambda spec: spec.update({name: value}))
    with pytest.raises(PolicyError, match=f"field {name}"):
        OnnxPolicy(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("stiffness", []), ("damping", [None]), ("action_scale", "1"), ("default_position", [float("nan")])],
)
def test_wrong_numbers_never_reach_a_robot(
    tmp_path: Path, deploy: Callable[..., str], name: str, value: object
) -> None:
    """The process that tries the policy first refuses it."""
    printed = deploy(edited(tmp_path / "p.onnx", lambda spec: spec.update({name: value})))
    assert f"field {name}" in printed and "no-port" not in printed


@pytest.mark.parametrize("fault", ["nan", "fails"])
@pytest.mark.parametrize(
    "verb", [("deploy", "cartpole"), ("deploy", "cartpole", "--dry-run"), ("collect", "cartpole")]
)
def test_a_faulty_network_never_reaches_a_robot(
    tmp_path: Path, deploy: Callable[..., str], fault: Any, verb: tuple[str, ...]
) -> None:
    """Whichever verb runs it, also where nothing would be sent."""
    path = tmp_path / "faulty.onnx"
    write_policy(*faulty_policy(DESCRIPTION, fault), path)
    arguments = (*verb, "--out", str(tmp_path / "run"), "--motion", "rich") if verb[0] == "collect" else verb
    printed = deploy(path, *arguments)
    assert "faulty.onnx: the network" in printed and "seen with fastest command" in printed
    assert "no-port" not in printed and not (tmp_path / "run").exists()


def test_a_policy_that_would_not_run_is_refused(tmp_path: Path, deploy: Callable[..., str]) -> None:
    """The motion `hold` runs none: whoever gives one expects something else."""
    verb = ("collect", "cartpole", "--motion", "hold", "--out", str(tmp_path / "run"))
    assert "--policy would have no effect: --motion hold runs no policy" in deploy(
        tmp_path / "nothing.onnx", *verb
    )


def test_a_policy_of_a_red_calibration_is_asked_about(
    tmp_path: Path,
    deploy: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Without a terminal it is refused; with one the answer decides, and so does the option. Amber warns."""
    path = edited(tmp_path / "p.onnx", lambda spec: spec["training"].update({VERDICT: "red"}))
    printed = deploy(path)
    assert "a red verdict" in printed and "--trust-calibration" in printed and "no-port" not in printed
    assert "no-port" in deploy(path, "deploy", "cartpole", "--trust-calibration")
    amber = edited(tmp_path / "a.onnx", lambda spec: spec["training"].update({VERDICT: "amber"}))
    assert "no-port" in deploy(amber, "deploy", "cartpole", "--trust-calibration")
    assert main(["deploy", "cartpole", "--port", "no-port", "--policy", str(amber)]) == REFUSED
    warning, error = capsys.readouterr().err.strip().splitlines()
    assert "an amber verdict" in warning and "Ctrl-C" in warning and "no-port" in error

    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    asked: list[str] = []

    def answer(words: str) -> str:
        asked.append(words)
        return "no" if len(asked) == 1 else "y"

    monkeypatch.setattr("builtins.input", answer)
    plan = RunPlan(robot="cartpole", policy=str(path))
    with pytest.raises(PolicyError, match="not run; calibrate again"):
        check_plan(plan, DESCRIPTION, Terminal())
    assert check_plan(plan, DESCRIPTION, Terminal()).policy_digest
    assert len(asked) == 2
