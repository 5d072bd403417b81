"""The G1's bytes: layouts, checksums and their vectors, round trips, refusals."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.drivers.g1.joints import JOINTS_23, JOINTS_29, MOTORS, NOT_IN_23
from deal_hw.drivers.g1.messages import (
    LOW_COMMAND_BYTES,
    LOW_STATE_BYTES,
    G1Command,
    G1CommandEncoder,
    G1State,
    G1StateDecoder,
    decode_low_command,
    encode_low_state,
    low_command_image,
    low_state_image,
    slots_of,
)
from deal_hw.errors import ConfigurationError, FrameError

VERSIONS = pytest.mark.parametrize("joints", [JOINTS_29, JOINTS_23], ids=["29", "23"])
HEADER = b"\x00\x01\x00\x00"
COMMAND = struct.Struct("<2B2x" + "B3x5fI" * 35 + "5I")
STATE = struct.Struct("<2I2B2xI" + "13fh2x" + "B3x4f2hf7I" * 35 + "40B5I")
"""The C structs over which the vendor computes the checksum, 1004 and 2092 bytes."""


def _table() -> list[int]:
    found = []
    for byte in range(256):
        register = byte << 24
        for _ in range(8):
            register = register << 1 ^ (0x04C11DB7 if register >> 31 else 0)
            register &= 0xFFFFFFFF
        found.append(register)
    return found


TABLE = _table()


def crc(image: bytes) -> int:
    """Return CRC-32/MPEG-2 of the struct's words, each from its most significant byte."""
    register = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", image):
        for byte in word.to_bytes(4, "big"):
            register = (register << 8 & 0xFFFFFFFF) ^ TABLE[register >> 24 ^ byte]
    return register


def zeros(joints: tuple[str, ...], **changes: Any) -> G1Command:
    """Return a command of zeros with some changes."""
    zero = np.zeros(len(joints))
    parts = dict.fromkeys(("position", "velocity", "stiffness", "damping", "effort"), zero)
    return G1Command(**{**parts, "mode": np.zeros(len(joints), np.int64), **changes})


def still(joints: tuple[str, ...], **changes: Any) -> G1State:
    """Return a state of zeros with some changes."""
    zero, none = np.zeros(len(joints)), np.zeros(len(joints), np.int64)
    usual: dict[str, Any] = {
        **dict.fromkeys(("position", "velocity", "acceleration", "effort", "voltage"), zero),
        **dict.fromkeys(("casing", "winding", "error", "mode"), none),
        "orientation": np.zeros(4),
        **dict.fromkeys(("angular_velocity", "specific_force", "rpy"), np.zeros(3)),
        "imu_temperature": 0,
        "tick_ms": 0,
        "remote": bytes(40),
        "mode_machine": 0,
    }
    return G1State(**{**usual, **changes})


def at(joint: str, value: float, joints: tuple[str, ...] = JOINTS_29) -> np.ndarray[Any, Any]:
    """Return zeros with one value at a joint."""
    found = np.zeros(len(joints))
    found[joints.index(joint)] = value
    return found


def test_the_23_joints_lack_waist_and_wrists() -> None:
    """29 motor numbers; those of the small version skip 13, 14, 20, 21, 27 and 28."""
    assert len(MOTORS) == 29 and len(JOINTS_23) == 23 and len(NOT_IN_23) == 6
    assert sorted(set(range(29)) - set(slots_of(JOINTS_23))) == [13, 14, 20, 21, 27, 28]


def test_places_in_a_command_are_those_of_the_idl() -> None:
    """Motor i: mode at 4 + 28 i (6 for the first), q at 8 + 28 i; then reserve at 984, checksum at 1000."""
    encoder = G1CommandEncoder(JOINTS_29)
    ones = np.ones(29, np.int64)
    empty = encoder.encode(zeros(JOINTS_29))
    payload = encoder.encode(
        zeros(JOINTS_29, position=at("right_wrist_yaw_joint", 1.0), mode=ones, mode_machine=5)
    )
    assert len(payload) == LOW_COMMAND_BYTES and payload[:4] == HEADER
    changed = [i for i in range(1000) if payload[i] != empty[i]]
    # 1.0 is 00 00 80 3f; the last joint is motor 28.
    assert changed == [5, 6, *range(32, 788 + 1, 28), 8 + 28 * 28 + 2, 8 + 28 * 28 + 3]
    assert payload[8 + 28 * 28 :][:4] == struct.pack("<f", 1.0)


