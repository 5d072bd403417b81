"""Uncertainty of a fit: intervals, identifiability, null directions in words, signs of a wrong model.

Symbols, for K parameters in their own scale (ln of positive ones) and the latency [s]:
    H, g: half the Hessian, (K + 1, K + 1), and half the gradient, (K + 1,), of the cost at the estimate,
        start states eliminated; from :class:`~deal_hw.calib.fit.residual.Normal`.
    P: information of the parameters' priors, (K + 1,).
    F: information of the range, 12 / width^2 as of a uniform law, (K + 1,).
    a: inflation of the noise's variance, kinks^2 max(1, chi2) tau [-]; tau is the residuals' integrated
        autocorrelation time [samples].
    V = ((H - P) / a + P + F)^-1: covariance of least squares with the noise's variance times a.
Then each standard deviation is multiplied by a factor for clusters (:func:`_factor`). Intervals are 90 %:
estimate +- z V_kk^(1/2), z = 1.645.

Sources: tau, Madras and Sokal (1988); chi2 as the variance of the residuals, Seber and Wild, Nonlinear
Regression (1989), chapter 2; clusters, :mod:`deal_hw.calib.fit.cluster_robust`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
import scipy

from deal_hw.calib.data.noise import autocorrelations, rows_by_value
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.cluster_robust import Clustered, clustered
from deal_hw.calib.fit.null_space import expected_directions, null_directions, null_space
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.fit.residual import Normal
from deal_hw.calib.fit.unexplained import Unexplained, as_one, autocorrelated
from deal_hw.calib.fit.weak_directions import with_weak_directions
from deal_hw.calibration import EXPLAINED_CHI2, Z90, Identifiability, listed
from deal_hw.findings import Finding
from deal_hw.parameters import LONGEST_LATENCY_S, ParameterSpace
from deal_hw.sim.parameters import find_kind
from deal_hw.types import FloatArray

if TYPE_CHECKING:
    from deal_hw.calib.fit.output_error import OutputErrorFit


LATENCY_AT_END = 0.01
"""Distance to an end of the latency range, as a share of it, that counts as at the end [-]."""

MISMATCH_CHI2 = EXPLAINED_CHI2
"""Mean squared residual over the noise variance above which the model is wrong [-]."""

CONTRADICTS = 3.0
"""Standard deviations from what was expected above which a value is doubtful [-]."""

CORRELATION_SAMPLES = 2.0
"""Autocorrelation time above which it is wrong [samples]."""

FALSE_ALARMS = 0.05
"""Probability of the alarm where every channel's time is at that limit [-]."""

NEGLIGIBLE_CHI2 = 0.5
"""Residuals this far below the noise need no explanation, autocorrelated or not [-]."""

WHITE_SAMPLES = 1.2
"""Longest autocorrelation time of a local fit that needs no search [samples]: beyond it the fit may be in
another minimum. Cart-poles with sensors, 15 tuning seeds of ratio 5 and 20: the 11 local fits that agreed
with a fit from the truth were at 1.00. One in another minimum, with a chi2 of 1.16, was at 1.39."""

LEAST_JITTER_S = 1e-4
"""Least jitter of the sample times that is an alarm [s]. Fast motion without noise looks like jitter of
some hundredths of a millisecond."""

KINKS = 1.2
"""Factor on standard deviations for nonlinearity [-]: stick-slip and saturation bend the likelihood. On
tuning seeds, 90 % intervals without it contained 86-89 % of the truths."""

CONTACT_KINKS = 2.0
"""The same with feet on the floor [-]. On five Go2 tuning seeds with sensor noise, errors were 0.9 to 1.7
times the linear estimate (root mean square), about 1.5 over all. As it differs so much between robots, it
includes Student's quantile with four degrees of freedom, 1.3 times the normal one."""

IDENTIFIABLE_STD = 0.15
"""Largest standard deviation of an identified parameter, in ln units or parts of a linear range [-]."""

WEAK_SHARE = 0.5
"""Largest standard deviation of a weakly identified parameter, as share of the prior's [-]."""

BLIND_SHARE = 0.9
"""Share of the prior's standard deviation above which the data have no information [-]."""

PRIOR_SHARE = 0.71
"""Share of a prior's standard deviation above which the prior says more than the data [-]: half of the
information is the prior's."""

