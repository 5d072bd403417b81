"""Each parameter kind writes what it says and nothing else, in a batch as in a single model."""

from __future__ import annotations

import copy
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.law_robots import SERVO
from mujoco.batch import Batch

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.batch import COMMAND_KINDS
from deal_hw.sim.parameters import (
    DEVICE_KINDS,
    KIND_TABLE,
    KINDS,
    apply_parameters,
    check_space,
    find_kind,
)
from deal_hw.sim.parameters.doubts import DOUBTS
from deal_hw.sim.parameters.fields import BatchFields, ModelFields
from deal_hw.sim.parameters.geom import bounce, damping_ratio, restitution_of
from deal_hw.sim.parameters.laws import FRICTION_KINDS, SERVO_LAW_KINDS
from deal_hw.sim.parameters.transmission import TRANSMISSION_KINDS
from deal_hw.sim.parameters.yaml_space import parse_space

MJCF = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" priority="1"/>
    <body name="ball" pos="2 0 0.55">
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
VALUES = {"geom_restitution": 0.4, "dof_friction_creep": 0.02}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MJCF)


def _parameter(kind: str, element: str | None = None, nominal: float | None = None) -> Parameter:
    found = KIND_TABLE[kind]
    if element is None:
        element = {"rod_length": "rod", "motor_gain": "cart", "motor_gear": "cart"}.get(
            kind, ELEMENTS[found.element]
        )
    value = VALUES.get(kind, 1.3) if nominal is None else nominal
    return Parameter(
        name=f"{element}.{kind}",
        kind=kind,
        elements=(element,),
        unit=found.unit,
        nominal=value,
        low=value / 2,
        high=value * 2,
        scale=found.scale,
    )


def _single(model: mujoco.MjModel, space: ParameterSpace, theta: np.ndarray) -> mujoco.MjModel:
    changed = copy.copy(model)
    apply_parameters(ModelFields(changed, model), space, theta[None])
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    return changed


def _changed(a: mujoco.MjModel, b: mujoco.MjModel) -> set[str]:
    return {
        name
        for name in dir(a)
        if not name.startswith("_")
        and isinstance(getattr(a, name), np.ndarray)
        and not np.array_equal(getattr(a, name), getattr(b, name))
    }


_SHORTCUTS = {"body_sameframe"}


@pytest.mark.parametrize("kind", KINDS)
def test_kind_writes_the_fields_it_names_and_no_other(kind: str, model: mujoco.MjModel) -> None:
    """What differs from the model after applying one parameter is what the table says."""
    space = ParameterSpace([_parameter(kind)])
    check_space(model, space)
    changed = copy.copy(model)
    apply_parameters(ModelFields(changed, model), space, space.nominal[None])
    found = _changed(model, changed)
    assert found and found <= set(KIND_TABLE[kind].writes) | _SHORTCUTS


@pytest.mark.parametrize("kind", KINDS)
def test_batch_of_three_and_single_model_agree(kind: str, model: mujoco.MjModel) -> None:
    """Each member of a batch holds what a single model with its value holds, derived constants included."""
    p = _parameter(kind)
    space = ParameterSpace([p])
    theta = np.linspace(p.low * 1.1, p.high * 0.9, 3)[:, None]
    batch = Batch(model, nsim=3, nthread=1)
    fields = BatchFields(batch, model)
    for _ in range(2):
        apply_parameters(fields, space, theta)
        batch.set_const()
    for i in range(3):
        single, member = _single(model, space, theta[i]), batch.get_model(i)
        for name in (*KIND_TABLE[kind].writes, "body_subtreemass", "dof_invweight0", "dof_M0"):
            np.testing.assert_allclose(getattr(member, name), getattr(single, name), rtol=1e-12, err_msg=name)


def test_mass_and_inertia_by_hand(model: mujoco.MjModel) -> None:
    """0.1 kg to 0.2 kg doubles 7.5e-4 to 1.5e-3; a factor 3 on the inertia makes that 4.5e-3."""
    space = ParameterSpace([_parameter("body_inertia", "rod", 3.0), _parameter("body_mass", "rod", 0.2)])
    changed = _single(model, space, np.array([3.0, 0.2]))
    assert changed.body("rod").mass[0] == pytest.approx(0.2)
    assert changed.body("rod").inertia[0] == pytest.approx(4.5e-3)


