#!/usr/bin/env python3
"""Fault table of a robot of ros2_control: results of faults, and the time until it holds its pose.

python tools/measure_ros2_faults.py --transport dds --jobs 2 --out ros2_dds.json
python tools/measure_ros2_faults.py --transport zenoh --jobs 2 --out ros2_zenoh.json
python tools/measure_ros2_faults.py --table faults.md ros2_dds.json ros2_zenoh.json
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from fault_acts import (
    JOINT_FAULTS,
    JOINT_MS,
    after,
    joint_cases,
    kill_both,
    network_cases,
    process_cases,
    signal_run,
)
from fault_rig import ANY, ARMING, CONNECTING, ENDING, RUNNING, TAKING_OVER, Case, FileRig, Rig
from fault_table import main
from ros2_rig import ros2_file

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.ros2.command_log import AGAIN, FIRST, HOLDS, MOVES
from deal_hw.drivers.ros2.connect import make_link
from deal_hw.drivers.ros2.messages import encode_positions
from deal_hw.drivers.ros2.topics import topics_of
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.transport import Message
from deal_hw.workflows.emulation.topics import free_port

ROBOT = "two joints"
SECONDS = 1.5
_DOMAIN = 61
_START_S = 0.95
"""Time from the first command until the motion begins: each joint is moved a little, then all settle [s]."""
FOREIGN = (0.111, -0.222)
"""Targets of the other program, which a run never sends [rad]."""
HOMING_RAD_S = 0.5
"""Fastest set-point of a run on its way to the start pose [rad/s]."""
OVERSHOOT = 1.5
"""A joint behind such a set-point may be so much faster for a moment."""
HELD_RAD = 0.3
"""The pose that is held is at most this far from the measured one [rad]."""
JOINT_S = 8.0
"""Length of a run with a fault of its joints or its controller [s]."""
IN_MOTION_S = (2.3, 4.3)
BACK = ("sound", "controller active")
"""Events at which drives, joints or the controller are as before."""
BY_ITSELF = (*JOINT_FAULTS, "controller off", "frozen")


class Ros2Rig(FileRig):
    """A robot of two joints behind a forward position controller, which plays a chirp or a multisine."""

    robot = ROBOT
    phases = (CONNECTING, TAKING_OVER, ARMING, RUNNING, ENDING)
    wires = ("dds", "zenoh")
    longest_s = 2.2
    active = frozenset({MOVES})
    inactive = frozenset({HOLDS})
    over = frozenset(BACK)
    again = ("--motion", "hold", "--seconds", "0.5")

    usual_s = SECONDS
    by_program = True

    def written(self) -> RobotFile:
        """Two joints in a domain that no real robot uses."""
        return ros2_file(self.folder, domain=_DOMAIN + self.slot)

    def emulator_options(self) -> list[str]:
        """Listen at a free port, or in a domain that no real robot uses."""
        port = free_port("tcp/127.0.0.1:0") if self.wire == "zenoh" else "lo"
        return ["--transport", self.wire, "--port", port, "--profile", "sensor", "--nominal"]

    def arguments(self) -> list[str]:
        """Play the motion."""
        motion = self.case.motion or ("--motion", "chirp")
        return ["collect", self.robot, "--transport", self.wire, *motion, "--seconds", str(self.seconds)]

    def phase_at(self, phase: str) -> tuple[str, float, float]:
        """Phases by the time after the first command."""
        return {
            CONNECTING: ("start", 0.0, self.typical_s[CONNECTING]),
            TAKING_OVER: (FIRST, 0.0, 0.7),
            ARMING: (FIRST, 0.7, _START_S - 0.7),
            RUNNING: (FIRST, _START_S + 0.05, min(self.seconds, SECONDS) - 0.3),
            ENDING: (FIRST, _START_S + self.seconds - 0.1, 0.2),
        }[phase]

    def changes(self, report: Mapping[str, Any]) -> list[tuple[int, str]]:
        """Targets of a run that moved, and those that it sent again and again: the robot holds.

        Without those of another program; the report has the newest commands.
        """
        own = [(ns, target) for ns, target, _ in report["commands"] if tuple(target) != FOREIGN]
        found: list[tuple[int, str]] = []
        for (before_ns, before), (ns, target) in pairwise(own):
            kind = HOLDS if target == before else MOVES
            if not found or found[-1][1] != kind:
                found.append((before_ns if kind == HOLDS else ns, kind))
        return found

    def untouched(self, report: Mapping[str, Any]) -> str:
        """No command came."""
        return f"{report['commands_accepted']} commands" if report["commands_accepted"] else ""

    def by_itself(self, report: Mapping[str, Any]) -> int:
        """The controller or the joints failed."""
        return next((ns for _, ns, what in report["changes"] if what in BY_ITSELF), -1)

    def figures(self, report: Mapping[str, Any]) -> dict[str, float]:
        """How far the held pose was from the joints; speeds after the return, and of the next run."""
        found = {}
        holds = [ns for ns, active in self.states(report) if not active]
        away = {ns: distance for ns, _, distance in report["commands"]}
        if self.case.expect == "passive" and holds and self.fault_ns > 0:
            found["distance of the held pose [rad]"] = away[holds[-1]]
            if away[holds[-1]] > HELD_RAD:
                self.notes.append(f"it holds a pose {away[holds[-1]]:.2f} rad away")
        for ns, what, speed in ((ns, what, speed) for _, ns, what, speed in report["fastest_after"]):
            if what in BACK:
                found["fastest joint in 1 s after the return [rad/s]"] = speed
            elif what == AGAIN and self.end_ns is not None and ns > self.end_ns:
                found["fastest joint in the first second of the next run [rad/s]"] = speed
                if speed > OVERSHOOT * HOMING_RAD_S:
                    self.notes.append(f"the next run begins at {speed:.2f} rad/s")
            elif what == FIRST and self.case.again:
                found["fastest joint in the first second of the run itself [rad/s]"] = speed
        return found


def other_publisher(rate_hz: float) -> Callable[[Rig], None]:
    """Return an act: another program publishes to the controller, so often; 0: it only opens the topic."""

    def act(rig: Rig) -> None:
        assert isinstance(rig, Ros2Rig) and rig.file.ros2 is not None
        clock, commands = MonotonicClock(), topics_of(rig.file.ros2).commands
        link = make_link(rig.file.ros2, rig.wire, rig.port, clock)
        link.declare(publish=[commands])
        joints = rig.description.actuated
        payload = encode_positions(np.array([FOREIGN[joints.index(name)] for name in ("elbow", "shoulder")]))
        with link:
            if not rate_hz:
                rig.fault()
                rig.until(lambda: False)
                return
            # It is found by its presence, too: the fault is its first message, at once.
            rig.fault()
            while rig.run.poll() is None:
                link.send(Message(commands, payload, clock.now_ns()))
                time.sleep(1.0 / rate_hz)

    return act


def _controller_cases() -> Iterator[Case]:
    """Yield the rows of a controller that is off for a while in the middle of a motion."""
    off = after("--controller-off-after-s")
    for who, more, within_ms in (("nobody", ("--silent-manager",), JOINT_MS), ("the manager", (), 600.0)):
        yield Case(
            name=f"the controller is off for 2 s, and {who} says so",
            emulator=(*off, *more),
            motion=("--excite", "multisine"),
            seconds=JOINT_S,
            moments_s=IN_MOTION_S,
            within_ms=within_ms,
            again=True,
        )


LINK_S = (0.5, 3.0)
CASES = (
    Case(name="none", expect="goes on", codes=(0,)),
    *joint_cases(JOINT_S, IN_MOTION_S, again=True),
    *_controller_cases(),
    *process_cases(),
    Case(name="the terminal is closed (SIGHUP)", act=signal_run(1), phases=ANY[1:], codes=(130,)),  # type: ignore[arg-type]
    Case(
        name="both processes are killed (SIGKILL): the controller holds the last target",
        act=kill_both,
        expect="stiff",
        codes=(-9,),
        phases=(RUNNING,),
    ),
    # On the way to the start pose a run fails before it began.
    *(dataclasses.replace(case, codes=(0, 3, 2)) for case in network_cases(LINK_S)),
    Case(name="states cease: the controller_manager stands still", emulator=after("--freeze-after-s")),
    Case(
        name="another program opens the topic of the commands",
        act=other_publisher(0.0),
        phases=(RUNNING,),
        seconds=8.0,
    ),
    Case(
        name="another program publishes commands 100 times a second",
        act=other_publisher(100.0),
        phases=(RUNNING,),
        expect="contested",
        seconds=8.0,
    ),
)
TITLE = "Robot of ros2_control: from a fault to a pose that is held"
WORDS = (
    "This page has the time from each fault until the robot holds the pose in which it was measured.",
    "`tools/measure_ros2_faults.py` measured it on the emulated robot of two joints, profile `sensor`, over",
    "DDS and over Zenoh (as rmw_zenoh). Each repetition draws a random moment of a random phase (connecting,",
    "the way to the start pose, arming, running, ending). ros2_control has no message that switches torque",
    "off: *passive* means that the last target was sent again and again, and that no other follows. Drives,",
    "joints, readings and the controller fail in a multisine, in which all joints move. In the row that",
    "expects *stiff*, both processes are dead, and the controller holds the last target for ever.",
    "",
    "**Not every run of an inactive controller trips, if nobody says that it is inactive.** Where the",
    "joints come to rest in the middle of a small, quick motion, their set-points pass to and fro, and no",
    "push lasts. So the run goes on. When the controller comes back after 2 s, the joints run to the moving",
    "set-point at 1.9 to 2.0 rad/s, which is as fast as the motion itself. So went 3 of 40 runs, and none of",
    "80 with limp drives or held joints. After a trip the joints stay below 0.05 rad/s when drives or",
    "controller come back.",
    "",
    "The set-points of the next run begin at 0.5 rad/s at most. Its joints move at 0.60 to 0.73 rad/s, about",
    "as on the first way to the start pose (0.61 to 0.63 rad/s): the drives swing about their set-points.",
    "",
)


if __name__ == "__main__":
    sys.exit(main(Ros2Rig, CASES, TITLE, WORDS, __doc__))
