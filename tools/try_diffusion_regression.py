#!/usr/bin/env python3
"""Test `deal` with a diffusion step in place of its Kalman step.

    python tools/try_diffusion_regression.py --seeds 0-4 --out diffusion_regression.json

The paper estimates theta_0 (eq. 1) by an average over neighbours, weighted by one number for each member.
Here it is the posterior mean of a linear-Gaussian regression on the critic's features, as in `deal`. Then
follow the paper's eqs. 2 and 3: re-noising with alpha_t and sigma_t. The search is that of `bench
fixed-range`, not refined; ``kalman`` is `deal` itself. A row has 100 times the mean absolute ln(p / p*).
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np
from measuring import Rows, add_seeds, parser

from deal_hw.bench.calibration import make_cells, run_cell
from deal_hw.bench.settings import FixedRange
from deal_hw.calib.paper.critic import PenaltyCritic, Samples
from deal_hw.calib.paper.diffusion_evolution import Schedule, alpha_schedule
from deal_hw.calib.search.eki import EnsembleKalman, KalmanStep, KalmanStepper, logit
from deal_hw.on_use import OnUse
from deal_hw.types import FloatArray

if TYPE_CHECKING:
    import torch
else:
    torch = OnUse("torch", "torch", "calib")

GENERATIONS = 50


@dataclass(frozen=True, slots=True)
class Step:
    """A diffusion step.

    Attributes:
        keep: Share of the residual that the regression leaves; less is a longer step.
        eta: sigma_t in units of the full DDPM noise; 0 is deterministic.
        schedule: How alpha_t falls.
        common: Whether all members share the mean of their estimates.
        adapt: Whether eq. 9 scales sigma_t by the critic's mean output on the members, with lambda = 1.
    """

    keep: float
    eta: float
    schedule: Schedule = "cosine"
    common: bool = False
    adapt: bool = False


STEPS: dict[str, Step | None] = {
    "kalman": None,
    "0.25, eta 0": Step(0.25, 0.0),
    "0.25, eta 0.3": Step(0.25, 0.3),
    "0.25, eta 1": Step(0.25, 1.0),
    "0.1, eta 1": Step(0.1, 1.0),
    "0.05, eta 0": Step(0.05, 0.0),
    "0.05, eta 1": Step(0.05, 1.0),
    "0.02, eta 1": Step(0.02, 1.0),
    "0.005, eta 1": Step(0.005, 1.0),
    "0.02, eta 1, linear": Step(0.02, 1.0, "linear"),
    "0.02, eta 1, common": Step(0.02, 1.0, common=True),
    "0.05, eta 1, eq. 9": Step(0.05, 1.0, adapt=True),
}
"""Steps by name: the share that is kept, sigma, and what else differs."""


class Still(np.random.Generator):
    """A generator whose normal numbers are zero: a Kalman step without perturbed observations."""

    def standard_normal(self, *shape: Any, **options: Any) -> Any:
        """Return zeros."""
        return np.zeros(shape[0])


class Diffusion(EnsembleKalman):
    """Members that are denoised towards their posterior means, and noised again.

    ``outputs`` gets the critic's mean output on the members before each step; eq. 9 reads the last one.
    """

    def __init__(
        self,
        ensemble: FloatArray,
        rng: np.random.Generator,
        step_clip: float,
        step: Step,
        outputs: Sequence[float] = (0.0,),
    ) -> None:
        super().__init__(ensemble, Still(rng.bit_generator), step_clip)
        self._noise, self._step, self._outputs = rng, step, outputs
        self._centre, self._scale = ensemble.mean(axis=0), ensemble.std(axis=0, ddof=1)
        self._alpha = alpha_schedule(GENERATIONS, step.schedule)
        self._t = GENERATIONS
        self.deltas: list[float] = []

    @property
    def finished(self) -> bool:
        """Whether theta^0 has been reached."""
        return self._t == 0

    def tell(self, residual: FloatArray, keep: float | None = None) -> KalmanStep:
        """Take the step t -> t - 1; see :class:`EnsembleKalman`."""
        residual = self._replace_diverged(residual)
        theta = (self.ask() - self._centre) / self._scale
        done = super().tell(residual, self._step.keep)
        # Eq. 1 with the regression's posterior mean in place of the neighbours' average.
        estimate = (self.ask() - self._centre) / self._scale
        if self._step.common:
            estimate = np.broadcast_to(estimate.mean(axis=0), estimate.shape)
        alpha, later = self._alpha[self._t], self._alpha[self._t - 1]
        noise = (theta - np.sqrt(alpha) * estimate) / np.sqrt(1 - alpha)  # eq. 2
        full = np.sqrt((1 - later) / (1 - alpha)) * np.sqrt(max(1 - alpha / later, 0.0))
        sigma = self._step.eta * full
        if self._step.adapt:
            # Eq. 9, cut to what eq. 10 can hold.
            delta = float(np.exp(np.clip(-self._outputs[-1], -50.0, 50.0)))
            sigma = min(delta * sigma, np.sqrt(1 - later))
            self.deltas.append(delta)
        theta = np.sqrt(later) * estimate + np.sqrt(max(1 - later - sigma**2, 0.0)) * noise  # eq. 3
        theta += sigma * self._noise.standard_normal(theta.shape)
        self._members = self._centre + self._scale * theta
        self._t -= 1
        return KalmanStep(done.inflation, done.misfit, float(self._members.std(axis=0, ddof=1).mean()))


def measure(name: str, seed: int, ratio: float) -> dict[str, Any]:
    """Search one cart-pole with a step by its name in :data:`STEPS`."""
    usual, statistics, step = KalmanStepper.new_ensemble, PenaltyCritic.statistics, STEPS[name]
    ensembles: list[Diffusion] = []
    outputs: list[float] = []

    def draw(stepper: KalmanStepper) -> EnsembleKalman:
        if step is None:
            return usual(stepper)
        unit = stepper.coordinates.sample(stepper.rng, stepper.log.budget.population)
        ensembles.append(Diffusion(logit(unit), stepper.rng, stepper.settings.step_clip, step, outputs))
        return ensembles[-1]

    def received(critic: PenaltyCritic, samples: Samples) -> FloatArray:
        found = statistics(critic, samples)
        if len(samples) > 1:  # members, not the recording
            outputs.append(float(np.nanmean(found[:, -1])))
        return found

    asked = FixedRange(profile="ideal", methods=("deal",), range_ratio=(ratio,), seeds=(seed,))
    (cell,) = make_cells(asked)
    start_s = time.process_time()
    with (
        mock.patch.object(KalmanStepper, "new_ensemble", draw),
        mock.patch.object(PenaltyCritic, "statistics", received),
    ):
        row = run_cell(cell, population=100, generations=GENERATIONS, threads=1)
    kept = ("error", "log_error_x100", "heldout_nrmse_nominal", "heldout_nrmse_calibrated")
    named = {key: row.get(key) for key in kept}
    deltas = [delta for ensemble in ensembles for delta in ensemble.deltas]
    if deltas:
        named["delta"] = [min(deltas), float(np.median(deltas)), max(deltas)]
    return {"step": name, "seed": seed, "range_ratio": ratio, **named, "cpu_s": time.process_time() - start_s}


def main() -> int:
    """Search each robot with each step, and print the rows."""
    options = parser(__doc__)
    add_seeds(options, 0)
    options.add_argument("--steps", nargs="+", choices=STEPS, default=list(STEPS), metavar="STEP")
    options.add_argument("--range-ratio", type=float, default=5.0)
    given = options.parse_args()
    torch.set_num_threads(1)
    rows = Rows(__file__, given.out)
    for seed, name in itertools.product(given.seeds, given.steps):
        row = measure(name, seed, given.range_ratio)
        error = row["error"] or format(row["log_error_x100"], ".3g")
        rows.add(row, f"{name}, seed {seed}: {error}", table=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
