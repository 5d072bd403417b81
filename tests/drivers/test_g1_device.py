"""The emulated G1 on a crane: its wire, its versions, damping, faults, and a whole run in virtual time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.passive import PassiveConfig
from deal_hw.control.safety.safety import Safety
from deal_hw.drivers.g1 import description as facts
from deal_hw.drivers.g1.description import DESCRIPTION, DESCRIPTION_23, SPACES, SPACES_23
from deal_hw.drivers.g1.emulator.device import G1Device
from deal_hw.drivers.g1.emulator.faults import G1FaultPlan
from deal_hw.drivers.g1.emulator.truth import G1Truth, draw_truth, nominal_truth
from deal_hw.drivers.g1.joints import JOINTS_29
from deal_hw.drivers.g1.messages import G1Command, G1CommandEncoder, G1Frame, G1StateDecoder
from deal_hw.drivers.g1.robot import G1Dof23Robot, G1Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.unitree.humanoid import part_of, per_joint
from deal_hw.drivers.unitree.rpc import Request, decode_response, encode_request
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.types import FloatArray
from deal_hw.workflows.running.plan import RunPlan, make_behaviour

DECODER = G1StateDecoder(JOINTS_29)
KNEE = JOINTS_29.index("left_knee_joint")
ANKLES = [JOINTS_29.index(f"{side}_ankle_pitch_joint") for side in ("left", "right")]


class Bench:
    """An emulated G1 in virtual time and a client of it; its own controller is released by default."""

    def __init__(self, **options: Any) -> None:
        truth = options.pop("truth", nominal_truth())
        self.device = G1Device(truth, **{"controller": "", **options})
        self.encoder = G1CommandEncoder(truth.joints)
        self.out: list[tuple[str, bytes]] = []

    def send(self, target: FloatArray, kp: float = 60.0, kd: float = 5.0, **more: Any) -> None:
        """Send a command for every joint, with the device's mode_machine unless another is given."""
        zero = np.zeros(len(target))
        ones = np.ones(len(target), np.int64)
        machine = more.pop("mode_machine", self.device.report()["mode_machine"])
        command = G1Command(target, zero, zero + kp, zero + kd, zero, ones, machine, **more)
        self.device.receive(topics.LOW_COMMAND, self.encoder.encode(command))

    def run(self, milliseconds: int) -> list[G1Frame]:
        """Let time pass; return the states that came."""
        self.out = [message for _ in range(milliseconds) for message in self.device.tick()]
        return [DECODER.decode(payload) for topic, payload in self.out if topic == topics.LOW_STATE]

    def call(self, api: int, parameter: str = "{}", service: str = "motion_switcher") -> tuple[int, str]:
        """Call a service; return code and data of its answer."""
        self.device.receive(topics.request(service), encode_request(Request(77, api, parameter)))
        answers = [p for topic, p in self.device.tick() if topic == topics.response(service)]
        response = decode_response(answers[0])
        return response.code, response.data


def test_the_model_is_that_of_the_description() -> None:
    """Joints, ranges, efforts, gains and friction of both files, and the vendor's masses."""
    for robot, mass_kg in ((DESCRIPTION, 35.112), (DESCRIPTION_23, 34.131)):
        model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
        joints = robot.joint_names
        assert tuple(model.joint(k).name for k in range(model.njnt)) == joints
        np.testing.assert_allclose(model.jnt_range, facts.joint_ranges(joints))
        np.testing.assert_allclose(model.actuator_forcerange[:, 1], robot.effort_limit)
        np.testing.assert_allclose(model.actuator_gainprm[:, 0], robot.stiffness)
        damping = np.array(robot.damping) + facts.JOINT_DAMPING_NMS_RAD
        np.testing.assert_allclose(-model.actuator_biasprm[:, 2], damping)
        np.testing.assert_allclose(model.dof_frictionloss, per_joint(facts.FRICTIONLOSS_NM, joints))
        assert float(model.body_mass.sum()) == pytest.approx(mass_kg, abs=1e-3)


