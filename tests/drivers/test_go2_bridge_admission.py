"""Who may command a Go2 through the bridge, and when it is damped: on a clock that the test sets."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable

import numpy as np
import pytest
from fakes.go2 import FakeGo2
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.drivers.go2.bridge.admission import Admission, Control
from deal_hw.drivers.go2.bridge.config import DESCRIPTION, BridgeConfig
from deal_hw.drivers.go2.bridge.limits import CommandLimits, is_damping
from deal_hw.drivers.go2.bridge.robot_side import ASK_NS, RobotSide
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.zenoh_stamps import Echo, Stamp
from deal_hw.drivers.unitree.cdr import words_crc
from deal_hw.drivers.unitree.go_messages.frames import low_command_image
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.rpc import Request, encode_request
from deal_hw.drivers.unitree.support import PATIENCE_S
from deal_hw.drivers.unitree.takeover import LISTEN_S, RELEASE_PAUSE_S
from deal_hw.errors import ConfigurationError
from deal_hw.transport import Message

MS = 1_000_000
SESSION = 0xB1
POSE = np.array(DESCRIPTION.default_position)
ZERO = np.zeros(12)
DAMPING = LowCommand(POSE, ZERO, ZERO, np.full(12, 5.0), ZERO)
HOLD = LowCommand(POSE, ZERO, np.full(12, 30.0), np.full(12, 1.0), ZERO)
ENCODER = LowCommandEncoder()


@pytest.fixture(scope="module")
def frame() -> LowStateFrame:
    """A robot that stands still in its default pose."""
    state = dataclasses.replace(FakeGo2().state(), position=POSE, velocity=ZERO)
    return decode_low_state(encode_low_state(state))


class Bench:
    """A judge, and controllers that write to it; each message is received 5 ms after the state it answers."""

    def __init__(self, frame: LowStateFrame, **settings: float) -> None:
        config = BridgeConfig(**{"margin_s": 0.006, **settings})
        self.judge = Admission(config, CommandLimits(DESCRIPTION, config.effort_margin), SESSION)
        self.frame, self.now_ns = frame, 10_000 * MS
        self.sequence: dict[int, int] = {}

    def message(
        self,
        payload: bytes,
        stream: int = 1,
        *,
        topic: str = topics.LOW_COMMAND,
        age_ms: float = 5.0,
        sequence: int | None = None,
        session: int = SESSION,
    ) -> Message:
        """Return the next message of a stream."""
        number = self.sequence.get(stream, -1) + 1 if sequence is None else sequence
        self.sequence[stream] = number
        echo = Echo(stream, number, Stamp(session, self.now_ns - round(age_ms * MS)))
        return Message(topic, payload, self.now_ns, echo.encode())

    def send(self, command: LowCommand, stream: int = 1, **how: object) -> LowCommand | None:
        """Send a command 2 ms later and return what the judge lets through."""
        self.wait(2)
        return self.take(self.message(ENCODER.encode(command), stream, **how))  # type: ignore[arg-type]

    def take(self, message: Message) -> LowCommand | None:
        """Let the judge see a message."""
        return self.judge.command(message, self.now_ns, self.frame)

    def wait(self, milliseconds: float) -> int:
        """Let time pass, looking for silence every 2 ms; return how often damping went out."""
        count = 0
        end_ns = self.now_ns + round(milliseconds * MS)
        while self.now_ns < end_ns:
            self.now_ns = min(self.now_ns + 2 * MS, end_ns)
            count += self.judge.tick(self.now_ns)
        return count

    def walk(self, stream: int = 1) -> None:
        """Take the robot over and hold a pose."""
        assert self.send(DAMPING, stream) is not None
        assert self.send(HOLD, stream) is not None

    def why(self) -> str:
        """Return why the last message was refused."""
        return self.judge.last_refusal


@pytest.fixture
def bench(frame: LowStateFrame) -> Bench:
    """Return a judge whose bridge has just started."""
    return Bench(frame)


def request(service: str, api: int, parameter: object = None) -> tuple[str, bytes]:
    """Return topic and payload of a request."""
    return topics.request(service), encode_request(Request(1, api, json.dumps(parameter or {})))


def test_an_idle_bridge_sends_nothing(bench: Bench) -> None:
    """Before anybody took the robot over its own controller may have it."""
    assert bench.wait(5000) == 0
    assert bench.judge.control is Control.IDLE


def test_it_says_which_streams_reach_it(bench: Bench) -> None:
    """The last eight, refused ones too; a stream that is missing there may not write."""
    bench.walk(1)
    for stream in range(2, 9):
        assert bench.send(DAMPING, stream, age_ms=500.0) is None
    bench.send(HOLD, 1)
    bench.send(DAMPING, 9)
    assert bench.judge.status()["heard"].split() == [f"{stream:016x}" for stream in (3, 4, 5, 6, 7, 8, 1, 9)]


def test_a_hand_over_begins_with_damping(bench: Bench) -> None:
    """A stiff command from nowhere is refused; after damping the same passes unchanged."""
    assert bench.send(HOLD) is None
    assert "begin with damping" in bench.why()
    bench.walk()
    passed = bench.send(HOLD)
    assert passed is not None
    np.testing.assert_allclose(passed.stiffness, HOLD.stiffness)
    assert bench.judge.control is Control.CONTROLLED
    assert bench.judge.refused == {"handover": 1}


def test_silence_beyond_the_limit_damps_until_a_new_hand_over(bench: Bench) -> None:
    """Within 50 ms of the last command, then at each look, whatever the old stream goes on to say."""
    bench.walk()
    assert bench.wait(44) == 0
    assert bench.wait(10) == 5
    assert bench.judge.control is Control.DAMPING
    assert "no admissible command for 46 ms, the limit is 50 ms" in bench.judge.reason
    assert bench.send(HOLD) is None
    assert "no admissible command" in bench.why()
    assert bench.wait(10_000) == 5000
    bench.walk()
    assert bench.wait(40) == 0


def test_a_controller_that_went_passive_keeps_the_robot_for_a_while(bench: Bench) -> None:
    """Between damping and the first target a policy may take its time; damping is repeated meanwhile."""
    assert bench.send(DAMPING) is not None
    assert bench.wait(900) == 428
    assert bench.judge.control is Control.CONTROLLED
    assert bench.send(HOLD) is not None
    assert bench.send(DAMPING) is not None
    bench.wait(1000)
    assert bench.judge.control is Control.CONTROLLED
    bench.wait(2)
    assert bench.judge.control is Control.DAMPING
    assert bench.judge.reason == "the controller went passive and left"
    bench.walk(stream=2)


def test_a_second_controller_is_refused_and_the_first_goes_on(bench: Bench) -> None:
    """Whatever it sends, damping included."""
    bench.walk()
    for command in (DAMPING, HOLD, DAMPING):
        assert bench.send(command, stream=2) is None
        assert "another controller" in bench.why()
        assert bench.send(HOLD) is not None
    assert bench.judge.refused == {"holder": 3}


def test_why_commands_stayed_away_is_said(bench: Bench) -> None:
    """The refusals of the stream that had the robot, and not the messages to another one."""
    bench.walk()
    for _ in range(30):
        bench.send(HOLD, stream=2)
        bench.judge.tick(bench.now_ns)
    assert bench.judge.reason.endswith("the limit is 50 ms")
    bench.walk()
    for _ in range(30):
        bench.send(HOLD, age_ms=80)
        bench.judge.tick(bench.now_ns)
    assert (
        "the limit is 50 ms; the last refusal: its sender's newest state was 80.0 ms old"
        in bench.judge.reason
    )


def test_after_silence_another_one_may_take_over(bench: Bench) -> None:
    """The supervisor of a run whose control process died is such a one."""
    bench.walk()
    bench.wait(52)
    assert bench.send(DAMPING, stream=2) is not None
    assert bench.send(HOLD, stream=1) is None


@pytest.mark.parametrize("age_ms", [50.001, 100.0, 5000.0, -0.001, -5000.0])
def test_an_old_command_is_refused(bench: Bench, age_ms: float) -> None:
    """The state that it answers was too long ago by our own clock, or never was."""
    bench.walk()
    assert bench.send(HOLD, age_ms=age_ms) is None
    assert bench.judge.refused == {"age": 1}
    assert bench.send(HOLD, age_ms=50.0) is not None


def test_a_replay_is_refused(bench: Bench) -> None:
    """The same message at once, a sequence that goes back, and all of them later."""
    bench.walk()
    message = bench.message(ENCODER.encode(HOLD))
    assert bench.take(message) is not None
    assert bench.take(message) is None
    assert "a replay" in bench.why()
    assert bench.send(HOLD, sequence=0) is None
    bench.sequence[1] = 100
    assert bench.send(HOLD) is not None, "numbers may be left out"
    bench.wait(2000)
    assert bench.take(message) is None
    assert bench.judge.refused == {"sequence": 2, "age": 1}


def test_a_restarted_bridge_knows_no_old_stream(bench: Bench) -> None:
    """Stamps of the session before do not count; nor does a stream that goes on once it received the new."""
    bench.judge.take_charge("restarted")
    assert bench.send(HOLD, session=SESSION + 1) is None
    assert "before its restart" in bench.why()
    assert bench.send(HOLD) is None
    assert "begin with damping" in bench.why()
    assert bench.wait(20) == 10
    bench.walk()


def test_a_client_without_stamps_is_refused(bench: Bench) -> None:
    """Neither order nor age of its messages is known; one that has received no state gets that message."""
    payload = ENCODER.encode(DAMPING)
    for attachment in (b"", b"\x01", Stamp(SESSION, bench.now_ns).encode(), b"\x02" * 40):
        assert bench.take(Message(topics.LOW_COMMAND, payload, 0, attachment)) is None
        assert "neither sequence nor age" in bench.why()
    assert bench.send(DAMPING, session=0) is None
    assert "received no state" in bench.why()
    assert bench.judge.refused == {"unstamped": 4, "session": 1}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:-1], "811 bytes"),
        (lambda data: data[:100] + bytes([data[100] ^ 1]) + data[101:], "checksum"),
        (lambda data: b"", "0 bytes"),
    ],
)
def test_broken_bytes_are_refused(bench: Bench, change: Callable[[bytes], bytes], words: str) -> None:
    """A wrong length or checksum never reaches the robot, and the stream goes on."""
    bench.walk()
    assert bench.take(bench.message(change(ENCODER.encode(HOLD)))) is None
    assert words in bench.why()
    assert bench.judge.refused == {"bytes": 1}
    assert bench.send(HOLD) is not None


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_is_refused(bench: Bench, value: float) -> None:
    """Its checksum is right, and the encoder of deal-hw would not have made it."""
    bench.walk()
    data = bytearray(ENCODER.encode(HOLD))
    data[28:32] = np.float32(value).tobytes()
    data[808:] = words_crc(low_command_image(bytes(data))).to_bytes(4, "little")
    assert bench.take(bench.message(bytes(data))) is None
    assert "not finite" in bench.why()


def with_joint(command: LowCommand, name: str, value: float) -> LowCommand:
    """Return a command with one number of its fourth joint changed."""
    changed = getattr(command, name).copy()
    changed[3] = value
    return dataclasses.replace(command, **{name: changed})


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("position", 3.0, "target of joint 'FR_hip_joint' is 3 rad"),
        ("stiffness", 80.1, "stiffness of joint"),
        ("stiffness", -0.1, "stiffness of joint"),
        ("damping", 5.1, "damping of joint"),
        ("damping", -0.1, "damping of joint"),
        ("effort", 24.0, "feed-forward of joint"),
        ("velocity", 60.0, "torque now of joint"),
        ("mode", 10, "motor modes"),
    ],
)
def test_what_exceeds_the_limits_is_refused(bench: Bench, name: str, value: float, words: str) -> None:
    """Gains, targets and torques of the driver's description, each named with its range."""
    bench.walk()
    assert bench.send(with_joint(HOLD, name, value)) is None
    assert words in bench.why()
    assert bench.judge.refused == {"limits": 1}


