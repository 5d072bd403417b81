"""A linear-quadratic balancer for known parameters: the oracle of the emulator and a reference for policies.

It reads positions only. A steady-state Kalman filter on the same linear model estimates the velocities. Past
targets that have not acted yet are part of the state, which compensates latency.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deal_hw.description import SensorModel
from deal_hw.drivers.cartpole.chips.servo import Servo
from deal_hw.drivers.cartpole.description import (
    DAMPING_NS_M,
    DESCRIPTION,
    EFFORT_LIMIT_N,
    STIFFNESS_N_M,
)
from deal_hw.drivers.cartpole.plant.mechanics import build_simulation
from deal_hw.drivers.cartpole.wire.protocol import Target
from deal_hw.types import FloatArray

TARGET_LIMIT_M = 0.25
STATE_COST = (1 / 0.1**2, 0.0, 1 / 0.1**2, 0.0)
"""Cost of cart position, cart velocity, pole angle, pole velocity."""
TARGET_COST = 1 / 0.1**2
"""Cost of the distance between target and middle of the rail."""
_POSITION_FLOOR = (0.2e-3, 1e-3)
"""Smallest standard deviation of a position in the filter [m, rad]."""
_DISTURBANCE_FLOOR = (0.3, 0.002)
_EPSILON = 1e-5
_MAX_ITERATIONS = 2000


@dataclass(frozen=True, slots=True)
class LinearModel:
    """Linear model of one control period about the upright pose, with q past targets that have not acted yet.

    Attributes:
        A: (4 + q, 4 + q); the state is cart, pole, cart velocity, pole velocity, newest past target first.
        B: (4 + q, 1).
        G: Effect of a constant cart force and pole torque over the period, (4 + q, 2).
    """

    A: FloatArray
    B: FloatArray
    G: FloatArray


class LqrController:
    """State feedback with its filter; one call a control period.

    Args:
        model: The linear model.
        feedback: (4 + q,).
        filter_gain: (4 + q, 2).
    """

    def __init__(self, model: LinearModel, feedback: FloatArray, filter_gain: FloatArray) -> None:
        self._model = model
        self._feedback = feedback
        self._filter_gain = filter_gain
        self._state = np.zeros(len(feedback))
        self._fresh = True

    def reset(self) -> None:
        """Forget the past."""
        self._fresh = True

    def act(self, position: FloatArray) -> float:
        """Return the position target [m] for the newest reported positions, (2,) [m, rad]."""
        if self._fresh:
            self._state[:] = 0.0
            self._state[:2] = position
            self._state[4:] = position[0]
            self._fresh = False
        self._state += self._filter_gain @ (position - self._state[:2])
        target = float(np.clip(-self._feedback @ self._state, -TARGET_LIMIT_M, TARGET_LIMIT_M))
        self._state = self._model.A @ self._state + self._model.B[:, 0] * target
        return target


def design_lqr(parameters: Mapping[str, float], latency_ticks: int, sensor: SensorModel) -> LqrController:
    """Return the balancer for these parameters and this total latency [device ticks]."""
    model = linearise(parameters, latency_ticks)
    size = len(model.A)
    Q = np.zeros((size, size))
    Q[[0, 2, 1, 3], [0, 2, 1, 3]] = STATE_COST
    X = _riccati(model.A, model.B, Q, np.array([[TARGET_COST]]))
    feedback = np.linalg.solve(model.B.T @ X @ model.B + TARGET_COST, model.B.T @ X @ model.A)[0]
    return LqrController(model, feedback, _filter_gain(model, parameters, sensor))


def _filter_gain(model: LinearModel, parameters: Mapping[str, float], sensor: SensorModel) -> FloatArray:
    # The linear model mainly lacks friction, which therefore sets the filter's process noise;
    # the floor represents the slewing set-point and the effort limit, which it lacks, too.
    friction = np.maximum(
        (parameters["cart.frictionloss"], parameters["pole.frictionloss"]), _DISTURBANCE_FLOOR
    )
    W = model.G @ np.diag(friction**2) @ model.G.T + 1e-12 * np.eye(len(model.A))
    V = np.diag(np.maximum(sensor.position_std, _POSITION_FLOOR) ** 2)
    C = np.eye(2, len(model.A))
    P = _riccati(model.A.T, C.T, W, V)
    gain: FloatArray = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
    return gain


def _riccati(A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray:
    # Plain value iteration: scipy's solve_discrete_are fails on some of these, because past targets are
    # pure delays (eigenvalues 0) beside stiff mechanics. Slow, but the slowest closed-loop mode here settles
    # in some hundred steps.
    X = Q.copy()
    for _ in range(_MAX_ITERATIONS):
        XB = X @ B
        new = Q + A.T @ (X - XB @ np.linalg.solve(R + B.T @ XB, XB.T)) @ A
        if np.max(np.abs(new - X)) <= 1e-10 * np.max(np.abs(new)):
            return new
        X = (new + new.T) / 2
    return X


def linearise(parameters: Mapping[str, float], latency_ticks: int) -> LinearModel:
    """Return the linear model of one control period, by central differences over the true mechanics.

    Dry friction and the limits have no linear part and are left out. The state is the one that a frame
    reports; a target computed from it acts ``latency_ticks`` + 1 ticks later (the device handles what came at
    a tick in the next one).
    """
    ticks = DESCRIPTION.steps_per_control
    whole, part = divmod(latency_ticks + 1, ticks)
    period = _Period({**parameters, "servo.effort_limit": 1e9, "servo.speed_limit": 1e9}, part, ticks)
    columns = [period.difference(i) for i in range(8)]
    size = 4 + whole + 1
    A, B, G = np.zeros((size, size)), np.zeros((size, 1)), np.zeros((size, 2))
    A[:4, :4] = np.column_stack(columns[:4])
    A[:4, 4 + whole] = columns[4]
    # The target that acts in the rest of the period: this one, or one that has not acted yet.
    if whole:
        A[:4, 3 + whole] = columns[5]
    else:
        B[:4, 0] = columns[5]
    G[:4] = np.column_stack(columns[6:])
    B[4, 0] = 1.0
    A[range(5, size), range(4, size - 1)] = 1.0
    return LinearModel(A, B, G)


class _Period:
    """One control period; inputs are state (4), earlier target, later target, force, torque."""

    def __init__(self, parameters: Mapping[str, float], part: int, ticks: int) -> None:
        self._sim = build_simulation({**parameters, "cart.frictionloss": 0.0, "pole.frictionloss": 0.0})
        self._servo = Servo(parameters, self._sim.timestep_s)
        self._part, self._ticks = part, ticks

    def difference(self, index: int) -> FloatArray:
        """Return the derivative of the state after the period by input ``index``, (4,)."""
        inputs = np.zeros(8)
        inputs[index] = _EPSILON
        return (self._run(inputs) - self._run(-inputs)) / (2 * _EPSILON)

    def _run(self, inputs: FloatArray) -> FloatArray:
        self._sim.set_state(inputs[:2].tolist(), inputs[2:4].tolist())
        for tick in range(self._ticks):
            if tick in (0, self._part):
                self._servo.accept(_target(inputs[5] if tick >= self._part else inputs[4]))
            force = self._servo.update(self._sim.position()[0], self._sim.velocity()[0])
            self._sim.step((force + inputs[6], inputs[7]))
        return np.array(self._sim.position() + self._sim.velocity())


def _target(position: float) -> Target:
    return Target(
        sequence=0,
        position_um=round(position * 1e6),
        stiffness_mn_m=round(STIFFNESS_N_M * 1e3),
        damping_mns_m=round(DAMPING_NS_M * 1e3),
        effort_limit_mn=round(EFFORT_LIMIT_N * 1e3),
        speed_limit_um_s=10**9,
    )
