"""Commands that a recording lacks, or that have another clock, from the policy that moved the robot.

Fits need to know which command acted when. A policy's commands follow from the states that it saw. So a
recording of states alone can be aligned where the policy is known, and a wrong clock of commands shows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from deal_hw.errors import ConfigurationError, DatasetError, PolicyMismatchError
from deal_hw.types import FloatArray, IntArray, Trajectory
from deal_hw.workflows.calibration.policy import NOTED_POLICY

if TYPE_CHECKING:
    from deal_hw.data.table import Table
    from deal_hw.motions.behaviours import ActionMap
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.policy import PolicySpec
    from deal_hw.sim.mjcf.describe import Sampling
    from deal_hw.sim.mjcf.joint_facts import JointFacts

AGREES: Final = 0.9
"""Share of the variance of recorded commands that the policy must give for them to be its own."""
LONGEST_SHIFT_S: Final = 2.0
"""Largest distance between the clocks of states and commands that is looked for [s]."""
USUAL_DELAY_S: Final = 0.1
"""Longest time from a state to the policy's command at which their clocks count as one [s]."""
WHOLE: Final = 0.02
"""Largest distance of the ratio of two rates to a whole number."""


@dataclass(frozen=True, slots=True, eq=False)
class _Ticks:
    """The policy's commands in a recording's states, with one of its samples in each control period.

    Attributes:
        first: Which samples: those whose number in the recording leaves this remainder.
        row: Row of each sample, (N,).
        command: (N, A).
    """

    first: int
    row: IntArray
    command: FloatArray


def with_policy_commands(
    tables: Sequence[Table], policy: OnnxPolicy, facts: JointFacts, say: Callable[[str], None]
) -> list[Table]:
    """Return recordings with the commands of a policy, or with their own on the states' clock.

    Args:
        tables: Recordings; for a policy that observes a floating base with its place and orientation.
        policy: The policy that moved it.
        facts: The joints of its model.
        say: Called with a sentence on each recording.

    Raises:
        ConfigurationError: The policy is not for these joints, needs more than the recordings have, or runs
            at a rate at which they have no samples.
        DatasetError: Recorded commands are not those of the policy.
        PolicyError: It cannot be run.
    """
    from deal_hw.data.importing.grid import period_of

    found, name = [], policy.path.name
    for recorded in tables:
        table, period_s = _as_policy(recorded, policy.spec), period_of(recorded)
        _refuse_unseen(table, policy.spec)
        every = _samples_a_tick(policy.spec, period_s)
        choices = list(_choices(table, policy, every, period_s, facts))
        if table.command_s.size:
            known = _checked(table, choices, period_s, name, say)
        else:
            known = _given(table, choices, policy.spec, name, say)
        found.append(dataclasses.replace(known, source={**known.source, NOTED_POLICY: policy.digest[:16]}))
    return found


def with_commands_of(
    policy: OnnxPolicy, tables: Sequence[Table], facts: JointFacts, say: Callable[[str], None]
) -> list[Table]:
    """Return recordings as :func:`with_policy_commands` does, with the joints in their own order."""
    found = with_policy_commands(tables, policy, facts, say)
    return [table.in_order(own.joint_names) for table, own in zip(found, tables, strict=True)]


