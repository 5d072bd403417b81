"""Messages of ros2_control: bytes of ROS 2, both ways; whatever is damaged is refused."""

from __future__ import annotations

import struct
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from deal_hw.data.recording.schemas import (
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    RosMessageType,
)
from deal_hw.drivers.ros2.messages import (
    HASHES,
    JointStates,
    TrajectoryPoint,
    decode_activity,
    decode_joint_states,
    decode_point,
    decode_positions,
    encode_activity,
    encode_joint_states,
    encode_point,
    encode_positions,
)
from deal_hw.errors import FrameError

STATES = bytes.fromhex(
    "00010000 01000000 02000000 05000000 62617365 00000000 02000000 02000000 61000000 03000000 62630000"
    "02000000 00000000 00000000 0000f03f 00000000 00000040 00000000 01000000 00000000 00001440"
)
"""Stamp 1.000000002 s, frame "base", joints a and bc at 1 and 2, no velocity, one effort of 5: 84 bytes, as
the package rosbags 0.11.9 writes them."""

finite = st.floats(allow_nan=False, allow_infinity=False)
names = st.lists(
    st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=12), max_size=6, unique=True
)


def decoded(kind: RosMessageType, payload: bytes) -> Any:
    """Return what another decoder, which knows the definition's text alone, reads."""
    schema = Schema(id=1, name=kind.name, encoding="ros2msg", data=kind.definition.encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    return decode(payload)


def test_joint_states_of_two_joints_are_84_bytes() -> None:
    """The vector's effort is one value for two joints: it is read by the layout, and refused by us."""
    sec, nanosec, frame, joints, position, velocity, effort = JOINT_STATE.decode(STATES, whole=True)
    assert (sec, nanosec, frame, joints) == (1, 2, "base", ("a", "bc"))
    assert (list(position), list(velocity), list(effort)) == ([1.0, 2.0], [], [5.0])
    assert JOINT_STATE.encode(sec, nanosec, frame, joints, position, velocity, effort) == STATES
    assert len(STATES) == 84
    with pytest.raises(FrameError, match="2 names, but 1 values of effort"):
        decode_joint_states(STATES)


def test_positions_of_two_joints_are_36_bytes() -> None:
    """Header 4, no dimension 4, offset 4, count 4, padding to 8: 4 (of the body), two numbers 16."""
    payload = encode_positions(np.array([1.0, 2.0]))
    assert payload == bytes.fromhex(
        "00010000 00000000 00000000 02000000 00000000 0000000000 00f03f 0000000000 000040".replace(" ", "")
    )
    assert len(payload) == 36


def test_a_trajectory_of_one_joint_is_72_bytes() -> None:
    """Header 4; stamp 8, frame 4+1; name count at 16: 4+4+2; point count at 28, four sequences, duration."""
    payload = encode_point(TrajectoryPoint(("a",), np.array([1.0]), 0.02))
    body = struct.pack("<iII", 0, 0, 1) + b"\0" + b"\0\0\0"  # Stamp, frame "", padding: 16.
    body += struct.pack("<II", 1, 2) + b"a\0" + b"\0\0"  # Names: 28.
    body += struct.pack("<I", 1) + struct.pack("<I", 1) + b"\0\0\0\0" + struct.pack("<d", 1.0)
    body += struct.pack("<IIIiI", 0, 0, 0, 0, 20_000_000)
    assert payload == b"\x00\x01\x00\x00" + body
    assert len(payload) == 72


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1), names, st.data())
def test_joint_states_both_ways(sec: int, nanosec: int, joints: list[str], data: st.DataObject) -> None:
    """What is written is read again, by us and by a decoder that knows only the definition."""
    some = st.lists(finite, min_size=len(joints), max_size=len(joints))
    position, effort = data.draw(some), data.draw(some)
    velocity = data.draw(st.one_of(st.just([]), some))
    stamp_ns = sec * 10**9 + nanosec
    written = JointStates(stamp_ns, tuple(joints), np.array(position), np.array(velocity), np.array(effort))
    payload = encode_joint_states(written)
    read = decode_joint_states(payload)
    assert (read.stamp_ns, read.names) == (stamp_ns, tuple(joints))
    for ours, theirs in ((read.position, position), (read.velocity, velocity), (read.effort, effort)):
        np.testing.assert_array_equal(ours, theirs)
    other = decoded(JOINT_STATE, payload)
    assert (other.header.stamp.sec, other.header.stamp.nanosec) == (sec, nanosec)
    assert list(other.name) == joints and list(other.position) == position


@given(st.lists(finite, max_size=8))
def test_positions_both_ways(values: list[float]) -> None:
    """As :func:`test_joint_states_both_ways`."""
    payload = encode_positions(np.array(values))
    np.testing.assert_array_equal(decode_positions(payload), values)
    assert list(decoded(FLOAT64_MULTI_ARRAY, payload).data) == values


