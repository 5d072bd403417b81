"""The calibrated model for MuJoCo alone: its motion by mj_step beside that of the laws, and what it lacks."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.law_robots import GEARED, MOTOR, SERVO, batch, known, moved, robot, swing

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.robots.registry import robot_description
from deal_hw.sim.actuators import ActuatorLaws
from deal_hw.sim.engine.model import command_scale, load_model
from deal_hw.sim.mjcf.calibrated import write_calibrated_mjcf
from deal_hw.sim.mjcf.plain import PlainModel, hold, write_plain_mjcf
from deal_hw.types import FloatArray


def both(
    tmp_path: Path, text: str, joint: str, kinds: dict[str, float], latency_s: float, bristles: bool = True
) -> tuple[Path, Path, PlainModel]:
    """Return the calibrated MJCF of a robot with laws of a joint, and that for MuJoCo alone."""
    members = batch(robot(tmp_path, text), *(known(kind, joint, value) for kind, value in kinds.items()))
    calibrated, plain = tmp_path / "calibrated.xml", tmp_path / "plain.xml"
    write_calibrated_mjcf(members.robot, members.space, members.space.nominal, calibrated, latency_s)
    return calibrated, plain, write_plain_mjcf(calibrated, plain, bristles=bristles)


def with_laws(path: Path, commands: FloatArray, start: FloatArray) -> FloatArray:
    """Return positions after each step of commands, (S, J), with the laws in <custom>; encoders are right."""
    return moved(mujoco.MjModel.from_xml_path(str(path)), commands, start)


def alone(path: Path, commands: FloatArray, start: FloatArray) -> FloatArray:
    """Return the same by mj_step, of the model beside the calibrated one."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = start
    calibrated = mujoco.MjModel.from_xml_path(str(path.with_name("calibrated.xml")))
    ctrl = commands / command_scale(calibrated, range(model.nu))
    hold(model, data, ctrl[0])
    found = []
    for now in ctrl:
        data.ctrl[:] = now
        mujoco.mj_step(model, data)
        found.append(data.qpos.copy())
    return np.array(found)


@pytest.mark.parametrize("latency_s", [0.0, 0.008, 0.0095])
@pytest.mark.parametrize(
    ("text", "joint", "kinds"),
    [
        (SERVO, "shoulder", {"command_lag": 0.02}),
        (SERVO, "elbow", {"command_lag": 0.05, "command_delay": 0.003}),
        (MOTOR, "wheel", {"command_lag": 0.02}),
        (GEARED, "shoulder", {"command_lag": 0.02}),
    ],
    ids=["servo", "servo+delay", "motor", "scaled servo"],
)
def test_latency_and_lag_are_exact(
    tmp_path: Path, text: str, joint: str, kinds: dict[str, float], latency_s: float
) -> None:
    """MuJoCo's delay and filter are our laws: the motions agree to rounding."""
    calibrated, plain, made = both(tmp_path, text, joint, kinds, latency_s)
    width = mujoco.MjModel.from_xml_path(str(plain)).nu
    # The scaled servo's set-point is limited, in MuJoCo before the filter.
    commands = swing(600, width)[0] * (0.25 if text == GEARED else 1.0)
    start = np.zeros(width) if text == MOTOR else commands[0]
    expected = with_laws(calibrated, commands, start)
    np.testing.assert_allclose(alone(plain, commands, start), expected, atol=1e-9)
    assert np.ptp(expected, axis=0).min() > 0.05
    assert made.lacks == () and any("a filter of" in law for law in made.has)


