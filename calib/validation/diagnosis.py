"""What an unexplained residual looks like, and what to free or mend next.

Each cause of a wrong model leaves a signature: a disturbance that a motion alone determines, such as a force
against the velocity at low speed. Its effect on the predictions is the convolution of the disturbance with
the windows' own response to a kick at their start, which the refinement has computed. What parameters and
start states could explain of it is projected out, and the residual is regressed on what is left. A cause's
effect is the share of the residual's excess over noise that it explains beyond what as many random columns
would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.signal import fftconvolve
from scipy.stats import chi2 as chi2_law

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.uncertainty.cluster_robust import eliminated, without_starts
from deal_hw.calibration import Alarm
from deal_hw.types import FloatArray

Cause = Literal["friction", "backlash", "delay", "damping", "inertia", "load", "contact"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosisSettings:
    """Settings of :func:`diagnose`.

    Attributes:
        noticed: A cause that explains less than this share of the excess is not named [-].
        by_chance: Nor is one that random columns would match with this probability [-].
        low_speeds: Speeds, as parts of a joint's rms speed, within which friction's excess at low speed falls
            to 1/e [-].
        play_s: After a reversal a gear with play does not drive for about so long [s].
        delay_piece_s: A varying delay is taken as constant for so long [s].
        burst_part: Bursts are where so small a part of the time
        burst_share: holds so much of the residual, [-] both,
        burst_kurtosis: and its kurtosis is that high (noise: 3).
        burst_size: A burst's squared residual over the median's [-].
        certain: Standard errors by which the residual must exceed noise before anything is said of it.
        still: Part of the rms speed below which a velocity has no direction [-].
    """

    noticed: float = 0.03
    by_chance: float = 1e-3
    low_speeds: tuple[float, ...] = (0.1, 0.4)
    play_s: float = 0.03
    delay_piece_s: float = 0.1
    burst_part: float = 0.05
    burst_share: float = 0.4
    burst_kurtosis: float = 8.0
    burst_size: float = 40.0
    certain: float = 4.0
    still: float = 1e-3


SETTINGS = DiagnosisSettings()

LOOKS: Mapping[Cause, tuple[str, str, str]] = {
    "friction": (
        "a force against slow motion",
        "Friction depends on speed (Stribeck), or creeps where it should hold.",
        "Free dof_friction_creep, dof_frictionloss and dof_damping of {}.",
    ),
    "backlash": (
        "an offset at each reversal",
        "There is play in the gear.",
        "Mend the gear of {}, or accept an error of that size.",
    ),
    "delay": (
        "a timing error that changes",
        "The delay of commands or sensors varies; the model's is constant.",
        "Mend the link, or measure the law of its delay; look at {} first.",
    ),
    "damping": (
        "a force that grows with speed",
        "Damping was not free, or follows another law (the square of speed).",
        "Free dof_damping or servo_damping of {}; if they are free, doubt the law.",
    ),
    "inertia": (
        "a force in proportion to acceleration",
        "An inertia or a gain was not free, or its range is too narrow.",
        "Free dof_armature, body_mass or the actuator's gain of {}.",
    ),
    "load": (
        "a constant force",
        "A mass, its centre or an encoder's zero was not free.",
        "Free encoder_bias, body_mass or body_ipos of {}.",
    ),
    "contact": (
        "bursts",
        "The robot touches something that the model does not have.",
        "Leave out {}.",
    ),
}
"""What each cause looks like, what it means, and what to do about it, {} being where."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One cause that the residual looks like.

    Attributes:
        cause: Which.
        share: Share of the residual's excess over noise that it explains.
        joints: Joints that show it most, most first.
        alarm: For people.
    """

    cause: Cause
    share: float
    joints: tuple[str, ...]
    alarm: Alarm


def _named(cause: Cause, share: float, joints: tuple[str, ...], where: str) -> Finding:
    looks, means, do = LOOKS[cause]
    seen = f"{100 * share:.0f} % of what is unexplained looks like {looks}: {cause}."
    return Finding(cause, share, joints, Alarm(seen, means, do.replace("{}", where)))


@dataclass(frozen=True, slots=True)
class Motion:
    """One episode's windows: how the joints moved and what a disturbance does.

    Attributes:
        rows: Linearised residuals.
        velocity: Of the joints at the predicted samples, (W, H, J).
        response: Whitened channels by a unit of joint velocity at the window's start, (W, H, M, J).
        direct: Whitened channels by a unit of joint position at the same sample, (W, H, M, J).
        period_s: Time from sample to sample [s].
        time_s: Time of each sample in its recording, (W, H) [s].
    """

    rows: WindowRows
    velocity: FloatArray
    response: FloatArray
    direct: FloatArray
    period_s: float
    time_s: FloatArray


def motions(problem: Problem, refined: Refined) -> list[Motion]:
    """Return how the joints moved in the refinement's windows.

    Args:
        problem: The problem.
        refined: Where the refinement ended, with linearised residuals.
    """
    C, joints, channels = problem.coordinates, problem.robot.joints, problem.channels
    states = refined.shooting.states(refined.point)
    own = np.zeros((len(channels), C))
    at = channels < C
    own[at, channels[at]] = 1.0
    found = []
    for data, rows in zip(refined.shooting.data, refined.normal.rows, strict=True):
        samples = data.windows.samples()
        W, H = samples.shape
        episode = problem.episodes[data.episode]
        direct = own[:, joints] / data.std[..., None]
        if rows.start.shape[2]:
            kick = rows.start[:, : H * len(channels)].reshape(W, H, len(channels), 2 * C)
            response = kick[..., C:][..., joints]
        else:
            # Where start states are known no response was computed: a free joint moves on.
            response = direct * (episode.period_s * np.arange(1, H + 1))[:, None, None]
        found.append(
            Motion(
                rows=rows,
                velocity=states[data.episode][1][samples][..., joints],
                response=response,
                direct=direct,
                period_s=episode.period_s,
                time_s=np.asarray(episode.sample[samples] * episode.step_s, dtype=np.float64),
            )
        )
    return found


def diagnose(
    found: Sequence[Motion], hessian: FloatArray, joint_names: Sequence[str], correlation_samples: float = 1.0
) -> tuple[Finding, ...]:
    """Regress the residual on each cause's signature; most telling first.

    Args:
        found: How the joints moved, with linearised residuals.
        hessian: Normal matrix of parameters and latency; fixed ones have zero rows and columns, (P, P).
        joint_names: Names of the joints.
        correlation_samples: Autocorrelation time of the residuals: random columns explain the more.
    """
    gain = np.asarray(np.linalg.pinv(hessian, rcond=1e-12, hermitian=True), dtype=np.float64)
    moved = np.concatenate([m.velocity.reshape(-1, m.velocity.shape[2]) for m in found])
    scale = np.asarray(np.sqrt(np.mean(moved**2, axis=0)), dtype=np.float64)
    left = _Left.of(found, gain)
    count = sum(_count(m) for m in found)
    # What white noise leaves is not to be explained; neither is what is not certain to be more.
    excess = max(left.total - count, (1.0 - 1.0 / correlation_samples) * left.total)
    if excess < SETTINGS.certain * np.sqrt(2.0 * correlation_samples * count):
        return ()
    chance = max(left.total / count, 1.0) * correlation_samples
    results: list[Finding] = []
    for cause, make in _SIGNATURES.items():
        columns = [make(m, scale) for m in found]
        explained, each, used = _explained(left, columns, gain)
        results.append(_finding(cause, explained, used, chance, excess, each, joint_names))
    explained, used = _varying_delay(left)
    results.append(_finding("delay", explained, used, chance, excess, scale, joint_names))
    bursts = _bursts(found)
    if bursts:
        results.append(_named("contact", bursts[0], (), bursts[1]))
    told = [f for f in results if f.share >= SETTINGS.noticed]
    return tuple(sorted(told, key=lambda f: -f.share))


def _count(motion: Motion) -> int:
    """Return the degrees of freedom of a motion's residuals."""
    W, R, S = motion.rows.start.shape
    weighed = int(np.count_nonzero(np.any(motion.rows.start != 0, axis=2))) if S else W * R
    return int(max(weighed - W * S, 1))


