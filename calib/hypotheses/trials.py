"""Which hypothesis on a residual predicts motion that it was not fitted to, and by how much.

All hypotheses are screened by their linearised effect around the fit without them, fitted on some windows
and compared on the others. Those that gain most are fitted as models of their own, to a part of the
recordings, and compared by what they predict of the rest. The best one is the robot if only noise is left.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import MISMATCH_CHI2
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.hypotheses.cause_words import Diagnosis
from deal_hw.calib.hypotheses.evidence import Evidence, evidence, groups_of
from deal_hw.calib.hypotheses.hypothesis import (
    SHAPES,
    Hypothesis,
    off_value,
    one_sided,
    sized,
    tried_value,
)
from deal_hw.calib.hypotheses.judge import UnseenGain, accepted, alike, needed
from deal_hw.calib.hypotheses.laws import HYPOTHESES, LIMITS, PLAY, ZERO_CAUSES, other_masses
from deal_hw.calib.hypotheses.signatures import Signature, whitened_changes
from deal_hw.calib.hypotheses.thresholds import DECISIVE, FAR_CHI2, LEAST_PLAY, LEAST_RISE, RIVAL, SURE
from deal_hw.calib.hypotheses.wider_models import WiderFit, fit_wider, held_out
from deal_hw.calibration import listed
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.types import FloatArray

Allows = Callable[[str, float], bool]
"""Whether a check, by name, may run that takes at most so many physics steps."""


@dataclass(frozen=True, slots=True)
class Tried:
    """A hypothesis that was screened, and fitted where that promised something.

    Attributes:
        hypothesis: The hypothesis.
        of: The recordings, without it.
        screened: Gain in held-out deviance of its linearised effect [-].
        wider: Its fit; None where it was not fitted, or could not be.
    """

    hypothesis: Hypothesis
    of: Problem
    screened: float
    wider: WiderFit | None


@dataclass(frozen=True, slots=True)
class Explained:
    """A hypothesis that predicts better than the model does without it.

    Attributes:
        hypothesis: The hypothesis.
        diagnosis: It as the cause of the residual.
        problem: The recordings, with its parameters that are sure.
        theta: The fit's values of these parameters.
        latency_s: Its latency [s].
        chi2: Mean squared residual over the noise variance, of motion that was not fitted.
        before: The same without the hypothesis.
    """

    hypothesis: Hypothesis
    diagnosis: Diagnosis
    problem: Problem
    theta: FloatArray
    latency_s: float
    chi2: float
    before: float

    @property
    def explains(self) -> bool:
        """Whether it leaves only noise of motion that was not fitted, and less than half of what is no noise.

        The share of the whole squared residual would ask more of an effect the nearer to the noise it is.
        """
        return self.chi2 < MISMATCH_CHI2 and self.before - self.chi2 >= DECISIVE * (self.before - 1)

    @property
    def change(self) -> float:
        """Change of the model's own values, root mean square, in widths of their ranges."""
        own = ParameterSpace(self.problem.space.parameters[: -len(self.added)])
        moved = own.to_scale(self.theta[: len(own)]) - own.to_scale(own.nominal)
        return float(np.sqrt(np.mean((moved / own.width) ** 2)))

    def shift_to(self, other: Explained) -> FloatArray:
        """Return the change of the values and the latency [s] if another hypothesis is true, (K + 1,).

        Own values go to those of the other one, and further ones to where they have no effect.
        """
        space, K = self.problem.space, len(self.problem.space) - len(self.added)
        at = self.theta.copy()
        at[:K] = other.theta[:K]
        for k, p in enumerate(space.free[K:], K):
            at[k] = at[k] if p.kind in SHAPES else off_value(p)
        return np.append(space.to_scale(at) - space.to_scale(self.theta), other.latency_s - self.latency_s)

    @property
    def added(self) -> tuple[str, ...]:
        """Names of its parameters in :attr:`problem`."""
        own = len(self.diagnosis.shift) - 1
        return tuple(self.problem.space.names[own:])


