"""The emulated servos as an XL330-M077: factory values, limits, modes, indirect addresses, resets."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.dynamixel.device import DynamixelDevice
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.servo_bus import registers as r
from deal_hw.drivers.servo_bus import xl330
from deal_hw.drivers.servo_bus.emulated_servo import BOOT_NS, EmulatedServo
from deal_hw.drivers.servo_bus.packets import BROADCAST, Error, Instruction, instruction, status
from deal_hw.drivers.servo_bus.registers import OperatingMode, Register

pytestmark = pytest.mark.real_time

MS = 1_000_000
FACTORY = {
    r.MODEL_NUMBER: 1190,
    r.ID: 1,
    r.BAUD_RATE: 1,
    r.RETURN_DELAY_TIME: 250,
    r.OPERATING_MODE: 3,
    r.SECONDARY_ID: 255,
    r.PROTOCOL_TYPE: 2,
    r.MOVING_THRESHOLD: 10,
    r.TEMPERATURE_LIMIT: 70,
    r.MAX_VOLTAGE_LIMIT: 70,
    r.MIN_VOLTAGE_LIMIT: 35,
    r.PWM_LIMIT: 885,
    r.CURRENT_LIMIT: 1750,
    r.VELOCITY_LIMIT: 1620,
    r.MAX_POSITION_LIMIT: 4095,
    r.MIN_POSITION_LIMIT: 0,
    r.PWM_SLOPE: 140,
    r.SHUTDOWN: 53,
    r.VELOCITY_I_GAIN: 400,
    r.VELOCITY_P_GAIN: 40,
    r.POSITION_D_GAIN: 0,
    r.POSITION_I_GAIN: 400,
    r.POSITION_P_GAIN: 400,
    r.GOAL_PWM: 885,
    r.GOAL_CURRENT: 1750,
}
"""Values of the e-Manual's page of the XL330-M077-T, typed from it a second time."""


class Bench:
    """Emulated servos and what a host does with the belt servo, id 1."""

    def __init__(self, mode: int | None = None) -> None:
        self.device = DynamixelDevice(nominal_truth("ideal"), DynamixelSettings())
        self.servo = self.device.servos[0]
        if mode is not None:
            assert self.write(r.OPERATING_MODE, mode) == Error.NONE

    def send(self, code: int, params: bytes = b"", servo: int = 1) -> bytes:
        """Send an instruction; return the bytes of the next 20 ms."""
        self.device.receive(instruction(servo, code, params))
        return self.device.advance_to(self.device.device_ns + 20 * MS)

    def write(self, register: Register, value: int) -> int:
        """Write a register; return the error of the answer."""
        data = register.address.to_bytes(2, "little") + _bytes(register, value)
        answer = self.send(Instruction.WRITE, data)
        assert answer[:9] == b"\xff\xff\xfd\x00\x01\x04\x00\x55" + answer[8:9]
        return answer[8]

    def read(self, register: Register) -> int:
        """Return a register, with its sign."""
        size = register.size
        answer = self.send(Instruction.READ, register.address.to_bytes(2, "little") + bytes([size, 0]))
        return int.from_bytes(answer[9 : 9 + size], "little", signed=size > 1)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.device.advance_to(self.device.device_ns + round(seconds * 1e9))


def _bytes(register: Register, value: int) -> bytes:
    return (value % (1 << 8 * register.size)).to_bytes(register.size, "little")


@pytest.mark.parametrize("register", FACTORY, ids=lambda register: register.name)
def test_factory_values_are_the_e_manuals(register: Register) -> None:
    """After a factory reset every register has the value of the e-Manual; most were 0."""
    servo = EmulatedServo(7, 4_000_000, mode=OperatingMode.PWM)
    servo.put(r.VELOCITY_LIMIT, 5)
    servo.put(r.CURRENT_LIMIT, 5)
    servo.factory_reset(0xFF, 0)
    assert servo.get(register) == FACTORY[register]


def test_an_emulated_servo_is_set_up_for_the_cart_pole() -> None:
    """Id, rate, mode and return delay differ from the factory's; LeRobot's read_calibration gets 0..4095."""
    bench = Bench()
    assert [bench.read(register) for register in (r.ID, r.BAUD_RATE, r.RETURN_DELAY_TIME)] == [1, 3, 0]
    assert bench.read(r.OPERATING_MODE) == OperatingMode.CURRENT_BASED_POSITION
    assert (bench.read(r.MIN_POSITION_LIMIT), bench.read(r.MAX_POSITION_LIMIT)) == (0, 4095)


