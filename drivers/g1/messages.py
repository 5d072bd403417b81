"""The G1's low-level messages (unitree_hg) as bytes: CDR with its 4-byte header, as DDS and Zenoh carry it.

A hazard of this wire: LowCmd has 1004 bytes and LowState 2092, both as CDR with header and as the C struct
over which the vendor computes the checksum. The two layouts differ. Source: IDL and utils/crc.py of
unitree_sdk2_python @ 37116c5. The first motor's mode byte follows its predecessor without padding, so the
other motors' stride does not apply to it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.drivers.g1.joints import MOTORS
from deal_hw.drivers.unitree.cdr import (
    CDR_HEADER,
    check_length,
    field_mask,
    packed,
    verify_words,
    words_crc,
)
from deal_hw.drivers.unitree.joint_frame import JointFrame, hot_words
from deal_hw.drivers.unitree.motor_command import check_numbers
from deal_hw.errors import ConfigurationError, FrameError
from deal_hw.types import FloatArray, IntArray

SLOTS: Final = 35
"""Motor slots of the messages; the G1 uses the first 29."""
LOW_COMMAND_BYTES: Final = 1004
LOW_STATE_BYTES: Final = 2092
MODE_PR: Final = 0
"""mode_pr: ankles and waist as pitch and roll joints (1: as their two parallel motors)."""

_MOTOR_COMMAND: Final = packed(
    28,
    {
        "q": ("<f4", 0),
        "dq": ("<f4", 4),
        "tau": ("<f4", 8),
        "kp": ("<f4", 12),
        "kd": ("<f4", 16),
        "reserve": ("<u4", 20),
    },
)
LOW_COMMAND: Final = packed(
    LOW_COMMAND_BYTES,
    {
        "encapsulation": (("u1", 4), 0),
        "mode_pr": ("u1", 4),
        "mode_machine": ("u1", 5),
        # A motor's numbers without its mode byte, which comes before their padding.
        "motor": ((_MOTOR_COMMAND, SLOTS), 8),
        "reserve": (("<u4", 4), 984),
        "crc": ("<u4", 1000),
    },
)
COMMAND_MODE_AT: Final = np.array([6, *range(32, 32 + 28 * (SLOTS - 1), 28)])
"""Offset of each motor's mode byte in a LowCmd, (35,)."""
_MOTOR_STATE: Final = packed(
    56,
    {
        "q": ("<f4", 0),
        "dq": ("<f4", 4),
        "ddq": ("<f4", 8),
        "tau_est": ("<f4", 12),
        "temperature": (("<i2", 2), 16),
        "vol": ("<f4", 20),
        "sensor": (("<u4", 2), 24),
        "motorstate": ("<u4", 32),
        "reserve": (("<u4", 4), 36),
    },
)
LOW_STATE: Final = packed(
    LOW_STATE_BYTES,
    {
        "encapsulation": (("u1", 4), 0),
        "version": (("<u4", 2), 4),
        "mode_pr": ("u1", 12),
        "mode_machine": ("u1", 13),
        "tick": ("<u4", 16),
        "quaternion": (("<f4", 4), 20),
        "gyroscope": (("<f4", 3), 36),
        "accelerometer": (("<f4", 3), 48),
        "rpy": (("<f4", 3), 60),
        "imu_temperature": ("<i2", 72),
        "motor": ((_MOTOR_STATE, SLOTS), 76),
        "wireless_remote": (("u1", 40), 2032),
        "reserve": (("<u4", 4), 2072),
        "crc": ("<u4", 2088),
    },
)
STATE_MODE_AT: Final = np.array([74, *range(128, 128 + 56 * (SLOTS - 1), 56)])
"""Offset of each motor's mode byte in a LowState, (35,)."""


def low_command_image(payload: bytes) -> bytes:
    """Return the C struct's image of a LowCmd without its last word, 1000 bytes."""
    return payload[4:6] + b"\0\0" + payload[6:7] + b"\0\0\0" + payload[8:1000]


def low_state_image(payload: bytes) -> bytes:
    """Return the C struct's image of a LowState without its last word, 2088 bytes."""
    return payload[4:74] + b"\0\0" + payload[74:75] + b"\0\0\0" + payload[76:2088]


def slots_of(joints: Sequence[str]) -> IntArray:
    """Return the motor number of each joint, (J,)."""
    return np.array([MOTORS.index(joint) for joint in joints])


@dataclass(frozen=True, slots=True)
class G1Command:
    """PD targets for the motors, arrays (J,) in the order of the joints.

    Attributes:
        position: Targets q [rad].
        velocity: Targets dq [rad/s].
        stiffness: kp [N·m/rad].
        damping: kd [N·m·s/rad].
        effort: Feed-forward tau [N·m].
        mode: 1 enabled, 0 disabled.
        mode_machine: The version of the G1 that the command is for.
        mode_pr: 0: ankles and waist as pitch and roll joints.
    """

    position: FloatArray
    velocity: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    effort: FloatArray
    mode: IntArray
    mode_machine: int = 0
    mode_pr: int = MODE_PR


