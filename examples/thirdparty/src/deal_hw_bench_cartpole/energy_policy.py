"""The package's policy: it pumps energy into the pole until it is up, and catches it by state feedback.

It is a law with a few gains, written as an ONNX network without weights. ``python -m
deal_hw_bench_cartpole.energy_policy FILE.onnx`` writes it.

The motor is weak: 1.77 N move a cart whose friction alone is 3.22 N at 1 m/s. So several swings are needed,
and the force is chosen for power. With R the horizontal force of the pole on the cart, the cart soon moves at
(F + R) / friction, and the pole gains the power -R (F + R) / friction. That is positive for a full force
against R, and R has the sign of sin a (w² - w0² cos a), with the angle a from upright, its speed w and w0 =
sqrt(3 g / (2 L)). So the pump is F = -sign R, of the angle that the pole will have when the command acts.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx

from deal_hw.description import RobotDescription
from deal_hw.policies.onnx_export import write_policy
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw_bench_cartpole.description import DESCRIPTION, POLE_M

SWING_RAD_S: Final = float(np.sqrt(1.5 * 9.81 / POLE_M))
"""w0: the pole's small swings when it hangs, and its rate of falling when it is up [rad/s]."""
OPSET: Final = 18
IR_VERSION: Final = 9
"""Low enough for every onnxruntime that deal-hw accepts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """Gains of the law. Energies are shares of w0²: 0 is at rest upright, -2 at rest below.

    They were found by a random search over about 1000 sets. Each was tried on 50 simulated robots: the cart's
    mass and friction were drawn within a factor 2, and 8 % of the commands did not arrive.

    Attributes:
        lead_s: Time from a measurement to the middle of its command's effect on the cart [s].
        energy: Energy at which the pump stops. It is above 0, since the rise costs energy.
        energy_gain: Share of the full force for each missing energy.
        sharpness: How sharply the pump changes its sign.
        centring: Force towards the middle while pumping, a share of the full force [1/m].
        pump_end_m: Where the pump's cart is stopped.
        pump_brake_s: Time before that at which it brakes [s].
        end_m: Where any cart is stopped: the pole may fall, and is swung up again.
        brake_s: Time before that at which it brakes [s].
        stop: Stiffness of both ends, a share of the full force [1/m].
        near_cos: Cosine of the largest angle at which the pole is caught.
        near_rad: Largest capture angle, a + w / w0, at which it is caught [rad].
        cart: Feedback of the cart's position when the pole is up, a share of the full force [1/m].
        cart_speed: Of its speed [s/m].
        pole: Of the pole's angle [1/rad].
        pole_speed: Of its speed [s/rad].
    """

    lead_s: float = 0.08
    energy: float = 0.5
    energy_gain: float = 10.0
    sharpness: float = 15.0
    centring: float = 0.7
    pump_end_m: float = 0.146
    pump_brake_s: float = 0.12
    end_m: float = 0.175
    brake_s: float = 0.1
    stop: float = 20.0
    near_cos: float = 0.55
    near_rad: float = 0.6
    cart: float = 2.4
    cart_speed: float = 5.2
    pole: float = 14.0
    pole_speed: float = 2.0


def energy_policy_spec(description: RobotDescription = DESCRIPTION) -> PolicySpec:
    """Return the layout: cart, sine and cosine of the angle from hanging, both speeds; the motor's share."""
    cart, pole = description.joint_names
    terms = [
        ObservationTerm("position", cart, 1.0),
        ObservationTerm("sin_position", pole, 1.0),
        ObservationTerm("cos_position", pole, 1.0),
        ObservationTerm("velocity", cart, 1.0),
        ObservationTerm("velocity", pole, 1.0),
    ]
    return PolicySpec.of_robot(description, terms, (1.0,))


