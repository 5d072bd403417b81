"""What can go wrong with Ray, each in one line with its remedy."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from deal_hw.errors import ClusterError, MissingExtraError, short
from deal_hw.scale.where import Where

CURRENT: Final = Path("/tmp/ray/ray_current_cluster")
"""Where Ray notes the address of the cluster that runs on a machine; it stays when the cluster was killed."""
CONNECT_S: Final = 5.0
"""Longest wait for a cluster's port [s]."""


def needs_ray() -> None:
    """Check that Ray is installed, without loading it.

    Raises:
        MissingExtraError: It is not.
    """
    if importlib.util.find_spec("ray") is None:
        raise MissingExtraError("ray", "scale")


def reachable(address: str) -> None:
    """Check that something listens at a cluster's address; Ray itself would wait for a minute.

    Raises:
        ClusterError: Nothing does.
    """
    if address == "auto":
        found = os.environ.get("RAY_ADDRESS", "")
        if not found and CURRENT.is_file():
            found = CURRENT.read_text(encoding="utf-8").strip()
        if ":" not in found:
            raise ClusterError(
                "no Ray cluster runs on this machine; start one with `ray start --head`, or name HOST:PORT"
            )
        address = found
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), CONNECT_S):
            return
    except (OSError, OverflowError) as err:
        raise ClusterError(
            f"no Ray cluster answers at {short(address)} ({err}); start one there with "
            f"`ray start --head --port={short(port)}`, or look at the address and the firewall"
        ) from err


_SLOW: Final = r"timed out during startup"
"""What Ray raises where its processes did not start within its 30 s."""

_CAUSES: Final = (
    (
        _SLOW,
        "Ray's processes did not start within its 30 s, three times ({why}); this machine is too busy "
        "({load}): end other work, or leave out --ray",
    ),
    (
        r"Version mismatch",
        "the cluster runs another version of Ray or of Python ({why}); install the same ones on all "
        "machines: this deal-hw needs the version of Ray in its extra `scale`",
    ),
    (
        r"[Tt]oken|[Aa]uthenticat",
        "the cluster did not accept this machine's token ({why}); copy ~/.ray/auth_token of the cluster's "
        "head to this machine, readable by you only",
    ),
    (
        r"Could not find any running Ray instance|could not be found at",
        "no Ray cluster runs on this machine; start one with `ray start --head`, or name HOST:PORT",
    ),
    (
        r"raylet|node (?:table|info)|NodeInfo|is not a node|No node info",
        "this machine is no node of the cluster ({why}); let it join with `ray start --address={address}`, "
        "or start deal-hw on a machine of the cluster",
    ),
    (
        r"object store|ObjectStoreFull|OutOfDisk|out of disk",
        "the recordings do not fit into the object store ({why}); start the machine's Ray with a larger one "
        "(`ray start --object-store-memory=BYTES`), free its disk, or use fewer recordings",
    ),
)


@contextlib.contextmanager
def explained(where: Where) -> Iterator[None]:
    """Turn what Ray raises when it starts, connects or takes data into one line with its remedy.

    Raises:
        ClusterError: Ray could not do it.
    """
    import ray

    kinds = (
        ray.exceptions.RayError,
        RuntimeError,
        ConnectionError,
        ValueError,
        OSError,
        AssertionError,
    )
    try:
        yield
    except Exception as err:
        if not (isinstance(err, kinds) or too_slow(err)):
            raise
        raise ClusterError(words(err, where.address)) from err


def too_slow(err: Exception) -> bool:
    """Return whether Ray's processes did not start in time, for which Ray raises a plain `Exception`."""
    return re.search(_SLOW, str(err)) is not None


def words(err: Exception, address: str | None) -> str:
    """Return an error of Ray as a sentence, with its remedy where it is known."""
    text = " ".join(f"{type(err).__name__}: {err}".split())
    for pattern, sentence in _CAUSES:
        if re.search(pattern, text):
            load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors"
            return sentence.format(why=short(text), address=address or "HOST:PORT", load=load)
    place = "on this machine" if address is None else f"with the cluster at {address}"
    return f"Ray cannot start {place}: {short(text)}; its log files are in /tmp/ray/session_latest/logs"
