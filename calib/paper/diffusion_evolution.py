"""Diffusion evolution (DEAL, section 3 and appendix A.1): a population denoised towards its fitter members.

It knows no simulator: ``ask`` returns a population, ``tell`` takes the fitness of each member. Equation
numbers and symbols are the DEAL paper's:
    theta: the population at step t, (N, K) [in the box]; t runs from T to 0.
    alpha_t: diffusion schedule, 1 at t = 0 and about 0 at t = T [-]; 1 - alpha_t is the noise's variance.
    p: probabilities of the members from their fitness, (N,) [-]; Z: their sum with the kernel (eq. 20).
    theta_0, epsilon: estimate of the optimum and of the noise for each member, (N, K) (eqs. 1 and 2).
    sigma_t, delta, omega: noise schedule, its factor (eq. 9), and standard normal draws, (N, K).
One step, eq. 10, with s = delta sigma_t:
theta_{t-1} = alpha_{t-1}^(1/2) theta_0 + (1 - alpha_{t-1} - s^2)^(1/2) epsilon + s omega.

The coordinates are a box around zero. The paper says "normalised within the search range", but not which box.
In [0, 1] the factors sqrt(alpha) pull the whole population towards the lower corner without any data: a flat
fitness drifts to 0.37-0.45 of the range. In a centred box they pull towards the centre, where the search
starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy.special import logsumexp, softmax

from deal_hw.calib.data.resume import Stateful
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray

Schedule = Literal["cosine", "linear"]


ALPHA_LAST: Final = 1e-3
"""alpha_T: eq. 12 wants about 0; a true 0 would weight all neighbours equally."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiffusionSettings:
    r"""The paper's choices, and ours where it leaves one.

    Attributes:
        generations: Search steps T.
        schedule: How alpha_t falls from 1 to about 0; the paper names none.
        eta: sigma_t in units of the full DDPM noise; 0 is deterministic DDIM. The paper names no schedule.
        divide_distance: Whether the kernel's squared distance is divided by K. The paper's N(.; ., 1 - alpha)
            is a sum over coordinates. At high K it underflows: each member then has only itself as neighbour.
        temperature: None is the paper's g, a softmax of the raw fitness (eq. 22). A number standardises the
            fitness within the generation and divides it by this. A critic's scale is arbitrary: the raw
            softmax selects either everyone or one.
        adapt_noise: Whether eq. 9 scales the noise; off is the paper's ablation DEAL\FN.
        influence: lambda in eq. 9; the paper gives no value.
    """

    generations: int = 50
    schedule: Schedule = "cosine"
    eta: float = 1.0
    divide_distance: bool = True
    temperature: float | None = 0.3
    adapt_noise: bool = True
    influence: float = 1.0

    def __post_init__(self) -> None:
        if self.generations < 1:
            raise ConfigurationError(f"generations must be at least 1, got {self.generations}")
        if self.schedule not in ("cosine", "linear"):
            raise ConfigurationError(f"unknown schedule {self.schedule!r}; known: cosine, linear")
        if not 0 <= self.eta <= 1:
            raise ConfigurationError(f"eta must be within [0, 1], got {self.eta:g}")
        if self.temperature is not None and not self.temperature > 0:
            raise ConfigurationError(f"the temperature must be above 0 or None, got {self.temperature:g}")


def alpha_schedule(generations: int, schedule: Schedule, last: float = 1e-3) -> FloatArray:
    """Return alpha_0 = 1, ..., alpha_T = ``last``, (T + 1,); "cosine" has smaller steps at both ends."""
    part = np.arange(generations + 1) / generations
    fall = (1 + np.cos(np.pi * part)) / 2 if schedule == "cosine" else 1 - part
    return np.asarray(last + (1 - last) * fall)


@dataclass(frozen=True, slots=True)
class DiffusionStep:
    """Result of one step.

    Attributes:
        effective_size: Effective sample size of the probabilities p, 1 / sum p^2: N is no selection at all.
        effective_neighbours: The same for p times the kernel, mean over members: 1 is a member with only
            itself as neighbour.
        delta: The factor of eq. 9 as computed.
        sigma: The noise used, after the clamp.
        clamped: Whether the noise of eq. 9 exceeded the limit of eq. 10.
    """

    effective_size: float
    effective_neighbours: float
    delta: float
    sigma: float
    clamped: bool


