"""The messages inside an episode file, against mcap_ros2 as an independent implementation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from deal_hw.data.recording.schemas import (
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
