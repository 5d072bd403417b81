"""``deal-hw bridge``: what it refuses before it starts, and what it loads."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from random import SystemRandom

import pytest

from deal_hw.cli.bridge import Bridge
from deal_hw.cli.main import EXIT_ERROR, main
from deal_hw.drivers.go2.bridge.config import BridgeConfig
from deal_hw.errors import ConfigurationError

pytestmark = pytest.mark.real_time

HEAVY = {"torch", "mujoco", "scipy", "onnxruntime", "rerun", "matplotlib", "cryptography"}
SERVE = """
import json, sys

from deal_hw.cli.main import main

code = main(sys.argv[1:])
print(json.dumps({"code": code, "loaded": sorted({name.partition(".")[0] for name in sys.modules})}))
"""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("cartpole --port lo", "unknown robot with a bridge 'cartpole'; known: go2"),
        ("go2 --port lo --listen tcp/192.0.2.9:7447", "is plain TCP beyond this machine"),
        ("go2 --port lo --listen tls/127.0.0.1:7447", "needs --ca"),
        ("go2 --port lo --controllers desk", "--controllers would have no effect"),
        ("go2 --port lo --observers wall", "--observers would have no effect"),
        ("go2 --port nosuch0", "there is no network interface 'nosuch0'"),
        ("go2 --port lo --command-age-s 9", "command_age_s is 9.0; allowed: 0.01 to 0.5"),
        ("go2 --port lo --command-age-s 0.02 --rate-hz 50", "checked less than 5 times in it"),
        ("go2 --port lo --listen lo", "write protocol/host:port"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], arguments: str, words: str
) -> None:
    """Before anything is opened."""
    assert main(["bridge", *arguments.split()]) == EXIT_ERROR
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error


def test_it_stays_on_this_computer_unless_an_address_is_named() -> None:
    """With certificates over TLS, without them in plain."""
    assert Bridge(robot="go2", port="eth0").end_point == "tcp/127.0.0.1:7447"
    secured = Bridge(robot="go2", port="eth0", certificate=Path("robot.pem"))
    assert secured.end_point == "tls/127.0.0.1:7447"
    assert Bridge(robot="go2", port="eth0", listen="tls/10.0.0.1:1").end_point == "tls/10.0.0.1:1"


@pytest.mark.parametrize("name", ["command_age_s", "effort_margin", "release_s", "rate_hz", "status_s"])
def test_settings_have_ranges(name: str) -> None:
    """A limit that is none, or absurd, is refused."""
    for value in (float("nan"), float("inf"), -1.0, 0.0):
        with pytest.raises(ConfigurationError, match=name):
            BridgeConfig(**{name: value})


def test_it_loads_neither_simulator_nor_learning(tmp_path: Path) -> None:
    """It serves on the robot's own computer, beside a DDS domain without a robot, and ends with 0."""
    if importlib.util.find_spec("cyclonedds") is None:
        pytest.skip("pip install 'deal-hw[dds]'")
    domain = str(SystemRandom().randrange(10, 100))
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            SERVE,
            "bridge",
            "go2",
            "--port",
            "lo",
            "--domain",
            domain,
            "--listen",
            "tcp/127.0.0.1:0",
            "--duration-s",
            "0.1",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    port, reported = done.stdout.splitlines()
    assert port.startswith("port tcp/127.0.0.1:")
    assert "the robot's active controller is unknown, so it is not damped yet" in done.stderr
    assert "0 commands passed" in done.stderr
    found = json.loads(reported)
    assert found["code"] == 0
    assert not HEAVY & set(found["loaded"])
    assert {"zenoh", "cyclonedds"} <= set(found["loaded"])
