"""The emulated Go2's motors, its hidden truth and the shares of spoilt states, each by itself."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.drivers.go2.descriptions.floor import JOINTS
from deal_hw.drivers.go2.descriptions.on_stand_recording import biased_space
from deal_hw.drivers.go2.emulator.faults import FaultPlan
from deal_hw.drivers.go2.emulator.motors import Motors
from deal_hw.drivers.go2.emulator.remote_script import RemoteMoment, read_remote_script
from deal_hw.drivers.go2.emulator.truth import PROFILES, Go2Truth, draw_truth, nominal_truth
from deal_hw.drivers.go2.messages.low_command import LowCommand
from deal_hw.drivers.unitree.command_log import kind_of
from deal_hw.drivers.unitree.emulated_faults import SHARES, StateFaults
from deal_hw.drivers.unitree.emulated_motors import AMBIENT_C
from deal_hw.drivers.unitree.remote import Remote, button_mask
from deal_hw.errors import ConfigurationError, UnknownNameError

ZERO = np.zeros(12)


def command(
    stiffness: float = 0.0, damping: float = 0.0, effort: float = 0.0, target: float = 0.0
) -> LowCommand:
    """Return the same command for all joints."""
    return LowCommand(
        np.full(12, target), ZERO, np.full(12, stiffness), np.full(12, damping), np.full(12, effort)
    )


def test_effort_is_p_d_with_feed_forward() -> None:
    """40 * (0.3 - 0.1) - 2 * 1.5 + 0.5 = 5.5 N·m."""
    motors = Motors(nominal_truth(), PROFILES["ideal"])
    motors.accept(command(40.0, 2.0, 0.5, 0.3))
    motors.update(np.full(12, 0.1), np.full(12, 1.5))
    assert np.allclose(motors.effort, 5.5)
    assert np.allclose(motors.constant, 8.5)
    assert np.allclose(motors.brake, 2.0)


def test_effort_is_limited_by_part() -> None:
    """Hips and thighs stop at 23.7 N·m, calves at 45.43, either way."""
    motors = Motors(nominal_truth(), PROFILES["ideal"])
    motors.accept(command(effort=100.0))
    motors.update(ZERO, ZERO)
    assert motors.effort.reshape(4, 3).tolist() == [[23.7, 23.7, 45.43]] * 4
    motors.accept(command(effort=-100.0, damping=3.0))
    motors.update(ZERO, ZERO)
    assert motors.constant.reshape(4, 3).tolist() == [[-23.7, -23.7, -45.43]] * 4
    assert not motors.brake.any()


@pytest.mark.parametrize(
    ("share", "effort"),
    # Full torque up to 0.6 of the no-load speed of 30.1 rad/s; at 0.8 half of it is left; beyond 1 none.
    [(0.0, 23.7), (0.6, 23.7), (0.8, 11.85), (1.0, 0.0), (1.2, 0.0), (-1.0, 23.7)],
)
def test_the_torque_speed_limit_spares_braking(share: float, effort: float) -> None:
    """A realistic motor weakens towards its no-load speed, and brakes with all it has."""
    motors = Motors(nominal_truth(), PROFILES["realistic"])
    motors.accept(command(effort=100.0))
    motors.update(ZERO, np.full(12, share * 30.1))
    assert motors.effort[0] == pytest.approx(effort)


def test_motors_warm_up_towards_the_square_of_the_torque() -> None:
    """10 N·m end at 28 + 0.25 * 100 = 53 °C; after one time constant of 150 s, 63 % of the way."""
    motors = Motors(nominal_truth(), PROFILES["ideal"])
    motors.accept(command(effort=10.0))
    motors.update(ZERO, ZERO)
    for _ in range(1500):
        motors.warm(0.1)
    assert motors.temperature[0] == pytest.approx(AMBIENT_C + 25.0 * (1 - np.exp(-1.0)), abs=0.05)


def test_kinds_of_commands() -> None:
    """Any kp or feed-forward is stiff; kd alone damps; nothing, or mode 0, is off."""
    assert kind_of(command(stiffness=1.0)) == kind_of(command(effort=0.1, damping=1.0)) == "stiff"
    assert kind_of(command(damping=3.0)) == "damping"
    assert kind_of(command()) == "off"
    off = LowCommand(ZERO, ZERO, np.ones(12), ZERO, ZERO, np.zeros(12, np.int64))
    assert kind_of(off) == "off"


def test_a_truth_survives_json() -> None:
    """What --reveal-to writes is what --truth-from reads."""
    truth = draw_truth("realistic", 5)
    assert Go2Truth.from_json(truth.to_json()) == truth
    values = truth.to_json()
    del values["armature"]
    with pytest.raises(ConfigurationError, match="field armature is missing; --reveal-to writes one"):
        Go2Truth.from_json(values)


def test_a_truth_speaks_the_names_of_the_parameter_sets() -> None:
    """Its parameters are those of the suspended Go2's biased set; kd 1.5 and 0.6 of the joint make 2.1."""
    parameters = nominal_truth().parameters(20.0, 1.5)
    space = biased_space()
    assert set(parameters) == set(space.names)
    assert parameters["RL_thigh_joint.damping"] == pytest.approx(2.1)
    assert all(parameters[p.name] == pytest.approx(p.nominal) for p in space.parameters)


