"""Parameter kinds: what each changes, what moves along, and that it can be seen in a rollout."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION, SPACES, k9_space, parameter_space
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model, model_with
from deal_hw.sim.mjcf.calibrated import LATENCY_NUMERIC, SPEED_LIMIT_NUMERIC, write_calibrated_mjcf
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.parameters import KINDS, apply_parameters
from deal_hw.sim.parameters.fields import ModelFields, element_id
from deal_hw.sim.parameters.yaml_space import parse_space


def test_mass_takes_the_inertia_along() -> None:
    """Doubling the pole's mass doubles its inertia: 0.1 kg, 0.3 m rod has 0.1 * 0.09 / 12 = 7.5e-4."""
    robot = load_model(DESCRIPTION)
    space = parameter_space().with_free(["pole.mass"])
    model = model_with(robot, space, np.array([0.2]))
    assert model.body("pole").mass[0] == pytest.approx(0.2)
    assert model.body("pole").inertia[0] == pytest.approx(1.5e-3)
    assert robot.model.body("pole").mass[0] == pytest.approx(0.1)


def test_length_moves_centre_and_inertia_and_mass_scales_what_it_set() -> None:
    """A rod of 0.6 m and 0.2 kg: centre at 0.3 m, inertia 0.2 * 0.36 / 12 = 6e-3, in any order."""
    robot = load_model(DESCRIPTION)
    space = parameter_space().with_free(["pole.length", "pole.mass"])
    model = model_with(robot, space, np.array([0.6, 0.2]))
    assert model.body("pole").ipos[2] == pytest.approx(0.3)
    assert model.body("pole").inertia[1] == pytest.approx(6e-3)


def test_servo_parameters_are_gain_bias_and_range() -> None:
    """kp, kd and the effort limit end where MuJoCo's affine actuator has them."""
    robot = load_model(DESCRIPTION)
    space = k9_space().with_free(["servo.stiffness", "servo.damping", "servo.effort_limit"])
    model = model_with(robot, space, np.array([50.0, 3.0, 2.5]))
    assert model.actuator_gainprm[0, 0] == 50.0
    assert model.actuator_biasprm[0, :3].tolist() == [0.0, -50.0, -3.0]
    assert model.actuator_forcerange[0].tolist() == [-2.5, 2.5]


