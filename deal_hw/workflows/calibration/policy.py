"""The policy of a dataset's recordings, for methods that run it in every simulator."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.calib.methods import CLOSED_LOOP_METHODS
from deal_hw.control.velocity import FixedVelocity, make_source
from deal_hw.data.recording.episode_info import motion_of
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.workflows.options import refuse

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.policies.demonstration import PopulationDemonstration


def check_policy(method: str, *, given: bool, model: bool) -> None:
    """Check that a method and where the recordings come from go together.

    Args:
        method: Name of the method.
        given: Whether a policy was named.
        model: Whether the recordings are of a robot that the user's own MJCF describes, named or carried.

    Raises:
        ConfigurationError: A policy would have no effect, or the method needs one that nobody knows.
    """
    if method not in CLOSED_LOOP_METHODS:
        refuse(["--policy"] if given else [], f"--method {method} runs no policy")
    elif model:
        raise ConfigurationError(
            f"--method {method} runs the policy that moved the robot, which recordings of --model do not "
            "name, nor those of a dataset that carries its robot; use eki, deal or deal-paper-replay"
        )


def recorded_policy(
    dataset: Dataset,
    runs: Mapping[int, Mapping[str, Any]],
    description: RobotDescription,
    given: Path | None,
) -> PopulationDemonstration:
    """Return the policy that moved the robot all through some episodes of a dataset.

    Args:
        dataset: The dataset.
        runs: Metadata of the episodes, by number.
        description: Their robot.
        given: File of the policy; by default the copy that the dataset keeps.

    Raises:
        InsufficientDataError: No policy moved the robot all through them, or it is not the same for all.
        ConfigurationError: The file is not that policy, or no copy of it is kept.
        PolicyError: The file cannot be run.
    """
    from deal_hw.policies.demonstration import PopulationDemonstration
    from deal_hw.policies.onnx_runtime import OnnxPolicy

    for index, run in runs.items():
        _refuse_other_motion(index, run)
    digests = {str(run.get("policy_digest", "")) for run in runs.values()}
    wishes = {str(run.get("velocity", "0,0,0")) for run in runs.values()}
    if len(digests) > 1 or len(wishes) > 1:
        raise InsufficientDataError(
            f"episodes {', '.join(map(str, runs))} were recorded with {len(digests)} policies and "
            f"{len(wishes)} wanted velocities; name episodes of one of each (--episodes)"
        )
    (digest,), (wish,) = digests, wishes
    source = make_source(wish)
    if not isinstance(source, FixedVelocity):
        raise InsufficientDataError(
            f"the recordings follow the velocities of {wish!r}, and a simulator is told one fixed velocity; "
            "record with --velocity X,Y,YAW"
        )
    file = given or dataset.policy_path(digest)
    if not file.is_file():
        raise ConfigurationError(
            f"{dataset.folder} keeps no copy of the policy that moved the robot (SHA-256 begins "
            f"{digest or 'unknown'}); name its file: --policy FILE"
        )
    policy = OnnxPolicy(file)
    if digest and not policy.digest.startswith(digest):
        raise ConfigurationError(
            f"{file} is not the policy that moved the robot: its SHA-256 begins {policy.digest[:16]}, that "
            f"of the recordings' policy {digest}; leave --policy out, or name that file"
        )
    ahead, left, turn = source.reach()[0]
    return PopulationDemonstration(policy, description, (float(ahead), float(left), float(turn)))


def _refuse_other_motion(index: int, run: Mapping[str, Any]) -> None:
    """Refuse an episode in which something else than the policy moved the robot, too."""
    motion, stands = motion_of(run), bool(run.get("stand", False))
    if motion == "balance" and not stands:
        return
    what = f"was recorded with motion {motion or 'unknown'!r}" if not stands else "stands up and lies down"
    raise InsufficientDataError(
        f"episode {index} {what}, so that the policy did not move the robot all the time, and the policy "
        "alone is run in the simulators; record with `deal-hw collect --motion balance`, or use a method "
        "that needs no policy: eki, deal, deal-paper-replay"
    )
