"""Robots in plain MuJoCo with hidden true parameters and deliberate faults, to test calibrations.

Only MuJoCo simulates here: an MJCF text, ``mj_step``, a delay of the commands, sensor noise, a CSV. The
calibrated model is the same text with other numbers, or lacks the effect of the fault.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from deal_hw.errors import UnknownNameError
from deal_hw.types import FloatArray

Fault = Literal["friction", "backlash", "motor-play", "jitter", "mass", "sign"]
RightModel = Literal["encoders"]
SharedFault = Literal[
    "mirrored", "swapped", "fast-clock", "slow-clock", "degrees", "doubled", "doubled-joint"
]

FAULTS: Mapping[Fault, str] = {
    "friction": "dry friction is four times as high at rest and falls with speed (Stribeck)",
    "backlash": "a gear with a play of 0.06 rad between servo and joint",
    "motor-play": "a gear with a play of 1 degree in the last joint, behind the motor's encoder of 12 bits",
    "jitter": "the delay of each command is between none and twice the mean",
    "mass": "the last link weighs 50 % more than in the model",
    "sign": "the last servo turns the other way",
}
"""Faults by name, with their descriptions."""

RIGHT_MODELS: Mapping[RightModel, str] = {
    "encoders": "the model is right; encoders of 12 bits, a PD at 1 kHz, physics steps of 2 ms in the model",
}
"""Robots inside the model's class by name, with their descriptions."""

WITH_ENCODERS = ("encoders", "motor-play")
"""Robots whose only noise is the rounding of their encoders: 1 degree of play would hide in white noise."""

SHARED: Mapping[SharedFault, tuple[str, ...]] = {
    "mirrored": (
        "the last joint has the other sign",
        "the sign of {last}",
        "{last} deviates from its command against gravity",
    ),
    "swapped": ("the last two joints are swapped", "{before} and {last} were swapped"),
    "fast-clock": ("the clock runs twice as fast", "the clock were 2 times too fast"),
    "slow-clock": ("the clock runs half as fast", "the clock were 2 times too slow"),
    "degrees": (
        "the last joint is in degrees",
        "positions of {last} were in degrees",
        "{last}: positions reach",
    ),
    "doubled": ("all positions are doubled", "{all} were multiplied by 2"),
    "doubled-joint": ("the last joint's positions are doubled", "positions of {last} were multiplied by 2"),
}
"""Faults of recordings that commands and measurements share: description, and the words of the message."""

CAUSES: Mapping[Fault, tuple[str, ...]] = {
    "friction": ("friction",),
    "backlash": ("backlash",),
    "motor-play": ("backlash",),
    "jitter": ("delay",),
    "mass": ("mass",),
    "sign": (),
}
"""Causes of the calibration's diagnosis that name the fault; a wrong sign is refused or warned of before."""

SIGN_WORDS = ("sign", "wrong way", "other way", "against")
"""A refusal or warning with one of these words names a servo that turns the other way."""

STRIBECK_SPEED = 0.15
"""Speed at which the extra dry friction has fallen to 1/e [rad/s or m/s]."""

STRIBECK_EXTRA = 3.0
PLAY = 0.06
MOTOR_PLAY = {"hinge": math.radians(1.0), "slide": 2e-3}
"""Play behind the encoder of the motor [rad or m]."""
COUNTS = {"hinge": 2 * math.pi / 4096, "slide": 1.0 / 4096}
"""A count of an encoder of 12 bits, of a turn or of 1 m [rad or m]."""
CONTROL_S = 0.001
"""Period of the PD that holds its torque, of the robot with encoders [s]."""
FINE_S = 0.00025
"""Physics step of that robot [s]."""
COARSE_S = 0.002
"""Physics step of its model [s]: no divisor of the sampling period, as in many published models."""
RATE_HZ = 200.0
NOISE = 1e-3
"""Standard deviation of a position sample [rad or m]."""


@dataclass(frozen=True, slots=True)
class _Joint:
    """A joint and its motor; ``kp`` 0 for a joint without a motor."""

    name: str
    damping: float
    frictionloss: float
    armature: float
    kp: float


