"""Inputs: foreign recordings, models, parameters, column maps, and the files of a calibration."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from mcap_ros2.writer import Writer

from deal_hw.calib.data.resume import SearchCheckpoint, pack
from deal_hw.calibration import CalibrationResult, read_result
from deal_hw.data.importing.columns import read_column_map
from deal_hw.data.importing.grid import common_period, to_trajectories
from deal_hw.data.importing.load import load_tables
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, nominal_truth
from deal_hw.errors import ConfigurationError
from deal_hw.findings import Finding
from deal_hw.sim.engine.compiling import problem_of
from deal_hw.sim.parameters.template import template
from deal_hw.sim.parameters.yaml_space import read_space
from deal_hw.workflows.emulation.common import read_truth
from deal_hw.workflows.train import read_distribution
from fuzz.kind import FileKind, Kind
from fuzz.mutations import damage_bytes, damage_json

_ROWS = 60
_JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_ODD_CELLS = (
    "",
    "nan",
    "inf",
    "-1e308",
    "1e999",
    "[1, 2]",
    "[[1]]",
    "[",
    '"',
    "x",
    "9" * 400,
    "1;2",
    "[" * 2000,
)
_ODD_WORDS = (
    "&a [*a]",
    "*nothing",
    "!!python/object/apply:os.getcwd []",
    "1e400",
    "9" * 5000,
    "-.nan",
    "[[[[",
    "{a: b}",
    "2024-13-41",
    "~",
    "!!binary x",
    "<<: *x",
    "1:1:1",
    "'",
    "\t",
    "0x" + "f" * 300,
    "elbow*",
    "-0",
)


def import_recording(path: Path) -> None:
    """Read a recording as `deal-hw data import` does, as far as the trajectories."""
    tables = load_tables(path)
    period = common_period(tables)
    for table in tables:
        to_trajectories(table, period_s=period)


def _signals() -> dict[str, Any]:
    time = np.arange(_ROWS) * 0.01
    return {"time": time, "elbow_pos": np.sin(9 * time), "elbow_target": np.cos(9 * time)}


def make_npz(folder: Path) -> list[bytes]:
    """Return archives, compressed and not, with names and with other content."""
    found = []
    for save in (np.savez, np.savez_compressed):
        buffer = io.BytesIO()
        wide: dict[str, Any] = {
            "dof_pos": np.zeros((_ROWS, 2)),
            "dof_target": np.ones((_ROWS, 2)),
            "names": np.array(["a", "b"]),
        }
        save(buffer, **_signals(), **wide, picture=np.zeros((2, 2, 3), np.uint8))
        found.append(buffer.getvalue())
    return found


def damage_npz(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Rebuild an archive with wrong headers: false shapes, kinds and orders."""
    shape = rng.choice(
        ("(60,)", "(2**62,)", "(1<<60,)", "(4611686018427387904, 2)", "(-1,)", "(0,)", "()", "(1, " * 70)
    )
    kind = rng.choice(
        ("<f8", "<f4", ">i2", "|b1", "|O", "<U9", "<U0", "|S0", "<c16", "<M8[ns]", "|V3", "<f16", "x")
    )
    header = (
        f"{{'descr': '{kind}', 'fortran_order': {rng.choice(('True', 'False', '1'))}, 'shape': {shape}, }}\n"
    )
    array = (
        b"\x93NUMPY" + bytes((rng.choice((1, 2, 3, 9)), 0)) + struct.pack("<H", len(header)) + header.encode()
    )
    buffer = io.BytesIO(data)
    with zipfile.ZipFile(buffer, "a") as archive:
        way = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
        archive.writestr(rng.choice(("time.npy", "x.npy", "x", "../x.npy")), array + bytes(480), way)
    return buffer.getvalue() if rng.random() < 0.7 else damage_bytes(rng, buffer.getvalue(), others)


def make_csv(folder: Path) -> list[bytes]:
    """Return tables with commas, semicolons and lists."""
    signals = _signals()
    rows = list(zip(*signals.values(), strict=True))
    plain = "\n".join([",".join(signals), *(",".join(f"{v:.6g}" for v in row) for row in rows)])
    lists = "\n".join(["time;pos;target", *(f"{a:.3g};[{b:.3g}, 1];[{c:.3g}, 2]" for a, b, c in rows)])
    return [plain.encode(), plain.replace(",", "\t").encode(), lists.encode()]


