"""LowCmd and LowState: lengths and layouts that trap, the checksum, and what is refused."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from fastcrc import crc32
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.go2.descriptions import floor
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.go2.messages.wire import WIRE_JOINTS
from deal_hw.drivers.unitree.cdr import words_crc
from deal_hw.drivers.unitree.go_messages.frames import low_command_image, low_state_image
from deal_hw.drivers.unitree.go_messages.layout import (
    COMMAND_MODE_AT,
    LOW_COMMAND_BYTES,
    LOW_STATE_BYTES,
    STATE_MODE_AT,
)
from deal_hw.drivers.unitree.go_messages.low_state import LowState, LowStateFrame
from deal_hw.errors import ConfigurationError, FrameError


def command(**changes: object) -> LowCommand:
    """Return a command whose every number tells its joint."""
    values: dict[str, object] = {
        "position": np.arange(12.0),
        "velocity": np.arange(12.0) + 100,
        "stiffness": np.arange(12.0) + 200,
        "damping": np.arange(12.0) + 300,
        "effort": np.arange(12.0) + 400,
    }
    return LowCommand(**{**values, **changes})  # type: ignore[arg-type]


def state(**changes: object) -> LowState:
    """Return a state whose every number tells its joint."""
    values: dict[str, object] = {
        "position": np.arange(12.0),
        "velocity": np.arange(12.0) + 100,
        "acceleration": np.arange(12.0) + 200,
        "effort": np.arange(12.0) + 300,
        "temperature": np.arange(12) + 30,
        "lost": np.arange(12),
        "mode": np.ones(12, np.int64),
        "orientation": np.array([1.0, 0.0, 0.0, 0.0]),
        "angular_velocity": np.array([0.1, 0.2, 0.3]),
        "specific_force": np.array([0.0, 0.0, 9.81]),
        "rpy": np.zeros(3),
        "imu_temperature": 61,
        "foot_force": np.array([10, 20, 30, 40]),
        "foot_force_estimate": np.array([11, 21, 31, 41]),
        "tick_ms": 0x01020304,
        "remote": bytes(40),
        "battery_percent": 77,
        "battery_current_ma": -1500,
        "battery_status": 8,
        "battery_cycles": 12,
        "cell_voltage_mv": np.full(15, 3900),
        "voltage": 29.5,
        "current": 1.25,
    }
    return LowState(**{**values, **changes})  # type: ignore[arg-type]


def with_bytes(payload: bytes, at: int, new: bytes, *, sign: bool = True) -> bytes:
    """Return the payload with other bytes somewhere, its checksum right again by default."""
    changed = bytearray(payload)
    changed[at : at + len(new)] = new
    if sign:
        image = low_command_image if len(payload) == LOW_COMMAND_BYTES else low_state_image
        changed[-4:] = words_crc(image(bytes(changed))).to_bytes(4, "little")
    return bytes(changed)


COMMAND = LowCommandEncoder().encode(command())
STATE = encode_low_state(state())


def test_joints_are_where_the_robot_has_them() -> None:
    """FR comes first on the wire: the first motor's target is the model's fourth joint's, FR_hip."""
    assert floor.JOINTS[3] == WIRE_JOINTS[0] == "FR_hip_joint"
    assert struct.unpack_from("<5f", COMMAND, 28) == (3.0, 103.0, 403.0, 203.0, 303.0)
    # Slot 3 is FL_hip, the model's joint 0: 28 + 3 * 36 = 136.
    assert struct.unpack_from("<5f", COMMAND, 136) == (0.0, 100.0, 400.0, 200.0, 300.0)
    # Slot 9 is RL_hip, the model's joint 6; its state stands at 84 + 9 * 48 = 516.
    assert struct.unpack_from("<4f", STATE, 516) == (6.0, 106.0, 206.0, 306.0)
    # Feet: FR, FL, RR, RL on the wire.
    assert struct.unpack_from("<4h", STATE, 1084) == (20, 10, 40, 30)


