"""MuJoCo Warp beside mujoco.batch: one step, rollouts, laws, faults, and environments.

On a GPU where there is one, else on its CPU device. The first step of a model compiles kernels for up to a
minute; they are kept in Warp's cache.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from fakes.law_robots import GEARED, MOTOR, SERVO, known, swing
from fakes.law_robots import robot as robot_of

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.robots.registry import default_space, robot_description, training_task
from deal_hw.sim.engine.batch import ServoBatch, make_engine
from deal_hw.sim.engine.gpu import EngineName, gpu_problem
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.engine.warp_check import difference_from_mujoco
from deal_hw.sim.engine.warp_engine import WarpEngine
from deal_hw.sim.parameters import KIND_TABLE, KINDS, apply_parameters
from deal_hw.types import FloatArray
from deal_hw.workflows.robot import described
from deal_hw.workflows.train import udr_distribution

# Not imported: tests are collected without it.
pytestmark = pytest.mark.skipif(
    find_spec("mujoco_warp") is None, reason="MuJoCo Warp is not installed (extra gpu)"
)
slow = pytest.mark.slow

WARP: EngineName = "warp-cpu" if gpu_problem() else "warp"
BOTH: tuple[EngineName, ...] = ("mujoco", WARP)
SHIPPED = ("cartpole", "so101", "ant", "allegro", "go2", "g1", "humanoid")


@pytest.fixture(scope="module", autouse=True)
def quickly_compiled() -> None:
    """On a CPU kernels are compiled in half the time without optimisation, and these tests take few steps."""
    import warp

    if WARP == "warp-cpu":
        warp.config.optimization_level = 0


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    """The cart-pole."""
    return load_model(DESCRIPTION)


def members(robot: RobotModel, engine: EngineName, count: int = 3, seed: int = 0) -> ServoBatch:
    """Return cart-poles that differ all over the range."""
    space = k9_space()
    batch = ServoBatch(robot, space, count, threads=1, engine=engine)
    batch.set_parameters(space.unnormalize(np.random.default_rng(seed).random((count, len(space)))))
    return batch


def starts(count: int, windows: int) -> tuple[FloatArray, FloatArray]:
    """Return start states of the cart-pole."""
    rng = np.random.default_rng(1)
    return 0.05 * rng.standard_normal((count, windows, 2)), 0.3 * rng.standard_normal((count, windows, 2))


def test_rollouts_agree(robot: RobotModel) -> None:
    """Fifty steps without contact, forces and all: to 1e-4 of a radian and of a metre."""
    command = np.full((3, 2, 50, 1), 0.05)
    force = 0.5 * np.random.default_rng(2).standard_normal((3, 2, 50, 2))
    found = [members(robot, e).advance_windows(starts(3, 2), command, 10, force=force) for e in BOTH]
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-5)
    np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-4)
    assert np.abs(found[0][0]).max() > 0.05


def test_a_shorter_rollout_takes_the_graph_of_a_longer_one(robot: RobotModel) -> None:
    """And what a new engine finds. Only a longer one captures the step again."""
    command = 0.1 * np.random.default_rng(3).standard_normal((3, 2, 40, 1))
    used = members(robot, WARP)
    assert isinstance(used.engine, WarpEngine)
    graphs = []
    for steps in (30, 20, 40, 20):
        found = used.advance_windows(starts(3, 2), command[:, :, :steps], 10)
        fresh = members(robot, WARP).advance_windows(starts(3, 2), command[:, :, :steps], 10)
        np.testing.assert_array_equal(found, fresh)
        worlds = used.engine._worlds
        assert worlds is not None
        # Without a GPU nothing is captured: this stands for it.
        worlds._graph = worlds._graph or object()
        graphs.append(worlds._graph)
    assert graphs[0] is graphs[1] is not graphs[2] is graphs[3]


@slow
def test_doctors_pendulum_agrees() -> None:
    """Far below what doctor takes for a difference, and above nothing: float32 rounds."""
    assert 0 < difference_from_mujoco(WARP) < 2e-6


@slow
def test_parameters_and_states_go_on(robot: RobotModel) -> None:
    """Set again, and advanced twice: a rollout begins where the one before ended."""
    ends = []
    for engine in BOTH:
        batch = members(robot, engine)
        batch.set_state(np.array([0.0, 0.1]), np.zeros(2))
        batch.advance(np.full((3, 20, 1), 0.05))
        batch.set_parameters(batch.space.nominal * np.array([[0.8], [1.0], [1.2]]))
        x, v = batch.advance(np.full((3, 30, 1), -0.05), 10)
        np.testing.assert_allclose(batch.position, x[:, -1], atol=1e-12)
        ends.append((x, v))
    np.testing.assert_allclose(ends[1][0], ends[0][0], atol=1e-5)
    np.testing.assert_allclose(ends[1][1], ends[0][1], atol=1e-4)


@slow
def test_one_world_that_diverges_is_alone(robot: RobotModel, caplog: pytest.LogCaptureFixture) -> None:
    """A start that is no number: that member is NaN in that window, and the others are as without it.

    One line says it, once, with what to do.
    """
    position, velocity = starts(3, 2)
    command = np.full((3, 2, 20, 1), 0.05)
    batch = members(robot, WARP)
    sound = batch.advance_windows((position, velocity), command, 10)
    assert not caplog.records
    velocity[1, 0, 1] = np.nan
    x, v = batch.advance_windows((position, velocity), command, 10)
    bad = np.zeros((3, 2), dtype=bool)
    bad[1, 0] = True
    assert np.isnan(x[bad]).all() and np.isnan(v[bad]).all()
    np.testing.assert_array_equal(x[~bad], sound[0][~bad])
    np.testing.assert_array_equal(v[~bad], sound[1][~bad])
    # Nothing of it is left in the next rollout.
    again = batch.advance_windows(starts(3, 2), command, 10)
    np.testing.assert_array_equal(again, sound)
    batch.set_state(np.array([[0.0, 0.1], [np.nan, 0.1], [0.0, 0.2]]), np.zeros((3, 2)))
    x, _ = batch.advance(command[:, 0])
    assert np.isnan(x[:, -1, 0]).tolist() == [False, True, False]
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("1 of 6 worlds diverged") and "--engine mujoco" in line
    # As in MuJoCo, a member that diverged begins anew where the model does.
    assert np.isfinite(batch.position).all()


@slow
def test_too_many_worlds_are_refused_with_the_number_that_fits(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is simulated. By hand: 100 bytes a world, 70 % of 400 bytes are free for 2 of them."""
    import psutil

    from deal_hw.sim.engine import warp_engine

    free = {"available": 400.0}
    monkeypatch.setattr(warp_engine._Worlds, "bytes", property(lambda worlds: 100.0 * worlds.count))
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(**free))
    with pytest.raises(ConfigurationError, match=r"3 members do not fit .* at most 2 worlds .*--members 2,"):
        members(robot, WARP)
    free["available"] = 430.0
    assert members(robot, WARP).engine.windows == 1


