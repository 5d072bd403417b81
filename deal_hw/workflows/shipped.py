"""Policies that are shipped with the package, and balancing by them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Final

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import Behaviour, PolicyBehaviour

SHIPPED: Final[Mapping[str, str]] = {
    "allegro": "allegro_turn",
    "go2": "go2_walk",
    "humanoid": "humanoid_walk",
}
"""Shipped policies not named ROBOT_udr. These robots' policies of that name only excite them in benches."""


def shipped_policy(robot: str) -> Path | None:
    """Return the policy that is shipped for a robot, or None."""
    name = SHIPPED.get(robot, f"{robot}_udr")
    path = Path(str(resources.files("deal_hw.policies") / "assets" / f"{name}.onnx"))
    return path if path.is_file() else None


def required_policy(robot: str) -> Path:
    """Return the policy that is shipped for a robot.

    Raises:
        ConfigurationError: There is none.
    """
    path = shipped_policy(robot)
    if path is None:
        tool = "train_udr_policy.py" if robot == "cartpole" else "train_demo_policy.py"
        raise ConfigurationError(f"no policy is shipped for robot {robot!r}; tools/{tool} trains one")
    return path


def balancer(description: RobotDescription, policy: Path | None) -> Callable[[], Behaviour] | None:
    """Return a function that makes a robot's balancing behaviour; None if the robot has no policy.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        PolicyError: The policy must not run on this robot.
    """
    path = policy or shipped_policy(description.name)
    return None if path is None else _tried(path, description)


def shipped_balancer(description: RobotDescription) -> Callable[[], Behaviour] | None:
    """Return :func:`balancer` of the shipped policy, which is tried at the first call and not before.

    Calibration needs it for advice alone, and runs without onnxruntime.
    """
    path = shipped_policy(description.name)
    if path is None:
        return None
    make = functools.cache(lambda: _tried(path, description))
    return lambda: make()()


def _tried(path: Path, description: RobotDescription) -> Callable[[], Behaviour]:
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.policies.trial import check_policy

    digest = check_policy(path, description).digest
    return lambda: PolicyBehaviour(OnnxPolicy(path, digest), description)
