"""Feetech's packets and registers: the manual's examples, signs by hand, hostile streams."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from deal_hw.drivers.servo_bus.feetech import registers as r
from deal_hw.drivers.servo_bus.feetech.packets import (
    BROADCAST,
    AnswerFrame,
    AnswerParser,
    Fault,
    Instruction,
    RequestFrame,
    RequestParser,
    encode,
    explain_fault,
    status,
)
from deal_hw.drivers.servo_bus.feetech.registers import (
    BLOCK_ADDRESS,
    BLOCK_BYTES,
    Block,
    TorqueMode,
    signed,
    to_signed,
)
from deal_hw.drivers.servo_bus.registers import Register

GOAL_2048 = bytes.fromhex("0008 0000 E803")
"""Goal position 2048, time 0, speed 1000."""


@pytest.mark.parametrize(
    ("frame", "printed"),
    [
        (encode(1, Instruction.PING), "FF FF 01 02 01 FB"),
        (status(1, 0), "FF FF 01 02 00 FC"),
        (encode(1, Instruction.READ, b"\x38\x02"), "FF FF 01 04 02 38 02 BE"),
        # 0x0518 = 1304.
        (status(1, 0, b"\x18\x05"), "FF FF 01 04 00 18 05 DD"),
        (encode(1, Instruction.WRITE, b"\x2a" + GOAL_2048), "FF FF 01 09 03 2A 00 08 00 00 E8 03 D5"),
        (encode(BROADCAST, Instruction.ACTION), "FF FF FE 02 05 FA"),
        (encode(1, Instruction.RESET), "FF FF 01 02 0A F2"),
        (
            encode(
                BROADCAST,
                Instruction.SYNC_WRITE,
                b"\x2a\x06" + b"".join(bytes([servo]) + GOAL_2048 for servo in (1, 2, 3, 4)),
            ),
            "FF FF FE 20 83 2A 06 01 00 08 00 00 E8 03 02 00 08 00 00 E8 03 "
            "03 00 08 00 00 E8 03 04 00 08 00 00 E8 03 58",
        ),
    ],
)
def test_known_frames(frame: bytes, printed: str) -> None:
    """The examples of Feetech's manual, with their checksums."""
    assert frame.hex(" ").upper() == printed


def test_a_checksum_by_hand() -> None:
    """Servo 1, length 4, Read, 0x38, 2: 1 + 4 + 2 + 56 + 2 = 65 = 0x41, inverted 0xBE."""
    assert encode(1, Instruction.READ, b"\x38\x02")[-1] == 0xBE


def test_a_frame_has_room_for_253_bytes() -> None:
    """The length byte counts two more bytes and is 255 at most."""
    assert len(encode(1, Instruction.WRITE, bytes(253))) == 259
    with pytest.raises(ValueError, match="254 bytes do not fit"):
        encode(1, Instruction.WRITE, bytes(254))


bodies = st.binary(max_size=253) | st.lists(
    st.sampled_from([b"\xff", b"\xff\xff", b"\xff\xff\x01\x02\x00\xfc", b"\x00", b"\x01"]), max_size=30
).map(b"".join)


@given(
    st.lists(st.tuples(st.integers(0, 254), st.integers(0, 255), bodies), min_size=1, max_size=5), st.data()
)
def test_frames_survive_any_cut_of_the_stream(
    frames: list[tuple[int, int, bytes]], data: st.DataObject
) -> None:
    """What was written is read, whatever its bytes, in whatever pieces it comes, with noise before it."""
    # Noise with a header could be the beginning of a long frame.
    noise = data.draw(st.binary(max_size=20).filter(lambda n: b"\xff\xff" not in n and n[-1:] != b"\xff"))
    stream = noise + b"".join(encode(*frame) for frame in frames)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    requests, answers = RequestParser(), AnswerParser()
    as_requests: list[RequestFrame] = []
    as_answers: list[AnswerFrame] = []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        as_requests += requests.feed(stream[begin:end])
        as_answers += answers.feed(stream[begin:end])
    assert [tuple(frame) for frame in as_requests] == frames
    assert [tuple(frame) for frame in as_answers] == frames
    assert (requests.errors, requests.skipped, answers.errors) == (0, len(noise), 0)
    assert sum(frame.size for frame in as_requests) + len(noise) == len(stream)


