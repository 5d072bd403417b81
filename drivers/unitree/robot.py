"""The driver that Unitree's robots share: topics in, commands out, damping as the passive state."""

from __future__ import annotations

import abc
import contextlib
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final, Generic, Protocol, TypeVar

import numpy as np

from deal_hw.clock import Clock
from deal_hw.drivers.topic_robot import TopicRobot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.command_sender import PASSIVE_COPIES, CommandSender
from deal_hw.drivers.unitree.drive_modes import DriveModes
from deal_hw.drivers.unitree.remote import Remote, decode_remote, parse_combination
from deal_hw.drivers.unitree.takeover import LISTEN_S, Takeover
from deal_hw.drivers.unitree.tick_stream import TickStream
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.errors import SafetyError, TransportTimeoutError, WrongDeviceError
from deal_hw.transport import Message, TopicTransport
from deal_hw.types import BodyState, FloatArray, IntArray, JointCommand, RobotState, Status

PASSIVE_DELAY_NS: Final = 10_000_000
"""States sensed within this time after the passive command do not confirm it [ns]."""
PUBLISHED: Final = (topics.LOW_COMMAND, *(topics.request(name) for name in topics.SERVICES))
SUBSCRIBED: Final = (
    topics.LOW_STATE,
    topics.LOW_COMMAND,
    *(topics.response(name) for name in topics.SERVICES),
)
DAMPED_TOLERANCE_NM: Final = 1.5
DAMPED_TOLERANCE_SHARE: Final = 0.3
"""Largest difference of estimated efforts from damping: the motors' noise, and the change of a joint's speed
within a sample."""


class StateFrame(Protocol):
    """What the driver reads in a state; joints in the description's order."""

    @property
    def tick_ms(self) -> int:
        """The robot's clock, modulo 2**32 [ms]."""
        ...

    @property
    def position(self) -> FloatArray:
        """Positions, (J,) [rad]."""
        ...

    @property
    def velocity(self) -> FloatArray:
        """Speeds, (J,) [rad/s]."""
        ...

    @property
    def effort(self) -> FloatArray:
        """The motors' estimated efforts, (J,) [N·m]."""
        ...

    @property
    def mode(self) -> IntArray:
        """Each motor's mode; 0: off, (J,)."""
        ...

    @property
    def remote(self) -> bytes:
        """The remote control's 40 bytes."""
        ...


F = TypeVar("F", bound=StateFrame)


def is_damped(frame: StateFrame, damping: FloatArray, effort_limit: FloatArray) -> bool:
    """Return whether the motors' estimated efforts are those of pure damping.

    A joint whose sensor gives no number is left out, unless none gives one.

    Args:
        frame: The state.
        damping: kd of each joint, (J,) [N·m·s/rad].
        effort_limit: Largest effort of each motor, (J,) [N·m].
    """
    braking = np.clip(-damping * frame.velocity, -effort_limit, effort_limit)
    allowed = DAMPED_TOLERANCE_NM + DAMPED_TOLERANCE_SHARE * np.abs(braking)
    excess = np.abs(frame.effort - braking) - allowed
    known = excess[np.isfinite(excess)]
    return known.size > 0 and bool((known <= 0.0).all())