def test_checksums_are_the_vendors() -> None:
    """Three frames whose checksums utils/crc.py of unitree_sdk2_python @ 37116c5 computed.

    A default LowCmd; the same with mode_machine 5, motor 0 enabled at q = 1 and motor 28 enabled with kd = 2;
    a default LowState with mode_machine 5, tick 1000, q = 1 of motor 0 and 40 and 60 degrees in motor 28.
    """
    encoder = G1CommandEncoder(JOINTS_29)
    assert encoder.encode(zeros(JOINTS_29))[-4:] == struct.pack("<I", 0xFE172F9F)
    mode = (at("left_hip_pitch_joint", 1) + at("right_wrist_yaw_joint", 1)).astype(np.int64)
    command = zeros(
        JOINTS_29,
        position=at("left_hip_pitch_joint", 1.0),
        damping=at("right_wrist_yaw_joint", 2.0),
        mode=mode,
        mode_machine=5,
    )
    assert encoder.encode(command)[-4:] == struct.pack("<I", 0x763AC63D)
    state = still(
        JOINTS_29,
        position=at("left_hip_pitch_joint", 1.0),
        casing=at("right_wrist_yaw_joint", 40).astype(np.int64),
        winding=at("right_wrist_yaw_joint", 60).astype(np.int64),
        tick_ms=1000,
        mode_machine=5,
    )
    assert encode_low_state(state, JOINTS_29)[-4:] == struct.pack("<I", 0xC387BD29)


@given(st.sampled_from((JOINTS_29, JOINTS_23)), st.integers(0, 2**32 - 1), st.integers(0, 255))
def test_a_command_comes_back(joints: tuple[str, ...], seed: int, machine: int) -> None:
    """Every number, mode_machine and mode_pr; the checksum is that of the C struct."""
    rng = np.random.default_rng(seed)
    parts = np.float32(rng.normal(size=(5, len(joints)), scale=10.0 ** rng.integers(-3, 4)))
    q, dq, kp, kd, tau = parts.astype(float)
    mode = rng.integers(0, 2, len(joints))
    command = G1Command(q, dq, kp, kd, tau, mode, machine, seed % 2)
    payload = G1CommandEncoder(joints).encode(command)
    found = decode_low_command(payload, joints)
    for name in ("position", "velocity", "stiffness", "damping", "effort", "mode"):
        np.testing.assert_array_equal(getattr(found, name), getattr(command, name))
    assert (found.mode_machine, found.mode_pr) == (command.mode_machine, command.mode_pr)
    values: list[Any] = [command.mode_pr, command.mode_machine]
    of_slot = {int(slot): k for k, slot in enumerate(slots_of(joints))}
    for slot in range(35):
        k = of_slot.get(slot)
        row = () if k is None else (command.position, command.velocity, command.effort)
        gains = () if k is None else (command.stiffness, command.damping)
        numbers = [0.0] * 5 if k is None else [float(part[k]) for part in (*row, *gains)]
        values += [0 if k is None else int(command.mode[k]), *numbers, 0]
    image = COMMAND.pack(*values, 0, 0, 0, 0, 0)
    assert image[:-4] == low_command_image(payload)
    assert int.from_bytes(payload[-4:], "little") == crc(image[:-4])