@given(st.binary(max_size=600), st.integers(6, 259))
@example(b"\xff" * 600, 259)
@example(b"\xff\xff\x01\x00" * 50, 259)
@example(b"\xff\xff\x01\xff" * 60, 259)
def test_no_bytes_make_a_parser_fail(data: bytes, longest: int) -> None:
    """Whatever comes, each byte is in a sound frame, skipped or waited for; then a sound frame is found."""
    for parser in (RequestParser(longest), AnswerParser(longest)):
        found = [*parser.feed(data)]
        assert sum(frame.size for frame in found) + parser.skipped <= len(data)
        found += parser.finish()
        assert not parser.waits
        assert sum(frame.size for frame in found) + parser.skipped == len(data)
        assert all(frame.size <= longest for frame in found)
        assert [tuple(frame) for frame in parser.feed(encode(7, Instruction.PING))] == [(7, 1, b"")]


# No data byte is, or becomes, a part of a header.
plain = st.binary(max_size=40).filter(lambda data: not {0xFF, 0xFF ^ 0x41} & {*data})


@given(st.lists(st.tuples(st.integers(0, 253), plain), min_size=1, max_size=3))
def test_a_changed_byte_costs_one_frame(frames: list[tuple[int, bytes]]) -> None:
    """A change of one byte always changes the checksum; the frames behind the changed one are found."""
    whole = [status(servo, 0, data) for servo, data in frames]
    for at in range(len(whole[0])):
        if at == 3:
            # A changed length takes bytes of the next frames, whose sum may be right by chance.
            continue
        changed = whole[0][:at] + bytes([whole[0][at] ^ 0x41]) + whole[0][at + 1 :]
        parser = AnswerParser()
        found = [*parser.feed(changed + b"".join(whole[1:])), *parser.finish()]
        assert found == [AnswerFrame(servo, 0, data) for servo, data in frames[1:]]
        assert parser.skipped == len(changed)


def test_a_corrupt_length_holds_the_next_frames_back_until_the_end() -> None:
    """FF FF 01 40 announces 64 more bytes; the frame of servo 2 is found when no more are expected."""
    parser = AnswerParser()
    sound = status(2, 0, b"\x18\x05")
    assert list(parser.feed(b"\xff\xff\x01\x40\x00\x18\x05\xdd" + sound)) == []
    assert parser.waits
    assert list(parser.finish()) == [AnswerFrame(2, 0, b"\x18\x05")]
    assert (parser.errors, parser.skipped) == (1, 8)


def test_a_parser_knows_the_longest_frame_that_it_expects() -> None:
    """With answers of 8 bytes at most, that length is refused at once."""
    parser = AnswerParser(8)
    sound = status(2, 0, b"\x18\x05")
    assert list(parser.feed(b"\xff\xff\x01\x40\x00\x18\x05\xdd" + sound)) == [AnswerFrame(2, 0, b"\x18\x05")]
    assert parser.errors == 1


def test_a_third_header_byte_is_noise() -> None:
    """FF FF FF 01 02 00 FC: no servo has the id 255, so the frame begins at the second byte."""
    parser = AnswerParser()
    assert list(parser.feed(b"\xff" + status(1, 0))) == [AnswerFrame(1, 0, b"")]
    assert (parser.errors, parser.skipped) == (0, 1)


def test_reset_forgets_an_incomplete_frame() -> None:
    """A servo that has heard nothing for a while begins with the next byte."""
    parser = RequestParser()
    assert list(parser.feed(b"\xff\xff\x01\xf0\x03")) == []
    parser.reset()
    assert list(parser.feed(encode(1, Instruction.PING))) == [RequestFrame(1, Instruction.PING, b"")]


def test_faults_are_explained_with_their_remedies() -> None:
    """0x21 is voltage and overload; a bit that nobody knows is shown as it is."""
    printed = explain_fault(Fault.VOLTAGE | Fault.OVERLOAD)
    assert printed.split("; ")[0].startswith("input voltage out of its limits (check the supply")
    assert "overload: it holds with reduced torque (take the load off" in printed
    assert [explain_fault(bit).split(" (")[0] for bit in (2, 4, 8)] == [
        "position sensor fault",
        "overheated",
        "current too high",
    ]
    assert explain_fault(0x90) == "unknown bits 0x90"
    assert explain_fault(0) == ""


