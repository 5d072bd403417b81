"""Policies with a fault on request, for tests of the checks between policy and motors.

They observe the commanded velocity alone. While it is zero they request the default pose. With a commanded
velocity ahead the fault shows. A rare fault shows at :data:`RARE_M_S` alone, which the trial of a policy does
not meet, so only the safety filter can stop it.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import MissingExtraError
from deal_hw.policy import AXES, ObservationTerm, PolicySpec

Fault = Literal["nan", "late", "endless", "fails", "shape", "memory"]
"""Answers NaN; takes its time; loops for ever; fails; answers twice as many actions; wants 4 GB of memory."""
RARE_M_S: Final = 0.3
"""Commanded velocity ahead at which a rare fault shows [m/s]; 1 mm/s away from it there is none."""
_RARE_WIDTH_M_S: Final = 1e-3
_SIDE = 128
_OPSET = 17
_IR_VERSION = 10


def faulty_policy(
    description: RobotDescription, fault: Fault, rounds: int = 4000, *, rare: bool = False
) -> tuple[Any, PolicySpec]:
    """Return such a policy as an ONNX model, and its spec.

    Args:
        description: The robot of the policy.
        fault: Name of the fault.
        rounds: For "late": products of 128 x 128 matrices a step at a wanted velocity of 1 m/s (of
            :data:`RARE_M_S` where it is rare); some 0.1 ms each.
        rare: Whether the fault shows at one wanted velocity alone.

    Raises:
        MissingExtraError: onnx is not installed.
    """
    try:
        import onnx
        from onnx import helper
    except ModuleNotFoundError as error:
        raise MissingExtraError("onnx", "train") from error
    actuated = len(description.actuated)
    node = helper.make_node
    trigger = [node("Relu", ["wish"], ["active"])]
    if rare:
        trigger = [
            node("Sub", ["wish", "rare"], ["off"]),
            node("Abs", ["off"], ["far"]),
            node("Div", ["far", "width"], ["share"]),
            node("Sub", ["unit", "share"], ["near"]),
            node("Relu", ["near"], ["active"]),
        ]
    graph = helper.make_graph(
        [
            node("Slice", ["observation", "zero", "one", "axis"], ["wish"]),
            *trigger,
            node("Ceil", ["active"], ["alarm"]),
            node("Cast", ["alarm"], ["alarm_count"], to=onnx.TensorProto.INT64),
            node("Reshape", ["alarm_count", "flat"], ["alarms"]),
            *_fault_nodes(onnx, fault),
            node("Mul", ["fault", "zeros"], ["calm"]),
            node("Concat", ["one", "copies"], ["repeats"], axis=0),
            node("Tile", ["calm", "repeats"], ["action"]),
        ],
        "faulty",
        [helper.make_tensor_value_info("observation", onnx.TensorProto.FLOAT, [1, 3])],
        [helper.make_tensor_value_info("action", onnx.TensorProto.FLOAT, [1, actuated])],
        [
            *(
                helper.make_tensor(name, onnx.TensorProto.INT64, [1], [value])
                for name, value in (
                    ("zero", 0),
                    ("one", 1),
                    ("axis", 1),
                    ("flat", -1),
                    ("endless", 2**62),
                    ("huge", 2**30),
                )
            ),
            *(
                helper.make_tensor(name, onnx.TensorProto.FLOAT, [1], [value])
                for name, value in (
                    ("rare", RARE_M_S),
                    ("width", _RARE_WIDTH_M_S),
                    ("unit", 1.0),
                    ("rounds", float(rounds)),
                )
            ),
            helper.make_tensor("zeros", onnx.TensorProto.FLOAT, [1, actuated], [0.0] * actuated),
            helper.make_tensor("scalar", onnx.TensorProto.INT64, [0], []),
            helper.make_tensor("yes", onnx.TensorProto.BOOL, [], [True]),
            helper.make_tensor(
                "eye",
                onnx.TensorProto.FLOAT,
                [_SIDE, _SIDE],
                np.eye(_SIDE, dtype=np.float32).ravel().tolist(),
            ),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    return model, _spec(description)


def _spec(description: RobotDescription) -> PolicySpec:
    return PolicySpec.of_robot(
        description,
        [ObservationTerm("command", axis, 1.0) for axis in AXES],
        (0.1,) * len(description.actuated),
        effort_limit=tuple(map(min, description.effort_limit, description.limits.effort)),
        training={"algorithm": "none: has a fault on purpose"},
    )


def _fault_nodes(onnx: Any, fault: Fault) -> list[Any]:
    """Return nodes for `fault`, a number that is 0 without a fault, and the `copies` of the action.

    It is made of `active`, (1, 1), and `alarms`, (1,), which are 0 without a fault.
    """
    node = onnx.helper.make_node
    copies = [node("Identity", ["one"], ["copies"])]
    if fault == "nan":
        return [node("Neg", ["active"], ["minus"]), node("Sqrt", ["minus"], ["fault"]), *copies]
    if fault == "late":
        many = [
            node("Mul", ["active", "rounds"], ["many"]),
            node("Cast", ["many"], ["rows"], to=onnx.TensorProto.INT64),
        ]
        return [*many, *_loop(onnx, "rows"), *copies]
    if fault == "endless":
        return [node("Mul", ["alarms", "endless"], ["rows"]), *_loop(onnx, "rows"), *copies]
    if fault == "fails":
        # There is one element: number 1 is none.
        return [node("Gather", ["unit", "alarms"], ["fault"]), *copies]
    if fault == "memory":
        return [
            node("Mul", ["alarms", "huge"], ["much"]),
            node("Max", ["much", "one"], ["length"]),
            node("Expand", ["unit", "length"], ["long"]),
            node("ReduceSum", ["long"], ["fault"], keepdims=0),
            *copies,
        ]
    return [node("Identity", ["active"], ["fault"]), node("Add", ["alarms", "one"], ["copies"])]


def _loop(onnx: Any, count: str) -> list[Any]:
    """Return nodes that multiply matrices without use, for the given number of times."""
    helper, side = onnx.helper, [_SIDE, _SIDE]
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
    return [
        helper.make_node("Reshape", [count, "scalar"], ["count"]),
        helper.make_node("Loop", ["count", "yes", "eye"], ["product"], body=body),
        helper.make_node("ReduceMax", ["product"], ["fault"], keepdims=0),
    ]
