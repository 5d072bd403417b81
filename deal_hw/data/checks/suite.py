"""All checks of a recording, before any long work: of our own recorder's, and of files of unknown origin.

Both read the same view of a recording, a :class:`~deal_hw.data.table.Table`, by the same functions for stamps
and values (:mod:`.samples`). Only ours then have telemetry (:mod:`.telemetry`); only in those of others may
channels mean something else than their names say (:mod:`.meaning`), as our recorder writes joints, units and
commands itself. With "fail" a recording is refused.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from deal_hw.data.checks import samples, telemetry
from deal_hw.data.checks.blind import BlindRange, check_blind, find_blind, without_blind
from deal_hw.data.checks.following import check_following, followed_part
from deal_hw.data.checks.samples import OTHERS, OURS
from deal_hw.data.checks.spikes import (
    DEFAULT_SPIKES,
    Spike,
    SpikeSettings,
    check_spikes,
    find_spikes,
    sound,
)
from deal_hw.data.table import Table, table_of
from deal_hw.errors import DatasetError
from deal_hw.findings import Finding, Severity, worst
from deal_hw.types import FloatArray, Trajectory


def check(
    trajectory: Trajectory,
    spikes: SpikeSettings = DEFAULT_SPIKES,
    blind: Sequence[BlindRange] | None = None,
) -> tuple[Finding, ...]:
    """Run all checks on an episode of our recorder; the order is fixed.

    They look at the part in which the joints followed their commands; the last one says where that ends.

    Args:
        trajectory: The recording.
        spikes: Definition of a spike.
        blind: Blind ranges of the robot's sensors; None: those that this recording shows.
    """
    following, trajectory = check_following(trajectory), followed_part(trajectory)
    if trajectory.device_s.size < samples.FEWEST:
        text = f"{trajectory.device_s.size} state samples"
        few = Finding("length", Severity.FAIL, text, f"record at least {samples.SHORTEST_S:g} s")
        return (few, following)
    table = table_of(trajectory)
    if table.effort is None and "import" not in trajectory.metadata:
        # Only the file of an import may have no effort at all.
        table = dataclasses.replace(table, effort=trajectory.effort)
    found = find_spikes(table.time_s, table.position, table.units, spikes)
    smooth = _without(table, found)
    return (
        samples.check_length(table, OTHERS if "import" in trajectory.metadata else OURS),
        samples.check_finite(table, OURS),
        _check_clocks(table, trajectory),
        samples.check_gaps(table.time_s, nominal_period_s(trajectory), OURS),
        telemetry.check_lost_frames(trajectory),
        telemetry.check_jitter(trajectory),
        samples.check_frozen(table, OURS),
        check_spikes(found, table.time_s, table.joint_names, table.units),
        check_blind(smooth, find_blind([smooth], spikes) if blind is None else blind),
        telemetry.check_arrival(trajectory),
        telemetry.check_device_limits(trajectory),
        telemetry.check_safety_filter(trajectory),
        telemetry.check_stops(trajectory),
        telemetry.check_hand_over(trajectory),
        following,
    )


def _check_clocks(table: Table, trajectory: Trajectory) -> Finding:
    """Check the device's own clock, then beside the host's."""
    own = samples.check_clock({"samples": table.time_s}, OURS)
    if own.severity is Severity.FAIL:
        return own
    jumps = telemetry.check_jumps(trajectory)
    return own if jumps.severity is Severity.OK and own.severity is not Severity.OK else jumps


def examine(
    table: Table,
    limits: FloatArray | None = None,
    kept: Table | None = None,
    spikes: SpikeSettings = DEFAULT_SPIKES,
    efforts: bool = False,
    blind: Sequence[BlindRange] | None = None,
) -> tuple[Finding, ...]:
    """Run all checks on a recording of unknown origin; the order is fixed.

    If clock or values are unusable, the later checks are skipped: they would only repeat it. Spikes, and what
    a sensor holds where it is blind, are reported, and the later checks use the recording without them.

    Args:
        table: The recording, on its own stamps.
        limits: Lowest and highest position of each joint in the model, (J, 2) [rad or m]; infinite if free.
        kept: The recording without the left-out parts, in which slips do no harm.
        spikes: Definition of a spike.
        efforts: Commands are efforts of motors: where they never change, the joints move by themselves.
        blind: Blind ranges of the robot's sensors; None: those that this recording shows.
    """
    from deal_hw.data.checks import meaning
    from deal_hw.data.checks.joint_match import match
    from deal_hw.data.checks.speed import speed_verdict

    first = (
        samples.check_length(table, OTHERS),
        samples.check_finite(table, OTHERS),
        samples.check_clock({"samples": table.time_s, "commands": table.command_s}, OTHERS),
    )
    if worst(first) is Severity.FAIL:
        return first
    table = _numbers(table)
    clock = table.time_s[np.isfinite(table.position).all(axis=1)]
    rate = samples.check_rate(clock)
    if rate.severity is Severity.FAIL:
        return (*first, rate)
    found = find_spikes(table.time_s, table.position, table.units, spikes)
    jumps = check_spikes(found, table.time_s, table.joint_names, table.units)
    table = _without(table, found)
    blind = find_blind([table], spikes) if blind is None else blind
    holds, table = check_blind(table, blind), without_blind(table, blind)
    middle = (
        rate,
        samples.check_gaps(clock, 0.0, OTHERS),
        jumps,
        holds,
        samples.check_frozen(table, OTHERS),
        speed_verdict(table),
        meaning.check_commands(table, efforts),
    )
    if not table.command_s.size or not table.actuated:
        return (*first, *middle)
    units, other_unit = meaning.check_units(table, limits)
    # Positions in another unit than commands also lie far from them and outside the limits: no other cause.
    places = () if other_unit else (meaning.check_levels(table), meaning.check_limits(table, limits))
    return (
        *first,
        *middle,
        meaning.check_copy(table),
        units,
        *places,
        *match(table),
        meaning.check_slip(kept or table),
        meaning.check_clipping(table, limits),
        meaning.check_saturation(table),
        meaning.check_excitation(table),
        *([] if table.orientation is None else [meaning.check_orientation(table.orientation)]),
    )


def nominal_period_s(trajectory: Trajectory) -> float:
    """Return the time between state samples [s]: of its import, else by the robot's description, else 0."""
    if period_s := trajectory.metadata.get("import", {}).get("period_s"):
        return float(period_s)
    rate_hz = trajectory.metadata.get("description", {}).get("state_rate_hz")
    return 1.0 / rate_hz if rate_hz else 0.0


def despiked(table: Table, settings: SpikeSettings) -> Table:
    """Return a recording without the samples that jump and come back, see :class:`SpikeSettings`."""
    return _without(table, find_spikes(table.time_s, table.position, table.units, settings))


def _numbers(table: Table) -> Table:
    """Return a recording in which what is infinite is not a number: its size has no meaning."""
    measured: dict[str, Any] = {
        name: np.where(np.isfinite(values), values, np.nan)
        for name in ("position", "velocity", "effort")
        if (values := getattr(table, name)) is not None
    }
    return dataclasses.replace(table, **measured)


def _without(table: Table, found: Sequence[Spike]) -> Table:
    return table.rows(sound(found, table.time_s.size)) if found else table


def require(verdicts: Sequence[Finding], name: str) -> None:
    """Refuse a recording with a failed check.

    Raises:
        DatasetError: A check failed; the message contains the sentence of each failed check.
    """
    failed = [f"{found.code}: {found.message}" for found in verdicts if found.severity is Severity.FAIL]
    if failed:
        raise DatasetError(f"{name} cannot be used: {'; '.join(failed)}")
