"""Training tasks: environment, trainer and settings. A robot's entry in `deal_hw.robots` names its task."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from deal_hw.policies.trainers import make_trainer

_BALANCE_PPO: Final = {
    "hidden": (64, 64),
    "rollout": 32,
    "gamma": 0.98,
    "entropy": 0.0,
    "reward_scale": 0.1,
    "steps": 1_500_000,
}
_REACH_PPO: Final = {
    "hidden": (64, 64),
    "gamma": 0.9,
    "entropy": 0.0,
    "exploration": 0.03,
    "reward_scale": 0.1,
    "steps": 1_000_000,
}
_LEGGED_SAC: Final = {
    "hidden": (128, 128),
    "gradient_steps": 8,
    "batch": 256,
    "learning_rate": 1e-3,
    "final_learning_rate": 3e-4,
    "gamma": 0.98,
    "tau": 0.02,
    "entropy": 0.1,
    "warmup": 5_000,
    "buffer": 500_000,
    "averaged": 0.05,
    "steps": 240_000,
}
_TURN_PPO: Final = {
    "exploration": 0.3,
    "divergence": 0.015,
    "reward_scale": 0.05,
    "steps": 6_000_000,
}
_CANTER_PPO: Final = {
    "divergence": 0.02,
    "exploration": 0.4,
    "steps": 16_000_000,
}
_CLIMB_PPO: Final = {
    "divergence": 0.02,
    "entropy": 0.001,
    "exploration": 0.25,
    "steps": 50_000_000,
}
_STRIDE_PPO: Final = {
    "hidden": (256, 128),
    "exploration": 0.3,
    "divergence": 0.015,
    "steps": 5_000_000,
}


_AS: Final = {"amp": "ppo", "rma": "ppo"}
"""Trainers with the usual settings of another one, on which they stand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingTask:
    """A robot's training; the defaults are those of its shipped policy.

    Attributes:
        environment: The environment, "module:class"; called as ``environment(description, distribution,
            members)``.
        trainer: The default trainer's name.
        members: Robots simulated at once, by trainer; see :meth:`usual_members`.
        settings: The trainers' settings that differ from their defaults, by trainer.
        udr_ratio: Factor of uniform domain randomisation on either side of each nominal value.
        udr_latency_s: Lowest and highest total latency of it [s].
    """

    environment: str
    trainer: str
    members: Mapping[str, int]
    settings: Mapping[str, Mapping[str, Any]]
    udr_ratio: float
    udr_latency_s: tuple[float, float]

    def make(self, *arguments: Any, **more: Any) -> Any:
        """Return the environment, made with these arguments."""
        module, _, name = self.environment.partition(":")
        return getattr(importlib.import_module(module), name)(*arguments, **more)

    def usual_members(self, trainer: str) -> int:
        """Return how many robots a trainer simulates at once."""
        return self.members[_AS.get(trainer, trainer)]

    def trainer_and_config(self, trainer: str | None = None, steps: int | None = None) -> tuple[Any, Any]:
        """Return a trainer and its settings for this task.

        Args:
            trainer: Its name; the robot's default by default.
            steps: Environment steps; None for the default.

        Raises:
            UnknownNameError: There is no such trainer.
        """
        name = trainer or self.trainer
        made = make_trainer(name)
        settings = dict(self.settings.get(_AS.get(name, name), {}))
        if steps is not None:
            settings["steps"] = steps
        return made, made.config(**settings)


def _simulated(
    environment: str,
    motors: int,
    udr_ratio: float,
    ppo: Mapping[str, Any] | None = None,
    members: int = 200,
) -> TrainingTask:
    """Return the task of a robot that exists in simulators only; PPO is usual if its settings are given."""
    return TrainingTask(
        environment=f"deal_hw.policies.{environment}",
        trainer="ppo" if ppo else "sac",
        members={"ppo": members, "sac": 64},
        settings={
            "ppo": ppo or {"steps": 3_000_000, "reward_scale": 0.05},
            "sac": {**_LEGGED_SAC, "target_entropy": -float(motors)},
        },
        udr_ratio=udr_ratio,
        udr_latency_s=(0.0, 0.02),
    )


def _go2(environment: str, ppo: Mapping[str, Any] | None = None, members: int = 200) -> TrainingTask:
    """Return a task of the Go2; PPO has its usual settings if none are given."""
    return TrainingTask(
        environment=f"deal_hw.policies.{environment}",
        trainer="ppo",
        members={"ppo": members, "sac": 64},
        settings={
            **({} if ppo is None else {"ppo": ppo}),
            "sac": {**_LEGGED_SAC, "target_entropy": -12.0},
        },
        udr_ratio=1.75,
        udr_latency_s=(0.0, 0.012),
    )


ALLEGRO: Final = _simulated("hand_env:HandEnv", motors=16, udr_ratio=1.75, ppo=_TURN_PPO, members=256)
ANT: Final = _simulated("run_env:RunEnv", motors=8, udr_ratio=5.0)
CARTPOLE: Final = TrainingTask(
    environment="deal_hw.policies.cartpole_env:CartPoleEnv",
    trainer="sac",
    members={"ppo": 128, "sac": 32},
    settings={"ppo": _BALANCE_PPO},
    udr_ratio=5.0,
    udr_latency_s=(0.0, 0.03),
)
GO2: Final = _go2("go2_env:Go2Env")
CANTER: Final = _go2("canter_env:CanterEnv", ppo=_CANTER_PPO)
"""The Go2's canter; the shipped policy was trained in two stages, see docs/how-to/go2-gaits.md."""
CLIMB: Final = _go2("climb_env:ClimbEnv", ppo=_CLIMB_PPO)
"""The Go2's climb onto a platform; the shipped policy had a third of these steps."""
TERRAIN: Final = _go2("climb_env:TerrainEnv", ppo=_CLIMB_PPO)
"""The Go2's walk over platforms, steps and slopes; no policy of it is shipped."""
HUMANOID: Final = _simulated(
    "humanoid_env:HumanoidEnv", motors=21, udr_ratio=1.75, ppo=_STRIDE_PPO, members=128
)
SO101: Final = TrainingTask(
    environment="deal_hw.policies.reach_env:ReachEnv",
    trainer="ppo",
    members={"ppo": 48, "sac": 32},
    settings={"ppo": _REACH_PPO},
    udr_ratio=1.75,
    udr_latency_s=(0.0, 0.02),
)
OWN_TASK: Final = TrainingTask(
    environment="deal_hw.policies.own_env:OwnVectorEnv",
    trainer="sac",
    members={"ppo": 16, "sac": 8},
    settings={},
    udr_ratio=1.0,
    udr_latency_s=(0.0, 0.0),
)
"""The user's own Gymnasium environment; good settings for it are not known."""
