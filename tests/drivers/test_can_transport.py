"""CAN transports: python-can's in-process bus, and a serial adapter on a pty whose far end the test plays."""

from __future__ import annotations

import errno
import itertools
import os
import select
import tty
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.clock import VirtualClock
from deal_hw.drivers.transports import can_transport
from deal_hw.drivers.transports.can_bus import CanAddress, take_settings
from deal_hw.drivers.transports.can_transport import (
    PythonCanTransport,
    can_links,
    check_link,
    open_can,
)
from deal_hw.drivers.transports.slcan_transport import (
    LONGEST_LINE,
    LineReader,
    SlcanTransport,
    decode_line,
    encode_line,
)
from deal_hw.errors import (
    ConfigurationError,
    PortNotFoundError,
    TransportLostError,
    TransportTimeoutError,
    UnknownNameError,
)
from deal_hw.testing.transport_suite import TransportPair, TransportSuite
from deal_hw.transport import Message

pytestmark = pytest.mark.real_time

CHANNELS = (f"bus{number}" for number in itertools.count())
SECOND_NS = 10**9


class FarBus:
    """The far end of an in-process bus."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)

    def write(self, data: bytes, identifier: int = 0x123) -> None:
        """Send in frames of at most eight bytes."""
        for begin in range(0, len(data), 8):
            self.bus.send(
                can.Message(arbitration_id=identifier, is_extended_id=False, data=data[begin : begin + 8])
            )

    def read(self, count: int) -> bytes:
        """Wait for that many bytes."""
        data = b""
        while len(data) < count:
            frame = self.bus.recv(5.0)
            assert frame is not None
            data += frame.data
        return data


class Adapter:
    """The far end of a serial adapter's pty: what a Lawicel adapter answers is up to the test."""

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.lines: list[bytes] = []
        self._reader = LineReader()

    def received(self, count: int) -> list[bytes]:
        """Wait until that many lines have come since the last call, empty ones left out."""
        while len(self.lines) < count:
            assert select.select([self.master], [], [], 5.0)[0], f"only {self.lines}"
            self.lines += [line for line in self._reader.feed(os.read(self.master, 4096)) if line]
        lines, self.lines = self.lines[:count], self.lines[count:]
        return lines

    def say(self, characters: bytes) -> None:
        """Send as the adapter."""
        os.write(self.master, characters)

    def write(self, data: bytes) -> None:
        """Send as a node of the bus."""
        for begin in range(0, len(data), 8):
            self.say(encode_line("123", data[begin : begin + 8]))

    def read(self, count: int) -> bytes:
        """Return what frames of the host carried."""
        data = b""
        while len(data) < count:
            frame = decode_line(self.received(1)[0])
            data += frame[1] if frame is not None else b""
        return data

    def close(self) -> None:
        """Vanish."""
        for fd in (self.master, self._slave):
            if fd >= 0:
                os.close(fd)
        self.master = self._slave = -1


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    """Return an adapter."""
    made = Adapter()
    yield made
    made.close()


class TestVirtualBus(TransportSuite):
    @pytest.fixture
    def pair(self) -> Iterator[TransportPair]:
        channel = next(CHANNELS)
        far = FarBus(channel)
        near = PythonCanTransport(f"virtual:{channel}")

        def unplug() -> None:
            assert near._bus is not None
            near._bus.shutdown()

        yield TransportPair(
            near=near, write=far.write, read=far.read, unplug=unplug, channel="321", largest=8
        )
        near.close()
        far.bus.shutdown()


class TestSlcan(TransportSuite):
    @pytest.fixture
    def pair(self, adapter: Adapter) -> Iterator[TransportPair]:
        near = SlcanTransport(f"slcan:{adapter.port}")
        yield TransportPair(
            near=near, write=adapter.write, read=adapter.read, unplug=adapter.close, channel="321", largest=8
        )
        near.close()


