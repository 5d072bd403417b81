"""Errors that commands and measurements share: a sign, two joints' order, a unit, a scale, the clock.

Comparing the two channels does not show them. The model can: by gravity, coupling between joints, and how
fast masses move. So each error is undone in turn, and the model is fitted to the corrected recordings. An
error is named if the corrected recordings are predicted well on unseen motion and the original ones are not.
Many errors cannot be found: parameters or a symmetry compensate for them.
docs/explanation/calibration.md lists them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from deal_hw.calib.data.parts import measurements, samples_in
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, NEGLIGIBLE_CHI2
from deal_hw.calib.fit.refinement import Refined, at_parameters, refine
from deal_hw.calib.hypotheses.candidates import Candidate
from deal_hw.calib.hypotheses.judge import UnseenGain, needed
from deal_hw.calib.hypotheses.thresholds import CORRECTIONS_ALIKE, NOTICED_CORRECTION, WINDOW_S
from deal_hw.errors import CalibrationError, InsufficientDataError
from deal_hw.findings import Finding
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.parts import spread, stretches
from deal_hw.types import FloatArray

Kind = Literal["sign", "order", "clock", "unit", "scale"]

DEGREES = 180 / math.pi
UNITS = {"rad": (1 / DEGREES, "degrees", "deg"), "m": (1e-3, "millimetres", "mm")}
"""Factor of a value that was written in the named unit, and that unit in a column map."""


FACTOR = 2.0
"""Clocks and positions are tried this factor faster or larger, and slower or smaller [-]."""

STRETCH_S = 1.0
"""Recordings are divided into stretches of this length; every other one is predicted [s]."""

PART_S = 4.0
"""Length of data that is fitted, and that is predicted, evenly spread [s]."""

TRIED = 5
"""Number of candidates that are fitted: those that the nominal values predict best."""

ITERATIONS = 8
"""Most steps of each fit."""

FIRST_STEPS = 3
"""Step after which a fit ends that is far behind the recordings as they are. On 16 recordings with a known
error its correction had at most 0.74 times their residual after two steps."""

BEHIND = 1.5
"""Ratio of its mean squared residual to theirs above which it is far behind [-]: twice the largest above.
Wrong corrections of a real Go2 had 2.3 to 2.9, and took another ten steps each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelChange:
    """A change of all joint channels of a fixed-base robot: x of joint j becomes ``scale[j] * x[source[j]]``.

    Command and measurement change alike, so comparing them does not show it.

    Attributes:
        source: Source joint of each joint, a permutation, (J,).
        scale: Factors, (J,); efforts take the sign only.
        clock: Factor of all times [-].
    """

    source: tuple[int, ...]
    scale: tuple[float, ...]
    clock: float = 1.0

    @classmethod
    def none(cls, joints: int) -> ChannelChange:
        """Return the identity."""
        return cls(source=tuple(range(joints)), scale=(1.0,) * joints)

    def of(self, episode: SampledEpisode, actuated: Sequence[int], servos: Sequence[bool]) -> SampledEpisode:
        """Return the changed recording of a fixed-base robot; gains and limits stay.

        Only the actuated joints, (A,), exchange commands. ``servos``: which of them take positions, not
        efforts.
        """
        joints, scale = list(self.source), np.array(self.scale)
        actuators = [list(actuated).index(self.source[joint]) for joint in actuated]
        sent = np.where(servos, scale[list(actuated)], np.sign(scale[list(actuated)]))
        return dataclasses.replace(
            episode,
            step_s=self.clock * episode.step_s,
            position=scale * episode.position[:, joints],
            velocity=scale / self.clock * episode.velocity[:, joints],
            target=sent * episode.target[:, actuators],
            start_setpoint=sent * episode.start_setpoint[actuators],
        )

    def on(self, problem: Problem, episodes: Sequence[SampledEpisode]) -> Problem:
        """Return the problem of changed recordings of a fixed-base robot, with the noise scaled alike."""
        facts = problem.robot.description
        changed = [self.of(e, facts.actuated_index, facts.servos) for e in episodes]
        joints, scale = list(self.source), np.abs(self.scale)
        position, velocity = np.split(problem.noise_std, 2)
        std = np.concatenate([scale * position[joints], scale / self.clock * velocity[joints]])
        return problem.on(changed, std)


