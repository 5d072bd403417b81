"""Memory over generations: what a search holds after many is what it held after some, traced, not timed."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.pipeline.methods import make_method
from deal_hw.calibration import Budget, Progress

FROM, TO = 5, 11
"""Generations between which is compared: by the first all buffers have their size."""
MOST_BYTES = 2000
"""Growth a generation: one row of the trace, some hundred bytes; a population alone would be more."""
MEMBERS = 24


class Enough(Exception):  # noqa: N818
    """The wanted number of generations is reached."""


@pytest.mark.parametrize("name", ["eki", "cma", "random"])
def test_memory_stays_flat(name: str, small_problem: Callable[..., Problem]) -> None:
    """Between the 5th and the 11th generation next to nothing is kept, however many runs they take."""
    problem, held = small_problem(seconds=0.6), []

    def note(progress: Progress) -> None:
        gc.collect()
        held.append(tracemalloc.get_traced_memory()[0])
        if len(held) >= TO:
            raise Enough

    # Libraries load here: to trace the memory of `cma`'s takes four times as long as to load them.
    make_method(name).run(
        problem, Budget(population=MEMBERS, generations=1, refine=False), np.random.default_rng(TO)
    )
    # What was there before is not traced, and looking through all of it takes 0.5 s each time. It stays
    # frozen, as tests/conftest.py has frozen it for the tests that follow.
    gc.freeze()
    tracemalloc.start()
    try:
        for seed in range(TO):
            budget = Budget(population=MEMBERS, generations=TO, refine=False)
            make_method(name).run(problem, budget, np.random.default_rng(seed), note)
    except Enough:
        pass
    finally:
        tracemalloc.stop()
    grown = (held[TO - 1] - held[FROM - 1]) / (TO - FROM)
    assert grown < MOST_BYTES