@given(names.filter(len), st.floats(0, 1000), st.data())
def test_points_both_ways(joints: list[str], after_s: float, data: st.DataObject) -> None:
    """As :func:`test_joint_states_both_ways`; the time is kept to a nanosecond."""
    values = data.draw(st.lists(finite, min_size=len(joints), max_size=len(joints)))
    payload = encode_point(TrajectoryPoint(tuple(joints), np.array(values), after_s))
    read = decode_point(payload)
    assert read.names == tuple(joints) and read.after_s == pytest.approx(after_s, abs=1e-9)
    np.testing.assert_array_equal(read.position, values)
    other = decoded(JOINT_TRAJECTORY, payload)
    assert list(other.joint_names) == joints and list(other.points[0].positions) == values


@given(st.binary(max_size=200))
@settings(max_examples=300)
def test_random_bytes_are_refused(noise: bytes) -> None:
    """No decoder raises anything but FrameError, with and without the right header."""
    for payload in (noise, b"\x00\x01\x00\x00" + noise):
        for decode in (decode_joint_states, decode_positions, decode_point):
            try:
                decode(payload)
            except FrameError:
                continue


@given(st.integers(0, 103), st.integers(1, 255))
def test_a_changed_byte_raises_nothing_else(at: int, change: int) -> None:
    """A message without a checksum may become another one; it never becomes another error."""
    payload = bytearray(encode_joint_states(JointStates(1, ("a", "bc"), np.ones(2), np.ones(2), np.ones(2))))
    payload[at % len(payload)] ^= change
    try:
        read = decode_joint_states(bytes(payload))
    except FrameError:
        return
    assert len(read.names) == len(read.position)


@pytest.mark.parametrize(
    ("begin", "told"), [(b"\0\0\0\0", "00 00 00 00"), (b"\0\x07\0\0", "00 07 00 00"), (b"", "begins with")]
)
def test_another_encoding_is_refused(begin: bytes, told: str) -> None:
    """Big-endian CDR, the second version of it, and nothing at all."""
    with pytest.raises(FrameError, match=told):
        decode_positions(begin + encode_positions(np.ones(1))[4:] if begin else b"")


def test_options_of_the_header_and_padding_are_no_fault() -> None:
    """Writers may say in the header's last byte how many bytes of padding follow the message."""
    payload = bytearray(encode_positions(np.ones(2))) + b"\0\0\0"
    payload[3] = 3
    np.testing.assert_array_equal(decode_positions(bytes(payload)), np.ones(2))
    with pytest.raises(FrameError, match="4 bytes are left"):
        decode_positions(bytes(payload) + b"\0")


def test_a_layout_and_several_points_are_refused() -> None:
    """Neither is a command of deal-hw, and the emulated controller says so."""
    with_layout = FLOAT64_MULTI_ARRAY.encode(0, 8, np.ones(2))
    with pytest.raises(FrameError, match="layout"):
        decode_positions(with_layout)
    none = JOINT_TRAJECTORY.encode(0, 0, "", ("a",), 0, (), (), (), (), 0, 0)
    with pytest.raises(FrameError, match="0 points, 1 names"):
        decode_point(none)


def test_hashes_have_the_form_of_rep_2016() -> None:
    """One of each of the four types; 64 hexadecimal digits."""
    assert len(HASHES) == 4
    assert all(text.startswith("RIHS01_") and len(bytes.fromhex(text[7:])) == 32 for text in HASHES.values())


@given(
    st.dictionaries(
        st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=12),
        st.integers(0, 4),
        max_size=5,
    )
)
def test_an_activity_comes_back_as_it_was(controllers: dict[str, int]) -> None:
    """Names of controllers and their states, whatever follows them."""
    assert decode_activity(encode_activity(1_700_000_000_123_456_789, controllers)) == controllers


def test_the_bytes_of_an_activity() -> None:
    """Stamp 1.000000002 s, no frame, controller `a` active, no hardware component: counted by hand."""
    payload = encode_activity(1_000_000_002, {"a": 3})
    assert payload.hex(" ", 4) == (
        "00010000 01000000 02000000 01000000 00000000 01000000 02000000 61000300 07000000 61637469 76650000 "
        "00000000"
    )


@pytest.mark.parametrize("cut", range(4, 44, 3))
def test_a_cut_activity_is_refused(cut: int) -> None:
    """Whatever is missing of the controllers."""
    with pytest.raises(FrameError):
        decode_activity(encode_activity(0, {"arm": 3})[:cut])


def test_a_count_of_controllers_beyond_all_sense_is_refused() -> None:
    """Nothing is allocated for it."""
    payload = bytearray(encode_activity(0, {}))
    payload[20:24] = (2**32 - 1).to_bytes(4, "little")
    with pytest.raises(FrameError, match="controllers"):
        decode_activity(bytes(payload))
