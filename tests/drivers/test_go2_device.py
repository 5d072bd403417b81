"""The emulated Go2 in virtual time: motion, messages, hidden truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import pytest

from deal_hw.drivers.go2.descriptions.on_stand_recording import DESCRIPTION as RECORDED
from deal_hw.drivers.go2.descriptions.on_stand_recording import parameter_space
from deal_hw.drivers.go2.emulator.sport_controller import LYING, STANDING
from deal_hw.drivers.go2.emulator.truth import draw_truth, nominal_truth
from deal_hw.drivers.go2.messages.low_command import LowCommand
from deal_hw.drivers.go2.messages.sport_state import decode_sport_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.sim.engine.model import load_model, model_with
from deal_hw.types import FloatArray

ZERO = np.zeros(12)


def servo(position: FloatArray, stiffness: float = 60.0, damping: float = 5.0) -> LowCommand:
    """Return a command to hold a pose, with the gains of the SDK's example."""
    return LowCommand(position, ZERO, np.full(12, stiffness), np.full(12, damping), ZERO)


DAMP = servo(ZERO, 0.0, 3.0)
OFF = dataclasses.replace(DAMP, mode=np.zeros(12, np.int64))


def fast(states: Sequence[LowStateFrame]) -> float:
    """Return the root mean square of all joint speeds [rad/s]."""
    return float(np.sqrt(np.mean([np.square(state.velocity) for state in states])))


def test_it_stands_up_and_lies_down_again(make_go2: Any) -> None:
    """The SDK's poses with kp 60, kd 5 lift the base by a third of a metre, level, and lay it down again."""
    bench = make_go2()
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


def test_the_last_command_holds_for_ever(make_go2: Any) -> None:
    """Two seconds without a command leave a standing robot standing: there is no watchdog."""
    bench = make_go2()
    bench.stand()
    height = bench.device.base_height
    bench.run(2000)
    assert bench.device.base_height == pytest.approx(height, abs=0.003)


@pytest.mark.parametrize("command", [DAMP, OFF], ids=["damping", "off"])
def test_damping_and_mode_0_let_it_sink(make_go2: Any, command: LowCommand) -> None:
    """A standing robot sinks to the floor under kd alone, and faster with its motors off."""
    bench = make_go2(start="standing")
    bench.run(600, command)
    assert bench.device.base_height < (0.12 if command is OFF else 0.3)
    assert np.all(bench.states()[-1].values().mode == command.mode)


def test_before_the_first_command_the_motors_are_off(make_go2: Any) -> None:
    """At power-up without sport mode no motor gives anything, and its mode says so."""
    state = make_go2().run(2)[-1].values()
    assert not state.effort.any()
    assert not state.mode.any()


def test_stop_values_turn_a_loop_off(make_go2: Any) -> None:
    """PosStopF and VelStopF, which the SDK writes to idle motors, command nothing whatever the gains."""
    stop = LowCommand(np.full(12, 2.146e9), np.full(12, 16000.0), np.full(12, 60.0), np.full(12, 5.0), ZERO)
    assert not make_go2().run(10, stop)[-1].effort.any()


def test_suspended_the_legs_follow_and_the_base_stays(make_go2: Any) -> None:
    """In the air the joints reach the pose but for gravity's share, and nothing else moves."""
    bench = make_go2(on_stand=True)
    states = bench.run(1500, servo(STANDING))
    assert np.abs(states[-1].position - STANDING).max() < 0.08
    assert bench.device.base_height == 0.6
    assert np.allclose(states[-1].specific_force, (0.0, 0.0, 9.81), atol=1e-5)
    assert not states[-1].foot_force.any()


def test_an_imu_at_rest_feels_the_floor(make_go2: Any) -> None:
    """Lying still: +9.81 upwards, no rotation, a unit quaternion, roll and pitch near zero."""
    state = make_go2().run(400)[-1].values()
    assert np.allclose(state.specific_force, (0.0, 0.0, 9.81), atol=0.05)
    assert np.allclose(state.angular_velocity, 0.0, atol=0.02)
    assert np.linalg.norm(state.orientation) == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(state.rpy[:2], 0.0, atol=0.01)


# The wire.


