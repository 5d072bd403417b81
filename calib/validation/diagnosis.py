"""Causes of an unexplained residual and the next repair, chosen on motion that was not fitted.

Three kinds of evidence use one statistic. Play in the gears is a candidate model: refitted on a part of the
recordings, it predicts the rest. Other causes have signatures, which a regression adds to the parameters:
fitted on some windows, they predict the others. Their statistic is the held-out deviance: twice the
logarithm of the likelihood ratio, with an estimated noise level. A random delay predicts no sample, but where
the residual is large: beside random forces of constant size, it must make the residual likelier.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import EVIDENCE, MISMATCH_CHI2, ended_at_bound
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.fit.solver import kurtosis
from deal_hw.calib.validation.cause_words import LOOKS, Diagnosis, SearchedKinds, advice, stretch_words
from deal_hw.calib.validation.cross_validation import fold_numbers
from deal_hw.calib.validation.random_delay import random_delay
from deal_hw.calib.validation.signatures import Cause, Signature, SignatureResponse, answers, signatures
from deal_hw.calib.validation.wider_models import (
    WiderFit,
    fit_wider,
    gain_of,
    wider_cost,
    zero_parameters,
)
from deal_hw.calibration import listed, percent
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter
from deal_hw.types import FloatArray

FOLDS = 4
"""Number of folds over the windows."""

ROUNDS = 2
"""Stretches of consecutive windows that each fold leaves out."""

NOTICED = 0.03
"""Least share of the held-out squared residual that a signature explains [-]."""

MOST_CAUSES = 3
"""Most named causes."""

ALIKE = 0.8
"""Least explained share of a named body's mass, relative to the best one's [-]."""

DECISIVE = 0.5
"""Share explained by play from which other causes are searched only after its repair [-]."""

POOR = 9.0
"""Chi2 that a cause may leave without explaining the share ``decisive`` [-]. Effects are computed around
the fit. Where most of a residual of three times the noise stays unexplained, the fit is not the robot, and
what remains can look like any cause."""

REVERSALS = 0.2
"""Share that play must explain in a poor fit [-]."""

ALONE = 2.0
"""Least ratio of play's deviance to that of each other signature in a poor fit [-]."""

MOST_PLAY = 0.5
"""Widest play, as a share of the commands' span [-]."""

LEAST_PLAY = 0.2
"""Least play of a named joint, as a share of the widest one [-]."""

SURE = 5.0
"""Least value of a named parameter that is 0 in the model, in its standard deviations [-]."""

PARAMETER_PRIOR = 0.5
"""Spread of parameters in the regression, as a share of their range [-]."""

LATENCY_PRIOR_S = 0.02
"""Spread of the latency in the regression [s]."""

BURST_PART = 0.05
"""Bursts occupy at most this part of the time [-]."""

BURST_SHARE = 0.4
"""Bursts hold at least this share of the squared residual [-]."""

BURST_KURTOSIS = 8.0
"""Least kurtosis of a residual with bursts; noise has 3 [-]."""

BURST_SIZE = 40.0
"""Least squared residual of a burst over the median [-]."""

BURST_LEFT = 4.0
"""Chi2 that bursts may leave: twice the noise [-]."""


Allows = Callable[[str, float], bool]
"""Whether a check, by name, may run that takes at most so many physics steps."""

PLAY = "play in the gears"
ZEROS = "what is 0 in the model"
"""Names of checks."""


def all_allowed(name: str, steps: float) -> bool:
    """Allow every check."""
    del name, steps
    return True


ZERO_CAUSES: Mapping[str, Cause] = {
    "dof_armature": "inertia",
    "dof_frictionloss": "friction",
    "dof_damping": "damping",
}
"""Cause that a parameter stands for which is 0 in the model."""