def test_at_the_limits_commands_pass(frame: LowStateFrame) -> None:
    """Exactly at a limit of float64, which the wire rounds."""
    limits = CommandLimits(DESCRIPTION, 10.0)
    low, high = np.array(DESCRIPTION.limits.target).T
    for target in (low, high):
        command = LowCommand(
            target.astype(np.float32).astype(float),
            ZERO,
            np.full(12, 1.0),
            np.array(DESCRIPTION.limits.damping),
            ZERO,
        )
        assert limits.complaint(command, frame) == ""


def test_a_target_without_a_gain_means_nothing(frame: LowStateFrame) -> None:
    """The vendor's stop values pass: they brake; without a state nothing else does."""
    limits = CommandLimits(DESCRIPTION, 2.0)
    stop = LowCommand(np.full(12, 2.146e9), np.full(12, 16000.0), ZERO, ZERO, ZERO)
    assert limits.complaint(stop, frame) == ""
    assert not is_damping(stop)
    assert limits.complaint(DAMPING, None) == ""
    assert "no valid state" in limits.complaint(HOLD, None)


def test_a_fast_joint_may_be_braked_but_not_driven(frame: LowStateFrame) -> None:
    """Damping passes at any speed; the same gain with a target asks for more than the motors give."""
    fast = dataclasses.replace(FakeGo2().state(), position=POSE, velocity=np.full(12, 25.0))
    spinning = decode_low_state(encode_low_state(fast))
    limits = CommandLimits(DESCRIPTION, 2.0)
    assert limits.complaint(DAMPING, spinning) == ""
    assert "torque now" in limits.complaint(dataclasses.replace(HOLD, damping=np.full(12, 5.0)), spinning)


