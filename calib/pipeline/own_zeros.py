"""Zeros of encoders that are not the model's, fitted before other causes take up what they do.

A zero that is off, in one recording or in all, looks like a force, friction or play in all of them. So this
comes before laws, searches and causes.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from deal_hw.calib.fit.intervals import MISMATCH_CHI2, with_rows
from deal_hw.calib.fit.refinement import Refined, local_fit
from deal_hw.calib.hypotheses.thresholds import DECISIVE, EVIDENCE, NEAR_CHI2
from deal_hw.calib.pipeline.calibration_run import OWN_ZEROS, CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.conclusion import conclude_fit
from deal_hw.calib.pipeline.minima import conclusive
from deal_hw.calibration import listed
from deal_hw.findings import Finding
from deal_hw.sim.recordings.own_setups import recordings_of

COMMON_ZEROS = "another zero of the encoders"
"""Name of the candidate with one zero for all recordings."""

if TYPE_CHECKING:
    from deal_hw.calib.hypotheses.evidence import Evidence


def with_own_zeros(run: CalibrationRun, local: Refined) -> FitOutcome | CalibrationRun:
    """Ask for other zeros of the encoders, those of each recording or one for all.

    Their linearised effect has to predict left-out windows better than a constant force, by half of what is
    no noise. Then a fit with them has to predict the part of the recordings that it has not seen. Where more
    than noise is left, zeros are a cause among others: on a real double pendulum they take nine tenths of the
    residual away, but predict no other recording better. Each recording has zeros of its own only where these
    gain more than chance over one for all.

    Args:
        run: The calibration.
        local: Its local fit.
    """
    from deal_hw.calib.hypotheses.candidates import Candidate
    from deal_hw.calib.hypotheses.cause_words import LOOKS, Diagnosis
    from deal_hw.calib.hypotheses.evidence import evidence
    from deal_hw.calib.hypotheses.recording_zeros import common_zeros, named_zeros, own_zeros, zeros_of
    from deal_hw.calib.hypotheses.signatures import zeros
    from deal_hw.calib.hypotheses.wider_models import fit_wider, held_out, wider_cost

    problem, names = run.problem, recordings_of(e.name for e in run.problem.episodes)
    shared = [] if problem.noise_free else zeros(problem)
    if not (run.settings.laws and shared):
        return run
    with run.check(OWN_ZEROS):
        known = evidence(problem, with_rows(local), answered=False)
        share, joints, differ = _share(known)
        if local.chi2 * share < DECISIVE * (local.chi2 - 1) or local.chi2 * (1 - share) > NEAR_CHI2:
            return run
        units = {p.elements[0]: p.unit for p in shared if p.elements[0] in joints}
        more = own_zeros(units, names) if differ else common_zeros(units)
        if not run.may_try(OWN_ZEROS, wider_cost(problem, True, len(units))):
            return run
        what = "a zero of its own in each recording" if differ else "another zero of the encoders"
        run.say(OWN_ZEROS, f"does {what} predict motion that was not fitted?")
        start = np.append(local.theta, np.zeros(len(more))), local.latency_s
        # Each recording has to show its zero.
        wider = fit_wider(problem, more, seconds=2.0 * len(names) if differ else 0.0, start=start)
        if wider is None or wider.prediction.chi2 > MISMATCH_CHI2:
            return run
        gained = held_out(wider, local)
        if gained is None or gained.before - wider.prediction.chi2 < DECISIVE * (gained.before - 1):
            return run
    wide = dataclasses.replace(run, problem=problem.with_more(more))
    fit = local_fit(wide.problem, partial(wide.offer, "local fit"), wider.fit)
    if fit is None or not conclusive(wide.problem, fit):
        return run
    values = fit.theta[len(problem.space) :]
    better = f"with chi2 {wider.prediction.chi2:.3g} instead of {gained.before:.3g}: zero"
    if differ:
        found = zeros_of(wide.problem.space, fit.theta)
        each = "; ".join(named_zeros(joint, units[joint], of) for joint, of in found.items())
        alarm = Finding.alarm(
            "With a zero of its own for each encoder in each recording the model predicts motion that it was "
            f"not fitted to {better}. {each}.",
            LOOKS["zero"][1],
            "Use this result: its other values do not depend on the zeros. But a policy meets a zero like "
            "these: set it in the same pose each time.",
        )
    else:
        each = listed([f"{p.elements[0]} {v:+.2g} {p.unit}" for p, v in zip(more, values, strict=True)])
        alarm = Finding.alarm(
            f"With another zero of its encoders ({each}) the model predicts motion that it was not fitted to "
            f"{better}.",
            "The encoders' zeros are not the model's, by as much in all recordings. Set-points of servos are "
            "off, too.",
            f"Use this result: it has the zeros as {listed([p.name for p in more])}. Or set the zeros in the "
            "model's pose, and record again.",
        )
    cause = Diagnosis.of("zero", gained.share, gained.deviance, tuple(units), alarm)
    outcome = conclude_fit(dataclasses.replace(wide, local=fit), None, fit)
    name = OWN_ZEROS if differ else COMMON_ZEROS
    return outcome.with_cause(cause, Candidate.of(name, "fit", cause, "taken"))


def _share(known: Evidence) -> tuple[float, list[str], bool]:
    """Return what zeros explain beyond a constant force, of which joints, and whether recordings differ."""
    own = [s for s in known.found if s.cause == "zero"]
    force, common = [s for s in known.found if s.cause == "load"], []
    for joint in dict.fromkeys(s.where for s in own):
        mine = [s for s in own if s.where == joint]
        columns = tuple(np.sum(parts, axis=0) for parts in zip(*(s.columns for s in mine), strict=True))
        common.append(dataclasses.replace(mine[0], columns=columns))
    known = dataclasses.replace(known, found=[*force, *common, *own])
    gain, differ = known.gain(force, own), known.gain([*force, *common], own) > EVIDENCE
    if gain <= EVIDENCE:
        return 0.0, [], False
    # Beyond chance they are there; of which joints is a choice of parameters: two for each value (Akaike).
    least = 2.0 * len(own) / len(common)
    return 1 - float(np.exp(-gain / known.count)), known.places([], own, least), differ