class UnitreeRobot(TopicRobot[TickStream[F]], Generic[F]):
    """A Unitree robot at its motors' own level.

    The robot holds the last command for ever: it has no arming and no watchdog, and without torque it falls.
    Passive therefore means damping, and only this driver knows whether it is armed: before ``arm`` it sends
    nothing, and after ``passive`` only damping.

    ``home`` releases the robot's own controller (sport mode) and checks that no other program commands the
    motors; ``hand_back`` returns the robot to that controller. All waits here keep reading messages.

    Attributes:
        info: What the robot reported about itself; None before ``connect``.
        wording: What messages say of the robot.
        published: Topics that the driver writes.
        subscribed: Topics that it reads.
        types: Types of the topics that have another type than the Go2's.

    Args:
        transport: Topics of the robot, or of a bridge to it.
        clock: The clock of the transport's stamps.
        stop_buttons: Buttons of the remote that stop a run while held together; "" for none.
        stream: Selects the valid and new states.
    """

    wording: ClassVar[Wording]
    look_at: ClassVar[str] = "check that the robot is on, and the cable"
    published: ClassVar[tuple[str, ...]] = PUBLISHED
    subscribed: ClassVar[tuple[str, ...]] = SUBSCRIBED
    types: ClassVar[Mapping[str, str]] = {}
    homes_by_motor: ClassVar[bool] = False
    listen_s: ClassVar[float] = LISTEN_S
    _has_services: ClassVar[bool] = True

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        stop_buttons: str,
        stream: TickStream[F],
    ) -> None:
        super().__init__(transport, clock, self.wording.name, stream)
        self._stop_text, self._stop_mask = stop_buttons, parse_combination(stop_buttons)
        self._sender = CommandSender(
            transport, clock, self.description, self._wire.append, self._encode, self.wording.name
        )
        self._drives = DriveModes(self.wording.name, self.description.joint_names)
        self._forget()

    def _forget(self) -> None:
        """Reset; an open transport can still make the robot passive."""
        self.info: Any | None = None
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
            self.wording,
            services=self._has_services,
            why_unreached=self._why_unreached,
        )
        self._frame: F | None = None
        self._armed = self._homed = self._in_charge = False
        self._passive_ns: int | None = None
        self._armed_ns = 0
        self._fault = self._operator_stop = ""

    def connect(self) -> None:
        """Open the transport and wait for states of the robot whose clock runs; sends nothing."""
        if self.info is not None:
            return
        self._transport.name_types(self.types)
        self._transport.declare(publish=self.published, subscribe=self.subscribed)
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

    def home(self, timeout_s: float) -> None:
        """Release the robot's own controller and check that no other program commands the motors.

        Raises:
            TransportTimeoutError: The robot's services do not answer, or do not let go in time.
            SafetyError: A service refuses, another program commands the motors (the text names it), or the
                robot is not set up as its description says.
        """
        self._check_connected()
        self._in_charge, self._homed, self._operator_stop = True, False, ""
        self._before_release()
        self._takeover.run(timeout_s)
        self._after_release()
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

    def _commanded_since(self, since_ns: int) -> str:
        return self._takeover.commanded_since(since_ns)

    def hand_back(self, timeout_s: float) -> None:
        """Return the robot to the mode that ``home`` released, if any; the robot stands up.

        Raises:
            SafetyError: The robot is armed, or the service refuses.
            TransportTimeoutError: The mode does not have the robot in time.
        """
        if self._armed:
            raise SafetyError(f"{self._name}: the robot is armed: make it passive before you hand it back")
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
            raise SafetyError(
                f"{self._name}: its own controller may still command the motors; call home() first"
            )
        if self._takeover.contested:
            raise SafetyError(self._takeover.complaint())
        if self._operator_stop:
            raise SafetyError(
                f"{self._name}: {self._operator_stop}; release the buttons and call home() again"
            )
        self._fault = ""
        self._drives.reset()
        self._sender.damp(self._motion()[0])
        self._await_new_states(timeout_s)
        self._armed, self._passive_ns, self._armed_ns = True, None, self._clock.now_ns()
        self._states.clear()

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
        """Text if a drive went off, or another program or a bridge took the robot, since it was armed."""
        return self._fault

    @property
    def last_sequence(self) -> int:
        """Number of the last new command; -1 before the first."""
        return self._sender.sequence

    @property
    def _frozen(self) -> str:
        return f"it repeats old ones: {self._stream.standstill}"

    def _await_robot(self) -> None:
        await_robot(self._transport, self._clock, self._stream, self._pump, self.wording.name)

    @abc.abstractmethod
    def _encode(
        self,
        position: FloatArray,
        velocity: FloatArray,
        stiffness: FloatArray,
        damping: FloatArray,
        effort: FloatArray,
    ) -> bytes:
        """Return the message of a command."""

    @abc.abstractmethod
    def _read_info(self) -> Any | None:
        """Return what the robot reported about itself."""

    @abc.abstractmethod
    def _body(self, frame: F, remote: Remote | None) -> BodyState:
        """Return body, motors, battery and remote of a state."""

    def _before_release(self) -> None:
        """Refuse a robot that must not be released from its own controller."""

    def _after_release(self) -> None:
        """Refuse a robot that is not set up as its description says."""

    def _notice_frame(self, frame: F) -> None:
        """Take a new state, before it is queued."""

    def _take_other(self, message: Message) -> bool:
        """Take a message that is no state; return whether it is done with."""
        return False

    def _why_unreached(self, since_ns: int) -> str:
        """Return why requests since a time [ns] cannot reach the robot; "" if nothing is known."""
        return ""

    def _pump(self, timeout_s: float) -> None:
        """Take one message, waiting for it."""
        message = self._transport.receive(timeout_s)
        self._wire.append(Message("rx", message.payload, message.stamp_ns))
        if message.channel == topics.LOW_STATE:
            if (frame := self._stream.take(message)) is not None:
                self._take_frame(frame, message.stamp_ns)
            return
        if self._take_other(message):
            return
        self._takeover.take(message)
        if message.channel == topics.LOW_COMMAND and self._armed and not self._fault:
            self._fault = self._takeover.complaint()

    def _take_frame(self, frame: F, receive_ns: int) -> None:
        self._frame = frame
        self._notice_frame(frame)
        if self._armed and not self._fault:
            self._fault = self._drives.complaint(frame.mode)
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
                body=self._body(frame, remote),
            )
        )

    def _status(self, frame: F) -> Status:
        if self._passive_ns is not None:
            sensed_ns = self._stream.device_ns + self._stream.offset_ns
            if sensed_ns - self._passive_ns >= PASSIVE_DELAY_NS and self._is_passive(frame):
                self._passive_ns = None
        status = Status.HOMED if self._homed else Status.NONE
        if self._armed or self._passive_ns is not None:
            status |= Status.ARMED
        return status | Status.FAULT if self._fault else status

    def _is_passive(self, frame: F) -> bool:
        return is_damped(frame, self._sender.damping, self._sender.effort_limit)

    def _motion(self) -> tuple[FloatArray, FloatArray]:
        """Return newest positions and velocities; zeros before the first state."""
        if self._frame is None:
            zero = np.zeros(len(self.description.joint_names))
            return zero, zero
        return self._frame.position, self._frame.velocity


