"""Contract of a robot: its description, and methods to read and command it."""

from __future__ import annotations

import abc
from types import TracebackType
from typing import ClassVar

from typing_extensions import Self

from deal_hw.description import RobotDescription
from deal_hw.transport import Message
from deal_hw.types import JointCommand, RobotState


class Robot(abc.ABC):
    """A robot behind a transport. The constructor does no I/O; ``connect`` and ``disconnect`` are idempotent.

    A driver never waits longer than the given time and never retries silently. It does not judge commands;
    the safety filter does. It rounds values to the wire's resolution and returns the values actually sent.
    """

    description: ClassVar[RobotDescription]
    watchdog_s: ClassVar[float] = 0.0
    """The device itself switches its motors off after this time without a command [s]. 0: it holds the last
    command for ever; if the connection is cut or this computer fails, only the robot's side can stop it."""
    stopped_by: ClassVar[str] = "its power switch"
    """What still stops a robot that holds its last command, once no connection is left."""
    homes_by_motor: ClassVar[bool] = True
    """Whether ``home`` moves the motors by this driver's commands; a run must then end passive."""

    lowers: ClassVar[bool] = False
    """Whether :meth:`lower` keeps it from falling at its end."""

    condition: ClassVar[str] = ""
    """What an operator must see to before the robot is commanded, as a sentence that no sensor confirms; "":
    nothing."""
    condition_setting: ClassVar[str] = ""
    """Name of the driver's setting by which the operator confirms the condition."""

    listen_s: ClassVar[float] = 0.0
    """How long :meth:`require_free` listens for other commanders [s]."""

    notice: ClassVar[str] = ""
    """A note to the operator before a run of an unusual device; "": none."""

    @abc.abstractmethod
    def connect(self) -> None:
        """Open the transport and check that the right robot answers, in the right version.

        Raises:
            TransportError: The port is missing, busy or silent.
            WrongDeviceError: Another device answers.
            VersionMismatchError: The protocol versions differ.
        """

    @abc.abstractmethod
    def disconnect(self) -> None:
        """Close the transport. Does not send ``passive``; the caller sends it as the last command."""

    def reopen(self) -> None:  # noqa: B027
        """Open a lost transport again; the driver keeps what it knows about the robot.

        Raises:
            TransportError: It cannot be opened now; a later attempt may succeed.
        """

    @abc.abstractmethod
    def home(self, timeout_s: float) -> None:
        """Bring the robot to its start pose and wait for its arrival.

        Raises:
            TransportTimeoutError: It does not arrive in time.
        """

    @abc.abstractmethod
    def arm(self, timeout_s: float) -> None:
        """Let the motors follow commands; clears a latched watchdog.

        Raises:
            TransportTimeoutError: The robot does not confirm in time.
        """

    @abc.abstractmethod
    def read_state(self, timeout_s: float) -> RobotState:
        """Return the next state sample in order of arrival.

        Args:
            timeout_s: How long to wait [s]; 0 polls.

        Raises:
            TransportTimeoutError: No sample in time.
            TransportLostError: The robot vanished.
        """

    @abc.abstractmethod
    def send_command(self, command: JointCommand) -> JointCommand:
        """Send PD targets and return the values actually sent (rounded to the wire's resolution)."""

    def repeat(self) -> None:  # noqa: B027
        """Send the current command again, as ``description.repeat_rate_hz`` requires. Never waits."""

    def require_free(self, timeout_s: float) -> None:  # noqa: B027
        """Check that nobody else commands the robot; needed before ``passive`` without ``home`` and ``arm``.

        Does nothing by default: the port itself is exclusive.

        Args:
            timeout_s: How long the robot's services may take to answer [s].

        Raises:
            SafetyError: Another program or the robot's own controller has it; the text names it.
        """

    def other_commander(self, listen_s: float) -> str:
        """Listen for commands of other programs; return a sentence that names them, "" if none came.

        For who takes over from a run of deal-hw on this computer that cannot act: until then that run was the
        only commander, so :meth:`require_free`, which listens for longer and asks the robot's services, is
        not needed. Returns "" at once by default: the port itself is exclusive. Never raises.

        Args:
            listen_s: How long to listen [s].
        """
        return ""

    def lower(self, timeout_s: float) -> str:
        """Bring the robot to a pose in which it may go limp, before ``passive``.

        Does nothing by default. It is called at a planned end and at Ctrl-C. After a trip, another signal or
        a second Ctrl-C the robot is passive at once.

        Returns:
            "" if it may go limp now. Else what the operator must know: ``passive`` then holds the pose.

        Raises:
            TransportTimeoutError: It does not arrive in time.
            SafetyError: The robot reports an error on the way.
        """
        return ""

    def hand_back(self, timeout_s: float) -> None:  # noqa: B027
        """Return the robot to its own controller, after ``passive``; does nothing by default.

        Raises:
            TransportTimeoutError: The robot does not confirm in time.
        """

    @abc.abstractmethod
    def passive(self) -> None:
        """Send the least harmful command that this robot has (motor off, or damping). Never blocks."""

    @property
    def if_cut(self) -> str:
        """What the robot does if the connection is cut and no passive command reaches it."""
        if self.watchdog_s:
            return f"If the cable is cut, its own watchdog has stopped the motor after {self.watchdog_s:g} s"
        return (
            "If the connection is lost, it still holds its last command, with stiff motors: only "
            f"{self.stopped_by} can stop it"
        )

    @property
    def operator_stop(self) -> str:
        """Reason of a stop requested through the robot itself, such as by its remote; "": none."""
        return ""

    @property
    def fault(self) -> str:
        """A problem after which the run must not continue, such as another program's commands; "": none."""
        return ""

    @property
    @abc.abstractmethod
    def last_sequence(self) -> int:
        """Sequence number of the last command sent; -1 before the first."""

    @property
    @abc.abstractmethod
    def transport_errors(self) -> int:
        """Corrupt frames and gaps in the state's sequence numbers so far."""

    @abc.abstractmethod
    def fileno(self) -> int:
        """The descriptor of the open port, which a child process can inherit; -1: a child opens its own."""

    @abc.abstractmethod
    def take_wire(self) -> list[Message]:
        """Return and forget the raw messages since the last call; channels "rx" and "tx"."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()
