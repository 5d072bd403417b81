"""Registers the tasks with Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping

from gymnasium.envs import registration


def register(tasks: Mapping[str, str], single: str, vector: str) -> None:
    """Register all tasks, single and vector; existing ones stay.

    Args:
        tasks: Gymnasium's name -> robot.
        single: Factory of a single environment, "module:name"; called with ``robot`` and the user's arguments
            of ``gymnasium.make``.
        vector: The same for ``gymnasium.make_vec``; called with ``num_envs``, too.
    """
    for name, robot in tasks.items():
        if name not in registration.registry:
            registration.register(
                name, entry_point=single, vector_entry_point=vector, kwargs={"robot": robot}
            )