def damage_cells(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Replace one to four cells, also of the header."""
    text = data.decode()
    mark = max(",;\t", key=text.splitlines()[0].count)
    rows = [line.split(mark) for line in text.splitlines()]
    for _ in range(rng.randint(1, 4)):
        row = rng.choice(rows)
        row[rng.randrange(len(row))] = rng.choice(_ODD_CELLS)
    return "\n".join(mark.join(row) for row in rows).encode()


def make_mcap(folder: Path) -> list[bytes]:
    """Return recordings of two topics of joint states by another program."""
    found = []
    for compressed in (False, True):
        buffer = io.BytesIO()
        from mcap.writer import CompressionType

        writer = Writer(buffer, compression=CompressionType.ZSTD if compressed else CompressionType.NONE)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", _JOINT_STATE)
        for row in range(_ROWS):
            stamp = {"sec": 5, "nanosec": row * 10_000_000}
            for topic in ("/joint_states", "/joint_command"):
                message = {
                    "header": {"stamp": stamp, "frame_id": ""},
                    "name": ["a", "b"],
                    "position": [0.1 * row, -row],
                    "velocity": [],
                }
                writer.write_message(topic, schema, message, row * 10_000_000, row * 10_000_000)
        writer.finish()
        found.append(buffer.getvalue())
    return found


def make_lerobot(folder: Path) -> list[bytes]:
    """Return the Parquet file of a LeRobot dataset; its meta/info.json is written by the reader below."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    signals = _signals()
    table = pa.table(
        {
            "timestamp": signals["time"].astype(np.float32),
            "observation.state": [[float(v), 0.0] for v in signals["elbow_pos"]],
            "action": [[float(v), 1.0] for v in signals["elbow_target"]],
            "episode_index": [i // 30 for i in range(_ROWS)],
            "frame_index": [i % 30 for i in range(_ROWS)],
        }
    )
    found = []
    for compression in ("none", "zstd"):
        buffer = io.BytesIO()
        pq.write_table(table, buffer, compression=compression)
        found.append(buffer.getvalue())
    return found


_FEATURE = {"dtype": "float32", "shape": [2], "names": ["a", "b"]}
_INFO = {
    "codebase_version": "v3.0",
    "fps": 100,
    "features": {
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "observation.state": _FEATURE,
        "action": _FEATURE,
    },
}


def read_lerobot(path: Path) -> None:
    """Read the dataset that a Parquet file, or an info.json, belongs to."""
    folder = path.parents[2] if path.suffix == ".parquet" else path.parents[1]
    if path.suffix == ".parquet":
        (folder / "meta").mkdir(exist_ok=True)
        (folder / "meta" / "info.json").write_text(json.dumps(_INFO))
    else:
        (folder / "data" / "chunk-000").mkdir(parents=True, exist_ok=True)
        (folder / "data" / "chunk-000" / "file-000.parquet").write_bytes(make_lerobot(folder)[0])
    import_recording(folder)


def damage_lines(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Replace, repeat, indent or leave out one to three lines of YAML, or their values."""
    lines = data.decode().splitlines()
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(lines))
        way = rng.randrange(5)
        if way == 0:
            del lines[at]
        elif way == 1:
            lines.insert(rng.randrange(len(lines)), lines[at])
        elif way == 2:
            lines[at] = rng.choice(("  ", "- ", "\t", "&a ")) + lines[at]
        else:
            lines[at] = lines[at].partition(":")[0] + ": " + rng.choice(_ODD_WORDS)
        lines = lines or [""]
    return "\n".join(lines).encode("utf-8", "surrogatepass")


_MODEL = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
_COLUMNS = """time: {column: t, unit: us}
position: "{joint}_pos"
target: "{joint}_cmd"
unit: deg
joints:
  - shoulder
  - {name: elbow, column: e, sign: -1, offset: 0.1, index: 2}
  - {name: jaw, normalised: {from: [0, 100], to: [-0.17, 1.75]}}
orientation: {columns: [w, x, y, z], order: wxyz}
gyro: {column: g, unit: deg}
"""


def make_result(folder: Path) -> list[bytes]:
    """Return a calibration's result."""
    space = k9_space()
    K = len(space)
    interval = np.stack([space.low, space.high], axis=1)
    result = CalibrationResult(
        method="fuzz",
        space=space,
        estimate=space.nominal,
        interval=interval,
        covariance=np.eye(K) * 0.01,
        verdicts=tuple(["weak"] * K),
        latency_s=0.01,
        chi2=1.0,
        heldout_nrmse={"nominal": 0.1},
        alarms=(Finding.alarm("a", "b", "c"),),
        advice=({"sentence": "b"},),
        null_directions=("c",),
        provenance={"seed": 1},
    )
    return [json.dumps(result.to_json()).encode()]


def make_distribution(folder: Path) -> list[bytes]:
    """Return a parameter distribution."""
    result = CalibrationResult.from_json(json.loads(make_result(folder)[0]))
    return [json.dumps(result.distribution().to_json()).encode()]


def draw(path: Path) -> None:
    """Read a distribution and draw from it; a draw that is no number is a fault of the reader."""
    found = read_distribution(path)
    rng = np.random.default_rng(0)
    if not (np.isfinite(found.sample(rng, 50)).all() and np.isfinite(found.sample_latency(rng, 50)).all()):
        raise AssertionError("a draw is not finite")


def _texts(*texts: str) -> Callable[[Path], Sequence[bytes]]:
    return lambda folder: [text.encode() for text in texts]


def damage_attributes(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Replace a number of an MJCF, or repeat, nest or leave out an element."""
    parts = data.decode().split('"')
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(1, len(parts), 2)
        parts[at] = rng.choice(
            ("nan", "-1", "0", "1e30", "1e-300", "", "x", "1 2 3", "99999", "-0.0001 1", "true")
        )
    return '"'.join(parts).encode()


def read_model(path: Path) -> None:
    """Compile and step a model, as the product's trial process does."""
    # In this process, so that a hang or a crash is detected.
    if problem := problem_of(str(path)):
        raise ConfigurationError(f"model {path} {problem}")


def _checkpoint(path: Path) -> None:
    SearchCheckpoint(path, "id").load()


KINDS: dict[str, Kind] = {
    "npz": FileKind(make=make_npz, read=import_recording, name="a.npz", mutations=(damage_bytes, damage_npz)),
    "csv": FileKind(
        make=make_csv, read=import_recording, name="a.csv", mutations=(damage_bytes, damage_cells)
    ),
    "foreign-mcap": FileKind(make=make_mcap, read=import_recording, name="a.mcap", mutations=(damage_bytes,)),
    "lerobot-data": FileKind(
        make=make_lerobot,
        read=read_lerobot,
        name="set/data/chunk-000/file-000.parquet",
        mutations=(damage_bytes,),
    ),
    "lerobot-info": FileKind(
        make=lambda folder: [json.dumps(_INFO).encode()],
        read=read_lerobot,
        name="set/meta/info.json",
        mutations=(damage_json, damage_bytes),
    ),
    "parameters": FileKind(
        make=_texts(template(_MODEL), yaml.safe_dump({"parameters": [{"kind": "damping", "elements": "*"}]})),
        read=lambda path: read_space(path, _MODEL),
        name="p.yaml",
        mutations=(damage_lines, damage_bytes),
    ),
    "columns": FileKind(
        make=_texts(_COLUMNS), read=read_column_map, name="c.yaml", mutations=(damage_lines, damage_bytes)
    ),
    "result": FileKind(
        make=make_result, read=read_result, name="result.json", mutations=(damage_json, damage_bytes)
    ),
    "distribution": FileKind(
        make=make_distribution, read=draw, name="distribution.json", mutations=(damage_json, damage_bytes)
    ),
    "truth": FileKind(
        make=lambda folder: [json.dumps(nominal_truth().to_json()).encode()],
        read=partial(read_truth, parse=CartpoleTruth.from_json),
        name="truth.json",
        mutations=(damage_json, damage_bytes),
    ),
    "checkpoint": FileKind(
        make=lambda folder: [pack({"identity": "id", "run": {"a": np.ones(9), "b": [1, {"c": 2.0}]}})],
        read=_checkpoint,
        name="checkpoint.npz",
        mutations=(damage_bytes,),
    ),
    "mjcf": FileKind(
        make=lambda folder: [DESCRIPTION.mjcf.read_bytes()],
        read=read_model,
        name="robot.xml",
        mutations=(damage_attributes, damage_bytes),
    ),
}
