"""A TorchScript policy as an ONNX graph, operation by operation.

For the import's own process only: a TorchScript file may come from anywhere. An operation that is not known
is refused by name, and so is a network that changes itself while it runs. An LSTM before the layers is known:
its memory becomes inputs and outputs of the graph.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from deal_hw.errors import PolicyError
from deal_hw.policy import Observation

OPSET: Final = 18
IR_VERSION: Final = 9
INPUT: Final = "observation"
OUTPUT: Final = "action"
MOST_NODES: Final = 20_000
_UNARY: Final = {
    **{"aten::relu": "Relu", "aten::relu_": "Relu", "aten::tanh": "Tanh", "aten::tanh_": "Tanh"},
    **{"aten::sigmoid": "Sigmoid", "aten::softplus": "Softplus", "aten::selu": "Selu", "aten::neg": "Neg"},
    **{"aten::exp": "Exp", "aten::sqrt": "Sqrt", "aten::abs": "Abs", "aten::silu": "Silu"},
    **{"aten::silu_": "Silu", "aten::softsign": "Softsign"},
}
_BUFFERS: Final = ("hidden_state", "cell_state")
"""What the exporters name an LSTM's memory."""
_SAME: Final = ("aten::contiguous", "aten::detach", "aten::clone", "aten::dropout", "aten::to", "aten::alias")
_BINARY: Final = {
    **{"aten::add": "Add", "aten::add_": "Add", "aten::sub": "Sub", "aten::sub_": "Sub"},
    **{"aten::mul": "Mul", "aten::mul_": "Mul", "aten::div": "Div", "aten::div_": "Div"},
}


@dataclass(slots=True)
class Converted:
    """A network as ONNX.

    Attributes:
        model: The graph: input (batch, O), output (batch, A), then the memory's inputs and outputs.
        observations: O.
        actions: A.
        memory: Widths of the memory's parts; empty without one.
        run: The TorchScript's own answer to an observation, (1, O) -> (1, A), from the memory it has.
        reset: Clears its memory.
    """

    model: onnx.ModelProto
    observations: int
    actions: int
    memory: list[int]
    run: Callable[[Observation], npt.NDArray[Any]]
    reset: Callable[[], None]


def convert(content: bytes, observations: int) -> Converted:
    """Return a TorchScript file as ONNX.

    Args:
        content: The file's bytes.
        observations: O.

    Raises:
        PolicyError: It is no TorchScript, or has an operation that is not known.
    """
    torch.set_num_threads(1)
    try:
        load: Any = torch.jit.load
        module = load(io.BytesIO(content), map_location="cpu").eval()
    except Exception as err:
        raise PolicyError(
            f"no TorchScript ({_line(err)}); give the file that torch.jit.save wrote (exported/policy.pt or "
            "motion.pt), not a checkpoint of weights"
        ) from err
    graph = _Graph()
    with torch.no_grad():
        lstm = _lstm_of(module)
        if lstm:
            value = INPUT
            if hasattr(module, "normalizer"):
                value = graph.follow(_frozen(module.normalizer), value)
            value = graph.follow(_frozen(module.actor), graph.lstm(getattr(module, lstm), value))
        else:
            value = graph.follow(_frozen(module), INPUT)
        reset = partial(_clear, module, bool(lstm))
        shape = np.shape(_answer(module, np.zeros((1, observations), dtype=np.float32)))
        reset()
    if len(shape) != 2 or shape[0] != 1:
        raise PolicyError(
            f"the network answers one observation with the shape {shape}, expected (1, actions)"
        )
    return Converted(
        graph.model(value, observations, shape[1]),
        observations,
        shape[1],
        list(graph.widths),
        lambda observation: _answer(module, observation),
        reset,
    )


def _lstm_of(module: Any) -> str:
    """Return the name of an LSTM whose memory the module holds, before the layers; "" for none.

    legged_gym's exporter names it memory, Isaac Lab's rnn, with a normaliser before it.
    """
    kinds = {name: part.original_name for name, part in module.named_children()}
    buffers = {name for name, _ in module.named_buffers(recurse=False)}
    found = next((name for name in ("memory", "rnn") if kinds.get(name) == "LSTM"), "")
    return found if "actor" in kinds and set(_BUFFERS) <= buffers else ""


def _frozen(module: Any) -> Any:
    kept = [name for name, _ in module.named_buffers()]
    recurrent = [
        f"{name} ({part.original_name})"
        for name, part in module.named_modules()
        if part.original_name in ("LSTM", "GRU", "RNN", "LSTMCell", "GRUCell", "RNNCell")
    ]
    if recurrent:
        raise PolicyError(
            f"the network is recurrent in a way that is not known: {', '.join(recurrent)}, buffers "
            f"{', '.join(kept) or 'none'}; known is an LSTM named memory or rnn with hidden_state "
            "and cell_state before the layers named actor, as legged_gym and Isaac Lab export it"
        )
    try:
        return torch.jit.freeze(module.eval()).graph
    except Exception as err:
        raise PolicyError(f"the network cannot be frozen ({_line(err)}); export it for evaluation") from err


