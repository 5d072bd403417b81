#!/usr/bin/env python3
"""Fault table of an arm of servos: results of faults, and the time until its motors are off or brake.

python tools/measure_arm_faults.py --jobs 2 --out arm_dynamixel.json
python tools/measure_arm_faults.py --transport feetech --jobs 2 --out arm_feetech.json
python tools/measure_arm_faults.py --table faults.md arm_dynamixel.json arm_feetech.json
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from arm_rig import BUSES, arm_file
from fault_acts import (
    JOINT_FAULTS,
    LINK_S,
    after,
    freeze_link,
    joint_cases,
    kill_both,
    link_cases,
    process_cases,
    signal_run,
)
from fault_rig import ANY, ARMING, CONNECTING, ENDING, RUNNING, TAKING_OVER, Case, FileRig, Rig
from fault_table import main

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.servo_arm.emulated_families import TROUBLES
from deal_hw.drivers.servo_arm.families import FAMILIES, OFF, Family
from deal_hw.drivers.servo_bus.interface import ServoBus
from deal_hw.drivers.servo_bus.other_master import DOUBLED, FOREIGN
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import FrameError, TransportError
from deal_hw.sim.robots.robot_file import RobotFile, write_robot_file

SECONDS = 1.5
ARMED, IDLE, BRAKING, PARTLY, STOPPED = "armed", "idle", "braking", "partly", "stopped"
BY_ITSELF = ("gone", "cut", "frozen", *TROUBLES, DOUBLED, FOREIGN, *JOINT_FAULTS)
OF_ONE_SERVO = ("--servo", "--duplicate-id", "--foreign-writer")
"""Beginnings of the emulator's options for faults of one servo."""
DYNAMIXEL, FEETECH = ("dynamixel",), ("feetech",)
ARM = "two joints"
SERVOS = (1, 2)
BAUD_RATE = 1_000_000
STATE_AGE_MS = 100.0
READING_S, READING_RATE_HZ = 3.0, 50.0
"""How long another program reads all servos, and how often."""


class ArmRig(FileRig):
    """An arm of two joints that plays a chirp; a wire is the kind of its servos."""

    robot = ARM
    wires = BUSES
    longest_s = 1.2
    active = frozenset({ARMED, PARTLY})
    inactive = frozenset({IDLE, BRAKING, STOPPED})
    phases = (CONNECTING, TAKING_OVER, ARMING, RUNNING, ENDING)

    usual_s = SECONDS

    def written(self) -> RobotFile:
        """Two joints whose states come 100 times a second."""
        file = dataclasses.replace(arm_file(self.folder, self.wire), state_rate_hz=100.0)
        (self.folder / "robot.yaml").write_text(write_robot_file(file), encoding="utf-8")
        return file

    def emulator_options(self) -> list[str]:
        """A port that keeps its name when the cable is put back."""
        faults_of_servo = any(word.startswith(OF_ONE_SERVO) for word in self.case.emulator)
        faulty = ["--faulty-servo", str(self.rng.choice(SERVOS))] if faults_of_servo else []
        return ["--profile", "sensor", "--nominal", "--link", str(self.folder / "port"), *faulty]

    def arguments(self) -> list[str]:
        """Play the motion."""
        motion = self.case.motion or ("--motion", "chirp")
        return ["collect", self.robot, *motion, "--seconds", str(self.seconds)]

    def phase_at(self, phase: str) -> tuple[str, float, float]:
        """Phases by the time after the first torque; the emulated arm begins near its start pose."""
        return {
            CONNECTING: ("start", 0.0, self.typical_s[CONNECTING]),
            TAKING_OVER: (ARMED, 0.0, 0.1),
            ARMING: (ARMED, 0.1, 0.2),
            RUNNING: (ARMED, 0.4, min(self.seconds, SECONDS) - 0.8),
            ENDING: (ARMED, self.seconds - 0.1, 0.15),
        }[phase]

    def changes(self, report: Mapping[str, Any]) -> list[tuple[int, str]]:
        """States of the motors."""
        return [(ns, what) for _, ns, what in report["changes"]]

    def untouched(self, report: Mapping[str, Any]) -> str:
        """Nothing gave torque."""
        given = [what for _, what in self.changes(report) if what in self.active]
        return f"the motors got {given}" if given else ""

    def by_itself(self, report: Mapping[str, Any]) -> int:
        """The port vanished, the wire was cut, the servos hang, or one has a fault."""
        return next((ns for ns, what in self.changes(report) if what in BY_ITSELF), -1)


