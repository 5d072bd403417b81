"""A recording of a robot on legs without a robot: it stands in simulation and reports joints and body.

For tests of code that reads recordings. It has no wire; tests of drivers and control use the emulator.
"""

from __future__ import annotations

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_quaternion
from deal_hw.types import BodyTrajectory, FloatArray, Status, Trajectory
from fakes.simulated_episode import recording

_SETTLE_S = 1.5


def standing_episode(
    description: RobotDescription,
    space: ParameterSpace,
    theta: FloatArray,
    targets: FloatArray,
    *,
    height_m: float,
    latency_ticks: int = 0,
) -> Trajectory:
    """Return an exact recording of a robot that first stands still and then follows targets.

    Args:
        description: The robot; a free base, PD drives without limits of speed.
        space: The parameters.
        theta: The robot's true parameters, (K,).
        targets: One for each control period, (C, A) [rad].
        height_m: Initial height of the base; the robot drops onto its feet [m].
        latency_ticks: Device periods from a command's reception until it acts.
    """
    robot = load_model(description)
    batch = ServoBatch(robot, space, 1, threads=1)
    batch.set_parameters(np.asarray(theta, dtype=float)[None])
    default = np.array(description.default_position)
    start = np.concatenate([[0.0, 0.0, height_m], np.zeros(3), default])
    batch.set_state(start, np.zeros(len(start)))
    step_s = 1.0 / description.device_rate_hz
    repeat = round(step_s / robot.step_s)
    rest = default[list(description.actuated_index)]
    batch.advance(np.tile(rest, (1, round(_SETTLE_S / robot.step_s), 1)))

    stride = round(description.device_rate_hz / description.state_rate_hz)
    ticks = len(targets) * description.steps_per_control
    # What is received during a tick acts from the next.
    command = (np.arange(ticks) - 1 - latency_ticks) // description.steps_per_control
    path = np.where((command >= 0)[:, None], targets[np.maximum(command, 0)], rest)
    first_x, first_v = batch.position[:1], batch.velocity[:1]
    x, v = batch.advance(np.repeat(path, repeat, axis=0)[None], repeat)
    x, v = np.concatenate([first_x, x[0]])[:-1:stride], np.concatenate([first_v, v[0]])[:-1:stride]
    return _report(description, x, v, targets)


def _report(description: RobotDescription, x: FloatArray, v: FloatArray, targets: FloatArray) -> Trajectory:
    """Return states, (T, 6 + J) each, as the robot reports them: without the base's position."""
    T, J = len(x), len(description.joint_names)
    body = BodyTrajectory(
        orientation=to_quaternion(x[:, 3:6], IDENTITY),
        angular_velocity=v[:, 3:6],
        acceleration=np.tile([0.0, 0.0, 9.81], (T, 1)),
        foot_force=np.full((T, len(description.feet)), 37.0),
        temperature=np.tile(30.0 + np.arange(J), (T, 1)),
        lost=np.zeros((T, J)),
        battery=np.full(T, 0.86),
        voltage=np.full(T, 30.5),
        current=np.full(T, 2.5),
        sticks=np.zeros((T, 4)),
        buttons=np.zeros(T, dtype=np.int64),
    )
    status = np.full(T, int(Status.ARMED | Status.HOMED))
    return recording(description, x[:, 6:], v[:, 6:], np.zeros((T, J)), targets, status, body=body)