def _clear(module: Any, recurrent: bool) -> None:
    if recurrent:
        for name in _BUFFERS:
            getattr(module, name).zero_()


def _answer(module: Any, observation: Observation) -> npt.NDArray[Any]:
    try:
        with torch.no_grad():
            return np.asarray(module(torch.as_tensor(observation)).numpy())
    except Exception as err:
        raise PolicyError(
            f"the network fails on an observation of {observation.shape[1]} numbers ({_line(err)}); the side "
            "file is of another policy, or terms are missing"
        ) from err


class _Graph:
    """Builds the ONNX graph."""

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._weights: list[onnx.TensorProto] = []
        self._count = 0
        self.widths: list[int] = []
        self._memory: list[tuple[str, str]] = []

    def model(self, value: str, observations: int, actions: int) -> onnx.ModelProto:
        """Return the model whose output is a value."""
        self._nodes.append(helper.make_node("Identity", [value], [OUTPUT]))

        def row(name: str, width: int) -> onnx.ValueInfoProto:
            return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width])

        graph = helper.make_graph(
            self._nodes,
            "policy",
            [
                row(INPUT, observations),
                *(row(i, w) for (i, _), w in zip(self._memory, self.widths, strict=True)),
            ],
            [row(OUTPUT, actions), *(row(o, w) for (_, o), w in zip(self._memory, self.widths, strict=True))],
            self._weights,
        )
        opset = helper.make_opsetid("", OPSET)
        return helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="deal-hw")

    def follow(self, graph: Any, given: str) -> str:
        """Add the nodes of a frozen TorchScript graph of one input, and return its output."""
        inputs = list(graph.inputs())[1:]
        nodes = list(graph.nodes())
        outputs = list(graph.outputs())
        if len(inputs) != 1 or len(outputs) != 1:
            raise PolicyError(
                f"the network has {len(inputs)} inputs and {len(outputs)} outputs; one of each is known"
            )
        if len(nodes) > MOST_NODES:
            raise PolicyError(f"the network has {len(nodes)} operations; {MOST_NODES} are allowed")
        names: dict[str, str] = {inputs[0].debugName(): given}
        for node in nodes:
            kind = node.kind()
            if kind == "prim::Constant":
                continue
            if kind == "prim::ListConstruct" and all(
                v.node().kind() == "prim::Constant" for v in node.inputs()
            ):
                continue
            made = self._node(kind, node, names)
            names[node.output().debugName()] = made
        if outputs[0].debugName() not in names:
            raise PolicyError("the network's answer does not depend on the observation")
        return names[outputs[0].debugName()]

    def lstm(self, memory: Any, given: str) -> str:
        """Add a TorchScript LSTM of one step and return its output, (batch, hidden)."""
        weights = {name: value.detach().numpy() for name, value in memory.named_parameters()}
        layers = sum(name.startswith("weight_ih_l") for name in weights)
        strange = [name for name in weights if "reverse" in name or "_hr_" in name]
        if strange or not layers:
            raise PolicyError(
                f"the LSTM has {', '.join(strange) or 'no weights'}; a plain one in one direction is known"
            )
        value = given
        for layer in range(layers):
            hidden = weights[f"weight_hh_l{layer}"].shape[1]

            def gates(
                name: str, kind: tuple[int, ...] = (0, 3, 1, 2), layer: int = layer
            ) -> npt.NDArray[Any]:
                # torch has the gates input, forget, cell, output; ONNX input, output, forget, cell.
                values = weights.get(f"{name}_l{layer}", np.zeros(4 * hidden, dtype=np.float32))  # noqa: B023
                return np.concatenate([np.split(values, 4)[k] for k in kind])

            bias = np.concatenate([gates("bias_ih"), gates("bias_hh")])
            w, r = (self._weight(gates(name)[None]) for name in ("weight_ih", "weight_hh"))
            b, axis = self._weight(bias[None]), self._weight(np.array([0], dtype=np.int64))
            begun = []
            for part in ("hidden", "cell"):
                names = (f"{part}_{layer}", f"{part}_{layer}_next")
                self._memory.append(names)
                self.widths.append(int(hidden))
                begun.append(self._add("Unsqueeze", [names[0], axis]))
            step = self._add("Unsqueeze", [value, axis])
            sequence, last_hidden, last_cell = (self._name() for _ in range(3))
            self._nodes.append(
                helper.make_node(
                    "LSTM",
                    [step, w, r, b, "", *begun],
                    [sequence, last_hidden, last_cell],
                    hidden_size=int(hidden),
                )
            )
            for last, names in zip((last_hidden, last_cell), self._memory[-2:], strict=True):
                self._nodes.append(helper.make_node("Squeeze", [last, axis], [names[1]]))
            value = self._memory[-2][1]
        return value

    def _node(self, kind: str, node: Any, names: Mapping[str, str]) -> str:
        inputs = list(node.inputs())

        def value(i: int) -> str:
            name = inputs[i].debugName()
            if name in names:
                return names[name]
            constant = _constant(inputs[i])
            if isinstance(constant, int | float) and not isinstance(constant, bool):
                return self._weight(np.array(constant, dtype=np.float32))
            if isinstance(constant, torch.Tensor):
                return self._weight(constant.detach().numpy().astype(np.float32))
            raise PolicyError(
                f"operation {kind} of the network has the input {constant!r}, which is not known"
            )

        def number(i: int) -> float:
            return float(_constant(inputs[i]))

        if kind == "aten::linear":
            made = self._add("MatMul", [value(0), self._weight(_tensor(inputs[1]).T.copy())])
            return made if _is_none(inputs[2]) else self._add("Add", [made, value(2)])
        if kind == "aten::addmm" and number(3) == 1 and number(4) == 1:
            return self._add("Add", [self._add("MatMul", [value(1), value(2)]), value(0)])
        if kind == "aten::matmul" or kind == "aten::mm":
            return self._add("MatMul", [value(0), value(1)])
        if kind == "aten::t":
            return self._add("Transpose", [value(0)], perm=[1, 0])
        if kind in ("aten::elu", "aten::elu_") and number(2) == 1 and number(3) == 1:
            return self._add("Elu", [value(0)], alpha=number(1))
        if kind in ("aten::leaky_relu", "aten::leaky_relu_"):
            return self._add("LeakyRelu", [value(0)], alpha=number(1))
        if kind == "aten::gelu":
            return self._gelu(value(0), _constant(inputs[1]))
        if kind in ("aten::clamp", "aten::clip", "aten::hardtanh", "aten::hardtanh_", "aten::clamp_"):
            ends = ["" if _is_none(inputs[i]) else value(i) for i in (1, 2)]
            return self._add("Clip", [value(0), *ends])
        if kind == "aten::layer_norm":
            return self._layer_norm(value(0), inputs)
        if kind in _UNARY:
            if _UNARY[kind] == "Silu":
                return self._add("Mul", [value(0), self._add("Sigmoid", [value(0)])])
            if kind == "aten::softplus" and (number(1) != 1 or number(2) < 20):
                raise PolicyError(f"operation {kind} with beta {number(1):g} is not known")
            return self._add(_UNARY[kind], [value(0)])
        if kind in _BINARY:
            if kind.startswith(("aten::add", "aten::sub")) and len(inputs) > 2 and number(2) != 1:
                factor = self._weight(np.array(number(2), dtype=np.float32))
                return self._add(_BINARY[kind], [value(0), self._add("Mul", [value(1), factor])])
            if kind.startswith("aten::div") and len(inputs) > 2:
                raise PolicyError(f"operation {kind} with rounding is not known")
            return self._add(_BINARY[kind], [value(0), value(1)])
        if kind in _SAME and not (kind == "aten::dropout" and _constant(inputs[2])):
            return value(0)
        raise PolicyError(
            f"operation {kind} of the network is not known{_state_hint(kind)}; known are linear layers, "
            "their usual activations, norms and sums; export the policy as ONNX instead"
        )

    def _gelu(self, value: str, approximate: object) -> str:
        if approximate != "none":
            raise PolicyError(f"operation aten::gelu with approximation {approximate!r} is not known")
        root, half, one = (self._weight(np.array(v, dtype=np.float32)) for v in (2**-0.5, 0.5, 1.0))
        grown = self._add("Add", [self._add("Erf", [self._add("Mul", [value, root])]), one])
        return self._add("Mul", [self._add("Mul", [value, half]), grown])

    def _layer_norm(self, value: str, inputs: list[Any]) -> str:
        shape = _constant(inputs[1])
        scale = np.ones(shape, dtype=np.float32) if _is_none(inputs[2]) else _tensor(inputs[2])
        given = [value, self._weight(scale)]
        if not _is_none(inputs[3]):
            given.append(self._weight(_tensor(inputs[3])))
        return self._add("LayerNormalization", given, axis=-len(shape), epsilon=float(_constant(inputs[4])))

    def _add(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        name = self._name()
        self._nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def _weight(self, values: npt.NDArray[Any]) -> str:
        name = self._name()
        self._weights.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def _name(self) -> str:
        self._count += 1
        return f"v{self._count}"


def _constant(value: Any) -> Any:
    node = value.node()
    if node.kind() == "prim::ListConstruct":
        return [_constant(part) for part in node.inputs()]
    return value.toIValue()


def _tensor(value: Any) -> npt.NDArray[Any]:
    found = _constant(value)
    if not isinstance(found, torch.Tensor):
        raise PolicyError(
            f"a weight of the network is computed while it runs ({value.debugName()}); freeze it"
        )
    return np.asarray(found.detach().numpy().astype(np.float32))


def _is_none(value: Any) -> bool:
    return bool(value.node().kind() == "prim::Constant" and value.toIValue() is None)


def _state_hint(kind: str) -> str:
    changing = kind in ("prim::SetAttr", "prim::GetAttr", "aten::copy_", "aten::roll", "aten::index_put_")
    return " (the network keeps a memory of its own)" if changing else ""


def _line(err: Exception) -> str:
    lines = [line.strip() for line in str(err).splitlines() if line.strip()] or [type(err).__name__]
    return lines[-1][:200]
