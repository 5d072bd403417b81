"""The cart-pole's CAN frames: the page's vectors, round trips, torn messages, a bus that holds anything."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import (
    FRAME,
    Angle,
    CanLink,
    CanMessage,
    accept,
    database,
    frame_id,
)
from deal_hw.drivers.cartpole.wire.protocol import MessageType, Result
from deal_hw.errors import ConfigurationError, FrameError

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "protocol-cartpole-can.md").read_text(
    encoding="utf-8"
)
U8, U16, U32 = (st.integers(0, 2**n - 1) for n in (8, 16, 32))
I16, I32 = (st.integers(-(2 ** (n - 1)), 2 ** (n - 1) - 1) for n in (16, 32))
NAMES = st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=16)
MESSAGES = st.one_of(
    st.builds(protocol.Hello, U8, U8),
    st.builds(protocol.Info, U8, NAMES, st.tuples(U8, U8, U8), U16, U16, st.integers(0, 2**64 - 1), U8),
    st.builds(protocol.Arm, U8),
    st.builds(protocol.Stop, U8),
    st.builds(protocol.Home, U8),
    st.builds(protocol.Ack, U8, st.sampled_from(MessageType), st.sampled_from(Result)),
    st.builds(protocol.Target, st.integers(0, protocol.NO_COMMAND - 1), I32, U32, U32, U16, U32),
    st.builds(protocol.State, U32, st.integers(0, 2**48 - 1), I32, I32, I32, I32, I16, U8, U32, U32),
    st.builds(Angle, U8, U32, I32, I32, U8),
)
STATE = protocol.State(2102, 10510000, -40200, 128748, -2824507, -673565, -756, 35, 499, 19000)


def vectors() -> list[tuple[str, bytes]]:
    """Return the page's messages and frames."""
    section = PAGE.split("## Test vectors")[1]
    found = []
    for expression, cell in re.findall(r"^\| `(\w+\(.*\))` \| (.*) \|$", section, re.MULTILINE):
        frames = re.findall(r"`([0-9A-F]{3})` `([0-9a-f ]+)`", cell)
        data = [(int(i, 16), bytes.fromhex(d)) for i, d in frames]
        found.append((expression, b"".join(FRAME.pack(i, len(d), d) for i, d in data)))
    return found


def frames_of(data: bytes) -> list[bytes]:
    """Cut bytes into frames."""
    return [data[k : k + FRAME.size] for k in range(0, len(data), FRAME.size)]


@pytest.mark.parametrize(("expression", "frames"), vectors())
def test_the_page_tells_the_truth(expression: str, frames: bytes) -> None:
    """Each of its messages has exactly the frames that stand beside it, in both directions."""
    message = eval(expression, {**vars(protocol), "Angle": Angle})
    assert CanLink().encode(message) == frames
    assert list(CanLink().decode_all(frames)) == [message]


def test_a_state_by_hand(crc_bit_by_bit: Callable[[bytes], int]) -> None:
    """Offsets of the page's table, packed by struct, with a CRC from its definition."""
    parts = [
        struct.pack("<II", 2102, 499),
        struct.pack("<IHBB", 10510000, 0, 35, 2102 & 0xFF),
        struct.pack("<ii", -40200, 128748),
        struct.pack("<ii", -2824507, -673565),
        struct.pack("<hI", -756, 19000),
    ]
    parts[-1] += struct.pack("<H", crc_bit_by_bit(b"\x01" + b"".join(parts)))
    node = 5
    expected = b"".join(struct.pack("<IB3x8s", node * 32 + 8 + k, 8, part) for k, part in enumerate(parts))
    assert CanLink(node).encode(STATE) == expected


def test_no_command_has_the_number_that_stands_for_none() -> None:
    """A device that reported it would seem to have received nothing."""
    with pytest.raises(FrameError, match="does not fit its frames"):
        CanLink().encode(protocol.Target(protocol.NO_COMMAND, 0, 0, 0, 0, 0))


