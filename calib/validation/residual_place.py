"""Where a residual lies that no known cause explains: in which channel, and at which motion of which joint.

A sensor that is blind or bent in a part of its range, an end stop or a cable leave their residual at the same
positions in each recording, friction at the same speeds, a weak motor at the same commands, and gears under
load. Something that happened once lies in one stretch of time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calibration import percent
from deal_hw.description import EFFORT_UNITS
from deal_hw.sim.engine.inverse_dynamics import link_torques
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray, IntArray

BINS = 16
"""Parts of a quantity's range [-]."""

LEAST_SHARE = 0.5
"""Share of the squared residual that a stretch of the range must hold [-]."""

DENSER = 2.5
"""Least ratio of that share to the share of the samples there [-]. A model error that is spread over the
motion has about 1."""

CHANNEL_SHARE = 0.8
"""Least share of the squared residual in one channel that is named without a stretch [-]."""

FEWEST = 20
"""Fewest samples of a part whose residual is drawn."""

Kind = Literal["position", "speed", "command", "load", "time"]

AS_DENSE = 0.5
"""Least density of a stretch that is as good a place as the densest one, over that one's [-]. Where a robot
moves in the same way each time, chance decides which is denser."""

EITHER_WAY: tuple[Kind, ...] = ("speed", "command", "load")
"""Those whose size may matter and not their direction."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """Something that a residual may depend on.

    Attributes:
        kind: What it is. A load is the torque that moves a joint's links, by the model's masses.
        of: The joint; of the time the recording.
        unit: Its unit; "" for the command of a motor, whose unit is the recording's.
        values: Its value at each sample of each recording, (T,) each; NaN in other recordings.
    """

    kind: Kind
    of: str
    unit: str
    values: tuple[FloatArray, ...]

    def at(self, rows: Sequence[tuple[int, IntArray]]) -> FloatArray:
        """Return its values, (n,), at samples of recordings: the index of each and its samples."""
        return np.concatenate([self.values[e][samples] for e, samples in rows])

    def between(self, low: float, high: float, *, either_way: bool = False) -> str:
        """Return in words where it is between two values, or its size, either way."""
        ends = f"between {low:.2f} and {high:.2f} {self.unit}".rstrip()
        if self.kind == "time":
            return f"{ends} of {self.of}" if self.of else ends
        what = self.of if self.kind == "position" else f"the {self.kind} of {self.of}"
        return f"where {what} is {ends}" + (", either way" if either_way else "")


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of a quantity's range that holds most of a residual.

    Attributes:
        low: Its lower end.
        high: Its upper end.
        share: Its share of the squared residual.
        samples: Its share of the samples.
    """

    low: float
    high: float
    share: float
    samples: float

    @property
    def density(self) -> float:
        """Squared residual a sample, over that of all samples [-]."""
        return self.share / self.samples


def quantities(problem: Problem, latency_s: float) -> list[Quantity]:
    """Return what a residual may depend on: of each joint, then the time in each recording.

    Angles of a joint that turns over are from -pi to pi. Commands are those that act, after a latency [s].
    """
    robot, facts = problem.robot, problem.robot.description
    found = list[Quantity]()
    loads = [_loads(problem, e) for e in range(len(problem.episodes))] if robot.base is None else []
    driven = {name: a for a, name in enumerate(facts.actuated)}
    joints = range(problem.coordinates)[robot.joints]
    for j, (name, c) in enumerate(zip(facts.joint_names, joints, strict=True)):
        unit = robot.coordinate_units[c]
        position = [e.position[:, c] for e in problem.episodes]
        if unit == "rad" and max(map(np.ptp, position)) > 2 * np.pi:
            position = [np.mod(p + np.pi, 2 * np.pi) - np.pi for p in position]
        found.append(Quantity("position", name, unit, tuple(position)))
        speed = tuple(s.velocity[:, c] for s in problem.starts)
        found.append(Quantity("speed", name, f"{unit}/s", speed))
        if name in driven:
            own = unit if facts.servos[driven[name]] else ""
            acting = tuple(_acting(e, latency_s)[:, driven[name]] for e in problem.episodes)
            found.append(Quantity("command", name, own, acting))
        if loads:
            found.append(Quantity("load", name, EFFORT_UNITS[unit], tuple(load[:, j] for load in loads)))
    for e, episode in enumerate(problem.episodes):
        times = [np.broadcast_to(np.nan, len(other.sample)) for other in problem.episodes]
        times[e] = episode.time_s
        found.append(Quantity("time", episode.name, "s", tuple(times)))
    return found


def _acting(episode: SampledEpisode, latency_s: float) -> FloatArray:
    """Return the commands that act just before each sample, (T, A)."""
    at = episode.sample - 1 - round(latency_s / episode.step_s)
    return np.asarray(episode.target[np.clip(at, 0, len(episode.target) - 1)])


def _loads(problem: Problem, e: int) -> FloatArray:
    """Return the torques that move the links in a recording, (T, J)."""
    joints, states = problem.robot.joints, problem.starts[e]
    position, velocity = states.position[:, joints], states.velocity[:, joints]
    acceleration = np.gradient(velocity, problem.episodes[e].period_s, axis=0)
    return link_torques(problem.robot, position, velocity, acceleration)


