"""Networks with a memory, as other trainers export them.

TorchScript reads annotations of types, so they are no text here.
"""

import torch


class Recurrent(torch.nn.Module):
    """An LSTM in the form of legged_gym's exporter, for an observation of unitree_rl_gym."""

    hidden_state: torch.Tensor
    cell_state: torch.Tensor

    def __init__(self, layers: int) -> None:
        super().__init__()
        self.memory = torch.nn.LSTM(47, 16, layers)
        self.actor = torch.nn.Sequential(torch.nn.Linear(16, 8), torch.nn.ELU(), torch.nn.Linear(8, 12))
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