@pytest.mark.parametrize(
    ("register", "value", "error"),
    [
        (r.OPERATING_MODE, 77, Error.DATA_RANGE),
        (r.OPERATING_MODE, 2, Error.DATA_RANGE),
        (r.OPERATING_MODE, 16, Error.NONE),
        (r.DRIVE_MODE, 2, Error.DATA_RANGE),
        (r.DRIVE_MODE, 5, Error.NONE),
        (r.BAUD_RATE, 7, Error.DATA_RANGE),
        (r.HOMING_OFFSET, -1_044_479, Error.NONE),
        (r.HOMING_OFFSET, -1_044_480, Error.DATA_RANGE),
        (r.VELOCITY_LIMIT, 2048, Error.DATA_RANGE),
        (r.MAX_POSITION_LIMIT, 4096, Error.DATA_RANGE),
        (r.GOAL_PWM, 886, Error.DATA_LIMIT),
        (r.GOAL_CURRENT, -1751, Error.DATA_LIMIT),
        (r.GOAL_VELOCITY, 1621, Error.DATA_LIMIT),
        (r.GOAL_VELOCITY, -1620, Error.NONE),
        (r.GOAL_POSITION, 1_048_576, Error.DATA_RANGE),
        (r.PRESENT_PWM, 0, Error.ACCESS),
        (r.BUS_WATCHDOG, 128, Error.DATA_RANGE),
    ],
)
def test_values_beyond_their_range_are_refused(register: Register, value: int, error: Error) -> None:
    """The reason is the e-Manual's: a range, a limit that a register sets, or no access; nothing changes."""
    bench = Bench()
    before = bench.read(register)
    assert bench.write(register, value) == error
    if error:
        assert bench.read(register) == before


def test_goals_beyond_the_position_limits_are_refused() -> None:
    """In position control mode the limits count; in a mode of many turns they do not."""
    bench = Bench(OperatingMode.POSITION)
    assert bench.write(r.MAX_POSITION_LIMIT, 3000) == Error.NONE
    assert bench.write(r.GOAL_POSITION, 3001) == Error.DATA_LIMIT
    assert bench.write(r.GOAL_POSITION, -1) == Error.DATA_LIMIT
    assert bench.write(r.GOAL_POSITION, 3000) == Error.NONE
    assert bench.write(r.OPERATING_MODE, OperatingMode.EXTENDED_POSITION) == Error.NONE
    assert bench.write(r.GOAL_POSITION, -5000) == Error.NONE


def test_the_eeprom_is_locked_while_the_torque_is_on() -> None:
    """Registers below 64 are refused with an access error; the mode too, also through indirect data."""
    bench = Bench()
    assert bench.write(r.TORQUE_ENABLE, 1) == Error.NONE
    for register in (r.OPERATING_MODE, r.HOMING_OFFSET, r.ID):
        assert bench.write(register, 3) == Error.ACCESS


def test_a_new_mode_resets_gains_and_goals() -> None:
    """e-Manual, Operating Mode: gains, profile and goals are those of the new mode."""
    bench = Bench()
    for register, value in ((r.POSITION_P_GAIN, 7), (r.PROFILE_VELOCITY, 9), (r.GOAL_PWM, 3)):
        bench.write(register, value)
    bench.write(r.OPERATING_MODE, OperatingMode.VELOCITY)
    found = [bench.read(register) for register in (r.POSITION_P_GAIN, r.PROFILE_VELOCITY, r.GOAL_PWM)]
    assert found == [400, 0, 885]


