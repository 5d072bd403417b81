"""Being a robot's only commander: the claim, the open connection, and Ctrl-Z."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.claim import LocalClaim
from deal_hw.control.process.realtime import priority
from deal_hw.control.process.run_note import RunNote
from deal_hw.priorities import TRANSPORT_PRIORITY
from deal_hw.robots.connect import claim_name, wire_claim
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.robot import Robot
    from deal_hw.workflows.running.plan import RunPlan

OTHERS_S = 0.1
"""How long who takes over from a dead run listens for other commanders [s]. A program that commands motors
sends 20 times a second at least; one that sends less often is noticed by a run, not here."""
HOLDS_LAST_COMMAND = (
    "note: {robot} holds its last command for ever. deal-hw makes it passive when a run ends, when one of "
    "its two processes dies, and when a lost connection comes back. If both processes are killed (out of "
    "memory, kill -9, power) or the connection stays lost, only {stopped_by} can stop it: keep it in reach"
)


@contextlib.contextmanager
def claimed(plan: RunPlan) -> Iterator[tuple[int, ...]]:
    """Hold the exclusive claim on the robot, on this computer and on its wire.

    Yields the descriptors that the control process also keeps open. A run that sends nothing needs no claim.

    Raises:
        PortBusyError: Another program commands the robot, or is about to.
    """
    if plan.dry_run:
        yield ()
        return
    with contextlib.ExitStack() as held:
        local = held.enter_context(LocalClaim(claim_name(plan.transport, plan.port, plan.wire)))
        with priority(TRANSPORT_PRIORITY, children=True):
            wire = wire_claim(plan.robot, plan.transport, plan.port, MonotonicClock(), who(), plan.wire)
            if wire is not None:
                wire.acquire()
                held.callback(wire.release)
        yield (local.fileno(),)


@contextlib.contextmanager
def noted(plan: RunPlan) -> Iterator[RunNote | None]:
    """Keep a note of the run, by which ``deal-hw stop`` finds it; none of a run that sends nothing."""
    if plan.dry_run:
        yield None
        return
    facts = {
        "port": plan.port,
        "transport": plan.transport,
        "wire": plan.wire.to_json(),
        "settings": {k: v for k, v in plan.robot_settings.items() if k in ("state_check", "simulator")},
        "claim": claim_name(plan.transport, plan.port, plan.wire),
    }
    with RunNote(plan.robot, facts) as note:
        yield note


def who() -> str:
    """Return a description of this commander for other programs."""
    words = [Path(sys.argv[0]).name, *sys.argv[1:2]]
    return f"{' '.join(words)[:60]} (process {os.getpid()} on {socket.gethostname()})"


@contextlib.contextmanager
def connected(robot: Robot) -> Iterator[None]:
    """Keep the robot connected; the transport's threads get real-time priority."""
    with priority(TRANSPORT_PRIORITY, children=True):
        robot.connect()
    try:
        yield
    finally:
        robot.disconnect()


def suspend(say: Say) -> None:
    """Stop this process after Ctrl-Z; print a note when it continues."""
    say("the robot is passive and the run is over; stopped (Ctrl-Z)")
    os.kill(os.getpid(), signal.SIGSTOP)
    say(
        "deal-hw continues after Ctrl-Z. The robot was made passive before, and the run has ended: start it "
        "again"
    )
