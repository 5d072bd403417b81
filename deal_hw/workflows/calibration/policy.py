"""The policy that moved the robot, for methods that run it in every simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.workflows.say import Say

NOTED_POLICY = "policy"
"""Entry of an imported recording's source: the policy whose commands it has, 16 digits of its SHA-256."""

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.parameters import ParameterSpace
    from deal_hw.policies.demonstration import PopulationDemonstration
    from deal_hw.policies.onnx_runtime import OnnxPolicy


def say_other_range(policy: PopulationDemonstration, robot: str, space: ParameterSpace, say: Say) -> None:
    """Say where a policy was not trained in the search's range, as the DEAL paper's is.

    Args:
        policy: The policy that moved the robot.
        robot: Name of a robot with a driver.
        space: What is searched.
        say: Called with the sentence.
    """
    from deal_hw.workflows.train import udr_distribution

    usual = udr_distribution(robot)
    ranges = {p.name: (p.low, p.high) for p in usual.space}
    other = [p.name for p in space if ranges.get(p.name) != (p.low, p.high)]
    if policy.trained_under != usual.digest():
        what = "under another distribution than uniform randomisation"
    elif other:
        what = f"in another range of {', '.join(other[:3])}{' and others' if len(other) > 3 else ''}"
    else:
        return
    say(
        f"the policy that moved the robot was trained {what}. The DEAL paper trains it in the range that is "
        "searched. Simulators at the ends of the range may fall at once under this one, and then say little"
    )


def imported_policy(
    dataset: Dataset, runs: Mapping[int, Mapping[str, Any]], given: Path | None
) -> OnnxPolicy | None:
    """Return the policy that moved the robot in imported episodes; None: it is not known.

    Args:
        dataset: The dataset, with its own robot.yaml.
        runs: Metadata of the episodes, by number.
        given: The file that was named; None: the copy in the dataset, if they were imported with a policy.

    Raises:
        ConfigurationError: The file is another policy, or the dataset lost its copy.
        InsufficientDataError: The episodes were imported with different policies.
        PolicyError: The file cannot be run.
    """
    digests = sorted({str(run.get("import", {}).get(NOTED_POLICY, "")) for run in runs.values()})
    if len(digests) > 1:
        raise InsufficientDataError(
            f"episodes {', '.join(map(str, runs))} were imported with {len(digests)} policies, or some "
            "without one; name episodes of one policy (--episodes, --holdout)"
        )
    (noted,) = digests
    if given is None and not noted:
        return None
    return _opened(dataset, noted, given, "with which the recordings were imported")


def recorded_policy(
    dataset: Dataset, runs: Mapping[int, Mapping[str, Any]], description: RobotDescription, given: Path | None
) -> PopulationDemonstration:
    """Return the policy that moved the robot during whole episodes of a dataset.

    Args:
        dataset: The dataset.
        runs: Metadata of the episodes, by number.
        description: Their robot.
        given: File of the policy; by default the copy in the dataset.

    Raises:
        InsufficientDataError: No policy moved the robot all the time, or the episodes have different
            policies.
        ConfigurationError: The file is another policy, or the dataset has no copy of it.
        PolicyError: The file cannot be run.
    """
    from deal_hw.motions.velocity import FixedVelocity, make_source
    from deal_hw.policies.demonstration import PopulationDemonstration

    for index, run in runs.items():
        _refuse_other_motion(index, run)
    digests = {str(run.get("policy_digest", "")) for run in runs.values()}
    wishes = {str(run.get("velocity", "0,0,0")) for run in runs.values()}
    if len(digests) > 1 or len(wishes) > 1:
        raise InsufficientDataError(
            f"episodes {', '.join(map(str, runs))} were recorded with {len(digests)} policies and "
            f"{len(wishes)} requested velocities; name episodes with one policy and one velocity "
            "(--episodes)"
        )
    (digest,), (wish,) = digests, wishes
    source = make_source(wish)
    if not isinstance(source, FixedVelocity):
        raise InsufficientDataError(
            f"the requested velocity of the recordings changes (it is {wish!r}), but the simulators take "
            "one fixed velocity; record with --velocity X,Y,YAW"
        )
    if any(run.get("hold_heading") for run in runs.values()):
        raise InsufficientDataError(
            "the recordings were made with --hold-heading, so the requested turn depended on the robot, but "
            "the simulators take one fixed velocity; record without it, or use a method that needs no "
            "policy: eki, deal, deal-paper-replay"
        )
    policy = _opened(dataset, digest, given, "that moved the robot")
    ahead, left, turn = source.reach()[0]
    return PopulationDemonstration(policy, description, (float(ahead), float(left), float(turn)))


