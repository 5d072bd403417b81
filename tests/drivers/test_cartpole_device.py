"""The emulated device in virtual time: modes, watchdog, latency, sensor, physics."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.chips.controller import WATCHDOG_TICKS
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.plant.mechanics import HOMING_TICKS, Mechanics
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, candidate_truth, nominal_truth
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.protocol import Ack, Info, Result, State, Target
from deal_hw.types import Status

MS = 1_000_000
FUZZED = candidate_truth("realistic", np.random.default_rng(1), seed=1, range_ratio=5.0, refused=0)
COMMANDS = st.one_of(
    st.builds(
        lambda *v: protocol.encode(Target(*v)),
        *(
            st.integers(*bounds)
            for bounds in (
                (0, 2**32 - 2),
                (-(2**31), 2**31 - 1),
                (0, 2**32 - 1),
                (0, 2**32 - 1),
                (0, 2**16 - 1),
                (0, 2**32 - 1),
            )
        ),
    ),
    st.builds(
        lambda kind, request: protocol.encode(kind(request)),
        st.sampled_from([protocol.Hello, protocol.Arm, protocol.Stop, protocol.Home]),
        st.integers(0, 255),
    ),
)


def messages(data: bytes) -> list[protocol.AnyMessage]:
    """Decode what a device sent."""
    return [protocol.decode(p) for p in protocol.FrameDecoder().feed(data)]


def states(data: bytes) -> list[State]:
    """Decode the state frames among what a device sent."""
    return [m for m in messages(data) if isinstance(m, State)]


def target(
    sequence: int, position_um: int = 0, speed_um_s: int = 1_000_000, effort_mn: int = 4_000
) -> Target:
    """Return a target with default gains."""
    return Target(sequence, position_um, 80_000, 8_000, effort_mn, speed_um_s)


def armed_device(truth: CartpoleTruth, **options: object) -> CartpoleDevice:
    """Return a device that was homed and armed; the next tick is 510."""
    device = CartpoleDevice(truth, **options)  # type: ignore[arg-type]
    device.receive(protocol.encode(protocol.Home(1)))
    device.advance_to((HOMING_TICKS + 4) * MS)
    device.receive(protocol.encode(protocol.Arm(2)))
    device.advance_to(509 * MS)
    assert device.armed
    return device


def command(device: CartpoleDevice, message: Target, ticks: int) -> bytes:
    """Send a target and run some ticks."""
    device.receive(protocol.encode(message))
    return device.advance_to(device.device_ns + (ticks - 1) * MS)


def test_the_device_introduces_itself_to_any_version() -> None:
    """Hello of version 9 is answered with our version, so that the other side can tell."""
    device = CartpoleDevice(nominal_truth())
    device.receive(protocol.encode(protocol.Hello(7, version=9)))
    info = messages(device.advance_to(0))[0]
    assert isinstance(info, Info)
    assert (info.request, info.kind, info.version) == (7, "cartpole", 1)
    assert (info.device_rate_hz, info.state_rate_hz) == (1000, 200)


def test_state_frames_come_every_fifth_tick() -> None:
    """Device times 0, 5000, 10 000 us, numbers 0, 1, 2; the pole hangs, nothing is armed."""
    found = states(CartpoleDevice(nominal_truth()).advance_to(10 * MS))
    assert [(s.sequence, s.device_us) for s in found] == [(0, 0), (1, 5000), (2, 10_000)]
    assert all(s.status == 0 and s.command_sequence == protocol.NO_COMMAND for s in found)
    assert found[0].pole_urad == round(math.pi * 1e6)


def test_arming_needs_homing() -> None:
    """Arm is refused before homing and during it, accepted after."""
    device = CartpoleDevice(nominal_truth())
    answers = []
    for message in (protocol.Arm(0), protocol.Home(1), protocol.Arm(2)):
        device.receive(protocol.encode(message))
        answers += [m.result for m in messages(device.advance_to(device.device_ns)) if isinstance(m, Ack)]
    assert answers == [Result.NOT_HOMED, Result.DONE, Result.HOMING]
    out = device.advance_to(device.device_ns + 600 * MS)
    assert Status(states(out)[0].status) == Status.HOMING
    assert Status(states(out)[-1].status) == Status.HOMED
    device.receive(protocol.encode(protocol.Arm(9)))
    device.advance_to(device.device_ns)
    assert device.armed


def test_homing_puts_the_cart_in_the_middle_and_the_pole_upright_until_armed() -> None:
    """The hand's angle is within 0.03 rad, differs between homings, and does not move before arming."""
    device = CartpoleDevice(nominal_truth(seed=4))
    angles = []
    for request in range(3):
        device.receive(protocol.encode(protocol.Home(request)))
        device.advance_to(device.device_ns + 1000 * MS)
        cart, pole = device.true_position
        assert cart == 0.0
        assert 0 < abs(pole) < 0.03
        device.advance_to(device.device_ns + 1000 * MS)
        assert device.true_position == (cart, pole)
        angles.append(pole)
    assert len(set(angles)) == 3


