"""The shipped walking policy in the conventions of other trainers, as small files of their formats.

The network is the same. A matrix in front turns the others' observation into ours, one behind turns our
actions into theirs: another order of joints, another default pose, other factors, and actions that nobody
clips. So an import must give back the shipped policy's targets.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import onnx
import yaml
from onnx import TensorProto, helper, numpy_helper

from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.wire import WIRE_JOINTS
from deal_hw.policies.onnx_runtime import SPEC_KEY
from deal_hw.policy import PolicySpec
from deal_hw.workflows.shipped import required_policy

LEGS, PARTS = ("FL", "FR", "RL", "RR"), ("hip", "thigh", "calf")
ISAAC: Final = tuple(f"{leg}_{part}_joint" for part in PARTS for leg in LEGS)
"""Isaac Lab's order: all hips, all thighs, all calves."""
DEFAULT: Final = {"hip": 0.1, "thigh": 0.8, "calf": -1.5}
STIFFNESS: Final = {name: 30.0 + 0.5 * i for i, name in enumerate(WIRE_JOINTS)}
"""Each joint has another, so that an exchange is seen."""
SCALE: Final = {"hip": 0.125, "thigh": 0.25, "calf": 0.2}
TERMS: Final = (
    "base_ang_vel",
    "projected_gravity",
    "velocity_commands",
    "gait_phase",
    "joint_pos_rel",
    "joint_vel_rel",
    "last_action",
)
SLICE: Final = "!!python/object/apply:builtins.slice [null, null, null]"


def shipped() -> tuple[onnx.ModelProto, PolicySpec]:
    """Return the shipped network and its spec."""
    model = onnx.load(str(required_policy("go2")))
    (text,) = [entry.value for entry in model.metadata_props if entry.key == SPEC_KEY]
    del model.metadata_props[:]
    return model, PolicySpec.from_json(text)


def pose(name: str) -> float:
    """Return a joint's default pose of the others [rad]."""
    leg, part, _ = name.split("_")
    side = -1.0 if part == "hip" and leg.endswith("R") else 1.0
    return side * DEFAULT[part] + (0.2 if part == "thigh" and leg.startswith("R") else 0.0)


def part_of(name: str) -> str:
    """Return hip, thigh or calf."""
    return name.split("_")[1]


