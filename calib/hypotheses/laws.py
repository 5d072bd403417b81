"""The table of laws and quantities that a model may lack, each a hypothesis on the robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.hypotheses.cause_words import LOOKS
from deal_hw.calib.hypotheses.hypothesis import Hypothesis
from deal_hw.calib.hypotheses.signatures import Cause, masses
from deal_hw.calib.hypotheses.wider_models import MOST_FORCE, motion, zero_parameters
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, Scale
from deal_hw.sim.parameters import KIND_TABLE, with_doubts
from deal_hw.sim.parameters.default_space import default_space
from deal_hw.sim.parameters.laws import FREE_SPEED, STRIBECK_SPEED
from deal_hw.sim.parameters.sensor import ENCODER_SCALE
from deal_hw.sim.parameters.transmission import TRANSMISSION_STIFFNESS
from deal_hw.sim.recordings.effort_limits import drives_at_limit

MOST_PLAY = 0.5
"""Widest play, as a share of the commands' span [-]."""

MOST_LAG_S = 0.1
"""Longest time constant of a drive that is tried [s]. A hobby servo's filter is below 0.05 s."""

FIRST_LAG_S = 0.005
"""Time constant from which its fit begins [s]."""

MOST_ASYMMETRY = 0.5
"""Largest share by which a motor does more to one side that is tried [-]."""

MOST_DEAD_ZONE = 0.5
"""Largest dead zone of a motor that is tried, as a share of its largest command [-]."""

MOST_SERVO_DEAD_ZONE = 0.1
"""The same of a servo [rad or m]. AX-12A: 0.0051 rad as it is delivered; HerkuleX: below 10 counts of 0.0057
rad are recommended."""

FREE_SPEEDS = (3.0, 1.0, 100.0)
"""Free speed at which a fit begins, the least and the largest one, in rms speeds of the joint [-]. The
largest one takes a hundredth of the effort at that speed."""

MOST_SCALE = 1.5
"""Largest factor by which an encoder is tried to report more or less [-]."""

FIRST_SHARE = 0.3
"""How much more or less friction at rest a fit begins with, as a share of that in motion [-]."""

SPEEDS = (0.01, 1.0)
"""Least and largest Stribeck speed that is tried, in rms speeds of the joint [-]. A faster one cannot be told
from less damping."""


def _friction(problem: Problem) -> list[Parameter]:
    return _at_zero(problem, "dof_frictionloss")


def _damping(problem: Problem) -> list[Parameter]:
    return _at_zero(problem, "dof_damping")


def _rotor(problem: Problem) -> list[Parameter]:
    return _at_zero(problem, "dof_armature")


def _at_zero(problem: Problem, kind: str) -> list[Parameter]:
    return [p for p in zero_parameters(problem) if p.kind == kind]


def _together(problem: Problem) -> list[Parameter]:
    """Return all quantities that are 0, where they are of several kinds."""
    found = zero_parameters(problem)
    return found if len({p.kind for p in found}) > 1 else []


def _dampings(problem: Problem) -> list[Parameter]:
    return [p for p in _at_limits(problem) if p.kind != "servo_effort_limit"]


def _at_limits(problem: Problem) -> list[Parameter]:
    """Return limits and both dampings of drives that reach their effort limit, but those that are searched.

    A limit cuts a drive's damping, but not its joint's: one does not stand for the other there.
    """
    of, model = problem.robot, problem.robot.model
    drives = set(drives_at_limit(of, problem.episodes))
    joints = {j for name, j in zip(of.actuator_names, of.description.actuated, strict=True) if name in drives}
    if not drives:
        return []
    taken = {(p.kind, element) for p in problem.space.parameters for element in p.elements}
    wanted = {"servo_effort_limit": drives, "servo_damping": drives, "dof_damping": joints}
    return [
        p
        for p in with_doubts(default_space(model, drives))
        if set(p.elements) <= wanted.get(p.kind, set()) and (p.kind, p.elements[0]) not in taken
    ]


def _play(problem: Problem) -> list[Parameter]:
    here = any(_searched(problem, kind) for kind in ("servo_play", TRANSMISSION_STIFFNESS))
    if here:
        return []
    span = np.max([np.ptp(e.target, axis=0) for e in problem.episodes], axis=0)
    return [
        _parameter(problem, "servo_play", name, 0.0, 0.0, MOST_PLAY * float(most))
        for name, most in zip(problem.robot.actuator_names, span, strict=True)
        if most > 0 and _usable(problem, "servo_play", name)
    ]