class TestInheritedSlcan(TransportSuite):
    """The control process has the descriptor from its parent and reads ahead in a thread."""

    @pytest.fixture
    def pair(self, adapter: Adapter) -> Iterator[TransportPair]:
        fd = os.open(adapter.port, os.O_RDWR | os.O_NOCTTY)
        near = SlcanTransport(f"slcan:{adapter.port}", fd=fd)
        yield TransportPair(
            near=near, write=adapter.write, read=adapter.read, unplug=adapter.close, channel="321", largest=8
        )
        near.close()

    def test_open_and_close_may_be_repeated(self, pair: TransportPair) -> None:
        """An inherited descriptor is gone once it is closed."""
        pair.near.open()
        pair.near.open()
        pair.near.close()
        pair.near.close()

    def test_a_closed_transport_refuses(self, pair: TransportPair) -> None:
        """As above: it is not opened twice."""
        with pytest.raises(TransportLostError):
            pair.near.send(Message("123", b"a", 0))


@pytest.mark.parametrize(("port", "received"), [("gs_usb:0", False), ("socketcan:can0", True)])
def test_an_adapters_echo_of_our_own_frame_is_left_out(
    monkeypatch: pytest.MonkeyPatch, port: str, received: bool
) -> None:
    """Of socketcan the same mark says that another program of this computer sent the frame."""
    make_bus, channel = can.Bus, next(CHANNELS)
    monkeypatch.setattr(
        can,
        "Bus",
        lambda **_: make_bus(
            interface="virtual", channel=channel, ignore_config=True, receive_own_messages=True
        ),
    )
    monkeypatch.setattr(can_transport, "check_link", lambda channel: None)
    near = PythonCanTransport(port)
    near.open()
    near.send(Message("321", b"a", 0))
    if received:
        assert near.receive(0.1).payload == b"a"
    else:
        with pytest.raises(TransportTimeoutError):
            near.receive(0.0)
    near.close()


# Ports.


@pytest.mark.parametrize(
    ("port", "meaning"),
    [
        ("can0", CanAddress(interface="socketcan", channel="can0")),
        ("socketcan:can1", CanAddress(interface="socketcan", channel="can1")),
        ("/dev/ttyACM0", CanAddress(interface="slcan", channel="/dev/ttyACM0")),
        (
            "slcan:/dev/ttyACM0?bitrate=1000000",
            CanAddress(interface="slcan", channel="/dev/ttyACM0", bitrate=1_000_000),
        ),
        ("pcan:PCAN_USBBUS1", CanAddress(interface="pcan", channel="PCAN_USBBUS1")),
    ],
)
def test_ports_mean_interface_channel_and_settings(port: str, meaning: CanAddress) -> None:
    """Short forms are socketcan for a name and slcan for a path."""
    assert CanAddress.parse(port) == meaning


def test_a_driver_takes_its_settings_out_of_a_port() -> None:
    """The bus keeps its own; others are refused with what is allowed."""
    port = "slcan:/dev/ttyACM0?node=2&bitrate=1000000&encoder=5"
    bus, given = take_settings(port, {"node": 0, "encoder": 1})
    assert bus == "slcan:/dev/ttyACM0?bitrate=1000000"
    assert given == {"node": 2, "encoder": 5}
    assert take_settings("can1", {"node": 0}) == ("can1", {})
    with pytest.raises(UnknownNameError, match="bitrate, node"):
        take_settings(port, {"node": 0})


@pytest.mark.parametrize("query", ["node=x", "node=-1", "node=", "encoder=0", "node=1000001", "node=1e3"])
def test_settings_are_whole_numbers_of_their_range(query: str) -> None:
    """With the lowest and the highest."""
    with pytest.raises(ConfigurationError, match="whole number"):
        take_settings(f"can0?{query}", {"node": 0, "encoder": 1})


@pytest.mark.parametrize(
    "port", ["", "slcan:", ":can0", "can0?node=x", "can0?bitrate=0", "can0?bitrate=2000000"]
)
def test_ports_that_mean_nothing_are_refused(port: str) -> None:
    """With the form that a port has."""
    with pytest.raises(ConfigurationError):
        CanAddress.parse(port)


def test_unknown_settings_and_interfaces_list_what_exists() -> None:
    """A typing error is answered with the table."""
    with pytest.raises(UnknownNameError, match="bitrate"):
        open_can("can0?baud=5")
    with pytest.raises(UnknownNameError, match="socketcan"):
        open_can("soketcan:can0").open()
    with pytest.raises(ConfigurationError, match="500000"):
        open_can("slcan:/dev/x?bitrate=123456")


