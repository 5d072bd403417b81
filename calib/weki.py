"""`weki`: ensemble Kalman inversion on window innovations that are whitened for noise and start-state error.

No critic: the vector of all whitened innovations itself is regressed on. Short windows come first, because
over a long one the unstable pole makes the prediction of a wrong simulator meaningless; long ones then hold
the information.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.calib.coordinates import Coordinates, logistic, logit
from deal_hw.calib.ensemble_kalman import EnsembleKalman
from deal_hw.calib.innovations import cut, explained, is_noisy, whitened_residual
from deal_hw.calib.outcome import Run
from deal_hw.calib.problem import Problem
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class WekiSettings:
    """Settings of `weki`.

    Attributes:
        noisy_ticks: Window lengths of the stages in control periods, where positions carry noise.
        clean_ticks: The same where they carry none.
        step_clip: Largest step of a coordinate, in logits.
        widen: Least spread of a coordinate at the start of each further stage, in logits.
        restart_chi2: A residual above this is not explained: the search starts again from the whole range.
        stage_generations: Most generations of one stage.
    """

    noisy_ticks: tuple[int, ...] = (5, 20, 20)
    clean_ticks: tuple[int, ...] = (5, 10)
    step_clip: float = 2.0
    widen: float = 0.5
    restart_chi2: float = 3.0
    stage_generations: int = 20


class Weki(CalibrationMethod[Problem]):
    """Whitened ensemble Kalman inversion.

    Args:
        settings: How to run.
    """

    name = "weki"

    def __init__(self, settings: WekiSettings | None = None) -> None:
        self.settings = settings or WekiSettings()

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
    ) -> CalibrationResult:
        """Calibrate; restarts while the residual is unexplained and the budget has generations left."""
        run = Run(self.name, problem, budget, progress)
        coordinates = Coordinates(problem)
        best: tuple[float, FloatArray] | None = None
        restarts = -1
        while len(run.trace) < budget.generations:
            restarts += 1
            chi2, z = self._search(run, coordinates, rng)
            if best is None or chi2 < best[0]:
                best = (chi2, z)
            if chi2 <= self.settings.restart_chi2:
                break
        if best is None:
            best = (float("nan"), logit(coordinates.sample(rng, budget.population)))
        chi2, z = best
        alarms = []
        if not chi2 <= self.settings.restart_chi2:
            alarms.append(
                f"the search left a residual of {chi2:.1f} times its expected variance after "
                f"{len(run.trace)} generations; "
                "allow more generations, widen the ranges, or suspect the model"
            )
        return run.result(
            coordinates,
            coordinates.members(logistic(z.mean(axis=0, keepdims=True))),
            coordinates.members(logistic(z)),
            settings=self.settings,
            chi2=chi2,
            alarms=alarms,
            extra={"restarts": restarts, "interval": "ensemble spread, uncalibrated"},
        )

    def _search(
        self, run: Run, coordinates: Coordinates, rng: np.random.Generator
    ) -> tuple[float, FloatArray]:
        problem, budget, settings = run.problem, run.budget, self.settings
        kalman = EnsembleKalman(
            logit(coordinates.sample(rng, budget.population)), rng, step_clip=settings.step_clip
        )
        lengths = settings.noisy_ticks if is_noisy(problem) else settings.clean_ticks
        for stage, ticks in enumerate(lengths):
            windows = cut(problem, ticks)
            offsets: list[FloatArray] | None = None
            if stage:
                kalman.widen(settings.widen)
                # From the second stage on the population is near enough to say better than a smoother where
                # each window began: start states are linearised anew around the last generation's most
                # probable ones.
                offsets = [np.zeros((len(d.windows), 2 * problem.joints)) for d in windows]
            for _ in range(settings.stage_generations):
                if kalman.finished or len(run.trace) >= budget.generations:
                    break
                z = kalman.ask()
                members = coordinates.members(logistic(z))
                centre = coordinates.members(logistic(z.mean(axis=0, keepdims=True)))
                step = kalman.tell(whitened_residual(problem, members, centre, windows, offsets))
                run.note(
                    f"windows of {ticks} ticks: misfit {step.misfit:.3g}, spread {step.spread:.3g}",
                    members.theta,
                    {
                        "ticks": float(ticks),
                        "misfit": step.misfit,
                        "spread": step.spread,
                        "inflation": step.inflation,
                        "tempering": kalman.tempering,
                    },
                )
        z = kalman.ask()
        centre = coordinates.members(logistic(z.mean(axis=0, keepdims=True)))
        return explained(problem, centre, lengths[-1]), z
