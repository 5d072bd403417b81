r"""Convert public recordings of a real UR10e arm into NPZ files, a column map, a model and its parameters.

The recordings are the CSV files below dataset_ur10e/ of shamilmamedov/dynamic_calibration (commit 11af40e),
of the work in "Practical Aspects of Model-Based Collision Detection" (Frontiers in Robotics and AI, 2020).
That repository has no licence: nothing of it is copied here, and this program reads your own copy.

    git clone https://github.com/shamilmamedov/dynamic_calibration
    mkdir all
    cp dynamic_calibration/dataset_ur10e/{identification,validation}_data/*.csv all
    python tools/convert_ur10e.py all/ur-20_02_05-20sec_8harm.csv all/ur-20_02_06-*.csv \
        all/ur-20_02_10-20sec_7harm.csv all/ur-20_01_17-ptp_10_points.csv --out ur10e

A file has no head, 31 columns and about 94 rows a second. Of its columns, these are used (as
utils/data_processing/parseURData.m of the source reads them):

    1         the controller's clock [s], in steps of 2 ms
    2 to 7    position [rad]
    8 to 13   velocity [rad/s]
    14 to 19  measured motor current [A]

Rows of standstill before and after the motion are left out, all but half a second.

The robot is driven by torque: the command is the measured current times the drive's nominal gain. The gains
are the controller's own: at rest, its desired torques (columns 26 to 31) are 11.98, 9.84 and 10.76 N·m for
each ampere of its desired currents (columns 20 to 25) at joints 2, 3 and 4. Joint 1 has the same drive as
joint 2, and the wrist has three of one size.

    cd ur10e
    deal-hw calibrate --model ur10e.xml --columns columns.yaml --parameters parameters.yaml \
        --data ur-20_02_05-*.npz ur-20_02_06-*.npz --holdout ur-20_02_10-*.npz ur-20_01_17-*.npz \
        --heldout-window 0.3
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from converting import write_recordings

from deal_hw.errors import DealHwError

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
COLUMNS_COUNT = 31
GAIN_NM_PER_A = np.array([11.98, 11.98, 9.84, 10.76, 10.76, 10.76])
MOVES_RAD_S = 0.02
REST_S = 0.5
"""Rows before the first motion and after the last one that are kept [s]."""
LOG = "a recording of the UR10e"

COLUMNS = """\
# UR10e of shamilmamedov/dynamic_calibration: meaning of the arrays in the NPZ files. The torque is the
# measured motor current times a nominal gain.
time: time
position: position
velocity: velocity
target: torque
target_unit: Nm
joints:
"""
PARAMETERS = """\
parameters:
  - {kind: motor_gain, elements: "*"}
  - {kind: dof_damping, elements: "*"}
  - {kind: dof_frictionloss, elements: "*"}
  - {kind: dof_armature, elements: "*"}
  - {kind: body_ipos_z, elements: upper_arm}
  - {kind: body_ipos_z, elements: forearm}
  - {kind: body_mass, elements: wrist_3, range: [0.05, 3]}
"""
# Link frames, masses, centres and inertias are those of the robot's public URDF (ur10e.urdf). Friction and
# rotors are no data sheet's but guesses: dry friction is 5 % of the joint's greatest torque, viscous friction
# at 1 rad/s is as much, and rotors of 1e-4, 5e-5 and 2e-5 kg·m² turn behind a gear of 101. solimpfriction
# keeps a joint that friction holds at rest.
MODEL = """\
<mujoco model="ur10e">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"><flag contact="disable"/></option>
  <default>
    <joint type="hinge" solimpfriction="0.999 0.999 0.001 0.5 2"/>
    <default class="large"><joint damping="16.5" frictionloss="16.5" armature="1.02"/></default>
    <default class="middle"><joint damping="7.5" frictionloss="7.5" armature="0.51"/></default>
    <default class="small"><joint damping="2.7" frictionloss="2.7" armature="0.204"/></default>
  </default>
  <worldbody>
    <body name="shoulder" pos="0 0 0.181">
      <joint name="shoulder_pan" class="large" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="7.778" diaginertia="0.03147431 0.03147431 0.02187563"/>
      <body name="upper_arm" pos="0 0.176 0" quat="1 0 1 0" simple="false">
        <joint name="shoulder_lift" class="large" axis="0 1 0"/>
        <inertial pos="0 0 0.3065" mass="12.93" diaginertia="0.42307374 0.42307374 0.03636563"/>
        <body name="forearm" pos="0 -0.137 0.613" simple="false">
          <joint name="elbow" class="middle" axis="0 1 0"/>
          <inertial pos="0 0 0.2855" mass="3.87" diaginertia="0.11059037 0.11059037 0.01088438"/>
          <body name="wrist_1" pos="0 0 0.571" quat="1 0 1 0">
            <joint name="wrist_1" class="small" axis="0 1 0"/>
            <inertial pos="0 0.135 0" mass="1.96" diaginertia="0.00510825 0.00510825 0.0055125"/>
            <body name="wrist_2" pos="0 0.135 0">
              <joint name="wrist_2" class="small" axis="0 0 1"/>
              <inertial pos="0 0 0.12" mass="1.96" diaginertia="0.00510825 0.00510825 0.0055125"/>
              <body name="wrist_3" pos="0 0 0.12">
                <joint name="wrist_3" class="small" axis="0 1 0"/>
                <inertial pos="0 0.092 0" mass="0.202" diaginertia="0.00014435 0.00020453 0.00014435"/>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_pan" joint="shoulder_pan"/>
    <motor name="shoulder_lift" joint="shoulder_lift"/>
    <motor name="elbow" joint="elbow"/>
    <motor name="wrist_1" joint="wrist_1"/>
    <motor name="wrist_2" joint="wrist_2"/>
    <motor name="wrist_3" joint="wrist_3"/>
  </actuator>
</mujoco>
"""


def read_log(path: Path) -> dict[str, Any]:
    """Return the arrays of the NPZ file: time (T,) [s], position, velocity and torque (T, 6).

    Raises:
        DealHwError: It is no such file, or nothing moves in it.
    """
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise DealHwError(f"{path} is not {LOG}: {error}") from error
    if rows.shape[1] != COLUMNS_COUNT:
        raise DealHwError(f"{path} is not {LOG}: it has {rows.shape[1]} columns, not {COLUMNS_COUNT}")
    time, position, velocity, current = rows[:, 0], rows[:, 1:7], rows[:, 7:13], rows[:, 13:19]
    moving = time[np.abs(velocity).max(axis=1) > MOVES_RAD_S]
    if not moving.size:
        raise DealHwError(
            f"{path}: no joint is faster than {MOVES_RAD_S:g} rad/s; such a file shows no friction"
        )
    kept = (time >= moving[0] - REST_S) & (time <= moving[-1] + REST_S)
    return {
        "time": time[kept],
        "position": position[kept],
        "velocity": velocity[kept],
        "torque": current[kept] * GAIN_NM_PER_A,
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+", help="CSV files of the source")
    parser.add_argument("--out", type=Path, required=True, help="folder for NPZ files, model and YAML files")
    options = parser.parse_args(arguments)
    named = {"joint_names": np.array(JOINTS)}
    if not write_recordings(options.recordings, options.out, lambda path: named | read_log(path)):
        return 1
    columns = COLUMNS + "".join(f"  - {joint}\n" for joint in JOINTS)
    for name, text in (("ur10e.xml", MODEL), ("columns.yaml", columns), ("parameters.yaml", PARAMETERS)):
        (options.out / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
