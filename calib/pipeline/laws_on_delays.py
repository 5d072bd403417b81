"""Laws that a model lacks, on top of delays of single commands.

Friction that falls with speed makes a joint late where it turns round, and commands that jitter make it late
at some places more than at others. A robot that has both is explained by neither alone: delays take up a part
of the friction, and of the values with it. So laws are asked for again on top of the delays.

The likeliest delays of commands are those of the fit without the law, and hide what it does. On two of two
robots with both, a law that was fitted to a part of the recordings predicted the rest worse than none did. So
it is fitted to all, and what it does at the fitted values is judged on windows that a regression left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import with_rows
from deal_hw.calib.fit.refinement import Refined, refine
from deal_hw.calib.hypotheses.candidates import Candidate
from deal_hw.calib.hypotheses.cause_words import Diagnosis
from deal_hw.calib.hypotheses.evidence import Evidence, evidence, unsure_shift
from deal_hw.calib.hypotheses.hypothesis import Hypothesis, one_sided, sized, tried_value, values_in_words
from deal_hw.calib.hypotheses.judge import UnseenGain, accepted, alike, needed
from deal_hw.calib.hypotheses.laws import ZERO_CAUSES
from deal_hw.calib.hypotheses.signatures import Signature
from deal_hw.calib.hypotheses.thresholds import FAR_CHI2, MOST_LAWS
from deal_hw.calib.hypotheses.trials import Allows, applicable, screened, screened_effect
from deal_hw.calib.hypotheses.wider_models import WiderFit
from deal_hw.calib.pipeline.calibration_run import EXPLANATIONS, CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.minima import clearly_lower
from deal_hw.calib.validation.checks import with_unsure
from deal_hw.errors import CalibrationError, InsufficientDataError
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter
from deal_hw.types import FloatArray

if TYPE_CHECKING:
    from deal_hw.calib.hypotheses.random_delay import DelayFit


@dataclass(frozen=True, slots=True)
class LawsOnDelays:
    """A fit with delays of single commands, and the laws that were taken on top of them.

    Attributes:
        run: The calibration of the recordings with the laws, without the delays.
        late: The fit, with linearised residuals.
        laws: The laws, as causes, by their names.
        unsure: Standard deviation of what laws that gain no more than chance may have moved, (K + 1,); see
            :func:`~deal_hw.calib.hypotheses.evidence.unsure_shift`. Empty for none.
    """

    run: CalibrationRun
    late: DelayFit
    laws: Mapping[str, Diagnosis] = field(default_factory=dict)
    unsure: FloatArray = field(default_factory=lambda: np.zeros(0))

    def said(self, outcome: FitOutcome) -> FitOutcome:
        """Return the result of the fit with its laws as alarms, and intervals that hold what may be there."""
        known = with_unsure(self.late.problem, self.late.fit, outcome.known, self.unsure)
        outcome = dataclasses.replace(outcome, known=known)
        rows = [Candidate.of(name, "effect", law, "taken") for name, law in self.laws.items()]
        return outcome.with_alarms(
            *self.laws.values(),
            diagnosis=[*outcome.facts.get("diagnosis", []), *(law.to_json() for law in self.laws.values())],
            candidates=[*outcome.facts.get("candidates", []), *(row.to_json() for row in rows)],
        )


def laws_on_delays(run: CalibrationRun, late: DelayFit, allows: Allows) -> LawsOnDelays:
    """Return a fit with delays of single commands with the laws that it shows on top of them.

    Around a poor fit their effects say nothing, so there are none, and none where causes are not asked for.
    ``allows`` says which fits may be made.
    """
    found = LawsOnDelays(run, dataclasses.replace(late, fit=with_rows(late.fit)))
    if not run.settings.diagnosis or late.fit.chi2 > FAR_CHI2:
        return found
    while True:
        with run.check(EXPLANATIONS):
            wider, effects = _with_a_law(found, allows)
        if wider is None:
            # Of a law that seems to gain more, a fit has said that it does not.
            unsure = [(gain, shift) for gain, shift in effects if gain < needed(len(effects))]
            if not unsure:
                return found
            return dataclasses.replace(found, unsure=unsure_shift(*zip(*unsure, strict=True)))
        found = wider


def _with_a_law(
    before: LawsOnDelays, allows: Allows
) -> tuple[LawsOnDelays | None, list[tuple[float, FloatArray]]]:
    """Return the fit with one more law; None where none is accepted.

    What each law gains by its linearised effect follows, with where the values go then.
    """
    problem, fit = before.late.problem, before.late.fit
    can = {
        each: more
        for each, more in applicable(problem).items()
        if before.run.takes(each) and each.name not in before.laws
    }
    if not can:
        return None, []
    seen = evidence(problem, fit, answered=False)
    effects = {each: screened(problem, fit, each, more) for each, more in can.items()}
    screen = {
        each: screened_effect(seen, effects[each], one_sided(problem, more)) for each, more in can.items()
    }
    return _taken(before, seen, effects, can, screen, allows), list(screen.values())


def _taken(
    before: LawsOnDelays,
    seen: Evidence,
    effects: Mapping[Hypothesis, Signature],
    can: Mapping[Hypothesis, Sequence[Parameter]],
    screen: Mapping[Hypothesis, tuple[float, FloatArray]],
    allows: Allows,
) -> LawsOnDelays | None:
    """Return the fit with the law whose linearised effect gains most, if it is accepted."""
    run, problem, fit = before.run, before.late.problem, before.late.fit
    gains = {each: gain for each, (gain, _) in screen.items()}
    best = max(gains, key=lambda each: gains[each])
    more = can[best]
    # The linearised effect is that of a first value: it says which law to fit, not whether it is there.
    if len(before.laws) == MOST_LAWS or gains[best] <= 0 or not allows(best.name, best.cost(problem, more)):
        return None
    run.say("fit", f"{best.name} on top of that")
    wide = _fitted(problem, fit, _seen_alone(seen, effects[best], problem, more))
    if wide is None:
        return None
    # The fit with the law may have left another minimum, to which one from there without it comes, too.
    bare = _refined(problem, wide.fit.theta[: len(problem.space)], wide.fit)
    without = fit if bare is None else min(fit, bare, key=lambda each: each.chi2)
    effect = screened(problem, fit, best, wide.more, wide.found)
    gain = screened_effect(seen, effect, one_sided(problem, wide.more))[0]
    judged = UnseenGain(1.0, float(np.exp(-gain / seen.count)), seen.count)
    if not (clearly_lower(wide.fit, without) and accepted({best: judged}, len(can))):
        return None
    rivals = [
        e.name for e in can if e is not best and alike(gains[best], gains[e]) and gains[e] > needed(len(can))
    ]
    law = _cause(wide, without, best, judged, rivals)
    late = dataclasses.replace(before.late, problem=wide.fit.shooting.problem, fit=with_rows(wide.fit))
    of = dataclasses.replace(run, problem=run.problem.with_more(wide.more))
    return LawsOnDelays(of, late, {**before.laws, best.name: law})


def _seen_alone(
    seen: Evidence, effect: Signature, problem: Problem, more: Sequence[Parameter]
) -> list[Parameter]:
    """Return a law's parameters at the joints that show it, each by its own effect, or at the best of all."""
    one_way, sizes = one_sided(problem, more), sized(more)
    gains = dict[tuple[str, ...], float]()
    for n, k in enumerate(sizes):
        own = dataclasses.replace(effect, columns=tuple(columns[..., [n]] for columns in effect.columns))
        gains[more[k].elements] = screened_effect(seen, own, one_way[[n]])[0]
    least = min(max(gains.values()), needed(len(gains)))
    places = {element for elements, gain in gains.items() if gain >= least for element in elements}
    return [p for p in more if places & set(p.elements)]


