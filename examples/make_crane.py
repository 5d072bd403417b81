"""Make an example of your own robot: an MJCF and three CSV recordings, from plain MuJoCo.

python examples/make_crane.py crane     (then: docs/tutorials/your-robot.md)
"""

import sys
from pathlib import Path

import mujoco
import numpy as np

MJCF = """<mujoco model="crane">
  <compiler angle="radian"/> <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="boom" pos="0 0 1">
    <joint name="boom" axis="0 1 0" range="-1.5 1.5" damping="{0}" frictionloss="{1}" armature="0.02"/>
    <geom type="capsule" fromto="0 0 0 .4 0 0" size="0.02" mass="0.6" contype="0"/>
    <body name="stick" pos="0.4 0 0">
      <joint name="stick" axis="0 1 0" range="-2 2" damping="{2}" frictionloss="0.04" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.015" mass="0.3" contype="0"/>
  </body></body></worldbody>
  <actuator><position name="m1" joint="boom" kp="{3}" kv="0.5" forcerange="-30 30"/>
    <position name="m2" joint="stick" kp="25" kv="0.3" forcerange="-15 15"/></actuator>
</mujoco>"""
(folder := Path(sys.argv[1] if sys.argv[1:] else "crane")).mkdir(parents=True, exist_ok=True)
(folder / "crane.xml").write_text(MJCF.format("0.5", "0.1", "0.2", "60"))
for seed, name in enumerate(("slow", "fast", "other")):
    model = mujoco.MjModel.from_xml_string(MJCF.format("0.8", "0.25", "0.13", "48"))
    data, time, rng, rows = mujoco.MjData(model), np.arange(0, 8, 0.01), np.random.default_rng(seed), []
    waves = np.outer(time, (2.4 + 1.8 * seed) * np.array([0.2, 0.5, 1, 1.7]))[:, None]
    target = (
        np.sin(waves + rng.uniform(0, 6, (2, 4))).sum(axis=2) * np.minimum(time, 1)[:, None] * (0.15, 0.25)
    )
    for k, wanted in enumerate(target):
        rows.append([time[k], *(data.qpos + 5e-4 * rng.standard_normal(2)), *wanted])
        for step in range(5):  # 100 samples a second; a command acts 8 ms late.
            data.ctrl = wanted if step == 4 else target[max(k - 1, 0)]
            mujoco.mj_step(model, data)
    head = "time,boom_pos,stick_pos,boom_cmd,stick_cmd"
    np.savetxt(folder / f"{name}.csv", rows, "%.6f", ",", header=head, comments="")
print(*sorted(folder.iterdir()))