CONNECT_TIMEOUT_S: Final = 5.0
_FIRST_STATES: Final = 20
"""Number of valid states with a running clock that identify the robot."""
_TOO_MANY: Final = 20
"""Number of messages without a valid state after which the device is another."""


def await_robot(
    transport: TopicTransport,
    clock: Clock,
    stream: TickStream[Any],
    pump: Callable[[float], None],
    name: str,
) -> None:
    """Wait for states of one robot whose clock runs.

    Args:
        transport: Topics of the robot; open.
        clock: For waiting.
        stream: Checks the states; not used before.
        pump: Receives one message, waiting at most so long [s], and gives states to the stream; raises
            TransportTimeoutError if none arrives.
        name: The robot, as messages begin.

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
        raise stream.complaint() or TransportTimeoutError(_why_silent(transport, stream, name))
    if stream.doubled:
        raise WrongDeviceError(
            f"{name}: two robots send {topics.LOW_STATE}, or one twice: {stream.stale} of "
            f"{stream.accepted + stream.stale} states were no newer than the one before."
            f"{_seen_writing(transport)} Choose another interface, domain or bridge"
        )


def _why_silent(transport: TopicTransport, stream: TickStream[Any], name: str) -> str:
    where = getattr(transport, "port", type(transport).__name__)
    if stream.stale:
        return (
            f"{name} on {where}: states arrive, but {stream.standstill}; restart the robot, or continue a "
            "paused simulator"
        )
    return (
        f"{name} on {where}: no {topics.LOW_STATE} within {CONNECT_TIMEOUT_S:g} s.{_seen_writing(transport)} "
        "Is the robot on and booted, the cable in, the interface the one with an address 192.168.123.x (the "
        "robot is 192.168.123.161), and does the firewall let UDP through? Over Zenoh: does the bridge "
        f"carry {topics.LOW_STATE}?"
    )


def _seen_writing(transport: TopicTransport) -> str:
    writers = transport.writers(topics.LOW_STATE)
    return f" Seen writing it: {'; '.join(writers)}." if writers else ""
