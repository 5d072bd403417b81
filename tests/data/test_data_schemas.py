"""The messages inside an episode file, against mcap_ros2 as an independent implementation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from deal_hw.data.recording.schemas import (
    BODY,
    CHANNELS,
    COMMAND,
    CYCLE,
    EVENT,
    ROBOT,
    STATE,
    WIRE,
    RosMessageType,
    message_type,
)
from deal_hw.errors import ProtocolError, UnknownNameError

TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
VALUES = {
    "int64": st.integers(-(2**63), 2**63 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "bool": st.booleans(),
    "string": TEXT,
    "string[]": st.lists(TEXT, max_size=3),
    "uint8[]": st.binary(max_size=20),
    "float64[]": st.lists(st.floats(allow_nan=False), max_size=4),
}
TYPES = (ROBOT, STATE, COMMAND, CYCLE, EVENT, WIRE)


@st.composite
def messages(draw: st.DrawFn) -> tuple[RosMessageType, list[Any]]:
    kind = draw(st.sampled_from(TYPES))
    return kind, [draw(VALUES[field]) for field, _ in kind.fields]


def plain(value: object) -> object:
    return list(value) if isinstance(value, list | tuple | np.ndarray) else value


@settings(max_examples=150, deadline=None)
@given(messages())
def test_mcap_ros2_reads_what_we_write_and_we_read_what_it_writes(
    message: tuple[RosMessageType, list[Any]],
) -> None:
    """Both implementations give the same bytes and the same values."""
    kind, values = message
    data = kind.encode(*values)
    theirs = generate_dynamic(kind.name, kind.definition)[kind.name](data)
    for (_, name), value in zip(kind.fields, values, strict=True):
        assert plain(getattr(theirs, name)) == plain(value)
    named = {name: value for (_, name), value in zip(kind.fields, values, strict=True)}
    assert serialize_dynamic(kind.name, kind.definition)[kind.name](named) == data
    assert [plain(value) for value in kind.decode(data)] == [plain(value) for value in values]


@st.composite
def tables(draw: st.DrawFn) -> tuple[RosMessageType, list[list[Any]]]:
    """Messages of a type without text, whose vectors are as long in each message."""
    kind = draw(st.sampled_from((STATE, COMMAND, BODY)))
    number = st.floats(allow_nan=False)
    columns = {
        name: st.lists(number, min_size=(n := draw(st.integers(0, 4))), max_size=n)
        if field == "float64[]"
        else VALUES.get(field, number)
        for field, name in kind.fields
    }
    count = draw(st.integers(1, 5))
    return kind, [[draw(columns[name]) for _, name in kind.fields] for _ in range(count)]


@settings(max_examples=100, deadline=None)
@given(tables())
def test_many_messages_are_read_as_each_of_them(table: tuple[RosMessageType, list[list[Any]]]) -> None:
    """Every field of every record equals the single message's."""
    kind, rows = table
    found = kind.decode_all([kind.encode(*row) for row in rows])
    assert len(found) == len(rows)
    for record, row in zip(found, rows, strict=True):
        assert [plain(record[name]) for _, name in kind.fields] == row


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (([1.0], [2.0, 3.0], []), "position has not the same layout"),
        (([1.0, 2.0], [3.0], [4.0]), "different lengths"),
    ],
)
def test_many_messages_with_other_vectors_are_refused(other: tuple[list[float], ...], what: str) -> None:
    """As many numbers in other vectors, or one number more."""
    first = STATE.encode(1, 2, 3, 4, 5, 6, [1.0, 2.0], [3.0], [])
    with pytest.raises(ProtocolError, match=what):
        STATE.decode_all([first, STATE.encode(1, 2, 3, 4, 5, 6, *other)])
    with pytest.raises(ProtocolError, match="encapsulation"):
        STATE.decode_all([first, b"\0\0" + first[2:]])


def test_bytes_of_one_message() -> None:
    """Header, int64 1, two payload bytes with their count, worked out by hand."""
    assert WIRE.encode(1, b"\xaa\xbb").hex() == "00010000" + "0100000000000000" + "02000000" + "aabb"


@pytest.mark.parametrize("cut", [3, 10, 13, 15])
def test_cut_messages_are_refused(cut: int) -> None:
    """A message that ends too early raises ProtocolError."""
    with pytest.raises(ProtocolError):
        WIRE.decode(WIRE.encode(1, b"\xaa\xbb\xcc\xdd")[:cut])


def test_unknown_topic_lists_the_known() -> None:
    """The error names the topics there are; any /wire topic is known."""
    assert message_type("/wire/can0") is WIRE
    with pytest.raises(UnknownNameError, match="/state"):
        message_type("/stat")
    assert all(message_type(topic) is kind for topic, kind in CHANNELS.items())
