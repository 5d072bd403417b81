"""The emulator that ``deal-hw emulate bench_cartpole`` runs."""

from __future__ import annotations

import dataclasses

from deal_hw.robots.emulation import Emulation, EmulatorRequest, on_pseudo_terminal
from deal_hw_bench_cartpole.device import Device, Truth, draw_truth, truth_from


def emulator(request: EmulatorRequest) -> Emulation:
    """Return the emulated robot on a pseudo-terminal, not opened."""
    if request.truth is not None:
        truth = truth_from(request.truth)
    elif request.nominal:
        truth = Truth(noise=request.profile != "ideal", seed=request.seed)
    else:
        truth = draw_truth(request.profile, request.seed, request.range_ratio or 2.0)
    return on_pseudo_terminal(Device(truth), request, dataclasses.asdict(truth))