def test_a_missing_adapter_is_named_with_what_is_at_hand() -> None:
    """Both kinds of port say what to do."""
    with pytest.raises(PortNotFoundError, match="slcan"):
        open_can("socketcan:can77").open()
    with pytest.raises(PortNotFoundError, match="ports at hand"):
        open_can("slcan:/dev/ttyNOPE").open()


def test_links_are_found_by_their_type_and_must_be_up(tmp_path: Path) -> None:
    """Type 280 is CAN; the lowest bit of the flags says up; 1 is Ethernet."""
    for name, kind, flags in (
        ("can0", "280", "0x40081"),
        ("can1", "280", "0x40080"),
        ("eth0", "1", "0x1003"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(kind + "\n")
        (tmp_path / name / "flags").write_text(flags + "\n")
    assert can_links(tmp_path) == ["can0", "can1"]
    check_link("can0", tmp_path)
    with pytest.raises(PortNotFoundError, match="ip link set can1 up type can bitrate 500000"):
        check_link("can1", tmp_path)
    with pytest.raises(PortNotFoundError, match="at hand: can0, can1"):
        check_link("can2", tmp_path)


def test_a_kernel_without_can_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error number of a missing protocol family becomes a sentence."""

    def no_can(**kwargs: object) -> can.BusABC:
        raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")

    monkeypatch.setattr(can, "Bus", no_can)
    monkeypatch.setattr(can_transport, "check_link", lambda channel: None)
    with pytest.raises(PortNotFoundError, match="this kernel has no CAN"):
        open_can("can0").open()


def test_filters_keep_foreign_frames_out() -> None:
    """Node 1 has the ids 0x20 to 0x3F."""
    channel = next(CHANNELS)
    far = FarBus(channel)
    with open_can(f"virtual:{channel}", accept=((0x20, 0x7E0),)) as near:
        for identifier in (0x1F, 0x40, 0x123, 0x3F):
            far.write(bytes([identifier & 0xFF]), identifier)
        assert near.receive(1.0).channel == "03F"
        with pytest.raises(TransportTimeoutError):
            near.receive(0.0)
    far.bus.shutdown()


# Serial adapters.


def test_a_serial_adapter_is_set_up_with_its_bit_rate(adapter: Adapter) -> None:
    """Close, bit rate, open; S8 is 1 Mbit/s. At the end its bus is closed."""
    with open_can(f"slcan:{adapter.port}?bitrate=1000000"):
        assert adapter.received(3) == [b"C", b"S8", b"O"]
    assert adapter.received(1) == [b"C"]


def test_an_inherited_adapter_is_neither_set_up_nor_closed(adapter: Adapter) -> None:
    """The parent process goes on with the same bus after the child's end."""
    fd = os.open(adapter.port, os.O_RDWR | os.O_NOCTTY)
    with open_can(f"slcan:{adapter.port}", fd=fd) as near:
        near.send(Message("123", b"\x01", 0))
    adapter.say(b"")
    assert adapter.received(1) == [b"t123101"]
    assert not select.select([adapter.master], [], [], 0.0)[0]


def test_half_a_line_of_another_process_is_ended_first(adapter: Adapter) -> None:
    """The first line after a silence begins with an end of line; those that follow at once do not."""
    clock = VirtualClock()
    with SlcanTransport(f"slcan:{adapter.port}", clock) as near:
        adapter.received(3)
        clock.advance_ns(SECOND_NS)
        near.send(Message("123", b"", 0))
        near.send(Message("124", b"", 0))
        expected = b"\rt1230\rt1240\r"
        written = b""
        while len(written) < len(expected):  # one read may return less than was written
            assert select.select([adapter.master], [], [], 5.0)[0], f"only {written!r}"
            written += os.read(adapter.master, 99)
        assert written == expected


def test_foreign_frames_are_dropped_by_their_id(adapter: Adapter) -> None:
    """With the same filter as on other adapters."""
    with open_can(f"slcan:{adapter.port}", accept=((0x20, 0x7E0),)) as near:
        adapter.say(encode_line("123", b"foreign") + encode_line("021", b"mine"))
        assert near.receive(5.0).payload == b"mine"


def test_frames_with_the_adapters_time_stamp_are_read(adapter: Adapter) -> None:
    """Two bytes more than the length says."""
    with open_can(f"slcan:{adapter.port}") as near:
        adapter.say(b"t1232AABB1F40\r")
        assert near.receive(5.0).payload == b"\xaa\xbb"


def test_garbage_is_counted_and_survived(adapter: Adapter) -> None:
    """Bytes above 0x7F, torn and overlong lines; python-can's slcan bus never reads again after the first."""
    good = encode_line("123", b"good")
    with SlcanTransport(f"slcan:{adapter.port}") as near:
        adapter.say(good + b"\xff\xfe\r" + b"t1238AABB\r" + b"x" * 3 * LONGEST_LINE + b"\r" + good)
        assert near.receive(5.0).payload == near.receive(5.0).payload == b"good"
        assert near.garbled == 3


def test_a_refusal_is_asked_about_and_bus_off_is_reported(adapter: Adapter) -> None:
    """BELL, the flags 0xA0 (bus error, error-passive): lost, until reopened; then the set-up comes again."""
    with SlcanTransport(f"slcan:{adapter.port}") as near:
        adapter.received(3)
        adapter.say(b"\a")
        with pytest.raises(TransportTimeoutError, match="refuses to send"):
            near.receive(0.05)
        assert adapter.received(1) == [b"F"]
        adapter.say(b"FA0\r")
        with pytest.raises(TransportLostError, match="bus-off"):
            near.receive(5.0)
        with pytest.raises(TransportLostError, match="bus-off"):
            near.send(Message("123", b"", 0))
        near.reopen()
        assert adapter.received(3) == [b"C", b"S6", b"O"]
        adapter.write(b"back")
        assert near.receive(5.0).payload == b"back"


def test_a_full_buffer_refuses_the_next_frame_only(adapter: Adapter) -> None:
    """The flag 0x02 makes one send fail; the next is tried again."""
    with SlcanTransport(f"slcan:{adapter.port}") as near:
        adapter.received(3)
        adapter.say(b"F02\r")
        with pytest.raises(TransportTimeoutError):
            near.receive(0.05)
        with pytest.raises(TransportTimeoutError, match="transmit buffer is full"):
            near.send(Message("123", b"", 0))
        near.send(Message("123", b"", 0))
        assert adapter.received(1) == [b"t1230"]


def test_nobody_acknowledging_is_said(adapter: Adapter) -> None:
    """The flags 0x84: warning and bus error, not yet passive."""
    with SlcanTransport(f"slcan:{adapter.port}") as near:
        adapter.say(b"F84\r")
        with pytest.raises(TransportTimeoutError, match="acknowledges"):
            near.receive(0.05)


FRAMES = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8))


