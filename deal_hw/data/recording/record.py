"""The record of one control cycle for the recorder: one datagram in a static binary layout.

The control process must not wait for disk, compression or a schema, so a cycle leaves it as one datagram over
a non-blocking Unix socket. The layout is little-endian, versioned and closed by a CRC-32; nothing in it is
executable.

======  ==========================================================================================
part    content
======  ==========================================================================================
head    magic, version, counts, the scalars of :class:`CycleRecord`
states  each: six int64 (receive_ns, device_ns, sequence, command_sequence, command_age_ns, status),
        then position, velocity, effort as J float64 each; of a robot with legs also its body (see
        ``_BODY``)
arrays  action (K float64), asked and sent (7 x A float64 each), where present
texts   safety state, events (stamp, kind, message, JSON), wire (stamp, channel, payload)
tail    CRC-32 of all bytes before it
======  ==========================================================================================
"""

from __future__ import annotations

import enum
import json
import operator
import struct
import zlib
from dataclasses import dataclass, fields

import numpy as np

from deal_hw.errors import ConfigurationError, ProtocolError, VersionMismatchError
from deal_hw.transport import Message
from deal_hw.types import BodyState, Event, FloatArray, IntArray, JointCommand, RobotState, Status

MAGIC = b"DHCR"
VERSION = 2
MAX_DATAGRAM_BYTES = 128 * 1024
"""A sender refuses more; Linux carries up to about 200 kB at its default socket buffer."""

_HEAD = struct.Struct("<4sHHHHHHiBxHI7qi")
_STATE = struct.Struct("<6q")
_BODY = struct.Struct("<3dq")
"""battery, voltage, current, buttons; before it orientation, angular velocity, acceleration, sticks, foot
forces and temperatures as float64, behind it the J counters of lost commands as int64."""
_EVENT = struct.Struct("<qHII")
_WIRE = struct.Struct("<qHI")
_CRC = struct.Struct("<I")
_HAS_REQUESTED, _HAS_SENT = 1, 2
_COMMAND_FIELDS = tuple(field.name for field in fields(JointCommand))
_SCALARS = (
    "flags",
    "cycle",
    "deadline_ns",
    "start_ns",
    "sent_sequence",
    "sent_ns",
    "state_age_ns",
    "lost",
)
_scalars = operator.attrgetter(*_SCALARS)


class CycleFlag(enum.IntFlag):
    """Unusual events in a cycle; the bits of :attr:`CycleRecord.flags`."""

    NONE = 0
    OVERRUN = 1
    """The cycle started more than one period after its deadline."""
    CLIPPED = 2
    """The safety filter changed the requested command."""
    NO_STATE = 4
    """No state sample arrived since the last cycle."""
    POLICY_LATE = 8
    """The policy's action came too late for this cycle."""
    SEND_FAILED = 16
    """The transport did not take the command."""
    LINK_ERROR = 32
    """Corrupt frames or gaps were seen since the last cycle."""


@dataclass(frozen=True, slots=True, eq=False)
class CycleRecord:
    """The recorded values of one control cycle; all stamps are on the host's monotonic clock.

    Attributes:
        cycle: Number of the cycle, from 0.
        deadline_ns: Time at which the cycle should have started [ns].
        start_ns: Time at which it started [ns].
        states: The samples received since the last cycle, in order of arrival.
        action: Action of the policy, (K,); None without a policy or an action.
        requested: The command given to the safety filter; None for none.
        sent: The command that was sent; None for none (disarmed, dry run).
        sent_sequence: Number of the sent command; -1 for none.
        sent_ns: Time at which it was sent [ns]; -1 for none.
        state_age_ns: Age of the newest state when the action was computed [ns]; -1 without a state.
        safety_state: Name of the safety filter's state.
        flags: :class:`CycleFlag` bits.
        events: Events in the cycle.
        wire: Raw bytes since the last cycle, channels "rx" and "tx".
        lost: Number of records that the recorder refused so far, counted by the sender.
    """

    cycle: int
    deadline_ns: int
    start_ns: int
    states: tuple[RobotState, ...] = ()
    action: FloatArray | None = None
    requested: JointCommand | None = None
    sent: JointCommand | None = None
    sent_sequence: int = -1
    sent_ns: int = -1
    state_age_ns: int = -1
    safety_state: str = ""
    flags: int = 0
    events: tuple[Event, ...] = ()
    wire: tuple[Message, ...] = ()
    lost: int = 0


