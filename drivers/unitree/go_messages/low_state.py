"""LowState: the robot's state, every 2 ms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.drivers.unitree.cdr import words_crc
from deal_hw.drivers.unitree.go_messages import layout
from deal_hw.drivers.unitree.go_messages.frames import (
    BEGIN,
    LEVEL_LOW,
    check_frame,
    low_state_image,
    verify_crc,
)
from deal_hw.drivers.unitree.go_messages.layout import LOW_STATE_BYTES, WireOrder
from deal_hw.drivers.unitree.joint_frame import JointFrame, hot_words
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LowState:
    """The robot's state, sent every 2 ms, arrays in the robot's own order of joints (J) and feet.

    Attributes:
        position: q, (J,) [rad].
        velocity: dq, (J,) [rad/s].
        acceleration: ddq, (J,) [rad/s²].
        effort: tau_est, the motors' estimate, (J,) [N·m].
        temperature: Of each motor, (J,) [°C].
        lost: Commands that each motor missed so far, (J,).
        mode: Of each motor, (J,).
        orientation: Quaternion wxyz, base in the world, (4,).
        angular_velocity: Base's frame, (3,) [rad/s].
        specific_force: Base's frame, (3,) [m/s²]; +9.81 upwards at rest.
        rpy: Roll, pitch, yaw, (3,) [rad].
        imu_temperature: [°C].
        foot_force: Sensor units, (4,).
        foot_force_estimate: The robot's estimate, (4,).
        tick_ms: The robot's clock, modulo 2**32 [ms].
        remote: The remote control's 40 bytes; see remote.py.
        battery_percent: State of charge.
        battery_current_ma: Negative: discharging [mA].
        battery_status: The battery's own status byte.
        battery_cycles: Charging cycles so far.
        cell_voltage_mv: (15,) [mV].
        voltage: Of the supply [V].
        current: Drawn from the supply [A].
        level: level_flag.
        serial: Serial number, two words.
        version: Version of the robot's firmware, two words.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    temperature: IntArray
    lost: IntArray
    mode: IntArray
    orientation: FloatArray
    angular_velocity: FloatArray
    specific_force: FloatArray
    rpy: FloatArray
    imu_temperature: int
    foot_force: IntArray
    foot_force_estimate: IntArray
    tick_ms: int
    remote: bytes
    battery_percent: int
    battery_current_ma: int
    battery_status: int
    battery_cycles: int
    cell_voltage_mv: IntArray
    voltage: float
    current: float
    level: int = LEVEL_LOW
    serial: tuple[int, int] = (0, 0)
    version: tuple[int, int] = (0, 0)


_BODY_WORD: Final = 7
_MOTOR_WORD: Final = 21
_MOTOR_WORDS: Final = 12
_LOST_WORD: Final = 29
_TEMPERATURE_AT: Final = 112
_MOTOR_BYTES: Final = 48
_F4: Final = np.dtype("<f4")


class LowStateFrame(JointFrame):
    """A received LowState: attributes as :class:`LowState`'s, read from the bytes on access.

    Attributes:
        crc_checked: Whether the checksum was verified.
        order: Where the robot's joints and feet are.
    """

    __slots__ = ("crc_checked", "order")

    def __init__(self, payload: bytes, hot: IntArray, crc_checked: bool, order: WireOrder) -> None:
        super().__init__(payload, hot, len(order.motors))
        self.crc_checked, self.order = crc_checked, order

    @property
    def tick_ms(self) -> int:
        """The robot's clock, modulo 2**32 [ms]."""
        return int.from_bytes(self.payload[1100:1104], "little")

    @property
    def remote(self) -> bytes:
        """The remote control's 40 bytes."""
        return self.payload[1104:1144]

    @property
    def battery_percent(self) -> int:
        """State of charge."""
        return self.payload[1043]

    @property
    def temperature(self) -> IntArray:
        """Of each motor, (J,) [°C]."""
        at = _TEMPERATURE_AT + _MOTOR_BYTES * self.order.motors
        return np.frombuffer(self.payload, np.uint8).take(at).astype(np.int64)

    @property
    def lost(self) -> IntArray:
        """Commands that each motor missed so far, (J,)."""
        at = _LOST_WORD + _MOTOR_WORDS * self.order.motors
        return np.frombuffer(self.payload, np.uint32).take(at).astype(np.int64)

    @property
    def mode(self) -> IntArray:
        """Of each motor, (J,)."""
        at = layout.STATE_MODE_AT[self.order.motors]
        return np.frombuffer(self.payload, np.uint8).take(at).astype(np.int64)

    @property
    def foot_force(self) -> IntArray:
        """Sensor units, (4,)."""
        return np.frombuffer(self.payload, np.int16, 4, 1084).take(self.order.feet).astype(np.int64)

    @property
    def voltage(self) -> float:
        """Of the supply [V]."""
        return float(np.frombuffer(self.payload, _F4, 1, 1156)[0])

    @property
    def current(self) -> float:
        """Drawn from the supply [A]."""
        return float(np.frombuffer(self.payload, _F4, 1, 1160)[0])

    def values(self) -> LowState:
        """Return all values, each array a copy of its own."""
        record = np.frombuffer(self.payload, layout.LOW_STATE)[0]
        return LowState(
            position=self.position.copy(),
            velocity=self.velocity.copy(),
            acceleration=self.acceleration.copy(),
            effort=self.effort.copy(),
            temperature=self.temperature,
            lost=self.lost,
            mode=self.mode,
            orientation=self.orientation.copy(),
            angular_velocity=self.angular_velocity.copy(),
            specific_force=self.specific_force.copy(),
            rpy=self.rpy.copy(),
            imu_temperature=self.payload[80],
            foot_force=self.foot_force,
            foot_force_estimate=record["foot_force_est"][self.order.feet].astype(np.int64),
            tick_ms=self.tick_ms,
            remote=self.remote,
            battery_percent=self.battery_percent,
            battery_current_ma=int(record["bms_current"]),
            battery_status=int(record["bms_status"]),
            battery_cycles=int(record["bms_cycle"]),
            cell_voltage_mv=record["cell_vol"].astype(np.int64),
            voltage=self.voltage,
            current=self.current,
            level=self.payload[6],
            serial=(int(record["sn"][0]), int(record["sn"][1])),
            version=(int(record["version"][0]), int(record["version"][1])),
        )


