"""What several tests of drivers share."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from random import SystemRandom
from typing import Any

import numpy as np
import pytest

from deal_hw.drivers.go2.emulator.sport_controller import LYING, STANDING
from deal_hw.drivers.go2.emulator.truth import nominal_truth
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.rpc import Request, Response, decode_response, encode_request
from deal_hw.types import FloatArray

ROOT = Path(__file__).resolve().parents[2]


def servo(position: FloatArray, stiffness: float = 60.0, damping: float = 5.0) -> LowCommand:
    """Return a command to hold a pose, with the gains of the SDK's example."""
    zero = np.zeros(12)
    return LowCommand(position, zero, np.full(12, stiffness), np.full(12, damping), zero)


class Go2Bench:
    """An emulated Go2 in virtual time and a client of it; sport mode is released by default."""

    def __init__(self, **options: Any) -> None:
        from deal_hw.drivers.go2.emulator.device import Go2Device

        truth = options.pop("truth", nominal_truth())
        self.device = Go2Device(truth, **{"sport": "", **options})
        self.encoder = LowCommandEncoder()
        self.out: list[tuple[str, bytes]] = []

    def run(self, milliseconds: int, command: LowCommand | None = None) -> list[LowStateFrame]:
        """Let time pass, sending a command every 2 ms; return the states that came."""
        payload = None if command is None else self.encoder.encode(command)
        self.out = []
        for tick in range(milliseconds):
            if payload is not None and tick % 2 == 0:
                self.device.receive(topics.LOW_COMMAND, payload)
            self.out += self.device.tick()
        return self.states()

    def ramp(self, target: FloatArray, milliseconds: int = 800) -> None:
        """Move to a pose along a straight line, as the SDK's example does."""
        start = self.device.true_position
        for tick in range(0, milliseconds, 2):
            share = (tick + 2) / milliseconds
            self.run(2, servo(start + share * (target - start)))

    def stand(self) -> None:
        """Stand up from the floor."""
        self.ramp(LYING)
        self.ramp(STANDING)
        self.run(300, servo(STANDING))

    def states(self) -> list[LowStateFrame]:
        """Return the states of the last run."""
        return [decode_low_state(payload) for topic, payload in self.out if topic == topics.LOW_STATE]

    def count(self, topic: str) -> int:
        """Return how many messages of a topic the last run brought."""
        return sum(1 for name, _ in self.out if name == topic)

    def call(self, service: str, api: int, parameter: object = None, **header: Any) -> Response | None:
        """Call a service; return its answer, which comes in the next tick."""
        request = Request(77_000_000_001, api, json.dumps(parameter or {}), **header)
        self.device.receive(topics.request(service), encode_request(request))
        answers = [payload for topic, payload in self.device.tick() if topic == topics.response(service)]
        assert len(answers) <= 1
        return decode_response(answers[0]) if answers else None

    def mode(self) -> str:
        """Return the name that CheckMode gives."""
        answer = self.call("motion_switcher", 1001)
        assert answer is not None
        assert answer.json()["form"] == "0"
        return str(answer.json()["name"])


@pytest.fixture
def make_go2() -> Callable[..., Go2Bench]:
    """Return what makes an emulated Go2 in virtual time with a client, from the device's options."""
    pytest.importorskip("mujoco", reason="pip install 'deal-hw[sim]'")
    return Go2Bench


def built(script: str, command: str) -> Path:
    """Return the folder of a program, built if all that it needs is installed; else skip the test."""
    done = subprocess.run(
        [ROOT / "tools" / script, "--no-install"], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"{command}, or: {done.stderr.strip().splitlines()[-1]}")
    return ROOT / "build" / script.removeprefix("build_").removesuffix(".sh")


@pytest.fixture(scope="session")
def dds_peer() -> Path:
    """The C program on Cyclone DDS 0.10.2; packages are only installed by `make dds-peer`."""
    return built("build_dds_peer.sh", "make dds-peer") / "go2_peer"


@pytest.fixture(scope="session", params=["build_dds_peer.sh", "build_fastdds_peer.sh"])
def ros2_peer(request: pytest.FixtureRequest) -> Path:
    """The program for robots of ros2_control, in C on Cyclone DDS 0.10.2 and in C++ on Fast DDS 2.9."""
    return built(request.param, "make dds-peer") / "ros2_peer"


@pytest.fixture
def dds_domain() -> int:
    """A domain that other runs on this machine hardly use at the same time."""
    return SystemRandom().randrange(10, 100)


@pytest.fixture(scope="session")
def crc_bit_by_bit() -> Callable[[bytes], int]:
    """Return CRC-16/IBM-3740 from its definition: polynomial 0x1021, start 0xFFFF, highest bit first."""

    def crc_of(data: bytes) -> int:
        crc = 0xFFFF
        for byte in data:
            crc ^= byte << 8
            for _ in range(8):
                crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        return crc

    return crc_of