@dataclass(frozen=True, slots=True)
class SharedError:
    """An error that commands and measurements may share.

    Attributes:
        kind: Kind of error.
        joints: Affected joints; none for the clock.
        undo: The correction of the recordings.
        words: The error, such as "positions of elbow were in degrees".
        do: How to correct it.
    """

    kind: Kind
    joints: tuple[str, ...]
    undo: ChannelChange
    words: str
    do: str


@dataclass(frozen=True, slots=True)
class FoundError:
    """A shared error whose correction improves predictions decisively.

    Attributes:
        errors: The error, and those whose correction predicts as well.
        chi2: Mean squared residual over the noise variance after the correction, on unseen motion.
        before: The same of the original recordings.
        deviance: Gain in held-out deviance.
        test: The original recordings of the unseen motion.
        length: Samples of a window.
    """

    errors: tuple[SharedError, ...]
    chi2: float
    before: float
    deviance: float
    test: Problem
    length: int

    @property
    def alarm(self) -> Finding:
        """The alarm for the user."""
        words = ", or ".join(error.words for error in self.errors)
        before = f"instead of {self.before:.3g}" if np.isfinite(self.before) else "where it diverged before"
        return Finding.alarm(
            f"The recordings look as if {words}, in commands and measurements alike. After this correction, "
            f"motion that was not fitted is predicted with chi2 {self.chi2:.3g} {before}.",
            "The parameters would compensate for this error. Comparing the two channels does not show it.",
            f"{' Or: '.join(error.do for error in self.errors)} Check it at the robot.",
        )

    @property
    def candidate(self) -> Candidate:
        """It as a candidate explanation that an alarm names."""
        finite = np.isfinite(self.before) and np.isfinite(self.deviance)
        return Candidate(
            explanation=", or ".join(error.words for error in self.errors),
            judged="fit",
            outcome="named",
            deviance=self.deviance if finite else None,
            share=1 - self.chi2 / self.before if finite else None,
        )

    @property
    def withdrawn(self) -> str:
        """The message where a simulator predicts the recordings as well without the correction."""
        words = ", or ".join(error.words for error in self.errors)
        return (
            f"withdrawn: the recordings looked as if {words}. A simulator was found that predicts them as "
            "well as they are, so they are right."
        )

    def confirmed(self, theta: FloatArray, latency_s: float) -> bool:
        """Return whether an estimate predicts the original recordings no better, at a latency [s]."""
        chi2 = _predicted(self.test, theta, latency_s, self.length)
        asked = sum(1 for _ in shared_errors(self.test))
        return _decides(UnseenGain(chi2, self.chi2, _samples(self.test, self.length)), asked)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "errors": [{"kind": e.kind, "joints": list(e.joints), "words": e.words} for e in self.errors],
            "chi2": self.chi2,
            "chi2_as_recorded": self.before if np.isfinite(self.before) else None,
            "deviance": self.deviance if np.isfinite(self.deviance) else None,
        }


