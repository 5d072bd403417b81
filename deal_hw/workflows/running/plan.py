"""The plan of a run for a control process, and the robot and behaviour that follow from it.

All values are plain, since they cross a process boundary as JSON. Imports neither torch, mujoco nor scipy.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, PolicyError, UnknownNameError
from deal_hw.motions.behaviours import Behaviour, HoldBehaviour, PolicyBehaviour, ReplayBehaviour
from deal_hw.motions.excitation.behaviours import ChirpBehaviour, ChirpConfig, RichBehaviour, RichConfig
from deal_hw.motions.excitation.level import with_excitation_level
from deal_hw.motions.joint_targets import make_targets
from deal_hw.motions.obstacle import BLIND, parse_obstacle
from deal_hw.motions.planned_end import PlannedEnd
from deal_hw.motions.posture import PostureBehaviour, PostureConfig
from deal_hw.motions.velocity import (
    BoundedSource,
    HeldHeading,
    SlowedVelocity,
    VelocitySource,
    check_fast,
    limited_axes,
    make_source,
)
from deal_hw.policy import CLIMBED, IMPORTED, VERDICT, Policy, PolicySpec
from deal_hw.schema import OPEN, from_values, plain
from deal_hw.transport import WireOptions
from deal_hw.workflows.running.view import RunView

if TYPE_CHECKING:
    from deal_hw.motions.excitation.plan import ExcitationPlan

Motion = Literal["rich", "chirp", "balance", "hold", "replay", "excite"]
"""Motions of a run; `balance` runs the policy all the time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPlan:
    """One run of one robot.

    Attributes:
        robot: Its name.
        transport: Name of the transport.
        motion: The motion.
        policy: Policy file; "" for none.
        trust_calibration: Whether to run a policy without a question or warning about its verdict.
        policy_digest: SHA-256 of the checked policy file, the only one that will be opened; "" if none was
        checked.
        recording: Episode to replay; "" for none.
        seconds: Length of the run [s].
        seed: Seed of the behaviour's random numbers.
        dry_run: Whether to compute everything but send no command.
        home: Whether to bring the robot to its start pose first.
        rich: Settings of the motion `rich`; its length is ``seconds``.
        excitation_level: Steps by which the motion `rich` is stronger, or gentler if negative.
        excite: What the motion `excite` plays: `chirp`, `multisine`, or a file of
            `deal-hw design-excitation`.
        port: The robot's port, for transports without a descriptor to inherit.
        wire: Options of a transport of topics.
        target: Poses that an arm's policy is to reach; see
        :func:`deal_hw.motions.joint_targets.make_targets`.
        velocity: Source of a walking policy's requested velocity; see
        :func:`deal_hw.motions.velocity.make_source`.
        hold_heading: Whether the requested turn is corrected by the robot's inertial sensor.
        obstacle: A platform ahead, as the operator says it; see
        :func:`deal_hw.motions.obstacle.parse_obstacle`.
        stand: Whether to stand up first and to lie down at the end; not counted in ``seconds``.
        posture: Durations of standing up and lying down.
        robot_settings: The driver's own settings.
        hand_back: Whether to return the robot to its own controller at the end.
        record_wire: Whether to record the raw bytes as well.
        realtime: Whether to ask for SCHED_FIFO and locked memory.
        passive_timeout_s: How long the passive command is repeated at the end until the robot confirms it
            [s].
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN

    robot: str
    transport: str = "serial"
    motion: Motion = "balance"
    policy: str = ""
    trust_calibration: bool = False
    policy_digest: str = ""
    recording: str = ""
    seconds: float = 4.0
    seed: int = 0
    dry_run: bool = False
    home: bool = True
    rich: RichConfig = field(default_factory=RichConfig)
    excitation_level: float = 0.0
    excite: str = ""
    port: str = ""
    wire: WireOptions = field(default_factory=WireOptions)
    target: str = ""
    velocity: str = "0,0,0"
    hold_heading: bool = False
    obstacle: str = BLIND
    stand: bool = False
    posture: PostureConfig = field(default_factory=PostureConfig)
    robot_settings: dict[str, Any] = field(default_factory=dict)
    hand_back: bool = False
    record_wire: bool = True
    realtime: bool = True
    passive_timeout_s: float = 30.0

    def __post_init__(self) -> None:
        if self.motion not in get_args(Motion):
            raise UnknownNameError("motion", self.motion, get_args(Motion))
        if not 0 < self.seconds < float("inf"):
            raise ConfigurationError(
                f"--seconds {self.seconds!r}: the length of a run is a finite number of seconds above 0"
            )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values: dict[str, Any] = plain(self, finite=False)
        return values

    @property
    def total_s(self) -> float:
        """Length of the run with standing up, slowing down, standing still and lying down [s]."""
        if not self.stand:
            return self.seconds
        return self.posture.before_s + self.seconds + self.posture.after_s(slows=self.motion == "balance")

    @property
    def longest_s(self) -> float:
        """Most time that the run may take: a robot is waited for until it stands still [s]."""
        return self.total_s + (self.posture.patience_s if self.stand else 0.0)

    def velocity_source(self) -> BoundedSource:
        """Return the source of the requested velocity.

        Raises:
            ConfigurationError: ``velocity`` is not the name of a source.
        """
        return make_source(self.velocity)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> RunPlan:
        """Return the plan that :meth:`to_json` wrote; other keys are ignored."""
        return from_values(cls, values)


def check_plan(plan: RunPlan, description: RobotDescription, view: RunView | None = None) -> RunPlan:
    """Check everything that a plan names, before the robot is used.

    A policy is tried in its own process, see :mod:`deal_hw.policies.trial`; this process does not open its
    network.

    Args:
        plan: The plan.
        description: The robot.
        view: Shows messages and asks questions; by default none.

    Returns:
        The plan, with the digest of the policy that was checked.

    Raises:
        DealHwError: As :func:`make_behaviour`; also if the policy fails its trial.
    """
    with contextlib.ExitStack() as stack:
        digests = [""]

        def load(plan: RunPlan) -> Policy:
            from deal_hw.policies.trial import TrialPolicy, try_policy

            policy = stack.enter_context(TrialPolicy(Path(plan.policy)))
            try_policy(policy, description)
            digests.append(policy.digest)
            verdict = policy.spec.training.get(VERDICT)
            if verdict == "red" and not plan.trust_calibration:
                _ask(Path(plan.policy), policy.spec, view or RunView())
            elif verdict == "amber" and not plan.trust_calibration and view is not None:
                view.warn(_amber(Path(plan.policy), policy.spec))
            _ask_height(plan, policy.spec, view or RunView())
            walks = plan.motion not in ("excite", "rich")
            if walks:
                check_fast(plan.velocity_source(), policy.spec.command_range)
            limited = limited_axes(plan.velocity_source(), policy.spec.command_range) if walks else []
            if limited and view is not None:
                view.warn(
                    f"--velocity {plan.velocity} may request more [m/s, m/s, rad/s] than "
                    f"{Path(plan.policy).stem} was trained for; it is limited: {'; '.join(limited)}"
                )
            return policy

        make_behaviour(plan, description, load=load)
    return dataclasses.replace(plan, policy_digest=digests[-1])


def _amber(policy: Path, spec: PolicySpec) -> str:
    """Return the warning about a policy with an amber verdict."""
    imported = _import_of(spec)
    if imported is not None:
        return (
            f"{policy.name} was imported, but could not be tried in the simulator "
            f"({imported.get('untried')}): nothing shows that joint order, signs and scales are right; hold "
            "or hang the robot, and be ready to stop it (Ctrl-C)"
        )
    return (
        f"{policy.name} was trained under a calibration with an amber verdict: the calibrated model does not "
        "explain all of the robot's motion; read the alarms in its report, and be ready to stop the robot "
        "(Ctrl-C)"
    )


def _ask(policy: Path, spec: PolicySpec, view: RunView) -> None:
    """Ask whether to run a policy with a red verdict.

    Raises:
        PolicyError: The answer is no, or no operator can answer.
    """
    imported = _import_of(spec)
    if imported is not None:
        seen = (
            f"{policy.name} was imported although it failed in the simulator ({imported.get('fault')}): a "
            "joint order, a sign or a scale may be wrong"
        )
        do = "import it again with what its training used"
    else:
        seen = (
            f"{policy.name} was trained under a calibration with a red verdict: the calibrated model "
            "predicts the robot worse than the original one, or no held-out data show that it is better"
        )
        do = "calibrate again and retrain"
    _confirm(view, seen, do, "run it with --trust-calibration")


def _ask_height(plan: RunPlan, spec: PolicySpec, view: RunView) -> None:
    """Ask whether to climb a platform that is higher than those of the policy's training.

    Raises:
        PolicyError: The answer is no, or no operator can answer.
    """
    climbed, (_, height) = spec.training.get(CLIMBED), parse_obstacle(plan.obstacle)
    if not isinstance(climbed, int | float) or height <= climbed + 1e-9:
        return
    seen = (
        f"--obstacle {plan.obstacle} is a platform of {height:g} m, and the highest that most robots climbed "
        f"in the training of {Path(plan.policy).name} is {climbed:g} m: the robot may fall"
    )
    _confirm(view, seen, f"use a platform of at most {climbed:g} m", "answer the question in a terminal")


def _confirm(view: RunView, seen: str, do: str, otherwise: str) -> None:
    """Ask whether to run all the same.

    Raises:
        PolicyError: The answer is no, or no operator can answer.
    """
    answer = view.confirm(f"warning: {seen}", "run it all the same?")
    if answer is None:
        raise PolicyError(f"{seen}; {do}, or {otherwise}")
    if not answer:
        raise PolicyError(f"not run; {do}")


def _import_of(spec: PolicySpec) -> Mapping[str, Any] | None:
    """Return the record of an import; None for a policy that was trained here."""
    found = spec.training.get(IMPORTED)
    return found if isinstance(found, Mapping) else None


def _open_policy(plan: RunPlan) -> Policy:
    from deal_hw.policies.onnx_runtime import OnnxPolicy

    return OnnxPolicy(plan.policy, plan.policy_digest)


def make_behaviour(
    plan: RunPlan,
    description: RobotDescription,
    source: VelocitySource | None = None,
    load: Callable[[RunPlan], Policy] = _open_policy,
    end: PlannedEnd | None = None,
) -> Behaviour:
    """Return the behaviour that the plan describes.

    Args:
        plan: The plan.
        description: The robot.
        source: The requested velocity of a walking policy; by default from the plan.
        load: Called for the plan's policy, if its motion needs one.
        end: The planned end of a robot that lies down.

    Raises:
        PolicyError: The policy is missing or cannot run, or a flat one is told of a platform.
        PolicyMismatchError: It was made for another robot.
        DatasetError: The recording cannot be replayed.
    """
    source = source or plan.velocity_source()
    source = SlowedVelocity(HeldHeading(source) if plan.hold_heading else source)
    inner = _inner_behaviour(plan, description, source, lambda: _loaded(plan, load))
    if not plan.stand:
        return inner
    walks = isinstance(inner, PolicyBehaviour) and inner.follows_velocity
    return PostureBehaviour(
        inner, description, plan.seconds, plan.posture, slowed=source if walks else None, end=end
    )


def _inner_behaviour(
    plan: RunPlan, description: RobotDescription, source: VelocitySource, policy: Callable[[], Policy]
) -> Behaviour:
    if plan.motion == "hold":
        return HoldBehaviour(description)
    if plan.motion == "chirp":
        return ChirpBehaviour(description, ChirpConfig(duration_s=plan.seconds))
    if plan.motion == "replay":
        from deal_hw.data.recording.reader import read_trajectory

        return ReplayBehaviour(read_trajectory(Path(plan.recording)), description)
    if plan.motion == "excite":
        from deal_hw.motions.excitation.plan import ExcitationBehaviour

        excitation = find_excitation(plan, description)
        balance = PolicyBehaviour(policy(), description) if excitation.balance_s > 0 else None
        return ExcitationBehaviour(excitation, description, balance)
    if plan.motion == "rich":
        config = with_excitation_level(plan.rich, plan.excitation_level, description)
        config = dataclasses.replace(config, duration_s=plan.seconds)
        balance = PolicyBehaviour(policy(), description) if config.balance_s > 0 else None
        return RichBehaviour(description, balance, config, plan.seed)
    targets, obstacle = make_targets(plan.target, description), parse_obstacle(plan.obstacle)
    found = PolicyBehaviour(policy(), description, source, targets.at, obstacle)
    if any(obstacle) and not found.follows_obstacle:
        raise PolicyError(
            f"{Path(plan.policy).stem} does not observe a platform, so --obstacle {plan.obstacle} has no "
            "effect: it was trained on flat ground; give a policy that climbs, or leave out --obstacle"
        )
    return found


def find_excitation(plan: RunPlan, description: RobotDescription) -> ExcitationPlan:
    """Return the excitation of the motion `excite`: from its file, or made from name and seed.

    A robot that cannot stand without a policy balances first, as in the motion `rich`.

    Raises:
        ConfigurationError: The file is no plan, is for another robot, or has another length than the run.
    """
    from deal_hw.motions.excitation.plan import FAMILIES, ExcitationDesign, make_plan, read_plan

    if plan.excite in FAMILIES:
        balance_s = min(plan.rich.balance_s, 0.5 * plan.seconds) if plan.policy else 0.0
        design = ExcitationDesign(
            family=plan.excite,  # type: ignore[arg-type]
            seconds=plan.seconds,
            balance_s=balance_s,
            seed=plan.seed,
        )
        return make_plan(description, design)
    found = read_plan(Path(plan.excite))
    found.check_fits(description)
    if abs(found.seconds - plan.seconds) > 1e-6:
        raise ConfigurationError(
            f"the excitation in {plan.excite} is {found.seconds:g} s long, but --seconds is "
            f"{plan.seconds:g}; give --seconds {found.seconds:g}"
        )
    return found


def _loaded(plan: RunPlan, load: Callable[[RunPlan], Policy]) -> Policy:
    if not plan.policy:
        raise PolicyError(
            f"motion {plan.motion!r} needs a policy, and none is shipped for robot {plan.robot!r}; "
            "give --policy FILE, or use --motion chirp or hold"
        )
    return load(plan)