def test_the_first_motors_mode_is_not_where_its_stride_would_have_it() -> None:
    """Modes are at 26, then 60, 96, ...; and at 81, then 128, 176, ...: the first lies apart."""
    assert COMMAND_MODE_AT[:3].tolist() == [26, 60, 96]
    assert STATE_MODE_AT[:3].tolist() == [81, 128, 176]
    one = LowCommandEncoder().encode(command(mode=np.eye(1, 12, 3, dtype=np.int64)[0]))
    assert (one[26], one[24], one[60]) == (1, 0, 0)
    # The eight spare motors keep the vendor's start values, mode 1 among them.
    assert [one[at] for at in COMMAND_MODE_AT[12:]] == [1] * 8
    assert struct.unpack_from("<2f", one, 28 + 12 * 36) == (2146000000.0, 16000.0)


def test_checksum_of_known_words() -> None:
    """The check value of CRC-32/MPEG-2 is 0x0376E6E7 for "123456789"; here each word is fed from its top."""
    assert crc32.mpeg_2(b"123456789") == 0x0376E6E7
    assert words_crc(b"43218765") == crc32.mpeg_2(b"12345678")
    # By hand: 0xFFFFFFFF and a word of ones cancel, so that 0 is left, and zeros keep it there.
    assert words_crc(b"\xff\xff\xff\xff") == 0
    assert words_crc(b"\xff\xff\xff\xff" + bytes(8)) == 0
    # Word 0xFFFFFFFE leaves 1, which 32 shifts turn into the polynomial.
    assert words_crc(b"\xfe\xff\xff\xff") == 0x04C11DB7


@pytest.mark.parametrize("size", [0, 3, 808, 811, 813, 1180])
def test_a_command_of_another_length_is_refused(size: int) -> None:
    """The message names both lengths; a body alone is distinguished from other lengths."""
    with pytest.raises(FrameError, match=f"{size} bytes, expected 812") as caught:
        decode_low_command((COMMAND + bytes(400))[:size])
    assert ("header is missing" in str(caught.value)) == (size == 808)


@pytest.mark.parametrize("size", [0, 1176, 1179, 1181, 812])
def test_a_state_of_another_length_is_refused(size: int) -> None:
    """The same for states."""
    with pytest.raises(FrameError, match=f"{size} bytes, expected 1180") as caught:
        decode_low_state((STATE + b"\0")[:size])
    assert ("header is missing" in str(caught.value)) == (size == 1176)


def test_a_c_struct_of_the_same_length_is_refused() -> None:
    """812 and 1180 are also the C structs' lengths; the missing header gives them away, as the error says."""
    command_struct = low_command_image(COMMAND) + COMMAND[-4:]
    state_struct = low_state_image(STATE) + STATE[-4:]
    assert (len(command_struct), len(state_struct)) == (LOW_COMMAND_BYTES, LOW_STATE_BYTES)
    with pytest.raises(FrameError, match="C struct"):
        decode_low_command(command_struct)
    with pytest.raises(FrameError, match="C struct"):
        decode_low_state(state_struct)


def test_other_headers_and_heads_are_refused() -> None:
    """Big-endian CDR, and messages that do not begin with FE EF."""
    for payload, decode in ((COMMAND, decode_low_command), (STATE, decode_low_state)):
        with pytest.raises(FrameError, match="CDR header is 00 00 00 00"):
            decode(b"\0\0\0\0" + payload[4:])
        with pytest.raises(FrameError, match="head is 12 34"):
            decode(payload[:4] + b"\x12\x34" + payload[6:])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 7), st.integers(6, LOW_STATE_BYTES - 1))
def test_any_flipped_bit_of_a_state_is_found(bit: int, at: int) -> None:
    """A CRC finds every single-bit error; only padding, which carries nothing, may change unnoticed."""
    changed = with_bytes(STATE, at, bytes([STATE[at] ^ 1 << bit]), sign=False)
    padding = {26, 27, 82, 83, *range(1145, 1148), 1154, 1155}
    padding |= {p + i for p in range(113, 1041, 48) for i in range(3)} | {
        p + i for p in STATE_MODE_AT[1:].tolist() for i in (1, 2, 3)
    }
    if at in padding:
        assert decode_low_state(changed).tick_ms == 0x01020304
    else:
        with pytest.raises(FrameError, match="checksum"):
            decode_low_state(changed)
        assert not decode_low_state(changed, strict=False).crc_checked