@slow
def test_constraints_without_room_get_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two joints with friction are two rows, and there is room for one at first."""
    from deal_hw.sim.engine import warp_engine

    model = robot_of(tmp_path, SERVO)
    space = ParameterSpace([servo_armature(model), known("dof_frictionloss", "shoulder", 0.2)])
    tried: list[int] = []

    def limits(of: Any, growth: int) -> dict[str, int]:
        tried.append(growth)
        return {"njmax": growth}

    monkeypatch.setattr(warp_engine, "_limits", limits)
    start = np.zeros((1, 2, 2)), np.full((1, 2, 2), 0.3)
    command = np.repeat(swing(40, 2)[None], 2, axis=1)
    found = [ServoBatch(model, space, 1, 1, engine=e).advance_windows(start, command, 10) for e in BOTH]
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-5)
    assert tried[-1] == 2


def servo_armature(model: RobotModel) -> Parameter:
    """Return a parameter to search."""
    return Parameter(
        name="free", kind="dof_armature", elements=model.description.joint_names[:1], unit="-",
        nominal=0.01, low=0.0, high=1.0, scale="linear",
    )  # fmt: skip


@slow
@pytest.mark.parametrize(
    ("text", "parameters"),
    [
        (
            SERVO,
            [
                ("dof_friction_stribeck", "shoulder", 0.3),
                ("dof_stribeck_speed", "shoulder", 0.5),
                ("dof_friction_load", "shoulder", 0.1),
                ("dof_friction_motor_stribeck", "elbow", 0.1),
                ("motor_free_speed", "elbow", 3.0),
            ],
        ),
        (SERVO, [("dof_friction_stribeck", "elbow", 0.2)]),
        (MOTOR, [("motor_free_speed", "wheel", 4.0)]),
        (SERVO, [("servo_dead_zone", "shoulder", 0.02), ("dof_friction_load", "shoulder", 0.1)]),
        (
            GEARED,
            [
                ("servo_dead_zone", "shoulder", 0.02),
                ("servo_punch", "shoulder", 0.2),
                ("servo_resolution", "shoulder", 0.01),
                ("encoder_scale", "shoulder", 1.2),
                ("encoder_bias", "shoulder", 0.05),
            ],
        ),
    ],
)
def test_laws_between_steps_agree(tmp_path: Path, text: str, parameters: list[Any]) -> None:
    """Friction by speed and load, and effort by speed, in windows at once, of two members."""
    model = robot_of(tmp_path, text)
    width = len(model.description.actuated)
    space = ParameterSpace([servo_armature(model), *(known(*p) for p in parameters)])
    command = np.repeat(np.repeat(swing(100, width)[None], 2, axis=0), 2, axis=1)
    command[:, 1] *= -0.5
    start = np.zeros((2, 2, len(model.coordinates))), np.full((2, 2, len(model.coordinates)), 0.3)
    found = []
    for engine in BOTH:
        batch = ServoBatch(model, space, 2, threads=1, engine=engine)
        batch.set_parameters(np.array([[0.01], [0.02]]))
        # Twice: the second rollout must not depend on what laws wrote in the first.
        batch.advance_windows(start, command, 10)
        found.append(batch.advance_windows(start, command, 10))
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-4)
    np.testing.assert_allclose(found[1][1], found[0][1], atol=2e-3)


@slow
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_models_agree(name: str) -> None:
    """One step from random states to 1e-4 of the step's change; a rollout to its statistics."""
    description = robot_description(name)
    model = load_model(description)
    space = default_space(name)
    rng = np.random.default_rng(3)
    theta = space.sample(rng, 3)
    rest = np.array(description.default_position)[list(description.actuated_index)]
    command = rest + rng.uniform(-0.2, 0.2, (3, 2, 60, len(rest)))
    if description.actuation != "position":
        command -= rest
    found = []
    for engine in BOTH:
        batch = ServoBatch(model, space, 3, threads=1, engine=engine)
        batch.set_parameters(theta)
        if model.model.nkey:
            batch.batch.bind("qpos")[:] = model.model.key_qpos[0]
        x, v = batch.position, batch.velocity
        start = np.repeat(x[:, None], 2, axis=1), np.repeat(v[:, None], 2, axis=1)
        start[1][:, 1] = 0.1
        one = batch.advance_windows(start, command[:, :, :1], 1)
        rolled = batch.advance_windows(start, command, 60)
        found.append((*one, *rolled))
    (x1, v1, x, v), (y1, w1, y, w) = found
    assert np.isfinite(y).all() and np.isfinite(w).all()
    np.testing.assert_allclose(y1, x1, atol=1e-4)
    np.testing.assert_allclose(w1, v1, atol=1e-4 * max(1.0, float(np.abs(v1).max())), rtol=1e-3)
    # Contacts begin a step earlier or later: not the states but their size and mean agree.
    assert np.sqrt(np.mean((y - x) ** 2)) < 0.05 * np.sqrt(np.mean(x**2))
    assert np.mean(w**2) == pytest.approx(np.mean(v**2), rel=0.2)


