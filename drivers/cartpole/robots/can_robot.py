"""The cart-pole on CAN: its robot, and CAN frames as the stream of bytes that it speaks."""

from __future__ import annotations

import contextlib

from deal_hw.clock import Clock
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire.can_link import FRAME, NODE, CanLink, accept, check_node
from deal_hw.drivers.transports.can_bus import CanTransport, take_settings
from deal_hw.drivers.transports.can_transport import open_can
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.errors import TransportError
from deal_hw.transport import Message, TransportWrapper

_MOST_AT_ONCE = 256


class CanFrames(TransportWrapper):
    """CAN frames as a stream of bytes, each frame as Linux's ``struct can_frame``; the channel is "".

    Args:
        inner: The bus.
    """

    _inner: CanTransport

    @property
    def trouble(self) -> str:
        """What the adapter last reported."""
        return self._inner.trouble

    @property
    def error_frames(self) -> int:
        """How often the adapter reported an error."""
        return self._inner.error_frames

    def send(self, message: Message) -> None:
        """Send frames one after the other; after a failed frame the rest is not sent."""
        for identifier, length, data in FRAME.iter_unpack(message.payload):
            self._inner.send(Message(f"{identifier:03X}", data[:length], message.stamp_ns))

    def receive(self, timeout_s: float) -> Message:
        """Return all received frames, waiting for the first; the stamp is that of the last."""
        frame = self._inner.receive(timeout_s)
        frames = [_pack(frame)]
        # An error after the first frame is raised by the next call.
        with contextlib.suppress(TransportError):
            while len(frames) < _MOST_AT_ONCE:
                frame = self._inner.receive(0.0)
                frames.append(_pack(frame))
        return Message("", b"".join(frames), frame.stamp_ns)


def can_bus(port: str) -> tuple[str, tuple[int]]:
    """Return the bus of a port, and the device's number on it.

    Raises:
        ConfigurationError: The port is not valid.
    """
    bus, given = take_settings(port, {"node": 0})
    return bus, (check_node(given.get("node", NODE)),)


def can_robot(port: str, clock: Clock, fd: int | None = None, *, can_send: bool = True) -> CartpoleRobot:
    """Return a cart-pole on a CAN bus; nothing is opened yet.

    Args:
        port: Such as ``socketcan:can0?node=3`` or ``slcan:/dev/ttyACM0?bitrate=1000000``.
        clock: Gives the stamps.
        fd: Descriptor of a serial adapter that a parent process opened.
        can_send: False for a robot that is only listened to.

    Raises:
        ConfigurationError: The port is not valid.
    """
    bus, (node,) = can_bus(port)
    frames = CanFrames(open_can(bus, clock, accept(node), fd))
    return CartpoleRobot(frames if can_send else listen_only(frames), clock, link=lambda: CanLink(node))


def _pack(message: Message) -> bytes:
    return FRAME.pack(int(message.channel, 16), len(message.payload), message.payload)
