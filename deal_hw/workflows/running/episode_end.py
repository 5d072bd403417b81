"""How an episode ended, from the ends of its two processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from deal_hw.control.loop.control_loop import Outcome
from deal_hw.control.loop.timing import LoopTimingReport
from deal_hw.control.process.supervisor import ChildEnd
from deal_hw.signals import OPERATOR, name
from deal_hw.workflows.causes import LATE, Load, corrupt_advice, late_advice
from deal_hw.workflows.running.report import EpisodeReport
from deal_hw.workflows.running.sleep_lock import ASLEEP

_LINK_WARNING = 0.01
"""Share of corrupt and missing state frames above which the operator gets a warning."""


def account(end: ChildEnd, path: Path | None, if_cut: str, local: bool = False) -> EpisodeReport:
    """Return the report on an episode from the ends of its processes.

    Args:
        end: How both ended.
        path: The recording.
        if_cut: What the robot does without a connection, as a sentence.
        local: The robot is a program on this computer.
    """
    result = end.result or {}
    outcome, reason, error = _verdict(end, result)
    warnings = list(result.get("warnings", ()))
    if not end.passive_confirmed:
        warnings.append(f"the robot did not confirm that it is passive: switch it off by hand. {if_cut}")
    loop_timing = LoopTimingReport.from_json(result["loop_timing"]) if result.get("loop_timing") else None
    if loop_timing is not None and loop_timing.transport_errors > _LINK_WARNING * max(loop_timing.states, 1):
        share = loop_timing.transport_errors / (loop_timing.states + loop_timing.transport_errors)
        warnings.append(
            f"{loop_timing.transport_errors} transport errors, {share:.0%} of the state frames: "
            f"{corrupt_advice(local, Load.now())}"
        )
    flags = tuple(result.get("flags", ()))
    if outcome is Outcome.TRIPPED and LATE.intersection(flags):
        warnings.append(late_advice(local, Load.now()))
    if end.recorder is not None and not end.recorder.complete:
        why = "; ".join(end.recorder.errors) or "for an unknown reason"
        warnings.append(f"the recording is incomplete ({why}); repair it with `deal-hw data repair {path}`")
        if outcome is Outcome.FINISHED:
            outcome, reason, error = Outcome.FAILED, f"the recorder failed: {why}", "DatasetError"
    return EpisodeReport(
        path=path,
        outcome=outcome,
        reason=reason,
        passive_confirmed=end.passive_confirmed,
        loop_timing=loop_timing,
        clipped=dict(result.get("clipped", {})),
        cycles_sent=int(result.get("cycles_sent", 0)),
        states_recorded=end.recorder.states if end.recorder is not None else 0,
        warnings=tuple(warnings),
        error=error,
        flags=flags,
    )


def _verdict(end: ChildEnd, result: dict[str, Any]) -> tuple[Outcome, str, str]:
    """Return the outcome, its reason as text, and the error's class."""
    operator = bool(end.signal) or end.stop_cause in (OPERATOR, ASLEEP)
    if end.killed and not operator:
        return Outcome.FAILED, f"the control process was killed: {end.killed}", "SafetyError"
    if end.stop_cause and not operator:
        return Outcome.FAILED, end.stop_cause, "DatasetError"
    if result:
        # The control process knows the signal that asked it to end, and not always why it was sent.
        reason = end.stop_cause or OPERATOR if result["reason"] == OPERATOR else result["reason"]
        return Outcome(result["outcome"]), reason, result["error"]
    if operator:
        return Outcome.STOPPED, end.stop_cause, ""
    code = end.exit_code
    how = f"by signal {-code} ({name(-code)})" if code < 0 else f"with exit code {code}"
    return Outcome.FAILED, f"the control process died {how} without a report", "SafetyError"
