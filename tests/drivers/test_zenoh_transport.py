"""The Zenoh transport: the contract of topics, who may connect, lost links, frozen peers, clean exits."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from deal_hw.clock import MonotonicClock, VirtualClock
from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
from deal_hw.errors import (
    ConfigurationError,
    PortBusyError,
    PortNotFoundError,
    TransportLostError,
    TransportTimeoutError,
)
from deal_hw.testing.transport_suite import TopicPair, TopicTransportSuite, meet, next_message
from deal_hw.transport import Message, WireOptions

pytestmark = pytest.mark.real_time

COMMAND, STATE = "rt/lowcmd", "rt/lowstate"
LISTEN = WireOptions(listen=True)


def payload(topic: str, number: int) -> bytes:
    """Return a message of the size of the real ones, all of it the number."""
    return bytes([number]) * {COMMAND: 812, STATE: 1180}[topic]


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Return a port of the loopback interface that nobody uses."""
    with socket.socket(type=kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def endpoint() -> str:
    """Return an end point that nobody uses."""
    return f"tcp/127.0.0.1:{free_port()}"


def make_pair(near: ZenohTransport, far: ZenohTransport) -> TopicPair:
    """Return a pair with the Go2's topics."""
    return TopicPair(near=near, far=far, down=COMMAND, up=STATE, payload=payload)


class TestZenohTransport(TopicTransportSuite):
    @pytest.fixture(params=["tcp peer", "tcp client", "udp peer"])
    def pair(self, request: pytest.FixtureRequest) -> Iterator[TopicPair]:
        """The far end goes to the near one, as a peer or as a client."""
        protocol, mode = request.param.split()
        kind = socket.SOCK_STREAM if protocol == "tcp" else socket.SOCK_DGRAM
        endpoint = f"{protocol}/127.0.0.1:{free_port(kind)}"
        near = ZenohTransport(endpoint, MonotonicClock(), LISTEN)
        far = ZenohTransport(endpoint, MonotonicClock(), WireOptions(mode=mode))
        with contextlib.closing(near), contextlib.closing(far):
            yield make_pair(near, far)


def opened(transport: ZenohTransport, publish: str, subscribe: str) -> ZenohTransport:
    """Return the transport, opened with its topics."""
    transport.declare(publish=[publish], subscribe=[subscribe])
    transport.open()
    return transport


def send_until_heard(sender: ZenohTransport, receiver: ZenohTransport) -> None:
    """Send states until one arrives at a side whose link comes back by itself."""
    for _ in range(3000):
        sender.send(Message(STATE, payload(STATE, 4), 0))
        with contextlib.suppress(TransportTimeoutError, TransportLostError):
            receiver.receive(0.02)
            return
    pytest.fail("the link did not come back")


def wait_for_arrival(receiver: ZenohTransport, data: bytes, again: Callable[[], None] | None = None) -> None:
    """Wait until a message is at hand, without taking it: one in flight may be lost with the link.

    Args:
        receiver: The side where it arrives.
        data: The message.
        again: Sends it once more, where the wire may drop it.
    """
    arrived = receiver._arrived
    for _ in range(600):
        if any(message is not None and message.payload == data for message in list(arrived._items)):
            return
        if select.select([arrived._read_fd], [], [], 0.1)[0]:
            os.read(arrived._read_fd, 65536)
        elif again is not None:
            again()
    pytest.fail("nothing arrived")


def test_a_client_hears_a_second_controller_and_a_peer_does_not(endpoint: str) -> None:
    """Commands of one controller reach the other through the robot's side where both are clients."""
    with opened(ZenohTransport(endpoint, options=LISTEN), STATE, COMMAND) as robot:
        for mode, received in (("client", True), ("peer", False)):
            first, second = (ZenohTransport(endpoint, options=WireOptions(mode=mode)) for _ in range(2))
            with opened(first, STATE, COMMAND), opened(second, COMMAND, STATE):
                meet(TopicPair(near=robot, far=second, down=STATE, up=COMMAND, payload=payload))
                for _ in range(20):
                    second.send(Message(COMMAND, payload(COMMAND, 1), 0))
                if received:
                    assert first.receive(5.0).channel == COMMAND
                else:
                    with pytest.raises(TransportTimeoutError):
                        first.receive(0.2)


def test_a_lost_link_is_news_for_the_side_that_went_there_until_it_is_back(endpoint: str) -> None:
    """What was at hand comes first, then TransportLostError; with the robot's side back, all works again."""
    near = ZenohTransport(endpoint)
    far = ZenohTransport(endpoint, options=LISTEN)
    with opened(far, STATE, COMMAND), opened(near, COMMAND, STATE):
        pair = make_pair(near, far)
        meet(pair)
        far.send(Message(STATE, payload(STATE, 3), 0))
        wait_for_arrival(near, payload(STATE, 3))
        far.close()
        assert next_message(pair, near).payload == payload(STATE, 3)
        with pytest.raises(TransportLostError, match="no connection"):
            near.receive(5.0)
        with pytest.raises(TransportLostError, match="no connection"):
            near.receive(0.0)
        with pytest.raises(TransportLostError, match="no connection"):
            near.send(Message(COMMAND, payload(COMMAND, 1), 0))
        far.open()
        send_until_heard(far, near)
        near.send(Message(COMMAND, payload(COMMAND, 5), 0))
        assert next_message(pair, far).payload == payload(COMMAND, 5)


def test_a_lost_link_is_opened_again_as_soon_as_the_end_point_answers(endpoint: str) -> None:
    """Refused while nothing listens; then a new session, without waiting for Zenoh's own next try."""
    near = ZenohTransport(endpoint)
    far = ZenohTransport(endpoint, options=LISTEN)
    with opened(far, STATE, COMMAND), opened(near, COMMAND, STATE):
        meet(make_pair(near, far))
        far.reopen()
        far.close()
        with pytest.raises(TransportLostError):
            for _ in range(3):
                near.receive(5.0)
        with pytest.raises(PortNotFoundError, match="and check its port"):
            near.reopen()
        with pytest.raises(TransportLostError):
            near.send(Message(COMMAND, payload(COMMAND, 1), 0))
        far.open()
        near.reopen()
        meet(make_pair(near, far))


def test_a_link_that_is_silent_is_made_anew_when_asked(endpoint: str) -> None:
    """Zenoh tells nothing of some dead links; one that was received a moment ago is left alone."""
    clock = VirtualClock(1)
    far = ZenohTransport(endpoint, MonotonicClock(), LISTEN)
    near = ZenohTransport(endpoint, clock)
    with opened(far, STATE, COMMAND), opened(near, COMMAND, STATE):
        first = near.stream
        clock.advance_ns(1_900_000_000)
        near.reopen()
        assert near.stream == first
        clock.advance_ns(200_000_000)
        near.reopen()
        second = near.stream
        assert second != first
        clock.advance_ns(1_900_000_000)
        send_until_heard(far, near)
        clock.advance_ns(200_000_000)
        near.reopen()
        assert near.stream == second


def test_signals_never_make_a_wait_endless(endpoint: str) -> None:
    """One that comes in a wait's last moment: Python's SimpleQueue then waits for ever."""
    seen = []

    def note(*_: object) -> None:
        seen.append(1)
        assert len(seen) < 100_000, "the wait does not end"

    with opened(ZenohTransport(endpoint, MonotonicClock(), LISTEN), STATE, COMMAND) as near:
        before = signal.signal(signal.SIGALRM, note)
        signal.setitimer(signal.ITIMER_REAL, 0.00037, 0.00037)
        try:
            for _ in range(1000):
                with pytest.raises(TransportTimeoutError):
                    near.receive(0.001)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
    assert seen


def test_a_reader_that_stays_away_finds_the_newest(endpoint: str) -> None:
    """Of 2000 unread messages the last ones are kept, in order."""
    with opened(ZenohTransport(endpoint, options=LISTEN), STATE, COMMAND) as far:
        with opened(ZenohTransport(endpoint), COMMAND, STATE) as near:
            meet(make_pair(near, far))

            def send(number: int) -> None:
                far.send(Message(STATE, number.to_bytes(4, "big"), 0))

            for number in range(2000):
                send(number)
            wait_for_arrival(near, (1999).to_bytes(4, "big"), again=lambda: send(1999))
            numbers: list[int] = []
            while not numbers or numbers[-1] != 1999:
                numbers.append(int.from_bytes(near.receive(5.0).payload, "big"))
    assert len(numbers) <= 257
    assert numbers == sorted(numbers)


def test_no_socket_but_the_named_one(endpoint: str) -> None:
    """The listener is on loopback alone, the other side listens nowhere, and nobody calls by multicast."""

    def sockets() -> set[tuple[str, str]]:
        connections = psutil.Process().net_connections("inet")
        return {(c.status, f"{c.laddr.ip}:{c.laddr.port}") for c in connections if not c.raddr}

    before = sockets()
    with ZenohTransport(endpoint, options=LISTEN), ZenohTransport(endpoint):
        assert sockets() - before == {("LISTEN", endpoint.removeprefix("tcp/"))}


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_nothing_listening_is_said_at_once(endpoint: str, mode: str) -> None:
    """The message names the end point and what should run there."""
    with pytest.raises(
        PortNotFoundError, match=rf"{endpoint}: Connection refused.*emulate go2 --transport zenoh"
    ):
        ZenohTransport(endpoint, options=WireOptions(mode=mode)).open()


def test_a_client_takes_the_end_point_that_answers_and_a_peer_needs_all(endpoint: str) -> None:
    """The dead end point comes first; the client passes it by."""
    dead = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(endpoint, options=LISTEN):
        with ZenohTransport(f"{dead}, {endpoint}", options=WireOptions(mode="client")):
            pass
        with pytest.raises(PortNotFoundError, match=dead):
            ZenohTransport(f"{dead},{endpoint}", options=WireOptions(mode="peer")).open()


def test_a_taken_port_and_a_foreign_address_are_told_apart(endpoint: str) -> None:
    """Where somebody listens it is PortBusyError, on another machine's address PortNotFoundError."""
    with ZenohTransport(endpoint, options=LISTEN):
        with pytest.raises(PortBusyError, match=endpoint):
            ZenohTransport(endpoint, options=LISTEN).open()
    foreign = ZenohTransport("tcp/192.0.2.1:7447", options=WireOptions(listen=True, insecure=True))
    with pytest.raises(PortNotFoundError, match="address of this machine"):
        foreign.open()


def test_what_is_no_zenoh_gives_no_session() -> None:
    """A server that says nothing is recognised within the time for opening."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(PortNotFoundError, match="something listens there, but it is not Zenoh"):
            ZenohTransport(f"tcp/127.0.0.1:{port}", settings={"connect/timeout_ms": 300}).open()


def test_an_unknown_host_is_named() -> None:
    """A host that no name service knows is an error of its own."""
    with pytest.raises(PortNotFoundError, match=r"no host 'robot\.invalid'"):
        ZenohTransport("tcp/robot.invalid:7447", options=WireOptions(insecure=True)).open()


@pytest.mark.parametrize(
    ("port", "options", "words"),
    [
        ("/dev/ttyUSB0", WireOptions(), "protocol/host:port"),
        ("tcp/127.0.0.1", WireOptions(), "protocol/host:port"),
        ("tcp/127.0.0.1:99999", WireOptions(), "protocol/host:port"),
        ("tcp/127.0.0.1:1#iface=eth0", WireOptions(), "protocol/host:port"),
        ("", WireOptions(), "protocol/host:port"),
        ("serial/127.0.0.1:7447", WireOptions(), "one of tcp, udp, tls"),
        ("tcp/192.168.123.18:7447", WireOptions(), "--insecure"),
        ("tcp/0.0.0.0:7447", LISTEN, "--insecure"),
        ("tcp/[::]:7447", LISTEN, "--insecure"),
        ("udp/127.0.0.1:1,tcp/robot:7447", WireOptions(), "Use tls/robot:7447"),
        ("tls/127.0.0.1:7447", WireOptions(), "needs --ca"),
        ("tls/127.0.0.1:7447", WireOptions(listen=True, ca=Path("ca.pem")), "needs --certificate"),
        ("tls/127.0.0.1:7447", WireOptions(ca=Path("/nowhere/ca.pem")), "/nowhere/ca.pem cannot be read"),
        ("tls/127.0.0.1:7447", WireOptions(ca=Path(__file__)), "holds no certificate"),
        ("tcp/127.0.0.1:7447", WireOptions(listen=True, mode="client"), "client cannot listen"),
    ],
)
def test_what_cannot_be_used_is_refused_before_any_connection(
    port: str, options: WireOptions, words: str
) -> None:
    """Each message says what is allowed."""
    with pytest.raises(ConfigurationError, match=words):
        ZenohTransport(port, options=options).open()


@pytest.mark.parametrize(
    "topic", ["/rt/lowcmd", "rt/*", "rt//lowcmd", "rt/lowcmd/", "rt/a?b", "", "rt/low cmd"]
)
def test_a_name_that_is_no_topic_is_refused(topic: str) -> None:
    """Wildcards would command and hear more than one topic."""
    with pytest.raises(ConfigurationError, match="rt/lowstate"):
        ZenohTransport("tcp/127.0.0.1:1").declare(subscribe=[topic])


def test_insecure_allows_plain_text_elsewhere() -> None:
    """With the option, the host is tried: nobody answers at an address of a documentation network."""
    transport = ZenohTransport("tcp/127.0.0.1:1,tcp/0.0.0.0:1", options=WireOptions(insecure=True))
    with pytest.raises(PortNotFoundError, match="Connection refused"):
        transport.open()


FROZEN_SCRIPT = """
    import sys
    from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
    from deal_hw.transport import Message, WireOptions
    transport = ZenohTransport(sys.argv[1], options=WireOptions(listen=True))
    transport.declare(publish=["rt/lowstate"], subscribe=["rt/lowcmd"])
    with transport:
        print("open", flush=True)
        count = 0
        while (payload := transport.receive(20.0).payload)[0] != 255:
            count += payload[0]
            transport.send(Message("rt/lowstate", payload, 0))
        print(count, flush=True)
"""


def test_a_peer_that_froze_wakes_up_to_few_old_commands(endpoint: str) -> None:
    """Of 3000 commands to a stopped process few are waiting for it: the kernel would have kept them all."""
    command = [sys.executable, "-c", textwrap.dedent(FROZEN_SCRIPT), endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as robot:
        try:
            assert robot.stdout is not None
            assert robot.stdout.readline() == "open\n"
            with opened(ZenohTransport(endpoint), COMMAND, STATE) as near:
                greet(near, 0)
                robot.send_signal(signal.SIGSTOP)
                for _ in range(3000):
                    near.send(Message(COMMAND, payload(COMMAND, 1), 0))
                robot.send_signal(signal.SIGCONT)
                greet(near, 255)
            waiting = int(robot.stdout.readline())
        finally:
            robot.kill()
    assert 0 < waiting < 300


def greet(near: ZenohTransport, number: int) -> None:
    """Send a message until the other side answers, or leaves."""
    for _ in range(250):
        with contextlib.suppress(TransportTimeoutError, TransportLostError):
            near.send(Message(COMMAND, payload(COMMAND, number), 0))
            if near.receive(0.02).payload[0] == number:
                return
    if number != 255:
        pytest.fail("the robot did not answer")


EXIT_SCRIPT = """
    import sys
    import threading
    from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
    from deal_hw.transport import Message, WireOptions
    transport = ZenohTransport(sys.argv[1], options=WireOptions(listen=sys.argv[2] == "listen"))
    transport.declare(publish=["rt/lowcmd"], subscribe=["rt/lowstate", "rt/sportmodestate"])
    transport.open()
    def send():
        message = Message("rt/lowcmd", bytes(812), 0)
        while True:
            transport.send(message)
    threading.Thread(target=send, daemon=True).start()
    threading.excepthook = lambda _: None
    print("open", flush=True)
    sys.stdin.readline()
    raise RuntimeError("in the middle")
"""


@pytest.mark.parametrize("side", ["listen", "connect"])
def test_a_process_that_raises_in_the_middle_ends(endpoint: str, side: str) -> None:
    """No thread of Zenoh keeps the interpreter, and the exception is what the exit code and stderr tell."""
    with contextlib.ExitStack() as stack:
        if side == "connect":
            stack.enter_context(opened(ZenohTransport(endpoint, options=LISTEN), STATE, COMMAND))
        process = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-c", textwrap.dedent(EXIT_SCRIPT), endpoint, side],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        stack.callback(process.kill)
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        _, errors = process.communicate("now\n", timeout=20)
        assert process.returncode == 1
        assert errors.rstrip().endswith("RuntimeError: in the middle")


def test_no_module_of_the_other_wire_is_loaded(endpoint: str) -> None:
    """Zenoh is loaded by opening only, and DDS not at all."""
    code = (
        "import sys\n"
        "from deal_hw.drivers.transports.zenoh_transport import ZenohTransport\n"
        "from deal_hw.transport import WireOptions\n"
        "t = ZenohTransport(sys.argv[1], options=WireOptions(listen=True))\n"
        "before = 'zenoh' in sys.modules\n"
        "t.open()\n"
        "print(before, 'zenoh' in sys.modules, 'cyclonedds' in sys.modules)\n"
    )
    command = [sys.executable, "-c", code, endpoint]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "False True False\n"
