"""An ONNX network of another trainer, and the one that is made of it for a robot.

The network stays as it is. In front of it, entries of the observation are clipped; behind it, outputs are put
into the robot's order. Positions, factors and history are no part of the graph: the spec has them, so that
they can be read.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from deal_hw.errors import PolicyError
from deal_hw.policies.importing.manifest import Adapter
from deal_hw.policies.onnx_runtime import SPEC_KEY, open_session
from deal_hw.policy import Observation

PREFIX: Final = "network/"
NEWEST_IR: Final = 10
"""Newest file version that the oldest onnxruntime of the extra `deploy` reads."""
OBSERVATION, ACTION = "observation", "action"


@dataclass(slots=True)
class Network:
    """A network that takes one observation.

    Attributes:
        model: The model; its first input is the observation, its first output the actions.
        observations: Length O of an observation.
        actions: Number of actions.
        memory: Widths of the parts of its memory, whose inputs and outputs follow, (layers, batch, n) each
            where ``layers`` is not 0, else (batch, n).
        layers: Number of layers of each part.
    """

    model: onnx.ModelProto
    observations: int
    actions: int
    memory: list[int]
    layers: list[int]


def read_network(path: Path, content: bytes, outside: bytes | None) -> Network:
    """Return the network of an ONNX file.

    Args:
        path: The file, for messages.
        content: Its bytes.
        outside: The bytes of the file of weights beside it, if there is one.

    Raises:
        PolicyError: It cannot be used; the message says why.
    """
    try:
        model = onnx.load_model_from_string(content)
    except Exception as err:
        raise PolicyError(f"{path} is no ONNX file ({str(err)[:120]}); give policy.onnx") from err
    _take_inside(model, path, outside)
    weights = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in weights]
    outputs = list(model.graph.output)
    _check_interface(path, inputs, outputs)
    widths, layers = [], []
    for value in inputs[1:]:
        sizes = _sizes(value)
        layers.append(int(sizes[0] or 0) if len(sizes) == 3 else 0)
        widths.append(int(sizes[-1] or 0) * max(layers[-1], 1))
    return Network(model, int(_sizes(inputs[0])[1] or 0), int(_sizes(outputs[0])[1] or 0), widths, layers)


def adapted(network: Network, adapter: Adapter, spec: str, *, batches: bool) -> bytes:
    """Return the file for a robot.

    Args:
        network: The network.
        adapter: How its inputs and outputs become the robot's.
        spec: The spec as JSON text.
        batches: Whether it is to take more than one observation at a time.
    """
    model = copy.deepcopy(network.model)
    weights = {tensor.name for tensor in model.graph.initializer}
    inputs = [value.name for value in model.graph.input if value.name not in weights]
    outputs = [value.name for value in model.graph.output]
    graph = onnx.compose.add_prefix_graph(model.graph, PREFIX)
    batch: str | int = "batch" if batches else 1

    def row(name: str, width: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [batch, width])

    made = _Nodes()
    made.clip(OBSERVATION, PREFIX + inputs[0], adapter)
    behind = _Nodes()
    behind.choose(PREFIX + outputs[0], ACTION, adapter.outputs)
    names = [(f"memory_{i}", f"memory_{i}_next") for i in range(len(network.memory))]
    for (before, after), given, width, layers, answered in zip(
        names, inputs[1:], network.memory, network.layers, outputs[1:], strict=True
    ):
        made.unfold(before, PREFIX + given, layers, width)
        behind.fold(PREFIX + answered, after, layers, width)
    whole = helper.make_graph(
        [*made.nodes, *graph.node, *behind.nodes],
        "policy",
        [
            row(OBSERVATION, network.observations),
            *(row(name, w) for (name, _), w in zip(names, network.memory, strict=True)),
        ],
        [
            row(ACTION, len(adapter.outputs)),
            *(row(name, w) for (_, name), w in zip(names, network.memory, strict=True)),
        ],
        [*graph.initializer, *made.weights, *behind.weights],
    )
    whole.sparse_initializer.extend(graph.sparse_initializer)
    model.graph.CopyFrom(whole)
    model.ir_version = min(model.ir_version, NEWEST_IR)
    model.producer_name, model.doc_string = "deal-hw", ""
    helper.set_model_props(model, {SPEC_KEY: spec})
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


class Runner:
    """Runs a network's file, observation by observation, with its memory."""

    def __init__(self, path: Path, content: bytes) -> None:
        self._session = open_session(path, content)
        self._names = [value.name for value in self._session.get_inputs()]
        self._outputs = [value.name for value in self._session.get_outputs()]
        self._shapes = [
            [size if isinstance(size, int) else None for size in value.shape]
            for value in self._session.get_inputs()
        ]
        self._memory: list[npt.NDArray[Any]] = []

    def reset(self) -> None:
        """Clear the memory."""
        self._memory = []

    def __call__(self, observations: Observation) -> npt.NDArray[Any]:
        """Return the actions, (B, A), of observations, (B, O)."""
        count = len(observations)
        if not self._memory:
            self._memory = [
                np.zeros([count if size is None else size for size in shape], dtype=np.float32)
                for shape in self._shapes[1:]
            ]
        values = dict(zip(self._names, [observations, *self._memory], strict=True))
        action, *self._memory = self._session.run(self._outputs, values)
        return np.asarray(action)


