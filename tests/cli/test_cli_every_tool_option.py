"""Every option of the verbs that reach no robot changes what they do, or is refused."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import json
import re
import shutil
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from fakes import foreign_policy
from fakes.foreign_policy import Foreign
from verb_options import Option, kind_of, options

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.validation.metrics import HeldOut
from deal_hw.cli.main import main, parse
from deal_hw.cli.verbs import VERBS
from deal_hw.errors import DealHwError
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.robots import robot_entry
from deal_hw.workflows.emulation import common as emulation
from deal_hw.workflows.emulation import go2 as emulated_go2
from deal_hw.workflows.emulation import topics as emulated_topics
from deal_hw.workflows.train import udr_distribution

MJCF = """<mujoco model="arm"><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.2" range="-3 3"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5" contype="0"/></body></worldbody>
<actuator><position name="motor" joint="shoulder" kp="20" kv="0.5" forcerange="-20 20"/></actuator>
</mujoco>"""

MJLAB = (
    "policy import mjlab.onnx --robot go2 --out walk.onnx --control-rate 50 --observation-scales 1 "
    "--history 1 --command-range -1:1,-1:1,-1:1 --clock 2 --clock-at-rest runs"
)
RECORDINGS = "calibrate --model arm.xml --data fit.csv more.csv"
LINES = (
    RECORDINGS,
    "calibrate dataset",
    "train cartpole --nominal",
    "train go2 --udr",
    "train cartpole --distribution distribution.json",
    "inspect dataset/episodes/000000.mcap --save a.rrd",
    "inspect dataset/episodes/000000.mcap --screenshot a.png",
    "inspect dataset/episodes/000000.mcap --web",
    "design-excitation cartpole --out e.json",
    "design-excitation cartpole --out e.json --family multisine",
    "design-excitation cartpole --out e.json --family chirp",
    "design-excitation cartpole --out e.json --family steps",
    "design-excitation go2 --out e.json --family sway",
    "emulate cartpole",
    "emulate cartpole --transport can",
    "emulate cartpole --transport dynamixel",
    "emulate go2",
    "emulate go2 --transport zenoh --port tcp/127.0.0.1:7447",
    "emulate b2",
    "emulate g1",
    "emulate h1",
    "emulate g1 --transport zenoh --port tcp/127.0.0.1:7447",
    "bridge go2 --port lo",
    "bridge go2 --port lo --listen tls/127.0.0.1:7447"
    " --ca made_keys/ca.pem --certificate made_keys/robot.pem --key made_keys/robot.key",
    "keys make --out keys --robot 192.168.1.20",
    "keys add made_keys somebody",
    "robot new arm.xml --out new.yaml",
    MJLAB,
    "policy import gym.onnx --config gym.yaml --robot go2 --out walk.onnx",
    "robot new arm.xml --out new.yaml --lerobot calibration.json",
    "data info dataset",
    "data verify dataset",
    "data repair dataset",
    "data keep dataset 0",
    "data remove dataset 0 --yes",
    "data import fit.csv --out imported",
    "data import fit.csv --out imported --model arm.xml",
    "data import fit.csv --out imported --robot arm.yaml",
    "data export dataset --out exported",
    "data export dataset --out exported --format foxglove",
    "demo",
    "demo --transport dynamixel",
    "demo go2",
    "demo go2 --on-stand",
    "bench loop",
    "bench go2-loop",
    "bench transfer",
    "bench fixed-range --methods eki",
    "bench mismatch --methods eki",
    "bench paper --methods eki",
    "bench real --dataset dataset",
    "bench verdict",
    "bench first-answer",
    "bench speed",
    "bench go2-codec",
)
VALUES: dict[str, tuple[str, ...]] = {
    "addresses": ("10.0.0.7",),
    "calibration": ("distribution.json",),
    "checkpoint": ("early.onnx",),
    "ca": ("ca2.pem",),
    "certificate": ("c2.pem",),
    "key": ("k2.pem",),
    "columns": ("columns.yaml",),
    "controllers": ("pilot",),
    "data": ("more.csv",),
    "dataset": ("dataset",),
    "description": ("description.json",),
    "distribution": ("distribution.json",),
    "env": ("module:Env-v0",),
    "episodes": ("0",),
    "events_to": ("events.jsonl",),
    "excite": ("chirp",),
    "faults": ("sign",),
    "feet": ("foot",),
    "free": ("shoulder.damping",),
    "generations": ("7",),
    "holdout": ("hold.csv",),
    "fault_joint": ("left_elbow_joint",),
    "hot_joint": ("FL_hip_joint",),
    "joint_names": ("motor=shoulder",),
    "known": ("shoulder.damping", "0.3"),
    "latency": ("0.01",),
    "latency_range": ("0.001", "0.03"),
    "leave_out": ("fit.csv", "0.5", "1"),
    "link": ("link",),
    "lerobot": ("calibration.json",),
    "listen": ("tls/127.0.0.1:7448",),
    "lost_joint": ("FL_hip_joint",),
    "low_hz": ("0.5",),
    "margin_s": ("0.01",),
    "method": ("midpoint",),
    "engine": ("warp-cpu",),
    "ray": ("local:2",),
    "methods": ("eki",),
    "model": ("arm.xml",),
    "name": ("other",),
    "config": ("gym.yaml",),
    "joints": ("a,b",),
    "motors": ("a,b",),
    "observations": ("actions,commands",),
    "observation_scales": ("2",),
    "history": ("2",),
    "command_range": ("0:1,0:1,0:1",),
    "nan_joint": ("FL_hip_joint",),
    "observers": ("watcher",),
    "out": ("elsewhere",),
    "parameters": ("parameters.yaml",),
    "parent": ("1",),
    "physics_step": ("0.001",),
    "policy": ("policy.onnx",),
    "port": ("127.0.0.2",),
    "problems": ("pendulum",),
    "range": ("shoulder.damping", "0.1", "0.4"),
    "range_ratio": ("3",),
    "real": ("real",),
    "remote_script": ("remote.json",),
    "residual_std": ("0.01",),
    "reveal_to": ("reveal.json",),
    "robot": ("arm.yaml",),
    "search": ("eki",),
    "save": ("b.rrd",),
    "spike_ratio": ("50",),
    "screenshot": ("b.png",),
    "seeds": ("7",),
    "setups": ("setups.yaml",),
    "space": ("k11",),
    "start": ("start.safetensors",),
    "start_std": ("shoulder.velocity", "0.1"),
    "steps": ("1000",),
    "task": ("ant",),
    "terrain": ("box:0.2",),
    "track_to": ("track.csv",),
    "transport": ("can",),
    "trainer": ("ppo",),
    "truth_from": ("truth.json",),
    "watch_save": ("watch.rrd",),
    "write_parameters": ("written.yaml",),
    # Calls, which Python alone can give.
    **dict.fromkeys(("say", "progress"), ()),
    # Shares and margins, where 2.5 would be refused for itself.
    **dict.fromkeys(("corrupt", "drop", "duplicate", "reorder", "holdout_part"), ("0.3",)),
    **dict.fromkeys(("amplitude", "split"), ("0.3",)),
    **dict.fromkeys(("command_age_s", "listen_s", "leave_s", "status_s"), ("0.05",)),
    "rate_hz": ("200",),
}
FAULTY_JOINTS = {
    "cartpole": "pole",
    **dict.fromkeys(("go2", "b2"), "FL_calf_joint"),
    **dict.fromkeys(("g1", "h1"), "left_elbow_joint"),
}
TOLD_ELSEWHERE = {"quiet", "json", "force", "several_trees", "authority_days"}
"""They change what is printed, which the tests of each verb look at; allow what is not needed here; or change
what no certificate's line tells."""


