r"""Convert public recordings of a real pendulum on an AK80-6 drive into NPZ files, a column map and a model.

The recordings are the files data_measured.csv below results/ of the repository
dfki-ric-underactuated-lab/torque_limited_simple_pendulum (BSD-3-Clause, commit ed17ea2). One quasi-direct
drive with a gear of 6 swings up a weight of 0.546 kg at 0.5 m, by different controllers:

    git clone https://github.com/dfki-ric-underactuated-lab/torque_limited_simple_pendulum pendulum
    python tools/convert_simple_pendulum.py \
        pendulum/results/control_method_{sac,direct_collocation,energy_shaping,ddp}/data_measured.csv \
        --out simple_pendulum

Each column has a head:

    time      [s]
    position  [rad], 0 hanging
    velocity  [rad/s]
    torque    measured by the drive, behind the gear [N·m]

The command is the measured torque. The torques of data_desired.csv are not what every controller sent: two of
these recordings add a position loop of unknown gains. The drive answers a command with the torque from before
it, so the reading of a row is the torque since the row before. Faster recordings are thinned to the 200 rows
a second of the others; torques are then means.

A recording is cut where the pendulum has arrived: half a second within 0.2 rad of upright. After that, people
push it to show that it swings up again, with up to 13 N·m. Some recordings of the source are no use here:

    energy_shaping/data_measured_1kg.csv  has another weight; it is refused
    ilqr                                  50 rows a second; it is refused
    gravity_compensation, pd/1nm_...      a hand moves it
    pd/system_identification              its torque jumps by up to 17 N·m from row to row

Fit two controllers, and predict the motion of two others:

    cd simple_pendulum
    deal-hw calibrate --model simple_pendulum.xml --columns columns.yaml \
        --data sac.npz direct_collocation.npz --holdout energy_shaping.npz ddp.npz --heldout-window 0.3
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from converting import write_recordings

from deal_hw.data.importing.csv_source import read_csv
from deal_hw.errors import DealHwError
from deal_hw.types import FloatArray

FILE = "data_measured.csv"
WEIGHT_KG, ROD_KG, LENGTH_M = 0.546, 0.13, 0.5
"""The weight at the end and the rod with its mounting parts: the source's description of the test bench."""
ROTOR_KG_M2, GEAR = 6.0719e-5, 6.0
"""Rotor's inertia before the gear: the source's data of the drive."""
RATE_HZ = 200.0
NEAR_TOP_RAD, STANDS_S = 0.2, 0.5
"""A swing-up is over where the pendulum stays so near to upright for so long."""

COLUMNS = """\
# Pendulum of dfki-ric-underactuated-lab/torque_limited_simple_pendulum (BSD-3-Clause): meaning of the arrays.
time: time
joints:
  - {name: shaft, position: position, velocity: velocity, target: torque, unit: rad, target_unit: Nm}
"""
# Friction is no data sheet's but a guess. solimpfriction keeps a joint that friction holds at rest.
MODEL = """\
<mujoco model="simple_pendulum">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="pendulum">
      <joint name="shaft" type="hinge" axis="0 1 0" damping="0.02" frictionloss="0.1" armature="{rotor:.4g}"
             solimpfriction="0.999 0.999 0.001 0.5 2"/>
      <inertial pos="0 0 -{centre:.5g}" mass="{mass:.4g}" diaginertia="{inertia:.4g} {inertia:.4g} 1e-4"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="shaft"/></actuator>
</mujoco>
"""


def model() -> str:
    """Return the MJCF of the pendulum by the source's description: a point on a uniform rod."""
    mass = WEIGHT_KG + ROD_KG
    centre = (WEIGHT_KG + ROD_KG / 2) * LENGTH_M / mass
    inertia = (WEIGHT_KG + ROD_KG / 3) * LENGTH_M**2 - mass * centre**2
    return MODEL.format(rotor=ROTOR_KG_M2 * GEAR**2, centre=centre, mass=mass, inertia=inertia)


def read_log(path: Path) -> dict[str, Any]:
    """Return the arrays of the NPZ file, (T,) each: time [s], position, velocity, torque.

    Raises:
        DealHwError: It is no such file, of another weight, or has fewer rows a second.
    """
    if path.name != FILE:
        raise DealHwError(f"{path}: give a file {FILE}; others have another weight, or no readings")
    log = read_csv(path)
    time, position, velocity, torque = map(log.column, ("time", "position", "velocity", "torque"))
    step = float(np.median(np.diff(time)))
    if step > 1.1 / RATE_HZ:
        raise DealHwError(
            f"{path} has {1 / step:.0f} rows a second; give recordings of {RATE_HZ:g} or more, so that all "
            "have one rate"
        )
    stamps, mean = mean_torque(time, torque)
    position = np.interp(stamps, time, position)
    last = arrival(stamps, position)
    return {
        "time": stamps[:last],
        "position": position[:last],
        "velocity": np.interp(stamps, time, velocity)[:last],
        "torque": mean[:last],
    }


def mean_torque(time: FloatArray, torque: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return stamps of 200 Hz at most, (T,) [s], and the mean torque from each to the next, (T - 1,) [N·m].

    A reading is the torque since the row before. Rows of 200 Hz are the stamps themselves.
    """
    slow = np.median(np.diff(time)) > 0.9 / RATE_HZ
    stamps = time if slow else np.arange(time[0], time[-1], 1 / RATE_HZ)
    impulse = np.append(0.0, np.cumsum(torque[1:] * np.diff(time)))
    return stamps, np.diff(np.interp(stamps, time, impulse)) / np.diff(stamps)


def arrival(time: FloatArray, position: FloatArray) -> int:
    """Return the row from which the pendulum stays near the top, or the last one, which has no torque.

    Args:
        time: Of each row, (T,) [s].
        position: (T,) [rad].
    """
    away = np.flatnonzero(np.abs(np.mod(position, 2 * np.pi) - np.pi) >= NEAR_TOP_RAD)
    ends = np.append(time[away[1:]], time[-1])
    stays = away[ends - time[away] > STANDS_S]
    return int(min(stays[0] + 1, time.size - 1)) if stays.size else time.size - 1


def controller(path: Path) -> str:
    """Return the name of the controller of a recording, from its folder."""
    return path.absolute().parent.name.removeprefix("control_method_")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+", help=f"files {FILE} of the source")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for NPZ files, columns.yaml and model"
    )
    options = parser.parse_args(arguments)
    if not write_recordings(options.recordings, options.out, read_log, controller):
        return 1
    (options.out / "simple_pendulum.xml").write_text(model(), encoding="utf-8")
    (options.out / "columns.yaml").write_text(COLUMNS, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
