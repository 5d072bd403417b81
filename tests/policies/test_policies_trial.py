"""Policies are tried before anything moves: what is refused, in which words, and what is sound."""

from __future__ import annotations

import dataclasses
import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from fakes.faulty_policy import Fault, faulty_policy
from fakes.linear_policy import CARTPOLE_GAINS, feedback_spec
from onnx import helper

from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION as ON_STAND
from deal_hw.drivers.so101.description import DESCRIPTION as SO101
from deal_hw.errors import MissingExtraError, PolicyError, PolicyMismatchError
from deal_hw.install import install_line
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.policies import onnx_runtime
from deal_hw.policies.onnx_export import write_policy
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.trial import TrialPolicy, TrialSettings, check_policy
from deal_hw.policies.trial_states import ProbeStates
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.robots.ant.description import DESCRIPTION as ANT
from deal_hw.workflows.running.plan import RunPlan, check_plan, make_behaviour
from deal_hw.workflows.shipped import balancer, shipped_balancer, shipped_policy

SPEC = feedback_spec(CARTPOLE)
BRIEF = TrialSettings(nominal=2, random=5)


def linear_model(observations: int = 4, batch: str | int | None = "batch") -> Any:
    """Return a network of one matrix."""
    gains = np.resize(np.array(CARTPOLE_GAINS), observations)
    value, kind = helper.make_tensor_value_info, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["observation", "weights"], ["action"])],
        "feedback",
        [value("observation", kind, [batch, observations])],
        [value("action", kind, [batch, 1])],
        [onnx.numpy_helper.from_array(gains.astype(np.float32)[:, None], "weights")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


@pytest.fixture
def file(tmp_path: Path) -> Callable[..., Path]:
    """Return what writes a policy, by default a sound one, and returns its path."""

    def write(spec: PolicySpec = SPEC, model: Any = None) -> Path:
        path = tmp_path / "policy.onnx"
        write_policy(linear_model(len(spec.observation)) if model is None else model, spec, path)
        return path

    return write


@pytest.mark.parametrize("description", [CARTPOLE, DRIVER], ids=["cartpole", "go2"])
def test_the_shipped_policies_pass(description: RobotDescription) -> None:
    """What is deployed without --policy passes on the driver's description, in a small part of the time."""
    path = shipped_policy(description.name)
    assert path is not None
    report = check_policy(path, description)
    policy = OnnxPolicy(path)
    assert report.spec == policy.spec and report.digest == policy.digest
    assert report.observations > 130
    assert 0 < max(report.median_s.values()) < description.limits.action_age_s
    assert set(report.median_s) == {"nominal", "extreme", "random"}


def test_this_process_does_not_open_the_network() -> None:
    """The process that will watch over the robot loads no onnxruntime for the trial."""
    code = (
        "import sys; from deal_hw.workflows.running.plan import RunPlan, check_plan; "
        "from deal_hw.workflows.shipped import shipped_policy; "
        "from deal_hw.drivers.cartpole.description import DESCRIPTION; "
        "plan = RunPlan(robot='cartpole', policy=str(shipped_policy('cartpole'))); "
        "assert len(check_plan(plan, DESCRIPTION).policy_digest) == 64; "
        "print([m for m in ('onnxruntime', 'torch', 'mujoco', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_actions_are_those_of_the_file(file: Callable[..., Path]) -> None:
    """What the other process computes is what the control process will compute."""
    rng = np.random.default_rng(0)
    observations = rng.standard_normal((8, 4)).astype(np.float32)
    path = file()
    with TrialPolicy(path) as policy:
        assert policy.takes_batches
        np.testing.assert_array_equal(
            policy.act_batch(observations), OnnxPolicy(path).act_batch(observations)
        )
        np.testing.assert_array_equal(policy.act(observations[0]), OnnxPolicy(path).act(observations[0]))


def test_a_network_for_one_observation_is_enough(file: Callable[..., Path]) -> None:
    """The robot asks for one at a time; a fixed batch of more is refused."""
    check_policy(file(model=linear_model(batch=1)), CARTPOLE, BRIEF)
    with pytest.raises(PolicyError, match=r"input 'observation' is .* of shape \[7, 4\], the spec says"):
        check_policy(file(model=linear_model(batch=7)), CARTPOLE, BRIEF)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("nan", r"the network answers nan for 'FL_hip_joint'; allowed: finite actions"),
        ("late", r"an action takes \d+\.\d ms \(median of 3\), robot 'go2' allows 40 ms"),
        ("fails", r"the network fails on an observation of the right shape .*out of data bounds"),
        ("shape", r"output 'action' came with shape \(1, 24\), the spec says \(1, 12\)"),
        ("memory", r"the network fails on an observation of the right shape"),
    ],
)
def test_a_faulty_network_is_refused(tmp_path: Path, fault: Fault, words: str) -> None:
    """Each fault, with the state on which it showed."""
    path = tmp_path / "faulty.onnx"
    write_policy(*faulty_policy(DRIVER, fault, rounds=20_000), path)
    with pytest.raises(
        PolicyError, match=rf"faulty\.onnx: {words}.*\(seen with fastest command \[1\.0"
    ) as caught:
        check_policy(path, DRIVER)
    assert "\n" not in str(caught.value)