def test_centre_of_mass_moves_by_the_offset(model: mujoco.MjModel) -> None:
    """The rod's centre at z = 0.15 m goes to (0.01, 0, 0.13) m."""
    space = ParameterSpace([_offset("rod", "x", 0.01), _offset("rod", "z", -0.02)])
    changed = _single(model, space, np.array([0.01, -0.02]))
    np.testing.assert_allclose(changed.body("rod").ipos, [0.01, 0, 0.13])


def _offset(body: str, axis: str, value: float) -> Parameter:
    return Parameter(
        name=f"{body}.{axis}",
        kind=f"body_ipos_{axis}",
        elements=(body,),
        unit="m",
        nominal=value,
        low=-0.05,
        high=0.05,
        scale="linear",
    )


def _acceleration(model: mujoco.MjModel) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[-3:] = 0.1, 0.4, -0.7
    data.qvel[:] = np.linspace(-1, 1, model.nv)
    data.ctrl[:] = 0.3, 0.2
    mujoco.mj_forward(model, data)
    return np.array(data.qacc)


def test_offset_of_a_centre_that_was_in_the_origin_equals_a_recompiled_model() -> None:
    """The compiler's shortcuts are taken back, and a body where that cannot be done is refused."""
    plain = mujoco.MjModel.from_xml_string(MJCF)
    with pytest.raises(ConfigurationError, match='<body name="ball" simple="false">'):
        check_space(plain, ParameterSpace([_offset("ball", "x", 0.03)]))
    text = MJCF.replace('<body name="ball"', '<body name="ball" simple="false"')
    model = mujoco.MjModel.from_xml_string(text)
    assert model.body_sameframe[model.body("ball").id]
    space = ParameterSpace([_offset("ball", "x", 0.03), _offset("cart", "z", 0.02)])
    check_space(model, space)
    spec = mujoco.MjSpec.from_string(text)
    for name, ipos in (("ball", [0.03, 0, 0]), ("cart", [0, 0, 0.02])):
        i = model.body(name).id
        body = spec.body(name)
        body.mass, body.inertia, body.ipos = model.body_mass[i], model.body_inertia[i], ipos
        body.explicitinertial = True
    changed = _single(model, space, np.array([0.03, 0.02]))
    np.testing.assert_allclose(_acceleration(changed), _acceleration(spec.compile()), rtol=1e-9, atol=1e-9)