class G1CommandEncoder:
    """Writes LowCmds into a buffer of its own and returns copies; one for each thread.

    Args:
        joints: The joints of this version; motors of other slots are disabled.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self._slots = slots_of(joints)
        self._buffer = bytearray(LOW_COMMAND_BYTES)
        self._buffer[:4] = CDR_HEADER
        self._record = np.frombuffer(self._buffer, LOW_COMMAND)[0]
        self._bytes = np.frombuffer(self._buffer, "u1")

    def encode(self, command: G1Command) -> bytes:
        """Return the command as CDR with header and checksum, 1004 bytes.

        Raises:
            FrameError: A number is not finite, or implausibly large.
        """
        values = np.concatenate(
            (command.position, command.velocity, command.effort, command.stiffness, command.damping)
        )
        check_numbers(values)
        self._buffer[4], self._buffer[5] = command.mode_pr, command.mode_machine
        self._bytes[COMMAND_MODE_AT[self._slots]] = command.mode
        motors = self._record["motor"]
        for name, part in (
            ("q", command.position),
            ("dq", command.velocity),
            ("tau", command.effort),
            ("kp", command.stiffness),
            ("kd", command.damping),
        ):
            motors[name][self._slots] = part
        crc = words_crc(low_command_image(bytes(self._buffer)))
        self._buffer[1000:] = crc.to_bytes(4, "little")
        return bytes(self._buffer)


def decode_low_command(payload: bytes, joints: Sequence[str]) -> G1Command:
    """Return the command in a LowCmd, as a robot with these joints would take it.

    Raises:
        FrameError: Wrong length, header or checksum, or a reserved field that is not 0.
    """
    _check(payload, "LowCmd")
    _verify(payload, "LowCmd")
    slots = slots_of(joints)
    record = np.frombuffer(payload, LOW_COMMAND)[0]
    if record["reserve"].any() or record["motor"]["reserve"].any():
        raise FrameError(
            "LowCmd: reserved fields are set; the sender uses another version, or another layout"
        )
    motors = record["motor"][slots]
    modes = np.frombuffer(payload, "u1")[COMMAND_MODE_AT[slots]].astype(np.int64)
    q, dq, kp, kd, tau = (motors[name].astype(np.float64) for name in ("q", "dq", "kp", "kd", "tau"))
    return G1Command(q, dq, kp, kd, tau, modes, mode_machine=payload[5], mode_pr=payload[4])


@dataclass(frozen=True, slots=True, kw_only=True)
class G1State:
    """The robot's state, sent every 2 ms, arrays in the order of the joints (J).

    Attributes:
        position: q, (J,) [rad].
        velocity: dq, (J,) [rad/s].
        acceleration: ddq, (J,) [rad/s²].
        effort: tau_est, the motors' estimate, (J,) [N·m].
        casing: Temperature of each motor's casing, (J,) [°C].
        winding: Temperature of each motor's winding, (J,) [°C].
        voltage: Of each motor's supply, (J,) [V].
        error: motorstate, the error code of each motor, 0 for none, (J,).
        mode: Of each motor, (J,).
        orientation: Quaternion wxyz, pelvis in the world, (4,).
        angular_velocity: Pelvis's frame, (3,) [rad/s].
        specific_force: Pelvis's frame, (3,) [m/s²]; +9.81 upwards at rest.
        rpy: Roll, pitch, yaw, (3,) [rad].
        imu_temperature: [°C].
        tick_ms: The robot's clock, modulo 2**32 [ms].
        remote: The remote control's 40 bytes.
        mode_machine: Version of the G1, see :data:`deal_hw.drivers.g1.joints.MACHINES`.
        mode_pr: See :data:`MODE_PR`.
        version: Version of the firmware, two words.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    casing: IntArray
    winding: IntArray
    voltage: FloatArray
    error: IntArray
    mode: IntArray
    orientation: FloatArray
    angular_velocity: FloatArray
    specific_force: FloatArray
    rpy: FloatArray
    imu_temperature: int
    tick_ms: int
    remote: bytes
    mode_machine: int
    mode_pr: int = MODE_PR
    version: tuple[int, int] = (0, 0)


_BODY_WORD: Final = 5
_MOTOR_WORD: Final = 19
_MOTOR_WORDS: Final = 14


