"""``deal_hw.collect``: record the robot during an informative motion."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from deal_hw.data.checks.samples import SHORTEST_S
from deal_hw.motions.excitation.behaviours import RichConfig
from deal_hw.motions.excitation.level import ATTEMPTS, HIGHEST_LEVEL, LOWEST_LEVEL
from deal_hw.ranges import Range
from deal_hw.workflows.options import FROM_PYTHON, File, RunSeconds, Seed, from_settings, given, refuse
from deal_hw.workflows.robot_kinds import robot_kinds
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.settings import (
    B2RunOptions,
    CartpoleRunOptions,
    G1RunOptions,
    Go2RunOptions,
    H1RunOptions,
    LegOptions,
    RecordOptions,
    RunOptions,
    SimulationOptions,
    crane_of,
    legs_of,
    plan_options,
    require_simulation,
)
from deal_hw.workflows.running.supervised import dataset_folder, run_episodes
from deal_hw.workflows.running.view import RunView
from deal_hw.workflows.shipped import balancing_policy, stands_alone

EXCITATION_FILE = "excitation.json"
"""File of the excitation of `--excite optimal`, in the run folder."""


@dataclass(frozen=True, kw_only=True)
class MotionOptions(RecordOptions):
    """The motion to record, of every kind of robot."""

    robot: str = field(kw_only=False)
    """The robot, such as cartpole."""

    excite: str = ""
    """Play this excitation instead of MOTION: multisine, chirp, optimal (computed first; needs
    deal-hw[calib]), or a file of `deal-hw design-excitation`, which also sets the length."""

    seconds: RunSeconds = 4.0
    """Length of an episode [s]."""

    episodes: Annotated[int, Range(1, 10_000)] = 1
    """Number of episodes."""

    excitation_level: Annotated[float, Range(LOWEST_LEVEL, HIGHEST_LEVEL)] = 0.0
    """Start motion rich stronger (1 to 3) or gentler (-1 to -3). Changes amplitude, hold times, gains and
    limits, within the safety limits."""

    attempts: Annotated[int, Range(1, 100)] = ATTEMPTS
    """How often an episode of motion rich is recorded at most. One that hardly moves is repeated with a
    stronger motion. After a trip nothing is repeated: check the robot first."""

    seed: Seed = 0
    """Seed of the random set-points; episode k uses SEED + k."""

    rich: Annotated[RichConfig, FROM_PYTHON] = field(default_factory=RichConfig)
    """Settings of the motion `rich`; its length is SECONDS."""


@dataclass(frozen=True, kw_only=True)
class CollectSettings(RunOptions, MotionOptions):
    """Record a robot during an informative motion."""

    motion: Literal["rich", "chirp", "balance", "hold"] = "rich"
    """rich: balance, then random set-points; chirp: a sine sweep, for held-out data; balance: the policy all
    the time; hold: the start pose."""

    policy: File | None = None
    """Policy that balances the robot (.onnx); by default the shipped one."""


@dataclass(frozen=True, kw_only=True)
class CollectCartpoleSettings(CartpoleRunOptions, CollectSettings):
    """Record a cart-pole during an informative motion."""


@dataclass(frozen=True, kw_only=True)
class CollectLeggedSettings(CollectSettings):
    """Record a robot with legs during an informative motion."""

    legs: LegOptions = field(default_factory=LegOptions)
    """Options of a robot with legs."""


@dataclass(frozen=True, kw_only=True)
class CollectGo2Settings(Go2RunOptions, CollectLeggedSettings):
    """Record a Go2 during an informative motion."""


@dataclass(frozen=True, kw_only=True)
class CollectB2Settings(B2RunOptions, CollectLeggedSettings):
    """Record a B2 during an informative motion."""


@dataclass(frozen=True, kw_only=True)
class CollectG1Settings(G1RunOptions, CollectSettings):
    """Record a G1 that hangs on a crane during an informative motion."""

    seconds: RunSeconds = 10.0
    """Length of an episode; the first 3 s lead into the motion [s]."""


@dataclass(frozen=True, kw_only=True)
class CollectH1Settings(H1RunOptions, CollectSettings):
    """Record an H1 that hangs on a crane during an informative motion."""

    seconds: RunSeconds = 10.0
    """Length of an episode; the first 3 s lead into the motion [s]."""


@dataclass(frozen=True, kw_only=True)
class CollectSimulatedSettings(MotionOptions):
    """Record your own robot in simulation, during an informative motion."""

    robot: str = field(kw_only=False)
    """Your robot: a robot.yaml, or a dataset with its own robot.yaml."""

    motion: Literal["rich", "chirp", "hold"] = "rich"
    """rich: random set-points, with the robot's own gains; chirp: a sine sweep, for held-out data; hold: the
    start pose."""

    simulation: SimulationOptions = field(default_factory=SimulationOptions)
    """The simulation."""


COLLECT = robot_kinds(
    {
        "cartpole": CollectCartpoleSettings,
        "go2": CollectGo2Settings,
        "b2": CollectB2Settings,
        "g1": CollectG1Settings,
        "h1": CollectH1Settings,
    },
    plain=CollectSettings,
    legged=CollectLeggedSettings,
    simulated=CollectSimulatedSettings,
    example="--port {port} --out runs/first",
    simulated_example="--simulated --out runs/first",
)
"""The kinds of :func:`collect`."""


@from_settings(COLLECT)
def collect(settings: CollectSettings | CollectSimulatedSettings) -> RunReport:
    """Record the robot during an informative motion, as ``deal-hw collect``.

    ``deal-hw collect ROBOT --help-all`` describes the arguments: ``collect("cartpole", port="/dev/ttyUSB0",
    out="runs/first")``.

    Returns:
        How the episodes went, with the paths of the recordings.

    Raises:
        DealHwError: A setting is unusable, or the run failed; the robot is passive and the recordings are
            complete.
        InterruptedRunError: Ctrl-C; the robot is passive.
    """
    return run(settings, RunView.of_python(settings.say))


def run(config: CollectSettings | CollectSimulatedSettings, view: RunView) -> RunReport:
    """Record episodes, as :func:`collect`, and show them."""
    _refuse_ignored(config)
    if isinstance(config, CollectSimulatedSettings):
        return _rehearse(config, view)
    policy = config.policy or balancing_policy(config.robot)
    excite, seconds = _excitation(config, view)
    if seconds < SHORTEST_S:
        view.note(
            f"warning: {seconds:g} s are too short: `deal-hw calibrate` takes recordings of {SHORTEST_S:g} s "
            "and more; record 4 s (--seconds 4)"
        )
    walks = config.motion == "balance" and not excite
    plan = RunPlan(
        **plan_options(config.robot, config.link, legs_of(config), crane=crane_of(config), walks=walks),
        motion="excite" if excite else config.motion,
        policy=str(policy or ""),
        seconds=seconds,
        seed=config.seed,
        rich=config.rich if policy or not stands_alone(config.robot) else without_balance(config.rich),
        excitation_level=config.excitation_level,
        excite=excite,
    )
    return run_episodes(
        plan,
        port=config.port,
        dataset=dataset_folder(config.out, config.dataset),
        episodes=config.episodes,
        purpose="collect",
        view=view,
        attempts=config.attempts,
    )


def _rehearse(config: CollectSimulatedSettings, view: RunView) -> RunReport:
    """Record a user's robot in simulation."""
    from deal_hw.workflows.running.simulated import run_simulated

    require_simulation(config.robot, config.simulation)
    folder = dataset_folder(config.out, config.dataset)
    excite, seconds = _excitation(config, view)
    plan = RunPlan(
        robot=config.robot,
        motion="excite" if excite else config.motion,
        seconds=seconds,
        seed=config.seed,
        rich=without_balance(config.rich),
        excitation_level=config.excitation_level,
        excite=excite,
    )
    return run_simulated(
        plan,
        config.robot,
        config.simulation,
        dataset=folder,
        episodes=config.episodes,
        purpose="collect",
        view=view,
        attempts=config.attempts,
    )


