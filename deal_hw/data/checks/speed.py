"""Checks that recorded velocities are the slopes of the recorded positions: units, signs, clock."""

from __future__ import annotations

import numpy as np

from deal_hw.data.table import Table
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray

OVER_S = 0.1
"""Velocities are integrated over this time, so that an encoder's steps and a filter's lag hardly matter
[s]."""
ALIKE = 0.9
"""Their sizes are compared from this correlation on [-]."""
FACTOR = 1.5
"""A ratio within this factor of 1 is the effect of a filter, or of a gear's compliance [-]."""
UNITS = {57.3: "degrees and radians", 1000.0: "millimetres and metres"}


def speed_verdict(table: Table) -> Finding:
    """Compare the velocities of a recording with its positions' slopes.

    Args:
        table: The recording; velocities that are not numbers are left out.
    """
    if table.velocity is None:
        return Finding("velocity", Severity.OK, "no velocity recorded")
    ratios: dict[str, float] = {}
    for name, position, velocity in zip(table.joint_names, table.position.T, table.velocity.T, strict=True):
        ratio = _ratio(table.time_s, position, velocity)
        if ratio is not None and not 1 / FACTOR < ratio < FACTOR:
            ratios[name] = ratio
    if not ratios:
        return Finding("velocity", Severity.OK, "velocities are the slopes of positions, or too noisy to say")
    found = ", ".join(f"{name} {ratio:.3g} times" for name, ratio in ratios.items())
    values = np.array(list(ratios.values()))
    if np.any(values < 0):
        what = "the sign of one of the two is wrong"
    elif units := [
        words
        for factor, words in UNITS.items()
        if np.all(np.abs(np.abs(np.log(values)) - np.log(factor)) < np.log(1.25))
    ]:
        what = f"{units[0]} in one recording?"
    elif len(ratios) == len(table.joint_names) and np.ptp(np.log(values)) < np.log(FACTOR):
        what = "all alike: check the clock (unit of time, rate) and the unit of positions"
    else:
        what = "check the unit of its positions"
    text = f"recorded velocities are not the slopes of positions: {found}; {what}"
    return Finding("velocity", Severity.WARN, text)


def _ratio(time_s: FloatArray, position: FloatArray, velocity: FloatArray) -> float | None:
    """Return the ratio of a velocity to the positions' slope; None if they are not correlated."""
    sound = np.isfinite(position) & np.isfinite(velocity)
    time, x, v = time_s[sound], position[sound], velocity[sound]
    new = np.concatenate([[True], np.diff(time) > 0])[: time.size]
    time, x, v = time[new], x[new], v[new]
    if time.size < 3:
        return None
    way = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(time))])
    after = np.searchsorted(time, time + OVER_S)
    rows = np.flatnonzero(after < time.size)
    moved, integrated = x[after[rows]] - x[rows], way[after[rows]] - way[rows]
    if rows.size < 3 or not (np.std(moved) > 0 and np.std(integrated) > 0):
        return None
    correlation = float(np.corrcoef(moved, integrated)[0, 1])
    if abs(correlation) < ALIKE:
        return None
    return float(np.sign(correlation) * np.std(integrated) / np.std(moved))
