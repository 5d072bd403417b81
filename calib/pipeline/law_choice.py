"""Which law that the model lacks a real robot may have, and what it gains.

No simulator explains a real robot down to its sensors' noise, so a law is not asked to. It is screened by its
linearised effect around an output-error fit. Fits with it are candidates of the cross-validation over the
motions. It is taken where it predicts every fold better than all fits without it do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.noise import Mask
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.intervals import EVIDENCE
from deal_hw.calib.fit.output_error import OutputErrorFit, Recipe, fit_output_error
from deal_hw.calib.pipeline.calibration_run import EXPLANATIONS, CalibrationRun
from deal_hw.calib.validation.cross_validation import Choice
from deal_hw.calib.validation.evidence import Evidence, parameter_prior
from deal_hw.calib.validation.explain import RIVAL, applicable, screened, screened_gains
from deal_hw.calib.validation.explanations import Explanation
from deal_hw.calib.validation.wider_models import NOTICED
from deal_hw.calibration import listed, percent
from deal_hw.errors import CalibrationError
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter
from deal_hw.types import FloatArray

MOST_LAWS = 2
"""Most laws that are fitted. Around a fit without it a law is often about as good as another one: play and
friction that falls with speed both delay a joint that turns round."""

FOLD_ITERATIONS, ITERATIONS = 3, 6
"""Most derivatives of each fit with a law, in a fold and on all recordings. It begins where that without the
law ended."""


@dataclass(frozen=True, slots=True)
class LawCandidate:
    """A law that a robot may have, as candidate fits.

    Attributes:
        explanation: The law.
        more: Its parameters.
        seconds: Windows of its fits [s]: those in which friction and drives show, then those that judge.
    """

    explanation: Explanation
    more: Sequence[Parameter]
    seconds: tuple[float, float]

    @property
    def names(self) -> tuple[str, str]:
        """Names of its candidates, one for each window."""
        short, _ = self.seconds
        return f"{short:g} s, {self.explanation.name}", f"long, {self.explanation.name}"

    def widened(self, problem: Problem) -> Problem:
        """Return a problem with the law's parameters."""
        return problem.with_more(self.more)

    def members(self, problem: Problem, start: Member, *, fold: bool) -> dict[str, Member]:
        """Return the fits with the law to a problem without it, from a fit of short windows without it."""
        iterations = FOLD_ITERATIONS if fold else ITERATIONS
        wide, found = self.widened(problem), dict[str, Member]()
        theta, latency_s = start
        member = np.append(theta, [p.nominal for p in self.more]), latency_s
        for name, seconds in zip(self.names, self.seconds, strict=True):
            member = fit_output_error(wide, *member, Recipe(seconds=seconds, iterations=iterations)).member
            found[name] = member
        return found

    def finding(self, choice: LawfulChoice, theta: FloatArray) -> Finding:
        """Return what was found where a fit with the law was chosen, with its values, (K + L,)."""
        found = self._values(theta)
        values = listed([f"{p.name} = {found[p.name]:.2g} {p.unit}".rstrip() for p in self.more])
        lower = percent(1 - float(np.exp(np.mean(np.log(choice.ratios)))))
        law = self.explanation
        return Finding.alarm(
            f"With {law.name} ({values}) the error of predicted motions that were left out is {lower} lower.",
            law.means,
            law.taken.replace("{}", listed([p.name for p in self.more])),
        )

    def facts(self, choice: LawfulChoice, theta: FloatArray) -> dict[str, Any]:
        """Return the law, its error in each fold over the best without it, and its values: plain JSON."""
        return {
            "law": self.explanation.name,
            "error_ratio": choice.ratios,
            "values": self._values(theta),
            "window_s": choice.made.window_s,
        }

    def _values(self, theta: FloatArray) -> dict[str, float]:
        last = theta[-len(self.more) :]
        return {p.name: float(v) for p, v in zip(self.more, last, strict=True)}


