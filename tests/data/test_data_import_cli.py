"""`deal-hw data import` and `export`, the converters, and the public recordings where they are present."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from deal_hw.cli.data import Export, Import, data
from deal_hw.cli.main import parse
from deal_hw.data.checks.suite import examine
from deal_hw.data.importing.channels import digest_of_file
from deal_hw.data.importing.columns import parse_column_map, read_column_map
from deal_hw.data.importing.grid import to_trajectories
from deal_hw.data.importing.load import load_tables
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.table import Table
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.findings import Severity, worst
from deal_hw.install import install_line

ROOT = Path(__file__).resolve().parents[2]
REAL = ROOT.parent / "shared" / "data" / "real"
SERVOS = ("go2_suspended", "so101")
needs_recordings = pytest.mark.skipif(not REAL.is_dir(), reason="the public recordings are not present")
MakeTable = Callable[..., Table]

MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body>
      <freejoint name="base"/>
      <geom size="0.1"/>
      <body>
        <joint name="knee" axis="1 0 0" range="-2 2" limited="true"/>
        <geom size="0.1"/>
        <body pos="0 0 1"><joint name="hip" axis="0 1 0"/><geom size="0.1"/></body>
        <body pos="0 0 2"><joint name="foot" type="slide" range="-3 3" limited="true"/><geom
        size="0.1"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="knee" kp="10"/><position joint="hip" kp="10"/><position joint="foot" kp="10"/>
  </actuator>
</mujoco>
"""


def tool(name: str) -> ModuleType:
    """Return a script of tools/ as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def recording(make_table: MakeTable, tmp_path: Path) -> Path:
    """A sound recording as CSV, columns named like the joints."""
    table = make_table()
    path = tmp_path / "rec.csv"
    names = [f"{joint}_{word}" for joint in table.joint_names for word in ("pos", "cmd")]
    values = np.stack([table.position, table.target], axis=2).reshape(1200, 6)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", *names])
        writer.writerows(np.column_stack([table.time_s, values]).tolist())
    return path


def test_import_and_export(
    recording: Path, make_table: MakeTable, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From CSV and MJCF to a dataset of ours, out as LeRobot and in again: the same numbers."""
    (tmp_path / "robot.xml").write_text(MODEL)
    out = tmp_path / "dataset"
    assert data(Import(paths=(recording,), out=out, model=tmp_path / "robot.xml", device_periods=4)) == 0
    printed = capsys.readouterr()
    assert "1 episode of robot" in printed.out
    for words in ("guessed", "hip_cmd", "base", "11.99 s at 100 Hz", "largest shift"):
        assert words in printed.err
    dataset = Dataset.open(out)
    assert dataset.description["joint_names"] == ["knee", "hip", "foot"]
    assert dataset.description["device_rate_hz"] == pytest.approx(400.0)
    assert len(dataset.description["mjcf"]) == 64
    trajectory = dataset.read(0).trajectory
    np.testing.assert_allclose(trajectory.position, make_table().position[:, [1, 0, 2]], atol=1e-12)
    assert trajectory.metadata["import"]["file"] == "rec.csv"
    source = {"file": "rec.csv", "sha256": digest_of_file(recording), "part": "", "stretch": 0}
    assert dataset.episodes[0].facts == {"plausibility": {"rec.csv": []}, "source": source}
    assert data(Export(path=out, out=tmp_path / "lerobot", task="wave")) == 0
    assert "1 LeRobot episode of robot" in capsys.readouterr().out
    (table,) = load_tables(tmp_path / "lerobot")
    (back,) = to_trajectories(table)
    np.testing.assert_allclose(back.trajectory.position, trajectory.position, atol=1e-6)
    assert data(Export(path=dataset.path(0), out=tmp_path / "again")) == 0


def test_a_recording_is_imported_once(recording: Path, tmp_path: Path) -> None:
    """A copy under another name is refused, in the same call and in a later one; nothing is written."""
    copy, out = tmp_path / "copy.csv", tmp_path / "dataset"
    copy.write_bytes(recording.read_bytes())
    with pytest.raises(DatasetError, match=r"copy.csv is a copy of rec.csv.*Leave it out"):
        data(Import(paths=(recording, copy), out=out))
    assert not out.exists()
    assert data(Import(paths=(recording,), out=out)) == 0
    with pytest.raises(DatasetError, match=r"copy.csv is a copy of episode 0 of .*dataset"):
        data(Import(paths=(copy,), out=out))
    assert len(Dataset.open(out).episodes) == 1
    # An episode of ours is known by its own bytes.
    other = tmp_path / "other"
    assert data(Import(paths=(out,), out=other)) == 0
    with pytest.raises(DatasetError, match="is a copy of episode 0"):
        data(Import(paths=(out / "episodes" / "000000.mcap",), out=other))


