"""Critics: networks that separate recorded transitions from simulated ones.

Two kinds share one interface. `ClippedCritic` is the paper's WGAN with weight clipping (eq. 5).
`PenaltyCritic` holds its gradient near one instead (WGAN-GP, Gulrajani et al. 2017). So it stays smooth
enough for regression on its hidden features. Both run on the CPU, in float32, and draw from one torch
generator: the same seed gives the same critic.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.resume import State, Stateful
from deal_hw.on_use import OnUse
from deal_hw.types import FloatArray

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    # It loads for seconds. Searches without a critic do not wait for it.
    torch = OnUse("torch", "torch", "calib")

Samples = npt.NDArray[np.float32]


PENALTY: Final = 10.0
"""Weight of the squared distance of the gradient's norm from one (`PenaltyCritic`): lambda of WGAN-GP, arXiv
1704.00028."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CriticSettings:
    """Size and training of a critic.

    Attributes:
        hidden: Units of the two hidden layers.
        learning_rate: Step of the optimiser.
        updates: Updates n a generation.
        batch: Samples M of each side in one update.
        clip: Weights are cut to [-clip, clip] after each update (`ClippedCritic`).
    """

    hidden: tuple[int, int] = (256, 256)
    learning_rate: float = 3e-4
    updates: int = 20
    batch: int = 1024
    clip: float = 0.01


PAPER_CRITIC = CriticSettings()
"""Two layers of 256 (section 3.1). Learning rate, clip, updates n and batch M are not in the paper."""

