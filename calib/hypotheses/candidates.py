"""The table of candidate explanations of a residual: what each gains on motion that its fit did not see.

Laws, quantities that are 0 in the model, signatures of forces, masses and sensors, zeros of recordings,
delays and errors that commands and measurements share are found in different ways. All are judged by one
figure: the gain in held-out deviance, twice the logarithm of the likelihood ratio, and the share of the
squared residual that goes with it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from deal_hw.calib.hypotheses.cause_words import LOOKS, Diagnosis
from deal_hw.calib.hypotheses.evidence import Evidence, groups_of
from deal_hw.calib.hypotheses.judge import needed
from deal_hw.calib.hypotheses.trials import Explained, Tried
from deal_hw.types import FloatArray

Judged = Literal["fit", "effect", "likelihood", "folds"]
"""A fit with it to a part of the recordings; its linearised effect around the fit without it, regressed on
some windows; the likelihood of the residual; fits with it in each fold of a cross-validation."""

Outcome = Literal["taken", "named", "chance", "not named"]
"""In the result; an alarm; gains no more than chance; neither, since another one explains the same or the fit
is too poor to tell."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """An explanation that was tried.

    Attributes:
        explanation: What it is.
        judged: How it was judged.
        outcome: What became of it.
        deviance: Gain in held-out deviance [-], with the folds that of the effect before them; None where a
            fit with it predicts no better.
        share: Share of the held-out squared residual that it explains [-]; None likewise.
        values: Its values where it was fitted, by parameter.
    """

    explanation: str
    judged: Judged
    outcome: Outcome
    deviance: float | None = None
    share: float | None = None
    values: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(cls, explanation: str, judged: Judged, cause: Diagnosis, outcome: Outcome) -> Candidate:
        """Return a candidate that became a cause."""
        return cls(
            explanation=explanation,
            judged=judged,
            outcome=outcome,
            deviance=cause.deviance if np.isfinite(cause.deviance) else None,
            share=cause.share,
        )

    @classmethod
    def of_errors(cls, gain: float, shares: Iterable[float]) -> Candidate:
        """Return random errors that a fit allows for, with their gain in deviance and their shares."""
        share = sum(shares)
        name = "random forces and late commands"
        return cls(explanation=name, judged="likelihood", outcome="taken", deviance=gain, share=share)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self) | {"values": dict(self.values)}


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """What a residual's diagnosis found.

    Attributes:
        causes: The causes, best supported first.
        candidates: All that was tried for it.
        unsure: Root mean square shift of the estimates by causes that are not named but may be there: of each
            parameter in its own scale, and of the latency [s], (K + 1,); empty where none was examined.
    """

    causes: tuple[Diagnosis, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    unsure: FloatArray = field(default_factory=lambda: np.zeros(0))


def law_candidates(
    tried: Iterable[Tried], found: Sequence[Explained], taken: str = "", named: Iterable[str] = ()
) -> list[Candidate]:
    """Return laws that were tried, by what a fit with each predicts, or by its linearised effect.

    Args:
        tried: The laws.
        found: Those that predict better than the model does without them.
        taken: Name of the law that is in the result.
        named: Names of those that an alarm has.
    """
    gained, named = {one.hypothesis.name: one.diagnosis for one in found}, set(named)
    tried, rows = list(tried), []
    for one in tried:
        name = one.hypothesis.name
        if one.wider is None:
            rows.append(_by_effect(name, one.screened, len(tried)))
            continue
        values = tuple(zip((p.name for p in one.wider.more), map(float, one.wider.found), strict=True))
        if name not in gained:
            row = Candidate(explanation=name, judged="fit", outcome="chance")
        else:
            outcome: Outcome = "taken" if name == taken else "named" if name in named else "not named"
            row = Candidate.of(name, "fit", gained[name], outcome)
        rows.append(dataclasses.replace(row, values=values))
    return rows


def effect_candidates(known: Evidence, causes: Sequence[Diagnosis]) -> list[Candidate]:
    """Return the signatures of causes, each alone beside the parameters; then causes without a signature."""
    rows = list[Candidate]()
    left = dict[str, Diagnosis]((cause.code, cause) for cause in causes)
    groups = groups_of(known.found)
    for group in groups:
        cause, gain = group[0].cause, known.gain([], group)
        looks = LOOKS[cause][0]
        name = f"{looks} of {group[0].where}" if cause == "mass" else looks
        named = [c for c in causes if c.code == cause and (cause != "mass" or group[0].where in c.subject)]
        row = _by_effect(name, gain, len(groups), 1 - float(np.exp(-gain / known.count)))
        rows.append(dataclasses.replace(row, outcome="named") if named else row)
        left.pop(cause, None)
    words = {str(cause): looks for cause, (looks, _, _) in LOOKS.items()}
    rows += [Candidate.of(words[cause.code], "likelihood", cause, "named") for cause in left.values()]
    return rows


def ranked(rows: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """Return candidates, those that are taken or named first, then by what they gain."""
    order: Sequence[Outcome] = ("taken", "named", "not named", "chance")
    return tuple(sorted(rows, key=lambda row: (order.index(row.outcome), -(row.deviance or 0.0))))


def _by_effect(name: str, gain: float, asked: int, share: float | None = None) -> Candidate:
    outcome: Outcome = "not named" if gain > needed(asked) else "chance"
    return Candidate(explanation=name, judged="effect", outcome=outcome, deviance=float(gain), share=share)