def residual_place(problem: Problem, refined: Refined) -> str:
    """Return in a sentence where the squared residual of a fit lies."""
    power, rows = [], list[tuple[int, IntArray]]()
    for data, residual in zip(refined.shooting.data, refined.normal.residual, strict=True):
        power.append((residual**2).reshape(-1, residual.shape[-1]))
        rows.append((data.episode, data.windows.samples().ravel()))
    squared = np.concatenate(power)
    of_channel = squared.sum(axis=0) / max(float(squared.sum()), 1e-300)
    worst = int(np.argmax(of_channel))
    most = f"{percent(float(of_channel[worst]))} of its square is in {problem.channel_names[worst]}"
    # Samples that filled a gap have a residual of 0.
    seen = squared.any(axis=1)
    total, every = squared.sum(axis=1)[seen], quantities(problem, refined.latency_s)

    def over(*, time: bool) -> Iterator[tuple[Quantity, FloatArray]]:
        for one in every:
            if (one.kind == "time") == time:
                yield one, one.at(rows)[seen]

    # What happens once happens at some place, too, so a time is named only where no place is.
    found = densest(total, over(time=False)) or densest(total, over(time=True))
    # Of a single channel it says nothing.
    channel = f"; {most}" if len(of_channel) > 1 else ""
    if found is None:
        alone = len(of_channel) > 1 and of_channel[worst] >= CHANNEL_SHARE
        return f"{most}." if alone else f"It is spread over the motion{channel}."
    stretch, where = found
    return (
        f"{percent(stretch.share)} of its square lies {where}, with {percent(stretch.samples)} of the "
        f"samples{channel}."
    )


def densest(power: FloatArray, over: Iterable[tuple[Quantity, FloatArray]]) -> tuple[Stretch, str] | None:
    """Return the densest stretch of all quantities, and where it is in words; None where none is dense.

    Joints move together, so a stretch of one quantity is one of others, too. Of those that are about as dense
    the first of :data:`Kind` is named.

    Args:
        power: Squared residual of each sample, (n,).
        over: The quantities, with their values at these samples, (n,) each.
    """
    found: list[tuple[Stretch, Quantity, bool]] = []
    for quantity, values in over:
        if (stretch := densest_stretch(power, values)) is not None:
            found.append((stretch, quantity, False))
        turns_round = quantity.kind in EITHER_WAY and np.min(values) < 0 < np.max(values)
        if turns_round and (stretch := densest_stretch(power, np.abs(values))) is not None:
            found.append((stretch, quantity, True))
    if not found:
        return None
    most = max(stretch.density for stretch, _, _ in found)
    near = [one for one in found if one[0].density >= AS_DENSE * most]
    order = get_args(Kind)
    stretch, quantity, either_way = min(near, key=lambda one: (order.index(one[1].kind), -one[0].density))
    return stretch, quantity.between(stretch.low, stretch.high, either_way=either_way)


def densest_stretch(power: FloatArray, values: FloatArray) -> Stretch | None:
    """Return the shortest stretch of a quantity, (n,), that holds most of the squared residual, (n,).

    It includes neighbours in which the residual is as dense. None where it holds about as many samples.
    Samples of which the quantity is NaN are elsewhere.
    """
    known = np.isfinite(values)
    total = float(power.sum())
    if not (known.any() and total > 0):
        return None
    low, high = float(values[known].min()), float(values[known].max())
    if not high > low:
        return None
    edges = np.linspace(low, high, BINS + 1)
    share = np.histogram(values[known], edges, weights=power[known])[0] / total
    samples = np.histogram(values[known], edges)[0] / len(values)
    dense = share >= DENSER * samples

    def stretch(first: int, end: int) -> Stretch:
        held, there = float(share[first:end].sum()), float(samples[first:end].sum())
        return Stretch(float(edges[first]), float(edges[end]), held, there)

    for width in range(1, BINS):
        every = [stretch(first, first + width) for first in range(BINS - width + 1)]
        enough = [s.share >= max(LEAST_SHARE, DENSER * s.samples) for s in every]
        if any(enough):
            first = int(np.argmax([s.share * good for s, good in zip(every, enough, strict=True)]))
            end = first + width
            # Its neighbours belong to it where the residual is as dense.
            while first > 0 and dense[first - 1]:
                first -= 1
            while end < BINS and dense[end]:
                end += 1
            return stretch(first, end)
    return None


def size_over(power: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residual's root mean square in parts of a quantity's range: their middles and it, (BINS,).

    Args:
        power: Squared residual, (n,); NaN where there is none.
        values: The quantity, (n,).

    Returns:
        Both are NaN in parts with fewer samples than :data:`FEWEST`; none where it does not change.
    """
    known = np.isfinite(power) & np.isfinite(values)
    if not known.any() or not np.ptp(values[known]) > 0:
        return np.zeros(0), np.zeros(0)
    edges = np.linspace(float(values[known].min()), float(values[known].max()), BINS + 1)
    count = np.histogram(values[known], edges)[0]
    total = np.histogram(values[known], edges, weights=power[known])[0]
    enough = count >= FEWEST
    size = np.full(BINS, np.nan)
    size[enough] = np.sqrt(total[enough] / count[enough])
    return (edges[:-1] + edges[1:]) / 2, size
