"""A cart-pole's recording without a robot: balanced in simulation, with the device's behaviour.

For tests of code that reads recordings. It has no wire; tests of drivers and control use the emulator.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model
from deal_hw.types import Event, FloatArray, IntArray, Status, Trajectory

BALANCE_GAINS = (1.65, 1.04, 0.475, 0.171)
"""Linear-quadratic regulator of the nominal cart-pole at 50 Hz: per cart position, angle and their rates."""
RECEIVED_AFTER_S = 0.4e-3
"""A command arrives this long after the device sent the sample that it answers."""


def simulated_episode(
    description: RobotDescription,
    space: ParameterSpace,
    theta: FloatArray,
    *,
    seconds: float = 4.0,
    latency_ticks: int = 0,
    sensor: bool = False,
    seed: int = 0,
) -> Trajectory:
    """Return a recording of a cart-pole that balances while its cart follows changing set-points.

    Args:
        description: The cart-pole.
        space: The parameters.
        theta: The robot's true parameters, (K,).
        seconds: Device time.
        latency_ticks: Device periods from a command's reception until it acts.
        sensor: Report through the description's sensor model instead of exactly.
        seed: Of the set-points and the noise.
    """
    rng = np.random.default_rng(seed)
    batch = ServoBatch(load_model(description), space, 1, threads=1)
    batch.set_parameters(np.asarray(theta, dtype=float)[None])
    batch.set_state(np.array([0.02, 0.05]), np.zeros(2))
    rate = (
        float(batch.servo_factor("servo_speed_limit")[0, 0])
        * description.speed_limit[0]
        / description.device_rate_hz
    )
    stride = round(description.device_rate_hz / description.state_rate_hz)
    control_every = description.steps_per_control
    ticks = round(seconds * description.device_rate_hz) // stride * stride
    goals = np.repeat(rng.uniform(-0.12, 0.12, ticks // 1000 + 1), 1000)

    true_x, true_v, effort = (np.empty((ticks // stride, 2)) for _ in range(3))
    setpoint = np.full(ticks + latency_ticks, 0.02)
    targets: list[float] = []
    for k in range(0, ticks, stride):
        i = k // stride
        true_x[i], true_v[i] = batch.position[0], batch.velocity[0]
        effort[i] = _effort(description, true_x[i, 0], true_v[i, 0], setpoint[k])
        if k % control_every == 0:
            # The first commands hold still, so that the set-point's start is where the recording says.
            wish = 0.02 if k < 5 * control_every else _balance(true_x[i], true_v[i], goals[k])
            targets.append(float(np.clip(wish, *description.limits.target[0])))
        for tick in range(k, k + stride):
            index = (
                tick - 1
            ) // control_every  # Received during the tick at which it was sent: acts from the next.
            goal = targets[index] if index >= 0 else 0.02
            before = setpoint[tick + latency_ticks - 1] if tick + latency_ticks else 0.02
            setpoint[tick + latency_ticks] = before + np.clip(goal - before, -rate, rate)
        batch.advance(setpoint[None, k : k + stride, None])
    return _report(description, true_x, true_v, effort, np.array(targets), rng if sensor else None)


def _balance(position: FloatArray, velocity: FloatArray, goal: float) -> float:
    off = np.array([position[0] - goal, position[1], velocity[0], velocity[1]])
    return float(goal + np.dot(BALANCE_GAINS, off))


def _effort(description: RobotDescription, x: float, v: float, setpoint: float) -> tuple[float, float]:
    force = description.stiffness[0] * (setpoint - x) - description.damping[0] * v
    return float(np.clip(force, -description.effort_limit[0], description.effort_limit[0])), 0.0


def _report(
    description: RobotDescription,
    x: FloatArray,
    v: FloatArray,
    effort: FloatArray,
    targets: FloatArray,
    rng: np.random.Generator | None,
) -> Trajectory:
    if rng is not None:
        x = x + rng.standard_normal(x.shape) * description.sensor.noise
        x = np.round(x / description.sensor.resolution) * description.sensor.resolution
        lag = round(description.sensor.velocity_window_s * description.state_rate_hz)
        v = np.concatenate([np.zeros((lag, 2)), (x[lag:] - x[:-lag]) / description.sensor.velocity_window_s])
    clamped = np.abs(effort[:, 0]) >= description.effort_limit[0]
    status = np.where(
        clamped, int(Status.ARMED | Status.HOMED | Status.EFFORT_CLAMPED), int(Status.ARMED | Status.HOMED)
    )
    return recording(
        description,
        x,
        v,
        effort,
        targets[:, None],
        status,
        events=(
            Event(300_000, "armed", "The motors follow commands."),
            Event(int(len(x) * 4e6), "clipped", "One target was clipped."),
        ),
    )


def recording(
    description: RobotDescription,
    position: FloatArray,
    velocity: FloatArray,
    effort: FloatArray,
    targets: FloatArray,
    status: IntArray,
    **more: Any,
) -> Trajectory:
    """Return the recording of states, (T, J) each, under commands with the description's gains, (C, A)."""
    device_s = np.arange(len(position)) / description.state_rate_hz
    sent_s = np.arange(len(targets)) / description.control_rate_hz + RECEIVED_AFTER_S
    in_force = np.ceil(device_s * description.control_rate_hz - 1e-9).astype(np.int64) - 1
    rows = np.ones((len(targets), 1))
    return Trajectory(
        joint_names=description.joint_names,
        actuated=description.actuated,
        receive_s=device_s + 0.3e-3,
        device_s=device_s,
        position=position,
        velocity=velocity,
        effort=effort,
        status=status.astype(np.int64),
        command_sequence=in_force,
        command_age_s=np.where(in_force >= 0, device_s - sent_s[np.maximum(in_force, 0)], np.nan),
        sent_s=sent_s,
        sent_sequence=np.arange(len(targets)),
        requested_position=targets.copy(),
        position_target=targets,
        stiffness=rows * description.stiffness,
        damping=rows * description.damping,
        effort_limit=rows * description.effort_limit,
        speed_limit=rows * description.speed_limit,
        metadata={"robot": description.name, "purpose": "collect", "start_ns": 0},
        **more,
    )