@dataclass(frozen=True, kw_only=True)
class Foreign:
    """Conventions.

    Attributes:
        joints: The policy's order of joints.
        scales: Factors of the terms.
    """

    joints: tuple[str, ...] = ISAAC
    scales: Mapping[str, float] = field(
        default_factory=lambda: {
            **dict.fromkeys(TERMS, 1.0),
            "base_ang_vel": 0.2,
            "joint_vel_rel": 0.04,
            "velocity_commands": 2.0,
        }
    )

    def matrices(self) -> tuple[tuple[npt.NDArray[Any], ...], tuple[npt.NDArray[Any], ...]]:
        """Return matrix and vector of the observation, (47, 47) and (47,), and of the action."""
        _, spec = shipped()
        columns = self.columns()
        default = dict(zip(spec.joint_names, spec.default_position, strict=True))
        scale = dict(zip(spec.actuated, spec.action_scale, strict=True))
        into, bias = np.zeros((len(spec.observation), len(columns))), np.zeros(len(spec.observation))
        quantity = dict(zip(TERMS, _QUANTITIES, strict=True))
        for row, term in enumerate(spec.observation):
            (column,) = [
                k
                for k, (name, element) in enumerate(columns)
                if (quantity[name], element) == (term.quantity, term.joint)
            ]
            name = columns[column][0]
            factor = term.scale / self.scales[name]
            if term.quantity == "position":
                bias[row] = term.scale * (pose(term.joint) - default[term.joint])
            if term.quantity == "action":
                factor *= SCALE[part_of(term.joint)] / scale[term.joint]
                bias[row] = term.scale * (pose(term.joint) - default[term.joint]) / scale[term.joint]
            into[row, column] = factor
        out, shift = np.zeros((len(self.joints), len(self.joints))), np.zeros(len(self.joints))
        for row, name in enumerate(self.joints):
            theirs = SCALE[part_of(name)]
            out[row, spec.actuated.index(name)] = scale[name] / theirs
            shift[row] = (default[name] - pose(name)) / theirs
        return (into, bias), (out, shift)

    def columns(self) -> list[tuple[str, str]]:
        """Return term and element of each entry of the observation."""
        axes = {"gait_phase": ("sin", "cos")}
        return [
            (name, element)
            for name in TERMS
            for element in (
                self.joints if "joint" in name or name == "last_action" else axes.get(name, ("x", "y", "z"))
            )
        ]

    def model(self, *, batch: int | str = 1, names: tuple[str, str] = ("obs", "actions")) -> onnx.ModelProto:
        """Return the network as ONNX, as exporters write it."""
        (into, bias), (out, shift) = self.matrices()
        own, _ = shipped()
        inner = onnx.compose.add_prefix_graph(own.graph, "mlp/")
        weights = {"into": into.T, "bias": bias, "out": out.T, "shift": shift}
        row = helper.make_tensor_value_info
        graph = helper.make_graph(
            [
                helper.make_node("MatMul", [names[0], "into"], ["turned"]),
                helper.make_node("Add", ["turned", "bias"], ["mlp/observation"]),
                *inner.node,
                helper.make_node("MatMul", ["mlp/action", "out"], ["unclipped"]),
                helper.make_node("Add", ["unclipped", "shift"], [names[1]]),
            ],
            "torch-jit-export",
            [row(names[0], TensorProto.FLOAT, [batch, into.shape[1]])],
            [row(names[1], TensorProto.FLOAT, [batch, out.shape[0]])],
            [
                *inner.initializer,
                *(numpy_helper.from_array(v.astype(np.float32), name) for name, v in weights.items()),
            ],
        )
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)

    def deploy_yaml(self) -> dict[str, Any]:
        """Return the values of unitree_rl_lab's deploy.yaml."""
        slots = [WIRE_JOINTS.index(name) for name in self.joints]
        defaults = [pose(name) for name in self.joints]
        length = {name: sum(term == name for term, _ in self.columns()) for name in TERMS}
        return {
            "joint_ids_map": slots,
            "step_dt": 0.02,
            "stiffness": [STIFFNESS[name] for name in WIRE_JOINTS],
            "damping": [1.0] * len(slots),
            "default_joint_pos": defaults,
            "commands": {
                "base_velocity": {
                    "ranges": {
                        "lin_vel_x": [-0.6, 1.0],
                        "lin_vel_y": [-0.5, 0.5],
                        "ang_vel_z": [-1.0, 1.0],
                        "heading": None,
                    }
                }
            },
            "actions": {
                "JointPositionAction": {
                    "clip": None,
                    "joint_names": [".*"],
                    "scale": [SCALE[part_of(name)] for name in self.joints],
                    "offset": defaults,
                    "joint_ids": None,
                }
            },
            "observations": {
                name: {
                    "params": {"period": 0.4} if name == "gait_phase" else {},
                    "clip": [-100, 100],
                    "scale": [self.scales[name]] * length[name],
                    "history_length": 1,
                }
                for name in TERMS
            },
        }

    def gym_yaml(self) -> dict[str, Any]:
        """Return the values of unitree_rl_gym's deploy_real yaml; its terms are in another order."""
        return {
            "control_dt": 0.02,
            "msg_type": "go",
            "imu_type": "pelvis",
            "policy_path": "{LEGGED_GYM_ROOT_DIR}/policy.pt",
            "leg_joint2motor_idx": [WIRE_JOINTS.index(name) for name in self.joints],
            "kps": [STIFFNESS[name] for name in self.joints],
            "kds": [1.0] * len(self.joints),
            "default_angles": [pose(name) for name in self.joints],
            "ang_vel_scale": self.scales["base_ang_vel"],
            "dof_pos_scale": self.scales["joint_pos_rel"],
            "dof_vel_scale": self.scales["joint_vel_rel"],
            "action_scale": [SCALE[part_of(name)] for name in self.joints],
            "cmd_scale": [self.scales["velocity_commands"]] * 3,
            "num_actions": len(self.joints),
            "num_obs": len(self.columns()),
            "max_cmd": [0.6, 0.5, 1.0],
        }

    def metadata(self) -> dict[str, str]:
        """Return mjlab's metadata."""
        names = ("base_ang_vel", "projected_gravity", "command", "phase", "joint_pos", "joint_vel", "actions")

        def text(values: Sequence[float]) -> str:
            return ",".join(f"{value:.3f}" for value in values)

        return {
            "run_path": "2026-01-01_00-00-00",
            "joint_names": ",".join(self.joints),
            "joint_stiffness": text([STIFFNESS[name] for name in self.joints]),
            "joint_damping": text([1.0] * len(self.joints)),
            "default_joint_pos": text([pose(name) for name in self.joints]),
            "command_names": "twist",
            "observation_names": ",".join(names),
            "action_scale": text([SCALE[part_of(name)] for name in self.joints]),
        }

    def torchscript(self, path: Path, *, terms: Sequence[str] = TERMS) -> Path:
        """Write the network as TorchScript, the terms of its observation in another order."""
        import torch

        (into, bias), (out, shift) = self.matrices()
        order = [k for name in terms for k, (own, _) in enumerate(self.columns()) if own == name]
        own, _ = shipped()
        weights = {tensor.name: numpy_helper.to_array(tensor) for tensor in own.graph.initializer}

        def linear(weight: npt.NDArray[Any], offset: npt.NDArray[Any]) -> torch.nn.Linear:
            layer = torch.nn.Linear(weight.shape[1], weight.shape[0])
            layer.weight.data = torch.as_tensor(np.array(weight), dtype=torch.float32)
            layer.bias.data = torch.as_tensor(np.array(offset), dtype=torch.float32)
            return layer

        network = torch.nn.Sequential(
            linear(into[:, order], bias),
            linear(weights["weight_0"], weights["bias_0"]),
            torch.nn.ELU(),
            linear(weights["weight_2"], weights["bias_2"]),
            torch.nn.ELU(),
            linear(weights["weight_4"], weights["bias_4"]),
            torch.nn.Hardtanh(),
            linear(out, shift),
        )
        return save_script(network, path)


