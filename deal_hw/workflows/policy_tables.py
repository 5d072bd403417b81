"""Tables of a policy: its joints, what it observes, and how it walked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

from deal_hw.policy import IMPORTED, ObservationTerm, PolicySpec
from deal_hw.workflows.say import text_table

if TYPE_CHECKING:
    from deal_hw.policies.walking_trial import WalkingReport

MOTIONS = ("x [m/s]", "y [m/s]", "yaw [rad/s]")


def policy_text(spec: PolicySpec) -> str:
    """Return a policy's tables as text: joints in its network's order, observation, rate, commands."""
    record = spec.training.get(IMPORTED)
    imported: Mapping[str, Any] = record if isinstance(record, Mapping) else {}
    head = [
        f"{len(spec.observation)} observations, {len(spec.actuated)} joints of {spec.robot}, "
        f"{spec.control_rate_hz:g} Hz"
        + (f", from {imported.get('format')} ({imported.get('network')})" if imported else "")
    ]
    parts = [
        head[0],
        text_table(("", "joint", "default", "offset", "scale", "kp", "kd"), joint_rows(spec, imported)),
        text_table(("observed", "numbers", "values", "scale"), term_rows(spec)),
        "\n".join(_facts(spec)),
    ]
    parts += [f"note: {note}" for note in imported.get("notes", ())]
    return "\n\n".join(part for part in parts if part)


def joint_rows(spec: PolicySpec, imported: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row for each actuated joint, in the order of the network's outputs if that is known."""
    named = [str(name) for name in imported.get("actions", ())]
    order = [name for name in named if name in spec.actuated]
    held = [name for name in spec.actuated if name not in order]
    rows = []
    for name in (*order, *held):
        i, place = spec.actuated.index(name), spec.joint_names.index(name)
        offset = spec.action_offset[i] if spec.action_offset else spec.default_position[place]
        number = str(order.index(name)) if name in order else ("-" if order else str(i))
        numbers = (
            spec.default_position[place],
            offset,
            spec.action_scale[i],
            spec.stiffness[i],
            spec.damping[i],
        )
        rows.append((number, name, *(f"{value:.4g}" for value in numbers)))
    return rows


def term_rows(spec: PolicySpec) -> list[tuple[str, ...]]:
    """Return a row for each run of entries of one quantity: its numbers, how many values, and factors."""
    rows: list[tuple[str, ...]] = []
    for quantity, entries in groupby(spec.observation, key=lambda term: term.quantity):
        terms = list(entries)
        ages = sorted({term.delay for term in terms})
        count = str(len(ages))
        if len(ages) > 1:
            count += ", oldest first" if terms[0].delay == ages[-1] else ", newest first"
        rows.append((f"{quantity} {_elements(terms)}".strip(), str(len(terms)), count, _factors(terms)))
    return rows


def walk_text(report: WalkingReport) -> str:
    """Return how robots walked at each command, beside robots that stood still, as text."""
    from deal_hw.policies.walking_trial import describe_command

    rows = [
        (
            describe_command(walk.command),
            *(f"{value:.2f}" if math.isfinite(value) else "-" for value in walk.velocity),
            f"{walk.up:.0%}",
            f"{still.up:.0%}",
            f"{walk.followed:.0%}" if any(walk.command) else "",
        )
        for walk, still in zip(report.walks, report.standing, strict=True)
    ]
    return text_table(("command", *MOTIONS, "time up", "standing still", "followed"), rows)


def _facts(spec: PolicySpec) -> Iterable[str]:
    if spec.command_range:
        spans = ", ".join(
            f"{name} {low:g} to {high:g}"
            for name, (low, high) in zip(MOTIONS, spec.command_range, strict=True)
        )
        yield f"commands: {spans}"
    if spec.clock_hz:
        rest = f"; reads zero for commands below {spec.clock_rest:g}" if spec.clock_rest else "; always runs"
        yield f"clock: {spec.clock_hz:.4g} turns per second{rest}"
    limit = "not clipped" if math.isinf(spec.action_limit) else f"clipped to ±{spec.action_limit:g}"
    yield f"actions: {limit}" + ("; targets are clipped" if spec.target_range else "")
    if spec.recurrent:
        yield "memory: the network has one of its own"


def _elements(terms: Sequence[ObservationTerm]) -> str:
    """Return the joints or axes of terms, the first and the last of many."""
    names = list(dict.fromkeys(term.joint for term in terms))
    return ", ".join(names) if len(names) <= 3 else f"{names[0]}, {names[1]} ... {names[-1]}"


def _factors(terms: Sequence[ObservationTerm]) -> str:
    found = list(dict.fromkeys(f"{term.scale:.4g}" for term in terms))
    return ", ".join(found) if len(found) <= 4 else f"{found[0]} ... {found[-1]}"
