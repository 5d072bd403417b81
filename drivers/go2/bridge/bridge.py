"""The bridge: two transports, a thread that passes states on, and a loop that checks commands and damps."""

from __future__ import annotations

import contextlib
import secrets
import threading
from collections import Counter
from collections.abc import Callable
from typing import Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.drivers.go2.bridge.admission import Admission, Control
from deal_hw.drivers.go2.bridge.config import DESCRIPTION, BridgeConfig
from deal_hw.drivers.go2.bridge.limits import CommandLimits
from deal_hw.drivers.go2.bridge.robot_side import BUSY
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.go2.messages.refusals import StateCheck
from deal_hw.drivers.go2.wording import WORDING
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.zenoh_stamps import Stamp
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.motion_switcher import BUSY as BUSY_CODE
from deal_hw.drivers.unitree.motion_switcher import CHECK_MODE, SWITCHER, MotionSwitcher, ServiceClient
from deal_hw.drivers.unitree.rpc import (
    CLAIM_TEXTS,
    Request,
    decode_response,
    encode_note,
    encode_request,
    read_note,
)
from deal_hw.errors import DealHwError, FrameError, TransportError, TransportTimeoutError
from deal_hw.transport import Message, TopicTransport

_RESPONSE: Final = topics.response(SWITCHER)


class ModeQuestion:
    """The newest question to ``motion_switcher``, and its answer.

    One thread asks; another one may take the robot's messages.
    """

    def __init__(self) -> None:
        self._identity = 0
        self._answer: tuple[int, str] | None = None

    def ask(self, now_ns: int) -> bytes:
        """Return the payload of a new question; the answer to the one before does not count any more.

        Args:
            now_ns: The bridge's clock, from which the question has its number [ns].
        """
        self._identity = max(self._identity + 1, now_ns)
        return encode_request(Request(self._identity, CHECK_MODE, "{}"))

    def take(self, message: Message) -> None:
        """Take a message of the robot's side; answers to other programs, and errors, are skipped."""
        if message.channel != _RESPONSE:
            return
        try:
            response = decode_response(message.payload)
            name = BUSY if response.code == BUSY_CODE else response.json().get("name")
        except FrameError:
            return
        if response.code in (0, BUSY_CODE) and isinstance(name, str):
            self._answer = response.identity, name

    def answer(self) -> str | None:
        """Return the active mode's name by the answer to the newest question, once; None without one."""
        answer, self._answer = self._answer, None
        return answer[1] if answer is not None and answer[0] == self._identity else None


REQUESTS: Final = tuple(topics.request(name) for name in topics.SERVICES)
RESPONSES: Final = tuple(topics.response(name) for name in topics.SERVICES)
COMMANDS: Final = (topics.LOW_COMMAND, *REQUESTS, topics.CLAIM)
"""Topics that a controller may write."""
TO_NETWORK: Final = (
    topics.LOW_STATE,
    topics.LOW_STATE_SLOW,
    topics.SPORT_STATE,
    topics.SPORT_STATE_SLOW,
    topics.WIRELESS,
    topics.LOW_COMMAND,
    topics.CLAIM,
    *RESPONSES,
)
"""Topics that pass from the robot's side; motor commands there come from other programs, such as sport
mode."""
READABLE: Final = (*TO_NETWORK, topics.BRIDGE)
_ASK_S: Final = 2.0
_RECEIVE_S: Final = 0.1
_JOIN_S: Final = 2.0
_MOST_MESSAGES: Final = 64
"""Messages checked before each check for silence; a flood of messages must not delay the damping."""