EVERY_FIELD = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" priority="1"/>
    <body name="ball" pos="2 0 0.052">
      <freejoint name="free"/>
      <geom name="ball" type="sphere" size="0.05" mass="1"/>
    </body>
    <body name="cart" pos="0 0 1">
      <joint name="cart" type="slide" axis="1 0 0" damping="0.1"/>
      <geom name="box" type="box" size="0.1 0.1 0.05" mass="2" contype="0" conaffinity="0"/>
      <site name="mast" pos="0 0 -0.3"/>
      <body name="arm" pos="0 0 0.1">
        <joint name="arm" axis="0 1 0" damping="0.2" frictionloss="0.3" armature="0.01" stiffness="1.5"/>
        <geom name="arm" type="capsule" fromto="0 0 0 0 0 0.4" size="0.02" mass="0.5"/>
        <site name="end" pos="0 0 0.4"/>
        <body name="rod" pos="0 0 0.4">
          <joint name="rod" axis="0 1 0"/>
          <inertial pos="0 0 0.15" mass="0.1" diaginertia="0.00075 0.00075 1e-6"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="arm" joint="arm" kp="20" kv="1" forcerange="-5 5"/>
    <motor name="cart" joint="cart" gear="-3" ctrlrange="-1 1"/>
  </actuator>
  <tendon>
    <spatial name="belt" frictionloss="0.7" damping="0.2"><site site="mast"/><site site="end"/></spatial>
  </tendon>