@pytest.mark.parametrize(
    ("number", "bit", "data"),
    [
        # Position -1: sign bit 15 and magnitude 1, not FF FF.
        (-1, 15, "0180"),
        (-32767, 15, "ffff"),
        (4095, 15, "ff0f"),
        # Load -35.0 %: 350 = 0x15E with bit 10, 0x400.
        (-350, 10, "5e05"),
        (1000, 10, "e803"),
        # Homing offset -2047 = 0x7FF with bit 11, 0x800.
        (-2047, 11, "ff0f"),
        (0, 11, "0000"),
    ],
)
def test_signs_by_hand(number: int, bit: int, data: str) -> None:
    """A sign bit and a magnitude, little-endian."""
    assert to_signed(number, bit, 2) == bytes.fromhex(data)
    assert signed(int.from_bytes(bytes.fromhex(data), "little"), bit) == number


@pytest.mark.parametrize(("number", "bit"), [(2048, 11), (-2048, 11), (32768, 15), (1024, 10)])
def test_numbers_beyond_the_sign_bit_are_refused(number: int, bit: int) -> None:
    """A homing offset of 2048 has no bytes: its magnitude is the sign bit."""
    with pytest.raises(ValueError, match="allowed are -"):
        to_signed(number, bit, 2)


def test_minus_zero_and_bits_above_the_sign() -> None:
    """0x8000 is a zero; above the sign bit of a load nothing counts."""
    assert signed(0x8000, 15) == 0
    assert signed(0xF000 | 0x400 | 7, 10) == -7


@given(st.sampled_from(sorted(r.SIGN_BITS)), st.data())
def test_registers_are_read_as_they_were_written(register: Register, data: st.DataObject) -> None:
    """Every number that fits comes back."""
    most = (1 << r.SIGN_BITS[register]) - 1
    number = data.draw(st.integers(-most, most))
    assert r.decode(register, r.encode(register, number)) == number


def test_registers_without_sign() -> None:
    """A gain is 0 to 255, a limit 0 to 65535."""
    assert r.encode(r.P_GAIN, 16) == b"\x10"
    assert r.decode(r.MAX_TORQUE, r.encode(r.MAX_TORQUE, 1000)) == 1000
    with pytest.raises(ValueError, match=r"P Coefficient \(21\): 256: allowed are 0 to 255"):
        r.encode(r.P_GAIN, 256)
    with pytest.raises(ValueError, match="-1: allowed"):
        r.encode(r.TORQUE_LIMIT, -1)


def test_no_two_registers_overlap() -> None:
    """Every byte of the table has one name."""
    registers = [x for x in vars(r).values() if isinstance(x, Register)]
    places = [at for x in registers for at in range(x.address, x.address + x.size)]
    assert len(places) == len(set(places))
    assert (BLOCK_ADDRESS, BLOCK_BYTES) == (40, 31)


def test_signs_of_a_block() -> None:
    """Registers 40 to 70, filled by hand."""
    table = bytearray(256)
    for address, data in (
        (40, "02"),
        (41, "fe"),
        (42, "0180"),
        (44, "0a00"),
        (46, "e883"),
        (48, "f401"),
        (55, "01"),
        (56, "ff0f"),
        (58, "2c81"),
        (60, "5e05"),
        (62, "4a"),
        (63, "1f"),
        (64, "99"),
        (65, "21"),
        (66, "01"),
        (67, "9999"),
        (69, "0780"),
    ):
        table[address : address + len(data) // 2] = bytes.fromhex(data)
    assert Block.unpack(bytes(table[BLOCK_ADDRESS : BLOCK_ADDRESS + BLOCK_BYTES])) == Block(
        torque_mode=TorqueMode.DAMPING,
        acceleration=254,
        goal_position=-1,
        goal_time=10,
        goal_speed=-1000,
        torque_limit=500,
        lock=1,
        position=4095,
        speed=-300,
        load=-350,
        voltage=74,
        temperature=31,
        status=Fault.VOLTAGE | Fault.OVERLOAD,
        moving=1,
        # The present current has no sign: 0x8007.
        current=32775,
    )
