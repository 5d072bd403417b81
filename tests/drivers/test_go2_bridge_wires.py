"""What the bridge passes, and what it does at its start and end: a fake Go2 in virtual time on one side."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from fakes.go2 import STIFF, FakeGo2, FakeTopics
from fakes.memory_wire import MemoryWire

from deal_hw.clock import VirtualClock
from deal_hw.drivers.go2.bridge.admission import Control
from deal_hw.drivers.go2.bridge.bridge import Go2Bridge
from deal_hw.drivers.go2.bridge.config import BridgeConfig
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.zenoh_stamps import Echo, read_stamp
from deal_hw.drivers.unitree.cdr import words_crc
from deal_hw.drivers.unitree.go_messages.frames import low_command_image
from deal_hw.drivers.unitree.rpc import STATUS_TEXTS, Request, encode_request, read_note
from deal_hw.errors import TransportError, TransportLostError
from deal_hw.transport import Message

pytestmark = pytest.mark.real_time

ZERO = np.zeros(12)
DAMPING = LowCommandEncoder().encode(LowCommand(ZERO, ZERO, ZERO, np.full(12, 5.0), ZERO))


class Network(MemoryWire):
    """The clients' side, in the bridge's time; it may be in use by another program."""

    port = "network"

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__()
        self._clock = clock

    def open(self) -> None:
        if self.broken:
            raise TransportError("in use")
        super().open()

    def receive(self, timeout_s: float) -> Message:
        if not self.arriving:
            self._clock.advance_ns(round(timeout_s * 1e9))
        return super().receive(timeout_s)


class Bench:
    """A bridge between a fake Go2 and the network; the test is its second thread."""

    def __init__(self, mode: str = "") -> None:
        self.clock = VirtualClock(1_000_000_000)
        self.go2 = FakeGo2(mode)
        self.wire = FakeTopics(self.go2, self.clock)
        self.network = Network(self.clock)
        self.reported: list[str] = []
        self.bridge = Go2Bridge(
            self.wire, self.network, self.clock, BridgeConfig(leave_s=0.02), tell=self.reported.append
        )

    def run(self, milliseconds: int) -> None:
        """Let the bridge look every 2 ms and pass on what the robot reported."""
        for _ in range(milliseconds // 2):
            self.bridge.step()
            # More than the robot says in that time.
            for _ in range(4):
                self.bridge.pass_one(0.0)

    def received(self, topic: str) -> list[Message]:
        """Return what clients received of a topic."""
        return [message for message in self.network.sent if message.channel == topic]

    def status(self) -> str:
        """Return who controls the robot, as the status for clients has it."""
        reported = read_note(self.received(topics.BRIDGE)[-1].payload, STATUS_TEXTS)
        assert reported is not None
        return reported["control"]

    def say(self, topic: str, payload: bytes, sequence: int) -> None:
        """Send as a client does that has received the newest state."""
        stamp = read_stamp(self.received(topics.LOW_STATE)[-1].attachment)
        assert stamp is not None
        self.network.arriving.append(Message(topic, payload, 0, Echo(7, sequence, stamp).encode()))


@pytest.fixture
def make_bench(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Bench]:
    """Return what makes a bench, from the active mode of the robot."""
    monkeypatch.setattr(Go2Bridge, "_pass_states", lambda self: None)
    return Bench


def kinds(go2: FakeGo2) -> list[bool]:
    """Return whether each command to the robot is stiff."""
    return [bool(command.stiffness.any()) for _, command in go2.received]


def test_it_leaves_a_robot_alone_that_sport_mode_has(make_bench: Callable[[str], Bench]) -> None:
    """From its start to its end no motor command goes out; what sport mode commands is passed on."""
    bench = make_bench("normal")
    bench.bridge.open()
    assert bench.reported == ["idle: the robot's own controller 'normal' has it"]
    bench.run(500)
    bench.bridge.close()
    assert bench.go2.received == []
    assert bench.received(topics.LOW_COMMAND)


def test_it_damps_a_robot_that_nobody_has_before_it_listens(make_bench: Callable[[str], Bench]) -> None:
    """Also where the network cannot be opened: the robot may hold anything."""
    bench = make_bench("")
    bench.network.broken = True
    with pytest.raises(TransportError, match="in use"):
        bench.bridge.open()
    assert kinds(bench.go2) == [False]
    assert bench.bridge.admission.control is Control.DAMPING


def test_it_yields_at_its_start_to_another_program(make_bench: Callable[[str], Bench]) -> None:
    """Sport mode is off, and somebody on the robot's side commands the motors."""
    bench = make_bench("")
    bench.wire.say(topics.LOW_COMMAND, STIFF, after_s=0.05)
    bench.bridge.open()
    assert bench.reported == ["idle: another program on the robot's side commands the motors"]
    assert kinds(bench.go2) == [True], "the other program's command alone"


