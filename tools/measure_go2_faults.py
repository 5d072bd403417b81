#!/usr/bin/env python3
"""Fault table of the Go2: results of faults, and the time until the robot stays damped.

python tools/measure_go2_faults.py --transport zenoh --jobs 2 --out zenoh.json
python tools/measure_go2_faults.py --table faults.md zenoh.json dds.json
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Mapping
from typing import Any

from fault_acts import (
    after,
    freeze_link,
    kill_both,
    link_cases,
    process_cases,
    reset_link,
    second_run,
    signal_control,
)
from fault_rig import ANY, ARMING, CONNECTING, ENDING, LYING_DOWN, RISING, RUNNING, TAKING_OVER, Case, Rig
from fault_table import main

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.transports.topics import LOW_COMMAND
from deal_hw.drivers.unitree.command_log import DAMPING, OFF, STIFF
from deal_hw.motions.posture import PostureConfig
from deal_hw.robots.connect import make_topic_transport
from deal_hw.transport import Message, WireOptions

POSTURE = PostureConfig(fold_s=0.3, rise_s=0.6, settle_s=0.2, lie_s=0.6)
SECONDS = 0.9
_DOMAIN = 91
REQUEST = "motion_switcher"


class Go2Rig(Rig):
    """A Go2 that stands up, holds, and lies down."""

    robot = "go2"
    description = DRIVER
    phases = ANY
    wires = ("zenoh", "dds")
    longest_s = 1.5
    active = frozenset({STIFF})
    inactive = frozenset({DAMPING, OFF})

    def emulator_options(self) -> list[str]:
        """Listen at a free port, or in a domain that no real robot uses."""
        standing = "standing" in self.case.emulator or self.case.dry
        sport = [] if standing else ["--sport", "off"]
        if self.case.dry:
            sport += ["--start", "standing"]
        where = (
            ["--port", "tcp/127.0.0.1:0"]
            if self.wire == "zenoh"
            else ["--port", "lo", "--domain", self._domain]
        )
        return ["--transport", self.wire, *where, "--profile", "sensor", "--nominal", *sport]

    @property
    def _domain(self) -> str:
        return str(_DOMAIN + self.slot)

    def arguments(self) -> list[str]:
        """Hold the standing pose, or walk with a faulty policy."""
        verb, what = "collect", ["--motion", "hold"]
        if self.case.policy or self.case.dry:
            verb, what = "deploy", self.policy_arguments()
        posture = [
            word
            for name in ("fold_s", "rise_s", "settle_s", "lie_s")
            for word in (f"--{name.replace('_', '-')}", str(getattr(POSTURE, name)))
        ]
        wire = ["--transport", self.wire, *(["--domain", self._domain] if self.wire == "dds" else [])]
        return [verb, "go2", *what, *posture, "--seconds", str(self._seconds), *wire]

    @property
    def _seconds(self) -> float:
        return self.case.seconds or SECONDS

    def phase_at(self, phase: str) -> tuple[str, float, float]:
        """Phases by the robot's commands; the later ones by their time after the first stiff command."""
        before_s = POSTURE.before_s
        total_s = before_s + self._seconds + POSTURE.after_s(slows=False)
        return {
            CONNECTING: ("start", 0.0, self.typical_s[CONNECTING]),
            TAKING_OVER: (REQUEST, 0.0, self.typical_s[TAKING_OVER]),
            ARMING: (DAMPING, 0.0, 0.02),
            RISING: (STIFF, 0.0, before_s),
            RUNNING: (STIFF, before_s, min(self._seconds, SECONDS)),
            LYING_DOWN: (STIFF, total_s - POSTURE.lie_s, POSTURE.lie_s - 0.1),
            ENDING: (STIFF, total_s - 0.12, 0.12),
        }[phase]

    def changes(self, report: Mapping[str, Any]) -> list[tuple[int, str]]:
        """Kinds of commands that the robot received."""
        return [(ns, kind) for _, ns, kind in report["commands"]["changes"]]

    def untouched(self, report: Mapping[str, Any]) -> str:
        """Neither commands nor requests to its services."""
        commands, requests = report["commands"]["accepted"], len(report["commands"]["requests"])
        left = report["sport"] == "normal"
        if commands or requests or not left:
            return f"{commands} commands, {requests} requests, sport mode {report['sport'] or 'released'}"
        return ""

    def by_itself(self, report: Mapping[str, Any]) -> int:
        """The emulator's own faults."""
        faults = report["commands"]["faults"]
        return int(faults[0]["begin_host_ns"]) if faults else -1


