#!/usr/bin/env python3
"""Fault table of the Go2: what happens when something goes wrong, and how soon the robot is damped.

Each row runs an emulator and `deal-hw collect` or `deploy` as processes of their own, over a real wire, lets
one thing go wrong while the robot stands, and asks three witnesses: the emulator (when did damping arrive
after the fault, on the machine's monotonic clock that all processes share), the operator's terminal, and the
dataset. The state-age limit of the description stands in the file for comparison.

    python tools/measure_go2_faults.py --transport zenoh --out zenoh.json
    python tools/measure_go2_faults.py --table faults.md zenoh.json dds.json
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.cli.bench import describe_machine
from deal_hw.cli.emulator_process import EmulatorProcess
from deal_hw.clock import MonotonicClock
from deal_hw.data.dataset import Dataset
from deal_hw.drivers.go2.driven import DRIVEN
from deal_hw.drivers.go2.protocol import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.topics import LOW_COMMAND
from deal_hw.errors import DealHwError
from deal_hw.policies.onnx_export import write_policy
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.testing.faulty_policy import RARE_M_S, faulty_policy
from deal_hw.transport import Message, TopicTransport, WireOptions

STANDING_S = 2.0
"""Faults begin this long after the first stiff command, while the robot rises [s]."""
PATIENCE_S = 90.0
LATE_S = 0.12
"""How long the policy that comes late takes [s]."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One row of the table.

    Attributes:
        name: The fault, in words.
        emulator: Options of the emulator.
        policy: "nan" or "late" for a faulty policy; "" to hold the standing pose.
        act: Called with the rig while the robot moves; what it does is the fault.
        expect: Whether the robot must be damped at once and stay so ("damped"), the run must go on in spite
            of the fault ("goes on"), or damping is sent while somebody else goes on commanding
            ("damped, contested").
    """

    name: str
    emulator: tuple[str, ...] = ()
    policy: str = ""
    act: Callable[[Rig], None] | None = None
    expect: str = "damped"


class Rig:
    """An emulator, a run, and what an operator could do to them."""

    def __init__(self, transport: str, folder: Path, case: Case, domain: int) -> None:
        self.transport, self.folder, self.case, self.domain = transport, folder, case, domain
        self.fault_ns = -1
        self.port = ""

    @contextlib.contextmanager
    def emulator(self) -> Iterator[EmulatorProcess]:
        """Run the emulator."""
        port = ("--port", "tcp/127.0.0.1:0") if self.transport == "zenoh" else ("--port", "lo")
        wire = ("--domain", str(self.domain)) if self.transport == "dds" else ()
        process = EmulatorProcess(
            "go2", "--transport", self.transport, *port, *wire, "--profile", "sensor", "--nominal",
            "--reveal-to", str(self.folder / "emulator.json"), *self.case.emulator,
        )  # fmt: skip
        with process:
            self.port = process.port
            yield process

    def start(self) -> subprocess.Popen[str]:
        """Start the run."""
        command = [sys.executable, "-m", "deal_hw"]
        if self.case.policy:
            path = self.folder / "policy.onnx"
            write_faulty(path, self.case.policy)
            script = self.folder / "walk.csv"
            script.write_text(f"time_s,x,y,yaw\n1.0,{RARE_M_S},0,0\n", encoding="utf-8")
            command += ["deploy", "go2", "--policy", str(path), "--velocity", str(script)]
        else:
            command += ["collect", "go2", "--profile", "hold"]
        command += ["--transport", self.transport, "--port", self.port, "--seconds", "4"]
        command += ["--out", str(self.folder / "run")]
        if self.transport == "dds":
            command += ["--domain", str(self.domain)]
        self.run = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
        )
        return self.run

    def control_pid(self) -> int:
        """Return the control process's pid once it exists."""
        for _ in range(3000):
            children = Path(f"/proc/{self.run.pid}/task/{self.run.pid}/children").read_text().split()
            for pid in children:
                with contextlib.suppress(OSError):
                    if "control_process" in Path(f"/proc/{pid}/cmdline").read_text():
                        return int(pid)
            time.sleep(0.01)
        raise TimeoutError("there is no control process")

    def await_motion(self) -> None:
        """Return some seconds after the control process got its real-time priority: the robot rises then."""
        pid = self.control_pid()
        for _ in range(3000):
            with contextlib.suppress(OSError):
                if os.sched_getscheduler(pid) == os.SCHED_FIFO:
                    break
            time.sleep(0.01)
        # Before the first command: connecting, releasing sport mode (1 s), listening for others (0.5 s).
        time.sleep(2.5 + STANDING_S)

    def note_fault(self) -> None:
        """The fault is now."""
        self.fault_ns = MonotonicClock().now_ns()


