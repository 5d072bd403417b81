"""A G1 without mechanics that sends and takes the wire's bytes, in virtual time, for tests of a driver.

Its joints never move by themselves. A test can change messages, and add other participants.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from deal_hw.clock import VirtualClock
from deal_hw.drivers.g1.emulator.device import newest_machine
from deal_hw.drivers.g1.messages import (
    G1Command,
    G1CommandEncoder,
    G1State,
    decode_low_command,
    encode_low_state,
)
from deal_hw.drivers.g1.robot import G1Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.remote import Remote, encode_remote
from deal_hw.drivers.unitree.rpc import Response, decode_request, encode_response
from deal_hw.types import FloatArray
from fakes.go2 import FakeTopics, TopicBench


class FakeG1:
    """Motors, own controller and motion switcher, one tick a millisecond, a state every two.

    Attributes:
        device_ns: Device time at which the next tick runs [ns].
        mode: Name of the active mode; "" once released. An active mode commands the motors, too.
        machine: mode_machine in the states.
        pose: Positions that it reports, (J,) [rad].
        tick_ms: The clock in its states.
        remote: State of the remote; None: no remote is in reach.
        changes: Fields of the state to replace, by name.
        talks: Whether it sends states.
        command: The command in force.
        received: Bytes of each received command.
        asked: Function of each received request.

    Args:
        kind: The driver, for its joints.
        mode: The active mode at the beginning.
    """

    def __init__(self, kind: type[G1Robot] = G1Robot, mode: str = "ai") -> None:
        self.joints = kind.description.joint_names
        self.device_ns, self.tick_ms, self.mode = 0, 1000, mode
        self.machine = newest_machine(kind.description.name)
        self.pose = np.array(kind.description.default_position)
        self.remote: Remote | None = None
        self.changes: dict[str, Any] = {}
        self.talks = True
        self.command: G1Command | None = None
        self.received: list[bytes] = []
        self.asked: list[int] = []
        self._answers: list[tuple[str, bytes]] = []
        zero, count = np.zeros(len(self.joints)), len(self.joints)
        own = G1Command(zero, zero, zero + 40.0, zero + 2.0, zero, np.ones(count, np.int64), self.machine)
        self._own = G1CommandEncoder(self.joints).encode(own)

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Follow a command at once, answer a request with the next tick."""
        if topic == topics.LOW_COMMAND:
            self.command = decode_low_command(payload, self.joints)
            self.received.append(payload)
        elif topic == topics.request("motion_switcher"):
            request = decode_request(payload)
            self.asked.append(request.api)
            if request.api == 1003:
                self.mode = ""
            data = json.dumps({"form": "0", "name": self.mode}) if request.api == 1001 else ""
            answer = encode_response(Response(request.identity, request.api, 0, data))
            self._answers.append((topics.response("motion_switcher"), answer))

    def tick(self) -> list[tuple[str, bytes]]:
        """Run one millisecond; return the messages sent in it."""
        now_ms, out, self._answers = self.device_ns // 1_000_000, self._answers, []
        self.device_ns += 1_000_000
        if self.talks and now_ms % 2 == 0:
            out.append((topics.LOW_STATE, encode_low_state(self.state(), self.joints)))
            self.tick_ms = (self.tick_ms + 2) % 2**32
        elif self.talks and self.mode:
            out.append((topics.LOW_COMMAND, self._own))
        return out

    def effort(self) -> FloatArray:
        """Return the motors' efforts under the command in force, (J,) [N·m]."""
        if (c := self.command) is None:
            return np.zeros(len(self.joints))
        return np.asarray(c.stiffness * (c.position - self.pose) + c.damping * c.velocity + c.effort)

    def state(self) -> G1State:
        """Return the present state."""
        zero, none = np.zeros(len(self.joints)), np.zeros(len(self.joints), np.int64)
        values: dict[str, Any] = {
            "position": self.pose,
            "velocity": zero,
            "acceleration": zero,
            "effort": self.effort(),
            "casing": none + 35,
            "winding": none + 50,
            "voltage": zero + 52.0,
            "error": none,
            "mode": none + 1,
            "orientation": np.array([1.0, 0.0, 0.0, 0.0]),
            "angular_velocity": np.array([0.1, 0.2, 0.3]),
            "specific_force": np.array([0.0, 0.0, 9.81]),
            "rpy": np.zeros(3),
            "imu_temperature": 45,
            "tick_ms": self.tick_ms,
            "remote": encode_remote(self.remote),
            "mode_machine": self.machine,
            "version": (3, 4),
        }
        return G1State(**{**values, **self.changes})


class FakeG1Bench(TopicBench[G1Robot]):
    """A fake robot, its driver, and the topics between them.

    Attributes:
        clock: The clock that everybody shares.
        device: The robot.

    Args:
        kind: The driver.
        hung: Whether the operator confirmed the crane.
    """

    def __init__(self, kind: type[G1Robot] = G1Robot, *, hung: bool = True) -> None:
        self.clock = VirtualClock(5_000_000_000)
        self.device = FakeG1(kind)
        self.topics = FakeTopics(self.device, self.clock)
        self.robot = kind(self.topics, self.clock, hung_on_crane=hung)
