"""Tasks in workers of Ray, on this machine or on a cluster.

Ray is loaded when workers are started. The settings of this module hold for every start: one thread of the
numeric libraries a worker, no dashboard, no statistics to anybody. Token authentication stays as Ray has it,
which is on.
"""

from __future__ import annotations

import logging
import os
import sys
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar

from typing_extensions import Self

from deal_hw.errors import ClusterError, TaskLostError, short
from deal_hw.scale.ray_errors import explained, needs_ray, reachable, words
from deal_hw.scale.ray_nodes import check_nodes
from deal_hw.scale.ray_start import start_ray
from deal_hw.scale.where import Where
from deal_hw.task_map import InThisProcess, TaskMap

S = TypeVar("S")
R = TypeVar("R")

RETRIES: Final = 3
"""Times that a task is begun again after its worker ended: killed, or its machine was lost."""

ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Small matrices: a second thread only waits, and takes the processor of another worker."""

QUIET: Final = {
    "RAY_USAGE_STATS_ENABLED": "0",
    # Else Ray begins a task whose machine has no memory left again and again.
    "RAY_task_oom_retries": str(RETRIES),
    # Without it Ray warns of a change that concerns GPUs.
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}
HERE: Final = {
    # Despite its name it holds on Linux: without it Ray takes the address of the network card for 127.0.0.1,
    # and its servers listen on all addresses.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    # Else workers have niceness 15: on a machine that others use, too, they get next to nothing.
    "RAY_worker_niceness": "0",
}
"""Settings of workers on this machine."""


@dataclass(frozen=True, slots=True)
class _Common:
    """What all tasks of a call share: sent to each machine once.

    Attributes:
        function: The function, with what is bound to it.
        argv: Command line of the process that asked, which rows name.
        folder: Its working directory, in which relative paths are meant.
    """

    function: Callable[[Any], Any]
    argv: list[str]
    folder: Path


@dataclass(frozen=True, slots=True)
class _Sent:
    """What all tasks of a call share, as a worker gets it: fetched from its machine's memory when needed.

    Attributes:
        common: Ray's reference.
    """

    common: Any


_FETCHED: Final[dict[Any, _Common]] = {}
"""In a worker: what it has fetched, by Ray's reference; the function of its last tasks."""


def _do(sent: _Sent, spec: Any) -> Any:
    """Do a task in a worker."""
    if sent.common not in _FETCHED:
        import ray

        _FETCHED.clear()
        _FETCHED[sent.common] = ray.get(sent.common)
    common = _FETCHED[sent.common]
    sys.argv[:] = common.argv
    if common.folder.is_dir():
        os.chdir(common.folder)
    return common.function(spec)


