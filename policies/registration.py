"""Registers the tasks with Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping

from gymnasium.envs import registration

IDS: Mapping[str, str] = {
    "deal_hw/Allegro-v0": "allegro",
    "deal_hw/Ant-v0": "ant",
    "deal_hw/CartPole-v0": "cartpole",
    "deal_hw/Go2-v0": "go2",
    "deal_hw/Humanoid-v0": "humanoid",
}
"""Gymnasium's name -> robot."""


def register(single: str, vector: str) -> None:
    """Register all tasks, single and vector; existing ones stay.

    Args:
        single: Factory of a single environment, "module:name"; called with ``robot`` and the user's arguments
            of ``gymnasium.make``.
        vector: The same for ``gymnasium.make_vec``; called with ``num_envs``, too.
    """
    for name, robot in IDS.items():
        if name not in registration.registry:
            registration.register(
                name, entry_point=single, vector_entry_point=vector, kwargs={"robot": robot}
            )
