"""Networks with a memory, as other trainers export them.

TorchScript reads annotations of types, so they are no text here.
"""

import torch


class Recurrent(torch.nn.Module):
    """An LSTM in the form of legged_gym's exporter, for an observation of unitree_rl_gym."""

    hidden_state: torch.Tensor
    cell_state: torch.Tensor

    def __init__(self, layers: int, observations: int = 47, actions: int = 12) -> None:
        super().__init__()
        self.memory = torch.nn.LSTM(observations, 16, layers)
        self.actor = torch.nn.Sequential(torch.nn.Linear(16, 8), torch.nn.ELU(), torch.nn.Linear(8, actions))
        self.register_buffer("hidden_state", torch.zeros(layers, 1, 16))
        self.register_buffer("cell_state", torch.zeros(layers, 1, 16))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Step."""
        out, (h, c) = self.memory(x.unsqueeze(0), (self.hidden_state, self.cell_state))
        self.hidden_state[:] = h
        self.cell_state[:] = c
        return self.actor(out.squeeze(0))  # type: ignore[no-any-return]

    @torch.jit.export
    def reset_memory(self) -> None:
        """Clear."""
        self.hidden_state[:] = 0.0
        self.cell_state[:] = 0.0


class Rolling(torch.nn.Module):
    """A history inside the network."""

    past: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.last = torch.nn.Linear(2 * 47, 12)
        self.register_buffer("past", torch.zeros(1, 47))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Step."""
        y = self.last(torch.cat([x, self.past], dim=1))
        self.past[:] = x
        return y  # type: ignore[no-any-return]


class Gated(torch.nn.Module):
    """A GRU."""

    def __init__(self) -> None:
        super().__init__()
        self.memory = torch.nn.GRU(47, 12)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Step."""
        return self.memory(x.unsqueeze(0))[0].squeeze(0)  # type: ignore[no-any-return]


class Normaliser(torch.nn.Module):
    """rsl_rl's normaliser of observations."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.randn(size))
        self.register_buffer("std", torch.rand(size) + 0.5)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalise."""
        return (x - self.mean) / (self.std + 1e-2)


class IsaacRecurrent(torch.nn.Module):
    """An LSTM in the form of Isaac Lab's exporter: named rnn, behind a normaliser."""

    hidden_state: torch.Tensor
    cell_state: torch.Tensor

    def __init__(self, layers: int) -> None:
        super().__init__()
        self.normalizer = Normaliser(47)
        self.rnn = torch.nn.LSTM(47, 16, layers)
        self.actor = torch.nn.Sequential(torch.nn.Linear(16, 12))
        self.register_buffer("hidden_state", torch.zeros(layers, 1, 16))
        self.register_buffer("cell_state", torch.zeros(layers, 1, 16))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Step."""
        x = self.normalizer(x)
        x, (h, c) = self.rnn(x.unsqueeze(0), (self.hidden_state, self.cell_state))
        self.hidden_state[:] = h
        self.cell_state[:] = c
        return self.actor(x.squeeze(0))  # type: ignore[no-any-return]

    @torch.jit.export
    def reset_memory(self) -> None:
        """Clear."""
        self.hidden_state[:] = 0.0
        self.cell_state[:] = 0.0


class Endless(torch.nn.Module):
    """Loops for ever."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Step."""
        for _ in range(1_000_000_000_000):
            x = torch.tanh(x)
        return x


class Greedy(torch.nn.Module):
    """An LSTM by its names, that takes 64 GB."""

    hidden_state: torch.Tensor
    cell_state: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.memory = torch.nn.LSTM(47, 16)
        self.actor = torch.nn.Sequential(torch.nn.Linear(16, 12))
        self.register_buffer("hidden_state", torch.zeros(1, 1, 16))
        self.register_buffer("cell_state", torch.zeros(1, 1, 16))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Step."""
        return torch.ones(16_000_000_000)[:12].unsqueeze(0) + x.sum()


class Writing(Greedy):
    """An LSTM by its names, that writes a file."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self.path = path

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Step."""
        made = torch.from_file(self.path, True, 12)
        return made.unsqueeze(0) + x.sum()


class Layers(torch.nn.Module):
    """Each layer and operation that is known, one after another."""

    def __init__(self) -> None:
        super().__init__()
        n = torch.nn
        self.normalizer = Normaliser(47)
        self.norm = n.LayerNorm(12)
        self.parts = n.Sequential(
            *(n.Linear(47, 24), n.ELU(), n.Linear(24, 24), n.ReLU(), n.Linear(24, 24, bias=False), n.Tanh()),
            *(n.Linear(24, 24), n.SELU(), n.Linear(24, 24), n.SiLU(), n.Linear(24, 24), n.GELU()),
            *(
                n.Linear(24, 24),
                n.LeakyReLU(0.1),
                n.Linear(24, 24),
                n.Softplus(),
                n.Linear(24, 24),
                n.Sigmoid(),
            ),
            *(n.Dropout(0.5), n.Identity(), n.Linear(24, 12), n.Hardtanh(-0.7, 0.9)),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Step."""
        y = self.parts(self.normalizer(torch.clamp(x, -5.0, 5.0)))
        return torch.clip(2.0 * self.norm(y) - y / 3.0, min=-0.8)
