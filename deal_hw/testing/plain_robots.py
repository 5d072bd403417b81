"""Robots in plain MuJoCo with hidden true parameters and deliberate faults, to test calibrations.

Only MuJoCo simulates here: an MJCF text, ``mj_step``, a delay of the commands, sensor noise, a CSV. The
calibrated model is the same text with other numbers, or lacks the effect of the fault.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.testing.plain_effects import Plant, in_file
from deal_hw.testing.plain_faults import (
    COARSE_S,
    FINE_S,
    LAG_S,
    MOTOR_PLAY,
    NOISE,
    SATURATION,
    SHARED,
    STEP,
    STEP_S,
    TURNING,
    WITH_ENCODERS,
    WITH_MOTORS,
    WITH_STEPS,
    WITHOUT,
    Fault,
    RightModel,
    SharedFault,
)
from deal_hw.types import FloatArray

RATE_HZ = 200.0


@dataclass(frozen=True, slots=True)
class _Joint:
    """A joint and its motor.

    Attributes:
        name: Name.
        damping: Damping [N·m·s/rad or N·s/m].
        frictionloss: Dry friction [N·m or N].
        armature: Inertia of the rotor [kg·m² or kg].
        kp: Stiffness of its servo [N·m/rad or N/m]; 0 for a joint without a motor.
        effort: Largest torque or force of a motor in the servo's place [N·m or N]; 0 where the robot would
            not hang: an arm that no servo holds falls onto itself.
    """

    name: str
    damping: float
    frictionloss: float
    armature: float
    kp: float
    effort: float = 0.0


@dataclass(frozen=True, slots=True)
class _Kind:
    """A robot: its joints, and bodies in MJCF with one ``{joint NAME}`` for each joint."""

    joints: tuple[_Joint, ...]
    bodies: str
    step_s: float = 0.001


KINDS: Mapping[str, _Kind] = {
    "pendulum": _Kind(
        (_Joint("pivot", 0.05, 0.02, 0.002, 4.0, 0.4),),
        '<body name="rod" pos="0 0 1">{pivot}<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.015" '
        'mass="{mass:0.25}"/></body>',
    ),
    "double-pendulum": _Kind(
        (_Joint("shoulder", 0.3, 0.1, 0.01, 30.0, 4.0), _Joint("elbow", 0.15, 0.05, 0.005, 15.0, 1.0)),
        '<body name="upper" pos="0 0 1">{shoulder}<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" '
        'mass="0.5"/><body name="fore" pos="0 0 -0.3">{elbow}<geom type="capsule" '
        'fromto="0 0 0 0 0 -0.25" size="0.015" mass="{mass:0.3}"/></body></body>',
    ),
    "arm": _Kind(
        (
            _Joint("yaw", 0.4, 0.12, 0.02, 40.0),
            _Joint("shoulder", 0.5, 0.15, 0.02, 60.0),
            _Joint("elbow", 0.3, 0.08, 0.01, 40.0),
        ),
        '<body name="base" pos="0 0 0.3">{yaw:0 0 1}<geom type="cylinder" size="0.05 0.04" mass="0.6"/>'
        '<body name="upper" pos="0 0 0.05" euler="0 0.8 0">{shoulder}<geom type="capsule" '
        'fromto="0 0 0 0 0 0.25" size="0.025" mass="0.5"/><body name="fore" pos="0 0 0.25" '
        'euler="0 0.7 0">{elbow}<geom type="capsule" fromto="0 0 0 0 0 0.22" size="0.02" '
        'mass="{mass:0.35}"/></body></body></body>',
    ),
    "cart-pole": _Kind(
        (_Joint("slide", 2.0, 0.6, 0.1, 300.0, 6.0), _Joint("pole", 0.004, 0.002, 0.0005, 0.0)),
        '<body name="cart" pos="0 0 1">{slide:slide}<geom type="box" size="0.05 0.04 0.03" mass="0.5"/>'
        '<body name="rod">{pole}<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.008" '
        'mass="{mass:0.12}"/></body></body>',
    ),
    "leg": _Kind(
        (
            _Joint("abduction", 0.2, 0.2, 0.01, 60.0, 4.0),
            _Joint("hip", 0.2, 0.2, 0.01, 60.0, 4.0),
            _Joint("knee", 0.2, 0.2, 0.02, 60.0, 1.5),
        ),
        '<body name="hip_body" pos="0 0 1">{abduction:1 0 0}<geom type="sphere" size="0.04" mass="0.7"/>'
        '<body name="thigh" pos="0 0.08 0" euler="0 0.7 0">{hip}<geom type="capsule" '
        'fromto="0 0 0 0 0 -0.21" size="0.02" mass="1.1"/><body name="shank" pos="0 0 -0.21" '
        'euler="0 -1.4 0">{knee}<geom type="capsule" fromto="0 0 0 0 0 -0.21" size="0.012" '
        'mass="{mass:0.22}"/></body></body></body>',
    ),
}
"""The robots by name: one to three joints, servos with and without a free joint behind them."""

SPREAD = {"damping": 2.0, "frictionloss": 2.0, "armature": 2.0, "kp": 1.5}
"""Truths lie within these factors of the model's values."""