AT_BOUND = 1e-6
"""Distance to an end of the range, as share of the range, that counts as at the bound [-]."""

PRIOR_BLOCKS = 4.0
"""Number of blocks that the overall inflation counts for in a parameter's own inflation, because a few
blocks are poor evidence."""

LAGS = 12
"""Longest lag of the autocorrelation time [samples]."""

NEAR_STRETCH = 0.1
"""Share of the refinement's parameter step for central differences [-]. Over a whole step, kinks of dry
friction can look like information that a noise-free recording does not have."""


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Uncertainty of an estimate of parameters and latency.

    Attributes:
        space: The parameters.
        theta: The estimate, (K,).
        covariance: Of the parameters in their own scale, (K, K).
        interval: 90 % intervals, physical, (K, 2).
        latency_interval_s: 90 % interval of the latency [s].
        null_directions: Combinations without effect on the recordings, in words.
        prior_directions: Combinations of which a prior says more than the recordings, in words.
        alarms: Signs that the model is wrong.
        inflation: Factor on the variance for model error.
        blind: Parameters that the data do not determine: their interval is the range's own, (K,).
        bound: -1 or 1 for parameters fixed at their lower or upper bound, (K,).
        clustered: Variances clustered by blocks of time over those of independent residuals; None if not
            computed or with too few blocks. Its last entry is the latency's.
        widened: Factor of clustering on each parameter's interval, (K,).
        biased: Cause of the residual that each of these values compensates for, by its name; "latency" is the
            latency.
    """

    space: ParameterSpace
    theta: FloatArray
    covariance: FloatArray
    interval: FloatArray
    latency_interval_s: tuple[float, float]
    null_directions: tuple[str, ...]
    alarms: tuple[Finding, ...]
    inflation: float
    blind: npt.NDArray[np.bool_]
    bound: npt.NDArray[np.int64]
    clustered: Clustered | None
    widened: FloatArray
    biased: Mapping[str, str] = field(default_factory=dict)
    prior_directions: tuple[str, ...] = ()

    @property
    def verdicts(self) -> tuple[Identifiability, ...]:
        """How well the data determine each parameter, (K,)."""
        unit, prior_std = _unit(self.space), self.space.width / np.sqrt(12.0)
        expected_std = self.space.prior[1]
        found: list[Identifiability] = []
        for k, std in enumerate(np.sqrt(np.diag(self.covariance))):
            if self.blind[k]:
                found.append("not identifiable")
            elif std > PRIOR_SHARE * expected_std[k]:
                # It is known well enough, but not by the recordings.
                found.append("weak")
            elif std <= IDENTIFIABLE_STD * unit[k]:
                # What compensates for a known effect is a property of the fit, not of the robot.
                found.append("weak" if self.space.names[k] in self.biased else "identifiable")
            else:
                # An expected value that recordings sharpen is a value; a range that they hardly cut is none.
                held = np.isfinite(expected_std[k]) or std <= WEAK_SHARE * prior_std[k]
                found.append("weak" if held else "not identifiable")
        return tuple(found)

    def with_alarms(self, *first: Finding, last: Sequence[Finding] = ()) -> Uncertainty:
        """Return it with more alarms, before and after its own."""
        return dataclasses.replace(self, alarms=as_one((*first, *self.alarms, *last)))

    def with_jitter(self, timing_std_s: float, means: str) -> Uncertainty:
        """Return it with another meaning of its alarm of sample times that jitter, if it has one."""
        plain, said = jitter_alarm(timing_std_s), jitter_alarm(timing_std_s, means)
        return dataclasses.replace(self, alarms=tuple(said if a == plain else a for a in self.alarms))

    def with_covariance(self, covariance: FloatArray) -> Uncertainty:
        """Return it with another covariance, (K, K), and the intervals that follow from it."""
        return dataclasses.replace(
            self,
            covariance=covariance,
            interval=intervals(self.space, self.theta, covariance, self.blind, self.bound),
        )

    def widened_to(self, std: FloatArray) -> Uncertainty:
        """Return it with standard deviations of at least ``std``, (K,), in own scales; correlations stay."""
        own = np.sqrt(np.diag(self.covariance))
        factor = np.maximum(std / np.maximum(own, 1e-300), 1.0)
        wider = self.with_covariance(self.covariance * np.outer(factor, factor))
        return dataclasses.replace(wider, widened=self.widened * factor)

    def latency_widened_to(
        self, reach_s: float, latency_s: float, latency_range_s: tuple[float, float]
    ) -> Uncertainty:
        """Return it with a latency interval that reaches at least so far from the estimate, in its range."""
        (low, high), (first, last) = self.latency_interval_s, latency_range_s
        interval_s = max(min(low, latency_s - reach_s), first), min(max(high, latency_s + reach_s), last)
        return dataclasses.replace(self, latency_interval_s=(float(interval_s[0]), float(interval_s[1])))

    def latency_reach_s(self, latency_s: float) -> float:
        """Return how far the latency's interval reaches from the estimate [s]; 0 for a given latency.

        An end of the range cuts off one side.
        """
        low, high = self.latency_interval_s
        return max(high - latency_s, latency_s - low)


def correlation_time(
    residuals: Sequence[FloatArray], chance: float | None = None, periods_s: Sequence[float] = ()
) -> float:
    """Return the integrated autocorrelation time of whitened residuals, (W, H, J) each, in samples.

    It is that of the worst channel, over all recordings of one rate: each recording alone is short, and the
    worst of many would be far from white by chance. White residuals have 1. Samples that filled a gap do not
    count: their whitened residual is exactly 0. With a ``chance``, it is a lower bound instead, which the
    true time of any channel is below with this probability. Without ``periods_s``, one an episode, all have
    one rate.
    """
    worst = 1.0
    channels = [
        channel
        for rows in rows_by_value(periods_s or [0.0] * len(residuals))
        for channel in zip(*(np.moveaxis(residuals[e], 2, 0) for e in rows), strict=True)
    ]
    below = 0.0 if chance is None else float(scipy.stats.norm.ppf(1 - chance / len(channels)))
    for channel in channels:
        total, used = 1.0, 0
        for rho, pairs in autocorrelations(channel, LAGS):
            if rho <= 2.0 / np.sqrt(pairs):
                break
            total, used = total + 2 * rho, used + 1
        count = max(sum(map(np.count_nonzero, channel)), 1)
        # tau = 1 + 2 sum_k rho_k, up to the first rho that white residuals would have. Its relative variance
        # with n samples and m lags is 2 (2 m + 1) / n: Madras and Sokal (1988). Bonferroni over the channels.
        worst = max(worst, total * (1 - below * np.sqrt(2 * (2 * used + 1) / count)))
    return worst


def uncertainty(
    space: ParameterSpace,
    theta: FloatArray,
    latency_s: float,
    normal: Normal,
    chi2: float,
    latency_range_s: tuple[float, float],
    *,
    kinks: float,
    fixed_latency: bool = False,
    timing_std_s: float = 0.0,
) -> Uncertainty:
    """Turn normal equations at an estimate, (K,) and latency [s], into intervals.

    Their gradient shows how hard a bound is pressed. Their rows give the clustered variances; without rows,
    residuals count as independent but for their correlation time. ``chi2`` is the mean squared whitened
    residual, ``timing_std_s`` the jitter of the sample times [s], ``kinks`` a factor on standard deviations
    for nonlinearity.
    """
    K = len(space)
    tau = correlation_time(normal.residual, periods_s=normal.periods_s)
    least_tau = correlation_time(normal.residual, FALSE_ALARMS, normal.periods_s)
    inflation = kinks**2 * max(1.0, chi2) * tau
    slope, known = normal.gradient, normal.prior
    data = normal.hessian - np.diag(known)
    # The range is a flat prior, of variance w^2 / 12: directions without information stay as wide as it.
    flat = np.append(space.width**2, (latency_range_s[1] - latency_range_s[0]) ** 2) / 12.0
    belief = known + 1.0 / flat
    # Null directions scale by the range themselves, so only what was measured counts here.
    unseen = null_space(space, data[:K, :K] / inflation + np.diag(known[:K]))
    blind = unseen.std > IDENTIFIABLE_STD * _unit(space)
    bound = pressed_ends(space, theta, slope[:K]) * ~blind
    free = np.append(bound == 0, not fixed_latency)
    # V of the module's text, with the entries at bounds and a given latency held.
    precision = data / inflation + np.diag(belief)
    covariance = _covariance(precision, free)
    cluster = clustered(normal.rows, covariance / inflation, [r.shape[1] for r in normal.residual], tau)
    factor = _factor(cluster, max(1.0, chi2) * tau, inflation)
    # Directions without information stay as wide as the range, however autocorrelated residuals are.
    factor = np.minimum(factor, np.sqrt(1.0 / (belief * np.maximum(np.diag(covariance), 1e-300))))
    factor = np.maximum(factor, 1.0)
    # D V D, with the factors in the diagonal D: correlations stay.
    covariance = covariance * np.outer(factor, factor)
    for k in map(int, np.flatnonzero(bound)):
        covariance[k, k] = _bound_std(precision, free, k, slope[k] / inflation, flat) ** 2
    std = np.sqrt(np.diag(covariance))
    reach, (first, last) = Z90 * std[K], latency_range_s
    latency = (max(latency_s - reach, first), min(latency_s + reach, last))
    if fixed_latency:
        latency = (latency_s, latency_s)
    blind |= std[:K] > BLIND_SHARE * np.sqrt(flat[:K])
    return Uncertainty(
        space=space,
        theta=theta,
        covariance=covariance[:K, :K],
        interval=intervals(space, theta, covariance[:K, :K], blind, bound),
        latency_interval_s=latency,
        null_directions=null_directions(space, unseen),
        prior_directions=expected_directions(space, data[:K, :K] / inflation, covariance[:K, :K]),
        alarms=(
            *_alarms(space, theta, chi2, tau, least_tau, timing_std_s, bound != 0),
            *contradictions(space, theta, std[:K]),
        ),
        inflation=inflation,
        blind=blind,
        bound=bound,
        clustered=cluster,
        widened=factor[:K],
    )


def _unit(space: ParameterSpace) -> FloatArray:
    return np.asarray(np.where(space.log_scale, 1.0, space.width))


def pressed_ends(space: ParameterSpace, theta: FloatArray, slope: FloatArray) -> npt.NDArray[np.int64]:
    """Return -1 or 1 where a parameter ended at a bound that the data press, (K,)."""
    side = np.where(space.normalize(theta) < 0.5, -1, 1)
    return np.asarray(side * (ended_at_bound(space, theta) & (side * slope <= 0)))


def latency_end(problem: Problem, latency_s: float, searched_s: tuple[float, float]) -> int:
    """Return at which end of its range a searched latency ended: -1, 1, or 0 for none; zero is no end."""
    if problem.fixed_latency_s is not None:
        return 0
    low, high = searched_s
    near = max(LATENCY_AT_END * (high - low), 0.5 * problem.step_s)
    if latency_s > high - near:
        return 1
    return -1 if low > 0 and latency_s < low + near else 0


def wider_latency(latency_range_s: tuple[float, float], end: int) -> tuple[float, float]:
    """Return a range of the latency that goes on at one end: -1, down to zero, or 1, twice as far [s]."""
    low, high = latency_range_s
    return (low, min(2 * high, LONGEST_LATENCY_S)) if end > 0 else (0.0, high)


def _covariance(precision: FloatArray, free: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the covariance of the free entries; rows and columns of fixed ones are zero."""
    covariance = np.zeros_like(precision)
    covariance[np.ix_(free, free)] = np.linalg.inv(precision[np.ix_(free, free)])
    # The inverse is symmetric up to rounding only.
    return np.asarray((covariance + covariance.T) / 2)


