"""The Go2's smaller messages: remote control, requests and responses, topics, sport state."""

from __future__ import annotations

import struct

import pytest

from deal_hw.drivers.go2.messages import sport_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree import remote, rpc
from deal_hw.drivers.unitree.remote import Remote
from deal_hw.errors import ConfigurationError, FrameError, UnknownNameError


def test_remote_bytes_by_hand() -> None:
    """Buttons at 2, floats at 4, 8, 12 and 20: lx, rx, ry, ly. L2 is bit 5, B bit 9."""
    data = struct.pack("<2sH5f16x", b"\x55\x51", 1 << 5 | 1 << 9, 0.25, -0.5, 0.75, 1.0, -1.0)
    found = remote.decode_remote(data)
    assert found == Remote(0x220, left_x=0.25, left_y=-1.0, right_x=-0.5, right_y=0.75)
    assert found.holds(remote.parse_combination("L2+B"))
    assert not found.holds(remote.parse_combination("L2+A"))
    assert remote.encode_remote(found) == data


def test_no_remote_is_all_zeros() -> None:
    """40 zeros mean that none is heard, which is not the same as a remote that lies idle."""
    assert remote.decode_remote(bytes(40)) is None
    assert remote.encode_remote(None) == bytes(40)
    assert remote.decode_remote(remote.encode_remote(Remote())) == Remote()


def test_combinations() -> None:
    """Names are joined by plus; none at all is never held; an unknown name lists the others."""
    assert remote.parse_combination("R1") == 1
    assert remote.parse_combination("left+Y") == 1 << 15 | 1 << 11
    assert not Remote(0xFFFF).holds(remote.parse_combination(""))
    with pytest.raises(UnknownNameError, match="L2"):
        remote.parse_combination("L2+Z")


def test_bad_remotes_are_refused() -> None:
    """Wrong lengths and buttons that are no 16 bits."""
    with pytest.raises(FrameError, match="39 bytes"):
        remote.decode_remote(bytes(39))
    with pytest.raises(FrameError, match="WirelessController"):
        remote.decode_wireless(bytes(22))
    with pytest.raises(ConfigurationError, match="16 bits"):
        remote.encode_remote(Remote(1 << 16))


def test_a_request_by_hand() -> None:
    """Identity, function, lease, priority, reply, then a text and bytes, each aligned to words."""
    expected = struct.pack("<4sqqqi?3x I4s I", b"\0\1\0\0", 7, 1001, 0, 0, False, 3, b"{}\0\0", 0)
    assert rpc.encode_request(rpc.Request(7, 1001)) == expected


@pytest.mark.parametrize(
    ("payload", "what"),
    [
        (b"\0\1\0\0" + bytes(10), "at least"),
        (b"\0\0\0\0" + bytes(40), "CDR header"),
        (rpc.encode_response(rpc.Response(1, 2, 0, "abc"))[:-5], "fit|end before"),
        (struct.pack("<4sqqiI", b"\0\1\0\0", 1, 2, 0, 0xFFFFFFFF), "does not fit"),
        (struct.pack("<4sqqiI4sI", b"\0\1\0\0", 1, 2, 0, 4, b"abcd", 0), "zero byte"),
        (struct.pack("<4sqqiI4sI", b"\0\1\0\0", 1, 2, 0, 4, b"\xff\xff\xff\0", 0), "UTF-8"),
        (rpc.encode_response(rpc.Response(1, 2)) + bytes(8), "too many"),
    ],
)
def test_bad_responses_are_refused(payload: bytes, what: str) -> None:
    """Cut short, of another encoding, or with lengths that lie."""
    with pytest.raises(FrameError, match=what):
        rpc.decode_response(payload)


def test_response_data_are_a_json_object() -> None:
    """Nothing is an empty object; anything else is refused with its text."""
    assert rpc.Response(1, 2).json() == {}
    assert rpc.Response(1, 2, data='{"name":"ai"}').json() == {"name": "ai"}
    for data in ("[1]", "{", "[" * 100_000, '{"a":' * 100_000):
        with pytest.raises(FrameError, match="JSON") as caught:
            rpc.Response(1, 2, data=data).json()
        assert len(str(caught.value)) < 300


def test_topics() -> None:
    """Requests and responses have a topic for each service; every topic has a type."""
    assert topics.request("motion_switcher") == "rt/api/motion_switcher/request"
    assert topics.TYPES[topics.response("sport")] == "unitree_api::msg::dds_::Response_"
    with pytest.raises(UnknownNameError, match="motion_switcher"):
        topics.request("gaits")


@pytest.mark.parametrize("size", [0, 232, 235, 512, 517])
def test_a_sport_state_of_another_length_is_refused(size: int) -> None:
    """Both lengths are named."""
    with pytest.raises(FrameError, match=r"516.*236"):
        sport_state.decode_sport_state(bytes(size))


def test_a_sport_state_without_header_is_refused() -> None:
    """The right length alone is not enough."""
    with pytest.raises(FrameError, match="CDR header"):
        sport_state.decode_sport_state(bytes(236))
