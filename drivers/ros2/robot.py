"""A robot of ros2_control over topics: joint states in, positions or trajectories out."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.command_echo import CommandEcho
from deal_hw.drivers.ros2.graph import Graph
from deal_hw.drivers.ros2.messages import (
    ACTIVE,
    TrajectoryPoint,
    decode_activity,
    encode_point,
    encode_positions,
)
from deal_hw.drivers.ros2.start_motion import StartMotion
from deal_hw.drivers.ros2.state_stream import JointSample, JointStateStream
from deal_hw.drivers.ros2.topics import ros_topic, topics_of
from deal_hw.drivers.topic_robot import TopicRobot
from deal_hw.errors import (
    ConfigurationError,
    FrameError,
    SafetyError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.transport import Message, TopicTransport
from deal_hw.types import FloatArray, JointCommand, RobotState, Status

CONNECT_TIMEOUT_S: Final = 5.0
LISTEN_S: Final = 0.5
"""Before the first command, no other program may publish commands for this long [s]."""
DISCOVERY_S: Final = 2.0
"""Longest wait for a controller to show up on its topic [s]; discovery takes some 0.3 s."""
WATCH_NS: Final = 250_000_000
"""Time between two looks at who else publishes commands [ns]."""
FIRST_STATES: Final = 20
"""Number of states that identify the robot and the rate of its clock."""
_TOO_MANY: Final = 20
"""Number of messages without a state of this robot after which it is another one."""
_CLOCK_RATES: Final = (0.8, 1.25)
"""The robot's clock may run so fast against this computer's, over the first states."""
_SPARSE: Final = 0.8
_PASSIVE_DELAY_NS: Final = 20_000_000
"""States that arrive within this time after the hold command do not confirm it [ns]."""
_FRESH_NS: Final = 200_000_000
"""An older state is no pose to hold [ns]."""
_ASTRAY: Final = {"rad": 0.3, "m": 0.06}
"""A joint that is further from the held pose was moved: the pose is measured again [rad or m]."""
_STILL: Final = {"rad": 0.15, "m": 0.03}
"""A joint slower than this stands [rad/s or m/s]."""


@dataclass(frozen=True, slots=True)
class Ros2Info:
    """What the robot's topics show.

    Attributes:
        states: Topic of the states, and its publishers.
        commands: Topic of the commands.
        rate_hz: States a second, by the robot's clock.
        not_reported: Quantities that its joint states lack.
    """

    states: str
    commands: str
    rate_hz: float
    not_reported: str


class Ros2ControlRobot(TopicRobot[JointStateStream]):
    """A robot behind a forward position controller or a joint trajectory controller.

    The controller holds the last target for ever, and no message switches torque off. Passive therefore means
    that the joints hold the position at which they were measured; a pose that was held once stays the target,
    so that an arm does not sag step by step. It is confirmed by joints that stand.

    States say nothing of commands. So which command was in force follows from the times of sending, and the
    robot's clock is only compared with itself and with the times of reception.

    Attributes:
        info: What the topics show; None before ``connect``.

    Args:
        transport: Topics of the robot.
        clock: The clock of the transport's stamps.
        description: The robot.
        section: Its controller and topics.
    """

    stopped_by = "the robot's emergency stop or its supply"
    listen_s = LISTEN_S
    look_at: ClassVar[str] = "look at the robot's controller_manager and the network"
    info: Ros2Info | None

    def __init__(
        self, transport: TopicTransport, clock: Clock, description: RobotDescription, section: Ros2Section
    ) -> None:
        self.description = description  # type: ignore[misc]  # A user's robot is known at run time.
        super().__init__(transport, clock, description.name, JointStateStream(description, section))
        self._section = section
        self._topics = topics_of(section)
        self._graph = Graph(transport, self._topics, section)
        self._actuated = np.array(description.actuated_index)
        self._order = [description.actuated.index(joint) for joint in section.joints or description.actuated]
        self._ros_names = tuple(section.ros_name(description.actuated[a]) for a in self._order)
        self._period_s = 1.0 / description.control_rate_hz
        units = [description.position_units[j] for j in self._actuated]
        self._still = np.array([_STILL[unit] for unit in units])
        self._astray = np.array([_ASTRAY[unit] for unit in units])
        self._echo = CommandEcho()
        self._forget()

    @property
    def _frozen(self) -> str:
        return "their stamps stand still"

    def _forget(self) -> None:
        self.info = None
        self._stream.reset()
        self._echo.reset()
        self._states.clear()
        self._sequence = -1
        self._newest: RobotState | None = None
        self._armed = self._homed = self._homing = self._in_charge = False
        self._in_force, self._published_ns = b"", -1
        self._target: FloatArray | None = None
        self._hold: FloatArray | None = None
        self._passive_ns: int | None = None
        self._foreign_ns: int | None = None
        self._watched_ns = 0
        self._fault = ""
        self._controller_state = ACTIVE

    # Connection.

    def connect(self) -> None:
        """Open the transport and wait for states of this robot; sends nothing."""
        if self.info is not None:
            return
        self._transport.declare(
            publish=[self._topics.commands],
            subscribe=[self._topics.states, self._topics.commands, self._topics.activity],
        )
        self._transport.open()
        try:
            self._forget()
            self._wire.clear()
            self.info = self._await_robot()
            self._states.clear()
            self._stream.errors = 0
        except BaseException:
            self._transport.close()
            raise

    def _await_robot(self) -> Ros2Info:
        """Wait for states of one robot whose clock runs as this computer's, at the expected rate."""
        begin_ns = self._clock.now_ns()
        deadline_ns = begin_ns + round(CONNECT_TIMEOUT_S * 1e9)
        stream, received, stamps = self._stream, 0, []
        while stream.accepted < FIRST_STATES and (left_ns := deadline_ns - self._clock.now_ns()) > 0:
            if received >= _TOO_MANY and (wrong := self._wrong()) is not None:
                raise wrong
            with contextlib.suppress(TransportTimeoutError):
                before = stream.accepted
                self._pump(left_ns * 1e-9)
                received += 1
                if stream.accepted > before:
                    stamps.append((self._states[-1].receive_ns, stream.device_ns))
        if (wrong := self._wrong()) is not None:
            raise wrong
        where = f"{self.description.name}: {ros_topic(self._topics.states)}"
        if len(stamps) < FIRST_STATES:
            raise TransportTimeoutError(self._why_silent(where, received))
        if stream.doubled:
            who = "; ".join(self._graph.state_publishers())
            raise WrongDeviceError(
                f"{where}: {stream.stale} of {stream.accepted + stream.stale} states were no newer than the "
                f"one before: two programs publish these joints{f' ({who})' * bool(who)}. End one, or choose "
                "another namespace or domain"
            )
        (receive_a, device_a), (receive_b, device_b) = stamps[0], stamps[-1]
        # The median: states that are lost on the way are no other rate.
        rate_hz = 1e9 / float(np.median(np.diff([device_ns for _, device_ns in stamps])))
        pace = (device_b - device_a) / max(receive_b - receive_a, 1)
        low, high = _CLOCK_RATES
        if not low < pace < high:
            raise WrongDeviceError(
                f"{where}: its clock runs at {pace:.2f} times this computer's. A simulator must run at real "
                "time (real time factor 1); a robot's computer needs a clock that is not being set"
            )
        if rate_hz < _SPARSE * self.description.state_rate_hz:
            raise ConfigurationError(
                f"{where} has {rate_hz:.0f} states a second, robot.yaml says "
                f"{self.description.state_rate_hz:g}: write state_rate_hz: {rate_hz:.0f}, or raise "
                "update_rate of the controller_manager"
            )
        return Ros2Info(
            states=ros_topic(self._topics.states),
            commands=ros_topic(self._topics.commands),
            rate_hz=round(rate_hz, 1),
            not_reported=", ".join(sorted(stream.differs)) or "nothing",
        )

    def _wrong(self) -> WrongDeviceError | VersionMismatchError | None:
        found = self._graph.mismatch()
        if isinstance(found, WrongDeviceError | VersionMismatchError):
            return found
        return self._stream.complaint()

    def _why_silent(self, where: str, received: int) -> str:
        if self._stream.stale:
            return (
                f"{where}: states arrive, but their stamps stand still at "
                f"{self._stream.device_ns * 1e-9:.3f} s: a paused simulator, or a publisher that does not "
                "set header.stamp"
            )
        others = f" ({received} other messages)" if received else ""
        return (
            f"{where}: no states within {CONNECT_TIMEOUT_S:g} s{others}. Is the joint_state_broadcaster "
            "active, is this the robot's interface or router, and are `domain` "
            f"({self._section.domain}), `namespace` and `joint_states` in robot.yaml the robot's? Over DDS: "
            "does the firewall let UDP through? Over Zenoh: does `rmw_zenohd` run there?"
        )

    # Who commands the robot.

    def require_free(self, timeout_s: float) -> None:
        """Check that a controller reads the commands, and that no other program publishes them.

        Raises:
            SafetyError: There is no controller, or another program publishes commands.
        """
        self._check_connected()
        self._foreign_ns = None
        now_ns = self._clock.now_ns()
        listened_ns = now_ns + round(LISTEN_S * 1e9)
        end_ns = now_ns + round(max(min(timeout_s, DISCOVERY_S), LISTEN_S) * 1e9)
        while (now_ns := self._clock.now_ns()) < end_ns:
            if now_ns >= listened_ns and self._graph.controlled is not False:
                break
            with contextlib.suppress(TransportTimeoutError):
                self._pump(min(end_ns - now_ns, WATCH_NS) * 1e-9)
        if (wrong := self._graph.mismatch()) is not None:
            raise SafetyError(f"{self.description.name}: {wrong}")
        who = self._graph.foreign()
        if who or self._foreign_ns is not None:
            raise SafetyError(f"{self.description.name}: {self._graph.foreign_complaint(who)}")
        if self._graph.controlled is False:
            raise SafetyError(f"{self.description.name}: {self._graph.no_controller()}")
        if self._controller_state != ACTIVE:
            raise SafetyError(f"{self.description.name}: {self._graph.not_active(self._controller_state)}")

    def _commanded_since(self, since_ns: int) -> str:
        who = self._graph.foreign()
        if who or (self._foreign_ns is not None and self._foreign_ns >= since_ns):
            return f"{self.description.name}: {self._graph.foreign_complaint(who)}"
        return ""

    # The start pose, and commands.

    def home(self, timeout_s: float) -> None:
        """Hold where the robot is, see that each joint follows, and move to the start pose, slowly.

        Raises:
            TransportTimeoutError: It did not arrive, or its states ceased.
            SafetyError: No controller, another commander, a joint that does not follow, or outside its range.
        """
        self._check_connected()
        end_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        self._in_charge, self._homed, self._fault = True, False, ""
        self._hold = self._passive_ns = None
        self.require_free(timeout_s)
        self._homing = True
        try:
            StartMotion(
                self.description,
                self._clock,
                self._publish,
                self._wait,
                names_sent=self._section.command == "trajectory",
                remedy=self._graph.inactive(),
            ).run(end_ns)
            self._homed = True
        finally:
            self._homing = False
            if not self._homed and self._in_force:
                self.passive()
        self._states.clear()

    def arm(self, timeout_s: float) -> None:
        """Let commands through; the robot holds its start pose until the first.

        Raises:
            SafetyError: It was not homed, another program publishes commands, or the controller is off.
            TransportTimeoutError: No new states arrive.
        """
        self._check_connected()
        self._drain()
        if not self._homed or self._target is None:
            raise SafetyError(f"{self.description.name}: not at its start pose; call home() first")
        if self._fault:
            raise SafetyError(self._fault)
        self._hold = self._passive_ns = None
        self._stream.trouble = ""
        # From here on a word of the controller_manager or a command of another program is a fault.
        self._armed = True
        try:
            self._publish(self._target)
            self._await_new_states(timeout_s)
            if self._fault:
                raise SafetyError(self._fault)
        except BaseException:
            self._armed = False
            raise
        self._states.clear()

    def send_command(self, command: JointCommand) -> JointCommand:
        """Send position targets; once passive, the held pose is sent instead and returned.

        The controller takes neither gains nor limits: those of the description come back.

        Raises:
            SafetyError: A target is not finite, or the robot was never armed.
        """
        target = np.asarray(command.position_target, dtype=float)
        if not np.isfinite(target).all():
            raise SafetyError(f"{self.description.name}: position_target is {target}; nothing was sent")
        if not self._armed:
            if self._hold is None:
                raise SafetyError(f"{self.description.name}: not armed; call arm() before the first command")
            target = self._hold
        stamp_ns = self._publish(target)
        self._sequence += 1
        self._echo.note(self._sequence, stamp_ns)
        d, zeros = self.description, np.zeros(len(target))
        return JointCommand(
            position_target=target.copy(),
            velocity_target=zeros,
            stiffness=np.array(d.stiffness),
            damping=np.array(d.damping),
            effort=zeros.copy(),
            effort_limit=np.array(d.effort_limit),
            speed_limit=np.array(d.speed_limit),
        )

    def repeat(self) -> None:
        """Publish the command in force again; nothing before the first."""
        if self._in_force:
            message = Message(self._topics.commands, self._in_force, self._clock.now_ns())
            self._transport.send(message)

    def passive(self) -> None:
        """Hold the joints where they were measured; the pose stays until the robot is homed or armed again.

        So an arm does not sag step by step. A joint that was moved away, while its drive was off or by
        another program, is not brought back: there the pose is measured anew.

        States received before are dropped. Nothing is sent by a run that never commanded the robot, nor while
        another program commands it: two would fight.

        Raises:
            TransportTimeoutError: No state and no command is known, so there is no pose to hold.
        """
        self._armed = self._homed = False
        if self._hold is None:
            # What waits in the buffers is newer than what was read.
            self._drain()
        self._states.clear()
        if self._in_charge and not self._in_force:
            return
        now_ns = self._clock.now_ns()
        contested = self._is_contested(now_ns)
        overruled = contested and (self._foreign_ns or 0) > self._published_ns
        if self._hold is None or overruled or self._is_astray(now_ns):
            self._hold = self._pose_to_hold(now_ns)
        if self._passive_ns is None or not contested:
            self._publish(self._hold)
        self._passive_ns = now_ns

    def _is_astray(self, now_ns: int) -> bool:
        state = self._newest
        if state is None or self._hold is None or now_ns - state.receive_ns > _FRESH_NS:
            return False
        at = self._credible(state.position[self._actuated], self._hold)
        return bool((np.abs(at - self._hold) > self._astray).any())

    def _credible(self, position: FloatArray, otherwise: FloatArray) -> FloatArray:
        """Return readings, and another pose where no joint can be: its drive would go there, (A,)."""
        low, high = np.array(self.description.limits.trip_position)[self._actuated].T
        return np.where((low <= position) & (position <= high), position, otherwise)

    def _pose_to_hold(self, now_ns: int) -> FloatArray:
        state = self._newest
        if state is not None and now_ns - state.receive_ns <= _FRESH_NS:
            at: FloatArray = state.position[self._actuated]
            return at if self._target is None else self._credible(at, self._target)
        if self._target is not None:
            # The robot goes there or is there: an older measurement would make it jump back.
            return self._target
        raise TransportTimeoutError(f"{self.description.name}: no state arrived, so there is no pose to hold")

    def _is_contested(self, now_ns: int) -> bool:
        return self._foreign_ns is not None and now_ns - self._foreign_ns <= _FRESH_NS

    @property
    def fault(self) -> str:
        """Text if another program commands the robot, or its states became unusable; "" if not."""
        return self._fault

    @property
    def last_sequence(self) -> int:
        """Number of the last new command; -1 before the first."""
        return self._sequence

    # Messages.

    def _publish(self, target: FloatArray) -> int:
        """Publish position targets, (A,); return when that was [ns]."""
        ordered = target[self._order]
        if self._section.command == "trajectory":
            payload = encode_point(TrajectoryPoint(self._ros_names, ordered, self._period_s))
        else:
            payload = encode_positions(ordered)
        stamp_ns = self._clock.now_ns()
        self._transport.send(Message(self._topics.commands, payload, stamp_ns))
        self._wire.append(Message("tx", payload, stamp_ns))
        self._in_force, self._target, self._published_ns = payload, target.copy(), stamp_ns
        return stamp_ns

    def _wait(self, until_ns: int) -> RobotState:
        """Read states until a time [ns]; return the newest.

        Raises:
            SafetyError: Another program commands the robot.
            TransportTimeoutError: The states are old.
        """
        while (left_ns := until_ns - self._clock.now_ns()) > 0:
            with contextlib.suppress(TransportTimeoutError):
                self._pump(left_ns * 1e-9)
        if self._fault:
            raise SafetyError(self._fault)
        state = self._newest
        if state is None or self._clock.now_ns() - state.receive_ns > _FRESH_NS:
            raise TransportTimeoutError(f"{self.description.name}: its states ceased on the way")
        return state

    def _pump(self, timeout_s: float) -> None:
        """Take one message, waiting for it."""
        message = self._transport.receive(timeout_s)
        self._wire.append(Message("rx", message.payload, message.stamp_ns))
        if message.channel == self._topics.commands:
            self._foreign_ns = message.stamp_ns
            if self._armed or self._homing:
                self._latch(self._graph.foreign_complaint(self._graph.foreign()))
        elif message.channel == self._topics.activity:
            self._take_activity(message.payload)
        elif (sample := self._stream.take(message)) is not None:
            self._take(sample, message.stamp_ns)
        if self._armed:
            if self._stream.trouble:
                self._latch(self._stream.trouble)
            self._watch(message.stamp_ns)

    def _take_activity(self, payload: bytes) -> None:
        """Note whether the controller is active; older controller_managers say nothing of it."""
        try:
            states = decode_activity(payload)
        except FrameError:
            self._stream.errors += 1
            return
        self._controller_state = states.get(self._graph.controller, self._controller_state)
        if self._controller_state != ACTIVE and (self._armed or self._homing):
            self._latch(self._graph.not_active(self._controller_state))

    def _watch(self, now_ns: int) -> None:
        """Look now and then whether another program began to publish commands, or the controller left."""
        if now_ns - self._watched_ns < WATCH_NS:
            return
        self._watched_ns = now_ns
        if who := self._graph.foreign():
            self._latch(self._graph.foreign_complaint(who))
        elif self._graph.controlled is False:
            self._latch(self._graph.no_controller())

    def _latch(self, text: str) -> None:
        self._fault = self._fault or f"{self.description.name}: {text}"

    def _take(self, sample: JointSample, receive_ns: int) -> None:
        stream = self._stream
        sequence, age_ns = self._echo.at(stream.device_ns, stream.offset_ns)
        self._newest = RobotState(
            position=sample.position,
            velocity=sample.velocity,
            effort=sample.effort,
            receive_ns=receive_ns,
            device_ns=stream.device_ns,
            sequence=stream.sequence,
            command_sequence=sequence,
            command_age_ns=age_ns,
            status=self._status(sample, receive_ns),
        )
        self._states.append(self._newest)

    def _status(self, sample: JointSample, receive_ns: int) -> Status:
        if self._passive_ns is not None and receive_ns - self._passive_ns >= _PASSIVE_DELAY_NS:
            speed = np.abs(sample.velocity[self._actuated])
            if (speed < self._still).all() and not self._is_contested(receive_ns):
                self._passive_ns = None
        status = Status.HOMED if self._homed else Status.NONE
        if self._homing:
            status |= Status.HOMING
        if self._armed or self._passive_ns is not None:
            status |= Status.ARMED
        return status | Status.FAULT if self._fault else status
