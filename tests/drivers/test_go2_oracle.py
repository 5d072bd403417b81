"""The Go2's messages against pycdr2, an independent CDR library: byte for byte, in both directions."""

import dataclasses
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from fakes.unitree_mujoco import UnitreeMujoco
from hypothesis import given, settings
from hypothesis import strategies as st
from pycdr2 import IdlStruct
from pycdr2.types import array, float32, int16, int32, int64, sequence, uint8, uint16, uint32

from deal_hw.drivers.go2.descriptions.floor import JOINTS, LEGS
from deal_hw.drivers.go2.messages import sport_state
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.go2.messages.wire import WIRE_JOINTS, WIRE_LEGS
from deal_hw.drivers.unitree import remote, rpc
from deal_hw.drivers.unitree.go_messages.low_state import LowState
from deal_hw.errors import FrameError

# The IDL of unitree_go and unitree_api, field by field. Fields are named as there.


@dataclass
class MotorCmd(IdlStruct):
    mode: uint8
    q: float32
    dq: float32
    tau: float32
    kp: float32
    kd: float32
    reserve: array[uint32, 3]


@dataclass
class BmsCmd(IdlStruct):
    off: uint8
    reserve: array[uint8, 3]


@dataclass
class LowCmd(IdlStruct):
    head: array[uint8, 2]
    level_flag: uint8
    frame_reserve: uint8
    sn: array[uint32, 2]
    version: array[uint32, 2]
    bandwidth: uint16
    motor_cmd: array[MotorCmd, 20]
    bms_cmd: BmsCmd
    wireless_remote: array[uint8, 40]
    led: array[uint8, 12]
    fan: array[uint8, 2]
    gpio: uint8
    reserve: uint32
    crc: uint32


@dataclass
class ImuState(IdlStruct):
    quaternion: array[float32, 4]
    gyroscope: array[float32, 3]
    accelerometer: array[float32, 3]
    rpy: array[float32, 3]
    temperature: uint8


@dataclass
class MotorState(IdlStruct):
    mode: uint8
    q: float32
    dq: float32
    ddq: float32
    tau_est: float32
    q_raw: float32
    dq_raw: float32
    ddq_raw: float32
    temperature: uint8
    lost: uint32
    reserve: array[uint32, 2]


@dataclass
class BmsState(IdlStruct):
    version_high: uint8
    version_low: uint8
    status: uint8
    soc: uint8
    current: int32
    cycle: uint16
    bq_ntc: array[uint8, 2]
    mcu_ntc: array[uint8, 2]
    cell_vol: array[uint16, 15]


@dataclass
class LowStateIdl(IdlStruct):
    head: array[uint8, 2]
    level_flag: uint8
    frame_reserve: uint8
    sn: array[uint32, 2]
    version: array[uint32, 2]
    bandwidth: uint16
    imu_state: ImuState
    motor_state: array[MotorState, 20]
    bms_state: BmsState
    foot_force: array[int16, 4]
    foot_force_est: array[int16, 4]
    tick: uint32
    wireless_remote: array[uint8, 40]
    bit_flag: uint8
    adc_reel: float32
    temperature_ntc1: uint8
    temperature_ntc2: uint8
    power_v: float32
    power_a: float32
    fan_frequency: array[uint16, 4]
    reserve: uint32
    crc: uint32


@dataclass
class TimeSpec(IdlStruct):
    sec: int32
    nanosec: uint32


@dataclass
class PathPoint(IdlStruct):
    t_from_start: float32
    x: float32
    y: float32
    yaw: float32
    vx: float32
    vy: float32
    vyaw: float32


@dataclass
class SportModeShort(IdlStruct):
    stamp: TimeSpec
    error_code: uint32
    imu_state: ImuState
    mode: uint8
    progress: float32
    gait_type: uint8
    foot_raise_height: float32
    position: array[float32, 3]
    body_height: float32
    velocity: array[float32, 3]
    yaw_speed: float32
    range_obstacle: array[float32, 4]
    foot_force: array[int16, 4]
    foot_position_body: array[float32, 12]
    foot_speed_body: array[float32, 12]


