"""Where tasks run, and what is said where they cannot; no worker is started here."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import deal_hw.policies
from deal_hw.bench.rows import Cells, load_rows, run_cells, save_rows
from deal_hw.bench.settings import Loop
from deal_hw.errors import ClusterError, ConfigurationError, MissingExtraError, TaskLostError
from deal_hw.install import install_line
from deal_hw.scale import facts, ray_errors
from deal_hw.scale.ray_errors import reachable, words
from deal_hw.scale.ray_nodes import clocks_apart, difference
from deal_hw.scale.ray_start import start_ray
from deal_hw.scale.tasks import task_map
from deal_hw.scale.where import Where, parse_where
from deal_hw.task_map import InThisProcess, TaskMap


class LastFirst(TaskMap):
    """Does the last task first, and loses those of some specifications; notes what was begun and left."""

    def __init__(self, lose: Sequence[Any] = ()) -> None:
        self.lose, self.left = lose, False

    def completed(
        self,
        function: Callable[[Any], Any],
        specs: Sequence[Any],
        lost: Callable[[Any, TaskLostError], Any] | None = None,
    ) -> Generator[tuple[int, Any], None, None]:
        """See the base class."""
        try:
            for index, spec in reversed(list(enumerate(specs))):
                if spec in self.lose:
                    assert lost is not None
                    yield index, lost(spec, TaskLostError("its worker ended"))
                else:
                    yield index, function(spec)
        except GeneratorExit:
            self.left = True
            raise


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("local", Where()),
        ("local:4", Where(workers=4)),
        ("auto", Where(address="auto")),
        ("head.lab:6379", Where(address="head.lab:6379")),
        ("[fd00::1]:6379", Where(address="[fd00::1]:6379")),
    ],
)
def test_places(text: str, where: Where) -> None:
    """This machine, or a cluster."""
    assert parse_where(text) == where


@pytest.mark.parametrize(
    "text", ["", "local:0", "local:1025", "local:x", "10.0.0.1", "ray://head:10001", "a b:1"]
)
def test_no_place(text: str) -> None:
    """Anything else is refused with what is allowed."""
    with pytest.raises(ConfigurationError, match=r"--ray .*HOST:PORT"):
        parse_where(text)


def test_without_ray_nothing_is_loaded_and_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """No option needs no Ray; with it the message has the line that installs it."""
    assert isinstance(task_map(None), InThisProcess)
    found = importlib.util.find_spec

    def missing(name: str, *rest: Any) -> Any:
        return None if name == "ray" else found(name, *rest)

    monkeypatch.setattr(importlib.util, "find_spec", missing)
    with pytest.raises(MissingExtraError, match=re.escape(install_line("scale"))):
        task_map("local")


def test_nothing_loads_ray_before_workers_start() -> None:
    """Neither the verbs nor the modules of this package."""
    code = (
        "import sys, deal_hw.cli.main, deal_hw.cli.bench, deal_hw.cli.calibrate, deal_hw.scale.ray_tasks; "
        "sys.exit('ray' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_an_address_where_nothing_listens() -> None:
    """It is one line with its remedy, at once."""
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
        with pytest.raises(
            ClusterError, match=f"no Ray cluster answers at 127[.]0[.]0[.]1:{port}.*ray start --head"
        ):
            reachable(f"127.0.0.1:{port}")
    with pytest.raises(ClusterError, match="no Ray cluster answers"):
        reachable("127.0.0.1:99999")


def test_auto_without_a_cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """None was ever started, or the one that was is gone: both are known at once."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(ray_errors, "CURRENT", tmp_path / "current")
    with pytest.raises(ClusterError, match="no Ray cluster runs on this machine"):
        reachable("auto")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        (tmp_path / "current").write_text(f"127.0.0.1:{closed.getsockname()[1]}")
        with pytest.raises(ClusterError, match="no Ray cluster answers at 127"):
            reachable("auto")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "Version mismatch: The cluster was started with:\n    Ray: 2.59.0\n    Python: 3.11.7\n",
            "another version of Ray or of Python .*same ones on all machines",
        ),
        ("Unauthenticated: InvalidAuthToken: Authentication token is missing", "copy ~/.ray/auth_token"),
        ("Could not find any running Ray instance.", "no Ray cluster runs on this machine"),
        (
            "This node has an IP address of 10.0.0.9, and Ray expects a raylet here",
            "ray start --address=head:1",
        ),
        ("ObjectStoreFullError: Failed to put object", "--object-store-memory"),
        (
            "The current node timed out during startup. This could happen because some of the raylet failed",
            r"did not start within its 30 s.*too busy .load [\d.]+ on \d+ processors.*leave out --ray",
        ),
        ("something new", "Ray cannot start with the cluster at head:1: RuntimeError: something new"),
    ],
)
def test_errors_of_ray_are_one_line_with_a_remedy(text: str, said: str) -> None:
    """As Ray words them."""
    line = words(RuntimeError(text), "head:1")
    assert re.search(said, line) and "\n" not in line and len(line) < 800


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (extra scale)")
@pytest.mark.parametrize(
    ("text", "fail", "begun", "said"),
    [
        ("The current node timed out during startup.", 2, 3, ""),
        ("The current node timed out during startup.", 3, 3, "did not start within its 30 s, three times"),
        ("Could not find any running Ray instance.", 1, 1, "no Ray cluster runs on this machine"),
    ],
)
def test_a_start_that_was_too_slow_is_begun_again(
    monkeypatch: pytest.MonkeyPatch, text: str, fail: int, begun: int, said: str
) -> None:
    """Three times in all; what another start would not change is said at once."""
    import ray

    calls: list[dict[str, Any]] = []

    def init(**options: Any) -> None:
        calls.append(options)
        if len(calls) <= fail:
            # Ray raises this very class for a slow start.
            raise (Exception if "startup" in text else ConnectionError)(text)

    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(ClusterError, match=said) if said else contextlib.nullcontext():
        start_ray(Where(), {"num_cpus": 2})
    assert calls == [{"num_cpus": 2}] * begun


