"""What a user can ask for wrongly: exit code 2, one line that says what to do, nothing written, no traceback.

Other tests hold what one verb or one reader refuses (`git grep EXIT_ERROR tests`); here are the refusals that
they do not provoke, each by the command line that leads to it. All sites: python tools/refusals.py.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import shlex
import sys
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.cli.main import EXIT_ERROR, main
from deal_hw.cli.verbs import VERBS
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.install import install_line
from deal_hw.motions.excitation.behaviours import RichBehaviour, RichConfig
from deal_hw.motions.excitation.plan import ExcitationDesign, make_plan
from deal_hw.workflows import shipped
from deal_hw.workflows.emulation.virtual import VirtualCartpole
from deal_hw.workflows.kinds import Arguments, Kinds
from deal_hw.workflows.train import udr_distribution

ARM = """
<mujoco model="arm">
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper">
      <joint name="elbow" axis="0 1 0" damping="0.2" armature="0.01" frictionloss="0.01"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/>
      <body name="tip"/>
    </body>
    <body name="cart" pos="1 0 0">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.2"/>
      <geom name="box" size="0.1" mass="1" solref="-900 -9"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="elbow" kp="12" kv="0.1"/><position name="belt" joint="rail" kp="9"/>
  </actuator>
</mujoco>
"""
MODEL = "calibrate --model arm.xml --out o --data"
OTHERS = "`deal-hw calibrate dataset` has no such option;"
FILES = "`calibrate --model robot.xml`"
Lines = list[tuple[str, str]]


def csv(path: Path, **columns: object) -> None:
    """Write columns of one length as CSV."""
    rows = np.stack([np.asarray(values, dtype=float) for values in columns.values()], axis=1)
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model, recordings, a dataset, and files that are not what their names say."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "arm.xml").write_text(ARM)
    (folder / "text.txt").write_text("hello\n")
    (folder / "empty.json").write_text("{}")
    (folder / "folder").mkdir()
    rng = np.random.default_rng(1)
    time_s = np.arange(300) * 0.02
    columns: dict[str, Any] = {"time": time_s}
    for joint, rate in (("elbow", 3.1), ("rail", 2.3)):
        wanted = 0.3 * np.sin(rate * time_s) + 0.1 * np.sin(7.7 * time_s)
        moved = np.zeros_like(wanted)
        for t in range(1, len(wanted)):
            moved[t] = moved[t - 1] + 0.3 * (wanted[t - 1] - moved[t - 1])
        columns[f"{joint}_pos"] = moved + 5e-4 * rng.standard_normal(len(moved))
        columns[f"{joint}_cmd"] = wanted
    csv(folder / "rec.csv", **columns)
    csv(folder / "positions.csv", **{name: v for name, v in columns.items() if name[-4:] != "_cmd"})
    csv(folder / "one.csv", **{name: v for name, v in columns.items() if name != "rail_cmd"})
    still = {name: 0.1 * (time_s > 3) if name.endswith("_cmd") else v for name, v in columns.items()}
    csv(folder / "still.csv", **still)
    csv(folder / "two.csv", **{name: v[[0, 0, 1]] for name, v in columns.items()})
    other = {name.replace("elbow", "knee").replace("rail", "foot"): v for name, v in columns.items()}
    csv(folder / "other.csv", **other)
    np.savez(
        folder / "base.npz",
        time=time_s,
        dof_pos=np.stack([columns["elbow_pos"], columns["rail_pos"]], 1),
        target=np.stack([columns["elbow_cmd"], columns["rail_cmd"]], 1),
        quat=np.zeros((300, 3)),
        gyro=np.zeros((300, 2)),
        short=np.zeros((299, 4)),
        nothing=np.full((300, 2), np.nan),
    )
    (folder / "lerobot" / "meta").mkdir(parents=True)
    info = {"fps": 50, "features": {}, "codebase_version": "v3.0"}
    (folder / "lerobot" / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "stopped" / "meta").mkdir(parents=True)
    (folder / "stopped" / "meta" / "info.json").write_text(json.dumps({**info, "fps": 0}))
    (folder / "downloaded" / "meta").mkdir(parents=True)
    (folder / "downloaded" / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "downloaded" / "data" / "chunk-000").mkdir(parents=True)
    (folder / "downloaded" / "data" / "chunk-000" / "file-000.parquet").write_bytes(b"PAR1")
    robot = VirtualCartpole(nominal_truth("sensor", 4, actuation_ticks=9))
    rich = RichBehaviour(DESCRIPTION, None, RichConfig(duration_s=2.4, balance_s=0.0), 1)
    with Dataset.create_or_open(folder / "run" / "dataset", DESCRIPTION) as store:
        path = store.next_episode_path()
        robot.run(rich, 2.4, path, {"motion": "rich", "purpose": "collect", "robot": "cartpole"})
        store.note_episode(path)
    Dataset.create_or_open(folder / "blank", DESCRIPTION).close()
    facts = {**DESCRIPTION.to_json(), "state_rate_hz": 50}
    (folder / "cartpole.json").write_text(json.dumps(facts))
    other_facts = {**facts, "joint_names": ["elbow", "rail"], "actuated": ["elbow"]}
    (folder / "arm.json").write_text(json.dumps(other_facts))
    write_distributions(folder)
    plan = make_plan(DESCRIPTION, ExcitationDesign(family="steps", seconds=4.0)).to_json()
    (folder / "long.json").write_text(json.dumps({**plan, "seconds": 1e9}))
    return folder


def write_distributions(folder: Path) -> None:
    """Write distributions that differ from a good one in one thing."""
    good = udr_distribution("cartpole").to_json()
    first, *others = good["space"]
    broken = {
        "scale": [{**first, "scale": "cubic"}, *others],
        "prior": [{**first, "prior_mean": 1.0, "prior_std": None}, *others],
        "twice": [first, *good["space"]],
        "list": "none",
    }
    for name, parameters in broken.items():
        (folder / f"{name}.json").write_text(json.dumps({**good, "space": parameters}))


@pytest.fixture
def refused(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Callable[[str, str], None]]:
    """Return a function that runs a command line and checks how it is refused."""
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))

    def check(line: str, words: str) -> None:
        assert main(shlex.split(line)) == EXIT_ERROR
        printed = capsys.readouterr().err
        assert "Traceback" not in printed
        last = printed.splitlines()[-1]
        assert last.startswith("deal-hw: error: ") and words in last and len(last) < 2100, printed

    yield check
    assert sorted(place.rglob("*")) == before, "something was written"


SETTINGS: Lines = [
    ("calibrate", "name a dataset (deal-hw calibrate runs/first/dataset), or a model"),
    ("calibrate run/dataset --model arm.xml", "not both"),
    (
        "calibrate run/dataset --holdout rec.csv",
        "--holdout is: Held-out episodes, which only test the result, by number",
    ),
    ("calibrate run/dataset --method nosuch", "unknown calibration method 'nosuch'; known: default"),
    ("calibrate --model arm.xml --data gone.csv --method nosuch", "unknown calibration method 'nosuch'"),
    ("data verify gone.mcap", "gone.mcap does not exist; name a dataset (DIR) or an episode"),
    ("data repair gone.mcap", "gone.mcap does not exist; name a dataset (DIR) or an episode"),
    ("calibrate run/dataset --episodes 7", "has 1 episodes; there is no number 7"),
    ("calibrate run/dataset --residual-std much", "'much' is no number [rad or m]"),
    ("calibrate run/dataset --residual-std knee 0.1", "unknown joint 'knee'; known: cart, pole"),
    (
        "calibrate run/dataset --write-parameters p.yaml",
        f"{OTHERS} `calibrate own-robot` and {FILES} have it",
    ),
    ("calibrate --model arm.xml --write-parameters empty.json", "empty.json exists; name another file"),
    ("calibrate --model arm.xml", "--model needs recordings to fit: --data rec.csv"),
    (f"{MODEL} rec.csv --holdout rec.csv", "a held-out recording must not be fitted"),
    (f"{MODEL} rec.csv --holdout one.csv --holdout-part 0.3", "give --holdout or --holdout-part, not both"),
    (f"{MODEL} rec.csv one.csv", "calibrate them separately"),
    (f"{MODEL} rec.csv --feet toe", "this one's base is fixed"),
    (f"{MODEL} one.csv", "actuators of the model without recorded commands: belt"),
    (f"{MODEL} positions.csv", "name them as `target` in the column map"),
    (f"{MODEL} still.csv --force", "record more motion"),
    ("collect cartpole --port p", "give --out RUN (the episodes go to RUN/dataset) or --dataset DIR"),
    ("collect cartpole --port p --out a --dataset b", "give --out RUN or --dataset DIR, not both"),
    ("collect cartpole --port p --out o --excite long.json", "an excitation of 1e+09 s"),
    ("collect cartpole --port p --out o --transport nosuch", "unknown transport 'nosuch'; known: serial"),
    ("collect ant --port p --out o", "robots that can be driven: cartpole, go2"),
    ("deploy go2 --port p --certificate text.txt", "a certificate and its private key belong together"),
    ("deploy go2 --port p --velocity 9,0,0", "x is 9.0, allowed: -1.5 to 1.5"),
    ("deploy go2 --port p --stop-buttons X+NOSUCH", "unknown button 'NOSUCH'; known: R1, L1"),
    ("replay run/dataset/episodes/000000.mcap --port p --robot go2", "the recording has joints"),
    (
        "design-excitation cartpole --out o.json --family multisine --low-hz 5 --high-hz 1",
        "--low-hz 5 must be below --high-hz 1",
    ),
    ("design-excitation cartpole --out o.json --family multisine --low-hz 0.9 --high-hz 1", "widen the band"),
    ("design-excitation go2 --out o.json --family sway --high-hz 900", "so a motion may have up to 25 Hz"),
    ("design-excitation go2 --out o.json", "robots on a stand (such as go2_suspended)"),
    ("inspect run/dataset/episodes/000000.mcap --calibration empty.json --web", "not a calibration result"),
    ("inspect run/dataset/episodes/000000.mcap --save folder", "name a file, such as folder/episode.rrd"),
    ("train --distribution scale.json", "scale is 'cubic'"),
    ("train --distribution prior.json", "a prior needs both mean and std"),
    ("train --distribution twice.json", "parameter names repeat"),
    ("train --distribution list.json", "valid array; `deal-hw calibrate` writes"),
    ("train --distribution empty.json", "format is None, not 'deal_hw.parameter_distribution/1'; `deal-hw"),
    ("train --udr --steps 10 --out o", "10 steps: give more than the 1000 steps of warmup"),
    ("train --udr --steps 2000 --out text.txt", "text.txt"),
    (
        "collect cartpole --port p --out o --domain 5",
        "--domain: `deal-hw collect cartpole` has no such option; `collect go2`",
    ),
    (
        "collect cartpole --port p --out o --state-check length",
        "--state-check: `deal-hw collect cartpole` has no such option; `collect go2`",
    ),
    ("doctor go2", "`deal-hw doctor go2` needs --port"),
    ("demo --out folder/../run", "does not hold a former demo; name another folder with --out"),
    ("emulate go2 --transport zenoh --port tcp/192.0.2.1:0 --duration-s 0", "port 'tcp/192.0.2.1:0': "),
]
REVIEWED: Lines = [
    ("calibrate run/dataset --columns nothere.yaml", f"--columns: {OTHERS} {FILES} has it"),
    ("calibrate run/dataset --leave-out nosuch 0 99", f"--leave-out: {OTHERS} {FILES} has it"),
    ("calibrate run/dataset --fit-seconds 2", f"{OTHERS} `calibrate own-robot` and {FILES} have it"),
    ("calibrate run/dataset --feet toe", f"--feet: {OTHERS} {FILES} has it"),
    ("calibrate run/dataset --holdout-part 0.3", f"{OTHERS} `calibrate own-robot` and {FILES} have it"),
    (f"{MODEL} rec.csv --parameters nothere.yaml", "nothere.yaml cannot be read: there is no such file"),
    (f"{MODEL} rec.csv --columns nothere.yaml", "nothere.yaml cannot be read: there is no such file"),
    (f"{MODEL} rec.csv --leave-out nosuch 0 99", "no such recording; known are rec.csv"),
    (
        "deploy cartpole --port p --velocity 0.1,0,0",
        "--velocity: `deal-hw deploy cartpole` has no such option; `deploy go2`",
    ),
    ("collect cartpole --port p --out o --motion chirp --excite multisine", "leave one of the two out"),
    ("inspect nothere.mcap", "nothere.mcap cannot be read: there is no such file"),
    ("inspect blank", "blank is a folder without an episode; record one with `deal-hw collect`"),
    (
        "inspect run/dataset/episodes/000000.mcap --screenshot x.jpg",
        "x.jpg does not end in .png; name it x.png",
    ),
    ("calibrate run --episodes 7", "dataset run/dataset has 1 episodes; there is no number 7"),
    ("train --udr --distribution scale.json", "--distribution and --udr exclude each other: keep one"),
    (
        "calibrate",
        "or a model and its recordings (deal-hw calibrate --model robot.xml --data rec.csv), one of",
    ),
    ("calibrate arm.xml rec.csv --out o", "deal-hw calibrate --model arm.xml --data rec.csv"),
    ("calibrate rec.csv rec.csv", "deal-hw calibrate --model robot.xml --data rec.csv rec.csv"),
    ("deploy cartpole --port /dev/null", "/dev/null cannot be opened as a serial port: it is a file or"),
    ("collect cartpole --port /dev/null --out o", "another device; ports at hand"),
    ("doctor cartpole", "`deal-hw doctor cartpole` needs --port"),
    (
        "robot check arm.xml",
        "arm.xml is an MJCF, not a robot.yaml: make one with `deal-hw robot new arm.xml`",
    ),
    (
        "doctor mine.yaml",
        "`deal-hw doctor robot.yaml` needs --port",
    ),
    ("emulate mine.yaml", "mine.yaml cannot be read: there is no such file"),
    ("train mine.yaml --udr", "no training environment for this robot; name your own by --env module:ENV_ID"),
]
"""What a review found to be accepted in silence, or refused without a hint."""
DATA: Lines = [
    ("data export blank --out o", "no recording to export"),
    ("data export run/dataset --out text.txt", "text.txt cannot be written: Not a directory"),
    ("data import nothere.csv --out o", "nothere.csv does not exist"),
    ("data import two.csv --out o --force", "2 samples at different times; check the time channel"),
    ("data import other.csv --out o --model arm.xml", "which channels are the joints' positions"),
    ("data import rec.csv --out o --description cartpole.json", "which channels are the joints' positions"),
    ("data import rec.csv --out o --description arm.json", "(commands: elbow); correct the column map"),
    ("data import lerobot --out o", "download the whole dataset"),
    ("data import stopped --out o", "field fps is 0.0; allowed: 0.001 to 1e6 Hz"),
]
ENTRIES: Lines = [
    ("{kind: dof_damping, elements: [elbow, rail], group: together, name: d}", "groups hinges with slides"),
    ("{kind: geom_friction_restitution, elements: rod}", "unknown parameter kind"),
    ("{kind: geom_restitution, elements: box}", "geom 'box' gives stiffness and damping directly"),
    (
        "{kind: body_mass, elements: tip, nominal: 1, range: [0.5, 2]}",
        "body 'tip' has no mass in the model, so there is nothing to scale",
    ),
    ("{kind: body_scale, elements: 'z*'}", "unknown MuJoCo body 'z*'; known: upper, tip, cart"),
    ("{kind: servo_effort_limit, elements: '*'}", "'*' matches nothing that can have servo_effort_limit"),
    ("{kind: dof_damping, elements: elbow, group: some}", "unknown group 'some'; known: each, together"),
]
COLUMNS: Lines = [
    ("gyro: {column: gyro, unit: rpm}", "unknown unit of gyro 'rpm'; known: rad, deg"),
    ("gyro: gyro", "gyro has shape (300, 2); it has 3 columns, x y z"),
    ("orientation: quat", "orientation has shape (300, 3); a quaternion has 4 columns"),
    ("orientation: short", "orientation has 299 rows, time has 300"),
    ("position: nothing", "every position is empty; check the channel in the column map"),
    ("position: [dof_pos]", "name a channel, or a pattern with {joint}"),
    ("position: none", "no position of elbow, rail; give `position` in the column map"),
    ("joints: [{name: elbow, index: -1}, rail]", "joint 'elbow': index -1 is not a column number, from 0"),
]


@pytest.mark.parametrize(("line", "words"), [*SETTINGS, *REVIEWED, *DATA], ids=lambda text: text[:60])
def test_a_line_that_cannot_be_is_refused(line: str, words: str, refused: Callable[[str, str], None]) -> None:
    """A setting, a file or a robot that is not what the verb needs."""
    refused(line, words)


def test_a_folder_with_one_episode_stands_for_it(
    place: Path, refused: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`inspect DATASET` goes on to what lacks, a desktop, and not to "Is a directory"."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for folder in ("run", "run/dataset"):
        refused(
            f"inspect {folder}",
            "so no window can open. Add --web (a browser here, or on another computer over ssh), --save FILE",
        )


def test_a_policy_of_another_robot_is_refused_in_short(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What differs is named, lists by their first entries, and what to give: 1,500 characters before."""
    monkeypatch.chdir(place)
    policy = shipped.shipped_policy("cartpole")
    assert main(["deploy", "go2", "--port", "lo", "--policy", str(policy)]) == EXIT_ERROR
    printed = capsys.readouterr().err
    assert "policy has 'cartpole', robot has 'go2'" in printed and "trained for 'go2'" in printed
    assert len(printed) < 600 and len(printed.splitlines()) == 1