def test_the_homing_offset_is_added() -> None:
    """Present = actual + offset, at once: LeRobot's half-turn homing reads 2047. So are goals.

    In position control mode the e-Manual ignores offsets beyond 1024.
    """
    bench = Bench(OperatingMode.EXTENDED_POSITION)
    actual = bench.read(r.PRESENT_POSITION)
    bench.write(r.HOMING_OFFSET, 2047 - actual)
    assert bench.read(r.PRESENT_POSITION) == 2047
    bench.write(r.POSITION_D_GAIN, 1000)
    bench.write(r.GOAL_POSITION, 2147)
    bench.write(r.TORQUE_ENABLE, 1)
    bench.run(1.0)
    assert bench.read(r.PRESENT_POSITION) == pytest.approx(2147, abs=10)
    bench.write(r.TORQUE_ENABLE, 0)
    bench.write(r.OPERATING_MODE, OperatingMode.POSITION)
    bench.write(r.HOMING_OFFSET, 1025)
    here = bench.read(r.PRESENT_POSITION)
    bench.write(r.HOMING_OFFSET, 1024)
    assert bench.read(r.PRESENT_POSITION) == here + 1024


def test_indirect_addresses_read_and_write() -> None:
    """As indirect_address.py of ROBOTIS' SDK: five bytes to goal and LED, five from position and Moving."""
    bench = Bench(OperatingMode.EXTENDED_POSITION)
    for k, address in enumerate((*range(116, 120), 65)):
        assert bench.write(xl330.INDIRECT_ADDRESSES[k], address) == Error.NONE
    for k, address in enumerate((*range(132, 136), 122)):
        assert bench.write(xl330.INDIRECT_ADDRESSES[5 + k], address) == Error.NONE
    bench.send(
        Instruction.SYNC_WRITE, b"\xe0\x00\x05\x00\x01" + (1234).to_bytes(4, "little") + b"\1", BROADCAST
    )
    assert (bench.read(r.GOAL_POSITION), bench.read(r.LED)) == (1234, 1)
    answer = bench.send(Instruction.READ, b"\xe5\x00\x05\x00")[9:14]
    assert int.from_bytes(answer[:4], "little") == bench.read(r.PRESENT_POSITION)
    # What cannot be written directly cannot be written through them: Present Position.
    assert bench.send(Instruction.WRITE, b"\xe5\x00\x01\x00")[8] == Error.ACCESS
    assert bench.write(xl330.INDIRECT_ADDRESSES[0], 63) == Error.DATA_RANGE
    # A restart forgets them: each points at its own data.
    bench.send(Instruction.REBOOT)
    bench.run(1.1 * BOOT_NS / 1e9)
    assert bench.read(xl330.INDIRECT_ADDRESSES[0]) == 224


def test_velocity_mode_turns_at_its_velocity() -> None:
    """Goal 100 is 22.9 rev/min: 0.061 m/s on 0.16 m a revolution; Moving, PWM and trajectory tell of it.

    Without load 383 rev/min (1672) take 885 units of PWM, so 100 take 53; friction takes more. The review
    found 966 rev/min of the position loop.
    """
    bench = Bench(OperatingMode.VELOCITY)
    bench.write(r.TORQUE_ENABLE, 1)
    bench.run(0.5)
    assert bench.read(r.MOVING) == 0
    start = bench.device.true_position[0]
    bench.write(r.GOAL_VELOCITY, 100)
    bench.run(3.0)
    assert bench.read(r.PRESENT_VELOCITY) == pytest.approx(100, abs=15)
    assert bench.device.true_position[0] - start == pytest.approx(0.061 * 3.0, rel=0.1)
    assert (bench.read(r.MOVING), bench.read(r.VELOCITY_TRAJECTORY)) == (1, 100)
    assert bench.read(r.PRESENT_PWM) == pytest.approx(53, abs=60)
    bench.write(r.GOAL_VELOCITY, 0)
    bench.run(1.0)
    assert abs(bench.read(r.PRESENT_VELOCITY)) < 20


def test_the_velocity_profile_has_its_acceleration() -> None:
    """t1 = 64 ms * goal / acceleration: goal 100 at acceleration 4 takes 1.6 s; after 0.8 s it is half."""
    bench = Bench(OperatingMode.VELOCITY)
    bench.write(r.PROFILE_ACCELERATION, 4)
    bench.write(r.TORQUE_ENABLE, 1)
    bench.write(r.GOAL_VELOCITY, 100)
    bench.run(0.78)
    assert bench.read(r.VELOCITY_TRAJECTORY) == pytest.approx(50, abs=3)


