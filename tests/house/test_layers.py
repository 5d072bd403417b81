"""The import order, read from the sources: allowed imports between parts, and of large packages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

import pytest
from import_graph import circles, imports, module_graph, module_name, package_folders, read_sources
from syntax import dotted, walk

ROOT = Path(__file__).resolve().parents[2]
LEAVES = ("calib", "drivers", "policies")
SERVICES = ("control", "data", "motions", "scale", "sim", "testing", "viz")
VOCABULARY = (
    "errors",
    "types",
    "clock",
    "findings",
    "reading",
    "schema",
    "install",
    "on_use",
    "documentation",
    "physical",
    "priorities",
    "load",
    "ranges",
    "rotations",
    "child_process",
    "signals",
    "version",
)
CONTRACTS = (
    "description",
    "robot",
    "transport",
    "policy",
    "parameters",
    "calibration",
    "task_map",
    "training",
)
LAYER = {
    **dict.fromkeys(("deal_hw", *VOCABULARY), 0),
    **dict.fromkeys(CONTRACTS, 1),
    **dict.fromkeys(SERVICES, 2),
    **dict.fromkeys(LEAVES, 3),
    "robots": 4,
    "workflows": 5,
    "cli": 6,
    "bench": 6,
    "__main__": 7,
}
"""Layer of each part; a part may import parts of lower layers and itself."""

BESIDE = {("cli.bench", "bench"), ("deal_hw", "workflows"), ("deal_hw", "transport")}
"""One verb runs the benches.
The package names its workflows and their settings, and loads them on use."""

ROOMS = {
    "control": ({"process", "safety"}, {"loop"}),
    "motions": (
        {"planned_end", "time_script"},
        {"velocity"},
        {"behaviours", "scores"},
        {"excitation", "joint_targets", "posture"},
    ),
    "calib": (
        {"data"},
        {"paper", "fit"},
        {"search", "baselines"},
        {"hypotheses"},
        {"validation"},
        {"design"},
        {"pipeline", "report"},
        {"api"},
    ),
    "drivers": (
        {"command_echo", "servo_bus", "topic_robot", "transports"},
        {"unitree"},
        {"cartpole", "g1", "go2", "ros2", "servo_arm"},
        {"b2", "h1", "so101"},
    ),
    "drivers.cartpole": (
        {"description"},
        {"wire", "plant"},
        {"robots", "chips"},
        {"emulator"},
        {"dynamixel", "fault_rows"},
    ),
    "drivers.go2": (
        {"descriptions", "wording"},
        {"messages"},
        {"emulator", "motions", "odometry", "state_stream"},
        {"bridge", "doctor"},
        {"robot"},
        {"unitree_mujoco"},
    ),
    "data": ({"files", "table"}, {"checks"}, {"recording", "run_folder"}, {"importing"}, {"export"}),
    "sim": (
        {"parameters", "laws"},
        {"engine"},
        {"legged", "mjcf"},
        {"recordings", "robots", "actuators"},
        {"plain_model"},
    ),
}
"""Rooms of a package, the lowest first: a room may import rooms of the sets before its own, and itself."""

WHOLE = {
    *(f"deal_hw.{part}" for part in LAYER),
    *(f"deal_hw.{package}.{room}" for package, sets in ROOMS.items() for rooms in sets for room in rooms),
}
"""Parts and rooms by their full names."""

CONFINED = {
    "torch": {"calib", "policies"},
    "botorch": {"calib"},
    "gpytorch": {"calib"},
    "cma": {"calib"},
    "pyarrow": {"data"},
    "stable_baselines3": {"policies"},
    "gymnasium": {"policies"},
    "onnx": {"policies", "testing"},
    "onnxscript": {"policies"},
    "onnxruntime": {"policies"},
    "mujoco": {"sim", "testing"},
    "rerun": {"viz"},
    "mcap": {"data"},
    "mcap_ros2": {"data"},
    "serial": {"drivers"},
    "can": {"drivers"},
    "cantools": {"drivers"},
    "cobs": {"drivers"},
    "cryptography": {"drivers"},
    "cyclonedds": {"drivers"},
    "dynamixel_sdk": {"drivers"},
    "zenoh": {"drivers"},
    "tyro": {"cli"},
    "pydantic": {"schema"},
    "ray": {"scale"},
    "warp": {"sim"},
    "mujoco_warp": {"sim"},
}
"""Which parts may load a package; packages that are not named here are free."""

OUTSIDE = ("tests", "tools")
IN_QUESTION = re.compile(r"(?<![\w.])(?:calib|drivers|policies)\b|from +\.|time\.time")
"""What a file outside of the product has where it breaks a rule; files without it are not parsed."""

MAX_LINES = 600
PACKAGES = package_folders(ROOT)


def part_of(module: str) -> str:
    """Return the part that a module of deal_hw belongs to: the name after the first dot, or `deal_hw`."""
    return module.split(".")[1] if "." in module else module


def imported(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and name of every import, at the top or inside functions, also by name as text."""
    for found in imports(tree):
        # `from deal_hw import drivers` imports a part and `from deal_hw.calib import fit` a room, not names.
        whole = [name for name in found.names if f"{found.source}.{name}" in WHOLE]
        yield from ((found.line, f"{found.source}.{name}") for name in whole)
        named_as_text = found.when == "text" or found.by_call
        if named_as_text and found.source.startswith("deal_hw."):
            # A module named as text (a table, `python -m`) is a dependency like any other.
            if part_of(found.source) in LAYER:
                yield found.line, found.source
        elif found.when != "text" and (not whole or len(whole) < len(found.names)):
            yield found.line, found.source


