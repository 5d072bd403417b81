"""The table of calibration methods: name and factory, imported on use.

A calibration is a pipeline with a search inside it. ``default+eki`` names both; ``default`` alone has the
search :data:`DEFAULT_SEARCH`. The other names are baselines, and the searches alone, for comparison.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, cast

from deal_hw.calibration import Budget, CalibrationMethod
from deal_hw.errors import ConfigurationError, UnknownNameError

if TYPE_CHECKING:
    from deal_hw.calib.data.problem import Problem

PIPELINES = ("default", "output-error", "local", "gait", "nominal")
"""Whole calibrations, as a user names them."""

SEARCHES = ("deal", "eki", "deal-paper")
"""Searches inside a pipeline, as a user names them."""

SEARCH_VARIANTS = ("deal-critic", "deal-untrained", "deal-no-critic")
"""Parts of `deal`, for comparison: `bench` takes them inside a pipeline, too."""

DEFAULT_SEARCH: Final = "deal"
"""The search where none is named."""

SEARCHING = frozenset({"default", "output-error", "output-error-no-laws"})
"""Pipelines with a search. What laws gain is measured beside the last one."""

METHODS: dict[str, str] = {
    "default": "deal_hw.calib.pipeline.output_error_fits:default_method",
    "eki": "deal_hw.calib.search.eki:Eki",
    "deal": "deal_hw.calib.search.deal:Deal",
    "deal-critic": "deal_hw.calib.search.deal:critic_alone",
    "deal-untrained": "deal_hw.calib.search.deal:untrained",
    "deal-no-critic": "deal_hw.calib.search.deal:without_critic",
    "deal-paper": "deal_hw.calib.paper.algorithm1:paper",
    "deal-paper-literal": "deal_hw.calib.paper.algorithm1:literal",
    "deal-paper-literal-fn": "deal_hw.calib.paper.algorithm1:literal_without_noise_adaptation",
    "deal-paper-literal-pn": "deal_hw.calib.paper.algorithm1:literal_without_normalisation",
    "deal-paper-literal-flat": "deal_hw.calib.paper.algorithm1:literal_flat",
    "deal-paper-fn": "deal_hw.calib.paper.algorithm1:without_noise_adaptation",
    "deal-paper-pn": "deal_hw.calib.paper.algorithm1:without_normalisation",
    "deal-paper-flat": "deal_hw.calib.paper.algorithm1:flat",
    "deal-paper-replay": "deal_hw.calib.paper.algorithm1:replayed",
    "deal-paper-energy": "deal_hw.calib.paper.algorithm1:by_energy",
    "deal-paper-mmd": "deal_hw.calib.paper.algorithm1:by_kernel",
    "deal-unaligned": "deal_hw.calib.search.unaligned:by_critic",
    "mmd-unaligned": "deal_hw.calib.search.unaligned:by_kernel",
    "moments-unaligned": "deal_hw.calib.search.unaligned:by_moments",
    "output-error": "deal_hw.calib.pipeline.output_error_fits:output_error_method",
    "output-error-no-laws": "deal_hw.calib.pipeline.output_error_fits:without_laws",
    "local": "deal_hw.calib.pipeline.output_error_fits:local",
    "gait": "deal_hw.calib.pipeline.output_error_fits:gait",
    "easi": "deal_hw.calib.baselines.easi:Easi",
    "easi-log": "deal_hw.calib.baselines.easi:logarithmic",
    "bo": "deal_hw.calib.baselines.bayesian:BayesianOptimisation",
    "bo-critic": "deal_hw.calib.baselines.bayesian:critic_return",
    "cma": "deal_hw.calib.baselines.cma_es:Cma",
    "gauss-newton": "deal_hw.calib.baselines.gauss_newton:GaussNewton",
    "least-squares": "deal_hw.calib.baselines.least_squares:LeastSquaresBaseline",
    "least-squares-random": "deal_hw.calib.baselines.least_squares:from_random_start",
    "least-squares-multistart": "deal_hw.calib.baselines.least_squares:MultiStartLeastSquares",
    "ekf": "deal_hw.calib.baselines.ekf:Ekf",
    "ekf-one-pass": "deal_hw.calib.baselines.ekf:one_pass",
    "mujoco-sysid": "deal_hw.calib.baselines.sysid:MujocoSysid",
    "random": "deal_hw.calib.baselines.random_search:RandomSearch",
    "midpoint": "deal_hw.calib.search.no_data:midpoint",
    "midpoint-linear": "deal_hw.calib.search.no_data:linear_midpoint",
    "nominal": "deal_hw.calib.search.no_data:nominal",
}
"""Name -> ``module:callable``: of a pipeline with a search, its factory by the search; of all others without
arguments."""

NO_DATA_METHODS = frozenset(
    {"midpoint", "midpoint-linear", "nominal", "deal-paper-flat", "deal-paper-literal-flat"}
)
"""Baselines that must not read the data. They are never refined."""

UNALIGNED_METHODS = frozenset({"deal-unaligned", "mmd-unaligned", "moments-unaligned"})
"""Searches that compare distributions. A refinement would align what they do not."""

ENGINE_SEARCHES = (
    frozenset({"deal", *SEARCH_VARIANTS, "eki", "random"})
    | {name for name in METHODS if name.startswith("deal-paper")} - NO_DATA_METHODS
    | UNALIGNED_METHODS
)
"""Searches whose populations the problem's engine simulates; all others take mujoco.batch."""