class RayTasks(TaskMap):
    """Tasks in Ray's workers.

    Args:
        where: This machine, or the address of a cluster.
        threads: Processors that each task takes.

    Raises:
        MissingExtraError: Ray is not installed.
    """

    def __init__(self, where: Where, threads: int = 1) -> None:
        needs_ray()
        self._where, self._threads = where, threads
        self._sent: tuple[Callable[[Any], Any], _Sent] | None = None

    def __reduce__(self) -> tuple[type[InThisProcess], tuple[()]]:
        """A task that has tasks itself does them in its own process."""
        return InThisProcess, ()

    def __enter__(self) -> Self:
        """Start the workers, or find the cluster, and check that its nodes compute as this machine does.

        Raises:
            ClusterError: That is not possible; the message has the remedy.
        """
        here = self._where.address is None
        if self._where.address is not None:
            reachable(self._where.address)
        for name, value in {**QUIET, **(HERE if here else {})}.items():
            os.environ.setdefault(name, value)
        import ray

        logging.getLogger("ray").setLevel(logging.ERROR)
        options: dict[str, Any] = {"address": self._where.address}
        if here:
            workers = self._where.workers or max(_processors() // self._threads, 1)
            options = {
                "address": "local",
                "num_cpus": workers * self._threads,
                "include_dashboard": False,
                "_node_ip_address": "127.0.0.1",
            }
        options |= {
            "log_to_driver": False,
            "logging_level": logging.ERROR,
            "runtime_env": {"env_vars": ONE_THREAD},
        }
        start_ray(self._where, options)
        try:
            if here:
                _check_loopback(ray.nodes())
            check_nodes(self._threads)
        except BaseException:
            ray.shutdown()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the cluster; workers that were started here end."""
        import ray

        self._sent = None
        ray.shutdown()

    def completed(
        self,
        function: Callable[[S], R],
        specs: Sequence[S],
        lost: Callable[[S, TaskLostError], R] | None = None,
    ) -> Generator[tuple[int, R], None, None]:
        """See :meth:`TaskMap.completed`.

        Ray gets as many tasks as it has room for, and one more. So where the iteration is left early, the
        others are not begun, and nothing has to be cancelled: Ray 2.60 ends this process where a task that it
        cancels answers at that moment ("Tried to complete task that was not pending", as in its pull request
        54798). Tasks that have begun go on to their end, or to that of the workers.
        """
        import ray

        task = ray.remote(max_retries=RETRIES, num_cpus=self._threads)(_do)
        sent = self._send(function)
        waiting, pending = deque(enumerate(specs)), dict[Any, int]()
        while waiting or pending:
            with explained(self._where):
                while waiting and len(pending) <= self.workers:
                    index, spec = waiting.popleft()
                    pending[task.remote(sent, spec)] = index
            (done,), _ = ray.wait(list(pending), num_returns=1)
            index = pending.pop(done)
            yield index, self._result(done, specs[index], lost)

    def _send(self, function: Callable[[Any], Any]) -> _Sent:
        """Send a function with what is bound to it, but for the one that was sent last.

        Raises:
            ClusterError: It cannot be sent.
        """
        import ray

        if self._sent is None or self._sent[0] is not function:
            with explained(self._where):
                self._sent = function, _Sent(ray.put(_Common(function, list(sys.argv), Path.cwd())))
        return self._sent[1]

    @property
    def workers(self) -> int:
        """How many tasks run at once on the machines that are there now."""
        import ray

        return int(ray.cluster_resources().get("CPU", 0.0)) // self._threads

    def _result(self, done: Any, spec: S, lost: Callable[[S, TaskLostError], R] | None) -> R:
        """Return a task's result, raising what it has raised."""
        import ray

        try:
            result: R = ray.get(done)
        except ray.exceptions.RayError as err:
            cause = err.cause if isinstance(err, ray.exceptions.RayTaskError) else err
            if not isinstance(cause, ray.exceptions.RayError):
                raise cause from err
            why = TaskLostError(self._why_lost(cause))
            if lost is None:
                raise why from err
            return lost(spec, why)
        return result

    def _why_lost(self, cause: Exception) -> str:
        """Return why a task has no result, with the remedy."""
        import ray

        if isinstance(cause, ray.exceptions.ObjectStoreFullError | ray.exceptions.OutOfDiskError):
            return words(cause, self._where.address)
        return (
            f"the worker of a task ended before the task, {1 + RETRIES} times "
            f"({short(str(cause).partition(chr(10))[0])}); look whether its machine has enough memory, or "
            "give each task more processors (--threads), so that fewer run at once"
        )


def _processors() -> int:
    return len(os.sched_getaffinity(0))


def _check_loopback(nodes: Sequence[dict[str, Any]]) -> None:
    """Refuse workers that the network can reach; these are for this machine only."""
    for node in nodes:
        address = str(node["NodeManagerAddress"])
        if not address.startswith("127."):
            raise ClusterError(
                f"Ray listens on {address}, not on this machine's own 127.0.0.1 alone, since it was loaded "
                "before deal-hw set it up; set RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER=0 before Python starts"
            )
