"""What is wrong with an exported policy is named in one line, and nothing of it runs in this process."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import onnx
import pytest
import yaml
from fakes import foreign_policy
from fakes.foreign_policy import DESCRIPTION, Foreign
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from deal_hw.drivers.go2.messages.wire import WIRE_JOINTS
from deal_hw.errors import ConfigurationError, DealHwError, PolicyError, PolicyMismatchError
from deal_hw.policies.importing import mjlab, unitree_rl_gym, unitree_rl_lab
from deal_hw.policies.importing.manifest import ForeignPolicy, adapter_of, spec_of
from deal_hw.policies.importing.network import ForeignNetwork
from deal_hw.policies.importing.sources import PolicyFiles, describe, find_source
from deal_hw.policies.importing.supplement import Supplement, parse_history, parse_range, parse_values

LAB = Foreign().deploy_yaml()
GYM = Foreign().gym_yaml()
METADATA = Foreign().metadata()
FULL: dict[str, Any] = {
    "motors": WIRE_JOINTS,
    "control_rate": 50.0,
    "observation_scales": "1",
    "history": "1",
    "command_range": "-1:1,-1:1,-1:1",
    "clock": 1.0,
    "clock_at_rest": "runs",
}


def lab(values: Any, **answers: Any) -> ForeignPolicy:
    """Parse a deploy.yaml."""
    given = {"motors": WIRE_JOINTS, "clock_at_rest": "runs", **answers}
    return unitree_rl_lab.parse(values, Supplement(**given), "go2")


def changed(values: Any, place: str, value: Any) -> Any:
    """Return values with one of them changed; ``...`` removes it."""
    found = copy.deepcopy(values)
    *way, last = place.split("/")
    inside = found
    for key in way:
        inside = inside[key]
    if value is ...:
        del inside[last]
    else:
        inside[last] = value
    return found


ACTION = "actions/JointPositionAction"
RANGES = "commands/base_velocity/ranges"


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("step_dt", ..., "step_dt is missing"),
        ("step_dt", 0, r"step_dt must be a finite number from 0\.0001"),
        ("step_dt", float("nan"), "step_dt must be a finite number"),
        ("joint_ids_map", [0, 1, 2], r"default_joint_pos has 12 numbers; 3 belong there"),
        ("joint_ids_map", [0] * 12, r"joint_ids_map: motor 0 comes 12 times"),
        ("joint_ids_map", [*range(11), 12], r"joint_ids_map\[11\] must be a finite number from 0 to 11"),
        ("joint_ids_map", "0", "joint_ids_map must be a list of motor numbers"),
        ("stiffness", [20.0] * 11, "damping has 12 numbers|stiffness has 11 numbers"),
        ("default_joint_pos", [0.0] * 11 + ["a"], r"default_joint_pos\[11\] must be a number"),
        ("gains", [1], "key 'gains' is unknown; known are"),
        (f"{ACTION}/low_pass_filter_cutoff_hz", 5.0, "key 'low_pass_filter_cutoff_hz' is unknown"),
        ("actions", {"JointVelocityAction": {}}, "one action term is known, JointPositionAction"),
        ("actions", {**LAB["actions"], "Other": {}}, "one action term is known"),
        (f"{ACTION}/scale", [0.25] * 4, r"actions\.scale has 4 numbers; 12 belong there"),
        (f"{ACTION}/clip", [[-1, 1]], "clip must be null or 12 pairs"),
        (f"{ACTION}/clip", [[1, -1]] * 12, r"actions\.clip\[0\] goes from 1 down to -1"),
        (f"{ACTION}/joint_ids", [0, 0], "joint_ids names a joint twice"),
        (f"{ACTION}/joint_ids", "all", "joint_ids must be null or a list"),
        ("observations", {}, "there is no term"),
        ("observations/base_ang_vel/scale", [1.0] * 4, r"base_ang_vel\.scale has 4 numbers; 3 belong there"),
        ("observations/base_ang_vel/clip", [1], "clip has 1 numbers; 2 belong there"),
        ("observations/base_ang_vel/history_length", 101, "history 101; allowed are 1 to 100"),
        ("observations/base_ang_vel/history_length", 1.5, "must be a whole number"),
        ("observations/base_ang_vel/noise", {}, "key 'noise' is unknown"),
        ("observations/gait_phase/params", {}, r"params\.period must be a number, got None"),
        (
            "observations/feet_contact",
            {"scale": [1.0]},
            "term 'feet_contact' is unknown; known are 'base_ang_vel'",
        ),
        ("observations/joint_pos", {"scale": [1.0]}, "term 'joint_pos' is unknown"),
        ("observations", {"policy": LAB["observations"], "other": LAB["observations"]}, "has the groups"),
        (f"{RANGES}/lin_vel_x", ..., "lin_vel_x is missing"),
        (f"{RANGES}/lin_vel_y", [0.5, -0.5], r"lin_vel_y goes from 0\.5 down to -0\.5"),
    ],
)
def test_a_wrong_deploy_yaml_names_the_value(place: str, value: Any, said: str) -> None:
    """Each in one line, with what is allowed."""
    with pytest.raises(ConfigurationError, match=said) as caught:
        lab(changed(LAB, place, value))
    assert "\n" not in str(caught.value)


def test_what_is_not_measured_is_refused_with_what_to_do() -> None:
    """In all formats."""
    term: dict[str, Any] = {"params": {}, "clip": None, "scale": [2.0] * 3, "history_length": 1}
    values = {**LAB, "observations": {"base_lin_vel": term, **LAB["observations"]}}
    said = "'base_lin_vel', the base's linear velocity, which no sensor of 'go2' measures; train it without"
    with pytest.raises(PolicyMismatchError, match=said):
        lab(values)
    with pytest.raises(PolicyMismatchError, match=said):
        mjlab.parse({**METADATA, "observation_names": "base_lin_vel,actions"}, Supplement(**FULL), "go2")
    with pytest.raises(PolicyMismatchError, match=said):
        unitree_rl_gym.parse({**GYM, "num_obs": 48}, Supplement(motors=WIRE_JOINTS), "go2")


@pytest.mark.parametrize(
    "name", ["control_rate", "observation_scales", "history", "command_range", "clock", "clock_at_rest"]
)
def test_what_mjlab_does_not_say_is_asked_for(name: str) -> None:
    """The message names the option and an answer."""
    answers = {key: value for key, value in FULL.items() if key != name}
    with pytest.raises(
        ConfigurationError, match=f"give it as it was in training: --{name.replace('_', '-')} "
    ):
        mjlab.parse(METADATA, Supplement(**answers), "go2")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("joint_names", "", "joint_names is missing"),
        ("joint_names", "a,a", "names with commas between, none twice"),
        ("joint_stiffness", "1,2", "allowed are 12 finite numbers"),
        ("default_joint_pos", ",".join(["nan"] * 12), "allowed are 12 finite numbers"),
        ("action_scale", "x", "allowed are 12 finite numbers"),
        ("observation_names", "base_ang_vel,height", "term 'height' is unknown; known are"),
    ],
)
def test_wrong_metadata_name_the_value(name: str, value: str, said: str) -> None:
    """Lists are text with commas there."""
    with pytest.raises(ConfigurationError, match=said):
        mjlab.parse({**METADATA, name: value}, Supplement(**FULL), "go2")


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("control_dt", ..., "control_dt is missing"),
        ("kps", [20.0] * 3, "kps has 3 numbers; 12 belong there"),
        ("num_actions", 11, "num_actions is 11, but there are 12 joints"),
        ("num_obs", 45, "--observations base_ang_vel,"),
        ("leg_joint2motor_idx", ..., "--joints FL_hip_joint,"),
        ("max_cmd", ..., "--command-range -1:1"),
        ("obs_scales_ang_vel", 0.25, "key 'obs_scales_ang_vel' is unknown"),
    ],
)
def test_a_wrong_gym_yaml_names_the_value(place: str, value: Any, said: str) -> None:
    """What it does not say is asked for by its option."""
    with pytest.raises(ConfigurationError, match=said):
        unitree_rl_gym.parse(changed(GYM, place, value), Supplement(motors=WIRE_JOINTS), "go2")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"go2/robot_lab": {"rl_kp": [], "observations_history": []}}, "of rl_sar, which is not imported"),
        ({"articulations": {}, "observations": {}}, "IO_descriptors.yaml of Isaac Lab"),
        ({"a": 1}, "no side file of a known format; imported are mjlab, unitree_rl_lab and unitree_rl_gym"),
        ([1], "no side file of a known format"),
        ("text", "no side file of a known format"),
    ],
)
def test_other_formats_are_named(tmp_path: Path, values: Any, said: str) -> None:
    """Those that are known but not imported, too."""
    config = foreign_policy.write_yaml(tmp_path / "c.yaml", values)
    with pytest.raises(ConfigurationError, match=said):
        describe(PolicyFiles(tmp_path / "p.onnx", config), {}, Supplement(motors=WIRE_JOINTS), "go2")


def test_side_file_and_metadata_must_agree(tmp_path: Path) -> None:
    """A network with the side file of another policy is found by its own metadata."""
    config = foreign_policy.write_yaml(tmp_path / "deploy.yaml", LAB)
    source = PolicyFiles(tmp_path / "p.onnx", config)

    def answers() -> Supplement:
        return Supplement(motors=WIRE_JOINTS)

    assert describe(source, METADATA, answers(), "go2").clock_rest == 0.1
    for name, value in (
        ("joint_names", ",".join(WIRE_JOINTS)),
        ("default_joint_pos", ",".join(["0.500"] * 12)),
        ("observation_names", "projected_gravity,base_ang_vel,command,phase,joint_pos,joint_vel,actions"),
    ):
        with pytest.raises(ConfigurationError, match=f"{name} of the network's own metadata is"):
            describe(source, {**METADATA, name: value}, answers(), "go2")
    with pytest.raises(ConfigurationError, match=r"does not say what it observes.*--config FILE"):
        describe(PolicyFiles(tmp_path / "p.onnx", None), {}, answers(), "go2")


def test_options_that_the_file_answers_are_refused(tmp_path: Path) -> None:
    """Two answers could contradict each other."""
    config = foreign_policy.write_yaml(tmp_path / "deploy.yaml", LAB)
    answers = Supplement(motors=WIRE_JOINTS, clock_at_rest="runs", control_rate=50.0, history="1")
    with pytest.raises(ConfigurationError, match=r"--control-rate, --history: .* says that itself"):
        describe(PolicyFiles(tmp_path / "p.onnx", config), {}, answers, "go2")


def test_the_robots_joints_are_compared() -> None:
    """Another robot's joints, and joints that are missing."""
    policy = mjlab.parse(
        {**METADATA, "joint_names": ",".join(f"j{i}" for i in range(12))}, Supplement(**FULL), "go2"
    )
    with pytest.raises(PolicyMismatchError, match=r"not of 'go2': j0, j1.*missing: FL_hip_joint.*--joints"):
        spec_of(policy, DESCRIPTION, recurrent=False, training={})
    named = {**FULL, "joints": DESCRIPTION.joint_names}
    policy = mjlab.parse(
        {**METADATA, "joint_names": ",".join(f"j{i}" for i in range(12))}, Supplement(**named), "go2"
    )
    assert tuple(joint.name for joint in policy.joints) == DESCRIPTION.joint_names
    with pytest.raises(ConfigurationError, match="in another order, which would exchange joints"):
        mjlab.parse(METADATA, Supplement(**named), "go2")
    with pytest.raises(ConfigurationError, match=r"joints are not known for robot 'x'.*--motors"):
        unitree_rl_lab.parse(LAB, Supplement(clock_at_rest="runs"), "x")


