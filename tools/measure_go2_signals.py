#!/usr/bin/env python3
"""Signals to a standing Go2's programs: the time until it stays damped, and whether the dataset is whole.

python tools/measure_go2_signals.py --only session --transport zenoh --out zenoh.json
python tools/measure_go2_signals.py --only '^SIG' --repetitions 1 --out each.json
python tools/measure_go2_signals.py --table signals.md zenoh.json dds.json each.json

`session`: what a lost ssh connection does under systemd (SIGHUP, or SIGTERM and then SIGHUP, to all
processes of a run), and what a closed terminal does to the bridge. `^SIG`: each signal once to each process,
and to all.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator

from fault_acts import signal_each
from fault_rig import RUNNING, Case, Rig
from fault_table import main
from measure_go2_faults import Go2Rig

from deal_hw.signals import ENDING, name
from deal_hw.workflows.emulation.process import EmulatorProcess, VerbProcess

BRIDGE = "the session of the bridge ends: SIGHUP to the bridge"
IDLE = "the session of an idle bridge ends: SIGHUP to the bridge"
TARGETS = ("supervisor", "control process", "recorder", "all processes")
SENT = (
    *sorted(number for number in ENDING if number < signal.SIGRTMIN),
    int(signal.SIGRTMIN),
    int(signal.SIGRTMAX),
)


class BridgedRig(Go2Rig):
    """A Go2 on DDS; where the case is one of a bridge, a bridge to Zenoh stands before it."""

    bridge: VerbProcess | None = None

    @property
    def _bridged(self) -> bool:
        return self.case.name in (BRIDGE, IDLE)

    def emulator_options(self) -> list[str]:
        """On DDS if a bridge stands before it."""
        if not self._bridged:
            return super().emulator_options()
        wire, self.wire = self.wire, "dds"
        try:
            return super().emulator_options()
        finally:
            self.wire = wire

    @contextlib.contextmanager
    def _before(self, process: EmulatorProcess) -> Iterator[None]:
        if not self._bridged:
            with super()._before(process):
                yield
            return
        self.process = process
        self.start_bridge("tcp/127.0.0.1:0")
        self.port = self.bridge.port if self.wire == "zenoh" and self.bridge is not None else "lo"
        try:
            yield
        finally:
            if self.bridge is not None:
                self.bridge.stop()

    def start_bridge(self, listen: str) -> None:
        """Start a bridge; the one before has ended."""
        where = ("--port", "lo", "--domain", self._domain, "--listen", listen)
        self.bridge = VerbProcess("bridge", "go2", *where)
        self.bridge.start()


def hang_up_bridge(rig: Rig) -> None:
    """The bridge's terminal closes; then it is started again, as a service manager does."""
    assert isinstance(rig, BridgedRig) and rig.bridge is not None
    rig.signal(rig.bridge.pid, signal.SIGHUP)
    begun = time.monotonic()
    while os.waitid(os.P_PID, rig.bridge.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if time.monotonic() - begun > 10.0:
            rig.notes.append("the bridge did not end within 10 s")
            break
        time.sleep(0.01)
    port = rig.bridge.port
    _, printed = rig.bridge.stop()
    rig.printed.append(f"bridge: {printed.strip().splitlines()[-2:]}"[:200])
    rig.start_bridge(port)


def _each() -> Iterator[Case]:
    codes = {"supervisor": (130,), "control process": (130,), "recorder": (2,), "all processes": (130,)}
    for number in SENT:
        for target in TARGETS:
            yield Case(
                name=f"{name(number)} to {'' if target == 'all processes' else 'the '}{target}",
                act=signal_each(target, number),
                phases=(RUNNING,),
                codes=codes[target],
                seconds=20.0,
            )


CASES = (
    Case(
        name="the session ends: SIGHUP to all processes",
        act=signal_each("all processes", signal.SIGHUP),
        phases=(RUNNING,),
        codes=(130,),
        seconds=20.0,
    ),
    Case(
        name="the session ends: SIGTERM, then SIGHUP, to all processes",
        act=signal_each("all processes", signal.SIGTERM, signal.SIGHUP),
        phases=(RUNNING,),
        codes=(130,),
        seconds=20.0,
    ),
    Case(
        name=BRIDGE,
        act=hang_up_bridge,
        phases=(RUNNING,),
        codes=(2, 3),
        seconds=20.0,
        wires=("zenoh",),
    ),
    # With sport mode on: a bridge damps a robot that nobody has, and then no run on its side can begin.
    Case(
        name=IDLE,
        act=hang_up_bridge,
        phases=(RUNNING,),
        expect="goes on",
        codes=(0,),
        wires=("dds",),
        emulator=("--start", "standing"),
    ),
    *_each(),
)
TITLE = "Go2: signals to the programs that command it"
WORDS = (
    "This page has the time from a signal to a damped robot, while the robot stands.",
    "`tools/measure_go2_signals.py` measured it on the emulated robot, profile `sensor`, over real wires.",
    "An idle bridge stands beside a run on the robot's own network: its end must not disturb that run.",
    "",
)


if __name__ == "__main__":
    sys.exit(main(BridgedRig, CASES, TITLE, WORDS, __doc__))
