"""Tables of recordings in files or memory: read, leave parts out, put on the grid."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.workflows.calibration.checks import REQUIRED_CHECKS
from deal_hw.workflows.calibration.source import Named

if TYPE_CHECKING:
    from deal_hw.data.importing.columns import ColumnMap, JointKinds
    from deal_hw.data.importing.grid import Recording
    from deal_hw.data.table import Table
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.mjcf.describe import Sampling
    from deal_hw.sim.mjcf.joint_facts import JointFacts

UNEVEN = 0.01
"""A stamp that lies further beside an even clock is said [sampling periods]."""

Recorded = Path | str | Mapping[str, Any] | Any
"""A recording: a file's path, or data in memory (:mod:`deal_hw.data.importing.memory_source`)."""


def read_tables(
    sources: Sequence[Recorded],
    columns: ColumnMap | None,
    facts: JointFacts,
    say: Callable[[str], None],
    name: str,
    printed: dict[str, str],
) -> list[Table]:
    """Return recordings in SI units, on their own stamps; those in memory are called NAME[0], NAME[1], ...

    ``printed`` has the guessed column maps that were printed already; new ones are added.
    """
    from deal_hw.data.importing.load import load_tables, tables_of

    tables: list[Table] = []
    joints, kinds = facts.names, kinds_of(facts)
    for number, source in enumerate(sources):
        if isinstance(source, str | Path):
            tables += load_tables(Path(source), columns, joints, say, printed, kinds)
        else:
            from deal_hw.data.importing.memory_source import read_memory

            channels = read_memory(source, f"{name}[{number}]")
            tables += tables_of([channels], columns, joints, say, printed, kinds)
    return tables


def kinds_of(facts: JointFacts) -> JointKinds:
    """Return which joints of a model slide, have motors or velocity servos, or follow others."""
    from deal_hw.data.importing.columns import JointKinds

    speeds = {n: float(g) for n, g in zip(facts.names, facts.speed_gain, strict=True) if np.isfinite(g)}
    motors = zip(facts.names, ~facts.servo & np.isfinite(facts.full_effort), facts.full_effort, strict=True)
    return JointKinds(
        slides=frozenset(n for n, unit in zip(facts.names, facts.units, strict=True) if unit == "m"),
        motors={name: float(full) for name, motor, full in motors if motor and name not in speeds},
        speeds=speeds,
        followers=facts.followers,
    )


def refuse_copies(tables: Sequence[Table]) -> None:
    """Refuse recordings that hold the same samples, whatever their names and formats.

    Raises:
        ConfigurationError: Two of them do.
    """
    for this, other in itertools.combinations(tables, 2):
        if np.array_equal(this.position, other.position, equal_nan=True) and np.array_equal(
            this.target, other.target, equal_nan=True
        ):
            raise ConfigurationError(
                f"{other.name} is a copy of {this.name}; a copy counts twice, and can be fitted and held out "
                "at the same time. Leave it out"
            )


def recorded_rates(
    tables: Sequence[Table], model: Any, physics_step_s: float | None, window_s: float
) -> list[Sampling]:
    """Check that recordings have the same joints; return the place of each on its physics grid.

    Args:
        tables: All recordings.
        model: The MjModel.
        physics_step_s: Requested physics step; None for the model's [s].
        window_s: Length of a search's longest windows [s].

    Raises:
        ConfigurationError: They have different joints, or a setting cannot be used.
        DatasetError: A clock is invalid.
    """
    from deal_hw.data.checks.suite import examine, require
    from deal_hw.data.importing.grid import grid_periods
    from deal_hw.sim.mjcf.describe import sampling

    first = tables[0]
    for table in tables:
        if (table.joint_names, table.actuated) != (first.joint_names, first.actuated):
            raise ConfigurationError(
                f"{table.name} has positions of {', '.join(table.joint_names)} and commands of "
                f"{', '.join(table.actuated) or 'none'}, but {first.name} of "
                f"{', '.join(first.joint_names)} and {', '.join(first.actuated) or 'none'}; calibrate them "
                "separately"
            )
        # An invalid clock has no period; report it before anything else fails on it.
        found = examine(table, efforts=not model_has_servos(model))
        require([v for v in found if v.code in REQUIRED_CHECKS], table.name)
    timestep = float(model.opt.timestep) if physics_step_s is None else physics_step_s
    return [sampling(period_s, timestep, window_s) for period_s in grid_periods(tables)]


def say_rates(names: Sequence[str], rates: Sequence[Sampling], say: Callable[[str], None]) -> None:
    """Say which rates recordings have, if there are several."""
    alike: dict[float, list[str]] = {}
    for name, each in zip(names, rates, strict=True):
        alike.setdefault(each.period_s, []).append(name)
    if len(alike) > 1:
        groups = (f"{1 / period_s:.4g} Hz ({', '.join(of)})" for period_s, of in alike.items())
        say(f"{len(alike)} rates: {'; '.join(groups)}. Each recording is fitted on its own grid")


