"""The datagram of one control cycle."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.data.recording.record import MAX_DATAGRAM_BYTES, CycleRecord, decode, encode
from deal_hw.errors import ConfigurationError, ProtocolError, VersionMismatchError
from deal_hw.transport import Message
from deal_hw.types import BodyState, Event, JointCommand, RobotState, Status

INT64 = st.integers(-(2**63), 2**63 - 1)
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=30)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=5,
)


def arrays(size: int) -> st.SearchStrategy[np.ndarray]:
    return st.lists(st.floats(), min_size=size, max_size=size).map(lambda v: np.array(v, dtype=np.float64))


def bodies(joints: int, feet: int) -> st.SearchStrategy[BodyState]:
    """Bodies of a robot with so many joints and feet."""
    lost = st.lists(INT64, min_size=joints, max_size=joints).map(lambda v: np.array(v, dtype=np.int64))
    sizes = (4, 3, 3, feet, joints)
    return st.builds(
        BodyState, *map(arrays, sizes), lost, st.floats(), st.floats(), st.floats(), arrays(4), INT64
    )


@st.composite
def records(draw: st.DrawFn) -> CycleRecord:
    joints, actuated = draw(st.integers(0, 5)), draw(st.integers(1, 3))
    body = st.just(None) if draw(st.booleans()) else bodies(joints, draw(st.integers(0, 4)))
    state = st.builds(
        RobotState,
        *[arrays(joints)] * 3,
        *[INT64] * 5,
        st.integers(0, 255).map(Status),
        body,
    )
    command = st.builds(JointCommand, *[arrays(actuated)] * len(fields(JointCommand)))
    return CycleRecord(
        cycle=draw(INT64),
        deadline_ns=draw(INT64),
        start_ns=draw(INT64),
        states=tuple(draw(st.lists(state, max_size=4))),
        action=draw(st.none() | st.integers(0, 4).flatmap(arrays)),
        requested=draw(st.none() | command),
        sent=draw(st.none() | command),
        sent_sequence=draw(INT64),
        sent_ns=draw(INT64),
        state_age_ns=draw(INT64),
        safety_state=draw(TEXT),
        flags=draw(st.integers(0, 2**32 - 1)),
        events=tuple(
            draw(
                st.lists(
                    st.builds(Event, INT64, TEXT, TEXT, st.dictionaries(TEXT, JSON, max_size=3)), max_size=3
                )
            )
        ),
        wire=tuple(draw(st.lists(st.builds(Message, TEXT, st.binary(max_size=100), INT64), max_size=4))),
        lost=draw(INT64),
    )


def plain(value: object) -> object:
    """Return a value that compares bit for bit, NaN included."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.tobytes()
    if isinstance(value, tuple):
        return tuple(plain(item) for item in value)
    if isinstance(value, float):
        return np.float64(value).tobytes()
    if isinstance(value, RobotState | JointCommand | BodyState):
        return tuple(plain(getattr(value, field.name)) for field in fields(value))
    return value


@settings(max_examples=80, deadline=None)
@given(records())
def test_record_survives_the_round_trip(record: CycleRecord) -> None:
    """Every field comes back bit for bit."""
    back = decode(encode(record))
    for field in fields(record):
        assert plain(getattr(back, field.name)) == plain(getattr(record, field.name)), field.name


@settings(max_examples=80, deadline=None)
@given(records(), st.data())
def test_any_changed_or_missing_byte_is_refused(record: CycleRecord, data: st.DataObject) -> None:
    """A flipped bit and a cut anywhere raise ProtocolError."""
    datagram = bytearray(encode(record))
    place = data.draw(st.integers(0, len(datagram) - 1))
    with pytest.raises(ProtocolError):
        decode(bytes(datagram[:place]))
    datagram[place] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(ProtocolError):
        decode(bytes(datagram))


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300))
def test_noise_is_refused(noise: bytes) -> None:
    """Bytes that nobody encoded raise ProtocolError, not something else."""
    with pytest.raises(ProtocolError):
        decode(noise)


@pytest.mark.parametrize("data", [b"[" * 100_000, b"[1]", b"{", b"\xff", b"1" * 5000])
def test_event_data_are_a_json_object(make_cycle: Callable[[int], CycleRecord], data: bytes) -> None:
    """Anything else in an event, with a right checksum, is corrupt."""
    good = encode(replace(make_cycle(0), events=(Event(0, "kind", "text", {"a": 1}),), wire=()))
    head, text = good[:-4].split(b'{"a": 1}')[0], b'{"a": 1}'
    assert good[:-4] == head + text
    sized = head[:-12] + head[-12:].replace(len(text).to_bytes(4, "little"), len(data).to_bytes(4, "little"))
    body = sized + data
    with pytest.raises(ProtocolError, match="does not match its head"):
        decode(body + zlib.crc32(body).to_bytes(4, "little"))


def test_another_version_is_named(make_cycle: Callable[[int], CycleRecord]) -> None:
    """A sender of another version gets a message with both versions."""
    datagram = bytearray(encode(make_cycle(0)))
    datagram[4] = 9
    with pytest.raises(VersionMismatchError, match="version 9; this recorder reads 2"):
        decode(bytes(datagram))


def test_layout_of_the_head(make_cycle: Callable[[int], CycleRecord]) -> None:
    """The first bytes are the magic, version 2, J=2, 4 states, A=1, no event, 2 raw messages, K=1."""
    head = encode(make_cycle(0))[:20]
    assert head == b"DHCR" + bytes([2, 0, 2, 0, 4, 0, 1, 0, 0, 0, 2, 0, 1, 0, 0, 0])


def test_mixed_shapes_are_refused(make_cycle: Callable[[int], CycleRecord]) -> None:
    """A state of three joints among states of two is a programming error that is reported."""
    good = make_cycle(0)
    odd = RobotState(np.zeros(3), np.zeros(3), np.zeros(3), 0, 0, 0, 0, 0, Status.NONE)
    record = CycleRecord(0, 0, 0, states=(*good.states, odd))
    with pytest.raises(ConfigurationError, match=r"position has shape \(3,\)"):
        encode(record)


def test_too_long_a_record_is_refused() -> None:
    """More raw bytes than a datagram holds are refused with both numbers."""
    record = CycleRecord(0, 0, 0, wire=(Message("rx", bytes(MAX_DATAGRAM_BYTES), 0),))
    with pytest.raises(ConfigurationError, match=f"at most {MAX_DATAGRAM_BYTES} fit"):
        encode(record)


def test_odd_event_data_does_not_stop_the_loop() -> None:
    """What JSON lacks goes in as text, NaN stays NaN."""
    odd = {"array": np.float32(1.5), "nan": math.nan}
    back = decode(encode(CycleRecord(0, 0, 0, events=(Event(0, "k", "m", odd),))))
    assert back.events[0].data["array"] == "1.5"
    assert math.isnan(back.events[0].data["nan"])
    worse: Any = {(1, 2): "a key that is no text"}
    back = decode(encode(CycleRecord(0, 0, 0, events=(Event(0, "k", "m", worse),))))
    assert "a key that is no text" in back.events[0].data["unreadable"]
