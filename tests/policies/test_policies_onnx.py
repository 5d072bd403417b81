"""Policies in ONNX files: the spec inside, export and runtime, and what is refused."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import PolicyError, PolicyMismatchError
from deal_hw.policies.cartpole_env import BalanceTask, balance_spec
from deal_hw.policies.onnx_export import export_network, write_policy
from deal_hw.policies.onnx_runtime import SPEC_KEY, OnnxPolicy
from deal_hw.policy import ObservationTerm, PolicySpec

if TYPE_CHECKING:
    import torch

SPEC = dataclasses.replace(
    balance_spec(DESCRIPTION, BalanceTask(), "0123456789abcdef"), training={"algorithm": "none"}
)


def network(inputs: int = len(SPEC.observation), outputs: int = 1, seed: int = 0) -> torch.nn.Sequential:
    import torch

    torch.manual_seed(seed)
    layers = [torch.nn.Linear(inputs, 16), torch.nn.ReLU(), torch.nn.Linear(16, outputs), torch.nn.Tanh()]
    return torch.nn.Sequential(*layers)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return an exported policy."""
    path = tmp_path / "policy.onnx"
    export_network(network(), SPEC, path, {"seed": 1})
    return path


def test_file_computes_what_the_network_computes(file: Path) -> None:
    """One observation at a time or many at once, the file agrees with torch to 1e-5."""
    import torch

    observations = np.random.default_rng(0).standard_normal((50, len(SPEC.observation))).astype(np.float32)
    with torch.no_grad():
        wanted = network()(torch.as_tensor(observations)).numpy()
    policy = OnnxPolicy(file)
    np.testing.assert_allclose(policy.act_batch(observations), wanted, rtol=0, atol=1e-5)
    np.testing.assert_allclose([policy.act(row) for row in observations], wanted, rtol=0, atol=1e-5)
    assert policy.act(observations[0]).dtype == np.float64


def test_a_tiny_network_by_hand(tmp_path: Path) -> None:
    """tanh(2 * relu(3 * 0.1 - 0.2) + 0.5) = tanh(0.7), from the file."""
    import torch

    first, last = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
    for layer, weight, bias in ((first, 3.0, -0.2), (last, 2.0, 0.5)):
        torch.nn.init.constant_(layer.weight, weight)
        torch.nn.init.constant_(layer.bias, bias)
    spec = dataclasses.replace(SPEC, observation=(ObservationTerm("position", "pole", 1.0),))
    chain = torch.nn.Sequential(torch.nn.Sequential(first, torch.nn.ReLU()), last, torch.nn.Tanh())
    policy = export_network(chain, spec, tmp_path / "tiny.onnx")
    np.testing.assert_allclose(policy.act(np.array([0.1], dtype=np.float32)), [np.tanh(0.7)], atol=1e-6)


def test_an_adapted_policy_by_hand(tmp_path: Path) -> None:
    """Of terms a, b: z = 0.5 a - b, then 2 a + 3 z + 0.1, clipped; a feedback is added before."""
    import torch

    from deal_hw.policies.network_policy import AdaptedNetwork, Feedback, FeedbackNetwork

    def linear(weights: list[float], bias: float) -> torch.nn.Linear:
        layer = torch.nn.Linear(len(weights), 1)
        with torch.no_grad():
            layer.weight[:] = torch.tensor(weights)
            layer.bias[:] = bias
        return layer

    terms = (ObservationTerm("position", "pole", 1.0), ObservationTerm("position", "pole", 1.0, 1))
    spec = dataclasses.replace(SPEC, observation=terms)
    policy, felt = torch.nn.Sequential(linear([2.0, 3.0], 0.1)), torch.nn.Sequential(linear([0.5, -1.0], 0.0))
    observed = np.array([[0.1, 0.2], [0.5, 0.0], [0.0, -0.1]], dtype=np.float32)
    bounded = torch.nn.Sequential(*policy, torch.nn.Hardtanh())
    plain = export_network(AdaptedNetwork(bounded, felt, 1), spec, tmp_path / "plain.onnx")
    np.testing.assert_allclose(plain.act_batch(observed)[:, 0], [-0.15, 1.0, 0.4], atol=1e-6)
    fed = FeedbackNetwork(AdaptedNetwork(policy, felt, 1), Feedback(np.array([[0.0, -2.0]])))
    summed = export_network(fed, spec, tmp_path / "fed.onnx")
    np.testing.assert_allclose(summed.act_batch(observed)[:, 0], [-0.55, 1.0, 0.6], atol=1e-6)


def test_file_is_one_file_with_its_record_beside_it(file: Path) -> None:
    """No side file holds weights, no draft is left, and nothing in it tells of the machine that wrote it."""
    assert sorted(p.name for p in file.parent.iterdir()) == ["policy.json", "policy.onnx"]
    assert str(Path(sys.prefix).resolve()).encode() not in file.read_bytes()


def test_spec_travels_inside_the_file(file: Path) -> None:
    """What comes out of the file equals what went in."""
    assert OnnxPolicy(file).spec == SPEC


names = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), min_size=1, max_size=8)
finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(0.0, allow_infinity=False)