def refused(path: Path, policy: ForeignPolicy | None = None) -> str:
    """Return why a network is refused."""
    parsed = policy or lab(LAB)
    with pytest.raises(DealHwError) as caught, ForeignNetwork(path) as network:
        network.open(parsed.observations)
        spec = spec_of(parsed, DESCRIPTION, recurrent=False, training={})
        network.file(spec, adapter_of(parsed, DESCRIPTION))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700
    return str(caught.value)


def with_inputs(*names: str) -> onnx.ModelProto:
    """Return a network with more inputs."""
    model = Foreign().model()
    for name in names:
        model.graph.input.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1]))
    return model


def with_metadata(size: int) -> onnx.ModelProto:
    """Return a network with long metadata."""
    model = Foreign().model()
    helper.set_model_props(model, {"k": "x" * size})
    return model


def with_nan() -> onnx.ModelProto:
    """Return a network whose answers are not finite."""
    model = Foreign().model()
    (shift,) = [tensor for tensor in model.graph.initializer if tensor.name == "shift"]
    shift.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(shift) * float("nan"), "shift"))
    return model


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: with_inputs("time_step"), "follows a motion inside the network"),
        (lambda: with_inputs("other"), "known is one observation and one action"),
        (lambda: with_metadata(2_000_000), "kB of metadata"),
        (with_nan, "not finite"),
    ],
    ids=["motion", "inputs", "metadata", "nan"],
)
def test_a_network_that_does_not_fit_is_refused(tmp_path: Path, make: Callable[[], Any], said: str) -> None:
    """Extra inputs by name, what answers with NaN, and too much text."""
    (tmp_path / "policy.onnx").write_bytes(make().SerializeToString())
    assert said in refused(tmp_path / "policy.onnx")


