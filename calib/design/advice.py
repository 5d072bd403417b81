"""Advice on the next recording: which excitation is most informative about the open parameters.

Each excitation of a menu is simulated at the estimate, and its Fisher information is added to that of the
recordings so far. An interval is promised to shrink by as much as that information says. What widened it,
such as an error of the model, will be in the next recording, too. What explanations that predict alike add to
it (``alike_std`` in a result's provenance) stays.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.design.experiment_design import (
    ExpectedInformation,
    Experiment,
    MakeBehaviour,
    Prior,
    information,
)
from deal_hw.calib.fit.intervals import IDENTIFIABLE_STD, WEAK_SHARE
from deal_hw.calibration import CalibrationResult, std_words
from deal_hw.description import RobotDescription, SensorModel
from deal_hw.errors import DealHwError
from deal_hw.motions.excitation.limits import largest_factor
from deal_hw.motions.excitation.plan import (
    OF_FAMILY,
    ExcitationDesign,
    ExcitationPlan,
    describe_design,
    make_plan,
)
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

WORTH = 0.7
"""Largest ratio of standard deviations, after to before, at which an excitation is advised."""

SECONDS = 4.0
"""Length of an excitation [s]."""

BALANCE_S = 0.6
"""Balancing time at the start, at most a quarter of the whole [s]."""

AMPLITUDES = (1.0, 0.4)
"""Shares of the joints' ranges."""

LOW_EFFORT = 0.15
"""A low effort limit, as a share of the usual one: it shows the unit of an effort."""

HIGH_SPEED = 2.5
"""A high speed limit, as a multiple of the usual one."""

BEYOND = 0.25
"""Margin on either side of the recorded range of a joint without limits, as a share of it."""

FASTER = 5.0
"""Trip speed of a joint without limits, as a multiple of the recorded one; requests get half."""

SEED = 1
"""Seeds the excitations."""


@dataclass(frozen=True, slots=True)
class Advice:
    """Advice for one parameter.

    Attributes:
        parameter: Its name.
        before: Its standard deviation now, in its own scale.
        after: The one after another recording; equal to ``before`` where none helps.
        excitation: The recording, in words; "" where none helps.
        sentence: The advice in one sentence.
        command: `deal-hw` options that make the excitation; "" where none helps.
    """

    parameter: str
    before: float
    after: float
    excitation: str
    sentence: str
    command: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; a figure that was not computed is None."""
        return {
            "parameter": self.parameter,
            "std": self.before if math.isfinite(self.before) else None,
            "std_after": self.after if math.isfinite(self.after) else None,
            "excitation": self.excitation,
            "sentence": self.sentence,
            "command": self.command,
        }


def menu_designs(
    description: RobotDescription, balances: bool = False, seconds: float = SECONDS
) -> dict[str, ExcitationDesign]:
    """Return the excitations of the menu by their description; ``balances``: a policy balances first."""
    balance_s = min(BALANCE_S, 0.25 * seconds) if balances else 0.0
    top = min(5.0, description.control_rate_hz / 6)
    designs = [
        ExcitationDesign(
            family=family,
            seconds=seconds,
            balance_s=balance_s,
            amplitude=amplitude,
            high_hz=top,
            split=1.0,
            effort=effort,
            speed=speed,
            seed=SEED,
        )
        for family in ("multisine", "chirp", "steps")
        for amplitude in AMPLITUDES
        for effort, speed in _variants(description)
    ]
    return {describe_design(design): design for design in designs}


def options(design: ExcitationDesign) -> str:
    """Return the options of `deal-hw design-excitation` that make a design of the menu."""
    effort, speed = design.effort[0], design.speed[0]
    limits = f" --effort {effort:.3g} --speed {speed:.3g} --split 0" if (effort, speed) != (1.0, 1.0) else ""
    own = OF_FAMILY[design.family]
    high = f" --high-hz {design.high_hz:.3g}" if "high_hz" in own else ""
    seed = f" --seed {design.seed}" if "seed" in own else ""
    size = f"--seconds {design.seconds:g} --amplitude {design.amplitude:g}"
    return f"--family {design.family} {size}{high}{limits}{seed}"


def _variants(
    description: RobotDescription,
) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return factors on effort and speed limit to try: both unchanged, low effort, high speed."""
    one = (1.0, 1.0)
    found = [(one, one)]
    fast = 1.0
    if np.isfinite(description.speed_limit).all():
        fast = min(HIGH_SPEED, largest_factor(description.speed_limit, description.limits.speed))
    if all(description.servos) and np.isfinite(description.effort_limit).all():
        found.append(((LOW_EFFORT, 1.0), (fast, 1.0)))
    if fast > 1.0:
        found.append((one, (fast, 1.0)))
    return found