def test_a_repeated_request_does_not_act_twice() -> None:
    """Home with the same number is answered again but does not start homing anew."""
    device = CartpoleDevice(nominal_truth())
    device.receive(protocol.encode(protocol.Home(5)))
    device.advance_to(300 * MS)
    device.receive(protocol.encode(protocol.Home(5)))
    out = device.advance_to((HOMING_TICKS + 10) * MS)
    assert [m for m in messages(out) if isinstance(m, Ack)] == [
        Ack(5, protocol.MessageType.HOME, Result.DONE)
    ]
    assert Status(states(out)[-1].status) == Status.HOMED


def test_the_watchdog_stops_the_motor_after_200_ms_and_latches() -> None:
    """The last target is handled at tick 510: tick 709 is armed, 710 is not; targets do not undo that."""
    device = armed_device(nominal_truth(), keep_truth=True)
    command(device, target(0, 50_000), 1)
    device.advance_to((510 + WATCHDOG_TICKS - 1) * MS)
    assert device.armed
    out = device.advance_to((510 + WATCHDOG_TICKS) * MS)
    assert not device.armed
    assert Status(states(out)[-1].status) == Status.HOMED | Status.WATCHDOG
    out = command(device, target(1, 50_000), 100)
    assert all(Status(s.status) == Status.HOMED | Status.WATCHDOG for s in states(out))
    assert np.all(device.true_trajectory().force[710:] == 0.0)
    device.receive(protocol.encode(protocol.Arm(3)))
    out = device.advance_to(device.device_ns + 10 * MS)
    assert Status(states(out)[-1].status) == Status.HOMED | Status.ARMED


def test_a_stuck_sender_does_not_feed_the_watchdog() -> None:
    """The same target every 20 ms, under one number, counts once."""
    device = armed_device(nominal_truth())
    for _ in range(11):
        command(device, target(0), 20)
    assert not device.armed


def test_targets_feed_the_watchdog() -> None:
    """A new number every 190 ms keeps the motor on."""
    device = armed_device(nominal_truth())
    for sequence in range(5):
        command(device, target(sequence), 190)
        assert device.armed


def test_hello_and_stop_switch_the_motor_off() -> None:
    """Both disarm at once; after hello the device has forgotten earlier commands."""
    for message, remembered in ((protocol.Hello(8), protocol.NO_COMMAND), (protocol.Stop(8), 0)):
        device = armed_device(nominal_truth())
        command(device, target(0), 5)
        device.receive(protocol.encode(message))
        last = states(device.advance_to(device.device_ns + 5 * MS))[-1]
        assert Status(last.status) == Status.HOMED
        assert last.command_sequence == remembered


def test_the_age_gives_the_tick_of_reception() -> None:
    """A target handled at tick 513 has age 2000 us in the frame of tick 515, whatever the latency."""
    device = armed_device(nominal_truth(actuation_ticks=7, sensing_ticks=4))
    device.advance_to(512 * MS)
    found = states(command(device, target(0), 10))
    assert [(s.device_us, s.command_sequence, s.command_age_us) for s in found] == [
        (515_000, 0, 2_000),
        (520_000, 0, 7_000),
    ]


def test_a_command_acts_after_the_actuation_delay() -> None:
    """Handled at tick 510, delay 7: the first force is in tick 517, 80 N/m times 1 mm of slew = 0.08 N."""
    device = armed_device(nominal_truth(actuation_ticks=7), keep_truth=True)
    command(device, target(0, 100_000), 20)
    force = device.true_trajectory().force
    assert np.flatnonzero(force)[0] == 517
    assert force[517] == pytest.approx(0.08, abs=1e-3)  # The released pole has pushed the cart by some um.


