"""The robot's own computer has `deal-hw[robot]`, or the base install: its verbs run there without more."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import onnx
import pytest
from fakes.linear_policy import CARTPOLE_GAINS, feedback_spec

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.install import install_line
from deal_hw.policies.onnx_runtime import SPEC_KEY
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.emulation.topics import free_port

pytestmark = pytest.mark.real_time

EXTRAS = (
    "torch",
    "mujoco",
    "scipy",
    "rerun",
    "gymnasium",
    "stable_baselines3",
    "onnx",
    "matplotlib",
    "pyarrow",
    "cyclonedds",
)
"""Packages that `deal-hw[robot]` does not install."""
OF_ROBOT = ("can", "cantools", "dynamixel_sdk", "dynamixel_easy_sdk", "zenoh", "onnxruntime")
"""Packages of `deal-hw[robot]` that the base install lacks."""
REFUSE = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in REFUSED:
            raise ModuleNotFoundError(f"{name} is refused", name=name)

sys.meta_path.insert(0, Refuse())
"""
FINISHED, TRIPPED = 0, 3

REACH_GO2 = """
import json, sys

from deal_hw.cli import collect, deploy, doctor
from deal_hw.workflows.running import control_process, supervised
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.clock import MonotonicClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.safety.safety import Safety
from deal_hw.robots.connect import make_robot, make_transport
from deal_hw.drivers.go2.doctor import Go2Doctor
from deal_hw.errors import DealHwError
from deal_hw.transport import WireOptions

transport, port, domain = sys.argv[1], sys.argv[2], int(sys.argv[3])
options = WireOptions(listen=True) if transport == "zenoh" else WireOptions(domain=domain)

def loaded():
    return sorted({name.partition(".")[0] for name in sys.modules})

clock = MonotonicClock()
plan = RunPlan(robot="go2", transport=transport, port=port, motion="hold", stand=True, wire=options)
robot = make_robot(plan.robot, plan.transport, plan.port, clock, plan.wire)
behaviour = make_behaviour(plan, robot.description)
ControlLoop(robot, behaviour, Safety(robot.description), clock, bool, LoopConfig(duration_s=plan.total_s))
Go2Doctor(make_transport(transport, port, clock, options), clock, 0.5)
made = loaded()
link = make_transport(transport, port, clock, options)
link.declare(publish=["rt/lowcmd"], subscribe=["rt/lowstate"])
try:
    link.open()
except DealHwError as error:
    print(error, file=sys.stderr)
finally:
    link.close()
print(json.dumps({"made": made, "opened": loaded()}))
"""
"""Makes all that collect, deploy and doctor make of a Go2, opens the path to it, tells what was loaded."""


@pytest.fixture
def silent() -> Iterator[str]:
    """Return a serial port at which no robot answers."""
    ours, theirs = os.openpty()
    yield os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


@pytest.fixture(scope="module")
def port() -> Iterator[str]:
    """Emulate the nominal cart-pole in a process of its own, which has all extras, and return its port.

    It computes in real time as long as it lives, so the tests that need it are the last of this file.
    """
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


def run_bare(
    tmp_path: Path, *arguments: str, refused: tuple[str, ...] = EXTRAS
) -> subprocess.CompletedProcess[str]:
    """Run the command where no process, the command's own children included, can load these packages."""
    (tmp_path / "refuse").mkdir(exist_ok=True)
    # Python imports a module of this name at every start, before anything else.
    text = f"REFUSED = {refused!r}\n{REFUSE}"
    (tmp_path / "refuse" / "sitecustomize.py").write_text(text, encoding="utf-8")
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
    """A verb that needs a missing extra is refused in one line."""
    done = run_bare(tmp_path, "emulate", "cartpole")
    assert done.returncode == 2
    assert install_line("sim") in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        ("deploy cartpole --port PORT --policy POLICY", "deploy"),
        ("deploy cartpole --port PORT", "deploy"),
        ("collect cartpole --port PORT --seconds 4 --out run", "deploy"),
        ("collect cartpole --transport can --port slcan:PORT --motion hold --out run", "can"),
        ("collect cartpole --transport odrive --port virtual:bus --motion hold --out run", "can"),
        ("collect cartpole --transport dynamixel --port PORT --motion hold --out run", "dynamixel"),
        ("collect go2 --transport zenoh --port tcp/127.0.0.1:1 --motion hold --out run", "zenoh"),
        ("deploy go2 --transport zenoh --port tcp/127.0.0.1:1", "deploy"),
    ],
)
def test_the_base_install_names_the_extra_that_is_missing(
    tmp_path: Path, silent: str, policy: Path, words: str, extra: str
) -> None:
    """One line that says what to install; no robot was moved, and no network is called broken."""
    line = words.replace("PORT", silent).replace("POLICY", str(policy)).split()
    done = run_bare(tmp_path, *line, refused=EXTRAS + OF_ROBOT)
    assert done.returncode == 2, done.stderr
    assert install_line(extra) in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "run" / "dataset" / "episodes" / "000000.mcap").exists()


