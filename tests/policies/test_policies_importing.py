"""Policies of other trainers give, imported, the targets that they gave there."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import mujoco
import numpy as np
import numpy.typing as npt
import onnx
import pytest
from fakes import foreign_policy
from fakes.foreign_policy import DESCRIPTION, ISAAC, STIFFNESS, Foreign, pose
from onnx import TensorProto, helper, numpy_helper

from deal_hw.drivers.go2.messages.wire import WIRE_JOINTS
from deal_hw.drivers.h1.description import DESCRIPTION as H1
from deal_hw.drivers.h1.joints import MOTORS
from deal_hw.drivers.h1.messages import pelvis_motion
from deal_hw.errors import ConfigurationError, PolicyError
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.policies.importing.manifest import adapter_of, spec_of
from deal_hw.policies.importing.network import ForeignNetwork
from deal_hw.policies.importing.sources import describe, find_source
from deal_hw.policies.importing.supplement import Supplement
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.trial import check_policy
from deal_hw.policies.trial_states import GivenVelocity, ProbeStates
from deal_hw.policy import ObservationBuilder, PolicySpec
from deal_hw.robots import driver_description, robot_entry
from deal_hw.rotations import rotation_vector
from deal_hw.types import FloatArray
from deal_hw.workflows.shipped import required_policy

if TYPE_CHECKING:
    import torch

TARGET_RAD = 2e-5
"""Largest difference of targets: sums of single precision with factors up to 5."""
MJLAB = {
    "control_rate": 50.0,
    "observation_scales": "base_ang_vel=0.2,joint_vel=0.04,command=2",
    "history": "1",
    "command_range": "-0.6:1,-0.5:0.5,-1:1",
    "clock": 2.5,
    "clock_at_rest": "runs",
}
ORDERS = {
    "isaac": ISAAC,
    "sdk": WIRE_JOINTS,
    "ours": DESCRIPTION.joint_names,
    "mixed": tuple(np.random.default_rng(5).permutation(DESCRIPTION.joint_names).tolist()),
}


def modules() -> Any:
    """Return the networks with a memory; their module loads torch, so collecting the tests does not."""
    return importlib.import_module("fakes.recurrent_modules")


@pytest.fixture
def imported(tmp_path: Path) -> Callable[..., OnnxPolicy]:
    """Return what imports files and returns the policy that deploys."""

    def run(source: Path, config: Path | None = None, *, robot: str = "go2", **answers: Any) -> OnnxPolicy:
        found, description = find_source(source, config), driver_description(robot)
        with ForeignNetwork(found.network) as network:
            given = Supplement(**{"motors": robot_entry(robot).motor_joints(), **answers})
            policy = describe(found, network.metadata, given, robot)
            network.open(policy.observations)
            spec = spec_of(policy, description, recurrent=bool(network.memory), training={})
            path = tmp_path / "imported.onnx"
            path.write_bytes(network.file(spec, adapter_of(policy, description)))
        return OnnxPolicy(path)

    return run


def targets(policy: OnnxPolicy, count: int = 60) -> FloatArray:
    """Return the targets for random states in a row, each the past of the next, with changing commands."""
    source = GivenVelocity()
    behaviour = PolicyBehaviour(policy, DESCRIPTION, source)
    behaviour.reset()
    found = []
    for probe in ProbeStates(DESCRIPTION).random(count, np.random.default_rng(3)):
        source.wanted = 0.5 * probe.velocity
        found.append(behaviour.command(probe.state, 0.0).position_target)
    return np.array(found)


def shipped_targets(count: int = 60) -> FloatArray:
    """Return those of the shipped policy; its first observed action is the others' 0, their default pose."""
    policy = OnnxPolicy(required_policy("go2"))
    spec = policy.spec
    centre, scale = np.array(spec.default_position), np.array(spec.action_scale)
    builder = ObservationBuilder(spec)
    builder.record_action((np.array([pose(name) for name in spec.actuated]) - centre) / scale)
    found = []
    low, high = np.array(spec.command_range).T
    for probe in ProbeStates(DESCRIPTION).random(count, np.random.default_rng(3)):
        assert probe.state.body is not None
        builder.command = np.clip(0.5 * probe.velocity, low, high)
        none = np.zeros(3)
        turn = rotation_vector(probe.state.body.orientation)
        action = policy.act(
            builder.build(
                np.concatenate([none, turn, probe.state.position]),
                np.concatenate([none, probe.state.body.angular_velocity, probe.state.velocity]),
            )
        )
        builder.record_action(action)
        found.append(centre + scale * action)
    return np.array(found)