def say_uneven(tables: Sequence[Table], rates: Sequence[Sampling], say: Callable[[str], None]) -> None:
    """Say which recordings have an uneven clock."""
    from deal_hw.data.importing.grid import unevenness_s

    off_s = [unevenness_s(table) for table in tables]
    uneven = [
        f"{table.name} by up to {1e3 * off:.2g} ms"
        for table, off, each in zip(tables, off_s, rates, strict=True)
        if off > UNEVEN * each.period_s
    ]
    if uneven:
        say(f"uneven clock: {', '.join(uneven)}. The samples are put on an even grid")


def one_rate(rates: Sequence[Sampling]) -> Sampling:
    """Return the rates of recordings whose policy is simulated, too: they must be the same.

    Raises:
        ConfigurationError: They differ.
    """
    if len(set(rates)) > 1:
        found = ", ".join(f"{hz:.4g}" for hz in sorted({1 / r.period_s for r in rates}))
        raise ConfigurationError(
            f"the recordings have several rates ({found} Hz), and this method simulates the policy at one; "
            "leave out --method, or calibrate the recordings of one rate"
        )
    return rates[0]


def model_has_servos(model: Any) -> bool:
    """Return whether an actuator of a model takes positions."""
    return bool((model.actuator_biasprm[:, 1] < 0).any())


def at_rest_without_commands(
    tables: Sequence[Table], facts: JointFacts, say: Callable[[str], None]
) -> list[Table]:
    """Return recordings in which motors without any recorded command are off: their commands are 0.

    A servo holds its joint, so its commands cannot be guessed. These recordings stay as they are.
    """
    found = []
    for table in tables:
        driven = tuple(
            name
            for name, servo, motor in zip(facts.names, facts.servo, facts.motor, strict=True)
            if (servo or motor) and name in table.joint_names
        )
        if table.command_s.size or facts.servo.any():
            found.append(table)
            continue
        off = f"its motors ({', '.join(driven)}) were off" if driven else "the model has no actuators"
        say(
            f"{table.name}: no commands, and {off}: it is taken as a motion of the joints alone. It shows "
            "friction, damping and armature relative to the masses of the model; of masses, too, only ratios"
        )
        table = dataclasses.replace(
            table, actuated=driven, command_s=np.zeros(1), target=np.zeros((1, len(driven)))
        )
        found.append(table)
    return found


def without(
    left_out: Sequence[tuple[str, float, float]], *groups: Sequence[Table]
) -> tuple[list[Table], ...]:
    """Return the recordings without some parts; the rest is split there.

    Raises:
        ConfigurationError: A file is not among the recordings, or a part has no samples.
    """
    wanted = list(left_out)
    found: list[list[Table]] = []
    for tables in groups:
        kept = []
        for table in tables:
            keep = np.ones(len(table.time_s), dtype=bool)
            names = (table.source["file"], Path(table.source["file"]).stem)
            for entry in [e for e in wanted if e[0] in names]:
                keep &= (table.time_s < entry[1]) | (table.time_s >= entry[2])
                wanted.remove(entry)
            kept.append(table if keep.all() else _rows(table, keep))
        found.append(kept)
    if wanted:
        known = ", ".join(table.source["file"] for tables in groups for table in tables)
        raise ConfigurationError(f"--leave-out {wanted[0][0]}: no such recording; known are {known}")
    return tuple(found)


def _rows(table: Table, keep: Any) -> Table:
    if not keep.any():
        raise ConfigurationError(
            f"--leave-out removes all of {table.name}; remove the file from --data instead"
        )
    return table.rows(keep)


def named_on_grid(tables: Sequence[Table], robot: RobotModel, rates: Sequence[Sampling]) -> list[Named]:
    """Return recordings on their grids with their names; a table with pauses gives several."""
    found = []
    for table, own in zip(tables, rates, strict=True):
        recordings = on_grid(table, robot, own)
        for number, recording in enumerate(recordings, 1):
            part = f", part {number} of {len(recordings)}" if len(recordings) > 1 else ""
            found.append(Named(table.name + part, recording.trajectory, own))
    return found


def on_grid(table: Table, robot: RobotModel, rates: Sampling) -> list[Recording]:
    """Put a recording on the grid, with the gains of the model and commands in the actuators' unit."""
    from deal_hw.data.importing.grid import Gains, to_trajectories

    description = robot.description
    gains = Gains(
        stiffness=description.stiffness,
        damping=description.damping,
        effort_limit=description.effort_limit,
        speed_limit=description.speed_limit,
    )
    if not all(description.servos):
        model, actuators = robot.model, list(robot.actuator)
        full = model.actuator_gear[actuators, 0] * model.actuator_gainprm[actuators, 0]
        target = table.target / np.where(description.servos, 1.0, full)
        table = dataclasses.replace(table, target=target)
    return to_trajectories(table, gains, rates.period_s)
