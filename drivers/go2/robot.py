"""The Go2 over topics: DDS or Zenoh carries the same bytes."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.go2.command_sender import PASSIVE_COPIES, CommandSender
from deal_hw.drivers.go2.descriptions import on_stand
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.body import body_state, is_damped
from deal_hw.drivers.go2.messages.low_state import LowStateFrame
from deal_hw.drivers.go2.messages.refusals import StateCheck
from deal_hw.drivers.go2.messages.remote import decode_remote, parse_combination
from deal_hw.drivers.go2.messages.rpc import HEARD_TEXTS, STATUS_TEXTS, read_note
from deal_hw.drivers.go2.state_stream import StateStream
from deal_hw.drivers.go2.support import Support, SupportConfig, SupportGuard
from deal_hw.drivers.go2.takeover import Takeover
from deal_hw.drivers.transports import topics
from deal_hw.errors import SafetyError, TransportTimeoutError, WrongDeviceError
from deal_hw.robot import Robot
from deal_hw.transport import Message, TopicTransport
from deal_hw.types import FloatArray, JointCommand, RobotState, Status

STOP_BUTTONS: Final = "L2+B"
PASSIVE_DELAY_NS: Final = 10_000_000
"""States sensed within this time after the passive command do not confirm it [ns]."""
BRIDGE_DELAY_NS: Final = 100_000_000
"""A bridge's status within this time after the arming may be from before it [ns]."""
PUBLISHED: Final = (topics.LOW_COMMAND, *(topics.request(name) for name in topics.SERVICES))
SUBSCRIBED: Final = (
    topics.LOW_STATE,
    topics.LOW_COMMAND,
    topics.BRIDGE,
    *(topics.response(name) for name in topics.SERVICES),
)
_QUEUE: Final = 4096
_ENOUGH: Final = 3
"""Number of new states after the first command that confirm the connection."""


@dataclass(frozen=True, slots=True)
class Go2Info:
    """What the robot reports about itself.

    Attributes:
        battery: State of charge, 0 to 1.
        voltage: Of the supply [V].
        serial: Serial number, two words.
        version: Version of its firmware, two words.
    """

    battery: float
    voltage: float
    serial: tuple[int, int]
    version: tuple[int, int]


