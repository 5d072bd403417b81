#!/usr/bin/env python3
"""Calibrate ordinary robots whose MJCF has an owner's errors, and judge the results by the truth.

    python tools/ordinary_robots.py --kinds cartpole,leg --seeds 8100-8109 --out ordinary.json
    python tools/ordinary_robots.py --kinds arm --seeds 8100-8103 --weighed --out weighed.json
    python tools/ordinary_robots.py --table ordinary.json

MuJoCo explains each robot exactly. The owner's MJCF has other gains, dampings, frictions and armatures (a
factor of up to 2.5), one mass that is 1.2 to 1.6 times too large or too small, one zero that is up to 1.5
degrees off, and no latency, where the robot has up to 30 ms. Encoders have 12 bits a turn, and noise of
0.3 mrad (0.3 mm).

    arm       2 to 5 joints in series with position drives, 100 Hz
    motors    the same with torque drives under a controller of the owner's, 250 Hz
    cartpole  a cart that a motor drives, with a pole that swings below it, 100 Hz
    leg       hip, thigh and calf of a leg on a stand, with position drives, 50 Hz

With --weighed the mass that is wrong is given by --known. A row has the number of true values inside their
intervals, errors of the values that the recordings hold, chi2, colour and physics steps. Held is a value
whose interval reaches no further than 30 % to either side. Seeds from 8000 on are for reporting.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from measuring import Row, Rows, add_seeds, markdown, parser, read_rows

from deal_hw.calib.report.verdict import trust
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input, usual_method
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import FilesSettings

STEP_S, NOISE, COUNT = 0.002, 3e-4, 2 * np.pi / 4096
RECORDED_S = 10.0
HELD = 0.3
FACTORS = {
    "servo_stiffness": 1.7,
    "frictionloss": 2.5,
    "damping": 2.5,
    "servo_damping": 1.7,
    "armature": 2.5,
    "motor_gain": 1.4,
}
"""Largest factor by which an owner's value is off, by the end of the parameter's name."""

Values = dict[str, float]
"""Values by the name of the parameter, as in a result."""


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot and how it is recorded.

    Attributes:
        values: The true values.
        xml: Writes the MJCF with values.
        joints: Names of its joints.
        drives: Index of the driven joints, in the order of the actuators, named d0, d1, ...
        limit: Effort limits of the drives, (A,) [N or N·m].
        period_s: Time between two samples [s].
        feedback: Stiffness and damping of the owner's controller of torque drives, (2, A); None for position
            drives.
        reach: Size of the motion, (A,) [rad or m].
        masses: Names of the masses, one of which is wrong.
    """

    values: Values
    xml: Callable[[Values], str]
    joints: tuple[str, ...]
    drives: tuple[int, ...]
    limit: FloatArray
    period_s: float
    feedback: FloatArray | None
    reach: FloatArray
    masses: tuple[str, ...]


def mjcf(bodies: str, drives: str) -> str:
    """Return an MJCF with bodies and actuators."""
    options = f'<option timestep="{STEP_S}" integrator="implicitfast"/>'
    return (
        f'<mujoco><compiler angle="radian" autolimits="true"/>{options}'
        f"<worldbody>{bodies}</worldbody><actuator>{drives}</actuator></mujoco>"
    )


def joint(name: str, values: Values, rest: str) -> str:
    """Return a joint with its friction, damping and armature."""
    fields = " ".join(f'{f}="{values[f"{name}.{f}"]:.9g}"' for f in ("frictionloss", "damping", "armature"))
    return f'<joint name="{name}" {rest} {fields}/>'


def rod(length_m: FloatArray | Sequence[float], mass: float) -> str:
    """Return a thin link without contacts."""
    end = " ".join(f"{x:.5f}" for x in length_m)
    shape = f'type="capsule" size=".015" fromto="0 0 0 {end}" contype="0" conaffinity="0"'
    return f'<geom {shape} mass="{mass:.9g}"/>'