def test_a_model_that_no_later_verb_can_use_is_refused(recording: Path, tmp_path: Path) -> None:
    """Without an actuator: nothing is written, and the same folder takes the mended model."""
    model, out = tmp_path / "robot.xml", tmp_path / "dataset"
    model.write_text(re.sub("<actuator>.*</actuator>", "", MODEL, flags=re.S))
    with pytest.raises(ConfigurationError, match=r"needs none; .*could not use the dataset.*without --model"):
        data(Import(paths=(recording,), out=out, model=model))
    assert not out.exists()
    model.write_text(MODEL)
    assert data(Import(paths=(recording,), out=out, model=model)) == 0


def test_import_refuses_what_is_not_plausible(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Joints swapped by the column map are refused before anything is written; --force keeps the finding."""
    columns = tmp_path / "columns.yaml"
    columns.write_text(
        "time: time\ntarget: '{joint}_cmd'\njoints:\n  - {name: hip, position: knee_pos}\n"
        "  - {name: knee, position: hip_pos}\n  - {name: foot, position: foot_pos}\n"
    )
    out = tmp_path / "dataset"
    with pytest.raises(DatasetError, match=r"hip follows the command of knee.*--force"):
        data(Import(paths=(recording,), out=out, columns=columns))
    assert not out.exists()
    # The error has it; a line before it had the same in full.
    assert "fail assignment" not in capsys.readouterr().err
    assert data(Import(paths=(recording,), out=out, columns=columns, force=True, name="odd")) == 0
    facts = Dataset.open(out).episodes[0].facts["plausibility"]["rec.csv"]
    assert [fact["name"] for fact in facts if fact["severity"] == "fail"] == ["assignment"]
    assert "fail assignment" in capsys.readouterr().err


def test_force_is_not_advised_where_it_would_not_help(recording: Path, tmp_path: Path) -> None:
    """A recording of a tenth of a second holds no window: no option overrules that, and none is named."""
    lines = recording.read_text(encoding="utf-8").splitlines()
    recording.write_text("\n".join(lines[:11]) + "\n", encoding="utf-8")
    (tmp_path / "robot.xml").write_text(MODEL)
    for force in (False, True):
        with pytest.raises(DatasetError, match=r"record at least 0\.2 s") as refused:
            data(Import(paths=(recording,), out=tmp_path / "out", model=tmp_path / "robot.xml", force=force))
        assert "--force" not in str(refused.value)


def test_import_with_a_description_and_dry_run(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A description orders the joints and is kept as given; a dry run writes nothing."""
    first = tmp_path / "first"
    assert data(Import(paths=(recording,), out=first, dry_run=True)) == 0
    assert not first.exists()
    assert "`calibrate` and `inspect` cannot use the dataset: add --model" in capsys.readouterr().err
    data(Import(paths=(recording,), out=first, name="leg"))
    description = Dataset.open(first).description
    path = tmp_path / "description.json"
    path.write_text(json.dumps({**description, "name": "other"}))
    data(Import(paths=(recording,), out=tmp_path / "second", description=path))
    second = Dataset.open(tmp_path / "second")
    assert second.description["name"] == "other" and len(second.episodes) == 1
    path.write_text("{}")
    with pytest.raises(ConfigurationError, match="name, joint_names, actuated"):
        data(Import(paths=(recording,), out=first, description=path))
    with pytest.raises(ConfigurationError, match="device-periods"):
        data(Import(paths=(recording,), out=first, device_periods=0))


def test_model_that_does_not_compile(recording: Path, tmp_path: Path) -> None:
    """It is refused with MuJoCo's reason; a missing one is named."""
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    for name, words in (("bad.xml", "does not compile"), ("none.xml", "does not exist")):
        with pytest.raises(ConfigurationError, match=words):
            data(Import(paths=(recording,), out=tmp_path / "out", model=tmp_path / name))


def test_command_line() -> None:
    """The verbs parse as docs/how-to/import.md writes them."""
    settings, function = parse(
        "data", ["import", "a.csv", "b.csv", "--out", "x", "--columns", "m.yaml", "--dry-run"]
    )
    assert function is data
    assert settings == Import(
        paths=(Path("a.csv"), Path("b.csv")), out=Path("x"), columns=Path("m.yaml"), dry_run=True
    )
    settings, _ = parse("data", ["export", "d", "--format", "lerobot", "--out", "x"])
    assert settings == Export(path=Path("d"), out=Path("x"))


def test_page_shows_a_column_map_that_reads() -> None:
    """The YAML block of docs/how-to/import.md is a column map."""
    page = (ROOT / "docs" / "how-to" / "import.md").read_text(encoding="utf-8")
    import yaml

    columns = parse_column_map(yaml.safe_load(page.partition("```yaml\n")[2].partition("```")[0]))
    assert [joint.name for joint in columns.joints] == [
        "shoulder",
        "elbow_joint",
        "wrist",
        "jaw",
        "cart",
        "wheel",
        "spindle",
        "finger",
        "knee",
    ]
    assert columns.joints[8].position == "m3.fb" and columns.velocity == "none"


def test_so101_converter(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Lists of six in CSV cells and microseconds become arrays that the written column map reads."""
    convert = tool("convert_so101")
    motion = tmp_path / "custom" / "wave"
    motion.mkdir(parents=True)
    six = [0.1, -0.2, 0.3, -0.4, 0.5, 0.75]
    for name, lists in (("control", 1), ("state_motor", 3)):
        with open(motion / f"{name}.csv", "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["type", "timestamp", "positions", "velocities", "torques"][: 2 + lists])
            writer.writerows([["X", 5.5 + 20060.0 * i, *[str(six)] * lists] for i in range(50)])
    out = tmp_path / "out"
    assert convert.main([str(tmp_path / "custom"), "--out", str(out)]) == 0
    (table,) = load_tables(out / "wave.npz", read_column_map(out / "columns.yaml"), convert.MODEL)
    assert table.actuated == convert.MODEL
    np.testing.assert_allclose(table.position[7, :5], six[:5])
    # 0.75 of 1524 ticks above -0.174533 rad: 0.75 * 2.337787 - 0.174533.
    assert table.target[0, 5] == pytest.approx(1.578807, abs=1e-5)
    np.testing.assert_allclose(np.diff(table.time_s), 0.02006)
    assert convert.main([str(tmp_path / "custom"), "--out", str(out), "--motions", "none"]) == 1
    assert "motions here: wave" in capsys.readouterr().err
    assert convert.main([str(tmp_path), "--out", str(out)]) == 1


def test_go2_converter(tmp_path: Path) -> None:
    """The torch file's three arrays come through; another file is refused."""
    torch = pytest.importorskip("torch", reason=install_line("calib"))

    convert = tool("convert_go2_suspended")
    q = np.arange(60.0).reshape(5, 12)
    arrays = {"time": np.arange(5) * 0.005, "dof_pos": q, "des_dof_pos": q + 0.5}
    torch.save({name: torch.from_numpy(values) for name, values in arrays.items()}, tmp_path / "traj_0.pt")
    assert convert.main([str(tmp_path / "traj_0.pt"), "--out", str(tmp_path / "out")]) == 0
    columns = read_column_map(tmp_path / "out/columns.yaml")
    (table,) = load_tables(tmp_path / "out/traj_0.npz", columns)
    assert table.joint_names[:4] == ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint", "FR_hip_joint")
    np.testing.assert_array_equal(table.position, q)
    np.testing.assert_array_equal(table.target, q + 0.5)
    halves = tmp_path / "split_half"
    assert convert.main([str(tmp_path / "traj_0.pt"), "--out", str(halves), "--parts", "2"]) == 0
    parts = [np.load(halves / f"traj_0_part{i}.npz")["dof_pos"] for i in (1, 2)]
    np.testing.assert_array_equal(np.concatenate(parts), q)
    torch.save({"time": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(SystemExit, match="not a recording of that project"):
        convert.main([str(tmp_path / "other.pt"), "--out", str(tmp_path)])


@needs_recordings
@pytest.mark.parametrize(
    "path",
    sorted(path for robot in SERVOS for path in REAL.glob(f"{robot}/*.npz")),
    ids=lambda path: path.stem,
)
def test_public_recordings_pass(path: Path) -> None:
    """Nothing in a real recording is refused, and its rate is kept to the digit."""
    legs = [f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
    (table,) = load_tables(path, joints=legs if "go2" in str(path) else None)
    assert worst(examine(table)) is not Severity.FAIL
    (part,) = to_trajectories(table)
    facts = part.trajectory.metadata["import"]
    assert facts["method"] == "kept" and facts["largest_shift_s"] < 1e-3
    assert 1 / facts["period_s"] == pytest.approx(199.9574 if "go2" in str(path) else 49.850, abs=2e-3)


@needs_recordings
def test_swapped_legs_of_a_real_robot_are_found() -> None:
    """The Go2's arrays in Unitree's own order (FR first) are refused: its hips move against each other."""
    legs = [f"{leg}_{part}" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf")]
    columns = parse_column_map(
        {
            "time": "time",
            "target": "des_dof_pos",
            "joints": [
                {"name": name, "position": f"dof_pos[{(i + 3) % 6 + i // 6 * 6}]"}
                for i, name in enumerate(legs)
            ],
        }
    )
    (table,) = load_tables(REAL / "go2_suspended" / "train.npz", columns)
    found = next(v for v in examine(table) if v.code == "assignment")
    assert found.severity is Severity.FAIL
    assert "FR_hip follows the command of FL_hip" in found.message
