"""rmw_zenoh's keys, tokens and attachments: text and bytes of other programs, both ways."""

from __future__ import annotations

import struct

import hypothesis.strategies as st
import pytest
from hypothesis import given

from deal_hw.drivers.ros2.messages import HASHES, STATE_TYPE
from deal_hw.drivers.ros2.zenoh_keys import (
    GID_BYTES,
    PUBLISHER,
    SUBSCRIBER,
    Attachment,
    Token,
    data_key,
    node_key,
    read_attachment,
    read_token,
)
from deal_hw.errors import FrameError

TOKEN = (
    "@ros2_lv/7/aac3178e146ba6f1fc6e6a4085e77f21/0/11/MP/%/%arm/joint_state_broadcaster/%arm%joint_states/"
    f"sensor_msgs::msg::dds_::JointState_/{HASHES[STATE_TYPE]}/::,1:,:,:,,"
)
name = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)


def test_keys_of_data() -> None:
    """Domain, topic without slashes at its ends, type, hash."""
    key = data_key(0, "/joint_states", STATE_TYPE, "*")
    assert key == "0/joint_states/sensor_msgs::msg::dds_::JointState_/*"


def test_a_token_both_ways() -> None:
    """A publisher in a namespace: slashes in names are percent signs."""
    token = read_token(TOKEN)
    assert token is not None
    assert (token.kind, token.namespace, token.node) == (PUBLISHER, "arm", "joint_state_broadcaster")
    assert (token.topic, token.type_name) == ("arm/joint_states", STATE_TYPE)
    assert token.type_hash == HASHES[STATE_TYPE]
    assert token.node_name == "/arm/joint_state_broadcaster"
    assert token.key(7) == TOKEN


@given(
    st.builds(
        Token,
        session=name,
        node_id=st.integers(0, 99),
        entity_id=st.integers(0, 99),
        kind=st.sampled_from([PUBLISHER, SUBSCRIBER]),
        namespace=st.one_of(st.just(""), st.lists(name, min_size=1, max_size=3).map("/".join)),
        node=name,
        topic=st.lists(name, min_size=1, max_size=3).map("/".join),
        type_name=st.just(STATE_TYPE),
        type_hash=st.sampled_from(sorted(HASHES.values())),
    ),
    st.integers(0, 232),
)
def test_any_token_both_ways(token: Token, domain: int) -> None:
    """What is written is read again."""
    assert read_token(token.key(domain)) == token


@pytest.mark.parametrize(
    "key",
    [
        "",
        "0/joint_states/sensor_msgs::msg::dds_::JointState_/x",
        node_key(0, "abc", "deal_hw"),
        TOKEN.replace("/MP/", "/SS/"),
        TOKEN.replace("/11/", "/eleven/"),
        TOKEN + "/more",
    ],
)
def test_other_keys_are_no_ends_of_topics(key: str) -> None:
    """Data, nodes, services, and what nobody knows."""
    assert read_token(key) is None


@given(st.text(max_size=120))
def test_any_text_is_a_token_or_none(text: str) -> None:
    """Nothing is raised."""
    read_token(text)


@given(
    st.integers(0, 2**63 - 1),
    st.integers(0, 2**63 - 1),
    st.binary(min_size=GID_BYTES, max_size=GID_BYTES),
    st.booleans(),
)
def test_attachments_both_ways(sequence: int, stamp_ns: int, gid: bytes, keyed: bool) -> None:
    """33 bytes, or 77 with names: what is written is read again, with its form."""
    attachment = Attachment(sequence, stamp_ns, gid, keyed)
    assert len(attachment.encode()) == (77 if keyed else 33)
    assert read_attachment(attachment.encode()) == attachment


def test_both_forms_byte_by_byte() -> None:
    """Numbers of 8 bytes, little-endian; texts and the id have their length before them."""
    gid = bytes(range(16))
    numbers = struct.pack("<q", 5), struct.pack("<q", 6)
    assert Attachment(5, 6, gid).encode() == numbers[0] + numbers[1] + b"\x10" + gid
    keyed = b"\x0fsequence_number" + numbers[0] + b"\x10source_timestamp" + numbers[1]
    assert Attachment(5, 6, gid, True).encode() == keyed + b"\x0asource_gid\x10" + gid


@given(st.binary(max_size=90))
def test_other_attachments_are_refused(noise: bytes) -> None:
    """They are an attachment of 16 bytes of id, or FrameError."""
    try:
        found = read_attachment(noise)
    except FrameError:
        return
    assert len(found.gid) == GID_BYTES and found.encode() == noise