</mujoco>
"""
ELEMENTS = {"body": "arm", "joint": "arm", "geom": "floor", "actuator": "arm", "tendon": "belt"}
OWN_ELEMENTS = {"rod_length": "rod", "motor_gain": "cart", "motor_gear": "cart"}
OWN_VALUES = {"geom_restitution": 0.4, "dof_friction_creep": 0.02}


@slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_a_model_field_agrees(kind: str) -> None:
    """Three members whose one parameter differs: twenty steps of a robot, and of a ball on the floor."""
    model = mujoco.MjModel.from_xml_string(EVERY_FIELD)
    found, value = KIND_TABLE[kind], OWN_VALUES.get(kind, 1.3)
    element = OWN_ELEMENTS.get(kind, ELEMENTS[found.element])
    parameter = Parameter(
        name=kind, kind=kind, elements=(element,), unit=found.unit, nominal=value, low=value / 2,
        high=value * 2, scale=found.scale,
    )  # fmt: skip
    theta = np.linspace(parameter.low * 1.1, parameter.high * 0.9, 3)[:, None]
    control = np.full((3, 1, 20, 2), 0.3)
    start = np.repeat(model.qpos0[None, None], 3, axis=0), np.full((3, 1, model.nv), 0.2)
    ends = []
    for name in BOTH:
        engine = make_engine(name, model, model, 3, 1)
        apply_parameters(engine.fields, ParameterSpace([parameter]), theta)
        engine.set_const()
        record, bad = engine.rollout(control, int(mujoco.mjtState.mjSTATE_CTRL), {"qvel": 20}, None, start)
        assert not bad.any()
        ends.append(record["qvel"][:, 0, 0])
    np.testing.assert_allclose(ends[1], ends[0], atol=2e-4 * np.abs(ends[0]).max())


@slow
@pytest.mark.parametrize(
    ("robot", "task"), [("cartpole", ""), ("go2", ""), ("go2", "climb"), ("go2", "terrain")]
)
def test_environments_agree(robot: str, task: str) -> None:
    """Five ticks of four robots, of which two are restarted: observations and rewards, to rounding."""
    distribution = udr_distribution(robot, task)
    found = []
    for engine in BOTH:
        env = training_task(robot, task).make(described(robot), distribution, 4, engine=engine)
        env.reset(seed=1)
        rng, seen = np.random.default_rng(2), []
        for tick in range(5):
            if tick == 3:
                env._restart(np.array([True, False, True, False]))
            observation, reward, *_ = env.step(rng.uniform(-0.2, 0.2, env.action_space.shape))
            seen.append(np.column_stack([observation, reward]))
        found.append(np.array(seen))
    assert np.isfinite(found[1]).all()
    np.testing.assert_allclose(found[1], found[0], atol=5e-3)
    assert np.abs(found[0][-1] - found[0][0]).max() > 0.05