def encode(record: CycleRecord) -> bytes:
    """Return the datagram of a record.

    Raises:
        ConfigurationError: Arrays do not fit each other, a number is out of range, or the datagram is too
            long. A sender in a control loop counts this like a record that the recorder refused.
    """
    try:
        body = _encode_body(record)
    except struct.error as error:
        raise ConfigurationError(
            f"cycle {record.cycle}: a number does not fit the record ({error})"
        ) from error
    size = len(body) + _CRC.size
    if size > MAX_DATAGRAM_BYTES:
        raise ConfigurationError(
            f"cycle {record.cycle}: the record has {size} bytes, at most {MAX_DATAGRAM_BYTES} fit; "
            "send fewer raw bytes or events in one cycle"
        )
    return body + _CRC.pack(zlib.crc32(body))


def _encode_body(record: CycleRecord) -> bytes:
    joints = record.states[0].position.size if record.states else 0
    bodies = [state.body for state in record.states if state.body is not None]
    if bodies and len(bodies) != len(record.states):
        raise ConfigurationError(f"cycle {record.cycle}: some states have a body, others none")
    feet = bodies[0].foot_force.size if bodies else -1
    commands = [command for command in (record.requested, record.sent) if command is not None]
    actuated = commands[0].position_target.size if commands else 0
    present = _HAS_REQUESTED * (record.requested is not None) | _HAS_SENT * (record.sent is not None)
    safety_state = _text(record.safety_state)
    action_size = -1 if record.action is None else record.action.size
    parts = [
        _HEAD.pack(
            MAGIC,
            VERSION,
            joints,
            len(record.states),
            actuated,
            len(record.events),
            len(record.wire),
            action_size,
            present,
            len(safety_state),
            *_scalars(record),
            feet,
        )
    ]
    parts.extend(_encode_state(state, joints, feet) for state in record.states)
    if record.action is not None:
        parts.append(_floats(record.action, action_size, "action"))
    for command in commands:
        parts.extend(_floats(getattr(command, name), actuated, name) for name in _COMMAND_FIELDS)
    parts.append(safety_state)
    parts.extend(_encode_event(event) for event in record.events)
    parts.extend(_encode_message(message) for message in record.wire)
    return b"".join(parts)


def decode(datagram: bytes) -> CycleRecord:
    """Return the record in a datagram; its arrays are read-only views.

    Raises:
        ProtocolError: The bytes are corrupt or cut off.
        VersionMismatchError: The sender speaks another version.
    """
    if len(datagram) < _HEAD.size + _CRC.size:
        least = _HEAD.size + _CRC.size
        raise ProtocolError(f"cycle record cut off: {len(datagram)} bytes, at least {least} expected")
    if datagram[:4] != MAGIC:
        raise ProtocolError(f"not a cycle record: it starts with {datagram[:4]!r}, expected {MAGIC!r}")
    if (version := int.from_bytes(datagram[4:6], "little")) != VERSION:
        raise VersionMismatchError(f"cycle record of version {version}; this recorder reads {VERSION}")
    body = datagram[: -_CRC.size]
    if zlib.crc32(body) != _CRC.unpack_from(datagram, len(body))[0]:
        raise ProtocolError(f"cycle record of {len(datagram)} bytes is corrupt or cut off: wrong CRC-32")
    try:
        return _decode_body(body)
    except (struct.error, ValueError, RecursionError) as error:
        raise ProtocolError(
            f"cycle record of {len(datagram)} bytes does not match its head: {error}"
        ) from error


def _decode_body(body: bytes) -> CycleRecord:
    _, _, joints, states, actuated, events, wire, action, present, text, *rest = _HEAD.unpack_from(body)
    *scalars, feet = rest
    cursor = _Cursor(body, _HEAD.size)
    record = CycleRecord(
        **dict(zip(_SCALARS, scalars, strict=True)),
        states=tuple(_decode_state(cursor, joints, feet) for _ in range(states)),
        action=cursor.floats(action) if action >= 0 else None,
        requested=_decode_command(cursor, actuated) if present & _HAS_REQUESTED else None,
        sent=_decode_command(cursor, actuated) if present & _HAS_SENT else None,
        safety_state=cursor.text(text),
        events=tuple(_decode_event(cursor) for _ in range(events)),
        wire=tuple(_decode_message(cursor) for _ in range(wire)),
    )
    cursor.finish()
    return record


class _Cursor:
    """Reads a body from front to back and refuses to read past its end."""

    def __init__(self, body: bytes, offset: int) -> None:
        self._body = body
        self._offset = offset

    def take(self, size: int) -> bytes:
        end = self._offset + size
        if end > len(self._body):
            raise ValueError(f"{size} bytes wanted at {self._offset} of {len(self._body)}")
        part = self._body[self._offset : end]
        self._offset = end
        return part

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        return layout.unpack(self.take(layout.size))

    def floats(self, count: int) -> FloatArray:
        return np.frombuffer(self.take(8 * count), dtype="<f8")

    def integers(self, count: int) -> IntArray:
        return np.frombuffer(self.take(8 * count), dtype="<i8")

    def text(self, size: int) -> str:
        return self.take(size).decode()

    def finish(self) -> None:
        if self._offset != len(self._body):
            raise ValueError(f"{len(self._body) - self._offset} bytes too many")