@given(FRAMES)
def test_a_frame_comes_back_from_its_line(frame: tuple[int, bytes]) -> None:
    """What is written is read, with and without a time stamp."""
    line = encode_line(f"{frame[0]:03X}", frame[1])
    assert decode_line(line[:-1]) == frame
    assert decode_line(line[:-1] + b"BEEF") == frame


@given(st.lists(FRAMES), st.lists(st.integers(1, 40)), st.binary(max_size=200))
def test_lines_do_not_depend_on_how_they_are_cut(
    frames: list[tuple[int, bytes]], cuts: list[int], garbage: bytes
) -> None:
    """However the characters arrive, after garbage and one end of line every frame is found."""
    stream = garbage + b"\r" + b"".join(encode_line(f"{i:03X}", data) for i, data in frames)
    reader, lines = LineReader(), []
    for size in [*cuts, len(stream)]:
        lines += reader.feed(stream[:size])
        stream = stream[size:]
    found = [decode_line(line) for line in lines]
    assert found[len(found) - len(frames) :] == frames


@given(st.binary(max_size=100))
def test_no_line_makes_the_reader_fail(line: bytes) -> None:
    """Whatever it is, it is a frame or none."""
    frame = decode_line(line)
    assert (
        frame is None
        or encode_line(f"{frame[0]:03X}", frame[1])[:-1].upper() == line[: 5 + 2 * len(frame[1])].upper()
    )