@pytest.mark.parametrize(
    ("transport", "port", "own"),
    [("zenoh", "tcp/127.0.0.1:0", "zenoh"), ("dds", "lo", "cyclonedds")],
)
def test_a_go2_loads_its_own_transport_alone(tmp_path: Path, transport: str, port: str, own: str) -> None:
    """Neither torch, mujoco nor scipy; of the two networks the one that was asked for, when it is opened."""
    if importlib.util.find_spec(own) is None:
        pytest.skip(f"{own} is not installed")
    done = subprocess.run(
        [sys.executable, "-c", REACH_GO2, transport, free_port(port), "97"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    reported = json.loads(done.stdout)
    networks = {"zenoh", "cyclonedds"}
    heavy = set(EXTRAS) - networks
    assert not set(reported["made"]) & (heavy | networks)
    assert not set(reported["opened"]) & heavy
    assert set(reported["opened"]) & networks == {own}


@pytest.mark.slow
def test_go2_runs_without_extras(tmp_path: Path) -> None:
    """Collect and doctor reach a Go2 over Zenoh with `deal-hw[robot]`: all processes of a run included."""
    options = ("--transport", "zenoh", "--port", "tcp/127.0.0.1:0", "--profile", "ideal", "--nominal")
    posture = ("--fold-s", "0.3", "--rise-s", "0.6", "--lie-s", "0.6")
    with EmulatorProcess("go2", *options) as emulator:
        reach = ("go2", "--transport", "zenoh", "--port", emulator.port)
        done = run_bare(
            tmp_path, "collect", *reach, "--motion", "hold", "--seconds", "0.4", "--out", "run", *posture
        )
        assert done.returncode in {FINISHED, TRIPPED}, done.stderr
        reported = run_bare(tmp_path, "doctor", *reach, "--seconds", "1")
    assert "refused" not in done.stderr + reported.stdout + reported.stderr
    assert (tmp_path / "run" / "dataset" / "episodes" / "000000.mcap").stat().st_size > 0
    assert reported.returncode in {0, 1}, reported.stderr
    assert "Traceback" not in reported.stderr
    assert "the body leans by" in reported.stdout


def test_dds_without_its_package_names_the_extra(tmp_path: Path) -> None:
    """One line that says what to install; no process was started for it."""
    done = run_bare(tmp_path, "collect", "go2", "--port", "lo", "--motion", "hold", "--out", "run")
    assert done.returncode == 2
    assert install_line("dds") in done.stderr
    assert "Traceback" not in done.stderr


def test_collect_runs_without_extras(tmp_path: Path, port: str) -> None:
    """Supervisor, control process and recorder record an episode that `data` then reads."""
    done = run_bare(
        tmp_path,
        "collect",
        "cartpole",
        "--port",
        port,
        "--motion",
        "hold",
        "--seconds",
        "0.4",
        "--out",
        "run",
    )
    # A busy machine may trip the safety module; what is looked for here is a missing package.
    assert done.returncode in {FINISHED, TRIPPED}, done.stderr
    assert (tmp_path / "run" / "dataset" / "episodes" / "000000.mcap").stat().st_size > 0
    reported = run_bare(tmp_path, "data", "info", "run/dataset")
    assert reported.returncode == 0, reported.stderr


@pytest.mark.slow
def test_the_base_install_records_checks_and_converts(tmp_path: Path, port: str) -> None:
    """Over a serial port; recordings are shown and verified; a CSV file becomes a dataset."""
    run = functools.partial(run_bare, tmp_path, refused=EXTRAS + OF_ROBOT)
    words = ("--port", port, "--motion", "chirp", "--seconds", "1", "--out", "run")
    done = run("collect", "cartpole", *words)
    assert done.returncode in {FINISHED, TRIPPED}, done.stderr
    assert (tmp_path / "run" / "dataset" / "episodes" / "000000.mcap").stat().st_size > 0
    for verb in ("info", "verify"):
        reported = run("data", verb, "run/dataset")
        assert reported.returncode == 0, reported.stdout + reported.stderr
    _, (recording, *_), _ = write(make_robot("pendulum", seed=0), tmp_path / "robot", seconds=3.0)
    reported = run("data", "import", str(recording), "--out", "imported")
    assert reported.returncode == 0, reported.stdout + reported.stderr
    assert "fit1" in run("data", "info", "imported").stdout
    examined = run("doctor", "cartpole", "--port", port, "--seconds", "0.5")
    assert "states a second" in examined.stdout, examined.stdout + examined.stderr


@pytest.mark.slow
def test_deploy_runs_without_extras(tmp_path: Path, port: str, policy: Path) -> None:
    """An ONNX policy runs and is recorded, and its recording replays."""
    robot = ("--port", port, "--out", "run")
    done = run_bare(tmp_path, "deploy", "cartpole", *robot, "--policy", str(policy), "--seconds", "0.4")
    assert done.returncode in {FINISHED, TRIPPED}, done.stderr
    again = run_bare(tmp_path, "replay", "run/dataset/episodes/000000.mcap", *robot)
    assert again.returncode in {FINISHED, TRIPPED}, again.stderr
    assert (tmp_path / "run" / "dataset" / "episodes" / "000001.mcap").stat().st_size > 0
