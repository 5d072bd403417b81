"""A program for the vendor's robot, on the vendor's DDS version, finds in our emulator what it expects."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from random import SystemRandom

import pytest

pytest.importorskip("cyclonedds", reason="pip install 'deal-hw[dds]'")
pytest.importorskip("mujoco", reason="pip install 'deal-hw[sim]'")
ROOT = Path(__file__).resolve().parents[2]
DOMAIN = SystemRandom().randrange(10, 100)


@pytest.fixture
def peer() -> Path:
    """The C program; packages are only installed by `make dds-peer`."""
    built = subprocess.run(
        [ROOT / "tools/build_dds_peer.sh", "--no-install"], capture_output=True, text=True, check=False
    )
    if built.returncode != 0:
        pytest.skip(f"make dds-peer, or: {built.stderr.strip().splitlines()[-1]}")
    return ROOT / "build/dds_peer/go2_peer"


@pytest.fixture
def _emulated_go2() -> Iterator[None]:
    """An emulated Go2 on loopback."""
    process = subprocess.Popen(
        [
            sys.executable, "-m", "deal_hw", "emulate", "go2", "--transport", "dds", "--port", "lo",
            "--domain", str(DOMAIN), "--profile", "realistic", "--duration-s", "100",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("port ")
        yield
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.usefixtures("_emulated_go2")
def test_a_0102_program_releases_sport_mode_stands_the_robot_up_and_lays_it_down(peer: Path) -> None:
    """The SDK's low-level example: CheckMode and ReleaseMode by RPC, then targets at 500 Hz, kp 60, kd 5."""
    ran = subprocess.run(
        [peer, "stand", str(DOMAIN), "4"], capture_output=True, text=True, check=False, timeout=90
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    told = json.loads(ran.stdout)
    phases = {phase["phase"]: phase for phase in told["phases"]}
    assert told["mode"] == "normal"
    assert told["releases"] >= 1
    assert (told["bad_crc"], told["bad_head"]) == (0, 0)
    # Thigh and calf of 0.213 m at the example's 0.67 and -1.3 rad: 0.213 (cos 0.67 + cos 0.63) = 0.339 m;
    # 10 N m of load against kp 60 bend each joint by about 0.17 rad, which leaves 0.30 m or more.
    assert phases["hold"]["shortest_leg"] > 0.28
    assert phases["hold"]["lightest_foot"] > 5
    assert max(abs(phases["hold"][name]) for name in ("roll", "pitch")) < 0.15
    # At 1.36 and -2.65 rad: 0.213 (cos 1.36 + cos 1.29) = 0.104 m.
    assert phases["lie"]["shortest_leg"] < 0.13
    assert max(phase["worst_effort"] for phase in phases.values()) < 45.0