def test_a_frame_reports_the_state_of_the_sensing_delay_ago() -> None:
    """With a delay of 4 ticks the frame of tick k holds the true state before tick k - 4, in um and urad."""
    device = armed_device(nominal_truth(sensing_ticks=4), keep_truth=True)
    found = states(command(device, target(0, 100_000), 60))
    truth = device.true_trajectory()
    for state in found:
        tick = state.device_us // 1000 - 4
        assert state.cart_um == round(truth.position[tick, 0] * 1e6)
        assert state.pole_urad == round(truth.position[tick, 1] * 1e6)
        assert state.cart_um_s == round(truth.velocity[tick, 0] * 1e6)


def test_the_effort_estimate_is_in_the_units_of_the_command() -> None:
    """A servo twice as strong still reports its own 80 N/m times the error, and its own limit."""
    truth = nominal_truth()
    strong = dataclasses.replace(truth, parameters={**truth.parameters, "servo.stiffness": 160.0})
    device = armed_device(strong, keep_truth=True)
    found = states(command(device, target(0, 20_000, speed_um_s=2**31), 6))
    assert found[0].effort_mn == 1600  # 80 N/m x 20 mm; the real force is twice that.
    assert device.true_trajectory().force[510] == pytest.approx(3.2)
    found = states(command(device, target(1, 200_000, speed_um_s=2**31), 6))
    assert found[0].effort_mn == 4000
    assert Status.EFFORT_CLAMPED in Status(found[0].status)


def test_the_speed_limit_shows_in_the_status() -> None:
    """1 m/s for a step of 100 mm: the bit is set for the first 100 ms and not after."""
    device = armed_device(nominal_truth())
    found = states(command(device, target(0, 100_000), 120))
    flags = [Status.SPEED_CLAMPED in Status(s.status) for s in found]
    assert flags == [s.device_us < 609_000 for s in found]


def test_the_sensor_profile_quantises_and_differences() -> None:
    """Positions are multiples of 0.5 mm and 2 pi / 4096; velocities differ over four frames."""
    device = armed_device(nominal_truth("sensor"))
    data = b"".join(command(device, target(i, 40_000 * (i % 2)), 100) for i in range(5))
    found = states(data)
    step = 2 * math.pi / 4096
    for state in found:
        assert state.cart_um % 500 == 0
        assert state.pole_urad == round(round(state.pole_urad / 1e6 / step) * step * 1e6)
    for old, new in zip(found, found[4:], strict=False):
        assert new.cart_um_s == (new.cart_um - old.cart_um) * 50
        assert new.pole_urad_s == (new.pole_urad - old.pole_urad) * 50


def test_the_sensor_noise_has_the_size_that_the_description_says() -> None:
    """At rest in the hand, 2000 readings scatter by sqrt(0.3^2 + 0.5^2 / 12) mm = 0.333 mm, within 10 %."""
    device = CartpoleDevice(nominal_truth("sensor"))
    device.receive(protocol.encode(protocol.Home(0)))
    device.advance_to(600 * MS)
    found = states(device.advance_to(10_600 * MS))
    np.testing.assert_allclose(np.std([s.cart_um for s in found]), 333, rtol=0.1)
    np.testing.assert_allclose(
        np.std([s.pole_urad for s in found]), math.hypot(2000, 1534 / math.sqrt(12)), rtol=0.1
    )


def test_the_realistic_profile_drops_frames_and_counts_them() -> None:
    """About 1 % of the sequence numbers are missing."""
    found = states(CartpoleDevice(nominal_truth("realistic")).advance_to(20_000 * MS))
    missing = found[-1].sequence + 1 - len(found)
    assert 0.004 < missing / found[-1].sequence < 0.02


def test_jittered_commands_keep_their_order() -> None:
    """Targets handled in consecutive ticks act in order, the last one wins."""
    device = armed_device(nominal_truth("realistic", seed=1), keep_truth=True)
    for sequence in range(20):
        command(device, target(sequence, 1000 * sequence, speed_um_s=2**31), 1)
    command(device, target(20, 0, speed_um_s=2**31), 10)
    setpoint = device.true_trajectory().setpoint[510:]
    assert np.all(np.diff(setpoint[:20]) >= 0)
    assert setpoint[-1] == 0.0