def test_right_and_left_are_mirrored() -> None:
    """Ranges, default pose and excitation of a joint on the right are those of the left, rolls negated."""
    for left in (name for name in JOINTS_29 if name.startswith("left_")):
        k, m = JOINTS_29.index(left), JOINTS_29.index(left.replace("left_", "right_"))
        sign = -1.0 if part_of(left) in facts.MIRRORED else 1.0
        assert DESCRIPTION.default_position[m] == sign * DESCRIPTION.default_position[k]
        for table in (DESCRIPTION.limits.target, DESCRIPTION.excitation_range):
            np.testing.assert_allclose(sorted(sign * np.array(table[k])), table[m])


def test_excitations_keep_links_apart() -> None:
    """Corners of the excitation range and draws in it: links that do not adjoin stay 2 cm apart."""
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    data = mujoco.MjData(model)
    low, high = np.array(DESCRIPTION.excitation_range).T
    far = [
        (a, b) for a in range(model.ngeom) for b in range(a) if _hops(model, model.geom_bodyid[[a, b]]) > 3
    ]
    rng = np.random.default_rng(1)
    least = math.inf
    for k in range(150):
        share = rng.integers(0, 2, len(low)) if k % 2 else rng.random(len(low))
        data.qpos[:] = low + share * (high - low)
        mujoco.mj_kinematics(model, data)
        least = min(least, *(mujoco.mj_geomDistance(model, data, a, b, 0.5, None) for a, b in far))
    assert least > 0.02


def _hops(model: Any, bodies: Any) -> int:
    """Return the number of joints between two bodies."""
    lines = []
    for body in bodies:
        line = [int(body)]
        while line[-1]:
            line.append(int(model.body_parentid[line[-1]]))
        lines.append(line)
    first, second = lines
    common = next(body for body in first if body in second)
    return first.index(common) + second.index(common)


def test_states_come_every_2_ms_with_the_version() -> None:
    """500 a second, the clock counts ms, the newest mode_machine with these joints, a level pelvis."""
    bench = Bench(tick_ms=2**32 - 100)
    states = bench.run(1000)
    assert len(states) == 500
    assert [s.tick_ms for s in states[:2]] == [2**32 - 100, 2**32 - 98] and states[-1].tick_ms == 898
    assert states[0].mode_machine == 5 and Bench(truth=nominal_truth(robot="g1_23dof")).run(2)
    np.testing.assert_allclose(states[0].specific_force, (0.0, 0.0, 9.81), atol=1e-5)
    assert not states[0].error.any() and states[0].casing[0] < 40


def test_its_own_controller_commands_until_it_is_released() -> None:
    """Checked, selected and released by the motion switcher; its commands are on the wire until then."""
    bench = Bench(controller="ai")
    assert bench.call(1001) == (0, '{"form": "0", "name": "ai"}')
    bench.run(100)
    assert sum(topic == topics.LOW_COMMAND for topic, _ in bench.out) == 50
    assert bench.call(1003)[0] == 0
    assert bench.call(1002, '{"name": "normal"}')[0] == 7002
    bench.run(400)
    assert bench.device.controller_name == "" and bench.call(1001)[1] == '{"form": "0", "name": ""}'
    bench.run(10)
    assert all(topic != topics.LOW_COMMAND for topic, _ in bench.out)
    assert bench.call(1002, '{"name": "nobody"}')[0] == 7004
    assert bench.call(1002, "[")[0] == 3204
    assert bench.call(1002, '{"name": "ai"}')[0] == 0 and bench.device.controller_name == "ai"
    assert bench.call(9999)[0] == 3203 and bench.call(7001, service="sport")[0] == 3203


def test_two_writers_fight() -> None:
    """A stiff command beside the active controller: the joint follows neither."""
    bench = Bench(controller="ai")
    target = np.zeros(29)
    target[KNEE] = 1.0
    for _ in range(400):
        bench.send(target)
        bench.run(2)
    assert 0.2 < bench.device.true_position[KNEE] < 0.8


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"mode_machine": 4}, "mode_machine is 4, that of this robot 5"),
        ({"mode_pr": 1}, "mode_pr 1"),
    ],
)
def test_commands_for_another_version_or_mode_do_nothing(more: dict[str, int], words: str) -> None:
    """As on the robot; the log has the reason."""
    bench = Bench()
    before = bench.run(2)[0].position[KNEE]
    for _ in range(100):
        bench.send(np.ones(29), **more)
        bench.run(2)
    assert words in bench.device.log.last_refusal and bench.device.log.refused == 100
    assert bench.device.log.accepted == 0
    assert abs(bench.device.true_position[KNEE] - before) < 0.02


