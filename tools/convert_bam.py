r"""Convert public recordings of a real servo with a weight on its arm into NPZ files, a model and set-ups.

The recordings are the raw JSON logs of Rhoban/bam (Apache-2.0): one servo lifts and swings a weight. Its
history has sixteen of a Dynamixel XL330-M288 (0.49 kg at 0.1 m, 6 s each at 190 Hz, four P gains):

    git clone https://github.com/Rhoban/bam
    git -C bam checkout af22604
    python tools/convert_bam.py bam/bam/data.bak/raw/*.json --out bam_xl330

Of each log it reads mass [kg], length [m], kp (the servo's P gain), trajectory and motor, and of each entry:

    timestamp      middle of the reading [s]
    position       [rad], 0 hanging
    speed          [rad/s]
    goal_position  [rad], written before the reading
    torque_enable  whether the motor was on; samples after it went off are left out

Of a lift too little is left. Besides kp400-sin_sin.npz and so on it writes pendulum.xml (the servo by its
data sheet), columns.yaml, parameters.yaml, and setups.yaml: the servo's stiffness is proportional to its P
gain, so recordings with different gains share one set of parameters. Fit three gains, and predict the fourth:

    cd bam_xl330
    deal-hw calibrate --model pendulum.xml --columns columns.yaml --parameters parameters.yaml \
        --setups setups.yaml --data kp100-*.npz kp200-*.npz kp800-*.npz --holdout kp400-*.npz \
        --heldout-window 1
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from deal_hw.errors import DealHwError
from deal_hw.reading import read_json, reading
from deal_hw.types import FloatArray

MOTOR = "xl330"
DUTY = 4096 / (2 * np.pi) / (256 * 885)
"""Duty for each rad of error and unit of the P gain: the firmware's, as bam measured it."""
STALL_NM, NO_LOAD_RAD_S, RATED_V = 0.52, 10.8, 5.0
"""XL330-M288 at its rated voltage, from its data sheet: 103 revolutions a minute without load."""
NOMINAL_KP = 400
"""P gain of the model's own stiffness; it is the servo's factory value."""

SHORTEST_S = 2.0
"""Recordings that end sooner are left out: a lift has 1.5 to 2 s until its motor goes off."""
LOG = "a raw log of bam"

COLUMNS = """\
# Servo with a weight of Rhoban/bam (Apache-2.0): meaning of the arrays in the NPZ files.
time: time
joints:
  - {name: shaft, position: position, velocity: velocity, target: goal, unit: rad}
"""
PARAMETERS = """\
parameters:
  - {kind: servo_stiffness, elements: servo}
  - {kind: servo_effort_limit, elements: servo}
  - {kind: dof_damping, elements: shaft}
  - {kind: dof_frictionloss, elements: shaft}
  - {kind: dof_armature, elements: shaft}
  - {kind: encoder_bias, elements: shaft}
"""
# The back-EMF is damping of the joint, because the duty is limited before it acts. Rotor and friction are no
# data sheet's: usual sizes of small servos. solimpfriction keeps a joint that friction holds at rest.
MODEL = """\
<mujoco model="pendulum">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="shaft" type="hinge" axis="0 1 0" damping="{damping:.4g}" frictionloss="0.02"
             armature="0.002" solimpfriction="0.999 0.999 0.001 0.5 2"/>
      <inertial pos="0 0 {drop:g}" mass="{mass:g}" diaginertia="1e-5 1e-5 1e-5"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="shaft" kp="{stiffness:.4g}" forcerange="-{stall:.4g} {stall:.4g}"/>
  </actuator>
</mujoco>
"""


@dataclass(frozen=True, slots=True)
class Log:
    """One recording while its motor was on.

    Attributes:
        name: Gain and trajectory.
        kp: The servo's P gain.
        rig: Mass [kg], length [m] and supply [V].
        arrays: Time, position, velocity and goal, (T,) each.
    """

    name: str
    kp: int
    rig: tuple[float, float, float]
    arrays: dict[str, FloatArray]


def read_log(path: Path) -> Log:
    """Read a raw log.

    Raises:
        DealHwError: It is no such log, or of another servo.
    """
    log: dict[str, Any] = read_json(path, dict[str, Any], LOG)
    with reading(path, LOG):
        if log["motor"] != MOTOR:
            raise DealHwError(f"the servo is {log['motor']}; this model is that of the {MOTOR}")
        entries = log["entries"]
        on = [bool(entry["torque_enable"]) for entry in entries]
        kept = entries[: on.index(False)] if False in on else entries
        columns = {
            "time": "timestamp",
            "position": "position",
            "velocity": "speed",
            "goal": "goal_position",
        }
        arrays = {name: np.array([float(e[key]) for e in kept]) for name, key in columns.items()}
        rig = float(log["mass"]), float(log["length"]), float(log["vin"])
        return Log(f"kp{log['kp']}-{log['trajectory']}", int(log["kp"]), rig, arrays)


def model_of(rig: tuple[float, float, float]) -> str:
    """Return the MJCF of the servo with its weight, by the data sheet."""
    mass, length, supply_v = rig
    stall = STALL_NM * supply_v / RATED_V
    return MODEL.format(
        damping=STALL_NM / NO_LOAD_RAD_S,
        drop=-length,
        mass=mass,
        stiffness=DUTY * NOMINAL_KP * stall,
        stall=stall,
    )


def setups_of(logs: list[Log]) -> str:
    """Return the set-ups: the stiffness that each P gain makes, YAML."""
    stall = STALL_NM * logs[0].rig[2] / RATED_V
    gains = sorted({log.kp for log in logs} - {NOMINAL_KP})
    found = {
        f"kp{kp}": {"recordings": f"kp{kp}-*", "stiffness": {"*": round(DUTY * kp * stall, 6)}}
        for kp in gains
    }
    return yaml.safe_dump({"setups": found}, sort_keys=False)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", type=Path, nargs="+", help="raw JSON logs of the source project")
    parser.add_argument("--out", type=Path, required=True, help="folder for NPZ files, model and YAML files")
    options = parser.parse_args(arguments)
    try:
        logs = [read_log(path) for path in options.logs]
        rigs = {log.rig for log in logs}
        if len(rigs) > 1:
            raise DealHwError(f"the logs are of {len(rigs)} weights, lengths or supplies; convert them apart")
    except DealHwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    for log in logs:
        if np.ptp(log.arrays["time"]) < SHORTEST_S:
            print(f"{log.name}: left out, its motor was on for less than {SHORTEST_S:g} s")
            continue
        columns: dict[str, Any] = {**log.arrays}
        np.savez_compressed(options.out / f"{log.name}.npz", **columns)
        print(options.out / f"{log.name}.npz")
    for name, text in (
        ("pendulum.xml", model_of(logs[0].rig)),
        ("columns.yaml", COLUMNS),
        ("parameters.yaml", PARAMETERS),
        ("setups.yaml", setups_of(logs)),
    ):
        (options.out / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