FEATURE_CRITIC = CriticSettings(hidden=(64, 64), learning_rate=1e-3, updates=20, batch=512)
"""The critic whose features are regressed on: smaller and faster than the paper's."""


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Use ``count`` threads inside one operation; on a busy machine more than one can be 30 times slower."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Critic(Stateful):
    """A network with two hidden layers, ReLU, and one output (the paper's D).

    ``diverged`` is the number of rounds of training whose weights were not finite, and which were undone.

    Args:
        inputs: Width of a sample.
        settings: Size and training.
        rng: Draws the seed of the critic's own generator.
        threads: Threads of the arithmetic. Parts are divided alike for any number, so results do not depend
            on it.
    """

    def __init__(
        self, inputs: int, settings: CriticSettings, rng: np.random.Generator, threads: int = 1
    ) -> None:
        self.settings = settings
        self._threads = threads
        self.diverged = 0
        self.generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        first, second = settings.hidden
        self.layers = [
            torch.nn.Linear(inputs, first),
            torch.nn.Linear(first, second),
            torch.nn.Linear(second, 1),
        ]
        self._parameters: list[Tensor] = []
        with torch.no_grad():
            for layer in self.layers:
                # torch's default initialisation, U(-1 / sqrt(inputs), 1 / sqrt(inputs)), but from our
                # generator instead of the global one.
                bound = layer.in_features**-0.5
                for parameter in (layer.weight, layer.bias):
                    parameter.uniform_(-bound, bound, generator=self.generator)
                    self._parameters.append(parameter)
        self.optimiser = self._make_optimiser()

    def _make_optimiser(self) -> torch.optim.Optimizer:
        raise NotImplementedError

    def _update(self, real: Tensor, fake: Tensor, pool: Executor) -> float:
        raise NotImplementedError

    @contextlib.contextmanager
    def _pool(self) -> Iterator[Executor]:
        """Return threads for independent parts; each uses one thread inside an operation."""
        with (
            torch_threads(1),
            ThreadPoolExecutor(self._threads, initializer=torch.set_num_threads, initargs=(1,)) as pool,
        ):
            yield pool

    def hidden(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the activations of both hidden layers and the output, (B, h1), (B, h2), (B, 1)."""
        first = self.layers[0](x).relu_()
        second = self.layers[1](first).relu_()
        return first, second, self.layers[2](second)

    def train(self, real: Samples, *fake: Samples) -> float:
        """Make the settings' updates on minibatches drawn with replacement (Algorithm 1, lines 4-7).

        Samples are (n, inputs). Those of the simulators come in blocks that are never joined: a replay of 50
        generations of 200 x 200 transitions is 72 MB. Return the estimate of the Wasserstein distance in the
        last update: mean output on real minus fake samples. If the weights diverge, they go back to what they
        were before, and the estimate is nan.
        """
        settings = self.settings
        data = torch.from_numpy(real)
        ends = np.cumsum([len(block) for block in fake])
        draws = settings.updates * settings.batch
        # Line 5: M samples of each side for each of n updates, (s, a, s') of the recording and of all
        # simulators together. Draws of all updates at once; each block gives the rows that fall into it.
        rows = torch.randint(len(data), (draws,), generator=self.generator)
        other = torch.randint(int(ends[-1]), (draws,), generator=self.generator).numpy()
        imitation = np.empty((draws, real.shape[1]), dtype=np.float32)
        owner = np.searchsorted(ends, other, side="right")
        for i, block in enumerate(fake):
            mine = np.flatnonzero(owner == i)
            imitation[mine] = block[other[mine] - (ends[i] - len(block))]
        shape = (settings.updates, settings.batch, real.shape[1])
        batches, copies = data[rows].reshape(shape), torch.from_numpy(imitation).reshape(shape)
        gap, sound = 0.0, self.save()
        # Lines 6-7: w <- w + step grad_w [mean D_w(real) - mean D_w(fake)], n times.
        with self._pool() as pool:
            for k in range(settings.updates):
                gap = self._update(batches[k], copies[k], pool)
        if all(bool(torch.isfinite(parameter).all()) for parameter in self._parameters):
            return gap
        # The generator goes on: the same draws would diverge again.
        self.load({**sound, "generator": self.generator.get_state().numpy()})
        self.diverged += 1
        return float("nan")

    def save(self) -> State:
        """Return weights, the optimiser's memory and the generator as arrays."""
        memory = self.optimiser.state_dict()["state"]
        return {
            "weights": [parameter.detach().numpy().copy() for parameter in self._parameters],
            "optimiser": {
                str(number): {name: value.numpy().copy() for name, value in state.items()}
                for number, state in memory.items()
            },
            "generator": self.generator.get_state().numpy().copy(),
            "diverged": self.diverged,
        }

    def load(self, state: State) -> None:
        """Continue from what :meth:`save` returned."""
        with torch.no_grad():
            for parameter, values in zip(self._parameters, state["weights"], strict=True):
                parameter.copy_(torch.tensor(values))
        memory = {
            int(number): {name: torch.tensor(value) for name, value in values.items()}
            for number, values in state["optimiser"].items()
        }
        # Learning rates and the like are settings, not state.
        groups = self.optimiser.state_dict()["param_groups"]
        self.optimiser.load_state_dict({"state": memory, "param_groups": groups})
        self.generator.set_state(torch.tensor(state["generator"]))
        self.diverged = state["diverged"]

    def score(self, samples: Samples, chunk: int = 2048) -> Samples:
        """Return the output on samples, (n,)."""
        x = torch.from_numpy(samples)

        @torch.no_grad()
        def output(begin: int) -> Tensor:
            return self.hidden(x[begin : begin + chunk])[2][:, 0]

        with self._pool() as pool:
            parts = list(pool.map(output, range(0, len(x), chunk)))
        return np.asarray(torch.cat(parts).numpy())

    def statistics(self, samples: Samples) -> FloatArray:
        """Return the mean hidden activations and output, (N, h1 + h2 + 1), of samples, (N, n, inputs)."""
        groups, count, width = samples.shape
        per = max(16384 // count, 1)
        out = []
        with torch_threads(1), torch.no_grad():
            for i in range(0, groups, per):
                block = torch.from_numpy(samples[i : i + per])
                parts = self.hidden(block.reshape(-1, width))
                # mean_j [h1, h2, D](x_ij) for each group i of samples j.
                means = [part.reshape(len(block), count, -1).mean(dim=1) for part in parts]
                out.append(torch.cat(means, dim=1))
        return torch.cat(out).double().numpy()


class ClippedCritic(Critic):
    """The paper's critic: WGAN, weights clipped to a box (eq. 5)."""

    def _make_optimiser(self) -> torch.optim.Optimizer:
        # The paper names no optimiser; WGAN's authors and EASI use RMSprop.
        return torch.optim.RMSprop(self._parameters, lr=self.settings.learning_rate, foreach=True)

    def _update(self, real: Tensor, fake: Tensor, pool: Executor) -> float:
        # The gradient of a difference of means is that of both means: two independent parts for two threads.
        ours, theirs = pool.map(self._mean_and_gradient, (real, fake))
        # Eq. 5: max over the weights of E_real D - E_fake D. Optimisers minimise: the gradient turns round.
        for parameter, up, down in zip(self._parameters, ours[1], theirs[1], strict=True):
            parameter.grad = down - up
        self.optimiser.step()
        with torch.no_grad():
            # w <- clip(w, -c, c) holds the slope of D below a constant, as the Wasserstein distance asks
            # (Arjovsky et al. 2017, Algorithm 1).
            torch._foreach_clamp_min_(self._parameters, -self.settings.clip)
            torch._foreach_clamp_max_(self._parameters, self.settings.clip)
        return ours[0] - theirs[0]

    def _mean_and_gradient(self, samples: Tensor) -> tuple[float, tuple[Tensor, ...]]:
        """Return the mean output on samples, and its gradient by the weights."""
        mean = self.hidden(samples)[2].mean()
        return float(mean.detach()), torch.autograd.grad(mean, self._parameters)


class PenaltyCritic(Critic):
    """WGAN-GP: the gradient by the input has length one between real and simulated samples."""

    def _make_optimiser(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(
            self._parameters, lr=self.settings.learning_rate, betas=(0.5, 0.9), foreach=True
        )

    def _update(self, real: Tensor, fake: Tensor, pool: Executor) -> float:
        self.optimiser.zero_grad(set_to_none=True)
        # Gulrajani et al. (2017), eq. 3: minimise E_fake D - E_real D + c E (|grad_x D(x)| - 1)^2, with x
        # uniform between pairs of samples and c = ``penalty``.
        mix = torch.rand(len(real), 1, generator=self.generator)
        between = (mix * real + (1 - mix) * fake).requires_grad_(True)
        output = self.hidden(torch.cat([real, fake, between]))[2][:, 0]
        ends = len(real), len(real) + len(fake)
        # A sum over samples: each D(x) depends on its own x alone, so row k is grad_x D(x_k).
        (slope,) = torch.autograd.grad(output[ends[1] :].sum(), between, create_graph=True)
        penalty = ((slope.norm(dim=1) - 1) ** 2).mean()
        gap = output[: ends[0]].mean() - output[ends[0] : ends[1]].mean()
        (-gap + PENALTY * penalty).backward()
        self.optimiser.step()
        return float(gap.detach())