# pycdr2 knows no inheritance.
SportModeLong = dataclasses.make_dataclass(
    "SportModeLong",
    [
        *((part.name, part.type) for part in dataclasses.fields(SportModeShort)),
        ("path_point", array[PathPoint, 10]),
    ],
    bases=(IdlStruct,),
)


@dataclass
class Identity(IdlStruct):
    id: int64
    api_id: int64


@dataclass
class Lease(IdlStruct):
    id: int64


@dataclass
class Policy(IdlStruct):
    priority: int32
    noreply: bool


@dataclass
class RequestHeader(IdlStruct):
    identity: Identity
    lease: Lease
    policy: Policy


@dataclass
class RequestIdl(IdlStruct):
    header: RequestHeader
    parameter: str
    binary: sequence[uint8]


@dataclass
class ReplyStatus(IdlStruct):
    code: int32


@dataclass
class ResponseHeader(IdlStruct):
    identity: Identity
    status: ReplyStatus


@dataclass
class ResponseIdl(IdlStruct):
    header: ResponseHeader
    data: str
    binary: sequence[uint8]


@dataclass
class Wireless(IdlStruct):
    lx: float32
    ly: float32
    rx: float32
    ry: float32
    keys: uint16


seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=20, deadline=None)
HEADER = bytes((0, 1, 0, 0))
IN_WIRE_ORDER = [JOINTS.index(joint) for joint in WIRE_JOINTS]
LEGS_IN_WIRE_ORDER = [LEGS.index(leg) for leg in WIRE_LEGS]
COMMAND_STRUCT = "<4B4IH2x" + "B3x5f3I" * 20 + "4B" + "55Bx2I"
STATE_STRUCT = "<4B4IH2x" + "13fB3x" + "B3x7fB3x3I" * 20 + "4BiH4B15H" + "8hI41B3xf2B2x2f4H2I"
"""The C structs as unitree_sdk2_python packs them for its checksum: another layout than CDR."""


def vendor_crc(image: bytes) -> int:
    """Return the checksum bit by bit, over all words but the last, each from its highest bit."""
    crc = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", image[:-4]):
        for bit in range(31, -1, -1):
            top = crc >> 31
            crc = (crc << 1) & 0xFFFFFFFF
            if top ^ (word >> bit & 1):
                crc ^= 0x04C11DB7
    return crc


def flat(value: Any) -> list[Any]:
    """Return the numbers of a message in the order of its fields."""
    if isinstance(value, IdlStruct):
        return [n for field in dataclasses.fields(value) for n in flat(getattr(value, field.name))]
    if isinstance(value, (list, tuple, bytes)):
        return [n for part in value for n in flat(part)]
    return [value]


def random_message(kind: Any, size: int, seed: int) -> Any:
    """Return a message whose every field is random: random bytes, read by pycdr2."""
    rng = np.random.default_rng(seed)
    message = kind.deserialize(HEADER + rng.integers(0, 256, size - 4, dtype=np.uint8).tobytes())
    if hasattr(message, "head"):
        message.head = bytes((0xFE, 0xEF))
    return message


def signed(message: Any, layout: str) -> bytes:
    """Return a message with its checksum, serialised by pycdr2."""
    message.crc = 0
    message.crc = vendor_crc(struct.pack(layout, *flat(message)))
    return bytes(message.serialize())


def motors(message: Any, name: str) -> list[Any]:
    """Return a field of the first 12 motors in the order of the wire."""
    slots = message.motor_cmd if hasattr(message, "motor_cmd") else message.motor_state
    return [getattr(motor, name) for motor in slots[:12]]