def refused(allows: Allows, names: Sequence[str]) -> Allows:
    """Return what allows no check of these names, and the others as ``allows`` does."""
    return lambda name, steps: name not in names and allows(name, steps)


def fits_wider_models(problem: Problem) -> bool:
    """Return whether models with more parameters are fitted: for fixed bases, with noise."""
    return problem.robot.base is None and not problem.noise_free


def applicable(problem: Problem) -> dict[Hypothesis, list[Parameter]]:
    """Return the hypotheses that a robot can have, with their parameters."""
    if not fits_wider_models(problem):
        return {}
    return {each: more for each in HYPOTHESES if (more := each.parameters(problem))}


def of_masses(problem: Problem) -> dict[Hypothesis, list[Parameter]]:
    """Return another mass of each body, with its parameter."""
    if not fits_wider_models(problem):
        return {}
    return {each: each.parameters(problem) for each in other_masses(problem)}


def try_hypotheses(
    problem: Problem,
    refined: Refined,
    allows: Allows,
    given: Sequence[Tried] = (),
    known: Callable[[], Evidence] | None = None,
    say: Callable[[str], None] = lambda name: None,
) -> tuple[Tried, ...]:
    """Screen all hypotheses on a fit's residual, and fit those that promise most.

    Each hypothesis says when it is worth a fit. Each body's mass is screened beside the laws. Where one
    leaves only noise, all are fitted: around a fit without it the ends of ranges may hide that another one
    does so, too.

    Args:
        problem: The problem.
        refined: Its fit without them, with linearised residuals.
        allows: Which fits may be made.
        given: Earlier results; those of the same problem are kept.
        known: Returns the evidence on the fit, where somebody else needs it, too.
        say: Called with the name of each hypothesis that is fitted.
    """
    if any(one.of is problem for one in given):
        return tuple(one for one in given if one.of is problem)
    laws, masses = (
        {each: more for each, more in every.items() if each.worth_asking(refined.chi2)}
        for every in (applicable(problem), of_masses(problem))
    )
    if refined.chi2 > FAR_CHI2:
        screen = dict.fromkeys(laws, 0.0)
        return tuple(_tried(problem, laws, screen, -np.inf, allows, say))
    if not (laws or masses):
        return ()
    seen = evidence(problem, refined, answered=False) if known is None else known()
    causes = [seen.gain([], group) for group in groups_of(seen.found)]
    screen = _screened(problem, refined, laws | masses, seen)
    least = _least(screen, causes)
    found = _tried(problem, laws, screen, least, allows, say)
    for each, more in sorted(masses.items(), key=lambda pair: -screen[pair[0]]):
        (one,) = _tried(problem, {each: more}, screen, least, allows, say)
        found.append(one)
        if one.wider is not None and one.wider.prediction.chi2 < MISMATCH_CHI2:
            least = -np.inf
    return tuple(found)


def _tried(
    problem: Problem,
    can: Mapping[Hypothesis, Sequence[Parameter]],
    screen: Mapping[Hypothesis, float],
    least: float,
    allows: Allows,
    say: Callable[[str], None],
) -> list[Tried]:
    """Fit the hypotheses whose linearised effect gains ``least``."""
    found = []
    for each, more in can.items():
        gain, wide = screen[each], None
        if each.worth_a_fit(gain, least) and allows(each.name, each.cost(problem, more)):
            say(each.name)
            wide = fit_wider(problem, more)
        found.append(Tried(each, problem, gain, wide))
    return found


def try_limits(problem: Problem, allows: Allows, say: Callable[[str], None]) -> tuple[Tried, ...]:
    """Fit with what shows at effort limits and is not searched; limits themselves where dampings do not do.

    Args:
        problem: The problem.
        allows: Which fits may be made.
        say: Called with the name of what is fitted.
    """
    found: tuple[Tried, ...] = ()
    for each in LIMITS if fits_wider_models(problem) else ():
        more = each.parameters(problem)
        if not more or not allows(each.name, each.cost(problem, more)):
            continue
        say(each.name)
        wide = fit_wider(problem, more)
        found = (Tried(each, problem, np.inf, wide), *found)
        if wide is not None and wide.prediction.chi2 < MISMATCH_CHI2:
            break
    return found


