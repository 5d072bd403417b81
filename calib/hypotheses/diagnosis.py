"""Causes of an unexplained residual and the next repair, chosen on motion that was not fitted.

Three kinds of evidence use one statistic. Laws that the model lacks are candidate models (`.trials`):
refitted on a part of the recordings, they predict the rest. Other causes have signatures, which a regression
adds to the parameters (`.evidence`). A random delay predicts no sample, but where the residual is large:
beside random forces of constant size, it must make the residual likelier. From a fit far from the recordings
no cause is named: effects around it are not the robot's.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Sequence

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.fit.solver import BURST_KURTOSIS, kurtosis
from deal_hw.calib.hypotheses.candidates import (
    Candidate,
    Diagnosed,
    effect_candidates,
    law_candidates,
    ranked,
)
from deal_hw.calib.hypotheses.cause_words import LOOKS, Diagnosis, advice, stretch_words
from deal_hw.calib.hypotheses.evidence import Evidence, evidence, groups_of, unsure_shift
from deal_hw.calib.hypotheses.judge import alike, needed
from deal_hw.calib.hypotheses.random_delay import random_delay
from deal_hw.calib.hypotheses.random_errors import SeenErrors
from deal_hw.calib.hypotheses.recording_zeros import MOST_ZERO, named_zeros
from deal_hw.calib.hypotheses.signatures import Cause, Signature, masses
from deal_hw.calib.hypotheses.thresholds import (
    BURST_LEFT,
    BURST_PART,
    BURST_SHARE,
    BURST_SIZE,
    DECISIVE,
    EVIDENCE,
    MASS_ALIKE,
    MOST_CAUSES,
    NEAR_CHI2,
    NOTICED,
)
from deal_hw.calib.hypotheses.trials import (
    Allows,
    Tried,
    explained,
    fits_wider_models,
    keeps_mass,
    likeliest,
    try_hypotheses,
)
from deal_hw.calib.hypotheses.wider_models import fit_wider, held_out, wider_cost
from deal_hw.calibration import listed, percent
from deal_hw.findings import Finding
from deal_hw.types import FloatArray

MASS = "another mass"
"""Name of a check."""


def all_allowed(name: str, steps: float) -> bool:
    """Allow every check."""
    del name, steps
    return True


def diagnose(
    problem: Problem,
    refined: Refined,
    tried: Sequence[Tried] = (),
    allows: Allows = all_allowed,
) -> Diagnosed:
    """Return the causes of a fit's residual, and all candidates; the fit has linearised residuals.

    Args:
        problem: The problem.
        refined: Its fit.
        tried: Explanations that were tried; those of this problem are not tried again.
        allows: Which fits of wider models may be made.
    """
    known = functools.cache(lambda: evidence(problem, refined))
    tried = try_hypotheses(problem, refined, allows, tried, known)
    laws = explained(problem, refined, tried)
    # A law is named from the fit that has it.
    wider = [one.diagnosis for one in likeliest(laws) if one.chi2 <= NEAR_CHI2]
    found, rows = [one for one in wider if one.share >= DECISIVE], list[Candidate]()
    unsure = np.zeros(0)
    if not found:
        named = {one.code for one in wider}
        effects = [e for e in name_causes(known(), refined.chi2, len(tried)) if e.code not in named]
        effects = [e for e in effects if e.code != "mass" or weighs(problem, refined, e, tried, allows)]
        found = sorted((*effects, *wider), key=lambda f: -f.deviance)
        if refined.chi2 <= NEAR_CHI2:
            again = {one.hypothesis.name for one in tried}
            rows += [row for row in effect_candidates(known(), effects) if row.explanation not in again]
            unsure = unnamed_shift(known(), {one.code for one in found})
    rows += law_candidates(tried, laws, named=[o.hypothesis.name for o in laws if o.diagnosis in found])
    return Diagnosed(tuple(found), ranked(rows), unsure)


def weighs(
    problem: Problem, refined: Refined, cause: Diagnosis, tried: Sequence[Tried], allows: Allows
) -> bool:
    """Return whether a model with another mass of the named body predicts unseen motion better, too.

    The signature is the effect of 2 % of the mass, and the cause may be far more. It was not tried where the
    fit is poor. Where no wider model is fitted, as for a free base and without noise, the signature stands.
    """
    body = next(p for p in masses(problem) if p.elements[0] == cause.subject[0])
    wide = next((one.wider for one in tried if one.wider is not None and one.wider.more == [body]), None)
    if wide is None:
        if not (fits_wider_models(problem) and allows(MASS, wider_cost(problem, True, 1))):
            return True
        wide = fit_wider(problem, [body])
    return wide is not None and keeps_mass(body, wide.found[0]) and held_out(wide, refined) is not None


def name_causes(known: Evidence, chi2: float = 1.0, others: int = 0) -> list[Diagnosis]:
    """Return the causes that evidence supports, best first; each is tested together with those before it.

    Args:
        known: The evidence.
        chi2: The fit's; above :data:`~deal_hw.calib.hypotheses.thresholds.NEAR_CHI2` only zeros are named, if
            they leave no more.
        others: How many hypotheses were asked in other ways.
    """
    found: list[Diagnosis] = []
    taken: list[Signature] = []
    groups, near = groups_of(known.found), chi2 <= NEAR_CHI2
    asked = others + len(groups)
    if not near:
        # The effect of a zero is known exactly: what it leaves is what a fit that has it leaves.
        groups = [group for group in groups if group[0].cause == "zero"]
    while groups and len(found) < MOST_CAUSES:
        groups = [some for group in groups if (some := _possible(known, taken, group))]
        gains = [known.gain(taken, group) for group in groups]
        if not gains or max(gains) < needed(asked, len(found) + 1):
            break
        group = groups[_simplest(groups, gains)]
        share = 1 - float(np.exp(-max(gains) / known.count))
        if share <= NOTICED:
            break
        found.append(_cause_diagnosis(known, taken, group, share, max(gains)))
        taken += group
        groups = [g for g in groups if g[0].cause != group[0].cause]
        if group[0].cause == "zero":
            groups = [g for g in groups if g[0].cause != "load"]
    left = chi2 * float(np.prod([1 - one.share for one in found]))
    if not near:
        return found if left <= NEAR_CHI2 else []
    varying, bursts = _varying_delay(known, taken), _bursts(known, known.residual(taken))
    if varying is not None:
        found.append(varying)
    # Bursts predict nothing, and are chosen for their size. So only what they leave can support them.
    if bursts is not None and left * (1 - bursts.share) <= BURST_LEFT:
        found.append(bursts)
    return sorted(found, key=lambda f: -f.deviance)


def unnamed_shift(known: Evidence, named: Collection[str]) -> FloatArray:
    """Return how far causes of the signatures that are not named may have moved the estimates, (P,).

    What is the parameters' own effect is no other cause. See :func:`unsure_shift`.
    """
    groups = [
        [other for s in group if (other := known.distinct(s)) is not None]
        for group in groups_of(known.found)
        if group[0].cause not in named
    ]
    groups = [some for group in groups if group and (some := _possible(known, [], group))]
    if not groups:
        return np.zeros(len(known.prior))
    before = known.coefficients([])
    return unsure_shift(
        [known.gain([], group) for group in groups], [_shift(known, before, group) for group in groups]
    )


def _shift(known: Evidence, before: FloatArray, taken: Sequence[Signature]) -> FloatArray:
    """Return the change of the parameters and the latency by further signatures, (P,).

    The residual is prediction minus measurement: a parameter moves against its coefficient.

    Args:
        known: The evidence.
        before: Coefficients of a regression with some of them, (P + n,).
        taken: All signatures.
    """
    P = len(known.prior)
    return before[:P] - known.coefficients(taken)[:P]


def _simplest(groups: Sequence[Sequence[Signature]], gains: Sequence[float]) -> int:
    """Return the group that gains most; a constant force where zeros of each recording gain no more."""
    best, causes = int(np.argmax(gains)), [group[0].cause for group in groups]
    if causes[best] == "zero" and "load" in causes:
        load = causes.index("load")
        return load if alike(gains[best], gains[load]) else best
    return best


def _possible(known: Evidence, taken: Sequence[Signature], group: Sequence[Signature]) -> list[Signature]:
    """Return what a cause may be of a group: another mass is above 0, and no zero is off as far as one sees.

    A joint whose zero hardly moves anything, as one that turns about a vertical axis, would need a huge one.
    """
    left = list(group)
    if group[0].cause == "mass":
        return left if _mass_change(known, taken, group[0]) > -1.0 else []
    while left and left[0].cause == "zero":
        values = np.abs(known.coefficients([*taken, *left])[-len(left) :])
        far = {s.where for s, value in zip(left, values, strict=True) if value > MOST_ZERO}
        if not far:
            break
        left = [s for s in left if s.where not in far]
    return left


def _mass_change(known: Evidence, taken: Sequence[Signature], body: Signature) -> float:
    """Return the change of a body's mass that the residual asks for, as a share of it."""
    # The signature is a change per share of the mass; the residual is prediction minus measurement.
    return -float(known.coefficients([*taken, body])[-1])