def test_draws_lie_in_the_range_and_are_all_different() -> None:
    """With range ratio 2 every factor lies within 2**-0.8 and 2**0.8; latencies within the profile's."""
    truths = [draw_truth("sensor", seed) for seed in range(50)]
    factors = np.array([truth.stiffness for truth in truths])
    assert 2**-0.8 <= factors.min() < 0.6
    assert 1.7 < factors.max() <= 2**0.8
    assert {truth.latency_ms for truth in truths} == set(range(2, 11))
    assert len({truth.armature for truth in truths}) == 50
    assert not any(any(truth.encoder_bias) for truth in truths)
    assert any(draw_truth("realistic", 0).encoder_bias)


def test_bad_settings_of_a_truth_are_refused() -> None:
    """A ratio of 1, a negative seed, an unknown profile and eleven joints are errors."""
    with pytest.raises(ConfigurationError, match=r"the range ratio must be above 1, got 1\.0"):
        draw_truth("ideal", 0, range_ratio=1.0)
    with pytest.raises(ConfigurationError, match="a seed is 0 or more, got -1"):
        draw_truth("ideal", -1)
    with pytest.raises(UnknownNameError, match="unknown profile 'dream'; known: ideal, sensor, realistic"):
        draw_truth("dream", 0)
    with pytest.raises(ConfigurationError, match="armature has 11 entries, expected 12"):
        nominal_truth(armature=(0.01,) * 11)


def test_bad_plans_are_refused() -> None:
    """Shares beyond 1, negative times and unknown joints are errors that name what is allowed."""
    with pytest.raises(ConfigurationError, match=r"drop is a share from 0 to 1, got 1\.5"):
        FaultPlan(drop=1.5)
    with pytest.raises(ConfigurationError, match="hot_after_s must be 0 to 1e7 seconds, got -1"):
        FaultPlan(hot_after_s=-1)
    with pytest.raises(UnknownNameError, match=f"unknown Go2 joint 'knee'; known: {JOINTS[0]}"):
        FaultPlan(lost_joint="knee")


@given(shares=st.tuples(*[st.floats(0.0, 1.0)] * 3), seed=st.integers(0, 1000), count=st.integers(1, 40))
def test_without_corruption_whole_messages_come_or_do_not(
    shares: tuple[float, float, float], seed: int, count: int
) -> None:
    """What comes is what was sent: each once, twice if doubled, or not at all if lost or still held back."""
    drop, duplicate, reorder = shares
    plan = FaultPlan(drop=drop, duplicate=duplicate, reorder=reorder)
    faults = StateFaults(plan, np.random.default_rng(seed))
    sent = [bytes([i]) * 8 for i in range(count)]
    came = Counter(one for payload in sent for one in faults.apply(payload))
    assert set(came) <= set(sent)
    assert max(came.values(), default=1) <= 2
    missing = sum(1 for payload in sent if payload not in came)
    assert missing - faults.counts["drop"] in (0, 1)
    assert sum(came.values()) == count - missing + faults.counts["duplicate"]


def test_a_corrupt_message_differs_in_one_byte() -> None:
    """With a share of 1 every message is changed in exactly one byte, and counted."""
    faults = StateFaults(FaultPlan(corrupt=1.0), np.random.default_rng(0))
    (changed,) = faults.apply(bytes(1180))
    assert sum(byte != 0 for byte in changed) == 1
    assert faults.counts == {**dict.fromkeys(SHARES, 0), "corrupt": 1}


def test_a_remote_script_is_read_in_order_of_time(tmp_path: Path) -> None:
    """Buttons by name, sticks by number, absence; earliest first."""
    path = tmp_path / "remote.json"
    path.write_text(
        '[{"at_s": 2, "absent": true}, {"at_s": 0.5, "buttons": "L2+B"}, {"at_s": 1, "left_y": -0.25}]'
    )
    assert read_remote_script(path) == (
        RemoteMoment(500, Remote(button_mask(["L2", "B"]))),
        RemoteMoment(1000, Remote(left_y=-0.25)),
        RemoteMoment(2000, None),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "cannot be read as a remote's script: Invalid JSON"),
        ("{}", "should be an? .*; it is a list of objects"),
        ('[{"buttons": "A"}]', "is no valid entry; allowed keys are at_s, buttons"),
        ('[{"at_s": 0, "stick": 1}]', "is no valid entry"),
        ('[{"at_s": "soon"}]', "at_s must be a number, got 'soon'"),
        ('[{"at_s": 0, "buttons": "Z"}]', "unknown button 'Z'; known: R1, L1"),
    ],
)
def test_bad_remote_scripts_are_refused(tmp_path: Path, text: str, message: str) -> None:
    """Each mistake in the file is named."""
    path = tmp_path / "remote.json"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=message):
        read_remote_script(path)
