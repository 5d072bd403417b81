"""Which law that the model lacks a real robot may have, and what it gains.

No simulator explains a real robot down to its sensors' noise, so a law is not asked to. Each is fitted to a
part of the recordings and predicts the rest. Around a fit without it, its linearised effect says little: on a
real XL330 dry friction has taken the place of friction by load, and only a fit finds the way back. Sometimes
none does: where an arm's motors are slow, inertia and damping take the place of their free speed, so far from
the truth that a fit from there ends elsewhere. So fits begin at the model's own values, too. Fits with the
best laws are candidates of the cross-validation over the motions. One is taken where it predicts every
fold better than all fits without it do. Then the others are asked for again, on top of it: friction by load
hides what friction does at rest, and a robot can have both.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.folds import Choice, fold_masks
from deal_hw.calib.data.noise import Mask
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.intervals import latency_end
from deal_hw.calib.fit.output_error import (
    Recipe,
    fit_output_error,
    prediction_errors,
    prediction_rmse,
)
from deal_hw.calib.fit.solver import channel_scale, independent_samples
from deal_hw.calib.hypotheses.candidates import Candidate, Judged, Outcome, ranked
from deal_hw.calib.hypotheses.hypothesis import Hypothesis, values_in_words
from deal_hw.calib.hypotheses.judge import UnseenGain, accepted
from deal_hw.calib.hypotheses.laws import LAG
from deal_hw.calib.hypotheses.thresholds import MOST_FOLDED, MOST_LAWS, RIVAL
from deal_hw.calib.hypotheses.trials import applicable
from deal_hw.calib.pipeline.calibration_run import EXPLANATIONS, CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.conclusion import conclude_fit
from deal_hw.calib.pipeline.minima import conclusive, refined_from
from deal_hw.calibration import LATENCY, CalibrationResult, percent
from deal_hw.errors import CalibrationError, InsufficientDataError
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter
from deal_hw.types import FloatArray

SCREEN_ITERATIONS, FOLD_ITERATIONS, ITERATIONS = 2, 3, 6
"""Most derivatives of each fit with a law, to a part of the recordings, in a fold and to all of them. The
first begins where the fit without the law ended or at the model's own values, the others where the first
did."""


@dataclass(frozen=True, slots=True)
class LawCandidate:
    """A law that a robot may have, as candidate fits.

    Attributes:
        hypothesis: The hypothesis.
        more: Its parameters.
        seconds: Windows of its fits [s]: those in which friction and drives show, then those that judge.
        start: Where its fits begin: a fit with it to a part of the recordings, (K + L,) and latency [s].
    """

    hypothesis: Hypothesis
    more: Sequence[Parameter]
    seconds: tuple[float, float]
    start: Member

    @property
    def names(self) -> tuple[str, str]:
        """Names of its candidates, one for each window."""
        short, _ = self.seconds
        return f"{short:g} s, {self.hypothesis.name}", f"long, {self.hypothesis.name}"

    def widened(self, problem: Problem) -> Problem:
        """Return a problem with the law's parameters."""
        return problem.with_more(self.more)

    def members(self, problem: Problem, *, fold: bool) -> dict[str, Member]:
        """Return the fits with the law to a problem without it, in its windows one after the other."""
        iterations = FOLD_ITERATIONS if fold else ITERATIONS
        wide, member, found = self.widened(problem), self.start, dict[str, Member]()
        for name, seconds in zip(self.names, self.seconds, strict=True):
            member = fit_output_error(wide, *member, Recipe(seconds=seconds, iterations=iterations)).member
            found[name] = member
        return found

    def finding(self, choice: LawfulChoice, theta: FloatArray) -> Finding:
        """Return what was found where a fit with the law was chosen, with its values, (K + L,)."""
        found = self._values(theta)
        values = values_in_words(self.more, [found[p.name] for p in self.more])
        lower = percent(1 - float(np.exp(np.mean(np.log(choice.ratios)))))
        law = self.hypothesis
        return Finding.alarm(
            f"With {law.name} ({values}) the error of predicted motions that were left out is {lower} lower.",
            law.means,
            law.taken_as([p.name for p in self.more]),
        )

    def facts(self, choice: LawfulChoice, theta: FloatArray) -> dict[str, Any]:
        """Return the law, its error in each fold over the best without it, and its values: plain JSON."""
        return {
            "law": self.hypothesis.name,
            "error_ratio": choice.ratios,
            "values": self._values(theta),
            "window_s": choice.made.window_s,
        }

    def _values(self, theta: FloatArray) -> dict[str, float]:
        last = theta[-len(self.more) :]
        return {p.name: float(v) for p, v in zip(self.more, last, strict=True)}


