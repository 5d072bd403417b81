"""Search of the most informative excitation inside the limits: random designs, then coordinate search."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from deal_hw.calib.design.experiment_design import ExpectedInformation, Experiment, MakeBehaviour
from deal_hw.description import RobotDescription
from deal_hw.errors import CalibrationError, ConfigurationError
from deal_hw.motions.excitation.limits import largest_factor
from deal_hw.motions.excitation.plan import (
    FAMILIES,
    ExcitationDesign,
    ExcitationPlan,
    Family,
    make_plan,
)

Criterion = Literal["determinant", "mean"]


CONFIRMED = 6
"""Number of designs to repeat on the members of the confirmation, if there is one."""

LOWEST_EFFORT = 0.08
"""Lowest factor on the effort limit: below it joints hardly move against their friction."""

TOP_HZ = 8.0
"""Highest frequency [Hz]."""

TICKS_A_CYCLE = 6.0
"""Fewest commands per cycle of the highest frequency."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchSettings:
    """Effort of an excitation search."""

    candidates: int = 40
    """Number of random designs."""
    finalists: int = 4
    """Number of designs to keep; a design is abandoned once it is certain to be worse than all of these."""
    rounds: int = 24
    """Number of single-coordinate changes of the best design."""
    criterion: Criterion = "determinant"
    """determinant: most information in total (D-optimal); mean: least mean standard deviation (A-optimal)."""

    def __post_init__(self) -> None:
        if self.candidates < 1 or self.finalists < 1 or self.rounds < 0:
            raise ConfigurationError(f"not a usable search for an excitation: {self}")


@dataclass(frozen=True, slots=True)
class Optimum:
    """Result of an excitation search.

    Attributes:
        design: The best design.
        plan: Its plan, with the predicted standard deviations.
        prediction: Its information on all members.
        references: Information of other excitations on the same members, by name.
        tried: Number of designs.
        tripped: Number of discarded designs, by reason.
        trace: The best score, at first and after each change of a coordinate.
    """

    design: ExcitationDesign
    plan: ExcitationPlan
    prediction: ExpectedInformation
    references: Mapping[str, ExpectedInformation]
    tried: int
    tripped: Mapping[str, int]
    trace: tuple[float, ...]


