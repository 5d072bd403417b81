"""`weki`: ensemble Kalman inversion on window innovations that are whitened for noise and start-state error.

No critic: the vector of all whitened innovations itself is regressed on. Short windows come first, because
over a long one the unstable pole makes the prediction of a wrong simulator meaningless; long ones then hold
the information.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.innovations import cut, explained, is_noisy, whitened_residual
from deal_hw.calib.search.base import Search, Stepper
from deal_hw.calib.search.checkpoint import State
from deal_hw.calib.search.kalman_search import KalmanStepper
from deal_hw.calib.search.log import Run
from deal_hw.calibration import CalibrationResult
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
        before_polish: Whether a polish follows. On robots with a free base, and where states are exact, the
            short windows of the first stage then are enough: the polish starts from there, and long windows
            of contacts say little to a population.
        least_spread: Spread in logits at which that stage ends on exact states.
    """

    noisy_ticks: tuple[int, ...] = (5, 20, 20)
    clean_ticks: tuple[int, ...] = (5, 10)
    step_clip: float = 2.0
    widen: float = 0.5
    restart_chi2: float = 3.0
    stage_generations: int = 20
    before_polish: bool = False
    least_spread: float = 0.01


@dataclass(frozen=True)
class Weki(Search):
    """Whitened ensemble Kalman inversion; restarts while the residual is unexplained and the budget lasts.

    Attributes:
        settings: How to run.
    """

    name = "weki"
    settings: WekiSettings = field(default_factory=WekiSettings)

    def begin(self, run: Run, rng: np.random.Generator) -> Stepper:
        """See :meth:`Search.begin`."""
        return _Weki(run, rng, self.settings)


class _Weki(KalmanStepper):
    """A run of `weki`: searches, each of several stages, each of several generations."""

    def __init__(self, run: Run, rng: np.random.Generator, settings: WekiSettings) -> None:
        super().__init__(run, rng, settings.step_clip)
        self._settings = settings
        problem = run.problem
        self._lengths = settings.noisy_ticks if is_noisy(problem) else settings.clean_ticks
        self._brief = settings.before_polish and (problem.robot.base is not None or problem.exact)
        if self._brief:
            self._lengths = self._lengths[:1]
        self._near = False
        self._restarts = 0
        self._best: tuple[float, FloatArray] | None = None
        self._over = run.budget.generations <= 0
        self._offsets: list[FloatArray] | None = None
        self._enter_stage(0)

    @property
    def finished(self) -> bool:
        """Whether a search has explained the recording, or the budget is used up."""
        return self._over

    def step(self) -> None:
        """One Kalman step; at the end of a stage or search also the beginning of the next."""
        z = self.kalman.ask()
        members, centre = self.population(z)
        problem = self.run.problem
        step = self.kalman.tell(whitened_residual(problem, members, centre, self._windows, self._offsets))
        self._generation += 1
        self._near = self._brief and problem.exact and step.spread < self._settings.least_spread
        ticks = self._lengths[self._stage]
        self.run.note(
            f"windows of {ticks} ticks: misfit {step.misfit:.3g}, spread {step.spread:.3g}",
            members.theta,
            {
                "ticks": float(ticks),
                "misfit": step.misfit,
                "spread": step.spread,
                "inflation": step.inflation,
                "tempering": self.kalman.tempering,
            },
            members.latency_s,
        )
        while self._stage_over and not self._over:
            if self._stage + 1 < len(self._lengths):
                self._enter_stage(self._stage + 1)
            else:
                self._end_search()

    def result(self) -> CalibrationResult:
        """See :meth:`Stepper.result`."""
        chi2, z = self._best or (float("nan"), self.kalman.ask())
        alarms = []
        if not chi2 <= self._settings.restart_chi2 and not self._brief:
            alarms.append(self.run.unexplained(chi2))
        members, centre = self.population(z)
        return self.run.result(
            self.coordinates,
            centre,
            members,
            settings=self._settings,
            chi2=chi2,
            alarms=alarms,
            extra={"restarts": self._restarts, "interval": "ensemble spread, uncalibrated"},
        )

    def save(self) -> dict[str, Any]:
        """See :meth:`Stepper.save`."""
        return {
            "kalman": self.kalman.save(),
            "restarts": self._restarts,
            "best": self._best,
            "over": self._over,
            "stage": self._stage,
            "generation": self._generation,
            "offsets": self._offsets,
        }

    def load(self, state: State) -> None:
        """See :meth:`Stepper.load`."""
        self._enter_stage(state["stage"])
        self.kalman.load(state["kalman"])
        self._restarts, self._over = state["restarts"], state["over"]
        self._best = None if state["best"] is None else (state["best"][0], state["best"][1])
        self._generation, self._offsets = state["generation"], state["offsets"]

    @property
    def _stage_over(self) -> bool:
        return (
            self.kalman.finished
            or self._near
            or self._generation >= self._settings.stage_generations
            or len(self.run.trace) >= self.run.budget.generations
        )

    def _enter_stage(self, stage: int) -> None:
        self._stage, self._generation = stage, 0
        self._windows = cut(self.run.problem, self._lengths[stage])
        self._offsets = None
        if stage:
            self.kalman.widen(self._settings.widen)
            # From the second stage on the population is near enough to say better than a smoother where each
            # window began: start states are linearised anew around the last generation's most probable ones.
            self._offsets = [np.zeros((len(d.windows), 2 * d.start_position.shape[1])) for d in self._windows]

    def _end_search(self) -> None:
        z = self.kalman.ask()
        chi2 = explained(self.run.problem, self.population(z)[1], self._lengths[-1])
        if self._best is None or chi2 < self._best[0]:
            self._best = (chi2, z)
        spent = len(self.run.trace) >= self.run.budget.generations
        if self._brief or spent or chi2 <= self._settings.restart_chi2:
            self._over = True
            return
        self._restarts += 1
        self.kalman = self.new_ensemble()
        self._enter_stage(0)