def test_it_yields_later_too_and_says_so(make_bench: Callable[[str], Bench]) -> None:
    """Damping stops at the next look."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    bench.wire.say(topics.LOW_COMMAND, STIFF)
    bench.run(20)
    count = len(bench.go2.received)
    bench.run(100)
    assert len(bench.go2.received) == count
    assert bench.reported[-1] == "idle: another program on the robot's side commands the motors"


def test_it_takes_charge_again_after_a_stray_command(make_bench: Callable[[str], Bench]) -> None:
    """The robot holds its last command for ever; it is damped half a second to a second later, and why."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    for k in range(150):
        bench.wire.say(topics.LOW_COMMAND, STIFF, after_s=0.002 * k)
    bench.run(300 + 490)
    assert bench.status() == "idle"
    assert kinds(bench.go2)[-1]
    bench.run(520)
    assert bench.status() == "damping"
    assert bench.reported[-1].startswith("damping: nobody has commanded the motors for")
    assert bench.reported[-1].endswith("and no mode is active")
    count = len(bench.go2.received)
    bench.run(100)
    assert kinds(bench.go2)[count:] == [False] * 50


def test_it_stays_idle_while_another_program_commands_slowly(make_bench: Callable[[str], Bench]) -> None:
    """Five commands a second, for ten seconds: two commanders would make the robot jump."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    for k in range(50):
        bench.wire.say(topics.LOW_COMMAND, STIFF, after_s=0.2 * k)
    bench.run(10)
    count = len(bench.go2.received)
    bench.run(9800)
    assert len(bench.go2.received) == count + 49


def test_it_takes_charge_once_sport_mode_is_released(make_bench: Callable[[str], Bench]) -> None:
    """By the vendor's app, or by a program that died before it commanded the motors."""
    bench = make_bench("normal")
    bench.bridge.open()
    bench.run(3000)
    assert bench.go2.received == []
    bench.go2.mode = ""
    bench.run(4900)
    assert bench.go2.received == []
    bench.run(1100)
    assert bench.bridge.admission.control is Control.DAMPING
    assert kinds(bench.go2)[-1] is False


def test_it_does_not_disturb_a_run_on_the_robots_own_network(make_bench: Callable[[str], Bench]) -> None:
    """The run releases sport mode, listens, and then commands; once it has ended, the bridge damps."""
    bench = make_bench("normal")
    bench.bridge.open()
    for k in range(500):
        bench.wire.say(topics.LOW_COMMAND, STIFF, after_s=0.002 * k)  # by sport mode itself
    bench.run(1000)
    bench.go2.mode = ""
    for k in range(500):
        bench.wire.say(topics.LOW_COMMAND, STIFF, after_s=4.5 + 0.002 * k)
    bench.run(5500)
    assert kinds(bench.go2) == [True] * 1000
    bench.run(1100)
    assert bench.status() == "damping"


def test_it_leaves_a_robot_alone_that_another_program_gave_to_sport_mode(
    make_bench: Callable[[str], Bench],
) -> None:
    """The newest answer counts, not what was known before; a switch in progress is no free robot."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    bench.go2.codes["motion_switcher", 1001] = [7002] * 4
    bench.wire.say(topics.LOW_COMMAND, STIFF)
    bench.run(1600)
    assert bench.bridge.admission.control is Control.IDLE
    bench.go2.mode = "ai"
    count = len(bench.go2.received)
    bench.run(5000)
    assert len(bench.go2.received) == count


def test_without_an_answer_it_damps_later(make_bench: Callable[[str], Bench]) -> None:
    """It damped before, so no mode was active: 2.5 s after the last command of the other program."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    bench.go2.deaf.add("motion_switcher")
    bench.wire.say(topics.LOW_COMMAND, STIFF)
    bench.run(2480)
    assert bench.status() == "idle"
    bench.run(40)
    assert bench.status() == "damping"
    assert bench.reported[-1].endswith("and motion_switcher does not answer")


