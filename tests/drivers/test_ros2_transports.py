"""ROS 2's topics over real DDS and real Zenoh: the contract of topics, and what discovery shows of others."""

from __future__ import annotations

import contextlib
import importlib.util
import random
import socket
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import zenoh

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.ros2.connect import make_link
from deal_hw.drivers.ros2.messages import (
    COMMAND_TYPES,
    HASHES,
    STATE_TYPE,
    JointStates,
    encode_joint_states,
    encode_positions,
)
from deal_hw.drivers.ros2.rmw_zenoh import RmwZenohTransport
from deal_hw.drivers.ros2.topics import topics_of
from deal_hw.drivers.ros2.zenoh_keys import (
    SUBSCRIBER,
    Attachment,
    Token,
    data_key,
    read_attachment,
)
from deal_hw.errors import TransportError, TransportTimeoutError, UnknownNameError
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.testing.transport_suite import TopicPair, TopicTransportSuite, meet
from deal_hw.transport import Message, TopicTransport, WireOptions

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="pip install 'deal-hw[dds]'"),
]

SECTION = Ros2Section(bus="ros2_control", controller="arm", joints=("a", "b"))
TOPICS = topics_of(SECTION)
HUMBLE = "TypeHashNotSupported"


def payload(topic: str, number: int) -> bytes:
    """Return a message with a number."""
    values = np.full(2, float(number))
    if topic == TOPICS.commands:
        return encode_positions(values)
    return encode_joint_states(JointStates(number, ("a", "b"), values, values, values))