def _bound_std(
    precision: FloatArray, free: npt.NDArray[np.bool_], k: int, slope: float, flat: FloatArray
) -> float:
    """Return the 90 % reach of a parameter that is fixed at its bound, over Z90.

    Its likelihood is cut off at the bound. Inside, it falls with the slope and with the curvature that is
    left when the others follow.
    """
    # At a distance x from the bound the cost grows by 2 |s| x + c x^2: a normal law of mean -|s| / c and
    # variance 1 / c, cut off outside [0, width]. c is the information left when the others follow.
    others = free.copy()
    others[k] = True
    curvature = 1.0 / _covariance(precision, others)[k, k]
    std, width = curvature**-0.5, float(np.sqrt(12.0 * flat[k]))
    mean = -abs(slope) / curvature
    reach = float(scipy.stats.truncnorm.ppf(0.9, -mean / std, (width - mean) / std, loc=mean, scale=std))
    # Far out in the tail the law is exponential in the slope, and its numerical quantile not finite.
    exponential = np.log(10.0) / max(abs(slope), 1e-300)
    return (reach if 0 < reach <= width else min(exponential, width)) / Z90


def _factor(cluster: Clustered | None, uniform: float, inflation: float) -> FloatArray:
    """Return the factor of clustering on each standard deviation, (P,); at least 1.

    Few blocks give a noisy variance. So it is shrunk towards the uniform inflation, which counts like some
    blocks, and used only where it is significantly larger.
    """
    if cluster is None:
        return np.ones(1)
    # With rho the clustered variance over the uniform one and n0 = PRIOR_BLOCKS: factor^2 =
    # (n0 + nu rho) / (n0 + nu) (t_95(n0 + nu) / z_95)^2 where rho > chi2_95(nu) / nu, otherwise 1.
    degrees = cluster.degrees
    ratio = cluster.ratio * inflation / uniform
    drawn = (PRIOR_BLOCKS * inflation + degrees * ratio) / (PRIOR_BLOCKS + degrees)
    quantile = scipy.stats.t.ppf(0.95, PRIOR_BLOCKS + degrees) / Z90
    used = cluster.ratio / uniform > scipy.stats.chi2.ppf(0.95, degrees) / degrees
    factor = np.where(used, np.sqrt(drawn / inflation) * quantile, 1.0)
    return np.asarray(np.maximum(factor, 1.0))


