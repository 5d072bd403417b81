"""The emulated Go2 in virtual time: motion, commands, services, faults. Messages in, messages out."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import pytest

from deal_hw.drivers.go2 import topics
from deal_hw.drivers.go2.description import JOINTS
from deal_hw.drivers.go2.device import Go2Device
from deal_hw.drivers.go2.faults import MOMENTS, FaultPlan
from deal_hw.drivers.go2.protocol import (
    LowCommand,
    LowCommandEncoder,
    LowStateFrame,
    decode_low_command,
    decode_low_state,
)
from deal_hw.drivers.go2.remote import Remote, button_mask, decode_remote, decode_wireless
from deal_hw.drivers.go2.remote_script import RemoteMoment
from deal_hw.drivers.go2.rpc import Request, Response, decode_response, encode_request
from deal_hw.drivers.go2.sport_controller import LYING, STANDING
from deal_hw.drivers.go2.sport_state import decode_sport_state
from deal_hw.drivers.go2.suspended import DESCRIPTION as SUSPENDED
from deal_hw.drivers.go2.suspended import parameter_space
from deal_hw.drivers.go2.truth import draw_truth, nominal_truth
from deal_hw.sim.model import load_model, model_with
from deal_hw.types import FloatArray

ZERO = np.zeros(12)
CALF = JOINTS.index("FL_calf_joint")


def servo(position: FloatArray, stiffness: float = 60.0, damping: float = 5.0) -> LowCommand:
    """Return a command to hold a pose, with the gains of the SDK's example."""
    return LowCommand(position, ZERO, np.full(12, stiffness), np.full(12, damping), ZERO)


DAMP = servo(ZERO, 0.0, 3.0)
OFF = dataclasses.replace(DAMP, mode=np.zeros(12, np.int64))


class Bench:
    """A device and a client of it."""

    def __init__(self, **options: Any) -> None:
        truth = options.pop("truth", nominal_truth())
        self.device = Go2Device(truth, **{"sport": "", **options})
        self.encoder = LowCommandEncoder()
        self.out: list[tuple[str, bytes]] = []

    def run(self, milliseconds: int, command: LowCommand | None = None) -> list[LowStateFrame]:
        """Let time pass, sending a command every 2 ms; return the states that came."""
        payload = None if command is None else self.encoder.encode(command)
        self.out = []
        for tick in range(milliseconds):
            if payload is not None and tick % 2 == 0:
                self.device.receive(topics.LOW_COMMAND, payload)
            self.out += self.device.tick()
        return self.states()

    def ramp(self, target: FloatArray, milliseconds: int = 800) -> None:
        """Move to a pose along a straight line, as the SDK's example does."""
        start = self.device.true_position
        for tick in range(0, milliseconds, 2):
            share = (tick + 2) / milliseconds
            self.run(2, servo(start + share * (target - start)))

    def stand(self) -> None:
        """Stand up from the floor."""
        self.ramp(LYING)
        self.ramp(STANDING)
        self.run(300, servo(STANDING))

    def states(self) -> list[LowStateFrame]:
        """Return the states of the last run."""
        return [decode_low_state(payload) for topic, payload in self.out if topic == topics.LOW_STATE]

    def count(self, topic: str) -> int:
        """Return how many messages of a topic the last run brought."""
        return sum(1 for name, _ in self.out if name == topic)

    def call(self, service: str, api: int, parameter: object = None, **header: Any) -> Response | None:
        """Call a service; return its answer, which comes in the next tick."""
        request = Request(77_000_000_001, api, json.dumps(parameter or {}), **header)
        self.device.receive(topics.request(service), encode_request(request))
        answers = [payload for topic, payload in self.device.tick() if topic == topics.response(service)]
        assert len(answers) <= 1
        return decode_response(answers[0]) if answers else None

    def mode(self) -> str:
        """Return the name that CheckMode gives."""
        answer = self.call("motion_switcher", 1001)
        assert answer is not None
        assert answer.json()["form"] == "0"
        return str(answer.json()["name"])


def fast(states: Sequence[LowStateFrame]) -> float:
    """Return the root mean square of all joint speeds [rad/s]."""
    return float(np.sqrt(np.mean([np.square(state.velocity) for state in states])))