@pytest.mark.parametrize(
    ("mode", "goal", "value"),
    [(OperatingMode.CURRENT, r.GOAL_CURRENT, 150), (OperatingMode.PWM, r.GOAL_PWM, 200)],
)
def test_current_and_pwm_modes_push(mode: OperatingMode, goal: Register, value: int) -> None:
    """150 mA are 0.86 N, 200 units of PWM 1.9 N at rest: the cart goes that way, and back with the sign."""
    bench = Bench(mode)
    bench.write(goal, 0)
    bench.write(r.TORQUE_ENABLE, 1)
    places = [bench.device.true_position[0]]
    for sign in (1, -1):
        bench.write(goal, sign * value)
        bench.run(0.25)
        places.append(bench.device.true_position[0])
        if mode == OperatingMode.CURRENT:
            assert bench.read(r.PRESENT_CURRENT) == sign * value
        else:
            assert bench.read(r.PRESENT_PWM) == pytest.approx(sign * value, abs=5)
        bench.write(goal, -sign * value)
        bench.run(0.25)
    assert places[1] - places[0] > 0.02


def test_position_mode_settles_with_the_factorys_gains() -> None:
    """ROBOTIS' examples wait until a goal is within 20 pulses; without back-EMF the cart rang by 2400."""
    bench = Bench(OperatingMode.POSITION)
    assert bench.read(r.PRESENT_POSITION) > 3000
    bench.write(r.GOAL_POSITION, 0)
    bench.write(r.TORQUE_ENABLE, 1)
    bench.run(0.5)
    for _ in range(10):
        bench.run(0.02)
        assert abs(bench.read(r.PRESENT_POSITION)) <= 20


def test_the_trajectory_is_shown() -> None:
    """Profile Velocity 50 of a far goal: 50 * 0.229 / 60 * 4096 = 782 pulses/s, so 1 s later 782 on."""
    bench = Bench(OperatingMode.EXTENDED_POSITION)
    bench.write(r.POSITION_D_GAIN, 1000)
    bench.write(r.PROFILE_VELOCITY, 50)
    bench.write(r.TORQUE_ENABLE, 1)
    start = bench.read(r.POSITION_TRAJECTORY)
    bench.write(r.GOAL_POSITION, start + 4000)
    before = bench.read(r.POSITION_TRAJECTORY)
    bench.run(0.98)
    after = bench.read(r.POSITION_TRAJECTORY)
    assert after - before == pytest.approx(782, abs=20)
    assert bench.read(r.VELOCITY_TRAJECTORY) == 50
    assert bench.read(r.MOVING_STATUS) == r.RECTANGULAR_PROFILE | r.PROFILE_ONGOING
    assert bench.read(r.MOVING) == 1
    bench.run(6.0)
    assert bench.read(r.MOVING_STATUS) & r.PROFILE_ONGOING == 0
    assert bench.read(r.VELOCITY_TRAJECTORY) == 0
    assert bench.read(r.POSITION_TRAJECTORY) == start + 4000


@pytest.mark.parametrize(
    ("keep", "kept"), [(0x01, (9, 1)), (0x02, (9, 3)), (0xFF, (1, 1))], ids=["id", "id and baud", "nothing"]
)
def test_a_factory_reset_keeps_what_it_is_told(keep: int, kept: tuple[int, int]) -> None:
    """It answers, is silent while it restarts, and has the factory's values, mode 3 among them."""
    bench = Bench()
    bench.write(r.ID, 9)
    answer = bench.send(Instruction.FACTORY_RESET, bytes([keep]), 9)
    assert answer == status(9, Error.NONE)
    assert (bench.servo.id, bench.servo.get(r.BAUD_RATE)) == kept
    assert bench.servo.get(r.OPERATING_MODE) == 3
    assert bench.send(Instruction.PING, servo=bench.servo.id) == b""


def test_a_factory_reset_of_all_to_one_id_is_ignored() -> None:
    """e-Manual: 0xFF to the broadcast id has no effect; an unknown choice is a data range error."""
    bench = Bench()
    assert bench.send(Instruction.FACTORY_RESET, b"\xff", BROADCAST) == b""
    assert bench.servo.get(r.OPERATING_MODE) == OperatingMode.CURRENT_BASED_POSITION
    assert bench.send(Instruction.FACTORY_RESET, b"\x07")[8] == Error.DATA_RANGE