def intervals(
    space: ParameterSpace,
    theta: FloatArray,
    covariance: FloatArray,
    blind: npt.NDArray[np.bool_] | Literal[False] = False,
    bound: npt.NDArray[np.int64] | Literal[0] = 0,
) -> FloatArray:
    """Return 90 % intervals, (K, 2), inside the range; the covariance is in each parameter's own scale.

    ``blind`` and ``bound`` are those of :class:`Uncertainty`.
    """
    K = len(space)
    std, center = np.sqrt(np.diag(covariance)), space.to_scale(theta)
    low = np.maximum(space.from_scale(center - Z90 * std), space.low)
    high = np.minimum(space.from_scale(center + Z90 * std), space.high)
    # Without information the estimate is arbitrary: the interval is the range's own 90 %.
    whole = ((std > BLIND_SHARE * space.width / np.sqrt(12.0)) | blind) & (bound == 0)
    # Nothing was searched beyond a bound; the interval lies on one side.
    low = np.where(bound < 0, space.low, np.where(whole, space.unnormalize(np.full(K, 0.05)), low))
    high = np.where(bound > 0, space.high, np.where(whole, space.unnormalize(np.full(K, 0.95)), high))
    return np.stack([low, high], axis=1)


def jitter_alarm(
    timing_std_s: float,
    means: str = "The model's delay is constant: if commands jitter too, the intervals are too narrow.",
) -> Finding:
    """Return the alarm of sample times that jitter; ``means`` says what the intervals have of it."""
    return Finding.alarm(
        f"The times of the samples jitter by {1e3 * timing_std_s:.1f} ms.",
        means,
        "Record over a connection with less jitter, or with the device's own time stamps.",
    )


