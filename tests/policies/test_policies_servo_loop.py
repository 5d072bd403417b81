"""The batched loop that training and evaluation stand on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from deal_hw.description import SensorModel
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError
from deal_hw.policies.servo_loop import EXACT_SENSOR, ServoLoop
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.laws.setpoints import slew

SPACE = k9_space()
ALL = np.ones(1, dtype=bool)
REST = np.zeros((1, 2))


def make_loop(count: int = 1, sensor: SensorModel = EXACT_SENSOR) -> ServoLoop:
    return ServoLoop(DESCRIPTION, SPACE, count, sensor=sensor)


def nominal(count: int = 1) -> np.ndarray:
    return np.repeat(SPACE.nominal[None], count, axis=0)


@pytest.mark.parametrize("latency_ticks", [0, 7, 20, 33, 45])
def test_loop_equals_a_rollout_without_feedback(latency_ticks: int) -> None:
    """Five periods of random targets give the states of one rollout in which the same targets act later."""
    rng = np.random.default_rng(latency_ticks)
    theta = SPACE.sample(rng, 2)
    start = np.array([[0.01, 0.02], [-0.03, 0.05]])
    targets = rng.uniform(-0.2, 0.2, (5, 2, 1))
    loop = make_loop(2)
    loop.restart(
        np.ones(2, dtype=bool), theta, np.full(2, latency_ticks * 1e-3), start, np.zeros((2, 2)), rng
    )
    for target in targets:
        loop.step(target, rng)

    batch = ServoBatch(load_model(DESCRIPTION), SPACE, 2, threads=1)
    batch.set_parameters(theta)
    batch.set_state(start, np.zeros((2, 2)))
    held = np.repeat(start[:, None, :1], latency_ticks, axis=1)
    late = np.concatenate([held, np.repeat(np.moveaxis(targets, 0, 1), 20, axis=1)], axis=1)[:, :100]
    rate = batch.servo_factor("servo_speed_limit") * DESCRIPTION.speed_limit[0] * 1e-3
    position, velocity = batch.advance(slew(start[:, :1], late, rate))
    np.testing.assert_allclose(loop.position, position[:, -1], atol=1e-9)
    np.testing.assert_allclose(loop.velocity, velocity[:, -1], atol=1e-7)


def test_restart_of_one_member_leaves_the_others_alone() -> None:
    """Members are independent: one that starts anew changes nothing for its neighbour."""
    results = []
    for restart in (False, True):
        rng = np.random.default_rng(0)
        loop = make_loop(2)
        loop.restart(
            np.ones(2, dtype=bool), nominal(2), np.full(2, 0.01), np.zeros((2, 2)), np.zeros((2, 2)), rng
        )
        for tick in range(6):
            if restart and tick == 3:
                where = np.array([True, False])
                loop.restart(where, 2 * nominal(), np.array([0.02]), np.array([[0.1, 0.1]]), REST, rng)
                assert loop.reported_position[0].tolist() == [0.1, 0.1]
            loop.step(np.full((2, 1), 0.05), rng)
        results.append(loop.position[1])
    np.testing.assert_array_equal(results[0], results[1])


def test_reports_are_quantised_and_velocities_are_their_differences() -> None:
    """Without noise a report is the nearest step, and the velocity is the change over the last 20 ms."""
    sensor = SensorModel(noise=(0.0, 0.0), resolution=(0.5e-3, 2 * math.pi / 4096), velocity_window_s=0.02)
    loop, rng = make_loop(sensor=sensor), np.random.default_rng(0)
    loop.restart(ALL, nominal(), np.zeros(1), np.array([[0.0102, 0.01]]), REST, rng)
    # 0.0102 / 0.0005 = 20.4 -> 20; 0.01 / 0.00153398 = 6.52 -> 7.
    np.testing.assert_allclose(loop.reported_position, [[0.0100, 7 * 2 * math.pi / 4096]], atol=1e-12)
    np.testing.assert_array_equal(loop.reported_velocity, 0.0)
    before = loop.reported_position.copy()
    loop.step(np.array([[0.2]]), rng)
    np.testing.assert_allclose(loop.reported_velocity, (loop.reported_position - before) / 0.02, atol=1e-12)
    assert np.abs(loop.reported_position - loop.position).max() < 0.8e-3


def test_noise_has_its_standard_deviation() -> None:
    """4000 first reports scatter as the sensor model says, within five standard errors."""
    sensor = SensorModel(noise=(1e-3, 5e-3), resolution=(0.0, 0.0), velocity_window_s=0.0)
    loop = make_loop(4000, sensor=sensor)
    where = np.ones(4000, dtype=bool)
    loop.restart(
        where,
        nominal(4000),
        np.zeros(4000),
        np.zeros((4000, 2)),
        np.zeros((4000, 2)),
        np.random.default_rng(1),
    )
    np.testing.assert_allclose(loop.reported_position.std(axis=0), [1e-3, 5e-3], rtol=5 / math.sqrt(8000))


def test_a_velocity_window_between_control_periods_is_refused() -> None:
    """The loop keeps one report a control period, so it cannot difference over half of one."""
    with pytest.raises(
        ConfigurationError, match=r"velocity_window_s = 0\.03 s must be a whole number of control periods"
    ):
        make_loop(sensor=SensorModel(noise=(0.0, 0.0), resolution=(0.0, 0.0), velocity_window_s=0.03))