def test_padding_of_a_foreign_serialiser_is_ignored() -> None:
    """Bytes between the fields may hold anything: the sender's checksum was made over zeros."""
    changed = with_bytes(COMMAND, 27, b"\x55", sign=False)
    changed = with_bytes(changed, 61, b"\x55\x55\x55", sign=False)
    np.testing.assert_array_equal(decode_low_command(changed).position, np.arange(12.0))


@pytest.mark.parametrize("at", [7, 28 + 20, 28 + 5 * 36 + 28, 745, 804])
def test_reserved_fields_of_a_command_are_refused(at: int) -> None:
    """What this version leaves at 0 may mean something in another: frame, motors, battery and message."""
    with pytest.raises(FrameError, match="reserved"):
        decode_low_command(with_bytes(COMMAND, at, b"\x01"))


@pytest.mark.parametrize("at", [7, 84 + 36, 84 + 19 * 48 + 40, 1172])
def test_reserved_fields_of_a_state_are_read_over(at: int) -> None:
    """A robot with newer firmware may use them; they are part of the checksum all the same."""
    frame = decode_low_state(with_bytes(STATE, at, b"\x01"))
    np.testing.assert_array_equal(frame.position, np.arange(12.0))
    with pytest.raises(FrameError, match="checksum"):
        decode_low_state(with_bytes(STATE, at, b"\x01", sign=False))


def test_the_level_flag_of_a_command_is_checked() -> None:
    """0xEE means the vendor's gaits, not the motors."""
    with pytest.raises(FrameError, match="level_flag is 0xEE"):
        decode_low_command(LowCommandEncoder().encode(command(level=0xEE)))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e300])
@pytest.mark.parametrize("name", ["position", "velocity", "stiffness", "damping", "effort"])
def test_commands_that_are_not_of_this_world_are_not_encoded(name: str, value: float) -> None:
    """NaN, infinity and absurd numbers raise, in whatever field; the next good command is sound."""
    encoder = LowCommandEncoder()
    bad = np.zeros(12)
    bad[7] = value
    with np.errstate(over="ignore"), pytest.raises(FrameError, match="finite"):
        encoder.encode(command(**{name: bad}))
    assert encoder.encode(command()) == COMMAND


def test_a_state_with_nan_passes_as_it_is() -> None:
    """The safety module must see it; only corrupt frames are dropped."""
    position = np.arange(12.0)
    position[4] = np.nan
    frame = decode_low_state(encode_low_state(state(position=position)))
    assert np.flatnonzero(np.isnan(frame.position)).tolist() == [4]


def test_a_frames_fields_are_the_states() -> None:
    """What is read when asked for is what was written."""
    frame = decode_low_state(STATE)
    assert isinstance(frame, LowStateFrame) and frame.crc_checked
    assert (frame.tick_ms, frame.battery_percent, frame.voltage, frame.current) == (
        0x01020304,
        77,
        29.5,
        1.25,
    )
    assert frame.temperature.tolist() == list(range(30, 42))
    assert frame.lost.tolist() == list(range(12))
    assert frame.foot_force.tolist() == [10, 20, 30, 40]
    values = frame.values()
    assert (values.imu_temperature, values.battery_current_ma, values.battery_cycles) == (61, -1500, 12)
    assert values.foot_force_estimate.tolist() == [11, 21, 31, 41]
    assert encode_low_state(values) == STATE


def test_a_remote_of_another_length_is_refused() -> None:
    """A state holds 40 bytes of it."""
    with pytest.raises(ConfigurationError, match="39 bytes, expected 40"):
        encode_low_state(state(remote=bytes(39)))


def test_what_an_encoder_returned_does_not_change() -> None:
    """The buffer is the encoder's own: commands that were recorded keep their bytes."""
    encoder = LowCommandEncoder()
    first = encoder.encode(command())
    encoder.encode(command(position=np.ones(12), mode=np.zeros(12, np.int64)))
    assert first == COMMAND
    assert decode_low_command(encoder.encode(command(mode=np.zeros(12, np.int64)))).mode.tolist() == [0] * 12


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=1300))
def test_garbage_is_a_frame_error(data: bytes) -> None:
    """Whatever comes, the decoders raise FrameError and nothing else."""
    for decode in (decode_low_command, decode_low_state):
        with pytest.raises(FrameError):
            decode(data)
