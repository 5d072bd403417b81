#!/usr/bin/env python3
"""Signals to a standing Go2's programs: the time until it stays damped, and whether the dataset is whole.

python tools/measure_go2_signals.py --only 'session|bridge' --transport zenoh --out zenoh.json
python tools/measure_go2_signals.py --only '^SIG' --repetitions 1 --out each.json
python tools/measure_go2_signals.py --table signals.md zenoh.json dds.json each.json

`session`: what a lost ssh connection does under systemd (SIGHUP, or SIGTERM and then SIGHUP, to all
processes of a run). `bridge`: the bridge before the robot ends by one signal or by two, is killed and started
again, or is stopped for a while. `^SIG`: each signal once to each process, and to all.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from fault_acts import signal_each
from fault_rig import RUNNING, Case, Rig
from fault_table import main
from measure_go2_faults import Go2Rig

from deal_hw.signals import ENDING, name
from deal_hw.workflows.emulation.process import EmulatorProcess, VerbProcess

IDLE = "the session of an idle bridge ends: SIGHUP to the bridge"
WHO = re.compile(r"damping|controlled|idle|the bridge ended")
"""Lines of the bridge on who has the robot."""
RESTART_MS = 5000.0
"""Longest time until a bridge that is started again damps the robot: it starts Python and joins DDS [ms]."""
_BETWEEN_S = 0.02
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
        return "bridge" in self.case.name

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
            self.end_bridge()

    def end_bridge(self) -> None:
        """Stop the bridge, or take the end of one that has ended; keep what it said of the robot."""
        if self.bridge is not None:
            _, printed = self.bridge.stop()
            self.printed += [f"bridge: {line[:200]}" for line in printed.splitlines() if WHO.match(line)]

    def start_bridge(self, listen: str) -> None:
        """Start a bridge; the one before has ended."""
        where = ("--port", "lo", "--domain", self.domain, "--listen", listen)
        self.bridge = VerbProcess("bridge", "go2", *where)
        self.bridge.start()


def end_bridge(*numbers: signal.Signals) -> Callable[[Rig], None]:
    """Return an act: signals to the bridge, one after the other; then it is started again, as by systemd."""

    def act(rig: Rig) -> None:
        assert isinstance(rig, BridgedRig) and rig.bridge is not None
        for number in numbers:
            rig.signal(rig.bridge.pid, number)
            time.sleep(_BETWEEN_S)
        begun = time.monotonic()
        while os.waitid(os.P_PID, rig.bridge.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            if time.monotonic() - begun > 10.0:
                rig.notes.append("the bridge did not end within 10 s")
                break
            time.sleep(0.01)
        port = rig.bridge.port
        rig.end_bridge()
        rig.start_bridge(port)

    return act


def stop_bridge(seconds: float) -> Callable[[Rig], None]:
    """Return an act: the bridge is stopped for a time, and goes on [s]."""

    def act(rig: Rig) -> None:
        assert isinstance(rig, BridgedRig) and rig.bridge is not None
        rig.signal(rig.bridge.pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(rig.bridge.pid, signal.SIGCONT)

    return act


def _of_the_bridge() -> Iterator[Case]:
    common: dict[str, Any] = {"phases": (RUNNING,), "codes": (2, 3), "seconds": 20.0, "wires": ("zenoh",)}
    term_hup = end_bridge(signal.SIGTERM, signal.SIGHUP)
    for name_, act in {
        "the session of the bridge ends: SIGHUP to the bridge": end_bridge(signal.SIGHUP),
        "the session of the bridge ends: SIGTERM, then SIGHUP, to the bridge": term_hup,
        "Ctrl-C twice to the bridge": end_bridge(signal.SIGINT, signal.SIGINT),
    }.items():
        yield Case(name=name_, act=act, **common)
    yield Case(
        name="the bridge is killed (SIGKILL) and started again at once",
        act=end_bridge(signal.SIGKILL),
        within_ms=RESTART_MS,
        **common,
    )
    for seconds in (0.2, 3.0):
        yield Case(
            name=f"the bridge is stopped for {seconds:g} s (SIGSTOP, then SIGCONT)",
            act=stop_bridge(seconds),
            from_ms=1e3 * seconds,
            **common,
        )


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
    *_of_the_bridge(),
    # With sport mode on: a bridge damps a robot that nobody has, and then no run on its side can begin.
    Case(
        name=IDLE,
        act=end_bridge(signal.SIGHUP),
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
    "In the rows of a bridge the run commands the robot through it, so each command that arrives passed the",
    "bridge or is the bridge's own. A bridge that ends damps the robot itself. While it is dead or stopped,",
    "the robot holds its last command; the time of a killed one counts from the kill, that of a stopped one",
    "from the moment at which it goes on. An idle bridge stands beside a run on the robot's own network: its",
    "end must not disturb that run.",
    "",
)


if __name__ == "__main__":
    sys.exit(main(BridgedRig, CASES, TITLE, WORDS, __doc__))
