#!/usr/bin/env python3
"""Timing of the cart-pole's wires: from a command to the state that names it, and how regular the cycles are.

python tools/measure_cartpole_wires.py --transports serial can odrive --seconds 120 --out wires.json
python tools/measure_cartpole_wires.py --table wires.json

Each row has an emulator in a separate process and a control loop here. The loop sends one command for each
cycle and reads all states. Round trip: from sending a command until the first state that names it has been
read [ms]. The device ticks once a millisecond and sends a state every 5 ms, so 1 to 6 ms are the device's
own. Cycle: lateness of its start [ms]. Wire: worst transit of a command and a state at the bit rate [ms]. Add
it, because the emulators' wires take no time. Only the emulated Dynamixel servos include it.
"""

from __future__ import annotations

import sys
from typing import Any

from measuring import Rows, markdown, parser, read_rows, spread

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.realtime import priority
from deal_hw.errors import TransportTimeoutError
from deal_hw.robots.connect import make_robot
from deal_hw.testing.robot_suite import default_command
from deal_hw.workflows.emulation.process import EmulatorProcess

WIRE_MS = {"serial": (0.28, 0.45), "can": (0.81, 1.35), "odrive": (1.0, 1.08), "dynamixel": (0.27, 1.76)}
"""Command and state: 28 and 45 bytes at 1 Mbaud; 3 and 5 frames of 135 bits at 500 kbit/s; for the ODrive
95 + 3 * 135 and 4 * 135 bits; for servos 27 bytes, and 16 + 160 of question and answer, at 1 Mbaud."""
HALF_WAY_M = 0.02


def measure(transport: str, rate_hz: int, seconds: float) -> dict[str, Any]:
    """Run one row.

    Args:
        transport: The wire.
        rate_hz: Commands a second.
        seconds: Duration [s].
    """
    clock = MonotonicClock()
    trips: list[float] = []
    late: list[float] = []
    open_at: dict[int, int] = {}
    with EmulatorProcess("cartpole", "--transport", transport, "--profile", "ideal", "--nominal") as emulator:
        robot = make_robot("cartpole", transport, emulator.port, clock)
        with robot, priority(50, children=True):
            robot.home(20.0)
            robot.arm(2.0)
            errors = robot.transport_errors
            period_ns = round(1e9 / rate_hz)
            begin_ns = clock.now_ns() + period_ns
            for cycle in range(round(seconds * rate_hz)):
                deadline_ns = begin_ns + cycle * period_ns
                while (left_ns := deadline_ns - clock.now_ns()) > 0:
                    try:
                        state = robot.read_state(left_ns / 1e9)
                    except TransportTimeoutError:
                        continue
                    if sent_ns := open_at.pop(state.command_sequence, 0):
                        trips.append((clock.now_ns() - sent_ns) / 1e6)
                late.append((clock.now_ns() - deadline_ns) / 1e6)
                command = default_command(robot, HALF_WAY_M * ((cycle * period_ns // 10**9) % 2))
                now_ns = clock.now_ns()
                robot.send_command(command)
                open_at[robot.last_sequence] = now_ns
            robot.passive()
            errors = robot.transport_errors - errors
        out, printed = emulator.stop()
    return {
        "transport": transport,
        "rate_hz": rate_hz,
        "seconds": seconds,
        "commands": len(late),
        "named": len(trips),
        "round_trip_ms": spread(trips),
        "late_ms": spread(late),
        "transport_errors": errors,
        "wire_ms": WIRE_MS.get(transport),
        "emulator": (out + printed).strip().splitlines()[-1],
    }


HEADS = (
    "wire",
    "commands a second",
    "seconds",
    "round trip p50 / p99 / max [ms]",
    "cycle late p50 / p99 / max [ms]",
    "command, state on the wire [ms]",
    "transport errors",
)


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as Markdown."""
    lines = []
    for row in rows:
        trip, late = (
            " / ".join(f"{row[name][k]:.2f}" for k in ("p50", "p99", "max"))
            for name in ("round_trip_ms", "late_ms")
        )
        wire = ", ".join(f"{value:.2f}" for value in row["wire_ms"] or ())
        first = (row["transport"], row["rate_hz"], f"{row['seconds']:g}")
        lines.append((*first, trip, late, wire, row["transport_errors"]))
    return markdown(HEADS, lines)


def main() -> int:
    """Measure the rows and print them as a table."""
    options = parser(__doc__, table=True)
    options.add_argument("--transports", nargs="+", default=["serial", "can", "odrive", "dynamixel"])
    options.add_argument("--rates", nargs="+", type=int, default=[50, 200])
    options.add_argument("--seconds", type=float, default=120.0)
    given = options.parse_args()
    if given.table is not None:
        print(table(read_rows(given.table)))
        return 0
    rows = Rows(__file__, given.out)
    for transport in given.transports:
        for rate_hz in given.rates:
            row = measure(transport, rate_hz, given.seconds)
            rows.add(row, table([row]).splitlines()[-1], table=True)
    print(table(rows.rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