def test_an_endless_network_is_stopped(tmp_path: Path) -> None:
    """After its share of processor time, and its process is gone."""
    path = tmp_path / "endless.onnx"
    write_policy(*faulty_policy(DRIVER, "endless"), path)
    settings = dataclasses.replace(BRIEF, processor_s=1)
    with TrialPolicy(path, settings) as policy:
        child = policy.process_id
        policy.act(np.zeros(3, dtype=np.float32))
        with pytest.raises(
            PolicyError, match=r"gave no answer within 1 s of processor time; it loops for ever"
        ):
            policy.act(np.array([1.0, 0.0, 0.0], dtype=np.float32))
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_a_trial_that_takes_too_long_is_stopped(file: Callable[..., Path]) -> None:
    """By the clock, whatever the reason: here the process was not even started when its time was over."""
    settings = dataclasses.replace(BRIEF, time_limit_s=0.0)
    with pytest.raises(PolicyError, match=r"stopped after 0 s; it is far too slow, or this computer is too"):
        check_policy(file(), CARTPOLE, settings)


def test_an_endless_network_ends_with_the_process_that_asked(tmp_path: Path) -> None:
    """Also where that one is killed and can end nobody."""
    path = tmp_path / "endless.onnx"
    write_policy(*faulty_policy(DRIVER, "endless"), path)
    code = (
        "import sys; import numpy as np; from pathlib import Path; "
        "from deal_hw.policies.trial import TrialPolicy, TrialSettings; "
        "policy = TrialPolicy(Path(sys.argv[1]), TrialSettings(processor_s=600)).__enter__(); "
        "print(policy.process_id, flush=True); policy.act(np.ones(3, dtype=np.float32))"
    )
    with subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE, text=True) as asker:
        assert asker.stdout is not None
        child = os.pidfd_open(int(asker.stdout.readline()))
        try:
            asker.kill()
            assert select.select([child], [], [], 60.0)[0]
        finally:
            os.close(child)


def test_a_network_that_crashes_its_process_is_refused(file: Callable[..., Path]) -> None:
    """The signal that ended it is named."""
    with TrialPolicy(file()) as policy:
        os.kill(policy.process_id, signal.SIGSEGV)
        os.waitid(os.P_PID, policy.process_id, os.WEXITED | os.WNOWAIT)
        with pytest.raises(PolicyError, match=r"crashes the process that runs it \(signal SIGSEGV"):
            policy.act(np.zeros(4, dtype=np.float32))


