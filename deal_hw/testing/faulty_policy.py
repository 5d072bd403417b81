"""Policies that go wrong when told to: for tests of what stands between policy and motors.

They observe the wanted velocity alone. While it is zero they ask for the default pose; from then on that it
is not, the first answers with NaN, and the second takes its time.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import MissingExtraError
from deal_hw.policy import AXES, ObservationTerm, PolicySpec

Fault = Literal["nan", "late"]
_SIDE = 128
_OPSET = 17
_IR_VERSION = 10


def faulty_policy(description: RobotDescription, fault: Fault, rounds: int = 4000) -> tuple[Any, PolicySpec]:
    """Return such a policy as an ONNX model, and its spec.

    Args:
        description: The robot that it shall fit.
        fault: "nan", or "late": it multiplies matrices in vain.
        rounds: Products of 128 x 128 matrices a step at a wanted velocity of 1 m/s; some 0.1 ms each.

    Raises:
        MissingExtraError: onnx is not installed.
    """
    try:
        import onnx
        from onnx import helper
    except ModuleNotFoundError as error:
        raise MissingExtraError("onnx", "train") from error
    actuated = len(description.actuated)
    nodes, constants = _nan_nodes(helper) if fault == "nan" else _late_nodes(helper, rounds)
    graph = helper.make_graph(
        [
            helper.make_node("Slice", ["observation", "zero", "one", "axis"], ["wish"]),
            *nodes,
            helper.make_node("Mul", ["fault", "zeros"], ["action"]),
        ],
        "faulty",
        [helper.make_tensor_value_info("observation", onnx.TensorProto.FLOAT, [1, 3])],
        [helper.make_tensor_value_info("action", onnx.TensorProto.FLOAT, [1, actuated])],
        [
            *(helper.make_tensor(name, onnx.TensorProto.INT64, [1], [value])
              for name, value in (("zero", 0), ("one", 1), ("axis", 1))),
            helper.make_tensor("zeros", onnx.TensorProto.FLOAT, [1, actuated], [0.0] * actuated),
            *constants,
        ],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    return model, _spec(description)


def _spec(description: RobotDescription) -> PolicySpec:
    limits = description.limits
    return PolicySpec(
        robot=description.name,
        joint_names=description.joint_names,
        actuated=description.actuated,
        observation=tuple(ObservationTerm("command", axis, 1.0) for axis in AXES),
        action_scale=(0.1,) * len(description.actuated),
        default_position=description.default_position,
        stiffness=description.stiffness,
        damping=description.damping,
        effort_limit=tuple(np.minimum(description.effort_limit, limits.effort)),
        speed_limit=description.speed_limit,
        control_rate_hz=description.control_rate_hz,
        training={"algorithm": "none: goes wrong on purpose"},
    )


def _nan_nodes(helper: Any) -> tuple[list[Any], list[Any]]:
    # The root of minus the wish: 0 while the robot shall stand, NaN once it shall walk.
    return [helper.make_node("Neg", ["wish"], ["minus"]), helper.make_node("Sqrt", ["minus"], ["fault"])], []


def _late_nodes(helper: Any, rounds: int) -> tuple[list[Any], list[Any]]:
    import onnx

    side = [_SIDE, _SIDE]
    body = helper.make_graph(
        [
            helper.make_node("MatMul", ["before", "eye"], ["after"]),
            helper.make_node("Identity", ["going"], ["still"]),
        ],
        "round",
        [
            helper.make_tensor_value_info("number", onnx.TensorProto.INT64, []),
            helper.make_tensor_value_info("going", onnx.TensorProto.BOOL, []),
            helper.make_tensor_value_info("before", onnx.TensorProto.FLOAT, side),
        ],
        [
            helper.make_tensor_value_info("still", onnx.TensorProto.BOOL, []),
            helper.make_tensor_value_info("after", onnx.TensorProto.FLOAT, side),
        ],
    )
    nodes = [
        helper.make_node("Mul", ["wish", "rounds"], ["many"]),
        helper.make_node("Cast", ["many"], ["count_1"], to=onnx.TensorProto.INT64),
        helper.make_node("Reshape", ["count_1", "scalar"], ["count"]),
        helper.make_node("Loop", ["count", "yes", "eye"], ["product"], body=body),
        helper.make_node("ReduceMax", ["product"], ["fault"], keepdims=0),
    ]
    eye = np.eye(_SIDE, dtype=np.float32).ravel().tolist()
    constants = [
        helper.make_tensor("rounds", onnx.TensorProto.FLOAT, [1], [float(rounds)]),
        helper.make_tensor("scalar", onnx.TensorProto.INT64, [0], []),
        helper.make_tensor("yes", onnx.TensorProto.BOOL, [], [True]),
        helper.make_tensor("eye", onnx.TensorProto.FLOAT, side, eye),
    ]
    return nodes, constants