def arm(rng: np.random.Generator, *, motors: bool) -> Robot:
    """Return an arm of 2 to 5 links."""
    count = int(rng.integers(2, 6))
    axes = ["0 0 1", *("0 1 0" if rng.random() < 0.7 else "1 0 0" for _ in range(count - 1))]
    return chain(rng, axes, 0.01 if not motors else 0.004, motors=motors, reach=0.6)


def leg(rng: np.random.Generator) -> Robot:
    """Return a leg that hangs from a stand: hip, thigh and calf."""
    return chain(rng, ["1 0 0", "0 1 0", "0 1 0"], 0.02, motors=False, reach=0.5, down=True)


def chain(
    rng: np.random.Generator,
    axes: Sequence[str],
    period_s: float,
    *,
    motors: bool,
    reach: float,
    down: bool = False,
) -> Robot:
    """Return a chain of links, each with a drive."""
    count, side = len(axes), -1.0 if down else 1.0
    length, mass = rng.uniform(0.1, 0.3, count), np.sort(rng.uniform(0.1, 0.8, count))[::-1]
    load = 9.81 * np.cumsum((mass * length)[::-1])[::-1]
    values: Values = {}
    for k in range(count):
        stiffness = load[k] * rng.uniform(8, 20) + 3
        damping = stiffness * rng.uniform(0.02, 0.06)
        values[f"j{k}.frictionloss"] = load[k] * rng.uniform(0.02, 0.08) + 0.01
        values[f"j{k}.damping"] = damping * rng.uniform(0.05, 0.3)
        values[f"j{k}.armature"] = load[k] * rng.uniform(0.002, 0.01) + 0.001
        values |= (
            {f"d{k}.motor_gain": 1.0}
            if motors
            else {f"d{k}.servo_stiffness": stiffness, f"d{k}.servo_damping": damping}
        )
        values[f"link{k}.mass"] = mass[k]
    limit = 30 * load + 10

    def write(p: Values) -> str:
        bodies = ""
        for k, axis in enumerate(axes):
            at = side * (length[k - 1] if k else 0.1)
            rest = f'axis="{axis}" range="-2.6 2.6"'
            bodies += f'<body name="link{k}" pos="0 0 {at:.5f}">{joint(f"j{k}", p, rest)}'
            bodies += rod([0.02, 0, side * length[k]], p[f"link{k}.mass"])
        drives = ""
        for k in range(count):
            of = f'name="d{k}" joint="j{k}"'
            if motors:
                gain = f'gear="{p[f"d{k}.motor_gain"]:.9g}" ctrlrange="-{limit[k]:.5g} {limit[k]:.5g}"'
                drives += f"<motor {of} {gain}/>"
            else:
                gains = f'kp="{p[f"d{k}.servo_stiffness"]:.9g}" kv="{p[f"d{k}.servo_damping"]:.9g}"'
                drives += f'<position {of} {gains} forcerange="-{limit[k]:.5g} {limit[k]:.5g}"/>'
        return mjcf(bodies + "</body>" * count, drives)

    return Robot(
        values,
        write,
        tuple(f"j{k}" for k in range(count)),
        tuple(range(count)),
        limit,
        period_s,
        np.stack([12 * load, 0.35 * load]) if motors else None,
        np.full(count, reach),
        tuple(f"link{k}.mass" for k in range(count)),
    )


