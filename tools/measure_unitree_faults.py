#!/usr/bin/env python3
"""Fault table of a B2, a G1 or an H1: results of faults, and the time until the robot stays damped.

python tools/measure_unitree_faults.py --robot g1 --transport dds --jobs 2 --out g1_dds.json
python tools/measure_unitree_faults.py --robot g1 --table faults.md g1_dds.json
"""

from __future__ import annotations

import abc
import argparse
import signal
import sys
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from fault_acts import after, joint_cases, kill_both, network_cases, process_cases, signal_run
from fault_rig import ANY, ARMING, CONNECTING, ENDING, RUNNING, TAKING_OVER, Case, Rig
from fault_table import main
from measure_go2_faults import Go2Rig, floor_cases
from unitree_fault_rig import REQUEST, UnitreeRig, second_controller

from deal_hw.drivers.b2 import description as b2
from deal_hw.drivers.g1 import description as g1
from deal_hw.drivers.g1.messages import G1Command, G1CommandEncoder
from deal_hw.drivers.g1.robot import G1Robot
from deal_hw.drivers.h1 import description as h1
from deal_hw.drivers.h1.joints import MODES, ORDER, SERVO_MODE
from deal_hw.drivers.unitree.command_log import DAMPING, STIFF
from deal_hw.drivers.unitree.go_messages.low_command import GoCommand, GoCommandEncoder
from deal_hw.motions.posture import PostureConfig

LINK_S = (0.5, 3.0)
JOINT_S = 9.0
"""Length of a run with a fault of its joints [s]."""
IN_MOTION_S = (3.5, 6.0)
HOLD_S = 0.9
"""A robot on a crane holds its pose for so long after the way there [s]."""


class B2Rig(Go2Rig):
    """A B2 that stands up, holds, and lies down; on a stand where the case has a motion of its own."""

    robot = "b2"
    description = b2.DESCRIPTION
    posture: ClassVar[PostureConfig] = PostureConfig(fold_s=0.5, rise_s=1.0, settle_s=0.2, lie_s=1.0)
    servo_mode: ClassVar[int] = b2.SERVO_MODE
    longest_s = 2.4

    def emulator_options(self) -> list[str]:
        """On the floor, or on a stand."""
        return [*super().emulator_options(), *(["--on-stand"] if self.case.motion else [])]

    def arguments(self) -> list[str]:
        """Hold the standing pose, or move the legs in the air."""
        if not self.case.motion:
            return super().arguments()
        motion = [*self.case.motion, "--seconds", str(self.seconds)]
        return ["collect", "b2_on_stand", *motion, *self.wire_arguments()]


class CraneRig(UnitreeRig, abc.ABC):
    """A humanoid on a crane that goes to its default pose and holds it, or plays a motion."""

    phases = (CONNECTING, TAKING_OVER, ARMING, RUNNING, ENDING)
    longest_s = 3.5

    def emulator_options(self) -> list[str]:
        """Its own controller is off, so that a run need not wait for it; in a dry run it must stay on."""
        return [*super().emulator_options(), *([] if self.case.dry else ["--controller", "off"])]

    def arguments(self) -> list[str]:
        """Hold, or play the motion; a dry run has a policy, for which no velocity is wanted."""
        what = ["collect", self.robot, *(self.case.motion or ("--motion", "hold"))]
        if self.case.dry:
            what = ["deploy", self.robot, *self.policy_arguments()[:2]]
        return [*what, "--hung-on-crane", "--seconds", str(self.seconds), *self.wire_arguments()]

    def phase_at(self, phase: str) -> tuple[str, float, float]:
        """Phases by the robot's commands; the later ones by their time after the first stiff command."""
        return {
            CONNECTING: ("start", 0.0, self.typical_s[CONNECTING]),
            TAKING_OVER: (REQUEST, 0.0, self.typical_s[TAKING_OVER]),
            ARMING: (DAMPING, 0.0, 0.02),
            RUNNING: (STIFF, 0.0, min(self.seconds, self.usual_s) - 0.1),
            ENDING: (STIFF, self.seconds - 0.12, 0.12),
        }[phase]