def _falling(problem: Problem) -> list[Parameter]:
    return _by_speed(problem, 1)


def _rising(problem: Problem) -> list[Parameter]:
    return _by_speed(problem, -1)


def _by_speed(problem: Problem, sign: int) -> list[Parameter]:
    """Return dry friction that is larger, or smaller, at rest than in motion."""
    if _searched(problem, "dof_friction_stribeck"):
        return []
    model, found, speeds = problem.robot.model, [], []
    for name, speed, push in zip(problem.robot.description.joint_names, *motion(problem), strict=True):
        coulomb = float(model.dof_frictionloss[int(model.joint(name).dofadr[0])])
        if coulomb <= 0 or speed <= 0:
            # Without dry friction in the model that comes first.
            continue
        most = sign * max(MOST_FORCE * float(push), MOST_FORCE * coulomb)
        first = sign * FIRST_SHARE * coulomb
        found.append(
            _parameter(problem, "dof_friction_stribeck", name, first, min(most, 0.0), max(most, 0.0))
        )
        first_speed = float(np.clip(STRIBECK_SPEED, 2 * SPEEDS[0] * speed, 0.5 * SPEEDS[1] * speed))
        ends = SPEEDS[0] * float(speed), SPEEDS[1] * float(speed)
        speeds.append(_parameter(problem, "dof_stribeck_speed", name, first_speed, *ends, scale="log"))
    return [*found, *speeds]


def _load(problem: Problem) -> list[Parameter]:
    if any(_searched(problem, kind) for kind in ("dof_friction_load", "dof_friction_motor")):
        return []
    driven = problem.robot.description.actuated
    return [Parameter.friction_by_load(name, (name,)) for name in driven]


def _motor_load(problem: Problem) -> list[Parameter]:
    return [
        _parameter(problem, "dof_friction_motor", p.elements[0], p.nominal, 0.0, p.high)
        for p in _load(problem)
    ]


def _lag(problem: Problem) -> list[Parameter]:
    if _searched(problem, "command_lag"):
        return []
    filters, names = problem.robot.filters, problem.robot.actuator_names
    # A filter of the MJCF acts already: then the question is whether its time constant is another.
    own = np.zeros(len(names)) if filters is None else filters.lag_s
    return [
        _parameter(
            problem, "command_lag", name, float(lag) or FIRST_LAG_S, 0.0, max(MOST_LAG_S, 2 * float(lag))
        )
        for name, lag in zip(names, own, strict=True)
    ]


def _motor(problem: Problem) -> list[Parameter]:
    if _searched(problem, "command_asymmetry"):
        return []
    return [
        _parameter(problem, "command_asymmetry", name, 0.0, -MOST_ASYMMETRY, MOST_ASYMMETRY)
        for name in problem.robot.actuator_names
        if _usable(problem, "command_asymmetry", name)
    ]


def _motor_dead_zone(problem: Problem) -> list[Parameter]:
    if _searched(problem, "command_dead_zone"):
        return []
    sent = np.max([np.max(np.abs(e.target), axis=0) for e in problem.episodes], axis=0)
    return [
        _parameter(problem, "command_dead_zone", name, 0.0, 0.0, MOST_DEAD_ZONE * float(most))
        for name, most in zip(problem.robot.actuator_names, sent, strict=True)
        if most > 0 and _usable(problem, "command_dead_zone", name)
    ]


def _servo_dead_zone(problem: Problem) -> list[Parameter]:
    if any(_searched(problem, kind) for kind in ("servo_dead_zone", TRANSMISSION_STIFFNESS)):
        return []
    return [
        _parameter(problem, "servo_dead_zone", name, 0.0, 0.0, MOST_SERVO_DEAD_ZONE)
        for name in problem.robot.actuator_names
        if _usable(problem, "servo_dead_zone", name)
    ]


def _free_speed(problem: Problem) -> list[Parameter]:
    if _searched(problem, FREE_SPEED):
        return []
    facts, speeds = problem.robot.description, motion(problem)[0]
    found = []
    for name, joint in zip(problem.robot.actuator_names, facts.actuated, strict=True):
        speed = float(speeds[facts.joint_names.index(joint)])
        if speed > 0 and _usable(problem, FREE_SPEED, name):
            first, low, high = (factor * speed for factor in FREE_SPEEDS)
            found.append(_parameter(problem, FREE_SPEED, name, first, low, high, scale="log"))
    return found


