"""The DDS transport fulfils the contract, in one process and between two."""

from __future__ import annotations

import importlib.util
import random
import re
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial

import pytest

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.transports import dds_domain, dds_types
from deal_hw.drivers.transports.dds_domain import acquire_domain, domain_xml, release_domain
from deal_hw.drivers.transports.dds_session import ArrivalClock
from deal_hw.drivers.transports.dds_transport import DdsTransport
from deal_hw.drivers.transports.dds_types import load_types
from deal_hw.drivers.transports.interfaces import Interface
from deal_hw.drivers.transports.topics import HUMANOID_TYPES
from deal_hw.errors import (
    ConfigurationError,
    FrameError,
    MissingExtraError,
    PortNotFoundError,
    TransportError,
    TransportTimeoutError,
    UnknownNameError,
    VersionMismatchError,
)
from deal_hw.install import install_line
from deal_hw.testing.transport_suite import TopicPair, TopicTransportSuite
from deal_hw.transport import Message, WireOptions

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="pip install 'deal-hw[dds]'"),
]

BYTES = {"rt/lowcmd": 812, "rt/lowstate": 1180, "rt/wirelesscontroller": 22}
HEADER = bytes([0, 1, 0, 0])


def payload(topic: str, number: int) -> bytes:
    """Return a message of the right length whose every octet is a number."""
    return HEADER + bytes([number]) * (BYTES[topic] - 4)


@pytest.fixture
def domain() -> int:
    """A domain that other runs on this machine hardly use at the same time."""
    return random.SystemRandom().randrange(10, 100)


class TestDdsTransport(TopicTransportSuite):
    @pytest.fixture
    def pair(self, domain: int) -> Iterator[TopicPair]:
        near, far = (DdsTransport("lo", MonotonicClock(), WireOptions(domain=domain)) for _ in range(2))
        yield TopicPair(near=near, far=far, down="rt/lowcmd", up="rt/lowstate", payload=payload)
        near.close()
        far.close()


def make(domain: int, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = ()) -> DdsTransport:
    """Return a transport on loopback with its topics declared."""
    wire = DdsTransport("lo", MonotonicClock(), WireOptions(domain=domain))
    wire.declare(publish=publish, subscribe=subscribe)
    return wire


@contextmanager
def child(script: str, domain: int) -> Iterator[subprocess.Popen[str]]:
    """Run a script in another process; kill it at the end, stopped or not."""
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(domain)], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def patiently(wire: DdsTransport, done: Callable[[], object], act: Callable[[], None] = lambda: None) -> None:
    """Act and wait until something is true; it fails after many tries, however slow the machine is."""
    for _ in range(400):
        act()
        if done():
            return
        with suppress(TransportTimeoutError):
            wire.receive(0.05)
    raise AssertionError("it never became true")


def test_a_wrong_interface_is_refused_with_those_at_hand() -> None:
    """The text names the interface asked for and lists loopback with its address."""
    wire = DdsTransport("eth77", MonotonicClock())
    with pytest.raises(PortNotFoundError, match=r"'eth77'.*lo 127\.0\.0\.1"):
        wire.open()


def test_a_topic_without_a_known_type_is_refused() -> None:
    """DDS needs the type; the text lists the topics."""
    with pytest.raises(UnknownNameError, match=r"'rt/arm_sdk'.*rt/lowcmd"):
        DdsTransport("lo", MonotonicClock()).declare(publish=["rt/arm_sdk"])


@pytest.mark.parametrize("data", [b"", HEADER, payload("rt/lowcmd", 1)[:-1]])
def test_a_payload_that_is_no_message_of_the_type_is_refused(domain: int, data: bytes) -> None:
    """Cyclone checks the bytes against the type before they reach a robot."""
    with make(domain, publish=("rt/lowcmd",)) as wire, pytest.raises(FrameError, match="LowCmd_"):
        wire.send(Message("rt/lowcmd", data, 0))


def test_without_cyclonedds_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Opening says what to install; making and declaring need nothing."""
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    load_types.cache_clear()
    wire = make(1, publish=("rt/lowcmd",))
    with pytest.raises(MissingExtraError, match=re.escape(install_line("dds"))):
        wire.open()


def test_foreign_types_keep_the_domain_shut(monkeypatch: pytest.MonkeyPatch, domain: int) -> None:
    """With a hash that is not the robot's, nothing is opened, so no peer can be hurt."""
    load_types.cache_clear()
    monkeypatch.setattr(dds_types, "MINIMAL", dict.fromkeys(dds_types.MINIMAL, "00" * 14))
    with pytest.raises(VersionMismatchError, match="crash the robot"):
        make(domain, publish=("rt/lowcmd",)).open()
    assert domain not in dds_domain._OPENED
    load_types.cache_clear()


