"""What a robot's fault table is made of: faults, phases of a run, and the end that each cell must have.

A driver's package has a table (``fault_rows.py``), without code of tests. A table has only what differs from
:func:`usual_rows`. A fault or a phase that a robot lacks says why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from deal_hw.description import RobotDescription
from deal_hw.motions.behaviours import Behaviour
from deal_hw.motions.planned_end import PlannedEnd
from deal_hw.robot import Robot
from deal_hw.testing.joint_faults import JointFaults
from deal_hw.testing.virtual_processes import Process, World

CONTROL_KILLED, SUPERVISOR_KILLED, BOTH_KILLED = "control process killed", "supervisor killed", "both killed"
CUT, FROZEN, EXCHANGED = "cable cut and back", "reading frozen", "readings exchanged"
LIMP, CONTROLLER_OFF, FOREIGN = "drives limp and back", "controller off and on", "foreign writer"
DUPLICATE, OUT_OF_RANGE = "duplicate id", "reading out of range"
CLOCK_AHEAD, CLOCK_BACK = "clock jumps ahead", "clock jumps back"
KILLS: Final = (CONTROL_KILLED, SUPERVISOR_KILLED, BOTH_KILLED)
FAULTS: Final = (
    *KILLS,
    CUT,
    FROZEN,
    EXCHANGED,
    LIMP,
    CONTROLLER_OFF,
    FOREIGN,
    DUPLICATE,
    OUT_OF_RANGE,
    CLOCK_AHEAD,
    CLOCK_BACK,
)
"""The faults that each robot has, or says why not."""
CONNECTING, HOMING, ARMING, RUNNING, PLANNED_END, LAST = (
    "connecting",
    "homing",
    "arming",
    "running",
    "planned end",
    "after the last command",
)
PHASES: Final = (CONNECTING, HOMING, ARMING, RUNNING, PLANNED_END, LAST)
"""Phases of a run in which a fault begins. A planned end is the motion to a rest pose."""

SOON_S: Final = 0.15
"""Time to notice at once what ends a run, to send the passive command, and for it to act [s]."""
RETURN_S: Final = 1.0
"""Time from a cable's return to the passive robot [s]: the port is opened every 0.5 s."""
SHOWS_S: Final = 3.0
"""Time in which a joint that does not follow is noticed in a motion of all joints [s]."""
EARLY_S: Final = 4.0
"""The same where it failed before the motion or as it began: a motion begins with little [s]."""
WHOLE_S: Final = 12.0
"""Longer than a run of a table [s]."""
CUT_S: Final = 1.5
"""How long a cable is cut [s]: longer than arming waits for a state."""

