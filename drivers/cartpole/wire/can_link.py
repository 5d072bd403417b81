"""The cart-pole's messages as classic CAN frames (docs/reference/protocol-cartpole-can.md).

The table of signals is assets/cartpole.dbc.

A state takes five frames, a target three and an info five. The last frame of each carries a CRC over all of
them: a sample with a lost frame, or with frames of two samples, is refused completely.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, Final

from fastcrc import crc16

from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.errors import ConfigurationError, FrameError, MissingExtraError

if TYPE_CHECKING:
    from cantools.database.can import Message as DbcMessage


@dataclass(frozen=True, slots=True)
class Angle:
    """One sample of the pole's encoder alone, if a motor drive has the cart.

    Attributes:
        sequence: Number of the sample; a received one has its low byte alone.
        device_us: Low 32 bits of the encoder's time.
        pole_urad: Pole angle, 0 upright, not wrapped.
        pole_urad_s: Pole velocity.
        status: Bits of :class:`deal_hw.types.Status`, of which it knows homing and homed.
    """

    sequence: int
    device_us: int
    pole_urad: int
    pole_urad_s: int
    status: int


CanMessage = protocol.AnyMessage | Angle
NODE: Final = 1
LAST_NODE: Final = 62
"""Largest node number. Number 0 would use ids of CANopen's network management; a new ODrive has number 63."""
STATES_PER_HEARTBEAT: Final = 20
FRAME: Final = struct.Struct("<IB3x8s")
"""One frame as bytes: Linux's ``struct can_frame`` with id, length and eight data bytes."""
REMOTE: Final = 0x4000_0000
"""Flag of a remote frame in the id of :data:`FRAME`, as in Linux's ``struct can_frame``."""
_NUMBER_BITS: Final = 5
_DEVICE_TIME: Final = 2**48 - 1
_GROUPS: Final[dict[str, type[CanMessage]]] = {
    "Stop": protocol.Stop,
    "Target": protocol.Target,
    "Arm": protocol.Arm,
    "Home": protocol.Home,
    "Hello": protocol.Hello,
    "State": protocol.State,
    "Ack": protocol.Ack,
    "Info": protocol.Info,
    "Angle": Angle,
}
_LENGTHS: Final = {"Target": 3, "State": 5, "Info": 5, "Angle": 2}
_SIGNALS: Final[dict[type[CanMessage], dict[str, str]]] = {
    kind: dict(zip((field.name for field in fields(kind)), signals.split(), strict=True))
    for kind, signals in (
        (
            protocol.State,
            "Sequence DeviceTime CartPosition CartVelocity PolePosition PoleVelocity Effort Status "
            "CommandSequence CommandAge",
        ),
        (protocol.Target, "Sequence Position Stiffness Damping EffortLimit SpeedLimit"),
        (Angle, "SequenceByte DeviceTimeLow PoleAngle PoleRate Status"),
        (protocol.Ack, "Request Of Result"),
        (protocol.Hello, "Request Version"),
        *((kind, "Request") for kind in (protocol.Arm, protocol.Stop, protocol.Home)),
    )
}
"""Signal of each field; an info is laid out by hand."""
_COMMANDS: Final = ("Target", "Arm", "Home")
_FIRMWARE: Final = ("Major", "Minor", "Patch")


def _cantools() -> ModuleType:
    """Return cantools. It is imported here alone: it would be half of a serial emulator's start."""
    try:
        import cantools
    except ImportError as error:
        raise MissingExtraError("cantools", "can") from error
    return cantools


@functools.cache
def database() -> dict[str, DbcMessage]:
    """Return the frames of assets/cartpole.dbc by name.

    Raises:
        MissingExtraError: cantools is not installed.
    """
    cantools = _cantools()
    loaded = cantools.database.load_file(Path(__file__).parents[1] / "assets" / "cartpole.dbc")
    assert isinstance(loaded, cantools.database.can.Database)
    return {message.name: message for message in loaded.messages}


def frame_id(name: str, node: int) -> int:
    """Return the id of a frame of the DBC for a node."""
    return (node << _NUMBER_BITS) | (database()[name].frame_id & 0x1F)


def accept(*nodes: int) -> tuple[tuple[int, int], ...]:
    """Return the filter, ids and masks, that passes the frames to and from nodes with these numbers."""
    return tuple((node << _NUMBER_BITS, 0x7FF & ~0x1F) for node in nodes)


def check_node(node: int) -> int:
    """Return a node's number.

    Raises:
        ConfigurationError: It is outside the range.
    """
    if not 1 <= node <= LAST_NODE:
        raise ConfigurationError(f"node {node}: allowed CAN node numbers are 1 to {LAST_NODE}")
    return node