def test_the_environment_does_not_choose_the_interface(monkeypatch: pytest.MonkeyPatch, domain: int) -> None:
    """A CYCLONEDDS_URI that points nowhere, as a ROS set-up leaves it, does no harm."""
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Nonsense/></CycloneDDS>")
    with make(domain, publish=("rt/lowcmd",)) as wire:
        wire.send(Message("rt/lowcmd", payload("rt/lowcmd", 1), 0))


def test_one_domain_has_one_interface_in_a_process(domain: int) -> None:
    """A second interface is refused while the first is open, and free again afterwards."""
    other = Interface("eth5", ("127.0.0.1",), up=True, carrier=True, multicast=True, loopback=True)
    with make(domain), pytest.raises(ConfigurationError, match="'lo'"):
        acquire_domain(domain, other)
    acquire_domain(domain, other)
    release_domain(domain)
    assert domain not in dds_domain._OPENED


def test_a_forked_child_is_told_to_start_anew(monkeypatch: pytest.MonkeyPatch, domain: int) -> None:
    """Cyclone's threads do not survive a fork; waiting for them would last for ever."""
    with make(domain):
        monkeypatch.setattr("os.getpid", lambda: -1)
        with pytest.raises(TransportError, match="fork"):
            make(domain).open()
        monkeypatch.undo()


def test_an_exception_inside_leaves_nothing_on_the_wire(domain: int) -> None:
    """Although the traceback still holds the transport, its peer sees it leave."""
    watcher = make(domain, subscribe=("rt/lowcmd",))
    with watcher:
        try:
            with make(domain, publish=("rt/lowcmd",)):
                patiently(watcher, lambda: watcher.writers("rt/lowcmd"))
                raise RuntimeError("policy failed")
        except RuntimeError as error:
            patiently(watcher, lambda: not watcher.writers("rt/lowcmd"))
            assert error.__traceback__ is not None
    assert domain not in dds_domain._OPENED