@st.composite
def specs(draw: st.DrawFn) -> PolicySpec:
    """Specs of robots with any names and numbers."""
    joints = tuple(draw(st.lists(names, min_size=1, max_size=4, unique=True)))
    actuated = joints[: draw(st.integers(1, len(joints)))]
    kinds = st.sampled_from(["position", "velocity", "sin_position", "cos_position"])
    scales = finite.filter(bool)
    terms = st.builds(ObservationTerm, kinds, st.sampled_from(joints), scales, st.integers(0, 5))
    actions = st.builds(
        ObservationTerm, st.just("action"), st.sampled_from(actuated), scales, st.integers(1, 5)
    )
    per_actuated = st.tuples(*[positive] * len(actuated))
    return PolicySpec(
        robot=draw(names),
        joint_names=joints,
        actuated=actuated,
        observation=tuple(draw(st.lists(terms | actions, min_size=1, max_size=6))),
        action_scale=draw(st.tuples(*[finite] * len(actuated))),
        default_position=draw(st.tuples(*[finite] * len(joints))),
        stiffness=draw(per_actuated),
        damping=draw(per_actuated),
        effort_limit=draw(per_actuated),
        speed_limit=draw(per_actuated),
        control_rate_hz=draw(st.floats(1.0, 1000.0)),
        trained_under=draw(st.text(max_size=8)),
        training=draw(st.dictionaries(names, st.integers() | st.text(max_size=5), max_size=3)),
        position_units=draw(st.tuples(*[st.sampled_from(["m", "rad"])] * len(joints)) | st.just(())),
    )


@given(specs())
def test_spec_survives_json(spec: PolicySpec) -> None:
    """Any spec comes back from its JSON, with the same digest."""
    again = PolicySpec.from_json(spec.to_json())
    assert again == spec
    assert again.digest() == spec.digest()


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(spec=specs())
def test_spec_survives_the_file(tmp_path: Path, spec: PolicySpec) -> None:
    """Any spec comes back from a file, whatever characters its names have."""
    path = tmp_path / "any.onnx"
    export_network(network(len(spec.observation), len(spec.actuated)), spec, path)
    assert OnnxPolicy(path).spec == spec


def test_a_missing_file_is_an_error_with_advice(tmp_path: Path) -> None:
    """The message names the path and the verb that makes such a file."""
    with pytest.raises(
        PolicyError, match=r"no such policy file: .*nothing\.onnx; train one with `deal-hw train`"
    ):
        OnnxPolicy(tmp_path / "nothing.onnx")


@pytest.mark.parametrize("content", [b"", b"not a network", b"\x08\x09\x12\x02"])
def test_what_is_not_onnx_is_refused(tmp_path: Path, content: bytes) -> None:
    """Text, nothing and a torn file are no networks."""
    path = tmp_path / "bad.onnx"
    path.write_bytes(content)
    with pytest.raises(PolicyError, match=r"bad\.onnx is not an ONNX network that can be run"):
        OnnxPolicy(path)


def test_a_network_without_a_spec_is_refused(file: Path) -> None:
    """Any other ONNX file lacks what deployment must know."""
    model = onnx.load(file)
    del model.metadata_props[:]
    file.write_bytes(model.SerializeToString())
    with pytest.raises(PolicyError, match="without a policy spec"):
        OnnxPolicy(file)


def test_a_spec_that_is_not_one_is_refused(file: Path) -> None:
    """A spec of another version does not become a crash."""
    model = onnx.load(file)
    onnx.helper.set_model_props(model, {SPEC_KEY: '{"robot": "cartpole"}'})
    file.write_bytes(model.SerializeToString())
    with pytest.raises(PolicyError, match=r"policy\.onnx: not a policy spec: .*train it again"):
        OnnxPolicy(file)


def test_network_and_spec_that_disagree_are_refused(file: Path) -> None:
    """The message gives both shapes of what differs."""
    model = onnx.load(file)
    write_policy(model, dataclasses.replace(SPEC, observation=SPEC.observation[:4]), file)
    with pytest.raises(
        PolicyError,
        match=r"input 'observation' is .* of shape \['batch', 32\], the spec says .* \(batch, 4\)",
    ):
        OnnxPolicy(file)


def test_an_observation_of_another_length_is_refused(file: Path) -> None:
    """The runtime does not guess which terms are missing."""
    with pytest.raises(PolicyError, match=r"observation of shape \(3,\), expected \(32,\)"):
        OnnxPolicy(file).act(np.zeros(3, dtype=np.float32))


def test_an_unknown_layer_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    """The message names the layer and the known ones; nothing that could be deployed is left."""
    import torch

    with pytest.raises(
        PolicyError,
        match="cannot export a layer of type GELU; known inside Sequential: Linear, Hardtanh, ELU",
    ):
        export_network(
            torch.nn.Sequential(torch.nn.Linear(32, 1), torch.nn.GELU()), SPEC, tmp_path / "x.onnx"
        )
    assert list(tmp_path.iterdir()) == []


def test_a_policy_for_another_robot_is_refused_by_field() -> None:
    """Every field that differs is named with both values; the others are not."""
    other = dataclasses.replace(SPEC, robot="pendulum", control_rate_hz=100.0, stiffness=(900.0,))
    with pytest.raises(PolicyMismatchError) as caught:
        other.check_fits(DESCRIPTION)
    text = str(caught.value)
    assert "robot: policy has 'pendulum', robot has 'cartpole'" in text
    assert "control_rate_hz: policy has 100.0, robot has 50.0" in text
    assert "stiffness: policy requests (900.0,), the robot allows at most (200.0,)" in text
    assert "joint_names" not in text


def test_runtime_loads_neither_torch_nor_mujoco() -> None:
    """The robot's computer has neither."""
    code = (
        "import sys, deal_hw.policies.onnx_runtime; "
        "print([m for m in ('torch', 'mujoco', 'scipy', 'onnx', 'gymnasium') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