class Go2Bridge:
    """Carries a Go2's messages between its own network and another, and keeps it safe.

    Attributes:
        admission: Checks the commands; only the thread that calls :meth:`step` changes it.
        counts: Messages that passed, by topic.
        unsent: Messages that a transport did not take.
        latest_ns: Largest delay of a check for silence [ns].

    Args:
        robot: Topics of the robot (DDS); not open.
        network: Topics of its clients (Zenoh); not open.
        clock: The bridge's own time.
        config: Settings.
        state_check: Check of states that the bridge itself uses; all states are passed on unchanged.
        tell: Called with a line for the operator at each change.
    """

    def __init__(
        self,
        robot: TopicTransport,
        network: TopicTransport,
        clock: Clock,
        config: BridgeConfig | None = None,
        *,
        state_check: StateCheck = "strict",
        tell: Callable[[str], object] = lambda text: None,
    ) -> None:
        self._robot, self._network, self._clock = robot, network, clock
        self._config = config or BridgeConfig()
        self._strict, self._tell = state_check == "strict", tell
        self._session = secrets.randbits(64) | 1
        self.admission = Admission(
            self._config, CommandLimits(DESCRIPTION, self._config.effort_margin), self._session
        )
        self.counts: Counter[str] = Counter()
        self.unsent = self.latest_ns = 0
        self._encoder = LowCommandEncoder()
        self._damping = np.array(DESCRIPTION.passive_damping)
        self._frame: LowStateFrame | None = None
        self._services: ServiceClient | None = None
        self._question = ModeQuestion()
        self._foreign = 0
        self._told = self.admission.control
        self._status_ns = self._due_ns = 0
        self._end = threading.Event()
        self._failure: BaseException | None = None
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Join both networks; sends nothing to the motors.

        Raises:
            TransportError: One of them cannot be joined.
        """
        self._robot.declare(publish=COMMANDS, subscribe=TO_NETWORK)
        self._network.declare(publish=READABLE, subscribe=COMMANDS)
        self._robot.open()
        try:
            self._ask_who_moves_it()
            self._network.open()
        except BaseException:
            self._robot.close()
            raise
        self._status_ns = self._due_ns = self._clock.now_ns()
        self._thread = threading.Thread(target=self._pass_states, name="bridge states", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Damp the robot if the bridge or its controller has it, and leave both networks."""
        self._end.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_JOIN_S)
        if self.admission.control is not Control.IDLE:
            self.admission.take_charge("the bridge ends")
            self._say_status()
            end_ns = self._clock.now_ns() + round(self._config.leave_s * 1e9)
            while self._clock.now_ns() < end_ns:
                self._clock.sleep_until_ns(self._clock.now_ns() + self._period_ns)
                self._damp()
        self._network.close()
        self._robot.close()

    def step(self) -> None:
        """Serve until the next check for silence is due, and check.

        Raises:
            DealHwError: The transport to the robot failed.
        """
        while (left_ns := self._due_ns - self._clock.now_ns()) > 0:
            with contextlib.suppress(TransportTimeoutError):
                self._take(self._network.receive(left_ns * 1e-9))
        if self._failure is not None:
            raise self._failure
        # Received messages are always checked first, even when late: they show that the controller is not
        # silent.
        with contextlib.suppress(TransportTimeoutError):
            for _ in range(_MOST_MESSAGES):
                self._take(self._network.receive(0.0))
        now_ns = self._clock.now_ns()
        self.latest_ns = max(self.latest_ns, now_ns - self._due_ns)
        self._tick(now_ns)
        self._due_ns = max(self._due_ns + self._period_ns, now_ns)

    @property
    def _period_ns(self) -> int:
        return round(1e9 / self._config.rate_hz)

    # From the network to the robot.

    def _take(self, message: Message) -> None:
        now_ns = self._clock.now_ns()
        if message.channel == topics.LOW_COMMAND:
            command = self.admission.command(message, now_ns, self._frame)
            if command is not None:
                # Encoded again, so that other fields of a LowCmd (battery switch, lights) do not pass.
                self._to_robot(topics.LOW_COMMAND, self._encoder.encode(command))
        elif message.channel == topics.CLAIM:
            if read_note(message.payload, CLAIM_TEXTS) is not None:
                self._to_robot(message.channel, message.payload)
        elif self.admission.request(message, now_ns):
            self._to_robot(message.channel, message.payload)

    def _to_robot(self, topic: str, payload: bytes) -> None:
        self._send(self._robot, Message(topic, payload, self._clock.now_ns()))

    def _damp(self) -> None:
        zero = np.zeros(len(self._damping))
        self._to_robot(
            topics.LOW_COMMAND, self._encoder.encode(LowCommand(zero, zero, zero, self._damping, zero))
        )

    def _tick(self, now_ns: int) -> None:
        foreign, self._foreign = self._foreign, 0
        if foreign:
            self.admission.yield_to_robot_side(now_ns)
        if self.admission.control is Control.IDLE:
            self._ask_for_the_mode(now_ns)
        if self.admission.tick(now_ns):
            self._damp()
        if self.admission.control is not self._told:
            self._told = self.admission.control
            self._tell(f"{self._told.value}: {self.admission.reason}")
            self._status_ns = now_ns
        if now_ns >= self._status_ns:
            self._status_ns = now_ns + round(self._config.status_s * 1e9)
            self._say_status()

    def _ask_for_the_mode(self, now_ns: int) -> None:
        """Take the last answer, and ask again if it is time; an answer is never waited for."""
        side = self.admission.robot_side
        if (mode := self._question.answer()) is not None:
            side.answered(mode)
        if side.to_ask(now_ns):
            self._to_robot(topics.request(SWITCHER), self._question.ask(now_ns))

    def _say_status(self) -> None:
        payload = encode_note(self.admission.status())
        self._send(self._network, Message(topics.BRIDGE, payload, self._clock.now_ns()))

    def _send(self, side: TopicTransport, message: Message) -> None:
        try:
            side.send(message)
            self.counts[message.channel] += 1
        except (TransportError, FrameError):
            self.unsent += 1

    # From the robot to the network, in a thread of its own once the network is open.

    def _pass_states(self) -> None:
        try:
            while not self._end.is_set():
                self.pass_one(_RECEIVE_S)
        except BaseException as error:
            self._failure = error

    def pass_one(self, timeout_s: float) -> None:
        """Pass one message of the robot's side on, waiting for it at most so long [s]."""
        with contextlib.suppress(TransportTimeoutError):
            self._send(self._network, self._heard(self._robot.receive(timeout_s)))

    def _heard(self, message: Message) -> Message:
        """Note a message of the robot's side; return it in the clients' form."""
        if message.channel == topics.LOW_STATE:
            with contextlib.suppress(FrameError):
                self._frame = decode_low_state(message.payload, self._strict)
            stamp = Stamp(self._session, message.stamp_ns).encode()
            return Message(message.channel, message.payload, message.stamp_ns, stamp)
        if message.channel == topics.LOW_COMMAND:
            self._foreign += 1
        elif self._services is not None:
            self._services.take(message)
        else:
            self._question.take(message)
        return message

    # At the beginning.

    def _ask_who_moves_it(self) -> None:
        """Damp the robot at once if nobody controls it; an earlier bridge may have died during a walk.

        A robot whose own controller is released holds its last command for ever. If its own controller is
        active, or another program commands it, the bridge sends nothing.
        """
        self._services = ServiceClient(self._to_robot, self._pump, self._clock, WORDING)
        switcher = MotionSwitcher(self._services, self._clock)
        try:
            # A request before the end of discovery is lost, and repeated half a second later.
            self._listen(_ASK_S, lambda: self._frame is not None)
            mode = switcher.active(_ASK_S)
        except DealHwError as error:
            self._tell(
                f"the robot's active controller is unknown, so it is not damped yet: {error}. The bridge "
                "asks again twice a second"
            )
            return
        finally:
            self._services = None
        self.admission.robot_side.left(self._clock.now_ns(), mode=mode)
        if mode:
            self._tell(f"idle: the robot's own controller {mode!r} has it")
            return
        self._listen(self._config.listen_s, lambda: self._foreign > 0)
        if self._foreign:
            self.admission.robot_side.commanded(self._clock.now_ns())
            self._tell("idle: another program on the robot's side commands the motors")
            return
        self.admission.take_charge("the bridge started, and the robot's own controller is released")
        self._damp()

    def _listen(self, timeout_s: float, until: Callable[[], bool]) -> None:
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not until() and (left_ns := until_ns - self._clock.now_ns()) > 0:
            with contextlib.suppress(TransportTimeoutError):
                self._pump(left_ns * 1e-9)

    def _pump(self, timeout_s: float) -> None:
        self._heard(self._robot.receive(timeout_s))