def test_clear_needs_its_code_and_moves_the_goal_along() -> None:
    """Turns are forgotten with the code alone; the goal keeps its distance, so nothing jumps."""
    bench = Bench(OperatingMode.EXTENDED_POSITION)
    bench.servo.sense(9000)
    bench.servo.put(r.GOAL_POSITION, 9100)
    bench.servo.forget_turns()
    # 9000 = 2 * 4096 + 808.
    assert bench.servo.block.present_position % 4096 == 808
    assert bench.servo.get(r.GOAL_POSITION) - bench.servo.block.present_position == 100
    assert bench.send(Instruction.CLEAR, b"\x01")[8] == Error.DATA_RANGE
    assert bench.send(Instruction.CLEAR, b"\x01\x44\x58\x4c\x22")[8] == Error.NONE


def test_shutdown_chooses_what_stops_the_motor() -> None:
    """5.0 V above a limit of 4.5 V: alert, error bit 0; the torque goes off only if Shutdown has the bit."""
    for shutdown, torque in ((53, 0), (52, 1)):
        bench = Bench()
        bench.write(r.SHUTDOWN, shutdown)
        bench.write(r.MAX_VOLTAGE_LIMIT, 70)
        bench.write(r.TORQUE_ENABLE, 1)
        bench.servo.put(r.MAX_VOLTAGE_LIMIT, 45)
        bench.run(0.01)
        assert bench.servo.get(r.HARDWARE_ERROR) == 1
        assert bench.servo.get(r.TORQUE_ENABLE) == torque


def test_a_goal_switches_the_torque_on_where_drive_mode_says_so() -> None:
    """Bit 3 of Drive Mode, from firmware 46 on."""
    bench = Bench()
    bench.write(r.DRIVE_MODE, r.TORQUE_BY_GOAL)
    assert bench.read(r.TORQUE_ENABLE) == 0
    bench.write(r.GOAL_POSITION, bench.read(r.PRESENT_POSITION))
    assert bench.read(r.TORQUE_ENABLE) == 1


def test_a_kept_write_is_shown() -> None:
    """Registered Instruction is 1 until Action."""
    bench = Bench()
    bench.send(Instruction.REG_WRITE, b"\x41\x00\x01")
    assert (bench.read(r.REGISTERED_INSTRUCTION), bench.read(r.LED)) == (1, 0)
    bench.send(Instruction.ACTION, b"", BROADCAST)
    assert (bench.read(r.REGISTERED_INSTRUCTION), bench.read(r.LED)) == (0, 1)


def test_the_status_return_level_is_kept() -> None:
    """Level 1 answers reads alone, level 0 neither; pings are always answered."""
    bench = Bench()
    bench.write(r.STATUS_RETURN_LEVEL, 1)
    assert bench.send(Instruction.WRITE, b"\x41\x00\x01") == b""
    assert bench.read(r.LED) == 1
    bench.send(Instruction.WRITE, b"\x44\x00\x00")
    assert bench.send(Instruction.READ, b"\x41\x00\x01\x00") == b""
    assert bench.send(Instruction.PING)


def packets_of_hosts() -> st.SearchStrategy[bytes]:
    """Sound instruction packets to both servos, to all and to nobody, with any parameters."""
    addresses = st.sampled_from(range(0, 252)).map(lambda at: at.to_bytes(2, "little"))
    params = st.binary(max_size=24) | st.builds(lambda at, data: at + data, addresses, st.binary(max_size=8))
    return st.builds(
        instruction,
        st.sampled_from([1, 1, 2, BROADCAST]) | st.integers(0, 252),
        st.sampled_from(Instruction) | st.integers(0, 255).filter(lambda code: code != 0x55),
        params,
    )


@settings(deadline=None, max_examples=200)
@given(st.lists(packets_of_hosts(), min_size=1, max_size=12), st.sampled_from(OperatingMode))
def test_no_packet_kills_the_servos(sent: list[bytes], mode: OperatingMode) -> None:
    """Any instruction and parameters, in any mode with torque: what comes back are status packets."""
    bench = Bench(mode)
    bench.write(r.TORQUE_ENABLE, 1)
    for data in sent:
        bench.device.receive(data)
        answer = bench.device.advance_to(bench.device.device_ns + 10 * MS)
        assert not answer or answer.startswith(b"\xff\xff\xfd\x00")
    assert all(abs(value) < 1e6 for value in bench.device.true_position)
