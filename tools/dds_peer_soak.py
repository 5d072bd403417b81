"""Exchange LowCmd and LowState with a real Cyclone DDS 0.10.2, in both roles; the result as JSON.

    make dds-peer
    python tools/dds_peer_soak.py --seconds 60 --out docs/measured/dds_peer_soak.json

The peer is the C program of tests/drivers/peer_0102. It and we write at 500 Hz, on loopback. The run fails if
the peer dies or warns, if a checksum is wrong, or if a type hash differs from the vendor's.
"""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from fakes.go2 import FakeGo2
from measuring import head, spread, write_document

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.realtime import become_realtime
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.transports.dds_transport import DdsTransport
from deal_hw.drivers.transports.dds_types import COMPLETE, MINIMAL
from deal_hw.drivers.transports.topics import LOW_COMMAND, LOW_STATE, TYPES
from deal_hw.errors import TransportTimeoutError
from deal_hw.transport import Message, WireOptions

ROOT = Path(__file__).resolve().parents[1]
PEER = ROOT / "build/dds_peer/go2_peer"
PERIOD_NS = 2_000_000
MARGIN_S = 3.0
"""The peer runs this much longer, so that it never ends first."""


@dataclass(frozen=True, kw_only=True)
class DdsPeerSoak:
    """Exchange messages with Cyclone DDS 0.10.2 in both roles."""

    seconds: float = 60.0
    """Length of each of the two runs [s]."""

    out: Path | None = None
    """File of the result; standard output by default."""

    domain: int = 40
    """DDS domain, and the next one."""


class Side:
    """Our side of a run: the messages sent and received."""

    def __init__(self, publish: str, subscribe: str, message: Callable[[int], bytes]) -> None:
        self.publish, self.subscribe, self.message = publish, subscribe, message
        self.stamps: list[int] = []
        self.numbers: list[int] = []
        self.sent = 0
        self.slowest_send_ns = 0

    def take(self, message: Message) -> None:
        """Decode, which checks length, head and checksum, and note number and stamp."""
        if self.subscribe == LOW_STATE:
            self.numbers.append(decode_low_state(message.payload).tick_ms // 2)
        else:
            decode_low_command(message.payload)
            self.numbers.append(int.from_bytes(message.payload[8:12], "little"))
        self.stamps.append(message.stamp_ns)

    def run(self, wire: DdsTransport, seconds: float) -> None:
        """Write every 2 ms, and read between the writes."""
        begin_ns = time.monotonic_ns()
        for cycle in range(round(seconds * 1e9 / PERIOD_NS)):
            start_ns = time.monotonic_ns()
            wire.send(Message(self.publish, self.message(cycle), 0))
            self.slowest_send_ns = max(self.slowest_send_ns, time.monotonic_ns() - start_ns)
            self.sent += 1
            while (left_ns := begin_ns + (cycle + 1) * PERIOD_NS - time.monotonic_ns()) > 0:
                try:
                    self.take(wire.receive(left_ns * 1e-9))
                except TransportTimeoutError:
                    break

    def report(self) -> dict[str, Any]:
        """Return counts, and the time between arriving messages [ms]."""
        numbers, gaps_ms = np.array(self.numbers), np.diff(self.stamps) * 1e-6
        span = int(numbers[-1] - numbers[0]) + 1
        return {
            "sent": self.sent,
            "received": len(numbers),
            "lost": span - len(numbers),
            "lost_percent": round(100.0 * (span - len(numbers)) / span, 3),
            "in_order": bool(np.all(np.diff(numbers) > 0)),
            "arrival_period_ms": spread(gaps_ms.tolist()),
            "slowest_send_ms": round(self.slowest_send_ns * 1e-6, 3),
        }


def soak(role: str, side: Side, domain: int, seconds: float) -> dict[str, Any]:
    """Run the peer in one role and our side in the other; return the findings of both."""
    wire = DdsTransport("lo", MonotonicClock(), WireOptions(domain=domain))
    wire.declare(publish=[side.publish], subscribe=[side.subscribe])
    peer = subprocess.Popen(
        [PEER, role, str(domain), str(seconds + MARGIN_S)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with wire:
        side.take(wire.receive(10.0))
        side.run(wire, seconds)
        survey = wire.survey()
        alive = peer.poll() is None
        printed, warnings = peer.communicate()
    hashes = {end.topic: end.type_hash for end in survey.endpoints if end.topic in TYPES}
    result = {
        "peer": json.loads(printed) if printed else {},
        "peer_alive_at_the_end": alive,
        "peer_exit_code": peer.returncode,
        "peer_warnings": warnings.splitlines(),
        "complaints": list(survey.complaints),
        "hashes_on_the_wire": hashes,
        "we": side.report(),
    }
    result["passed"] = bool(
        alive
        and peer.returncode == 0
        and not warnings
        and not survey.complaints
        and hashes == {topic: COMPLETE[TYPES[topic]] for topic in (LOW_COMMAND, LOW_STATE)}
        and result["peer"]["received"]
        and result["peer"]["bad_crc"] == result["peer"]["bad_head"] == 0
    )
    return result


def command_bytes() -> Callable[[int], bytes]:
    """Return a function for the command of a cycle: swinging targets."""
    encoder, ones = LowCommandEncoder(), np.ones(12)

    def message(cycle: int) -> bytes:
        return encoder.encode(LowCommand(ones * np.sin(cycle * 0.01), ones, ones * 60.0, ones * 5.0, ones))

    return message


def state_bytes() -> Callable[[int], bytes]:
    """Return a function for the state of a cycle: a robot at rest."""
    robot = FakeGo2()

    def message(cycle: int) -> bytes:
        robot.tick_ms = 2 * cycle
        return encode_low_state(robot.state())

    return message


def main(config: DdsPeerSoak) -> int:
    """Run both roles; return the exit status."""
    build_peer()
    hashes = subprocess.run([PEER, "hashes"], capture_output=True, text=True, check=True).stdout
    ours = [[name, MINIMAL[name], COMPLETE[name]] for name in MINIMAL]
    became = become_realtime()
    as_user = Side(LOW_COMMAND, LOW_STATE, command_bytes())
    as_robot = Side(LOW_STATE, LOW_COMMAND, state_bytes())
    result: dict[str, Any] = {
        **head(__file__),
        "scheduling": became.scheduling,
        "cyclonedds_python": importlib.metadata.version("cyclonedds"),
        "seconds_each": config.seconds,
        "idlc_0102_gives_our_hashes": [line.split() for line in hashes.splitlines()] == ours,
        "peer_is_robot": soak("robot", as_user, config.domain, config.seconds),
        "peer_is_user": soak("user", as_robot, config.domain + 1, config.seconds),
    }
    passed = result["idlc_0102_gives_our_hashes"] and all(
        result[run]["passed"] for run in ("peer_is_robot", "peer_is_user")
    )
    return finish({"passed": bool(passed), **result}, config.out)


def build_peer() -> None:
    """Build the C program, if it is not there."""
    subprocess.run([ROOT / "tools/build_dds_peer.sh"], check=True)


def finish(result: dict[str, Any], out: Path | None) -> int:
    """Write a result to a file or print it; return the exit status."""
    if out is None:
        print(json.dumps(result, indent=1))
    write_document(out, result)
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(DdsPeerSoak)))