@settings(deadline=None)
@given(MESSAGES, st.integers(1, 62))
def test_every_message_survives_the_round_trip(message: CanMessage, node: int) -> None:
    """Encoding and decoding gives the same message; every frame has its node's ids and at most 8 bytes."""
    link = CanLink(node)
    data = link.encode(message)
    assert list(link.decode_all(data)) == [message]
    assert list(link.decode(data)) == [message] * (not isinstance(message, Angle))
    assert link.errors == 0
    for identifier, length, _ in FRAME.iter_unpack(data):
        assert identifier >> 5 == node
        assert length <= 8


@settings(deadline=None)
@given(st.lists(MESSAGES, max_size=4), st.lists(st.integers(1, 9), max_size=30))
def test_messages_do_not_depend_on_how_frames_are_handed_over(
    messages: list[CanMessage], cuts: list[int]
) -> None:
    """One at a time or many at once."""
    link, host = CanLink(), CanLink()
    frames = frames_of(b"".join(link.encode(message) for message in messages))
    found = []
    for size in [*cuts, max(len(frames), 1)]:
        found += list(host.decode_all(b"".join(frames[:size])))
        frames = frames[size:]
    assert found == messages


@settings(deadline=None)
@given(st.integers(0, 4), st.integers(0, 4))
def test_a_sample_that_lost_or_mixed_frames_is_refused(first: int, count: int) -> None:
    """Frames of two samples in a row, with any run of frames missing: only whole samples come out."""
    later = protocol.State(2103, 10515000, 1, 2, 3, 4, 5, 6, 7, 8)
    link, host = CanLink(), CanLink()
    frames = frames_of(link.encode(STATE) + link.encode(later))
    del frames[first : first + count]
    found = list(host.decode(b"".join(frames)))
    whole = [STATE] * (count == 0) + [later] * (first + count <= 5)
    assert found == whole
    # What is torn at its beginning was never begun; everything else is counted once.
    assert host.torn == (0 if first == 0 or count == 0 else 1)
    assert host.errors == 0


def test_frames_of_two_samples_in_the_right_order_fail_the_crc() -> None:
    """The third to fifth frame of a sample 256 later: order and low byte fit, the CRC does not."""
    later = protocol.State(2102 + 256, 11790000, 1, 2, 3, 4, 5, 6, 7, 8)
    link, host = CanLink(), CanLink()
    mixed = frames_of(link.encode(STATE))[:2] + frames_of(link.encode(later))[2:]
    assert list(host.decode(b"".join(mixed))) == []
    assert host.errors == 1


@settings(deadline=None)
@given(st.integers(0, 4), st.integers(0, 7), st.integers(0, 7))
def test_a_changed_bit_in_a_state_is_noticed(frame: int, byte: int, bit: int) -> None:
    """A CRC finds every single wrong bit."""
    host = CanLink()
    frames = [bytearray(frame) for frame in frames_of(CanLink().encode(STATE))]
    frames[frame][8 + byte] ^= 1 << bit
    assert list(host.decode(b"".join(frames))) == []
    assert host.errors == 1


@settings(deadline=None, max_examples=300)
@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.integers(0, 8), st.binary(max_size=8)), max_size=30))
def test_nothing_on_the_bus_makes_the_link_fail(frames: list[tuple[int, int, bytes]]) -> None:
    """Frames of our node with any content are messages or counted, and a whole sample is found afterwards."""
    host = CanLink()
    junk = b"".join(FRAME.pack(0x20 | i & 0x1F if i & 1 else i, n, data) for i, n, data in frames)
    list(host.decode(junk))
    assert list(host.decode(CanLink().encode(STATE))) == [STATE]


def test_half_a_frame_is_counted() -> None:
    """Bytes that are no whole frames come from no CAN bus."""
    host = CanLink()
    assert list(host.decode(b"\0" * 17)) == []
    assert host.errors == 1


def test_other_nodes_cost_nothing() -> None:
    """Frames of node 2 are neither messages nor errors for node 1, and the filter lets none through."""
    host = CanLink(1)
    assert list(host.decode(CanLink(2).encode(STATE))) == []
    assert host.errors == 0
    ((wanted, mask),) = accept(1)
    assert [i for i in range(0x800) if i & mask == wanted & mask] == list(range(0x20, 0x40))


