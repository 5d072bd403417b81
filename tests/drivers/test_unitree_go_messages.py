"""unitree_go's low-level messages for any motors: round trips, slots without a joint, kinds of robots."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.go2.messages import low_command as go2_command
from deal_hw.drivers.go2.messages import low_state as go2_state
from deal_hw.drivers.go2.messages.wire import ORDER
from deal_hw.drivers.unitree.go_messages import layout
from deal_hw.drivers.unitree.go_messages.layout import SLOTS, WireOrder
from deal_hw.drivers.unitree.go_messages.low_command import (
    GoCommand,
    GoCommandEncoder,
    decode_low_command,
)
from deal_hw.drivers.unitree.go_messages.low_state import LowState, LowStateDecoder, encode_low_state
from deal_hw.drivers.unitree.go_messages.robot_kind import humanoid_complaint, quadruped_complaint

SPARE = np.arange(SLOTS) % 3
MOTORS = st.lists(st.integers(0, SLOTS - 1), min_size=1, max_size=SLOTS, unique=True)
FEET = st.permutations(range(4))


def command(rng: np.random.Generator, count: int) -> GoCommand:
    """Return a command of numbers that survive 32 bits."""
    q, dq, kp, kd, tau = rng.integers(-4000, 4000, (5, count)) / 16.0
    return GoCommand(q, dq, kp, kd, tau, rng.integers(0, 256, count))


def state(rng: np.random.Generator, count: int) -> LowState:
    """Return a state of numbers that survive 32 bits."""
    values: dict[str, Any] = {
        name: rng.integers(-4000, 4000, count) / 16.0
        for name in ("position", "velocity", "acceleration", "effort")
    }
    return LowState(
        **values,
        temperature=rng.integers(0, 256, count),
        lost=rng.integers(0, 2**31, count),
        mode=rng.integers(0, 256, count),
        orientation=rng.integers(-16, 16, 4) / 16.0,
        angular_velocity=rng.integers(-16, 16, 3) / 16.0,
        specific_force=rng.integers(-160, 160, 3) / 16.0,
        rpy=rng.integers(-16, 16, 3) / 16.0,
        imu_temperature=int(rng.integers(0, 256)),
        foot_force=rng.integers(-(2**15), 2**15, 4),
        foot_force_estimate=rng.integers(-(2**15), 2**15, 4),
        tick_ms=int(rng.integers(0, 2**32)),
        remote=rng.bytes(40),
        battery_percent=int(rng.integers(0, 101)),
        battery_current_ma=int(rng.integers(-(2**31), 2**31)),
        battery_status=int(rng.integers(0, 256)),
        battery_cycles=int(rng.integers(0, 2**16)),
        cell_voltage_mv=rng.integers(0, 2**16, 15),
        voltage=float(rng.integers(0, 1000) / 16.0),
        current=float(rng.integers(-1000, 1000) / 16.0),
        serial=(int(rng.integers(0, 2**32)), int(rng.integers(0, 2**32))),
        version=(int(rng.integers(0, 2**32)), int(rng.integers(0, 2**32))),
    )


def assert_same(found: LowState, sent: LowState) -> None:
    """Check each field."""
    for name in LowState.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(found, name), getattr(sent, name), err_msg=name)


@given(MOTORS, st.integers(0, 2**32))
@settings(deadline=None)
def test_a_command_comes_back_whatever_the_motors(motors: list[int], seed: int) -> None:
    """Each motor's numbers are in its own slot; the others keep the vendor's stop values and their mode."""
    slots = np.array(motors)
    sent = command(np.random.default_rng(seed), len(slots))
    encoder = GoCommandEncoder(slots, SPARE)
    # What an earlier command left in the buffer must not remain.
    encoder.encode(command(np.random.default_rng(seed + 1), len(slots)))
    payload = encoder.encode(sent)
    found = decode_low_command(payload, slots)
    for name in ("position", "velocity", "stiffness", "damping", "effort", "mode", "level"):
        np.testing.assert_array_equal(getattr(found, name), getattr(sent, name), err_msg=name)
    record = np.frombuffer(payload, layout.LOW_COMMAND)[0]
    modes = np.frombuffer(payload, "u1")[layout.COMMAND_MODE_AT]
    for slot in range(SLOTS):
        numbers = [float(record["motor"][name][slot]) for name in ("q", "dq", "tau", "kp", "kd")]
        if slot in motors:
            joint = motors.index(slot)
            assert numbers[0] == sent.position[joint] and modes[slot] == sent.mode[joint]
        else:
            assert numbers == [2146000000.0, 16000.0, 0.0, 0.0, 0.0] and modes[slot] == SPARE[slot]


@given(MOTORS, FEET, st.integers(0, 2**32))
@settings(deadline=None)
def test_a_state_comes_back_whatever_the_motors(motors: list[int], feet: list[int], seed: int) -> None:
    """Every field, and zeros in the slots without a joint."""
    order = WireOrder(motors=np.array(motors), feet=np.array(feet))
    sent = state(np.random.default_rng(seed), len(motors))
    payload = encode_low_state(sent, order)
    assert_same(LowStateDecoder(order).decode(payload).values(), sent)
    record = np.frombuffer(payload, layout.LOW_STATE)[0]
    empty = [slot for slot in range(SLOTS) if slot not in motors]
    assert not any(record["motor"][name][empty].any() for name in ("q", "tau_est", "temperature", "lost"))


@given(st.integers(0, 2**32))
@settings(deadline=None)
def test_the_go2_is_one_order_among_others(seed: int) -> None:
    """Its own functions make and read the same bytes as the general ones with its motor numbers."""
    rng = np.random.default_rng(seed)
    sent, said = command(rng, 12), state(rng, 12)
    payload = go2_command.LowCommandEncoder().encode(
        go2_command.LowCommand(
            sent.position, sent.velocity, sent.stiffness, sent.damping, sent.effort, sent.mode
        )
    )
    assert payload == GoCommandEncoder(ORDER.motors, np.ones(SLOTS, np.int64)).encode(sent)
    assert go2_state.encode_low_state(said) == encode_low_state(said, ORDER)
    assert_same(go2_state.decode_low_state(encode_low_state(said, ORDER)).values(), said)


# Which robot a state is of. The frames are made by hand: zeros, and a motor's q or temperature by its offset.

Q_AT, TEMPERATURE_AT, MOTOR_BYTES = 84, 112, 48
GO2, GO2_W, H1 = range(12), range(16), [slot for slot in range(20) if slot != 9]


def reporting(slots: Iterable[int], *, cold: bool = False) -> bytes:
    """Return a LowState in which slots report a position and, unless cold, a temperature."""
    buffer = bytearray(layout.LOW_STATE_BYTES)
    for slot in slots:
        struct.pack_into("<f", buffer, Q_AT + MOTOR_BYTES * slot, -0.01)
        buffer[TEMPERATURE_AT + MOTOR_BYTES * slot] = 0 if cold else 31
    return bytes(buffer)


@pytest.mark.parametrize("cold", [False, True])
@pytest.mark.parametrize(
    ("slots", "quadruped", "humanoid"),
    [
        (GO2, "", "take robot `go2` or `b2`"),
        (H1, "16 to 19.*take robot `h1`", ""),
        (range(20), "16 to 19.*take robot `h1`", ""),
        (GO2_W, "12 to 15.*Go2-W.*do not command", "16 to 19"),
        # An H1 whose arms are off, or are not there.
        ([slot for slot in H1 if slot < 12], "motor 9.*take robot `h1`", "16 to 19"),
    ],
    ids=["go2", "h1", "h1 with slot 9", "go2-w", "h1 without arms"],
)
def test_the_slots_that_report_tell_the_robot(
    slots: Iterable[int], quadruped: str, humanoid: str, cold: bool
) -> None:
    """By positions alone, too, as those of a simulator without temperatures."""
    payload = reporting(slots, cold=cold)
    for found, expected in (
        (quadruped_complaint(payload, "Go2"), quadruped),
        (humanoid_complaint(payload), humanoid),
    ):
        assert re.search(expected, found) if expected else found == ""


@given(st.integers(0, 19), st.floats(-3.0, 3.0, width=32).filter(bool), st.integers(1, 255))
def test_one_more_motor_makes_no_go2(slot: int, position: float, temperature: int) -> None:
    """A single value in a slot beyond 11 is enough; inside, a Go2 remains one."""
    for offset, value in ((Q_AT, struct.pack("<f", position)), (TEMPERATURE_AT, bytes([temperature]))):
        payload = bytearray(reporting(GO2))
        at = offset + MOTOR_BYTES * slot
        payload[at : at + len(value)] = value
        assert bool(quadruped_complaint(bytes(payload), "Go2")) == (slot > 11)
