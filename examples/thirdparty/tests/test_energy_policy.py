"""The policy: the law by itself, on simulated robots, and on the emulated device through the driver."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from deal_hw_bench_cartpole.description import DESCRIPTION, parameter_space
from deal_hw_bench_cartpole.device import Device, Truth, draw_truth
from deal_hw_bench_cartpole.energy_policy import Gains, write_energy_policy
from deal_hw_bench_cartpole.robot import BenchCartpole
from deal_hw_bench_cartpole.swing_up import SWING_UP, SwingUpEnv, SwingUpTask

from deal_hw.clock import VirtualClock
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.types import FloatArray, Status

FILE = Path(str(resources.files("deal_hw_bench_cartpole") / "assets" / "swing_up.onnx"))
POLICY = OnnxPolicy(FILE)
UPRIGHT = math.cos(0.3)


def actions(state: FloatArray) -> FloatArray:
    """Return the policy's actions, (B,), for states, (B, 4): cart, angle from upright, both speeds."""
    x, angle, v, w = state.T
    hanging = angle - math.pi
    seen = np.stack([x, np.sin(hanging), np.cos(hanging), v, w], axis=1).astype(np.float32)
    return np.asarray(POLICY.act_batch(seen)[:, 0])


def test_the_file_is_what_the_module_writes(tmp_path: Path) -> None:
    """The same spec and record, and the same actions."""
    write_energy_policy(tmp_path / "again.onnx")
    again = OnnxPolicy(tmp_path / "again.onnx")
    assert again.spec == POLICY.spec
    assert (tmp_path / "again.json").read_text() == FILE.with_suffix(".json").read_text()
    seen = np.random.default_rng(0).normal(size=(500, 5)).astype(np.float32)
    np.testing.assert_array_equal(again.act_batch(seen), POLICY.act_batch(seen))


def states(rng: np.random.Generator, low: float, high: float) -> FloatArray:
    """Return states (cart, angle from upright, both speeds), the cart between two places [m], (5000, 4)."""
    return rng.uniform([low, -4.0, -1.5, -15.0], [high, 4.0, 1.5, 15.0], (5000, 4))


def test_left_and_right_are_alike() -> None:
    """The mirrored state has the mirrored action, within single precision times the gains."""
    given = states(np.random.default_rng(1), -0.2, 0.2)
    np.testing.assert_allclose(actions(-given), -actions(given), atol=1e-3)


def test_no_force_acts_outwards_at_the_end() -> None:
    """Whatever the pole does, as long as the cart does not already come back."""
    given = states(np.random.default_rng(2), Gains().end_m, 0.2)
    given[:, 2] = np.abs(given[:, 2])
    assert actions(given).max() <= 1e-5
    assert actions(-given).min() >= -1e-5


def test_the_pole_is_pumped_and_held() -> None:
    """At rest 0.5 rad from hanging the pump is full; near upright the action is the feedback's sum."""
    given = np.array([[0.0, math.pi + 0.5, 0.0, 0.0], [0.02, 0.02, 0.01, -0.05]])
    # sin a cos a = -0.479 * -0.878 = 0.421, tanh(15 * 0.421) = 1.000, and energy is missing.
    # 2.4 * 0.02 + 14 sin 0.02 + 5.2 * 0.01 - 2.0 * 0.05 = 0.048 + 0.27998 + 0.052 - 0.1 = 0.27998
    np.testing.assert_allclose(actions(given), [1.0, 0.27998], atol=1e-3)


def distribution() -> ParameterDistribution:
    """Return what `deal-hw train bench_cartpole --udr` trains under."""
    return ParameterDistribution.uniform(
        parameter_space().with_ratio(SWING_UP.udr_ratio), SWING_UP.udr_latency_s
    )


def returns(policy: OnnxPolicy | None, seconds: float) -> tuple[FloatArray, FloatArray, int]:
    """Return returns and last cosines, (32,), of robots that began hanging, and how many left the track."""
    count, ticks = 32, round(seconds * DESCRIPTION.control_rate_hz)
    task = SwingUpTask(ticks=ticks + 1, hanging_share=1.0, end_position_m=0.19)
    env = SwingUpEnv(DESCRIPTION, distribution(), count, task=task)
    env.observe_for(POLICY.spec)
    seen, _ = env.reset(seed=4)
    total, left = np.zeros(count), 0
    for _ in range(ticks):
        action = np.zeros((count, 1)) if policy is None else policy.act_batch(seen)
        seen, reward, ended, _, _ = env.step(action)
        total, left = total + reward, left + int(ended.sum())
    return total, np.cos(env.loop.position[:, 1]), left


def test_simulated_robots_swing_up() -> None:
    """Masses, friction and latency are drawn; the task's reward prefers the policy to doing nothing."""
    total, height, left = returns(POLICY, 15.0)
    nothing, _, _ = returns(None, 3.0)
    assert (height > UPRIGHT).sum() >= 30
    assert left == 0
    assert total.min() > 100.0 and np.abs(nothing).max() < 1.0


@pytest.mark.parametrize("seed", [30, 31, 32])
def test_the_emulated_pole_is_swung_up_and_the_output_switched_off(seed: int) -> None:
    """Bytes in virtual time, on each firmware; at the end later firmware takes no command any more."""
    truth: Truth = draw_truth("realistic", seed, 2.0)
    clock, device = VirtualClock(), Device(truth)
    robot = BenchCartpole(VirtualTransport(device, clock), clock)
    robot.connect()
    robot.home(5.0)
    robot.arm(1.0)
    behaviour, positions = PolicyBehaviour(POLICY, DESCRIPTION), []
    for cycle in range(600):
        state = robot.read_state(1.0)
        robot.send_command(behaviour.command(state, cycle / 50))
        positions.append(device.position)
    x, angle = np.array(positions).T
    assert np.cos(angle[-100:]).min() > UPRIGHT
    assert np.abs(x).max() < 0.19
    robot.passive()
    while robot.read_state(1.0).status & Status.ARMED:
        pass
    assert device.mode == "idle"