def _finding(
    cause: Cause,
    explained: float,
    used: int,
    chance: float,
    excess: float,
    each: FloatArray,
    names: Sequence[str],
) -> Finding:
    share = min((explained - used * chance) / excess, 1.0)
    if chi2_law.sf(explained / chance, max(used, 1)) > SETTINGS.by_chance:
        share = 0.0
    order = np.argsort(-each)
    chosen = tuple(names[j] for j in order[:4] if each[j] >= 0.25 * each[order[0]])
    return _named(cause, float(share), chosen, ", ".join(chosen))


@dataclass(frozen=True, slots=True)
class _Left:
    """What start states and parameters leave of the residual.

    Attributes:
        motions: The episodes.
        effective: Derivatives by parameters while start states follow, (W, R, P) each.
        normal: Start states' normal matrices, (W, S, S) each.
        residual: The residual without what either explains, (W, R) each.
        total: Its sum of squares.
    """

    motions: Sequence[Motion]
    effective: Sequence[FloatArray]
    normal: Sequence[FloatArray]
    residual: Sequence[FloatArray]
    total: float

    @classmethod
    def of(cls, found: Sequence[Motion], gain: FloatArray) -> _Left:
        """Take it out of the motions' residuals; ``gain`` is the parameters' covariance, (P, P)."""
        both = [eliminated(m.rows) for m in found]
        residual = [
            without_starts(m.rows.start, normal, m.rows.residual[..., None])[..., 0]
            for m, (_, normal) in zip(found, both, strict=True)
        ]
        back = sum(np.einsum("wrp,wr->p", J, r) for (J, _), r in zip(both, residual, strict=True))
        residual = [r - J @ (gain @ back) for (J, _), r in zip(both, residual, strict=True)]
        total = float(sum(np.sum(r**2) for r in residual))
        return cls(found, [J for J, _ in both], [n for _, n in both], residual, total)


