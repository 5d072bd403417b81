"""A program for the vendor's robot, on the vendor's DDS version, finds in our emulator what it expects."""

from __future__ import annotations

import importlib.util
import json
import subprocess
from pathlib import Path

import pytest

from deal_hw.workflows.emulation.process import EmulatorProcess

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(
        any(importlib.util.find_spec(name) is None for name in ("cyclonedds", "mujoco")),
        reason="pip install 'deal-hw[dds,sim]'",
    ),
]


@pytest.mark.slow
def test_a_0102_program_releases_sport_mode_stands_the_robot_up_and_lays_it_down(
    dds_peer: Path, dds_domain: int
) -> None:
    """The SDK's low-level example: CheckMode and ReleaseMode by RPC, then targets at 500 Hz, kp 60, kd 5."""
    options = ("--transport", "dds", "--port", "lo", "--domain", str(dds_domain), "--duration-s", "100")
    with EmulatorProcess("go2", *options) as emulator:
        ran = subprocess.run(
            [dds_peer, "stand", str(dds_domain), "4"], capture_output=True, text=True, check=False, timeout=90
        )
        _, summary = emulator.stop(30.0)
    assert "sport mode: released" in summary
    assert (ran.returncode, ran.stderr) == (0, "")
    reported = json.loads(ran.stdout)
    phases = {phase["phase"]: phase for phase in reported["phases"]}
    assert reported["mode"] == "normal"
    assert reported["releases"] >= 1
    assert (reported["bad_crc"], reported["bad_head"]) == (0, 0)
    # Thigh and calf of 0.213 m at the example's 0.67 and -1.3 rad: 0.213 (cos 0.67 + cos 0.63) = 0.339 m;
    # 10 N m of load against kp 60 bend each joint by about 0.17 rad, which leaves 0.30 m or more.
    assert phases["hold"]["shortest_leg"] > 0.28
    assert phases["hold"]["lightest_foot"] > 5
    assert max(abs(phases["hold"][name]) for name in ("roll", "pitch")) < 0.15
    # At 1.36 and -2.65 rad: 0.213 (cos 1.36 + cos 1.29) = 0.104 m.
    assert phases["lie"]["shortest_leg"] < 0.13
    assert max(phase["worst_effort"] for phase in phases.values()) < 45.0