# Motion.


def test_it_stands_up_and_lies_down_again() -> None:
    """The SDK's poses with kp 60, kd 5 lift the base by a third of a metre, level, and lay it down again."""
    bench = Bench()
    assert bench.device.base_height < 0.08
    bench.stand()
    # Links of 0.213 m at 0.67 and -0.63 rad, a foot of 0.022 m: 0.213 * (0.784 + 0.808) + 0.022 = 0.361 m,
    # less what the springs give under 37 N a foot.
    assert 0.31 < bench.device.base_height < 0.361
    assert bench.device.tilt < 0.05
    feet = bench.run(2)[-1].foot_force
    assert feet.sum() == pytest.approx(15.2 * 9.81, rel=0.1)
    bench.ramp(LYING)
    assert bench.device.base_height < 0.15


def test_the_last_command_holds_for_ever() -> None:
    """Two seconds without a command leave a standing robot standing: there is no watchdog."""
    bench = Bench()
    bench.stand()
    height = bench.device.base_height
    bench.run(2000)
    assert bench.device.base_height == pytest.approx(height, abs=0.003)


@pytest.mark.parametrize("command", [DAMP, OFF], ids=["damping", "off"])
def test_damping_and_mode_0_let_it_sink(command: LowCommand) -> None:
    """A standing robot sinks to the floor under kd alone, and faster with its motors off."""
    bench = Bench(start="standing")
    bench.run(600, command)
    assert bench.device.base_height < (0.12 if command is OFF else 0.3)
    assert np.all(bench.states()[-1].values().mode == command.mode)


def test_before_the_first_command_the_motors_are_off() -> None:
    """At power-up without sport mode no drive gives anything, and its mode says so."""
    state = Bench().run(2)[-1].values()
    assert not state.effort.any()
    assert not state.mode.any()


def test_stop_values_turn_a_loop_off() -> None:
    """PosStopF and VelStopF, which the SDK writes to idle motors, command nothing whatever the gains."""
    stop = LowCommand(np.full(12, 2.146e9), np.full(12, 16000.0), np.full(12, 60.0), np.full(12, 5.0), ZERO)
    assert not Bench().run(10, stop)[-1].effort.any()


def test_suspended_the_legs_follow_and_the_base_stays() -> None:
    """In the air the joints reach the pose but for gravity's share, and nothing else moves."""
    bench = Bench(suspended=True)
    states = bench.run(1500, servo(STANDING))
    assert np.abs(states[-1].position - STANDING).max() < 0.08
    assert bench.device.base_height == 0.6
    assert np.allclose(states[-1].specific_force, (0.0, 0.0, 9.81), atol=1e-5)
    assert not states[-1].foot_force.any()


def test_an_imu_at_rest_feels_the_floor() -> None:
    """Lying still: +9.81 upwards, no rotation, a unit quaternion, roll and pitch near zero."""
    state = Bench().run(400)[-1].values()
    assert np.allclose(state.specific_force, (0.0, 0.0, 9.81), atol=0.05)
    assert np.allclose(state.angular_velocity, 0.0, atol=0.02)
    assert np.linalg.norm(state.orientation) == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(state.rpy[:2], 0.0, atol=0.01)


# The wire.


def test_rates_ticks_and_checksums() -> None:
    """A second brings 500 states whose ticks count 2 ms each, and the slower topics at their rates."""
    bench = Bench(sport="normal")
    states = bench.run(1000)
    assert [state.tick_ms for state in states] == list(range(0, 1000, 2))
    assert all(state.crc_checked for state in states)
    assert bench.count(topics.LOW_STATE_SLOW) == bench.count(topics.SPORT_STATE_SLOW) == 20
    assert bench.count(topics.SPORT_STATE) == 300
    assert bench.count(topics.WIRELESS) == 100


def test_the_clock_wraps_at_32_bits() -> None:
    """A tick of 2**32 - 2 ms is followed by 0."""
    states = Bench(tick_ms=2**32 - 2).run(4)
    assert [state.tick_ms for state in states] == [2**32 - 2, 0]