def _alarms(
    space: ParameterSpace,
    theta: FloatArray,
    chi2: float,
    tau: float,
    least_tau: float,
    timing_std_s: float,
    pressed: npt.NDArray[np.bool_],
) -> tuple[Finding, ...]:
    alarms: list[Finding] = []
    if timing_std_s >= LEAST_JITTER_S:
        alarms.append(jitter_alarm(timing_std_s))
    if chi2 > MISMATCH_CHI2:
        alarms.append(Unexplained.larger(chi2))
    if chi2 > NEGLIGIBLE_CHI2 and least_tau > CORRELATION_SAMPLES:
        alarms.append(Unexplained.of([autocorrelated(tau)]))
    # A mass or a play of 0 is an answer: there is no wider range.
    least = np.array([p.low <= find_kind(p.kind).least for p in space.free])
    ended = ended_at_bound(space, theta) & ~(least & (theta < space.center))
    for which, means in (
        (
            pressed,
            "The data prefer a value outside the range, or the model is wrong. The intervals of the "
            "other parameters hold for this value.",
        ),
        (~pressed, "The search ended there, but the data do not press the value to that end."),
    ):
        names = [
            f"{space.names[k]} ({theta[k]:.4g} {space.free[k].unit})" for k in np.flatnonzero(ended & which)
        ]
        if names:
            alarms.append(
                Finding.alarm(
                    f"Ended at the bound of the search range: {listed(names)}.",
                    means,
                    "Widen the range (--range NAME LOW HIGH) if such a value is possible, or check the "
                    "model.",
                )
            )
    return as_one(alarms)