def second_host(device: str, frame: str) -> str:
    """Return the fault of a device that this program commands, and another one too."""
    return (
        f"another program or computer commands {device} (it sent {frame}); end it, or take its adapter off "
        "the bus"
    )


class CanLink:
    """One side of a CAN wire; bytes are whole frames in the layout of :data:`FRAME`.

    Attributes:
        errors: Number of corrupt or unknown messages so far.
        torn: Number of messages so far that lost a frame; hosts detect a missing state by its number.
        fault: Two devices with one number, or another host that commands this one; "" for none.

    Args:
        node: The device's number.
        version: Version of the protocol, for devices under test.
        unique_id: The device's serial number, for its heartbeat; a host has none.
        device: Whether this is the device's side, which takes frames from the host alone.
    """

    resync: ClassVar[bytes] = b""

    def __init__(
        self,
        node: int = NODE,
        version: int = protocol.VERSION,
        unique_id: int = 0,
        *,
        device: bool = False,
    ) -> None:
        self.errors = self.torn = 0
        self.fault = ""
        self._unfit = (_cantools().database.EncodeError, KeyError, UnicodeEncodeError)
        self._node, self._version, self._unique_id = check_node(node), version, unique_id
        # The host's frames have the numbers 0 to 7; a chip filters by the same bits.
        self._number_bits = 3 if device else _NUMBER_BITS
        self._names = {frame_id(name, node): name for name in database()}
        self._parts: dict[str, list[bytes] | None] = {}
        self._heard: int | None = None
        self._commands = False

    @property
    def hint(self) -> str:
        """What to check if frames arrive, but no answer."""
        return (
            f"node {self._node} sends, but does not answer in this protocol; check that it is the "
            "cart-pole, and that its firmware has the same DBC"
        )

    def encode(self, message: CanMessage) -> bytes:
        """Return a message's frames; every twentieth sample is followed by a heartbeat.

        Raises:
            FrameError: A value does not fit its field.
        """
        self._commands = isinstance(message, protocol.Target | protocol.Arm | protocol.Home)
        group = type(message).__name__
        values = _to_values(message, self._version)
        names = _frames_of(group)
        try:
            parts = [_pack(name, values) for name in names]
        except self._unfit as error:
            raise FrameError(f"{message} does not fit its frames: {error}") from error
        if len(parts) > 1:
            parts[-1] = parts[-1][:-2] + self._crc(group, parts).to_bytes(2, "little")
        out = b"".join(self._frame(name, part) for name, part in zip(names, parts, strict=True))
        if isinstance(message, protocol.State | Angle) and message.sequence % STATES_PER_HEARTBEAT == 0:
            out += self._status(message)
        return out

    def decode(self, data: bytes) -> Iterator[protocol.AnyMessage]:
        """Take frames; return the messages that they complete, and count invalid ones."""
        return (message for message in self.decode_all(data) if not isinstance(message, Angle))

    def feasible(self, target: protocol.Target) -> protocol.Target:
        """Return a target with the wire's resolution."""
        return target

    def decode_all(self, data: bytes) -> Iterator[CanMessage]:
        """As :meth:`decode`, including messages that only CAN has."""
        if len(data) % FRAME.size:
            self.errors += 1
            return
        for identifier, length, payload in FRAME.iter_unpack(data):
            if identifier >> self._number_bits != self._node << _NUMBER_BITS >> self._number_bits:
                continue
            name = self._names.get(identifier)
            if name is None or length != database()[name].length:
                self.errors += 1
            elif name == "Heartbeat":
                self._take_heartbeat(payload)
            elif name != "Errors" and (message := self._take(name, payload[:length])) is not None:
                yield message

    def _take(self, name: str, part: bytes) -> CanMessage | None:
        group = name.rstrip("0123456789")
        if self._commands and group in _COMMANDS:
            self.fault = second_host(f"node {self._node}", group)
        names = _frames_of(group)
        index = names.index(name)
        parts = self._parts.get(group)
        if index == 0:
            # A first frame while others are missing: the earlier message is incomplete.
            self.torn += bool(parts)
            parts = self._parts[group] = []
        if parts is None:
            return None  # The rest of a message whose beginning was lost.
        if len(parts) != index:
            self.torn += 1
            self._parts[group] = None
            return None
        parts.append(part)
        if len(parts) < len(names):
            return None
        self._parts[group] = None
        try:
            return self._assemble(group, names, parts)
        except (ValueError, FrameError):
            self.errors += 1
            return None

    def _assemble(self, group: str, names: Sequence[str], parts: list[bytes]) -> CanMessage:
        if len(parts) > 1 and self._crc(group, parts) != int.from_bytes(parts[-1][-2:], "little"):
            raise FrameError(f"{group}: its frames do not belong together, or one is corrupt")
        values: dict[str, int] = {}
        for name, part in zip(names, parts, strict=True):
            values |= database()[name].decode_simple(part, decode_choices=False, scaling=False)  # type: ignore[arg-type]
        # Requests for the peer's identity and for motor-off work in any version.
        timeless = (protocol.Hello, protocol.Info, protocol.Stop)
        if _GROUPS[group] not in timeless and values.get("Version", self._version) != self._version:
            raise FrameError(f"{group}: of version {values['Version']}, this side speaks {self._version}")
        return _from_values(_GROUPS[group], values)

    def _crc(self, group: str, parts: Sequence[bytes]) -> int:
        # The version is included, so that frames of another version are refused; not in info.
        version = 0 if group == "Info" else self._version
        return crc16.ibm_3740(bytes([version]) + b"".join(parts)[:-2])

    def _take_heartbeat(self, payload: bytes) -> None:
        unique_id = int.from_bytes(payload[:4], "little")
        if self._heard is None:
            self._heard = unique_id
        elif unique_id != self._heard:
            self.fault = (
                f"two devices use node {self._node} (0x{self._heard:08x} and 0x{unique_id:08x}); give one of "
                "them another number, or take it off the bus"
            )

    def _status(self, state: protocol.State | Angle) -> bytes:
        low = self._unique_id & 0xFFFF_FFFF
        zero = {"TransmitErrors": 0, "ReceiveErrors": 0}
        heartbeat = {"UniqueIdLow": low, "Version": self._version, "Status": state.status, **zero}
        out = self._frame("Heartbeat", _pack("Heartbeat", heartbeat))
        if self.errors or self.torn:
            counts = {"ReceiveOverflows": 0, "BusOffs": 0, "TransmitDrops": 0}
            torn = {"TornMessages": min(self.errors + self.torn, 0xFFFF), **counts}
            out += self._frame("Errors", _pack("Errors", torn))
        return out

    def _frame(self, name: str, part: bytes) -> bytes:
        return FRAME.pack(frame_id(name, self._node), len(part), part)