def cartpole(rng: np.random.Generator) -> Robot:
    """Return a cart that a motor drives, with a pole that swings below it."""
    cart, pole, length = rng.uniform(0.3, 0.9), rng.uniform(0.05, 0.3), rng.uniform(0.25, 0.6)
    weight = 9.81 * pole * length
    values = {
        "cart.frictionloss": rng.uniform(0.1, 0.6),
        "cart.damping": rng.uniform(0.5, 5.0),
        "cart.armature": rng.uniform(0.05, 0.8),
        "pole.frictionloss": weight * rng.uniform(0.002, 0.01),
        "pole.damping": weight * rng.uniform(0.001, 0.006),
        "pole.armature": pole * length**2 * rng.uniform(0.01, 0.1),
        "d0.motor_gain": rng.uniform(2.0, 15.0),
        "cart.mass": cart,
        "pole.mass": pole,
    }

    def write(p: Values) -> str:
        slide = joint("cart", p, 'type="slide" axis="1 0 0"')
        shape = 'type="box" size=".05 .03 .02" contype="0" conaffinity="0"'
        box = f'<geom {shape} mass="{p["cart.mass"]:.9g}"/>'
        hinge, link = joint("pole", p, 'axis="0 1 0"'), rod([0, 0, -length], p["pole.mass"])
        swing = f'<body name="pole">{hinge}{link}</body>'
        gain = f'gear="{p["d0.motor_gain"]:.9g}" ctrlrange="-1 1"'
        return mjcf(
            f'<body name="cart">{slide}{box}{swing}</body>', f'<motor name="d0" joint="cart" {gain}/>'
        )

    gain = values["d0.motor_gain"]
    stiffness = (values["cart.mass"] + values["cart.armature"]) * 9.0 / gain
    feedback = np.array([[stiffness], [0.3 * stiffness]])
    return Robot(
        values,
        write,
        ("cart", "pole"),
        (0,),
        np.array([1.0]),
        0.01,
        feedback,
        np.array([0.5]),
        ("cart.mass", "pole.mass"),
    )


KINDS: dict[str, Callable[[np.random.Generator], Robot]] = {
    "arm": lambda rng: arm(rng, motors=False),
    "motors": lambda rng: arm(rng, motors=True),
    "cartpole": cartpole,
    "leg": leg,
}


def owners(robot: Robot, rng: np.random.Generator, errors: float) -> tuple[Values, str]:
    """Return the values of the owner's MJCF, and the name of the mass that is wrong in it.

    ``errors`` is the exponent of the usual factors.
    """
    values = dict(robot.values)
    for name in values:
        if (factor := FACTORS.get(name.split(".")[1])) is not None:
            values[name] *= float(factor ** (errors * rng.uniform(-1, 1)))
    wrong = str(rng.choice(robot.masses))
    values[wrong] *= float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.2, 0.5)))
    return values, wrong