def advise(
    robot: RobotModel,
    result: CalibrationResult,
    seen: FloatArray,
    *,
    balance: MakeBehaviour | None = None,
    seconds: float = SECONDS,
    threads: int | None = None,
) -> tuple[Advice, ...]:
    """Return advice for each weak or unidentified parameter of a result.

    The robot's base is fixed. ``seen`` is the information of the recordings, (K + 1, K + 1), from
    :func:`~deal_hw.calib.design.experiment_design.information`. ``balance`` makes the balancing policy; None
    for robots that stand by themselves. Excitations last ``seconds``.
    """
    space, K = result.space, len(result.space)
    known = result.distribution()
    before = np.full(K, np.inf) if known.covariance is None else np.sqrt(np.diag(known.covariance))
    # A truncated interval has more information than its width shows.
    before = np.minimum(before, space.width / np.sqrt(12.0))
    # A parameter with the verdict identifiable needs no recording, however wide its interval is.
    open_ = [k for k, verdict in enumerate(result.verdicts) if verdict != "identifiable"]
    if not open_:
        return ()
    designs = menu_designs(robot.description, balance is not None, seconds)
    menu = {name: make_plan(robot.description, design) for name, design in designs.items()}
    # The ranges bound what the recordings leave open.
    prior = Prior(seen + Prior.of(dataclasses.replace(known, covariance=None)).information)
    predictions = predict_menu(robot, known, menu, prior, balance=balance, threads=threads)
    added = result.provenance.get("alike_std", {})
    alike = np.minimum([float(added.get(name, 0.0)) for name in space.names], before)
    own = np.sqrt(before**2 - alike**2)
    wider = own / np.sqrt(np.diag(np.linalg.inv(prior.information))[:K])
    found = []
    for k in open_:
        one = _advice(space, k, float(before[k]), predictions, float(wider[k]), float(alike[k]))
        command = options(designs[one.excitation]) if one.excitation else ""
        found.append(dataclasses.replace(one, command=command))
    return tuple(found)


def predict_menu(
    robot: RobotModel,
    known: ParameterDistribution,
    menu: Mapping[str, ExcitationPlan],
    prior: Prior,
    *,
    balance: MakeBehaviour | None = None,
    threads: int | None = None,
) -> dict[str, ExpectedInformation]:
    """Predict the information of each excitation of a menu at the estimate; all have one length."""
    # One member, at the estimate: the linearised posterior is about this one robot.
    there = dataclasses.replace(known, covariance=1e-18 * np.eye(len(known.space)))
    seconds = max(plan.seconds for plan in menu.values())
    rng = np.random.default_rng(0)
    experiment = Experiment(robot, there, seconds, 1, rng, threads=threads, prior=prior)
    return {name: experiment.predict(experiment.playing(plan, balance)) for name, plan in menu.items()}


def _advice(
    space: ParameterSpace,
    k: int,
    before: float,
    predictions: Mapping[str, ExpectedInformation],
    widened: float,
    alike: float,
) -> Advice:
    """Return a parameter's advice: excitations shrink its standard deviation ``before`` down to ``alike``."""
    name, prior = space.names[k], float(space.width[k] / np.sqrt(12.0))
    now = std_words(space.free[k], before)
    usable = {name: found for name, found in predictions.items() if found.usable}
    if not usable:
        sentence = (
            f"{name} is open at {now}: with the values found, none of "
            f"{len(predictions)} excitations stays inside the limits in simulation, so there is no advice"
        )
        return Advice(name, before, before, "", sentence)
    best = min(usable, key=lambda name: float(usable[name].std[k]))
    after = min(math.hypot(widened * float(usable[best].std[k]), alike), before)
    if after > WORTH * before:
        how = (
            "measure it by other means (scale, ruler, stall torque), or give what it is bound to as known"
            if before > WEAK_SHARE * prior or alike > WORTH * before
            else "record for longer, or measure it by other means"
        )
        sentence = (
            f"{name} is open at {now}, and the best of {len(usable)} excitations "
            f"leaves {std_words(space.free[k], after)}: {how}"
        )
        return Advice(name, before, after, "", sentence)
    unit = 1.0 if space.log_scale[k] else float(space.width[k])
    rest = "" if after <= IDENTIFIABLE_STD * unit else _STILL_WEAK
    sentence = f"{_record(best)}{name} goes from {now} to {std_words(space.free[k], after)}{rest}"
    return Advice(name, before, after, best, sentence)


