"""``deal_hw.design_excitation``: compute the most informative motion to play on a robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from deal_hw.calibration import LATENCY_RANGE_S
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, MissingExtraError, UnknownNameError
from deal_hw.motions.behaviours import Behaviour
from deal_hw.motions.excitation.behaviours import RichBehaviour, RichConfig
from deal_hw.motions.excitation.plan import (
    OF_FAMILY,
    ExcitationBehaviour,
    ExcitationDesign,
    ExcitationPlan,
    make_plan,
)
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.ranges import Range, check_ranges
from deal_hw.robots import is_known, robot_entry, robots
from deal_hw.workflows.options import File, Ratio, Seed, Threads, from_settings, given, refuse
from deal_hw.workflows.robot import described, described_spaces
from deal_hw.workflows.shipped import balancer

if TYPE_CHECKING:
    from deal_hw.calib.design.excitation_search import Optimum

BALANCE_S = 0.6
LIMITS = ("effort", "speed", "split")
GIVEN_DESIGN = ("amplitude", "low_hz", "high_hz", *LIMITS)
Notify = Callable[[int, int, str], None]
SEARCH = ("calibration", "space", "range_ratio", "criterion", "draws", "confirm", "candidates", "rounds")


@dataclass(frozen=True, kw_only=True)
class ExcitationSettings:
    """Settings of :func:`design_excitation`."""

    robot: str = field(kw_only=False)
    """The robot, such as cartpole, or a robot.yaml, or a dataset with its own robot.yaml."""

    out: File
    """File to write, FILE.json; `deal-hw collect --excite FILE.json` plays it."""

    family: Literal["optimal", "multisine", "chirp", "steps", "sway"] = "optimal"
    """optimal: the most informative of many candidates of the other families, found by simulation; multisine:
    a sum of sines with a low peak; chirp: a sine sweep; steps: random set-points; sway: the body moves over
    standing feet (go2)."""

    seconds: Annotated[float, Range(0.5, 600, "s")] = 4.0
    """Length of the recording [s]."""

    amplitude: Annotated[float, Range(1e-3, 1)] = 1.0
    """Not for optimal: amplitude, as a share of the largest one within the safety limits."""

    low_hz: Annotated[float, Range(1e-3, 1000, "Hz")] = 0.3
    """Lowest frequency of multisine, chirp and sway [Hz]."""

    high_hz: Annotated[float, Range(1e-3, 1000, "Hz")] = 5.0
    """Highest frequency of multisine, chirp and sway [Hz]."""

    effort: Annotated[float, Range(1e-3, 1000)] = 1.0
    """Not for optimal: factor on the commanded effort limit, after SPLIT."""

    speed: Annotated[float, Range(1e-3, 1000)] = 1.0
    """Not for optimal: factor on the commanded speed limit, after SPLIT."""

    split: Annotated[float, Range(0, 1)] = 0.5
    """Not for optimal: fraction of the run after which EFFORT and SPEED hold; 0: all the time."""

    policy: File | None = None
    """Policy that balances the robot first (.onnx); by default the shipped one, if any."""

    calibration: File | None = None
    """distribution.json of a calibration, from which robots are drawn instead of the whole ranges."""

    space: str = ""
    """Parameter set to identify, such as k9; by default the robot's first set."""

    range_ratio: Annotated[float, Ratio] = 5.0
    """Ranges go from nominal / RANGE-RATIO to nominal * RANGE-RATIO."""

    criterion: Literal["determinant", "mean"] = "determinant"
    """determinant: smallest volume of the uncertainty; mean: smallest mean standard deviation."""

    draws: Annotated[int, Range(1, 10_000)] = 24
    """Number of drawn robots on which each candidate is tried."""

    confirm: Annotated[int, Range(1, 10_000)] = 24
    """Number of other robots on which the best candidates are compared at the end."""

    candidates: Annotated[int, Range(1, 100_000)] = 40
    """Number of random candidates."""

    rounds: Annotated[int, Range(0, 100_000)] = 24
    """Number of changes that are tried on the best candidate."""

    seed: Seed = 0
    """Seed of all random numbers."""

    threads: Threads = None
    """Simulation threads; by default all CPUs."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.low_hz < self.high_hz:
            raise ConfigurationError(f"--low-hz {self.low_hz:g} must be below --high-hz {self.high_hz:g}")


@dataclass(frozen=True, kw_only=True)
class ExcitationReport:
    """What was computed.

    Attributes:
        plan: The motion.
        path: Its file.
        optimum: How it was found; None without a search.
        space: The parameters to identify; None without a search.
        refused: Draws of parameters that the model refused.
    """

    plan: ExcitationPlan
    path: Path
    optimum: Optimum | None = None
    space: ParameterSpace | None = None
    refused: int = 0


@from_settings(ExcitationSettings)
def design_excitation(settings: ExcitationSettings) -> ExcitationReport:
    """Compute the most informative motion to play on a robot, as ``deal-hw design-excitation``.

    :class:`ExcitationSettings` and ``deal-hw design-excitation --help`` describe the arguments:
    ``design_excitation("cartpole", out="excitation.json")``.

    Returns:
        The motion, and how it was found.

    Raises:
        DealHwError: A setting is unusable, or no candidate keeps the limits.
    """
    return run(settings)


def run(config: ExcitationSettings, notify: Notify | None = None) -> ExcitationReport:
    """Compute an excitation, as :func:`design_excitation`.

    Args:
        config: Settings.
        notify: Called with candidates done, candidates in total, and a text on the current step.
    """
    default = ExcitationSettings(robot=config.robot, out=config.out)
    if config.family == "optimal":
        refuse(given(config, default, GIVEN_DESIGN), "--family optimal searches it; name another")
        if config.calibration is not None:
            refuse(given(config, default, ("space", "range_ratio")), "--calibration gives the ranges")
    else:
        refuse(
            given(config, default, (*SEARCH, "threads")),
            f"--family {config.family} is not searched; use --family optimal",
        )
        own = (
            ("low_hz", "high_hz", "seed") if config.family == "sway" else (*LIMITS, *OF_FAMILY[config.family])
        )
        others = [name for name in (*GIVEN_DESIGN[1:], "seed") if name not in own]
        refuse(given(config, default, others), f"--family {config.family} does not use it")
        if config.effort == default.effort and config.speed == default.speed:
            refuse(
                given(config, default, ("split",)),
                "it is the time after which --effort or --speed holds, and neither is given",
            )
    description = described(config.robot)
    most_hz = description.control_rate_hz / 2
    if config.family in ("multisine", "chirp", "sway") and config.high_hz > most_hz:
        raise ConfigurationError(
            f"--high-hz {config.high_hz:g}: {config.robot} takes {description.control_rate_hz:g} commands "
            f"per second, so a motion may have up to {most_hz:g} Hz; lower --high-hz"
        )
    balance = balancer(description, None if config.policy is None else Path(config.policy))
    balance_s = 0.0 if balance is None else min(BALANCE_S, 0.25 * config.seconds)
    path = Path(config.out)
    if config.family == "optimal":
        report = _search(config, description, balance, balance_s, notify)
    elif config.family == "sway":
        report = ExcitationReport(plan=_sway(config, description), path=path)
    else:
        whole = config.split <= 0
        design = ExcitationDesign(
            family=config.family,
            seconds=config.seconds,
            amplitude=config.amplitude,
            low_hz=config.low_hz,
            high_hz=config.high_hz,
            split=1.0 if whole else config.split,
            effort=(config.effort, 1.0) if whole else (1.0, config.effort),
            speed=(config.speed, 1.0) if whole else (1.0, config.speed),
            seed=config.seed,
            balance_s=balance_s,
        )
        report = ExcitationReport(plan=make_plan(description, design), path=path)
    report.plan.write(path)
    return report


def _sway(config: ExcitationSettings, description: RobotDescription) -> ExcitationPlan:
    entry = robot_entry(description.name) if is_known(description.name) else None
    if entry is None or not entry.sway:
        able = ", ".join(one.name for one in robots().entries() if one.sway)
        raise ConfigurationError(
            f"robot {description.name!r} does not sway: that is for robots that stand on feet ({able}); "
            "choose another --family"
        )
    try:
        sway_plan = entry.load(entry.sway)
        from deal_hw.sim.engine.model import load_model
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err
    plan: ExcitationPlan = sway_plan(
        load_model(description),
        np.random.default_rng(config.seed),
        config.seconds,
        (config.low_hz, config.high_hz),
        config.amplitude,
    )
    return plan


def _search(
    config: ExcitationSettings,
    description: RobotDescription,
    balance: Callable[[], Behaviour] | None,
    balance_s: float,
    notify: Notify | None,
) -> ExcitationReport:
    try:
        from deal_hw.calib.design.excitation_search import SearchSettings, search_excitation
        from deal_hw.calib.design.experiment_design import Experiment
        from deal_hw.sim.engine.model import load_model
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err
    settings = SearchSettings(candidates=config.candidates, rounds=config.rounds, criterion=config.criterion)
    rng = np.random.default_rng(config.seed)
    design = partial(ExcitationDesign, seconds=config.seconds, balance_s=balance_s)

    def player(design: ExcitationDesign) -> Callable[[], Behaviour]:
        plan = make_plan(description, design)
        return lambda: ExcitationBehaviour(plan, description, balance() if balance is not None else None)

    rest = player(design(family="steps", amplitude=0.01))
    experiment = Experiment(
        load_model(description),
        _knowledge(config),
        config.seconds,
        config.draws,
        rng,
        rest=rest,
        threads=config.threads,
    )
    references = {
        "multisine": player(design(family="multisine", seed=config.seed)),
        "chirp": player(design(family="chirp")),
    }
    if balance is not None:
        rich = RichConfig(duration_s=config.seconds)
        references["rich"] = lambda: RichBehaviour(description, balance(), rich, config.seed)
    optimum = search_excitation(
        experiment,
        rng,
        settings,
        balance=balance,
        references=references,
        confirmation=experiment.afresh(config.confirm, rng),
        notify=notify,
    )
    return ExcitationReport(
        plan=optimum.plan,
        path=Path(config.out),
        optimum=optimum,
        space=experiment.space,
        refused=experiment.refused,
    )


def _knowledge(config: ExcitationSettings) -> ParameterDistribution:
    if config.calibration is not None:
        from deal_hw.workflows.train import read_distribution

        path = Path(config.calibration)
        return read_distribution(path / "distribution.json" if path.is_dir() else path)
    table = described_spaces(config.robot)
    name = config.space or next(iter(table))
    if name not in table:
        raise UnknownNameError("parameter set", name, table)
    return ParameterDistribution.uniform(table[name]().with_ratio(config.range_ratio), LATENCY_RANGE_S)
