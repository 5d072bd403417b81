"""``deal_hw.stop``: make a robot passive, whoever of deal-hw commands it, and ask nothing."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Literal

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.control.process.claim import LocalClaim
from deal_hw.control.process.run_note import FoundRun, find_runs
from deal_hw.control.safety.passive import PassiveConfig, make_passive
from deal_hw.errors import ConfigurationError, DealHwError, PortBusyError
from deal_hw.ranges import Checked, Range
from deal_hw.robots import default_transport, same_machine
from deal_hw.robots.connect import claim_name, make_robot, wire_claim
from deal_hw.signals import taken
from deal_hw.transport import WireOptions
from deal_hw.workflows.options import FROM_PYTHON, from_settings, given, refuse
from deal_hw.workflows.robot_kinds import robot_kinds
from deal_hw.workflows.running.commander import who
from deal_hw.workflows.say import Say, silent
from deal_hw.workflows.unitree import Go2Link, UnitreeGoLink, UnitreeLink

OBEY_S = 5.0
"""How long a run may take after a request to end until its robot is passive [s]. It takes 0.25 s at most
(measured); a run that hangs longer is killed, its control process first."""
TAKE_OVER_S = 2.0
"""How long its supervisor may take after its control process was killed [s]."""
FREE_S = 5.0
"""How long the robot's own services may take to say who has it [s]."""
_POLL_S = 0.02


@dataclass(frozen=True, kw_only=True)
class StopSettings(Checked):
    """Make a robot passive at once, from any terminal: motor off, or damping. Nothing is asked.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """

    robot: str = field(kw_only=False)
    """The robot, such as go2."""

    port: str = ""
    """The robot's port, as for deploy. Without it, every run of this robot on this computer is stopped. With
    it, that robot alone, and also one that no run commands any more."""

    transport: str = ""
    """Transport to the robot; by default the robot's usual one."""

    seconds: Annotated[float, Range(0.5, 600, "s")] = 10.0
    """How long to repeat the passive command until the robot confirms it [s]."""

    say: Annotated[Say, FROM_PYTHON] = silent
    """From Python: called with messages; ``print`` shows them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.port:
            kind = type(self)
            names = [
                name for name in ("transport", "seconds", "state_check", "simulator") if hasattr(kind, name)
            ]
            wire = given(_wire(self), WireOptions())
            refuse(
                [*given(self, kind, names), *wire], "without --port only runs on this computer are stopped"
            )


@dataclass(frozen=True, kw_only=True)
class StopCartpoleSettings(StopSettings):
    """Make a cart-pole passive at once, from any terminal: motor off. Nothing is asked.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program has the robot. The exit code is 0 only if the
    robot confirmed that it is passive.
    """

    transport: Literal["serial", "can", "odrive", "dynamixel"] = "serial"
    """Transport to the cart-pole."""


@dataclass(frozen=True, kw_only=True)
class StopGo2Settings(Go2Link, StopSettings):
    """Make a Go2 passive at once, from any terminal: damping. Nothing is asked.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """


@dataclass(frozen=True, kw_only=True)
class StopB2Settings(UnitreeGoLink, StopSettings):
    """Make a B2 passive at once, from any terminal: damping. Nothing is asked.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """


@dataclass(frozen=True, kw_only=True)
class StopG1Settings(UnitreeLink, StopSettings):
    """Make a G1 passive at once, from any terminal: damping. Nothing is asked. On the floor it falls.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """


@dataclass(frozen=True, kw_only=True)
class StopH1Settings(UnitreeGoLink, StopSettings):
    """Make an H1 passive at once, from any terminal: damping. Nothing is asked. On the floor it falls.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """


STOP = robot_kinds(
    {
        "cartpole": StopCartpoleSettings,
        "go2": StopGo2Settings,
        "b2": StopB2Settings,
        "g1": StopG1Settings,
        "h1": StopH1Settings,
    },
    plain=StopSettings,
    legged=StopSettings,
    example="--port {port}",
)
"""The kinds of :func:`stop`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StopReport:
    """What was done.

    Attributes:
        robot: The robot.
        passive: Whether it confirmed that it is passive.
        words: What was found and done, and what to do if it is not passive.
    """

    robot: str
    passive: bool
    words: str

    @property
    def exit_code(self) -> int:
        """For the shell: 0 if the robot is passive, else 1."""
        return int(not self.passive)


@from_settings(STOP)
def stop(settings: StopSettings) -> StopReport:
    """Make a robot passive, as ``deal-hw stop``: motor off, or damping. Nothing is asked.

    ``deal-hw stop ROBOT --help`` describes the arguments: ``stop("go2", port="enp2s0")``. A run on this
    computer gets a request to end, and makes its robot passive itself: two writers would fight. A run that
    hangs is killed. If no run commands the robot, this program does it, and sends nothing while another
    program or the robot's own controller has it.

    Returns:
        Whether the robot confirmed that it is passive.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: An option would have no effect.
    """
    return run_stop(settings, settings.say)