def _explained(left: _Left, columns: Sequence[FloatArray], gain: FloatArray) -> tuple[float, FloatArray, int]:
    """Return by how much columns, (W, H, M, J, n) each, lower the cost, alone by joint, and their number."""
    J, n = columns[0].shape[3:]
    matrix, vector = np.zeros((J * n, J * n)), np.zeros(J * n)
    cross = np.zeros((gain.shape[0], J * n))
    parts = zip(left.motions, columns, left.effective, left.normal, left.residual, strict=True)
    for motion, own, effective, normal, r in parts:
        W, _, S = motion.rows.start.shape
        x = np.concatenate([own.reshape(W, -1, J * n), np.zeros((W, S, J * n))], axis=1)
        x = without_starts(motion.rows.start, normal, x)
        matrix += np.einsum("wri,wrj->ij", x, x)
        vector += np.einsum("wri,wr->i", x, r)
        cross += np.einsum("wrp,wri->pi", effective, x)
    # What the parameters can do of it is theirs; the residual has nothing of that left.
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    matrix -= cross.T @ gain @ cross
    solved = np.linalg.lstsq(matrix / np.outer(size, size), vector / size, rcond=1e-6)
    explained = float(solved[0] @ (vector / size))
    own_size = np.sqrt(np.maximum(np.diag(matrix), 1e-6 * size**2))
    each = np.sum((vector / own_size).reshape(J, n) ** 2, axis=1)
    return explained, each, int(solved[2])


def _forced(motion: Motion, force: FloatArray) -> FloatArray:
    """Return what disturbances (W, H, J, n), as accelerations, do to the channels, (W, H, M, J, n)."""
    H = motion.velocity.shape[1]
    before = np.concatenate([np.zeros_like(force[:, :1]), force[:, :-1]], axis=1)
    # A force during a step acts like a kick at its end: the response is the window's, from there on.
    full = fftconvolve(motion.response[..., None], before[:, :, None], axes=1)
    return np.asarray(full[:, :H] * motion.period_s)


def _friction(motion: Motion, scale: FloatArray) -> FloatArray:
    v = motion.velocity
    return _forced(
        motion,
        np.stack([-np.sign(v) * np.exp(-np.abs(v) / (s * scale)) for s in SETTINGS.low_speeds], axis=-1),
    )


def _backlash(motion: Motion, scale: FloatArray) -> FloatArray:
    direction = held_direction(motion.velocity, SETTINGS.still * scale)
    samples = max(round(SETTINGS.play_s / motion.period_s), 1)
    recent = direction.copy()
    recent[:, samples:] -= direction[:, :-samples]
    recent[:, :samples] -= direction[:, :1]
    # Either the drive is free for a moment after a reversal, or the sensor sits on the side of the motor.
    hysteresis = motion.direct * direction[:, :, None]
    return np.stack([_forced(motion, 0.5 * recent[..., None])[..., 0], hysteresis], axis=-1)


