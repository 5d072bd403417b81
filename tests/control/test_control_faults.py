"""Real processes over a real wire, by the rigs of the fault tables: whatever goes wrong, it is passive.

`tools/measure_go2_faults.py` and `tools/measure_cartpole_faults.py` draw moments and repeat each row; here
the worst rows run once, at a moment of their own. The emulator reports the robot's commands, never deal-hw.
`make test` runs some rows of the cart-pole; its other rows, and all of the Go2, are slow tests.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from deal_hw.install import install_line

pytestmark = pytest.mark.real_time

TOOLS = Path(__file__).resolve().parents[2] / "tools"
SLOW = pytest.mark.slow
CARTPOLE = ("cartpole", "serial")
GO2 = [pytest.param("go2", wire, marks=SLOW) for wire in ("zenoh", "dds")]
TYPICAL_S = {"connecting": 2.0, "taking over": 0.5}


@pytest.fixture
def measure() -> Iterator[Any]:
    """Return a function that runs one repetition of a row at a phase and returns what came of it."""
    pytest.importorskip("torch", reason=install_line("calib"))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOOLS))
        table = importlib.import_module("fault_table")

        def run(robot: str, wire: str, name: str, phase: str, **changes: Any) -> dict[str, Any]:
            tool: ModuleType = importlib.import_module(f"measure_{robot}_faults")
            rig_type = tool.Go2Rig if robot == "go2" else tool.CartpoleRig
            (case,) = (c for c in tool.CASES if c.name == name)
            phases = (phase,) if phase else ()
            if phase == "ending":
                rig_type = sooner(rig_type)
            case = dataclasses.replace(case, phases=phases, within_ms=10_000.0, **changes)
            for attempt in range(3):
                row: dict[str, Any] = table.repetition(rig_type, case, wire, [attempt], 0, dict(TYPICAL_S))
                # A machine that stands still for 40 ms trips a run, whatever else happens to it.
                if not (row["complaints"] and row["exit_code"] == 3 and "ms old" in row["operator"]):
                    break
            return row

        yield run


def sooner(rig_type: Any) -> Any:
    """Return a rig whose runs end a little after the fault, not a little before: a busy machine is late."""

    class Sooner(rig_type):  # type: ignore[misc]
        def phase_at(self, phase: str) -> tuple[str, float, float]:
            event, begin_s, _ = super().phase_at(phase)
            return event, begin_s - (0.1 if phase == "ending" else 0.0), 0.0

    return Sooner


def assert_passive(row: dict[str, Any]) -> None:
    """Check that the robot obeyed, is passive for good, and that the recording is whole."""
    assert row["complaints"] == []
    assert (row["ends"], row["dataset"]) == ("passive", "whole")
    assert row["passive_ms"] is not None


@SLOW
@pytest.mark.parametrize(
    "name", ["the link freezes for 3 s as the run ends", "the link is reset for 1.5 s as the run ends"]
)
def test_a_go2_whose_link_is_away_as_the_run_ends_is_damped_when_it_is_back(measure: Any, name: str) -> None:
    """Its last command was stiff, and it would hold that for ever."""
    row = measure("go2", "zenoh", name, "ending")
    assert_passive(row)
    assert row["exit_code"] == 3


@SLOW
def test_a_go2_whose_wire_is_cut_as_the_run_ends_is_damped_when_it_is_back(measure: Any) -> None:
    """Over DDS no error tells of a link that is gone: silence alone does."""
    assert_passive(measure("go2", "dds", "the link is cut for 3 s as the run ends", "ending"))


@pytest.mark.parametrize(("robot", "wire"), [GO2[0], CARTPOLE])
@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("Ctrl-Z, then fg", 130),
        pytest.param("the supervisor stands still (SIGSTOP)", 130, marks=SLOW),
    ],
)
def test_a_program_that_is_stopped_leaves_a_passive_robot(
    measure: Any, robot: str, wire: str, name: str, code: int
) -> None:
    """Ctrl-Z: passive first, then stopped. SIGSTOP: the control process misses its supervisor."""
    row = measure(robot, wire, name, "running", seconds=10.0)
    assert_passive(row)
    assert row["exit_code"] == code


@SLOW
@pytest.mark.parametrize(("robot", "wire"), [("go2", "zenoh"), ("go2", "dds"), CARTPOLE])
@pytest.mark.parametrize("phase", ["connecting", "running"])
def test_a_second_run_is_refused_and_never_takes_over(
    measure: Any, robot: str, wire: str, phase: str
) -> None:
    """It ends with 2 and says who commands; the first goes on until Ctrl-C, and then nobody moves it."""
    # Ctrl-C ends it when the second is refused, however long that takes on a busy machine.
    row = measure(robot, wire, "a second run while the first connects, starts or runs", phase, seconds=300.0)
    assert_passive(row)
    assert row["exit_code"] == 130


@SLOW
def test_a_second_run_from_another_computer_is_refused(measure: Any) -> None:
    """By another address the kernel's claim does not see it: the claim on the wire does."""
    name = "a second run by another address, as from another computer"
    assert_passive(measure("go2", "zenoh", name, "running"))


@pytest.mark.parametrize(("robot", "wire"), [*GO2, CARTPOLE])
@pytest.mark.parametrize(
    ("name", "phase"),
    [
        ("dry run: a policy that hangs", ""),
        pytest.param("dry run: the control process is killed", "connecting", marks=SLOW),
    ],
)
def test_a_dry_run_that_dies_has_told_the_robot_nothing(
    measure: Any, robot: str, wire: str, name: str, phase: str
) -> None:
    """Not a command and not a request: a Go2 goes on standing under sport mode."""
    row = measure(robot, wire, name, phase)
    assert row["complaints"] == []
    assert (row["ends"], row["exit_code"]) == ("never commanded", 2)


@SLOW
@pytest.mark.parametrize("wire", ["zenoh", "dds"])
def test_a_run_that_is_killed_while_sport_mode_stands_commands_no_motor(measure: Any, wire: str) -> None:
    """Damping beside sport mode would make a standing robot shake or fall."""
    row = measure("go2", wire, "killed while taking over from sport mode, which stands", "taking over")
    assert row["complaints"] == []
    assert row["ends"] == "never commanded"


@SLOW
def test_only_the_robot_can_help_where_both_processes_are_killed(measure: Any) -> None:
    """The cart-pole's watchdog stops its motor; the Go2 has none and stays stiff, as the docs say."""
    assert measure("go2", "zenoh", "both processes are killed (SIGKILL)", "running")["ends"] == "active"
    name = "both processes are killed (SIGKILL); the device's watchdog stops the motor"
    row = measure("cartpole", "serial", name, "running")
    assert (row["ends"], row["complaints"]) == ("passive", [])
    assert row["passive_ms"] > 100.0


def test_a_cable_that_is_pulled_and_put_back_ends_the_run(measure: Any) -> None:
    """The link is lost, the watchdog acts, and the port is found again to confirm it."""
    row = measure("cartpole", "serial", "the cable is pulled, and put back after 0.5 s", "")
    assert_passive(row)
    assert row["exit_code"] == 3