def test_a_recording_too_short_to_calibrate_is_told_before_it_is_made(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`collect --seconds 1` says what calibrate needs."""
    monkeypatch.chdir(place)
    assert main(shlex.split("collect cartpole --port p --out o --seconds 1")) == EXIT_ERROR
    printed = capsys.readouterr().err
    assert "are too short: `deal-hw calibrate`" in printed and "(--seconds 4)" in printed


def test_a_quiet_calibration_prints_nothing(
    place: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither results nor what was guessed: errors alone are printed."""
    monkeypatch.chdir(place)
    line = f"calibrate --model arm.xml --data rec.csv --out {tmp_path} --method nominal --quiet --no-report"
    assert main([*shlex.split(line), "--no-advise", "--threads", "1"]) == 0
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err == ""


@pytest.mark.parametrize(("entry", "words"), ENTRIES)
def test_a_parameter_that_cannot_be_is_refused(
    entry: str, words: str, refused: Callable[[str, str], None], tmp_path: Path
) -> None:
    """The file and the place in it are named."""
    path = tmp_path / "params.yaml"
    path.write_text(f"parameters: [{entry}]\n")
    refused(f"{MODEL} rec.csv --parameters {path}", f"{path}, entry 1: ")
    refused(f"{MODEL} rec.csv --parameters {path}", words)


@pytest.mark.parametrize(("entry", "words"), COLUMNS)
def test_a_column_map_that_cannot_be_is_refused(
    entry: str, words: str, refused: Callable[[str, str], None], tmp_path: Path
) -> None:
    """Each is one line of the map away from a good one."""
    good = ["time: time", "position: dof_pos", "target: target", "joints: [elbow, rail]"]
    lines = [line for line in good if line.split(":")[0] != entry.split(":")[0]]
    path = tmp_path / "columns.yaml"
    path.write_text("\n".join([*lines, entry]) + "\n")
    refused(f"data import base.npz --out o --columns {path}", words)


@pytest.mark.parametrize(
    ("line", "package", "extra"),
    [
        ("calibrate run/dataset", "threadpoolctl", "calib"),
        ("design-excitation cartpole --out e.json", "onnxruntime", "deploy"),
        ("data export run/dataset --out o", "pyarrow", "lerobot"),
        ("data import downloaded --out o", "pyarrow", "lerobot"),
    ],
)
def test_a_missing_package_names_its_extra(
    line: str, package: str, extra: str, refused: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Verbs import on need what an extra brings."""
    for name in [*sys.modules]:
        if name == package or name.startswith(f"{package}."):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    refused(line, install_line(extra))


def test_a_demo_without_its_policy_says_how_to_make_it(
    refused: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkout in which the assets were left out."""
    monkeypatch.setattr(shipped, "shipped_policy", lambda robot, task="": None)
    refused("demo --out new", "tools/train_udr_policy.py trains one")


def mistyped() -> Iterator[tuple[str, str]]:
    """Yield lines that the parser refuses, with a word of what it says: every verb, every kind of slip."""
    for name, verb in VERBS.items():
        config = getattr(importlib.import_module(verb.module), verb.config)
        if not isinstance(config, Kinds):
            yield from slips(name, config, "")
            continue
        for word, kind in config.table().items():
            # Some kinds are found from another option or from a file; their tests are with their verbs.
            if (
                kind.compound
                or ".yaml" in (kind.usage or word)
                or config.choose(Arguments(word, {}))[0] != word
            ):
                continue
            by_option = kind.usage.startswith("--")
            stated = kind.usage.split()[0].removeprefix("--") if by_option else config.argument
            yield from slips(f"{name} {kind.usage if by_option else word}", kind.settings, stated)


def slips(begin: str, settings: type, stated: str) -> Iterator[tuple[str, str]]:
    """Yield mistyped lines of one settings type; the field ``stated`` is in the line's beginning."""
    robot = "--robot go2" if begin.startswith("policy") else "cartpole"
    needed = {"robot": robot, "port": "--port p", "out": "--out o", "episode": "e"}
    hints = typing.get_type_hints(settings)
    required = [
        next(iter(typing.get_args(hints[f.name])), "x") if f.name not in needed else needed[f.name]
        for f in dataclasses.fields(settings)
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if f.name != stated
    ]
    required = [word if isinstance(word, str) else "x" for word in required]
    if required:
        yield " ".join([begin, *required[:-1]]), "needs"
    line = " ".join([begin, *required])
    yield f"{line} --nosuch", "nosuch"
    for field, hint in hints.items():
        option = f"--{field.replace('_', '-')}"
        if hint in (int, float, int | None, float | None):
            yield f"{line} {option} much", "much"


@pytest.mark.parametrize(("line", "word"), [*mistyped()], ids=lambda text: text)
def test_what_does_not_parse_is_one_line(line: str, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    """An option that is not there, a value that is no number, one that lacks."""
    assert main(line.split()) == EXIT_ERROR
    printed = capsys.readouterr()
    assert word in printed.err.lower() and printed.err.count("\n") == 1 and not printed.out
