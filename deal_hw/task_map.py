"""Independent tasks, and where they run: in this process, or in workers on other machines.

A task is a function of one specification, which names every seed. So its result does not depend on the worker
that does it, on the number of workers or on the order, and a task whose worker was lost can be done again.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Generator, Sequence
from types import TracebackType
from typing import Any, TypeVar

from typing_extensions import Self

from deal_hw.errors import TaskLostError

S = TypeVar("S")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])


class TaskMap(abc.ABC):
    """Applies a function to specifications that do not depend on each other.

    A context manager: workers are started at its beginning and ended at its end.
    """

    here = False
    """Whether tasks run in this process, so that they share its memory."""

    _made: tuple[tuple[object, ...], Any] | None = None

    @property
    def workers(self) -> int:
        """How many tasks run at once, now."""
        return 1

    def once(self, of: tuple[object, ...], make: Callable[[], F]) -> F:
        """Return the function that was made for the same objects in the last call, or make it.

        A function that is given again is not sent again, and keeps what it has stored in a worker. ``of`` is
        all that it depends on, which nobody may change.
        """
        made = self._made
        if made is None or [*map(id, made[0])] != [*map(id, of)]:
            made = self._made = of, make()
        function: F = made[1]
        return function

    @abc.abstractmethod
    def completed(
        self,
        function: Callable[[S], R],
        specs: Sequence[S],
        lost: Callable[[S, TaskLostError], R] | None = None,
    ) -> Generator[tuple[int, R], None, None]:
        """Yield the index and the result of each task as it ends; closed early, it begins no others.

        Args:
            function: Pure: its result depends on the specification alone. What all tasks have in common, such
                as recordings, is bound to it (``functools.partial``) and sent once, also where the same
                function is given in the next call.
            specs: One small value for each task.
            lost: Makes the result of a task that could not be done since its workers ended; None: that is
                raised.

        Raises:
            TaskLostError: The workers of a task ended, each time that it was begun.
            ClusterError: The function, with what is bound to it, cannot be sent to the workers.
        """

    def map(self, function: Callable[[S], R], specs: Sequence[S]) -> list[R]:
        """Return the results in the order of the specifications. See :meth:`completed`."""
        found = dict(self.completed(function, specs))
        return [found[index] for index in range(len(specs))]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the workers; what they have not finished is lost."""
        return None


class InThisProcess(TaskMap):
    """Does one task after the other, in order."""

    here = True

    def completed(
        self,
        function: Callable[[S], R],
        specs: Sequence[S],
        lost: Callable[[S, TaskLostError], R] | None = None,
    ) -> Generator[tuple[int, R], None, None]:
        """See :meth:`TaskMap.completed`; each task begins when its result is asked for."""
        for index, spec in enumerate(specs):
            yield index, function(spec)