def _floats(values: FloatArray, size: int, name: str) -> bytes:
    if values.shape != (size,):
        raise ConfigurationError(f"{name} has shape {values.shape}, the rest of the record has ({size},)")
    return np.asarray(values, dtype="<f8").tobytes()


def _text(value: str) -> bytes:
    return value.encode("utf-8", "backslashreplace")


def _encode_state(state: RobotState, joints: int, feet: int) -> bytes:
    body = b"" if state.body is None else _encode_body_state(state.body, joints, feet)
    return b"".join(
        (
            _STATE.pack(
                state.receive_ns,
                state.device_ns,
                state.sequence,
                state.command_sequence,
                state.command_age_ns,
                state.status,
            ),
            _floats(state.position, joints, "position"),
            _floats(state.velocity, joints, "velocity"),
            _floats(state.effort, joints, "effort"),
            body,
        )
    )


def _body_sizes(joints: int, feet: int) -> dict[str, int]:
    return {
        "orientation": 4,
        "angular_velocity": 3,
        "acceleration": 3,
        "sticks": 4,
        "foot_force": feet,
        "temperature": joints,
    }


def _encode_body_state(body: BodyState, joints: int, feet: int) -> bytes:
    parts = [_floats(getattr(body, name), size, name) for name, size in _body_sizes(joints, feet).items()]
    parts.append(_BODY.pack(body.battery, body.voltage, body.current, body.buttons))
    if body.lost.shape != (joints,):
        raise ConfigurationError(f"lost has shape {body.lost.shape}, the robot has {joints} joints")
    parts.append(np.asarray(body.lost, dtype="<i8").tobytes())
    return b"".join(parts)


def _decode_body_state(cursor: _Cursor, joints: int, feet: int) -> BodyState:
    arrays = {name: cursor.floats(size) for name, size in _body_sizes(joints, feet).items()}
    battery, voltage, current, buttons = cursor.unpack(_BODY)
    return BodyState(
        **arrays,
        lost=cursor.integers(joints),
        battery=battery,
        voltage=voltage,
        current=current,
        buttons=buttons,
    )


def _decode_state(cursor: _Cursor, joints: int, feet: int) -> RobotState:
    receive_ns, device_ns, sequence, command_sequence, command_age_ns, status = cursor.unpack(_STATE)
    position, velocity, effort = (cursor.floats(joints) for _ in range(3))
    return RobotState(
        position=position,
        velocity=velocity,
        effort=effort,
        receive_ns=receive_ns,
        device_ns=device_ns,
        sequence=sequence,
        command_sequence=command_sequence,
        command_age_ns=command_age_ns,
        status=Status(status),
        body=_decode_body_state(cursor, joints, feet) if feet >= 0 else None,
    )


def _decode_command(cursor: _Cursor, actuated: int) -> JointCommand:
    return JointCommand(**{name: cursor.floats(actuated) for name in _COMMAND_FIELDS})


def _encode_event(event: Event) -> bytes:
    # A value that JSON cannot hold must not end the control loop, so its text is recorded instead.
    try:
        data = json.dumps(dict(event.data), default=str).encode() if event.data else b""
    except (TypeError, ValueError):
        data = json.dumps({"unreadable": repr(event.data)}).encode()
    kind, message = _text(event.kind), _text(event.message)
    return _EVENT.pack(event.stamp_ns, len(kind), len(message), len(data)) + kind + message + data


def _decode_event(cursor: _Cursor) -> Event:
    stamp_ns, kind, message, data = cursor.unpack(_EVENT)
    texts = cursor.text(kind), cursor.text(message)
    values = json.loads(cursor.take(data)) if data else {}
    if not isinstance(values, dict):
        raise ValueError(f"an event's data are a JSON {type(values).__name__}, not an object")
    return Event(stamp_ns, *texts, values)


def _encode_message(message: Message) -> bytes:
    channel = _text(message.channel)
    return _WIRE.pack(message.stamp_ns, len(channel), len(message.payload)) + channel + message.payload


def _decode_message(cursor: _Cursor) -> Message:
    stamp_ns, channel, payload = cursor.unpack(_WIRE)
    return Message(channel=cursor.text(channel), payload=cursor.take(payload), stamp_ns=stamp_ns)