def second_controller(rig: Rig) -> None:
    """Another program sends stiff commands, too."""
    options = WireOptions(domain=_DOMAIN + rig.slot) if rig.wire == "dds" else WireOptions()
    transport = make_topic_transport(rig.wire, rig.port, MonotonicClock(), options)
    transport.declare(publish=[LOW_COMMAND])
    pose = list(DRIVER.rest_position)
    zeros = [0.0] * 12
    payload = LowCommandEncoder().encode(LowCommand(pose, zeros, [20.0] * 12, [1.0] * 12, zeros))  # type: ignore[arg-type]
    with transport:
        time.sleep(0.5)
        rig.fault()
        for _ in range(25):
            transport.send(Message(LOW_COMMAND, payload, MonotonicClock().now_ns()))
            time.sleep(0.01)


WIRE = after("--wire-after-s")
CASES = (
    Case(name="none", expect="goes on", codes=(0,)),
    *process_cases(),
    Case(
        name="both processes are killed (SIGKILL)",
        act=kill_both,
        expect="stiff",
        codes=(-9,),
        phases=(RISING, RUNNING, LYING_DOWN),
    ),
    Case(
        name="a second run by another address, as from another computer",
        act=second_run(elsewhere=True),
        codes=(130,),
        phases=(CONNECTING, TAKING_OVER, RISING, RUNNING),
        seconds=60.0,
        wires=("zenoh",),
    ),
    Case(
        name="killed while taking over from sport mode, which stands",
        act=signal_control(signal.SIGKILL),
        phases=(TAKING_OVER,),
        emulator=("--start", "standing"),
        expect="unhomed",
        codes=(2,),
    ),
    *(
        case
        for wire, kinds, cut in (
            (
                "zenoh",
                {"the link freezes for {}": freeze_link, "the link is reset for {}": reset_link},
                False,
            ),
            ("dds", {"the link is cut for {}": freeze_link}, True),
        )
        for case in link_cases(kinds, cut, (wire,))
    ),
    Case(name="5 % of the states lost", emulator=(*WIRE, "--drop", "0.05"), expect="goes on", codes=(0,)),
    Case(
        name="5 % of the states twice", emulator=(*WIRE, "--duplicate", "0.05"), expect="goes on", codes=(0,)
    ),
    Case(
        name="5 % of the states after their successor",
        emulator=(*WIRE, "--reorder", "0.05"),
        expect="goes on",
        codes=(0,),
    ),
    Case(
        name="5 % of the states corrupt", emulator=(*WIRE, "--corrupt", "0.05"), expect="goes on", codes=(0,)
    ),
    Case(name="60 % of the states corrupt", emulator=(*WIRE, "--corrupt", "0.6")),
    Case(name="the robot falls silent", emulator=after("--freeze-after-s")),
    Case(name="the same state again and again", emulator=after("--stale-after-s")),
    Case(name="a motor is lost", emulator=after("--lost-after-s")),
    Case(name="sport mode returns", emulator=after("--sport-after-s")),
    Case(name="the battery is nearly empty", emulator=after("--battery-after-s")),
    Case(name="a joint reports NaN", emulator=after("--nan-after-s")),
    Case(name="a motor reports 95 degrees", emulator=after("--hot-after-s")),
    Case(name="L2+B on the remote", emulator=after("--stop-after-s"), codes=(130,)),
    # If it lies or stands on all feet at the push, it may stay up, and the run goes on.
    Case(name="a hard push to its side", emulator=(*after("--push-after-s"), "--push", "60"), codes=(0, 3)),
    Case(name="the policy answers NaN", policy="nan"),
    Case(name="the policy takes over 100 ms", policy="late"),
    Case(name="a second controller", act=second_controller, phases=(RISING, RUNNING), expect="contested"),
)
TITLE = "Go2: from a fault to damping"
WORDS = (
    "This page has the time from each fault to a damped robot. `tools/measure_go2_faults.py` measured it on",
    "the emulated robot, profile `sensor`, over real wires. Each repetition draws a random moment of a",
    "random phase (connecting, taking over, arming, standing up, running, lying down, ending). *Cut*: the",
    "emulator neither sends nor receives. *Freezes*, *reset*: a proxy freezes or resets the TCP connection.",
    "",
    "In the row that expects *stiff*, both processes are dead and the Go2 holds its last command. Only a",
    "program on the robot's side could help. The same holds while a link is away. Keep the remote in your",
    "hand.",
    "",
)


if __name__ == "__main__":
    sys.exit(main(Go2Rig, CASES, TITLE, WORDS, __doc__))