def record(
    robot: Robot,
    goal: Callable[[float], FloatArray],
    zero: FloatArray,
    latency_s: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Move the robot and return time, readings (C) and commands (A) of each sample, (T, 1 + C + A)."""
    model = mujoco.MjModel.from_xml_string(robot.xml(robot.values))
    data, drives = mujoco.MjData(model), list(robot.drives)
    if robot.feedback is None:
        data.qpos[drives] = goal(0.0) - zero[drives]
    rows: list[FloatArray] = []
    sent_s, sent = list[float](), list[FloatArray]()
    for step in range(round(RECORDED_S / STEP_S)):
        now = step * STEP_S
        if now >= len(rows) * robot.period_s - 1e-9:
            reading = COUNT * np.round((data.qpos + zero + rng.normal(0, NOISE, len(zero))) / COUNT)
            command = goal(now)
            if robot.feedback is not None:
                speed = data.qvel[drives] + rng.normal(0, 0.01, len(drives))
                force = robot.feedback[0] * (command - reading[drives]) - robot.feedback[1] * speed
                command = np.clip(force, -robot.limit, robot.limit)
            rows.append(np.concatenate([[len(rows) * robot.period_s], reading, command]))
            sent_s.append(rows[-1][0])
            sent.append(command)
        # The mean of the commands in force during the step; before the first, that one.
        edges = np.clip(np.array([now, now + STEP_S]) - latency_s, 0.0, None)
        first, last = np.maximum(np.searchsorted(sent_s, edges + 1e-12, side="right") - 1, 0)
        share = 1.0 if first == last else (edges[1] - sent_s[last]) / STEP_S
        data.ctrl[:] = share * sent[last] + (1 - share) * sent[first]
        if robot.feedback is None:
            # The servo closes its loop on the reading.
            data.ctrl[:] -= zero[drives]
        mujoco.mj_step(model, data)
    return np.stack(rows)


def motions(robot: Robot, rng: np.random.Generator) -> dict[str, Callable[[float], FloatArray]]:
    """Return sines and steps to fit, and other sines to hold out."""
    count = len(robot.drives)

    def sines() -> Callable[[float], FloatArray]:
        hertz, phase = rng.uniform(0.2, 1.8, (4, count)), rng.uniform(0, 2 * np.pi, (4, count))

        def goal(t: float) -> FloatArray:
            waves = np.sin(2 * np.pi * hertz * t + phase) - np.sin(phase)
            return np.asarray(0.4 * robot.reach * waves.sum(axis=0) * min(1.0, t))

        return goal

    levels = robot.reach * rng.uniform(-1, 1, (round(RECORDED_S / 0.5) + 1, count))
    levels[0] = 0.0
    return {"fit1": sines(), "fit2": lambda t: levels[int(t / 0.5)], "hold": sines()}


def write_case(
    kind: str, seed: int, folder: Path, *, errors: float = 1.0
) -> tuple[Values, Values, str, float]:
    """Write what an owner has; return the true values, the owner's, the wrong mass and the latency [s]."""
    rng = np.random.default_rng(seed)
    robot = KINDS[kind](rng)
    values, wrong = owners(robot, rng, errors)
    zero, latency_s = np.zeros(len(robot.joints)), float(rng.uniform(0, 0.03))
    zero[int(rng.integers(len(zero)))] = float(np.radians(rng.uniform(-1.5, 1.5)))
    (folder / "nominal.xml").write_text(robot.xml(values), encoding="utf-8")
    channels = []
    for k, name in enumerate(robot.joints):
        channel: dict[str, Any] = {"name": name, "position": f"{name}_pos"}
        if k in robot.drives:
            channel["target"] = f"{name}_command"
            if robot.feedback is not None:
                # The command is the control of the MJCF, and its effort that of the owner's gain.
                full = values[f"d{robot.drives.index(k)}.motor_gain"]
                channel["target_normalised"] = {"from": [-1.0, 1.0], "to": [-full, full]}
        channels.append(channel)
    columns = {"time": {"column": "t", "unit": "s"}, "unit": "rad", "joints": channels}
    (folder / "columns.yaml").write_text(yaml.safe_dump(columns, sort_keys=False), encoding="utf-8")
    head = ["t", *(f"{j}_pos" for j in robot.joints), *(f"{robot.joints[d]}_command" for d in robot.drives)]
    for name, goal in motions(robot, rng).items():
        rows = record(robot, goal, zero, latency_s, rng)
        np.savetxt(
            folder / f"{name}.csv", rows, delimiter=",", fmt="%.6f", comments="", header=",".join(head)
        )
    truth = dict(robot.values)
    truth |= {f"{j}.encoder_bias": float(z) for j, z in zip(robot.joints, zero, strict=True)}
    truth |= {f"d{k}.servo_effort_limit": float(limit) for k, limit in enumerate(robot.limit)}
    return truth, values, wrong, latency_s


def expected(truth: Values, owner: Values, names: Sequence[str]) -> Values:
    """Return the true value of each parameter; of two dampings that add up, only one may be searched."""
    found = {name: truth[name] for name in names}
    for name in names:
        element, quantity = name.split(".")
        other = {
            "damping": f"d{element[1:]}.servo_damping",
            "servo_damping": f"j{element[1:]}.damping",
        }.get(quantity)
        if other in truth and other not in names:
            found[name] += truth[other] - owner[other]
    return found


def measure(kind: str, seed: int, *, weighed: bool) -> Row:
    """Calibrate one robot by default and return its row."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth, owner, wrong, latency_s = write_case(kind, seed, folder)
        settings = FilesSettings(
            model=folder / "nominal.xml",
            data=(folder / "fit1.csv", folder / "fit2.csv"),
            holdout=(folder / "hold.csv",),
            columns=folder / "columns.yaml",
            known={wrong: truth[wrong]} if weighed else {},
            threads=1,
        )
        began = time.process_time()
        work = calibration_input(settings)
        result: CalibrationResult = calibrate_or_raise(settings, work, usual_method(settings, work))
        return judged(result, truth, owner, latency_s) | {"processor_seconds": time.process_time() - began}


def judged(result: CalibrationResult, truth: Values, owner: Values, latency_s: float) -> Row:
    """Return a result's row: its intervals and values beside the truth."""
    names = [p.name for p in result.space]
    true = expected(truth, owner, names)
    inside, errors = 0, []
    for name, value, (low, high), verdict in zip(
        names, result.estimate, result.interval, result.verdicts, strict=True
    ):
        inside += int(low <= true[name] <= high)
        linear = name.endswith("encoder_bias")
        if not linear and verdict == "identifiable" and max(high / value, value / low) - 1 <= HELD:
            errors.append(abs(float(value / true[name]) - 1))
    low, high = result.latency_interval_s or (np.nan, np.nan)
    return {
        "colour": trust(result).colour,
        "chi2": result.chi2,
        "heldout_chi2": result.provenance.get("heldout_chi2"),
        "inside": inside + int(low <= latency_s <= high),
        "shown": len(names) + 1,
        "held": len(errors),
        "error_median": float(np.median(errors)) if errors else None,
        "error_worst": max(errors, default=None),
        "latency_error_ms": 1e3 * (result.latency_s - latency_s),
        "steps": result.steps,
        "alarms": [str(alarm)[:160] for alarm in result.alarms],
        "estimates": {
            n: [float(v), *map(float, i), true[n]]
            for n, v, i in zip(names, result.estimate, result.interval, strict=True)
        },
    }


def table(rows: Sequence[Row]) -> str:
    """Return one line for each kind."""
    lines = []
    for kind in dict.fromkeys((row["kind"], row["weighed"]) for row in rows):
        of = [row for row in rows if (row["kind"], row["weighed"]) == kind and not row["error"]]
        if not of:
            continue
        errors = [row["error_median"] for row in of if row["error_median"] is not None]
        green = [row for row in of if row["colour"] == "green"]
        lines.append(
            (
                kind[0] + (", weighed" if kind[1] else ""),
                f"{len(green)} of {len(of)}",
                f"{sum(r['inside'] for r in of) / sum(r['shown'] for r in of):.3f}",
                f"{min((r['inside'] / r['shown'] for r in green), default=np.nan):.2f}",
                f"{100 * float(np.median(errors)):.2f}" if errors else "",
                f"{float(np.median([r['steps'] for r in of])) / 1e6:.1f}",
                f"{float(np.median([r['processor_seconds'] for r in of])):.0f}",
            )
        )
    heads = (
        "robot",
        "green",
        "coverage",
        "least under green",
        "error of held values, median [%]",
        "steps, median [M]",
        "processor seconds, median",
    )
    return markdown(heads, lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure kinds and seeds."""
    made = parser(__doc__, table=True)
    made.add_argument("--kinds", default=",".join(KINDS), help=f"default: {','.join(KINDS)}")
    made.add_argument("--weighed", action="store_true", help="give the wrong mass by --known")
    add_seeds(made)
    options = made.parse_args(arguments)
    if options.table is not None:
        print(table(read_rows(options.table)))
        return 0
    rows = Rows(__file__, options.out, names=("kind", "seed", "weighed"))
    for kind in options.kinds.split(","):
        for seed in options.seeds:
            key = {"kind": kind, "seed": seed, "weighed": options.weighed}
            rows.measured(
                key,
                f"{kind} {seed}",
                partial(measure, kind, seed, weighed=options.weighed),
                lambda row: f"{row['colour']}, chi2 {row['chi2']:.3g}, {row['inside']}/{row['shown']}",
            )
    print(table(rows.rows))
    return int(any(row["error"] for row in rows.rows))


if __name__ == "__main__":
    sys.exit(main())
