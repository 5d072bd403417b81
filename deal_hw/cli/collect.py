"""``deal-hw collect``: record the robot while it moves with an informative motion."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from deal_hw.calibration import SHORTEST_S
from deal_hw.cli.episode_report import RunReport
from deal_hw.cli.link import RunOptions, plan_options
from deal_hw.cli.run_plan import RunPlan
from deal_hw.cli.supervised import dataset_folder, run_episodes
from deal_hw.control.excitation import RichConfig
from deal_hw.control.excitation_level import ATTEMPTS, HIGHEST_LEVEL, LOWEST_LEVEL
from deal_hw.control.excitation_plan import FAMILIES, read_plan
from deal_hw.workflows.options import Range, RunSeconds, Seed, given, refuse
from deal_hw.workflows.shipped import shipped_policy

EXCITATION_FILE = "excitation.json"
"""Where the excitation of `--excite optimal` is kept, in the run folder."""
SHORT_S = 1.5 * SHORTEST_S
"""Recordings below this are told to be short: not every sample is usable [s]."""


@dataclass(frozen=True, kw_only=True)
class Collect(RunOptions):
    """Record the robot while it moves with an informative motion."""

    robot: tyro.conf.Positional[str]
    """The robot, such as cartpole."""

    profile: Literal["rich", "chirp", "balance", "hold"] = "rich"
    """rich: balance, then random set-points; chirp: a sine sweep (for held-out data); balance: the policy all
    the time; hold: the start pose."""

    excite: str = ""
    """Play this instead of a profile: multisine, chirp, optimal (computed first; needs deal-hw[calib]), or a
    file that `deal-hw design-excitation` wrote, which says how long it is."""

    policy: Path | None = None
    """Policy that balances (.onnx); by default the one shipped for the robot."""

    seconds: RunSeconds = 4.0
    """Length of an episode [s]."""

    episodes: Annotated[int, Range(1, 10_000)] = 1
    """How many episodes."""

    excitation_level: Annotated[float, Range(LOWEST_LEVEL, HIGHEST_LEVEL)] = 0.0
    """Start profile rich stronger (1 to 3) or gentler (-1 to -3): amplitude, holds, gains and limits, inside
    the safety limits."""

    attempts: Annotated[int, Range(1, 100)] = ATTEMPTS
    """How often an episode of profile rich is recorded at most: one that hardly moves is repeated stronger.
    After a trip nothing is repeated; look at the robot first."""

    seed: Seed = 0
    """Fixes the random set-points; episode k uses SEED + k."""

    rich: tyro.conf.Suppress[RichConfig] = field(default_factory=RichConfig)
    """Settings of the profile `rich`; its length is SECONDS."""


def collect(config: Collect) -> RunReport:
    """Record episodes and return how they went.

    Raises:
        DealHwError: What made it fail; the robot is passive and what was recorded is whole.
    """
    _refuse_ignored(config)
    policy = config.policy or shipped_policy(config.robot)
    excite, seconds = _excitation(config)
    if seconds * config.episodes < SHORT_S and not config.quiet:
        print(
            f"warning: {seconds * config.episodes:g} s in all is too short for `deal-hw calibrate`, which "
            f"needs {SHORTEST_S:g} s of usable samples; 4 s are enough (--seconds 4)",
            file=sys.stderr,
        )
    walks = config.profile == "balance" and not excite
    plan = RunPlan(
        **plan_options(config.robot, config.link, config.legs, walks=walks),
        profile="excite" if excite else config.profile,
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
        quiet=config.quiet,
        attempts=config.attempts,
    )


def _refuse_ignored(config: Collect) -> None:
    """Refuse options that the motion would ignore.

    Raises:
        ConfigurationError: There is one.
    """
    default = Collect(robot=config.robot, port=config.port)
    if config.excite:
        refuse(given(config, default, ["profile"]), "--excite plays its own motion; leave one of the two out")
    if config.excite or config.profile != "rich":
        refuse(
            given(config, default, ["excitation_level", "attempts"]), "only --profile rich can be stronger"
        )
    if not config.excite and config.profile in ("chirp", "hold"):
        refuse(given(config, default, ["policy"]), f"--profile {config.profile} runs no policy")


def _excitation(config: Collect) -> tuple[str, float]:
    """Return what the control process is told to play, and for how long [s]; compute what is optimal."""
    if not config.excite or config.excite in FAMILIES:
        return config.excite, config.seconds
    if config.excite != "optimal":
        path = Path(config.excite)
        plan = read_plan(path)
        if config.seconds not in (plan.seconds, Collect.seconds):
            refuse(["--seconds"], f"{path} says that it is {plan.seconds:g} s long; leave it out")
        return str(path), plan.seconds
    # Only here: the rest of this verb runs on computers without the extras.
    from deal_hw.cli.design_excitation import DesignExcitation, design_excitation

    folder = dataset_folder(config.out, config.dataset)
    if folder is None:
        raise RuntimeError("unreachable: dataset_folder() raises where neither folder was given")
    path = folder.parent / EXCITATION_FILE
    report = design_excitation(
        DesignExcitation(
            robot=config.robot,
            out=path,
            seconds=config.seconds,
            policy=config.policy,
            seed=config.seed,
            quiet=config.quiet,
        )
    )
    return str(path), report.plan.seconds