@few
@given(seeds)
def test_decoded_state_equals_the_oracle(seed: int) -> None:
    """Every field of a LowState with random contents, reserved ones and NaN included, arrives at its name."""
    message = random_message(LowStateIdl, 1180, seed)
    state = decode_low_state(signed(message, STATE_STRUCT)).values()
    for ours, theirs in (
        ("position", "q"),
        ("velocity", "dq"),
        ("acceleration", "ddq"),
        ("effort", "tau_est"),
        ("temperature", "temperature"),
        ("lost", "lost"),
        ("mode", "mode"),
    ):
        np.testing.assert_array_equal(getattr(state, ours)[IN_WIRE_ORDER], motors(message, theirs), ours)
    imu, bms = message.imu_state, message.bms_state
    for ours, expected in (
        (state.orientation, imu.quaternion),
        (state.angular_velocity, imu.gyroscope),
        (state.specific_force, imu.accelerometer),
        (state.rpy, imu.rpy),
        (state.imu_temperature, imu.temperature),
        (state.foot_force[LEGS_IN_WIRE_ORDER], message.foot_force),
        (state.foot_force_estimate[LEGS_IN_WIRE_ORDER], message.foot_force_est),
        (state.tick_ms, message.tick),
        (state.battery_percent, bms.soc),
        (state.battery_current_ma, bms.current),
        (state.battery_status, bms.status),
        (state.battery_cycles, bms.cycle),
        (state.cell_voltage_mv, bms.cell_vol),
        (state.voltage, message.power_v),
        (state.current, message.power_a),
        (state.level, message.level_flag),
        (state.serial, message.sn),
        (state.version, message.version),
    ):
        np.testing.assert_array_equal(ours, expected)
    assert state.remote == bytes(message.wireless_remote)


def random_state(seed: int) -> LowState:
    """Return a state whose numbers fit their fields exactly."""
    rng = np.random.default_rng(seed)

    def reals(count: int) -> Any:
        return rng.normal(size=count).astype(np.float32).astype(float)

    def whole(low: int, high: int, count: int) -> Any:
        return rng.integers(low, high, count)

    return LowState(
        position=reals(12),
        velocity=reals(12),
        acceleration=reals(12),
        effort=reals(12),
        temperature=whole(0, 256, 12),
        lost=whole(0, 2**32, 12),
        mode=whole(0, 256, 12),
        orientation=reals(4),
        angular_velocity=reals(3),
        specific_force=reals(3),
        rpy=reals(3),
        imu_temperature=int(rng.integers(256)),
        foot_force=whole(-(2**15), 2**15, 4),
        foot_force_estimate=whole(-(2**15), 2**15, 4),
        tick_ms=int(rng.integers(2**32)),
        remote=rng.integers(0, 256, 40, dtype=np.uint8).tobytes(),
        battery_percent=int(rng.integers(101)),
        battery_current_ma=int(rng.integers(-(2**31), 2**31)),
        battery_status=int(rng.integers(256)),
        battery_cycles=int(rng.integers(2**16)),
        cell_voltage_mv=whole(0, 2**16, 15),
        voltage=float(reals(1)[0]),
        current=float(reals(1)[0]),
        serial=(int(rng.integers(2**32)), 2),
        version=(3, int(rng.integers(2**32))),
    )


@few
@given(seeds)
def test_encoded_state_equals_the_oracle(seed: int) -> None:
    """A LowState written by us is the one that pycdr2 writes from the same values, checksum included."""
    state = random_state(seed)
    wire = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    for name in ("position", "velocity", "acceleration", "effort", "temperature", "lost", "mode"):
        wire[name] = wire[name][IN_WIRE_ORDER].tolist()
    used = [
        MotorState(mode, q, dq, ddq, tau, q, dq, ddq, temperature, lost, [0, 0])
        for mode, q, dq, ddq, tau, temperature, lost in zip(
            wire["mode"],
            wire["position"],
            wire["velocity"],
            wire["acceleration"],
            wire["effort"],
            wire["temperature"],
            wire["lost"],
            strict=True,
        )
    ]
    spare = [MotorState(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, [0, 0]) for _ in range(8)]
    message = LowStateIdl(
        [0xFE, 0xEF],
        0xFF,
        0,
        list(state.serial),
        list(state.version),
        0,
        ImuState(
            state.orientation.tolist(),
            state.angular_velocity.tolist(),
            state.specific_force.tolist(),
            state.rpy.tolist(),
            state.imu_temperature,
        ),
        used + spare,
        BmsState(
            0,
            0,
            state.battery_status,
            state.battery_percent,
            state.battery_current_ma,
            state.battery_cycles,
            [0, 0],
            [0, 0],
            state.cell_voltage_mv.tolist(),
        ),
        state.foot_force[LEGS_IN_WIRE_ORDER].tolist(),
        state.foot_force_estimate[LEGS_IN_WIRE_ORDER].tolist(),
        state.tick_ms,
        list(state.remote),
        0,
        0.0,
        0,
        0,
        state.voltage,
        state.current,
        [0] * 4,
        0,
        0,
    )
    assert encode_low_state(state) == signed(message, STATE_STRUCT)