def write_faulty(path: Path, fault: str) -> None:
    """Write a faulty policy; the one that comes late takes :data:`LATE_S` of a processor here."""
    rounds = 1000
    if fault == "late":
        write_policy(*faulty_policy(DRIVEN, "late", rounds, rare=True), path)
        policy, wish = OnnxPolicy(path), np.array([RARE_M_S, 0.0, 0.0], dtype=np.float32)
        times = []
        for _ in range(5):
            begun = time.thread_time()
            policy.act(wish)
            times.append(time.thread_time() - begun)
        rounds = round(rounds * LATE_S / min(times))
    write_policy(*faulty_policy(DRIVEN, "late" if fault == "late" else "nan", rounds, rare=True), path)


def kill_control(rig: Rig) -> None:
    """The control process dies."""
    pid = rig.control_pid()
    rig.note_fault()
    os.kill(pid, signal.SIGKILL)


def stall_control(rig: Rig) -> None:
    """The control process stops running, and lives."""
    pid = rig.control_pid()
    rig.note_fault()
    os.kill(pid, signal.SIGSTOP)


def kill_supervisor(rig: Rig) -> None:
    """The process that the operator started dies."""
    rig.note_fault()
    rig.run.kill()


def interrupt(rig: Rig) -> None:
    """The operator presses Ctrl-C."""
    rig.note_fault()
    os.killpg(rig.run.pid, signal.SIGINT)


def second_controller(rig: Rig) -> None:
    """Another program sends stiff commands, too."""
    from deal_hw.cli.emulate_go2 import make_transport

    options = WireOptions(domain=rig.domain)
    transport: TopicTransport = make_transport(rig.transport, rig.port, options)
    transport.declare(publish=[LOW_COMMAND])
    pose = list(DRIVEN.rest_position)
    zeros = [0.0] * 12
    payload = LowCommandEncoder().encode(LowCommand(pose, zeros, [20.0] * 12, [1.0] * 12, zeros))  # type: ignore[arg-type]
    with transport:
        time.sleep(1.0)
        rig.note_fault()
        for _ in range(25):
            transport.send(Message(LOW_COMMAND, payload, MonotonicClock().now_ns()))
            time.sleep(0.01)


def after(option: str) -> tuple[str, ...]:
    """Return an option of the emulator with the usual time."""
    return (option, str(STANDING_S))


WIRE = after("--wire-after-s")
CASES = (
    Case("none", expect="goes on"),
    Case("5 % of the states lost", (*WIRE, "--drop", "0.05"), expect="goes on"),
    Case("5 % of the states twice", (*WIRE, "--duplicate", "0.05"), expect="goes on"),
    Case("5 % of the states after their successor", (*WIRE, "--reorder", "0.05"), expect="goes on"),
    Case("5 % of the states corrupt", (*WIRE, "--corrupt", "0.05"), expect="goes on"),
    Case("60 % of the states corrupt", (*WIRE, "--corrupt", "0.6")),
    Case("the robot falls silent", after("--freeze-after-s")),
    Case("the same state again and again", after("--stale-after-s")),
    Case("a motor is lost", after("--lost-after-s")),
    Case("sport mode returns", after("--sport-after-s")),
    Case("the battery is nearly empty", after("--battery-after-s")),
    Case("a joint reports NaN", after("--nan-after-s")),
    Case("a motor reports 95 degrees", after("--hot-after-s")),
    Case("L2+B on the remote", after("--stop-after-s")),
    Case("a push that topples it", (*after("--push-after-s"), "--push", "60")),
    Case("the policy answers NaN", policy="nan"),
    Case("the policy takes over 100 ms", policy="late"),
    Case("a second controller", act=second_controller, expect="damped, contested"),
    Case("Ctrl-C", act=interrupt),
    Case("the control process is killed (SIGKILL)", act=kill_control),
    Case("the control process stalls (SIGSTOP)", act=stall_control),
    Case("the supervisor is killed (SIGKILL)", act=kill_supervisor),
)


