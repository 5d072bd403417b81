"""Checks of any robot's recordings against its model and parameters, before any long work."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from deal_hw.data.checks.spikes import DEFAULT_SPIKES, SpikeSettings
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray, Trajectory

if TYPE_CHECKING:
    from deal_hw.data.checks.blind import BlindRange
    from deal_hw.data.table import Table
    from deal_hw.findings import Finding
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.mjcf.joint_facts import JointFacts
    from deal_hw.sim.recordings.episode import SampledEpisode

GRAVITY_EXPLAINED, GRAVITY_LEAST, GRAVITY_ERRORS = 0.5, 0.01, 4.0
"""Gravity must explain this share of a deviation of at least this size [rad, m], or no gain is reported. A
contradiction counts from this many standard errors on."""
REQUIRED_CHECKS = ("length", "finite", "clock", "rate", "commands")
"""Checks without which a recording has no time grid: --force does not overrule them."""
MOTOR_CHECKS = (
    "length",
    "finite",
    "clock",
    "rate",
    "gaps",
    "spikes",
    "blind",
    "frozen",
    "velocity",
    "limits",
    "orientation",
    "actuation",
)
"""Checks that also apply to commands that are efforts, not positions."""


def require_base(robot: RobotModel, feet: Sequence[str], recordings: Sequence[Trajectory]) -> None:
    """Check that a floating robot's recordings contain the motion of its base.

    Raises:
        ConfigurationError: A recording has no IMU, or no feet are named, or the base is fixed.
        UnknownNameError: A foot is no geom of the model.
    """
    from deal_hw.sim.parameters.fields import element_id

    free = robot.description.floating_base
    if free is None:
        if feet:
            raise ConfigurationError("--feet are for a model with a free joint; this one's base is fixed")
        return
    placed = [t for t in recordings if t.base is not None]
    if placed:
        _require_poses(placed, recordings, feet)
        return
    without = [t for t in recordings if not _base_is_measured(t)]
    if without or not feet:
        lacks = "recordings of the base (orientation and gyro in the column map)" if without else "--feet"
        raise ConfigurationError(
            f"the model floats (free joint {free!r}) and needs {lacks}: the IMU and the standing feet "
            "(sphere geoms, floor at height 0) give the base's motion. Add these; or name base_position and "
            "orientation of motion capture or odometry in the column map; or record with the trunk held and "
            "remove the free joint from a copy of the MJCF"
        )
    for name in feet:
        element_id(robot.model, "geom", name)


def _require_poses(
    placed: Sequence[Trajectory], recordings: Sequence[Trajectory], feet: Sequence[str]
) -> None:
    """Check recordings of which some contain the base's place: all must, with its orientation."""
    if len(placed) < len(recordings):
        raise ConfigurationError(
            f"{len(placed)} of {len(recordings)} recordings contain the base's place (base_position in the "
            "column map); calibrate the others separately"
        )
    if any(t.body is None or not np.isfinite(t.body.orientation).all() for t in placed):
        raise ConfigurationError(
            "a recording contains the base's place (base_position) without its orientation at every sample, "
            "so its state is unknown; name the quaternion as `orientation` in the column map"
        )
    if feet:
        raise ConfigurationError("--feet would have no effect: the recordings contain the base's place")


def _base_is_measured(trajectory: Trajectory) -> bool:
    body = trajectory.body
    measured = () if body is None else (body.orientation, body.angular_velocity)
    return bool(measured) and not any(np.isnan(values).all() for values in measured)


def examine_recording(
    table: Table,
    facts: JointFacts | None,
    force: bool,
    *,
    kept: Table | None = None,
    spikes: SpikeSettings = DEFAULT_SPIKES,
    blind: Sequence[BlindRange] | None = None,
    say: Callable[[str], None],
) -> list[Finding]:
    """Check a recording and report problems; return the findings to keep.

    Args:
        table: The recording.
        facts: The model's joints, for their limits; None without a model.
        force: Continue although a check failed.
        kept: The recording without the left-out parts; None: all of it is used.
        spikes: Definition of a spike.
        blind: Blind ranges of the robot's sensors; None: those that this recording shows.
        say: Called with a sentence on each finding.

    Raises:
        DatasetError: A check failed, and ``force`` is not set.
    """
    from deal_hw.data.checks.command_kind import command_kind
    from deal_hw.data.checks.suite import examine, require
    from deal_hw.errors import DatasetError
    from deal_hw.findings import Severity

    limits, motors = None, frozenset[str]()
    if facts is not None:
        limits = facts.limits[[facts.names.index(name) for name in table.joint_names]]
        motors = facts.motors
    # Efforts are not compared with positions.
    servos = [name for name in table.actuated if name not in motors]
    compared = table.commanded(servos or table.actuated)
    kept = None if kept is None else kept.commanded(compared.actuated)
    every = list(examine(compared, limits, kept, spikes, efforts=bool(motors), blind=blind))
    if facts is not None and {v.code for v in every} >= {"assignment"}:
        # These checks run only if clock and values are valid.
        for names, servo in ((servos, True), (motors, False)):
            part = table.commanded(names)
            command = facts.command[[facts.names.index(name) for name in part.actuated]]
            every += [command_kind(part, servo=servo, limits=command)] if part.actuated else []
    found = [v for v in every if v.severity is not Severity.OK]
    if not servos:
        found = [v for v in found if v.code in MOTOR_CHECKS]
    for verdict in found:
        # The error itself contains the failed ones.
        if force or verdict.severity is not Severity.FAIL:
            say(f"{table.name}: {verdict.severity} {verdict.code}: {verdict.message}")
    if not force:
        try:
            require(found, table.name)
        except DatasetError as err:
            if any(v.severity is Severity.FAIL and v.code in REQUIRED_CHECKS for v in found):
                raise
            raise DatasetError(
                f"{err}. Correct the recording or its column map, or use it all the same with --force"
            ) from err
    return found


