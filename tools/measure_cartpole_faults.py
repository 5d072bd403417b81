#!/usr/bin/env python3
"""Fault table of the cart-pole: results of faults, and the time until its motor is off.

python tools/measure_cartpole_faults.py --jobs 2 --out cartpole.json
python tools/measure_cartpole_faults.py --transport can --jobs 2 --out cartpole_can.json
python tools/measure_cartpole_faults.py --table faults.md cartpole.json cartpole_can.json
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from fault_acts import LINK_S, after, freeze_link, kill_both, link_cases, process_cases
from fault_rig import ARMING, CONNECTING, ENDING, RUNNING, TAKING_OVER, Case, Rig
from fault_table import main

from deal_hw.drivers.cartpole.description import DESCRIPTION

SECONDS = 1.2
HOMING, ARMED, IDLE, HELD = "homing", "armed", "idle", "held"
BY_ITSELF = (
    "gone",
    "cut",
    "frozen",
    "bus-off",
    "transmit buffer full",
    "node lost",
    "belt servo restarts",
    "overload",
    "pole servo absent",
)
CAN = ("can", "odrive")
DYNAMIXEL = ("dynamixel",)
STOPPED = "stopped"
"""State of a servo that its own watchdog stopped: it holds its position with torque."""


class CartpoleRig(Rig):
    """A cart-pole that plays a chirp."""

    robot = "cartpole"
    wires = ("serial", "can", "odrive", "dynamixel")
    longest_s = 1.0
    usual_s = SECONDS
    by_program = True
    active = frozenset({ARMED})
    inactive = frozenset({IDLE, HELD, STOPPED})
    description = DESCRIPTION
    phases = (CONNECTING, TAKING_OVER, ARMING, RUNNING, ENDING)

    def emulator_options(self) -> list[str]:
        """A port that keeps its name when the cable is put back."""
        link = ["--link", str(self.folder / "port")]
        return ["--transport", self.wire, "--profile", "sensor", "--nominal", *link]

    def arguments(self) -> list[str]:
        """Play a chirp."""
        motion = ["--motion", "chirp", "--seconds", str(self.seconds)]
        return ["collect", "cartpole", "--transport", self.wire, *motion]

    def phase_at(self, phase: str) -> tuple[str, float, float]:
        """Phases by the device's modes; the later ones by their time after arming."""
        return {
            CONNECTING: ("start", 0.0, self.typical_s[CONNECTING]),
            TAKING_OVER: (HOMING, 0.0, self.typical_s[TAKING_OVER]),
            ARMING: (ARMED, 0.0, 0.02),
            RUNNING: (ARMED, 0.05, min(self.seconds, SECONDS) - 0.2),
            ENDING: (ARMED, self.seconds - 0.1, 0.15),
        }[phase]

    def changes(self, report: Mapping[str, Any]) -> list[tuple[int, str]]:
        """Modes of the device."""
        return [(ns, what) for _, ns, what in report["changes"]]

    def untouched(self, report: Mapping[str, Any]) -> str:
        """No byte came."""
        return f"{report['received_bytes']} bytes" if report["received_bytes"] else ""

    def by_itself(self, report: Mapping[str, Any]) -> int:
        """The port vanished, the wire was cut, the firmware stopped, or the bus had a fault."""
        return next((ns for ns, what in self.changes(report) if what in BY_ITSELF), -1)


CASES = (
    Case(name="none", expect="goes on", codes=(0,)),
    *process_cases(),
    Case(
        name="both processes are killed (SIGKILL); the device's watchdog stops the motor",
        act=kill_both,
        codes=(-9,),
        phases=(RUNNING,),
    ),
    *link_cases({"the cable is cut for {}": freeze_link}, cut=True),
    *(
        Case(
            name=f"the cable is pulled, and put back after {seconds:g} s",
            codes=(3, 0),
            emulator=(*after("--vanish-after-s"), "--return-after-s", f"{seconds}"),
        )
        for seconds in LINK_S
    ),
    Case(name="5 % of the frames lost", emulator=("--drop", "0.05"), expect="goes on", codes=(0,)),
    Case(name="60 % of the frames corrupt", emulator=("--corrupt", "0.6"), codes=(2, 3)),
    Case(name="the firmware hangs", emulator=after("--freeze-after-s")),
    *(
        Case(
            name=f"bus-off for {seconds:g} s",
            wires=CAN,
            emulator=(*after("--bus-off-after-s"), "--bus-off-s", f"{seconds}"),
        )
        for seconds in (0.1, 1.5)
    ),
    Case(
        name="the adapter's transmit buffer is full for 0.3 s",
        wires=CAN,
        emulator=(*after("--tx-full-after-s"), "--tx-full-s", "0.3"),
    ),
    Case(name="the node is lost, the adapter stays", emulator=after("--lost-node-after-s"), wires=CAN),
    Case(name="two devices under one node number", emulator=("--duplicate-node",), codes=(2,), wires=CAN),
    Case(name="a DBC of another version", emulator=("--dbc-version", "2"), codes=(2,), wires=CAN),
    Case(name="nobody on the bus acknowledges", emulator=("--no-acknowledge",), codes=(2,), wires=CAN),
    Case(name="the belt servo restarts", emulator=after("--servo-reboot-after-s"), wires=DYNAMIXEL),
    Case(name="the belt servo reports overload", emulator=after("--servo-overload-after-s"), wires=DYNAMIXEL),
    Case(name="the pole servo falls silent", emulator=after("--servo-absent-after-s"), wires=DYNAMIXEL),
    Case(name="two servos with one id", emulator=("--servo-duplicate-id",), codes=(2,), wires=DYNAMIXEL),
    Case(
        name="a servo in another operating mode",
        emulator=("--servo-wrong-mode",),
        codes=(2,),
        wires=DYNAMIXEL,
    ),
    Case(name="a servo with protocol 1.0", emulator=("--servo-protocol", "1"), codes=(2,), wires=DYNAMIXEL),
    Case(
        name="servos of another baud rate",
        emulator=("--servo-baud-rate", "57600"),
        codes=(2,),
        wires=DYNAMIXEL,
    ),
    Case(name="the policy answers NaN", policy="nan"),
    Case(name="the policy takes over 100 ms", policy="late"),
)
TITLE = "Cart-pole: from a fault to a motor without torque"
WORDS = (
    "This page has the time from each fault to a motor without torque. `tools/measure_cartpole_faults.py`",
    "measured it on the emulated cart-pole, profile `sensor`, over a pseudo-terminal. Each repetition draws",
    "a random moment of a random phase (connecting, homing, arming, running, ending). The device's own",
    "watchdog stops the motor 200 ms after the last command.",
    "",
)


if __name__ == "__main__":
    sys.exit(main(CartpoleRig, CASES, TITLE, WORDS, __doc__))
