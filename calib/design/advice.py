"""What to record next: which excitation tells most about what a recording left open.

All figures are computed: each excitation of a menu is simulated at the estimate, and its Fisher information
is added to what the calibration knows already.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.calib.design.experiment_design import Experiment, MakeBehaviour, Prediction
from deal_hw.calib.uncertainty.intervals import SETTINGS as INTERVALS
from deal_hw.calibration import CalibrationResult
from deal_hw.control.behaviours import Behaviour
from deal_hw.control.excitation_plan import (
    ExcitationBehaviour,
    ExcitationDesign,
    ExcitationPlan,
    largest_factor,
    make_plan,
    words,
)
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.sim.engine.model import RobotModel
from deal_hw.types import FloatArray

WORTH = 0.7
"""An excitation is worth naming where it takes a standard deviation to this share or less."""

LOW_EFFORT = 0.15
BALANCE_S = 0.6


@dataclass(frozen=True, slots=True)
class Advice:
    """What would help with one parameter.

    Attributes:
        parameter: Its name.
        before: Its standard deviation now, in its own scale.
        after: The one that another recording would leave; as before where none helps.
        excitation: Which recording, in words; "" where none helps.
        sentence: All of it as one sentence.
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


def excitation_menu(
    description: RobotDescription, seconds: float = 4.0, *, balances: bool = False, seed: int = 1
) -> dict[str, ExcitationPlan]:
    """Return excitations that a robot can be recorded with, by what they are in words."""
    found = menu_designs(description, seconds, balances=balances, seed=seed)
    return {in_words: make_plan(description, design) for in_words, design in found.items()}


def menu_designs(
    description: RobotDescription, seconds: float = 4.0, *, balances: bool = False, seed: int = 1
) -> dict[str, ExcitationDesign]:
    """Return what the menu's excitations are made from, by what they are in words.

    Args:
        description: The robot.
        seconds: Length of each.
        balances: Whether they begin with a balancing policy.
        seed: Fixes what is random in them.
    """
    balance_s = min(BALANCE_S, 0.25 * seconds) if balances else 0.0
    top = min(5.0, description.control_rate_hz / 6)
    designs = [
        ExcitationDesign(
            family=family, seconds=seconds, balance_s=balance_s, amplitude=amplitude, high_hz=top, split=1.0,
            effort=effort, speed=speed, seed=seed,
        )
        for family in ("multisine", "chirp", "steps")
        for amplitude in (1.0, 0.4)
        for effort, speed in _variants(description)
    ]  # fmt: skip
    return {words(design): design for design in designs}


def options(design: ExcitationDesign) -> str:
    """Return the options of `deal-hw excite` that make a design of the menu."""
    effort, speed = design.effort[0], design.speed[0]
    limits = f" --effort {effort:.3g} --speed {speed:.3g} --split 0" if (effort, speed) != (1.0, 1.0) else ""
    return (
        f"--family {design.family} --seconds {design.seconds:g} --amplitude {design.amplitude:g} "
        f"--high-hz {design.high_hz:.3g}{limits} --seed {design.seed}"
    )


