"""``deal_hw.collect``: record the robot during an informative motion."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from deal_hw.calibration import SHORTEST_S
from deal_hw.motions.excitation.behaviours import RichConfig
from deal_hw.motions.excitation.level import ATTEMPTS, HIGHEST_LEVEL, LOWEST_LEVEL
from deal_hw.motions.excitation.plan import FAMILIES, read_plan
from deal_hw.ranges import Range
from deal_hw.workflows.options import OWN_ROBOT, File, RunSeconds, Seed, from_settings, given, refuse
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.settings import RunOptions, plan_options
from deal_hw.workflows.running.simulated import (
    SimulationOptions,
    check_simulation,
    require_driver,
    run_simulated,
)
from deal_hw.workflows.running.supervised import dataset_folder, run_episodes
from deal_hw.workflows.running.view import RunView
from deal_hw.workflows.shipped import shipped_policy

EXCITATION_FILE = "excitation.json"
"""File of the excitation of `--excite optimal`, in the run folder."""
SHORT_S = 1.5 * SHORTEST_S
"""Shorter recordings give a warning, since not every sample is usable [s]."""


@dataclass(frozen=True, kw_only=True)
class CollectSettings(RunOptions):
    """Settings of :func:`collect`."""

    robot: str = field(kw_only=False)
    """The robot, such as cartpole. With --simulated a robot.yaml, or a dataset with its own robot.yaml."""

    port: str = ""
    """The robot's port: a serial port such as /dev/ttyUSB0, a CAN bus such as can0 or
    slcan:/dev/ttyACM0?bitrate=500000&node=1, a network interface (dds), or an end point such as
    tcp/127.0.0.1:7447 (zenoh)."""

    simulation: Annotated[SimulationOptions, OWN_ROBOT] = field(default_factory=SimulationOptions)
    """Your own robot, in simulation."""

    motion: Literal["rich", "chirp", "balance", "hold"] = "rich"
    """rich: balance, then random set-points (with --simulated only set-points, with the robot's own gains);
    chirp: a sine sweep, for held-out data; balance: the policy all the time; hold: the start pose."""

    excite: str = ""
    """Play this excitation instead of MOTION: multisine, chirp, optimal (computed first; needs
    deal-hw[calib]), or a file of `deal-hw design-excitation`, which also sets the length."""

    policy: File | None = None
    """Policy that balances the robot (.onnx); by default the shipped one."""

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

    rich: RichConfig = field(default_factory=RichConfig)
    """Settings of the motion `rich`; its length is SECONDS."""


@from_settings(CollectSettings)
def collect(settings: CollectSettings) -> RunReport:
    """Record the robot during an informative motion, as ``deal-hw collect``.

    :class:`CollectSettings` and ``deal-hw collect --help-all`` describe the arguments: ``collect("cartpole",
    port="/dev/ttyUSB0", out="runs/first")``.

    Returns:
        How the episodes went, with the paths of the recordings.

    Raises:
        DealHwError: A setting is unusable, or the run failed; the robot is passive and the recordings are
            complete.
        InterruptedRunError: Ctrl-C; the robot is passive.
    """
    return run(settings, RunView.of_python(settings.say))


def run(config: CollectSettings, view: RunView) -> RunReport:
    """Record episodes, as :func:`collect`, and show them."""
    _refuse_ignored(config)
    if config.simulation.simulated:
        return _rehearse(config, view)
    require_driver(config.robot, config.port)
    policy = config.policy or shipped_policy(config.robot)
    excite, seconds = _excitation(config, view)
    if seconds * config.episodes < SHORT_S:
        view.note(
            f"warning: {seconds * config.episodes:g} s in total are too short: `deal-hw calibrate` needs "
            f"{SHORTEST_S:g} s of usable samples; record 4 s (--seconds 4)"
        )
    walks = config.motion == "balance" and not excite
    plan = RunPlan(
        **plan_options(config.robot, config.link, config.legs, walks=walks),
        motion="excite" if excite else config.motion,
        policy=str(policy or ""),
        seconds=seconds,
        seed=config.seed,
        rich=config.rich,
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


def _rehearse(config: CollectSettings, view: RunView) -> RunReport:
    """Record a user's robot in simulation."""
    folder = dataset_folder(config.out, config.dataset)
    excite, seconds = _excitation(config, view)
    plan = RunPlan(
        robot=config.robot,
        motion="excite" if excite else config.motion,
        policy=str(config.policy or ""),
        seconds=seconds,
        seed=config.seed,
        rich=dataclasses.replace(config.rich, balance_s=0.0, segments=()),
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


def _refuse_ignored(config: CollectSettings) -> None:
    """Refuse options that the motion would ignore.

    Raises:
        ConfigurationError: There is one.
    """
    default = CollectSettings(robot=config.robot, port=config.port)
    check_simulation(config, default)
    if config.simulation.simulated:
        refuse(given(config, default, ["policy"]), "--simulated runs no policy")
    if config.excite:
        refuse(given(config, default, ["motion"]), "--excite plays its own motion; leave one of the two out")
    if config.excite or config.motion != "rich":
        refuse(given(config, default, ["excitation_level", "attempts"]), "only --motion rich can be stronger")
    if not config.excite and config.motion in ("chirp", "hold"):
        refuse(given(config, default, ["policy"]), f"--motion {config.motion} runs no policy")


def _excitation(config: CollectSettings, view: RunView) -> tuple[str, float]:
    """Return the excitation for the control process and its length [s]; an optimal one is computed here."""
    if not config.excite or config.excite in FAMILIES:
        return config.excite, config.seconds
    if config.excite != "optimal":
        path = Path(config.excite)
        plan = read_plan(path)
        if config.seconds not in (plan.seconds, CollectSettings.seconds):
            refuse(["--seconds"], f"{path} sets the length, {plan.seconds:g} s; leave it out")
        return str(path), plan.seconds
    # Imported here, since the rest of this verb runs without the extras.
    from deal_hw.workflows import design_excitation

    path = dataset_folder(config.out, config.dataset).parent / EXCITATION_FILE
    settings = design_excitation.ExcitationSettings(
        config.robot, out=path, seconds=config.seconds, policy=config.policy, seed=config.seed
    )
    report = design_excitation.run(settings, view.notify)
    view.designed(config.robot, report)
    return str(path), report.plan.seconds