def test_a_rare_fault_passes(tmp_path: Path) -> None:
    """A trial cannot see every observation: what it misses is the safety filter's, in the same plan."""
    path = tmp_path / "rare.onnx"
    write_policy(*faulty_policy(DRIVER, "nan", rare=True), path)
    check_policy(path, DRIVER)
    assert np.isnan(OnnxPolicy(path).act(np.array([0.3, 0.0, 0.0], dtype=np.float32))).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"observation": (ObservationTerm("position", "cart", 1e300),)},
            r"field observation\[0\] \(position of 'cart', scale 1e\+300\) is -inf in a state that this",
        ),
        (
            {"observation": (ObservationTerm("gravity", "z", 1.0),)},
            r"observes gravity of the base, which no sensor of 'cartpole' reports",
        ),
        ({"stiffness": (1e9,)}, r"stiffness: policy requests \(1000000000.0,\), the robot allows at most"),
    ],
)
def test_a_spec_that_does_not_suit_the_robot_is_refused(
    file: Callable[..., Path], change: dict[str, Any], words: str
) -> None:
    """Numbers that overflow on the way to the network, and quantities that no sensor gives."""
    path = file(dataclasses.replace(SPEC, **change))
    with pytest.raises(PolicyError, match=words):
        check_policy(path, CARTPOLE, BRIEF)


def test_weights_outside_of_the_file_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: Callable[..., Path]
) -> None:
    """Beside the policy, where they were found and loaded, and in the working folder."""
    path = file()
    onnx.save_model(
        onnx.load(path), path, save_as_external_data=True, location="weights.bin", size_threshold=0
    )
    assert (tmp_path / "weights.bin").stat().st_size == 16
    monkeypatch.chdir(tmp_path)
    for attempt in (lambda: OnnxPolicy(path), lambda: check_policy(path, CARTPOLE, BRIEF)):
        with pytest.raises(PolicyError, match=r"policy\.onnx keeps its weights in another file"):
            attempt()


@pytest.mark.parametrize("name", [b"observation", b"deal_hw.policy_spec"])
def test_names_that_are_no_text_are_refused(
    tmp_path: Path, file: Callable[..., Path], capfd: pytest.CaptureFixture[str], name: bytes
) -> None:
    """A torn file; onnxruntime raises UnicodeDecodeError where names are read, and prints where it loads."""
    path = file()
    path.write_bytes(path.read_bytes().replace(name, b"\xff" + name[1:]))
    with pytest.raises(PolicyError, match=r"policy\.onnx is (damaged|not an ONNX network that can be run)"):
        OnnxPolicy(path)
    assert capfd.readouterr() == ("", "")


def make_folder(path: Path) -> None:
    path.mkdir()


def make_fifo(path: Path) -> None:
    os.mkfifo(path)


def make_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def make_loop(path: Path) -> None:
    path.symlink_to(path)


def make_large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(onnx_runtime.MAX_FILE_BYTES + 1)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (make_folder, r"x\.onnx cannot be read \(Is a directory\)"),
        (make_fifo, r"x\.onnx is not a regular file"),
        (make_device, r"x\.onnx is not a regular file"),
        (make_loop, r"x\.onnx cannot be read \(Too many levels of symbolic links\)"),
        (make_large, r"x\.onnx is larger than 100 MB"),
        (lambda path: None, r"no such policy file: .*x\.onnx; train one"),
        (lambda path: path.write_bytes(b"\x08\x09"), r"x\.onnx is not an ONNX network that can be run"),
    ],
)
def test_what_is_no_policy_file_is_refused(
    tmp_path: Path, make: Callable[[Path], object], words: str
) -> None:
    """A pipe that nobody writes to holds up nobody."""
    path = tmp_path / "x.onnx"
    make(path)
    for attempt in (lambda: OnnxPolicy(path), lambda: check_policy(path, CARTPOLE, BRIEF)):
        with pytest.raises(PolicyError, match=words):
            attempt()