def random_command(seed: int) -> LowCommand:
    """Return a command whose numbers are exact in single precision."""
    rng = np.random.default_rng(seed)
    parts = (rng.normal(size=12).astype(np.float32).astype(float) for _ in range(5))
    return LowCommand(*parts, mode=rng.integers(0, 256, 12))


def command_message(command: LowCommand, spare_mode: int = 1) -> LowCmd:
    """Return the same command for pycdr2: 12 motors in wire order, 8 with the vendor's stop values."""
    rows = zip(
        command.mode,
        command.position,
        command.velocity,
        command.effort,
        command.stiffness,
        command.damping,
        strict=True,
    )
    listed = [MotorCmd(int(mode), *map(float, rest), [0, 0, 0]) for mode, *rest in rows]
    spare = [MotorCmd(spare_mode, 2.146e9, 16000.0, 0.0, 0.0, 0.0, [0, 0, 0]) for _ in range(8)]
    return LowCmd(
        [0xFE, 0xEF],
        0xFF,
        0,
        [0, 0],
        [0, 0],
        0,
        [listed[j] for j in IN_WIRE_ORDER] + spare,
        BmsCmd(0, [0] * 3),
        [0] * 40,
        [0] * 12,
        [0, 0],
        0,
        0,
        0,
    )


@few
@given(st.lists(seeds, min_size=1, max_size=4))
def test_encoded_command_equals_the_oracle(seeds_: list[int]) -> None:
    """An encoder's LowCmds are pycdr2's, one after the other, whatever the encoder wrote before."""
    encoder = LowCommandEncoder()
    for seed in seeds_:
        command = random_command(seed)
        assert encoder.encode(command) == signed(command_message(command), COMMAND_STRUCT)


@few
@given(seeds)
def test_a_b2s_command_equals_the_oracle(seed: int) -> None:
    """Motor mode 0x0A in all twenty slots, as in the vendor's example for the B2."""
    command = dataclasses.replace(random_command(seed), mode=np.full(12, 0x0A))
    message = command_message(command, spare_mode=0x0A)
    assert LowCommandEncoder(0x0A).encode(command) == signed(message, COMMAND_STRUCT)


@few
@given(seeds)
def test_decoded_command_equals_the_oracle(seed: int) -> None:
    """A LowCmd with random numbers in every field that is not reserved is understood as pycdr2 does."""
    message = random_message(LowCmd, 812, seed)
    message.level_flag, message.frame_reserve, message.reserve = 0xFF, 0, 0
    message.bms_cmd.reserve = [0] * 3
    for motor in message.motor_cmd:
        motor.reserve = [0] * 3
    command = decode_low_command(signed(message, COMMAND_STRUCT))
    for ours, theirs in (
        ("position", "q"),
        ("velocity", "dq"),
        ("stiffness", "kp"),
        ("damping", "kd"),
        ("effort", "tau"),
        ("mode", "mode"),
    ):
        np.testing.assert_array_equal(getattr(command, ours)[IN_WIRE_ORDER], motors(message, theirs), ours)


