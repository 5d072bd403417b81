"""params.yaml: what it may say, what it must not say, and the template."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, get_args

import mujoco
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION, JOINTS
from deal_hw.errors import ConfigurationError, DealHwError, UnknownNameError
from deal_hw.parameters import Parameter, ParameterSpace, Scale
from deal_hw.robots import recorded_description
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.parameters import KIND_TABLE, with_doubts, with_usual_range
from deal_hw.sim.parameters.default_space import default_space, left_at_zero
from deal_hw.sim.parameters.doubts import DOUBTS
from deal_hw.sim.parameters.template import template
from deal_hw.sim.parameters.yaml_space import parse_space, read_space

MODEL = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))


def _entry(text: str) -> ParameterSpace:
    return parse_space(f"parameters:\n  - {{{text}}}\n", MODEL)


def test_pattern_each_gives_one_parameter_an_element_with_the_models_value() -> None:
    """Four hips, nominal 0.6 from the MJCF, a factor 10 to either side: 0.06 to 6."""
    space = _entry("kind: dof_damping, elements: '*_hip_joint'")
    assert space.names == tuple(f"{leg}_hip_joint.damping" for leg in ("FL", "FR", "RL", "RR"))
    p = space["FL_hip_joint.damping"]
    assert (p.nominal, p.unit, p.scale) == (0.6, "N·m·s/rad", "log")
    assert (p.low, p.high) == pytest.approx((0.06, 6.0))


def test_dry_friction_is_searched_wider() -> None:
    """The model's 0.2 within a factor 20, 0.01 to 4; a ratio in the file overrules."""
    p = _entry("kind: dof_frictionloss, elements: FL_hip_joint")["FL_hip_joint.frictionloss"]
    assert (p.nominal, p.low, p.high) == pytest.approx((0.2, 0.01, 4.0))
    p = _entry("kind: dof_frictionloss, elements: FL_hip_joint, ratio: 5")["FL_hip_joint.frictionloss"]
    assert (p.low, p.high) == pytest.approx((0.04, 1.0))


def test_pattern_together_gives_one_parameter_for_all() -> None:
    """Symmetry: one value for the four calves."""
    space = _entry(
        "kind: servo_stiffness, elements: ['F?_calf*', RL_calf_joint, 'R*_calf_joint'], "
        "group: together, name: calf.stiffness, ratio: 2"
    )
    p = space["calf.stiffness"]
    assert p.elements == ("FL_calf_joint", "FR_calf_joint", "RL_calf_joint", "RR_calf_joint")
    assert (p.low, p.high) == (20.0, 80.0)


def test_pattern_skips_what_cannot_have_the_parameter_and_a_name_does_not() -> None:
    """`*` means the twelve hinges, not the free joint; naming the free joint is a mistake."""
    assert len(_entry("kind: dof_armature, elements: '*'")) == 12
    with pytest.raises(ConfigurationError, match="ball or free joint"):
        _entry("kind: dof_armature, elements: base, nominal: 1")


def test_weighed_known_and_prior() -> None:
    """A weighed value is not searched; a prior's mean and std are values, or the std a share of the mean."""
    assert _entry("kind: body_mass, elements: base, weighed: 7.1").known == {"base.mass": 7.1}
    assert _entry("kind: body_mass, elements: base, known: true").known == {"base.mass": 6.921}
    # 0.14 kg of 7 kg are 2 %, the standard deviation of the logarithm.
    for width in ("0.14", "2 %", "2%"):
        space = _entry(f"kind: body_mass, elements: base, prior: {{mean: 7, std: {width}}}")
        mean, std = space.prior
        assert (mean[0], std[0]) == (7.0, pytest.approx(0.02, rel=1e-12))
    zero = "kind: encoder_bias, elements: FL_hip_joint, prior: {mean: 0.05, std: "
    assert _entry(zero + "0.01}").prior[1] == 0.01
    assert _entry(zero + "10 %}").prior[1] == pytest.approx(0.005, rel=1e-12)
    assert ParameterSpace.from_json(space.to_json()).to_json() == space.to_json()