def _fitted(problem: Problem, fit: Refined, more: Sequence[Parameter]) -> WiderFit | None:
    """Return the fit with a law's parameters, in the same windows; None where it cannot be fitted."""
    theta = np.append(fit.theta, [tried_value(p) for p in more])
    found = _refined(problem.with_more(more), theta, fit)
    return None if found is None else WiderFit(problem, more, found, found)


def _refined(problem: Problem, theta: FloatArray, begun: Refined) -> Refined | None:
    """Return a fit from values, (K,), and the latency, windows and start states of another."""
    window_s = begun.shooting.length * problem.period_s
    states = begun.shooting.states(begun.point)
    try:
        return refine(problem, theta, begun.latency_s, (window_s,), states=states)
    except (InsufficientDataError, CalibrationError):
        return None


def _cause(
    wide: WiderFit, fit: Refined, law: Hypothesis, judged: UnseenGain, rivals: Sequence[str]
) -> Diagnosis:
    """Return a law that the result has as a cause of the residual; ``fit`` is without it."""
    values = values_in_words(wide.more, list(map(float, wide.found)))
    alarm = Finding.alarm(
        f"With {law.name} ({values}) the fit leaves a chi2 of {wide.fit.chi2:.3g} instead of {fit.chi2:.3g}.",
        law.means,
        law.taken_as([p.name for p in wide.more], rivals),
    )
    elements = tuple(dict.fromkeys(e for p in wide.more for e in p.elements))
    kind = ZERO_CAUSES.get(wide.more[0].kind, law.cause)
    return Diagnosis.of(kind, judged.share, judged.deviance, elements, alarm, wide.shift_of(fit))