def h1_gym_yaml() -> dict[str, Any]:
    """Return the values of unitree_rl_gym @ 276801e, deploy/deploy_real/configs/h1.yaml."""
    return {
        "control_dt": 0.02,
        "msg_type": "go",
        "imu_type": "torso",
        "weak_motor": list(range(10, 20)),
        "leg_joint2motor_idx": [7, 3, 4, 5, 10, 8, 0, 1, 2, 11],
        "kps": [150, 150, 150, 200, 40] * 2,
        "kds": [2, 2, 2, 4, 2] * 2,
        "default_angles": [0, 0.0, -0.1, 0.3, -0.2] * 2,
        "arm_waist_joint2motor_idx": [6, 16, 17, 18, 19, 12, 13, 14, 15],
        "arm_waist_kps": [300, *[100, 100, 50, 50] * 2],
        "arm_waist_kds": [3, *[2] * 8],
        "arm_waist_target": [0] * 9,
        "ang_vel_scale": 0.25,
        "dof_pos_scale": 1.0,
        "dof_vel_scale": 0.05,
        "action_scale": 0.25,
        "cmd_scale": [2.0, 2.0, 0.25],
        "num_actions": 10,
        "num_obs": 41,
        "max_cmd": [0.8, 0.5, 1.57],
    }


def save_script(network: Any, path: Path) -> Path:
    """Write a torch module as TorchScript."""
    import torch

    with warnings.catch_warnings():
        # Newer versions of torch load it, and advise to write it no more.
        warnings.simplefilter("ignore", DeprecationWarning)
        script: Any = torch.jit.script
        script(network.eval()).save(str(path))
    return path


_QUANTITIES: Final = ("angular_velocity", "gravity", "command", "clock", "position", "velocity", "action")


def lab_folder(folder: Path, foreign: Foreign, values: Mapping[str, Any] | None = None) -> Path:
    """Write unitree_rl_lab's folder: exported/policy.onnx and params/deploy.yaml."""
    for name in ("exported", "params"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "exported" / "policy.onnx").write_bytes(foreign.model().SerializeToString())
    write_yaml(folder / "params" / "deploy.yaml", foreign.deploy_yaml() if values is None else values)
    return folder


def write_yaml(path: Path, values: Any) -> Path:
    """Write YAML as the exporters do."""
    path.write_text(yaml.dump(values, default_flow_style=None, sort_keys=False), encoding="utf-8")
    return path


def mjlab_file(path: Path, foreign: Foreign, **changed: str | None) -> Path:
    """Write an ONNX file with mjlab's metadata; a changed entry of None is left out."""
    model = foreign.model()
    metadata = {**foreign.metadata(), **changed}
    helper.set_model_props(model, {key: value for key, value in metadata.items() if value is not None})
    path.write_bytes(model.SerializeToString())
    return path


def spec_of_file(path: Path) -> dict[str, Any]:
    """Return the values of the spec in a file."""
    (text,) = [entry.value for entry in onnx.load(str(path)).metadata_props if entry.key == SPEC_KEY]
    values: dict[str, Any] = json.loads(text)
    return values


DESCRIPTION: Final = DRIVER


def without(model: onnx.ModelProto, foreign: Foreign, terms: Sequence[str]) -> onnx.ModelProto:
    """Return a network that sees zeros in place of some terms, and has no entries for them."""
    kept = [k for k, (name, _) in enumerate(foreign.columns()) if name not in terms]
    (into,) = [tensor for tensor in model.graph.initializer if tensor.name == "into"]
    into.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(into)[kept].copy(), "into"))
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = len(kept)
    return model