class _Graph:
    """Nodes and constants of an ONNX graph.

    Attributes:
        nodes: The nodes.
        constants: The constants.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def node(self, kind: str, *given: _Value | float, name: str = "") -> _Value:
        """Add a node and return its value."""
        names = [one.name if isinstance(one, _Value) else self._constant(one) for one in given]
        name = name or f"value_{len(self.nodes)}"
        self.nodes.append(onnx.helper.make_node(kind, names, [name]))
        return _Value(self, name)

    def column(self, index: int) -> _Value:
        """Return a column of the observation, (batch, 1)."""
        place = f"column_{index}"
        self.constants.append(onnx.numpy_helper.from_array(np.array([index]), place))
        self.nodes.append(onnx.helper.make_node("Gather", ["observation", place], [f"seen_{index}"], axis=1))
        return _Value(self, f"seen_{index}")

    def _constant(self, number: float) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(onnx.numpy_helper.from_array(np.array(number, dtype=np.float32), name))
        return name


@dataclass(frozen=True, slots=True)
class _Value:
    """A value of the graph, (batch, 1); arithmetic adds nodes."""

    graph: _Graph
    name: str

    def __add__(self, other: _Value | float) -> _Value:
        return self.graph.node("Add", self, other)

    def __sub__(self, other: _Value | float) -> _Value:
        return self.graph.node("Sub", self, other)

    def __rsub__(self, other: float) -> _Value:
        return self.graph.node("Sub", other, self)

    def __mul__(self, other: _Value | float) -> _Value:
        return self.graph.node("Mul", self, other)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> _Value:
        return self.graph.node("Neg", self)

    def clip(self, low: _Value | float, high: _Value | float) -> _Value:
        """Return the value within two ends, of which the lower one counts more."""
        return self.graph.node("Max", self.graph.node("Min", self, high), low)


def energy_network(gains: Gains = Gains()) -> onnx.ModelProto:
    """Return the law as a network: observations (batch, 5) in, actions (batch, 1) out."""
    graph = _Graph()
    x, sin_hanging, cos_hanging, v, w = (graph.column(index) for index in range(5))
    sin_a, cos_a = -sin_hanging, -cos_hanging
    pump = _pump(graph, gains, sin_a, cos_a, w) - gains.centring * x
    pump = _within(gains.pump_end_m, gains.pump_brake_s, gains.stop, pump, x, v)
    hold = gains.cart * x + gains.cart_speed * v + gains.pole * sin_a + gains.pole_speed * w
    capture = graph.node("Abs", sin_a + w * (1.0 / SWING_RAD_S))
    high, slow = graph.node("Greater", cos_a, gains.near_cos), graph.node("Less", capture, gains.near_rad)
    action = graph.node("Where", graph.node("And", high, slow), hold, pump).clip(-1.0, 1.0)
    action = _within(gains.end_m, gains.brake_s, gains.stop, action, x, v)
    graph.node("Clip", action, -1.0, 1.0, name="action")
    made = onnx.helper.make_graph(
        graph.nodes,
        "energy_policy",
        [onnx.helper.make_tensor_value_info("observation", onnx.TensorProto.FLOAT, ["batch", 5])],
        [onnx.helper.make_tensor_value_info("action", onnx.TensorProto.FLOAT, ["batch", 1])],
        graph.constants,
    )
    opset = onnx.helper.make_opsetid("", OPSET)
    return onnx.helper.make_model(
        made, opset_imports=[opset], ir_version=IR_VERSION, producer_name="deal-hw-bench-cartpole"
    )


def _pump(graph: _Graph, gains: Gains, sin_a: _Value, cos_a: _Value, w: _Value) -> _Value:
    """Return the share of the force that brings the pole's energy to the wanted one."""
    squared = w * w * SWING_RAD_S**-2
    missing = gains.energy - (0.5 * squared + cos_a - 1.0)
    # Where the pole will be when the command acts.
    turn = w * gains.lead_s
    sin_turn, cos_turn = graph.node("Sin", turn), graph.node("Cos", turn)
    sin_then = sin_a * cos_turn + cos_a * sin_turn
    cos_then = cos_a * cos_turn - sin_a * sin_turn
    direction = graph.node("Tanh", gains.sharpness * sin_then * (cos_then - squared))
    return direction * (gains.energy_gain * missing).clip(-1.0, 1.0)


def _within(end_m: float, brake_s: float, stop: float, action: _Value, x: _Value, v: _Value) -> _Value:
    """Return an action that stops the cart before either end of the track."""
    ahead = x + brake_s * v
    return action.clip(-stop * (ahead + end_m), stop * (end_m - ahead))


def write_energy_policy(path: Path, gains: Gains = Gains()) -> None:
    """Write the policy as a file that ``deal-hw deploy`` runs, with its record beside it."""
    record: dict[str, Any] = {
        "algorithm": "energy pump and state feedback",
        "gains": dataclasses.asdict(gains),
        "pole_m": POLE_M,
    }
    spec = dataclasses.replace(energy_policy_spec(), training=record)
    write_policy(energy_network(gains), spec, path)
    about = {"robot": spec.robot, "training": record, "spec_digest": spec.digest()}
    path.with_suffix(".json").write_text(json.dumps(about, indent=2, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_energy_policy(Path(sys.argv[1]))