def with_policy_clock(
    trajectories: Mapping[int, Trajectory], policy: OnnxPolicy, facts: JointFacts, say: Callable[[str], None]
) -> dict[int, Trajectory]:
    """Return imported episodes whose commands have the states' clock, as :func:`with_policy_commands` does.

    Args:
        trajectories: Episodes by their numbers; commands of motors are shares of the actuators' range.
        policy: The policy that moved the robot.
        facts: The joints of its model.
        say: Called with a sentence on each episode.

    Raises:
        PolicyMismatchError: The policy has other joints, or the same ones in another order.
        ConfigurationError: See there.
        DatasetError: See there.
    """
    from deal_hw.data.importing.grid import with_earlier_commands
    from deal_hw.data.table import table_of

    found = {}
    for index, trajectory in trajectories.items():
        table = table_of(trajectory, f"episode {index}")
        if not table.command_s.size:
            raise DatasetError(f"episode {index}: no command was ever in force; import the recording again")
        gain = facts.gain[[facts.names.index(name) for name in table.actuated]]
        table = dataclasses.replace(table, target=table.target * gain)
        (checked,) = with_policy_commands([table], policy, facts, say)
        if checked.joint_names != table.joint_names:
            raise PolicyMismatchError(
                f"the dataset's robot.yaml has the joints {', '.join(table.joint_names)}, the policy the "
                f"same ones in the order {', '.join(checked.joint_names)}; write `joints` of robot.yaml in "
                "the policy's order, and import again"
            )
        late_s = float(table.command_s[0] - checked.command_s[0])
        found[index] = trajectory if late_s == 0 else with_earlier_commands(trajectory, late_s)
    return found


def at_policy_rate(rates: Sampling, policy: OnnxPolicy) -> Sampling:
    """Return the sampling with the policy's control periods, for methods that run it in every simulator."""
    return dataclasses.replace(rates, samples_per_tick=_samples_a_tick(policy.spec, rates.period_s))


def _samples_a_tick(spec: PolicySpec, period_s: float) -> int:
    ratio = 1.0 / (spec.control_rate_hz * period_s)
    if abs(ratio - round(ratio)) > WHOLE or round(ratio) < 1:
        raise ConfigurationError(
            f"--policy: it ran at {spec.control_rate_hz:g} Hz, and the recordings have {1 / period_s:.4g} "
            "samples a second, which is no whole multiple. The state at each command is needed; record at "
            f"{spec.control_rate_hz:g} Hz or a multiple of it"
        )
    return round(ratio)


def _refuse_unseen(table: Table, spec: PolicySpec) -> None:
    """Refuse a policy that observes what a recording does not hold."""
    requested = any(term.quantity in ("command", "target_rotation") for term in spec.observation)
    if requested or spec.clock_hz:
        raise ConfigurationError(
            f"--policy: the policy for {spec.robot!r} observes a clock, or a requested velocity or "
            "orientation, which recordings do not hold; record its commands, or leave --policy out"
        )
    if spec.recurrent:
        raise ConfigurationError(
            f"--policy: the network of the policy for {spec.robot!r} has a memory of its own, which "
            "recordings do not hold; record its commands, or leave --policy out"
        )
    if spec.observes_base and (table.base_position is None or table.orientation is None):
        raise ConfigurationError(
            f"--policy: the policy for {spec.robot!r} observes a base, whose state {table.name} does not "
            "hold; name base_position and orientation in the column map, record the commands, or leave "
            "--policy out"
        )


def _states(table: Table, every: int) -> tuple[FloatArray, FloatArray]:
    """Return the states that a policy observes: those of a base, if its place was recorded, then the joints.

    Velocities that were not recorded are differences over one control period.
    """
    joint_speed = table.velocity if table.velocity is not None else _slopes(table, table.position, every)
    if table.base_position is None or table.orientation is None:
        return table.position, joint_speed
    from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_vector

    place, speed, gyro = table.base_position, table.base_velocity, table.gyro
    if speed is None:
        speed = _slopes(table, place, every)
    if gyro is None:
        before, seconds = _earlier(table, every)
        gyro = to_vector(table.orientation, table.orientation[before]) / seconds[:, None]
    turn = to_vector(table.orientation, IDENTITY)
    return np.concatenate([place, turn, table.position], axis=1), np.concatenate(
        [speed, gyro, joint_speed], axis=1
    )


