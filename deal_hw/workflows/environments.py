"""The training tasks as Gymnasium environments; importing this module registers them.

``gymnasium.make("deal_hw/CartPole-v0", distribution="runs/first/calibration/distribution.json")`` and
``gymnasium.make_vec("deal_hw/CartPole-v0", num_envs=32)``. With the module in the name, Gymnasium imports it:
``gymnasium.make("deal_hw.workflows.environments:deal_hw/CartPole-v0")``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.policies.registration import register as _register
from deal_hw.robots import robots

if TYPE_CHECKING:
    from deal_hw.parameters import ParameterDistribution
    from deal_hw.policies.single_env import SingleEnv
    from deal_hw.policies.vector_env import ServoVectorEnv


def make_vector(
    num_envs: int, robot: str, distribution: Path | str | ParameterDistribution | None = None, **more: Any
) -> ServoVectorEnv:
    """Return a batch of robots, each with its own physics.

    Args:
        num_envs: Number of robots.
        robot: The robot.
        distribution: ``distribution.json`` of a calibration, or a distribution, from which parameters and
        latency are drawn. None: uniform domain randomisation, as with ``deal-hw train --udr``.
        **more: Passed on to the environment, such as ``task``.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: The distribution cannot be read.
    """
    from deal_hw.parameters import ParameterDistribution
    from deal_hw.robots import recorded_description, training_task
    from deal_hw.workflows.train import read_distribution, udr_distribution

    if distribution is None:
        drawn = udr_distribution(robot)
    elif isinstance(distribution, ParameterDistribution):
        drawn = distribution
    else:
        drawn = read_distribution(Path(distribution))
    made: ServoVectorEnv = training_task(robot).make(recorded_description(robot), drawn, num_envs, **more)
    return made


def make_single(
    robot: str, distribution: Path | str | ParameterDistribution | None = None, **more: Any
) -> SingleEnv:
    """Return one robot; arguments and errors as :func:`make_vector`."""
    from deal_hw.policies.single_env import SingleEnv

    return SingleEnv(make_vector(1, robot, distribution, **more))


def register() -> None:
    """Register the tasks with Gymnasium; a second call changes nothing."""
    tasks = {entry.environment: entry.name for entry in robots().entries() if entry.environment}
    _register(
        tasks, "deal_hw.workflows.environments:make_single", "deal_hw.workflows.environments:make_vector"
    )


register()
