"""Makes one robot passive: by the runs that command it, or from here where there is none.

Only the standard library and the table of robots are imported with this module: to ask a run to end needs no
more. What reaches a robot is imported where no run does it, after the runs were asked.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.control.process.claim import LocalClaim
from deal_hw.control.process.realtime import hurry_the_dying
from deal_hw.control.process.run_end import TAKE_OVER_S, RunEnd
from deal_hw.control.process.run_note import FoundRun, find_runs
from deal_hw.errors import ConfigurationError, DealHwError, PortBusyError
from deal_hw.robots import default_transport, same_machine
from deal_hw.robots.connect import claim_name, make_robot, wire_claim
from deal_hw.signals import taken
from deal_hw.transport import WireOptions
from deal_hw.workflows.running.commander import OTHERS_S, who
from deal_hw.workflows.say import Say
from deal_hw.workflows.stopping.settings import STOP, StopSettings, wire_of
from deal_hw.workflows.unitree import UnitreeLink

if TYPE_CHECKING:
    from deal_hw.robot import Robot

FREE_S = 5.0
"""How long the robot's own services may take to say who has it [s]."""
_POLL_S = 0.01


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
        ends = [RunEnd(run, clock) for run in runs]
        for end in ends:
            end.request()
        found = [
            _stopped(settings, run, end.wait(), clock, say) for run, end in zip(runs, ends, strict=True)
        ] or [_directly(settings, clock, say)]
    words = "; ".join(report.words for report in found)
    return StopReport(robot=settings.robot, passive=all(report.passive for report in found), words=words)


def _is_meant(settings: StopSettings, run: FoundRun) -> bool:
    """Return whether a run commands this robot; a Go2 on a stand is a Go2."""
    if not same_machine(run.facts["robot"], settings.robot):
        return False
    if not settings.port:
        return True
    with contextlib.suppress(DealHwError):
        # Without --transport that of the run: a robot.yaml, which names the usual one, takes long to read.
        transport = settings.transport or run.facts["transport"]
        return claim_name(transport, settings.port, wire_of(settings)) == str(run.facts["claim"])
    # Such as a port that is none of this transport.
    return False


def _transport(settings: StopSettings) -> str:
    return settings.transport or default_transport(settings.robot)


def _claim(settings: StopSettings) -> str:
    return claim_name(_transport(settings), settings.port, wire_of(settings))


def _stopped(settings: StopSettings, run: FoundRun, passive: bool, clock: Clock, say: Say) -> StopReport:
    """Return the report on a run that was asked to end; do it here if it did not make its robot passive."""
    name, facts = f"the run of process {run.pid}", run.facts
    if passive:
        words = f"{facts['robot']} is passive: {name} got a request to end, and the robot has confirmed it"
        return StopReport(robot=settings.robot, passive=True, words=words)
    alive = run.holders()
    if alive:
        words = (
            f"{name} got a request to end, but it does not, and may not be killed by this user: "
            "sudo deal-hw stop"
        )
        return StopReport(robot=settings.robot, passive=False, words=words)
    usual = WireOptions()
    # The reader of JSON takes long to load.
    wire = usual if facts["wire"] == usual.to_json() else WireOptions.from_json(facts["wire"])
    own = STOP.settings(
        facts["robot"],
        port=facts["port"],
        transport=facts["transport"],
        seconds=settings.seconds,
        **({"wire": wire} if wire != usual else {}),
        **facts["settings"],
    )
    say(f"{name} has ended without a passive robot; making it passive from here")
    return _directly(own, clock, say, after_run=True)


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
            hurry_the_dying()
            clock.sleep_until_ns(clock.now_ns() + round(_POLL_S * 1e9))
        else:
            return claim


def _check_free(robot: Robot, claim: Any, held: contextlib.ExitStack) -> None:
    """Check that nobody has a robot, and claim it; listens to claims and to commands at the same time.

    Args:
        robot: Connected.
        claim: Its claim on the wire; None if the port itself is exclusive.
        held: Releases the claim.

    Raises:
        DealHwError: Somebody has it.
    """
    refused: list[BaseException] = []

    def acquire() -> None:
        try:
            claim.acquire()
        except BaseException as error:
            refused.append(error)
        else:
            held.callback(claim.release)

    claiming = threading.Thread(target=acquire, name="claiming")
    if claim is not None:
        claiming.start()
    try:
        robot.require_free(FREE_S)
    finally:
        if claim is not None:
            claiming.join()
    if refused:
        raise refused[0]


def _directly(settings: StopSettings, clock: Clock, say: Say, *, after_run: bool = False) -> StopReport:
    """Make a robot passive that no run commands.

    Args:
        settings: The robot.
        clock: For the waiting.
        say: Shows messages.
        after_run: Whether a run on this computer commanded it until it was killed. Then nobody else did, and
            a short look for other commanders is enough.
    """
    from deal_hw.control.safety.passive import PassiveConfig, make_passive

    def report(passive: bool, words: str) -> StopReport:
        return StopReport(robot=settings.robot, passive=passive, words=words)

    transport = _transport(settings)
    own = settings.driver_settings() if isinstance(settings, UnitreeLink) else {}
    robot = make_robot(settings.robot, transport, settings.port, clock, wire_of(settings), own)
    try:
        with contextlib.ExitStack() as held:
            held.callback(_claimed(_claim(settings), clock).release)
            if after_run:
                held.enter_context(robot)
                if others := robot.other_commander(OTHERS_S):
                    return report(False, f"{settings.robot} was NOT made passive: {others}")
            else:
                wire = wire_of(settings)
                claim = wire_claim(settings.robot, transport, settings.port, clock, who(), wire)
                listen_s = max(robot.listen_s, getattr(claim, "listen_s", 0.0))
                if listen_s:
                    say(
                        f"no run of deal-hw on this computer commands {settings.robot}: listening for other "
                        f"commanders for {listen_s:g} s before anything is sent"
                    )
                held.enter_context(robot)
                _check_free(robot, claim, held)
            config = PassiveConfig(timeout_s=settings.seconds)
            if make_passive(robot, clock, config, progress=lambda text, silence_s: say(text)):
                why = "its run was killed" if after_run else "no run commanded it"
                return report(True, f"{settings.robot} is passive: {why}, and the robot has confirmed it")
    except ConfigurationError:
        raise
    except DealHwError as error:
        return report(False, f"{settings.robot} was NOT made passive: {error}")
    return report(
        False,
        f"{settings.robot} did NOT confirm within {settings.seconds:g} s that it is passive. Use its remote "
        "or its switch. Over a bridge, the certificate must be a controller's",
    )
