"""Critics: they tell two clouds apart, keep their constraint, and are deterministic."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.calib.paper.critic import (
    ClippedCritic,
    Critic,
    CriticSettings,
    PenaltyCritic,
    Samples,
    torch_threads,
)


def cloud(seed: int, mean: float, count: int = 400) -> Samples:
    """Return a Gaussian cloud in two dimensions."""
    rng = np.random.default_rng(seed)
    return (rng.standard_normal((count, 2)) * 0.3 + [mean, -mean]).astype(np.float32)


SMALL = CriticSettings(hidden=(32, 32), learning_rate=2e-3, updates=100, batch=64, clip=0.1)


@pytest.mark.parametrize("kind", [ClippedCritic, PenaltyCritic])
def test_separates_two_clouds(kind: type[Critic]) -> None:
    """After training, fresh samples of the recording's cloud nearly always score higher."""
    critic = kind(2, SMALL, np.random.default_rng(0))
    with torch_threads(1):
        gap = critic.train(cloud(1, 0.7), cloud(2, -0.7))
        real, fake = critic.score(cloud(3, 0.7)), critic.score(cloud(4, -0.7))
    assert gap > 0
    middle = 0.5 * (real.mean() + fake.mean())
    assert np.mean(real > middle) > 0.97
    assert np.mean(fake < middle) > 0.97


def test_clipped_weights_stay_in_the_box() -> None:
    """Eq. 5's Lipschitz bound is kept by the clip after every update."""
    critic = ClippedCritic(2, SMALL, np.random.default_rng(0))
    critic.train(cloud(1, 0.7), cloud(2, -0.7))
    for layer in critic.layers:
        assert float(layer.weight.detach().abs().max()) <= SMALL.clip + 1e-7


def test_penalised_slope_is_near_one() -> None:
    """Between the clouds the gradient by the input has about unit length."""
    import torch

    critic = PenaltyCritic(2, SMALL, np.random.default_rng(0))
    for _ in range(3):
        critic.train(cloud(1, 0.7), cloud(2, -0.7))
    x = torch.zeros(50, 2) + torch.linspace(-0.5, 0.5, 50)[:, None] * torch.tensor([1.0, -1.0])
    x.requires_grad_(True)
    (slope,) = torch.autograd.grad(critic.hidden(x)[2].sum(), x)
    assert 0.7 < float(slope.norm(dim=1).mean()) < 1.3


def test_same_seed_same_critic() -> None:
    """Weights and training draw from the generator that is passed in, not from torch's global one."""
    import torch

    scores = []
    for number in range(2):
        torch.manual_seed(number)
        critic = ClippedCritic(2, SMALL, np.random.default_rng(7))
        critic.train(cloud(1, 0.7), cloud(2, -0.7))
        scores.append(critic.score(cloud(3, 0.1)))
    np.testing.assert_array_equal(scores[0], scores[1])


@pytest.mark.parametrize("kind", [ClippedCritic, PenaltyCritic])
def test_threads_change_no_result(kind: type[Critic]) -> None:
    """Work is divided alike for any number of threads, so a critic is the same to the last bit."""
    found = []
    for threads in (1, 2, 3):
        critic = kind(2, SMALL, np.random.default_rng(7), threads)
        gap = critic.train(cloud(1, 0.7), cloud(2, -0.7))
        found.append(np.append(critic.score(cloud(3, 0.1, 5000)), np.float32(gap)))
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_clipped_update_follows_the_gradient_of_eq_5() -> None:
    """One plain step moves each weight by the rate times the difference of the two sides' mean gradients."""
    import torch

    critic = ClippedCritic(2, dataclasses.replace(SMALL, updates=1, clip=10.0), np.random.default_rng(7))
    critic.optimiser = torch.optim.SGD(critic._parameters, lr=0.5)
    before = [p.detach().clone() for p in critic._parameters]
    real, fake = torch.from_numpy(cloud(1, 0.7, 50)), torch.from_numpy(cloud(2, -0.7, 50))
    gap = critic.hidden(real)[2].mean() - critic.hidden(fake)[2].mean()
    slopes = torch.autograd.grad(gap, critic._parameters)
    with critic._pool() as pool:
        assert critic._update(real, fake, pool) == pytest.approx(float(gap.detach()), abs=1e-6)
    for old, slope, new in zip(before, slopes, critic._parameters, strict=True):
        torch.testing.assert_close(new.detach(), old + 0.5 * slope, rtol=1e-5, atol=1e-7)


def test_blocks_are_as_good_as_one_array() -> None:
    """A replay in blocks gives bit for bit what the joined array gives."""
    fake = cloud(2, -0.7, 300)
    whole, parts = (ClippedCritic(2, SMALL, np.random.default_rng(7)) for _ in range(2))
    whole.train(cloud(1, 0.7), fake)
    parts.train(cloud(1, 0.7), fake[:50], fake[50:120], fake[120:])
    np.testing.assert_array_equal(whole.score(fake), parts.score(fake))


def test_statistics_are_the_means_of_activations() -> None:
    """A group's statistics are the means over its samples: both hidden layers, then the output."""
    import torch

    critic = PenaltyCritic(2, SMALL, np.random.default_rng(0))
    groups = np.stack([cloud(1, 0.5, 30), cloud(2, -0.5, 30)])
    statistics = critic.statistics(groups)
    assert statistics.shape == (2, 32 + 32 + 1)
    np.testing.assert_allclose(statistics[1, -1], critic.score(groups[1]).mean(), atol=1e-6)
    with torch.no_grad():
        first = critic.hidden(torch.from_numpy(groups[0]))[0].mean(dim=0)
    np.testing.assert_allclose(statistics[0, :32], first.numpy(), atol=1e-6)


def test_thread_count_is_restored() -> None:
    """The number of torch's threads is borrowed, not changed."""
    import torch

    before = torch.get_num_threads()
    with torch_threads(1):
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before


@pytest.mark.parametrize("kind", [ClippedCritic, PenaltyCritic])
def test_a_round_that_diverges_is_undone(kind: type[Critic]) -> None:
    """The weights go back, the estimate is nan, and the generator goes on to other draws."""
    rng = np.random.default_rng(0)
    critic = kind(2, CriticSettings(hidden=(8, 8), updates=2, batch=16), rng)
    real, fake = (rng.standard_normal((50, 2)).astype(np.float32) for _ in range(2))
    assert np.isfinite(critic.train(real, fake)) and critic.diverged == 0
    before = critic.save()
    assert np.isnan(critic.train(np.full_like(real, np.nan), fake))
    after = critic.save()
    assert after["diverged"] == critic.diverged == 1
    for was, now in zip(before["weights"], after["weights"], strict=True):
        np.testing.assert_array_equal(was, now)
    assert not np.array_equal(before["generator"], after["generator"])
    assert np.isfinite(critic.train(real, fake)) and critic.diverged == 1