def test_rates_ticks_and_checksums(make_go2: Any) -> None:
    """A second brings 500 states whose ticks count 2 ms each, and the slower topics at their rates."""
    bench = make_go2(sport="normal")
    states = bench.run(1000)
    assert [state.tick_ms for state in states] == list(range(0, 1000, 2))
    assert all(state.crc_checked for state in states)
    assert bench.count(topics.LOW_STATE_SLOW) == bench.count(topics.SPORT_STATE_SLOW) == 20
    assert bench.count(topics.SPORT_STATE) == 300
    assert bench.count(topics.WIRELESS) == 100


def test_the_clock_wraps_at_32_bits(make_go2: Any) -> None:
    """A tick of 2**32 - 2 ms is followed by 0."""
    states = make_go2(tick_ms=2**32 - 2).run(4)
    assert [state.tick_ms for state in states] == [2**32 - 2, 0]


def test_the_sport_state_has_the_sdks_layout(make_go2: Any) -> None:
    """Sport mode's state comes with path points, the posture's number and the feet below the base."""
    bench = make_go2(sport="ai", start="standing")
    bench.run(20)
    state = decode_sport_state([p for t, p in bench.out if t == topics.SPORT_STATE][-1])
    assert state.path is not None
    assert (state.mode, state.progress) == (6, 1.0)
    assert state.body_height == pytest.approx(bench.device.base_height, abs=0.01)
    assert np.all(state.foot_position[:, 2] < -0.25)
    assert state.foot_position[0, 0] > 0.1 > 0.0 > state.foot_position[2, 0]


def test_the_battery_delivers_what_the_motors_take(make_go2: Any) -> None:
    """Holding itself up costs the robot current; voltage and cells agree."""
    limp, standing = (make_go2(start=start).run(300)[-1].values() for start in ("lying", "standing"))
    assert limp.current == pytest.approx(1.2, abs=0.01)
    after = standing
    assert after.current > 1.5
    assert after.battery_current_ma == -round(1e3 * after.current)
    assert np.count_nonzero(after.cell_voltage_mv) == 8
    assert 25.0 < after.voltage < after.cell_voltage_mv.sum() * 1e-3


@pytest.mark.parametrize("what", ["crc", "level", "length", "nan", "head"])
def test_bad_commands_are_not_obeyed(make_go2: Any, what: str) -> None:
    """Corrupt, short, foreign and absurd commands are counted and change nothing."""
    bench = make_go2()
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
    from deal_hw.drivers.unitree.cdr import words_crc
    from deal_hw.drivers.unitree.go_messages.frames import low_command_image

    changed = bytearray(payload)
    changed[28:32] = np.float32(np.nan).tobytes()
    changed[808:] = words_crc(low_command_image(bytes(changed))).to_bytes(4, "little")
    return bytes(changed)


def test_a_request_that_is_none_is_ignored(make_go2: Any) -> None:
    """Garbage on a request topic brings no answer and no harm."""
    bench = make_go2()
    bench.device.receive(topics.request("sport"), b"\x00\x01\x00\x00nonsense")
    bench.device.receive("rt/unknown", b"")
    bench.run(2)
    assert bench.device.report()["bad_requests"] == 1


# Hidden truth.


def test_a_command_acts_after_the_hidden_latency(make_go2: Any) -> None:
    """With 4 ms, a command that came before tick 0 shows in the state of tick 4 and not in that of tick 2."""
    bench = make_go2(truth=nominal_truth(latency_ms=4))
    bench.device.receive(topics.LOW_COMMAND, bench.encoder.encode(servo(STANDING)))
    efforts = [bool(state.effort.any()) for state in bench.run(6)]
    assert efforts == [False, False, True]


def test_hidden_gains_decide_the_effort(make_go2: Any) -> None:
    """Half the stiffness gives 0.5 * 10 * 0.2 = 1.0 N·m at 0.2 rad; feed-forward acts as commanded."""
    bench = make_go2(truth=nominal_truth(stiffness=(0.5,) * 12), on_stand=True)
    q = bench.device.true_position
    state = bench.run(1, servo(q + 0.2, 10.0, 0.0))[0]
    assert np.allclose(state.effort, 1.0, atol=1e-6)
    fed = dataclasses.replace(servo(q, 0.0, 0.0), effort=np.full(12, 0.7))
    assert np.allclose(make_go2(on_stand=True).run(1, fed)[0].effort, 0.7, atol=1e-6)