def test_linear_kinds_get_their_usual_width() -> None:
    """Encoder bias: 0 within 0.1 rad."""
    p = _entry("kind: encoder_bias, elements: FL_hip_joint")["FL_hip_joint.encoder_bias"]
    assert (p.nominal, p.low, p.high, p.scale) == (0.0, -0.1, 0.1, "linear")


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            "kind: dof_dampin, elements: '*'",
            r"nearest of .*.*dof_frictionloss.*; did you mean 'dof_damping'\?",
        ),
        ("kind: dof_damping, elements: FL_hip", r"known: .*FL_hip_joint.*; did you mean 'FL_hip_joint'\?"),
        ("kind: dof_damping, elements: 'X*'", "unknown MuJoCo joint 'X\\*'"),
        ("kind: dof_damping, elements: []", "must be a joint name, a pattern"),
        ("kind: dof_damping, elements: FL_hip_joint, range: [0.7, 0.9]", "nominal value 0.6 lies outside"),
        ("kind: dof_damping, elements: FL_hip_joint, range: [0.9, 0.1]", "they are reversed"),
        ("kind: dof_damping, elements: FL_hip_joint, range: [0.6, 0.6]", "for a fixed value use `known`"),
        ("kind: dof_damping, elements: FL_hip_joint, range: [0, 1]", "log scale needs a positive range"),
        ("kind: dof_damping, elements: FL_hip_joint, range: 3", r"must be \[low, high\]"),
        ("kind: dof_damping, elements: FL_hip_joint, ratio: 0.5", "must be above 1"),
        ("kind: dof_damping, elements: FL_hip_joint, range: [0.1, 1], ratio: 2", "not both"),
        ("kind: dof_damping, elements: FL_hip_joint, nominal: .nan", "must be a finite number"),
        ("kind: dof_damping, elements: FL_hip_joint, nominal: much", "must be a number"),
        ("kind: dof_damping, elements: FL_hip_joint, scale: lin", r"unknown scale 'lin'.*'linear'"),
        ("kind: dof_damping, elements: FL_hip_joint, rang: [0.1, 1]", r"unknown key 'rang'.*'range'"),
        ("kind: dof_damping, elements: FL_hip_joint, nominal: 0", "so a ratio gives no range"),
        ("kind: servo_speed_limit, elements: FL_hip_joint", "an MJCF has no servo_speed_limit"),
        ("kind: dof_damping, elements: '*', group: together", "needs a `name`"),
        ("kind: dof_damping, elements: '*', name: all", "group: together"),
        ("kind: body_mass, elements: [base, FL_hip], group: together, name: m", "base 6.921, FL_hip 0.678"),
        ("kind: body_mass, elements: base, known: 7, nominal: 6", "leave out `nominal`"),
        ("kind: body_mass, elements: base, known: 7, weighed: 6", "not both"),
        ("kind: body_mass, elements: base, prior: {mean: 7}", "`mean` and `std`"),
        ("kind: body_mass, elements: base, prior: {mean: 7, std: 0}", "above 0"),
        ("kind: body_mass, elements: base, prior: {mean: 7, std: some %}", "must be a number"),
        ("kind: body_mass, elements: base, prior: {mean: -7, std: 1}", "mean must be above 0, got -7"),
        ("kind: body_mass, elements: base, prior: {mean: 99, std: 1}", "mean 99 lies outside"),
        ("kind: geom_friction, elements: FL_foot", "overridden by geom 'floor'"),
        ("kind: geom_friction, elements: FL_hip", "touches nothing"),
        ("kind: motor_gain, elements: FL_hip_joint", "use servo_stiffness"),
        ("kind: 3, elements: '*'", "`kind` must be a text"),
    ],
)
def test_mistakes_say_what_to_write(entry: str, message: str) -> None:
    """Every message names the entry and what is allowed."""
    with pytest.raises(ConfigurationError, match=message) as caught:
        _entry(entry)
    assert str(caught.value).startswith("params.yaml")


@pytest.mark.parametrize(
    "text",
    ["", "[]", "parameters: []", "parameters: x", "parameters: [1]", "other: 1", "a: [", "- !!python/none x"],
)
def test_texts_that_are_no_parameters_are_refused(text: str) -> None:
    """Whatever the file holds, the error is ours; nothing is constructed from tags."""
    with pytest.raises(ConfigurationError, match=r"params\.yaml"):
        parse_space(text, MODEL)


def test_repeated_names_and_repeated_elements_are_refused() -> None:
    """Two entries of one name, and two names for one thing."""
    one = "  - {kind: dof_damping, elements: FL_hip_joint}\n"
    with pytest.raises(ConfigurationError, match="names repeat"):
        parse_space("parameters:\n" + one + one, MODEL)
    other = "  - {kind: dof_damping, elements: FL_hip_joint, name: other}\n"
    with pytest.raises(ConfigurationError, match="both set dof_damping"):
        parse_space("parameters:\n" + one + other, MODEL)


def test_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    """The path is in the message."""
    with pytest.raises(ConfigurationError, match=r"absent\.yaml cannot be read"):
        read_space(tmp_path / "absent.yaml", MODEL)


