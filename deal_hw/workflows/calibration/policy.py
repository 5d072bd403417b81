"""The policy that moved the robot, for methods that run it in every simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.workflows.say import Say

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
    from deal_hw.policies.onnx_runtime import OnnxPolicy

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
    file = given or dataset.policy_path(digest)
    if not file.is_file():
        raise ConfigurationError(
            f"{dataset.folder} has no copy of the policy that moved the robot (its SHA-256 begins with "
            f"{digest or 'unknown'}); name its file: --policy FILE"
        )
    policy = OnnxPolicy(file)
    if digest and not policy.digest.startswith(digest):
        raise ConfigurationError(
            f"{file} is not the policy that moved the robot: its SHA-256 begins with {policy.digest[:16]}, "
            f"that of the recordings' policy with {digest}; leave --policy out, or name the right file"
        )
    ahead, left, turn = source.reach()[0]
    return PopulationDemonstration(policy, description, (float(ahead), float(left), float(turn)))


def policy_of_files(policy: OnnxPolicy, description: RobotDescription) -> PopulationDemonstration:
    """Return the policy that moved the robot, for methods that run it in every simulator.

    Args:
        policy: The policy. It gave or checked the commands of these recordings, so joints, units and
            rate fit.
        description: The robot by the user's model, sampled at the policy's rate.
    """
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
    return PopulationDemonstration(policy, own, ran_before=True)


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