class _Nodes:
    """Nodes and weights in front of a network, or behind it."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []

    def clip(self, given: str, result: str, adapter: Adapter) -> None:
        """Clip the observation, where an entry has ends."""
        low, high = (np.array(ends, dtype=np.float32) for ends in (adapter.lowest, adapter.highest))
        if not (np.isfinite(low).any() or np.isfinite(high).any()):
            self._node("Identity", [given], result)
            return
        self._node("Max", [given, self._weight("lowest", low)], "at_least")
        self._node("Min", ["at_least", self._weight("highest", high)], result)

    def choose(self, given: str, result: str, outputs: Sequence[int]) -> None:
        """Put outputs into the robot's order; -1 is an action of 0."""
        place = np.array(outputs, dtype=np.int64)
        if -1 in outputs:
            # One more column of zeros, for as many rows as there are.
            self._node("Gather", [given, self._weight("first", np.array([0], dtype=np.int64))], "one", axis=1)
            self._node("Mul", ["one", self._weight("zero", np.array(0, dtype=np.float32))], "none")
            self._node("Concat", ["none", given], "with_none", axis=1)
            given, place = "with_none", place + 1
        self._node("Gather", [given, self._weight("order", place)], result, axis=1)

    def unfold(self, given: str, result: str, layers: int, width: int) -> None:
        """Turn (batch, layers * n) into (layers, batch, n)."""
        if not layers:
            self._node("Identity", [given], result)
            return
        shape = self._weight(f"{given}_shape", np.array([-1, layers, width // layers], dtype=np.int64))
        self._node("Reshape", [given, shape], f"{given}_layers")
        self._node("Transpose", [f"{given}_layers"], result, perm=[1, 0, 2])

    def fold(self, given: str, result: str, layers: int, width: int) -> None:
        """Turn (layers, batch, n) into (batch, layers * n)."""
        if not layers:
            self._node("Identity", [given], result)
            return
        shape = self._weight(f"{result}_shape", np.array([-1, width], dtype=np.int64))
        self._node("Transpose", [given], f"{result}_rows", perm=[1, 0, 2])
        self._node("Reshape", [f"{result}_rows", shape], result)

    def _node(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> None:
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))

    def _weight(self, name: str, values: npt.NDArray[Any]) -> str:
        self.weights.append(numpy_helper.from_array(values, name))
        return name


def _take_inside(model: onnx.ModelProto, path: Path, outside: bytes | None) -> None:
    """Put weights that lie in the file beside the model into it; no other file is opened."""
    wanted = f"{path.name}.data"
    for tensor in model.graph.initializer:
        if tensor.data_location != TensorProto.EXTERNAL:
            continue
        place = {entry.key: entry.value for entry in tensor.external_data}
        if place.get("location") != wanted or outside is None:
            raise PolicyError(
                f"{path} keeps weights in the file {str(place.get('location'))[:80]!r}; only {wanted} beside "
                "it is read; copy it there, or export the network as one file"
            )
        try:
            begin, length = int(place.get("offset", 0)), int(place["length"])
        except (KeyError, ValueError):
            begin, length = 0, -1
        if not 0 <= begin <= begin + length <= len(outside):
            raise PolicyError(f"{wanted} is shorter than {path.name} says; copy both again")
        tensor.raw_data = outside[begin : begin + length]
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]


def _check_interface(
    path: Path, inputs: Sequence[onnx.ValueInfoProto], outputs: Sequence[onnx.ValueInfoProto]
) -> None:
    names = [value.name for value in inputs], [value.name for value in outputs]
    if "time_step" in names[0]:
        raise PolicyError(
            f"{path} has the input 'time_step': it follows a motion inside the network, by the time; only "
            "policies that follow a velocity, or nothing, are imported"
        )
    memory = [(_sizes(i), _sizes(o)) for i, o in zip(inputs[1:], outputs[1:], strict=False)]
    if not inputs or len(inputs) != len(outputs) or not all(_is_memory(i) and i == o for i, o in memory):
        raise PolicyError(
            f"{path} has the inputs {_listed(inputs)} and the outputs {_listed(outputs)}; known is one "
            "observation and one action, and with an LSTM its states behind both, in the same order"
        )
    for value in (*inputs, *outputs):
        if value.type.tensor_type.elem_type != TensorProto.FLOAT:
            raise PolicyError(
                f"{path}: {value.name!r} is not of 32-bit floats; export the network in float32"
            )
    for value in (inputs[0], outputs[0]):
        sizes = _sizes(value)
        if len(sizes) != 2 or not sizes[1] or sizes[0] not in (None, 1):
            raise PolicyError(
                f"{path}: {_listed([value])} is not of shape (1, n) or (batch, n); export the network for "
                "one observation"
            )


def _is_memory(sizes: Sequence[int | None]) -> bool:
    if len(sizes) == 3:
        return bool(sizes[0]) and bool(sizes[2]) and sizes[1] in (None, 1)
    return len(sizes) == 2 and bool(sizes[1]) and sizes[0] in (None, 1)


def _sizes(value: onnx.ValueInfoProto) -> list[int | None]:
    return [dim.dim_value if dim.HasField("dim_value") else None for dim in value.type.tensor_type.shape.dim]


def _listed(values: Sequence[onnx.ValueInfoProto]) -> str:
    return ", ".join(f"{value.name[:40]!r} {_sizes(value)}" for value in values[:6]) or "none"
