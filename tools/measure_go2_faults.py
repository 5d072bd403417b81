#!/usr/bin/env python3
"""Fault table of the Go2: results of faults, and the time until the robot stays damped.

python tools/measure_go2_faults.py --transport zenoh --jobs 2 --out zenoh.json
python tools/measure_go2_faults.py --table faults.md zenoh.json dds.json
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from fault_acts import LINK_S, after, kill_both, network_cases, process_cases, second_run, signal_control
from fault_rig import ANY, ARMING, CONNECTING, ENDING, LYING_DOWN, RISING, RUNNING, TAKING_OVER, Case
from fault_table import main
from unitree_fault_rig import REQUEST, UnitreeRig, second_controller

from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.unitree.command_log import DAMPING, STIFF
from deal_hw.drivers.unitree.motor_command import MODE_SERVO
from deal_hw.motions.posture import PostureConfig


class Go2Rig(UnitreeRig):
    """A Go2 that stands up, holds, and lies down."""

    robot = "go2"
    description = DRIVER
    posture: ClassVar[PostureConfig] = PostureConfig(fold_s=0.3, rise_s=0.6, settle_s=0.2, lie_s=0.6)
    servo_mode: ClassVar[int] = MODE_SERVO
    phases = ANY
    longest_s = 1.5
    usual_s = 0.9

    def emulator_options(self) -> list[str]:
        """It lies, its sport mode off, or stands in it."""
        standing = "standing" in self.case.emulator or self.case.dry
        sport = [] if standing else ["--sport", "off"]
        if self.case.dry:
            sport += ["--start", "standing"]
        return [*super().emulator_options(), *sport]

    def arguments(self) -> list[str]:
        """Hold the standing pose, or walk with a faulty policy."""
        verb, what = "collect", ["--motion", "hold"]
        if self.case.policy or self.case.dry:
            verb, what = "deploy", self.policy_arguments()
        posture = [
            word
            for name in ("fold_s", "rise_s", "settle_s", "lie_s")
            for word in (f"--{name.replace('_', '-')}", str(getattr(self.posture, name)))
        ]
        return [verb, self.robot, *what, *posture, "--seconds", str(self.seconds), *self.wire_arguments()]

    def phase_at(self, phase: str) -> tuple[str, float, float]:
        """Phases by the robot's commands; the later ones by their time after the first stiff command."""
        before_s = self.posture.before_s
        total_s = before_s + self.seconds + self.posture.after_s(slows=False)
        return {
            CONNECTING: ("start", 0.0, self.typical_s[CONNECTING]),
            TAKING_OVER: (REQUEST, 0.0, self.typical_s[TAKING_OVER]),
            ARMING: (DAMPING, 0.0, 0.02),
            RISING: (STIFF, 0.0, before_s),
            RUNNING: (STIFF, before_s, min(self.seconds, self.usual_s)),
            LYING_DOWN: (STIFF, total_s - self.posture.lie_s, self.posture.lie_s - 0.1),
            ENDING: (STIFF, total_s - 0.12, 0.12),
        }[phase]

    def stiff_command(self) -> bytes:
        """The pose at rest."""
        zeros = [0.0] * 12
        modes = np.full(12, self.servo_mode)
        pose = list(self.description.rest_position)
        command = LowCommand(pose, zeros, [20.0] * 12, [1.0] * 12, zeros, modes)  # type: ignore[arg-type]
        return LowCommandEncoder(self.servo_mode).encode(command)


WIRE = after("--wire-after-s")


def floor_cases(lengths_s: Sequence[float] = LINK_S) -> tuple[Case, ...]:
    """Return the rows of a robot that stands up on the floor; its link is lost for so long [s]."""
    return (
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
        *network_cases(lengths_s),
        Case(name="5 % of the states lost", emulator=(*WIRE, "--drop", "0.05"), expect="goes on", codes=(0,)),
        Case(
            name="5 % of the states twice",
            emulator=(*WIRE, "--duplicate", "0.05"),
            expect="goes on",
            codes=(0,),
        ),
        Case(
            name="5 % of the states after their successor",
            emulator=(*WIRE, "--reorder", "0.05"),
            expect="goes on",
            codes=(0,),
        ),
        Case(
            name="5 % of the states corrupt",
            emulator=(*WIRE, "--corrupt", "0.05"),
            expect="goes on",
            codes=(0,),
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
        Case(
            name="a hard push to its side", emulator=(*after("--push-after-s"), "--push", "60"), codes=(0, 3)
        ),
        Case(name="the policy answers NaN", policy="nan"),
        Case(name="the policy takes over 100 ms", policy="late"),
        Case(name="a second controller", act=second_controller, phases=(RISING, RUNNING), expect="contested"),
    )


CASES = floor_cases()
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