@pytest.mark.parametrize("order", ORDERS)
def test_unitree_rl_lab_gives_the_same_targets(
    tmp_path: Path, imported: Callable[..., OnnxPolicy], order: str
) -> None:
    """Another order, default pose, factors, and raw actions: the folder as its exporter writes it."""
    foreign = Foreign(joints=ORDERS[order])
    policy = imported(foreign_policy.lab_folder(tmp_path / "run", foreign), clock_at_rest="runs")
    np.testing.assert_allclose(targets(policy), shipped_targets(), atol=TARGET_RAD)
    spec = policy.spec
    assert spec.stiffness == tuple(STIFFNESS[name] for name in DESCRIPTION.actuated)
    assert spec.default_position == tuple(pose(name) for name in DESCRIPTION.joint_names)
    assert spec.command_range == ((-0.6, 1.0), (-0.5, 0.5), (-1.0, 1.0))
    assert spec.control_rate_hz == 50.0 and spec.clock_hz == pytest.approx(2.5)
    assert np.isinf(spec.action_limit)
    check_policy(policy.path, DESCRIPTION)


def test_all_joints_may_be_a_slice(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """Isaac Lab's dump has a Python tag for it, which a safe loader does not know."""
    folder = foreign_policy.lab_folder(tmp_path / "run", Foreign())
    file = folder / "params" / "deploy.yaml"
    text = file.read_text(encoding="utf-8")
    assert "joint_ids: null" in text
    file.write_text(text.replace("joint_ids: null", f"joint_ids: {foreign_policy.SLICE}"), encoding="utf-8")
    policy = imported(folder, clock_at_rest="runs")
    np.testing.assert_allclose(targets(policy), shipped_targets(), atol=TARGET_RAD)


def test_mjlab_gives_the_same_targets(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """By the metadata of its ONNX, and what they do not say by options."""
    foreign = Foreign(joints=ORDERS["mixed"])
    policy = imported(foreign_policy.mjlab_file(tmp_path / "policy.onnx", foreign), **MJLAB)
    np.testing.assert_allclose(targets(policy), shipped_targets(), atol=TARGET_RAD)
    assert policy.spec.stiffness == tuple(STIFFNESS[name] for name in DESCRIPTION.actuated)


def test_unitree_rl_gym_gives_the_same_targets(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """TorchScript and yaml; its clock comes last and turns as its program has it."""
    foreign = Foreign(joints=ORDERS["mixed"])
    terms = (*(name for name in foreign_policy.TERMS if name != "gait_phase"), "gait_phase")
    script = foreign.torchscript(tmp_path / "motion.pt", terms=terms)
    config = foreign_policy.write_yaml(
        tmp_path / "go2.yaml", {**foreign.gym_yaml(), "max_cmd": [1.0, 0.5, 1.0]}
    )
    policy = imported(script, config, clock=2.5)
    np.testing.assert_allclose(targets(policy), shipped_targets(), atol=TARGET_RAD)
    assert imported(script, config).spec.clock_hz == pytest.approx(1 / 0.8)


def test_the_clock_at_rest(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """unitree_rl_mjlab's clock reads zero for commands below 0.1; a network of mjlab says that itself."""
    folder = foreign_policy.lab_folder(tmp_path / "run", Foreign())
    assert imported(folder, clock_at_rest="zero").spec.clock_rest == 0.1
    file = foreign_policy.mjlab_file(folder / "exported" / "policy.onnx", Foreign())
    assert imported(file).spec.clock_rest == 0.1


@pytest.mark.parametrize("layers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_an_lstms_memory_is_input_and_output(
    tmp_path: Path, imported: Callable[..., OnnxPolicy], layers: int
) -> None:
    """Step by step as in torch; a reset clears it, and robots in a batch have a memory each."""
    import torch

    torch.manual_seed(layers)
    module = modules().Recurrent(layers).eval()
    foreign_policy.save_script(module, tmp_path / "motion.pt")
    config = foreign_policy.write_yaml(tmp_path / "go2.yaml", Foreign().gym_yaml())
    policy = imported(tmp_path / "motion.pt", config)
    assert policy.spec.recurrent and policy.takes_batches
    order = [ISAAC.index(name) for name in DESCRIPTION.actuated]
    drawn = np.random.default_rng(0).standard_normal((2, 6, 47)).astype(np.float32)
    wanted = np.empty((2, 6, 12))
    for sequence, result in zip(drawn, wanted, strict=True):
        module.reset_memory()
        policy.reset()
        for observation, row in zip(sequence, result, strict=True):
            with torch.no_grad():
                row[:] = module(torch.as_tensor(observation[None]))[0].numpy()[order]
            np.testing.assert_allclose(policy.act(observation), row, atol=1e-6)
    policy.reset()
    for k in range(6):
        np.testing.assert_allclose(policy.act_batch(drawn[:, k]), wanted[:, k], atol=1e-6)
    check_policy(policy.path, DESCRIPTION)


@pytest.mark.parametrize(
    ("module", "said"), [("Rolling", "keeps a memory of its own|not known"), ("Gated", r"memory \(GRU\)")]
)
def test_other_memories_are_refused_by_name(
    tmp_path: Path, imported: Callable[..., OnnxPolicy], module: str, said: str
) -> None:
    """The state would else be frozen at its first value, and nothing would tell."""
    foreign_policy.save_script(getattr(modules(), module)(), tmp_path / "motion.pt")
    config = foreign_policy.write_yaml(tmp_path / "go2.yaml", Foreign().gym_yaml())
    with pytest.raises(PolicyError, match=said):
        imported(tmp_path / "motion.pt", config)


@pytest.mark.parametrize("layers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_isaac_labs_lstm_has_a_normaliser(
    tmp_path: Path, imported: Callable[..., OnnxPolicy], layers: int
) -> None:
    """Its exporter names the LSTM otherwise; the ONNX of the same exporter has the states as inputs."""
    import torch

    torch.manual_seed(layers)
    module = modules().IsaacRecurrent(layers).eval()
    foreign_policy.save_script(module, tmp_path / "policy.pt")
    config = foreign_policy.write_yaml(tmp_path / "go2.yaml", Foreign().gym_yaml())
    order = [ISAAC.index(name) for name in DESCRIPTION.actuated]
    drawn = np.random.default_rng(0).standard_normal((5, 47)).astype(np.float32)
    module.reset_memory()
    with torch.no_grad():
        wanted = [module(torch.as_tensor(row[None]))[0].numpy()[order] for row in drawn]
    (tmp_path / "policy.onnx").write_bytes(isaac_lstm(module, layers).SerializeToString())
    for file in ("policy.pt", "policy.onnx"):
        policy = imported(tmp_path / file, config)
        assert policy.spec.recurrent and policy.takes_batches
        np.testing.assert_allclose([policy.act(row) for row in drawn], wanted, atol=1e-5)
        policy.reset()
        both = policy.act_batch(np.repeat(drawn[:1], 3, axis=0))
        np.testing.assert_allclose(both, np.repeat(wanted[:1], 3, axis=0), atol=1e-5)


def isaac_lstm(module: Any, layers: int) -> onnx.ModelProto:
    """Return the network as Isaac Lab exports it: inputs obs, h_in, c_in of a batch of one."""
    state, kind, row = [layers, 1, 16], TensorProto.FLOAT, helper.make_tensor_value_info
    gates, last = [0, 3, 1, 2], cast(Any, module.actor[0])

    def turned(value: torch.Tensor) -> npt.NDArray[Any]:
        parts = np.split(value.detach().numpy(), 4)
        return np.concatenate([parts[k] for k in gates])

    weights = {
        "mean": module.normalizer.mean.numpy(),
        "std": module.normalizer.std.numpy() + np.float32(1e-2),
        "zero": np.array([0], dtype=np.int64),
        "gain": last.weight.detach().numpy().T.copy(),
        "bias": last.bias.detach().numpy(),
    }
    nodes = [
        helper.make_node("Sub", ["obs", "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "std"], ["x"]),
        helper.make_node("Unsqueeze", ["x", "zero"], ["y0"]),
        helper.make_node("Split", ["h_in"], [f"h{k}" for k in range(layers)], num_outputs=layers, axis=0),
        helper.make_node("Split", ["c_in"], [f"c{k}" for k in range(layers)], num_outputs=layers, axis=0),
    ]
    for k in range(layers):
        own = {
            name: getattr(module.rnn, f"{name}_l{k}")
            for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        }
        weights[f"W{k}"], weights[f"R{k}"] = turned(own["weight_ih"])[None], turned(own["weight_hh"])[None]
        weights[f"B{k}"] = np.concatenate([turned(own["bias_ih"]), turned(own["bias_hh"])])[None]
        given = [f"y{k}", f"W{k}", f"R{k}", f"B{k}", "", f"h{k}", f"c{k}"]
        nodes += [
            helper.make_node("LSTM", given, [f"s{k}", f"hn{k}", f"cn{k}"], hidden_size=16),
            helper.make_node("Identity", [f"hn{k}"], [f"y{k + 1}"]),
        ]
    nodes += [
        helper.make_node("Squeeze", [f"y{layers}", "zero"], ["last"]),
        helper.make_node("MatMul", ["last", "gain"], ["product"]),
        helper.make_node("Add", ["product", "bias"], ["actions"]),
        *(
            helper.make_node("Concat", [f"{n}n{k}" for k in range(layers)], [f"{n}_out"], axis=0)
            for n in "hc"
        ),
    ]
    graph = helper.make_graph(
        nodes,
        "policy",
        [row("obs", kind, [1, 47]), row("h_in", kind, state), row("c_in", kind, state)],
        [row("actions", kind, [1, 12]), row("h_out", kind, state), row("c_out", kind, state)],
        [numpy_helper.from_array(np.ascontiguousarray(value), name) for name, value in weights.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


def test_each_known_layer_is_converted(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """Activations, norms, sums and clips give what torch gives."""
    import torch

    torch.manual_seed(0)
    module = modules().Layers().eval()
    foreign_policy.save_script(module, tmp_path / "policy.pt")
    config = foreign_policy.write_yaml(tmp_path / "go2.yaml", Foreign().gym_yaml())
    policy = imported(tmp_path / "policy.pt", config)
    drawn = 3 * np.random.default_rng(0).standard_normal((50, 47)).astype(np.float32)
    with torch.no_grad():
        wanted = module(torch.as_tensor(drawn)).numpy()
    assert wanted.std() > 0.1
    order = [ISAAC.index(name) for name in DESCRIPTION.actuated]
    np.testing.assert_allclose(policy.act_batch(drawn), wanted[:, order], atol=1e-5)


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("Endless", "operation prim::Loop of the network is not known"),
        ("Greedy", "the network fails on an observation|memory|crashes"),
    ],
)
def test_what_loops_or_takes_all_memory_ends(
    tmp_path: Path, imported: Callable[..., OnnxPolicy], module: str, said: str
) -> None:
    """A loop is refused before it runs; the process has limits."""
    foreign_policy.save_script(getattr(modules(), module)(), tmp_path / "motion.pt")
    config = foreign_policy.write_yaml(tmp_path / "go2.yaml", Foreign().gym_yaml())
    with pytest.raises(PolicyError, match=said):
        imported(tmp_path / "motion.pt", config)


def test_a_network_that_writes_a_file_does_not(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """TorchScript can map a file to memory, and would make it."""
    made = tmp_path / "made"
    foreign_policy.save_script(modules().Writing(str(made)), tmp_path / "motion.pt")
    config = foreign_policy.write_yaml(tmp_path / "go2.yaml", Foreign().gym_yaml())
    with pytest.raises(PolicyError, match="the network fails on an observation"):
        imported(tmp_path / "motion.pt", config)
    assert not made.exists()


def test_a_yaml_of_deploy_mujoco(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """It has no order of motors, no range, and the control period in two numbers."""
    foreign = Foreign(joints=ORDERS["mixed"])
    values = foreign.gym_yaml()
    for name in ("control_dt", "leg_joint2motor_idx", "max_cmd", "msg_type", "imu_type"):
        del values[name]
    values.update(simulation_dt=0.002, control_decimation=10, xml_path="scene.xml", cmd_init=[0.5, 0, 0])
    terms = (*(name for name in foreign_policy.TERMS if name != "gait_phase"), "gait_phase")
    script = foreign.torchscript(tmp_path / "motion.pt", terms=terms)
    config = foreign_policy.write_yaml(tmp_path / "go2.yaml", values)
    policy = imported(script, config, joints=foreign.joints, command_range=MJLAB["command_range"], clock=2.5)
    assert policy.spec.control_rate_hz == pytest.approx(50.0)
    np.testing.assert_allclose(targets(policy), shipped_targets(), atol=TARGET_RAD)


def linear_network(gain: npt.NDArray[Any]) -> onnx.ModelProto:
    """Return a network of one matrix."""
    row, kind = helper.make_tensor_value_info, TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["obs", "gain"], ["actions"])],
        "linear",
        [row("obs", kind, [1, gain.shape[1]])],
        [row("actions", kind, [1, gain.shape[0]])],
        [numpy_helper.from_array(gain.T.astype(np.float32).copy(), "gain")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


@pytest.mark.parametrize("frames", [False, True])
def test_history_is_oldest_first(tmp_path: Path, imported: Callable[..., OnnxPolicy], frames: bool) -> None:
    """Term by term, or whole frames; commands and the clock, too; clipped before the factor.

    The expectation is computed here as the format's own runner does: each term keeps its last values, and the
    first observation fills them.
    """
    depth, foreign = 3, Foreign()
    values = foreign.deploy_yaml()
    for term in values["observations"].values():
        term["history_length"], term["clip"] = depth, [-0.3, 0.4]
    if frames:
        values["observations"]["use_gym_history"] = True
    count = len(foreign.columns()) * depth
    gain = 0.05 * np.random.default_rng(1).standard_normal((12, count))
    (tmp_path / "policy.onnx").write_bytes(linear_network(gain).SerializeToString())
    foreign_policy.write_yaml(tmp_path / "deploy.yaml", values)
    policy = imported(tmp_path / "policy.onnx", clock_at_rest="zero")
    assert policy.spec.delayed_commands

    source, action = GivenVelocity(), np.zeros(12)
    behaviour = PolicyBehaviour(policy, DESCRIPTION, source)
    memory: dict[str, list[npt.NDArray[Any]]] = {}
    low, high = np.array(policy.spec.command_range).T
    places = [DESCRIPTION.joint_names.index(name) for name in foreign.joints]
    default = np.array([pose(name) for name in foreign.joints])
    for tick, probe in enumerate(ProbeStates(DESCRIPTION).random(12, np.random.default_rng(7))):
        source.wanted = (0.0 if tick % 4 == 3 else 0.4) * probe.velocity
        command = np.clip(source.wanted, low, high)
        assert probe.state.body is not None
        w, x, y, z = probe.state.body.orientation
        gravity = np.array([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1])
        phase = 2 * np.pi * ((tick * 0.02) % 0.4) / 0.4
        clock = np.array([np.sin(phase), np.cos(phase)]) * (np.linalg.norm(command) >= 0.1)
        seen = {
            "base_ang_vel": probe.state.body.angular_velocity,
            "projected_gravity": gravity,
            "velocity_commands": command,
            "gait_phase": clock,
            "joint_pos_rel": probe.state.position[places] - default,
            "joint_vel_rel": probe.state.velocity[places],
            "last_action": action,
        }
        for name, now in seen.items():
            value = foreign.scales[name] * np.clip(now, -0.3, 0.4)
            memory[name] = ([value] * depth if tick == 0 else [*memory[name], value])[-depth:]
        if frames:
            row = np.concatenate([memory[name][k] for k in range(depth) for name in seen])
        else:
            row = np.concatenate([value for name in seen for value in memory[name]])
        action = gain @ row
        target = behaviour.command(probe.state, 0.0).position_target
        found = (target[places] - default) / [foreign_policy.SCALE[n.split("_")[1]] for n in foreign.joints]
        np.testing.assert_allclose(found, action, atol=2e-5)


def test_targets_are_clipped_but_not_the_observed_action(
    tmp_path: Path, imported: Callable[..., OnnxPolicy]
) -> None:
    """The format clips what it sends and observes what the network answered."""
    foreign = Foreign(joints=DESCRIPTION.joint_names)
    values = foreign.deploy_yaml()
    action = values["actions"]["JointPositionAction"]
    action["clip"] = [[pose(name) - 0.05, pose(name) + 0.1] for name in foreign.joints]
    clipped = targets(
        imported(foreign_policy.lab_folder(tmp_path / "a", foreign, values), clock_at_rest="runs")
    )
    free = shipped_targets()
    low, high = np.array(action["clip"]).T
    assert (free > high).any() and (free < low).any()
    np.testing.assert_allclose(clipped, np.clip(free, low, high), atol=TARGET_RAD)


def test_joints_without_an_action_keep_their_pose(
    tmp_path: Path, imported: Callable[..., OnnxPolicy]
) -> None:
    """A policy of eight joints: the four hips are held with their own gains."""
    foreign = Foreign(joints=WIRE_JOINTS)
    legs = [name for name in WIRE_JOINTS if "hip" not in name]
    hips = [name for name in WIRE_JOINTS if "hip" in name]
    values = {
        **foreign.gym_yaml(),
        "num_actions": 8,
        "num_obs": 11 + 3 * 8,
        "leg_joint2motor_idx": [WIRE_JOINTS.index(name) for name in legs],
        "arm_waist_joint2motor_idx": [WIRE_JOINTS.index(name) for name in hips],
        "arm_waist_kps": [60.0] * 4,
        "arm_waist_kds": [2.0] * 4,
        "arm_waist_target": [0.11, -0.12, 0.13, -0.14],
        "kps": [40.0] * 8,
        "kds": [1.0] * 8,
        "default_angles": [pose(name) for name in legs],
        "action_scale": 0.25,
    }
    gain = 0.05 * np.random.default_rng(2).standard_normal((8, 35))
    (tmp_path / "policy.onnx").write_bytes(linear_network(gain).SerializeToString())
    policy = imported(tmp_path / "policy.onnx", foreign_policy.write_yaml(tmp_path / "g.yaml", values))
    found = targets(policy, 5)
    for name, at in zip(hips, values["arm_waist_target"], strict=True):
        place = DESCRIPTION.actuated.index(name)
        np.testing.assert_allclose(found[:, place], at)
        assert policy.spec.stiffness[place] == 60.0
    moving = [DESCRIPTION.actuated.index(name) for name in legs]
    assert (found[:, moving].std(axis=0) > 1e-3).all()


def test_an_h1s_policy_observes_what_its_own_runner_gives_it(
    tmp_path: Path, imported: Callable[..., OnnxPolicy]
) -> None:
    """The sensor is in the torso: turning and gravity are the pelvis's, whatever the torso's angle and speed.

    The expected values are deploy_real.py's: transform_imu_data of rotation_helper.py, in matrices.
    """
    # The network's answers are the first six numbers of its observation, and the targets show them.
    (tmp_path / "policy.onnx").write_bytes(linear_network(np.eye(10, 41)).SerializeToString())
    config = foreign_policy.write_yaml(tmp_path / "h1.yaml", foreign_policy.h1_gym_yaml())
    policy = imported(tmp_path / "policy.onnx", config, robot="h1")
    joints = [
        H1.actuated.index(MOTORS[motor]) for motor in foreign_policy.h1_gym_yaml()["leg_joint2motor_idx"]
    ]
    behaviour = PolicyBehaviour(policy, H1, GivenVelocity())
    rng = np.random.default_rng(4)
    for probe in ProbeStates(H1).random(20, rng):
        behaviour.reset()
        quaternion = rng.standard_normal(4)
        quaternion /= np.linalg.norm(quaternion)
        turning, force = rng.uniform(-3.0, 3.0, (2, 3))
        angle, speed = rng.uniform(-2.0, 2.0, 2)
        orientation, rate, acceleration = pelvis_motion(quaternion, turning, force, angle, speed)
        assert probe.state.body is not None
        body = dataclasses.replace(
            probe.state.body, orientation=orientation, angular_velocity=rate, acceleration=acceleration
        )
        state = dataclasses.replace(probe.state, body=body)
        target = behaviour.command(state, 0.0).position_target[joints]
        torso = np.empty(9)
        mujoco.mju_quat2Mat(torso, quaternion)
        waist = np.array(((np.cos(angle), -np.sin(angle), 0), (np.sin(angle), np.cos(angle), 0), (0, 0, 1)))
        expected = np.zeros(10)
        expected[:3] = 0.25 * (waist @ turning - (0, 0, speed))
        expected[3:6] = (torso.reshape(3, 3) @ waist.T).T @ (0, 0, -1)
        expected[6:9] = 0.0  # No velocity is wanted.
        expected[9] = state.position[joints[0]]
        np.testing.assert_allclose(
            target, foreign_policy.h1_gym_yaml()["default_angles"] + 0.25 * expected, atol=TARGET_RAD
        )
        held = {name: k for k, name in enumerate(H1.actuated) if k not in joints}
        assert len(held) == 9 and policy.spec.stiffness[held["torso_joint"]] == 300.0


def test_a_sensor_in_another_torso_is_refused(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """A robot whose sensor is in the pelvis, or a first joint by which an H1's sensor does not turn."""
    (tmp_path / "policy.onnx").write_bytes(linear_network(np.eye(10, 41)).SerializeToString())

    def refused(robot: str, said: str, **changes: Any) -> None:
        config = foreign_policy.write_yaml(tmp_path / "h1.yaml", {**foreign_policy.h1_gym_yaml(), **changes})
        with pytest.raises(ConfigurationError, match=said):
            imported(tmp_path / "policy.onnx", config, robot=robot)

    refused("g1", r"imu_type is torso.*'g1' is not known as one.*such a sensor: h1.*imu_type: pelvis")
    refused(
        "h1",
        "which is left_shoulder_pitch_joint.*turns with torso_joint; put that joint's motor first",
        arm_waist_joint2motor_idx=[16, 6, 17, 18, 19, 12, 13, 14, 15],
    )
    refused("h1", "which is none", arm_waist_joint2motor_idx=None)


def test_a_fixed_batch_stays_one(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """A network with its batch of one inside is imported; the file takes one observation at a time."""
    foreign = Foreign()
    folder = foreign_policy.lab_folder(tmp_path / "run", foreign)
    assert imported(folder, clock_at_rest="runs").takes_batches
    model = foreign.model()
    model.graph.node[0].input[0] = "one"
    model.graph.node.insert(0, helper.make_node("Reshape", ["obs", "shape"], ["one"]))
    model.graph.initializer.append(numpy_helper.from_array(np.array([1, 47], dtype=np.int64), "shape"))
    (folder / "exported" / "policy.onnx").write_bytes(model.SerializeToString())
    policy = imported(folder, clock_at_rest="runs")
    assert not policy.takes_batches
    np.testing.assert_allclose(targets(policy), shipped_targets(), atol=TARGET_RAD)


def test_weights_beside_the_network_are_taken_in(tmp_path: Path, imported: Callable[..., OnnxPolicy]) -> None:
    """PyTorch's newer exporter writes policy.onnx.data; only this file is read."""
    folder = foreign_policy.lab_folder(tmp_path / "run", Foreign())
    file = folder / "exported" / "policy.onnx"
    onnx.save_model(
        Foreign().model(),
        str(file),
        save_as_external_data=True,
        location="policy.onnx.data",
        size_threshold=0,
    )
    policy = imported(folder, clock_at_rest="runs")
    np.testing.assert_allclose(targets(policy), shipped_targets(), atol=TARGET_RAD)
    file.with_name("policy.onnx.data").unlink()
    with pytest.raises(PolicyError, match=r"only policy\.onnx\.data beside it is read"):
        imported(folder, clock_at_rest="runs")


def test_a_spec_of_ours_is_read_as_before() -> None:
    """The new fields are not written where they are as before: digests of specs stay."""
    policy = OnnxPolicy(required_policy("go2"))
    text = policy.spec.to_json()
    for name in (
        "action_offset",
        "action_limit",
        "target_range",
        "delayed_commands",
        "clock_rest",
        "recurrent",
    ):
        assert name not in text
    assert PolicySpec.from_json(text) == policy.spec
