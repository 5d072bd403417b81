"""`eki`: ensemble Kalman inversion on window innovations that are whitened for noise and start-state error.

No critic: the vector of all whitened innovations itself is regressed on. Short windows come first, because
over a long one the unstable pole makes the prediction of a wrong simulator meaningless; long ones then hold
the information.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.data.innovations import cut, explained, is_noisy, whitened_residual
from deal_hw.calib.search.base import Search, SearchLog
from deal_hw.calib.search.ensemble_kalman import KalmanStepper
from deal_hw.calib.search.resume import State
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class EkiSettings:
    """Settings of `eki`.

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


class _Eki(KalmanStepper):
    """A run of `eki`: searches, each of several stages, each of several generations."""

    KEPT = ("kalman", "_restarts", "_best", "_over", "_stage", "_generation", "_offsets")

    settings: EkiSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        problem, settings = self.problem, self.settings
        self._lengths = settings.noisy_ticks if is_noisy(problem) else settings.clean_ticks
        self._brief = settings.before_polish and (problem.robot.base is not None or problem.exact)
        if self._brief:
            self._lengths = self._lengths[:1]
        self._near = False
        self._restarts = 0
        self._best: tuple[float, FloatArray] | None = None
        self._over = log.budget.generations <= 0
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
        residual = whitened_residual(self.problem, members, centre, self._windows, self._offsets)
        step = self.kalman.tell(residual)
        self._generation += 1
        self._near = self._brief and self.problem.exact and step.spread < self.settings.least_spread
        ticks = self._lengths[self._stage]
        self.log.note(
            f"windows of {ticks} ticks: misfit {step.misfit:.3g}, spread {step.spread:.3g}",
            members,
            {
                "ticks": float(ticks),
                "misfit": step.misfit,
                "spread": step.spread,
                "inflation": step.inflation,
                "tempering": self.kalman.tempering,
            },
        )
        while self._stage_over and not self._over:
            if self._stage + 1 < len(self._lengths):
                self._enter_stage(self._stage + 1)
            else:
                self._end_search()

    def result(self) -> CalibrationResult:
        chi2, z = self._best or (float("nan"), self.kalman.ask())
        alarms = []
        if not chi2 <= self.settings.restart_chi2 and not self._brief:
            alarms.append(self.log.unexplained(chi2))
        members, centre = self.population(z)
        return self.log.result(
            centre,
            members,
            chi2=chi2,
            alarms=alarms,
            extra={"restarts": self._restarts, "interval": "ensemble spread, uncalibrated"},
        )

    def load(self, state: State) -> None:
        self._enter_stage(state["_stage"])
        super().load(state)

    @property
    def _stage_over(self) -> bool:
        return (
            self.kalman.finished
            or self._near
            or self._generation >= self.settings.stage_generations
            or len(self.log.trace) >= self.log.budget.generations
        )

    def _enter_stage(self, stage: int) -> None:
        self._stage, self._generation = stage, 0
        self._windows = cut(self.problem, self._lengths[stage])
        self._offsets = None
        if stage:
            self.kalman.widen(self.settings.widen)
            # From the second stage on the population is near enough to say better than a smoother where each
            # window began: start states are linearised anew around the last generation's most probable ones.
            self._offsets = [np.zeros((len(d.windows), 2 * d.start_position.shape[1])) for d in self._windows]

    def _end_search(self) -> None:
        z = self.kalman.ask()
        chi2 = explained(self.problem, self.population(z)[1], self._lengths[-1])
        if self._best is None or chi2 < self._best[0]:
            self._best = (chi2, z)
        spent = len(self.log.trace) >= self.log.budget.generations
        if self._brief or spent or chi2 <= self.settings.restart_chi2:
            self._over = True
            return
        self._restarts += 1
        self.kalman = self.new_ensemble()
        self._enter_stage(0)


@dataclass(frozen=True)
class Eki(Search):
    """Whitened ensemble Kalman inversion; restarts while the residual is unexplained and the budget lasts."""

    name = "eki"
    stepper = _Eki
    settings: EkiSettings = field(default_factory=EkiSettings)