@dataclass(frozen=True, slots=True)
class ScreenedLaws:
    """Laws by what a fit with each to a part of the recordings predicts of the rest.

    Attributes:
        chosen: Those that the folds compare.
        gains: What each gains there, by the law's name.
        asked: How many were asked; some fits with a law diverge.
    """

    chosen: Sequence[LawCandidate] = ()
    gains: Mapping[str, UnseenGain] = field(default_factory=dict)
    asked: int = 0

    def promising(self) -> list[str]:
        """Return the laws that the judge accepts and that gain about as much as the best, best first."""
        names = accepted(self.gains, self.asked)[:MOST_FOLDED]
        return [n for n in names if self.gains[n].deviance > RIVAL * self.gains[names[0]].deviance]


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

    def candidates(self, laws: ScreenedLaws) -> list[Candidate]:
        """Return all laws that were fitted to a part of the recordings; those of the folds by these."""
        rows, chosen = list[Candidate](), {law.hypothesis.name for law in laws.chosen}
        for name, gain in laws.gains.items():
            judged: Judged = "fit"
            share = gain.share
            outcome: Outcome = "not named" if name in chosen else "chance"
            if self.law is not None and name == self.law.hypothesis.name:
                judged, outcome = "folds", "taken"
                share = 1 - float(np.exp(2 * np.mean(np.log(self.ratios))))
            elif any(name in of for of in self.lost):
                judged, outcome = "folds", "chance"
            row = Candidate(
                explanation=name, judged=judged, outcome=outcome, deviance=gain.deviance, share=share
            )
            rows.append(row)
        return rows


@dataclass(frozen=True, slots=True)
class LawsTaken:
    """Laws that were taken one on top of the other, and the fit with all of them.

    Attributes:
        problem: The recordings, with the laws' parameters.
        rounds: What was screened, and the choice with it, of each round; the first knows of no law.
        member: The chosen fit to all recordings: values and latency [s]. None where no law was taken.
    """

    problem: Problem
    rounds: Sequence[tuple[ScreenedLaws, LawfulChoice]]
    member: Member | None = None

    @property
    def choices(self) -> list[tuple[LawCandidate, LawfulChoice]]:
        """The laws that were taken, each with the choice that took it."""
        return [(choice.law, choice) for _, choice in self.rounds if choice.law is not None]

    @property
    def made(self) -> Choice:
        """The choice among all fits."""
        return next(
            (choice.made for _, choice in reversed(self.rounds) if choice.law), self.rounds[0][1].made
        )

    def widened(self, problem: Problem) -> Problem:
        """Return a problem with the parameters of all laws that were taken."""
        for law, _ in self.choices:
            problem = law.widened(problem)
        return problem

    def findings(self, theta: FloatArray) -> list[Finding]:
        """Return what was found of each law, with the values of the fit, (K,)."""
        return [law.finding(choice, theta[: self._end(k)]) for k, (law, choice) in enumerate(self.choices)]

    def facts(self, theta: FloatArray) -> list[dict[str, Any]]:
        """Return each law with the error that it saves, and its values: plain JSON."""
        return [law.facts(choice, theta[: self._end(k)]) for k, (law, choice) in enumerate(self.choices)]

    def candidates(self) -> list[Candidate]:
        """Return all laws that were fitted to a part of the recordings, each as its last round judged it."""
        rows = dict[str, Candidate]()
        for screened, choice in self.rounds:
            for row in choice.candidates(screened):
                if row.explanation not in rows or row.outcome == "taken":
                    rows[row.explanation] = row
        return list(rows.values())

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values: the choice, and the laws that lost."""
        lost = {name: list(errors) for _, choice in self.rounds for name, errors in choice.lost.items()}
        return self.made.to_json() | ({"lost": lost} if lost else {})

    def _end(self, number: int) -> int:
        """Return where a law's values end among those of the fit."""
        later = sum(len(law.more) for law, _ in self.choices[number + 1 :])
        return len(self.problem.space) - later


def take_laws(
    run: CalibrationRun,
    problem: Problem,
    first: tuple[ScreenedLaws, LawfulChoice],
    judged: Callable[[Problem, Sequence[LawCandidate], Choice], LawfulChoice],
    seconds: tuple[float, float],
) -> LawsTaken:
    """Fit the law of a choice to all recordings, and look for others on top of it until none is taken.

    Args:
        run: The calibration.
        problem: The recordings, without laws.
        first: What was screened without any, and the choice.
        judged: Compares laws of a problem in the folds with a choice without them.
        seconds: Windows of the candidates [s].
    """
    found = LawsTaken(problem, [first])
    while (law := found.rounds[-1][1].law) is not None:
        choice = found.rounds[-1][1].made
        run.say("fit", f"{choice.chosen} on all recordings")
        members = law.members(found.problem, fold=False)
        wide = law.widened(found.problem)
        found = dataclasses.replace(found, problem=wide, member=members[choice.chosen])
        if len(found.rounds) == MOST_LAWS:
            break
        screened = screened_laws(run, wide, [members[law.names[0]]], seconds)
        if not screened.chosen:
            break
        again = screened, judged(wide, screened.chosen, choice)
        found = dataclasses.replace(found, rounds=[*found.rounds, again])
    return found