def held_direction(velocity: FloatArray, still: FloatArray) -> FloatArray:
    """Return the direction of the last motion, (W, H, J): the velocity's, kept where a joint is still."""
    moving = np.abs(velocity) > still
    index = np.where(moving, np.arange(velocity.shape[1])[:, None], 0)
    last = np.maximum.accumulate(index, axis=1)
    return np.asarray(np.sign(np.take_along_axis(velocity, last, axis=1)))


def _damping(motion: Motion, scale: FloatArray) -> FloatArray:
    v = motion.velocity
    return _forced(motion, np.stack([-v, -v * np.abs(v)], axis=-1))


def _inertia(motion: Motion, scale: FloatArray) -> FloatArray:
    acceleration = np.gradient(motion.velocity, motion.period_s, axis=1)
    return _forced(motion, acceleration[..., None])


def _load(motion: Motion, scale: FloatArray) -> FloatArray:
    return _forced(motion, np.ones_like(motion.velocity)[..., None])


_SIGNATURES: dict[Cause, Callable[[Motion, FloatArray], FloatArray]] = {
    "friction": _friction,
    "backlash": _backlash,
    "damping": _damping,
    "inertia": _inertia,
    "load": _load,
}


def _varying_delay(left: _Left) -> tuple[float, int]:
    """Return by how much a timing error of each short piece lowers the cost, and how many pieces are."""
    explained, used = 0.0, 0
    for motion, normal, r in zip(left.motions, left.normal, left.residual, strict=True):
        W, H, M, _ = motion.direct.shape
        size = max(round(SETTINGS.delay_piece_s / motion.period_s), 2)
        pieces = max(H // size, 1)
        label = np.minimum(np.arange(H) // size, pieces - 1)
        moved = np.einsum("whmj,whj->whm", motion.direct, motion.velocity)
        x = (moved[..., None] * (label[:, None, None] == np.arange(pieces))).reshape(W, H * M, pieces)
        x = np.concatenate([x, np.zeros((W, motion.rows.start.shape[2], pieces))], axis=1)
        x = without_starts(motion.rows.start, normal, x)
        matrix, vector = np.einsum("wri,wrj->wij", x, x), np.einsum("wri,wr->wi", x, r)
        solved = np.einsum("wij,wj->wi", np.linalg.pinv(matrix, rcond=1e-6, hermitian=True), vector)
        explained += float(np.sum(solved * vector))
        used += int(np.sum(np.linalg.matrix_rank(matrix, hermitian=True)))
    return explained, used


def _bursts(found: Sequence[Motion]) -> tuple[float, str] | None:
    """Return the share of the residual that comes in bursts, and when; None where it does not."""
    power: list[FloatArray] = []
    times: list[FloatArray] = []
    values: list[FloatArray] = []
    for motion in found:
        W, H = motion.time_s.shape
        M = motion.direct.shape[2]
        r = motion.rows.residual[:, : H * M].reshape(W, H, M)
        power.append(np.sum(r**2, axis=2).ravel())
        times.append(motion.time_s.ravel())
        values.append(r.ravel())
    joined = np.concatenate(values)
    kurtosis = float(np.mean(joined**4)) / max(float(np.mean(joined**2)) ** 2, 1e-300)
    each, time = np.concatenate(power), np.concatenate(times)
    most = np.argsort(-each)[: max(round(SETTINGS.burst_part * len(each)), 1)]
    most = most[each[most] > SETTINGS.burst_size * np.median(each)]
    share = float(each[most].sum() / max(each.sum(), 1e-300))
    if kurtosis < SETTINGS.burst_kurtosis or share < SETTINGS.burst_share:
        return None
    period_s = found[0].period_s
    seconds = sorted({round(t / (10 * period_s)) for t in time[most].tolist()})
    stretches = _stretches(seconds, 10 * period_s)
    return share, ", ".join(stretches[:5]) + (" and more" if len(stretches) > 5 else "")


def _stretches(numbers: Sequence[int], unit_s: float) -> list[str]:
    found: list[list[int]] = []
    for number in numbers:
        if found and number <= found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return [f"{(a - 0.5) * unit_s:.2f}-{(b + 0.5) * unit_s:.2f} s" for a, b in found]