@few
@given(seeds)
@pytest.mark.parametrize(("kind", "size"), [(SportModeShort, 236), (SportModeLong, 516)])
def test_sport_state_equals_the_oracle(kind: Any, size: int, seed: int) -> None:
    """Both layouts of SportModeState are read and written as by pycdr2."""
    rng = np.random.default_rng(seed)
    payload = bytearray(HEADER + rng.integers(0, 128, size - 4, dtype=np.uint8).tobytes())
    payload[8:12] = int(rng.integers(10**9)).to_bytes(4, "little")
    message = kind.deserialize(bytes(payload))
    written = bytes(message.serialize())
    state = sport_state.decode_sport_state(written)
    assert state.stamp_ns == message.stamp.sec * 10**9 + message.stamp.nanosec
    assert (state.path is None) == (size == 236)
    assert (state.gait, state.mode, state.error_code) == (message.gait_type, message.mode, message.error_code)
    np.testing.assert_array_equal(state.foot_force[LEGS_IN_WIRE_ORDER], message.foot_force)
    feet = np.reshape(message.foot_position_body, (4, 3))
    np.testing.assert_array_equal(state.foot_position[LEGS_IN_WIRE_ORDER], feet)
    np.testing.assert_array_equal(state.range_obstacle, message.range_obstacle)
    assert sport_state.encode_sport_state(state) == written


texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
longs = st.integers(-(2**63), 2**63 - 1)
ints = st.integers(-(2**31), 2**31 - 1)


@few
@given(longs, longs, longs, ints, st.booleans(), texts, st.binary(max_size=9))
def test_request_equals_the_oracle(
    identity: int, api: int, lease: int, priority: int, silent: bool, text: str, binary: bytes
) -> None:
    """Requests are written and read as by pycdr2, whatever the text's length does to the alignment."""
    ours = rpc.Request(identity, api, text, lease, priority, silent, binary)
    header = RequestHeader(Identity(identity, api), Lease(lease), Policy(priority, silent))
    payload = bytes(RequestIdl(header, text, list(binary)).serialize())
    assert rpc.encode_request(ours) == payload
    for padding in range(4):
        assert rpc.decode_request(payload + bytes(padding)) == ours


@few
@given(longs, longs, ints, texts, st.binary(max_size=9))
def test_response_equals_the_oracle(identity: int, api: int, code: int, text: str, binary: bytes) -> None:
    """Responses are written and read as by pycdr2."""
    ours = rpc.Response(identity, api, code, text, binary)
    header = ResponseHeader(Identity(identity, api), ReplyStatus(code))
    payload = bytes(ResponseIdl(header, text, list(binary)).serialize())
    assert rpc.encode_response(ours) == payload
    assert rpc.decode_response(payload) == ours


@few
@given(st.lists(st.floats(-1, 1, width=32), min_size=4, max_size=4), st.integers(0, 0xFFFF))
def test_wireless_equals_the_oracle(sticks: list[float], keys: int) -> None:
    """WirelessController messages are written and read as by pycdr2."""
    ours = remote.Remote(keys, *sticks)
    payload = bytes(Wireless(*sticks, keys).serialize())
    assert remote.encode_wireless(ours) == payload
    assert remote.decode_wireless(payload) == ours
    assert remote.decode_wireless(payload + bytes(2)) == ours


@few
@given(st.binary(max_size=60), st.integers(0, 59))
def test_garbage_is_refused_not_crashed_on(data: bytes, cut: int) -> None:
    """Whatever the bytes, the parsers of texts answer with a FrameError or a message."""
    whole = rpc.encode_request(rpc.Request(1, 2, "abc")) + data
    readers: list[Callable[[bytes], object]] = [
        rpc.decode_request,
        rpc.decode_response,
        remote.decode_wireless,
    ]
    for reader in readers:
        for payload in (data, HEADER + data, whole, whole[:cut]):
            try:
                reader(payload)
            except FrameError:
                continue


def test_the_simulators_state_equals_the_oracle() -> None:
    """The stand-in of unitree_mujoco fills in what the vendor's bridge does, and leaves zeros elsewhere."""
    payload = UnitreeMujoco(np.linspace(0.1, 1.2, 12), settle_s=0.1).state()
    frame = decode_low_state(payload, strict=False)
    message = LowStateIdl.deserialize(HEADER + bytes(1176))
    slots: Any = message.motor_state
    for motor, joint in zip(slots, IN_WIRE_ORDER, strict=False):
        motor.q, motor.dq, motor.tau_est = frame.position[joint], frame.velocity[joint], frame.effort[joint]
    imu = message.imu_state
    imu.quaternion, imu.gyroscope = frame.orientation.tolist(), frame.angular_velocity.tolist()
    imu.accelerometer = frame.specific_force.tolist()
    assert payload == message.serialize()
