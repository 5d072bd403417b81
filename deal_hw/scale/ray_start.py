"""The start of Ray's processes on this machine, once more where a busy machine is too slow for Ray's limits.

Ray's node waits 15 s for its agent, a Python process (`WaitForPersistedPort` of Ray 2.60: "Timed out waiting
for file .../metrics_agent_port"), and no setting changes that. Where the agent needs longer, the node ends
itself, and `ray.init` raises after 30 s. Often the next start is faster, since the files are in memory.
"""

from __future__ import annotations

import logging
from typing import Any, Final

import psutil

from deal_hw.scale.ray_errors import explained, too_slow
from deal_hw.scale.where import Where

STARTS: Final = 3
"""Times that Ray is started until it counts as not to be started."""

END_S: Final = 10.0
"""Longest wait for the processes of a start that failed [s]."""


def start_ray(where: Where, options: dict[str, Any]) -> None:
    """Start Ray, or connect to a cluster.

    Args:
        where: This machine, or a cluster.
        options: What `ray.init` takes.

    Raises:
        ClusterError: That is not possible; the message has the remedy.
    """
    import ray

    with explained(where):
        for left in reversed(range(STARTS)):
            earlier = psutil.Process().children(recursive=True)
            try:
                ray.init(**options)
            except Exception as err:
                # Ray has no narrower class for it.
                if not (left and too_slow(err)):
                    raise
                ray.shutdown()
                _end_children(earlier)
                logging.getLogger(__name__).warning(
                    "Ray did not start within its 30 s, as on a busy machine; it is started again"
                )
            else:
                return


def _end_children(earlier: list[psutil.Process]) -> None:
    """End this process's children that were not there before."""
    children = [child for child in psutil.Process().children(recursive=True) if child not in earlier]
    for child in children:
        try:
            child.kill()
        except psutil.NoSuchProcess:
            continue
    psutil.wait_procs(children, timeout=END_S)
