"""Bring the arm's tip to a point, for `deal-hw train --env`: see docs/tutorials/servo-arm.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

GOAL = np.array([0.12, 0.08, 0.22])
"""The point [m]."""
STEPS = 100
"""Length of an episode [control periods of 20 ms]."""


class Reach(gymnasium.Env[Any, Any]):
    """Observes joint positions and velocities, and takes position targets, as robot.yaml has them."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("arm.xml")))
        self.data = mujoco.MjData(self.model)
        self._period = round(0.02 / self.model.opt.timestep)
        self._left = STEPS
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2 * self.model.nq,), np.float64)
        low, high = self.model.actuator_ctrlrange.T
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float64)

    def _seen(self) -> Any:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin near the start pose."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-0.3, 0.3, self.model.nq)
        self._left = STEPS
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        """Move for a control period; the reward is minus the tip's distance from the point."""
        change = float(np.abs(action - self.data.ctrl).mean())
        self.data.ctrl[:] = action
        for _ in range(self._period):
            mujoco.mj_step(self.model, self.data)
        self._left -= 1
        far = float(np.linalg.norm(self.data.site("tip").xpos - GOAL))
        # Without its second term the policy would jump between its limits.
        return self._seen(), -far - 0.02 * change, False, self._left == 0, {}


gymnasium.register("Reach-v0", entry_point=lambda **given: Reach(**given))
