"""Fits that do not depend on each other give the same results and counts wherever they run."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable, Generator, Sequence
from typing import Any

import numpy as np
import pytest

from deal_hw.calib.data.independent import for_worker, in_order
from deal_hw.calib.data.innovations import Members, predict_population
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts, run_identity
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.pipeline.methods import make_method
from deal_hw.calib.pipeline.minima import RestartSettings, lower_minimum
from deal_hw.calib.search.no_data import nominal
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget
from deal_hw.errors import TaskLostError
from deal_hw.task_map import InThisProcess, TaskMap


class Pickled(TaskMap):
    """Does tasks as workers do: with a copy of everything, and the last one first."""

    def __init__(self, workers: int = 1) -> None:
        self.done, self.closed, self._workers = 0, 0, workers
        self.last, self.functions = object(), 0

    @property
    def workers(self) -> int:
        """See the base class."""
        return self._workers

    def __reduce__(self) -> tuple[Callable[[], object], tuple[()]]:
        return object, ()

    def completed(
        self,
        function: Callable[[Any], Any],
        specs: Sequence[Any],
        lost: Callable[[Any, TaskLostError], Any] | None = None,
    ) -> Generator[tuple[int, Any], None, None]:
        """See the base class."""
        sent = pickle.dumps(function)
        if function is not self.last:
            self.last, self.functions = function, self.functions + 1
        try:
            for index in reversed(range(len(specs))):
                result = pickle.loads(sent)(pickle.loads(pickle.dumps(specs[index])))
                self.done += 1
                yield index, pickle.loads(pickle.dumps(result))
        finally:
            self.closed += 1


@pytest.fixture
def both(small_problem: Callable[..., Problem]) -> tuple[Problem, Problem]:
    """The same problem twice: fits here, and fits in workers."""
    return small_problem(), small_problem().sharing(tasks=Pickled())


def _simulated(problem: Problem, factor: float) -> float:
    """Return a number that needs the simulator."""
    data = problem.windows(8)[0]
    found = problem.predict(factor * problem.space.nominal[None], np.zeros(1), data)
    return float(np.sum(found.position))


def test_results_and_steps_are_the_same(both: tuple[Problem, Problem]) -> None:
    """In order, although the last ends first; simulators are made anew in the worker."""
    factors = [1.0, 1.1, 1.2]
    found = [list(in_order(problem, _simulated, factors)) for problem in both]
    assert found[0] == found[1] and len(set(found[0])) == 3
    assert both[0].steps == both[1].steps > 0


def test_a_policy_stays_here(both: tuple[Problem, Problem]) -> None:
    """Its network cannot be sent, and these fits do not run it; other numbers of the problem stay."""
    sent = pickle.loads(pickle.dumps(for_worker(both[1])))
    assert sent.policy is None and sent.threads == 1 and sent.steps == 0
    assert np.array_equal(sent.noise_std, both[1].noise_std) and both[1].policy is not None


def test_what_is_not_asked_for_is_not_counted(both: tuple[Problem, Problem]) -> None:
    """Where the first result decides, others that have ended do not count, and the rest is cancelled."""
    for problem in both:
        fits = in_order(problem, _simulated, [1.0, 1.1])
        assert np.isfinite(next(fits))
        fits.close()
    tasks = both[1].tasks
    assert isinstance(tasks, Pickled) and (tasks.done, tasks.closed) == (2, 1)
    assert both[0].steps == both[1].steps > 0


def test_drawn_starts(both: tuple[Problem, Problem]) -> None:
    """The same one is taken, after the same number of steps."""
    found, steps = [], []
    for problem in both:
        start = dataclasses.replace(refine(problem, problem.space.high, 0.0, (0.2,), iterations=1), chi2=1e6)
        run = CalibrationRun(
            problem=problem,
            budget=Budget(population=8, generations=1),
            rng=np.random.default_rng(0),
            attempts=Restarts(nominal(), np.random.default_rng(0), None),
            settings=Validation(cross_validation=False),
        )
        lower = lower_minimum(run, start, RestartSettings(drawn=2))
        assert lower is not None
        found.append((lower.theta.tobytes(), lower.chi2, lower.latency_s))
        steps.append(problem.steps)
    assert found[0] == found[1] and steps[0] == steps[1]


@pytest.mark.parametrize(("workers", "tasks"), [(1, 0), (3, 3), (20, 7)])
def test_a_population_is_shared_by_more_workers_than_threads(
    both: tuple[Problem, Problem], workers: int, tasks: int
) -> None:
    """The same bits and steps; a worker that is no more than this process's thread brings nothing."""
    here, there = both[0].sharing(threads=1), both[1].sharing(threads=1, tasks=Pickled(workers))
    data = here.windows(8)[0]
    theta = here.space.nominal * np.linspace(0.5, 1.5, 7)[:, None]
    members = Members(theta, np.linspace(-0.002, 0.02, 7))
    moved = data.start_position + 0.01, data.start_velocity - 0.01
    for starts in ((), moved):
        found = [predict_population(problem, members, data, *starts) for problem in (here, there)]
        assert found[0].tobytes() == found[1].tobytes() and np.isfinite(found[0]).all()
    assert isinstance(there.tasks, Pickled) and there.tasks.done == 2 * tasks
    assert here.steps == there.steps > 0


