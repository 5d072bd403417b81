"""The driver: deal-hw's contract of a robot, over the robot's serial protocol."""

from __future__ import annotations

import math
from collections import deque
from typing import ClassVar, Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.command_echo import ClockOffset, CommandEcho
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import SafetyError, TransportTimeoutError, VersionMismatchError, WrongDeviceError
from deal_hw.robot import Robot
from deal_hw.transport import Message, Transport
from deal_hw.types import FloatArray, JointCommand, RobotState, Status
from deal_hw_bench_cartpole import protocol
from deal_hw_bench_cartpole.description import COUNTS_M, COUNTS_RAD, DESCRIPTION, FORCE_N
from deal_hw_bench_cartpole.protocol import Command, Splitter, State

GREETING_S: Final = 1.0
RETRY_S: Final = 0.1
PERIOD_MS: Final = 20
SWING_S: Final = 1.2
"""Longer than the hanging pole's period of 1.0 s: the middle of its extremes is where it hangs [s]."""
_QUEUE: Final = 4096


class BenchCartpole(Robot):
    """The bench cart-pole. Its motor is commanded by a share of its voltage, -1 to 1.

    The states have no number and name no command, so the driver counts them and finds out which command was
    in force by the times of both clocks. The pole's angle is measured from where it hangs, which is found by
    ``home``.

    Args:
        transport: The port's bytes.
        clock: The clock of the transport's stamps.
    """

    description: ClassVar[RobotDescription] = DESCRIPTION
    stopped_by: ClassVar[str] = "the switch of its motor's supply"

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._transport, self._clock = transport, clock
        self._states: deque[RobotState] = deque(maxlen=_QUEUE)
        self._wire: deque[Message] = deque(maxlen=_QUEUE)
        self._answers: deque[bytes] = deque(maxlen=64)
        self._hanging = math.nan
        self._connected = self._homed = self._armed = self._stopping = False
        self._sequence = -1
        self._gaps = 0
        self._forget()

    def connect(self) -> None:
        """Open the port, ping the robot, stop its motor and have it send states."""
        if self._connected:
            return
        self._transport.open()
        try:
            self._forget()
            if self._transport.can_send:
                self._greet()
            first = self._next_raw(GREETING_S)
            if self._transport.can_send:
                self._send(protocol.configure(PERIOD_MS, first.length))
        except BaseException:
            self._transport.close()
            raise
        self._connected = True

    def disconnect(self) -> None:
        """Close the port."""
        self._transport.close()
        self._connected = self._homed = self._armed = False

    def reopen(self) -> None:
        """Open the port again after it vanished."""
        self._transport.reopen()
        self._forget()

    def home(self, timeout_s: float) -> None:
        """Measure where the pole hangs, and have the firmware find the ends of the track."""
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        self._hanging = self._measure_hanging()
        self._answers.clear()
        self._send(protocol.frame(Command.CALIBRATE))
        while not any(answer[1] == Command.CALIBRATE for answer in self._answers):
            self._pump(self._left_s(end_ns), "it does not finish its calibration; is the track free?")
        self._states.clear()
        self._homed = True

    def arm(self, timeout_s: float) -> None:
        """Let the motor follow commands. Firmware of 2024 does not know this switch and needs none."""
        self._send(protocol.motor(0))
        self._send(protocol.switch(Command.PC_CONTROL, True))
        self._armed, self._stopping = True, False
        self._states.clear()
        self.read_state(timeout_s)

    def read_state(self, timeout_s: float) -> RobotState:
        """Return the next state sample in order of arrival."""
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not self._states:
            self._pump(self._left_s(end_ns), f"no state within {timeout_s:g} s; check its power and cable")
        return self._states.popleft()

    def send_command(self, command: JointCommand) -> JointCommand:
        """Send the share of the motor's voltage, -1 to 1.

        Raises:
            SafetyError: It is not finite.
        """
        share = float(command.position_target[0])
        if not math.isfinite(share):
            raise SafetyError(f"bench_cartpole: a command of {share} is not finite")
        counts = round(min(max(share, -1.0), 1.0) * protocol.LARGEST_COMMAND)
        # Firmware of 2024 obeys at any time, so a command after `passive` must not reach it.
        if self._armed:
            self._sequence += 1
            self._echo.note(self._sequence, self._clock.now_ns())
            self._send(protocol.motor(counts))
        zeros = np.zeros(1)
        return JointCommand(
            position_target=np.array([counts / protocol.LARGEST_COMMAND]),
            velocity_target=zeros,
            stiffness=zeros,
            damping=zeros,
            effort=zeros,
            effort_limit=np.array([FORCE_N]),
            speed_limit=np.array([math.inf]),
        )

    def passive(self) -> None:
        """Switch the motor off. States received before are discarded: they confirm nothing."""
        self._states.clear()
        self._armed, self._stopping = False, True
        self._send(protocol.motor(0))
        self._send(protocol.switch(Command.PC_CONTROL, False))

    @property
    def last_sequence(self) -> int:
        """Sequence number of the last command sent; -1 before the first."""
        return self._sequence

    @property
    def transport_errors(self) -> int:
        """Damaged frames, and gaps in the states' times."""
        return self._splitter.errors + self._gaps

    def fileno(self) -> int:
        """Return the descriptor of the open port."""
        return self._transport.fileno()

    def take_wire(self) -> list[Message]:
        """Return and forget the raw messages since the last call."""
        taken = list(self._wire)
        self._wire.clear()
        return taken

    def _forget(self) -> None:
        """Forget what was received: a new connection begins with new bytes."""
        self._splitter = Splitter()
        self._echo, self._offset = CommandEcho(), ClockOffset()
        self._last: State | None = None
        self._raw: State | None = None
        self._count = self._device_ns = 0
        self._before = np.zeros(2)
        self._moved_origin = False
        self._states.clear()
        self._answers.clear()

    def _greet(self) -> None:
        """Ping until the robot answers, stop its motor and have it send states."""
        ping = protocol.frame(Command.PING)
        end_ns = self._clock.now_ns() + round(GREETING_S * 1e9)
        heard = 0
        while ping not in self._answers:
            if self._clock.now_ns() >= end_ns:
                if heard:
                    raise WrongDeviceError(
                        f"bench_cartpole: {heard} bytes came, but no answer to a ping; is it another "
                        f"device, or another baud rate than {protocol.BAUD_RATE}?"
                    )
                raise TransportTimeoutError(
                    f"bench_cartpole: no answer within {GREETING_S:g} s; check its power and cable"
                )
            self._send(ping)
            try:
                self._pump(RETRY_S, "")
            except TransportTimeoutError:
                pass
            heard = self._splitter.skipped
        self._send(protocol.motor(0))
        self._send(protocol.switch(Command.PC_CONTROL, False))
        self._send(protocol.switch(Command.STREAM, True))

    def _measure_hanging(self) -> float:
        """Return the encoder's count where the pole hangs, from a swing or at rest."""
        end_ns = self._clock.now_ns() + round(SWING_S * 1e9)
        counts = [self._next_raw(GREETING_S).angle]
        while self._clock.now_ns() < end_ns:
            counts.append(self._next_raw(GREETING_S).angle)
        return 0.5 * (min(counts) + max(counts))

    def _next_raw(self, timeout_s: float) -> State:
        """Wait for a state and return it as it came."""
        self._raw = None
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while self._raw is None:
            self._pump(self._left_s(end_ns), f"no state within {timeout_s:g} s; check its power and cable")
        return self._raw

    def _left_s(self, end_ns: int) -> float:
        return max(0, end_ns - self._clock.now_ns()) / 1e9

    def _send(self, data: bytes) -> None:
        message = Message("tx", data, self._clock.now_ns())
        self._transport.send(Message("", data, message.stamp_ns))
        self._wire.append(message)

    def _pump(self, timeout_s: float, problem: str) -> None:
        """Take what arrives.

        Raises:
            TransportTimeoutError: Nothing arrived in time.
            VersionMismatchError: The states have another layout.
        """
        try:
            message = self._transport.receive(timeout_s)
        except TransportTimeoutError as error:
            raise TransportTimeoutError(f"bench_cartpole: {problem}") from error
        self._wire.append(Message("rx", message.payload, message.stamp_ns))
        for data in self._splitter.feed(message.payload):
            if data[1] != Command.STATE:
                self._answers.append(data)
                # Positions count from the new centre now: the difference to the last one is no speed.
                self._moved_origin |= data[1] == Command.CALIBRATE
                continue
            state = protocol.decode_state(data)
            if state is None:
                raise VersionMismatchError(
                    f"bench_cartpole: states of {len(data)} bytes, and this driver knows 31, 36 and 40; "
                    "update deal-hw-bench-cartpole"
                )
            self._take(state, message.stamp_ns)

    def _take(self, state: State, stamp_ns: int) -> None:
        """Queue a state in units of the description."""
        last = self._last or state
        elapsed_us = (state.time_us - last.time_us) % 2**32
        if elapsed_us > 1500 * PERIOD_MS:
            self._gaps += 1
        # The robot's 32-bit clock wraps after 71 min; ours goes on.
        self._device_ns += elapsed_us * 1000
        device_ns = self._device_ns
        self._last = self._raw = state
        self._offset.take(stamp_ns, device_ns)
        position = self._position(state)
        velocity = np.zeros(2)
        if elapsed_us and not self._moved_origin:
            velocity = (position - self._before) / (elapsed_us * 1e-6)
        self._moved_origin = False
        self._before = position
        if state.motor == 0:
            self._stopping = False
        status = Status.HOMED if self._homed else Status.NONE
        if self._armed or self._stopping:
            status |= Status.ARMED
        number, age_ns = self._echo.at(device_ns, self._offset.offset_ns)
        effort = np.array([state.motor / protocol.LARGEST_COMMAND * FORCE_N, 0.0])
        self._states.append(
            RobotState(
                position=position,
                velocity=velocity,
                effort=effort,
                receive_ns=stamp_ns,
                device_ns=device_ns,
                sequence=self._count,
                command_sequence=number,
                command_age_ns=age_ns,
                status=status,
            )
        )
        self._count += 1

    def _position(self, state: State) -> FloatArray:
        """Return cart [m] and pole [rad]; the pole's angle goes on growing over full turns."""
        hanging = state.angle if math.isnan(self._hanging) else self._hanging
        angle = math.pi + (state.angle - hanging) / COUNTS_RAD
        if self._count:
            angle += 2 * math.pi * round((self._before[1] - angle) / (2 * math.pi))
        return np.array([state.position / COUNTS_M, angle])


def serial_robot(port: str, clock: Clock, fd: int | None = None, *, can_send: bool = True) -> BenchCartpole:
    """Return the robot on a serial port; nothing is opened yet.

    Args:
        port: Path of the port.
        clock: Gives the stamps.
        fd: Descriptor of the port that a parent process opened.
        can_send: False for a robot that is only listened to.
    """
    if fd is None:
        link = SerialTransport(port, protocol.BAUD_RATE, clock)
    else:
        link = SerialTransport.from_fd(fd, clock, port, protocol.BAUD_RATE)
    return BenchCartpole(link if can_send else listen_only(link), clock)