def test_template_parses_to_all_that_an_owner_doubts(tmp_path: Path) -> None:
    """12 joints x 5 and 13 bodies. A joint's damping adds to its servo's, which is larger: it is left out."""
    path = tmp_path / "params.yaml"
    path.write_text(template(MODEL, "go2.xml"), encoding="utf-8")
    space = read_space(path, MODEL)
    assert len(space) == 73
    assert {p.kind for p in space} == {
        "dof_frictionloss",
        "servo_damping",
        "dof_armature",
        "servo_stiffness",
        "body_mass",
        "encoder_bias",
    }


_ARM = """<mujoco><worldbody><body name="link"><joint name="knee" {}/><geom size=".1"/>
<body name="rail"><joint name="rail" type="slide" {}/><geom size=".1"/></body></body></worldbody>
<actuator><position name="knee" joint="knee" kp="{!r}" kv="{!r}" forcerange="-{!r} {!r}"/>
<motor name="push" joint="rail" gear="{!r}"/></actuator></mujoco>"""
_value = st.just(0.0) | st.floats(1e-4, 1e3)


@pytest.mark.parametrize("robot", ["allegro", "b2", "cartpole", "g1", "go2", "h1", "humanoid", "so101"])
def test_the_written_file_reads_back_as_the_default_space(robot: str) -> None:
    """People edit what the code searches: names, values, ranges, scales and order, of each shipped model."""
    model = compile_mjcf(recorded_description(robot).mjcf)
    assert parse_space(template(model), model).parameters == default_space(model).parameters


@settings(deadline=None)
@given(*3 * [st.tuples(_value, _value, _value)])
def test_whatever_is_zero_the_file_reads_back_as_the_default_space(
    knee: tuple[float, ...], rail: tuple[float, ...], drive: tuple[float, ...]
) -> None:
    """A hinge and a slide, with any of friction, damping, armature and a drive's damping and limit at 0."""
    text = 'frictionloss="{!r}" damping="{!r}" armature="{!r}"'
    kp, kv, most = drive
    values = kp or 1.0, kv, most or 1.0, most or 1.0, kp or 2.0
    arm = _ARM.format(text.format(*knee), text.format(*rail), *values)
    model = mujoco.MjModel.from_xml_string(arm)
    assert parse_space(template(model), model).parameters == default_space(model).parameters


def test_a_drive_at_its_limit_has_its_limit_and_both_dampings_searched() -> None:
    """There the limit cuts the drive's damping, not the joint's. An actuator without a name is let be."""
    arm = _ARM.format('damping="1"', "", 9.0, 2.0, 5.0, 5.0, 1.0)
    model = mujoco.MjModel.from_xml_string(arm.replace('<motor name="push"', "<motor"))
    usual, limited = default_space(model), default_space(model, ("knee", ""))
    assert set(limited.names) - set(usual.names) == {"knee.damping", "knee.servo_effort_limit"}
    assert limited["knee.servo_effort_limit"].nominal == 5.0


def test_every_line_of_the_template_can_be_switched_on() -> None:
    """Taking the # away gives lines that parse, one at a time."""
    lines = [x for x in template(MODEL).splitlines() if x.startswith("  # - {")]
    assert len(lines) > 20
    for line in lines:
        assert len(parse_space("parameters:\n" + line.replace("# - {", "- {", 1), MODEL)) == 1


def test_what_is_zero_is_not_searched_and_is_named() -> None:
    """No ratio leads away from 0. A servo's kv is a joint's damping; a plain joint has none."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="thigh"><joint name="knee" armature="0.1"/><geom size="1"/>
        <body name="shank"><joint name="foot" damping="0.2" frictionloss="0.1"/><geom size="1"/></body></body>
        </worldbody>
        <actuator><position name="m" joint="knee" kp="9" kv="1"/></actuator></mujoco>"""
    )
    assert left_at_zero(model) == {"dof_frictionloss": ["knee"], "dof_armature": ["foot"]}
    assert {p.name for p in parse_space(template(model), model)} == {
        "foot.frictionloss",
        "foot.damping",
        "knee.armature",
        "m.servo_stiffness",
        "m.servo_damping",
        "thigh.mass",
        "shank.mass",
        "knee.encoder_bias",
        "foot.encoder_bias",
    }


def test_template_of_a_model_with_nothing_to_search_says_so() -> None:
    """Names and values above 0 are needed."""
    empty = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ConfigurationError, match="name them in the MJCF"):
        template(empty)


