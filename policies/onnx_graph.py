"""A torch network as an ONNX graph, built layer by layer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import torch

from deal_hw.errors import PolicyError
from deal_hw.policies.network_policy import AdaptedNetwork, Feedback, FeedbackNetwork
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
    made = _Graph()
    made.add(network, "observation", "action")
    graph = onnx.helper.make_graph(
        made.nodes,
        "policy",
        [onnx.helper.make_tensor_value_info("observation", onnx.TensorProto.FLOAT, ["batch", observation])],
        [
            onnx.helper.make_tensor_value_info(
                "action", onnx.TensorProto.FLOAT, ["batch", made.width or observation]
            )
        ],
        made.weights,
    )
    opset = onnx.helper.make_opsetid("", OPSET)
    return onnx.helper.make_model(
        graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="deal-hw"
    )


class _Graph:
    """Nodes and weights of a graph, layer by layer.

    Attributes:
        nodes: The nodes.
        weights: The weights.
        width: Number of values of the last linear layer; 0 before the first.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []
        self.width = 0
        self._count = 0

    def add(self, network: torch.nn.Module, value: str, result: str) -> None:
        """Add a network from one value to another.

        Raises:
            PolicyError: A layer has an unknown type.
        """
        layers = _chain(network)
        for k, layer in enumerate(layers):
            i, self._count = self._count, self._count + 1
            named = result if k == len(layers) - 1 else f"value_{i}"
            self._add_layer(layer, i, value, named)
            value = named

    def _add_layer(self, layer: torch.nn.Module, i: int, value: str, result: str) -> None:
        if isinstance(layer, AdaptedNetwork):
            self.add(layer.adaptation, value, "encoding")
            ends = [
                self._weight(f"{name}_{i}", np.array([x]))
                for name, x in (("from", 0), ("to", layer.own), ("axis", 1))
            ]
            self._node("Slice", [value, *ends], "own")
            self._node("Concat", ["own", "encoding"], "given", axis=1)
            self.add(layer.policy, "given", result)
        elif isinstance(layer, Feedback):
            gain = self._weight("gain", _numbers(layer.weight))
            self._node("Gemm", ["observation", gain], "feedback", transB=1)
            self._node("Add", [value, "feedback"], result)
        elif isinstance(layer, torch.nn.Linear):
            bias = torch.zeros(layer.out_features) if layer.bias is None else layer.bias
            given = [
                self._weight(f"{name}_{i}", _numbers(tensor))
                for name, tensor in (("weight", layer.weight), ("bias", bias))
            ]
            self._node("Gemm", [value, *given], result, transB=1)
            self.width = layer.out_features
        elif type(layer) in _ACTIVATIONS:
            self._node(_ACTIVATIONS[type(layer)], [value], result)
        elif isinstance(layer, torch.nn.Hardtanh):
            ends = [
                self._weight(f"{name}_{i}", np.array(bound, dtype=np.float32))
                for name, bound in (("lowest", layer.min_val), ("highest", layer.max_val))
            ]
            self._node("Clip", [value, *ends], result)
        else:
            known = ", ".join(["Linear", "Hardtanh", *(kind.__name__ for kind in _ACTIVATIONS)])
            raise PolicyError(
                f"cannot export a layer of type {type(layer).__name__}; known inside Sequential: {known}"
            )

    def _weight(self, name: str, values: npt.NDArray[Any]) -> str:
        self.weights.append(onnx.numpy_helper.from_array(values, name))
        return name

    def _node(self, kind: str, given: list[str], result: str, **more: Any) -> None:
        self.nodes.append(onnx.helper.make_node(kind, given, [result], **more))


def _numbers(tensor: torch.Tensor) -> npt.NDArray[np.float32]:
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float32)


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
