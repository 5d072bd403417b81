"""The part of a recording in which the joints followed their commands; nothing else may be fitted.

A drive that was switched off, or stopped by an e-stop, does not answer its commands. A fit would explain that
by friction and gains. The control loop notes it as an event of the kind :data:`~deal_hw.types.NOT_FOLLOWING`.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from deal_hw.data.checks.spikes import with_samples
from deal_hw.errors import short
from deal_hw.findings import Finding, Severity
from deal_hw.types import NOT_FOLLOWING, Event, Trajectory

_SENT = (
    "sent_s",
    "sent_sequence",
    "requested_position",
    "position_target",
    "stiffness",
    "damping",
    "effort_limit",
    "speed_limit",
)
"""Arrays of a recording with one row per command."""


def followed_until_s(trajectory: Trajectory) -> float:
    """Return the host time until which a recording may be fitted, on the time base of ``receive_s`` [s].

    Infinite where the joints always followed their commands.
    """
    start_ns = int(trajectory.metadata.get("start_ns", 0))
    return min(((_since_ns(event) - start_ns) * 1e-9 for event in _noted(trajectory)), default=math.inf)


def followed_part(trajectory: Trajectory) -> Trajectory:
    """Return a recording up to where joints no longer followed their commands; the events stay."""
    until_s = followed_until_s(trajectory)
    if until_s == math.inf:
        return trajectory
    sent = trajectory.sent_s < until_s
    part = with_samples(trajectory, np.logical_and.accumulate(trajectory.receive_s < until_s))
    return dataclasses.replace(part, **{name: getattr(part, name)[sent] for name in _SENT})


def what_is_cut(trajectory: Trajectory) -> str:
    """Return how much of a recording :func:`followed_part` leaves out, and why, as text; "" if nothing."""
    until_s = followed_until_s(trajectory)
    if not trajectory.receive_s.size or trajectory.receive_s[-1] < until_s:
        return ""
    cut_s = float(trajectory.receive_s[-1]) - max(until_s, float(trajectory.receive_s[0]))
    return f"the last {cut_s:.1f} s are left out: {_who(trajectory)} commands"


def check_following(trajectory: Trajectory) -> Finding:
    """Report joints that did not follow their commands, and how much is left out for it."""
    if not (text := what_is_cut(trajectory)):
        text = "no event says that a joint did not follow its commands"
        return Finding("following", Severity.OK, text)
    return Finding("following", Severity.WARN, text, "check power, e-stop and controller of the drives")


def _who(trajectory: Trajectory) -> str:
    lists = (event.data.get("joints") for event in _noted(trajectory))
    names = list(dict.fromkeys(str(joint) for names in lists if isinstance(names, list) for joint in names))
    if len(names) > 1:
        return f"joints {short(', '.join(names))} did not follow their"
    return f"{f'joint {short(names[0])}' if names else 'a joint'} did not follow its"


def _noted(trajectory: Trajectory) -> list[Event]:
    return [event for event in trajectory.events if event.kind == NOT_FOLLOWING]


def _since_ns(event: Event) -> int:
    """Return since when joints did not follow [ns]; a damaged file gives the event's own stamp."""
    since = event.data.get("since_ns")
    return min(since, event.stamp_ns) if isinstance(since, int) else event.stamp_ns