def _frames_of(group: str) -> tuple[str, ...]:
    count = _LENGTHS.get(group, 0)
    return tuple(f"{group}{k}" for k in range(1, count + 1)) or (group,)


def _pack(name: str, values: dict[str, int]) -> bytes:
    message = database()[name]
    return message.encode({s.name: values[s.name] for s in message.signals}, scaling=False, strict=True)


def _to_values(message: CanMessage, version: int) -> dict[str, int]:
    values = {"Version": version, "Crc": 0}
    if isinstance(message, protocol.Info):
        kind = message.kind.encode("ascii")
        if len(kind) > 16:
            raise FrameError(f"a device kind has at most 16 characters, got {message.kind!r}")
        # A device of another version reports its own version.
        reported = version if message.version == protocol.VERSION else message.version
        return values | {
            "Request": message.request,
            "Version": reported,
            "DeviceRate": message.device_rate_hz,
            "StateRate": message.state_rate_hz,
            "Kind1": int.from_bytes(kind[:8], "little"),
            "Kind2": int.from_bytes(kind[8:], "little"),
            "UniqueId": message.unique_id,
            **dict(zip(_FIRMWARE, message.firmware, strict=True)),
        }
    values |= {signal: getattr(message, name) for name, signal in _SIGNALS[type(message)].items()}
    if isinstance(message, protocol.State | Angle):
        low, time = message.sequence & 0xFF, message.device_us
        values |= {"SequenceLow": low, "DeviceTime": time & _DEVICE_TIME}
        values |= {"SequenceByte": low, "DeviceTimeLow": time & 0xFFFF_FFFF}
    return values


def _from_values(kind: type[CanMessage], v: dict[str, int]) -> CanMessage:
    if kind is protocol.State and v["SequenceLow"] != v["Sequence"] & 0xFF:
        raise FrameError("State: its frames have different numbers")
    if kind is protocol.Info:
        text = v["Kind1"].to_bytes(8, "little") + v["Kind2"].to_bytes(8, "little")
        firmware = v["Major"], v["Minor"], v["Patch"]
        rates = v["DeviceRate"], v["StateRate"]
        name = text.rstrip(b"\0").decode("ascii")
        return protocol.Info(v["Request"], name, firmware, *rates, v["UniqueId"], v["Version"])
    if kind is protocol.Ack:
        return protocol.Ack(v["Request"], protocol.MessageType(v["Of"]), protocol.Result(v["Result"]))
    found: list[Any] = [v[signal] for signal in _SIGNALS[kind].values()]
    return kind(*found)