CLOSED_LOOP_METHODS = UNALIGNED_METHODS | frozenset(
    {
        "deal-paper",
        "deal-paper-literal",
        "deal-paper-literal-fn",
        "deal-paper-literal-pn",
        "deal-paper-fn",
        "deal-paper-pn",
        "deal-paper-energy",
        "deal-paper-mmd",
        "easi",
        "easi-log",
        "bo-critic",
    }
)
"""Methods that run the recordings' policy in every simulator."""

PAPER_POPULATION = 200
"""Number of simulators in the DEAL paper's Table 4."""

WHOLE_METHODS = UNALIGNED_METHODS | {"output-error", "output-error-no-laws", "local", "gait", "mujoco-sysid"}
"""Methods with their own refinement, that align nothing, or that represent another tool. They are never
refined."""


RATES_METHODS = NO_DATA_METHODS | {"eki", "local", "gait"}
"""Methods, and searches, that take recordings of several rates. Others compare sample with sample."""


def divided(name: str) -> tuple[str, str]:
    """Return a method's pipeline and its search; the search is "" where the name is no pipeline with one."""
    pipeline, plus, search = name.partition("+")
    if pipeline not in SEARCHING:
        return name, ""
    return pipeline, search if plus else DEFAULT_SEARCH


def with_search(pipeline: str, search: str) -> str:
    """Return the name of a pipeline with a search inside it; the same name where it has none."""
    return pipeline if search == DEFAULT_SEARCH or pipeline not in SEARCHING else f"{pipeline}+{search}"


def with_rates(name: str) -> str:
    """Return a method for recordings of several rates: a pipeline's search is one that takes them.

    Raises:
        ConfigurationError: The method takes one rate only.
    """
    pipeline, search = divided(name)
    if search:
        return pipeline + "+eki"
    if name not in RATES_METHODS:
        raise ConfigurationError(
            f"--method {name} takes recordings of one rate, and these have several; leave out --method, or "
            "calibrate the recordings of one rate"
        )
    return name


def is_default(name: str) -> bool:
    """Return whether a method is the default pipeline, whatever search it has."""
    return divided(name)[0] == "default"


def search_of(name: str) -> str:
    """Return the search of a method, which is the method itself where it is no pipeline."""
    pipeline, search = divided(name)
    return search or pipeline


def takes_engine(name: str) -> bool:
    """Return whether a method has a search whose populations the problem's engine simulates."""
    return search_of(name) in ENGINE_SEARCHES or name in SEARCHING


def check_method(name: str) -> None:
    """Raise `UnknownNameError`, which lists the table, where there is no such method."""
    pipeline, search = divided(name)
    if pipeline not in METHODS:
        raise UnknownNameError("calibration method", name, METHODS)
    if search and search not in SEARCHES + SEARCH_VARIANTS:
        raise UnknownNameError("search", search, SEARCHES + SEARCH_VARIANTS)


def usual_population(name: str) -> int:
    """Return a method's default population."""
    search = search_of(name)
    paper = search in CLOSED_LOOP_METHODS or search.startswith("deal-paper")
    return PAPER_POPULATION if paper else Budget().population


def usual_budget(
    name: str, population: int | None = None, generations: int | None = None, *, refine: bool = True
) -> Budget:
    """Return a method's budget; a population or a number of generations of None means its default."""
    members = population or usual_population(name)
    return Budget(population=members, generations=generations or Budget().generations, refine=refine)


def make_method(
    name: str, *, refine: bool = False, thorough: bool = False, laws: bool = True
) -> CalibrationMethod[Problem]:
    """Return a new method; see `check_method`.

    ``refine`` has no effect on baselines and whole methods; `default` without it is its search alone.
    ``thorough`` and ``laws`` are those of :class:`deal_hw.calib.validation.settings.Validation`.
    """
    from deal_hw.calib.pipeline.stages import CalibrationPipeline
    from deal_hw.calib.validation.settings import Validation

    check_method(name)
    pipeline, inside = divided(name)
    if inside:
        search = _made(inside)
        if pipeline == "default" and not refine:
            return search
        made: CalibrationMethod[Problem] = _factory(pipeline)(search, name)
    else:
        made = _made(name)
    if isinstance(made, CalibrationPipeline):
        laws = laws and made.settings.laws
        made.settings = dataclasses.replace(made.settings, thorough=thorough, laws=laws)
        return made
    if not refine or name in NO_DATA_METHODS | WHOLE_METHODS:
        return made
    # Who compares searches wants each to run, even where refining the nominal values would be enough.
    return CalibrationPipeline(made, name, Validation(local_first=False, thorough=thorough, laws=laws))


def _factory(name: str) -> Callable[..., CalibrationMethod[Problem]]:
    module, _, attribute = METHODS[name].partition(":")
    return cast(
        "Callable[..., CalibrationMethod[Problem]]", getattr(importlib.import_module(module), attribute)
    )


def _made(name: str) -> CalibrationMethod[Problem]:
    return _factory(name)()