def test_the_control_process_opens_the_bytes_that_were_checked(file: Callable[..., Path]) -> None:
    """A file that was changed after its check is refused, though it is sound."""
    path = file()
    plan = check_plan(RunPlan(robot="cartpole", policy=str(path)), CARTPOLE)
    assert isinstance(make_behaviour(plan, CARTPOLE), PolicyBehaviour)
    file(dataclasses.replace(SPEC, trained_under="others"))
    with pytest.raises(PolicyError, match="was changed after it was checked"):
        make_behaviour(plan, CARTPOLE)


def test_a_profile_without_a_policy_tries_none(tmp_path: Path) -> None:
    """A file that is not used is not looked at."""
    plan = RunPlan(robot="cartpole", motion="hold", policy=str(tmp_path / "nothing.onnx"))
    assert check_plan(plan, CARTPOLE).policy_digest == ""


def test_a_policy_of_another_robot_is_a_mismatch() -> None:
    """The class says it, too: callers tell it from a policy that is broken."""
    with pytest.raises(PolicyMismatchError, match="policy has 'go2', robot has 'cartpole'"):
        check_policy(Path(str(shipped_policy("go2"))), CARTPOLE, BRIEF)


@pytest.mark.parametrize("description", [CARTPOLE, DRIVER, ON_STAND, ANT], ids=lambda d: d.name)
def test_states_of_a_trial_are_such_as_the_robot_can_have(description: RobotDescription) -> None:
    """Finite, inside the ranges that do not trip, all ends among them; a seed gives the same states again."""
    states, limits = ProbeStates(description), description.limits
    low, high = np.array(limits.trip_position).T
    extremes = list(states.extreme())
    probes = [*states.nominal(1), *extremes, *states.random(50, np.random.default_rng(3))]
    positions = np.array([probe.state.position for probe in probes])
    velocities = np.array([probe.state.velocity for probe in probes])
    assert np.isfinite(positions).all() and np.isfinite(velocities).all()
    assert (positions >= low).all() and (positions <= high).all()
    assert (np.abs(velocities) <= limits.trip_velocity).all()
    for bound, reached in ((low, positions.min(axis=0)), (high, positions.max(axis=0))):
        np.testing.assert_array_equal(reached[np.isfinite(bound)], bound[np.isfinite(bound)])
    np.testing.assert_array_equal(positions[0], description.default_position)
    assert {probe.velocity[0] for probe in extremes} >= {-1.0, 0.0, 1.0}
    again = states.random(50, np.random.default_rng(3))
    for probe, same in zip(probes[-50:], again, strict=True):
        np.testing.assert_array_equal(probe.state.position, same.state.position)
    for probe in probes:
        body = probe.state.body
        assert (body is None) == (description is CARTPOLE)
        if body is None:
            continue
        assert np.linalg.norm(body.orientation) == pytest.approx(1.0)
        if limits.legs is not None:
            upright = 1 - 2 * (body.orientation[1] ** 2 + body.orientation[2] ** 2)
            assert np.arccos(np.clip(upright, -1, 1)) <= limits.legs.tilt + 1e-9
            assert np.abs(body.angular_velocity).max() <= limits.legs.tumble


def test_without_onnxruntime_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before a process is started. The balancing that calibration may need asks for it at the first call."""
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    words = "onnxruntime is not installed.*" + re.escape(install_line("deploy"))
    with pytest.raises(MissingExtraError, match=words):
        check_policy(Path(str(shipped_policy("cartpole"))), CARTPOLE, BRIEF)
    with pytest.raises(MissingExtraError, match=words):
        balancer(CARTPOLE, None)
    make = shipped_balancer(CARTPOLE)
    assert make is not None
    with pytest.raises(MissingExtraError, match=words):
        make()


def test_the_shipped_balancing_is_made_at_the_first_call() -> None:
    """A new behaviour each time; no policy is shipped for the arm."""
    make = shipped_balancer(CARTPOLE)
    assert make is not None
    first, second = make(), make()
    assert isinstance(first, PolicyBehaviour) and first is not second
    assert shipped_balancer(SO101) is None