def warn_of_gravity(
    robot: RobotModel, space: ParameterSpace, episodes: list[SampledEpisode], say: Callable[[str], None]
) -> None:
    """Warn if gravity contradicts a joint's sign or a servo's gain."""
    from deal_hw.sim.recordings.gravity_gain import gravity_gain

    found = gravity_gain(robot, episodes)
    if found is None:
        return
    searched = {p.elements: p for p in space if p.kind == "servo_stiffness"}
    names = robot.actuator_names
    friction = robot.model.dof_frictionloss[list(robot.qvel)][list(robot.description.actuated_index)]
    for a, joint in enumerate(robot.description.actuated):
        if not robot.description.servos[a]:
            continue
        if found.explained[a] < GRAVITY_EXPLAINED or found.deviation[a] < GRAVITY_LEAST:
            continue
        # Dry friction holds such a load anywhere: the deviation is that of the motion.
        if found.load[a] <= friction[a]:
            continue
        gain, own = float(found.gain[a]), robot.description.stiffness[a]
        # In a few seconds of motion, deviation and weight correlate by chance.
        reach = GRAVITY_ERRORS * float(found.error[a])
        softest, stiffest = 1 / gain + reach, 1 / gain - reach
        parameter = next((p for elements, p in searched.items() if names[a] in elements), None)
        low, high = (own / 2, own * 2) if parameter is None else (parameter.low, parameter.high)
        if softest < 0:
            say(
                f"warning: {joint} deviates from its command against gravity: by {found.deviation[a]:.2g} "
                f"rad or m, at a gravity torque of the model of {found.load[a]:.2g} N·m. Its sign or its "
                "zero is wrong; check the sign in the column map"
            )
        elif stiffest > 0 and (1 / softest > high or 1 / stiffest < low):
            say(
                f"warning: {joint} sags under gravity as with a gain of about {gain:.3g}; the model has "
                f"{own:.4g}. The search range ({low:.3g} to {high:.3g}) does not contain that gain: give "
                f"`nominal: {gain:.2g}` in the parameters"
            )


def sensitive_parameters(
    robot: RobotModel,
    space: ParameterSpace,
    episodes: Sequence[SampledEpisode],
    known_std: FloatArray | None,
    window_s: float,
    threads: int | None,
    say: Callable[[str], None],
) -> ParameterSpace:
    """Check before any search that the recordings are long enough, move, and depend on every parameter.

    Recordings without any command never show what an actuator does. Parameters without effect on these keep
    their nominal values; a sentence names them.

    Returns:
        The parameters to search.
    """
    from deal_hw.calib.data.checks import (
        check_excitation,
        compute_sensitivity,
        jumps,
        require_sensitive,
        target_changes,
    )
    from deal_hw.calib.data.parts import samples_in
    from deal_hw.calib.data.problem import Problem

    problem = Problem(robot, space, episodes, threads=threads, known_std=known_std)
    # Raises if not even one window of that length fits.
    problem.windows(samples_in(problem, window_s), offset=round(problem.smoothing_s / 2 / problem.period_s))
    try:
        check_excitation(problem)
    except InsufficientDataError as err:
        # Its own advice is for robots of deal-hw.
        raise InsufficientDataError(
            str(err).partition("; record again with")[0] + "; record more motion"
        ) from err
    found = compute_sensitivity(problem)
    if found.unseen and not target_changes(episodes) and len(found.unseen) < len(found.names):
        say(
            f"not identifiable without commands, so the model's values stay: {', '.join(found.unseen)}. "
            "Add a recording with commands to find them"
        )
        return space.with_known({name: space[name].nominal for name in found.unseen})
    expected = {n: mean for n in found.unseen if (mean := space[n].prior_mean) is not None}
    if expected and len(expected) < len(space):
        say(
            "no trace in these recordings, so these keep the value that their prior expects: "
            f"{', '.join(expected)}"
        )
        space, found = space.with_known(expected), found.without(expected)
    require_sensitive(found)
    if found.faint:
        say(
            f"warning: the recordings hardly depend on {', '.join(found.faint)}. Over its whole range each "
            "changes the predictions by less than the sensor's noise, so its estimate will be poor: "
            "record motion that depends on it, or give its value with --known"
        )
    rough = jumps(problem)
    if rough:
        worst = max(rough, key=lambda name: rough[name])
        say(
            f"warning: predictions jump (by {rough[worst]:.1g} rad or m) when {worst} changes by a "
            "millionth. The model's solver stops too early, and no fit can follow such jumps. Write <option "
            'tolerance="1e-15" iterations="200" ls_tolerance="1e-6" ls_iterations="200"/> into the MJCF'
        )
    return space
