"""The verb with workers, and clusters of two nodes in a network namespace of their own: real processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil
import pytest

from deal_hw.scale.ray_start import STARTS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("one_ray"),
    pytest.mark.filterwarnings("default:Ray failed"),
    pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed (extra scale)"),
]

LONGEST_S = 500


def bench(folder: Path, name: str, *words: str) -> list[dict[str, Any]]:
    """Run the bench on two cells in a process of its own; return the rows but for their times."""
    out = folder / f"{name}.json"
    done = subprocess.run(
        [*command(out), *words], cwd=folder, capture_output=True, text=True, timeout=LONGEST_S
    )
    assert done.returncode == 0, done.stderr
    return rows(out)


def command(out: Path, seeds: str = "0,1", methods: str = "midpoint,least-squares") -> list[str]:
    """Return the command of a bench with small cells."""
    cells = ["--task", "cartpole", "--methods", methods, "--seeds", seeds]
    budget = ["--population", "8", "--generations", "2", "--demonstration-seconds", "3"]
    return [sys.executable, "-m", "deal_hw", "bench", "fixed-range", *cells, *budget, "--out", str(out)]


def rows(out: Path) -> list[dict[str, Any]]:
    """Return a file's rows but for their times."""
    found = json.loads(out.read_text())["rows"]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in found]


def test_rows_are_those_without_workers(tmp_path: Path) -> None:
    """Bit for bit, for one, two and four workers."""
    alone = bench(tmp_path, "alone", "--threads", "1")
    assert len(alone) == 4 and not any(row["error"] for row in alone)
    for count in (1, 2, 4):
        assert bench(tmp_path, f"workers{count}", "--ray", f"local:{count}") == alone