def test_sizes_are_compared_with_the_side_file(tmp_path: Path) -> None:
    """A history that is off by one shows as the wrong length."""
    (tmp_path / "policy.onnx").write_bytes(Foreign().model().SerializeToString())
    longer = lab(changed(LAB, "observations/base_ang_vel/history_length", 2))
    assert "takes 47 numbers, the terms of the observation have 50" in refused(
        tmp_path / "policy.onnx", longer
    )


DAMAGED = (b"", b"no protobuf" * 9, b"\x08\x09" * 400, b"PK\x03\x04" + bytes(60))


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        *((".onnx", content) for content in DAMAGED),
        # Each .pt loads torch in a process: the empty file and the one that begins as an archive.
        *((".pt", content) for content in (DAMAGED[0], DAMAGED[3])),
        *(pytest.param(".pt", content, marks=pytest.mark.slow) for content in DAMAGED[1:3]),
    ],
)
def test_damaged_files_are_one_line(tmp_path: Path, suffix: str, content: bytes) -> None:
    """Whatever the bytes are."""
    path = tmp_path / f"policy{suffix}"
    path.write_bytes(content)
    assert str(path) in refused(path)


class Evil:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (exec, (f"import pathlib; pathlib.Path({str(self.path)!r}).touch()",))


def test_a_pickle_with_code_does_not_run(tmp_path: Path) -> None:
    """Neither plain, nor as weights of torch.save: only TorchScript is read, by torch's own reader."""
    import torch

    made = tmp_path / "ran"
    plain, saved = tmp_path / "plain.pt", tmp_path / "saved.pt"
    plain.write_bytes(pickle.dumps(Evil(made)))
    torch.save({"weights": Evil(made)}, saved)
    for path in (plain, saved):
        assert "no TorchScript" in refused(path)
    assert not made.exists()
    pickle.loads(plain.read_bytes())
    assert made.exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: !!python/object/apply:os.system ['touch ran']", "python/object/apply:os.system"),
        ("a: !!python/name:os.system", "python/name:os.system"),
        ("a: !!python/object/apply:builtins.slice [0, 3, null]", "list the joints' numbers"),
        ("a: !!python/object/apply:builtins.slice {x: 1}", "list the joints' numbers"),
        ("a: &a [*a]", "aliases count each time"),
        (
            "a: &a [x, x]\n"
            + "".join(
                f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 9)}]\n" for i in range(8)
            ),
            "aliases",
        ),
        ("[" * 5000, "nested too deep|expected"),
        ("x" * 20_000, "characters"),
        ("a: b: c", "mapping values"),
        ("a: \x00", "special characters|unacceptable"),
    ],
)
def test_hostile_yaml_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, said: str
) -> None:
    """Tags of Python, cycles, bombs and damage; nothing runs."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "deploy.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match=said) as caught:
        unitree_rl_lab.read_deploy_yaml(path)
    assert str(path) in str(caught.value) and not (tmp_path / "ran").exists()


def test_a_huge_yaml_is_not_read(tmp_path: Path) -> None:
    """Its size is looked at first."""
    path = tmp_path / "deploy.yaml"
    path.write_bytes(b"a: 1\n" * 400_000)
    with pytest.raises(ConfigurationError, match="MiB"):
        unitree_rl_lab.read_deploy_yaml(path)


def test_what_is_there_is_found(tmp_path: Path) -> None:
    """A folder with several networks, none, or another kind of file."""
    with pytest.raises(PolicyError, match="has 0 networks"):
        find_source(tmp_path)
    folder = foreign_policy.lab_folder(tmp_path / "run", Foreign())
    found = find_source(folder)
    assert found.network == folder / "exported/policy.onnx" and found.config == folder / "params/deploy.yaml"
    assert find_source(found.network) == found
    (folder / "exported" / "policy.pt").touch()
    with pytest.raises(PolicyError, match=r"has 2 networks.*exported/policy\.pt; name the one"):
        find_source(folder)
    with pytest.raises(PolicyError, match="no such file"):
        find_source(tmp_path / "policy.onnx")
    with pytest.raises(PolicyError, match="is no network"):
        find_source(found.config or Path())
    with pytest.raises(ConfigurationError, match=r"--config .*no such file"):
        find_source(folder, tmp_path / "none.yaml")


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-200, 200) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=13) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=14,
)


def places(values: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the way to each value."""
    yield way
    if isinstance(values, dict | list):
        for key, inner in values.items() if isinstance(values, dict) else enumerate(values):
            yield from places(inner, (*way, key))