def next_recordings(
    robot: RobotModel,
    result: CalibrationResult,
    episodes: Sequence[SampledEpisode],
    *,
    balance: MakeBehaviour | None = None,
    threads: int | None = None,
) -> tuple[Advice, ...]:
    """Return advice as :func:`advise` does, for the parameters that the result calls weak or unidentified.

    A robot without described limits stays inside what its recordings covered. The noise is the residual that
    the calibration left.
    """
    open_ = [n for n, v in zip(result.space.names, result.verdicts, strict=False) if v != "identifiable"]
    if not open_:
        return ()
    if robot.base is not None:
        return _without(open_, "motions are planned for a fixed base only; record it held by its trunk")
    if not robot.description.actuated:
        return _without(open_, "nothing drives its joints; record a swing from another pose, or weigh a part")
    try:
        described = _described(robot, result, episodes, threads)
        known = dataclasses.replace(robot, description=described)
        seen = information(known, result.space, episodes, result.estimate, result.latency_s, threads=threads)
        return advise(known, result, seen, balance=balance, threads=threads)
    except DealHwError as err:
        return _without(open_, str(err))


def _without(names: Sequence[str], why: str) -> tuple[Advice, ...]:
    return tuple(
        Advice(name, float("nan"), float("nan"), "", f"{name} is open, and no advice was computed: {why}")
        for name in names
    )


def _described(
    robot: RobotModel,
    result: CalibrationResult,
    episodes: Sequence[SampledEpisode],
    threads: int | None,
) -> RobotDescription:
    """Return the description with the residual as noise, and with the recordings' limits if it has none."""
    description = robot.description
    problem = Problem(robot, result.space, episodes, threads=threads)
    noise = _noise(problem, result)
    sensor = SensorModel(
        noise=tuple(map(float, noise)), resolution=(0.0,) * len(noise), velocity_window_s=0.0
    )
    description = dataclasses.replace(description, sensor=sensor)
    if np.isfinite(np.array(description.limits.target)).all():
        return description
    targets = np.concatenate([e.target for e in episodes])
    positions = np.concatenate([e.position[e.usable] for e in episodes])
    low, high = np.nanmin(targets, axis=0), np.nanmax(targets, axis=0)
    least, most = np.nanmin(positions, axis=0), np.nanmax(positions, axis=0)
    spare = BEYOND * (most - least)
    fastest = np.max([np.abs(s.velocity).max(axis=0) for s in problem.starts], axis=0)
    home = 0.5 * (least + most)
    index, servos = np.array(description.actuated_index, dtype=int), np.array(description.servos, dtype=bool)
    home[index[servos]] = 0.5 * (low + high)[servos]
    limits = dataclasses.replace(
        description.limits,
        target=_pairs(low, high),
        trip_position=_pairs(least - spare, most + spare),
        trip_velocity=tuple(map(float, FASTER * fastest)),
    )
    return dataclasses.replace(description, limits=limits, default_position=tuple(map(float, home)))


def _noise(problem: Problem, result: CalibrationResult) -> FloatArray:
    """Return the expected error of positions, (J,): the sensor's noise times the unexplained residual."""
    joints = len(problem.robot.description.joint_names)
    used = result.provenance.get("noise_std", ())
    noise = np.array(used) if len(used) == joints else problem.noise_std[:joints]
    left = result.chi2 if np.isfinite(result.chi2) else 1.0
    return np.asarray(noise * np.sqrt(max(left, 1.0)))


def _pairs(low: FloatArray, high: FloatArray) -> tuple[tuple[float, float], ...]:
    return tuple((float(a), float(b)) for a, b in zip(low, high, strict=True))


_STILL_WEAK = ", which is still weak"


def _record(excitation: str) -> str:
    """Return how the advice to record an excitation begins."""
    return f"record {excitation}: "


def next_step(
    advice: Sequence[Mapping[str, Any]], robot: str = "", dataset: str = "runs/first/dataset"
) -> list[str]:
    """Return the one thing to do next, in words and as commands.

    It is the recording that helps most parameters most; without one, the measurement to make. ``advice`` is
    :meth:`Advice.to_json` of each open parameter. Commands need a robot that `deal-hw` can record. They add
    to ``dataset``: a recording alone would have no held-out one beside it.
    """
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in advice:
        groups.setdefault(row["excitation"], []).append(row)
    hopeless = groups.pop("", [])
    if not groups:
        return [row["sentence"] for row in hopeless[:1]]

    def gain(rows: Sequence[Mapping[str, Any]]) -> float:
        return sum(math.log(row["std"] / row["std_after"]) for row in rows)

    best = max(groups, key=lambda name: gain(groups[name]))
    parts = (row["sentence"].removeprefix(_record(best)).removesuffix(_STILL_WEAK) for row in groups[best])
    found = [_record(best) + ", ".join(parts)]
    if robot and groups[best][0].get("command"):
        found += [
            f"    deal-hw design-excitation {robot} {groups[best][0]['command']} --out next.json",
            f"    deal-hw collect {robot} --excite next.json --port PORT --dataset {dataset}",
            f"    deal-hw calibrate {dataset}",
        ]
    if hopeless:
        names = ", ".join(row["parameter"] for row in hopeless)
        found.append(f"no recording helps with {names}: measure it by other means, then --known NAME VALUE")
    return found