def test_a_failed_open_gives_the_domain_back(monkeypatch: pytest.MonkeyPatch, domain: int) -> None:
    """What was made so far is deleted, and the next open works."""
    wire = make(domain, publish=("rt/lowcmd",))
    with monkeypatch.context() as patch:
        patch.setattr("cyclonedds.pub.DataWriter", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            wire.open()
    assert domain not in dds_domain._OPENED
    with wire:
        wire.send(Message("rt/lowcmd", payload("rt/lowcmd", 1), 0))


def test_xml_forces_multicast_on_loopback_and_names_other_interfaces() -> None:
    """The one form for loopback that works between Cyclone 0.10.2 and 11, and the SDK's form for a cable."""
    lo = Interface("lo", ("127.0.0.1",), up=True, carrier=True, multicast=False, loopback=True)
    eth = Interface("eth0", ("192.168.123.99",), up=True, carrier=True, multicast=True, loopback=False)
    assert '<NetworkInterface address="127.0.0.1" multicast="true"/>' in domain_xml(3, lo)
    assert '<NetworkInterface name="eth0" multicast="default"/>' in domain_xml(0, eth)


def test_cyclone_is_silent_once_open(domain: int) -> None:
    """A line per failed send on a slow terminal would hold the control loop; only fatal errors remain (1)."""
    from cyclonedds.internal import DDS

    with make(domain):
        assert DDS._dll_handle.dds_get_log_mask() == 1


def test_the_raw_calls_of_cyclonedds_are_still_there(domain: int) -> None:
    """If this fails, cyclonedds changed them: mend dds_session.py before the pin in pyproject moves."""
    from cyclonedds import _clayer

    advice = "cyclonedds changed its private raw calls; see deal_hw.drivers.transports.dds_session"
    assert {"ddspy_write", "ddspy_take"} <= set(dir(_clayer)), advice
    data = payload("rt/lowcmd", 9)
    reader = make(domain, subscribe=("rt/lowcmd",))
    with make(domain, publish=("rt/lowcmd",)) as writer, reader:
        session, sender = reader._live, writer._live
        assert session is not None
        assert sender is not None
        patiently(writer, lambda: reader.writers("rt/lowcmd"))
        assert sender.write(sender.writers["rt/lowcmd"], data) == 0, advice
        ((_, reader_entity),) = session._readers
        (sample,) = session._take(reader_entity._ref, session._mask, 5)
        assert sample[0] == data, advice
        assert isinstance(sample[1].source_timestamp, int), advice
        assert isinstance(sample[1].publication_handle, int), advice
        assert sample[1].valid_data, advice


WRITER = """
import sys
from deal_hw.clock import MonotonicClock
from deal_hw.drivers.transports.dds_transport import DdsTransport
from deal_hw.transport import WireOptions
wire = DdsTransport("lo", MonotonicClock(), WireOptions(domain=int(sys.argv[1])))
wire.declare(publish=["rt/lowcmd"])
wire.open()
sys.stdin.read()
"""


def test_another_writer_is_named_until_it_is_killed(domain: int) -> None:
    """Process and host are named; a killed process of this computer does not haunt us for the 10 s of DDS."""
    with make(domain, subscribe=("rt/lowcmd",)) as wire, child(WRITER, domain) as other:
        patiently(wire, lambda: wire.writers("rt/lowcmd"))
        (writer,) = wire.writers("rt/lowcmd")
        assert "deal-hw" in writer
        assert f"pid {other.pid}" in writer
        assert socket.gethostname() in writer
        assert wire.writers("rt/lowstate") == ()
        other.kill()
        other.wait()
        assert wire.writers("rt/lowcmd") == ()


RELIABLE_READER = """
import sys
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from deal_hw.drivers.transports.dds_domain import acquire_domain
from deal_hw.drivers.transports.dds_types import load_types
from deal_hw.drivers.transports.topics import HUMANOID_TYPES
from deal_hw.drivers.transports.interfaces import find_interface
domain = int(sys.argv[1])
acquire_domain(domain, find_interface("lo"))
participant = DomainParticipant(domain)
topic = Topic(participant, "rt/lowcmd", load_types()["unitree_go::msg::dds_::LowCmd_"])
reader = DataReader(participant, topic, qos=Qos(Policy.Reliability.Reliable(10**8), Policy.History.KeepAll))
next(iter(reader.take_iter()))
print("received", flush=True)
sys.stdin.read()
"""


def test_a_frozen_peer_that_must_confirm_holds_no_send_up(domain: int) -> None:
    """Ten thousand commands to a stopped Reliable reader all go out; none waits for it, none is refused."""
    message = Message("rt/lowcmd", payload("rt/lowcmd", 1), 0)
    with make(domain, publish=("rt/lowcmd",)) as wire, child(RELIABLE_READER, domain) as frozen:
        assert frozen.stdout is not None
        received = frozen.stdout
        patiently(wire, lambda: select.select([received], [], [], 0)[0], lambda: wire.send(message))
        frozen.send_signal(signal.SIGSTOP)
        for _ in range(10_000):
            wire.send(message)


def test_messages_that_waited_are_stamped_as_they_arrived() -> None:
    """A fresh one written at 100 arrives at 1000: the writer's clock is 900 behind. Later ones waited."""
    clock = ArrivalClock()
    assert clock.stamps_ns([[("a", 100)]], 1000, fresh=True) == [[1000]]
    assert clock.stamps_ns([[("a", 102), ("a", 104)]], 1050, fresh=False) == [[1002, 1004]]


def test_no_stamp_lies_in_the_future() -> None:
    """A slow fresh one (900) is corrected by a quicker one: written at 200, there at 1050, so 850 at most."""
    clock = ArrivalClock()
    clock.stamps_ns([[("a", 100)]], 1000, fresh=True)
    assert clock.stamps_ns([[("a", 190), ("a", 200)]], 1050, fresh=False) == [[1040, 1050]]


def test_a_writers_clock_that_jumps_back_does_not_turn_messages_round() -> None:
    """Written at 500, after the jump at 50: the stamp does not fall; a fresh one finds the clock again."""
    clock = ArrivalClock()
    clock.stamps_ns([[("a", 400)]], 1000, fresh=True)
    assert clock.stamps_ns([[("a", 500), ("a", 50)]], 1200, fresh=False) == [[1100, 1100]]
    assert clock.stamps_ns([[("a", 60)]], 1210, fresh=True) == [[1210]]


def test_participants_have_clocks_of_their_own() -> None:
    """Two computers write one topic, one an hour ahead."""
    clock = ArrivalClock()
    assert clock.stamps_ns([[("a", 100), ("b", 3_600_100)]], 1000, fresh=True) == [[1000, 1000]]
    assert clock.stamps_ns([[("a", 110), ("b", 3_600_120)]], 1100, fresh=False) == [[1010, 1020]]


def test_topics_of_a_participant_share_its_clock() -> None:
    """Written at 100 and 103 on two topics, seen at 1000: the first waited 3."""
    assert ArrivalClock().stamps_ns([[("a", 100)], [("a", 103)]], 1000, fresh=True) == [[997], [1000]]


def test_messages_of_several_topics_come_in_the_order_of_writing(domain: int) -> None:
    """States and remote control alternate, although each topic has a queue of its own."""
    far = make(domain, publish=("rt/lowstate", "rt/wirelesscontroller"))
    near = make(domain, subscribe=("rt/lowstate", "rt/wirelesscontroller"))
    with far, near:
        for topic in ("rt/lowstate", "rt/wirelesscontroller"):
            patiently(far, partial(near.writers, topic))
        sent = ["rt/lowstate", "rt/wirelesscontroller"] * 10
        for topic in sent:
            far.send(Message(topic, payload(topic, 1), 0))
        assert [near.receive(5.0).channel for _ in sent] == sent


@pytest.mark.parametrize(("code", "error"), [(-10, TransportTimeoutError), (-1, TransportError)])
def test_what_dds_refuses_is_an_error(domain: int, code: int, error: type[Exception]) -> None:
    """A full queue is a time-out at once; anything else is reported with its code."""
    with make(domain, publish=("rt/lowcmd",)) as wire:
        assert wire._live is not None
        wire._live.write = lambda *_: code
        with pytest.raises(error):
            wire.send(Message("rt/lowcmd", payload("rt/lowcmd", 1), 0))


def test_a_failing_library_is_an_error_not_silence(domain: int) -> None:
    """Neither a failed take nor a failed wait looks like a robot that says nothing."""
    from cyclonedds.core import DDSException

    def fail(_: int) -> int:
        raise DDSException(-1)

    with make(domain, subscribe=("rt/lowstate",)) as wire:
        assert wire._live is not None
        wire._live._waitset.wait = fail
        with pytest.raises(TransportError, match="waiting"):
            wire.receive(0.1)
        wire._live._take = lambda *_: -1
        with pytest.raises(TransportError, match="rt/lowstate"):
            wire.receive(0.1)


def humanoid(domain: int, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = ()) -> DdsTransport:
    """Return a transport on loopback for a G1's topics."""
    wire = make(domain, publish=publish, subscribe=subscribe)
    wire.name_types(HUMANOID_TYPES)
    return wire


def test_a_g1s_topics_have_its_own_types(domain: int) -> None:
    """1004 bytes arrive where both name the type; the Go2's command is then no message of it."""
    frame = HEADER + bytes(1000)
    with (
        humanoid(domain, publish=("rt/lowcmd",)) as near,
        humanoid(domain, subscribe=("rt/lowcmd",)) as far,
    ):
        heard: list[bytes] = []

        def act() -> None:
            near.send(Message("rt/lowcmd", frame, 0))
            with suppress(TransportTimeoutError):
                heard.append(far.receive(0.05).payload)

        patiently(far, lambda: heard, act)
        assert heard[0] == frame
        with pytest.raises(FrameError, match=r"unitree_hg::msg::dds_::LowCmd_"):
            near.send(Message("rt/lowcmd", payload("rt/lowcmd", 1), 0))


def test_a_go2_and_a_g1_do_not_hear_each_other(domain: int) -> None:
    """One topic with two types: no message passes, and the survey says which type the other has."""
    with (
        humanoid(domain, publish=("rt/lowstate",)) as g1,
        make(domain, subscribe=("rt/lowstate",)) as go2,
    ):
        patiently(go2, lambda: go2.survey().complaints, lambda: g1.send(_hg_state()))
        (complaint,) = go2.survey().complaints
        assert (
            "unitree_hg::msg::dds_::LowState_, not unitree_go" in complaint and "another robot" in complaint
        )
        with pytest.raises(TransportTimeoutError):
            go2.receive(0.05)


def _hg_state() -> Message:
    return Message("rt/lowstate", HEADER + bytes(2088), 0)