class G1Frame(JointFrame):
    """A received LowState: attributes as :class:`G1State`'s, read from the bytes on access.

    Attributes:
        slots: Motor numbers of the joints, (J,).
    """

    __slots__ = ("slots",)

    def __init__(self, payload: bytes, slots: IntArray, hot: IntArray) -> None:
        super().__init__(payload, hot, len(slots))
        self.slots = slots

    @property
    def casing(self) -> IntArray:
        """Temperatures of the motors' casings, (J,) [°C]."""
        return self._words("<i2", 46)

    @property
    def winding(self) -> IntArray:
        """Temperatures of the motors' windings, (J,) [°C]."""
        return self._words("<i2", 47)

    @property
    def error(self) -> IntArray:
        """Error codes of the motors, (J,)."""
        return self._words("<u4", 27)

    @property
    def voltage(self) -> FloatArray:
        """Of each motor's supply, (J,) [V]."""
        record = np.frombuffer(self.payload, LOW_STATE)[0]
        return np.asarray(record["motor"]["vol"][self.slots].astype(np.float64))

    @property
    def mode(self) -> IntArray:
        """Modes of the motors, (J,)."""
        modes = np.frombuffer(self.payload, "u1")[STATE_MODE_AT[self.slots]]
        return np.asarray(modes, dtype=np.int64)

    @property
    def mode_pr(self) -> int:
        """See :data:`MODE_PR`."""
        return self.payload[12]

    @property
    def mode_machine(self) -> int:
        """Version of the G1."""
        return self.payload[13]

    @property
    def tick_ms(self) -> int:
        """The robot's clock, modulo 2**32 [ms]."""
        return int.from_bytes(self.payload[16:20], "little")

    @property
    def remote(self) -> bytes:
        """The remote control's 40 bytes."""
        return self.payload[2032:2072]

    @property
    def version(self) -> tuple[int, int]:
        """Version of the firmware, two words."""
        return int.from_bytes(self.payload[4:8], "little"), int.from_bytes(self.payload[8:12], "little")

    def _words(self, kind: str, first: int) -> IntArray:
        """Return an integer of each motor; ``first``: its index among numbers of this kind in slot 0."""
        stride = 56 // np.dtype(kind).itemsize
        return np.asarray(np.frombuffer(self.payload, kind)[first + stride * self.slots], dtype=np.int64)


class G1StateDecoder:
    """Reads LowStates of a G1 with some joints.

    Args:
        joints: The joints, in the wanted order.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self.slots = slots_of(joints)
        self._hot = hot_words(self.slots, _MOTOR_WORD, _MOTOR_WORDS, _BODY_WORD)

    def decode(self, payload: bytes) -> G1Frame:
        """Return the state in a LowState. Reserved fields are ignored: newer firmware may use them.

        Numbers that are not finite pass, because the safety module decides about them.

        Raises:
            FrameError: Wrong length, header or checksum.
        """
        _check(payload, "LowState")
        _verify(payload, "LowState")
        return G1Frame(payload, self.slots, self._hot)


def encode_low_state(state: G1State, joints: Sequence[str]) -> bytes:
    """Return the state as CDR with header and checksum, 2092 bytes; unused slots are 0.

    Raises:
        ConfigurationError: The remote's bytes are not 40.
    """
    if len(state.remote) != 40:
        raise ConfigurationError(f"LowState.remote has {len(state.remote)} bytes, expected 40")
    slots = slots_of(joints)
    buffer = bytearray(LOW_STATE_BYTES)
    record = np.frombuffer(buffer, LOW_STATE)[0]
    buffer[:4] = CDR_HEADER
    buffer[12], buffer[13] = state.mode_pr, state.mode_machine
    motors = record["motor"]
    for name, value in (
        ("q", state.position),
        ("dq", state.velocity),
        ("ddq", state.acceleration),
        ("tau_est", state.effort),
        ("vol", state.voltage),
        ("motorstate", state.error),
        ("temperature", np.stack((state.casing, state.winding), axis=-1)),
    ):
        motors[name][slots] = value
    np.frombuffer(buffer, "u1")[STATE_MODE_AT[slots]] = state.mode
    for name, number in (
        ("version", state.version),
        ("tick", state.tick_ms),
        ("quaternion", state.orientation),
        ("gyroscope", state.angular_velocity),
        ("accelerometer", state.specific_force),
        ("rpy", state.rpy),
        ("imu_temperature", state.imu_temperature),
    ):
        record[name] = number
    buffer[2032:2072] = state.remote
    buffer[2088:] = words_crc(low_state_image(bytes(buffer))).to_bytes(4, "little")
    return bytes(buffer)


def _check(payload: bytes, name: str) -> None:
    """Refuse a payload that is not a whole CDR message of this type.

    Raises:
        FrameError: Wrong length or header.
    """
    size = LOW_COMMAND_BYTES if name == "LowCmd" else LOW_STATE_BYTES
    check_length(payload, name, size)
    if payload[:4] != CDR_HEADER:
        raise FrameError(
            f"{name}: the CDR header is {payload[:4].hex(' ')}, expected {CDR_HEADER.hex(' ')} (version 1, "
            f"little-endian); the C struct's image has {size} bytes, too, but another layout"
        )


def _verify(payload: bytes, name: str) -> None:
    """Refuse a message whose checksum is wrong.

    Raises:
        FrameError: It is wrong.
    """
    image = low_command_image if name == "LowCmd" else low_state_image
    verify_words(payload, name, image, _mask)


@functools.cache
def _mask(name: str) -> npt.NDArray[np.uint8]:
    """Return 255 for each byte that belongs to a field, 0 for padding."""
    if name == "LowCmd":
        return field_mask(LOW_COMMAND, COMMAND_MODE_AT, SLOTS)
    return field_mask(LOW_STATE, STATE_MODE_AT, SLOTS)
