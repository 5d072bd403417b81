"""Fits that do not depend on each other, done where the problem says."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Sequence
from functools import partial
from typing import TypeVar

from deal_hw.calib.data.problem import Problem

S = TypeVar("S")
R = TypeVar("R")


def in_order(
    problem: Problem, function: Callable[[Problem, S], R], specs: Sequence[S]
) -> Generator[R, None, None]:
    """Yield a function's results for a problem and each specification, in order.

    Here each begins when its result is asked for. In workers all begin at once; where the iteration is left
    early, the others are cancelled, and the steps of those that have ended are not counted. So results and
    counts do not depend on where it runs.

    Args:
        problem: Recordings and simulator, simulated on one thread in workers. It is sent to them once, also
            where the same function and problem are given in the next call.
        function: Pure, beside the count of the problem's steps; it does not run the problem's policy.
        specs: One small value for each fit.
    """
    if problem.tasks.here:
        yield from (function(problem, spec) for spec in specs)
        return
    found: dict[int, tuple[R, int]] = {}
    work = problem.tasks.once((function, problem), lambda: partial(_counted, function, for_worker(problem)))
    # Closed at once, which cancels what is left, and not when the memory is collected.
    with contextlib.closing(problem.tasks.completed(work, specs)) as completed:
        for index in range(len(specs)):
            while index not in found:
                number, ended = next(completed)
                found[number] = ended
            result, steps = found.pop(index)
            problem.count(steps)
            yield result


def for_worker(problem: Problem) -> Problem:
    """Return the problem on one thread, and without the policy, which cannot be sent."""
    return problem.sharing(threads=1, policy=None)


def _counted(function: Callable[[Problem, S], R], problem: Problem, spec: S) -> tuple[R, int]:
    """Return a result and its physics steps."""
    before = problem.steps
    return function(problem, spec), problem.steps - before