def measure(case: Case, transport: str, domain: int) -> dict[str, Any]:
    """Run one case and return its row."""
    with tempfile.TemporaryDirectory() as text:
        rig = Rig(transport, Path(text), case, domain)
        with rig.emulator():
            run = rig.start()
            if case.act is not None:
                rig.await_motion()
                case.act(rig)
            try:
                said, _ = run.communicate(timeout=PATIENCE_S)
            except subprocess.TimeoutExpired:
                os.killpg(run.pid, signal.SIGKILL)
                said, _ = run.communicate()
            # Where the supervisor died, its children may need a moment to leave the robot passive.
            time.sleep(1.0 if case.act is not None else 0.2)
        report = json.loads((rig.folder / "emulator.json").read_text())
        data = dataset(rig.folder / "run" / "dataset")
        if case.policy:
            rig.fault_ns = last_cycle_ns(rig.folder / "run" / "dataset")
        return {
            "fault": case.name, "transport": transport, "expected": case.expect,
            **damping(report["commands"], rig.fault_ns, case),
            "exit_code": run.returncode, "operator": headline(said), **data,
        }  # fmt: skip


def last_cycle_ns(folder: Path) -> int:
    """Return when the last cycle with a command asked for began: there the policy went wrong [ns]."""
    opened = Dataset.open(folder)
    episode = opened.read(len(opened.episodes) - 1)
    passive = [i for i, state in enumerate(episode.cycles.safety_state) if state == "passive"]
    return episode.start_ns + round(episode.cycles.start_s[passive[0]] * 1e9) if passive else -1


def damping(commands: dict[str, Any], fault_ns: int, case: Case) -> dict[str, Any]:
    """Return how long it took from the fault to the first damping command, by the emulator's own log."""
    begin = commands["faults"]
    if fault_ns < 0 and begin:
        fault_ns = begin[0]["begin_host_ns"]
    damped = [ns for _, ns, kind in commands["changes"] if kind == "damping" and ns >= fault_ns > 0]
    ms = (damped[0] - fault_ns) * 1e-6 if damped else None
    ok = commands["last_kind"] == "damping"
    if case.expect == "goes on":
        ms = None
    return {"damping_ms": None if ms is None else round(ms, 1), "ends_damped": ok}


def headline(said: str) -> str:
    """Return the line that tells the operator how it ended."""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    wanted = [line for line in lines if re.match(r"(tripped|finished|stopped|failed|error|deal-hw)", line)]
    return (wanted or lines or [""])[0]


def dataset(folder: Path) -> dict[str, Any]:
    """Return whether the recording is whole, after the repair that the next opening does by itself."""
    try:
        opened = Dataset.open(folder)
        states = sum(len(opened.read(i).trajectory.device_s) for i in range(len(opened.episodes)))
    except DealHwError as error:
        return {"dataset": f"not readable: {error}", "states": 0}
    return {"dataset": "whole" if states else "empty", "states": states}