@st.composite
def damaged(draw: st.DrawFn, values: Any) -> Any:
    """Return values of which some are replaced, removed or added."""
    found = copy.deepcopy(values)
    for _ in range(draw(st.integers(1, 3))):
        way = draw(st.sampled_from(sorted(places(found), key=str)))
        if not way:
            return draw(plain)
        inside = found
        for key in way[:-1]:
            inside = inside[key]
        change = draw(st.sampled_from(("replace", "remove", "add")))
        if change == "replace":
            inside[way[-1]] = draw(plain)
        elif change == "remove":
            del inside[way[-1]]
        elif isinstance(inside, dict):
            inside[draw(st.text(max_size=6))] = draw(plain)
        else:
            inside.append(draw(plain))
    return found


def judge(parse: Callable[[], ForeignPolicy]) -> None:
    """Parse, and make a spec of what comes out; only our own errors may come."""
    try:
        policy = parse()
        spec_of(policy, DESCRIPTION, recurrent=False, training={})
        adapter_of(policy, DESCRIPTION)
    except DealHwError as err:
        assert str(err).strip()


@settings(max_examples=150)
@given(damaged(LAB))
def test_no_deploy_yaml_gives_a_traceback(values: Any) -> None:
    """Values of any shape."""
    judge(lambda: lab(values))