@dataclass(frozen=True, slots=True)
class PlainRobot:
    """A model and its robot.

    Attributes:
        kind: A name in `KINDS`.
        model: MJCF of the model to calibrate.
        robot: MJCF of the robot.
        truth: The robot's values by the names that ``deal-hw calibrate --model`` gives them.
        delay_s: Mean delay of the commands, a whole number of physics steps [s].
        fault: Effect that the model lacks, or fault of its recordings, or a right model's kind, or None.
        seed: Of truth, motions and noise.
    """

    kind: str
    model: str
    robot: str
    truth: Mapping[str, float]
    delay_s: float
    fault: Fault | SharedFault | RightModel | None
    seed: int


def make_robot(kind: str, seed: int, fault: Fault | SharedFault | RightModel | None = None) -> PlainRobot:
    """Return a robot with a truth of its own.

    Raises:
        UnknownNameError: There is no such kind.
        ConfigurationError: It cannot have the fault.
    """
    if kind not in KINDS:
        raise UnknownNameError("robot", kind, KINDS)
    if not can_have(kind, fault):
        able = ", ".join(name for name in KINDS if can_have(name, fault))
        raise ConfigurationError(f"the robot {kind!r} cannot have the fault {fault!r}; these can: {able}")
    rng = np.random.default_rng([seed, *kind.encode()])
    made = KINDS[kind]
    truth: dict[str, float] = {}
    values: dict[str, dict[str, float]] = {}
    for joint in made.joints:
        own: dict[str, float] = {}
        for name, factor in SPREAD.items():
            own[name] = getattr(joint, name) * float(np.exp(rng.uniform(-1, 1) * np.log(factor)))
            if name == "kp" and fault in WITH_MOTORS and joint.kp:
                truth[f"{joint.name}.motor_gain"] = own[name] / joint.kp
            elif own[name]:
                truth[f"{joint.name}.{'servo_stiffness' if name == 'kp' else name}"] = own[name]
        values[joint.name] = own
    delay_s = made.step_s * int(rng.integers(2, 16))
    lacks = WITHOUT.get(fault or "", ())
    nominal = {j.name: {n: 0.0 if n in lacks else getattr(j, n) for n in SPREAD} for j in made.joints}
    return PlainRobot(
        kind=kind,
        model=_mjcf(
            kind, made, nominal, _modelled(fault), step_s=COARSE_S if fault in WITH_ENCODERS else made.step_s
        ),
        robot=_mjcf(kind, made, values, fault, step_s=FINE_S if fault in WITH_ENCODERS else made.step_s),
        truth=truth,
        delay_s=delay_s,
        fault=fault,
        seed=seed,
    )


def _modelled(fault: str | None) -> str | None:
    """Return the fault that a model has by its drives alone: motors or limited servos, as the robot has."""
    return fault if fault in (*WITH_MOTORS, *WITH_STEPS) else None