class G1Rig(CraneRig):
    """A G1 with 29 joints."""

    robot = "g1"
    description = g1.DESCRIPTION
    # The way to the default pose comes first.
    usual_s = g1.DESCRIPTION.limits.ease_in_s + HOLD_S
    mode_machine: ClassVar[int] = 5
    """The emulated version of 29 joints."""
    types: ClassVar[Mapping[str, str]] = G1Robot.types

    def stiff_command(self) -> bytes:
        """The default pose, with little stiffness."""
        d, count = self.description, len(self.description.actuated)
        zeros, ones = np.zeros(count), np.ones(count)
        pose = np.array(d.default_position)
        machine = self.mode_machine
        command = G1Command(
            pose, zeros, 20.0 * ones, ones, zeros, ones.astype(np.int64), mode_machine=machine
        )
        return G1CommandEncoder(d.joint_names).encode(command)


class H1Rig(CraneRig):
    """An H1."""

    robot = "h1"
    description = h1.DESCRIPTION
    usual_s = h1.DESCRIPTION.limits.ease_in_s + HOLD_S

    def stiff_command(self) -> bytes:
        """The default pose, with little stiffness."""
        count = len(self.description.actuated)
        zeros, ones = np.zeros(count), np.ones(count)
        pose = np.array(self.description.default_position)
        command = GoCommand(pose, zeros, 20.0 * ones, ones, zeros, SERVO_MODE)
        return GoCommandEncoder(ORDER.motors, MODES).encode(command)


def crane_cases(*own: Case) -> tuple[Case, ...]:
    """Return the rows of a humanoid on a crane, with its own."""
    return (
        Case(name="none", expect="goes on", codes=(0,)),
        *joint_cases(JOINT_S, IN_MOTION_S, exchanged=False),
        # A policy gets no wanted velocity in the air, so none can be made to hang there.
        *(case for case in process_cases() if case.policy != "hang"),
        Case(
            name="the terminal is closed (SIGHUP)",
            act=signal_run(signal.SIGHUP),
            phases=ANY[1:],
            codes=(130,),
        ),
        Case(
            name="both processes are killed (SIGKILL)",
            act=kill_both,
            expect="stiff",
            codes=(-9,),
            phases=(RUNNING,),
        ),
        *network_cases(LINK_S),
        Case(name="5 % of the states lost", emulator=("--drop", "0.05"), expect="goes on", codes=(0,)),
        Case(name="5 % of the states corrupt", emulator=("--corrupt", "0.05"), expect="goes on", codes=(0,)),
        Case(name="the robot falls silent", emulator=after("--freeze-after-s")),
        Case(name="its own controller returns", emulator=after("--sport-after-s")),
        Case(name="a joint reports NaN", emulator=after("--nan-after-s")),
        Case(name="a motor reports 130 degrees", emulator=after("--hot-after-s")),
        Case(name="L2+B on the remote", emulator=after("--stop-after-s"), codes=(130,)),
        *own,
        Case(name="a second controller", act=second_controller, phases=(RUNNING,), expect="contested"),
    )


ROBOTS: Mapping[str, tuple[type[Rig], str, tuple[Case, ...]]] = {
    "b2": (B2Rig, "B2", (*floor_cases(LINK_S), *joint_cases(JOINT_S, IN_MOTION_S, exchanged=False))),
    "g1": (
        G1Rig,
        "G1",
        crane_cases(
            Case(name="a motor reports an error", emulator=after("--error-after-s")),
            Case(name="the states have another mode_machine", emulator=after("--machine-after-s")),
        ),
    ),
    "h1": (H1Rig, "H1", crane_cases(Case(name="a motor is lost", emulator=after("--lost-after-s")))),
}
WORDS = (
    "This page has the time from each fault to a damped robot. `tools/measure_unitree_faults.py` measured it",
    "on the emulated robot, profile `sensor`, over a real wire. Each repetition draws a random moment of a",
    "random phase of the run. Joints fail in a multisine, in which all of them move, on the crane or on a",
    "stand; which joint's reading stands still is drawn, too. *Cut*: the emulator neither sends nor",
    "receives.",
    "In the row that expects *stiff*, both processes are dead and the robot holds its last command.",
    "",
)


def run(arguments: list[str]) -> int:
    """Run the table of the chosen robot."""
    first = argparse.ArgumentParser(add_help=False)
    first.add_argument("--robot", choices=tuple(ROBOTS), required=True)
    chosen, rest = first.parse_known_args(arguments)
    rig, name, cases = ROBOTS[chosen.robot]
    return main(rig, cases, f"{name}: from a fault to damping", WORDS, __doc__, rest)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
