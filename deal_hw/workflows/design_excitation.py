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
    ExcitationBehaviour,
    ExcitationDesign,
    ExcitationPlan,
    make_plan,
)
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.ranges import Checked, Range
from deal_hw.robots import is_known, robot_entry, robots
from deal_hw.workflows.kinds import InputKind, Kinds
from deal_hw.workflows.options import File, Ratio, Seed, Threads, from_settings, given, refuse
from deal_hw.workflows.robot import described, described_spaces
from deal_hw.workflows.shipped import balancer

if TYPE_CHECKING:
    from deal_hw.calib.design.excitation_search import Optimum

BALANCE_S = 0.6
Notify = Callable[[int, int, str], None]


@dataclass(frozen=True, kw_only=True)
class ExcitationSettings(Checked):
    """Compute a motion to play on a robot."""

    robot: str = field(kw_only=False)
    """The robot, such as cartpole, or a robot.yaml, or a dataset with its own robot.yaml."""

    out: File
    """File to write, FILE.json; `deal-hw collect --excite FILE.json` plays it."""

    seconds: Annotated[float, Range(0.5, 600, "s")] = 4.0
    """Length of the recording [s]."""

    policy: File | None = None
    """Policy that balances the robot first (.onnx); by default the shipped one, if any."""


@dataclass(frozen=True, kw_only=True)
class OptimalSettings(ExcitationSettings):
    """The most informative of many candidates of the other families, found by simulation."""

    family: Literal["optimal"] = "optimal"
    """The family of motions."""

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
        super().__post_init__()
        if self.calibration is not None:
            names = ("space", "range_ratio")
            refuse(given(self, OptimalSettings, names), "--calibration gives the ranges")


@dataclass(frozen=True, kw_only=True)
class DesignSettings(ExcitationSettings):
    """A motion of one family."""

    amplitude: Annotated[float, Range(1e-3, 1)] = 1.0
    """Amplitude, as a share of the largest one within the safety limits."""


@dataclass(frozen=True, kw_only=True)
class BandOptions(Checked):
    """Frequencies of a motion."""

    low_hz: Annotated[float, Range(1e-3, 1000, "Hz")] = 0.3
    """Lowest frequency [Hz]."""

    high_hz: Annotated[float, Range(1e-3, 1000, "Hz")] = 5.0
    """Highest frequency [Hz]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.low_hz < self.high_hz:
            raise ConfigurationError(f"--low-hz {self.low_hz:g} must be below --high-hz {self.high_hz:g}")


@dataclass(frozen=True, kw_only=True)
class LimitOptions(Checked):
    """Limits that are commanded during a part of the motion."""

    effort: Annotated[float, Range(1e-3, 1000)] = 1.0
    """Factor on the commanded effort limit, after SPLIT."""

    speed: Annotated[float, Range(1e-3, 1000)] = 1.0
    """Factor on the commanded speed limit, after SPLIT."""

    split: Annotated[float, Range(0, 1)] = 0.5
    """Fraction of the run after which EFFORT and SPEED hold; 0: all the time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.effort == LimitOptions.effort and self.speed == LimitOptions.speed:
            refuse(
                given(self, LimitOptions, ("split",)),
                "it is the time after which --effort or --speed holds, and neither is given",
            )


@dataclass(frozen=True, kw_only=True)
class MultisineSettings(LimitOptions, BandOptions, DesignSettings):
    """A sum of sines with a low peak."""

    family: Literal["multisine"] = "multisine"
    """The family of motions."""

    seed: Seed = 0
    """Seed of the phases."""


@dataclass(frozen=True, kw_only=True)
class ChirpSettings(LimitOptions, BandOptions, DesignSettings):
    """A sine sweep."""

    family: Literal["chirp"] = "chirp"
    """The family of motions."""


@dataclass(frozen=True, kw_only=True)
class StepsSettings(LimitOptions, DesignSettings):
    """Random set-points."""

    family: Literal["steps"] = "steps"
    """The family of motions."""

    seed: Seed = 0
    """Seed of the set-points."""


@dataclass(frozen=True, kw_only=True)
class SwaySettings(BandOptions, DesignSettings):
    """The body moves over standing feet (go2)."""

    family: Literal["sway"] = "sway"
    """The family of motions."""

    seed: Seed = 0
    """Seed of the sines."""


_SETTINGS: dict[str, type[ExcitationSettings]] = {
    "optimal": OptimalSettings,
    "multisine": MultisineSettings,
    "chirp": ChirpSettings,
    "steps": StepsSettings,
    "sway": SwaySettings,
}
_ROBOTS = {"sway": "go2"}
_TABLE = {
    family: InputKind(
        settings,
        usage="ROBOT" if family == "optimal" else f"ROBOT --family {family}",
        example=f"{_ROBOTS.get(family, 'cartpole')} --family {family} --out runs/first/excitation.json",
    )
    for family, settings in _SETTINGS.items()
}
DESIGN_EXCITATION = Kinds(
    noun="family",
    argument="robot",
    table=lambda: _TABLE,
    find=lambda arguments: str(arguments.options.get("family", "optimal")),
)
"""The kinds of :func:`design_excitation`: families of motions."""


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


@from_settings(DESIGN_EXCITATION)
def design_excitation(settings: ExcitationSettings) -> ExcitationReport:
    """Compute the most informative motion to play on a robot, as ``deal-hw design-excitation``.

    ``deal-hw design-excitation ROBOT --help`` describes the arguments:
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
    description = described(config.robot)
    most_hz = description.control_rate_hz / 2
    if isinstance(config, BandOptions) and config.high_hz > most_hz:
        raise ConfigurationError(
            f"--high-hz {config.high_hz:g}: {config.robot} takes {description.control_rate_hz:g} commands "
            f"per second, so a motion may have up to {most_hz:g} Hz; lower --high-hz"
        )
    balance = balancer(description, None if config.policy is None else Path(config.policy))
    balance_s = 0.0 if balance is None else min(BALANCE_S, 0.25 * config.seconds)
    path = Path(config.out)
    if isinstance(config, OptimalSettings):
        report = _search(config, description, balance, balance_s, notify)
    elif isinstance(config, SwaySettings):
        report = ExcitationReport(plan=_sway(config, description), path=path)
    else:
        report = ExcitationReport(plan=make_plan(description, _design(config, balance_s)), path=path)
    report.plan.write(path)
    return report


def _design(config: ExcitationSettings, balance_s: float) -> ExcitationDesign:
    names = ("family", "amplitude", "low_hz", "high_hz", "seed")
    own = {name: getattr(config, name) for name in names if hasattr(config, name)}
    if isinstance(config, LimitOptions):
        whole = config.split <= 0
        own["split"] = 1.0 if whole else config.split
        own["effort"] = (config.effort, 1.0) if whole else (1.0, config.effort)
        own["speed"] = (config.speed, 1.0) if whole else (1.0, config.speed)
    return ExcitationDesign(seconds=config.seconds, balance_s=balance_s, **own)


def _sway(config: SwaySettings, description: RobotDescription) -> ExcitationPlan:
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
    config: OptimalSettings,
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


def _knowledge(config: OptimalSettings) -> ParameterDistribution:
    if config.calibration is not None:
        from deal_hw.workflows.train import read_distribution

        path = Path(config.calibration)
        return read_distribution(path / "distribution.json" if path.is_dir() else path)
    table = described_spaces(config.robot)
    name = config.space or next(iter(table))
    if name not in table:
        raise UnknownNameError("parameter set", name, table)
    return ParameterDistribution.uniform(table[name]().with_ratio(config.range_ratio), LATENCY_RANGE_S)