def _mjcf(
    kind: str,
    made: _Kind,
    values: Mapping[str, Mapping[str, float]],
    fault: str | None = None,
    *,
    step_s: float,
) -> str:
    bodies, actuators = made.bodies, []
    driven = [joint.name for joint in made.joints if joint.kp]
    for joint in made.joints:
        own = dict(values[joint.name])
        if fault in WITH_ENCODERS and joint.kp:
            # The PD damps in the joint's place.
            own["damping"] = 0.0
        start = bodies.index("{" + joint.name)
        end = bodies.index("}", start) + 1
        _, _, axis = bodies[start + 1 : end - 1].partition(":")
        place = 'type="slide" axis="1 0 0"' if axis == "slide" else f'axis="{axis or "0 1 0"}"'
        text = f'<joint name="{joint.name}" {place} ' + " ".join(
            f'{name}="{own[name]:.9g}"' for name in ("damping", "frictionloss", "armature")
        )
        text += "/>"
        if fault == "motor-play" and joint.name == driven[-1]:
            half = MOTOR_PLAY["slide" if axis == "slide" else "hinge"] / 2
            # The rotor moves with the joint; the link follows it within the play.
            text += f'<joint name="{joint.name}.play" {place} limited="true" range="{-half:.9g} {half:.9g}"/>'
        bodies = bodies[:start] + text + bodies[end:]
        if joint.kp:
            actuators.append(_drive(joint, own["kp"], fault))
    start = bodies.index("{mass:")
    end = bodies.index("}", start)
    heavier = 1.5 if fault == "mass" else 1.0
    bodies = bodies[:start] + f"{heavier * float(bodies[start + 6 : end]):.9g}" + bodies[end + 1 :]
    return (
        f'<mujoco model="{kind}"><compiler angle="radian"/>'
        f'<option timestep="{step_s:g}" integrator="implicitfast"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{''.join(actuators)}</actuator></mujoco>\n"
    )


def _drive(joint: _Joint, kp: float, fault: str | None) -> str:
    """Return a joint's actuator in MJCF."""
    named = f'name="{joint.name}" joint="{joint.name}"'
    if fault in WITH_MOTORS:
        return f'<motor {named} gear="{kp / joint.kp:.9g}"/>'
    if fault in WITH_ENCODERS:
        return f"<motor {named}/>"
    more = ""
    if fault == "lag":
        more = f' timeconst="{LAG_S:g}"'
    elif fault in WITH_STEPS:
        # The torque at standstill is that of a data sheet, which the model has, too.
        stall = SATURATION * joint.kp
        more = f' forcerange="{-stall:.9g} {stall:.9g}"'
    return f'<position {named} kp="{kp:.9g}"{more}/>'