def test_the_last_command_is_held_for_ever() -> None:
    """No watchdog: 2 s after the last command the joints are still stiff."""
    bench = Bench()
    pose = np.array(DESCRIPTION.default_position)
    bench.send(pose)
    states = bench.run(2000)
    assert np.abs(states[-1].position - pose)[KNEE] < 0.05
    assert bench.device.log.to_json()["last_kind"] == "stiff"


def test_damping_lets_the_limbs_sink_slowly() -> None:
    """After damping: the efforts are those of damping, the raised arm falls, slower than when it is limp."""

    def fall(kd: float) -> tuple[float, list[G1Frame]]:
        bench = Bench()
        raised = np.array(DESCRIPTION.default_position)
        raised[[JOINTS_29.index(f"{side}_shoulder_pitch_joint") for side in ("left", "right")]] = -1.5
        for _ in range(600):
            bench.send(raised, 100.0, 5.0)
            bench.run(2)
        bench.send(raised, 0.0, kd)
        states = bench.run(400)
        return float(max(np.abs(s.velocity).max() for s in states)), states

    slow, states = fall(3.0)
    fast, _ = fall(0.1)
    shoulder = JOINTS_29.index("left_shoulder_pitch_joint")
    assert states[-1].position[shoulder] > states[5].position[shoulder] + 0.2
    assert slow < 4.0 and fast > 1.5 * slow
    for state in states[5:]:
        np.testing.assert_allclose(state.effort, -3.0 * state.velocity, atol=0.2)


def vendors_frames(start: FloatArray) -> Iterator[tuple[float, FloatArray, int]]:
    """Yield time, targets and mode_pr of g1_low_level_example.py of unitree_sdk2_python @ 37116c5, 2 ms each.

    3 s to zero, 3 s of swinging ankles as pitch and roll, then as parallel motors (mode_pr 1).
    """
    target = start.copy()
    for step in range(1, 3501):
        now = step * 0.002
        if now < 3.0:
            target = (1.0 - now / 3.0) * start
        else:
            target = target.copy()
            target[ANKLES] = np.pi / 6 * np.sin(2 * np.pi * (now - 3.0))
        yield now, target, 0 if now < 6.0 else 1


def test_the_vendors_example_swings_the_ankles() -> None:
    """Its first two stages are followed; the third, which is not emulated, is refused by name."""
    bench = Bench()
    start = bench.run(2)[0].position
    kp = np.array([60, 60, 60, 100, 40, 40] * 2 + [60, 40, 40] + [40] * 14, float)
    kd = np.array([1, 1, 1, 2, 1, 1] * 2 + [1] * 17, float)
    swing: list[float] = []
    for now, target, mode_pr in vendors_frames(start):
        bench.send(target, kp, kd, mode_pr=mode_pr)  # type: ignore[arg-type]
        state = bench.run(2)[0]
        if 4.0 < now < 6.0:
            swing.append(float(state.position[ANKLES[0]]))
    assert max(swing) > 0.35 and min(swing) < -0.35
    assert "mode_pr 1" in bench.device.log.last_refusal and bench.device.log.refused == 501
    assert bench.device.log.accepted == 2999


# Whole runs.


def _plan(faults: Mapping[str, Any]) -> G1FaultPlan:
    return G1FaultPlan(**faults)


def play(
    seconds: float,
    motion: str = "hold",
    kind: type[G1Robot] = G1Robot,
    truth: G1Truth | None = None,
    faults: Mapping[str, float] | None = None,
) -> tuple[LoopReport, G1Device]:
    """Run a motion with the driver on an emulated robot in virtual time."""
    name = kind.description.name
    clock = VirtualClock(10**9)
    device = G1Device(truth or nominal_truth(robot=name), plan=_plan(faults or {}))
    robot = kind(VirtualTopics(device, clock), clock, hung_on_crane=True)
    own: dict[str, Any] = {"motion": "excite", "excite": motion} if motion != "hold" else {"motion": motion}
    behaviour = make_behaviour(RunPlan(robot=name, seconds=seconds, **own), kind.description)
    config = LoopConfig(duration_s=seconds, passive=PassiveConfig(timeout_s=1.0))
    loop = ControlLoop(robot, behaviour, Safety(kind.description), clock, lambda _: True, config)
    return loop.run(), device