class Go2Robot(Robot):
    """A Unitree Go2 at its motors' own level.

    The robot holds the last command for ever: it has no arming and no watchdog, and without torque it falls.
    Passive therefore means damping, and only this driver knows whether it is armed: before ``arm`` it sends
    nothing, and after ``passive`` only damping.

    ``home`` releases the robot's own controller (sport mode) and checks that no other program commands the
    motors; ``hand_back`` returns the robot to that controller. All waits here keep reading messages.

    Attributes:
        info: What the robot reported about itself; None before ``connect``.

    Args:
        transport: Topics of the robot, or of a bridge to it.
        clock: The clock of the transport's stamps.
        stop_buttons: Buttons of the remote that stop a run while held together; "" for none.
        state_check: What a state must pass: "strict", or "length" for firmware or a simulator that makes head
            or checksum by another rule. Corrupted states are then not detected.
        support_check: Whether ``home`` checks that the robot is on the floor, or on a stand, as in the
            description.
    """

    description: ClassVar[RobotDescription] = DRIVER
    stopped_by: ClassVar[str] = (
        "a bridge on the robot's side (deal-hw bridge), its own remote (damping) or its power switch"
    )
    homes_by_motor: ClassVar[bool] = False
    _has_services: ClassVar[bool] = True

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        *,
        stop_buttons: str = STOP_BUTTONS,
        state_check: StateCheck = "strict",
        support_check: bool = True,
    ) -> None:
        self._transport, self._clock = transport, clock
        self._stop_text, self._stop_mask = stop_buttons, parse_combination(stop_buttons)
        self._stream = self._make_stream(state_check)
        self._states: deque[RobotState] = deque(maxlen=_QUEUE)
        self._wire: deque[Message] = deque(maxlen=_QUEUE)
        self._sender = CommandSender(transport, clock, self.description, self._wire.append)
        self._support = SupportGuard(
            self.description.name,
            Support.HELD if self.description.floating_base is None else Support.FLOOR,
            clock,
            self._pump,
            SupportConfig() if support_check else None,
        )
        self._forget()

    def _forget(self) -> None:
        """Reset; an open transport can still make the robot passive."""
        self.info: Go2Info | None = None
        self._stream.reset()
        self._sender.reset()
        self._states.clear()
        self._takeover = Takeover(
            self._transport,
            self._clock,
            self._sender.publish,
            self._pump,
            self._motion,
            lambda: self._stream.device_ns,
            None if self.description.floating_base is None else np.array(self.description.rest_position),
            services=self._has_services,
            why_unreached=self._why_unreached,
        )
        self._frame: LowStateFrame | None = None
        self._armed = self._homed = self._in_charge = False
        self._passive_ns: int | None = None
        self._armed_ns, self._bridged = 0, False
        # Streams that the bridge has received, and when it reported so [ns].
        self._bridge_heard, self._bridge_heard_ns = "", 0
        self._fault = self._operator_stop = ""

    def connect(self) -> None:
        """Open the transport and wait for states of a Go2 whose clock runs; sends nothing."""
        if self.info is not None:
            return
        self._transport.declare(publish=PUBLISHED, subscribe=SUBSCRIBED)
        self._transport.open()
        try:
            self._forget()
            self._wire.clear()
            self._await_robot()
            self._stream.errors = 0
            self._states.clear()
            self.info = self._read_info()
        except BaseException:
            self._transport.close()
            raise

    def disconnect(self) -> None:
        """Close the transport."""
        self._transport.close()
        self._forget()

    def reopen(self) -> None:
        """Open the transport again where it is lost."""
        self._transport.reopen()

    def home(self, timeout_s: float) -> None:
        """Release the robot's own controller, lying, and check that no other program commands the motors.

        Raises:
            TransportTimeoutError: The robot's services do not answer, or do not let go in time.
            SafetyError: The robot does not lie down, a service refuses, another program commands the motors
                (the text names it), or the robot is on a stand instead of the floor, or the reverse.
        """
        self._check_connected()
        self._in_charge, self._homed, self._operator_stop = True, False, ""
        self._support.before_release()
        self._takeover.run(timeout_s)
        self._support.require()
        self._homed = True
        self._states.clear()

    def require_free(self, timeout_s: float) -> None:
        """Check that nobody commands the motors, neither on the robot's side nor through a bridge."""
        self._check_connected()
        self._in_charge = True
        try:
            self._takeover.require_free(timeout_s)
        finally:
            # The passive command that follows is the first one.
            self._in_charge = False

    def hand_back(self, timeout_s: float) -> None:
        """Return the robot to the mode that ``home`` released, if any; the robot stands up.

        Raises:
            SafetyError: The robot is armed, or the service refuses.
            TransportTimeoutError: The mode does not have the robot in time.
        """
        if self._armed:
            raise SafetyError("go2: the robot is armed: make it passive before you hand it back")
        self._homed, self._sender.in_force, self._passive_ns = False, b"", None
        self._takeover.hand_back(timeout_s)

    def arm(self, timeout_s: float) -> None:
        """Damp the robot in its measured pose, make sure that states follow, and let commands through.

        Raises:
            SafetyError: It was not homed, the stop buttons were pressed, or another program commands the
                motors.
            TransportTimeoutError: No new states arrive.
        """
        self._check_connected()
        self._in_charge = True
        self._drain()
        if not self._homed:
            raise SafetyError("go2: sport mode may still command the motors; call home() first")
        if self._takeover.contested:
            raise SafetyError(self._takeover.complaint())
        if self._operator_stop:
            raise SafetyError(f"go2: {self._operator_stop}; release the buttons and call home() again")
        self._fault = ""
        self._sender.damp(self._motion()[0])
        seen = self._stream.accepted
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while self._stream.accepted < seen + _ENOUGH:
            if (left_ns := deadline_ns - self._clock.now_ns()) <= 0:
                raise TransportTimeoutError(f"go2: no new states within {timeout_s:g} s of the first command")
            with contextlib.suppress(TransportTimeoutError):
                self._pump(left_ns * 1e-9)
        self._armed, self._passive_ns, self._armed_ns = True, None, self._clock.now_ns()
        self._states.clear()

    def read_state(self, timeout_s: float) -> RobotState:
        """Return the next valid and new state; others are counted and dropped."""
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        stale = self._stream.stale
        while not self._states:
            try:
                self._pump(max(0, deadline_ns - self._clock.now_ns()) * 1e-9)
            except TransportTimeoutError as error:
                frozen = f" (it repeats old ones: {self._stream.standstill})" * (self._stream.stale > stale)
                raise TransportTimeoutError(
                    f"go2: no new state within {timeout_s:g} s{frozen}; check that the robot is on, and "
                    f"the cable ({self.transport_errors} transport errors so far)"
                ) from error
        return self._states.popleft()

    def send_command(self, command: JointCommand) -> JointCommand:
        """Send PD targets; once passive, damping is sent instead and returned.

        The wire has no limits of effort and speed: those of the description come back.

        Raises:
            SafetyError: A value is not finite, or the robot was never armed.
        """
        return self._sender.send(command, damp_at=None if self._armed else self._motion()[0])

    def repeat(self) -> None:
        """Send the command in force again, the same bytes; nothing before the first."""
        self._sender.repeat()

    def passive(self) -> None:
        """Damp all joints; works on any open transport, and never waits.

        Earlier states are dropped, so that none of them counts as a confirmation. A run that began to take
        the robot over but never commanded it sends nothing: sport mode may still be active, and two
        commanders make the robot jump.
        """
        self._armed = False
        self._states.clear()
        if self._in_charge and not self._sender.in_force:
            return
        self._passive_ns = self._clock.now_ns()
        self._sender.damp(self._motion()[0])
        for _ in range(PASSIVE_COPIES - 1):
            self.repeat()

    @property
    def operator_stop(self) -> str:
        """How the operator stopped the run by the remote since ``home``; "" if not."""
        return self._operator_stop

    @property
    def fault(self) -> str:
        """Text if another program or a bridge took the robot since it was armed; "" if none did."""
        return self._fault

    @property
    def last_sequence(self) -> int:
        """Number of the last new command; -1 before the first."""
        return self._sender.sequence

    @property
    def transport_errors(self) -> int:
        """Corrupt, missing, repeated and overtaken states so far."""
        return self._stream.errors

    def fileno(self) -> int:
        """Return -1: each process opens its own path to the topics."""
        return -1

    def take_wire(self) -> list[Message]:
        """Return and forget the messages since the last call; repeats of a command are left out."""
        wire = list(self._wire)
        self._wire.clear()
        return wire

    def _make_stream(self, check: StateCheck) -> StateStream:
        return StateStream(check)

    def _await_robot(self) -> None:
        await_robot(self._transport, self._clock, self._stream, self._pump)

    def _read_info(self) -> Go2Info | None:
        if self._frame is None:
            return None
        values = self._frame.values()
        return Go2Info(values.battery_percent / 100, values.voltage, values.serial, values.version)

    def _drain(self) -> None:
        with contextlib.suppress(TransportTimeoutError):
            while True:
                self._pump(0.0)

    def _pump(self, timeout_s: float) -> None:
        """Take one message, waiting for it."""
        message = self._transport.receive(timeout_s)
        self._wire.append(Message("rx", message.payload, message.stamp_ns))
        if message.channel == topics.LOW_STATE:
            if (frame := self._stream.take(message)) is not None:
                self._take_frame(frame, message.stamp_ns)
            return
        if message.channel == topics.BRIDGE:
            self._take_bridge(message)
            return
        if message.channel == topics.LOW_COMMAND and self._bridged and message.attachment:
            # A command of another client has an attachment, and the bridge checks it. Commands from the
            # robot's side have none.
            return
        self._takeover.take(message)
        if message.channel == topics.LOW_COMMAND and self._armed and not self._fault:
            self._fault = self._takeover.complaint()

    def _take_bridge(self, message: Message) -> None:
        """Read a bridge's status on who controls the robot.

        Raises:
            SafetyError: Another controller has it, and this one has just begun to take it over.
        """
        status = read_note(message.payload, STATUS_TEXTS)
        if status is None:
            return
        self._bridged = True
        if (received := read_note(message.payload, HEARD_TEXTS)) is not None:
            self._bridge_heard, self._bridge_heard_ns = received["heard"], message.stamp_ns
        controlled = status["control"] == "controlled"
        ours = bool(self._sender.in_force or self._armed_ns)
        if controlled and self._in_charge and not ours:
            raise SafetyError(
                "go2: another controller commands the robot through the bridge; end the other run first "
                "(Ctrl-C in its terminal)"
            )
        later = message.stamp_ns - self._armed_ns > BRIDGE_DELAY_NS
        if self._armed and later and not controlled and not self._fault:
            self._fault = f"go2: the bridge took the robot from this run: {status['reason']}"

    def _why_unreached(self, since_ns: int) -> str:
        """Return why requests since a time [ns] do not pass the bridge; "" if nothing is known.

        Zenoh drops a reader's messages and tells neither side. The bridge says whom it hears.
        """
        stream = self._transport.stream
        if stream is None or self._bridge_heard_ns <= since_ns or f"{stream:016x}" in self._bridge_heard:
            return ""
        return (
            "states arrive through the bridge, but it hears none of this run's messages: the certificate "
            "may only read (an observer's). Give a controller's by --certificate and --key, and its name to "
            "the bridge by --controllers (`deal-hw keys show DIR` lists names)"
        )

    def _take_frame(self, frame: LowStateFrame, receive_ns: int) -> None:
        self._frame = frame
        self._support.take(frame)
        remote = decode_remote(frame.remote)
        if remote is not None and remote.holds(self._stop_mask):
            self._operator_stop = f"{self._stop_text} was pressed on the remote"
        stream = self._stream
        sequence, age_ns = self._sender.echo.at(stream.device_ns, stream.offset_ns)
        self._states.append(
            RobotState(
                position=frame.position,
                velocity=frame.velocity,
                effort=frame.effort,
                receive_ns=receive_ns,
                device_ns=stream.device_ns,
                sequence=stream.sequence,
                command_sequence=sequence,
                command_age_ns=age_ns,
                status=self._status(frame),
                body=body_state(frame, remote),
            )
        )

    def _status(self, frame: LowStateFrame) -> Status:
        if self._passive_ns is not None:
            sensed_ns = self._stream.device_ns + self._stream.offset_ns
            if sensed_ns - self._passive_ns >= PASSIVE_DELAY_NS and self._is_passive(frame):
                self._passive_ns = None
        status = Status.HOMED if self._homed else Status.NONE
        if self._armed or self._passive_ns is not None:
            status |= Status.ARMED
        return status | Status.FAULT if self._fault else status

    def _is_passive(self, frame: LowStateFrame) -> bool:
        return is_damped(frame, self._sender.damping, self._sender.effort_limit)

    def _motion(self) -> tuple[FloatArray, FloatArray]:
        """Return newest positions and velocities; zeros before the first state."""
        if self._frame is None:
            zero = np.zeros(len(self.description.joint_names))
            return zero, zero
        return self._frame.position, self._frame.velocity

    def _check_connected(self) -> None:
        if self.info is None:
            raise SafetyError("go2: not connected; call connect() first")