def _variants(description: RobotDescription) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return factors on effort and speed limit that are worth trying: as it is, low effort, high speed."""
    one = (1.0, 1.0)
    found = [(one, one)]
    fast = 1.0
    if np.isfinite(description.speed_limit).all():
        fast = min(2.5, largest_factor(description.speed_limit, description.limits.speed))
    if description.actuation == "position" and np.isfinite(description.effort_limit).all():
        found.append(((LOW_EFFORT, 1.0), (fast, 1.0)))
    if fast > 1.0:
        found.append((one, (fast, 1.0)))
    return found


def advise(
    robot: RobotModel,
    result: CalibrationResult,
    menu: Mapping[str, ExcitationPlan] | None = None,
    *,
    balance: Callable[[], Behaviour] | None = None,
    seconds: float = 4.0,
    threads: int | None = None,
) -> tuple[Advice, ...]:
    """Say for each weak or unidentified parameter of a result what to record next.

    Args:
        robot: The nominal model, with a fixed base.
        result: What the calibration found.
        menu: Excitations that can be recorded; :func:`excitation_menu` by default.
        balance: Makes the policy that balances; None for robots that stand by themselves.
        seconds: Length of the excitations of the default menu.
        threads: Simulation threads.
    """
    space, K = result.space, len(result.space)
    known = result.distribution()
    before = np.sqrt(np.diag(known.covariance)) if known.covariance is not None else np.full(K, np.inf)
    # An interval that was cut off at the range says less than its width.
    before = np.minimum(before, space.width / np.sqrt(12.0))
    open_ = [k for k in range(K) if not _told(space, k, float(before[k])) or _said_weak(result, k)]
    if not open_:
        return ()
    plans = (
        menu
        if menu is not None
        else excitation_menu(robot.description, seconds, balances=balance is not None)
    )
    predictions = predict_menu(robot, known, before, plans, balance=balance, threads=threads)
    usable = {name: found for name, found in predictions.items() if found.usable}
    designs = menu_designs(robot.description, seconds, balances=balance is not None)
    # What the model lacks will be in the next recording, too: it widens that interval like this one.
    widened = result.provenance.get("clustered", {}).get("widened", {})
    found = [
        _advice(
            space, k, float(before[k]), usable, len(predictions), max(widened.get(space.names[k], 1.0), 1.0)
        )
        for k in open_
    ]
    return tuple(
        dataclasses.replace(one, command=options(designs[one.excitation]))
        if one.excitation in designs
        else one
        for one in found
    )


def predict_menu(
    robot: RobotModel,
    known: ParameterDistribution,
    before: FloatArray,
    menu: Mapping[str, ExcitationPlan],
    *,
    balance: Callable[[], Behaviour] | None = None,
    threads: int | None = None,
) -> dict[str, Prediction]:
    """Predict at the estimate what each excitation adds to what is known.

    Args:
        robot: The nominal model.
        known: What is known; its mean is where is simulated.
        before: Standard deviations that are known, in each parameter's own scale, (K,).
        menu: Excitations.
        balance: Makes the policy that balances.
        threads: Simulation threads.
    """
    lengths = {plan.seconds for plan in menu.values()}
    if len(lengths) != 1:
        raise ConfigurationError(f"a menu of excitations has one length, not {sorted(lengths)} s")
    # One member at the estimate: the linearised posterior is about this one robot.
    space = known.space
    covariance = known.covariance if known.covariance is not None else np.diag(before**2)
    floor = np.diag(space.width**2 / 12.0)
    bounded = np.linalg.inv(np.linalg.inv(covariance + 1e-12 * np.eye(len(space))) + np.linalg.inv(floor))
    centre = ParameterDistribution(
        space=space, mean=known.mean, covariance=1e-18 * np.eye(len(space)), latency_s=known.latency_s
    )
    experiment = Experiment(robot, centre, lengths.pop(), 1, np.random.default_rng(0), threads=threads)
    experiment.assume(bounded)
    description = robot.description

    def maker(plan: ExcitationPlan) -> MakeBehaviour:
        return lambda: ExcitationBehaviour(plan, description, balance() if balance is not None else None)

    return {name: experiment.predict(maker(plan)) for name, plan in menu.items()}


def _said_weak(result: CalibrationResult, k: int) -> bool:
    return bool(result.verdicts) and result.verdicts[k] != "identifiable"


def _told(space: ParameterSpace, k: int, std: float) -> bool:
    return std <= INTERVALS.identifiable_std * (1.0 if space.log_scale[k] else float(space.width[k]))


def _advice(
    space: ParameterSpace, k: int, before: float, usable: Mapping[str, Prediction], tried: int, widened: float
) -> Advice:
    name, prior = space.names[k], float(space.width[k] / np.sqrt(12.0))
    if not usable:
        sentence = (
            f"{name} is open at {_amount(space, k, before)}: none of {tried} excitations keeps the limits in "
            "the simulation with the values found, so no advice can be computed"
        )
        return Advice(name, before, before, "", sentence)
    best = min(usable, key=lambda name: float(usable[name].std[k]))
    after = min(widened * float(usable[best].std[k]), before)
    if after > WORTH * before:
        how = (
            "measure it by other means (scale, ruler, stall torque), or give what it is bound to as known"
            if before > INTERVALS.weak_share * prior
            else "record for longer, or measure it by other means"
        )
        sentence = (
            f"{name} is open at {_amount(space, k, before)}, and the best of {len(usable)} excitations "
            f"leaves {_amount(space, k, after)}: {how}"
        )
        return Advice(name, before, after, "", sentence)
    rest = "" if _told(space, k, after) else ", which is still weak"
    sentence = (
        f"record {best}: {name} goes from {_amount(space, k, before)} to {_amount(space, k, after)}{rest}"
    )
    return Advice(name, before, after, best, sentence)


def _amount(space: ParameterSpace, k: int, std: float) -> str:
    """Return a standard deviation in words: a share on a log scale, the unit on a linear one."""
    if space.log_scale[k]:
        return f"{100 * std:.2g} %"
    return f"{std:.2g} {space.free[k].unit}"


def next_step(advice: Sequence[Mapping[str, Any]], robot: str = "") -> list[str]:
    """Return the one thing to do next, in words and as commands.

    Of all recordings the one that helps most parameters most; where none helps, what to measure.

    Args:
        advice: What :meth:`Advice.to_json` gave for each open parameter.
        robot: The robot's name where `deal-hw` can record it; "" for no commands.
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
    helped = ", ".join(row["sentence"].split(": ", 1)[1].split(",")[0] for row in groups[best])
    found = [f"record {best}: {helped}"]
    if robot and groups[best][0].get("command"):
        found += [
            f"    deal-hw excite {robot} {groups[best][0]['command']} --out next.json",
            f"    deal-hw collect {robot} --excite next.json",
        ]
    if hopeless:
        names = ", ".join(row["parameter"] for row in hopeless)
        found.append(f"no recording helps with {names}: measure it by other means, then --known NAME VALUE")
    return found
