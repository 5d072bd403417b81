"""Whether MuJoCo Warp does on this machine's device what MuJoCo does."""

from __future__ import annotations

import mujoco
import numpy as np

from deal_hw.sim.engine.batch import make_engine
from deal_hw.sim.engine.gpu import EngineName

STEPS = 50
"""Physics steps, of 2 ms."""

PENDULUM = """
<mujoco>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.02" frictionloss="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><position joint="hinge" kp="4" kv="0.1"/></actuator>
</mujoco>
"""


def difference_from_mujoco(engine: EngineName = "warp") -> float:
    """Return the largest difference of a pendulum's positions in 0.1 s, in three worlds [rad].

    The first call compiles kernels, for some seconds.

    Args:
        engine: The engine to compare.

    Raises:
        ConfigurationError: There is no GPU, or Warp cannot use it.
    """
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    start = np.array([[[0.5]], [[1.0]], [[-1.5]]]), np.zeros((3, 1, 1))
    control = np.linspace(-1.0, 1.0, 3 * STEPS).reshape(3, 1, STEPS, 1)
    spec = int(mujoco.mjtState.mjSTATE_CTRL)
    found = [
        make_engine(name, model, model, 3, 1).rollout(control, spec, {"qpos": 1}, None, start)[0]["qpos"]
        for name in ("mujoco", engine)
    ]
    return float(np.abs(found[1] - found[0]).max())