def test_the_sport_state_has_the_sdks_layout() -> None:
    """Sport mode's state comes with path points, the posture's number and the feet below the base."""
    bench = Bench(sport="ai", start="standing")
    bench.run(20)
    state = decode_sport_state([p for t, p in bench.out if t == topics.SPORT_STATE][-1])
    assert state.path is not None
    assert (state.mode, state.progress) == (6, 1.0)
    assert state.body_height == pytest.approx(bench.device.base_height, abs=0.01)
    assert np.all(state.foot_position[:, 2] < -0.25)
    assert state.foot_position[0, 0] > 0.1 > 0.0 > state.foot_position[2, 0]


def test_the_battery_delivers_what_the_motors_take() -> None:
    """Holding itself up costs the robot current; voltage and cells agree."""
    limp, standing = (Bench(start=start).run(300)[-1].values() for start in ("lying", "standing"))
    assert limp.current == pytest.approx(1.2, abs=0.01)
    after = standing
    assert after.current > 1.5
    assert after.battery_current_ma == -round(1e3 * after.current)
    assert np.count_nonzero(after.cell_voltage_mv) == 8
    assert 25.0 < after.voltage < after.cell_voltage_mv.sum() * 1e-3


@pytest.mark.parametrize("what", ["crc", "level", "length", "nan", "head"])
def test_bad_commands_are_not_obeyed(what: str) -> None:
    """Corrupt, short, foreign and absurd commands are counted and change nothing."""
    bench = Bench()
    good = bench.encoder.encode(servo(STANDING))
    bad = {
        "crc": good[:100] + bytes([good[100] ^ 1]) + good[101:],
        "level": bench.encoder.encode(dataclasses.replace(servo(STANDING), level=0xEE)),
        "length": good[4:],
        "nan": _with_nan(good),
        "head": good[:4] + b"\x00\x00" + good[6:],
    }[what]
    for _ in range(10):
        bench.device.receive(topics.LOW_COMMAND, bad)
        bench.run(2)
    assert bench.device.log.refused == 10
    assert bench.device.log.accepted == 0
    assert bench.device.log.last_refusal.startswith("LowCmd")
    assert not bench.states()[-1].effort.any()


def _with_nan(payload: bytes) -> bytes:
    from deal_hw.drivers.go2.wire import low_command_image, words_crc

    changed = bytearray(payload)
    changed[28:32] = np.float32(np.nan).tobytes()
    changed[808:] = words_crc(low_command_image(bytes(changed))).to_bytes(4, "little")
    return bytes(changed)


def test_a_request_that_is_none_is_ignored() -> None:
    """Garbage on a request topic brings no answer and no harm."""
    bench = Bench()
    bench.device.receive(topics.request("sport"), b"\x00\x01\x00\x00nonsense")
    bench.device.receive("rt/unknown", b"")
    bench.run(2)
    assert bench.device.report()["bad_requests"] == 1


# Services.


def test_the_sdks_release_sequence() -> None:
    """CheckMode, StandDown, ReleaseMode until the name is empty; then sport mode is gone and silent."""
    bench = Bench(sport="ai", start="standing")
    assert bench.mode() == "ai"
    assert bench.call("sport", 1005) == Response(77_000_000_001, 1005)
    assert bench.call("motion_switcher", 1003) == Response(77_000_000_001, 1003)
    assert bench.mode() == "ai"
    bench.run(1600)
    assert bench.mode() == ""
    assert bench.device.base_height < 0.15
    bench.run(100)
    assert bench.count(topics.SPORT_STATE) == bench.count(topics.LOW_COMMAND) == 0
    assert bench.call("sport", 1004) is None


@pytest.mark.parametrize("start", ["lying", "standing"])
def test_the_sdks_release_loop_ends(start: str) -> None:
    """Its loop asks for StandDown and ReleaseMode every second while a name is there: three turns suffice."""
    bench = Bench(sport="normal", start=start)
    turns = 0
    while bench.mode() and turns < 10:
        bench.call("sport", 1005)
        bench.call("motion_switcher", 1003)
        bench.run(1000)
        turns += 1
    assert turns <= 3
    assert bench.device.base_height < 0.15