@pytest.mark.parametrize("kind", [G1Robot, pytest.param(G1Dof23Robot, marks=pytest.mark.slow)])
def test_a_collected_run_finishes_and_ends_damped(kind: type[G1Robot]) -> None:
    """A multisine of every joint with hidden parameters; not one command is refused."""
    truth = draw_truth("sensor", 3, robot=kind.description.name)
    report, device = play(7.0, "multisine", kind, truth)
    assert (report.outcome, report.passive_confirmed) == (Outcome.FINISHED, True)
    assert device.controller_name == "" and device.log.refused == 0
    assert [kind for _, _, kind in device.log.changes] == ["damping", "stiff", "damping"]
    assert report.clipped.get("predicted_effort", 0) < 0.25 * report.cycles_sent


@pytest.mark.parametrize(
    ("fault", "outcome", "words"),
    [
        ("hot", Outcome.TRIPPED, "winding"),
        ("error", Outcome.TRIPPED, "'left_knee_joint' reports error 0x2"),
        ("nan", Outcome.TRIPPED, "not finite"),
        ("machine", Outcome.TRIPPED, "mode_machine 9"),
        ("sport", Outcome.TRIPPED, "another program commands"),
        ("stop", Outcome.STOPPED, "L2+B"),
    ],
)
def test_each_fault_ends_in_damping(fault: str, outcome: Outcome, words: str) -> None:
    """The reason is named; the last command is damping, or its own controller has the robot."""
    report, device = play(1.0, faults={f"{fault}_after_s": 0.3})
    assert report.outcome is outcome and words in report.reason
    log = device.log.to_json()
    (record,) = log["faults"]
    if fault == "machine":
        # One control period of repeats still has the old one; the damping has that of the states.
        assert log["refused"] <= 12
    assert log["last_kind"] == "damping"
    assert record["first_damping_ms"] - record["begin_ms"] < 100


def test_a_frozen_robot_is_not_said_to_be_passive() -> None:
    """It still takes the damping, but does not confirm it."""
    report, device = play(1.0, faults={"freeze_after_s": 0.3})
    assert report.outcome is Outcome.TRIPPED and not report.passive_confirmed
    assert device.log.to_json()["last_kind"] == "damping"


# The truth.


def test_the_truth_has_the_names_of_the_parameter_sets() -> None:
    """29 and 23 joints, with and without bias; the nominal one is the nominal of the sets."""
    for robot, spaces in (("g1", SPACES), ("g1_23dof", SPACES_23)):
        values = nominal_truth(robot=robot).parameters()
        assert set(spaces["biased"]().names) == set(values)
        space = spaces["default"]()
        np.testing.assert_allclose([values[name] for name in space.names], space.nominal)
        drawn = draw_truth("realistic", 5, robot=robot)
        assert all(low < drawn.parameters()[p.name] < high for p, low, high in _ranges(space))
        assert G1Truth.from_json(drawn.to_json()) == drawn


def _ranges(space: Any) -> Iterator[tuple[Any, float, float]]:
    yield from zip(space, space.low, space.high, strict=True)


def test_a_truth_of_another_robot_is_refused() -> None:
    """Unknown names, a profile that does not exist, too few joints."""
    with pytest.raises(UnknownNameError, match="g2"):
        G1Truth.from_json({**nominal_truth().to_json(), "robot": "g2"})
    with pytest.raises(UnknownNameError, match="profile"):
        draw_truth("perfect", 0)
    with pytest.raises(ConfigurationError, match="29"):
        nominal_truth(stiffness=(1.0,))
    with pytest.raises(ConfigurationError, match="above 1"):
        draw_truth("ideal", 0, range_ratio=1.0)
    with pytest.raises(ConfigurationError, match="byte"):
        G1Device(nominal_truth(), mode_machine=256)