@dataclass(frozen=True, slots=True)
class LawfulChoice:
    """A choice among fits with and without laws.

    Attributes:
        made: The choice, with the errors of the fits that were judged in every fold.
        law: The law of the chosen fit; None where that has none.
        ratios: Its error in each fold over that of the best fit without a law; empty where it has none.
        lost: Errors of fits with laws up to the fold that a fit without one predicts as well.
    """

    made: Choice
    law: LawCandidate | None = None
    ratios: Sequence[float] = ()
    lost: Mapping[str, Sequence[float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, plain: Choice, laws: Sequence[LawCandidate], errors: Mapping[str, Sequence[float]]
    ) -> LawfulChoice:
        """Return the choice: a fit with a law only where it predicts each fold better than all without.

        ``plain`` compares the fits without laws, and ``errors`` are those of :func:`law_errors`.
        """
        if not errors:
            return cls(plain)
        each = list(zip(*plain.errors.values(), strict=True))
        ratios = {n: [e / min(of) for e, of in zip(es, each, strict=False)] for n, es in errors.items()}
        won = {n for n, r in ratios.items() if len(r) == len(each) and max(r) < 1}
        lost = {n: tuple(e) for n, e in errors.items() if n not in won}
        if not won:
            return cls(plain, lost=lost)
        best = min(sorted(won), key=lambda n: float(np.mean(np.log(errors[n]))))
        every = dict(plain.errors) | {n: tuple(errors[n]) for n in errors if n in won}
        law = next(law for law in laws if best in law.names)
        return cls(dataclasses.replace(plain, chosen=best, errors=every), law, ratios[best], lost)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values: the choice, and the laws that lost."""
        lost = {name: list(errors) for name, errors in self.lost.items()}
        return self.made.to_json() | ({"lost": lost} if lost else {})


def law_errors(
    problem: Problem,
    masks: Sequence[Sequence[Mask]],
    laws: Sequence[LawCandidate],
    start: Member,
    plain: Choice,
    errors: Callable[[Problem, Sequence[Member]], FloatArray],
    say: Callable[[int, str], None] = lambda fold, law: None,
) -> dict[str, list[float]]:
    """Return the error of each fit with a law in each fold, up to the first in which one without is as good.

    It would not be taken, whatever the other folds say, and a law can cost several times the bare physics.

    Args:
        problem: The recordings, as they are fitted.
        masks: The samples of each recording that each fold leaves out, (T,) each.
        laws: The laws.
        start: Fit of short windows without a law, to all recordings.
        plain: Errors of the fits without a law.
        errors: Returns the error of each member's predictions of a part, (N,).
        say: Called with the number of each fold and the law that is fitted to it.
    """
    found: dict[str, list[float]] = {name: [] for law in laws for name in law.names}
    left = set(found)
    for fold, left_out in enumerate(masks):
        least = min(each[fold] for each in plain.errors.values())
        train, test = problem.part([~mask for mask in left_out]), problem.part(left_out)
        for law in laws:
            if left.isdisjoint(law.names):
                continue
            say(fold, law.explanation.name)
            try:
                members = law.members(train, start, fold=True)
                values = errors(law.widened(test), list(members.values()))
            except CalibrationError:
                left.difference_update(law.names)
                continue
            for name, value in zip(members, map(float, values), strict=True):
                if name in left:
                    found[name].append(value)
                if not value < least:
                    left.discard(name)
    return found


def screened_laws(
    run: CalibrationRun, problem: Problem, fit: OutputErrorFit, seconds: tuple[float, float]
) -> list[LawCandidate]:
    """Return the laws whose linearised effect predicts left-out windows best, beyond chance; most often none.

    Args:
        run: The calibration.
        problem: The recordings, as they are fitted.
        fit: Their fit without a law, of short windows: in longer ones, errors that build up look like laws.
        seconds: Windows of the candidates [s].
    """
    can = applicable(problem)
    if not can:
        return []
    with run.check(EXPLANATIONS):
        at = problem, fit.theta, fit.latency_s, fit.weighed, fit.point
        known = Evidence(
            rows=fit.normal.rows,
            prior=parameter_prior(problem),
            found=(),
            period_s=problem.episodes[0].period_s,
        )
        gains = screened_gains(known, {each: screened(*at, each, more) for each, more in can.items()})
    # A share of the squared residual as a gain in deviance; see `Evidence.gain`.
    least = max(EVIDENCE, -known.count * float(np.log(1 - NOTICED)), RIVAL * max(gains.values()))
    best = sorted(gains, key=lambda each: -gains[each])[:MOST_LAWS]
    return [LawCandidate(each, can[each], seconds) for each in best if gains[each] > least]