def test_a_node_must_compute_as_this_machine_does() -> None:
    """Another deal-hw, other sources, another library or none is named; equal ones are not."""
    mine = facts.facts()
    assert {"python", "numpy", "mujoco", "deal-hw", "sources"} <= set(mine)
    assert difference(mine, dict(mine)) == ""
    assert "has no deal-hw" in difference(
        mine, {k: v for k, v in mine.items() if k not in ("deal-hw", "sources")}
    )
    assert f"has deal-hw 0.0.1, and this machine {mine['deal-hw']}" in difference(
        mine, {**mine, "deal-hw": "0.0.1"}
    )
    assert "other sources of deal-hw" in difference(mine, {**mine, "sources": "0"})
    assert "has numpy none" in difference(mine, {k: v for k, v in mine.items() if k != "numpy"})


def test_clocks_that_are_apart_are_said() -> None:
    """By how much at least: an answer has any time between the question and the end of the wait."""
    assert clocks_apart(110.0, 100.0, 120.0) == clocks_apart(95.0, 100.0, 120.0) == ""
    assert clocks_apart(3720.0, 100.0, 120.0).startswith(
        "its clock is 3600 s ahead of this machine's; results"
    )
    assert clocks_apart(40.0, 100.0, 120.0).startswith("its clock is 60 s behind this machine's")
    assert "timedatectl" in clocks_apart(0.0, 100.0, 120.0)


def test_other_sources_have_another_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One changed line is enough; the folder's place is not a part of it."""
    found = []
    for name, text in (("a", "x = 1\n"), ("b", "x = 1\n"), ("c", "x = 2\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file.py").write_text(text)
        monkeypatch.setattr(deal_hw.policies, "__path__", [str(tmp_path / name)])
        found.append(facts.facts()["sources"])
    assert found[0] == found[1] != found[2]


def _cells(tasks: TaskMap, seeds: Sequence[int]) -> Cells:
    def run(seed: int) -> dict[str, Any]:
        return {"bench": "b", "seed": seed, "value": seed**2, "error": ""}

    return Cells(names=("seed",), run=run, args=[((s,), (s,)) for s in seeds], tasks=tasks, bench="b")


def _note(places: list[str], place: str, row: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    places.append(place)


def test_rows_do_not_depend_on_the_order_in_which_cells_end(tmp_path: Path) -> None:
    """The file has the order of the cells; each row is in it before the next one comes."""
    counted = []
    for name, tasks in (("here", InThisProcess()), ("there", LastFirst())):
        out = tmp_path / f"{name}.json"
        places: list[str] = []
        counted.append(places)
        rows = run_cells(_cells(tasks, (0, 1, 2)), out, partial(_note, places))
        assert [row["seed"] for row in rows] == [0, 1, 2] and load_rows(out) == rows
    assert counted == [["1/3", "2/3", "3/3"]] * 2
    assert (tmp_path / "here.csv").read_text() == (tmp_path / "there.csv").read_text()


def test_a_lost_cell_is_a_row_with_its_error_and_is_run_again(tmp_path: Path) -> None:
    """The other cells still run; the next call runs only the lost one, and keeps the rest of the file."""
    out = tmp_path / "rows.json"
    save_rows(out, [{"bench": "b", "seed": 9, "value": 81, "error": ""}])
    lost = run_cells(_cells(LastFirst(lose=[((1,), (1,))]), (0, 1, 2)), out, lambda *_: None)
    assert [(row["seed"], row["error"]) for row in lost] == [
        (9, ""),
        (0, ""),
        (1, "TaskLostError: its worker ended"),
        (2, ""),
    ]
    places: list[str] = []
    again = run_cells(_cells(InThisProcess(), (0, 1, 2)), out, lambda place, *_: places.append(place))
    assert places == ["3/3"] and [row["seed"] for row in again] == [9, 0, 2, 1]
    assert not any(row["error"] for row in again)


def test_a_row_whose_completion_was_lost_keeps_its_numbers(tmp_path: Path) -> None:
    """It has the error beside them."""
    out, row = tmp_path / "rows.json", {"bench": "b", "seed": 1, "value": 1, "error": ""}
    save_rows(out, [row])
    lose = LastFirst(lose=[((1,), (1, row))])
    cells = dataclasses.replace(_cells(lose, (1,)), whole=lambda one: "more" in one)
    (lost,) = run_cells(cells, out, lambda *_: None)
    assert lost["value"] == 1 and lost["error"] == "TaskLostError: its worker ended"


def test_what_ended_before_a_ctrl_c_is_kept(tmp_path: Path) -> None:
    """The other cells are cancelled."""
    out, tasks = tmp_path / "rows.json", LastFirst()

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cells(_cells(tasks, (0, 1, 2)), out, interrupt)
    assert [row["seed"] for row in load_rows(out)] == [2] and tasks.left


def test_a_cell_in_a_worker_takes_one_processor() -> None:
    """Else each would take all: --threads says otherwise."""
    assert Loop().cell_threads is None
    assert Loop(ray="local").cell_threads == 1
    assert Loop(ray="local", threads=3).cell_threads == 3
