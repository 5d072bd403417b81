"""The two processes of ``tools/measure_bridge.py``: a controller and a robot that only note times.

A state carries its number as the robot's tick. A command carries it as the first joint's target, which has no
effect while all gains but damping are 0. Both are valid messages, because the bridge passes no others.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import signal
import sys
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from fakes.go2 import FakeGo2

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.realtime import become_realtime, die_with_parent
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.transports.topics import LOW_COMMAND, LOW_STATE
from deal_hw.errors import TransportError, TransportTimeoutError
from deal_hw.robots.connect import make_topic_transport
from deal_hw.transport import Message, WireOptions

PERIOD_NS: Final = 2_000_000
WARM_NS: Final = 3_000_000_000
"""Time at the start in which messages are not noted, while both sides and the bridge connect."""


def run(side: str, orders: dict[str, Any]) -> dict[str, Any]:
    """Send every 2 ms, and note the times of all messages sent and received."""
    clock = MonotonicClock()
    own, other = (LOW_STATE, LOW_COMMAND) if side == "robot" else (LOW_COMMAND, LOW_STATE)
    make, read = (_state(), _command_number) if side == "robot" else (_command(), _state_number)
    link = make_topic_transport(
        orders["transport"], orders["port"], clock, WireOptions.from_json(orders["wire"])
    )
    granted = become_realtime()
    link.declare(publish=[own], subscribe=[other])
    sent: dict[int, int] = {}
    received: dict[int, int] = {}
    stopped: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: stopped.append(number))
    with link:
        print("ready", flush=True)
        begin_ns = due_ns = clock.now_ns()
        end_ns = begin_ns + WARM_NS + round(orders["seconds"] * 1e9) if side == "controller" else None
        number = 0
        while not stopped and (end_ns is None or clock.now_ns() < end_ns):
            number += 1
            payload = make(number)
            now_ns = clock.now_ns()
            if end_ns is None or now_ns - begin_ns > WARM_NS:
                sent[number] = now_ns
            with contextlib.suppress(TransportError):
                link.send(Message(own, payload, now_ns))
            due_ns = max(due_ns + PERIOD_NS, clock.now_ns())
            with contextlib.suppress(TransportTimeoutError):
                while (left_ns := due_ns - clock.now_ns()) > 0:
                    message = link.receive(left_ns * 1e-9)
                    came_ns = clock.now_ns()
                    if came_ns - begin_ns > WARM_NS:
                        received[read(message.payload)] = came_ns
    return {"sent": sent, "heard": received, "scheduling": granted.scheduling}


def _state() -> Callable[[int], bytes]:
    state = FakeGo2().state()
    return lambda number: encode_low_state(dataclasses.replace(state, tick_ms=2 * number))


def _state_number(payload: bytes) -> int:
    return decode_low_state(payload).tick_ms // 2


def _command() -> Callable[[int], bytes]:
    encoder, zero, damping = LowCommandEncoder(), np.zeros(12), np.full(12, 5.0)
    return lambda number: encoder.encode(LowCommand(np.full(12, float(number)), zero, zero, damping, zero))


def _command_number(payload: bytes) -> int:
    return round(float(decode_low_command(payload).position[0]))


def main() -> int:
    orders = json.load(sys.stdin)
    die_with_parent(orders["parent_pid"])
    print(json.dumps(run(sys.argv[1], orders)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
