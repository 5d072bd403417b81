"""Checks of a cluster's nodes before long work: that their numbers are those of this machine."""

from __future__ import annotations

import logging
import socket
from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Any, Final

from deal_hw.errors import ClusterError, short
from deal_hw.scale import facts

ANSWER_S: Final = 120.0
"""Longest wait for a node's answer; a worker's first start loads Ray from the disk [s]."""

CLOCK_S: Final = 5.0
"""Difference of two machines' clocks that is said [s]."""


def check_nodes(threads: int) -> None:
    """Ask every node for its versions, and compare them with this machine's.

    Args:
        threads: Processors that each task takes.

    Raises:
        ClusterError: A node lacks deal-hw or has another version of what computes, no node has that many
            processors, or one does not answer.
    """
    import ray
    from ray import cloudpickle
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    nodes = [node for node in ray.nodes() if node["Alive"]]
    most = max((float(node["Resources"].get("CPU", 0)) for node in nodes), default=0.0)
    if most < threads:
        raise ClusterError(
            f"no node of the cluster has {threads} processors for one task, the largest has {most:g}; give "
            "fewer --threads"
        )
    # As code: on a node without deal-hw the name of a function means nothing.
    cloudpickle.register_pickle_by_value(facts)
    try:
        ask, began = ray.remote(num_cpus=0, max_retries=1)(facts.stamped_facts), _clock()
        asked = {
            ask.options(
                scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            ).remote(): (_name(node))
            for node in nodes
            if node["Resources"].get("CPU", 0)
        }
        _, silent = ray.wait(list(asked), num_returns=len(asked), timeout=ANSWER_S)
    finally:
        cloudpickle.unregister_pickle_by_value(facts)
    if silent:
        raise ClusterError(
            f"node {asked[silent[0]]} gave no answer within {ANSWER_S:g} s; look at it with `ray status`, or "
            "take it out of the cluster"
        )
    mine = facts.facts()
    for answer, name in asked.items():
        try:
            theirs, clock = ray.get(answer)
        except ray.exceptions.RayError as err:
            first = str(err).strip().rpartition("\n")[2]
            raise ClusterError(
                f"node {name} cannot run a task ({short(first)}); look at it with `ray status`, or take it "
                "out of the cluster"
            ) from err
        if why := difference(mine, theirs):
            raise ClusterError(f"node {name} {why}")
        if apart := clocks_apart(clock, began, _clock()):
            logging.getLogger(__name__).warning("node %s: %s", name, apart)


def clocks_apart(clock: float, began: float, ended: float) -> str:
    """Return how a node's clock differs from this machine's, with the remedy; "" where it does not.

    Args:
        clock: The node's clock when it answered [s].
        began: This machine's clock before the question [s].
        ended: This machine's clock after the answer [s].
    """
    ahead = clock - ended if clock > ended else min(clock - began, 0.0)
    if abs(ahead) <= CLOCK_S:
        return ""
    side = "ahead of" if ahead > 0 else "behind"
    return (
        f"its clock is {abs(ahead):.0f} s {side} this machine's; results do not depend on it, but dates in "
        "files and logs do: let both follow NTP (`timedatectl set-ntp true`)"
    )


def difference(mine: Mapping[str, str], theirs: Mapping[str, str]) -> str:
    """Return how a node differs from this machine, as the rest of a sentence; "" where it does not."""
    if "deal-hw" not in theirs:
        return (
            "has no deal-hw in the Python that Ray uses there; install it on all machines, and start Ray "
            "from that environment"
        )
    for name, own in mine.items():
        if theirs.get(name) != own:
            what = "other sources of deal-hw" if name == "sources" else f"{name} {theirs.get(name, 'none')}"
            return (
                f"has {what}, and this machine {own}: results would depend on the machine; install the same "
                "on all machines"
            )
    return ""


def _clock() -> float:
    """Return this machine's clock, which other machines share [s since 1970]."""
    return datetime.now(timezone.utc).timestamp()


def _name(node: Mapping[str, Any]) -> str:
    host, address = str(node.get("NodeManagerHostname", "")), str(node["NodeManagerAddress"])
    return address if host in ("", address, socket.gethostname()) else f"{host} ({address})"