def _as_policy(table: Table, spec: PolicySpec) -> Table:
    """Return the recording with its joints in the policy's order.

    Raises:
        PolicyMismatchError: They are other joints.
    """
    if set(table.joint_names) != set(spec.joint_names):
        raise PolicyMismatchError(
            f"{table.name} has the joints {', '.join(table.joint_names)}, the policy "
            f"{', '.join(spec.joint_names)}; give the policy that moved this robot"
        )
    actuated = tuple(name for name in spec.joint_names if name in table.actuated)
    if actuated and set(actuated) != set(spec.actuated):
        raise PolicyMismatchError(
            f"{table.name} has commands of {', '.join(actuated)}, the policy of {', '.join(spec.actuated)}; "
            "give the policy that moved this robot, or name the other commands as `target` in the column map"
        )
    return table.in_order(spec.joint_names)


def _choices(
    table: Table, policy: OnnxPolicy, every: int, period_s: float, facts: JointFacts
) -> Iterator[_Ticks]:
    """Yield the policy's commands for each of the samples of a period at which it may have run."""
    from deal_hw.policy import ObservationBuilder

    spec = policy.spec
    mapped = _commands_of(spec, facts)
    number = np.round((table.time_s - table.time_s[0]) / period_s).astype(np.int64)
    position, velocity = _states(table, every)
    sound = np.isfinite(position).all(axis=1) & np.isfinite(velocity).all(axis=1)
    for first in range(every):
        rows = np.flatnonzero(sound & (number % every == first))
        builder = ObservationBuilder(spec)
        command = np.empty((len(rows), len(spec.actuated)))
        for k, row in enumerate(rows):
            observation = builder.build(position[row], velocity[row])
            action = mapped.action(policy.act_batch(observation[None])[0])
            builder.record_action(action)
            command[k] = mapped.target(action)
        # Before, its memory holds states that were not recorded.
        yield _Ticks(first, rows[spec.history :], command[spec.history :])


def _commands_of(spec: PolicySpec, facts: JointFacts) -> ActionMap:
    """Return the map from actions to commands as recordings hold them."""
    from deal_hw.motions.behaviours import ActionMap

    joints = [facts.names.index(name) for name in spec.actuated]
    if not facts.servo[joints].any():
        scale = np.array(spec.action_scale) * facts.full_effort[joints]
        return ActionMap(spec, np.zeros(len(joints)), scale)
    if spec.action_offset:
        return ActionMap(spec, np.array(spec.action_offset))
    places = [spec.joint_names.index(name) for name in spec.actuated]
    return ActionMap(spec, np.array(spec.default_position)[places])


def _earlier(table: Table, every: int) -> tuple[IntArray, FloatArray]:
    """Return the sample one control period before each, (T,), and the time since, (T,) [s]."""
    before = np.maximum(np.arange(len(table.time_s)) - every, 0)
    return before, np.maximum(table.time_s - table.time_s[before], 1e-9)


def _slopes(table: Table, values: FloatArray, every: int) -> FloatArray:
    """Return differences to the sample one control period earlier, a second: a policy sees no later one."""
    before, seconds = _earlier(table, every)
    return np.asarray((values - values[before]) / seconds[:, None])


def _checked(
    table: Table, choices: Sequence[_Ticks], period_s: float, name: str, say: Callable[[str], None]
) -> Table:
    """Return a recording whose own commands have the clock of its states."""
    span = round(min(LONGEST_SHIFT_S, (table.time_s[-1] - table.time_s[0]) / 4) / period_s)
    delays_s = period_s * np.arange(-span, span + 1)
    scores = [(_agreement(table, ticks, d), float(d)) for ticks in choices for d in delays_s]
    # A command holds for a period, so several delays agree alike: the command begins at the first.
    share, late_s = max(scores, key=lambda score: (round(score[0], 3), -score[1]))
    if share < AGREES:
        raise DatasetError(
            f"{table.name}: the recorded commands are not those of {name} in the recorded states: at the "
            f"best shift in time ({1e3 * late_s:.0f} ms) it gives {max(share, 0.0):.0%} of their variance. "
            "Another policy moved the robot, or states and commands have no common clock. Name the right "
            "policy; or take the commands out of the column map, and those of the policy are used"
        )
    fit = f"{table.name}: {name} gives {share:.0%} of the variance of the recorded commands"
    if -period_s <= late_s <= USUAL_DELAY_S:
        say(f"{fit}, {1e3 * late_s:.0f} ms after its states: both have one clock")
        return table
    say(
        f"{fit}, but {abs(late_s):.3g} s {'after' if late_s > 0 else 'before'} its states: their clocks are "
        "apart. The commands are moved by that time, and the latency then counts from the policy's state"
    )
    return dataclasses.replace(table, command_s=table.command_s - late_s)