def complaint(importer: str, target: str) -> str | None:
    """Return why a module must not import another, or None where it may."""
    root = target.split(".")[0]
    if target.startswith("."):
        return f"relative import {target!r}"
    if root in LEAVES:
        return f"imports {target!r}; write deal_hw.{target}, or there are two copies of each class"
    if not importer.startswith("deal_hw"):
        return None
    me = part_of(importer)
    if root in CONFINED and me not in CONFINED[root]:
        return f"loads {root}, which only {sorted(CONFINED[root])} may"
    if root != "deal_hw":
        return None
    other = part_of(target)
    if me not in LAYER or other not in LAYER:
        return f"{importer if me not in LAYER else target} stands in no layer"
    for package, rooms in ROOMS.items():
        if reason := room_complaint(package, rooms, importer, target):
            return reason
    beside = any((part, other) in BESIDE for part in (me, importer.removeprefix("deal_hw.")))
    same_layer = beside or (LAYER[me] == LAYER[other] and (me == other or LAYER[me] < 3))
    return None if LAYER[other] < LAYER[me] or same_layer else f"{me} imports {other}"


def room_complaint(package: str, rooms: Sequence[set[str]], importer: str, target: str) -> str | None:
    """Return why a module of a package must not import another of its rooms, or None where it may."""
    inside = f"deal_hw.{package}."
    if not (importer.startswith(inside) and target.startswith(inside)):
        return None
    here, there = (name.removeprefix(inside).split(".")[0] for name in (importer, target))
    level = {room: number for number, others in enumerate(rooms) for room in others}
    for room in (here, there):
        if room not in level:
            return f"{package}/{room} is in no room"
    return (
        None if here == there or level[there] < level[here] else f"{package}/{here} imports {package}/{there}"
    )


def violations(sources: Mapping[str, str]) -> list[str]:
    """Return every breach of the order in sources by path, as `path:line: reason`."""
    found = []
    edges: dict[str, set[str]] = {}
    for path, text in sources.items():
        if text.count("\n") > MAX_LINES:
            found.append(f"{path}: {text.count(chr(10))} lines, more than {MAX_LINES}")
        if path.startswith(OUTSIDE) and not IN_QUESTION.search(text):
            continue
        tree = ast.parse(text, path)
        importer = module_name(PurePosixPath(path), PACKAGES)
        for line, target in imported(tree):
            if reason := complaint(importer, target):
                found.append(f"{path}:{line}: {reason}")
            inside = importer.startswith("deal_hw") and target.startswith("deal_hw.")
            if inside and part_of(target) != part_of(importer):
                edges.setdefault(part_of(importer), set()).add(part_of(target))
        for node in walk(tree) if "time.time" in text else ():
            if isinstance(node, ast.Call) and dotted(node.func) == "time.time":
                found.append(f"{path}:{node.lineno}: time.time() jumps; use deal_hw.clock.Clock")
    services = {part: edges.get(part, set()) & set(SERVICES) for part in SERVICES}
    while done := [part for part, needs in services.items() if not needs & set(services)]:
        for part in done:
            del services[part]
    if services:
        found.append(f"services import each other in a circle: {sorted(services)}")
    return found


def repository_sources() -> dict[str, str]:
    """Return every source file of the repository by its path from the root."""
    folders = ("deal_hw", *LEAVES, *OUTSIDE)
    paths = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    return {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in paths}


def test_repository_keeps_the_order() -> None:
    """No file of the repository breaks the import order."""
    sources = repository_sources()
    assert len(sources) > 30
    assert violations(sources) == []