def explained_by_laws(run: CalibrationRun, searched: CalibrationResult, laws: LawsTaken) -> FitOutcome | None:
    """Return the result of a fit of start states, too, where laws were taken and leave only noise then.

    Fits of predictions begin at smoothed states, whose errors bias them. A robot that its laws explain is
    fitted as one that needs none.

    Args:
        run: The calibration, with the parameters of the laws.
        searched: Result of the search, or its substitute.
        laws: The laws; the fit begins where theirs ended.
    """
    if laws.member is None or {law.hypothesis.name for law, _ in laws.choices} <= run.inexact:
        return None
    fit = refined_from(run, *laws.member)
    if not conclusive(run.problem, fit):
        return None
    found = conclude_fit(run, searched, fit)
    rows = [row.to_json() for row in ranked(laws.candidates())]
    return found.with_alarms(
        *laws.findings(found.theta),
        laws=laws.facts(found.theta),
        cross_validation=laws.to_json(),
        candidates=[*rows, *found.facts.get("candidates", [])],
    )


def law_errors(
    problem: Problem,
    masks: Sequence[Sequence[Mask]],
    laws: Sequence[LawCandidate],
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
            say(fold, law.hypothesis.name)
            try:
                members = law.members(train, fold=True)
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
    run: CalibrationRun, problem: Problem, fits: Sequence[Member], seconds: tuple[float, float]
) -> ScreenedLaws:
    """Fit each law to half of the recordings, and return those that predict the other better, beyond chance.

    Args:
        run: The calibration.
        problem: The recordings, as they are fitted.
        fits: Where fits with a law begin, (K,) and latency [s] each: that of all recordings without a further
            law, then others. The fit of the half without one begins at the first, with as many derivatives.
        seconds: Windows of the candidates [s]: the first are those of these fits and their predictions.
    """
    can, fit = {law: more for law, more in applicable(problem).items() if run.takes(law)}, fits[0]
    if LATENCY not in problem.guessed and latency_end(problem, fit[1], problem.latency_range_s):
        # A latency beyond a range that somebody gave is the simpler explanation, and an alarm asks for it. A
        # guessed range has grown as far as that gains.
        can.pop(LAG, None)
    if not can:
        return ScreenedLaws()
    left_out, seen = fold_masks(problem, 2)
    part, rest = problem.part(seen), problem.part(left_out)
    recipe, laws, gains = (
        Recipe(seconds=seconds[0], iterations=SCREEN_ITERATIONS),
        [],
        dict[str, UnseenGain](),
    )
    with run.check(EXPLANATIONS):
        try:
            without = fit_output_error(part, *fit, recipe).member
            rms, count = _unexplained(rest, without, seconds[0])
        except InsufficientDataError:
            return ScreenedLaws()
        for law, more in can.items():
            run.ask(law.name)
            member = _with_law(part.with_more(more), more, fits, recipe)
            if member is None:
                continue
            rmse = prediction_rmse(rest.with_more(more), [member], seconds[0])[0]
            if not np.isfinite(rmse).all():
                continue
            gains[law.name] = UnseenGain(1.0, float(np.mean((rmse / rms) ** 2)), count)
            laws.append(LawCandidate(law, more, seconds, member))
    found = ScreenedLaws((), gains, len(can))
    chosen = found.promising()
    return dataclasses.replace(found, chosen=[law for law in laws if law.hypothesis.name in chosen])


def _with_law(
    problem: Problem, more: Sequence[Parameter], starts: Sequence[Member], recipe: Recipe
) -> Member | None:
    """Return the fit with a law's parameters that predicts best what it was fitted to; None if all diverge.

    Args:
        problem: The recordings, with the parameters.
        more: The parameters, which begin at their nominal values.
        starts: Where the fits begin, without the parameters.
        recipe: The fits.
    """
    members = list[Member]()
    for theta, latency_s in starts:
        start = np.append(theta, [p.nominal for p in more])
        with contextlib.suppress(CalibrationError):
            members.append(fit_output_error(problem, start, latency_s, recipe).member)
    if len(members) < 2:
        return members[0] if members else None
    errors = np.mean(np.log(prediction_rmse(problem, members, recipe.seconds)), axis=1)
    return members[int(np.argmin(np.nan_to_num(errors, nan=np.inf)))]


def _unexplained(problem: Problem, member: Member, seconds: float) -> tuple[FloatArray, float]:
    """Return the size of a member's prediction errors, (M,), and how many of them are independent."""
    found = list(prediction_errors(problem, [member], seconds))
    seen = [data.reported for data, _ in found]
    errors = [np.where(s, e[0], 0.0) for s, (_, e) in zip(seen, found, strict=True)]
    rms = channel_scale(errors, seen, robust=False)
    periods_s = [problem.episodes[data.episode].period_s for data, _ in found]
    return rms, independent_samples([e / rms for e in errors], [int(s.sum()) for s in seen], periods_s)