@pytest.mark.parametrize("noise", [None, 1e-3])
@pytest.mark.parametrize("method", ["deal", "eki", "random"])
def test_searches(both: tuple[Problem, Problem], method: str, noise: float | None) -> None:
    """With a population in workers: all numbers are the same, and the recordings are sent once."""
    results = []
    for exact in both:
        problem = exact
        if noise is not None:
            problem = dataclasses.replace(exact, known_std=np.full(4, noise))
        tasks = Pickled(2) if exact is both[1] else problem.tasks
        problem = problem.sharing(threads=1, tasks=tasks)
        budget = Budget(population=8, generations=4, refine=False)
        found = make_method(method, refine=False).run(problem, budget, np.random.default_rng(0))
        results.append((found.estimate.tobytes(), found.chi2, problem.steps))
        if isinstance(problem.tasks, Pickled):
            assert problem.tasks.done > 0
            assert problem.tasks.functions == 1
    assert results[0] == results[1]


def test_a_function_is_made_anew_where_what_it_depends_on_is_another() -> None:
    """By identity; equal values that are other objects count as others."""
    tasks, first, second = InThisProcess(), [1], [1]
    made = [tasks.once((first,), lambda: lambda: 1) for _ in range(2)]
    assert made[0] is made[1]
    assert tasks.once((second,), lambda: lambda: 2)() == 2
    assert tasks.once((second, first), lambda: lambda: 3)() == 3


@pytest.mark.slow
@pytest.mark.parametrize("method", ["output-error", "least-squares-multistart"])
def test_methods(both: tuple[Problem, Problem], method: str) -> None:
    """Folds of the cross-validation, starts of the baseline: every number of the result is the same."""
    results = []
    for exact in both:
        # With a chosen residual no fit is conclusive, so folds follow.
        problem = dataclasses.replace(exact, known_std=np.full(4, 1e-3))
        budget = Budget(population=8, generations=2, refine=method == "output-error")
        result = make_method(method, refine=budget.refine).run(problem, budget, np.random.default_rng(0))
        facts = {name: value for name, value in result.provenance.items() if "seconds" not in name}
        results.append((result.estimate.tobytes(), result.interval.tobytes(), result.steps, repr(facts)))
    tasks = both[1].tasks
    assert isinstance(tasks, Pickled) and tasks.done > 2
    assert results[0] == results[1]


def test_a_checkpoint_is_of_the_same_run_wherever_its_fits_are_done(both: tuple[Problem, Problem]) -> None:
    """So a calibration that was stopped in workers can be continued without them."""
    method, budget = nominal(), Budget()
    here, there = (run_identity(p, method, budget, np.random.default_rng(0)) for p in both)
    assert here == there
