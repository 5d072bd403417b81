"""Being the one commander of a robot: the claim, the connection that is kept, and Ctrl-Z."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

from deal_hw.clock import MonotonicClock
from deal_hw.control.claim import LocalClaim
from deal_hw.control.realtime import TRANSPORT_PRIORITY, priority
from deal_hw.drivers import claim_name, wire_claim
from deal_hw.robot import Robot
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.say import Say

HOLDS_LAST_COMMAND = (
    "note: {robot} holds its last command for ever. deal-hw damps it when a run ends, when one of its two "
    "processes dies, and when a lost link comes back. Where both are killed (out of memory, kill -9, power) "
    "or the link stays away, only a bridge on the robot's side (deal-hw bridge), its own remote or its power "
    "switch can: keep the remote in your hand"
)


@contextlib.contextmanager
def claimed(plan: RunPlan) -> Iterator[tuple[int, ...]]:
    """Hold the exclusive claim on the robot, on this computer and on its wire.

    Yields the descriptors that the control process keeps open, too. Who sends nothing claims nothing.

    Raises:
        PortBusyError: Somebody else commands the robot, or is about to.
    """
    if plan.dry_run:
        yield ()
        return
    with contextlib.ExitStack() as held:
        local = held.enter_context(LocalClaim(claim_name(plan.transport, plan.port, plan.wire)))
        with priority(TRANSPORT_PRIORITY, children=True):
            wire = wire_claim(plan.robot, plan.transport, plan.port, MonotonicClock(), _who(), plan.wire)
            if wire is not None:
                wire.acquire()
                held.callback(wire.release)
        yield (local.fileno(),)


def _who() -> str:
    """Return who commands, for others to read."""
    words = [Path(sys.argv[0]).name, *sys.argv[1:2]]
    return f"{' '.join(words)[:60]} (process {os.getpid()} on {socket.gethostname()})"


@contextlib.contextmanager
def connected(robot: Robot) -> Iterator[None]:
    """Keep the robot connected; the transport's threads run ahead of ordinary processes."""
    with priority(TRANSPORT_PRIORITY, children=True):
        robot.connect()
    try:
        yield
    finally:
        robot.disconnect()


def suspend(say: Say) -> None:
    """Stop this process, as Ctrl-Z asked for; say what happened once it goes on."""
    say("the robot is passive and the run is over; stopped (Ctrl-Z)")
    os.kill(os.getpid(), signal.SIGSTOP)
    say(
        "deal-hw goes on after Ctrl-Z. The robot was made passive before, and the run does not go on: start "
        "it again"
    )