@pytest.mark.parametrize(
    ("path", "source", "reason"),
    [
        ("drivers/x.py", "import deal_hw.calib.deal", "drivers imports calib"),
        ("calib/x.py", "from deal_hw import policies", "calib imports policies"),
        ("policies/x.py", "def f():\n    import deal_hw.drivers.cartpole", "policies imports drivers"),
        ("deal_hw/control/x.py", "from deal_hw.drivers import go2", "control imports drivers"),
        ("deal_hw/robot.py", "from deal_hw.data.reader import read", "robot imports data"),
        ("deal_hw/types.py", "from deal_hw.robot import Robot", "types imports robot"),
        ("drivers/x.py", "from deal_hw.cli import main", "drivers imports cli"),
        ("calib/data/x.py", "from deal_hw.calib.fit import solver", "calib/data imports calib/fit"),
        ("calib/data/x.py", "from deal_hw.calib import fit", "calib/data imports calib/fit"),
        ("calib/data/x.py", "import deal_hw.calib.newroom.y", "calib/newroom is in no room"),
        ("drivers/transports/x.py", "from deal_hw.drivers.go2 import robot", "drivers/transports imports"),
        ("drivers/go2/messages/x.py", "from deal_hw.drivers.go2 import robot", "go2/messages imports"),
        (
            "drivers/go2/robot.py",
            "X = 'deal_hw.drivers.go2.unitree_mujoco:Bench'",
            "imports drivers.go2/unitree",
        ),
        ("deal_hw/cli/x.py", "from calib.deal import Deal", "two copies"),
        ("tests/test_x.py", "import drivers.cartpole", "two copies"),
        ("deal_hw/cli/x.py", "from . import main", "relative import"),
        ("deal_hw/control/x.py", "def f():\n    import torch.nn as nn", "loads torch"),
        ("deal_hw/cli/x.py", "import importlib\nimportlib.import_module('mujoco')", "loads mujoco"),
        ("drivers/x.py", "run(['-m', 'deal_hw.cli.demo'])", "drivers imports cli"),
        ("policies/x.py", "TABLE = {'deal': 'deal_hw.calib.deal:Deal'}", "policies imports calib"),
        ("drivers/x.py", "import mujoco", "loads mujoco"),
        ("drivers/x.py", "from deal_hw.robots import make_robot", "drivers imports robots"),
        ("policies/x.py", "from deal_hw.robots import robots", "policies imports robots"),
        ("deal_hw/robots/x.py", "from deal_hw.workflows import train", "robots imports workflows"),
        ("deal_hw/cli/x.py", "import rerun as rr", "loads rerun"),
        ("deal_hw/cli/x.py", "from deal_hw.bench import rows", "cli imports bench"),
        ("deal_hw/bench/x.py", "from deal_hw.cli import calibrate", "bench imports cli"),
        ("deal_hw/workflows/x.py", "from deal_hw.cli import main", "workflows imports cli"),
        ("deal_hw/control/x.py", "import serial", "loads serial"),
        ("deal_hw/utils/x.py", "from deal_hw.types import Status", "deal_hw.utils.x stands in no layer"),
        ("deal_hw/cli/x.py", "import deal_hw.helpers", "deal_hw.helpers stands in no layer"),
        ("deal_hw/control/x.py", "import time\nnow = time.time()", "time.time() jumps"),
        ("calib/x.py", "x = 1\n" * 601, "more than 600"),
    ],
)
def test_seeded_violation_is_caught(path: str, source: str, reason: str) -> None:
    """Each kind of breach is found, and found once."""
    (found,) = violations({path: source})
    assert found.startswith(path)
    assert reason in found


@pytest.mark.parametrize(
    ("path", "source"),
    [
        (
            "deal_hw/cli/x.py",
            "import tyro\nfrom deal_hw.calib import deal\nfrom deal_hw.robots import robots",
        ),
        (
            "calib/x.py",
            "import torch\nfrom deal_hw.sim.batch import BatchSimulator\nfrom deal_hw import errors",
        ),
        ("drivers/x.py", "import serial\nfrom deal_hw.sim.model import build\nfrom deal_hw.drivers import y"),
        (
            "drivers/go2/robot.py",
            "from deal_hw.drivers.go2 import state_stream\nfrom deal_hw.drivers.go2.messages import body",
        ),
        (
            "deal_hw/bench/x.py",
            "from deal_hw.workflows.calibrate import calibrate\nimport deal_hw.calib.pipeline.methods",
        ),
        ("deal_hw/cli/bench.py", "from deal_hw.bench import rows"),
        ("deal_hw/policy.py", "import numpy\nfrom deal_hw.description import RobotDescription"),
        ("deal_hw/viz/x.py", "import rerun\nfrom deal_hw.sim.model import build"),
        ("deal_hw/sim/x.py", "NAME = 'deal_hw.speed_limit'"),
        ("tests/test_x.py", "import mujoco, torch\nfrom deal_hw.calib import deal"),
    ],
)
def test_allowed_imports_pass(path: str, source: str) -> None:
    """Allowed imports give no complaint."""
    assert violations({path: source}) == []


def test_circle_between_services_is_caught() -> None:
    """Two services that import each other are named, with those that need them."""
    sources = {
        "deal_hw/viz/x.py": "import deal_hw.sim.model",
        "deal_hw/sim/x.py": "import deal_hw.data.reader",
        "deal_hw/data/x.py": "import deal_hw.sim.model",
        "deal_hw/control/x.py": "import deal_hw.data.record",
        "deal_hw/testing/x.py": "import deal_hw.clock",
    }
    (found,) = violations(sources)
    assert found == "services import each other in a circle: ['control', 'data', 'sim', 'viz']"


def test_no_modules_import_each_other() -> None:
    """No circle, be it through imports inside functions or those for type checkers alone."""
    seen = module_graph(read_sources(ROOT), ("load", "call", "types"))
    assert len(seen) > 400
    assert not circles(seen)
