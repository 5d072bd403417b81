#!/usr/bin/env python3
"""`deal-hw stop`: the time from its start until the emulated robot is passive, by the emulator's own log.

python tools/measure_stop.py --out stop.json
python tools/measure_stop.py --load 16 --out stop.json
python tools/measure_stop.py --robots go2-dds so101 --states both-stopped --repetitions 2
python tools/measure_stop.py --table stop.json

Each repetition starts a run on an emulated robot, brings it into a state, and starts `deal-hw stop`:

no-owner         both processes of the run are killed (SIGKILL) before; `stop` gets the port
healthy          the run works
control-stopped  its control process gets SIGSTOP at the same moment
both-stopped     both its processes got SIGSTOP three seconds before

The time counts from just before the new process is made (fork and exec) until the first entry of the
emulator's log after which the robot does not follow commands any more. A cart-pole's own watchdog stops it
0.2 s after its run was killed; the row then says that it was passive before. `realtime_ms` is the part of the
time until `stop` has real-time priority.

With `--load N`, N processes compute beside `stop`, from half a second before its start until its end. `stop`
has a session of its own, as in another terminal: Linux shares the processors between sessions (autogroup).
With `--same-session` it is in that of the programs which compute.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arm_rig import arm_file
from fault_rig import UNDER_TEST
from measuring import Row, Rows, hear_signals, load, markdown, parser, read_rows
from ros2_rig import ros2_file
from test_under_load import busy_loops

from deal_hw.control.process.realtime import priority
from deal_hw.drivers.unitree.command_log import DAMPING, OFF, STIFF
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.emulation.topics import free_port

STATES = ("no-owner", "healthy", "control-stopped", "both-stopped")
NAMES = ("robot", "state", "busy", "same_session", "repetition")
_RIG_PRIORITY = 48
"""Of the thread that causes the state and starts `stop`; it is inherited by none of its processes."""
_PATIENCE_S = 120.0
_POLL_S, _LOOK_S = 0.01, 0.005
_SETTLED_S = 0.3
"""Until what was sent has arrived, after `stop` has ended [s]."""
_STOPPED_S = 3.0
"""How long both processes are stopped before `stop` starts [s]: claims and sessions have expired by then."""
_ATTEMPTS = 5
"""Starts of a run, where one ends before it can be stopped, as on a busy machine."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A robot on a wire.

    Attributes:
        robot: Its name; "" for one that a robot.yaml describes.
        wire: The transport; "" for the usual one.
        collect: Further options of its run.
        emulate: Further options of its emulator.
        file: Which robot.yaml is written: "feetech" or "ros2"; "" for none.
        active: Entries of the emulator's log after which the robot follows commands.
        inactive: Entries after which it does not.
    """

    robot: str = ""
    wire: str = ""
    collect: tuple[str, ...] = ("--motion", "chirp")
    emulate: tuple[str, ...] = ()
    file: str = ""
    active: frozenset[str] = frozenset({STIFF})
    inactive: frozenset[str] = frozenset({DAMPING, OFF})


_ANY_PORT = ("--port", "tcp/127.0.0.1:0")
_DOMAIN = ("--domain", "97")
_HOLD = ("--motion", "hold")
_HUNG = ("--excite", "chirp", "--hung-on-crane")
_ARMED, _IDLE = frozenset({"armed", "partly"}), frozenset({"idle", "braking", "held", "stopped"})
_MOVES, _HOLDS = frozenset({"moves"}), frozenset({"holds"})
_SPORT_OFF = ("--sport", "off")
SUBJECTS: Mapping[str, Subject] = {
    "go2-zenoh": Subject(robot="go2", wire="zenoh", collect=_HOLD, emulate=(*_ANY_PORT, *_SPORT_OFF)),
    "go2-dds": Subject(robot="go2", wire="dds", collect=(*_HOLD, *_DOMAIN), emulate=(*_DOMAIN, *_SPORT_OFF)),
    "b2": Subject(robot="b2", wire="zenoh", collect=_HOLD, emulate=(*_ANY_PORT, *_SPORT_OFF)),
    "g1": Subject(robot="g1", wire="zenoh", collect=_HUNG, emulate=(*_ANY_PORT, "--controller", "off")),
    "h1": Subject(robot="h1", wire="zenoh", collect=_HUNG, emulate=(*_ANY_PORT, "--controller", "off")),
    "so101": Subject(robot="so101", active=_ARMED, inactive=_IDLE),
    "arm": Subject(file="feetech", active=_ARMED, inactive=_IDLE),
    "ros2-zenoh": Subject(file="ros2", wire="zenoh", emulate=_ANY_PORT, active=_MOVES, inactive=_HOLDS),
    "ros2-dds": Subject(file="ros2", wire="dds", active=_MOVES, inactive=_HOLDS),
    "cartpole": Subject(robot="cartpole", wire="serial", active=_ARMED, inactive=_IDLE),
}


class Bench:
    """An emulated robot, and one run after the other on it; a context manager.

    Args:
        subject: The robot.
        folder: For its files.
        same_session: Whether `stop` shares the session of the programs that keep the machine busy.
    """

    def __init__(self, subject: Subject, folder: Path, same_session: bool = False) -> None:
        self.subject, self.folder, self.same_session = subject, folder, same_session
        self._events = folder / "events"
        self._events.touch()
        self._runs = 0
        self._robot = subject.robot
        if subject.file:
            _write_robot(subject, folder)
            self._robot = str(folder / "robot.yaml")
        wire = ("--transport", subject.wire) if subject.wire else ()
        own = ("--nominal", "--profile", "sensor", "--events-to", str(self._events), *wire)
        options = (free_port(word) for word in subject.emulate)
        self._emulator = EmulatorProcess(self._robot, *own, *options)
        # The domain of a robot of ros2_control stands in its robot.yaml.
        domain = () if subject.wire != "dds" or subject.file else _DOMAIN
        self._wire = (*wire, *domain)

    def __enter__(self) -> Bench:
        self._emulator.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._emulator.stop()

    def changes(self) -> list[tuple[int, bool]]:
        """Return the emulator's log: host time [ns], and whether the robot follows commands from then on."""
        known = self.subject.active | self.subject.inactive
        lines = [json.loads(line) for line in self._events.read_text().splitlines(keepends=False) if line]
        return [(ns, what in self.subject.active) for _, ns, what in lines if what in known]

    @contextlib.contextmanager
    def run(self) -> Iterator[tuple[int, int]]:
        """Start a run; yield its supervisor and its control process once the robot follows commands."""
        for _ in range(_ATTEMPTS):
            self._runs += 1
            folder = self.folder / f"run{self._runs}"
            with open(self.folder / "printed", "w", encoding="utf-8") as printed:
                process = subprocess.Popen(
                    [
                        *(UNDER_TEST, "-m", "deal_hw", "collect", self._robot, "--port", self._emulator.port),
                        *(*self._wire_of_run(), *self.subject.collect),
                        *("--seconds", "60", "--out", str(folder)),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=printed,
                    stderr=subprocess.STDOUT,
                    process_group=0,
                )
            try:
                if control := self._obeying(process):
                    yield process.pid, control
                    return
            finally:
                _end(process, control if (control := _child(process.pid, "control_process")) else 0)
        raise TimeoutError(f"no run of {self._robot} began: {(self.folder / 'printed').read_text()[-500:]}")

    def _wire_of_run(self) -> tuple[str, ...]:
        return ("--transport", self.subject.wire) if self.subject.wire else ()

    def _obeying(self, process: subprocess.Popen[bytes]) -> int:
        """Return the control process as soon as the robot follows commands; 0 where the run ended before."""
        since_ns, end_ns = time.monotonic_ns(), time.monotonic_ns() + round(_PATIENCE_S * 1e9)
        while process.poll() is None and time.monotonic_ns() < end_ns:
            after = [active for ns, active in self.changes() if ns >= since_ns]
            if after and after[-1] and (control := _child(process.pid, "control_process")):
                # Some more cycles, so that the run is well on its way.
                time.sleep(0.5)
                after = [active for ns, active in self.changes() if ns >= since_ns]
                return control if after[-1] and process.poll() is None else 0
            time.sleep(_POLL_S)
        return 0

    def stop(self, state: str, supervisor: int, control: int) -> Row:
        """Bring the run into a state, start `deal-hw stop`, and return what came of it."""
        where = ("--port", self._emulator.port, *self._wire) if state == "no-owner" else ()
        command = [str(Path(UNDER_TEST).parent / "deal-hw"), "stop", self._robot, *where]
        if state == "no-owner":
            # All are stopped first: where one is killed alone, the other makes the robot passive.
            for number in (signal.SIGSTOP, signal.SIGKILL):
                for pid in (control, supervisor):
                    os.kill(pid, number)
            _await(lambda: _gone(control) and _gone(supervisor))
        if state == "both-stopped":
            for pid in (supervisor, control):
                os.kill(pid, signal.SIGSTOP)
            time.sleep(_STOPPED_S)
        with priority(_RIG_PRIORITY):
            running, average = _running(), load()
            if state == "control-stopped":
                os.kill(control, signal.SIGSTOP)
            begin_ns = time.monotonic_ns()
            process = subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=not self.same_session,
            )
            realtime_ns = _realtime_ns(process)
        printed, _ = process.communicate(timeout=_PATIENCE_S)
        end_ns = time.monotonic_ns()
        time.sleep(_SETTLED_S)
        changes = self.changes()
        before = [active for ns, active in changes if ns < begin_ns][-1:]
        after = [(ns, active) for ns, active in changes if ns >= begin_ns]
        last_active = max((i for i, (_, active) in enumerate(after) if active), default=-1)
        passive = [ns for ns, _ in after[last_active + 1 :]][:1]
        is_passive = not changes[-1][1]
        return {
            "passive": is_passive,
            "passive_before": before == [False],
            "passive_ms": round((passive[0] - begin_ns) * 1e-6, 1) if passive and is_passive else None,
            "realtime_ms": round((realtime_ns - begin_ns) * 1e-6, 1) if realtime_ns else None,
            "stop_ms": round((end_ns - begin_ns) * 1e-6, 1),
            "exit_code": process.returncode,
            "running": running,
            "load": average,
            "said": printed.strip().replace(str(self.folder), "DIR")[-300:],
        }