def endpoint() -> str:
    """Return an end point that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def make_pair(wire: str) -> TopicPair:
    """Return a driver's transport and an emulated robot's."""
    section = Ros2Section(
        bus="ros2_control",
        controller="arm",
        joints=("a", "b"),
        domain=random.SystemRandom().randrange(10, 100),
    )
    port = "lo" if wire == "dds" else endpoint()
    near, far = (
        make_link(section, wire, port, MonotonicClock(), emulated=emulated) for emulated in (True, False)
    )
    return TopicPair(near=near, far=far, down=TOPICS.states, up=TOPICS.commands, payload=payload)


class _Suite(TopicTransportSuite):
    wire = ""

    @pytest.fixture
    def pair(self) -> Iterator[TopicPair]:
        made = make_pair(self.wire)
        with contextlib.closing(made.near), contextlib.closing(made.far):
            yield made


class TestDds(_Suite):
    wire = "dds"


class TestRmwZenoh(_Suite):
    wire = "zenoh"


@pytest.fixture(params=["dds", "zenoh"])
def pair(request: pytest.FixtureRequest) -> Iterator[TopicPair]:
    """A robot and a driver that have met."""
    made = make_pair(request.param)
    made.near.declare(publish=[made.down], subscribe=[made.up])
    made.far.declare(publish=[made.up], subscribe=[made.down, made.up])
    with made.near, made.far:
        meet(made)
        yield made


def until(found: Callable[[], bool], transport: TopicTransport) -> bool:
    """Read a transport until something is true; return whether it became so."""
    for _ in range(250):
        if found():
            return True
        # Over Zenoh the link is lost with the peer.
        with contextlib.suppress(TransportError):
            transport.receive(0.02)
    return False


def test_each_side_sees_the_other(pair: TopicPair) -> None:
    """With types, hashes, and whether it is a deal-hw that commands."""
    assert until(lambda: len(pair.far.ends(TOPICS.commands) or ()) == 1, pair.far)
    (robot,) = pair.far.ends(TOPICS.commands) or ()
    assert not robot.writes and not robot.ours
    (states,) = [end for end in pair.far.ends(TOPICS.states) or () if end.writes]
    assert (states.type_name, states.type_hash) == (STATE_TYPE, HASHES[STATE_TYPE])
    assert until(lambda: len(pair.near.ends(TOPICS.commands) or ()) == 2, pair.near)
    ours = pair.near.ends(TOPICS.commands) or ()
    assert {end.writes for end in ours} == {True, False} and all(end.ours for end in ours)
    assert len(pair.near.writers(TOPICS.commands)) == 1


def test_one_that_left_is_seen_no_more(pair: TopicPair) -> None:
    """A controller that was unloaded."""
    assert until(lambda: bool(pair.far.ends(TOPICS.commands)), pair.far)
    pair.near.close()
    assert until(lambda: not pair.far.ends(TOPICS.commands), pair.far)


def test_a_topic_without_a_type_is_refused() -> None:
    """On both."""
    for wire in ("dds", "zenoh"):
        link = make_link(SECTION, wire, "lo" if wire == "dds" else endpoint(), MonotonicClock())
        with pytest.raises(UnknownNameError, match="rt/other"):
            link.declare(subscribe=["rt/other"])


# What only rmw_zenoh has.


@pytest.fixture
def listening() -> Iterator[tuple[RmwZenohTransport, zenoh.Session]]:
    """A driver that waits, and a session of plain Zenoh that comes to it as a ROS program does."""
    port = endpoint()
    near = RmwZenohTransport(
        port, MonotonicClock(), WireOptions(listen=True), typed=TOPICS.typed, domain=3, emulated=False
    )
    near.declare(publish=[TOPICS.commands], subscribe=[TOPICS.states])
    near.open()
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)
    with contextlib.closing(near):
        yield near, session
    session.close()  # type: ignore[no-untyped-call]


def test_bytes_of_a_publisher(listening: tuple[RmwZenohTransport, zenoh.Session]) -> None:
    """Key, encoding and attachment of a command, as a subscriber of ROS gets them."""
    near, session = listening
    got: list[zenoh.Sample] = []
    subscriber = session.declare_subscriber("3/**", got.append)
    data = payload(TOPICS.commands, 1)
    for _ in range(250):
        near.send(Message(TOPICS.commands, data, 0))
        with contextlib.suppress(TransportTimeoutError):
            near.receive(0.02)
        if got:
            break
    name = COMMAND_TYPES["position"]
    assert str(got[0].key_expr) == f"3/arm/commands/{name}/{HASHES[name]}"
    assert got[0].payload.to_bytes() == data
    assert str(got[0].encoding) == "application/cdr"
    attachment = got[0].attachment
    assert attachment is not None
    found = read_attachment(attachment.to_bytes())
    assert found.sequence >= 1 and not found.keyed and found.stamp_ns > 1_700_000_000 * 10**9
    subscriber.undeclare()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("keyed", [False, True])
@pytest.mark.parametrize("type_hash", [HASHES[STATE_TYPE], HUMBLE])
def test_states_of_each_generation(
    listening: tuple[RmwZenohTransport, zenoh.Session], keyed: bool, type_hash: str
) -> None:
    """Under any hash; our attachments then have the form of the robot's."""
    near, session = listening
    publisher = session.declare_publisher(data_key(3, "joint_states", STATE_TYPE, type_hash))
    attachment = Attachment(1, 2, bytes(16), keyed).encode()
    data = payload(TOPICS.states, 3)
    message = None
    for _ in range(250):
        publisher.put(data, attachment=attachment)
        with contextlib.suppress(TransportTimeoutError):
            message = near.receive(0.02)
            break
    assert message is not None and (message.channel, message.payload) == (TOPICS.states, data)
    assert read_attachment(near._next_attachment(TOPICS.commands)).keyed is keyed


def test_a_controller_of_humble_gets_commands(
    listening: tuple[RmwZenohTransport, zenoh.Session],
) -> None:
    """Its token has no hash, and neither has the key to which it subscribes."""
    near, session = listening
    got: list[zenoh.Sample] = []
    name = COMMAND_TYPES["position"]
    subscriber = session.declare_subscriber(data_key(3, "arm/commands", name, HUMBLE), got.append)
    token = Token(
        session=str(session.info.zid()),
        node_id=0,
        entity_id=1,
        kind=SUBSCRIBER,
        namespace="",
        node="arm",
        topic="arm/commands",
        type_name=name,
        type_hash=HUMBLE,
    )
    held = session.liveliness().declare_token(token.key(3))
    for _ in range(250):
        near.send(Message(TOPICS.commands, payload(TOPICS.commands, 1), 0))
        with contextlib.suppress(TransportTimeoutError):
            near.receive(0.02)
        if got:
            break
    assert got and got[0].payload.to_bytes() == payload(TOPICS.commands, 1)
    held.undeclare()  # type: ignore[no-untyped-call]
    subscriber.undeclare()  # type: ignore[no-untyped-call]