def test_scaled_body_equals_a_recompiled_model() -> None:
    """An arm 1.25 times as large: 0.5 m long, child at 0.5 m, inertia times 1.5625, mass 0.5 kg."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    space = ParameterSpace([_parameter("body_scale", "arm", 1.25)])
    changed = _single(model, space, np.array([1.25]))
    larger = mujoco.MjModel.from_xml_string(
        MJCF.replace('fromto="0 0 0 0 0 0.4" size="0.02"', 'fromto="0 0 0 0 0 0.5" size="0.025"')
        .replace('<site name="end" pos="0 0 0.4"/>', '<site name="end" pos="0 0 0.5"/>')
        .replace('<body name="rod" pos="0 0 0.4">', '<body name="rod" pos="0 0 0.5">')
    )
    for name in KIND_TABLE["body_scale"].writes:
        np.testing.assert_allclose(
            getattr(changed, name), getattr(larger, name), rtol=1e-9, atol=1e-12, err_msg=name
        )
    np.testing.assert_allclose(_acceleration(changed), _acceleration(larger), rtol=1e-9)


def test_gear_keeps_its_sign(model: mujoco.MjModel) -> None:
    """A motor with gear -3 and a value of 4 gets gear -4."""
    changed = _single(model, ParameterSpace([_parameter("motor_gear", "cart", 4.0)]), np.array([4.0]))
    assert changed.actuator_gear[1, 0] == -4.0


def test_restitution_is_the_damping_ratio_of_a_spring_damper(model: mujoco.MjModel) -> None:
    """At e = exp(-pi) the ratio is 1 / sqrt(2): pi z / sqrt(1 - z^2) = pi there; the frequency stays."""
    e = np.exp(-np.pi)
    assert damping_ratio(np.array([e]))[0] == pytest.approx(np.sqrt(0.5))
    assert restitution_of(float(np.sqrt(0.5))) == pytest.approx(e)
    assert restitution_of(1.0) == 0.0
    changed = _single(model, ParameterSpace([_parameter("geom_restitution", "floor", 0.5)]), np.array([0.5]))
    timeconst, ratio = changed.geom_solref[changed.geom("floor").id]
    assert timeconst * ratio == pytest.approx(0.02)
    assert restitution_of(float(ratio)) == pytest.approx(0.5)


def test_a_ball_bounces_higher_with_more_restitution(model: mujoco.MjModel) -> None:
    """The bounce of a dropped ball rises with the parameter, as a one-sided spring-damper says."""
    values = np.array([0.1, 0.3, 0.6, 0.9])
    space = ParameterSpace([_parameter("geom_restitution", "floor", 0.3)])
    ratios = []
    for e in values:
        changed = _single(model, space, np.array([e]))
        data = mujoco.MjData(changed)
        speeds = []
        for _ in range(300):
            mujoco.mj_step(changed, data)
            speeds.append(data.qvel[2])
        ratios.append(max(speeds[100:]) / -min(speeds))
    assert np.all(np.diff(ratios) > 0)
    wanted = [bounce(float(ratio)) for ratio in damping_ratio(values)]
    np.testing.assert_allclose(ratios, wanted, atol=0.02)
    np.testing.assert_allclose(wanted, [0.25, 0.40, 0.63, 0.90], atol=0.006)


@pytest.mark.parametrize("speed", [2.0, -3.0])
def test_damping_grows_with_speed(model: mujoco.MjModel, speed: float) -> None:
    """Against the motion: 0.2 |v| of the model's own, 0.5 v^2 and 0.1 |v|^3; 3.2 N·m at 2 rad/s."""
    space = ParameterSpace(
        [_parameter("dof_dampingpoly_square", "arm", 0.5), _parameter("dof_dampingpoly_cube", "arm", 0.1)]
    )
    changed = _single(model, space, space.nominal)
    data = mujoco.MjData(changed)
    dof = changed.joint("arm").dofadr[0]
    data.qvel[dof] = speed
    mujoco.mj_forward(changed, data)
    torque = 0.2 * abs(speed) + 0.5 * speed**2 + 0.1 * abs(speed) ** 3
    assert data.qfrc_damper[dof] == pytest.approx(-np.sign(speed) * torque)


def test_creep_falls_in_proportion_to_the_parameter(model: mujoco.MjModel) -> None:
    """The loaded arm that dry friction holds creeps a tenth as fast at a tenth of the value."""
    speeds = []
    for value in (0.1, 0.01):
        space = ParameterSpace([_parameter("dof_friction_creep", "rod", value)])
        changed = _single(model, space, np.array([value]))
        changed.opt.gravity[:] = 0
        changed.dof_frictionloss[changed.joint("rod").dofadr[0]] = 0.5
        data = mujoco.MjData(changed)
        for _ in range(200):
            data.qfrc_applied[changed.joint("rod").dofadr[0]] = 0.1
            mujoco.mj_step(changed, data)
        speeds.append(float(data.joint("rod").qvel[0]))
    assert speeds[0] > 1e-4
    assert speeds[0] / speeds[1] == pytest.approx(11, rel=0.1)  # (0.1 / 0.9) / (0.01 / 0.99) = 11


@pytest.mark.parametrize(
    ("kind", "element", "message"),
    [
        ("dof_damping", "free", "ball or free joint"),
        ("servo_stiffness", "cart", "no position servo.*motor_gain"),
        ("motor_gain", "arm", "no motor.*servo_stiffness"),
        ("servo_effort_limit", "cart", "no symmetric effort limit"),
        ("geom_friction", "box", "touches nothing"),
        ("geom_friction", "ball", "overridden by geom 'floor'"),
        ("rod_length", "cart", "not a thin uniform rod"),
        ("body_mass", "world", "fixed to the world"),
    ],
)
def test_element_that_cannot_have_the_parameter_says_why(
    kind: str, element: str, message: str, model: mujoco.MjModel
) -> None:
    """The check before any work names element, reason and what to do."""
    with pytest.raises(ConfigurationError, match=message):
        check_space(model, ParameterSpace([_parameter(kind, element)]))