def run_stop(settings: StopSettings, say: Say) -> StopReport:
    """Make the robot passive, as :func:`stop`, and say what happens meanwhile."""
    clock = MonotonicClock()
    # From here no signal ends it: it takes seconds.
    with contextlib.ExitStack() as open_notes, taken(lambda number: None):
        runs = [open_notes.enter_context(run) for run in find_runs()]
        runs = [run for run in runs if _is_meant(settings, run)]
        if not runs and not settings.port:
            words = (
                f"no run of {settings.robot} of this user on this computer, so nothing was requested and "
                "nothing sent. Give its port, as for deploy, to make it passive all the same (--port); runs "
                "of another user: sudo"
            )
            return StopReport(robot=settings.robot, passive=False, words=words)
        found = [_stopped(settings, run, clock, say) for run in runs] or [_directly(settings, clock, say)]
    words = "; ".join(report.words for report in found)
    return StopReport(robot=settings.robot, passive=all(report.passive for report in found), words=words)


def _is_meant(settings: StopSettings, run: FoundRun) -> bool:
    """Return whether a run commands this robot; a Go2 on a stand is a Go2."""
    if not same_machine(run.facts["robot"], settings.robot):
        return False
    return not settings.port or run.facts["claim"] == _claim(settings)


def _transport(settings: StopSettings) -> str:
    return settings.transport or default_transport(settings.robot)


def _wire(settings: StopSettings) -> WireOptions:
    """Return the network options; the usual ones of a robot that has none."""
    return settings.wire if isinstance(settings, UnitreeLink) else WireOptions()


def _claim(settings: StopSettings) -> str:
    return claim_name(_transport(settings), settings.port, _wire(settings))


def _stopped(settings: StopSettings, run: FoundRun, clock: Clock, say: Say) -> StopReport:
    """Tell a run to end; kill it, and do it here, if it does not make its robot passive."""
    name, facts = f"the run of process {run.pid}", run.facts
    if end_run(run, clock):
        words = f"{facts['robot']} is passive: {name} got a request to end, and the robot has confirmed it"
        return StopReport(robot=settings.robot, passive=True, words=words)
    alive = run.holders()
    if alive:
        words = (
            f"{name} got a request to end, but it does not, and may not be killed by this user: "
            "sudo deal-hw stop"
        )
        return StopReport(robot=settings.robot, passive=False, words=words)
    wire = WireOptions.from_json(facts["wire"])
    own = STOP.settings(
        facts["robot"],
        port=facts["port"],
        transport=facts["transport"],
        seconds=settings.seconds,
        **({"wire": wire} if wire != WireOptions() else {}),
        **facts["settings"],
    )
    say(f"{name} has ended without a passive robot; making it passive from here")
    return _directly(own, clock, say)


def end_run(run: FoundRun, clock: Clock) -> bool:
    """Have a run make its robot passive and end; return whether the robot confirmed it.

    A run that does not is killed: its control process first, so that its supervisor can act, then the
    supervisor.
    """
    for wait_s, number, pids in (
        (OBEY_S, signal.SIGTERM, lambda: [run.pid]),
        (TAKE_OVER_S, signal.SIGKILL, lambda: [pid for pid in run.holders() if pid != run.pid]),
        (TAKE_OVER_S, signal.SIGKILL, run.holders),
    ):
        _send(number, pids)
        end_ns = clock.now_ns() + round(wait_s * 1e9)
        while clock.now_ns() < end_ns:
            if run.passive:
                return True
            if not run.holders():
                return bool(run.passive)
            clock.sleep_until_ns(clock.now_ns() + round(_POLL_S * 1e9))
    return bool(run.passive)


def _send(number: int, pids: Callable[[], list[int]]) -> None:
    for pid in pids():
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)


def _claimed(resource: str, clock: Clock) -> LocalClaim:
    """Return the claim on a robot, which is taken here.

    A process that was killed keeps its claim until it is gone, which takes longest on a busy computer.

    Raises:
        PortBusyError: A run holds it for longer than a killed one can.
    """
    claim, end_ns = LocalClaim(resource), clock.now_ns() + round(TAKE_OVER_S * 1e9)
    while True:
        try:
            claim.acquire()
        except PortBusyError:
            if clock.now_ns() >= end_ns:
                raise
            clock.sleep_until_ns(clock.now_ns() + round(_POLL_S * 1e9))
        else:
            return claim


def _directly(settings: StopSettings, clock: Clock, say: Say) -> StopReport:
    """Make a robot passive that no run commands."""

    def report(passive: bool, words: str) -> StopReport:
        return StopReport(robot=settings.robot, passive=passive, words=words)

    transport = _transport(settings)
    own = settings.driver_settings() if isinstance(settings, UnitreeLink) else {}
    robot = make_robot(settings.robot, transport, settings.port, clock, _wire(settings), own)
    try:
        with contextlib.ExitStack() as held:
            held.callback(_claimed(_claim(settings), clock).release)
            claim = wire_claim(settings.robot, transport, settings.port, clock, who(), _wire(settings))
            if claim is not None:
                claim.acquire()
                held.callback(claim.release)
            held.enter_context(robot)
            robot.require_free(FREE_S)
            config = PassiveConfig(timeout_s=settings.seconds)
            if make_passive(robot, clock, config, progress=lambda text, silence_s: say(text)):
                return report(
                    True, f"{settings.robot} is passive: no run commanded it, and it has confirmed it"
                )
    except ConfigurationError:
        raise
    except DealHwError as error:
        return report(False, f"{settings.robot} was NOT made passive: {error}")
    return report(
        False,
        f"{settings.robot} did NOT confirm within {settings.seconds:g} s that it is passive. Use its remote "
        "or its switch. Over a bridge, the certificate must be a controller's",
    )