def _opened(dataset: Dataset, digest: str, given: Path | None, which: str) -> OnnxPolicy:
    """Return the policy of a file, by default of the copy in a dataset, whose recordings note its digest.

    Args:
        dataset: The dataset.
        digest: Beginning of the SHA-256 that the recordings note; "" for none.
        given: The file that was named.
        which: Which policy the recordings note, for the message.

    Raises:
        ConfigurationError: The file is another policy, or the dataset has no copy of it.
        PolicyError: The file cannot be run.
    """
    from deal_hw.policies.onnx_runtime import OnnxPolicy

    file = given or dataset.policy_path(digest)
    if given is None and not file.is_file():
        raise ConfigurationError(
            f"{dataset.folder} has no copy of the policy that moved the robot (its SHA-256 begins with "
            f"{digest or 'unknown'}); name its file: --policy FILE"
        )
    policy = OnnxPolicy(file)
    if digest and not policy.digest.startswith(digest):
        raise ConfigurationError(
            f"{file} is not the policy {which}: its SHA-256 begins with {policy.digest[:16]}, that of the "
            f"recordings' policy with {digest}; leave --policy out, or name the right file"
        )
    return policy


def policy_of_files(
    policy: OnnxPolicy,
    description: RobotDescription,
    space: ParameterSpace,
    latency_range_s: tuple[float, float],
    say: Say,
) -> PopulationDemonstration:
    """Return the policy that moved a user's robot, for methods that run it in every simulator.

    Where nothing shows that it was trained in the range that is searched, a sentence tells it.

    Args:
        policy: The policy. It gave or checked the commands of these recordings, so joints, units and rate
            fit.
        description: The robot by the user's model, sampled at the policy's rate.
        space: What is searched.
        latency_range_s: Range of the latency's search [s].
        say: Called with the sentence.
    """
    from deal_hw.parameters import ParameterDistribution
    from deal_hw.policies.demonstration import PopulationDemonstration

    spec = policy.spec
    # A model's file has another name than the robot, and often another rest pose. Actions are around the
    # policy's own pose, as in the commands that were computed.
    own = dataclasses.replace(
        description,
        name=spec.robot,
        default_position=spec.default_position,
        control_rate_hz=spec.control_rate_hz,
    )
    found = PopulationDemonstration(policy, own, ran_before=True)
    trained = found.trained_under
    if trained != ParameterDistribution.uniform(space, latency_range_s).digest():
        what = f"names the distribution {trained}" if trained else "names no distribution of its training"
        say(
            f"the policy {what}, not that of the {len(space)} searched parameters. The DEAL paper trains it "
            "in the range that is searched. Simulators at the ends of the range may fall at once under this "
            "one, and then say little; --range-ratio narrows it"
        )
    return found


def _refuse_other_motion(index: int, run: Mapping[str, Any]) -> None:
    """Refuse an episode in which not only the policy moved the robot."""
    from deal_hw.data.recording.episode_info import motion_of

    motion, stands = motion_of(run), bool(run.get("stand", False))
    if motion == "balance" and not stands:
        return
    what = f"was recorded with motion {motion or 'unknown'!r}" if not stands else "stands up and lies down"
    raise InsufficientDataError(
        f"episode {index} {what}, so the policy did not move the robot all the time, but the simulators "
        "run the policy alone; record with `deal-hw collect --motion balance`, or use a method that needs "
        "no policy: eki, deal, deal-paper-replay"
    )