def without_balance(config: RichConfig) -> RichConfig:
    """Return the settings of random set-points alone, for a robot that stands without a policy."""
    return dataclasses.replace(config, balance_s=0.0, segments=())


def _refuse_ignored(config: CollectSettings | CollectSimulatedSettings) -> None:
    """Refuse options that the motion would ignore.

    Raises:
        ConfigurationError: There is one.
    """
    kind = type(config)
    if config.excite:
        refuse(given(config, kind, ["motion"]), "--excite plays its own motion; leave one of the two out")
    if config.excite or config.motion != "rich":
        refuse(given(config, kind, ["excitation_level", "attempts"]), "only --motion rich can be stronger")
    if isinstance(config, CollectSettings) and not config.excite and config.motion in ("chirp", "hold"):
        refuse(given(config, kind, ["policy"]), f"--motion {config.motion} runs no policy")


def _excitation(config: CollectSettings | CollectSimulatedSettings, view: RunView) -> tuple[str, float]:
    """Return the excitation for the control process and its length [s]; an optimal one is computed here."""
    if not config.excite:
        return "", config.seconds
    from deal_hw.motions.excitation.plan import FAMILIES, read_plan

    if config.excite in FAMILIES:
        return config.excite, config.seconds
    if config.excite != "optimal":
        path = Path(config.excite)
        plan = read_plan(path)
        if config.seconds not in (plan.seconds, MotionOptions.seconds):
            refuse(["--seconds"], f"{path} sets the length, {plan.seconds:g} s; leave it out")
        return str(path), plan.seconds
    # Imported here, since the rest of this verb runs without the extras.
    from deal_hw.workflows import design_excitation

    path = dataset_folder(config.out, config.dataset).parent / EXCITATION_FILE
    settings = design_excitation.OptimalSettings(
        config.robot,
        out=path,
        seconds=config.seconds,
        policy=getattr(config, "policy", None),
        seed=config.seed,
    )
    report = design_excitation.run(settings, view.notify)
    view.designed(config.robot, report)
    return str(path), report.plan.seconds