@given(
    st.sampled_from((JOINTS_29, JOINTS_23)),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(-40, 200),
    st.binary(min_size=40, max_size=40),
)
def test_a_state_comes_back(
    joints: tuple[str, ...], seed: int, tick_ms: int, degrees: int, remote: bytes
) -> None:
    """Every number of a state, signed temperatures, error codes, the whole clock."""
    rng, count = np.random.default_rng(seed), len(joints)
    state = still(
        joints,
        position=rng.normal(size=count),
        velocity=rng.normal(size=count),
        acceleration=rng.normal(size=count),
        effort=rng.normal(size=count),
        voltage=rng.normal(size=count),
        casing=rng.integers(-40, 130, count),
        winding=rng.integers(-40, 130, count),
        error=rng.integers(0, 2**32, count),
        mode=rng.integers(0, 2, count),
        orientation=rng.normal(size=4),
        angular_velocity=rng.normal(size=3),
        specific_force=rng.normal(size=3),
        rpy=rng.normal(size=3),
        imu_temperature=degrees,
        tick_ms=tick_ms,
        remote=remote,
        mode_machine=seed % 256,
        version=(seed, tick_ms),
    )
    payload = encode_low_state(state, joints)
    assert len(payload) == LOW_STATE_BYTES
    assert int.from_bytes(payload[-4:], "little") == crc(low_state_image(payload))
    found = G1StateDecoder(joints).decode(payload)
    floats = ("position", "velocity", "acceleration", "effort", "voltage", "orientation", "rpy")
    for name in (*floats, "angular_velocity", "specific_force"):
        np.testing.assert_array_equal(getattr(found, name), getattr(state, name).astype(np.float32))
    for name in ("casing", "winding", "error", "mode"):
        np.testing.assert_array_equal(getattr(found, name), getattr(state, name))
    whole = (found.tick_ms, found.remote, found.mode_machine, found.version, found.mode_pr)
    assert whole == (tick_ms, remote, seed % 256, (seed, tick_ms), 0)
    # As the C struct has it, the fields that deal-hw does not use included.
    assert STATE.unpack(low_state_image(payload) + bytes(4))[5:6] == (np.float32(state.orientation[0]),)


@given(st.integers(4, LOW_COMMAND_BYTES - 1), st.integers(1, 255))
def test_a_changed_byte_is_found(place: int, change: int) -> None:
    """Whatever byte of a field is changed, the frame is refused; padding has no meaning."""
    payload = bytearray(G1CommandEncoder(JOINTS_29).encode(zeros(JOINTS_29, mode_machine=5)))
    payload[place] ^= change
    padding = place == 7 or (32 <= place < 984 and (place - 32) % 28 in (1, 2, 3))
    if padding:
        assert decode_low_command(bytes(payload), JOINTS_29).mode_machine == 5
    else:
        with pytest.raises(FrameError):
            decode_low_command(bytes(payload), JOINTS_29)


@VERSIONS
def test_frames_of_another_length_or_encoding_are_refused(joints: tuple[str, ...]) -> None:
    """Too short, without the header, the C struct's image, big-endian."""
    payload = encode_low_state(still(joints), joints)
    decoder = G1StateDecoder(joints)
    for wrong, words in (
        (payload[:-1], "2091 bytes"),
        (payload[4:], "header is missing"),
        (low_state_image(payload) + bytes(4), "C struct"),
        (b"\x00\x00\x00\x00" + payload[4:], "little-endian"),
    ):
        with pytest.raises(FrameError, match=words):
            decoder.decode(wrong)


def test_numbers_without_sense_are_not_sent() -> None:
    """Not finite, or beyond any plausible size."""
    encoder = G1CommandEncoder(JOINTS_29)
    for value in (np.nan, np.inf, 1e16):
        with pytest.raises(FrameError, match="finite"):
            encoder.encode(zeros(JOINTS_29, effort=at("waist_yaw_joint", value)))


def test_reserved_fields_are_refused_in_commands() -> None:
    """A sender with another layout; its checksum is right."""
    payload = bytearray(G1CommandEncoder(JOINTS_29).encode(zeros(JOINTS_29)))
    payload[984] = 1
    payload[1000:] = struct.pack("<I", crc(low_command_image(bytes(payload))))
    with pytest.raises(FrameError, match="reserved"):
        decode_low_command(bytes(payload), JOINTS_29)


def test_a_remote_has_40_bytes() -> None:
    """Others are a mistake of the caller."""
    with pytest.raises(ConfigurationError, match="39"):
        encode_low_state(still(JOINTS_29, remote=bytes(39)), JOINTS_29)
