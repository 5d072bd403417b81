"""Commands that an emulated robot received, with times. Tests compute the time from a fault to damping."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

from deal_hw.drivers.unitree.motor_command import MotorCommand

STIFF, DAMPING, OFF = "stiff", "damping", "off"
_MOST_CHANGES: Final = 2000


def kind_of(command: MotorCommand) -> str:
    """Return the kind of a command: ``stiff`` (gain or feed-forward), ``damping`` (kd alone) or ``off``."""
    if not command.mode.any():
        return OFF
    if command.stiffness.any() or command.effort.any():
        return STIFF
    return DAMPING if command.damping.any() else OFF


@dataclass(slots=True)
class FaultRecord:
    """One fault, and the user's commands after it.

    Attributes:
        name: The fault.
        begin_ms: Its beginning [device ms].
        begin_host_ns: Host clock then [ns]; in virtual time the device clock.
        last_stiff_ms: Last stiff command since, as received [device ms].
        first_damping_ms: First command since whose kp are all 0, as received [device ms].
    """

    name: str
    begin_ms: int
    begin_host_ns: int = 0
    last_stiff_ms: int | None = None
    first_damping_ms: int | None = None


class CommandLog:
    """Logs the user's commands, without those of sport mode.

    Attributes:
        accepted: Number of accepted commands.
        refused: Number of refused commands: corrupt, wrong level, not finite.
        last_refusal: Reason of the last refusal.
        first_stiff_ms: First stiff command [device ms].
        last_stiff_ms: Last stiff command [device ms].
        last_ms: Last command of any kind [device ms].
        largest_gap_ms: Longest time without a command while stiff [ms].
        faults: The faults that were made.
        changes: Changes of the kind of command: device ms, host ns, kind; the first 2000.
        requests: Requests to the robot's services: device ms, host ns, service; the first 2000.
    """

    def __init__(self) -> None:
        self.accepted = self.refused = 0
        self.last_refusal = ""
        self.first_stiff_ms: int | None = None
        self.last_stiff_ms: int | None = None
        self.last_ms: int | None = None
        self.largest_gap_ms = 0
        self.faults: list[FaultRecord] = []
        self.changes: list[tuple[int, int, str]] = []
        self.requests: list[tuple[int, int, str]] = []
        self._kind = ""

    def ask(self, service: str, now_ms: int, host_ns: int) -> None:
        """Note a request to a service of the robot."""
        if len(self.requests) < _MOST_CHANGES:
            self.requests.append((now_ms, host_ns, service))

    def refuse(self, reason: str) -> None:
        """Note a refused command."""
        self.refused += 1
        self.last_refusal = reason

    def accept(self, command: MotorCommand, now_ms: int, host_ns: int) -> None:
        """Note an accepted command."""
        kind = kind_of(command)
        if self._kind == STIFF and self.last_ms is not None:
            self.largest_gap_ms = max(self.largest_gap_ms, now_ms - self.last_ms)
        if kind != self._kind and len(self.changes) < _MOST_CHANGES:
            self.changes.append((now_ms, host_ns, kind))
        self.accepted += 1
        self._kind, self.last_ms = kind, now_ms
        if kind == STIFF:
            self.last_stiff_ms = now_ms
            if self.first_stiff_ms is None:
                self.first_stiff_ms = now_ms
        for fault in self.faults:
            if kind == STIFF:
                fault.last_stiff_ms = now_ms
            elif fault.first_damping_ms is None:
                fault.first_damping_ms = now_ms

    def begin(self, fault: str, now_ms: int, host_ns: int = 0) -> None:
        """Note the beginning of a fault."""
        self.faults.append(FaultRecord(fault, now_ms, host_ns))

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "accepted": self.accepted,
            "refused": self.refused,
            "last_refusal": self.last_refusal,
            "first_stiff_ms": self.first_stiff_ms,
            "last_stiff_ms": self.last_stiff_ms,
            "last_ms": self.last_ms,
            "last_kind": self._kind or None,
            "largest_gap_ms": self.largest_gap_ms,
            "changes": [list(change) for change in self.changes],
            "requests": [list(request) for request in self.requests],
            "faults": [asdict(fault) for fault in self.faults],
        }