def page(results: list[dict[str, Any]]) -> str:
    """Return the fault table as a page, one column of times a transport."""
    wires = [result["rows"][0]["transport"] for result in results]
    by_fault = {
        row["fault"]: [
            next((r for r in result["rows"] if r["fault"] == row["fault"]), None) for result in results
        ]
        for row in results[0]["rows"]
    }
    worst = [max(row["damping_ms"] or 0.0 for row in result["rows"]) for result in results]
    loads = ", ".join(f"{r['machine']['load'][0]:.1f}" for r in results)
    first = results[0]
    machine = f"{first['machine']['platform']}, {first['machine']['processors']} processors, load {loads}"
    heads = " | ".join(f"{wire} [ms]" for wire in wires)
    lines = [
        "# Go2: from a fault to damping",
        "",
        "By `tools/measure_go2_faults.py` on the emulated robot, profile `sensor`, over real wires on one "
        f"machine ({machine}).",
        "Times are from the fault to the first damping command that the robot received.",
        "",
        f"Worst: {', '.join(f'{w} {t:.0f} ms' for w, t in zip(wires, worst, strict=True))}. The limit on the "
        f"age of a state is {first['state_age_limit_ms']:.0f} ms, judged every 20 ms; that",
        f"on a silent control process {first['silence_limit_ms']:.0f} ms.",
        "",
        f"| fault | {heads} | exit code | recording | the operator sees |",
        "|---|" + "---:|" * len(wires) + "---|---|---|",
    ]
    for fault, rows in by_fault.items():
        known = [row for row in rows if row is not None]
        times = [cell(row) for row in rows]
        codes = ", ".join(dict.fromkeys(str(row["exit_code"]) for row in known))
        data = ", ".join(dict.fromkeys(row["dataset"] for row in known))
        lines.append(
            f"| {fault} | {' | '.join(times)} | {codes} | {data} | {known[0]['operator'] or '(nothing)'} |"
        )
    bad = [
        f"{row['transport']}: {row['fault']}" for r in results for row in r["rows"] if not row["as_expected"]
    ]
    lines += ["", "Not as expected: " + ("; ".join(bad) if bad else "none") + "."]
    return "\n".join(lines) + "\n"


def cell(row: dict[str, Any] | None) -> str:
    """Return a row's time as the page shows it."""
    if row is None:
        return "not run"
    if row["expected"] == "goes on":
        return "goes on" if row["as_expected"] else "stopped"
    return "never" if row["damping_ms"] is None else f"{row['damping_ms']:.0f}"


def main() -> int:
    """Run the table; return 1 where something was not as expected."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--transport", choices=["zenoh", "dds"], default="zenoh")
    parser.add_argument("--domain", type=int, default=91, help="DDS domain, away from real robots")
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--table", type=Path, nargs="+", default=None, metavar="FILE",
                        help="write a page (first) from results (others), and measure nothing")  # fmt: skip
    given = parser.parse_args()
    if given.table is not None:
        given.table[0].write_text(
            page([json.loads(p.read_text()) for p in given.table[1:]]), encoding="utf-8"
        )
        return 0
    limits = DRIVEN.limits
    rows = []
    for case in CASES:
        if given.only not in case.name:
            continue
        row = measure(case, given.transport, given.domain)
        damped = row["ends_damped"] or case.expect == "damped, contested"
        damped = damped and (case.expect == "goes on" or row["damping_ms"] is not None)
        row["as_expected"] = bool(damped) and (row["exit_code"] == 0) == (case.expect == "goes on")
        rows.append(row)
        print(
            f"{'ok ' if row['as_expected'] else 'BAD'} {case.name:42} {row['damping_ms'] or '-':>7} ms  "
            f"exit {row['exit_code']:>3}  {row['dataset']:7} {row['operator'][:110]}",
            flush=True,
        )
        if given.out is not None:
            text = {
                "format": "deal_hw.go2_faults/1", "machine": describe_machine(),
                "state_age_limit_ms": 1e3 * limits.state_age_s, "silence_limit_ms": 1e3 * limits.silence_s,
                "rows": rows,
            }  # fmt: skip
            given.out.write_text(json.dumps(text, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return int(not all(row["as_expected"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