def test_backlash_keeps_the_motor_within_half_the_play() -> None:
    """The motor's encoder stays put until the play of 0.4 mm is used up."""
    mechanics = Mechanics(nominal_truth("realistic"))
    found = []
    for cart in (0.0, 0.0001, 0.0005, 0.0001, -0.0005):
        mechanics._sim.set_state((cart, 0.0), (0.0, 0.0))
        found.append(mechanics.motor().position)
    np.testing.assert_allclose(found[1:], [found[0], 0.0003, 0.0003, -0.0003], atol=1e-12)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    """Truth, noise, jitter and drops all come from the seed, also when time advances in other steps."""

    def run(seed: int, step_ms: int) -> bytes:
        device = armed_device(nominal_truth("realistic", seed=seed, actuation_ticks=5))
        data = b""
        for sequence in range(10):
            device.receive(protocol.encode(target(sequence, 10_000 * sequence)))
            for _ in range(60 // step_ms):
                data += device.advance_to(device.device_ns + (step_ms - 1) * MS)
        return data

    assert run(3, 1) == run(3, 20)
    assert run(3, 1) != run(4, 1)


@settings(deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=60), COMMANDS), max_size=15))
def test_whatever_the_host_sends_the_device_goes_on(sent: list[bytes]) -> None:
    """Garbage and commands of any size, in any order, never stop the state frames."""
    device = armed_device(FUZZED)
    for sequence, data in enumerate(sent):
        device.receive(b"\0" + data)
        found = states(device.advance_to(device.device_ns + 10 * MS))
        assert found, sequence
        assert all(math.isfinite(value) for value in device.true_position)


@pytest.mark.parametrize("seed", [0, 2, 3, 5])
def test_the_trajectory_equals_that_of_the_position_actuator_of_the_mjcf(seed: int) -> None:
    """Without latency and noise it is a MuJoCo rollout with ctrl = slewed set-point, to 1e-9.

    The calibrator models the robot so. The motion goes through both limits, dry friction and a fallen pole.
    """
    rng = np.random.default_rng(seed)
    truth = candidate_truth("ideal", rng, seed=seed, range_ratio=5.0, refused=0)
    device = armed_device(truth, keep_truth=True)
    targets = np.repeat(np.rint(rng.uniform(-0.25, 0.25, 15) * 1e6).astype(int), 10)
    for sequence, position_um in enumerate(targets):
        command(device, target(sequence, int(position_um)), 20)
    found = device.true_trajectory()

    values = truth.parameters
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    data = mujoco.MjData(model)
    cart, pole = model.body("cart").id, model.body("pole").id
    model.body_inertia[cart] *= values["cart.mass"] / model.body_mass[cart]
    model.body_mass[cart] = values["cart.mass"]
    model.body_mass[pole] = values["pole.mass"]
    model.dof_frictionloss[:] = values["cart.frictionloss"], values["pole.frictionloss"]
    model.dof_damping[1] = values["pole.damping"]
    model.dof_armature[1] = values["pole.armature"]
    model.actuator_gainprm[0, 0] = values["servo.stiffness"]
    model.actuator_biasprm[0, 1:3] = -values["servo.stiffness"], -values["servo.damping"]
    model.actuator_forcerange[0] = -values["servo.effort_limit"], values["servo.effort_limit"]
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = found.position[510], found.velocity[510]
    setpoint, step = 0.0, values["servo.speed_limit"] * 1e-3
    saturated = 0
    for i in range(3000):
        np.testing.assert_allclose(data.qpos, found.position[510 + i], rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qvel, found.velocity[510 + i], rtol=0, atol=1e-7)
        setpoint += float(np.clip(targets[i // 20] / 1e6 - setpoint, -step, step))
        data.ctrl[0] = setpoint
        mujoco.mj_step(model, data)
        saturated += abs(found.force[510 + i]) >= values["servo.effort_limit"]
    assert np.ptp(found.position[510:, 1]) > 1.0
    assert saturated > 10
    assert np.sum(np.abs(np.diff(found.setpoint[510:])) > 0.99 * step) > 100
