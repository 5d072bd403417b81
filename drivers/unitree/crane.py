"""The driver of a humanoid that hangs on a crane: the operator's word, and what its motors report."""

from __future__ import annotations

import abc
from typing import ClassVar, Final, TypeVar

from deal_hw.clock import Clock
from deal_hw.drivers.unitree.robot import StateFrame, UnitreeRobot
from deal_hw.drivers.unitree.tick_stream import TickStream
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.errors import SafetyError
from deal_hw.transport import TopicTransport

STOP_BUTTONS: Final = "L2+B"
CONTROLLER: Final = "own controller"
RELEASED: Final = (
    "hang the robot on a crane first: deal-hw releases this controller when it arms, and a robot that is "
    "released while it stands falls"
)
LEVEL: Final = "let the crane hold it level"
F = TypeVar("F", bound=StateFrame)


def hung(kind: str) -> str:
    """Return what must be true of a robot of this kind before a run."""
    return (
        f"the {kind} must hang on a crane, with its feet free and nobody in reach of its limbs: at the end "
        "of the run, and at every stop, its joints are only damped, and on the floor it would fall"
    )


def on_crane(kind: str) -> str:
    """Return what the operator of a robot of this kind must know."""
    return (
        f"note: the {kind} stays on its crane: the run moves its limbs in the air and does not walk, and it "
        "ends with damped joints (kp 0), in which they sink. The robot holds its last command for ever: if "
        "both processes of deal-hw are killed, or the connection stays lost, only its remote (L2 and R2: "
        "damping) or its power switch can stop it; keep them in reach"
    )


def wording(name: str) -> Wording:
    """Return what messages of the shared driver say of a robot with this name."""
    free = "press L2 and R2 on its remote while it hangs (debug mode: its joints are damped)"
    return Wording(
        name=name,
        free=free,
        quiet=free,
        off="if it is the robot's own controller, press L2 and R2 on its remote while it hangs (debug mode)",
    )


class HungRobot(UnitreeRobot[F], abc.ABC):
    """A humanoid of Unitree at its motors' own level, hung on a crane.

    No sensor tells whether it hangs, so the operator must confirm it. ``home`` moves nothing: it releases the
    robot's own controller, and the safety filter then leads the joints from where they hang to the first
    targets.

    Args:
        transport: Topics of the robot.
        clock: The clock of the transport's stamps.
        stop_buttons: Buttons of the remote that stop a run while held together; "" for none.
        stream: Selects the valid and new states.
        hung_on_crane: Whether the operator confirmed that the robot hangs on a crane.
    """

    stopped_by: ClassVar[str] = "its own remote (L2 and R2: damping) or its power switch"
    condition: ClassVar[str]
    condition_setting: ClassVar[str] = "hung_on_crane"
    notice: ClassVar[str]

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        stop_buttons: str,
        stream: TickStream[F],
        *,
        hung_on_crane: bool,
    ) -> None:
        self._hung = hung_on_crane
        super().__init__(transport, clock, stop_buttons, stream)

    @abc.abstractmethod
    def _frame_fault(self, frame: F) -> str:
        """Return what a state reports that must end the run; "" if nothing."""

    def _before_release(self) -> None:
        if not self._hung:
            raise SafetyError(f"{self.description.name}: {self.condition}. Confirm it by --hung-on-crane")

    def _after_release(self) -> None:
        if self._frame is not None and (wrong := self._frame_fault(self._frame)):
            raise SafetyError(wrong)

    def _notice_frame(self, frame: F) -> None:
        if self._armed and not self._fault:
            self._fault = self._frame_fault(frame)