def test_a_sent_effort_limit_acts_beside_an_actuator_without_one(tmp_path: Path) -> None:
    """One servo has a forcerange, the other none: the host's smaller limit acts on the first."""
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1"/>
        <body pos="0 0 0.3"><joint name="b" axis="0 1 0"/><geom size="0.1"/></body></body></worldbody>
        <actuator><position name="a" joint="a" kp="9" forcerange="-4 4"/>
        <position name="b" joint="b" kp="9"/></actuator></mujoco>"""
    )
    rates = sampling(0.01, 0.002, 0.2)
    description = describe(path, mujoco.MjModel.from_xml_path(str(path)), ["a", "b"], ["a", "b"], rates)
    entry = "parameters: [{kind: servo_stiffness, elements: a}]"
    robot = load_model(description)
    batch = ServoBatch(robot, parse_space(entry, robot.model), 1, threads=1)
    gains = np.full(2, 9.0), np.zeros(2)
    batch.set_sent(*gains, np.array([1.5, np.inf]))
    assert batch.batch.expand("actuator_forcerange")[0].tolist() == [[-1.5, 1.5], [0.0, 0.0]]


@pytest.mark.parametrize("name", [p.name for p in parameter_space()])
def test_every_parameter_can_be_seen(name: str) -> None:
    """Doubling any one parameter changes a rollout in which the cart moves and the pole swings."""
    robot, space = load_model(DESCRIPTION), parameter_space()
    batch = ServoBatch(robot, space, 2, threads=1)
    theta = np.repeat(space.nominal[None], 2, axis=0)
    theta[1, space.names.index(name)] *= 2
    batch.set_parameters(theta)
    from deal_hw.sim.laws.setpoints import slew

    target = np.where(np.arange(800) % 400 < 200, 0.25, -0.25)[:, None]
    rate = batch.servo_factor("servo_speed_limit")[:, None] * np.full((1, 800, 1), 4e-3)
    setpoint = slew(np.zeros((2, 1)), target, rate)
    batch.set_state(np.array([0.0, 0.4]), np.zeros(2))
    position, _ = batch.advance(setpoint, every=10)
    assert np.max(np.abs(position[0] - position[1])) > 1e-4


def test_k11_has_the_common_scale_as_exact_null_direction() -> None:
    """Masses, frictions, armature, gains and effort limit times two leave the trajectory as it is."""
    robot, space = load_model(DESCRIPTION), parameter_space()
    scaled = [n not in ("pole.length", "servo.speed_limit") for n in space.names]
    theta = np.repeat(space.nominal[None], 2, axis=0)
    theta[1, scaled] *= 2
    batch = ServoBatch(robot, space, 2, threads=1)
    batch.set_parameters(theta)
    batch.set_state(np.array([0.0, 0.2]), np.zeros(2))
    setpoint = np.full((2, 600, 1), 0.2)
    position, _ = batch.advance(setpoint, every=1)
    np.testing.assert_allclose(position[0], position[1], atol=1e-9)


def test_unknown_element_lists_the_elements() -> None:
    """A parameter of a body that is not there says which bodies are."""
    robot = load_model(DESCRIPTION)
    wrong = Parameter(name="x", kind="body_mass", elements=("wheel",), unit="kg", nominal=1, low=0.5, high=2)
    with pytest.raises(UnknownNameError, match=r"wheel.*cart, pole"):
        model_with(robot, ParameterSpace([wrong]), np.array([1.0]))


def test_unknown_kind_lists_the_kinds() -> None:
    """A kind that does not exist says which do."""
    robot = load_model(DESCRIPTION)
    wrong = Parameter(name="x", kind="colour", elements=("cart",), unit="", nominal=1, low=0.5, high=2)
    with pytest.raises(UnknownNameError, match="dof_damping"):
        model_with(robot, ParameterSpace([wrong]), np.array([1.0]))


def test_kinds_write_batch_and_single_model_alike() -> None:
    """A batch of one and a single model end with the same fields."""
    robot, space = load_model(DESCRIPTION), parameter_space()
    theta = space.unnormalize(np.linspace(0.2, 0.8, len(space)))
    batch = ServoBatch(robot, space, 3, threads=1)
    batch.set_parameters(np.repeat(theta[None], 3, axis=0))
    single, other = model_with(robot, space, theta), batch.batch.get_model(1)
    for field in (
        "body_mass",
        "body_inertia",
        "body_ipos",
        "dof_damping",
        "dof_armature",
        "dof_frictionloss",
    ):
        np.testing.assert_allclose(getattr(single, field), getattr(other, field), rtol=1e-12)
    assert set(KINDS) >= {p.kind for p in space if p.kind != "servo_speed_limit"}


def test_setting_parameters_again_and_again_does_not_drift() -> None:
    """Masses that scale what is at hand come back to the same inertia after many settings."""
    robot, space = load_model(DESCRIPTION), parameter_space()
    batch = ServoBatch(robot, space, 1, threads=1)
    rng = np.random.default_rng(0)
    for _ in range(200):
        batch.set_parameters(space.sample(rng, 1))
    batch.set_parameters(space.nominal[None])
    np.testing.assert_allclose(batch.batch.get_model(0).body_inertia, robot.model.body_inertia, rtol=1e-9)


def test_calibrated_mjcf_compiles_to_the_calibrated_values(tmp_path: object) -> None:
    """The written file holds the values, the speed limit and the latency."""
    from pathlib import Path

    robot, space = load_model(DESCRIPTION), k9_space()
    theta = space.unnormalize(np.linspace(0.1, 0.9, len(space)))
    path = Path(str(tmp_path)) / "calibrated.xml"
    write_calibrated_mjcf(robot, space, theta, path, latency_s=0.012)
    model, wanted = mujoco.MjModel.from_xml_path(str(path)), model_with(robot, space, theta)
    np.testing.assert_allclose(model.dof_damping, wanted.dof_damping, rtol=1e-5)
    assert model.numeric(LATENCY_NUMERIC).data[0] == pytest.approx(0.012)
    speed = theta[space.names.index("servo.speed_limit")]
    assert model.numeric(SPEED_LIMIT_NUMERIC).data[0] == pytest.approx(speed, rel=1e-5)


def test_mjcf_that_does_not_compile_says_which(tmp_path: object) -> None:
    """The error names the file."""
    from pathlib import Path

    broken = Path(str(tmp_path)) / "broken.xml"
    broken.write_text("<mujoco><worldbody><body></mujoco>")
    with pytest.raises(ConfigurationError, match=r"broken\.xml does not compile"):
        load_model(dataclasses.replace(DESCRIPTION, mjcf=broken))


def test_spaces_table_starts_with_the_default() -> None:
    """The first parameter set is K9: pole length and mass known."""
    first = next(iter(SPACES))
    assert first == "k9" and SPACES[first]().known == {"pole.length": 0.3, "pole.mass": 0.1}


def test_apply_checks_kinds_before_it_writes() -> None:
    """Nothing is half applied when a kind is unknown."""
    robot = load_model(DESCRIPTION)
    good = parameter_space()["cart.mass"]
    wrong = Parameter(name="x", kind="nonsense", elements=("cart",), unit="", nominal=1, low=0.5, high=2)
    import copy

    model = copy.copy(robot.model)
    with pytest.raises(UnknownNameError):
        apply_parameters(
            ModelFields(model, robot.model), ParameterSpace([good, wrong]), np.array([[1.0, 1.0]])
        )
    assert model.body_mass[element_id(model, "body", "cart")] == pytest.approx(0.3)
