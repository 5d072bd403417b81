"""Policies that are shipped with the package, and balancing by them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.robots import is_known, robot_entry

if TYPE_CHECKING:
    from deal_hw.motions.behaviours import Behaviour


def shipped_policy(robot: str, task: str = "") -> Path | None:
    """Return the policy that is shipped for a robot, or None.

    Args:
        robot: Its name.
        task: One of its further tasks; "" for its usual one.
    """
    entry = robot_entry(robot) if is_known(robot) else None
    reference = "" if entry is None else entry.policies.get(task, "" if task else entry.policy)
    package, _, file = reference.partition(":")
    path = Path(str(resources.files(package) / file)) if package else None
    return path if path is not None and path.is_file() else None


def policy_file(robot: str, given: Path | str | None) -> Path | None:
    """Return the policy that an option names: a file, or a task of the robot whose policy is shipped.

    Args:
        robot: The robot's name.
        given: The option; None for the robot's usual policy.
    """
    if given is None:
        return shipped_policy(robot)
    named = None if Path(given).exists() else shipped_policy(robot, str(given))
    return named or Path(given)


def stands_alone(robot: str) -> bool:
    """Return whether a robot cannot fall: it has no pole to balance, no legs, and its base is fixed."""
    entry = robot_entry(robot)
    facts = entry.model_description()
    return not (entry.balance or facts.rest_position or facts.floating_base)


def balancing_policy(robot: str) -> Path | None:
    """Return the shipped policy by which a robot is kept from falling; None if it needs or has none."""
    found = shipped_policy(robot)
    return None if found is None or stands_alone(robot) else found


def required_policy(robot: str, task: str = "") -> Path:
    """Return the policy that is shipped for a robot.

    Args:
        robot: Its name.
        task: One of its further tasks; "" or walk for a Go2's usual one.

    Raises:
        ConfigurationError: There is none.
    """
    path = shipped_policy(robot, "" if task == "walk" else task)
    if path is None:
        of = f" and task {task!r}" if task else ""
        raise ConfigurationError(
            f"no policy is shipped for robot {robot!r}{of}; tools/train_udr_policy.py trains one for the "
            "cart-pole, tools/train_demo_policy.py for others"
        )
    return path


def balancer(description: RobotDescription, policy: Path | None) -> Callable[[], Behaviour] | None:
    """Return a function that makes a robot's balancing behaviour; None if there is no policy for it.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        PolicyError: The policy must not run on this robot.
    """
    path = policy or balancing_policy(description.name)
    return None if path is None else _tried(path, description)


def shipped_balancer(description: RobotDescription) -> Callable[[], Behaviour] | None:
    """Return :func:`balancer` of the shipped policy, which is tried at the first call and not before.

    Calibration needs it for advice alone, and runs without onnxruntime.
    """
    path = balancing_policy(description.name)
    if path is None:
        return None
    make = functools.cache(lambda: _tried(path, description))
    return lambda: make()()


def _tried(path: Path, description: RobotDescription) -> Callable[[], Behaviour]:
    from deal_hw.motions.behaviours import PolicyBehaviour
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.policies.trial import check_policy

    digest = check_policy(path, description).digest
    return lambda: PolicyBehaviour(OnnxPolicy(path, digest), description)