def shared_errors(problem: Problem) -> Iterator[SharedError]:
    """Yield the errors that a robot's recordings may have in both channels."""
    facts = problem.robot.description
    names, units, J = facts.joint_names, facts.position_units, len(facts.joint_names)
    same = ChannelChange.none(J)

    def scaled(factor: float, joints: Sequence[int]) -> ChannelChange:
        return dataclasses.replace(same, scale=tuple(factor if j in joints else 1.0 for j in range(J)))

    for j, name in enumerate(names):
        yield SharedError(
            "sign",
            (name,),
            scaled(-1.0, [j]),
            f"the sign of {name} were turned",
            f"Set sign: -1 for {name} in the column map.",
        )
    for i, j in itertools.combinations(range(J), 2):
        if units[i] == units[j] and (i in facts.actuated_index) == (j in facts.actuated_index):
            source = list(same.source)
            source[i], source[j] = j, i
            yield SharedError(
                "order",
                (names[i], names[j]),
                dataclasses.replace(same, source=tuple(source)),
                f"{names[i]} and {names[j]} were swapped",
                f"Change the columns of {names[i]} and {names[j]} in the column map.",
            )
    f = FACTOR
    for clock, words in (
        (1 / f, f"the clock were {f:g} times too fast"),
        (f, f"the clock were {f:g} times too slow"),
    ):
        undo = dataclasses.replace(same, clock=clock)
        yield SharedError("clock", (), undo, words, f"Multiply all times by {clock:g}.")
    single = [(j,) for j in range(J)]
    alike = [tuple(j for j in range(J) if units[j] == unit) for unit in units]
    for group in dict.fromkeys((*single, *alike)):
        where, of, at = _where(names, group)
        factor, unit, short = UNITS[units[group[0]]]
        yield SharedError(
            "unit",
            at,
            scaled(factor, group),
            f"{where} were in {unit}",
            f"Set unit: {short}{of} in the column map.",
        )
        yield SharedError(
            "unit",
            at,
            scaled(1 / factor, group),
            f"{where} were converted from {unit}, and had not been in {unit}",
            f"Set unit: {units[group[0]]}{of} in the column map.",
        )
    for group in dict.fromkeys((*single, tuple(range(J)))):
        where, of, at = _where(names, group)
        for scale in (1 / f, f):
            yield SharedError(
                "scale",
                at,
                scaled(scale, group),
                f"{where} were multiplied by {1 / scale:g}",
                f"Multiply commands and positions{of} by {scale:g}.",
            )


def _where(names: Sequence[str], group: Sequence[int]) -> tuple[str, str, tuple[str, ...]]:
    """Return a description of the positions, a suffix for advice, and the names of a group of joints."""
    at = tuple(names[j] for j in group)
    if len(group) == len(names) > 1:
        return "all positions", "", at
    return f"positions of {', '.join(at)}", f" for {', '.join(at)}", at


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedErrorCheck:
    """Result of the check for shared errors.

    Attributes:
        found: The error, if there is one.
        tried: Number of corrections that were fitted.
        of: Number of those worth it. The rest would have taken more steps than allowed.
    """

    found: FoundError | None = None
    tried: int = 0
    of: int = 0