def test_postures_of_sport_mode() -> None:
    """StandUp lifts it, Damp lets it sink, RecoveryStand lifts it again, StandDown lays it down."""
    bench = Bench(sport="normal")
    heights = []
    for api, wait_ms in ((1004, 1600), (1001, 1500), (1006, 2600), (1002, 100), (1005, 2000)):
        answer = bench.call("sport", api)
        assert answer is not None
        assert answer.code == 0
        bench.run(wait_ms)
        heights.append(bench.device.base_height)
    up, damped, recovered, balanced, down = heights
    assert min(up, recovered, balanced) > 0.31
    assert damped < 0.15
    assert down < 0.15


def test_a_move_is_answered_and_not_walked() -> None:
    """Move and StopMove return 0; the robot stays where it is."""
    bench = Bench(sport="normal", start="standing")
    before = bench.device.base_position[0]
    answer = bench.call("sport", 1008, {"x": 0.5, "y": 0.0, "z": 0.1})
    assert answer is not None
    assert answer.code == 0
    bench.run(300)
    assert abs(bench.device.base_position[0] - before) < 0.01
    assert bench.call("sport", 1003) == Response(77_000_000_001, 1003)


@pytest.mark.parametrize(
    ("service", "api", "parameter", "code"),
    [
        ("motion_switcher", 4711, {}, 3203),
        ("sport", 1030, {}, 3203),
        ("sport", 1008, {"x": 1.0}, 3204),
        ("sport", 1008, {"x": float("nan"), "y": 0.0, "z": 0.0}, 3204),
        ("motion_switcher", 1002, {"name": "gallop"}, 7004),
        ("motion_switcher", 1002, {"name": "ai"}, 7002),
        ("motion_switcher", 1002, {"name": "normal"}, 0),
        ("robot_state", 1001, {"name": "tea_kitchen", "switch": 1}, 3204),
        ("motion_switcher", 1, {}, 0),
    ],
)
def test_codes_of_answers(service: str, api: int, parameter: dict[str, Any], code: int) -> None:
    """Unknown functions, bad parameters and wrong names have the vendor's error codes."""
    answer = Bench(sport="normal").call(service, api, parameter)
    assert answer == Response(77_000_000_001, api, code, answer.data if answer else "")


def test_no_reply_is_no_reply() -> None:
    """A request that wants no answer is obeyed in silence."""
    bench = Bench(sport="normal")
    assert bench.call("motion_switcher", 1003, no_reply=True) is None
    bench.run(320)
    assert bench.mode() == ""


def test_select_mode_brings_sport_mode_back() -> None:
    """SelectMode after a release, also by the service's name, stands the robot up."""
    bench = Bench()
    answer = bench.call("motion_switcher", 1002, {"name": "ai_sport"})
    assert answer is not None
    assert answer.code == 0
    assert bench.mode() == "ai"
    bench.run(1600)
    assert bench.device.base_height > 0.31


def test_the_older_service_switch() -> None:
    """robot_state lists services (0: active), switches sport_mode off and on, and protects itself."""
    bench = Bench(sport="normal")

    def status() -> dict[str, int]:
        answer = bench.call("robot_state", 1003)
        assert answer is not None
        return {entry["name"]: entry["status"] for entry in json.loads(answer.data)}

    assert status()["sport_mode"] == 0
    assert status()["ai_sport"] == 1
    assert bench.call("robot_state", 1001, {"name": "sport_mode", "switch": 0}) is not None
    bench.run(320)
    assert bench.mode() == ""
    assert status()["sport_mode"] == 1
    bench.call("robot_state", 1001, {"name": "sport_mode", "switch": 1})
    assert bench.mode() == "normal"
    answer = bench.call("robot_state", 1001, {"name": "robot_state", "switch": 0})
    assert answer is not None
    assert answer.json()["status"] == 5


def test_sport_mode_fights_until_it_is_released() -> None:
    """A user who lays the robot down against sport mode shakes it; after the release it obeys."""
    bench = Bench(sport="normal", start="standing")
    calm = fast(bench.run(300))
    fight = fast(bench.run(400, servo(LYING)))
    assert fight > 20 * calm
    assert fight > 0.5
    assert bench.device.base_height > 0.15
    bench.call("motion_switcher", 1003)
    bench.run(1500, servo(LYING))
    assert bench.device.base_height < 0.15
    assert fast(bench.run(200, servo(LYING))) < 0.1 * fight