def contradictions(space: ParameterSpace, theta: FloatArray, std: FloatArray) -> tuple[Finding, ...]:
    """Return the alarm of values that are far from what was expected; none where there is none.

    Args:
        space: The parameters; those without a prior are not asked.
        theta: The estimate, (K,).
        std: Its standard deviations in the parameters' own scales, (K,).
    """
    mean, expected = space.prior
    # (x - m) / (s_m^2 + s^2)^(1/2). An estimate that knows the prior varies around it by (s_m^2 - s^2)^(1/2)
    # only, so this is cautious.
    far = (space.to_scale(theta) - space.to_scale(mean)) / np.hypot(expected, std)
    names = [
        f"{space.names[k]} = {theta[k]:.3g} {space.free[k].unit}, expected {mean[k]:.3g}: "
        f"{abs(far[k]):.1f} standard deviations"
        for k in np.argsort(-np.abs(far))
        if abs(far[k]) > CONTRADICTS
    ]
    if not names:
        return ()
    return (
        Finding.alarm(
            f"Far from what was expected: {'; '.join(names)}.",
            "Either the model is much further off than models usually are, or these values stand for another "
            "cause: a wrong clock, unit or axis of the recordings, or a law that the model lacks.",
            "Check one of these values, and the recordings' clock and units. If it is right, say so with "
            "--known NAME VALUE.",
        ),
    )


def ended_at_bound(space: ParameterSpace, theta: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which parameters lie at an end of their range, pressed against it or not, (K,)."""
    unit = space.normalize(theta)
    return np.asarray((unit < AT_BOUND) | (unit > 1 - AT_BOUND))


def names_at_bound(space: ParameterSpace, theta: FloatArray) -> list[str]:
    """Return the names of the parameters that :func:`ended_at_bound` finds."""
    return [space.names[k] for k in np.flatnonzero(ended_at_bound(space, theta))]


def with_rows(refined: Refined) -> Refined:
    """Return the fit with linearised residuals, from which variances are clustered.

    Central differences where nothing has kinks: directions without information depend on them.
    """
    if refined.normal.rows:
        return refined
    shooting = refined.shooting
    if shooting.problem.robot.base is None:
        normal = shooting.normal(refined.point, keep=True, stretch=NEAR_STRETCH, central=True)
        normal = with_weak_directions(shooting, refined.point, normal)
    else:
        normal = shooting.normal(refined.point, keep=True)
    return dataclasses.replace(refined, normal=normal)


def uncertainty_at(
    problem: Problem,
    fit: Refined | OutputErrorFit,
    fixed_latency: bool | None = None,
    *,
    own_scale: bool = False,
) -> Uncertainty:
    """Return the uncertainty of a fit; variances are clustered if it holds linearised residuals.

    Residuals that a fit divides by their ``own_scale`` count as noise. The latency is fixed where the problem
    gives it, unless ``fixed_latency`` says otherwise.
    """
    return uncertainty(
        problem.space,
        fit.theta,
        fit.latency_s,
        fit.normal,
        1.0 if own_scale else fit.chi2,
        problem.latency_range_s,
        fixed_latency=problem.fixed_latency_s is not None if fixed_latency is None else fixed_latency,
        timing_std_s=0.0 if own_scale else problem.noise.timing_std_s,
        kinks=kinks_of(problem),
    )


def kinks_of(problem: Problem) -> float:
    """Return the factor on standard deviations for nonlinearity, see `KINKS`."""
    smooth = problem.robot.base is None or problem.noise_free
    return KINKS if smooth else CONTACT_KINKS