def record(robot: PlainRobot, number: int, seconds: float) -> str:
    """Return a recording as CSV text: time, positions and commands.

    Args:
        robot: The robot.
        number: Number of the motion.
        seconds: Duration [s].
    """
    # A fault may give the robot more joints than its model has.
    nominal = mujoco.MjModel.from_xml_string(robot.model)
    names = [nominal.joint(j).name for j in range(nominal.njnt)]
    effort = [j.effort for j in KINDS[robot.kind].joints if j.kp] if robot.fault in WITH_MOTORS else []
    zero = np.random.default_rng([robot.seed, number, 11]).uniform(-1, 1, len(names))
    plant = Plant(robot.robot, names, robot.fault, robot.truth, effort, zero)
    rng = np.random.default_rng([robot.seed, number, 7])
    step_s, rows = float(plant.model.opt.timestep), round(seconds * RATE_HZ)
    substeps, time = round(1 / (RATE_HZ * step_s)), np.arange(rows) / RATE_HZ
    commands = _motion(rng, time, len(plant.moved))
    if robot.fault in WITH_MOTORS:
        commands *= effort
    if robot.fault in WITH_STEPS:
        commands += _steps(np.random.default_rng([robot.seed, number, 13]), time, len(plant.moved))
    arrives = np.full(rows, round(robot.delay_s / step_s)) + substeps * np.arange(rows)
    if robot.fault == "jitter":
        late = rng.uniform(0.0, 2.0 * robot.delay_s / step_s, rows)
        arrives = np.maximum.accumulate(substeps * np.arange(rows) + late.astype(np.int64))
    positions = np.empty((rows, len(names)))
    next_row = 0
    for step in range(rows * substeps):
        if step % substeps == 0:
            positions[step // substeps] = plant.read()
        while next_row < rows and arrives[next_row] <= step:
            next_row += 1
        plant.step(commands[max(next_row - 1, 0)])
    if robot.fault in WITH_ENCODERS:
        measured = np.round(positions / plant.count) * plant.count
    else:
        measured = positions + NOISE * rng.standard_normal(positions.shape)
    time, measured, commands = in_file(robot.fault, time, measured, commands)
    header = ",".join(["time", *names, *(f"{name}.command" for name in plant.moved)])
    lines = [
        ",".join(f"{value:.7g}" for value in (t, *position, *command))
        for t, position, command in zip(time, measured, commands, strict=True)
    ]
    return "\n".join([header, *lines]) + "\n"


def can_have(kind: str, fault: str | None) -> bool:
    """Return whether a fault makes sense for a robot.

    Swapped joints need two of one type, a doubled joint another one beside it. Motors need a robot that
    hangs. A servo with a free speed turns, and so does a harmonic drive. In the loop of a servo an encoder's
    scale looks as other gains and inertias do, so it is that of a joint without a motor.
    """
    joints = KINDS[kind].joints
    if fault == "swapped":
        return len(joints) > 1 and all(joint.kp for joint in joints[-2:])
    if fault == "doubled-joint":
        return len(joints) > 1
    if fault in WITH_MOTORS:
        return all(joint.effort for joint in joints if joint.kp)
    if fault in TURNING:
        return ":slide" not in KINDS[kind].bodies
    return fault != "encoder-scale" or not joints[-1].kp


def shared_words(kind: str, fault: SharedFault) -> tuple[str, ...]:
    """Return phrases; a message that names the fault of the recordings has one of them."""
    names = [joint.name for joint in KINDS[kind].joints]
    every = f"positions of {names[0]}" if len(names) == 1 else "all positions"
    before = names[max(len(names) - 2, 0)]
    return tuple(words.format(last=names[-1], before=before, all=every) for words in SHARED[fault][1:])


def _motion(rng: np.random.Generator, time: FloatArray, count: int) -> FloatArray:
    """Return set-points of six sines and a hold in between, starting at rest, (T, count)."""
    found = np.zeros((len(time), count))
    for column in range(count):
        for _ in range(6):
            frequency, phase = rng.uniform(0.1, 1.6), rng.uniform(0, 2 * np.pi)
            found[:, column] += rng.uniform(0.04, 0.2) * np.sin(2 * np.pi * frequency * time + phase)
    return np.asarray((found - found[0]) * np.minimum(time, 1.0)[:, None])


def _steps(rng: np.random.Generator, time: FloatArray, count: int) -> FloatArray:
    """Return set-points that step to another value at even times, the first of them 0, (T, count)."""
    number = (time / STEP_S).astype(np.int64)
    levels = rng.uniform(-STEP, STEP, (int(number[-1]) + 1, count))
    levels[0] = 0.0
    return np.asarray(levels[number])


def write(robot: PlainRobot, folder: Path, *, seconds: float = 12.0) -> tuple[Path, list[Path], Path]:
    """Write the model, two recordings to fit and one that only judges.

    Args:
        robot: The robot.
        folder: Folder to write to.
        seconds: Length of each recording [s].

    Returns:
        Model, recordings to fit, held-out recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    model = folder / "robot.xml"
    model.write_text(robot.model, encoding="utf-8")
    paths = [folder / name for name in ("fit1.csv", "fit2.csv", "held-out.csv")]
    for number, path in enumerate(paths):
        path.write_text(record(robot, number, seconds), encoding="utf-8")
    return model, paths[:2], paths[2]