class DiffusionEvolution(Stateful):
    """A population (N, K) in a box around zero; a uniform start of unit variance fits eq. 12 best.

    The paper draws the start theta^T uniformly from the search range.
    """

    STATE = ("_theta", "t")

    def __init__(self, population: FloatArray, settings: DiffusionSettings, rng: np.random.Generator) -> None:
        self._theta = np.array(population, dtype=float)
        self._settings = settings
        self._rng = rng
        self.alpha = alpha_schedule(settings.generations, settings.schedule, ALPHA_LAST)
        self.t = settings.generations

    def ask(self) -> FloatArray:
        """Return theta^t, (N, K); members may lie outside the box."""
        return self._theta.copy()

    @property
    def finished(self) -> bool:
        """Whether theta^0 has been reached."""
        return self.t == 0

    def tell(self, fitness: FloatArray) -> DiffusionStep:
        """Take the step t -> t - 1.

        Args:
            fitness: Mean critic output of each member, (N,); higher is better. Members whose simulation
                diverged are -inf and get probability 0.
        """
        settings, theta, t = self._settings, self._theta, self.t
        p = probabilities(fitness, settings.temperature)
        alpha, alpha_next = self.alpha[t], self.alpha[t - 1]
        # Eq. 1, 19 and 20 (Algorithm 1, lines 12-13): theta_0 = sum_i p_i N(theta_j; sqrt(a) theta_i, 1 - a)
        # theta_i / Z.
        weights = neighbour_weights(theta, p, alpha, divide=settings.divide_distance)
        estimate = weights @ theta
        # Eq. 2 (line 14): epsilon = (theta - alpha_t^(1/2) theta_0) / (1 - alpha_t)^(1/2). alpha_t < 1 for
        # every t >= 1.
        noise = (theta - np.sqrt(alpha) * estimate) / np.sqrt(1 - alpha)
        # sigma_t = eta ((1 - alpha_{t-1}) / (1 - alpha_t))^(1/2) (1 - alpha_t / alpha_{t-1})^(1/2): the DDPM
        # posterior's standard deviation times eta, eq. 16 of DDIM (Song et al. 2021, the paper's reference
        # 25). The paper itself gives no sigma_t.
        sigma = (
            settings.eta * np.sqrt((1 - alpha_next) / (1 - alpha)) * np.sqrt(max(1 - alpha / alpha_next, 0.0))
        )
        delta = 1.0
        if settings.adapt_noise:
            finite = fitness[np.isfinite(fitness)]
            # Eq. 9 (line 10): delta = lambda exp(-E D), the mean over all members' transitions, which is the
            # mean fitness. Cut before exp overflows; the clamp below limits it anyway.
            delta = (
                settings.influence * float(np.exp(np.clip(-finite.mean(), -50.0, 50.0)))
                if finite.size
                else 1.0
            )
        wanted = delta * sigma
        # Eq. 10 needs 1 - alpha_{t-1} - sigma^2 >= 0, which eq. 9 does not guarantee: clamp. The paper does
        # not say.
        sigma_hat = min(wanted, np.sqrt(1 - alpha_next))
        keep = np.sqrt(max(1 - alpha_next - sigma_hat**2, 0.0))
        omega = self._rng.standard_normal(theta.shape)
        # Eq. 10 (line 15). At t = 1, alpha_0 = 1: the last step is the estimate itself, without noise.
        self._theta = np.sqrt(alpha_next) * estimate + keep * noise + sigma_hat * omega
        self.t -= 1
        return DiffusionStep(
            effective_size=float(1 / np.sum(p**2)),
            effective_neighbours=float(np.mean(1 / np.sum(weights**2, axis=1))),
            delta=delta,
            sigma=float(sigma_hat),
            clamped=bool(wanted > sigma_hat),
        )


def probabilities(fitness: FloatArray, temperature: float | None) -> FloatArray:
    """Map fitness to probabilities, (N,) each (the paper's g, eq. 22); see `DiffusionSettings.temperature`.

    A fitness of -inf gets probability 0, unless all have it.
    """
    finite = np.isfinite(fitness)
    if not finite.any():
        return np.full(len(fitness), 1 / len(fitness))
    values = np.where(finite, fitness, -np.inf)
    if temperature is not None:
        spread = float(fitness[finite].std())
        if spread == 0.0:
            values = np.where(finite, 0.0, -np.inf)
        else:
            values = (values - fitness[finite].mean()) / (spread * temperature)
    return np.asarray(softmax(values))


def neighbour_weights(theta: FloatArray, p: FloatArray, alpha: float, *, divide: bool) -> FloatArray:
    """Return p_i N(theta_j; sqrt(alpha) theta_i, 1 - alpha) / Z, (N, N), row j for member j.

    Computed from logarithms: at high K the density itself underflows to zero for every neighbour. With
    ``divide`` the squared distance is divided by K; the constant factor of the density cancels in Z.
    """
    # |theta_j - alpha^(1/2) theta_i|^2 by parts, (N, N); the log of the density is minus half of it over
    # 1 - alpha.
    centres = np.sqrt(alpha) * theta
    squared = np.sum(theta**2, axis=1)[:, None] - 2 * theta @ centres.T + np.sum(centres**2, axis=1)
    if divide:
        squared = squared / theta.shape[1]
    with np.errstate(divide="ignore"):
        logs = np.log(p) - 0.5 * np.maximum(squared, 0.0) / (1 - alpha)
    return np.asarray(np.exp(logs - logsumexp(logs, axis=1, keepdims=True)))