def test_two_parameters_of_one_thing_are_refused(model: mujoco.MjModel) -> None:
    """The later one would silently win."""
    both = [
        _parameter("dof_damping", "arm"),
        Parameter.around("again", "dof_damping", ["rod", "arm"], "N·m·s/rad", 1.0),
    ]
    with pytest.raises(ConfigurationError, match="both set dof_damping of 'arm'"):
        check_space(model, ParameterSpace(both))


def test_range_that_the_kind_does_not_allow_is_refused(model: mujoco.MjModel) -> None:
    """A restitution above 1 gains energy."""
    p = Parameter.around("bounce", "geom_restitution", ["floor"], "-", 0.5)
    with pytest.raises(ConfigurationError, match=r"exceeds what geom_restitution allows, \[0, 0.99\]"):
        check_space(model, ParameterSpace([p]))


def test_mesh_that_touches_cannot_be_scaled() -> None:
    """The error names rod_length."""
    mesh = "0 0 0 0.1 0 0 0 0.1 0 0 0 0.1"
    text = f"""
    <mujoco><asset><mesh name="m" vertex="{mesh}"/></asset><worldbody><body name="b"><freejoint/>
    <geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    with pytest.raises(ConfigurationError, match="rod_length"):
        check_space(model, ParameterSpace([_parameter("body_scale", "b")]))


def test_unknown_kind_names_the_nearest() -> None:
    """All of them would be a screenful, and docs/reference/parameters.md has them."""
    with pytest.raises(UnknownNameError, match=r"did you mean 'dof_damping'\?") as caught:
        find_kind("dof_dampin")
    assert len(caught.value.allowed) == len((*KINDS, *DEVICE_KINDS)) and len(str(caught.value)) < 500
    assert "dof_dampingpoly_square" in str(caught.value)
    with pytest.raises(UnknownNameError, match="'encoder_bias'"):
        find_kind("encoder_bia")
    assert set(DEVICE_KINDS) == {
        "servo_speed_limit",
        "command_delay",
        "servo_play",
        "encoder_bias",
        "encoder_scale",
        "sensor_noise",
        "motor_free_speed",
        *COMMAND_KINDS,
        *FRICTION_KINDS,
        *SERVO_LAW_KINDS,
        *(kind.name for kind in TRANSMISSION_KINDS),
        "effort_gain",
        "effort_bias",
        "effort_delay",
        "effort_noise",
    }


@pytest.mark.parametrize(("torque", "moves"), [(0.19, False), (0.21, True)])
def test_tendon_friction_is_force_times_moment_arm(torque: float, moves: bool) -> None:
    """At 90 degrees a line between points 0.1 m from the knee passes it at 0.0707 m: 2.83 N hold 0.2 N·m."""
    knee = mujoco.MjModel.from_xml_string(
        """
<mujoco>
  <option timestep="0.001" gravity="0 0 0" integrator="implicitfast" tolerance="1e-12"/>
  <worldbody>
    <site name="above" pos="0 0 0.1"/>
    <body>
      <joint name="knee" axis="0 1 0" armature="0.01"/>
      <geom size="0.01" pos="0 0 -0.1" mass="0.01"/>
      <site name="below" pos="0 0 -0.1"/>
    </body>
  </worldbody>
  <tendon><spatial name="rod"><site site="above"/><site site="below"/></spatial></tendon>
