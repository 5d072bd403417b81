"""The diffusion-evolution step: by hand, on a quadratic, and with a fitness that knows nothing."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.calib.paper.diffusion_evolution import (
    DiffusionEvolution,
    DiffusionSettings,
    alpha_schedule,
    neighbour_weights,
    probabilities,
)
from deal_hw.errors import ConfigurationError

LITERAL = DiffusionSettings(
    generations=2, schedule="linear", eta=0.0, temperature=None, adapt_noise=False, divide_distance=False
)


def test_step_for_two_members_by_hand() -> None:
    """Eqs. 1, 2 and 10 for theta = (1, -1), p = (3/4, 1/4), alpha_2 = 0.001, alpha_1 = 0.5005, no noise."""
    search = DiffusionEvolution(np.array([[1.0], [-1.0]]), LITERAL, np.random.default_rng(0))
    step = search.tell(np.array([np.log(3.0), 0.0]))
    # Member 1: weights 3/4 exp(-(1 - sqrt .001)^2 / 1.998) = 0.469058 and 1/4 exp(-(1 + sqrt .001)^2 / 1.998)
    # = 0.146761; theta_0 = (0.469058 - 0.146761) / 0.615819 = 0.523363; eps = (1 - 0.0316228 * 0.523363) /
    # 0.9995 = 0.983942; next = 0.707460 * 0.523363 + 0.706753 * 0.983942. Member 2: theta_0 = 0.475886, eps =
    # -1.015557.
    np.testing.assert_allclose(search.ask()[:, 0], [1.065663, -0.381078], atol=2e-6)
    assert step.effective_size == pytest.approx(1 / (0.75**2 + 0.25**2))
    assert search.t == 1


def test_last_step_is_the_estimate_itself() -> None:
    """At t = 1, alpha_0 = 1: eq. 10 leaves theta_0 alone, whatever the noise schedule says."""
    settings = DiffusionSettings(generations=1, eta=1.0, temperature=None, adapt_noise=True)
    theta = np.array([[0.3, -0.2], [0.5, 0.1], [-0.4, 0.9]])
    search = DiffusionEvolution(theta, settings, np.random.default_rng(0))
    fitness = np.array([0.1, 0.7, -0.3])
    weights = neighbour_weights(theta, probabilities(fitness, None), search.alpha[1], divide=True)
    step = search.tell(fitness)
    np.testing.assert_allclose(search.ask(), weights @ theta)
    assert step.sigma == 0.0
    assert search.finished


@pytest.mark.parametrize("schedule", ["cosine", "linear"])
def test_alpha_runs_from_one_to_nearly_zero(schedule: str) -> None:
    """Eq. 12's ends, and no step back."""
    alpha = alpha_schedule(20, schedule)  # type: ignore[arg-type]
    assert alpha[0] == pytest.approx(1.0)
    assert alpha[-1] == pytest.approx(1e-3)
    assert np.all(np.diff(alpha) < 0)


def test_noise_adaptation_is_clamped() -> None:
    """A fitness of -20 asks for a noise of e^20 sigma; eq. 10 can hold sqrt(1 - alpha_{t-1})."""
    settings = DiffusionSettings(generations=10, adapt_noise=True, influence=1.0)
    search = DiffusionEvolution(np.zeros((4, 2)), settings, np.random.default_rng(0))
    step = search.tell(np.full(4, -20.0))
    assert step.delta == pytest.approx(np.exp(20.0))
    assert step.clamped
    assert step.sigma == pytest.approx(np.sqrt(1 - search.alpha[9]))
    assert np.isfinite(search.ask()).all()


def test_good_fitness_reduces_the_noise() -> None:
    """Eq. 9: a mean fitness of ln 4 quarters sigma."""
    rng = np.random.default_rng(0)
    population = rng.uniform(-1, 1, (8, 3))
    plain = DiffusionEvolution(population, DiffusionSettings(adapt_noise=False), np.random.default_rng(1))
    adapted = DiffusionEvolution(population, DiffusionSettings(adapt_noise=True), np.random.default_rng(1))
    fitness = np.full(8, np.log(4.0))
    assert adapted.tell(fitness).sigma == pytest.approx(plain.tell(fitness).sigma / 4)


def test_kernel_does_not_underflow_in_high_dimensions() -> None:
    """At K = 2000 and alpha near 1 the density is below the smallest float, its ratios are not."""
    theta = np.random.default_rng(0).uniform(-1, 1, (5, 2000))
    weights = neighbour_weights(theta, np.full(5, 0.2), 0.99, divide=False)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(weights, np.eye(5), atol=1e-12)
    divided = neighbour_weights(theta, np.full(5, 0.2), 0.5, divide=True)
    assert divided.max() < 0.5


def test_diverged_members_get_no_weight() -> None:
    """A fitness of -inf means a simulation that diverged; if all did, nobody is preferred."""
    for temperature in (None, 0.5):
        p = probabilities(np.array([1.0, -np.inf, 0.0]), temperature)
        assert p[1] == 0.0
        assert p[0] > p[2] > 0.0
    np.testing.assert_allclose(probabilities(np.full(4, -np.inf), 0.5), 0.25)


def test_flat_fitness_has_no_opinion_at_any_temperature() -> None:
    """Equal fitness, equal probabilities."""
    np.testing.assert_allclose(probabilities(np.full(5, 3.0), 0.5), 0.2)


def test_finds_the_optimum_of_a_quadratic() -> None:
    """With a perfect fitness in 3 dimensions the mean of the last population is within 0.1 of the optimum."""
    rng = np.random.default_rng(3)
    optimum = np.array([0.6, -0.5, 0.3])
    search = DiffusionEvolution(rng.uniform(-1.7, 1.7, (150, 3)), DiffusionSettings(adapt_noise=False), rng)
    while not search.finished:
        search.tell(-np.sum((search.ask() - optimum) ** 2, axis=1))
    np.testing.assert_allclose(search.ask().mean(axis=0), optimum, atol=0.1)


def test_flat_fitness_stays_at_the_start() -> None:
    """A search that cannot see the data stays, within its Monte-Carlo spread, at the box's centre."""
    finals = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        search = DiffusionEvolution(rng.uniform(-1.7, 1.7, (50, 9)), DiffusionSettings(generations=30), rng)
        while not search.finished:
            search.tell(np.zeros(50))
        finals.append(search.ask().mean(axis=0))
    means = np.array(finals)
    error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    # Nine coordinates: the largest of them stays below 3.5 standard errors with a probability of 0.996.
    assert np.abs(means.mean(axis=0) / error).max() < 3.5


@pytest.mark.parametrize(
    "setting", [{"generations": 0}, {"schedule": "square"}, {"eta": 1.5}, {"temperature": 0.0}]
)
def test_bad_settings_are_refused(setting: dict[str, object]) -> None:
    """Each setting that cannot be used is named."""
    with pytest.raises(ConfigurationError, match=next(iter(setting))):
        DiffusionSettings(**setting)  # type: ignore[arg-type]
