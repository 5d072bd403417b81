"""Contract of parameters: their names, search ranges, and their distribution after a calibration.

A :class:`Parameter` is named after the element and the MuJoCo field it changes. The search runs in the unit
cube; :meth:`ParameterSpace.normalize` and :meth:`ParameterSpace.unnormalize` are the only two functions that
map to and from it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from deal_hw.errors import ConfigurationError, UnknownNameError, shown
from deal_hw.physical import check_amount
from deal_hw.reading import numbers
from deal_hw.schema import FINITE, OPEN_FINITE, from_values
from deal_hw.types import FloatArray

Scale = Literal["log", "linear"]
FORMAT = "deal_hw.parameter_distribution/1"
"""Format name of a distribution's JSON."""
LONGEST_LATENCY_S = 1.0
"""Longest total latency [s]."""
_ROUNDING = 1e-6
"""Share of a range by which a value may lie outside of it."""
_LARGEST_STD = 1e12
"""Largest standard deviation, in a parameter's own scale; on either scale it says nothing of the value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One physical parameter.

    Attributes:
        name: Unique name, ``<element>.<quantity>``.
        kind: Name of the function in ``deal_hw.sim.parameters`` that applies it.
        elements: MuJoCo elements that it changes together (symmetry), usually one.
        unit: SI unit.
        nominal: The value in the user's model.
        low: Lower end of the search range.
        high: Upper end of the search range.
        scale: "log": equal steps are equal ratios; "linear": equal differences.
        known: Measured by other means (ruler, scale); not searched.
        prior_mean: Expected physical value; None: no expectation.
        prior_std: Standard deviation of the expectation in the parameter's own scale: a share of the value
        (0.05 for 5 %) on a log scale, in the parameter's unit on a linear one.
        setup: The set-up in whose recordings it acts, or "@" and the name of one recording; "" for all.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    name: str
    kind: str
    elements: tuple[str, ...]
    unit: str
    nominal: float
    low: float
    high: float
    scale: Scale = "log"
    known: bool = False
    prior_mean: float | None = None
    prior_std: float | None = None
    setup: str = ""

    @classmethod
    def around(
        cls, name: str, kind: str, elements: Iterable[str], unit: str, nominal: float, ratio: float = 5.0
    ) -> Parameter:
        """Return a parameter on a log scale, searched from nominal / ratio to nominal * ratio."""
        return cls(
            name=name,
            kind=kind,
            elements=tuple(elements),
            unit=unit,
            nominal=nominal,
            low=nominal / ratio,
            high=nominal * ratio,
        )

    @classmethod
    def encoder_bias(cls, joint: str, most: float, *, unit: str = "rad", setup: str = "") -> Parameter:
        """Return a joint's encoder bias, reported minus true position, up to ``most`` to both sides.

        ``most`` is in the joint's ``unit``. With a ``setup`` it is that of the set-up's recordings alone.
        """
        return cls(
            name=f"{joint}.encoder_bias" + (f"@{setup.removeprefix('@')}" if setup else ""),
            kind="encoder_bias",
            elements=(joint,),
            unit=unit,
            nominal=0.0,
            low=-most,
            high=most,
            scale="linear",
            setup=setup,
        )

    @classmethod
    def from_zero(
        cls, name: str, kind: str, elements: Iterable[str], unit: str, nominal: float, most: float
    ) -> Parameter:
        """Return a parameter on a linear scale that may be nil, searched from 0 to ``most``."""
        return cls(
            name=name,
            kind=kind,
            elements=tuple(elements),
            unit=unit,
            nominal=nominal,
            low=0.0,
            high=most,
            scale="linear",
        )

    @classmethod
    def friction_at_rest(
        cls,
        group: str,
        elements: Iterable[str],
        friction: float,
        *,
        speed: float = 0.1,
        units: tuple[str, str] = ("N·m", "rad/s"),
    ) -> list[Parameter]:
        """Return friction of joints that falls with speed: its excess at rest, and the Stribeck speed.

        Args:
            group: Name of the joints.
            elements: The joints.
            friction: Dry friction in motion [N·m or N]. The excess begins at 0.3 of it, and may be five times
                that.
            speed: Where the speed's search begins [rad/s or m/s]; it goes a factor of 10 to either side. A
                faster one cannot be told from less damping.
            units: Those of friction and speed.
        """
        joints, (of_friction, of_speed) = tuple(elements), units
        rest = f"{group}.friction_stribeck", "dof_friction_stribeck", joints, of_friction
        fall = f"{group}.stribeck_speed", "dof_stribeck_speed", joints, of_speed
        return [cls.from_zero(*rest, 0.3 * friction, 5 * friction), cls.around(*fall, speed, ratio=10.0)]

    @classmethod
    def friction_by_load(cls, group: str, elements: Iterable[str]) -> Parameter:
        """Return friction of joints that grows with the torque through the gear.

        It begins at 0.02 of it and may be half of it. Identified servos have up to 0.31 (BAM, bam/params).
        """
        return cls.from_zero(f"{group}.friction_load", "dof_friction_load", elements, "-", 0.02, 0.5)

    def __post_init__(self) -> None:
        if self.scale not in get_args(Scale):
            raise UnknownNameError(f"scale of parameter {self.name!r}", self.scale, get_args(Scale))
        if not (np.isfinite(self.high - self.low) and self.low < self.high):
            raise ConfigurationError(
                f"parameter {self.name!r}: range [{self.low:g}, {self.high:g}] {self.unit} must have "
                "low < high"
            )
        if self.scale == "log" and self.low <= 0:
            raise ConfigurationError(
                f"parameter {self.name!r}: a log scale needs a positive range, "
                f"got low={self.low:g} {self.unit}"
            )
        check_amount(f"parameter {self.name!r}: low, an end of its range,", self.low, self.unit)
        check_amount(f"parameter {self.name!r}: high, an end of its range,", self.high, self.unit)
        if not self.low <= self.nominal <= self.high:
            raise ConfigurationError(
                f"parameter {self.name!r}: the nominal value {self.nominal:g} lies outside "
                f"[{self.low:g}, {self.high:g}] {self.unit}; widen the range or correct the model"
            )
        self._check_prior()

    def _check_prior(self) -> None:
        if (self.prior_mean is None) != (self.prior_std is None):
            raise ConfigurationError(
                f"parameter {self.name!r}: a prior needs both mean and std, got mean={self.prior_mean}, "
                f"std={self.prior_std}"
            )
        if self.prior_mean is None or self.prior_std is None:
            return
        if not 0 < self.prior_std <= _LARGEST_STD:
            raise ConfigurationError(
                f"parameter {self.name!r}: prior std is {self.prior_std:g}; it must be above 0, at most "
                f"{_LARGEST_STD:g}"
            )
        if not self.low <= self.prior_mean <= self.high:
            raise ConfigurationError(
                f"parameter {self.name!r}: the prior's mean {self.prior_mean:g} lies outside "
                f"[{self.low:g}, {self.high:g}] {self.unit}"
            )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values, with a prior only if there is one."""
        values = dataclasses.asdict(self)
        if self.prior_mean is None:
            # Policies contain a digest of these values; policies from before priors existed must keep it.
            del values["prior_mean"], values["prior_std"]
        if not self.setup:
            del values["setup"]
        return values


