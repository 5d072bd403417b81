"""Whole inertias: every value of stretch and shear is an inertia that a body can have, and is written out."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest
from fakes.sine_arm import MJCF
from mujoco.batch import Batch

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters import apply_parameters
from deal_hw.sim.parameters.fields import BatchFields, ModelFields
from deal_hw.sim.parameters.yaml_space import parse_space

TILTED = """<mujoco><worldbody>
  <body name="a"><joint name="a" axis="0 1 0"/>
    <inertial pos="0.1 0.02 0.03" mass="1.2" fullinertia="0.01 0.012 0.005 0.001 -0.002 0.0005"/>
    <body name="rod" pos="0.3 0 0"><joint name="b" axis="0 0 1"/>
      <inertial pos="0.1 0 0" mass="0.4" diaginertia="1e-9 0.001 0.001"/>
      <body name="plate" pos="0.2 0 0"><joint name="c" axis="1 0 0"/>
        <inertial pos="0 0.05 0" mass="0.3" diaginertia="0.001 0.0005 0.0005"/></body></body></body>
</worldbody></mujoco>"""
WHOLE = "parameters:\n  - {kind: inertial, elements: '*'}"


def _moments(model: mujoco.MjModel, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a body's principal axes as columns, and its second moments about the centre in its frame."""
    body, rotation = model.body(name), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, body.iquat)
    axes = rotation.reshape(3, 3).copy()
    return axes, axes @ np.diag(body.inertia.sum() / 2 - body.inertia) @ axes.T


def _changed(model: mujoco.MjModel, space: ParameterSpace, theta: np.ndarray) -> mujoco.MjModel:
    changed = copy.copy(model)
    apply_parameters(ModelFields(changed, model), space, theta[None])
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    return changed


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", ["a", "rod", "plate"])
def test_second_moments_are_those_of_the_deformed_body(name: str, seed: int) -> None:
    """S = A S0 A^T m / m0 in the frame of the model's principal axes, thinnest first: by definition."""
    model = mujoco.MjModel.from_xml_string(TILTED)
    space = parse_space(WHOLE, model)
    theta = space.sample(np.random.default_rng(seed), 1)[0]
    value = dict(zip(space.names, theta, strict=True))
    changed = _changed(model, space, theta)
    axes, before = _moments(model, name)
    order = np.argsort(np.diag(axes.T @ before @ axes), kind="stable")
    frame = axes[:, order]
    A = np.diag([value[f"{name}.stretch_{i}"] for i in (1, 2, 3)])
    A[0, 1], A[0, 2], A[1, 2] = (value[f"{name}.shear_{i}"] for i in ("12", "13", "23"))
    wanted = frame @ A @ frame.T @ before @ frame @ A.T @ frame.T
    wanted *= value[f"{name}.mass"] / model.body(name).mass[0]
    turned, found = _moments(changed, name)
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)
    offset = [value[f"{name}.ipos_{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(changed.body(name).ipos, model.body(name).ipos + offset)
    inertia = np.sort(changed.body(name).inertia)
    assert inertia[0] > 0 and inertia[2] <= inertia[0] + inertia[1] + 1e-15


def test_members_of_a_batch_move_as_recompiled_models_do() -> None:
    """Mass matrix and bias of each member equal those of a model compiled with its inertia."""
    model = mujoco.MjModel.from_xml_string(TILTED)
    space = parse_space(WHOLE, model)
    theta = space.sample(np.random.default_rng(7), 3)
    theta[0] = space.nominal
    batch = Batch(model, nsim=3, nthread=1)
    for _ in range(2):
        apply_parameters(BatchFields(batch, model), space, theta)
        batch.set_const()
    for n in range(3):
        member, spec = batch.get_model(n), mujoco.MjSpec.from_string(TILTED)
        for name in ("a", "rod", "plate"):
            of, body = member.body(name), spec.body(name)
            body.mass, body.ipos, body.explicitinertial = of.mass[0], of.ipos, True
            body.inertia, body.iquat, body.fullinertia = of.inertia, of.iquat, [np.nan, 0, 0, 0, 0, 0]
        for one, other in zip(_forward(member), _forward(spec.compile()), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def _forward(model: mujoco.MjModel) -> tuple[Any, Any]:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0.3, -0.4, 0.7], [1.0, -2.0, 0.5]
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M, np.array(data.qfrc_bias)


def test_without_deformation_nothing_changes() -> None:
    """At the model's values all fields are the model's, axes included."""
    model = mujoco.MjModel.from_xml_string(TILTED)
    space = parse_space(WHOLE, model)
    changed = _changed(model, space, space.nominal)
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_allclose(getattr(changed, name), getattr(model, name), 1e-12, 1e-15, err_msg=name)


def test_the_set_has_ten_parameters_with_the_model_as_prior() -> None:
    """Accuracies are the usual ones of CAD data unless the file gives others; a weighed mass is known."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    text = "parameters:\n  - {kind: inertial, elements: lower, prior: {com: 0.002}}"
    space = parse_space(text, model)
    mean, std = space.prior
    assert len(space) == 10
    np.testing.assert_array_equal(mean, space.nominal)
    np.testing.assert_allclose(std, [0.1, 0.002, 0.002, 0.002, *[0.1] * 6])
    weighed = parse_space("parameters:\n  - {kind: inertial, elements: lower, weighed: 0.61}", model)
    assert weighed.known == {"lower.mass": 0.61} and len(weighed) == 9


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("kind: inertial, elements: lower, ratio: 3", "`ratio` is not for inertial"),
        ("kind: inertial, elements: lower, prior: {weight: 0.1}", "unknown part of inertial 'weight'"),
        ("kind: inertial, elements: lower, prior: 0.1", "a standard deviation for each part"),
        ("kind: inertial, elements: [upper, lower], weighed: 0.5", "one body's mass, but the entry names 2"),
        ("kind: inertial, elements: hand", "unknown MuJoCo body 'hand'"),
        ("kind: inertail, elements: lower", "did you mean 'inertial'?"),
    ],
)
def test_wrong_entries_say_what_to_write(entry: str, words: str) -> None:
    """The message names the entry's fault."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    with pytest.raises(ConfigurationError) as caught:
        parse_space(f"parameters:\n  - {{{entry}}}", model)
    assert words in str(caught.value)


def test_two_laws_of_one_inertia_are_refused() -> None:
    """A factor on the inertia and a stretch do the same."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    text = "parameters:\n  - {kind: body_inertia, elements: lower}\n  - {kind: inertial, elements: lower}"
    with pytest.raises(ConfigurationError, match=r"both change the inertia of 'lower'; keep one"):
        parse_space(text, model)


def test_a_body_with_fixed_axes_is_refused_with_the_line_to_write() -> None:
    """The compiler's short cut for a centred body cannot be taken back."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="ball"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(ConfigurationError, match='<body name="ball" simple="false">'):
        parse_space("parameters:\n  - {kind: body_stretch_1, elements: ball}", model)


def test_unknown_kinds_list_the_set() -> None:
    """Who looks for the whole inertia finds its word."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    with pytest.raises(UnknownNameError, match="inertial"):
        parse_space("parameters:\n  - {kind: inertias, elements: lower}", model)