@pytest.mark.parametrize("stubborn", [False, True])
def test_a_robot_that_is_handed_back_keeps_its_damping_until_a_mode_has_it(
    make_bench: Callable[[str], Bench], stubborn: bool
) -> None:
    """Damping would work against sport mode as it stands up; if no mode takes it, it is damped again."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    bench.say(topics.LOW_COMMAND, DAMPING, 0)
    bench.run(4)
    bench.go2.stubborn = stubborn
    bench.say(topics.request("motion_switcher"), encode_request(Request(9, 1002, '{"name": "ai"}')), 1)
    bench.run(4)
    assert bench.bridge.admission.control is Control.IDLE
    count = len(bench.go2.received)
    bench.run(9900)
    assert len(bench.go2.received) == count
    bench.run(200)
    assert bench.bridge.admission.control is (Control.DAMPING if stubborn else Control.IDLE)


def test_a_robot_that_does_not_answer_is_not_damped(make_bench: Callable[[str], Bench]) -> None:
    """Sport mode may hold it, and then damping would throw it down; the operator is informed."""
    bench = make_bench("")
    bench.go2.deaf.add("motion_switcher")
    bench.bridge.open()
    assert bench.go2.received == []
    assert "is unknown, so it is not damped yet" in bench.reported[0]
    bench.run(5000)
    assert bench.go2.received == []
    bench.go2.deaf.clear()
    bench.run(520)
    assert bench.bridge.admission.control is Control.DAMPING


def test_clients_hear_states_with_stamps_and_who_has_the_robot(make_bench: Callable[[str], Bench]) -> None:
    """Five times a second, and at once when it changes."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(1000)
    states = bench.received(topics.LOW_STATE)
    stamps = [read_stamp(message.attachment) for message in states]
    assert [stamp.time_ns for stamp in stamps if stamp] == [message.stamp_ns for message in states]
    assert len({stamp.session for stamp in stamps if stamp}) == 1
    reported = [read_note(message.payload, STATUS_TEXTS) for message in bench.received(topics.BRIDGE)]
    assert 5 <= len(reported) <= 7
    before = len(reported)
    bench.say(topics.LOW_COMMAND, DAMPING, 0)
    bench.run(4)
    status = read_note(bench.received(topics.BRIDGE)[before].payload, STATUS_TEXTS)
    assert status == {"control": "controlled", "reason": "a controller took the robot over"}


def test_only_the_joints_numbers_pass(make_bench: Callable[[str], Bench]) -> None:
    """A switched-off battery in the command stays here: the message is made anew."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    received: list[bytes] = []
    receive = bench.go2.receive

    def overheard(topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        if topic == topics.LOW_COMMAND:
            received.append(payload)
        receive(topic, payload, stamp_ns)

    bench.go2.receive = overheard  # type: ignore[method-assign]
    evil = bytearray(DAMPING)
    evil[744] = evil[788] = 1
    evil[808:] = words_crc(low_command_image(bytes(evil))).to_bytes(4, "little")
    bench.say(topics.LOW_COMMAND, bytes(evil), 0)
    bench.run(10)
    assert bench.bridge.admission.admitted == 1
    assert received
    assert set(received) == {DAMPING}


def test_requests_and_claims_pass_and_rubbish_does_not(make_bench: Callable[[str], Bench]) -> None:
    """A claim is received on both sides; other text on its topic is dropped."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    asked = len(bench.go2.requests)
    bench.say(topics.request("sport"), encode_request(Request(5, 1005)), 0)
    claim = encode_request(Request(0, 0, '{"id": "a", "who": "b", "state": "asking"}', no_reply=True))
    bench.say(topics.CLAIM, claim, 1)
    bench.say(topics.CLAIM, encode_request(Request(0, 0, "[]")), 2)
    bench.wire.say(topics.CLAIM, claim)
    bench.run(20)
    assert [request.identity for _, request in bench.go2.requests[asked:]] == [5]
    assert [message.payload for message in bench.received(topics.response("sport"))] != []
    assert bench.bridge.counts[topics.CLAIM] == 2


def test_a_network_that_takes_nothing_is_counted(make_bench: Callable[[str], Bench]) -> None:
    """The robot's side goes on."""
    bench = make_bench("")
    bench.bridge.open()
    bench.network.broken = True
    bench.run(20)
    assert bench.bridge.unsent > 5
    assert len(bench.go2.received) >= 10


def test_it_damps_when_it_ends_and_when_its_thread_fails(make_bench: Callable[[str], Bench]) -> None:
    """A controller's last command is not the robot's last one."""
    bench = make_bench("")
    bench.bridge.open()
    bench.run(20)
    bench.say(topics.LOW_COMMAND, DAMPING, 0)
    bench.run(4)
    bench.bridge._failure = TransportLostError("the cable is out")
    with pytest.raises(TransportLostError):
        bench.bridge.step()
    count = len(bench.go2.received)
    bench.bridge.close()
    assert len(bench.go2.received) >= count + 10
    assert not bench.network.is_open
    last = read_note(bench.received(topics.BRIDGE)[-1].payload, STATUS_TEXTS)
    assert last == {"control": "damping", "reason": "the bridge ends"}


@pytest.mark.parametrize("text", ["[]", "{}", '{"control": 1, "reason": "x"}', "rubbish"])
def test_what_is_no_status_is_passed_over(text: str) -> None:
    """Whatever stands on the topic."""
    assert read_note(encode_request(Request(0, 0, text)), STATUS_TEXTS) is None
    assert read_note(text.encode(), STATUS_TEXTS) is None
