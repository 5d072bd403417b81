"""Network interfaces are found by name and address, and the wrong ones refused with advice."""

from __future__ import annotations

import errno
import socket
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from deal_hw.drivers.transports import interfaces
from deal_hw.drivers.transports.interfaces import Interface, find_interface, list_interfaces
from deal_hw.errors import PortNotFoundError

LO = Interface("lo", ("127.0.0.1",), up=True, carrier=True, multicast=False, loopback=True)
CABLE = Interface(
    "eth0", ("10.0.0.2", "192.168.123.99"), up=True, carrier=False, multicast=True, loopback=False
)
BARE = Interface("eth1", (), up=True, carrier=True, multicast=True, loopback=False)
OFF = Interface("eth2", ("10.0.0.3",), up=False, carrier=False, multicast=True, loopback=False)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with loopback and three cables."""
    monkeypatch.setattr(interfaces, "list_interfaces", lambda: (LO, CABLE, BARE, OFF))


def test_this_machine_has_loopback() -> None:
    """Read from the kernel: name, address and flags."""
    (lo,) = [interface for interface in list_interfaces() if interface.name == "lo"]
    assert "127.0.0.1" in lo.addresses
    assert lo.up
    assert lo.loopback
    assert lo.carrier


def test_a_label_is_no_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel lists a second address of eth0 under a label such as eth0:1; other families are left out."""
    four, six, no_flags = socket.AF_INET, socket.AF_INET6, ""
    address = {
        "eth0": [
            SimpleNamespace(family=four, address="10.0.0.2"),
            SimpleNamespace(family=six, address="fe80::1"),
        ],
        "eth0:1": [SimpleNamespace(family=four, address="10.0.1.2")],
    }
    stats = {
        "eth0": SimpleNamespace(flags="up,broadcast,multicast"),
        "eth1": SimpleNamespace(flags=no_flags),
    }
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: address)
    monkeypatch.setattr(psutil, "net_if_stats", lambda: stats)
    monkeypatch.setattr(Path, "read_text", lambda self: "0\n")
    assert list_interfaces() == (
        Interface("eth0", ("10.0.0.2", "10.0.1.2"), up=True, carrier=False, multicast=True, loopback=False),
        Interface("eth1", (), up=False, carrier=False, multicast=False, loopback=False),
    )


def test_flags_without_psutil(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """QEMU's user-mode emulation refuses the question for the speed: the kernel's files have the flags."""
    for name, flags, carrier in (("eth0", "0x1002", "0"), ("eth1", "0x1003", "1"), ("lo", "0x9", "1")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "flags").write_text(f"{flags}\n")
        (tmp_path / name / "carrier").write_text(f"{carrier}\n")

    def refuse() -> None:
        raise OSError(errno.ENOSYS, "Function not implemented (originated from ioctl(SIOCETHTOOL))")

    monkeypatch.setattr(interfaces, "_INTERFACES", tmp_path)
    monkeypatch.setattr(psutil, "net_if_stats", refuse)
    monkeypatch.setattr(
        psutil, "net_if_addrs", lambda: {"lo": [SimpleNamespace(family=socket.AF_INET, address="127.0.0.1")]}
    )
    assert list_interfaces() == (
        Interface("eth0", (), up=False, carrier=False, multicast=True, loopback=False),
        Interface("eth1", (), up=True, carrier=True, multicast=True, loopback=False),
        LO,
    )


@pytest.mark.usefixtures("machine")
@pytest.mark.parametrize(
    ("port", "found"), [("lo", LO), ("127.0.0.1", LO), ("eth0", CABLE), ("192.168.123.99", CABLE)]
)
def test_an_interface_has_a_name_and_addresses(port: str, found: Interface) -> None:
    """Each of them finds it, also the second address."""
    assert find_interface(port) is found


@pytest.mark.usefixtures("machine")
@pytest.mark.parametrize(
    ("port", "words"),
    [
        (
            "eth9",
            r"'eth9'; known interfaces: lo 127\.0\.0\.1; eth0 10\.0\.0\.2, 192\.168\.123\.99 \(no carrier\)"
            r"; eth1 without an IPv4 address; eth2 10\.0\.0\.3 \(down\)",
        ),
        ("", "known interfaces"),
        ("eth1", r"ip address add 192\.168\.123\.99/24 dev eth1"),
        ("eth2", "ip link set eth2 up"),
    ],
)
def test_what_cannot_be_used_is_refused_with_advice(port: str, words: str) -> None:
    """The text lists the interfaces with their addresses, or says the command that helps."""
    with pytest.raises(PortNotFoundError, match=words):
        find_interface(port)