def _write_robot(subject: Subject, folder: Path) -> None:
    if subject.file == "ros2":
        domain: dict[str, Any] = {"domain": int(_DOMAIN[1])} if subject.wire == "dds" else {}
        ros2_file(folder, **domain)
    else:
        arm_file(folder, subject.file)


def _child(parent: int, module: str) -> int:
    """Return a process's child with this module; 0: there is none."""
    with contextlib.suppress(OSError):
        for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
            with contextlib.suppress(OSError):
                if module in Path(f"/proc/{pid}/cmdline").read_text():
                    return int(pid)
    return 0


def _gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


def _end(process: subprocess.Popen[bytes], control: int) -> None:
    """End what is left of a run."""
    for pid in (control, process.pid):
        if pid and not _gone(pid):
            os.kill(pid, signal.SIGCONT)
    process.terminate()
    try:
        process.wait(20.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if control:
        _await(lambda: _gone(control))


def _realtime_ns(process: subprocess.Popen[str]) -> int:
    """Return when a process has got real-time priority [ns]; 0: it ended without."""
    while process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            if os.sched_getscheduler(process.pid) == os.SCHED_FIFO:
                return time.monotonic_ns()
        time.sleep(_LOOK_S)
    return 0


def _await(ready: Any) -> None:
    end_s = time.monotonic() + _PATIENCE_S
    while not ready() and time.monotonic() < end_s:
        time.sleep(_POLL_S)


def _running() -> int:
    """Return how many threads are ready to run on this machine at this moment."""
    return int(Path("/proc/loadavg").read_text().split()[3].partition("/")[0])


def measure(name: str, given: argparse.Namespace, rows: Rows) -> None:
    """Measure one robot in all states; rows that the file has already are left out."""
    busy, same = given.load, given.same_session
    wanted = [
        (state, number)
        for number in range(given.repetitions)
        for state in given.states
        if not rows.done(name, state, busy, same, number)
    ]
    if not wanted:
        return
    with tempfile.TemporaryDirectory() as folder, Bench(SUBJECTS[name], Path(folder), same) as bench:
        for state, number in wanted:
            row: Row = dict(zip(NAMES, (name, state, busy, same, number), strict=True)) | {"error": ""}
            try:
                with bench.run() as (supervisor, control), busy_loops(busy):
                    if busy:
                        time.sleep(0.5)
                    row |= bench.stop(state, supervisor, control)
            except (TimeoutError, subprocess.TimeoutExpired, ProcessLookupError) as error:
                row["error"] = f"{type(error).__name__}: {error}"[:500]
            rows.add(row)


def table(rows: Sequence[Row]) -> str:
    """Return the table: for each robot and state the median and the longest time."""
    kinds = sorted({(row["busy"], row["same_session"], STATES.index(row["state"])) for row in rows})

    def cell(name: str, busy: int, same: bool, state: int) -> str:
        kind = (name, busy, same, STATES[state])
        found = [
            row
            for row in rows
            if (row["robot"], row["busy"], row["same_session"], row["state"]) == kind and not row["error"]
        ]
        if not found:
            return ""
        passive = sum(row["passive"] for row in found)
        short = "" if passive == len(found) else f" ({passive} of {len(found)})"
        times = sorted(row["passive_ms"] for row in found if row["passive_ms"] is not None)
        if not times:
            return f"before{short}"
        return f"{times[len(times) // 2] / 1e3:.2f} / {times[-1] / 1e3:.2f}{short}"

    names = [name for name in SUBJECTS if any(row["robot"] == name for row in rows)]
    heads = [
        STATES[state] + f", {busy} busy" * (busy > 0) + ", same session" * same for busy, same, state in kinds
    ]
    return markdown(["robot", *heads], ([name, *(cell(name, *kind) for kind in kinds)] for name in names))


def main() -> int:
    """Measure, or print the table of a file."""
    options = parser(__doc__, table=True)
    options.add_argument("--robots", nargs="+", choices=[*SUBJECTS], default=[*SUBJECTS])
    options.add_argument("--states", nargs="+", choices=STATES, default=list(STATES))
    options.add_argument("--repetitions", type=int, default=5)
    options.add_argument("--load", type=int, default=0, metavar="N", help="processes that compute beside")
    options.add_argument("--same-session", action="store_true", help="see above")
    given = options.parse_args()
    if given.table is not None:
        print(table(read_rows(given.table)))
        return 0
    hear_signals()
    rows = Rows(__file__, given.out, NAMES)
    for name in given.robots:
        measure(name, given, rows)
    print(table(rows.rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