@dataclass(frozen=True, slots=True)
class Play:
    """Play in the gears, found by fitting a model with it to a part of the recordings.

    Attributes:
        diagnosis: Play as the cause of the residual.
        problem: The recordings, with the named joints' plays as more parameters.
        theta: The fit's values of these parameters.
        latency_s: Its latency [s].
        chi2: Mean squared residual over the noise variance, of motion that was not fitted.
    """

    diagnosis: Diagnosis
    problem: Problem
    theta: FloatArray
    latency_s: float
    chi2: float

    @property
    def explains(self) -> bool:
        """Whether it leaves only noise of motion that was not fitted, and less than half of the residual."""
        return self.chi2 < MISMATCH_CHI2 and self.diagnosis.share >= DECISIVE


@dataclass(frozen=True)
class Evidence:
    """Evidence for a diagnosis; regressions on it leave the start states free.

    Attributes:
        rows: Linearised residuals, per episode.
        prior: Information on the parameters and the latency, (P,).
        found: Signatures of the causes.
        answers: Responses of the windows to commands, per episode; empty if unknown, or if each command's
            delay was an unknown of the fit.
        period_s: Sampling period [s].
        time_s: Time of each sample in its recording, per episode (W, H) [s].
        names: Names of the recordings, per episode.
        searched: What the fit searched.
    """

    rows: Sequence[WindowRows]
    prior: FloatArray
    found: Sequence[Signature]
    answers: Sequence[SignatureResponse]
    period_s: float
    time_s: Sequence[FloatArray]
    names: Sequence[str]
    searched: SearchedKinds = field(default_factory=SearchedKinds)

    @cached_property
    def _following(self) -> list[FloatArray]:
        return [rows.following for rows in self.rows]

    @cached_property
    def _rest(self) -> list[FloatArray]:
        return [rows.rest for rows in self.rows]

    @cached_property
    def _columns(self) -> dict[int, list[FloatArray]]:
        """Each signature's columns without what start states explain, by its identity."""

        def left(rows: WindowRows, x: FloatArray) -> FloatArray:
            # Rows of the start states' prior are 0.
            return rows.without_starts(np.pad(x, ((0, 0), (0, rows.start.shape[2]), (0, 0))))

        return {id(s): list(map(left, self.rows, s.columns)) for s in self.found}

    def _design(self, taken: Sequence[Signature]) -> list[FloatArray]:
        """Return derivatives by the parameters and by signatures, (W, R, P + n) per episode."""
        columns = [self._columns[id(s)] for s in taken]
        return [np.concatenate(parts, axis=2) for parts in zip(self._following, *columns, strict=True)]

    def _normal(self, taken: Sequence[Signature]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return each window's normal matrix, (W, n, n), and vector, (W, n), squares, (W,), and the prior."""
        design = self._design(taken)
        matrix = np.concatenate([np.einsum("wri,wrj->wij", x, x) for x in design])
        vector = np.concatenate(
            [np.einsum("wri,wr->wi", x, r) for x, r in zip(design, self._rest, strict=True)]
        )
        squares = np.concatenate([np.sum(r**2, axis=1) for r in self._rest])
        own = np.einsum("wii->i", matrix)
        prior = np.append(self.prior, 1e-6 * own[len(self.prior) :] + 1e-12)
        return matrix, vector, squares, prior

    def coefficients(self, taken: Sequence[Signature]) -> FloatArray:
        """Return the regression's coefficients on all windows, parameters first, (P + n,)."""
        matrix, vector, _, prior = self._normal(taken)
        return np.asarray(np.linalg.solve(matrix.sum(axis=0) + np.diag(prior), vector.sum(axis=0)))

    def residual(self, taken: Sequence[Signature]) -> list[FloatArray]:
        """Return the residual after the regression, (W, R) per episode."""
        found = self.coefficients(taken)
        return [r - x @ found for x, r in zip(self._design(taken), self._rest, strict=True)]

    def without(self, taken: Sequence[Signature]) -> list[WindowRows]:
        """Return the rows without what signatures explain beside the parameters; start states stay free."""
        found = self.coefficients(taken)[len(self.prior) :]
        left = []
        for e, rows in enumerate(self.rows):
            residual, first = rows.residual.copy(), 0
            for signature in taken:
                columns = signature.columns[e]
                n = columns.shape[2]
                residual[:, : columns.shape[1]] -= columns @ found[first : first + n]
                first += n
            left.append(dataclasses.replace(rows, residual=residual))
        return left

    @cached_property
    def count(self) -> int:
        """Degrees of freedom of the residuals, which are 0 where a sample is missing."""
        measured = sum(int(np.count_nonzero(r)) for r in self._rest)
        return max(measured - sum(len(r.start) * int(r.start.shape[2]) for r in self.rows), 1)

    def held_out(self, taken: Sequence[Signature]) -> float:
        """Return the total cost of each fold's windows with the regression fitted to the others."""
        matrix, vector, squares, prior = self._normal(taken)
        fold = fold_numbers(len(squares), FOLDS, ROUNDS)
        cost = 0.0
        for k in range(FOLDS):
            mine, others = fold == k, fold != k
            found = np.linalg.solve(matrix[others].sum(axis=0) + np.diag(prior), vector[others].sum(axis=0))
            each = squares - 2 * vector @ found + np.einsum("i,wij,j->w", found, matrix, found)
            cost += float(each[mine].sum())
        return cost

    def gain(self, taken: Sequence[Signature], more: Sequence[Signature]) -> float:
        """Return the held-out deviance that ``more`` signatures gain in addition to ``taken``."""
        return self.count * float(np.log(self.held_out(taken) / self.held_out([*taken, *more])))


def diagnose(
    problem: Problem,
    refined: Refined,
    fitted: WiderFit | None = None,
    allows: Allows = all_allowed,
) -> tuple[Diagnosis, ...]:
    """Return the causes of a fit's residual, best supported first; the fit has linearised residuals.

    Args:
        problem: The problem.
        refined: Its fit.
        fitted: A fit with play, if there is one of this problem.
        allows: Which fits of wider models may be made.
    """
    wider: list[Diagnosis] = []
    if may_have_play(problem) and allows(
        PLAY, wider_cost(problem, fitted is None or fitted.of is not problem)
    ):
        found_play = find_play(problem, refined, fitted)
        wider += [] if found_play is None else [found_play.diagnosis]
    if not any(one.share >= DECISIVE for one in wider):
        more = [] if problem.noise_free else zero_parameters(problem)
        if more and allows(ZEROS, wider_cost(problem, True)):
            wider += find_zero(problem, refined, more)
    decisive = [one for one in wider if one.share >= DECISIVE]
    if decisive:
        return tuple(decisive)
    wider = [one for one in wider if supported(one.share, refined.chi2)]
    found = name_causes(evidence(problem, refined), refined.chi2)
    return tuple(sorted((*found, *wider), key=lambda f: -f.deviance))


def supported(share: float, chi2: float) -> bool:
    """Return whether a cause that explains a share of a residual is more than an accident of a poor fit."""
    return share >= DECISIVE or chi2 * (1 - share) <= POOR


def evidence(problem: Problem, refined: Refined) -> Evidence:
    """Return the evidence for :func:`diagnose`."""
    space, data = problem.space, refined.shooting.data
    width = np.append(PARAMETER_PRIOR * space.width, LATENCY_PRIOR_S)
    # A parameter at the end of its range cannot explain more.
    free = np.append(~ended_at_bound(space, refined.theta), problem.fixed_latency_s is None)
    episodes = [problem.episodes[d.episode] for d in data]
    return Evidence(
        rows=[dataclasses.replace(r, parameter=r.parameter * free) for r in refined.normal.rows],
        prior=1 / width**2,
        found=signatures(problem, refined),
        answers=answers(problem, refined) if problem.command_delays is None else [],
        period_s=problem.episodes[0].period_s,
        time_s=[
            np.asarray((e.origin + e.sample[d.windows.samples()]) * e.step_s)
            for e, d in zip(episodes, data, strict=True)
        ],
        names=[e.name for e in episodes],
        searched=SearchedKinds.of(problem, refined.theta),
    )


def may_have_play(problem: Problem) -> bool:
    """Return whether a model with play in the gears can be fitted: to servos on a fixed base."""
    known = any(p.kind == "servo_play" for p in problem.space.parameters)
    fixed = problem.robot.base is None and not problem.noise_free
    return problem.robot.description.actuation == "position" and fixed and not known


def fit_play(problem: Problem) -> WiderFit | None:
    """Fit a model with play in every gear to a part of the recordings; None where it cannot be fitted."""
    description, names = problem.robot.description, problem.robot.actuator_names
    if not may_have_play(problem):
        return None
    span = np.max([np.ptp(e.target, axis=0) for e in problem.episodes], axis=0)
    coordinate_units = problem.robot.coordinate_units[problem.robot.joints]
    units = dict(zip(description.joint_names, coordinate_units, strict=True))
    plays = [
        Parameter(
            name=f"{name}.play",
            kind="servo_play",
            elements=(name,),
            unit=units[joint],
            nominal=0.0,
            low=0.0,
            high=MOST_PLAY * float(most),
            scale="linear",
        )
        for name, joint, most in zip(names, description.actuated, span, strict=True)
        if most > 0
    ]
    return fit_wider(problem, plays)


def find_play(problem: Problem, refined: Refined, fitted: WiderFit | None = None) -> Play | None:
    """Compare predictions with play in the gears and without, of samples that the fit with play has not seen.

    The fit without play, ``refined``, has used all recordings. ``fitted`` is the fit with play; it is made
    where it is of another problem, or missing.
    """
    wide = fitted if fitted is not None and fitted.of is problem else fit_play(problem)
    if wide is None:
        return None
    gained = gain_of(wide, refined)
    if gained is None:
        return None
    plays, fit, found = wide.more, wide.fit, wide.found
    order = [k for k in np.argsort(-found) if found[k] >= LEAST_PLAY * found.max() > 0]
    named = [plays[k] for k in order]
    joints = [play.elements[0] for play in named]
    sizes = listed([f"{found[k]:.2g} {plays[k].unit} at {plays[k].elements[0]}" for k in order])
    seen_words = (
        f"With play in the gears ({sizes}) the model predicts motion that it was not fitted to with chi2 "
        f"{wide.prediction.chi2:.3g} instead of {gained.before:.3g}: backlash."
    )
    looks = LOOKS["backlash"]
    alarm = Finding.alarm(seen_words, looks[1], looks[2].replace("{}", listed(joints)))
    cause = Diagnosis.of("backlash", gained.share, gained.deviance, joints, alarm, wide.shift_of(refined))
    theta = np.concatenate([fit.theta[: len(problem.space)], found[order]])
    return Play(cause, problem.with_more(named), theta, fit.latency_s, wide.prediction.chi2)


def find_zero(problem: Problem, refined: Refined, more: Sequence[Parameter]) -> list[Diagnosis]:
    """Compare predictions with parameters that are 0 in the model, and were not searched, and without.

    They come as one cause, that of the parameter which explains most.
    """
    wide = fit_wider(problem, more)
    gained = None if wide is None else gain_of(wide, refined)
    if wide is None or gained is None:
        return []
    sure = wide.significance()
    order = [k for k in np.argsort(-sure) if sure[k] > SURE]
    if not order:
        return []
    named = [more[k] for k in order]
    values = listed([f"{p.name} = {wide.found[k]:.2g} {p.unit}" for p, k in zip(named, order, strict=True)])
    seen = (
        f"With {values} the model predicts motion that it was not fitted to with chi2 "
        f"{wide.prediction.chi2:.3g} instead of {gained.before:.3g}."
    )
    alarm = Finding.alarm(
        seen,
        "In your model this is 0, so it was not searched. Other values compensate for it.",
        "Write a value above 0 into the MJCF, such as this one, and calibrate again. Or give it a nominal "
        "value and a range in a parameter file (--parameters).",
    )
    joints = tuple(dict.fromkeys(joint for p in named for joint in p.elements))
    cause = ZERO_CAUSES[named[0].kind]
    return [Diagnosis.of(cause, gained.share, gained.deviance, joints, alarm, wide.shift_of(refined))]


def name_causes(known: Evidence, chi2: float = 1.0) -> list[Diagnosis]:
    """Return the causes that evidence supports, best first; each is tested together with those before it.

    ``chi2`` is the fit's. Causes with signatures are :func:`supported` together, or none is named.
    """
    found: list[Diagnosis] = []
    taken: list[Signature] = []
    groups = _groups(known.found)
    while groups and len(found) < MOST_CAUSES:
        groups = [group for group in groups if _possible(known, taken, group)]
        gains = [known.gain(taken, group) for group in groups]
        if not gains or max(gains) <= EVIDENCE:
            break
        group = groups[int(np.argmax(gains))]
        share = 1 - float(np.exp(-max(gains) / known.count))
        if share <= NOTICED:
            break
        found.append(_cause_diagnosis(known, taken, group, share, max(gains)))
        taken += group
        groups = [g for g in groups if g[0].cause != group[0].cause]
    if found and not supported(1 - float(np.prod([1 - one.share for one in found])), chi2):
        found, taken = [], []
        if (play := _alone_at_reversals(known)) is not None:
            # A delay of its own for each command would take up a part of any residual.
            return [play]
    left = chi2 * float(np.prod([1 - one.share for one in found]))
    varying, bursts = _varying_delay(known, taken), _bursts(known, known.residual(taken))
    if varying is not None and supported(varying.share, left):
        found.append(varying)
    # Bursts predict nothing, and are chosen for their size. So only what they leave can support them.
    if bursts is not None and left * (1 - bursts.share) <= BURST_LEFT:
        found.append(bursts)
    return sorted(found, key=lambda f: -f.deviance)


def _alone_at_reversals(known: Evidence) -> Diagnosis | None:
    """Return play as the cause of a poor fit's residual, if no other signature comes near to it.

    Effects of masses and friction are those around the fit, which is not the robot. Play acts where the
    measured motion or load turns round, wherever the parameters are.
    """
    groups = [group for group in _groups(known.found) if _possible(known, [], group)]
    rivals = [known.gain([], group) for group in groups if group[0].cause != "backlash"]
    for group in (group for group in groups if group[0].cause == "backlash"):
        gain = known.gain([], group)
        share = 1 - float(np.exp(-gain / known.count))
        if share >= REVERSALS and gain >= ALONE * max(rivals, default=0.0):
            return _cause_diagnosis(known, [], group, share, gain)
    return None


def _groups(found: Sequence[Signature]) -> list[list[Signature]]:
    """Return the units of the selection: a cause at all joints, or the mass of one body."""
    causes = dict.fromkeys(s.cause for s in found if s.cause != "mass")
    return [
        *([s for s in found if s.cause == cause] for cause in causes),
        *([s] for s in found if s.cause == "mass"),
    ]


def _possible(known: Evidence, taken: Sequence[Signature], group: Sequence[Signature]) -> bool:
    """Return whether a cause leaves every mass above 0."""
    return group[0].cause != "mass" or _mass_change(known, taken, group[0]) > -1.0


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
    else:
        gains = np.array([known.gain(taken, [signature]) for signature in group])
        order = [k for k in np.argsort(-gains) if gains[k] >= 0.25 * gains.max()]
        joints = [group[k].where for k in order[:4]]
        found = _diagnosis(known, cause, share, deviance, joints)
    P = len(known.prior)
    before, after = (known.coefficients(these)[:P] for these in (taken, [*taken, *group]))
    # The residual is prediction minus measurement: a parameter moves against its coefficient.
    return dataclasses.replace(found, shift=before - after)


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
        enough = [(gain, s) for gain, s in gains if gain >= ALIKE * deviance]
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


def _varying_delay(known: Evidence, taken: Sequence[Signature]) -> Diagnosis | None:
    """Return whether commands seem to have delays of their own beside other causes; see `.random_delay`."""
    found = random_delay(known.without(taken), known.answers, known.period_s)
    if found is None or not (found.gain > EVIDENCE and found.share > NOTICED):
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
    for time_s, of_episode, rows in zip(known.time_s, known.rows, residual, strict=True):
        # The rows of the start states' prior come last.
        r = rows[:, : rows.shape[1] - of_episode.start.shape[2]].reshape(*time_s.shape, -1)
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
    unit_s = 10 * known.period_s
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