def search_excitation(
    experiment: Experiment,
    rng: np.random.Generator,
    settings: SearchSettings,
    *,
    balance: MakeBehaviour | None = None,
    references: Mapping[str, MakeBehaviour] | None = None,
    confirmation: Experiment | None = None,
    notify: Callable[[int, int, str], None] | None = None,
) -> Optimum:
    """Search the most informative excitation that keeps every member inside the limits.

    Args:
        experiment: Predicts a candidate's information.
        rng: Draws the candidates.
        settings: Effort of the search.
        balance: Makes the balancing behaviour of the start; None for robots that stand by themselves.
        references: Other excitations to compare with.
        confirmation: The same experiment on other, more members. The best designs are repeated on these, and
            the best one there is returned with its prediction there. Without it, a search on few members
            finds a design for these few.
        notify: Called with candidates done, candidates expected and a short line.

    Raises:
        CalibrationError: No candidate keeps the limits.
    """
    description = experiment.robot.description
    tried, tripped = 0, Counter[str]()
    designer = _Designer(description, experiment.seconds, balance is not None)
    designs = designer.usual() + [designer.draw(rng) for _ in range(settings.candidates)]
    total = len(designs) + settings.rounds + (CONFIRMED if confirmation is not None else 0)

    def predict(
        design: ExcitationDesign, bar: float = -np.inf, on: Experiment = experiment
    ) -> ExpectedInformation:
        nonlocal tried
        make = on.playing(make_plan(description, design), balance)
        found = on.predict(make, lambda bound: score(bound, settings) > bar)
        tried += 1
        tripped.update(filter(None, [found.tripped]))
        if notify is not None:
            outcome = "less than others" if found.beaten else found.tripped or f"{found.gain:.1f} nats"
            notify(tried, total, f"{design.family}: {outcome}")
        return found

    finals: list[tuple[ExpectedInformation, ExcitationDesign]] = []
    for design in designs:
        full = len(finals) >= settings.finalists
        found = predict(design, score(finals[-1][0], settings) if full else -np.inf)
        if found.usable:
            finals = sorted([*finals, (found, design)], key=lambda pair: -score(pair[0], settings))
            finals = finals[: settings.finalists]
    if not finals:
        reasons = ", ".join(f"{n} x {why}" for why, n in tripped.items())
        raise CalibrationError(
            f"none of {tried} excitations keeps {description.name!r} inside its limits ({reasons}); "
            "draw from narrower ranges (--range-ratio, --calibration), or try more (--candidates)"
        )
    best, design = finals[0]
    trace = [score(best, settings)]
    steps = [(best, design)]
    for k in range(settings.rounds):
        other = designer.neighbour(design, k, rng)
        found = predict(other, score(best, settings))
        if score(found, settings) > score(best, settings):
            best, design = found, other
            steps.append((best, design))
        trace.append(score(best, settings))
    if confirmation is not None:
        # Half of them from the history of the best design, half other finalists.
        chosen = steps[::-1][: (CONFIRMED + 1) // 2]
        there = [d for _, d in chosen]
        chosen += [pair for pair in finals if pair[1] not in there][: CONFIRMED - len(chosen)]
        again = [(predict(d, on=confirmation), d) for _, d in chosen]
        best, design = max(again, key=lambda pair: score(pair[0], settings))
        if not best.usable:
            raise CalibrationError(
                f"the best excitation for {len(experiment.scenario)} draws of {description.name!r} trips on "
                f"one of {len(confirmation.scenario)} others ({best.tripped}); give narrower ranges "
                "(--range-ratio, --calibration) or more draws (--draws)"
            )
    judge = experiment if confirmation is None else confirmation
    plan = make_plan(description, design)
    predicted = dict(zip(experiment.space.names, map(float, best.std), strict=True))
    return Optimum(
        design=design,
        plan=dataclasses.replace(plan, predicted=predicted),
        prediction=best,
        references={name: judge.predict(make) for name, make in (references or {}).items()},
        tried=tried,
        tripped=tripped,
        trace=tuple(trace),
    )


def score(prediction: ExpectedInformation, settings: SearchSettings) -> float:
    """Return the quantity that the search maximises; minus infinity if not usable."""
    if not prediction.usable:
        return -np.inf
    return prediction.gain if settings.criterion == "determinant" else -float(np.mean(prediction.std))


class _Designer:
    """Makes candidates inside a robot's limits."""

    def __init__(self, description: RobotDescription, seconds: float, balances: bool) -> None:
        self._seconds, self._balances = seconds, balances
        self._top_hz = min(TOP_HZ, description.control_rate_hz / TICKS_A_CYCLE)
        # Factors on effort and speed limits; 1 to 1 where there is no such limit.
        self._effort, self._speed = (LOWEST_EFFORT, 1.0), (1.0, 1.0)
        if not all(description.servos) or not np.isfinite(description.effort_limit).all():
            self._effort = (1.0, 1.0)
        if np.isfinite(description.speed_limit).all():
            self._speed = (0.4, largest_factor(description.speed_limit, description.limits.speed))

    def usual(self) -> list[ExcitationDesign]:
        """Return start designs of known quality, such as the motion `rich`."""
        low, fast = max(0.15, self._effort[0]), min(2.5, self._speed[1])
        fair: tuple[tuple[Family, float], ...] = (("steps", 0.5), ("multisine", 1.0), ("chirp", 1.0))
        balance_s = min(0.6, 0.25 * self._seconds) if self._balances else 0.0
        return [
            ExcitationDesign(
                family=family,
                seconds=self._seconds,
                amplitude=amplitude,
                high_hz=min(4.0, self._top_hz),
                low_hz=0.3,
                balance_s=balance_s,
                effort=(1.0, low),
                speed=(1.0, fast),
            )
            for family, amplitude in fair
        ]

    def draw(self, rng: np.random.Generator) -> ExcitationDesign:
        """Return a random design."""
        shortest = _log_uniform(rng, 0.06, 0.25)
        top = self._top_hz
        return ExcitationDesign(
            family=FAMILIES[int(rng.integers(len(FAMILIES)))],
            seconds=self._seconds,
            amplitude=float(rng.uniform(0.25, 1.0)),
            low_hz=_log_uniform(rng, 0.2, 1.0),
            high_hz=_log_uniform(rng, 0.25 * top, top),
            tilt=float(rng.choice((0.0, 0.5, 1.0))),
            law="log" if rng.random() < 0.5 else "linear",
            arrangement="staggered" if rng.random() < 0.5 else "one-by-one",
            hold_s=(shortest, shortest * float(rng.uniform(1.2, 4.0))),
            balance_s=float(rng.choice((0.2, 0.4, 0.6))) if self._balances else 0.0,
            split=float(rng.choice((0.35, 0.5, 0.65))),
            effort=(1.0, _log_uniform(rng, *self._effort) if rng.random() < 0.75 else 1.0),
            speed=(1.0, _log_uniform(rng, *self._speed) if rng.random() < 0.75 else 1.0),
            seed=int(rng.integers(2**31)),
        )

    def neighbour(self, design: ExcitationDesign, k: int, rng: np.random.Generator) -> ExcitationDesign:
        """Return the design with one coordinate changed: the k-th, cyclically."""
        factor = float(np.exp(rng.choice((-1.0, 1.0)) * rng.uniform(0.15, 0.6)))
        high = float(np.clip(design.high_hz * factor, 0.5, self._top_hz))
        low = float(np.clip(design.low_hz * factor, 0.1, 0.8 * design.high_hz))
        other = self.draw(rng)
        own: dict[str, list[dict[str, object]]] = {
            "steps": [{"hold_s": tuple(s * factor for s in design.hold_s)}, {"hold_s": other.hold_s}],
            "chirp": [{"high_hz": high}, {"low_hz": low}, {"law": other.law}],
            "multisine": [{"high_hz": high}, {"low_hz": low}, {"tilt": other.tilt}],
        }
        moves: list[dict[str, object]] = [
            {"amplitude": float(np.clip(design.amplitude * factor, 0.05, 1.0))},
            {"seed": other.seed},
            {"effort": (1.0, float(np.clip(design.effort[1] * factor, *self._effort)))},
            own[design.family][int(rng.integers(len(own[design.family])))],
            {"speed": (1.0, float(np.clip(design.speed[1] * factor, *self._speed)))},
            {"split": float(np.clip(design.split + rng.uniform(-0.2, 0.2), 0.2, 0.8))},
            {"seed": other.seed},
            {"balance_s": other.balance_s},
        ]
        return dataclasses.replace(design, **moves[k % len(moves)])  # type: ignore[arg-type]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(max(high, low)))))
