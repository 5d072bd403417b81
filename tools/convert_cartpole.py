r"""Convert public recordings of a real cart-pole into NPZ files, their column map and a MuJoCo model.

The recordings are the CSV files below Driver/ExperimentRecordings/ of SensorsINI/physical-cartpole, such as
"Swingups for Training V1/Experiment-0.csv" (commit 89b023a of its history; later commits left them out). That
repository has no licence: nothing of it is copied here, and this program reads your own copy.

    git clone https://github.com/SensorsINI/physical-cartpole
    git -C physical-cartpole checkout 89b023a
    python tools/convert_cartpole.py \
        physical-cartpole/Driver/ExperimentRecordings/Swing*V1/Experiment-[015].csv --out cartpole

Of each row it reads (CSV, or NPZ arrays of the same names):

    sent             the firmware's clock [s], even to the microsecond
    angle_raw        counts of the pole's potentiometer
    position         of the cart [m]
    actualMotorSave  pulse width as sent to the motor, +-4307.69 at full power; positive pulls to the left
    Q, angle         normalised motor power, and the angle by the log's own scale [rad]; for --as-logged

The potentiometer does not read as the log says. Hanging still is at 1209.82 counts, and a count is
0.001467 rad (swings of a known centre, both sides of the blind angle), where the log has 2 pi / 4096. Over
about 0.26 rad the slider touches nothing: the first and the last counts, below 8 and above 4086, are no
angles, and their rows are left out. So is a last reading before them that the sensor holds. The angle is
unwrapped; 0 is upright, as in the model. `--keep-gap` keeps these rows: the gap is from -5.19 to -4.92
rad, and the check `blind` of a calibration finds it and leaves its samples out. `--as-logged` keeps the
log's angle instead, which wraps at +-pi, all rows, and the normalised command: what `deal-hw data import`
says of these is worth reading.

Calibrate and import as the recordings of any robot:

    deal-hw data import cartpole/Experiment-0.npz --columns cartpole/columns.yaml \
        --model cartpole/cartpole.xml --out runs/cartpole/dataset

`tools/score_cartpole.py` fits all recordings but one, and predicts that one.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from converting import write_recordings

from deal_hw.data.importing.csv_source import read_csv
from deal_hw.data.importing.npz_source import read_npz
from deal_hw.types import FloatArray

HANGING_COUNT = 1209.82
RAD_PER_COUNT = 0.001467
FIRST_COUNT, LAST_COUNT = 8, 4086
"""Counts that are angles; the others are read while the slider crosses the gap of its track."""
MOVES_COUNTS, HELD = 20, 0.3
"""A reading is held if it changes by less than this share of a step of more than so many counts."""
FULL_PULSE = 4307.69
FULL_N = 2.62
"""Force of the motor at full power, by the project's own model [N]."""
ROTOR_KG = 1.4
"""Inertia of the motor's rotor, felt at the cart [kg]; the project's model has none."""

COLUMNS = """\
# Cart-pole of SensorsINI/physical-cartpole: meaning of the arrays in the NPZ files.
time: time
command_time: command_time
joints:
  - {name: cart, position: cart_position, target: cart_force, unit: m}
  - {name: pole, position: pole_angle, unit: rad}
"""
AS_LOGGED = f"""\
# Cart-pole of SensorsINI/physical-cartpole as logged: the angle wraps, the command is normalised.
time: time
joints:
  - {{name: cart, position: position, target: Q, unit: m, slides: true,
     target_normalised: {{from: [-1, 1], to: [-{FULL_N}, {FULL_N}]}}}}
  - {{name: pole, position: angle, unit: rad}}
"""
# Masses, length, friction and force as in the project's own files (its model of the plant). Pulses reach
# 1.09 times full power, since the firmware adds a pulse against dry friction.
MODEL = """\
<mujoco model="cartpole">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="cart">
      <joint name="cart" type="slide" axis="1 0 0" damping="4.77" frictionloss="0.2" armature="{rotor:g}"/>
      <inertial pos="0 0 0" mass="0.230" diaginertia="1e-4 1e-4 1e-4"/>
      <body name="pole">
        <joint name="pole" type="hinge" axis="0 -1 0" damping="2.5e-4" frictionloss="5e-4"/>
        <inertial pos="0 0 0.1975" mass="0.087" diaginertia="0.00113 0.00113 1e-6"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="cart" gear="{force:g}" ctrlrange="-1.1 1.1"/></actuator>
</mujoco>
"""


