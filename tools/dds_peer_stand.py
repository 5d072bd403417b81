"""Let a C program on Cyclone DDS 0.10.2 stand the emulated Go2 up and lay it down; the result as JSON.

    make dds-peer
    python tools/dds_peer_stand.py --out docs/measured/dds_peer_stand.json

The program does what the vendor's low-level example does: it releases sport mode by RPC, then sends targets
at 500 Hz with kp 60 and kd 5. It runs twice: once until the robot stands, once to the end. The result has the
program's observations and the emulator's own state.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from dds_peer_soak import PEER, build_peer, finish
from measuring import head

from deal_hw.workflows.emulation.process import EmulatorProcess

STAND, LIE = 3, 4
STANDING_M, LYING_M = 0.28, 0.12
"""Base height above which the robot stands, below which it lies."""
TOLD = ("base_height_m", "largest_tilt_rad", "sport", "commands", "requests_answered", "bad_requests")


@dataclass(frozen=True, kw_only=True)
class DdsPeerStand:
    """Stand the emulated Go2 up from a 0.10.2 program, and lay it down."""

    out: Path | None = None
    """File of the result; standard output by default."""

    domain: int = 42
    """DDS domain, and the next one."""

    profile: str = "realistic"
    """Profile of the emulator."""

    seed: int = 0
    """Its seed."""


def run(phases: int, domain: int, config: DdsPeerStand) -> dict[str, Any]:
    """Run an emulator and the program's first phases; return the reports of both."""
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder, "truth.json")
        wire = ("--transport", "dds", "--port", "lo", "--domain", str(domain), "--duration-s", "120")
        robot = ("--profile", config.profile, "--seed", str(config.seed), "--reveal-to", str(truth))
        with EmulatorProcess("go2", *wire, *robot) as emulator:
            peer = subprocess.run(
                [PEER, "stand", str(domain), str(phases)],
                capture_output=True,
                text=True,
                check=False,
                timeout=100,
            )
            emulator.stop(30.0)
        known = json.loads(truth.read_text())
    return {
        "peer": json.loads(peer.stdout) if peer.stdout else {},
        "peer_exit_code": peer.returncode,
        "peer_warnings": peer.stderr.splitlines(),
        "emulator": {name: known[name] for name in TOLD},
    }


def clean(result: dict[str, Any]) -> bool:
    """Return whether the program ended well, without a warning or a wrong checksum."""
    return result["peer_exit_code"] == 0 and not result["peer_warnings"] and not result["peer"]["bad_crc"]


def main(config: DdsPeerStand) -> int:
    """Run twice; return the exit status."""
    build_peer()
    stood = run(STAND, config.domain, config)
    lay = run(LIE, config.domain + 1, config)
    passed = (
        stood["emulator"]["base_height_m"] > STANDING_M
        and lay["emulator"]["base_height_m"] < LYING_M
        and all(clean(result) for result in (stood, lay))
    )
    settings = {**head(__file__), "passed": passed, "profile": config.profile, "seed": config.seed}
    return finish({**settings, "stood": stood, "lay_down": lay}, config.out)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(DdsPeerStand)))