def test_sport_modes_commands_are_seen_on_the_wire() -> None:
    """While it is active its commands come over rt/lowcmd at 500 Hz, valid ones; told to hide, none."""
    bench = Bench(sport="normal", start="standing")
    bench.run(100)
    assert bench.count(topics.LOW_COMMAND) == 50
    command = decode_low_command([p for t, p in bench.out if t == topics.LOW_COMMAND][-1])
    assert np.allclose(command.position, STANDING, atol=1e-6)
    hidden = Bench(sport="normal", start="standing", sport_on_wire=False)
    hidden.run(100)
    assert hidden.count(topics.LOW_COMMAND) == 0


# Hidden truth.


def test_a_command_acts_after_the_hidden_latency() -> None:
    """With 4 ms, a command that came before tick 0 shows in the state of tick 4 and not in that of tick 2."""
    bench = Bench(truth=nominal_truth(latency_ms=4))
    bench.device.receive(topics.LOW_COMMAND, bench.encoder.encode(servo(STANDING)))
    efforts = [bool(state.effort.any()) for state in bench.run(6)]
    assert efforts == [False, False, True]


def test_hidden_gains_decide_the_effort() -> None:
    """Half the stiffness gives 0.5 * 10 * 0.2 = 1.0 N·m at 0.2 rad; feed-forward acts as told."""
    bench = Bench(truth=nominal_truth(stiffness=(0.5,) * 12), suspended=True)
    q = bench.device.true_position
    state = bench.run(1, servo(q + 0.2, 10.0, 0.0))[0]
    assert np.allclose(state.effort, 1.0, atol=1e-6)
    fed = dataclasses.replace(servo(q, 0.0, 0.0), effort=np.full(12, 0.7))
    assert np.allclose(Bench(suspended=True).run(1, fed)[0].effort, 0.7, atol=1e-6)


def test_the_hidden_encoder_bias_is_reported_and_servoed_on() -> None:
    """Reported minus true is the bias, and a stiff drive brings the reported position to the target."""
    bias = tuple(0.01 * (i - 6) for i in range(12))
    bench = Bench(truth=nominal_truth(encoder_bias=bias), suspended=True)
    state = bench.run(1500, servo(STANDING, 300.0))[-1]
    assert np.abs(state.position - STANDING).max() < 0.02
    assert np.allclose(state.position - bench.device.true_position, bias, atol=2e-3)


@pytest.mark.parametrize("what", ["stiffness", "damping", "joint_damping", "frictionloss", "armature"])
def test_hidden_parameters_change_the_motion(what: str) -> None:
    """Each hidden quantity, doubled, changes a step response by more than a milliradian."""
    paths = []
    for factor in (1.0, 2.0):
        nominal = nominal_truth()
        changed = dataclasses.replace(nominal, **{what: tuple(factor * v for v in getattr(nominal, what))})
        bench = Bench(truth=changed, suspended=True)
        paths.append(np.array([s.position for s in bench.run(300, servo(STANDING, 20.0, 1.5))]))
    assert np.abs(paths[0] - paths[1]).max() > 1e-3