class ParameterSpace:
    """An ordered set of parameters; arrays (N, K) follow the order of the K free ones.

    Args:
        parameters: All parameters, known ones included.
    """

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self.parameters = tuple(parameters)
        names = [p.name for p in self.parameters]
        if len(set(names)) != len(names):
            raise ConfigurationError(f"parameter names repeat: {names}")
        self.free = tuple(p for p in self.parameters if not p.known)
        log = np.array([p.scale == "log" for p in self.free], dtype=bool)
        self._log = log
        self.low = np.array([p.low for p in self.free])
        self.high = np.array([p.high for p in self.free])
        self.nominal = np.array([p.nominal for p in self.free])
        safe_low = np.where(log, self.low, 1.0)
        self._offset = np.where(log, np.log(safe_low), self.low)
        self._width = np.where(log, np.log(np.where(log, self.high, np.e)), self.high) - self._offset

    def __len__(self) -> int:
        return len(self.free)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.free)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(p.name for p in self.free)

    @property
    def log_scale(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Which free parameters are searched on a log scale, (K,)."""
        return self._log.copy()

    @property
    def known(self) -> dict[str, float]:
        """The parameters that are not searched, with their values."""
        return {p.name: p.nominal for p in self.parameters if p.known}

    def __getitem__(self, name: str) -> Parameter:
        for p in self.parameters:
            if p.name == name:
                return p
        raise UnknownNameError("parameter", name, (p.name for p in self.parameters))

    def to_scale(self, theta: FloatArray) -> FloatArray:
        """Map physical values, (..., K), to each parameter's scale: log or linear."""
        return np.where(self._log, np.log(np.where(self._log, theta, 1.0)), theta)

    def from_scale(self, value: FloatArray) -> FloatArray:
        """Undo :meth:`to_scale`; far ends of an interval may become 0 or infinite."""
        with np.errstate(over="ignore"):
            return np.where(self._log, np.exp(np.where(self._log, value, 0.0)), value)

    def normalize(self, theta: FloatArray) -> FloatArray:
        """Map physical values, (..., K), to the unit cube; values outside the range leave the cube."""
        return np.asarray((self.to_scale(theta) - self._offset) / self._width)

    def unnormalize(self, unit: FloatArray) -> FloatArray:
        """Map the unit cube, (..., K), to physical values."""
        return self.from_scale(self._offset + np.asarray(unit) * self._width)

    @property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean, in physical units, and standard deviation, in each parameter's own scale, (K,) each.

        Without an expectation: the nominal value and infinity.
        """
        mean = np.array([p.nominal if p.prior_mean is None else p.prior_mean for p in self.free], dtype=float)
        std = np.array([np.inf if p.prior_std is None else p.prior_std for p in self.free], dtype=float)
        return mean, std

    @property
    def width(self) -> FloatArray:
        """Width of the range in its own scale, (K,): ln(high / low) or high - low."""
        return self._width.copy()

    @property
    def center(self) -> FloatArray:
        """Physical values at the centre of the range, in each parameter's own scale, (K,)."""
        return self.unnormalize(np.full(len(self), 0.5))

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw uniformly in the unit cube; returns physical values, (count, K)."""
        return self.unnormalize(rng.random((count, len(self))))

    def with_ratio(self, range_ratio: float) -> ParameterSpace:
        """Return the space with log ranges from nominal / range_ratio to nominal * range_ratio.

        Raises:
            ConfigurationError: ``range_ratio`` is not above 1.
        """
        if not range_ratio > 1:
            raise ConfigurationError(f"the range ratio must be above 1, got {range_ratio:g}")
        return ParameterSpace(
            dataclasses.replace(p, low=p.nominal / range_ratio, high=p.nominal * range_ratio)
            if p.scale == "log"
            else p
            for p in self.parameters
        )

    def with_friction_laws(
        self, groups: Iterable[tuple[str, tuple[str, ...]]], friction: float
    ) -> ParameterSpace:
        """Return the space with friction by speed and by load of groups of rotary joints, each with a name.

        ``friction`` is the dry friction in motion [N·m]. Friction by load takes its place, so that one of
        this space may fall to a hundredth.
        """
        own = [
            dataclasses.replace(p, low=p.nominal / 100) if p.kind == "dof_frictionloss" else p
            for p in self.parameters
        ]
        for group, joints in groups:
            own += Parameter.friction_at_rest(group, joints, friction)
            own.append(Parameter.friction_by_load(group, joints))
        return ParameterSpace(own)

    def with_known(self, values: Mapping[str, float]) -> ParameterSpace:
        """Return the space with these parameters known at these values; ranges are widened to fit."""
        for name in values:
            self[name]
        return ParameterSpace(
            dataclasses.replace(
                p,
                nominal=values[p.name],
                low=min(p.low, values[p.name]),
                high=max(p.high, values[p.name]),
                known=True,
            )
            if p.name in values
            else p
            for p in self.parameters
        )

    def with_free(self, names: Iterable[str]) -> ParameterSpace:
        """Return the space in which exactly these are searched; all others keep their nominal value."""
        wanted = set(names)
        for name in wanted:
            self[name]
        return ParameterSpace(dataclasses.replace(p, known=p.name not in wanted) for p in self.parameters)

    def with_range(self, name: str, low: float, high: float) -> ParameterSpace:
        """Return the space with another range for one parameter."""
        self[name]
        return ParameterSpace(
            dataclasses.replace(p, low=low, high=high) if p.name == name else p for p in self.parameters
        )

    def holding(self, theta: FloatArray) -> ParameterSpace:
        """Return the space with ranges that hold these values, (K,)."""
        values = dict(zip(self.names, map(float, theta), strict=True))
        return ParameterSpace(
            dataclasses.replace(p, low=min(p.low, values[p.name]), high=max(p.high, values[p.name]))
            if p.name in values
            else p
            for p in self.parameters
        )

    def check_names(self, what: str, names: Iterable[str]) -> None:
        """Check that the names in a file are those of the free parameters.

        Raises:
            ConfigurationError: One is missing.
            UnknownNameError: One is no free parameter; the message lists those.
        """
        given = set(names)
        for name in self.names:
            if name not in given:
                raise ConfigurationError(f"field {what}.{name} is missing")
        for name in sorted(given.difference(self.names)):
            raise UnknownNameError(f"parameter of {what}", name, self.names)

    def check_value(self, what: str, name: str, value: float, *, end: bool = False) -> None:
        """Check that a value in a file is one that a search or a training can have had.

        Args:
            what: The field, for the message.
            name: The parameter.
            value: Its value.
            end: Whether it is an end of an interval, which a common factor of several values may move beyond
                the range.

        Raises:
            ConfigurationError: It lies outside the parameter's range.
        """
        p = self[name]
        width, log, around = p.high - p.low, p.scale == "log", ""
        low, high = p.low, p.high
        if end:
            low, high = max(low - width, 0.0 if log else -np.inf), high + width
            around = ", and its width to either side"
        slack = _ROUNDING * width
        if not (low - slack <= value <= high + slack) or (log and value <= 0):
            raise ConfigurationError(
                f"field {what} is {value:g} {p.unit}; allowed: {low:g} to {high:g}, the range of "
                f"{name!r}{around}"
            )

    def to_json(self) -> list[dict[str, Any]]:
        """Return plain JSON values."""
        return [p.to_json() for p in self.parameters]

    @classmethod
    def from_json(cls, values: Any) -> ParameterSpace:
        """Return the space that :meth:`to_json` wrote."""
        return cls(from_values(tuple[Parameter, ...], values))


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterDistribution:
    """A distribution of the parameters, under which a policy is trained.

    In each parameter's own scale (log or linear) it is a Gaussian, cut off at the range, or uniform over the
    range.

    Attributes:
        space: The parameters.
        mean: Physical values, (K,).
        covariance: In each parameter's own scale, (K, K); None for uniform over the range.
        latency_s: Lowest and highest total latency (actuation plus sensing) [s].
    """

    space: ParameterSpace
    mean: FloatArray
    covariance: FloatArray | None
    latency_s: tuple[float, float]

    @classmethod
    def uniform(cls, space: ParameterSpace, latency_s: tuple[float, float]) -> ParameterDistribution:
        """Return the distribution of uniform domain randomisation (UDR)."""
        return cls(space=space, mean=space.center, covariance=None, latency_s=latency_s)

    @classmethod
    def point(cls, space: ParameterSpace, theta: FloatArray, latency_s: float) -> ParameterDistribution:
        """Return the distribution without uncertainty (the oracle's)."""
        K = len(space)
        return cls(
            space=space,
            mean=np.asarray(theta, dtype=float),
            covariance=np.zeros((K, K)),
            latency_s=(latency_s, latency_s),
        )

    def without(self, names: Iterable[str]) -> ParameterDistribution:
        """Return the distribution of the other parameters, whatever the values of these."""
        left = set(names)
        kept = [k for k, name in enumerate(self.space.names) if name not in left]
        return dataclasses.replace(
            self,
            space=ParameterSpace(p for p in self.space.parameters if p.name not in left),
            mean=self.mean[kept],
            covariance=None if self.covariance is None else self.covariance[np.ix_(kept, kept)],
        )

    def with_more(
        self, parameters: Sequence[Parameter], mean: FloatArray, std: FloatArray
    ) -> ParameterDistribution:
        """Return the distribution with more parameters after its own, which depend on no other.

        Args:
            parameters: L parameters.
            mean: Their physical values, (L,).
            std: Their standard deviations in each one's own scale, (L,).
        """
        K = len(self.space)
        if self.covariance is None:
            raise ValueError("a uniform distribution has no standard deviations")
        covariance = np.diag(np.concatenate([np.zeros(K), np.square(std)]))
        covariance[:K, :K] = self.covariance
        return dataclasses.replace(
            self,
            space=ParameterSpace([*self.space.parameters, *parameters]),
            mean=np.append(self.mean, mean),
            covariance=covariance,
        )

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw physical values, (count, K), inside the range."""
        if self.covariance is None:
            return self.space.sample(rng, count)
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        draws = self.space.to_scale(self.mean) + rng.standard_normal((count, len(self.space))) @ root.T
        # A draw that overflows on a log scale is also cut off at the range.
        with np.errstate(over="ignore"):
            return np.clip(self.space.from_scale(draws), self.space.low, self.space.high)

    def sample_latency(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw total latencies, (count,) [s]."""
        return rng.uniform(self.latency_s[0], self.latency_s[1], count)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "format": FORMAT,
            "space": self.space.to_json(),
            "mean": dict(zip(self.space.names, map(float, self.mean), strict=True)),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "latency_s": list(self.latency_s),
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> ParameterDistribution:
        """Return the distribution that :meth:`to_json` wrote.

        Raises:
            ConfigurationError: A field cannot give draws that are finite; the message names it.
        """
        if values.get("format") != FORMAT:
            given = shown(values.get("format"))
            raise ConfigurationError(f"not a parameter distribution: format is {given}, not {FORMAT!r}")
        found = from_values(_DistributionFile, values)
        space = ParameterSpace(found.space)
        low_s, high_s = found.latency_s
        if not 0 <= low_s <= high_s <= LONGEST_LATENCY_S:
            raise ConfigurationError(
                f"latency_s is {low_s:g} to {high_s:g} s; allowed are 0 to {LONGEST_LATENCY_S:g} s, the "
                "lower one first"
            )
        space.check_names("mean", found.mean)
        mean = np.array([found.mean[name] for name in space.names])
        for name, value in found.mean.items():
            space.check_value(f"mean.{name}", name, value)
        return cls(
            space=space,
            mean=mean,
            covariance=None if found.covariance is None else covariance_of(found.covariance, space),
            # The generator would treat minus zero as below zero.
            latency_s=(low_s + 0.0, high_s + 0.0),
        )

    def digest(self) -> str:
        """Return a digest of the distribution; a policy contains that of its own."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class _DistributionFile:
    """A distribution as its file has it."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN_FINITE

    space: tuple[Parameter, ...]
    mean: dict[str, float]
    covariance: list[list[float]] | None
    latency_s: tuple[float, float]


def covariance_of(values: Any, space: ParameterSpace) -> FloatArray:
    """Return a covariance of a file, (K, K).

    Raises:
        ConfigurationError: It is none: the message names the entry.
    """
    K = len(space)
    if not K and values == []:
        # Nothing is uncertain but the latency: an empty matrix is written as an empty list.
        return np.zeros((0, 0))
    found = numbers(values, "covariance", (K, K))
    if np.abs(found).max(initial=0.0) > _LARGEST_STD**2:
        raise ConfigurationError(f"covariance contains a value above {_LARGEST_STD**2:g}")
    diagonal = np.diag(found)
    rounding = 1e-9 * np.abs(diagonal).max(initial=0.0)
    if (diagonal < 0).any():
        name = space.names[int(np.argmin(diagonal))]
        raise ConfigurationError(f"covariance: the variance of {name!r} is below 0")
    if not np.allclose(found, found.T, rtol=1e-6, atol=rounding):
        raise ConfigurationError("covariance is not symmetric")
    std = np.sqrt(diagonal)
    beyond = np.abs(found) - (1 + 1e-6) * np.outer(std, std)
    if (beyond > rounding).any():
        i, j = np.unravel_index(int(np.argmax(beyond)), (K, K))
        first, second = space.names[i], space.names[j]
        raise ConfigurationError(
            f"covariance: {first!r} and {second!r} have {found[i, j]:g}, more than their standard deviations "
            f"allow ({std[i] * std[j]:g}): their correlation would be outside -1 to 1"
        )
    return found