def test_awkward_names_survive_the_template() -> None:
    """A joint named like a YAML value or a pattern is still that joint."""
    names = ("yes", "1e3", "a: b", "null", "#x", "j[1]")
    bodies = "".join(
        f'<body name="{n}"><joint name="{n}" damping="1"/><geom size="1"/></body>' for n in names
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    assert [p.elements for p in parse_space(template(model), model)] == 3 * [(n,) for n in names]


_kinds = st.sampled_from(["dof_damping", "dof_frictionloss", "dof_armature", "servo_stiffness"])


@st.composite
def _parameters(draw: st.DrawFn, number: int) -> Parameter:
    scale: Scale = draw(st.sampled_from(get_args(Scale)))
    low = draw(st.floats(1e-6, 1e3))
    high = low * draw(st.floats(1.001, 1e3))
    nominal = min(max(low, low + (high - low) * draw(st.floats(0, 1))), high)
    prior = draw(st.booleans())
    kind = draw(_kinds)
    unit = {"dof_armature": "kg·m²", "dof_damping": "N·m·s/rad", "dof_frictionloss": "N·m"}.get(
        kind, "N·m/rad"
    )
    return Parameter(
        name=f"p{number}." + draw(st.text(min_size=0, max_size=5)).replace("\x00", ""),
        kind=kind,
        elements=(JOINTS[number],),
        unit=unit,
        nominal=nominal,
        low=low,
        high=high,
        scale=scale,
        known=draw(st.booleans()),
        prior_mean=nominal if prior else None,
        prior_std=draw(st.floats(1e-3, 10)) if prior else None,
    )


def write_space(space: ParameterSpace) -> str:
    """Return YAML text that :func:`parse_space` reads back to the same space."""
    # ASCII only: with allow_unicode PyYAML writes a next-line character unquoted and reads it as a space.
    return yaml.safe_dump({"parameters": [_as_entry(p) for p in space.parameters]}, sort_keys=False)


def _as_entry(p: Parameter) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "kind": p.kind,
        "elements": list(p.elements),
        "group": "together",
        "name": p.name,
        "nominal": float(p.nominal),
        "range": [float(p.low), float(p.high)],
        "scale": p.scale,
    }
    if p.known:
        entry["known"] = True
    if p.prior_mean is not None and p.prior_std is not None:
        unit = p.prior_mean if p.scale == "log" else 1.0
        entry["prior"] = {"mean": float(p.prior_mean), "std": float(p.prior_std) * float(unit)}
    return entry


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_written_space_reads_back(data: st.DataObject) -> None:
    """Any space of valid parameters survives the round trip: bit by bit, but for the width of a prior."""
    count = data.draw(st.integers(1, 6))
    space = ParameterSpace(data.draw(_parameters(number)) for number in range(count))
    read = parse_space(write_space(space), MODEL)
    assert read.prior[1] == pytest.approx(space.prior[1], rel=1e-12)
    widths = [p.prior_std for p in space.parameters]
    same = [dataclasses.replace(p, prior_std=w) for p, w in zip(read.parameters, widths, strict=True)]
    assert ParameterSpace(same).to_json() == space.to_json()


@settings(max_examples=150, deadline=None)
@given(
    st.text(max_size=60), st.sampled_from(["", "parameters:\n - ", "parameters:\n - {kind: dof_damping, "])
)
def test_any_text_parses_or_is_refused(text: str, head: str) -> None:
    """No text raises anything but our own error."""
    try:
        assert len(parse_space(head + text, MODEL).parameters)
    except DealHwError as error:
        assert isinstance(error, ConfigurationError | UnknownNameError)


def test_a_value_of_which_nobody_said_anything_has_the_usual_prior() -> None:
    """A chosen range, a given prior and a known value say more; the parameter's range stays the usual one."""
    named = "kind: dof_damping, elements: FL_hip_joint"
    usual, chosen, given, known = (
        with_doubts(_entry(text)).parameters[0]
        for text in (
            named,
            f"{named}, ratio: 3",
            f"{named}, prior: {{mean: 0.5, std: 0.1}}",
            f"{named}, known: 0.6",
        )
    )
    assert (usual.prior_mean, usual.prior_std) == (0.6, DOUBTS["dof_damping"].std)
    assert (chosen.prior_std, given.prior_std, known.prior_std) == (None, 0.2, None)
    space = with_doubts(_entry(named))
    assert with_usual_range(space) == space.names and with_doubts(space).parameters == space.parameters
    assert with_usual_range(ParameterSpace([given])) == ()


@pytest.mark.parametrize("kind", DOUBTS)
def test_a_doubt_is_narrower_than_the_range_that_is_searched(kind: str) -> None:
    """A prior as wide as the range would leave the value to the range, and call it unknown."""
    low, high = KIND_TABLE[kind].usual_range(1.0, KIND_TABLE[kind].scale)
    width = math.log(high / low) if KIND_TABLE[kind].scale == "log" else high - low
    assert DOUBTS[kind].std < width / math.sqrt(12)
