"""What travels beside a Zenoh message: the bytes of docs/reference/protocol-go2.md, and who answers what."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.drivers.transports.zenoh_access import access_settings
from deal_hw.drivers.transports.zenoh_stamps import Echo, Echoes, Stamp, read_echo, read_stamp
from deal_hw.errors import ConfigurationError, FrameError

pytestmark = pytest.mark.real_time

U64 = st.integers(0, 2**64 - 1)


def test_the_bytes_are_those_of_the_page() -> None:
    """Little-endian, version and kind first; clients in other languages rely on it."""
    assert Stamp(0xABCD, 77).encode() == struct.pack("<HHIQQ", 1, 1, 0, 0xABCD, 77)
    assert Echo(5, 9, Stamp(0xABCD, 77)).encode() == struct.pack("<HHIQQQQ", 1, 2, 0, 5, 9, 0xABCD, 77)


@given(stream=U64, sequence=U64, session=U64, time_ns=U64)
def test_what_is_written_is_read(stream: int, sequence: int, session: int, time_ns: int) -> None:
    """Both kinds, and neither passes for the other."""
    stamp = Stamp(session, time_ns)
    echo = Echo(stream, sequence, stamp)
    assert read_stamp(stamp.encode()) == stamp
    assert read_echo(echo.encode()) == echo
    assert read_stamp(echo.encode()) is None
    with pytest.raises(FrameError):
        read_echo(stamp.encode())


@given(st.binary(max_size=60))
def test_rubbish_is_refused(data: bytes) -> None:
    """Any bytes: read, or refused by a FrameError, never another error."""
    read_stamp(data)
    try:
        read_echo(data)
    except FrameError as error:
        assert "neither sequence nor age" in str(error)


def test_a_client_returns_the_newest_stamp_and_numbers_its_messages() -> None:
    """What is no stamp, such as another client's echo, changes nothing."""
    echoes = Echoes(stream=4)
    assert read_echo(echoes.next()) == Echo(4, 0, Stamp(0, 0))
    for attachment in (Stamp(8, 100).encode(), b"", Echo(1, 2, Stamp(9, 9)).encode()):
        echoes.hear(attachment)
    assert read_echo(echoes.next()) == Echo(4, 1, Stamp(8, 100))
    assert Echoes().stream != Echoes().stream


def test_whoever_is_not_named_may_do_nothing() -> None:
    """The default is to deny; observers have no rule that writes."""
    made = access_settings(["desk"], ["wall"], write=["rt/lowcmd"], read=["rt/lowstate"])["access_control"]
    assert made["enabled"] and made["default_permission"] == "deny"
    rules = {policy["subjects"][0]: policy["rules"] for policy in made["policies"]}
    assert rules == {"controllers": ["read", "hear", "write"], "observers": ["read", "hear"]}
    (write,) = [rule for rule in made["rules"] if "put" in rule["messages"] and "ingress" in rule["flows"]]
    assert write["key_exprs"] == ["rt/lowcmd"]
    alone = access_settings(["desk"], [], write=["a"], read=["b"])["access_control"]
    assert [policy["subjects"] for policy in alone["policies"]] == [["controllers"]]


@pytest.mark.parametrize(
    ("controllers", "observers", "words"),
    [
        (["a"], ["b", "a"], "'a' is a controller and an observer"),
        ([], ["a"], "at least one controller"),
        ([""], [], "at least one controller"),
    ],
)
def test_unclear_roles_are_refused(controllers: list[str], observers: list[str], words: str) -> None:
    """A name has one role, and there is somebody who may command."""
    with pytest.raises(ConfigurationError, match=words):
        access_settings(controllers, observers, write=["a"], read=["b"])