def find_shared_error(
    problem: Problem,
    local: Refined | None,
    tell: Callable[[int, int], None] | None = None,
    most_steps: float = math.inf,
) -> SharedErrorCheck:
    """Find the error whose correction makes unpredictable recordings predictable.

    ``local`` is the fit of the original recordings; None where it diverged. ``tell`` is called before each
    fit, with the number of those that are done and of all. No fit begins after ``most_steps`` physics steps.
    """
    if problem.robot.base is not None or problem.noise_free or problem.efforts:
        return SharedErrorCheck()
    before = problem.steps
    parts = [s for e in problem.episodes for s in stretches(e, STRETCH_S) if s.usable.any()]
    seen, unseen = (spread(parts[k::2], PART_S) for k in (0, 1))
    length = samples_in(problem, WINDOW_S)
    same = ChannelChange.none(len(problem.robot.description.joint_names))
    if not unseen:
        return SharedErrorCheck()
    if most_steps <= 0:
        return SharedErrorCheck(of=TRIED)
    tell = tell or (lambda done, total: None)
    tell(0, 1 + TRIED)
    try:
        test = same.on(problem, unseen)
        count = _samples(test, length)
        trained, as_recorded = _fitted(problem, same, seen, unseen, length)
        if local is not None:
            as_recorded = min(as_recorded, _predicted(test, local.theta, local.latency_s, length))
    except InsufficientDataError:
        return SharedErrorCheck()
    ranked = sorted(shared_errors(problem), key=lambda e: _screened(problem, e.undo, seen, length))
    found: dict[SharedError, float] = {}
    for error in ranked[:TRIED]:
        if problem.steps - before >= most_steps:
            break
        tell(1 + len(found), 1 + TRIED)
        hopeless = BEHIND * trained
        found[error] = _fitted(problem, error.undo, seen, unseen, length, hopeless)[1]
    check = SharedErrorCheck(tried=len(found), of=min(len(ranked), TRIED))
    best = min(found, key=lambda e: found[e], default=None)
    if best is None:
        return check
    gained = UnseenGain(as_recorded, found[best], count)
    if not _decides(gained, len(ranked)):
        return check
    alike = sorted((e for e in found if found[e] <= CORRECTIONS_ALIKE * found[best]), key=lambda e: found[e])
    error_found = FoundError(tuple(alike), found[best], as_recorded, gained.deviance, test, length)
    return dataclasses.replace(check, found=error_found)


def _decides(gained: UnseenGain, asked: int) -> bool:
    """Return whether the prediction improves so much that the best of the corrections asked is named.

    Only noise may remain: from a fit that explains neither, no cause can be named. Residuals far below the
    noise need no explanation.
    """
    if gained.before <= NEGLIGIBLE_CHI2 or not gained.after <= MISMATCH_CHI2:
        return False
    if not gained.share > NOTICED_CORRECTION:
        return False
    return not np.isfinite(gained.before) or gained.deviance >= needed(asked)


def _samples(test: Problem, length: int) -> int:
    return measurements(test.windows(length))


def _screened(
    problem: Problem, change: ChannelChange, episodes: Sequence[SampledEpisode], length: int
) -> float:
    """Return the nominal values' median prediction error on changed recordings."""
    try:
        changed = change.on(problem, episodes)
        every = []
        for data in changed.windows(length):
            nominal, latency_s = problem.space.nominal[None], np.array([problem.first_latency_s])
            predicted = changed.predict(nominal, latency_s, data).observed[0]
            every.append(np.abs(predicted - data.measured).ravel() / data.std.ravel())
    except InsufficientDataError:
        return math.inf
    return float(np.median(np.nan_to_num(np.concatenate(every), nan=np.inf)))


def _fitted(
    problem: Problem,
    change: ChannelChange,
    seen: Sequence[SampledEpisode],
    unseen: Sequence[SampledEpisode],
    length: int,
    hopeless: float = math.inf,
) -> tuple[float, float]:
    """Return the chi2 of a fit to changed recordings, on fitted and on held-out ones.

    It is infinite where simulations diverge, and for a fit above ``hopeless`` after its first steps.
    """
    steps = itertools.count(1)

    def check(fit: Refined) -> None:
        if next(steps) == FIRST_STEPS and fit.chi2 > hopeless:
            raise CalibrationError("the correction explains the recordings worse than they are")

    try:
        train = change.on(problem, seen)
        window_s = length * train.period_s
        fit = refine(
            train,
            problem.space.nominal,
            problem.first_latency_s,
            (window_s,),
            iterations=ITERATIONS,
            notify_step=check,
        )
        held_out = change.on(problem, unseen)
        return fit.chi2, _predicted(held_out, fit.theta, fit.latency_s, length)
    except (InsufficientDataError, CalibrationError):
        return math.inf, math.inf


def _predicted(test: Problem, theta: FloatArray, latency_s: float, length: int) -> float:
    """Return the chi2 of predictions; infinite where they diverge."""
    chi2 = at_parameters(test, theta, latency_s, length).chi2
    return chi2 if np.isfinite(chi2) else math.inf