class SeenError(Exception):
    """What a verb was about to do at length; nothing long is run here."""


def cases() -> Iterator[Any]:
    """Yield each line with each option that is not in it."""
    for line in LINES:
        verb, *words = line.split()
        config = getattr(importlib.import_module(VERBS[verb].module), VERBS[verb].config)
        joint = next((FAULTY_JOINTS[word] for word in words if word in FAULTY_JOINTS), "")
        for option in options(kind_of(config, *words), {**VALUES, "faulty_joint": (joint,)}):
            if option.name not in TOLD_ELSEWHERE and not {option.flag, *option.words[:1]} & set(words):
                yield pytest.param(line, option, id=f"{line} {option.name}")


def contents(path: Path) -> str:
    """Return a text file's contents without the times in it, a table's digest, of other files nothing."""
    if path.suffix == ".parquet":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    if path.suffix not in (".json", ".yaml", ".csv"):
        return ""
    return re.sub(r"\d{4}-\d\d-\d\dT[\d:.]+", "", path.read_text(encoding="utf-8"))


def reported(value: Any) -> str:
    """Return a value as text that is the same for the same value."""
    if isinstance(value, np.ndarray):
        return hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:12]
    if isinstance(value, np.random.Generator):
        return str(value.bit_generator.state)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        inner = {entry.name: reported(getattr(value, entry.name)) for entry in dataclasses.fields(value)}
        return f"{type(value).__name__}{inner}"
    if isinstance(value, dict):
        return str({key: reported(one) for key, one in value.items()})
    if isinstance(value, list | tuple):
        return str([reported(one) for one in value])
    if isinstance(value, mujoco.MjModel):
        return f"MjModel {value.opt.timestep} {value.nq}"
    if isinstance(value, functools.partial):
        return f"{reported(value.func)} {reported(value.args)} {reported(value.keywords)}"
    if closure := getattr(value, "__closure__", None):
        return f"{value.__qualname__} {[reported(cell.cell_contents) for cell in closure]}"
    if callable(value):
        return getattr(value, "__qualname__", type(value).__name__)
    if type(value).__module__.startswith("deal_hw"):
        inner = vars(value) if hasattr(value, "__dict__") else {}
        return f"{type(value).__name__}{ {key: reported(one) for key, one in inner.items()} }"
    return repr(value)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files that the lines name."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "arm.xml").write_text(MJCF, encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(MJCF.replace('damping="0.2"', 'damping="0.3"'))
    for seed, name in enumerate(("fit", "more", "hold")):
        data, rng, rows = mujoco.MjData(model), np.random.default_rng(seed), []
        for time_s in np.arange(0, 2.4, 0.02):
            wanted = 0.5 * np.sin((3 + seed) * time_s)
            rows.append((time_s, data.qpos[0] + 1e-3 * rng.standard_normal(), wanted))
            data.ctrl[0] = wanted
            mujoco.mj_step(model, data, 4)
        rows[60] = (rows[60][0], rows[60][1] + 0.4, rows[60][2])
        head = "time,shoulder_pos,shoulder_cmd"
        np.savetxt(folder / f"{name}.csv", rows, "%.6f", ",", header=head, comments="")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main("robot new arm.xml --out arm.yaml --control-rate 50".split()) == 0
        motor = {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 90, "range_max": 3990}
        (folder / "calibration.json").write_text(json.dumps({"shoulder": motor}), encoding="utf-8")
        line = "data import fit.csv more.csv hold.csv --robot arm.yaml --out dataset"
        assert main(line.split()) == 0
        text = "parameters:\n  - {kind: dof_damping, elements: shoulder}\n"
        (folder / "parameters.yaml").write_text(text, encoding="utf-8")
        text = "setups: {loaded: {recordings: ['more*', 1], payload: {body: upper, mass: 0.1}}}\n"
        (folder / "setups.yaml").write_text(text, encoding="utf-8")
        distribution = json.dumps(udr_distribution("cartpole").to_json())
        (folder / "distribution.json").write_text(distribution, encoding="utf-8")
        foreign_policy.mjlab_file(folder / "mjlab.onnx", Foreign())
        (folder / "gym.onnx").write_bytes(Foreign().model().SerializeToString())
        foreign_policy.write_yaml(folder / "gym.yaml", Foreign().gym_yaml())
        assert main("keys make --out made_keys --robot 192.168.1.20".split()) == 0
    return folder


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a verb did."""
    did: list[str] = []

    def note(name: str, answer: Any = None, *, ends: bool = False) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            did.append(f"{name} {reported(args)} {reported(kwargs)}")
            if ends:
                raise SeenError
            return answer

        return call

    def patch(target: str) -> None:
        monkeypatch.setattr(target, note(target.rpartition(".")[2], ends=True))

    def nothing(name: str) -> Callable[..., Any]:
        @contextlib.contextmanager
        def enter(*args: Any) -> Iterator[Callable[[], None]]:
            did.append(f"{name} {reported(args)}")
            yield lambda: None

        return enter

    # The model is the test's own, and a shipped policy sound: neither needs a process that tries it first.
    monkeypatch.setattr("deal_hw.policies.trial.check_policy", lambda path, _: OnnxPolicy(path))
    monkeypatch.setattr("deal_hw.sim.engine.compiling._try", lambda path: None)

    def tried(path: Path, description: Any, say: Any) -> Any:
        did.append(str(foreign_policy.spec_of_file(path)))
        raise SeenError

    monkeypatch.setattr("deal_hw.workflows.policy._tried", tried)
    experiment = types.SimpleNamespace(afresh=note("afresh"), space=None, refused=0)
    demos = [importlib.import_module(f"deal_hw.cli.demo_{robot}") for robot in ("cartpole", "go2", "so101")]
    emulated = contextlib.nullcontext(types.SimpleNamespace(port="p"))
    files = {"distribution.json": Path("distribution.json")}
    for demo in demos:
        monkeypatch.setattr(demo, "EmulatorProcess", note("emulator", emulated))
        monkeypatch.setattr(demo, "show_episode", note("show_episode", ends=True))
        monkeypatch.setattr(demo, "recorded", lambda record, *_: record(0))
        monkeypatch.setattr(demo, "deployed", lambda run, count, _: run(count))
        monkeypatch.setattr(demo, "numbers", lambda run: (0,))
        monkeypatch.setattr(
            demo, "calibrate", note("calibrate", types.SimpleNamespace(files=files, result=None))
        )
        for name in ("collect", "train", "deploy"):
            run = types.SimpleNamespace(episodes=(), paths=(Path("e.mcap"),))
            monkeypatch.setattr(demo, name, note(name, run))
    monkeypatch.setattr(demos[1], "on_floor", lambda distribution: distribution)
    monkeypatch.setattr(demos[1], "trust", lambda result: types.SimpleNamespace(colour="green"))
    _calibrate(monkeypatch, did)
    for target in ("save_screenshot", "serve_web", "open_window", "check_display"):
        place = "deal_hw.viz.screenshot" if target == "save_screenshot" else "deal_hw.cli.inspect_"
        patch(f"{place}.{target}")
    patch("deal_hw.workflows.train.train_policy")
    patch("deal_hw.calib.design.excitation_search.search_excitation")
    monkeypatch.setattr("deal_hw.calib.design.experiment_design.Experiment", note("experiment", experiment))
    patch("deal_hw.cli.bridge.Go2Bridge")
    monkeypatch.setattr("deal_hw.bench.rows.run_cells", _note_cells(did))
    emulator = types.SimpleNamespace(
        open=lambda: "port", close=lambda: None, changes=[], report=lambda: {}, slips=0, dropped=0
    )
    for wire in robot_entry("cartpole").wires:
        monkeypatch.setattr(str(wire.emulator).replace(":", "."), note("emulator", emulator))
    from deal_hw.drivers.b2.emulator import B2Truth
    from deal_hw.drivers.cartpole.plant.truth import nominal_truth as nominal_cartpole
    from deal_hw.drivers.g1.emulator.truth import nominal_truth as nominal_g1
    from deal_hw.drivers.go2.emulator.truth import Go2Truth
    from deal_hw.drivers.h1.emulator import H1Truth

    for target, truth in (
        ("cartpole.emulator.oracle", nominal_cartpole),
        ("g1.emulator.truth", nominal_g1),
    ):
        drawn = note("drawn", truth("sensor", 0))
        monkeypatch.setattr(f"deal_hw.drivers.{target}.draw_truth", drawn)
    for kind in (Go2Truth, B2Truth, H1Truth):
        monkeypatch.setattr(kind, "draw", note("drawn", kind.nominal("sensor", 0)))
    device = types.SimpleNamespace(log=types.SimpleNamespace(requests=[], changes=[]))
    monkeypatch.setattr("deal_hw.drivers.go2.emulator.device.Go2Device", note("device", device))
    monkeypatch.setattr("deal_hw.drivers.g1.emulator.device.G1Device", note("device", device))
    monkeypatch.setattr("deal_hw.drivers.h1.emulator.H1Device", note("device", device))
    monkeypatch.setattr("deal_hw.drivers.unitree.emulator.UnitreeEmulator", note("go2", emulator))
    monkeypatch.setattr(emulated_topics, "make_topic_transport", note("transport"))
    monkeypatch.setattr(emulated_topics, "summary", lambda report: [])
    monkeypatch.setattr(emulated_go2, "tracking", nothing("tracking"))
    for module in (emulation, emulated_topics):
        for name in ("run_until", "reveal"):
            monkeypatch.setattr(module, name, note(name))
        monkeypatch.setattr(module, "happenings", nothing("happenings"))
        monkeypatch.setattr(module, "realtime_priority", contextlib.nullcontext)
    patch("deal_hw.bench.go2_codec.bench_codec")
    return did


def _note_cells(did: list[str]) -> Callable[..., Any]:
    """Note what a bench would run, and its file; what is called after each row holds all settings."""

    def run_cells(cells: Any, out: Path, after: Any) -> None:
        did.append(f"{reported(cells)} {out}")
        raise SeenError

    return run_cells


def _calibrate(monkeypatch: pytest.MonkeyPatch, did: list[str]) -> None:
    """Note all that a calibration is called with, and what its result goes into."""
    from deal_hw.cli import calibrate
    from deal_hw.workflows.calibration import run as run_calibration

    def search(problem: Problem, searcher: Any, settings: Any, best: Any, results: Any) -> None:
        space = problem.space
        names = [f.name for f in dataclasses.fields(problem) if f.init and f.name not in ("robot", "space")]
        did.append(reported((space.names, space.nominal, space.low, space.high, space.known)))
        did.append(reported((problem.robot.model, {name: getattr(problem, name) for name in names})))
        did.append(reported((searcher, settings.budget, settings.seed, results)))

    def check(problem: Any, result: Any, settings: Any, method: str, held_out: HeldOut | None) -> None:
        did.append(f"{method} {[data.measured.shape for data in held_out._windows] if held_out else None}")

    def finish(work: Any, result: Any, results: Any, *settings: Any, **rest: Any) -> None:
        did.append(reported((work.provenance, results, settings, rest)))
        raise SeenError

    @contextlib.contextmanager
    def watching(*shown: Any) -> Iterator[None]:
        did.append(reported(shown[:2]))
        yield None

    monkeypatch.setattr(calibrate, "watching", watching)
    monkeypatch.setattr(run_calibration, "_searched", search)
    monkeypatch.setattr(run_calibration, "_checked", check)
    monkeypatch.setattr(calibrate, "finish", finish)


@pytest.fixture
def outcome(
    made: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    done: list[str],
) -> Callable[[str], Any]:
    """Tells what a verb did with a line, in a copy of that folder, or the refusal."""

    def run(line: str) -> Any:
        # At the same place each time: paths are part of what is noted.
        folder, (verb, *words) = made.with_name("copy"), line.split()
        monkeypatch.chdir(made)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(made, folder)
        monkeypatch.chdir(folder)
        done.clear()
        try:
            settings, function = parse(verb, words)
            function(settings)
        except DealHwError as error:
            return error
        except SeenError:
            pass
        # The record of a run repeats the settings.
        written = [path for path in folder.rglob("*") if path.name != "run.json"]
        files = {str(path.relative_to(folder)): contents(path) for path in written}
        return (done.copy(), capsys.readouterr().out, files)

    return run


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    """What the lines do by themselves, as they are come to."""
    return {}


@pytest.mark.parametrize(("line", "option"), list(cases()))
def test_an_option_changes_something_or_is_refused(
    line: str, option: Option, outcome: Callable[[str], Any], plain: dict[str, Any]
) -> None:
    """In this combination. The lines themselves are not refused."""
    if line not in plain:
        plain[line] = outcome(line)
    assert not isinstance(plain[line], DealHwError), plain[line]
    changed = outcome(f"{line} {' '.join(option.words)}")
    assert isinstance(changed, DealHwError) or changed != plain[line], f"{' '.join(option.words)} did nothing"


@pytest.mark.parametrize("line", LINES[:2])
def test_a_calibration_does_the_same_twice(line: str, outcome: Callable[[str], Any]) -> None:
    """Otherwise an option that does nothing would pass the test above."""
    assert outcome(line) == outcome(line)
