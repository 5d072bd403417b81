"""Command delay of single actuators, and noise of a sensor: kinds that no MuJoCo field holds."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.drivers.go2.descriptions.on_stand_recording import DESCRIPTION, parameter_space
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.parameters import check_space
from deal_hw.sim.parameters.yaml_space import parse_space
from deal_hw.sim.recordings.target import record_target
from deal_hw.sim.recordings.windows import cut_windows, predict_windows, setpoints
from deal_hw.types import FloatArray

STEP_S = 0.002
LATE = "FL_calf_joint"


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    """Return the Go2 that hangs on a stand."""
    return load_model(DESCRIPTION, STEP_S)


def delays(robot: RobotModel) -> ParameterSpace:
    """Return a space of two free delays: of one actuator, and of all others together."""
    one = robot.actuator_names[DESCRIPTION.joint_names.index(LATE)]
    others = tuple(name for name in robot.actuator_names if name != one)

    def parameter(name: str, elements: tuple[str, ...]) -> Parameter:
        return Parameter(
            name=name,
            kind="command_delay",
            elements=elements,
            unit="s",
            nominal=0.0,
            low=0.0,
            high=0.05,
            scale="linear",
        )

    return ParameterSpace([parameter("one", (one,)), parameter("others", others)])


def wave(robot: RobotModel) -> FloatArray:
    """Return the amplitudes of a motion in which all joints move."""
    return np.linspace(0.05, 0.15, len(DESCRIPTION.joint_names))


def test_lag_is_latency_plus_the_actuators_own_delay(robot: RobotModel) -> None:
    """Member 0: 4 ms for all; member 1: 4 ms + 10 ms, and 4 ms + 1 ms for the one."""
    batch = ServoBatch(robot, delays(robot), 2, threads=1)
    batch.set_parameters(np.array([[0.0, 0.0], [0.001, 0.010]]))
    lag = batch.lag_s(np.array([0.004, 0.004]))
    column = DESCRIPTION.joint_names.index(LATE)
    assert lag.shape == (2, 12)
    np.testing.assert_allclose(lag[0], 0.004)
    np.testing.assert_allclose(np.delete(lag[1], column), 0.014)
    assert lag[1, column] == pytest.approx(0.005)
    plain = ServoBatch(robot, parameter_space(), 2, threads=1)
    np.testing.assert_array_equal(plain.lag_s(np.array([0.004, 0.002])), [0.004, 0.002])


def test_a_delayed_actuator_follows_its_target_later(robot: RobotModel) -> None:
    """Windows predicted with the true delay match the target to rounding; with none, that leg is off."""
    space, amplitude = delays(robot), wave(robot)

    def behaviour(position: FloatArray, velocity: FloatArray, time_s: float) -> FloatArray:
        return np.asarray(np.array(DESCRIPTION.default_position) + amplitude * np.sin(9.0 * time_s))

    rng = np.random.default_rng(0)
    truth = np.array([0.012, 0.0])
    made = record_target(robot, space, truth, behaviour, seconds=1.0, latency_s=0.006, rng=rng)
    episode = made.episode
    windows = cut_windows(episode, 20)
    batch = ServoBatch(robot, space, 2, threads=1)
    batch.set_parameters(np.array([[0.012, 0.0], [0.0, 0.0]]))
    path = setpoints(batch, episode, np.array([0.006, 0.006]))
    start = windows.start
    predicted, _ = predict_windows(
        batch, episode, windows, episode.position[start], episode.velocity[start], path
    )
    error = np.abs(predicted - episode.position[windows.samples()]).max(axis=(1, 2))
    column = DESCRIPTION.joint_names.index(LATE)
    assert error[0].max() < 1e-9
    assert error[1, column] > 1e-3
    assert np.argmax(error[1]) == column


def test_a_part_of_a_step_is_mixed(robot: RobotModel) -> None:
    """A ramp of 1 a step, late by 2 and by 1.25 steps, on two actuators of one member."""
    space = delays(robot)
    batch = ServoBatch(robot, space, 1, threads=1)
    batch.set_parameters(np.array([[0.0025, 0.004]]))
    recording = record_target(
        robot,
        space,
        space.nominal,
        lambda x, v, t: np.array(DESCRIPTION.default_position),
        seconds=0.1,
        rng=np.random.default_rng(0),
    ).episode
    steps = recording.steps
    ramp = np.repeat(np.arange(1.0, steps + 1)[:, None], 12, axis=1)
    episode = dataclasses.replace(recording, target=ramp, start_setpoint=np.zeros(12))
    path = setpoints(batch, episode, np.zeros(1))[0]
    column = DESCRIPTION.joint_names.index(LATE)
    np.testing.assert_allclose(path[2:6, column], [1.75, 2.75, 3.75, 4.75])
    np.testing.assert_allclose(np.delete(path, column, axis=1)[2:6, 0], [1.0, 2.0, 3.0, 4.0])


def test_noise_of_a_sensor_is_known_or_refused(robot: RobotModel) -> None:
    """No search can find it; a known value is accepted."""
    with pytest.raises(ConfigurationError, match=r"no search can find it.*known: 0\.002"):
        parse_space(
            f"parameters:\n - {{kind: sensor_noise, elements: {LATE}, nominal: 0.002}}\n", robot.model
        )
    space = parse_space(
        f"parameters:\n - {{kind: sensor_noise, elements: {LATE}, known: 0.002}}\n", robot.model
    )
    check_space(robot.model, space)
    assert space.known == {f"{LATE}.sensor_noise": 0.002}
