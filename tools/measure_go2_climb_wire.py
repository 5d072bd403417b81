"""Let an emulated Go2 climb over its wire, in real time: the whole of `deal-hw deploy`, DDS and Zenoh.

    python tools/measure_go2_climb_wire.py --policy climb --height 0.1 --seeds 1000-1004 --out climb_wire.json
    python tools/measure_go2_climb_wire.py --wires virtual --height 0.15 0.2 --seeds 1000-1009 --out FILE

The emulator is a process of its own, with hidden gains, friction, payload and latency, and with a platform
1 m ahead. `deal-hw deploy` stands the robot up, walks it ahead at 0.6 m/s for 6 s, and lays it down. A try
succeeds if the run ends as planned with the base at least 0.5 m beyond the edge; the emulator's own track
says where it is. A row is one robot, height and wire. Ends are those of the run: `finished`, or what tripped.

`virtual` is the same driver, bytes, safety filter and loop in virtual time, in one process. Its rows also say
in how many cycles each limit of the filter changed the command.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import tempfile
from pathlib import Path

from measuring import Row, Rows, add_seeds, parser

from deal_hw.cli.demo_go2 import CLIMB_M_S, CLIMB_S, PORTS
from deal_hw.control.process.channel import Outcome
from deal_hw.drivers.go2.emulator.truth import draw_truth
from deal_hw.motions.velocity import FixedVelocity
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.sim.legged.terrain import Terrain
from deal_hw.workflows.emulation.go2 import read_track
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.emulation.virtual_go2 import walk
from deal_hw.workflows.shipped import policy_file

EDGE_M, BEYOND_M = 1.0, 0.5
LONGEST_S = 120.0
PROFILE, VIRTUAL = "realistic", "virtual"


def measure(policy: str, wire: str, height: float, seed: int, *, blind: bool) -> Row:
    """Return the row of one try.

    Args:
        policy: A policy's file, or its name.
        wire: ``dds`` or ``zenoh``.
        height: Of the platform [m].
        seed: Of the hidden robot.
        blind: Whether the robot is told nothing.
    """
    row: Row = {"wire": wire, "height_m": height, "seed": seed, "told": not blind, "error": ""}
    with tempfile.TemporaryDirectory() as place:
        track = Path(place) / "track.csv"
        with EmulatorProcess(
            "go2",
            *("--transport", wire, "--port", PORTS[wire], "--seed", str(seed), "--profile", PROFILE),
            *("--terrain", f"box:{height:g},{EDGE_M:g}", "--track-to", str(track)),
        ) as emulator:
            done = subprocess.run(
                [
                    *(sys.executable, "-m", "deal_hw", "deploy", "go2", "--transport", wire),
                    *("--port", emulator.port, "--policy", policy, "--seconds", f"{CLIMB_S:g}"),
                    *("--velocity", f"{CLIMB_M_S:g},0,0", "--out", str(Path(place) / "run")),
                    *(() if blind else ("--obstacle", f"{EDGE_M:g},{height:g}")),
                ],
                input="y\n",
                capture_output=True,
                text=True,
                timeout=LONGEST_S,
            )
        lines = done.stdout.splitlines()
        ends = [line for line in lines if line.startswith(("finished", "tripped", "stopped", "failed"))]
        furthest = float(read_track(track).place[:, 0].max())
    row |= {
        "exit_code": done.returncode,
        "end": ends[-1] if ends else "",
        "furthest_m": round(furthest, 3),
        "climbed": done.returncode == 0 and furthest >= EDGE_M + BEYOND_M,
    }
    if not ends:
        row["error"] = done.stderr.strip()[-500:] or "deploy printed no end"
    return row


def measure_virtual(policy: str, height: float, seed: int, *, blind: bool) -> Row:
    """Return the row of one try in virtual time; arguments as for :func:`measure`."""
    done = walk(
        draw_truth(PROFILE, seed),
        OnnxPolicy(policy_file("go2", policy) or policy),
        FixedVelocity((CLIMB_M_S, 0.0, 0.0)),
        CLIMB_S,
        record=False,
        terrain=Terrain(kind="box", rise=height, distance_m=EDGE_M),
        obstacle=(0.0, 0.0) if blind else (EDGE_M, height),
    )
    furthest, report = float(done.track.place[:, 0].max()), done.report
    return {
        **{"wire": VIRTUAL, "height_m": height, "seed": seed, "told": not blind, "error": ""},
        "end": f"{report.outcome.value}: {report.reason}",
        "furthest_m": round(furthest, 3),
        "climbed": report.outcome is Outcome.FINISHED and furthest >= EDGE_M + BEYOND_M,
        "cycles": report.cycles_sent,
        "clipped": dict(report.clipped),
    }


def main() -> None:
    """Climb as the command line says; print a row for each robot and wire."""
    options = parser(__doc__)
    options.add_argument("--policy", default="climb", help="a policy's file, or the name of a shipped one")
    options.add_argument("--wires", nargs="+", choices=[*sorted(PORTS), VIRTUAL], default=sorted(PORTS))
    options.add_argument("--height", type=float, nargs="+", default=[0.1], help="of the platform [m]")
    options.add_argument("--blind", action="store_true", help="tell the robot nothing")
    add_seeds(options, 0)
    args = options.parse_args()
    rows = Rows(__file__, args.out)
    for wire, height, seed in itertools.product(args.wires, args.height, args.seeds):
        if wire == VIRTUAL:
            rows.add(measure_virtual(args.policy, height, seed, blind=args.blind))
        else:
            rows.add(measure(args.policy, wire, height, seed, blind=args.blind))


if __name__ == "__main__":
    main()
