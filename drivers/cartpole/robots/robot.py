"""The cart-pole behind a byte stream."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.link import HostLink, SerialLink
from deal_hw.drivers.command_echo import NumberWatch
from deal_hw.errors import (
    SafetyError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.robot import Robot
from deal_hw.transport import Message, Transport
from deal_hw.types import JointCommand, RobotState, Status

HELLO_TIMEOUT_S = 1.0
RETRY_S = 0.1
_QUEUE = 4096
_U32, _I32 = 0xFFFF_FFFF, 0x7FFF_FFFF
_REFUSALS = {
    protocol.Result.NOT_HOMED: "it was never homed; call home() first",
    protocol.Result.HOMING: "homing is not finished; wait for it",
}


class CartpoleRobot(Robot):
    """A cart-pole that speaks protocol version 1, on any frames.

    ``connect`` says hello to the device, which switches its motor off. On an inherited port a child process
    connects again, with a transport that adopted the descriptor, and starts from the passive state. Over a
    transport that only listens, ``connect`` waits for a state instead, and does not check kind and version.

    Attributes:
        info: The device's answer to hello; None before ``connect``, and over a transport that only listens.
        resent: Number of requests sent again because no answer came within :data:`RETRY_S`.

    Args:
        transport: A stream of the link's bytes.
        clock: The clock of the transport's stamps.
        link: Makes the wire's codec for each connection.
    """

    description: ClassVar[RobotDescription] = DESCRIPTION
    watchdog_s: ClassVar[float] = 0.2

    def __init__(
        self, transport: Transport, clock: Clock, *, link: Callable[[], HostLink] = SerialLink
    ) -> None:
        self.info: protocol.Info | None = None
        self.resent = 0
        self._transport = transport
        self._clock = clock
        self._make_link = link
        self._link = link()
        self._states: deque[RobotState] = deque(maxlen=_QUEUE)
        self._wire: deque[Message] = deque(maxlen=_QUEUE)
        self._request = 0
        self._ack: protocol.Ack | None = None
        self._gaps = 0
        self._next_state: int | None = None
        self._sequence = -1
        self._numbers = NumberWatch()
        self._after_ack: Status | None = None
        self._torn = self._connected = False

    def connect(self) -> None:
        """Open the transport, say hello to the device and check its kind and version."""
        if self._connected:
            return
        self._transport.open()
        try:
            if self._transport.can_send:
                self.info = self._greet()
            else:
                self._states.append(self.read_state(HELLO_TIMEOUT_S))
        except BaseException:
            self._transport.close()
            raise
        self._connected = True

    def disconnect(self) -> None:
        """Close the transport."""
        self._transport.close()
        self.info, self._connected = None, False
        self._link = self._make_link()

    def reopen(self) -> None:
        """Open the port again after the device vanished; old bytes are discarded."""
        self._transport.reopen()
        self._torn = True

    def home(self, timeout_s: float) -> None:
        """Bring the cart to the middle and wait until the pole has been set upright."""
        self._ask(protocol.Home(self._next_request()), timeout_s, reached=Status.HOMED, without=Status.HOMING)

    def arm(self, timeout_s: float) -> None:
        """Let the motor follow commands; from now on the device's watchdog expects one every 200 ms."""
        self._numbers.restart()
        self._ask(
            protocol.Arm(self._next_request()), timeout_s, reached=Status.ARMED, without=Status.WATCHDOG
        )

    def read_state(self, timeout_s: float) -> RobotState:
        """Return the next state sample in order of arrival."""
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not self._states:
            try:
                self._pump(max(0, deadline_ns - self._clock.now_ns()) / 1e9)
            except TransportTimeoutError as error:
                raise TransportTimeoutError(
                    f"cartpole: no state within {timeout_s:g} s; check the device's power and the cable "
                    f"({self.transport_errors} transport errors so far){self._trouble}"
                ) from error
        return self._states.popleft()

    def send_command(self, command: JointCommand) -> JointCommand:
        """Send a position target; this wire has no velocity target and no feed-forward effort.

        Raises:
            SafetyError: A value is not finite.
        """
        sequence = (self._sequence + 1) % protocol.NO_COMMAND
        target = self._link.feasible(to_target(command, sequence))
        self._send(self._link.encode(target))
        self._sequence = sequence
        self._numbers.sent(sequence)
        return from_target(target)

    def passive(self) -> None:
        """Switch the motor off; sent once, never waits, works on a port that another process was using.

        States received before are discarded, so that none of them counts as a confirmation.
        """
        self._states.clear()
        self._torn = True
        self._send(self._link.encode(protocol.Stop(self._next_request())))

    @property
    def last_sequence(self) -> int:
        """Sequence number of the last command sent; -1 before the first."""
        return self._sequence

    @property
    def transport_errors(self) -> int:
        """Corrupt or foreign frames and missing state samples so far."""
        return self._link.errors + self._gaps

    @property
    def fault(self) -> str:
        """A received fault after which the host must not continue; "" for none. Latched until armed again."""
        if self._link.fault or self._numbers.foreign < 0:
            return self._link.fault
        return (
            f"another program commands the cart-pole: it follows command {self._numbers.foreign}, which this "
            f"run did not send (its last is {self._sequence}). It may arm the motor again: end it, then "
            "start again"
        )

    def fileno(self) -> int:
        """Return the descriptor of the transport."""
        return self._transport.fileno()

    def take_wire(self) -> list[Message]:
        """Return and forget the raw messages since the last call; if many, only the newest."""
        wire = list(self._wire)
        self._wire.clear()
        return wire

    def _greet(self) -> protocol.Info:
        received = 0
        deadline_ns = self._clock.now_ns() + round(HELLO_TIMEOUT_S * 1e9)
        while (now_ns := self._clock.now_ns()) < deadline_ns:
            self._torn = True
            self._send(self._link.encode(protocol.Hello(self._next_request())))
            retry_ns = min(deadline_ns, now_ns + round(RETRY_S * 1e9))
            while (left_ns := retry_ns - self._clock.now_ns()) > 0:
                try:
                    info, count = self._hear_info(left_ns / 1e9)
                except TransportTimeoutError:
                    break
                received += count
                if info is not None:
                    self._check_info(info)
                    return info
                if self._link.fault:
                    raise WrongDeviceError(f"{self._where}: {self._link.fault}")
        if received:
            raise WrongDeviceError(
                f"{self._where}: {received} bytes came but no answer to hello; {self._link.hint}"
            )
        raise TransportTimeoutError(
            f"{self._where}: no answer to hello within {HELLO_TIMEOUT_S:g} s; check the device's power and "
            f"the port (`deal-hw doctor cartpole` finds out what answers there){self._trouble}"
        )

    def _hear_info(self, timeout_s: float) -> tuple[protocol.Info | None, int]:
        """Return the answer to the hello if it came, and how many bytes came."""
        message = self._transport.receive(timeout_s)
        self._wire.append(Message("rx", message.payload, message.stamp_ns))
        info = None
        for found in self._link.decode(message.payload):
            if info is not None:
                self._take(found, message.stamp_ns)
            elif isinstance(found, protocol.Info):
                info = found
                # The device forgot earlier commands; messages from before that hello are discarded.
                self._sequence, self._next_state, self._gaps = -1, None, 0
                self._link.errors = 0
                self._states.clear()
        return info, len(message.payload)

    def _check_info(self, info: protocol.Info) -> None:
        if info.kind != protocol.DEVICE_KIND:
            raise WrongDeviceError(
                f"{self._where}: the device reports the kind {info.kind!r}, not {protocol.DEVICE_KIND!r}; "
                "choose another port"
            )
        if info.version != protocol.VERSION:
            older = "the device's firmware" if info.version < protocol.VERSION else "deal-hw"
            raise VersionMismatchError(
                f"{self._where}: the device (firmware {'.'.join(map(str, info.firmware))}) speaks protocol "
                f"version {info.version}, deal-hw speaks {protocol.VERSION}; update {older}"
            )

    def _ask(
        self, request: protocol.Arm | protocol.Home, timeout_s: float, reached: Status, without: Status
    ) -> None:
        what = request.TYPE.name.lower()
        frame = self._link.encode(request)
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        self._ack = self._after_ack = None
        next_send_ns, sent = 0, 0
        while (now_ns := self._clock.now_ns()) < deadline_ns:
            if self._ack is None and now_ns >= next_send_ns:
                self._send(frame)
                self.resent += sent > 0
                sent += 1
                next_send_ns = now_ns + round(RETRY_S * 1e9)
            wait_until_ns = deadline_ns if self._ack else min(deadline_ns, next_send_ns)
            with contextlib.suppress(TransportTimeoutError):
                self._pump((wait_until_ns - now_ns) / 1e9)
            if self._ack is not None and self._ack.result is not protocol.Result.DONE:
                raise SafetyError(f"cartpole: the device refuses to {what}: {_REFUSALS[self._ack.result]}")
            status = self._after_ack
            if status is not None and status & reached and not status & without:
                return
        raise TransportTimeoutError(
            f"cartpole: the device did not confirm {what!r} within {timeout_s:g} s "
            f"({'no answer' if self._ack is None else f'status {self._after_ack!r}'})"
        )

    def _pump(self, timeout_s: float) -> None:
        message = self._transport.receive(timeout_s)
        self._wire.append(Message("rx", message.payload, message.stamp_ns))
        for found in self._link.decode(message.payload):
            self._take(found, message.stamp_ns)

    def _take(self, message: protocol.AnyMessage, stamp_ns: int) -> None:
        if isinstance(message, protocol.State):
            if self._next_state is not None:
                missing = (message.sequence - self._next_state) & _U32
                # If the number goes back, the device restarted. This counts as one error; the unsigned
                # difference would be about 2**32.
                self._gaps += missing if missing < _I32 else 1
            self._next_state = (message.sequence + 1) & _U32
            state = to_robot_state(message, stamp_ns)
            self._numbers.shown(state.command_sequence)
            self._states.append(state)
            if self._ack is not None:
                self._after_ack = state.status
        elif isinstance(message, protocol.Ack) and message.request == self._request:
            self._ack = message

    def _send(self, frame: bytes) -> None:
        # After a partial write, the resync bytes separate the torn frame from this one.
        data = self._link.resync + frame if self._torn else frame
        message = Message("", data, self._clock.now_ns())
        self._torn = True
        self._transport.send(message)
        self._torn = False
        self._wire.append(Message("tx", data, message.stamp_ns))

    def _next_request(self) -> int:
        self._request = (self._request + 1) & 0xFF
        return self._request

    @property
    def _trouble(self) -> str:
        trouble = getattr(self._transport, "trouble", "")
        return f". The adapter reports: {trouble}" if trouble else ""

    @property
    def _where(self) -> str:
        return str(getattr(self._transport, "port", type(self._transport).__name__))