def _scale(problem: Problem) -> list[Parameter]:
    if _searched(problem, ENCODER_SCALE):
        return []
    facts = problem.robot.description
    servos = [name for name, servo in zip(facts.actuated, facts.servos, strict=True) if servo]
    # In the loop of a servo a scale looks as other gains and inertias do.
    return [
        _parameter(problem, ENCODER_SCALE, name, 1.0, 1 / MOST_SCALE, MOST_SCALE, scale="log")
        for name in facts.joint_names
        if name not in servos
    ]


_NOT_SEARCHED = "In your model this is 0, so it was not searched. Other values compensate for it."
_WRITE = (
    "Write values above 0 into the MJCF at {}, such as these, and calibrate again. Or give them nominal "
    "values and ranges in a parameter file (--parameters)."
)
_TAKE = "Use this result: it has them as {}, and so has its MJCF."


def _zero(name: str, cause: Cause, parameters: Callable[[Problem], list[Parameter]]) -> Hypothesis:
    return Hypothesis(name, cause, parameters, _NOT_SEARCHED, _WRITE, _TAKE, in_mjcf=True, far=True)


ZEROS: Sequence[Hypothesis] = (
    _zero("dry friction that is 0 in the model", "friction", _friction),
    _zero("damping that is 0 in the model", "damping", _damping),
    _zero("a rotor's inertia that is 0 in the model", "inertia", _rotor),
    _zero("several quantities that are 0 in the model", "inertia", _together),
)
"""Quantities that an MJCF can say, and this one does not: a model made from a URDF often has none of them."""


def _at_limit(name: str, parameters: Callable[[Problem], list[Parameter]]) -> Hypothesis:
    return Hypothesis(
        name,
        "drive",
        parameters,
        "Drives reach their effort limit. There the limit acts, and it cuts the drive's damping but not that "
        "of the joint, so each of them has a value of its own. They were not searched.",
        "Free servo_effort_limit, servo_damping and dof_damping of {} (--parameters).",
        _TAKE,
        in_mjcf=True,
        certain=True,
    )


LIMITS: Sequence[Hypothesis] = (
    _at_limit("other dampings of drives at their effort limit", _dampings),
    _at_limit("other dampings and effort limits of drives at these limits", _at_limits),
)
"""What shows only where drives reach their limits, that with the fewest parameters first."""

ZERO_CAUSES: Mapping[str, Cause] = {
    "dof_armature": "inertia",
    "dof_frictionloss": "friction",
    "dof_damping": "damping",
}
"""Cause that a parameter stands for which is 0 in the model."""

PLAY = Hypothesis(
    "play in the gears",
    "backlash",
    _play,
    "Motor and joint do not move as one where the motion or the load turns round. The encoder may be on "
    "either side.",
    "Repair the gear of {}, or free servo_play there (--parameters).",
    "Repair the gear. Until then use this result: it has the play as {}.",
    hidden=True,
    far=True,
)

LAG = Hypothesis(
    "drives that lag",
    "drive",
    _lag,
    "The drive follows its command with a first-order lag, as one with a filter or an inductance does.",
    "Free command_lag of {} (--parameters).",
    "Use this result: it has the lag as {}. In your own MuJoCo loop deal_hw.sim.actuators applies it.",
    hidden=True,
)