End = Literal["passive", "passive or over", "untouched", "goes on", "holds"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Expected:
    """How a run with a fault must end, judged by the device.

    Attributes:
        end: "passive": the drives follow no command any more. "passive or over": the same, or the run comes
            to its end as without the fault, because it does not show before. "untouched": no drive ever
            followed a command. "goes on": the run finishes. "holds": the drives hold the last command for
            ever, because nobody is left who could end it.
        within_s: Longest time until the drives are passive [s].
        since: From when: the fault, the end of the fault, or the first command of the run.
        why: What the reader cannot guess.
    """

    end: End
    within_s: float = 0.0
    since: Literal["fault", "return", "first command"] = "fault"
    why: str = ""


@dataclass(frozen=True, slots=True)
class Lacks:
    """A combination that a robot lacks, and why."""

    why: str


WAITS: Final = Expected(end="goes on", why="who connects waits for states, longer than the fault lasts")
NO_TIME_YET: Final = Expected(end="goes on", why="no time is known before the first state")
NOT_ARMED: Final = Expected(end="goes on", why="times count from the arming on")
Act = Callable[["FaultRig"], None]
Cell = Expected | Lacks


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultRow:
    """One fault of one robot.

    Attributes:
        begin: Makes the fault on the emulated robot or its wire; None for a killed process.
        mend: Makes the robot sound again.
        lasts_s: How long until it is mended by itself while the run goes on [s]; None: it stays, and is
            mended before the next run.
        from_first_command: That time counts from the first command on, if the fault began before.
        cells: The end in each phase.
        at_s: When it begins, after the phase's own begin [s], where it is not :data:`AT_S`.
    """

    begin: Act | None = None
    mend: Act | None = None
    lasts_s: float | None = None
    from_first_command: bool = False
    cells: Mapping[str, Cell]
    at_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultTable:
    """The faults of one robot, and how its emulated device is judged.

    Attributes:
        name: The robot and its wire.
        stiff: Returns whether the device's drives follow commands now.
        target: Of a robot that holds its pose when it is passive: returns the set-points of the drives,
            (A,). Its drives follow commands while these move. None: passive drives have no torque.
        homes_by_motor: Whether homing moves the motors.
        watchdog_s: The device stops its motors after this time without a command [s]; 0: never.
        start_speed: Fastest joint in the first second of a run, and after a fault [rad/s or m/s].
        phases: When the default fault begins in a phase, or why there is no such phase.
        may_fall: Whether it may fall when it is damped, and lie so that the next run is refused before any
            command.
        joint: The joint whose reading is wrong; "": the first one with a drive.
        may_not_show: Faults that its motion may be too small to show, and why; the run may then finish.
        rows: What differs from the usual rows, by fault.
        cells: Single cells that differ from their rows, by fault and phase.
    """

    name: str
    stiff: Callable[[Any], bool]
    target: Callable[[Any], Any] | None = None
    homes_by_motor: bool = True
    watchdog_s: float = 0.0
    start_speed: float
    phases: Mapping[str, float | Lacks] = field(default_factory=dict)
    may_fall: bool = False
    joint: str = ""
    may_not_show: Mapping[str, str] = field(default_factory=dict)
    rows: Mapping[str, FaultRow | Lacks]
    cells: Mapping[tuple[str, str], Expected] = field(default_factory=dict)

    def all_rows(self) -> dict[str, FaultRow | Lacks]:
        """Return the rows of every fault, the usual ones first."""
        rows = {**usual_rows(self), **self.rows}
        for (fault, phase), cell in self.cells.items():
            row = rows[fault]
            assert isinstance(row, FaultRow)
            rows[fault] = replace(row, cells={**row.cells, phase: cell})
        return rows

    def combinations(self) -> dict[tuple[str, str], Cell]:
        """Return what each fault in each phase must end in, or why the robot lacks it."""
        found: dict[tuple[str, str], Cell] = {}
        for fault, row in self.all_rows().items():
            for phase in PHASES:
                absent = next((one for one in (row, self.phases.get(phase)) if isinstance(one, Lacks)), None)
                found[fault, phase] = absent or row.cells[phase]  # type: ignore[union-attr]
        return found


@dataclass(slots=True, eq=False, kw_only=True)
class FaultRig:
    """An emulated robot that was just switched on.

    Attributes:
        table: Its faults.
        description: The robot.
        world: Its virtual wire and time.
        topics: Whether its wire has topics.
        make_robot: Returns a driver of another process, over its wire and clock.
        make_behaviour: Returns the motion of a run.
        make_next: Returns that of the next run, which holds the start pose.
        seconds: Longest time of a run [s].
    """

    table: FaultTable
    description: RobotDescription
    world: World
    topics: bool
    make_robot: Callable[[Any, Any], Robot]
    make_behaviour: Callable[[PlannedEnd], Behaviour]
    make_next: Callable[[PlannedEnd], Behaviour]
    seconds: float

    @property
    def device(self) -> Any:
        """The emulated device."""
        return self.world.wire.device

    def process(self) -> tuple[Process, Robot]:
        """Return a new process, and its driver."""
        process = Process(self.world, topics=self.topics)
        return process, self.make_robot(process.wire, process.clock)


AT_S: Final[Mapping[str, float]] = {
    CONNECTING: 0.0,
    HOMING: 0.1,
    ARMING: 0.001,
    RUNNING: 0.7,
    PLANNED_END: 0.3,
    LAST: 0.0,
}
"""When a fault begins, after the phase's own begin [s]."""


def joint_fault(**times: float) -> Act:
    """Return what gives the joints a fault now; the arguments are fields of :class:`JointFaults`."""

    def act(rig: FaultRig) -> None:
        device = rig.device
        device.joint_faults.give(JointFaults(faulty_joint=rig.table.joint, **times), device.device_ns)

    return act


def sound_joints(rig: FaultRig) -> None:
    """Make the joints sound."""
    rig.device.joint_faults.give(JointFaults(), rig.device.device_ns)


def in_phases(cells: Mapping[str, Cell], **more: Cell) -> dict[str, Cell]:
    """Return cells with others in their place; a phase's name is written with "_" for " "."""
    return {**cells, **{name.replace("_", " "): cell for name, cell in more.items()}}


def killed_cells(*, homes_by_motor: bool, within_s: float = SOON_S) -> dict[str, Cell]:
    """Return the cells of a fault that is noticed at once, and ends a run of which the robot takes note.

    Args:
        homes_by_motor: Whether homing moves the motors.
        within_s: Longest time until the drives are passive [s].
    """
    untouched, passive = Expected(end="untouched"), Expected(end="passive", within_s=within_s)
    return {
        **dict.fromkeys(PHASES, passive),
        CONNECTING: untouched,
        HOMING: passive if homes_by_motor else untouched,
        LAST: Expected(end="passive or over", within_s=within_s),
    }


def returned_cells(*, homes_by_motor: bool, within_s: float = RETURN_S) -> dict[str, Cell]:
    """Return the cells of a fault under which nothing can be made passive before it ends; see above."""
    untouched = Expected(end="untouched")
    passive = Expected(end="passive", within_s=within_s, since="return")
    return {
        **dict.fromkeys(PHASES, passive),
        CONNECTING: untouched,
        HOMING: passive if homes_by_motor else untouched,
        LAST: Expected(end="passive or over", within_s=within_s, since="return"),
    }


def usual_rows(table: FaultTable) -> dict[str, FaultRow | Lacks]:
    """Return the rows that every robot has unless its table says otherwise."""
    untouched, passive = Expected(end="untouched"), Expected(end="passive", within_s=SOON_S)
    by_motor = table.homes_by_motor
    killed = killed_cells(homes_by_motor=by_motor)
    alone: Cell = (
        Expected(end="passive", within_s=table.watchdog_s + SOON_S, why="its own watchdog")
        if table.watchdog_s
        else Expected(end="holds", why="nobody is left who could damp it")
    )
    both = {**dict.fromkeys(PHASES, alone), CONNECTING: untouched, HOMING: alone if by_motor else untouched}
    back = (
        Expected(end="passive", within_s=table.watchdog_s + SOON_S, why="its own watchdog")
        if table.watchdog_s
        else Expected(end="passive", within_s=RETURN_S, since="return")
    )
    cut = {
        **dict.fromkeys(PHASES, back),
        CONNECTING: untouched,
        HOMING: back if by_motor else untouched,
        LAST: replace(back, end="passive or over"),
    }
    shows = Expected(end="passive", within_s=SHOWS_S)
    later = Expected(end="passive", within_s=EARLY_S, since="first command")
    too_late = Expected(end="passive or over", within_s=EARLY_S)
    reading: dict[str, Cell] = {
        CONNECTING: later,
        HOMING: Expected(end="passive", within_s=EARLY_S) if by_motor else later,
        ARMING: later,
        RUNNING: shows,
        PLANNED_END: too_late,
        LAST: Expected(end="passive or over", within_s=SOON_S),
    }

    def of_joints(fault: str) -> dict[str, Cell]:
        why = table.may_not_show.get(fault)
        over = Expected(end="passive or over", within_s=WHOLE_S, why=why or "")
        return reading if why is None else {**dict.fromkeys(PHASES, over), LAST: reading[LAST]}

    refused = Expected(end="untouched", why="the pose is refused before anything moves")
    outside = {**killed, HOMING: passive if by_motor else refused, CONNECTING: refused}
    return {
        CONTROL_KILLED: FaultRow(cells=killed),
        SUPERVISOR_KILLED: FaultRow(cells=killed),
        BOTH_KILLED: FaultRow(cells=both),
        CUT: FaultRow(begin=cut_wire, mend=mend_wire, lasts_s=CUT_S, cells=cut),
        FROZEN: FaultRow(begin=joint_fault(frozen_after_s=0.0), mend=sound_joints, cells=of_joints(FROZEN)),
        EXCHANGED: FaultRow(
            begin=joint_fault(exchanged_after_s=0.0), mend=sound_joints, cells=of_joints(EXCHANGED)
        ),
        LIMP: FaultRow(
            begin=joint_fault(limp_after_s=0.0, limp_s=1e6),
            mend=sound_joints,
            lasts_s=2.0,
            from_first_command=True,
            cells=of_joints(LIMP),
        ),
        OUT_OF_RANGE: FaultRow(begin=joint_fault(out_of_range_after_s=0.0), mend=sound_joints, cells=outside),
    }


def cut_wire(rig: FaultRig) -> None:
    """Cut the cable: a port vanishes with an error, a network is silent."""
    rig.world.cut = True
    if not rig.topics:
        rig.world.wire.unplug()


def mend_wire(rig: FaultRig) -> None:
    """Put the cable back."""
    rig.world.cut = False
    if not rig.topics:
        rig.world.wire.plug_in()