@pytest.mark.parametrize("extra", [0.2, -0.08], ids=["falls", "rises"])
def test_friction_by_speed_in_slow_motion(tmp_path: Path, extra: float) -> None:
    """0.3 rad at 0.1 Hz: bristles are nearer to the law than constant friction by a factor of ten."""
    time = np.arange(8000) * 0.002
    commands = np.stack([0.3 * np.sin(2 * np.pi * f * time) for f in (0.1, 0.14)], axis=1)
    kinds = {"dof_friction_stribeck": extra, "dof_stribeck_speed": 0.3}
    apart = []
    for bristles in (False, True):
        calibrated, plain, made = both(tmp_path, SERVO, "shoulder", kinds, 0.0, bristles=bristles)
        difference = alone(plain, commands, commands[0]) - with_laws(calibrated, commands, commands[0])
        apart.append(float(np.sqrt(np.mean(difference[:, 0] ** 2))))
        assert bool(made.lacks) != bristles and bool(made.has) == bristles
    constant, bristled = apart
    assert constant > 2.5e-3 and bristled < constant / 10


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="MuJoCo Warp is not installed (extra gpu)")
def test_mujoco_warp_has_these_elements(tmp_path: Path) -> None:
    """Delay, filter and bristles, after a command that has acted for long: the motion is that of MuJoCo."""
    import mujoco_warp

    kinds = {"command_lag": 0.05, "dof_friction_stribeck": 0.2, "dof_stribeck_speed": 0.3}
    _, plain, made = both(tmp_path, SERVO, "shoulder", kinds, 0.0095)
    assert len(made.has) == 3 and made.lacks == ()
    commands = swing(200, 2)[0]
    model = mujoco.MjModel.from_xml_path(str(plain))
    start = mujoco.MjData(model)
    start.qpos[:] = commands[0]
    hold(model, start, commands[0])
    there, data = mujoco_warp.put_model(model), mujoco_warp.put_data(model, start)
    found = []
    for now in commands:
        data.ctrl.assign(now[None].astype(np.float32))
        mujoco_warp.step(there, data)
        found.append(data.qpos.numpy()[0].copy())
    expected = alone(plain, commands, commands[0])
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.ptp(expected))


@pytest.mark.parametrize("extra", [0.2, -0.08], ids=["falls", "rises"])
def test_bristles_slide_with_the_force_of_the_law(tmp_path: Path, extra: float) -> None:
    """At a steady speed friction is 0.1 N·m + extra exp(-(w/0.3)²), by hand."""
    kinds = {"dof_friction_stribeck": extra, "dof_stribeck_speed": 0.3}
    _, plain, _ = both(tmp_path, SERVO, "shoulder", kinds, 0.0)
    model = mujoco.MjModel.from_xml_path(str(plain))
    data, bristles = mujoco.MjData(model), model.actuator("shoulder.friction").id
    for speed in (0.1, 0.3, 2.0):
        mujoco.mj_resetData(model, data)
        for _ in range(500):
            data.qpos[:], data.qvel[:] = 0, (speed, 0)
            mujoco.mj_step(model, data)
        total = model.dof_frictionloss[0] - data.actuator_force[bristles]
        assert total == pytest.approx(0.1 + extra * np.exp(-((speed / 0.3) ** 2)), abs=1e-6)
    # A passive element takes no control.
    assert model.nu == 2


def test_what_mujoco_cannot_express_is_named(tmp_path: Path) -> None:
    """Play and friction by load have no element; a Stribeck speed without friction is no law."""
    kinds = {"servo_play": 0.03, "dof_friction_load": 0.1, "dof_stribeck_speed": 0.3, "encoder_bias": 0.0}
    _, plain, made = both(tmp_path, SERVO, "shoulder", kinds, 0.007)
    assert made.has == ("latency: a delay of 7 ms",)
    assert sorted(made.lacks) == ["dof_friction_load of shoulder (0.1)", "play of shoulder (0.03)"]
    text = plain.read_text()
    assert "left out: play of shoulder (0.03)" in text and "<dcmotor" not in text
    # A joint with both laws keeps its constant friction.
    kinds |= {"dof_friction_stribeck": 0.2}
    _, plain, made = both(tmp_path, SERVO, "shoulder", kinds, 0.0)
    assert "dof_friction_stribeck of shoulder (0.2)" in made.lacks
    assert mujoco.MjModel.from_xml_path(str(plain)).dof_frictionloss[0] == pytest.approx(0.1)


