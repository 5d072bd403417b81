"""Zeros of encoders that differ between recordings, fitted before other causes take up what they do.

A zero that is off in one recording looks like a force, friction or play in all of them. So this comes before
laws, searches and causes.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calib.fit.intervals import EVIDENCE, MISMATCH_CHI2, with_rows
from deal_hw.calib.fit.refinement import Refined, local_fit
from deal_hw.calib.pipeline.calibration_run import OWN_ZEROS, CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.minima import conclusive
from deal_hw.findings import Finding
from deal_hw.sim.recordings.own_setups import recordings_of

if TYPE_CHECKING:
    from deal_hw.calib.validation.cause_words import Diagnosis
    from deal_hw.calib.validation.evidence import Evidence


@dataclasses.dataclass(frozen=True, slots=True)
class OwnZeros:
    """A fit with a zero of its own for each encoder in each recording.

    Attributes:
        run: The calibration, with these zeros among its parameters.
        fit: Its local fit.
        cause: What they explain.
    """

    run: CalibrationRun
    fit: Refined
    cause: Diagnosis

    def said(self, found: FitOutcome) -> FitOutcome:
        """Return an outcome of the run with them as its first cause."""
        from deal_hw.calib.validation.candidates import Candidate

        row = Candidate.of(OWN_ZEROS, "fit", self.cause, "taken").to_json()
        causes: list[Any] = found.facts.get("diagnosis", [])
        rows: list[Any] = found.facts.get("candidates", [])
        return found.with_alarms(
            self.cause, diagnosis=[self.cause.to_json(), *causes], candidates=[row, *rows]
        )


def with_own_zeros(run: CalibrationRun, local: Refined) -> OwnZeros | None:
    """Return a run with zeros of each recording, if they leave only noise; otherwise None.

    Their linearised effect has to predict left-out windows better than a force and a zero that all recordings
    share. Then a fit with them has to predict the part of the recordings that it has not seen. Where more
    than noise is left, zeros are a cause among others: on a real double pendulum they take nine tenths of the
    residual away, but predict no other recording better.

    Args:
        run: The calibration.
        local: Its local fit.
    """
    from deal_hw.calib.validation.cause_words import LOOKS, Diagnosis
    from deal_hw.calib.validation.diagnosis import POOR
    from deal_hw.calib.validation.evidence import evidence
    from deal_hw.calib.validation.explain import DECISIVE
    from deal_hw.calib.validation.recording_zeros import named_zeros, own_zeros, zeros_of
    from deal_hw.calib.validation.signatures import zeros
    from deal_hw.calib.validation.wider_models import fit_wider, gain_of, wider_cost

    problem, names = run.problem, recordings_of(e.name for e in run.problem.episodes)
    shared = [] if problem.noise_free else zeros(problem)
    if not (run.settings.laws and shared):
        return None
    with run.check(OWN_ZEROS):
        known = evidence(problem, with_rows(local), answered=False)
        share, joints = _share(known)
        if share < DECISIVE or local.chi2 * (1 - share) > POOR:
            return None
        units = {p.elements[0]: p.unit for p in shared if p.elements[0] in joints}
        more = own_zeros(units, names)
        if not run.may_try(OWN_ZEROS, wider_cost(problem, True, len(units))):
            return None
        run.say(OWN_ZEROS, "does a zero of its own in each recording predict motion that was not fitted?")
        start = np.append(local.theta, np.zeros(len(more))), local.latency_s
        # Each recording has to show its zero.
        wider = fit_wider(problem, more, seconds=2.0 * len(names), start=start)
        if wider is None or wider.prediction.chi2 > MISMATCH_CHI2:
            return None
        gained = gain_of(wider, local)
        if gained is None or gained.share < DECISIVE:
            return None
    wide = dataclasses.replace(run, problem=problem.with_more(more))
    fit = local_fit(wide.problem, partial(wide.offer, "local fit"), wider.fit)
    if fit is None or not conclusive(wide.problem, fit):
        return None
    found = zeros_of(wide.problem.space, fit.theta)
    each = "; ".join(named_zeros(joint, units[joint], values) for joint, values in found.items())
    _, means, _ = LOOKS["zero"]
    alarm = Finding.alarm(
        "With a zero of its own for each encoder in each recording the model predicts motion that it was not "
        f"fitted to with chi2 {wider.prediction.chi2:.3g} instead of {gained.before:.3g}: zero. {each}.",
        means,
        "Use this result: its other values do not depend on the zeros. But a policy meets a zero like these: "
        "set it in the same pose each time.",
    )
    return OwnZeros(wide, fit, Diagnosis.of("zero", gained.share, gained.deviance, tuple(found), alarm))


def _share(known: Evidence) -> tuple[float, list[str]]:
    """Return what zeros of each recording explain beyond a force and a zero that all share; the joints."""
    own = [s for s in known.found if s.cause == "zero"]
    shared = [s for s in known.found if s.cause == "load"]
    for joint in dict.fromkeys(s.where for s in own):
        mine = [s for s in own if s.where == joint]
        columns = tuple(np.sum(parts, axis=0) for parts in zip(*(s.columns for s in mine), strict=True))
        shared.append(dataclasses.replace(mine[0], columns=columns))
    known = dataclasses.replace(known, found=[*shared, *own])
    gain = known.gain(shared, own)
    if gain <= EVIDENCE:
        return 0.0, []
    return 1 - float(np.exp(-gain / known.count)), known.places([], own)
