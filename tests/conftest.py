"""What holds for all tests."""

import fcntl
import functools
import gc
import json
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# How fast an example is found or runs is the machine's matter: a busy one must fail no test.
settings.register_profile("deal_hw", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("deal_hw")

# A shell starts background jobs with SIGINT ignored, nohup with SIGHUP. Tests would wait for them.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# Without it `import mujoco` loads a library for windows, which starts a process to ask for its version. No
# test draws by OpenGL. Programs that the tests start inherit it.
os.environ.setdefault("MUJOCO_GL", "disable")

NICE = int(os.environ.get("DEAL_HW_TESTS_NICE", "10"))
"""Added to the niceness of a worker that computes: tests in real time get their cores at once. Beside ten
busy programs such a worker would get 1 % of a core, so tools/test_under_load.py sets 0."""


def in_real_time(item: pytest.Item) -> bool:
    """Return whether a test runs processes in real time."""
    return item.get_closest_marker("real_time") is not None


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """For `-m slow` read only the files that name the marker; each worker collects for itself."""
    if config.option.markexpr != "slow" or not collection_path.match("test_*.py"):
        return None
    return "mark.slow" not in collection_path.read_text(encoding="utf-8") or None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Let each worker begin to collect at another folder; pytest_collection_modifyitems restores the order.

    Where no bytecode lies yet, each worker would compile every test file, which takes as long as half of the
    collection. So each begins with another part, and finds the rest compiled by the others. Below this file's
    folder pytest asks no conftest.py.
    """
    report = yield
    worker: dict[str, Any] | None = getattr(collector.config, "workerinput", None)
    if worker is not None and isinstance(collector, pytest.Dir) and report.result:
        number = int(worker["workerid"].removeprefix("gw"))
        first = len(report.result) * number // worker["workercount"]
        report.result = [*report.result[first:], *report.result[:first]]
    return report


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Tell a worker of pytest-xdist where to list its tests in real time: the controller sees no markers."""
    folder = Path(tempfile.gettempdir()) / f"deal_hw_tests_{node.workerinput['testrunuid']}"
    folder.mkdir(exist_ok=True)
    node.workerinput["real_time_to"] = str(folder / node.workerinput["workerid"])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Under pytest-xdist one worker gets all tests in real time, and others get whole files."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):  # type: ignore[misc, unused-ignore]
        @functools.cached_property
        def _real_time(self) -> frozenset[str]:
            """By one worker's list: all collect the same tests. The lists are not needed again."""
            files = [Path(node.workerinput["real_time_to"]) for node in self.registered_collections]
            found = frozenset(json.loads(files[0].read_text(encoding="utf-8")))
            shutil.rmtree(files[0].parent)
            return found

        def _split_scope(self, nodeid: str) -> str:
            return "real time" if nodeid in self._real_time else nodeid.partition("::")[0]

        def remove_node(self, node: Any) -> str | None:
            """Leave out what is done, where a worker would stop, and the test that ended this one."""
            units: dict[str, dict[str, bool]] = self.assigned_work[node]
            left = ((unit, name) for unit in units.values() for name, done in unit.items() if not done)
            first = next(left, None)
            if first is not None:
                first[0][first[1]] = True
            self.assigned_work[node] = {
                scope: unit for scope, unit in units.items() if not all(unit.values())
            }
            super().remove_node(node)
            return None if first is None else first[1]

    config.option.loadscopereorder = False  # the order is that of pytest_collection_modifyitems
    return Scheduling(config, log)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with what lasts longest: tests in real time, then the files with the most slow tests.

    All workers have the same order, whatever they collected first.
    """
    if hasattr(config, "workerinput"):
        slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
        items.sort(key=lambda item: (not in_real_time(item), -slow[item.path], item.path))
        names = [item.nodeid for item in items if in_real_time(item)]
        Path(config.workerinput["real_time_to"]).write_text(json.dumps(names), encoding="utf-8")


LOADED = pytest.StashKey[frozenset[str]]()
"""Names of the modules that collecting the tests loaded."""


def pytest_collection_finish(session: pytest.Session) -> None:
    """Note what is loaded before the first test runs: tests/house/test_collection.py looks at it.

    The tests live to the end, and no search for garbage need visit them: it takes 0.3 s each time. With
    Python's own thresholds, 700 new objects, searches took 7 % of the tests' processor time; with these 5 %.
    """
    session.config.stash[LOADED] = frozenset(sys.modules)
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@pytest.fixture(scope="session")
def loaded_by_collection(pytestconfig: pytest.Config) -> frozenset[str]:
    """The modules that collecting the tests loaded, by their full names."""
    return pytestconfig.stash[LOADED]


@pytest.fixture(scope="module")
def one_ray(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Wait until no other worker of pytest has tests with Ray: its processes start within 15 s or end."""
    # The folder above is that of all workers of a run.
    with (tmp_path_factory.getbasetemp().parent / "ray.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


computing = False
"""Whether this worker has begun to compute. Tests in real time come first: it is given no more of them."""


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give the cores to the worker with the tests in real time, if that wants them."""
    global computing
    if hasattr(item.config, "workerinput") and not computing and not in_real_time(item):
        computing = True
        os.nice(NICE)


@pytest.fixture
def checks_may_fail() -> None:
    """For a test in which a check of a result fails on purpose."""


@pytest.fixture(autouse=True)
def no_check_fails(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fail a test in which a check of a calibration's result failed: the result stands, and would hide it."""
    from deal_hw import findings

    failed: list[Exception] = []
    reason_of = findings.reason_of

    def noted(err: Exception) -> str:
        failed.append(err)
        return reason_of(err)

    monkeypatch.setattr(findings, "reason_of", noted)
    yield
    if failed and "checks_may_fail" not in request.fixturenames:
        raise failed[0]


@pytest.fixture(autouse=True)
def signals_are_left_as_they_were() -> Iterator[None]:
    """Fail a test that leaves a handler of Ctrl-C or SIGTERM behind: a later one would fail for it."""
    # The functions themselves: a test may have replaced those of the module until after this.
    handler_of, set_handler = signal.getsignal, signal.signal
    before = {number: handler_of(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    left = {number: handler_of(number) for number in before}
    for number, handler in before.items():
        set_handler(number, handler)
    assert left == before
