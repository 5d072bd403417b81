"""Contract of calibration: methods, budgets and results."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar

import numpy as np

from deal_hw.errors import ConfigurationError, short, shown
from deal_hw.findings import Finding, SafeChecks
from deal_hw.parameters import (
    LONGEST_LATENCY_S,
    Parameter,
    ParameterDistribution,
    ParameterSpace,
    covariance_of,
)
from deal_hw.reading import number, numbers, read_json, reading
from deal_hw.schema import OPEN, OPEN_FINITE, check_members, either, from_values, plain, refusal
from deal_hw.types import FloatArray

LATENCY_RANGE_S = (0.0, 0.04)
"""Default range of the latency search [s]."""
LATENCY = "latency"
"""Name of the latency among the values of a fit."""
Z90 = 1.6448536269514722
"""A standard normal lies within +- this with 90 % probability."""
EXPLAINED_CHI2 = 1.3
"""Mean squared residual over its expected variance up to which a model explains its recordings [-]."""
RESULT_FILE = "result.json"
FAILED_CHECKS = "checks_failed"
"""Entry of a result's provenance: why checks failed, by their names."""
RESULT_FORMAT = "deal_hw.calibration_result/1"
_LARGEST = 1e100
"""Largest amount of a number in a file: beyond it, sums of squares overflow."""
_MOST_STEPS, _MOST_SECONDS = 1e18, 1e9
"""Most physics steps and longest time of a calibration [s]: thirty years."""
Identifiability = Literal["identifiable", "weak", "not identifiable"]
ProblemT = TypeVar("ProblemT", contravariant=True)


BEFORE_SEARCH = "before the search"
"""Stage of a calibration before the search, for messages on what no search can find."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a long run; passed to the callback after each generation or iteration.

    Attributes:
        stage: The current stage, such as ``"search"``, ``"refinement"`` or ``"latency"``.
        done: Units done.
        total: Units expected; may grow.
        message: One short line.
        population: The current population, (N, K) physical values, or None.
        latency_s: The population's mean total latency [s], or None.
        values: Further values of this generation or iteration, as in the result's trace.
        estimate: A complete fit, (K,) physical values, with ``latency_s``; None within a search or a fit.
        space: Its parameters: at least those of the calibration; None: these.
        fitted: The fit that the result will have, with its intervals, before the checks; None before that.
    """

    stage: str
    done: int
    total: int
    message: str = ""
    population: FloatArray | None = None
    latency_s: float | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    estimate: FloatArray | None = None
    space: ParameterSpace | None = None
    fitted: CalibrationResult | None = None


ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """How much a method may use.

    Attributes:
        population: Members N.
        generations: Search steps T; restarts count.
        refine: Whether multiple shooting follows the search.
        brief: Whether the search ends as soon as the refinement can begin, instead of at its optimum.
    """

    population: int = 100
    generations: int = 50
    refine: bool = True
    brief: bool = False


def percent(share: float) -> str:
    """Return a share as text, in percent with two digits, as a whole number from 100 to a million."""
    value = 100 * share
    return f"{value:.0f} %" if 99.5 <= value < 1e6 else f"{value:.2g} %"


def std_words(parameter: Parameter, std: float) -> str:
    """Return a standard deviation in a parameter's own scale as text: in percent on a log scale."""
    return percent(std) if parameter.scale == "log" else f"{std:.2g} {parameter.unit}"


