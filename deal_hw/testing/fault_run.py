"""Runs one fault in one phase of a run, in virtual time, and judges it by the emulated device.

A run has its real parts: driver, behaviour, safety module, control loop, and what a supervisor does after the
death of a control process. Only time, the wire and the robot are virtual.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from deal_hw.control.loop.after_death import passive_after
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport, Sink
from deal_hw.control.process import channel
from deal_hw.control.safety.passive import PassiveConfig
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.record import CycleRecord
from deal_hw.motions.behaviours import Behaviour
from deal_hw.motions.planned_end import ENDING_EVENT, PlannedEnd
from deal_hw.motions.posture import limited_for
from deal_hw.testing.fault_rows import (
    ARMING,
    AT_S,
    BOTH_KILLED,
    CONNECTING,
    CONTROL_KILLED,
    HOMING,
    KILLS,
    LAST,
    PLANNED_END,
    RUNNING,
    SUPERVISOR_KILLED,
    Expected,
    FaultRig,
    FaultRow,
    FaultTable,
    Lacks,
)
from deal_hw.testing.virtual_processes import Killed
from deal_hw.types import FloatArray

REACTION_S: Final = 0.005
"""From the death of a control process until its supervisor acts [s]."""
AFTER_S: Final = 1.0
"""How long the robot is watched after the run, and after the end of a fault [s]."""
PASSIVE_S: Final = 4.0
"""How long the passive command is repeated [s]."""
NEXT_S: Final = 1.0
"""How long the next run is watched from its first command on [s]."""
_SAMPLE_NS: Final = 5_000_000
_MEAN: Final = 10
"""Samples over which a speed is a mean: set-points come in steps."""
_MOVES: Final = 1e-3
"""A set-point that changes by less stands [rad or m]."""
_MOVED_NS: Final = 50_000_000
"""A set-point that changed within this time follows commands [ns]."""
_FASTER: Final = 1.3
"""A drive overshoots: this share of the speed of its set-point is allowed."""
_HELD: Final = 0.3
"""A held pose is this near to the measured one [rad or m]."""
_PHASES: Final = {
    channel.CONNECTING: CONNECTING,
    channel.HOMING: HOMING,
    channel.ARMING: ARMING,
    channel.RUNNING: RUNNING,
    channel.LOWERING: PLANNED_END,
    channel.MAKING_PASSIVE: LAST,
}


class Watch:
    """What the device does, whatever deal-hw reports.

    Attributes:
        first_ns: When its drives first followed a command [ns]; -1: never.
        last_ns: When they last did [ns]; -1: never.
        following: Whether they do now.

    Args:
        rig: The robot.
    """

    def __init__(self, rig: FaultRig) -> None:
        self._rig, self._table = rig, rig.table
        self.first_ns = self.last_ns = -1
        self.following = False
        self._times: list[int] = []
        self._positions: list[FloatArray] = []
        self._driven: list[bool] = []
        self._next_ns = 0
        self._index = list(rig.description.actuated_index)
        self._moved_ns = -_MOVED_NS
        self._target = self._target_now()
        rig.world.watchers.append(self._look)

    def _target_now(self) -> FloatArray | None:
        target = self._table.target
        return None if target is None else np.array(target(self._rig.device))

    def _look(self, now_ns: int) -> None:
        stiff = self._table.stiff(self._rig.device)
        if self._target is not None:
            target = self._target_now()
            if target is not None and np.abs(target - self._target).max() > _MOVES:
                self._target, self._moved_ns = target, now_ns
            stiff = stiff and now_ns - self._moved_ns < _MOVED_NS
        self.following = stiff
        if stiff:
            self.first_ns = now_ns if self.first_ns < 0 else self.first_ns
            self.last_ns = now_ns
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + _SAMPLE_NS
            self._times.append(now_ns)
            position = np.array(self._rig.device.true_position, dtype=float)
            self._positions.append(position[self._index])
            self._driven.append(stiff or self._target is not None)

    def forget(self) -> None:
        """Forget when the drives followed commands."""
        self.first_ns = self.last_ns = -1

    def fastest(self, begin_ns: int, end_ns: int, *, driven: bool = True) -> float:
        """Return the highest mean speed of a joint over 50 ms in a time [ns]; [rad/s or m/s].

        Args:
            begin_ns: Begin of the time.
            end_ns: Its end.
            driven: Look only at times at which the drives follow commands.
        """
        times = np.array(self._times)
        inside = (times >= begin_ns) & (times <= end_ns)
        if inside.sum() <= _MEAN:
            return 0.0
        at, time = np.array(self._positions)[inside], times[inside]
        speed = np.abs(at[_MEAN:] - at[:-_MEAN]).max(axis=1) / ((time[_MEAN:] - time[:-_MEAN]) * 1e-9)
        if driven:
            follows = np.array(self._driven)[inside]
            speed = speed[follows[:-_MEAN] & follows[_MEAN:]]
        return float(speed.max(initial=0.0))

    def off_target(self) -> float:
        """Return how far a held pose is from the true one [rad or m]; 0 without torque."""
        if self._target is None:
            return 0.0
        return float(np.abs(self._target - self._positions[-1]).max())


@dataclass(slots=True, kw_only=True)
class FaultEvidence:
    """What happened in a run with one fault; times in virtual ns, -1: never.

    Attributes:
        phase: The phase in which the fault began.
        fault_ns: When it began.
        return_ns: When it was mended.
        first_ns: When the drives first followed a command.
        last_ns: When they last did, until the end of watching.
        end_ns: End of watching.
        outcome: How the run ended; "killed" without a report.
        reason: Why.
        flags: Failed checks of the safety module.
        confirmed: Whether run or supervisor say that the robot is passive.
        after_return: Highest speed of a driven joint in the second after the fault's end [rad/s or m/s].
        off_target: How far a held pose is from the true one at the end [rad or m].
        next_outcome: How the next run ended; "" without one.
        next_reason: Why.
        next_speed: Highest speed of a driven joint in its first second [rad/s or m/s].
        next_fall: Highest speed of a joint just before: limbs may still fall, and are caught.
        next_began: Whether it commanded the robot.
    """

    phase: str = ""
    fault_ns: int = -1
    return_ns: int = -1
    first_ns: int = -1
    last_ns: int = -1
    end_ns: int = -1
    outcome: str = "killed"
    reason: str = ""
    flags: tuple[str, ...] = ()
    confirmed: bool = False
    after_return: float = 0.0
    off_target: float = 0.0
    next_outcome: str = ""
    next_reason: str = ""
    next_speed: float = 0.0
    next_fall: float = 0.0
    next_began: bool = False
    phases: list[str] = field(default_factory=list)

    @property
    def passive_s(self) -> float | None:
        """Time from the fault until the drives last followed a command [s]; None: they never did after it."""
        return (self.last_ns - self.fault_ns) * 1e-9 if 0 <= self.fault_ns < self.last_ns else None


class _Run:
    """One run, with a fault in one phase; "" for none."""

    def __init__(
        self,
        rig: FaultRig,
        make_behaviour: Callable[[PlannedEnd], Behaviour],
        sink: Sink,
        watch: Watch,
        fault: str = "",
        phase: str = "",
    ) -> None:
        self._rig, self._world, self._watch = rig, rig.world, watch
        self._fault, self._phase, self._sink = fault, phase, sink
        self.found = FaultEvidence()
        self._process, self._robot = rig.process()
        self._supervisor, self._other = rig.process()
        self._now, self._over = "", False
        end = PlannedEnd()
        behaviour = make_behaviour(end)
        self.loop = ControlLoop(
            self._robot,
            behaviour,
            Safety(limited_for(behaviour, self._robot.description)),
            self._process.clock,
            self._take,
            LoopConfig(duration_s=rig.seconds, passive=PassiveConfig(timeout_s=PASSIVE_S)),
            progress=self._progress,
            end=end,
        )

    def run(self) -> FaultEvidence:
        """Run it under its supervisor."""
        found, report = self.found, None
        # The supervisor connects first, and keeps the port.
        self._other.connect()
        with contextlib.suppress(Killed):
            report = self.loop.run()
        self._over = True
        if report is not None:
            self._note(report)
        if not found.confirmed and self._fault != BOTH_KILLED:
            now_ns = self._world.clock.now_ns()
            self._world.sleep_until_ns(now_ns + round(REACTION_S * 1e9))
            config = PassiveConfig(timeout_s=1.0 if report is not None else PASSIVE_S)
            found.confirmed = passive_after(self._now, self._other, self._supervisor.clock, config)
        if self._fault == BOTH_KILLED:
            self._supervisor.kill()
        else:
            self._other.disconnect()
        return found

    def _note(self, report: LoopReport) -> None:
        found = self.found
        found.outcome, found.reason, found.flags = report.outcome.value, report.reason, report.flags
        found.confirmed = report.passive_confirmed

    def _progress(self, phase: str, silence_s: float) -> None:
        self._process.check()
        name = phase.partition(":")[0]
        if name != self._now:
            self._now = name
            if name in _PHASES:
                self._enter(_PHASES[name])

    def _take(self, record: CycleRecord) -> bool:
        if any(event.kind == ENDING_EVENT for event in record.events):
            self._enter(PLANNED_END)
        return self._sink(record)

    def _enter(self, phase: str) -> None:
        found, table = self.found, self._rig.table
        if phase in found.phases:
            return
        found.phases.append(phase)
        if phase != self._phase:
            return
        row = table.all_rows()[self._fault]
        assert isinstance(row, FaultRow)
        usual = table.phases.get(phase, AT_S[phase])
        after_s = row.at_s.get(phase, AT_S[phase] if isinstance(usual, Lacks) else usual)
        if not after_s:
            self._begin()
        else:
            self._world.at(self._world.clock.now_ns() + round(after_s * 1e9), self._begin)

    def _begin(self) -> None:
        """Make the fault."""
        found, row = self.found, self._rig.table.all_rows()[self._fault]
        assert isinstance(row, FaultRow)
        if self._over:
            return
        found.fault_ns, found.phase = self._world.clock.now_ns(), found.phases[-1]
        if row.lasts_s is not None:
            self._world.at(found.fault_ns + round(row.lasts_s * 1e9), self._mend_in_time)
        if row.begin is not None:
            row.begin(self._rig)
        if self._fault in (CONTROL_KILLED, BOTH_KILLED):
            self._process.kill()
            raise Killed
        if self._fault == SUPERVISOR_KILLED:
            self.loop.request_stop("the supervisor died")

    def _mend_in_time(self) -> None:
        """Make the robot sound when the fault has lasted for its time."""
        row, now_ns = self._rig.table.all_rows()[self._fault], self._world.clock.now_ns()
        assert isinstance(row, FaultRow) and row.lasts_s is not None
        lasts_ns, first_ns = round(row.lasts_s * 1e9), self._watch.first_ns
        due_ns = (now_ns if first_ns < 0 else first_ns) + lasts_ns
        if row.from_first_command and not self._over and now_ns < due_ns:
            self._world.at(due_ns, self._mend_in_time)
        else:
            self._mend()

    def _mend(self) -> None:
        found, row = self.found, self._rig.table.all_rows()[self._fault]
        assert isinstance(row, FaultRow)
        if found.return_ns < 0:
            found.return_ns = self._world.clock.now_ns()
            if row.mend is not None:
                row.mend(self._rig)

    def mend(self) -> None:
        """Make the robot sound, if it is not."""
        self._mend()


def _keep(record: CycleRecord) -> bool:
    return True


def run_sound(rig: FaultRig, sink: Sink = _keep) -> FaultEvidence:
    """Run the motion without a fault."""
    watch = Watch(rig)
    found = _Run(rig, rig.make_behaviour, sink, watch).run()
    found.first_ns, found.last_ns = watch.first_ns, watch.last_ns
    return found


def run_fault(rig: FaultRig, fault: str, phase: str, sink: Sink = _keep) -> FaultEvidence:
    """Run with a fault that begins in a phase, watch the robot, and run it once more when it is sound.

    Args:
        rig: The robot, just switched on.
        fault: Name of the fault.
        phase: Name of the phase.
        sink: Takes the records of the run.
    """
    world, watch = rig.world, Watch(rig)
    one = _Run(rig, rig.make_behaviour, sink, watch, fault, phase)
    found = one.run()
    row = rig.table.all_rows()[fault]
    assert isinstance(row, FaultRow)
    until_ns = world.clock.now_ns()
    if row.lasts_s is not None and found.fault_ns >= 0:
        until_ns = max(until_ns, found.fault_ns + round(row.lasts_s * 1e9) + 1)
    world.sleep_until_ns(until_ns + round(AFTER_S * 1e9))
    found.first_ns, found.last_ns, found.end_ns = watch.first_ns, watch.last_ns, world.clock.now_ns()
    found.off_target = watch.off_target()
    if found.return_ns >= 0:
        found.after_return = watch.fastest(found.return_ns, found.return_ns + round(AFTER_S * 1e9))
    one.mend()
    cell = row.cells[phase]
    if isinstance(cell, Expected) and cell.end in ("passive", "passive or over", "holds"):
        _run_next(rig, watch, found)
    return found


def _run_next(rig: FaultRig, watch: Watch, found: FaultEvidence) -> None:
    """Run the robot once more for a second, and note how fast it moves."""
    world = rig.world
    held = watch.following
    watch.forget()
    following = _Run(rig, rig.make_next, _keep, watch)
    begun: list[int] = []

    def look(now_ns: int) -> None:
        if watch.first_ns >= 0 and not begun and (not held or following.found.phases):
            begun.append(now_ns)
            world.at(now_ns + round(NEXT_S * 1e9), lambda: following.loop.request_stop("seen enough"))

    world.watchers.append(look)
    after = following.run()
    world.watchers.remove(look)
    found.next_outcome, found.next_reason, found.next_began = after.outcome, after.reason, bool(begun)
    if begun:
        found.next_speed = watch.fastest(begun[0], begun[0] + round(NEXT_S * 1e9))
        found.next_fall = watch.fastest(begun[0] - 2 * _MEAN * _SAMPLE_NS, begun[0], driven=False)


def complaints(found: FaultEvidence, phase: str, cell: Expected, table: FaultTable) -> list[str]:
    """Return what is not as expected, as sentences; none if all is."""
    if found.fault_ns < 0:
        return [f"the run did not come to the phase {phase!r} ({found.outcome}: {found.reason})"]
    wrong: list[str] = []
    if found.phase != phase:
        wrong.append(f"the fault came in the phase {found.phase!r}, not in {phase!r}")
    over = found.outcome == "finished"
    untouched = found.first_ns < 0
    match cell.end:
        case "untouched":
            if not untouched:
                wrong.append("the drives followed commands")
            if over:
                wrong.append("the run finished")
        case "goes on":
            if not over:
                wrong.append(f"the run did not finish: {found.reason}")
        case "holds":
            if found.last_ns < found.fault_ns and table.target is None:
                wrong.append("the drives do not hold the last command")
        case "passive" | "passive or over":
            if over and cell.end == "passive":
                wrong.append("the run finished")
            wrong += _late(found, cell)
    if cell.end == "goes on" and found.last_ns > found.end_ns - AFTER_S * 0.5e9:
        wrong.append("the drives still follow commands after the run")
    if cell.end.startswith("passive"):
        if not over and found.after_return > _FASTER * table.start_speed:
            wrong.append(f"after the fault's end a joint is driven at {found.after_return:.2f} rad/s or m/s")
        if found.off_target > _HELD:
            wrong.append(f"the held pose is {found.off_target:.2f} rad or m from the true one")
    if found.next_outcome and (found.next_began or not table.may_fall):
        wrong += _next(found, table)
    return wrong


def driven_s(found: FaultEvidence, cell: Expected) -> float:
    """Return how long drives followed commands after the time from which a cell counts [s]; 0: not at all."""
    since = {"fault": found.fault_ns, "return": found.return_ns, "first command": found.first_ns}[cell.since]
    return max(0.0, (found.last_ns - since) * 1e-9) if found.last_ns >= 0 else 0.0


def _late(found: FaultEvidence, cell: Expected) -> list[str]:
    passive_s = driven_s(found, cell)
    if passive_s > cell.within_s:
        still = found.end_ns - found.last_ns < AFTER_S * 0.5e9
        seen = "still follow commands" if still else f"followed commands for {passive_s:.2f} s"
        return [f"after the {cell.since} the drives {seen}; allowed: {cell.within_s:g} s"]
    return []


def _next(found: FaultEvidence, table: FaultTable) -> Sequence[str]:
    wrong = []
    if not found.next_began:
        wrong.append(f"the next run does not begin: {found.next_reason}")
    if found.next_speed > _FASTER * max(table.start_speed, found.next_fall):
        wrong.append(f"the next run begins with {found.next_speed:.2f} rad/s or m/s")
    return wrong


__all__ = ["KILLS", "FaultEvidence", "FaultRig", "Watch", "complaints", "driven_s", "run_fault", "run_sound"]