_U16, _U32, _I32 = 0xFFFF, 0xFFFF_FFFF, 0x7FFF_FFFF


def to_target(command: JointCommand, sequence: int) -> protocol.Target:
    """Round a command to the wire's integers; a value beyond its field's range is clipped.

    Raises:
        SafetyError: A value is not finite.
    """
    return protocol.Target(
        sequence=sequence,
        position_um=_integer(command.position_target, 1e6, -_I32, _I32, "position_target"),
        stiffness_mn_m=_integer(command.stiffness, 1e3, 0, _U32, "stiffness"),
        damping_mns_m=_integer(command.damping, 1e3, 0, _U32, "damping"),
        effort_limit_mn=_integer(command.effort_limit, 1e3, 0, _U16, "effort_limit"),
        speed_limit_um_s=_integer(command.speed_limit, 1e6, 0, _U32, "speed_limit"),
    )


def from_target(target: protocol.Target) -> JointCommand:
    """Return a target as a command in SI units; quantities that the wire does not carry are 0."""
    return JointCommand(
        position_target=np.array([target.position_um / 1e6]),
        velocity_target=np.zeros(1),
        stiffness=np.array([target.stiffness_mn_m / 1e3]),
        damping=np.array([target.damping_mns_m / 1e3]),
        effort=np.zeros(1),
        effort_limit=np.array([target.effort_limit_mn / 1e3]),
        speed_limit=np.array([target.speed_limit_um_s / 1e6]),
    )


def to_robot_state(state: protocol.State, receive_ns: int) -> RobotState:
    """Return a state frame in SI units."""
    known = state.command_sequence != protocol.NO_COMMAND
    return RobotState(
        position=np.array([state.cart_um / 1e6, state.pole_urad / 1e6]),
        velocity=np.array([state.cart_um_s / 1e6, state.pole_urad_s / 1e6]),
        effort=np.array([state.effort_mn / 1e3, 0.0]),
        receive_ns=receive_ns,
        device_ns=state.device_us * 1000,
        sequence=state.sequence,
        command_sequence=state.command_sequence if known else -1,
        command_age_ns=state.command_age_us * 1000 if known else -1,
        status=Status(state.status),
    )


def _integer(
    values: np.ndarray[tuple[int, ...], np.dtype[np.float64]], scale: float, low: int, high: int, name: str
) -> int:
    value = float(values[0])
    if not math.isfinite(value):
        raise SafetyError(f"cartpole: {name} is {value}; nothing was sent")
    return min(max(round(value * scale), low), high)