</mujoco>"""
    )
    space = ParameterSpace([_parameter("tendon_frictionloss", "rod", 0.2 / (0.1 * np.sin(np.pi / 4)))])
    changed = _single(knee, space, space.nominal)
    data = mujoco.MjData(changed)
    data.qpos[0], data.qfrc_applied[0] = np.pi / 2, torque
    mujoco.mj_step(changed, data, 100)
    # 0.01 N·m on 0.0101 kg·m² for 0.1 s is 0.1 rad/s; what friction holds creeps by 0.02 rad/s.
    assert (abs(data.qvel[0]) > 0.04) == moves


@pytest.mark.parametrize("name", [name for name in KINDS if name != "geom_restitution"])
def test_baseline_is_what_writing_it_back_keeps(name: str, model: mujoco.MjModel) -> None:
    """A parameter at the model's own value leaves the model as it is (restitution 0 is any ratio above 1)."""
    kind = KIND_TABLE[name]
    assert kind.baseline is not None
    element = _parameter(name).elements[0]
    index = getattr(model, kind.element)(element).id
    value = kind.baseline(model, index)
    changed = copy.copy(model)
    wide = Parameter(
        name="x",
        kind=name,
        elements=(element,),
        unit="",
        nominal=value,
        low=value - 1,
        high=value + 1,
        scale="linear",
    )
    apply_parameters(ModelFields(changed, model), ParameterSpace([wide]), np.array([[value]]))
    for field in kind.writes:
        np.testing.assert_allclose(getattr(changed, field), getattr(model, field), rtol=1e-12, err_msg=field)


def test_every_kind_has_its_row_in_the_docs() -> None:
    """Kind, element, unit, fields and what moves along are those of the table."""
    text = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "parameters.md").read_text(
        encoding="utf-8"
    )
    rows = {
        cells[1].strip().strip("`"): [cell.strip() for cell in cells[2:6]]
        for cells in (line.split("|") for line in text.splitlines() if line.startswith("| `"))
        if len(cells) == 7
    }
    assert set(rows) == set(KIND_TABLE)
    for name, kind in KIND_TABLE.items():
        fields = ", ".join(f"`{field}`" for field in kind.writes) or "none"
        wanted = [kind.element, kind.unit, "see below" if name == "body_scale" else fields, kind.along]
        assert rows[name] == wanted
    assert all(f"`{field}`" in text for field in KIND_TABLE["body_scale"].writes)


def test_every_doubt_has_its_row_in_the_docs() -> None:
    """Width and source are those of the table."""
    page = Path(__file__).resolve().parents[2] / "docs" / "reference" / "parameters.md"
    part = page.read_text(encoding="utf-8").split("## What is expected")[1].split("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("| `")]
    assert {name.strip("`"): (float(std.split()[0]), source) for name, std, source in rows} == {
        name: (doubt.std, doubt.source) for name, doubt in DOUBTS.items()
    }


def test_the_set_of_a_dynamixel_servo_in_the_docs_can_be_searched() -> None:
    """Six parameters of each of two servos are searched, and the counts of its encoder are known."""
    page = Path(__file__).resolve().parents[2] / "docs" / "reference" / "parameters.md"
    block = page.read_text(encoding="utf-8").split("A Dynamixel X servo")[1].split("    parameters:\n")[1]
    entries = [line[4:] for line in block.splitlines() if line.startswith("      - ")]
    space = parse_space("\n".join(["parameters:", *entries]), mujoco.MjModel.from_xml_string(SERVO))
    assert len(space.parameters) == 2 * 7 and len(space.free) == 2 * 6
    assert [p.nominal for p in space.parameters if p.kind == "servo_resolution"] == 2 * [0.001534]


def test_gain_of_a_motor_is_its_force_at_the_joint(model: mujoco.MjModel) -> None:
    """A slide's motor of gear -3: 3 N at a control of 1, where 1 N was printed; 6 N doubles MuJoCo's gain."""
    kind, index = KIND_TABLE["motor_gain"], model.actuator("cart").id
    assert kind.baseline is not None
    assert kind.baseline(model, index) == 3.0 and kind.unit_of(model, index) == "N"
    changed = _single(model, ParameterSpace([_parameter("motor_gain", nominal=6.0)]), np.array([6.0]))
    data = mujoco.MjData(changed)
    data.ctrl[index] = 1.0
    mujoco.mj_forward(changed, data)
    assert changed.actuator_gainprm[index, 0] == 2.0
    assert data.joint("cart").qfrc_actuator[0] == -6.0
