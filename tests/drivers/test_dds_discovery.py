"""What discovery tells about others, in words."""

from __future__ import annotations

import os
import socket
import uuid

import pytest

from deal_hw.drivers.transports import dds_discovery
from deal_hw.drivers.transports.dds_discovery import DdsEndpoint, DdsPeer, _unicast, _vendor
from deal_hw.drivers.transports.dds_types import COMPLETE, MINIMAL, UINT8
from deal_hw.drivers.transports.topics import LOW_COMMAND, TYPES

pytestmark = pytest.mark.real_time

NAME = TYPES[LOW_COMMAND]
KEY = uuid.UUID("01102866-bb83-421f-7037-3285000001c1")
PEER = DdsPeer(KEY, "Cyclone DDS", host="go2", process="ai_sport", pid=812, addresses=("192.168.123.161",))


def endpoint(type_name: str = NAME, type_hash: str = COMPLETE[NAME]) -> DdsEndpoint:
    """Return a writer of commands."""
    return DdsEndpoint(KEY, LOW_COMMAND, type_name, type_hash, writes=True, peer=PEER)


def test_a_peer_is_named_by_all_that_it_tells() -> None:
    """Implementation, GUID prefix, process, host and address."""
    assert str(PEER) == (
        "Cyclone DDS 01102866bb83421f70373285: process ai_sport (pid 812) on host go2 at 192.168.123.161"
    )
    assert str(DdsPeer(KEY, "Fast DDS")) == "Fast DDS 01102866bb83421f70373285: process unknown"


@pytest.mark.parametrize(
    ("prefix", "vendor"),
    [("0110", "Cyclone DDS"), ("010f", "Fast DDS"), ("0101", "RTI Connext"), ("0177", "DDS vendor 0177")],
)
def test_the_first_bytes_of_a_guid_name_the_implementation(prefix: str, vendor: str) -> None:
    """As RTPS reserves them."""
    assert _vendor(uuid.UUID(prefix + "0" * 28)) == vendor


@pytest.mark.parametrize(
    ("locators", "addresses"),
    [
        ("udp/239.255.0.1:7401@1,udp/127.0.0.1:52537@1", ("127.0.0.1",)),
        ("udp/192.168.123.161:7411,udp/192.168.123.161:7413", ("192.168.123.161",)),
        ("localprocess", ()),
        ("", ()),
        ("udp6/[fe80::1]:7400,udp/10.0.0.x:1,udp/x.1.1.1:2", ()),
    ],
)
def test_addresses_are_those_of_one_machine(locators: str, addresses: tuple[str, ...]) -> None:
    """Groups, other kinds and doubles are left out; nonsense does no harm."""
    assert _unicast(locators) == addresses


def test_a_fitting_endpoint_gives_no_complaint() -> None:
    """The robot's own type, and one that tells no hash."""
    assert endpoint().complaint(NAME) is None
    assert endpoint(type_hash="").complaint(NAME) is None


@pytest.mark.parametrize(
    ("end", "shown"),
    [
        (endpoint(), f"type hash {MINIMAL[NAME]}, the robot's"),
        (endpoint(type_hash="00" * 14), f"complete type hash {'00' * 14}"),
        (endpoint(type_hash=""), "type hash not reported"),
    ],
)
def test_the_hash_shown_is_that_of_the_docs_and_the_headers(end: DdsEndpoint, shown: str) -> None:
    """Peers tell the complete hash; the page for people and the vendor's headers have the minimal one."""
    assert end.shown_hash == shown


@pytest.mark.parametrize(
    ("end", "words"),
    [
        (endpoint(type_name="unitree_hg::msg::dds_::LowCmd_"), "another robot"),
        (endpoint(type_hash=UINT8[NAME]), "crashes Cyclone DDS 0.10.2"),
        (endpoint(type_hash="00" * 14), "firmware"),
    ],
)
def test_what_does_not_fit_is_said_with_its_owner(end: DdsEndpoint, words: str) -> None:
    """Another robot on the topic, octets declared as uint8, and a type nobody knows."""
    complaint = end.complaint(NAME)
    assert complaint is not None
    assert complaint.startswith("writer of rt/lowcmd (Cyclone DDS")
    assert words in complaint


def gone_pid() -> int:
    """Return the number of a process that has ended."""
    pid = os.posix_spawn("/bin/true", ["true"], {})
    os.waitpid(pid, 0)
    return pid


@pytest.mark.parametrize(
    ("host", "pid", "addresses", "ghost"),
    [
        (socket.gethostname(), gone_pid(), ("127.0.0.1",), True),
        (socket.gethostname(), os.getpid(), ("127.0.0.1",), False),
        (socket.gethostname(), gone_pid(), ("192.168.123.161",), False),
        (socket.gethostname(), gone_pid(), (), False),
        ("go2", gone_pid(), ("127.0.0.1",), False),
        (socket.gethostname(), 0, ("127.0.0.1",), False),
    ],
    ids=["ghost", "alive", "namesake elsewhere", "no address", "other host", "no pid"],
)
def test_only_a_dead_process_of_this_computer_is_a_ghost(
    host: str, pid: int, addresses: tuple[str, ...], ghost: bool
) -> None:
    """A robot that shares our host's name must never be taken for one: it would be overlooked."""
    peer = DdsPeer(KEY, "Cyclone DDS", host=host, pid=pid, addresses=addresses)
    assert peer.is_ghost() is ghost


def test_our_note_is_that_of_every_deal_hw() -> None:
    """Other versions look for it."""
    assert dds_discovery.OUR_NOTE == b"deal-hw"