def _cause_diagnosis(
    known: Evidence, taken: Sequence[Signature], group: Sequence[Signature], share: float, deviance: float
) -> Diagnosis:
    cause = group[0].cause
    if cause == "mass":
        found = _mass_diagnosis(known, taken, share, deviance)
    elif cause == "zero":
        found = _zero_diagnosis(known, taken, group, share, deviance)
    else:
        gains = np.array([known.gain(taken, [signature]) for signature in group])
        order = [k for k in np.argsort(-gains) if gains[k] >= 0.25 * gains.max()]
        joints = [group[k].where for k in order[:4]]
        found = _diagnosis(known, cause, share, deviance, joints)
    return dataclasses.replace(found, shift=_shift(known, known.coefficients(taken), [*taken, *group]))


def _diagnosis(
    known: Evidence, cause: Cause, share: float, deviance: float, joints: Sequence[str], where: str = ""
) -> Diagnosis:
    means, do = advice(cause, joints, where or listed(joints), known.searched)
    looks = LOOKS[cause][0]
    seen = f"{percent(share)} of the squared residual on left-out motion looks like {looks}: {cause}."
    return Diagnosis.of(cause, share, deviance, joints, Finding.alarm(seen, means, do))


def _mass_diagnosis(known: Evidence, taken: Sequence[Signature], share: float, deviance: float) -> Diagnosis:
    """Name each body that explains about as much: without a known torque, motion shows mass ratios only.

    A rotor's inertia at a joint may explain as much, too.
    """

    def alike(cause: Cause) -> list[Signature]:
        gains = [(known.gain(taken, [s]), s) for s in known.found if s.cause == cause]
        enough = [(gain, s) for gain, s in gains if gain >= MASS_ALIKE * deviance]
        return [s for _, s in sorted(enough, key=lambda pair: -pair[0])]

    bodies = [s for s in alike("mass") if _possible(known, taken, [s])]
    change = [_mass_change(known, taken, body) for body in bodies]
    ways = [
        f"{body.where} {percent(abs(c))} {'heavier' if c > 0 else 'lighter'}"
        for body, c in zip(bodies, change, strict=True)
    ]
    rotors = [s.where for s in alike("inertia")]
    rotor = f" (another inertia at {listed(rotors)} explains as much)" if rotors else ""
    seen = (
        f"With {' or '.join(ways)} the model predicts left-out motion with {percent(share)} less squared "
        f"residual: another mass{rotor}."
    )
    names = [body.where for body in bodies]
    _, means, do = LOOKS["mass"]
    do = do.replace("{}", " and ".join(names))
    if rotors:
        do += f" If it is a rotor's inertia, free dof_armature of {listed(rotors)}."
    return Diagnosis.of("mass", share, deviance, names, Finding.alarm(seen, means, do))