HYPOTHESES: Sequence[Hypothesis] = (
    *ZEROS,
    PLAY,
    Hypothesis(
        "friction that falls with speed",
        "friction",
        _falling,
        "Dry friction is larger at rest than in motion (Stribeck). That of MuJoCo is constant.",
        "Free dof_friction_stribeck and dof_stribeck_speed of {} (--parameters).",
        "Use this result: it has the law as {}. In your own MuJoCo loop deal_hw.sim.actuators applies it.",
    ),
    Hypothesis(
        "friction that rises with speed",
        "friction",
        _rising,
        "Dry friction is smaller at rest than in motion, so friction grows less than in proportion to speed, "
        "as in harmonic drives. That of MuJoCo is a constant and a straight line.",
        "Free dof_friction_stribeck, below 0, and dof_stribeck_speed of {} (--parameters).",
        "Use this result: it has the law as {}. In your own MuJoCo loop deal_hw.sim.actuators applies it.",
    ),
    Hypothesis(
        "friction that grows with load",
        "friction",
        _load,
        "Dry friction grows with the torque that the gear transmits. That of MuJoCo is constant.",
        "Free dof_friction_load of {} (--parameters).",
        "Use this result: it has the law as {}. In your own MuJoCo loop deal_hw.sim.actuators applies it.",
    ),
    Hypothesis(
        "friction that grows with the motor's torque",
        "friction",
        _motor_load,
        "Dry friction grows with the torque of the motor, and not with that from outside. So it is in most "
        "servos that were identified (BAM, model M6). That of MuJoCo is constant.",
        "Free dof_friction_motor of {} (--parameters).",
        "Use this result: it has the law as {}. In your own MuJoCo loop deal_hw.sim.actuators applies it.",
    ),
    LAG,
    Hypothesis(
        "motors that do more to one side",
        "drive",
        _motor,
        "The same command has another effect to either side.",
        "Check the motor of {} and its drive, or free command_asymmetry there (--parameters).",
        "Check the motor and its drive. Until then use this result: it has the difference as {}.",
    ),
    Hypothesis(
        "motors with a dead zone",
        "drive",
        _motor_dead_zone,
        "Small commands have no effect, and larger ones lose as much, as with a bridge that takes a voltage.",
        "Free command_dead_zone of {} (--parameters).",
        "Use this result: it has the zone as {}. In your own MuJoCo loop deal_hw.sim.actuators applies it.",
    ),
    Hypothesis(
        "servos with a dead zone",
        "drive",
        _servo_dead_zone,
        "The servo has no effort while its error is small, as its firmware or its electronics may want.",
        "Make the dead zone of {} smaller in the servo, or free servo_dead_zone there (--parameters).",
        "Use this result: it has the zone as {}. In your own MuJoCo loop deal_hw.sim.actuators applies it.",
    ),
    Hypothesis(
        "effort that falls with speed",
        "drive",
        _free_speed,
        "The motor is on a limited voltage: its largest effort falls with speed. That of MuJoCo is constant.",
        "Free motor_free_speed of {} (--parameters).",
        "Use this result: it has the law as {}. In your own MuJoCo loop deal_hw.sim.actuators applies it.",
    ),
    Hypothesis(
        "encoders with another scale",
        "scale",
        _scale,
        "The encoder reports more or less than the joint moves, as with a wrong number of counts a turn.",
        "Check the counts a turn of {} in the column map, or free encoder_scale there (--parameters).",
        "Correct the counts a turn. Until then use this result: it has the scale as {}.",
    ),
)
"""What is asked, the simplest first."""


def other_masses(problem: Problem) -> list[Hypothesis]:
    """Return another mass of each moving body, each a hypothesis of its own.

    Motion under position servos shows ratios of masses, so all of them at once would not be determined.
    """
    looks, means, do = LOOKS["mass"]
    taken = "Weigh that body. Until then use this result: it has the mass as {}, and so has its MJCF."
    return [
        Hypothesis(
            f"{looks} of {p.elements[0]}", "mass", partial(_alone, mass=p), means, do, taken, in_mjcf=True
        )
        for p in masses(problem)
    ]


def _alone(problem: Problem, *, mass: Parameter) -> list[Parameter]:
    del problem
    return [mass]


def _searched(problem: Problem, kind: str) -> bool:
    return any(p.kind == kind for p in problem.space.parameters)


def _usable(problem: Problem, kind: str, element: str) -> bool:
    """Return whether an element can have a parameter of a kind."""
    of, model = KIND_TABLE[kind], problem.robot.model
    try:
        if of.usable is not None:
            of.usable(model, getattr(model, of.element)(element).id, element)
    except ConfigurationError:
        return False
    return True


def _parameter(
    problem: Problem,
    kind: str,
    element: str,
    nominal: float,
    low: float,
    high: float,
    scale: Scale = "linear",
) -> Parameter:
    of, model = KIND_TABLE[kind], problem.robot.model
    index = getattr(model, of.element)(element).id
    return Parameter(
        name=f"{element}.{of.quantity}",
        kind=kind,
        elements=(element,),
        unit=of.unit_of(model, index),
        nominal=nominal,
        low=low,
        high=high,
        scale=scale,
    )
