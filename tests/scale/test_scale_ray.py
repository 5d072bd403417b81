"""Tasks in real workers of Ray on this machine: results, processes that are killed, what listens.

Ray runs in a process of its own: where its native part fails, as on a busy computer, it ends the process
that it runs in, which would be the worker of pytest.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("one_ray"),
    pytest.mark.filterwarnings("default:Ray failed"),
    pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed (extra scale)"),
]

LONGEST_S = 240
PROGRAM = r"""
import json, os, signal, sys
from functools import partial
from pathlib import Path
import psutil
from deal_hw.errors import ConfigurationError, TaskLostError
from deal_hw.scale.tasks import task_map
from deal_hw.task_map import InThisProcess

folder, found = Path.cwd(), {}

def power(shared, spec):
    return [spec, spec ** len(shared)]

def power_of_two(spec):
    return 2 ** spec

def seen(spec):
    return [sys.argv[1:], os.getcwd(), os.environ["OMP_NUM_THREADS"], os.environ["OPENBLAS_NUM_THREADS"]]

def fails(spec):
    raise ConfigurationError(f"number {spec}")

def dies_once(spec):
    mark = folder / str(spec)
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 10 * spec

def dies(spec):
    if spec == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return spec

def marks(spec):
    (folder / f"begun {spec}").touch()
    return spec

class Counts:
    calls = 0

    def __call__(self, spec):
        self.calls += 1
        return [os.getpid(), self.calls]

def raised(function, spec):
    try:
        tasks.map(function, [spec])
    except Exception as err:
        return [type(err).__name__, str(err)]

def listening(process):
    try:
        return [p.laddr.ip for p in process.net_connections("inet") if p.status == psutil.CONN_LISTEN]
    except psutil.NoSuchProcess:
        return []

with task_map("local:2") as tasks:
    task = partial(power, [0] * 3)
    found["results"] = [tasks.map(task, range(20)), InThisProcess().map(task, range(20)), tasks.map(task, [])]
    found["worker"] = tasks.map(seen, [0])[0]
    found["raised"] = raised(fails, 3)
    counts = Counts()
    found["counts"] = [call for _ in range(2) for call in tasks.map(counts, range(10))]
    found["workers"] = tasks.workers
    here = psutil.Process()
    found["listening"] = [ip for p in (here, *here.children(recursive=True)) for ip in listening(p)]
    found["died once"] = tasks.map(dies_once, [1, 2])
    found["lost"] = dict(tasks.completed(dies, [0, 1, 2], lambda spec, why: -spec))
    found["lost alone"] = raised(dies, 1)
    early = tasks.completed(marks, range(40))
    found["first"] = next(early)
    early.close()
    found["after"] = tasks.map(power_of_two, range(4))
    found["begun"] = len(list(folder.glob("begun *")))
print(json.dumps(found))
"""


def run(folder: Path) -> dict[str, Any] | str:
    """Run the program, and return what it found; or how Ray itself ended it."""
    line = [sys.executable, "-c", PROGRAM, "bench", "x"]
    with subprocess.Popen(
        line, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            printed, errors = process.communicate(timeout=LONGEST_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return f"hung for {LONGEST_S} s"
    if process.returncode < 0:
        return f"ended its process by {signal.Signals(-process.returncode).name}"
    assert process.returncode == 0, errors
    found: dict[str, Any] = json.loads(printed.splitlines()[-1])
    return found


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of the program, and what it found; where Ray itself failed, it is run once more."""
    for _ in range(2):
        folder = tmp_path_factory.mktemp("ray")
        result = run(folder)
        if not isinstance(result, str):
            return folder, result
        warnings.warn(f"Ray failed: it {result}", stacklevel=1)
    pytest.fail(f"Ray {result}, for the second time")


def test_results_are_those_of_this_process(found: tuple[Path, dict[str, Any]]) -> None:
    """In the order of the specifications."""
    there, here, none = found[1]["results"]
    assert there == here == [[n, n**3] for n in range(20)]
    assert none == []


def test_a_worker_knows_command_line_and_folder_and_has_one_thread(
    found: tuple[Path, dict[str, Any]],
) -> None:
    """Relative paths mean the same there; numeric libraries do not take each other's processors."""
    assert found[1]["worker"] == [["bench", "x"], str(found[0]), "1", "1"]


def test_a_function_that_is_given_again_is_not_sent_again(found: tuple[Path, dict[str, Any]]) -> None:
    """Each worker keeps its own, which counts all tasks that the worker did, in both calls."""
    last = dict[int, int]()
    for worker, calls in found[1]["counts"]:
        last[worker] = max(calls, last.get(worker, 0))
    assert found[1]["workers"] == 2 >= len(last) and sum(last.values()) == 20


def test_an_error_of_a_task_is_raised_here(found: tuple[Path, dict[str, Any]]) -> None:
    """As its own class, so that it is handled as without workers."""
    assert found[1]["raised"] == ["ConfigurationError", "number 3"]


def test_a_task_whose_worker_is_killed_is_done_again(found: tuple[Path, dict[str, Any]]) -> None:
    """By `kill -9`, as the kernel does where memory ends; the result is the same."""
    assert found[1]["died once"] == [10, 20]


def test_nothing_listens_beyond_this_machine(found: tuple[Path, dict[str, Any]]) -> None:
    """Of all processes that were started."""
    places = found[1]["listening"]
    assert len(places) > 3 and {ip.removeprefix("::ffff:") for ip in places} == {"127.0.0.1"}


def test_a_task_that_kills_each_worker_is_lost_and_the_others_are_done(
    found: tuple[Path, dict[str, Any]],
) -> None:
    """After four beginnings; it is one line with its remedy, or what the caller makes of it."""
    assert found[1]["lost"] == {"0": 0, "1": -1, "2": 2}
    kind, said = found[1]["lost alone"]
    assert kind == "TaskLostError" and "4 times" in said and "enough memory" in said and "\n" not in said


def test_an_iteration_that_is_left_early_begins_no_others(found: tuple[Path, dict[str, Any]]) -> None:
    """Of forty tasks three are with Ray, whose two workers do what comes next. Nothing is cancelled."""
    index, result = found[1]["first"]
    assert 0 <= index == result < 3
    assert found[1]["after"] == [1, 2, 4, 8] and 1 <= found[1]["begun"] <= 3