def test_another_version_is_told_by_its_info_alone() -> None:
    """Its info and its stop are understood; states and arms are not."""
    newer, host = CanLink(version=2), CanLink()
    info = protocol.Info(1, "cartpole", (1, 0, 0), 1000, 200, 7)
    (found,) = host.decode(newer.encode(info))
    assert isinstance(found, protocol.Info)
    assert found.version == 2
    assert list(host.decode(newer.encode(protocol.Stop(4)))) == [protocol.Stop(4)]
    assert list(host.decode(newer.encode(protocol.Arm(4)))) == []
    assert list(host.decode(newer.encode(STATE))) == []
    assert host.errors == 2


def test_heartbeats_come_ten_times_a_second_and_tell_two_devices_apart() -> None:
    """Every twentieth of 200 states a second; a second serial number under the same node is a fault."""
    host = CanLink()
    devices = [CanLink(unique_id=0xA), CanLink(unique_id=0xB)]
    states = [protocol.State(k, 5000 * k, 0, 0, 0, 0, 0, 0, 0, 0) for k in range(200)]
    data = b"".join(devices[0].encode(state) for state in states)
    assert [i for i, _, _ in FRAME.iter_unpack(data)].count(frame_id("Heartbeat", 1)) == 10
    assert list(host.decode(data)) == states
    assert host.fault == ""
    list(host.decode(devices[1].encode(states[0])))
    assert "two devices use node 1 (0x0000000a and 0x0000000b)" in host.fault


def test_a_device_reports_torn_messages_in_its_errors_frame() -> None:
    """With the heartbeat, once there is one; the host reads past it."""
    device, host = CanLink(), CanLink()
    device.errors, device.torn = 1, 2
    data = device.encode(protocol.State(0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    (_, _, payload) = next(f for f in FRAME.iter_unpack(data) if f[0] == frame_id("Errors", 1))
    assert payload == b"\x03\x00" + bytes(6)
    assert len(list(host.decode(data))) == 1
    assert host.errors == 0


@pytest.mark.parametrize("node", [0, 63, -1])
def test_numbers_that_no_node_has_are_refused(node: int) -> None:
    """0 and 63 belong to others."""
    with pytest.raises(ConfigurationError, match="1 to 62"):
        CanLink(node)


@pytest.mark.parametrize(
    "message",
    [
        protocol.Arm(256),
        protocol.Info(1, "seventeen letters", (0, 0, 0), 1, 1, 1),
        protocol.Target(0, 2**31, 0, 0, 0, 0),
    ],
)
def test_values_that_do_not_fit_are_refused(message: protocol.AnyMessage) -> None:
    """As on the serial wire."""
    with pytest.raises(FrameError):
        CanLink().encode(message)


def test_the_budget_on_the_page_follows_from_the_dbc() -> None:
    """Worst case: 44 + 8n bits, a stuff bit after every four of 34 + 8n, 3 bits between frames."""
    frames = database()

    def bits(name: str) -> int:
        n = frames[name].length
        return 44 + 8 * n + (34 + 8 * n - 1) // 4 + 3

    states = 200 * sum(bits(f"State{k}") for k in range(1, 6))
    targets = 50 * sum(bits(f"Target{k}") for k in range(1, 4))
    beats = 10 * (bits("Heartbeat") + bits("Errors"))
    rows = {"states, 200 Hz": states, "targets, 50 Hz": targets, "sum": states + targets + beats}
    rows["heartbeats and errors, 10 Hz"] = beats
    for row, total in rows.items():
        grouped = f"{total:,}".replace(",", " ")
        shares = f"{total / 5e3:.1f} % | {total / 1e4:.1f} %"
        assert re.search(rf"\| {re.escape(row)} \| \d+ \| {grouped} \| {shares} \|", PAGE), (
            row,
            grouped,
            shares,
        )


def test_every_frame_of_the_dbc_is_on_the_page() -> None:
    """Its number, its sender and its length."""
    for name, message in database().items():
        if name.startswith("Info"):
            continue
        (sender,) = message.senders
        who = {"HOST": "host", "CARTPOLE": "device", "ENCODER": "encoder"}[sender]
        assert f"| {message.frame_id & 31} | {name} | {who} | {message.length} |" in PAGE
