"""A torch network as an ONNX graph, built layer by layer."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx
import torch

from deal_hw.errors import PolicyError
from deal_hw.policies.network_policy import Feedback, FeedbackNetwork
from deal_hw.policy import Observation
from deal_hw.types import FloatArray

OPSET = 18
IR_VERSION = 9
"""Low enough for every onnxruntime that the extra `deploy` accepts."""
_ACTIVATIONS: Mapping[type[torch.nn.Module], str] = {
    torch.nn.ELU: "Elu",
    torch.nn.ReLU: "Relu",
    torch.nn.Tanh: "Tanh",
}


def network_graph(network: torch.nn.Module, observation: int) -> onnx.ModelProto:
    """Return the graph of a network with so many observations.

    Raises:
        PolicyError: A layer has an unknown type.
    """
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


def largest_sum(network: torch.nn.Module, observations: Observation) -> float:
    """Return the largest sum of absolute terms of a fixed feedback: its rounding grows with it."""
    if not isinstance(network, FeedbackNetwork):
        return 0.0
    weight = np.abs(network.feedback.weight.numpy())
    return float((np.abs(observations) @ weight.T).max())


def actions(network: torch.nn.Module, observations: Observation) -> FloatArray:
    """Return the network's actions, (B, A), for observations, (B, O)."""
    with torch.no_grad():
        return np.asarray(network(torch.as_tensor(observations)).numpy())
