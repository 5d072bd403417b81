"""What `weki` and `deal` share: an ensemble in logits of the search range, moved by Kalman steps."""

from __future__ import annotations

import numpy as np

from deal_hw.calib.data.coordinates import Coordinates, Members, logistic, logit
from deal_hw.calib.search.base import Stepper
from deal_hw.calib.search.ensemble_kalman import EnsembleKalman
from deal_hw.calib.search.log import Run
from deal_hw.types import FloatArray


class KalmanStepper(Stepper):
    """A run whose population is an ensemble Kalman inversion's, in logits.

    Args:
        run: The run's book-keeping.
        rng: Draws the ensemble and the perturbations.
        step_clip: Largest step of a coordinate, in logits.
    """

    def __init__(self, run: Run, rng: np.random.Generator, step_clip: float) -> None:
        self.run, self.rng = run, rng
        self.coordinates = Coordinates(run.problem)
        self._step_clip = step_clip
        self.kalman = self.new_ensemble()

    def new_ensemble(self) -> EnsembleKalman:
        """Return an ensemble drawn over the whole range."""
        unit = self.coordinates.sample(self.rng, self.run.budget.population)
        return EnsembleKalman(logit(unit), self.rng, step_clip=self._step_clip)

    def population(self, z: FloatArray) -> tuple[Members, Members]:
        """Return the members at logits z, (N, C), and the one at their mean."""
        middle = logistic(z.mean(axis=0, keepdims=True))
        return self.coordinates.members(logistic(z)), self.coordinates.members(middle)
