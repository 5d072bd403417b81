"""How well a policy balances: the paper's Table 2, and a batched evaluation of many members at once.

The task is frozen: 10 s of balancing from the home pose (cart in the middle, pole upright, at rest). Judged
are the reported states, because on a robot there are no others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.parameters import ParameterSpace
from deal_hw.policies.cartpole_env import CART, POLE
from deal_hw.policies.demonstration import BatchPolicy
from deal_hw.policies.servo_loop import ServoLoop
from deal_hw.policy import ObservationBuilder
from deal_hw.types import FloatArray

TASK_SECONDS = 10.0
FALLEN_RAD = 0.5
"""A pole beyond this angle has fallen: no cart of this size brings it back."""


_SLACK_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class BalanceResult:
    """One run of the task.

    Attributes:
        angle_error_rad: Mean |pole angle| [rad]. The angle is taken modulo a turn, so that after a fall it
            counts with what is left to upright, pi at most; nothing is left out and nothing counts for more.
        cart_speed_m_s: Mean |cart velocity| [m/s].
        fell: Whether the pole was ever beyond :data:`FALLEN_RAD`.
        upright_s: Time until then, or the whole duration [s].
    """

    angle_error_rad: float
    cart_speed_m_s: float
    fell: bool
    upright_s: float


def wrapped_angle(angle: FloatArray) -> FloatArray:
    """Return angles modulo a turn, in [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def balance_result(
    position: FloatArray, velocity: FloatArray, period_s: float, duration_s: float | None = None
) -> BalanceResult:
    """Judge one run.

    Args:
        position: Reported joint positions (cart, pole), (T, 2).
        velocity: Reported joint velocities, (T, 2).
        period_s: Time between samples [s].
        duration_s: How long the run should have lasted [s]. Where the safety module ended it before, the
            time that is missing counts as a hanging pole and a cart at rest; None: as it is.
    """
    missing = 0 if duration_s is None else max(0, round(duration_s / period_s) - len(position))
    # A recording has a sample less or more than its duration, depending on where its first one falls.
    if missing * period_s > _SLACK_S:
        position = np.concatenate([position, np.tile([0.0, np.pi], (missing, 1))])
        velocity = np.concatenate([velocity, np.zeros((missing, 2))])
    angle = np.abs(wrapped_angle(position[:, POLE]))
    fallen = angle > FALLEN_RAD
    fell = bool(fallen.any())
    return BalanceResult(
        angle_error_rad=float(angle.mean()),
        cart_speed_m_s=float(np.abs(velocity[:, CART]).mean()),
        fell=fell,
        upright_s=(int(np.argmax(fallen)) if fell else len(angle)) * period_s,
    )


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
    threads: int | None = 1,
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
        threads: Threads of the physics.

    Returns:
        N results.
    """
    spec, count = policy.spec, len(theta)
    loop = ServoLoop(description, space, count, sensor=sensor, threads=threads)
    home = np.repeat(np.array(description.default_position)[None], count, axis=0)
    start = home if start_position is None else start_position
    loop.restart(np.ones(count, dtype=bool), theta, latency_s, start, np.zeros_like(home), rng)
    builder = ObservationBuilder(spec, (count,))
    default = home[:, list(description.actuated_index)]
    positions, velocities = [], []
    for _ in range(round(seconds * description.control_rate_hz)):
        observation = builder.build(loop.reported_position, loop.reported_velocity)
        action = np.clip(policy.act_batch(observation), -1.0, 1.0)
        builder.record_action(action)
        loop.step(default + np.array(spec.action_scale) * action, rng)
        positions.append(loop.reported_position.copy())
        velocities.append(loop.reported_velocity.copy())
    position, velocity = np.stack(positions, axis=1), np.stack(velocities, axis=1)
    period_s = 1.0 / description.control_rate_hz
    return [balance_result(position[i], velocity[i], period_s) for i in range(count)]