def test_a_description_without_legs_is_refused() -> None:
    """The cart-pole has no bridge."""
    from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE

    with pytest.raises(ConfigurationError, match="no limits for legs"):
        CommandLimits(CARTPOLE, 2.0)


def test_requests_pass_from_whoever_may_command(bench: Bench) -> None:
    """Before a hand-over any controller's; after it the holder's alone."""
    topic, payload = request("motion_switcher", 1001)
    assert bench.judge.request(bench.message(payload, 2, topic=topic), bench.now_ns)
    bench.walk()
    assert bench.judge.request(bench.message(payload, 1, topic=topic), bench.now_ns)
    assert not bench.judge.request(bench.message(payload, 2, topic=topic), bench.now_ns)
    assert "another controller" in bench.why()
    assert not bench.judge.request(bench.message(payload, 1, topic=topic, age_ms=60), bench.now_ns)
    assert not bench.judge.request(bench.message(b"rubbish", 1, topic=topic), bench.now_ns)
    assert bench.judge.refused == {"holder": 1, "age": 1, "bytes": 1}


@pytest.mark.parametrize(
    ("service", "api", "parameter"),
    [
        ("motion_switcher", 1002, {"name": "normal"}),
        ("robot_state", 1001, {"name": "sport_mode", "switch": 1}),
    ],
)
def test_a_robot_that_is_handed_back_is_left_alone(
    bench: Bench, service: str, api: int, parameter: object
) -> None:
    """Only a passive one; then sport mode stands it up, and damping would throw it down."""
    topic, payload = request(service, api, parameter)
    bench.walk()
    assert not bench.judge.request(bench.message(payload, topic=topic), bench.now_ns)
    assert "damp it first" in bench.why()
    assert bench.send(DAMPING) is not None
    assert bench.judge.request(bench.message(payload, topic=topic), bench.now_ns)
    assert bench.judge.control is Control.IDLE
    assert bench.wait(5000) == 0