def test_the_ideal_emulator_is_the_calibrators_model() -> None:
    """With the true parameters in it, the engine at 1 ms repeats the emulated motion to a microradian."""
    truth = draw_truth("ideal", 1)
    bench = Bench(truth=truth, suspended=True)
    bench.run(1500, servo(STANDING, 20.0, 1.5))
    start, speed = bench.device.true_position, bench.run(1)[-1].velocity
    robot = load_model(SUSPENDED, step_s=1e-3)
    space = parameter_space()
    known = truth.parameters(20.0, 1.5)
    model = model_with(robot, space, np.array([known[name] for name in space.names]))
    data = mujoco.MjData(model)
    bench = Bench(truth=truth, suspended=True)
    bench.run(1500, servo(STANDING, 20.0, 1.5))
    data.qpos[:], data.qvel[:] = start, speed
    for step in range(400):
        target = STANDING + 0.3 * np.sin(0.02 * (step // 20 * 20) * np.arange(1.0, 13.0))
        data.ctrl[:] = target
        bench.run(1, servo(target, 20.0, 1.5))
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() > 0.5
    assert np.abs(bench.device.true_position - data.qpos).max() < 1e-6


def test_gains_that_a_real_drive_takes_do_not_shake_it() -> None:
    """Kd 20 on the lightest joints that can be drawn is damping, not an oscillation of the integrator."""
    truth = nominal_truth(armature=(0.002,) * 12)
    bench = Bench(truth=truth, suspended=True)
    bench.ramp(STANDING)
    assert fast(bench.run(1200, servo(STANDING, 100.0, 20.0))[550:]) < 0.01


def test_a_seed_decides_everything() -> None:
    """The same seed gives the same bytes, another seed others, in the noisiest profile."""
    runs = []
    for seed in (3, 3, 4):
        bench = Bench(truth=draw_truth("realistic", seed), suspended=True)
        bench.run(200, servo(STANDING))
        runs.append(bench.out)
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


def test_profiles_differ_in_noise_alone_where_nothing_moves() -> None:
    """At rest "ideal" repeats itself to the bit, "sensor" does not; both have whole encoder steps or none."""
    ideal = Bench(truth=nominal_truth("ideal"), suspended=True)
    noisy = Bench(truth=nominal_truth("sensor"), suspended=True)
    assert np.std([s.velocity[0] for s in ideal.run(300)]) < np.std([s.velocity[0] for s in noisy.run(300)])
    steps = noisy.states()[-1].position / (2 * np.pi / 32768)
    assert np.allclose(steps, np.rint(steps), atol=2e-3)


# Faults.


def faulty(name: str, **options: Any) -> Bench:
    """Return a bench whose robot stands, 100 ms after a fault began under stiff commands."""
    plan = FaultPlan(**{f"{name}_after_s": 0.1}, **options)
    bench = Bench(start="standing", plan=plan)
    bench.run(100, servo(STANDING))
    assert not bench.device.log.faults
    bench.run(100, servo(STANDING))
    assert [fault.name for fault in bench.device.log.faults] == [name]
    assert bench.device.log.faults[0].begin_ms == 100
    return bench


def test_freeze_says_nothing_and_still_hears() -> None:
    """A frozen robot sends nothing, not even answers, and takes the damping command."""
    bench = faulty("freeze")
    assert bench.out == []
    assert bench.call("motion_switcher", 1001) is None
    bench.run(10, DAMP)
    assert bench.device.log.faults[0].first_damping_ms == 201


def test_stale_repeats_the_same_bytes() -> None:
    """The same state comes 500 times a second; the robot itself goes on."""
    bench = faulty("stale")
    payloads = [payload for topic, payload in bench.out if topic == topics.LOW_STATE]
    assert len(payloads) == 50
    assert len(set(payloads)) == 1
    bench.run(600, OFF)
    assert bench.device.base_height < 0.15


def test_a_lost_motor_gives_nothing_and_counts() -> None:
    """Its effort is 0, its counter grows by one a state, the others work."""
    bench = faulty("lost", lost_joint="RR_thigh_joint")
    lost = JOINTS.index("RR_thigh_joint")
    states = bench.states()
    assert states[-1].lost[lost] - states[0].lost[lost] == len(states) - 1
    assert np.count_nonzero(states[-1].lost) == 1
    assert states[-1].effort[lost] == 0.0
    assert np.count_nonzero(states[-1].effort) == 11


def test_sport_mode_returns() -> None:
    """CheckMode names it again, its commands are on the wire, and it fights damping."""
    bench = faulty("sport")
    assert bench.device.sport_name == "normal"
    assert bench.count(topics.LOW_COMMAND) > 0
    bench.run(500, DAMP)
    assert bench.device.base_height > 0.2


def test_low_battery_nan_and_heat_are_reported() -> None:
    """4 % and a lower voltage; NaN in one joint alone; 95 °C in one motor alone."""
    state = faulty("battery").states()[-1]
    assert state.battery_percent <= 4
    assert state.voltage < 27.0
    state = faulty("nan").states()[-1]
    assert np.flatnonzero(np.isnan(state.position)).tolist() == [CALF]
    assert np.flatnonzero(np.isnan(state.velocity)).tolist() == [CALF]
    state = faulty("hot").states()[-1]
    assert np.flatnonzero(state.temperature == 95).tolist() == [CALF]


def test_the_operator_stops() -> None:
    """L2 and B are held in the state's 40 bytes and in WirelessController."""
    bench = faulty("stop")
    mask = button_mask(["L2", "B"])
    remote = decode_remote(bench.states()[-1].remote)
    assert remote is not None
    assert remote.holds(mask)
    assert decode_wireless([p for t, p in bench.out if t == topics.WIRELESS][-1]).holds(mask)


def test_a_push_moves_the_base() -> None:
    """25 N·s to the left in 0.1 s throw 15 kg at about 1.6 m/s: 80 mm by then, less what the legs resist."""
    bench = faulty("push")
    assert 0.02 < bench.device.base_position[1] < 0.085


def test_shares_of_states() -> None:
    """A tenth of 1000 states each: lost, doubled, late and corrupt ones come in about that number."""
    plan = FaultPlan(drop=0.1, duplicate=0.1, reorder=0.1, corrupt=0.1)
    bench = Bench(plan=plan, suspended=True)
    bench.out = [message for _ in range(2000) for message in bench.device.tick()]
    counts = bench.device.report()["wire_faults"]
    assert all(60 < count < 140 for count in counts.values())
    assert bench.count(topics.LOW_STATE) == pytest.approx(1000 - counts["drop"] + counts["duplicate"], abs=15)
    ticks = [int.from_bytes(p[1100:1104], "little") for t, p in bench.out if t == topics.LOW_STATE]
    assert sum(1 for a, b in itertools.pairwise(ticks) if b < a) > 30


def test_shares_can_begin_later() -> None:
    """With wire_after_s every state comes until then and none after."""
    bench = Bench(start="standing", plan=FaultPlan(drop=1.0, wire_after_s=0.1))
    assert len(bench.run(100, servo(STANDING))) == 50
    assert bench.run(100, servo(STANDING)) == []


def test_the_log_gives_the_time_to_damping() -> None:
    """Fault at 100 ms, last stiff command at 118, damping from 120 ms on: 20 ms."""
    bench = Bench(start="standing", plan=FaultPlan(hot_after_s=0.1))
    bench.run(120, servo(STANDING))
    bench.run(50, DAMP)
    log = bench.device.report()["commands"]
    (fault,) = log["faults"]
    assert (fault["begin_ms"], fault["last_stiff_ms"], fault["first_damping_ms"]) == (100, 118, 120)
    assert [(at, kind) for at, _, kind in log["changes"]] == [(0, "stiff"), (120, "damping")]
    assert log["largest_gap_ms"] == 2
    assert json.loads(json.dumps(bench.device.report()))["commands"]["last_kind"] == "damping"


def test_faults_wait_for_the_first_stiff_command() -> None:
    """Damping does not start the clock of a plan."""
    bench = Bench(plan=FaultPlan(hot_after_s=0.0))
    bench.run(50, DAMP)
    assert not bench.device.log.faults
    bench.run(2, servo(LYING))
    assert [fault.name for fault in bench.device.log.faults] == ["hot"]


@pytest.mark.parametrize("name", MOMENTS)
def test_each_fault_begins_at_once_when_asked(name: str) -> None:
    """A test may begin any fault itself."""
    bench = Bench(suspended=True)
    bench.device.begin_fault(name)
    bench.device.tick()
    assert bench.device.log.faults[0].name == name


def test_an_unknown_fault_is_refused() -> None:
    """A name that is no fault is an error."""
    with pytest.raises(ValueError, match="no such fault: 'rain'"):
        Bench(suspended=True).device.begin_fault("rain")


def test_the_remote_follows_its_script() -> None:
    """A stick moves at 20 ms, the remote goes out of reach at 40 ms; without one the bytes are zeros."""
    script = (RemoteMoment(20, Remote(left_y=0.5)), RemoteMoment(40, None))
    states = Bench(suspended=True, remote=script).run(60)
    seen = [decode_remote(state.remote) for state in states]
    assert seen[5] == Remote()
    assert seen[15] == Remote(left_y=0.5)
    assert seen[25] is None
    assert Bench(suspended=True, remote=None).run(2)[-1].remote == bytes(40)
