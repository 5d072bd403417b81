"""The robot's own computer has the base install only: its verbs run there without the extras."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import onnx
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.policies.onnx_runtime import SPEC_KEY
from deal_hw.testing.linear_policy import CARTPOLE_GAINS, feedback_spec

EXTRAS = ("torch", "mujoco", "scipy", "rerun", "gymnasium", "stable_baselines3", "onnx", "matplotlib")
REFUSE = f"""
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {EXTRAS!r}:
            raise ModuleNotFoundError(f"{{name}} is refused", name=name)

sys.meta_path.insert(0, Refuse())
"""
FINISHED, TRIPPED = 0, 3


@pytest.fixture(scope="module")
def port() -> Iterator[str]:
    """Emulate the nominal cart-pole in a process of its own, which has all extras, and return its port."""
    command = [sys.executable, "-m", "deal_hw", "emulate", "cartpole", "--profile", "ideal", "--nominal"]
    with subprocess.Popen(
        [*command, "--parent", str(os.getpid())], stdout=subprocess.PIPE, text=True
    ) as emulator:
        assert emulator.stdout is not None
        word, _, path = emulator.stdout.readline().strip().partition(" ")
        assert word == "port"
        yield path
        emulator.terminate()


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a state feedback as the kind of file that training exports."""
    spec = feedback_spec(DESCRIPTION)
    weights = [gain / spec.action_scale[0] for gain in CARTPOLE_GAINS]
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMul", ["observation", "weights"], ["action"])],
        "feedback",
        [onnx.helper.make_tensor_value_info("observation", onnx.TensorProto.FLOAT, ["batch", 4])],
        [onnx.helper.make_tensor_value_info("action", onnx.TensorProto.FLOAT, ["batch", 1])],
        [onnx.helper.make_tensor("weights", onnx.TensorProto.FLOAT, [4, 1], weights)],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.helper.set_model_props(model, {SPEC_KEY: spec.to_json()})
    path = tmp_path_factory.mktemp("policy") / "feedback.onnx"
    onnx.save(model, path)
    return path


def run_bare(tmp_path: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command where no process, the command's own children included, can load an extra."""
    (tmp_path / "refuse").mkdir(exist_ok=True)
    # Python imports a module of this name at every start, before anything else.
    (tmp_path / "refuse" / "sitecustomize.py").write_text(REFUSE, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "refuse")}
    return subprocess.run(
        [sys.executable, "-m", "deal_hw", *arguments],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_extras_are_really_refused(tmp_path: Path) -> None:
    """A verb that needs an extra says so here, in one line: the refusal works, and so does its message."""
    done = run_bare(tmp_path, "emulate", "cartpole")
    assert done.returncode == 2
    assert "pip install 'deal-hw[sim]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_collect_runs_without_extras(tmp_path: Path, port: str) -> None:
    """Supervisor, control process and recorder record an episode that `data` then reads."""
    done = run_bare(
        tmp_path,
        "collect",
        "cartpole",
        "--port",
        port,
        "--profile",
        "hold",
        "--seconds",
        "0.4",
        "--out",
        "run",
    )
    # A busy machine may trip the safety module; what is looked for here is a missing package.
    assert done.returncode in {FINISHED, TRIPPED}, done.stderr
    assert (tmp_path / "run" / "dataset" / "episodes" / "000000.mcap").stat().st_size > 0
    told = run_bare(tmp_path, "data", "info", "run/dataset")
    assert told.returncode == 0, told.stderr


def test_deploy_runs_without_extras(tmp_path: Path, port: str, policy: Path) -> None:
    """An ONNX policy runs and is recorded, and its recording replays."""
    robot = ("--port", port, "--out", "run")
    done = run_bare(tmp_path, "deploy", "cartpole", *robot, "--policy", str(policy), "--seconds", "0.4")
    assert done.returncode in {FINISHED, TRIPPED}, done.stderr
    again = run_bare(tmp_path, "replay", "run/dataset/episodes/000000.mcap", *robot)
    assert again.returncode in {FINISHED, TRIPPED}, again.stderr
    assert (tmp_path / "run" / "dataset" / "episodes" / "000001.mcap").stat().st_size > 0