@contextlib.contextmanager
def other_program(rig: Rig) -> Iterator[tuple[Family, ServoBus]]:
    """Open the port as a program does that does not respect its lock, such as one with a vendor's library."""
    family = FAMILIES[rig.wire]()
    descriptor = os.open(rig.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    clock = MonotonicClock()
    with SerialTransport.from_fd(descriptor, clock, rig.port, BAUD_RATE) as transport:
        yield family, family.bus(transport, clock, BAUD_RATE, 0.008)


def take_torque(rig: Rig) -> None:
    """Another program begins as LeRobot's do: it switches the torque of a servo off."""
    with other_program(rig) as (family, bus):
        rig.fault()
        bus.post(family.torque([int(rig.rng.choice(SERVOS))], OFF))


def read_beside(rig: Rig) -> None:
    """Another program reads all servos: requests collide, and each program takes answers of the other's."""
    clock = MonotonicClock()
    with other_program(rig) as (family, bus):
        rig.fault()
        due_ns = clock.now_ns()
        for _ in range(round(READING_S * READING_RATE_HZ)):
            if rig.run.poll() is not None:
                return
            with contextlib.suppress(TransportError, FrameError):
                bus.ask(SERVOS, *family.block)
                bus.take(clock.now_ns() + 10_000_000)
            due_ns += round(1e9 / READING_RATE_HZ)
            clock.sleep_until_ns(due_ns)


LOWERED_MS = 4000.0
"""At Ctrl-C the arm goes first to where it was found, at homing's speed; then its motors are off [ms]."""
JOINT_S, IN_MOTION_S = 8.0, (2.3, 4.3)
"""Length of a run with a fault of its joints, and when that begins after the first torque [s]."""
_BOTH = "both processes are killed (SIGKILL); "
CASES = (
    Case(name="none", expect="goes on", codes=(0,)),
    *joint_cases(JOINT_S, IN_MOTION_S),
    *(
        # Servos answer only requests: without any, a dry run cannot see them.
        case
        for case in process_cases(LOWERED_MS)
        if not case.dry and not case.policy
    ),
    Case(
        name="the terminal is closed (SIGHUP)",
        act=signal_run(signal.SIGHUP),
        # Before it takes signals, a program that still imports dies of this one, and no motor was commanded.
        phases=ANY[1:],
        codes=(130,),
    ),
    Case(
        name=f"{_BOTH}the servos' watchdog stops them",
        act=kill_both,
        codes=(-9,),
        phases=(RUNNING,),
        wires=DYNAMIXEL,
    ),
    Case(
        name=f"{_BOTH}nothing stops the servos",
        expect="stiff",
        act=kill_both,
        codes=(-9,),
        phases=(RUNNING,),
        wires=FEETECH,
    ),
    *(
        # A cut of 0.1 s is as long as the oldest state that does not trip a run: some runs go on.
        dataclasses.replace(case, codes=(0, 3)) if case.from_ms <= STATE_AGE_MS else case
        for case in link_cases({"the cable is cut for {}": freeze_link}, cut=True)
    ),
    *(
        Case(
            name=f"the cable is pulled, and put back after {seconds:g} s",
            codes=(3, 0),
            emulator=(*after("--vanish-after-s"), "--return-after-s", f"{seconds}"),
            within_ms=2500.0,
            from_ms=1e3 * seconds,
        )
        for seconds in LINK_S
    ),
    Case(name="60 % of the answers corrupt", emulator=("--corrupt", "0.6"), codes=(2, 3)),
    Case(name="a servo restarts", emulator=after("--servo-reboot-after-s")),
    Case(name="a servo reports overload", emulator=after("--servo-overload-after-s")),
    Case(name="a servo is unplugged", emulator=after("--servo-absent-after-s")),
    Case(name="a second servo has its id", emulator=after("--duplicate-id-after-s"), codes=(3, 2)),
    *(
        # On the way to the start pose the run fails before it began.
        Case(
            name=f"another program writes goals {how}",
            emulator=(*after("--foreign-writer-after-s"), *options),
            codes=(3, 2),
        )
        for how, options in {
            "60 times a second": (),
            "30 times a second": ("--foreign-rate-hz", "30"),
            "60 times a second, by an adapter of its own": ("--foreign-on-line",),
        }.items()
    ),
    Case(name="another program switches a servo's torque off", act=take_torque, phases=(RUNNING,)),
    Case(
        name="another program reads the servos",
        act=read_beside,
        phases=(RUNNING,),
        codes=(3, 0),
        # Many lost answers within a second trip, and one collision may be a lost command.
        within_ms=2000.0,
    ),
)
TITLE = "Arm of servos: from a fault to motors without torque, or braking"
WORDS = (
    "This page has the time from each fault to motors that no longer follow goals.",
    "`tools/measure_arm_faults.py` measured it on an emulated arm of two joints, profile `sensor`, over a",
    "pseudo-terminal: Dynamixel servos, whose passive state is no torque, and Feetech servos, which brake.",
    "Each repetition draws a random moment of a random phase (connecting, moving to the start pose, arming,",
    "running, ending); joints and their readings fail in a multisine, in which all joints move. At Ctrl-C",
    "the arm is lowered first. A fault that comes after a run has made the motors passive leaves its exit",
    "code 0. Feetech servos have no watchdog: where both processes are killed, they hold their last goal.",
    "Which servo fails is drawn, too; an unplugged one has no supply. An empty cell was not measured.",
    "",
)


if __name__ == "__main__":
    sys.exit(main(ArmRig, CASES, TITLE, WORDS, __doc__))
