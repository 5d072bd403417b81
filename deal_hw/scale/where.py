"""Where tasks run, as `--ray` names it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from deal_hw.errors import ConfigurationError, shown

MOST_WORKERS: Final = 1024


@dataclass(frozen=True, slots=True)
class Where:
    """Where tasks run.

    Attributes:
        address: HOST:PORT of a cluster, "auto" for the one that runs on this machine; None: this machine, in
            workers of its own.
        workers: Workers of this machine; None for as many as it has processors.
    """

    address: str | None = None
    workers: int | None = None


def parse_where(text: str) -> Where:
    """Return where tasks run: "local", "local:4" or the address of a cluster.

    Raises:
        ConfigurationError: It is none of these.
    """
    if found := re.fullmatch(r"local(?::(\d{1,4}))?", text):
        workers = int(found[1]) if found[1] else None
        if workers is None or 1 <= workers <= MOST_WORKERS:
            return Where(workers=workers)
    elif text.startswith("ray://"):
        raise ConfigurationError(
            f"--ray {shown(text)} is Ray's client, which deal-hw does not use: start deal-hw on a machine of "
            "the cluster, and name HOST:PORT or auto"
        )
    elif text == "auto" or re.fullmatch(r"(?:[\w.-]+|\[[0-9A-Fa-f:.]+\]):\d{1,5}", text):
        return Where(address=text)
    raise ConfigurationError(
        f"--ray {shown(text)}: give local, local:N for N workers (1 to {MOST_WORKERS}), the HOST:PORT of a "
        "cluster, or auto for the one that runs on this machine"
    )


def check_device(ray: str | None, engine: str, tasks: str) -> None:
    """Refuse workers whose tasks, such as "cells", would be simulated on one device.

    Raises:
        ConfigurationError: Both are given.
    """
    if ray is not None and engine != "mujoco":
        raise ConfigurationError(
            f"--ray with --engine {engine}: the {tasks} of all workers would share one device; leave one of "
            "the two out"
        )