def _zero_diagnosis(
    known: Evidence, taken: Sequence[Signature], group: Sequence[Signature], share: float, deviance: float
) -> Diagnosis:
    """Name the zero of each recording, of the joints that need their own ones beside the others."""
    # The residual is prediction minus measurement: a zero moves against its coefficient.
    values = -known.coefficients([*taken, *group])[-len(group) :]
    units = {s.where: s.unit for s in group}
    joints, found = known.places(taken, group) or list(units), list[str]()
    for joint in joints:
        mine = values[[s.where == joint for s in group]]
        each = dict(zip(known.recordings, map(float, mine), strict=True))
        found.append(named_zeros(joint, units[joint], each))
    looks, means, do = LOOKS["zero"]
    seen = (
        f"{percent(share)} of the squared residual on left-out motion looks like {looks}: zero. "
        f"{'; '.join(found)}."
    )
    alarm = Finding.alarm(seen, means, do.replace("{}", listed(joints)))
    return Diagnosis.of("zero", share, deviance, joints, alarm)


def _varying_delay(known: Evidence, taken: Sequence[Signature]) -> Diagnosis | None:
    """Return whether commands seem to have delays of their own beside other causes; see `.random_delay`."""
    found = random_delay(SeenErrors(known.without(taken), known.answers, known.periods_s))
    if found is None or not (found.gain > EVIDENCE and found.share > NOTICED):
        return None
    if found.std_s > known.most_delay_std_s:
        # Something else is large where commands change fast, such as friction by load.
        return None
    seen = (
        f"{percent(found.share)} of the squared residual comes where commands change fast, as if each "
        f"had its own delay (standard deviation about {1e3 * found.std_s:.2g} ms): delay."
    )
    _, means, do = LOOKS["delay"]
    alarm = Finding.alarm(seen, means, do.replace("{}", ""))
    return Diagnosis.of("delay", found.share, found.deviance, (), alarm)


def _bursts(known: Evidence, residual: Sequence[FloatArray]) -> Diagnosis | None:
    """Return when the residual comes in bursts; None where it does not."""
    power: list[FloatArray] = []
    values: list[FloatArray] = []
    for r in known.by_sample(residual):
        power.append(np.sum(r**2, axis=2).ravel())
        values.append(r.ravel())
    each, time = np.concatenate(power), np.concatenate([t.ravel() for t in known.time_s])
    source = np.repeat(known.names, [t.size for t in known.time_s])
    # Samples that filled a gap have a residual of 0.
    seen = each > 0
    each, time, source = each[seen], time[seen], source[seen]
    most = np.argsort(-each)[: max(round(BURST_PART * len(each)), 1)]
    most = most[each[most] > BURST_SIZE * np.median(each)]
    share = float(each[most].sum() / max(each.sum(), 1e-300))
    if kurtosis(values) < BURST_KURTOSIS or share < BURST_SHARE:
        return None
    unit_s = 10 * max(known.periods_s)
    stretches = [
        f"{name} {stretch}".strip()
        for name in dict.fromkeys(known.names)
        for stretch in stretch_words(
            sorted({round(t / unit_s) for t in time[most][source[most] == name].tolist()}), unit_s
        )
    ]
    where = ", ".join(stretches[:5]) + (" and more" if len(stretches) > 5 else "")
    deviance = -len(each) * float(np.log(max(1 - share, 1e-300)))
    return _diagnosis(known, "contact", share, deviance, (), where)