def _screened(
    problem: Problem, refined: Refined, can: Mapping[Hypothesis, Sequence[Parameter]], seen: Evidence
) -> dict[Hypothesis, float]:
    """Return what each hypothesis gains by its linearised effect; see :func:`screened_effect`."""
    return {
        each: screened_effect(seen, screened(problem, refined, each, more), one_sided(problem, more))[0]
        for each, more in can.items()
    }


def _least(screen: Mapping[Hypothesis, float], causes: Sequence[float] = ()) -> float:
    """Return the linearised gain from which a hypothesis is fitted.

    That of a first value says which one to fit, not whether it is there. So the best one is fitted even where
    it gains little, unless one of the ``causes``, which gain so much, is far better.
    """
    best = max(screen.values())
    return max(min(needed(len(screen)), best), RIVAL * max([best, *causes])) if best > 0 else np.inf


def screened_effect(
    known: Evidence, law: Signature, one_way: npt.NDArray[np.bool_]
) -> tuple[float, FloatArray]:
    """Return what a hypothesis gains by its linearised effect alone, and where the values go with it.

    That is the held-out deviance, and the change of the own parameters, in their scales, and of the latency
    [s], (K + 1,). A dead zone below 0 explains what friction does, too, but no robot has one. Parameters that
    would have to leave their range have no effect.

    Args:
        known: The evidence.
        law: What its parameters do where they have an effect, n of them.
        one_way: Which of them can only move in that direction, (n,).
    """
    kept = np.arange(len(one_way))
    while len(kept):
        mine = dataclasses.replace(law, columns=tuple(columns[..., kept] for columns in law.columns))
        # The residual is prediction minus measurement: a parameter moves against its coefficient.
        moves = -known.coefficients([mine])
        own, further = np.split(moves, [len(known.prior)])
        left = kept[(further > 0) | ~one_way[kept]]
        if len(left) == len(kept):
            return known.gain([], [mine]), own
        kept = left
    return 0.0, np.zeros(len(known.prior))


def screened(
    problem: Problem,
    refined: Refined,
    found: Hypothesis,
    more: Sequence[Parameter],
    values: Sequence[float] | FloatArray | None = None,
) -> Signature:
    """Return what a hypothesis's parameters do to the predictions of a fit without it.

    Each goes from no effect to its value; those without an effect of their own stay.

    Args:
        problem: The problem, without the hypothesis.
        refined: Its fit.
        found: The hypothesis.
        more: Its parameters.
        values: Their values; their first ones by default.
    """
    wide, shooting, point = problem.with_more(more), refined.shooting, refined.point
    sizes, K = sized(more), len(refined.theta)
    to = np.array([tried_value(p) for p in more] if values is None else values)
    off = np.array([off_value(p) for p in more] if values is None else values)
    off[sizes] = [off_value(more[k]) for k in sizes]
    members = np.repeat(np.append(refined.theta, off)[None], 1 + len(sizes), axis=0)
    for row, k in enumerate(sizes):
        members[1 + row, K + k] = to[k]
    late = np.full(len(members), refined.latency_s)
    columns = []
    for e, data in enumerate(shooting.data):
        seen = wide.predict(members, late, data, point.position[e], point.velocity[e]).observed
        columns.append(np.moveaxis(whitened_changes(seen, data), 0, -1))
    return Signature(found.cause, found.name, tuple(columns))


