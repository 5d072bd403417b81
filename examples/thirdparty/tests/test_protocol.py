"""The codec: what one side writes the other reads, and damage costs one frame."""

from __future__ import annotations

import pytest
from deal_hw_bench_cartpole import protocol
from deal_hw_bench_cartpole.protocol import Command, Splitter, State
from hypothesis import given
from hypothesis import strategies as st

I16 = st.integers(-(2**15), 2**15 - 1)
STATES = st.builds(
    State,
    angle=I16,
    position=I16,
    motor=I16,
    time_us=st.integers(0, 2**32 - 1),
    length=st.sampled_from((31, 36, 40)),
)


@given(STATES)
def test_a_state_is_read_as_it_was_written(state: State) -> None:
    """In each of the three layouts."""
    data = protocol.encode_state(state)
    assert len(data) == data[2] == state.length
    assert protocol.decode_state(data) == state


@given(st.lists(st.tuples(st.sampled_from(Command), st.binary(max_size=60)), max_size=8), st.data())
def test_frames_are_found_however_they_are_torn(
    contents: list[tuple[Command, bytes]], data: st.DataObject
) -> None:
    """The bytes arrive in any pieces."""
    frames = [protocol.frame(command, payload) for command, payload in contents]
    rest, splitter, found = b"".join(frames), Splitter(), []
    while rest:
        size = data.draw(st.integers(1, len(rest)))
        found += splitter.feed(rest[:size])
        rest = rest[size:]
    assert (found, splitter.errors) == (frames, 0)


@given(st.binary(max_size=300))
def test_any_bytes_are_survived(data: bytes) -> None:
    """What is found has a right checksum, and after enough other bytes a frame is found again."""
    splitter, ping = Splitter(), protocol.frame(Command.PING)
    for one in splitter.feed(data):
        assert one == protocol.frame(one[1], one[3:-1])
    # A damaged length may swallow 255 bytes.
    assert ping in splitter.feed(bytes(255) + ping)


@given(STATES, st.integers(0, 30), st.integers(1, 255))
def test_one_damaged_byte_is_one_error(state: State, where: int, flip: int) -> None:
    """The checksum finds it, and the next state is read."""
    data = bytearray(protocol.encode_state(state))
    data[where] ^= flip
    splitter = Splitter()
    parts = bytes(data), bytes(255), protocol.encode_state(state)
    found = [one for part in parts for one in splitter.feed(part)]
    assert found[-1] == protocol.encode_state(state)
    assert splitter.errors >= 1


@pytest.mark.parametrize(
    ("data", "text"),
    [(protocol.frame(Command.PING), "aac00449"), (protocol.motor(-1), "aac808ffffffff7e")],
)
def test_known_bytes(data: bytes, text: str) -> None:
    """Start, command, length of the whole frame, little-endian payload, checksum."""
    assert data.hex() == text