def listed(names: Sequence[str]) -> str:
    """Return names as text, of more than six only the first."""
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return ", ".join(names[:6]) + more


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationResult:
    """What a calibration found.

    Attributes:
        method: Name of the method.
        space: The parameters.
        estimate: Physical values, (K,).
        interval: 90 % interval of each parameter, (K, 2).
        covariance: In each parameter's own scale, (K, K); None if the method gives none.
        population: The last population, (N, K), or None.
        verdicts: How well the data determine each parameter.
        null_directions: Combinations that the data do not determine, as text.
        prior_directions: Combinations that an expected value determines more than the data, as text.
        latency_s: Total latency found, or given [s].
        latency_interval_s: 90 % interval of the latency [s].
        chi2: Mean squared residual over its expected variance; 1 is a perfect model.
        alarms: Reasons to distrust the result; empty is good.
        biased: Named cause of the residual that a value compensates for, by the name of its parameter, or
            "latency".
        advice: What to record next, one mapping per weak or unidentified parameter: ``parameter``, its
            standard deviation in its own scale now (``std``) and after that recording (``std_after``),
            ``excitation`` and a ``sentence``; empty if no parameter is weak or no advice was requested.
        heldout_nrmse: Held-out error by predictor: "nominal", "calibrated", "null" (the state stays as it
            is).
        trace: One mapping per generation or iteration.
        steps: Simulated physics steps.
        seconds: Wall clock [s].
        provenance: Versions, digests, settings, seed: plain JSON values.
        unchecked: Whether it is a fit whose checks were not made, or not to their end. The first alarm says
            why, and what to do.
    """

    method: str
    space: ParameterSpace
    estimate: FloatArray
    interval: FloatArray
    covariance: FloatArray | None = None
    population: FloatArray | None = None
    verdicts: tuple[Identifiability, ...] = ()
    null_directions: tuple[str, ...] = ()
    prior_directions: tuple[str, ...] = ()
    latency_s: float = 0.0
    latency_interval_s: tuple[float, float] = (0.0, 0.0)
    chi2: float = float("nan")
    alarms: tuple[Finding, ...] = ()
    biased: Mapping[str, str] = field(default_factory=dict)
    advice: Sequence[Mapping[str, Any]] = ()
    heldout_nrmse: Mapping[str, float] = field(default_factory=dict)
    trace: Sequence[Mapping[str, float]] = ()
    steps: int = 0
    seconds: float = 0.0
    provenance: Mapping[str, Any] = field(default_factory=dict)
    unchecked: bool = False

    @property
    def without_value(self) -> tuple[str, ...]:
        """Names of the parameters that the recordings do not determine."""
        verdicts = self.verdicts or ("",) * len(self.space)
        named = zip(self.space.names, verdicts, strict=True)
        return tuple(name for name, verdict in named if verdict == "not identifiable")

    def estimate_text(self, name: str) -> str:
        """Return a parameter's estimate as text; one that the recordings do not determine has no value."""
        if name in self.without_value:
            return "no value"
        return f"{self.estimate[self.space.names.index(name)]:.4g}"

    def with_unchecked(self, alarm: Finding) -> CalibrationResult:
        """Return it as a fit whose checks were not made; the alarm says why."""
        return replace(self, unchecked=True, alarms=(alarm, *self.alarms))

    def with_failed(self, checks: SafeChecks) -> CalibrationResult:
        """Return it with the failed checks among its alarms and in its provenance."""
        if not checks.failed:
            return self
        failed = {**self.provenance.get(FAILED_CHECKS, {}), **checks.failed}
        alarms = (*self.alarms, *checks.alarms)
        return replace(self, alarms=alarms, provenance={**self.provenance, FAILED_CHECKS: failed})

    def restricted(self, space: ParameterSpace) -> CalibrationResult:
        """Return the result of a space's parameters alone, which come first; others were added to it."""
        K = len(space)
        return replace(
            self,
            space=space,
            estimate=self.estimate[:K],
            interval=self.interval[:K],
            covariance=None if self.covariance is None else self.covariance[:K, :K],
            verdicts=self.verdicts[:K],
        )

    def distribution(self) -> ParameterDistribution:
        """Return the calibrated distribution of the parameters."""
        covariance = self.covariance
        if covariance is None:
            spread = np.diff(self.space.to_scale(self.interval.T), axis=0)[0] / (2 * Z90)
            covariance = np.diag(np.square(spread))
        return ParameterDistribution(
            space=self.space, mean=self.estimate, covariance=covariance, latency_s=self.latency_interval_s
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values (without population and trace, which go into ``trace.npz``).

        A number that is not finite is None.
        """
        parameters = {}
        for k, p in enumerate(self.space):
            parameters[p.name] = {
                "unit": p.unit,
                "nominal": p.nominal,
                "estimate": float(self.estimate[k]),
                "low": float(self.interval[k, 0]),
                "high": float(self.interval[k, 1]),
                "range": [p.low, p.high],
                "verdict": self.verdicts[k] if self.verdicts else None,
                "biased_by": self.biased.get(p.name),
            }
        values = {
            "format": RESULT_FORMAT,
            "method": self.method,
            "space": self.space.to_json(),
            "parameters": parameters,
            "known": self.space.known,
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "null_directions": list(self.null_directions),
            "prior_directions": list(self.prior_directions),
            "latency_s": self.latency_s,
            "latency_interval_s": list(self.latency_interval_s),
            "chi2": self.chi2,
            "alarms": [{"seen": a.seen, "means": a.means, "do": a.do} for a in self.alarms],
            "biased": dict(self.biased),
            "advice": [dict(row) for row in self.advice],
            "heldout_nrmse": dict(self.heldout_nrmse),
            "steps": self.steps,
            "seconds": self.seconds,
            "unchecked": self.unchecked,
            "provenance": dict(self.provenance),
        }
        return dict(plain(values))

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> CalibrationResult:
        """Return the result that :meth:`to_json` wrote.

        Raises:
            ConfigurationError: A field is of another kind or shape; the message names it.
        """
        if values.get("format") != RESULT_FORMAT:
            given = shown(values.get("format"))
            raise ConfigurationError(f"not a calibration result: format is {given}, not {RESULT_FORMAT!r}")
        found = from_values(_ResultFile, values)
        space = ParameterSpace(found.space)
        K = len(space)
        space.check_names("parameters", found.parameters)
        rows = [found.parameters[name] for name in space.names]
        for name, row in found.parameters.items():
            row.check(space, name)
        _check_mentions(space, found)
        _check_amounts("provenance", values["provenance"])
        for place, there in (
            ("provenance.shared_error", "shared_error" in values["provenance"]),
            ("unchecked", found.unchecked),
        ):
            if there and not found.alarms:
                raise ConfigurationError(f"field {place} has no alarm beside it")
        bounds = [[row.low, row.high] for row in rows] if K else np.empty((0, 2))
        low_s, high_s = numbers(found.latency_interval_s, "latency_interval_s", (2,), finite=False)
        return cls(
            method=found.method,
            space=space,
            estimate=numbers([row.estimate for row in rows], "estimate", (K,)),
            interval=numbers(bounds, "interval", (K, 2), finite=False),
            covariance=None if found.covariance is None else covariance_of(found.covariance, space),
            verdicts=tuple(row.verdict for row in rows if row.verdict is not None),
            null_directions=found.null_directions,
            prior_directions=found.prior_directions,
            latency_s=number(found.latency_s, "latency_s", 0.0, LONGEST_LATENCY_S),
            latency_interval_s=(float(low_s), float(high_s)),
            chi2=_number(found.chi2),
            alarms=tuple(Finding.alarm(alarm.seen, alarm.means, alarm.do) for alarm in found.alarms),
            biased=found.biased,
            advice=tuple(values.get("advice", ())),
            heldout_nrmse={name: _number(value) for name, value in found.heldout_nrmse.items()},
            steps=int(number(found.steps, "steps", 0.0, _MOST_STEPS)),
            seconds=number(found.seconds, "seconds", 0.0, _MOST_SECONDS),
            provenance=values["provenance"],
            unchecked=found.unchecked,
        )


@dataclass(frozen=True, slots=True)
class _Row:
    """A parameter of a result's file; an end of an interval is null where it is not finite.

    The parameter's own facts stand there for people; they are those of the space.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN_FINITE

    estimate: float
    low: float | None
    high: float | None
    verdict: Identifiability | None = None
    unit: str | None = None
    nominal: float | None = None
    range: tuple[float, float] | None = None
    biased_by: str | None = None

    def check(self, space: ParameterSpace, name: str) -> None:
        """Check the numbers against the parameter's range, and the facts against the space.

        Raises:
            ConfigurationError: The message names the field.
        """
        what, p = f"parameters.{name}", space[name]
        space.check_value(f"{what}.estimate", name, self.estimate)
        for end, value in (("low", self.low), ("high", self.high)):
            if value is not None:
                space.check_value(f"{what}.{end}", name, value, end=True)
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ConfigurationError(
                f"fields {what}.low and {what}.high are {self.low:g} and {self.high:g}; the lower one comes "
                "first"
            )
        for fact, given, own in (
            ("unit", self.unit, p.unit),
            ("nominal", self.nominal, p.nominal),
            ("range", self.range, (p.low, p.high)),
        ):
            if given is not None and given != own:
                raise ConfigurationError(f"field {what}.{fact} is {given}, and the field space has {own}")


@dataclass(frozen=True, slots=True)
class _Alarm:
    """An alarm of a result's file."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN

    seen: str
    means: str
    do: str

    def __post_init__(self) -> None:
        Finding.alarm(self.seen, self.means, self.do)


@dataclass(frozen=True, slots=True)
class _Advice:
    """What is read of a row of the advice."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN_FINITE

    parameter: str | None = None
    std: float | None = None
    std_after: float | None = None

    def __post_init__(self) -> None:
        for name in ("std", "std_after"):
            _at_least_0(name, getattr(self, name))


@dataclass(frozen=True, slots=True)
class _Noise:
    """What is read of the sensors' noise, as a held-out error."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN_FINITE

    nrmse: float | None = None
    mean: float | None = None
    by_coordinate: dict[str, float | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("nrmse", "mean", "by_coordinate"):
            _all_at_least_0(name, getattr(self, name))


@dataclass(frozen=True, slots=True)
class _Errors:
    """What is read of held-out errors; each is null where a prediction diverged."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN_FINITE

    window_s: float | None = None
    mean: dict[str, float | None] = field(default_factory=dict)
    pooled: dict[str, float | None] = field(default_factory=dict)
    by_coordinate: dict[str, dict[str, float | None]] = field(default_factory=dict)
    unit: dict[str, str] = field(default_factory=dict)
    noise: _Noise = field(default_factory=_Noise)

    def __post_init__(self) -> None:
        for name in ("window_s", "mean", "pooled", "by_coordinate"):
            _all_at_least_0(name, getattr(self, name))


@dataclass(frozen=True, slots=True)
class _Provenance:
    """What is read of the provenance."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN_FINITE

    heldout_rmse: _Errors | None = None


@dataclass(frozen=True, slots=True)
class _ResultFile:
    """A result as its file has it."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN_FINITE

    method: str
    space: tuple[Parameter, ...]
    parameters: dict[str, _Row]
    covariance: list[list[float]] | None
    null_directions: tuple[str, ...]
    latency_s: float
    latency_interval_s: tuple[float | None, float | None]
    chi2: float | None
    alarms: tuple[_Alarm, ...]
    heldout_nrmse: dict[str, float | None]
    steps: float
    seconds: float
    provenance: _Provenance
    biased: dict[str, str] = field(default_factory=dict)
    known: dict[str, float] | None = None
    prior_directions: tuple[str, ...] = ()
    # Results from before advice and unchecked results existed have neither.
    advice: tuple[_Advice, ...] = ()
    unchecked: bool = False

    def __post_init__(self) -> None:
        told = [name for name, row in self.parameters.items() if row.verdict is not None]
        if told and len(told) < len(self.parameters):
            raise ConfigurationError("some of the parameters have a verdict and others have none")
        _at_least_0("chi2", self.chi2)
        for name, value in self.heldout_nrmse.items():
            _at_least_0(f"heldout_nrmse.{name}", value)
        low_s, high_s = self.latency_interval_s
        for end_s in self.latency_interval_s:
            if end_s is not None:
                number(end_s, "latency_interval_s", 0.0, LONGEST_LATENCY_S)
        if low_s is not None and high_s is not None and low_s > high_s:
            raise refusal("latency_interval_s", [low_s, high_s], "two times, the shorter one first")


def _check_mentions(space: ParameterSpace, found: _ResultFile) -> None:
    """Check that whatever a result says of parameters, it says of its own.

    Raises:
        ConfigurationError: The message names the field.
    """
    known = space.known if found.known is None else found.known
    for name in sorted({*known, *space.known}):
        if known.get(name) != space.known.get(name):
            own = f"{space.known.get(name)}, as the field space has it"
            raise refusal(f"known.{name}", known.get(name), own)
    names = (*space.names, LATENCY)
    check_members("biased", tuple(found.biased), names)
    for name, row in found.parameters.items():
        if row.biased_by is not None and row.biased_by != found.biased.get(name):
            raise refusal(f"parameters.{name}.biased_by", row.biased_by, "as the field biased has it")
    for i, advice in enumerate(found.advice):
        if advice.parameter is not None and advice.parameter not in names:
            raise refusal(f"advice[{i}].parameter", advice.parameter, either(names))


def _at_least_0(name: str, value: float | None) -> None:
    if value is not None and not 0 <= value <= _LARGEST:
        raise refusal(name, value, f"0 to {_LARGEST:g}, or null")


def _all_at_least_0(name: str, values: Any) -> None:
    if isinstance(values, Mapping):
        for key, value in values.items():
            _all_at_least_0(f"{name}.{short(key)}", value)
    else:
        _at_least_0(name, values)


def _check_amounts(place: str, value: Any) -> None:
    """Check that every number of plain JSON values is finite, and small enough to calculate with.

    Raises:
        ConfigurationError: The message names the place.
    """
    if isinstance(value, Mapping):
        for name, inside in value.items():
            _check_amounts(f"{place}.{name}", inside)
    elif isinstance(value, list | tuple):
        for i, inside in enumerate(value):
            _check_amounts(f"{place}[{i}]", inside)
    elif isinstance(value, int | float) and not abs(value) <= _LARGEST:
        raise refusal(short(place), value, f"{-_LARGEST:g} to {_LARGEST:g}, or null")


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def read_result(path: Path) -> CalibrationResult:
    """Read a result from its file or its folder.

    Raises:
        DatasetError: There is none.
        ConfigurationError: The file contains no result; the message names the field.
    """
    file = path / RESULT_FILE if path.is_dir() else path
    what, advice = "a calibration result", "`deal-hw calibrate` writes one"
    values = read_json(file, dict[str, Any], what, advice)
    with reading(file, what, advice):
        return CalibrationResult.from_json(values)


class StateStore(Protocol):
    """Stores the state from which a method can continue: nested mappings of plain values and arrays."""

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the stored state, completely or not at all."""

    def load(self) -> Mapping[str, Any] | None:
        """Return the stored state, or None.

        Raises:
            DealHwError: It belongs to another run, or is unreadable.
        """


class CalibrationMethod(abc.ABC, Generic[ProblemT]):
    """A calibration method. It knows the problem (data and simulator); the optimiser inside knows neither."""

    name: str

    @property
    def adversarial(self) -> bool:
        """Whether a critic learns to tell recording and simulation apart."""
        return False

    @property
    def moves(self) -> bool:
        """Whether it looks for other values than the model's own."""
        return True

    @abc.abstractmethod
    def run(
        self,
        problem: ProblemT,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Calibrate.

        Args:
            problem: Data and simulator.
            budget: How much may be used.
            rng: The only source of randomness: the same generator state gives the same result.
            progress: Called after each generation; may raise to stop the run.
            checkpoint: Updated after each generation. A state in it at the start is continued, with the same
            numbers as without the interruption; ``rng`` is then set to the saved state.
        """