@settings(max_examples=100)
@given(damaged(GYM))
def test_no_gym_yaml_gives_a_traceback(values: Any) -> None:
    """The same."""
    judge(lambda: unitree_rl_gym.parse(values, Supplement(**{**FULL, "observations": ()}), "go2"))


@settings(max_examples=100)
@given(
    st.fixed_dictionaries(
        {}, optional={name: st.just(value) | st.text(max_size=40) for name, value in METADATA.items()}
    ),
    st.text(max_size=12),
    st.text(max_size=12),
)
def test_no_metadata_give_a_traceback(metadata: dict[str, str], scales: str, history: str) -> None:
    """Nor does text in the options."""
    answers = {**FULL, "observation_scales": scales or "1", "history": history or "1"}
    judge(lambda: mjlab.parse(metadata, Supplement(**answers), "go2"))


@settings(max_examples=60)
@given(st.text(max_size=60) | st.binary(max_size=60).map(lambda b: b.decode("latin-1")))
def test_no_text_gives_a_traceback(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    """As YAML, and as the text of options."""
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    for parse in (
        lambda: unitree_rl_lab.read_deploy_yaml(path),
        lambda: parse_range(text),
        lambda: parse_values(text, "--observation-scales", ("a", "b")),
        lambda: parse_history(text, ("a", "b")),
    ):
        try:
            parse()
        except DealHwError as err:
            assert str(err).strip()


def test_yaml_of_the_exporters_is_read(tmp_path: Path) -> None:
    """As yaml.dump writes it, with flow lists."""
    path = foreign_policy.write_yaml(tmp_path / "deploy.yaml", LAB)
    assert unitree_rl_lab.read_deploy_yaml(path) == yaml.safe_load(path.read_text(encoding="utf-8"))
