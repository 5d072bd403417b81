"""``deal_hw.deploy``: run a policy on the robot behind the safety filter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from deal_hw.ranges import Range
from deal_hw.workflows.options import File, RunSeconds, Seed, from_settings
from deal_hw.workflows.robot import name_of
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
    RunOptions,
    crane_of,
    legs_of,
    plan_options,
    refuse_unrecorded,
)
from deal_hw.workflows.running.supervised import recording_folder, run_episodes
from deal_hw.workflows.running.view import RunView
from deal_hw.workflows.shipped import policy_file


@dataclass(frozen=True, kw_only=True)
class DeploySettings(RunOptions):
    """Run a policy on a robot behind the safety filter, and record it."""

    robot: str = field(kw_only=False)
    """The robot, such as cartpole."""

    policy: File | None = None
    """The policy (.onnx), or canter, canter_amp, climb or climb_rma for one that is shipped for a Go2; by
    default the robot's usual one."""

    seconds: RunSeconds = 10.0
    """Length of an episode [s]."""

    episodes: Annotated[int, Range(1, 10_000)] = 1
    """Number of episodes."""

    seed: Seed = 0
    """Only noted in the recording, since the policy is not random."""

    task: str = ""
    """Description of the task, for the recording."""

    trust_calibration: bool = False
    """Run a policy without a question or warning if its calibration, or its import, has a red or amber
    verdict."""

    record: bool = True
    """Record the episodes."""

    dry_run: bool = False
    """Compute everything but send no command: the robot is neither homed nor armed. Recorded only with --out
    or --dataset."""

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_unrecorded(self, self.record)


@dataclass(frozen=True, kw_only=True)
class DeployCartpoleSettings(CartpoleRunOptions, DeploySettings):
    """Run a policy on a cart-pole behind the safety filter, and record it."""


@dataclass(frozen=True, kw_only=True)
class DeploySo101Settings(DeploySettings):
    """Run a policy on an SO-101 behind the safety filter, and record it."""

    target: str = ""
    """Pose to reach: the joints' positions [rad], such as 0.2,-0.5,0.4,0,0,0; or a script: a CSV file with
    time_s and a column for each joint. By default the start pose."""


@dataclass(frozen=True, kw_only=True)
class DeployLeggedSettings(DeploySettings):
    """Run a policy on a robot with legs behind the safety filter, and record it."""

    legs: LegOptions = field(default_factory=LegOptions)
    """Options of a robot with legs."""


@dataclass(frozen=True, kw_only=True)
class DeployGo2Settings(Go2RunOptions, DeployLeggedSettings):
    """Run a policy on a Go2 behind the safety filter, and record it."""


@dataclass(frozen=True, kw_only=True)
class DeployB2Settings(B2RunOptions, DeployLeggedSettings):
    """Run a policy on a B2 behind the safety filter, and record it."""


@dataclass(frozen=True, kw_only=True)
class DeployG1Settings(G1RunOptions, DeploySettings):
    """Run a policy on a G1 that hangs on a crane behind the safety filter, and record it.

    It moves the limbs in the air. Walking is not supported: the robot stays on the crane to the end.
    """


@dataclass(frozen=True, kw_only=True)
class DeployH1Settings(H1RunOptions, DeploySettings):
    """Run a policy on an H1 that hangs on a crane behind the safety filter, and record it.

    It moves the limbs in the air. Walking is not supported: the robot stays on the crane to the end.
    """


DEPLOY = robot_kinds(
    {
        "cartpole": DeployCartpoleSettings,
        "go2": DeployGo2Settings,
        "b2": DeployB2Settings,
        "g1": DeployG1Settings,
        "h1": DeployH1Settings,
        "so101": DeploySo101Settings,
    },
    plain=DeploySettings,
    legged=DeployLeggedSettings,
    example="--port {port} --policy runs/first/policies/policy.onnx",
)
"""The kinds of :func:`deploy`."""


@from_settings(DEPLOY)
def deploy(settings: DeploySettings) -> RunReport:
    """Run a policy on the robot behind the safety filter, and record it, as ``deal-hw deploy``.

    ``deal-hw deploy ROBOT --help-all`` describes the arguments: ``deploy("cartpole", port="/dev/ttyUSB0",
    policy="policy.onnx", out="runs/first")``.

    Returns:
        How the episodes went, with the paths of the recordings.

    Raises:
        PolicyMismatchError: The policy was made for another robot; the message names what differs.
        DealHwError: A setting is unusable, or the run failed; the robot is passive and the recordings are
            complete.
        InterruptedRunError: Ctrl-C; the robot is passive.
    """
    return run(settings, RunView.of_python(settings.say))


def run(config: DeploySettings, view: RunView) -> RunReport:
    """Run the policy, as :func:`deploy`, and show it."""
    policy = policy_file(config.robot, config.policy)
    plan = RunPlan(
        **plan_options(config.robot, config.link, legs_of(config), crane=crane_of(config)),
        motion="balance",
        policy=str(policy or ""),
        target=config.target if isinstance(config, DeploySo101Settings) else "",
        seconds=config.seconds,
        seed=config.seed,
        dry_run=config.dry_run,
        trust_calibration=config.trust_calibration,
        home=not config.dry_run,
    )
    return run_episodes(
        plan,
        port=config.port,
        dataset=recording_folder(
            config.out,
            config.dataset,
            "deploy",
            name_of(config.robot),
            record=config.record and not config.dry_run,
        ),
        episodes=config.episodes,
        purpose="deploy",
        task=config.task,
        view=view,
    )