def explained(problem: Problem, refined: Refined, tried: Sequence[Tried]) -> list[Explained]:
    """Return the hypotheses that the judge accepts among all that were asked, best first.

    The fit without them, ``refined``, has used all recordings; each of them saw a part.
    """
    named, gains = dict[str, tuple[Tried, WiderFit, list[int]]](), dict[str, UnseenGain | None]()
    for each in tried:
        name, wide = each.hypothesis.name, each.wider
        gains[name] = gained = None if wide is None else held_out(wide, refined, len(tried))
        if wide is not None and gained is not None and (order := _named(wide, each.hypothesis)):
            named[name] = each, wide, order
        else:
            gains[name] = None
    return [
        _explained(problem, refined, *named[name], gained)
        for name in accepted(gains)
        if (gained := gains[name]) is not None
    ]


def rivals(found: Sequence[Explained]) -> list[Explained]:
    """Return the best hypothesis, and those that predict about as well: no chance tells them apart."""
    return [one for one in found if alike(found[0].diagnosis.deviance, one.diagnosis.deviance)]


def likeliest(found: Sequence[Explained]) -> list[Explained]:
    """Return the hypotheses without masses that predict worse than another body's, beyond chance.

    Where one mass is wrong, the others gain, too.
    """
    best = {id(one) for one in rivals([one for one in found if one.diagnosis.code == "mass"])}
    return [one for one in found if one.diagnosis.code != "mass" or id(one) in best]


def keeps_mass(p: Parameter, value: float) -> bool:
    """Return whether a found mass is one: a body that keeps less than a fifth of its mass has no other mass.

    Its mass takes up something else.
    """
    return value > p.low * (1 + LEAST_RISE)


def _explained(
    problem: Problem, refined: Refined, tried: Tried, wide: WiderFit, order: Sequence[int], gained: UnseenGain
) -> Explained:
    """Return an accepted hypothesis with these of its parameters."""
    of = tried.hypothesis
    named = [wide.more[k] for k in order]
    elements = tuple(dict.fromkeys(e for p in named for e in p.elements))
    if of is PLAY:
        sizes = listed(
            [f"{wide.found[k]:.2g} {wide.more[k].unit} at {wide.more[k].elements[0]}" for k in order]
        )
    else:
        sizes = listed([_value(wide.more[k], wide.found[k]) for k in order])
    seen = (
        f"With {of.name} ({sizes}) the model predicts motion that it was not fitted to with chi2 "
        f"{gained.after:.3g} instead of {gained.before:.3g}: {of.cause}."
    )
    alarm = Finding.alarm(seen, of.means, of.do.replace("{}", listed(elements)))
    kind = ZERO_CAUSES.get(named[0].kind, of.cause)
    cause = Diagnosis.of(kind, gained.share, gained.deviance, elements, alarm, wide.shift_of(refined))
    theta = np.concatenate([wide.fit.theta[: len(problem.space)], wide.found[order]])
    wider = problem.with_more(named)
    return Explained(of, cause, wider, theta, wide.fit.latency_s, gained.after, gained.before)


def _value(p: Parameter, found: float) -> str:
    """Return a parameter with its value, and the model's where that is a quantity of its own."""
    model = f", in the model {p.nominal:.2g}" if p.kind == "body_mass" else ""
    return f"{p.name} = {found:.2g} {p.unit}{model}"


def _named(wide: WiderFit, of: Hypothesis) -> list[int]:
    """Return the parameters that are sure, largest first, then those that shape them."""
    if of is PLAY:
        found = wide.found
        return [int(k) for k in np.argsort(-found) if found[k] >= LEAST_PLAY * found.max() > 0]
    if of.certain:
        return list(range(len(wide.more)))
    if of.cause == "mass":
        # The scale of masses, gains and friction may be free. What a single value gains is its evidence.
        return [k for k, p in enumerate(wide.more) if keeps_mass(p, wide.found[k])]
    off = np.array([off_value(p) for p in wide.more])
    sure = np.where([p.kind in SHAPES for p in wide.more], 0.0, np.abs(wide.significance(off)))
    sizes = [int(k) for k in np.argsort(-sure) if sure[k] > SURE]
    places = {e for k in sizes for e in wide.more[k].elements}
    shapes = [k for k, p in enumerate(wide.more) if p.kind in SHAPES and places & set(p.elements)]
    return sizes + shapes