@pytest.mark.parametrize("parameter", ['{"name": "sport_mode", "switch": 0}', "[1]", '"text"', "{"])
def test_switching_the_old_sport_mode_off_is_no_hand_back(bench: Bench, parameter: str) -> None:
    """The bridge goes on damping."""
    bench.judge.take_charge("test")
    topic, payload = topics.request("robot_state"), encode_request(Request(1, 1001, parameter))
    assert bench.judge.request(bench.message(payload, topic=topic), bench.now_ns)
    assert bench.judge.control is Control.DAMPING


def test_damping_yields_to_a_program_on_the_robots_side(bench: Bench) -> None:
    """Two who command make the robot jump; a controller behind the bridge is not taken off for it."""
    bench.walk()
    bench.judge.yield_to_robot_side(bench.now_ns)
    assert bench.judge.control is Control.CONTROLLED
    bench.wait(52)
    bench.judge.yield_to_robot_side(bench.now_ns)
    assert bench.judge.control is Control.IDLE
    assert bench.wait(100) == 0


def test_streams_are_forgotten_in_order(bench: Bench) -> None:
    """A hundred controllers later the judge remembers a bounded number of them."""
    for stream in range(100):
        bench.walk(stream)
        bench.wait(60)
    assert len(bench.judge._newest) <= 64


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["damping", "hold", "wrong", "wait"]),
        st.integers(1, 3),
        st.sampled_from([0.0, 1.0, 49.0, 51.0, 400.0, -1.0]),
        st.booleans(),
    ),
    max_size=60,
)