class Go2OnStandRobot(Go2Robot):
    """A Go2 with its base on a stand."""

    description: ClassVar[RobotDescription] = on_stand.DESCRIPTION


CONNECT_TIMEOUT_S: Final = 5.0
_FIRST_STATES: Final = 20
"""Number of valid states with a running clock that identify a Go2."""
_TOO_MANY: Final = 20
"""Number of messages without a valid state after which the device is no Go2."""


def await_robot(
    transport: TopicTransport, clock: Clock, stream: StateStream, pump: Callable[[float], None]
) -> None:
    """Wait for states of one Go2 whose clock runs.

    Args:
        transport: Topics of the robot; open.
        clock: For waiting.
        stream: Checks the states; not used before.
        pump: Receives one message, waiting at most so long [s], and gives states to the stream; raises
            TransportTimeoutError if none arrives.

    Raises:
        TransportTimeoutError: No states come, or their clock stands still.
        WrongDeviceError: It is another robot, or there are two.
        VersionMismatchError: The robot's firmware uses other checksums.
    """
    deadline_ns = clock.now_ns() + round(CONNECT_TIMEOUT_S * 1e9)
    while stream.accepted < _FIRST_STATES and (left_ns := deadline_ns - clock.now_ns()) > 0:
        if stream.errors >= _TOO_MANY and (error := stream.complaint()) is not None:
            raise error
        with contextlib.suppress(TransportTimeoutError):
            pump(left_ns * 1e-9)
    if stream.accepted < _FIRST_STATES:
        raise stream.complaint() or TransportTimeoutError(_why_silent(transport, stream))
    if stream.doubled:
        raise WrongDeviceError(
            f"go2: two robots send {topics.LOW_STATE}, or one twice: {stream.stale} of "
            f"{stream.accepted + stream.stale} states were no newer than the one before."
            f"{_seen_writing(transport)} Choose another interface, domain or bridge"
        )


def _why_silent(transport: TopicTransport, stream: StateStream) -> str:
    where = getattr(transport, "port", type(transport).__name__)
    if stream.stale:
        return (
            f"go2 on {where}: states arrive, but {stream.standstill}; restart the robot, or continue a "
            "paused simulator"
        )
    return (
        f"go2 on {where}: no {topics.LOW_STATE} within {CONNECT_TIMEOUT_S:g} s.{_seen_writing(transport)} Is "
        "the robot on and booted, the cable in, the interface the one with an address 192.168.123.x (the "
        "robot is 192.168.123.161), and does the firewall let UDP through? Over Zenoh: does the bridge "
        f"carry {topics.LOW_STATE}?"
    )


def _seen_writing(transport: TopicTransport) -> str:
    writers = transport.writers(topics.LOW_STATE)
    return f" Seen writing it: {'; '.join(writers)}." if writers else ""
