"""What does tasks: this process, or workers of Ray."""

from __future__ import annotations

from deal_hw.scale.where import parse_where
from deal_hw.task_map import InThisProcess, TaskMap


def task_map(ray: str | None, threads: int | None = None) -> TaskMap:
    """Return what does tasks where `--ray` says.

    Args:
        ray: "local", "local:4" or the address of a cluster; None: this process.
        threads: Processors that each task takes; None for 1.

    Raises:
        ConfigurationError: It names no place.
        MissingExtraError: Ray is not installed.
    """
    if ray is None:
        return InThisProcess()
    from deal_hw.scale.ray_tasks import RayTasks

    return RayTasks(parse_where(ray), threads or 1)