def test_ctrl_c_keeps_rows_and_ends_all_processes(tmp_path: Path) -> None:
    """The same command goes on, with other workers or none, to the rows of an unbroken run."""
    out = tmp_path / "rows.json"
    line = command(out, seeds="0-3")
    with subprocess.Popen(
        [*line, "--ray", "local:1"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline().startswith("1/8")
        started = psutil.Process(process.pid).children(recursive=True)
        # As the terminal does: to every process of the group.
        os.killpg(process.pid, signal.SIGINT)
        process.stdout.read()
        errors = process.stderr.read()
    assert process.returncode == 130 and "Traceback" not in errors
    _, alive = psutil.wait_procs(started, timeout=120)
    assert len(started) > 3 and not alive
    kept = rows(out)
    assert 1 <= len(kept) < 8
    done = subprocess.run([*line, "--threads", "1"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert f"{len(kept) + 1}/8" in done.stdout and "\n1/8" not in done.stdout
    assert rows(out)[: len(kept)] == kept and len(rows(out)) == 8


def test_a_start_that_failed_once_is_begun_again(tmp_path: Path) -> None:
    """As on a busy machine, where Ray ends its node: its agent, a Python process, comes too late once."""
    mark = tmp_path / "ended"
    (tmp_path / "sitecustomize.py").write_text(
        "import os, pathlib, sys\n"
        f"mark = pathlib.Path({str(mark)!r})\n"
        "if any(word.endswith('dashboard/agent.py') for word in sys.orig_argv) and not mark.exists():\n"
        "    mark.touch()\n"
        "    os._exit(1)\n"
    )
    out = tmp_path / "rows.json"
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [*command(out, seeds="0", methods="midpoint"), "--ray", "local:1"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
    )
    assert done.returncode == 0, done.stderr
    assert mark.exists() and "it is started again" in done.stderr and "Traceback" not in done.stderr
    (row,) = rows(out)
    assert row["error"] == ""


TWO_NODES = """
import json, os, sys, time
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
import ray
from ray.cluster_utils import Cluster
from deal_hw.errors import DealHwError
from deal_hw.scale.tasks import task_map

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
second = cluster.add_node(num_cpus=1, env_vars=json.loads(sys.argv[1]))
cluster.wait_for_nodes()

def slow(spec):
    time.sleep(1.5)
    return spec ** 2

found = {}
try:
    with task_map(cluster.address) as tasks:
        for index, value in tasks.completed(slow, list(range(6))):
            found[index] = value
            if len(found) == 1:
                cluster.remove_node(second, allow_graceful=False)
    print("found", json.dumps([found[i] for i in range(6)]))
except DealHwError as err:
    print("error", err)
"""


FULL_STORE = """
import json, os, sys
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
import numpy as np
from functools import partial
from ray.cluster_utils import Cluster
from deal_hw.errors import DealHwError
from deal_hw.scale.tasks import task_map

head = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 80 * 2**20}
cluster = Cluster(initialize_head=True, head_node_args=head)
cluster.wait_for_nodes()

def size(shared, spec):
    return len(shared)

def array(spec):
    return np.zeros(spec * 2**20, dtype=np.uint8)

found = {}
with task_map(cluster.address) as tasks:
    found["kept"] = [len(value) for _, value in tasks.completed(array, [1])]
    for name, function, spec in (("given", partial(size, array(300)), 0), ("returned", array, 300)):
        try:
            tasks.map(function, [spec])
        except DealHwError as err:
            found[name] = [type(err).__name__, str(err)]
print(json.dumps(found))
"""


def in_namespace(
    folder: Path, second: dict[str, str], program: str = TWO_NODES, every: dict[str, str] | None = None
) -> str:
    """Run a program where there is no network but a loopback; return its last line.

    ``second`` is more environment of the second node, ``every`` of all processes. Where Ray itself does not
    start in time, as on a busy machine, it is run again: this start is not ours. Skips the test where this
    user may make no namespace.
    """
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        pytest.skip("unshare or ip is missing (packages util-linux, iproute2)")
    alone = ["unshare", "-rn", "sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    tried = subprocess.run([*alone, "true"], capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(f"no network namespace is permitted here: {tried.stderr.strip()}")
    for _ in range(STARTS):
        done = subprocess.run(
            [*alone, sys.executable, "-c", program, json.dumps(second)],
            # Workers look into the folder of the process that asks, too: not where deal_hw lies.
            cwd=folder,
            env={**os.environ, "RAY_worker_niceness": "0", **(every or {})},
            capture_output=True,
            text=True,
            timeout=LONGEST_S,
        )
        if "timed out during startup" not in done.stderr:
            break
        warnings.warn("Ray failed: it did not start in time", stacklevel=2)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_tasks_of_a_killed_node_are_done_on_the_other(tmp_path: Path) -> None:
    """With SIGKILL, as a machine that loses its power; no result is missing or different."""
    assert in_namespace(tmp_path, {}) == "found [0, 1, 4, 9, 16, 25]"


def test_a_full_object_store_is_one_line_with_its_remedy(tmp_path: Path) -> None:
    """What tasks are given does not fit, then what one returns; what was computed before is kept.

    Ray would spill to the disk, which it takes for full above a share of 0.
    """
    line = in_namespace(tmp_path, {}, FULL_STORE, {"RAY_local_fs_capacity_threshold": "0.0"})
    found = json.loads(line)
    assert found["kept"] == [2**20]
    for name, kind in (("given", "ClusterError"), ("returned", "TaskLostError")):
        assert found[name][0] == kind
        assert "do not fit into the object store" in found[name][1] and "\n" not in found[name][1]


def test_a_node_with_another_deal_hw_is_named_before_the_work(tmp_path: Path) -> None:
    """Its Python finds another version first."""
    other = tmp_path / "other" / "deal_hw"
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("")
    (other / "version.py").write_text('__version__ = "0.0.1"\n')
    for name in ("calib", "drivers", "policies"):
        (other / name).mkdir()
        (other / name / "__init__.py").write_text("")
    line = in_namespace(tmp_path, {"PYTHONPATH": str(other.parent)})
    assert line.startswith("error node 127.0.0.1 has deal-hw 0.0.1") and "install the same" in line


def test_a_node_without_deal_hw_is_named_before_the_work(tmp_path: Path) -> None:
    """Its Python finds a package of this name in which nothing is."""
    other = tmp_path / "other" / "deal_hw"
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("raise ImportError('not installed')\n")
    line = in_namespace(tmp_path, {"PYTHONPATH": str(other.parent)})
    assert line.startswith("error node 127.0.0.1 has no deal-hw") and "install it on all machines" in line