def test_the_hidden_encoder_bias_is_reported_and_servoed_on(make_go2: Any) -> None:
    """Reported minus true is the bias, and a stiff motor brings the reported position to the target."""
    bias = tuple(0.01 * (i - 6) for i in range(12))
    bench = make_go2(truth=nominal_truth(encoder_bias=bias), on_stand=True)
    state = bench.run(1500, servo(STANDING, 300.0))[-1]
    assert np.abs(state.position - STANDING).max() < 0.02
    assert np.allclose(state.position - bench.device.true_position, bias, atol=2e-3)


@pytest.mark.parametrize("what", ["stiffness", "damping", "joint_damping", "frictionloss", "armature"])
def test_hidden_parameters_change_the_motion(make_go2: Any, what: str) -> None:
    """Each hidden quantity, doubled, changes a step response by more than a milliradian."""
    paths = []
    for factor in (1.0, 2.0):
        nominal = nominal_truth()
        scaled: Any = {what: tuple(factor * v for v in getattr(nominal, what))}
        changed = dataclasses.replace(nominal, **scaled)
        bench = make_go2(truth=changed, on_stand=True)
        paths.append(np.array([s.position for s in bench.run(300, servo(STANDING, 20.0, 1.5))]))
    assert np.abs(paths[0] - paths[1]).max() > 1e-3


def test_the_ideal_emulator_is_the_calibrators_model(make_go2: Any) -> None:
    """With the true parameters in it, the engine at 1 ms repeats the emulated motion to a microradian."""
    truth = draw_truth("ideal", 1)
    bench = make_go2(truth=truth, on_stand=True)
    bench.run(1500, servo(STANDING, 20.0, 1.5))
    start, speed = bench.device.true_position, bench.run(1)[-1].velocity
    robot = load_model(RECORDED, step_s=1e-3)
    space = parameter_space()
    known = truth.parameters(20.0, 1.5)
    model = model_with(robot, space, np.array([known[name] for name in space.names]))
    data = mujoco.MjData(model)
    bench = make_go2(truth=truth, on_stand=True)
    bench.run(1500, servo(STANDING, 20.0, 1.5))
    data.qpos[:], data.qvel[:] = start, speed
    for step in range(400):
        target = STANDING + 0.3 * np.sin(0.02 * (step // 20 * 20) * np.arange(1.0, 13.0))
        data.ctrl[:] = target
        bench.run(1, servo(target, 20.0, 1.5))
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() > 0.5
    assert np.abs(bench.device.true_position - data.qpos).max() < 1e-6


def test_gains_that_a_real_drive_takes_do_not_shake_it(make_go2: Any) -> None:
    """Kd 20 on the lightest joints that can be drawn is damping, not an oscillation of the integrator."""
    truth = nominal_truth(armature=(0.002,) * 12)
    bench = make_go2(truth=truth, on_stand=True)
    bench.ramp(STANDING)
    assert fast(bench.run(1200, servo(STANDING, 100.0, 20.0))[550:]) < 0.01


def test_a_seed_decides_everything(make_go2: Any) -> None:
    """The same seed gives the same bytes, another seed others, in the noisiest profile."""
    runs = []
    for seed in (3, 3, 4):
        bench = make_go2(truth=draw_truth("realistic", seed), on_stand=True)
        bench.run(200, servo(STANDING))
        runs.append(bench.out)
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


def test_profiles_differ_in_noise_alone_where_nothing_moves(make_go2: Any) -> None:
    """At rest "ideal" repeats itself to the bit, "sensor" does not; both have whole encoder steps or none."""
    ideal = make_go2(truth=nominal_truth("ideal"), on_stand=True)
    noisy = make_go2(truth=nominal_truth("sensor"), on_stand=True)
    assert np.std([s.velocity[0] for s in ideal.run(300)]) < np.std([s.velocity[0] for s in noisy.run(300)])
    steps = noisy.states()[-1].position / (2 * np.pi / 32768)
    assert np.allclose(steps, np.rint(steps), atol=2e-3)
