"""The control process, which runs robot, behaviour, safety filter and loop in real time.

The supervisor starts it as ``python -m deal_hw.workflows.running.control_process``. Its orders come as JSON
on standard input. The open port, the recorder's socket and the status socket are inherited descriptors. It
writes neither to disk nor to the terminal, and imports neither torch, mujoco nor scipy.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import threading
from typing import Any

from deal_hw import signals
from deal_hw.clock import MonotonicClock
from deal_hw.control.process.channel import LOADING, RecordSender, StatusSender
from deal_hw.control.process.realtime import (
    Granted,
    become_realtime,
    die_with_parent,
    kill_self_after,
    parent_is_gone,
)
from deal_hw.control.process.watchdog import SUPERVISOR_SILENCE_S, SupervisorWatchdog

_START_SILENCE_S = 30.0
_ORPHAN_S = 5.0
"""Time an orphaned control process may take beyond that of repeating the passive command [s]."""
_SUPERVISOR_SILENT = signal.SIGUSR2
"""Sent by the watchdog's thread to the main thread, which may be waiting for the robot."""


class _Stopper:
    """Turns signals into a stop: an exit before the loop exists, the loop's passive route afterwards."""

    def __init__(self, parent_pid: int) -> None:
        self._parent_pid = parent_pid
        self.loop: Any = None
        self.passive_s = 0.0
        self.supervisor_silent = False
        """Whether the watchdog found so: another program may send its signal, too."""
        self.reason = ""
        """Of the first signal; "" before it."""
        signals.take(self._handle)

    def _handle(self, number: int) -> None:
        again, self.reason = bool(self.reason), self.reason or self._why(number)
        if self.loop is not None:
            self.loop.request_stop(self.reason, gently=number == signal.SIGINT)
        elif not again:
            # Once: a second exception could come out where the first one is being answered.
            raise KeyboardInterrupt

    def _why(self, number: int) -> str:
        """Return the reason, and see to it that a process which its supervisor cannot kill does end."""
        if parent_is_gone(self._parent_pid):
            kill_self_after(self.passive_s + _ORPHAN_S)
            return "the supervisor died"
        if number == _SUPERVISOR_SILENT and self.supervisor_silent:
            kill_self_after(self.passive_s + _ORPHAN_S)
            return (
                f"no heartbeat from the supervisor for {SUPERVISOR_SILENCE_S:g} s: it is stopped, swapped "
                "out or blocked, so the operator cannot stop the run"
            )
        return signals.reason(number)


def main() -> int:
    """Run the orders from standard input; return the exit code (0: the report says how it went)."""
    orders: dict[str, Any] = json.load(sys.stdin)
    status = StatusSender(socket.socket(fileno=orders["status_fd"]))
    clock = MonotonicClock()
    stopper = _Stopper(orders["parent_pid"])
    try:
        die_with_parent(orders["parent_pid"])
        status.beat(clock.now_ns(), LOADING, _START_SILENCE_S)
        status.result(_run(orders, status, clock, stopper))
    except KeyboardInterrupt:
        status.result(
            {
                "outcome": "stopped",
                "reason": stopper.reason or signals.OPERATOR,
                "error": "",
                "passive_confirmed": True,
            }
        )
    except Exception as err:
        # Before there is a loop, nothing is armed. A loop reports its errors; if it raises one, nobody knows
        # how the robot is, and the supervisor makes it passive.
        status.result(
            {
                "outcome": "failed",
                "reason": str(err),
                "error": type(err).__name__,
                "passive_confirmed": stopper.loop is None,
            }
        )
    return 0


def _run(
    orders: dict[str, Any], status: StatusSender, clock: MonotonicClock, stopper: _Stopper
) -> dict[str, Any]:
    # Imported here, so that a stop signal during these imports is handled, too.
    from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
    from deal_hw.control.safety.passive import PassiveConfig
    from deal_hw.control.safety.safety import Safety
    from deal_hw.motions.planned_end import PlannedEnd
    from deal_hw.motions.posture import limited_for
    from deal_hw.motions.scores.velocity_error import VELOCITY_EVENT, velocity_data
    from deal_hw.motions.velocity import END_KEY, KeyboardVelocity, NotedVelocity
    from deal_hw.robots.connect import adopt_robot, make_robot
    from deal_hw.workflows.running.plan import RunPlan, make_behaviour

    plan = RunPlan.from_json(orders)
    can_send = not plan.dry_run
    if orders["port_fd"] is None:
        robot = make_robot(
            plan.robot, plan.transport, plan.port, clock, plan.wire, plan.robot_settings, can_send=can_send
        )
    else:
        robot = adopt_robot(
            plan.robot, plan.transport, orders["port_fd"], clock, port=plan.port, can_send=can_send
        )
    source = plan.velocity_source()
    noted = NotedVelocity(
        source, lambda wanted: loop.note(VELOCITY_EVENT, "wanted velocity", **velocity_data(wanted))
    )
    end = PlannedEnd()
    behaviour = make_behaviour(plan, robot.description, noted, end=end)
    sink = RecordSender(socket.socket(fileno=orders["record_fd"])) if "record_fd" in orders else _discard

    main = threading.get_ident()

    def supervisor_is_silent() -> None:
        stopper.supervisor_silent = True
        signal.pthread_kill(main, _SUPERVISOR_SILENT)

    watchdog = SupervisorWatchdog(status, clock, supervisor_is_silent)

    def progress(phase: str, silence_s: float) -> None:
        status.beat(clock.now_ns(), phase, silence_s)
        for key in watchdog.messages():
            if key == END_KEY and plan.stand:
                end.request("ended by the operator's key")
            elif key == END_KEY:
                loop.request_stop("stopped by the operator's key", gently=True)
            elif isinstance(source, KeyboardVelocity):
                source.press(key)

    granted = become_realtime() if plan.realtime else Granted("default", ())
    passive = PassiveConfig(timeout_s=plan.passive_timeout_s)
    loop = ControlLoop(
        robot,
        behaviour,
        Safety(limited_for(behaviour, robot.description)),
        clock,
        sink,
        LoopConfig(
            duration_s=plan.longest_s,
            dry_run=plan.dry_run,
            home=plan.home,
            record_wire=plan.record_wire,
            hand_back=plan.hand_back,
            passive=passive,
        ),
        progress=progress,
        scheduling=granted.scheduling,
        end=end,
    )
    for warning in granted.warnings:
        loop.note("warning", warning)
    stopper.loop, stopper.passive_s = loop, passive.timeout_s
    if stopper.reason:
        # Its exception was lost in a callback of a library.
        loop.request_stop(stopper.reason)
    watchdog.start()
    report = loop.run()
    return {**report.to_json(), "warnings": [*granted.warnings, *report.warnings]}


def _discard(record: object) -> bool:
    return True


if __name__ == "__main__":
    sys.exit(main())