def _agreement(table: Table, ticks: _Ticks, late_s: float) -> float:
    """Return the share of the recorded commands' variance that the policy's give, so much later."""
    at = table.time_s[ticks.row] + late_s
    inside = (at >= table.command_s[0]) & (at <= table.command_s[-1])
    if np.count_nonzero(inside) < max(len(at) / 4, 4):
        return -np.inf
    recorded = table.target_at(at[inside] + 1e-6)
    spread = float(np.sum((recorded - recorded.mean(axis=0)) ** 2))
    if spread == 0:
        return -np.inf
    return 1.0 - float(np.sum((recorded - ticks.command[inside]) ** 2)) / spread


def _given(
    table: Table, choices: Sequence[_Ticks], spec: PolicySpec, name: str, say: Callable[[str], None]
) -> Table:
    """Return a recording without commands with those of the policy."""
    if min(len(ticks.row) for ticks in choices) < 2:
        raise DatasetError(
            f"{table.name}: {len(table.time_s)} samples are fewer than the policy remembers "
            f"({spec.history} control periods); record longer"
        )
    best = choices[0]
    which = ""
    if len(choices) > 1:
        every = len(choices)
        best = min(choices, key=lambda ticks: _unexplained(table, ticks, every))
        which = f", from sample {best.first} and every {every} later (those commands explain the motion best)"
    say(
        f"{table.name}: no commands, so they are those of {name} in the recorded states, {len(best.row)} at "
        f"{spec.control_rate_hz:g} Hz{which}"
    )
    return dataclasses.replace(
        table, actuated=spec.actuated, command_s=table.time_s[best.row], target=best.command
    )


def _unexplained(table: Table, ticks: _Ticks, every: int) -> float:
    """Return the share of the accelerations that the commands leave, at the best delay.

    The change of speed over a control period is regressed on positions and speeds, and on the commands at
    both ends of the period. Only the policy's own states give commands that say more than the states do.
    """
    q, T = table.position, len(table.position)
    rows = np.arange(every, T - 2 * every)
    change = q[rows + 2 * every] - 2 * q[rows + every] + q[rows]
    state = np.concatenate([np.ones((len(rows), 1)), q[rows], q[rows] - q[rows - every]], axis=1)
    without = _left(state, change)
    found = [1.0]
    for late in range(round(USUAL_DELAY_S / np.median(np.diff(table.time_s)))):
        number = np.searchsorted(ticks.row + late, np.arange(T), side="right") - 1
        known = (number[rows] >= 0) & np.isfinite(change).all(axis=1)
        acting = ticks.command[np.maximum(number, 0)]
        both = np.concatenate([state, acting[rows], acting[rows + every]], axis=1)
        left = _left(both[known], change[known]) / np.count_nonzero(known)
        found.append(float(np.mean(left / np.maximum(without / len(rows), 1e-300))))
    return min(found)


def _left(inputs: FloatArray, outputs: FloatArray) -> FloatArray:
    """Return the sum of squares that a linear regression leaves, for each output."""
    sound = np.isfinite(inputs).all(axis=1) & np.isfinite(outputs).all(axis=1)
    x, y = inputs[sound], outputs[sound]
    return np.asarray(np.sum((y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) ** 2, axis=0))