@dataclass(frozen=True, slots=True)
class _Kind:
    """A robot: its joints, and bodies in MJCF with one ``{joint NAME}`` for each joint."""

    joints: tuple[_Joint, ...]
    bodies: str
    step_s: float = 0.001


KINDS: Mapping[str, _Kind] = {
    "pendulum": _Kind(
        (_Joint("pivot", 0.05, 0.02, 0.002, 4.0),),
        '<body name="rod" pos="0 0 1">{pivot}<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.015" '
        'mass="{mass:0.25}"/></body>',
    ),
    "double-pendulum": _Kind(
        (_Joint("shoulder", 0.3, 0.1, 0.01, 30.0), _Joint("elbow", 0.15, 0.05, 0.005, 15.0)),
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
        (_Joint("slide", 2.0, 0.6, 0.1, 300.0), _Joint("pole", 0.004, 0.002, 0.0005, 0.0)),
        '<body name="cart" pos="0 0 1">{slide:slide}<geom type="box" size="0.05 0.04 0.03" mass="0.5"/>'
        '<body name="rod">{pole}<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.008" '
        'mass="{mass:0.12}"/></body></body>',
    ),
    "leg": _Kind(
        (
            _Joint("abduction", 0.2, 0.2, 0.01, 60.0),
            _Joint("hip", 0.2, 0.2, 0.01, 60.0),
            _Joint("knee", 0.2, 0.2, 0.02, 60.0),
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
    """
    if kind not in KINDS:
        raise UnknownNameError("robot", kind, KINDS)
    rng = np.random.default_rng([seed, *kind.encode()])
    made = KINDS[kind]
    truth: dict[str, float] = {}
    values: dict[str, dict[str, float]] = {}
    for joint in made.joints:
        own: dict[str, float] = {}
        for name, factor in SPREAD.items():
            own[name] = getattr(joint, name) * float(np.exp(rng.uniform(-1, 1) * np.log(factor)))
            if own[name]:
                truth[f"{joint.name}.{'servo_stiffness' if name == 'kp' else name}"] = own[name]
        values[joint.name] = own
    delay_s = made.step_s * int(rng.integers(2, 16))
    nominal = {j.name: {n: getattr(j, n) for n in SPREAD} for j in made.joints}
    return PlainRobot(
        kind=kind,
        model=_mjcf(kind, made, nominal, step_s=COARSE_S if fault in WITH_ENCODERS else made.step_s),
        robot=_mjcf(kind, made, values, fault, step_s=FINE_S if fault in WITH_ENCODERS else made.step_s),
        truth=truth,
        delay_s=delay_s,
        fault=fault,
        seed=seed,
    )


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
        if joint.kp and fault in WITH_ENCODERS:
            actuators.append(f'<motor name="{joint.name}" joint="{joint.name}"/>')
        elif joint.kp:
            actuators.append(f'<position name="{joint.name}" joint="{joint.name}" kp="{own["kp"]:.9g}"/>')
    start = bodies.index("{mass:")
    end = bodies.index("}", start)
    heavier = 1.5 if fault == "mass" else 1.0
    bodies = bodies[:start] + f"{heavier * float(bodies[start + 6 : end]):.9g}" + bodies[end + 1 :]
    return (
        f'<mujoco model="{kind}"><compiler angle="radian"/>'
        f'<option timestep="{step_s:g}" integrator="implicitfast"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{''.join(actuators)}</actuator></mujoco>\n"
    )


def record(robot: PlainRobot, number: int, seconds: float) -> str:
    """Return a recording as CSV text: time, positions and commands.

    Args:
        robot: The robot.
        number: Number of the motion.
        seconds: Duration [s].
    """
    model = mujoco.MjModel.from_xml_string(robot.robot)
    data = mujoco.MjData(model)
    rng = np.random.default_rng([robot.seed, number, 7])
    step_s, rows = float(model.opt.timestep), round(seconds * RATE_HZ)
    substeps, time = round(1 / (RATE_HZ * step_s)), np.arange(rows) / RATE_HZ
    commands = _motion(rng, time, model.nu)
    arrives = np.full(rows, round(robot.delay_s / step_s)) + substeps * np.arange(rows)
    if robot.fault == "jitter":
        late = rng.uniform(0.0, 2.0 * robot.delay_s / step_s, rows)
        arrives = np.maximum.accumulate(substeps * np.arange(rows) + late.astype(np.int64))
    # A fault may give the robot more joints than its model has.
    nominal = mujoco.MjModel.from_xml_string(robot.model)
    names = [nominal.joint(j).name for j in range(nominal.njnt)]
    joint = model.actuator_trnid[:, 0]
    moved = [model.joint(int(i)).name for i in joint]
    dof, place = model.jnt_dofadr[joint], model.jnt_qposadr[joint]
    seen = np.array([int(model.joint(name).qposadr[0]) for name in names])
    slides = [int(model.joint(name).type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE) for name in names]
    count = np.array([COUNTS["slide" if slide else "hinge"] for slide in slides])
    at = [names.index(name) for name in moved]
    stiffness = np.array([robot.truth[f"{name}.servo_stiffness"] for name in moved])
    damping = np.array([robot.truth[f"{name}.damping"] for name in moved])
    held = round(CONTROL_S / step_s)
    positions = np.empty((rows, len(names)))
    next_row, engaged = 0, data.qpos[place].copy()
    for step in range(rows * substeps):
        if step % substeps == 0:
            positions[step // substeps] = data.qpos[seen]
        while next_row < rows and arrives[next_row] <= step:
            next_row += 1
        wanted = commands[max(next_row - 1, 0)].copy()
        if robot.fault == "backlash":
            # The servo's side of the gear: it drives the joint only where the play is used up.
            engaged = np.clip(engaged, wanted - PLAY / 2, wanted + PLAY / 2)
            wanted = engaged
        if robot.fault == "sign":
            wanted[-1] = -wanted[-1]
        if robot.fault in WITH_ENCODERS:
            if step % held == 0:
                read = np.round(data.qpos[place] / count[at]) * count[at]
                data.ctrl[:] = stiffness * (wanted - read) - damping * data.qvel[dof]
        else:
            data.ctrl[:] = wanted
        if robot.fault == "friction":
            speed = data.qvel[dof]
            extra = STRIBECK_EXTRA * model.dof_frictionloss[dof] * np.exp(-np.abs(speed) / STRIBECK_SPEED)
            data.qfrc_applied[dof] = -extra * np.tanh(speed / 0.01)
        mujoco.mj_step(model, data)
    if robot.fault in WITH_ENCODERS:
        measured = np.round(positions / count) * count
    else:
        measured = positions + NOISE * rng.standard_normal(positions.shape)
    time, measured, commands = _shared(robot.fault, time, measured, commands)
    header = ",".join(["time", *names, *(f"{name}.command" for name in moved)])
    lines = [
        ",".join(f"{value:.7g}" for value in (t, *position, *command))
        for t, position, command in zip(time, measured, commands, strict=True)
    ]
    return "\n".join([header, *lines]) + "\n"


def _shared(
    fault: str | None, time: FloatArray, measured: FloatArray, commands: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a recording with the robot's shared fault; a free last joint has no command."""
    time, measured, commands = time.copy(), measured.copy(), commands.copy()
    last = [measured[:, -1], *([commands[:, -1]] if commands.shape == measured.shape else [])]
    factors = {"mirrored": -1.0, "degrees": 180 / np.pi, "doubled-joint": 2.0}
    for values in last:
        values *= factors.get(fault or "", 1.0)
    if fault == "swapped":
        measured[:, -2:], commands[:, -2:] = measured[:, :-3:-1].copy(), commands[:, :-3:-1].copy()
    if fault == "doubled":
        measured, commands = 2 * measured, 2 * commands
    return time * {"fast-clock": 2.0, "slow-clock": 0.5}.get(fault or "", 1.0), measured, commands


def has_shared(kind: str, fault: SharedFault) -> bool:
    """Return whether a robot has enough joints of one type for a fault of its recordings."""
    joints = KINDS[kind].joints
    if fault == "swapped":
        return len(joints) > 1 and all(joint.kp for joint in joints[-2:])
    return fault != "doubled-joint" or len(joints) > 1


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
