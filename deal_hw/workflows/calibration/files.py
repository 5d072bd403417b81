"""Reads recordings of any robot: its MJCF, and files or arrays of positions and commands."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deal_hw.errors import ConfigurationError
from deal_hw.workflows.calibration.checks import examine_recording
from deal_hw.workflows.calibration.recordings import (
    Recorded,
    at_rest_without_commands,
    named_on_grid,
    one_rate,
    read_tables,
    recorded_rates,
    refuse_copies,
    say_rates,
    say_uneven,
    without,
)
from deal_hw.workflows.calibration.settings import FilesSettings
from deal_hw.workflows.calibration.source import Source
from deal_hw.workflows.calibration.space import searched_space
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.data.table import Table
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.sim.mjcf.joint_facts import JointFacts


def read_files(settings: FilesSettings, say: Say) -> Source:
    """Read recordings of any robot from files or memory, with its model.

    Args:
        settings: The settings; their model is a file.
        say: Called with sentences on guesses and doubts.

    Raises:
        ConfigurationError: A setting, the model or a parameter cannot be used.
        DatasetError: A recording cannot be read, understood or trusted.
    """
    from deal_hw.data.checks.blind import find_blind, without_blind
    from deal_hw.data.checks.suite import despiked
    from deal_hw.sim.engine.compiling import compile_mjcf
    from deal_hw.sim.engine.model import load_model
    from deal_hw.sim.mjcf.describe import describe, slowest, with_speed_limits
    from deal_hw.sim.mjcf.joint_facts import joint_facts

    data: Sequence[Recorded] = settings.data
    holdout: Sequence[Recorded] = settings.holdout
    spikes, division = settings.spikes, settings.division(judged=bool(holdout))
    if not data:
        raise ConfigurationError("--model needs recordings to fit: --data rec.csv [more ...]")
    _refuse_same(data, holdout)
    path = Path(settings.model)
    model = compile_mjcf(path)
    space = searched_space(settings, model, say)
    facts = joint_facts(path, model)
    for note in facts.notes:
        say(f"{path.name}: {note}")
    policy = None
    if settings.policy is not None:
        from deal_hw.policies.onnx_runtime import OnnxPolicy

        policy = OnnxPolicy(settings.policy)
    fitted, held = _tables(settings, (("data", data), ("holdout", holdout)), policy, facts, say)
    every = recorded_rates([*fitted, *held], model, settings.physics_step, settings.window)
    say_rates([table.name for table in (*fitted, *held)], every, say)
    say_uneven([*fitted, *held], every, say)
    rates = slowest(every)
    in_loop = None
    if policy is not None and settings.in_closed_loop:
        from deal_hw.workflows.calibration.policy import policy_of_files
        from deal_hw.workflows.calibration.policy_commands import at_policy_rate

        rates = at_policy_rate(one_rate(every), policy)
        every = [rates] * len(every)
        in_loop = functools.partial(policy_of_files, policy)
    description = describe(path, model, fitted[0].joint_names, fitted[0].actuated, rates)
    description = with_speed_limits(description, model, space)
    smooth = [[despiked(table, spikes) for table in tables] for tables in (fitted, held)]
    blind = find_blind(itertools.chain(*smooth), spikes)
    parts = without(
        settings.leave_out, *([without_blind(table, blind) for table in tables] for tables in smooth)
    )
    verdicts = {
        table.name: examine_recording(
            table, facts, settings.force, kept=kept, spikes=spikes, blind=blind, say=say
        )
        for table, kept in zip((*fitted, *held), itertools.chain(*parts), strict=True)
    }
    robot = load_model(description, rates.step_s)
    fitted, held = parts
    return Source(
        robot=robot,
        space=space,
        fitted=named_on_grid(fitted, robot, every[: len(fitted)]),
        held=named_on_grid(held, robot, every[len(fitted) :]),
        division=division,
        sample_hz=None,
        feet=tuple(settings.feet),
        telemetry=[
            f"{name}: {verdict.severity} {verdict.code}: {verdict.message}"
            for name, found in verdicts.items()
            for verdict in found
        ],
        provenance={
            "model": str(path),
            "description_digest": description.digest(),
            "recordings": [dict(table.source) for table in fitted],
            "holdout": [dict(table.source) for table in held]
            or f"last {division.share:.0%} of each recording",
            "left_out": [list(entry) for entry in settings.leave_out],
            "sampling": dataclasses.asdict(rates),
            "rates_hz": sorted({1.0 / each.period_s for each in every}),
        },
        advice="name recordings of other motion with --holdout",
        policy=None if in_loop is None else in_loop(description, space, settings.latency_range, say),
        rates=rates,
    )


def _refuse_same(data: Sequence[Recorded], holdout: Sequence[Recorded]) -> None:
    """Refuse a file that is both fitted and held out."""
    files, judges = (
        {Path(s).resolve() for s in some if isinstance(s, str | Path)} for some in (data, holdout)
    )
    if both := sorted(files & judges):
        raise ConfigurationError(
            f"{both[0]} is both fitted and held out; a held-out recording must not be fitted: remove it "
            "from --data or --holdout"
        )


def _tables(
    settings: FilesSettings,
    groups: Sequence[tuple[str, Sequence[Recorded]]],
    policy: OnnxPolicy | None,
    facts: JointFacts,
    say: Say,
) -> list[list[Table]]:
    """Return each group's recordings in SI units, with the commands that their policy or rest gives."""
    from deal_hw.data.importing.columns import read_column_map

    path = settings.columns
    columns = None if path is None else read_column_map(Path(path))
    printed: dict[str, str] = {}
    found = [read_tables(sources, columns, facts, say, name, printed) for name, sources in groups]
    if policy is not None:
        from deal_hw.workflows.calibration.policy_commands import with_policy_commands

        found = [with_policy_commands(tables, policy, facts, say) for tables in found]
    found = [at_rest_without_commands(tables, facts, say) for tables in found]
    refuse_copies(list(itertools.chain(*found)))
    return found