Mask = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True, slots=True)
class Log:
    """The columns of one recording that are used, (T,) each.

    Attributes:
        sent_s: The firmware's clock [s].
        count: Counts of the potentiometer.
        position_m: Of the cart [m].
        pulse: Pulse width as sent.
        power: Normalised motor power.
        angle: The log's own angle [rad].
    """

    sent_s: FloatArray
    count: FloatArray
    position_m: FloatArray
    pulse: FloatArray
    power: FloatArray
    angle: FloatArray

    @property
    def force_n(self) -> FloatArray:
        """Commanded force, along the model's axis, (T,) [N]."""
        return -self.pulse / FULL_PULSE * FULL_N


def read_log(path: Path) -> Log:
    """Read a recording, CSV or NPZ.

    Raises:
        DealHwError: It cannot be read, or a column is missing.
    """
    channels = read_npz(path) if path.suffix == ".npz" else read_csv(path)
    names = ("sent", "angle_raw", "position", "actualMotorSave", "Q", "angle")
    return Log(*(channels.column(name) for name in names))


def repaired(log: Log, keep_gap: bool = False) -> tuple[Mask, FloatArray]:
    """Return which rows have an angle, (T,), and the unwrapped angles of these [rad], 0 upright."""
    sound = ((log.count >= FIRST_COUNT) & (log.count <= LAST_COUNT)) | keep_gap
    return sound, np.unwrap((log.count[sound] - HANGING_COUNT) * RAD_PER_COUNT - np.pi)


def held(log: Log, sound: Mask) -> Mask:
    """Return which rows repeat the angle before them because the slider has left its track, (T,).

    The last reading before the gap sometimes does: 0.14 rad off, a hundred times the noise.
    """
    found = np.zeros(sound.size, dtype=bool)
    for k in range(2, sound.size - 1):
        if sound[k - 2 : k + 1].all() and not sound[k + 1]:
            before, last = np.abs(np.diff(log.count[k - 2 : k + 1]))
            found[k] = before > MOVES_COUNTS and last < HELD * before
    return found


def arrays(log: Log, as_logged: bool = False, keep_gap: bool = False) -> dict[str, Any]:
    """Return the arrays of the NPZ file; ``every_`` ones include held angles, for tools/score_cartpole.py."""
    if as_logged:
        return {"time": log.sent_s, "position": log.position_m, "angle": log.angle, "Q": log.power}
    sound, angle = repaired(log, keep_gap)
    kept = np.ones(angle.size, dtype=bool) if keep_gap else ~held(log, sound)[sound]
    return {
        "time": log.sent_s[sound][kept],
        "cart_position": log.position_m[sound][kept],
        "pole_angle": angle[kept],
        "every_time": log.sent_s[sound],
        "every_cart_position": log.position_m[sound],
        "every_pole_angle": angle,
        "command_time": log.sent_s,
        "cart_force": log.force_n,
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+", help="CSV files of the source, or NPZ files")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for NPZ files, columns.yaml and model"
    )
    kept = parser.add_mutually_exclusive_group()
    kept.add_argument("--keep-gap", action="store_true", help="keep rows in which the slider touches nothing")
    kept.add_argument("--as-logged", action="store_true", help="keep the log's angle and command")
    parser.add_argument(
        "--rotor", type=float, default=ROTOR_KG, help="armature of the cart [kg]; 0: not searched"
    )
    options = parser.parse_args(arguments)
    as_logged, keep_gap = options.as_logged, options.keep_gap

    def read(path: Path) -> dict[str, Any]:
        return arrays(read_log(path), as_logged, keep_gap)

    if not write_recordings(options.recordings, options.out, read):
        return 1
    (options.out / "columns.yaml").write_text(AS_LOGGED if options.as_logged else COLUMNS, encoding="utf-8")
    model = MODEL.format(rotor=options.rotor, force=FULL_N)
    (options.out / "cartpole.xml").write_text(model, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
