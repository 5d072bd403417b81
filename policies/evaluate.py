"""Evaluation of balancing policies: the paper's Table 2, batched over many robots.

The task is fixed: 10 s of balancing from the home pose (cart in the middle, pole upright, at rest). The
results use the reported states, because a real robot has no others.
"""

from __future__ import annotations

import numpy as np

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.motions.behaviours import ActionMap
from deal_hw.motions.scores.balance import TASK_SECONDS, BalanceResult, balance_result
from deal_hw.parameters import ParameterSpace
from deal_hw.policies.demonstration import BatchPolicy
from deal_hw.policies.servo_loop import ServoLoop
from deal_hw.policy import ObservationBuilder
from deal_hw.types import FloatArray


def evaluate_batch(
    policy: BatchPolicy,
    description: RobotDescription,
    space: ParameterSpace,
    theta: FloatArray,
    latency_s: FloatArray,
    rng: np.random.Generator,
    *,
    seconds: float = TASK_SECONDS,
    start_position: FloatArray | None = None,
    sensor: SensorModel | None = None,
) -> list[BalanceResult]:
    """Run the task on N simulated robots.

    Args:
        policy: The policy.
        description: The robot.
        space: The parameters.
        theta: Parameters of each robot, (N, K).
        latency_s: Total latency of each robot, the host's share included, (N,) [s].
        rng: For the noise.
        seconds: Duration [s].
        start_position: Joint positions at the start, (N, J); the home pose by default.
        sensor: The sensor model; the description's by default.

    Returns:
        N results.
    """
    spec, count = policy.spec, len(theta)
    loop = ServoLoop(description, space, count, sensor=sensor)
    home = np.repeat(np.array(description.default_position)[None], count, axis=0)
    start = home if start_position is None else start_position
    loop.restart(np.ones(count, dtype=bool), theta, latency_s, start, np.zeros_like(home), rng)
    builder = ObservationBuilder(spec, (count,))
    mapped = ActionMap.of_robot(spec, description)
    positions, velocities = [], []
    lost = np.zeros(count, dtype=bool)
    for _ in range(round(seconds * description.control_rate_hz)):
        observation = builder.build(loop.reported_position, loop.reported_velocity)
        action = mapped.action(policy.act_batch(observation))
        builder.record_action(action)
        # A robot whose physics diverged reports the home pose, which is perfect balance. It counts as fallen.
        lost |= loop.step(mapped.target(action), rng)
        positions.append(np.where(lost[:, None], (0.0, np.pi), loop.reported_position))
        velocities.append(np.where(lost[:, None], 0.0, loop.reported_velocity))
    position, velocity = np.stack(positions, axis=1), np.stack(velocities, axis=1)
    period_s = 1.0 / description.control_rate_hz
    return [balance_result(position[i], velocity[i], period_s) for i in range(count)]