def test_a_default_class_for_actuators_does_not_hold_for_bristles(tmp_path: Path) -> None:
    """Limits, gears and damping that the model sets for all of its actuators."""
    usual = '<default><position forcerange="-4 4" gear="1.1"/><general damping="0.01"/></default><worldbody>'
    limited = SERVO.replace("<worldbody>", usual, 1)
    _, plain, made = both(tmp_path, limited, "shoulder", {"dof_friction_stribeck": 0.2}, 0.0)
    model = mujoco.MjModel.from_xml_path(str(plain))
    bristles = model.actuator("shoulder.friction").id
    assert made.bristles and not model.actuator_forcelimited[bristles]
    assert model.actuator_gear[bristles, 0] == 1 and model.actuator_damping[bristles] == 0
    assert model.actuator_gear[0, 0] == 1.1 and model.actuator_forcelimited[0]


@pytest.mark.parametrize(("latency_s", "delay_s"), [(0.0009, 0.0), (0.0015, 0.002), (0.0021, 0.0021)])
def test_a_delay_of_less_than_a_step_is_the_nearer_of_none_and_one(
    tmp_path: Path, latency_s: float, delay_s: float
) -> None:
    """MuJoCo has none between 0 and a step of 2 ms."""
    _, plain, made = both(tmp_path, SERVO, "shoulder", {"command_lag": 0.0}, latency_s)
    assert mujoco.MjModel.from_xml_path(str(plain)).actuator_delay.tolist() == pytest.approx([delay_s] * 2)
    assert bool(made.has) == (delay_s > 0)


def test_friction_that_cannot_fall_further_is_constant(tmp_path: Path) -> None:
    """A joint without dry friction has no less at rest."""
    smooth = SERVO.replace(' frictionloss="0.1"', "")
    _, _, made = both(tmp_path, smooth, "shoulder", {"dof_friction_stribeck": -0.05}, 0.0)
    assert not made.bristles


@pytest.mark.parametrize("name", ["go2", "so101", "cartpole", "g1", "allegro", "humanoid"])
def test_our_robots_have_such_models(tmp_path: Path, name: str) -> None:
    """All laws on all joints: the file compiles, takes the same controls, and moves without a warning."""
    own = load_model(robot_description(name))
    loss = own.model.dof_frictionloss
    rubbing = [j for j, dof in zip(own.description.joint_names, own.qvel, strict=True) if loss[dof] > 0]
    laws = [known("dof_friction_stribeck", joint, 0.05) for joint in rubbing]
    lags = [known("command_lag", actuator, 0.01) for actuator in own.actuator_names]
    space = ParameterSpace((*laws, *lags))
    write_calibrated_mjcf(own, space, space.nominal, tmp_path / "calibrated.xml", 0.012)
    made = write_plain_mjcf(tmp_path / "calibrated.xml", tmp_path / "plain.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "plain.xml"))
    assert made.lacks == () and model.nu == own.model.nu and made.bristles == bool(rubbing)
    assert np.count_nonzero(model.actuator_delay) == model.nu
    data = mujoco.MjData(model)
    hold(model, data, np.zeros(model.nu))
    mujoco.mj_step(model, data, 100)
    assert np.isfinite(data.qpos).all() and not data.warning.number.any()


def test_laws_do_not_act_twice(tmp_path: Path) -> None:
    """The loop with laws refuses the model that has them, and says which to give."""
    _, plain, _ = both(tmp_path, SERVO, "shoulder", {"command_lag": 0.02}, 0.0)
    model = mujoco.MjModel.from_xml_path(str(plain))
    with pytest.raises(ConfigurationError, match=re.escape("would act twice; give the calibrated model")):
        ActuatorLaws(model, mujoco.MjData(model))


def test_a_file_that_does_not_compile_is_taken_away(tmp_path: Path) -> None:
    """An actuator that has the name of the bristles: the error stays, the file does not."""
    taken = SERVO.replace('<position name="elbow"', '<position name="shoulder.friction"')
    with pytest.raises(ConfigurationError, match="does not compile"):
        both(tmp_path, taken, "shoulder", {"dof_friction_stribeck": 0.2}, 0.0)
    assert not (tmp_path / "plain.xml").exists()


def test_the_calibrated_model_is_not_overwritten(tmp_path: Path) -> None:
    """It is the source of the laws."""
    calibrated, _, _ = both(tmp_path, SERVO, "shoulder", {"command_lag": 0.02}, 0.0)
    with pytest.raises(ConfigurationError, match="the model itself"):
        write_plain_mjcf(calibrated, calibrated)
