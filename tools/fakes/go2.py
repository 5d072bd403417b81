"""A Go2 without mechanics that sends and takes the wire's bytes, in virtual time, for tests of a driver.

Its joints never move by themselves. A test can change messages, and add other participants.
"""

from __future__ import annotations

import heapq
import itertools
import json
from collections.abc import Callable, Iterable
from typing import Any, Final, Generic, TypeVar

import numpy as np

from deal_hw.clock import VirtualClock
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.leg_geometry import GEOMETRY
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import encode_low_state
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import TopicCore, VirtualTopics
from deal_hw.drivers.unitree.go_messages.low_state import LowState
from deal_hw.drivers.unitree.remote import Remote, encode_remote
from deal_hw.drivers.unitree.rpc import Request, Response, decode_request, encode_response
from deal_hw.robot import Robot
from deal_hw.types import FloatArray


def efforts_under(position: FloatArray, loads: FloatArray) -> FloatArray:
    """Return the efforts that balance the floor's forces on the feet, (12,) [N·m].

    Args:
        position: Joint positions, (12,) [rad].
        loads: Force of the floor on each foot, (4, 3) [N].
    """
    return np.asarray(-np.einsum("lij,li->lj", GEOMETRY.foot_jacobians(position), loads).reshape(12))


RESTING: Final = np.array(DRIVER.rest_position)
STANDING: Final = np.array(DRIVER.default_position)
STANDING_EFFORT: Final = efforts_under(STANDING, np.array([[0.0, 0.0, GEOMETRY.weight_n / 4]] * 4))
"""Motor efforts of a standing robot [N·m]."""
ANSWER_NS: Final = 3_000_000
STIFF: Final = LowCommandEncoder().encode(
    LowCommand(STANDING, np.zeros(12), np.full(12, 60.0), np.full(12, 5.0), np.zeros(12))
)
"""Command of sport mode."""


class FakeGo2:
    """Motors, sport mode and services, one tick a millisecond, a state every two.

    Attributes:
        device_ns: Device time at which the next tick runs [ns].
        mode: Name of the active mode; "" once released. An active mode commands the motors, too.
        pose: Positions that it reports, (12,) [rad].
        velocity: Velocities that it reports, (12,) [rad/s].
        tick_ms: The clock in its states.
        tick_step: Advance of that clock with each state; 0: it stands still.
        remote: State of the remote; None: no remote is in reach.
        changes: Fields of the state to replace, by name.
        on_stand: Whether its body is on a stand, so that its legs carry no weight.
        talks: Whether it sends states.
        hears: Whether commands reach the motors.
        deaf: Services that do not answer.
        stubborn: Whether requests leave its mode unchanged.
        codes: Errors that a service answers with, in order, by service and function.
        command: The command in force.
        received: Device time and command of each received command.
        requests: Service and request of each received request.

    Args:
        mode: The active mode at the beginning.
        pose: The pose, (12,) [rad]; by default at rest, or the legs down on a stand.
        on_stand: As the attribute.
    """

    def __init__(
        self, mode: str = "normal", pose: FloatArray | None = None, *, on_stand: bool = False
    ) -> None:
        self.device_ns = 0
        self.mode, self.on_stand, self.velocity = mode, on_stand, np.zeros(12)
        self.pose = (STANDING if on_stand else RESTING).copy() if pose is None else pose.copy()
        self.tick_ms, self.tick_step = 1000, 2
        self.remote: Remote | None = None
        self.changes: dict[str, Any] = {}
        self.talks = self.hears = True
        self.deaf: set[str] = set()
        self.stubborn = False
        self.codes: dict[tuple[str, int], list[int]] = {}
        self.command: LowCommand | None = None
        self.received: list[tuple[int, LowCommand]] = []
        self.requests: list[tuple[str, Request]] = []
        self._answers: list[tuple[int, str, bytes]] = []

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Follow a command at once, answer a request after 3 ms."""
        if topic == topics.LOW_COMMAND:
            if self.hears:
                self.command = decode_low_command(payload)
                self.received.append((self.device_ns, self.command))
            return
        if not topic.endswith("/request"):
            return
        service, request = topic.split("/")[2], decode_request(payload)
        self.requests.append((service, request))
        if service not in self.deaf:
            code, data = self.serve(service, request)
            answer = encode_response(Response(request.identity, request.api, code, data))
            self._answers.append((self.device_ns + ANSWER_NS, topics.response(service), answer))

    def serve(self, service: str, request: Request) -> tuple[int, str]:
        """Act on a request; return the code and the data of its answer."""
        if (codes := self.codes.get((service, request.api))) and (code := codes.pop(0)):
            return code, ""
        if (service, request.api) == ("motion_switcher", 1001):
            return 0, json.dumps({"form": "0", "name": self.mode})
        if not self.stubborn:
            self._obey(service, request.api, json.loads(request.parameter))
        return 0, ""

    def _obey(self, service: str, api: int, asked: dict[str, Any]) -> None:
        match service, api:
            case "motion_switcher", 1002:
                self.mode = asked["name"]
            case "motion_switcher", 1003:
                self.mode = ""
            case "sport", 1005:
                self.pose = RESTING.copy()
            case "robot_state", 1001 if asked["name"] == "sport_mode":
                self.mode = "normal" if asked["switch"] else ""

    def tick(self) -> list[tuple[str, bytes]]:
        """Run one millisecond; return the messages sent in it."""
        now_ms = self.device_ns // 1_000_000
        out = [(topic, answer) for due_ns, topic, answer in self._answers if due_ns <= self.device_ns]
        self._answers = [answer for answer in self._answers if answer[0] > self.device_ns]
        self.device_ns += 1_000_000
        if self.talks and now_ms % 2 == 0:
            out.append((topics.LOW_STATE, encode_low_state(self.state())))
            self.tick_ms = (self.tick_ms + self.tick_step) % 2**32
        elif self.talks and self.mode:
            out.append((topics.LOW_COMMAND, STIFF))
        return out

    def effort(self) -> FloatArray:
        """Return the motors' efforts under the command in force, (12,) [N·m]."""
        if (c := self.command) is None:
            stands = not self.on_stand and np.array_equal(self.pose, STANDING)
            return STANDING_EFFORT if stands else np.zeros(12)
        return np.asarray(
            c.stiffness * (c.position - self.pose) + c.damping * (c.velocity - self.velocity) + c.effort
        )

    def state(self) -> LowState:
        """Return the present state."""
        values: dict[str, Any] = {
            "position": self.pose,
            "velocity": self.velocity,
            "acceleration": np.zeros(12),
            "effort": self.effort(),
            "temperature": np.arange(12) + 30,
            "lost": np.arange(12),
            "mode": np.ones(12, np.int64),
            "orientation": np.array([1.0, 0.0, 0.0, 0.0]),
            "angular_velocity": np.array([0.1, 0.2, 0.3]),
            "specific_force": np.array([0.0, 0.0, 9.81]),
            "rpy": np.zeros(3),
            "imu_temperature": 60,
            "foot_force": np.array([1, 2, 3, 4]),
            "foot_force_estimate": np.zeros(4, np.int64),
            "tick_ms": self.tick_ms,
            "remote": encode_remote(self.remote),
            "battery_percent": 77,
            "battery_current_ma": -2000,
            "battery_status": 8,
            "battery_cycles": 1,
            "cell_voltage_mv": np.full(15, 3900),
            "voltage": 30.5,
            "current": 2.0,
            "serial": (1, 2),
            "version": (3, 4),
        }
        return LowState(**{**values, **self.changes})