@given(events=EVENTS)
def test_whatever_comes_the_rules_hold(
    frame: LowStateFrame, events: list[tuple[str, int, float, bool]]
) -> None:
    """Stiff commands pass from one stream only, after its damping, and never after too long a silence."""
    bench = Bench(frame)
    commands = {"damping": DAMPING, "hold": HOLD, "wrong": with_joint(HOLD, "position", 3.0)}
    holder, last_ns, stiff = None, 0, False
    for kind, stream, number, again in events:
        if kind == "wait":
            bench.wait(max(number, 0))
        else:
            bench.now_ns += 2 * MS
            bench.judge.tick(bench.now_ns)
        silent_ns = bench.now_ns - last_ns
        if holder is not None and silent_ns > (44 if stiff else 1000) * MS:
            holder = None
            assert bench.judge.control is Control.DAMPING
        if kind == "wait":
            continue
        if again:
            bench.sequence[stream] = bench.sequence.get(stream, 0) - 1
        newest = bench.judge._newest.get((stream, topics.LOW_COMMAND), -1)
        message = bench.message(ENCODER.encode(commands[kind]), stream, age_ms=number)
        passed = bench.take(message) is not None
        fit = 0 <= number <= 50 and bench.sequence[stream] > newest and kind != "wrong"
        mine = holder == stream or (holder is None and kind == "damping")
        assert passed == (fit and mine)
        if passed:
            holder, last_ns, stiff = stream, bench.now_ns, kind == "hold"
        bench.sequence[stream] = max(bench.sequence[stream], newest)


def test_a_program_that_releases_a_mode_has_time_to_command() -> None:
    """Between release and first command deal-hw's driver pauses and listens; damping would make it refuse."""
    needs_s = RELEASE_PAUSE_S + LISTEN_S + PATIENCE_S
    side, asked_ns = RobotSide(), 10**12
    assert side.to_ask(asked_ns)
    side.answered("normal")
    side.commanded(asked_ns)  # by the mode itself
    times = range(asked_ns + ASK_NS, asked_ns + 7 * 10**9, ASK_NS)
    deserted = []
    for now_ns in times:
        assert side.to_ask(now_ns)
        side.answered("")
        if side.deserted(now_ns):
            deserted.append(now_ns - asked_ns)
    assert needs_s < deserted[0] * 1e-9 <= 5.0
    side.commanded(times[-1])
    assert not side.deserted(times[-1] + ASK_NS - MS)
    assert side.to_ask(times[-1] + ASK_NS)
    side.answered("")
    assert side.deserted(times[-1] + ASK_NS), "after its last command it has 0.5 s, not 5"
