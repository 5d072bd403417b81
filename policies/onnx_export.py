"""Writes a torch network as an ONNX file with its policy spec inside and its training record beside it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch

from deal_hw.errors import PolicyError
from deal_hw.policies.network_policy import Feedback, FeedbackNetwork
from deal_hw.policies.onnx_runtime import SPEC_KEY, OnnxPolicy
from deal_hw.policy import Observation, PolicySpec

OPSET = 18
IR_VERSION = 9
"""Low enough for every onnxruntime that the extra `deploy` accepts."""
_ACTIVATIONS: Mapping[type[torch.nn.Module], str] = {
    torch.nn.ELU: "Elu",
    torch.nn.ReLU: "Relu",
    torch.nn.Tanh: "Tanh",
}
TOLERANCE = 1e-5
"""Largest difference between network and file on an action in [-1, 1]."""
ROUNDING = 1e-6
"""Rounding of a sum in single precision, as share of the sum of its absolute terms."""


def export_network(
    network: torch.nn.Module, spec: PolicySpec, path: Path, record: Mapping[str, Any] | None = None
) -> OnnxPolicy:
    """Write a network, compare the file with it, and return the file's policy.

    Files are written under other names and then renamed, so that an interrupted export leaves nothing that
    could be deployed.

    Args:
        network: Observations (B, O) in, actions (B, A) out: a Sequential of linear layers and activations,
            or a FeedbackNetwork of one.
        spec: Its spec.
        path: The .onnx file; the record goes beside it with the suffix .json.
        record: Plain JSON values about the training.

    Raises:
        PolicyError: A layer has an unknown type, or the file computes other actions than the network.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.draft")
    try:
        write_policy(_graph(network, len(spec.observation)), spec, draft)
        policy = OnnxPolicy(draft)
        _check_equal(network, policy)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    if record is not None:
        path.with_suffix(".json").write_text(
            json.dumps(dict(record), indent=2, sort_keys=True) + "\n", encoding="utf-8"
        )
    return OnnxPolicy(path)


def write_policy(model: onnx.ModelProto, spec: PolicySpec, path: Path) -> None:
    """Write an ONNX network with a policy spec inside, weights included, as one file."""
    kept = {entry.key: entry.value for entry in model.metadata_props if entry.key != SPEC_KEY}
    onnx.helper.set_model_props(model, {**kept, SPEC_KEY: spec.to_json()})
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())


def _graph(network: torch.nn.Module, observation: int) -> onnx.ModelProto:
    # Built by hand: torch's exporter takes seconds, needs onnxscript, and writes local paths into every node.
    # A policy network is a chain of a few known layers, with or without a feedback beside it.
    nodes: list[onnx.NodeProto] = []
    weights: list[onnx.TensorProto] = []
    width, value = observation, "observation"
    layers = _chain(network)
    for i, layer in enumerate(layers):
        result = "action" if i == len(layers) - 1 else f"value_{i}"
        if isinstance(layer, Feedback):
            gain = layer.weight.detach().cpu().numpy().astype(np.float32)
            weights.append(onnx.numpy_helper.from_array(gain, "gain"))
            nodes.append(onnx.helper.make_node("Gemm", ["observation", "gain"], ["feedback"], transB=1))
            nodes.append(onnx.helper.make_node("Add", [value, "feedback"], [result]))
        elif isinstance(layer, torch.nn.Linear):
            names = [f"weight_{i}", f"bias_{i}"]
            bias = torch.zeros(layer.out_features) if layer.bias is None else layer.bias
            weights += [
                onnx.numpy_helper.from_array(tensor.detach().cpu().numpy().astype(np.float32), name)
                for tensor, name in zip((layer.weight, bias), names, strict=True)
            ]
            nodes.append(onnx.helper.make_node("Gemm", [value, *names], [result], transB=1))
            width = layer.out_features
        elif type(layer) in _ACTIVATIONS:
            nodes.append(onnx.helper.make_node(_ACTIVATIONS[type(layer)], [value], [result]))
        elif isinstance(layer, torch.nn.Hardtanh):
            names = [f"lowest_{i}", f"highest_{i}"]
            weights += [
                onnx.numpy_helper.from_array(np.array(bound, dtype=np.float32), name)
                for bound, name in zip((layer.min_val, layer.max_val), names, strict=True)
            ]
            nodes.append(onnx.helper.make_node("Clip", [value, *names], [result]))
        else:
            known = ", ".join(["Linear", "Hardtanh", *(kind.__name__ for kind in _ACTIVATIONS)])
            raise PolicyError(
                f"cannot export a layer of type {type(layer).__name__}; known inside Sequential: {known}"
            )
        value = result
    graph = onnx.helper.make_graph(
        nodes,
        "policy",
        [onnx.helper.make_tensor_value_info("observation", onnx.TensorProto.FLOAT, ["batch", observation])],
        [onnx.helper.make_tensor_value_info("action", onnx.TensorProto.FLOAT, ["batch", width])],
        weights,
    )
    opset = onnx.helper.make_opsetid("", OPSET)
    return onnx.helper.make_model(
        graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="deal-hw"
    )


def _chain(network: torch.nn.Module) -> list[torch.nn.Module]:
    if isinstance(network, FeedbackNetwork):
        return [*_chain(network.network), network.feedback, torch.nn.Hardtanh()]
    if isinstance(network, torch.nn.Sequential):
        return [layer for part in network for layer in _chain(part)]
    return [network]


def _largest_sum(network: torch.nn.Module, observations: Observation) -> float:
    """Return the largest sum of absolute terms of a fixed feedback: its rounding grows with it."""
    if not isinstance(network, FeedbackNetwork):
        return 0.0
    weight = np.abs(network.feedback.weight.numpy())
    return float((np.abs(observations) @ weight.T).max())


def _check_equal(network: torch.nn.Module, policy: OnnxPolicy) -> None:
    # Fixed draws: an export must not use the caller's random generators.
    scales = np.array([0.1, 1.0, 10.0], dtype=np.float32)[:, None, None]
    draws = np.random.default_rng(0).standard_normal((3, 32, len(policy.spec.observation))).astype(np.float32)
    observations = (scales * draws).reshape(-1, draws.shape[-1])
    with torch.no_grad():
        wanted = network(torch.as_tensor(observations)).numpy()
    worst = float(np.abs(policy.act_batch(observations) - wanted).max())
    allowed = max(TOLERANCE, ROUNDING * _largest_sum(network, observations))
    if not worst <= allowed:
        raise PolicyError(
            f"the exported policy differs from the network by {worst:g}, allowed are {allowed:g}; "
            "replace the operation that ONNX computes differently"
        )
