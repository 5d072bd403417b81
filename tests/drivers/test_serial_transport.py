"""The serial transport on a pty: contract, exclusive use, inherited descriptors, and errors that help."""

import contextlib
import os
import select
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import (
    ConfigurationError,
    PortBusyError,
    PortNotFoundError,
    TransportLostError,
    TransportTimeoutError,
)
from deal_hw.testing.transport_suite import TransportPair, TransportSuite, receive_bytes
from deal_hw.transport import Message

pytestmark = pytest.mark.real_time


class Pty:
    """The device's end of a pty."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave

    def write(self, data: bytes) -> None:
        """Send as the device."""
        os.write(self.master, data)

    def read(self, count: int) -> bytes:
        """Receive as the device."""
        data = b""
        while len(data) < count:
            assert select.select([self.master], [], [], 5.0)[0]
            data += os.read(self.master, count - len(data))
        return data

    def close(self) -> None:
        """Vanish."""
        for fd in (self._slave, self.master):
            with contextlib.suppress(OSError):
                os.close(fd)
        self._slave = self.master = -1


@pytest.fixture
def pty() -> Iterator[Pty]:
    pair = Pty()
    yield pair
    pair.close()


class TestSerialTransport(TransportSuite):
    @pytest.fixture
    def pair(self, pty: Pty) -> Iterator[TransportPair]:
        transport = SerialTransport(pty.port)
        yield TransportPair(near=transport, write=pty.write, read=pty.read, unplug=pty.close)
        transport.close()


class TestReadingAhead(TransportSuite):
    """The same contract where a thread reads ahead: over a descriptor that a parent opened."""

    @pytest.fixture
    def pair(self, pty: Pty) -> Iterator[TransportPair]:
        with SerialTransport(pty.port) as parent:
            transport = SerialTransport.from_fd(os.dup(parent.fileno()))
            yield TransportPair(near=transport, write=pty.write, read=pty.read, unplug=pty.close)
            transport.close()

    @pytest.mark.skip(reason="an inherited descriptor is closed for good")
    def test_a_closed_transport_refuses(self, pair: TransportPair) -> None:
        """Not of this kind: it cannot be opened again."""

    @pytest.mark.skip(reason="an inherited descriptor is closed for good")
    def test_open_and_close_may_be_repeated(self, pair: TransportPair) -> None:
        """Not of this kind: it cannot be opened again."""

    def test_a_vanished_port_stays_vanished(self, pair: TransportPair) -> None:
        """Every receive after the loss says so, not only the first."""
        with pair.near as near:
            pair.unplug()
            for _ in range(3):
                with pytest.raises(TransportLostError):
                    near.receive(5.0)


@pytest.mark.parametrize("adopted", [False, True])
def test_a_cable_that_is_put_back_is_found_under_the_same_path(adopted: bool, tmp_path: Path) -> None:
    """As a USB adapter under /dev/serial/by-id: gone, refused while gone, back with another number, works.

    No descriptor is left open, nor one closed twice, which may be another's by then.
    """
    before = len(os.listdir("/proc/self/fd"))
    link = tmp_path / "by-id"
    first, second = Pty(), Pty()
    link.symlink_to(first.port)
    owner = SerialTransport(str(link))
    with owner:
        near = SerialTransport.from_fd(os.dup(owner.fileno()), port=str(link)) if adopted else owner
        with near:
            near.reopen()
            first.close()
            with pytest.raises(TransportLostError):
                near.receive(5.0)
            link.unlink()
            with pytest.raises(PortNotFoundError):
                near.reopen()
            with pytest.raises(TransportLostError):
                near.receive(0.1)
            link.symlink_to(second.port)
            near.reopen()
            near.send(Message("", b"stop", 0))
            assert second.read(4) == b"stop"
            second.write(b"state")
            assert receive_bytes(near, 5) == b"state"
    second.close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_missing_port_lists_the_ports_at_hand() -> None:
    """The message names the port that was given and what there is."""
    with pytest.raises(PortNotFoundError, match=r"no serial port '/dev/ttyNOPE'; ports at hand: "):
        SerialTransport("/dev/ttyNOPE").open()


def test_a_file_is_not_a_port(tmp_path: object) -> None:
    """An ordinary file is refused as a port."""
    with pytest.raises(PortNotFoundError, match="cannot be opened as a serial port"):
        SerialTransport(os.path.join(str(tmp_path))).open()
    with pytest.raises(PortNotFoundError, match="cannot be opened as a serial port"):
        SerialTransport(__file__).open()


def test_a_baud_rate_that_does_not_exist_is_a_setting_error(pty: Pty) -> None:
    """A negative rate raises ConfigurationError with the port's name."""
    with pytest.raises(ConfigurationError, match=pty.port):
        SerialTransport(pty.port, baud_rate=-1).open()


def test_a_second_collector_is_refused_until_the_first_is_gone(pty: Pty) -> None:
    """The port is exclusive between open transports; closing frees it."""
    first, second = SerialTransport(pty.port), SerialTransport(pty.port)
    first.open()
    with pytest.raises(PortBusyError, match="another process"):
        second.open()
    first.close()
    with second:
        pty.write(b"x")
        assert receive_bytes(second, 1) == b"x"


def test_opening_forgets_what_came_before(pty: Pty) -> None:
    """Old bytes in the port's buffer are not handed out as news."""
    pty.write(b"old")
    with SerialTransport(pty.port) as transport:
        with pytest.raises(TransportTimeoutError):
            transport.receive(0.05)
        pty.write(b"new")
        assert receive_bytes(transport, 3) == b"new"


def test_a_peer_that_does_not_read_is_a_timeout(pty: Pty) -> None:
    """Sending never blocks: once the port takes no more, TransportTimeoutError says how much it took."""
    with SerialTransport(pty.port) as transport, pytest.raises(TransportTimeoutError, match="of 1000 bytes"):
        for _ in range(1000):
            transport.send(Message("", bytes(1000), 0))


def test_a_child_goes_on_with_an_inherited_descriptor(pty: Pty) -> None:
    """The child reads and writes; the lock holds while either process has the port open."""
    code = (
        "import sys\n"
        "from deal_hw.drivers.transports.serial_transport import SerialTransport\n"
        "from deal_hw.transport import Message\n"
        "with SerialTransport.from_fd(int(sys.argv[1])) as t:\n"
        "    t.send(Message('', b'ready', 0))\n"
        "    data = b''\n"
        "    while len(data) < 4: data += t.receive(10.0).payload\n"
        "    t.send(Message('', data[::-1], 0))\n"
    )
    with SerialTransport(pty.port) as parent:
        fd = parent.fileno()
        child = subprocess.Popen([sys.executable, "-c", code, str(fd)], pass_fds=[fd])
        assert pty.read(5) == b"ready"
        with pytest.raises(PortBusyError):
            SerialTransport(pty.port).open()
        pty.write(b"abcd")
        assert pty.read(4) == b"dcba"
        assert child.wait(10) == 0
        with pytest.raises(PortBusyError):
            SerialTransport(pty.port).open()
        parent.send(Message("", b"still", 0))
        assert pty.read(5) == b"still"


def test_a_descriptor_that_is_no_port_is_refused() -> None:
    """A closed descriptor and a pipe are refused at opening."""
    with pytest.raises(TransportLostError):
        SerialTransport.from_fd(987).open()
    read_end, write_end = os.pipe()
    try:
        with pytest.raises(ConfigurationError, match="not a serial port"):
            SerialTransport.from_fd(read_end).open()
    finally:
        os.close(read_end)
        os.close(write_end)