class FakeTopics(VirtualTopics):
    """A virtual wire with other participants and faults.

    Attributes:
        others: Writers that discovery knows, by topic.
        our_stream: Number by which a bridge knows the driver; None without a bridge.
        tamper: Returns the bytes that arrive, from topic and bytes of a message of the device.

    Args:
        device: The device.
        clock: The clock that everybody shares.
    """

    def __init__(self, device: TopicCore, clock: VirtualClock) -> None:
        super().__init__(device, clock)
        self.others: dict[str, tuple[str, ...]] = {}
        self.our_stream: int | None = None
        self.tamper: Callable[[str, bytes], Iterable[bytes]] = lambda topic, payload: (payload,)
        self._later: list[tuple[int, int, str, bytes]] = []
        self._number = itertools.count()

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return :attr:`others`."""
        return self.others.get(topic, ())

    @property
    def stream(self) -> int | None:
        """Return :attr:`our_stream`."""
        return self.our_stream

    def say(self, topic: str, payload: bytes, after_s: float = 0.0) -> None:
        """Let another participant send a message, now or later; the device hears it, too."""
        due_ns = self._clock.now_ns() + round(after_s * 1e9)
        heapq.heappush(self._later, (due_ns, next(self._number), topic, payload))

    def _run_tick(self, tick_ns: int) -> None:
        while self._later and self._later[0][0] <= tick_ns:
            _, _, topic, payload = heapq.heappop(self._later)
            self.device.receive(topic, payload, tick_ns)
            self._arrive(topic, payload, tick_ns)
        for topic, payload in self.device.tick():
            for arrived in self.tamper(topic, payload):
                self._arrive(topic, arrived, tick_ns)


RobotT = TypeVar("RobotT", bound=Robot)


class TopicBench(Generic[RobotT]):
    """A fake robot, its driver, and the topics between them.

    Attributes:
        topics: The wire.
        robot: The driver, not connected.
    """

    topics: FakeTopics
    robot: RobotT

    def armed(self) -> RobotT:
        """Return the driver, connected, homed and armed."""
        self.robot.connect()
        self.robot.home(10.0)
        self.robot.arm(1.0)
        return self.robot

    def spoil_once(self, change: Callable[[bytes], Iterable[bytes]]) -> None:
        """Let the next state arrive changed."""
        pending = [True]

        def tamper(topic: str, payload: bytes) -> Iterable[bytes]:
            return change(payload) if topic == topics.LOW_STATE and pending and pending.pop() else (payload,)

        self.topics.tamper = tamper


class FakeBench(TopicBench[Go2Robot]):
    """A fake robot, its driver, and the topics between them.

    Attributes:
        clock: The clock that everybody shares.
        device: The robot.

    Args:
        kind: The driver.
        settings: Arguments of :class:`FakeGo2`.
    """

    def __init__(self, kind: type[Go2Robot] = Go2Robot, **settings: Any) -> None:
        self.clock = VirtualClock(5_000_000_000)
        self.device = FakeGo2(**{"on_stand": kind.description.floating_base is None, **settings})
        self.topics = FakeTopics(self.device, self.clock)
        self.robot = kind(self.topics, self.clock)