class LowStateDecoder:
    """Reads LowStates of a robot.

    Args:
        order: Where its joints and feet are.
    """

    def __init__(self, order: WireOrder) -> None:
        self._order = order
        self._hot = hot_words(order.motors, _MOTOR_WORD, _MOTOR_WORDS, _BODY_WORD)

    def decode(self, payload: bytes, strict: bool = True) -> LowStateFrame:
        """Return the state in a LowState. Reserved fields are ignored: newer firmware may use them.

        Numbers that are not finite pass, because the safety module decides about them.

        Args:
            payload: CDR with its header.
            strict: Whether to verify head and checksum, too.

        Raises:
            FrameError: Wrong length, header, head or checksum.
        """
        if len(payload) != LOW_STATE_BYTES or payload[:6] != BEGIN:
            check_frame(payload, "LowState", head=strict)
        if strict:
            verify_crc(payload, "LowState")
        return LowStateFrame(payload, self._hot, strict, self._order)


def encode_low_state(state: LowState, order: WireOrder) -> bytes:
    """Return the state as CDR with header and checksum, 1180 bytes; slots without a joint are 0.

    Args:
        state: The state.
        order: Where the robot's joints and feet are.

    Raises:
        ConfigurationError: The remote's bytes are not 40.
    """
    if len(state.remote) != 40:
        raise ConfigurationError(f"LowState.remote has {len(state.remote)} bytes, expected 40")
    buffer = bytearray(LOW_STATE_BYTES)
    record = np.frombuffer(buffer, layout.LOW_STATE)[0]
    buffer[:6], buffer[6] = BEGIN, state.level
    motors = record["motor"]
    for name, value in (
        ("q", state.position),
        ("dq", state.velocity),
        ("ddq", state.acceleration),
        ("tau_est", state.effort),
        ("q_raw", state.position),
        ("dq_raw", state.velocity),
        ("ddq_raw", state.acceleration),
        ("temperature", state.temperature),
        ("lost", state.lost),
    ):
        motors[name][order.motors] = value
    np.frombuffer(buffer, "u1")[layout.STATE_MODE_AT[order.motors]] = state.mode
    record["foot_force"][order.feet] = state.foot_force
    record["foot_force_est"][order.feet] = state.foot_force_estimate
    buffer[1104:1144] = state.remote
    for name, number in (
        ("quaternion", state.orientation),
        ("gyroscope", state.angular_velocity),
        ("accelerometer", state.specific_force),
        ("rpy", state.rpy),
        ("imu_temperature", state.imu_temperature),
        ("tick", state.tick_ms),
        ("soc", state.battery_percent),
        ("bms_current", state.battery_current_ma),
        ("bms_status", state.battery_status),
        ("bms_cycle", state.battery_cycles),
        ("cell_vol", state.cell_voltage_mv),
        ("power_v", state.voltage),
        ("power_a", state.current),
        ("sn", state.serial),
        ("version", state.version),
    ):
        record[name] = number
    buffer[1176:] = words_crc(low_state_image(bytes(buffer))).to_bytes(4, "little")
    return bytes(buffer)
