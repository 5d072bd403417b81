"""The emulated ODrive as other people's programs find it: requests, settings, addresses, any frame."""

from __future__ import annotations

import json
import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.emulator.faults import CanFaults, Hazards
from deal_hw.drivers.cartpole.emulator.odrive_drive import BOOT_TICKS
from deal_hw.drivers.cartpole.emulator.odrive_emulator import odrive_device, odrive_emulator
from deal_hw.drivers.cartpole.emulator.odrive_endpoints import ENABLE_WATCHDOG, ENDPOINTS, flat_endpoints
from deal_hw.drivers.cartpole.emulator.slcan_adapter import SlcanAdapter
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.wire.can_link import FRAME, REMOTE
from deal_hw.drivers.cartpole.wire.odrive_frames import (
    CLOSED_LOOP,
    IDLE,
    LAYOUT,
    PASSTHROUGH,
    TORQUE_CONTROL,
    VELOCITY_CONTROL,
    AxisError,
    Command,
    pack,
)
from deal_hw.drivers.cartpole.wire.odrive_link import OdriveSettings

PARTS = OdriveSettings()
MS = 1_000_000
ANSWERED = (
    Command.VERSION,
    Command.HEARTBEAT,
    Command.ERROR,
    Command.ADDRESS,
    Command.ENCODER_ESTIMATES,
    Command.IQ,
    Command.TEMPERATURE,
    Command.BUS_VOLTAGE_CURRENT,
    Command.TORQUES,
    Command.POWERS,
)


def drive() -> CartpoleDevice:
    """Return an emulated ODrive of node 0 with its encoder."""
    return odrive_device(nominal_truth("ideal"), PARTS)


def run(device: CartpoleDevice, *sent: bytes, ticks: int = 1) -> list[tuple[int, bytes]]:
    """Send frames; return ids and data of the frames of the next ticks."""
    for frame in sent:
        device.receive(frame)
    out = device.advance_to(device.device_ns + (ticks - 1) * MS)
    return [(identifier, payload[:length]) for identifier, length, payload in FRAME.iter_unpack(out)]


def ask(device: CartpoleDevice, command: Command, node: int = 0) -> tuple[float | bytes, ...]:
    """Return the values of the answer to a remote frame."""
    answers = run(device, FRAME.pack(node << 5 | command | REMOTE, 0, b""))
    (data, *_) = [data for identifier, data in answers if identifier & 0x1F == command]
    return LAYOUT[command].unpack(data)


def read(device: CartpoleDevice, number: int) -> bytes:
    """Return the value of a setting, asked for with four bytes as ODrive's example does."""
    ((_, data),) = [
        frame
        for frame in run(device, FRAME.pack(Command.RX_SDO, 4, struct.pack("<BHx", 0, number)))
        if frame[0] == Command.TX_SDO
    ]
    assert struct.unpack_from("<BHx", data) == (0, number)
    return data[4:]


def frames() -> st.SearchStrategy[bytes]:
    """Frames of any kind to drive, encoder, all and others; most with a number that CANSimple has."""
    node = st.sampled_from([0, 0, 0, PARTS.encoder, 0x3F]) | st.integers(0, 0x3F)
    number = st.sampled_from(Command) | st.integers(0, 0x1F)
    whole = st.binary(max_size=8) | st.sampled_from(Command).flatmap(
        lambda c: st.binary(min_size=LAYOUT[c].size, max_size=LAYOUT[c].size)
    )
    known = st.builds(lambda n, c, r: n << 5 | c | r, node, number, st.sampled_from([0, 0, REMOTE]))
    return st.builds(
        lambda identifier, data, length: FRAME.pack(
            identifier, len(data) if length is None else length, data
        ),
        known | st.integers(0, 2**32 - 1),
        whole,
        st.none() | st.integers(0, 255),
    )


@settings(deadline=None, max_examples=300)
@given(st.lists(frames(), min_size=1, max_size=12), st.booleans())
def test_no_frame_kills_the_emulator(sent: list[bytes], armed: bool) -> None:
    """Any id, data, length and remote flag; every answer has the layout of its number, and is a number."""
    device = drive()
    if armed:
        run(device, pack(0, Command.SET_AXIS_STATE, CLOSED_LOOP))
    for frame in sent:
        for identifier, data in run(device, frame, ticks=6):
            if identifier >> 5 != PARTS.encoder:
                command = Command(identifier & 0x1F)
                assert len(data) == LAYOUT[command].size or command is Command.TX_SDO
                if command is not Command.TX_SDO:
                    values = LAYOUT[command].unpack(data)
                    assert all(math.isfinite(v) for v in values if isinstance(v, float))
    assert all(map(math.isfinite, device.true_position))


@pytest.mark.parametrize("command", [Command.SET_INPUT_VEL, Command.SET_INPUT_TORQUE])
def test_velocities_and_torques_are_taken(command: Command) -> None:
    """Both ended the emulator with a KeyError."""
    run(drive(), FRAME.pack(command, 8, struct.pack("<ff", 0.5, 0.0)))


@pytest.mark.parametrize("empty", [False, True], ids=["remote", "empty data frame"])
@pytest.mark.parametrize("command", ANSWERED)
def test_every_value_is_answered(command: Command, empty: bool) -> None:
    """ODrive's page: asked by a remote frame, or by a data frame without data."""
    device = drive()
    run(device, ticks=2)
    flag = 0 if empty else REMOTE
    answers = run(device, FRAME.pack(command | flag, 0, b""))
    assert [identifier for identifier, _ in answers] == [command]
    assert len(answers[0][1]) == LAYOUT[command].size == 8


def test_nothing_is_asked_of_a_frame_that_only_a_host_sends() -> None:
    """A remote frame with the number of a command neither is answered nor acts."""
    device = drive()
    for command in set(Command) - set(ANSWERED):
        assert ask_nothing(device, command) == []
    assert device.mode == "idle"


def ask_nothing(device: CartpoleDevice, command: Command) -> list[int]:
    """Return the drive's answers to a remote frame, without its reports."""
    run(device, ticks=5 - device.device_ns // MS % 5 + 1)
    return [i for i, _ in run(device, FRAME.pack(command | REMOTE, 8, b""))]


def test_values_by_hand() -> None:
    """Protocol 2, an ODrive Pro (4.4.58), firmware 0.6.11; 24 V; a drive at rest has no current and no power.

    0.1 N*m at 8.27 / 270 N*m/A are 3.265 A. 2 rev/s at 0.1 N*m are 2 * 2 pi * 0.1 = 1.257 W.
    """
    device = drive()
    assert ask(device, Command.VERSION) == (2, 4, 4, 58, 0, 6, 11, 0)
    assert ask(device, Command.ERROR) == (0, 0)
    assert ask(device, Command.BUS_VOLTAGE_CURRENT) == (24.0, 0.0)
    assert ask(device, Command.IQ) == ask(device, Command.POWERS) == (0.0, 0.0)
    run(device, pack(0, Command.SET_CONTROLLER_MODE, TORQUE_CONTROL, PASSTHROUGH))
    run(device, pack(0, Command.SET_LIMITS, 100.0, 50.0), pack(0, Command.SET_AXIS_STATE, CLOSED_LOOP))
    run(device, FRAME.pack(Command.SET_INPUT_TORQUE, 4, struct.pack("<f", 0.1)), ticks=30)
    assert ask(device, Command.IQ) == pytest.approx((3.265, 3.265), rel=1e-3)
    _, speed = ask(device, Command.ENCODER_ESTIMATES)
    assert isinstance(speed, float)
    electrical, mechanical = ask(device, Command.POWERS)
    assert mechanical == pytest.approx(0.1 * 2 * math.pi * speed, rel=0.05)
    assert electrical == mechanical


def test_velocity_control_turns_at_the_velocity() -> None:
    """ODrive's can_simple.py: 1 rev/s is 40 mm/s; after 1 s at it the cart has gone about 40 mm."""
    device = drive()
    run(device, pack(0, Command.SET_CONTROLLER_MODE, VELOCITY_CONTROL, PASSTHROUGH))
    run(device, pack(0, Command.SET_VEL_GAINS, 0.02, 0.1), pack(0, Command.SET_AXIS_STATE, CLOSED_LOOP))
    start = device.true_position[0]
    run(device, pack(0, Command.SET_INPUT_VEL, 1.0, 0.0), ticks=1000)
    _, speed = ask(device, Command.ENCODER_ESTIMATES)
    assert speed == pytest.approx(1.0, abs=0.1)
    assert device.true_position[0] - start == pytest.approx(0.04, abs=0.01)


def test_the_feed_forward_of_a_position_is_in_thousandths() -> None:
    """vel_ff 2000 is 2 rev/s: without a position gain the motor turns at it."""
    device = drive()
    run(device, pack(0, Command.SET_POS_GAIN, 0.0), pack(0, Command.SET_VEL_GAINS, 0.02, 0.1))
    run(device, pack(0, Command.SET_AXIS_STATE, CLOSED_LOOP))
    run(device, pack(0, Command.SET_INPUT_POS, 12.0, 2000, 0), ticks=800)
    assert ask(device, Command.ENCODER_ESTIMATES)[1] == pytest.approx(2.0, abs=0.2)


def test_the_reason_of_a_stop_is_kept() -> None:
    """Get_Error has the errors and what disarmed the motor; Clear_Errors clears the first."""
    device = drive()
    run(device, pack(0, Command.SET_AXIS_STATE, CLOSED_LOOP), pack(0, Command.ESTOP))
    stop = int(AxisError.ESTOP_REQUESTED)
    assert ask(device, Command.ERROR) == (stop, stop)
    run(device, FRAME.pack(Command.CLEAR_ERRORS, 0, b""), FRAME.pack(Command.CLEAR_ERRORS, 1, b"\0"))
    assert ask(device, Command.ERROR) == (0, stop)


def test_addresses_are_given_as_can_enumerate_does() -> None:
    """All are asked; the serial number chooses who gets a number, and who had the number has none."""
    device = drive()
    node, serial, _ = ask(device, Command.ADDRESS, node=0x3F)
    assert node == 0
    assert isinstance(serial, bytes)
    run(device, FRAME.pack(0x3F << 5 | Command.ADDRESS, 7, bytes([9]) + serial))
    assert ask(device, Command.ADDRESS, node=0x3F)[0] == 9
    assert {identifier >> 5 for identifier, _ in run(device, ticks=20)} == {9, PARTS.encoder}
    run(device, FRAME.pack(0x3F << 5 | Command.ADDRESS, 7, bytes([9]) + b"others"))
    assert ask(device, Command.ADDRESS, node=0x3F)[0] == 0x3F
    # Without a number it sends nothing of its own accord.
    assert {identifier >> 5 for identifier, _ in run(device, ticks=20)} == {PARTS.encoder}


def test_a_restart_forgets_what_was_not_saved() -> None:
    """Reboot 1 saves: gains written before stay, a number given afterwards is lost with reboot 0."""
    device = drive()
    pos_gain = ENDPOINTS["axis0.controller.config.pos_gain"].number
    run(device, pack(0, Command.SET_AXIS_STATE, CLOSED_LOOP), pack(0, Command.SET_POS_GAIN, 3.0))
    silent = run(device, pack(0, Command.REBOOT, 1), ticks=BOOT_TICKS - 10)
    assert {identifier >> 5 for identifier, _ in silent} == {PARTS.encoder}
    assert device.mode == "idle"
    run(device, ticks=15)
    assert struct.unpack("<f", read(device, pos_gain)) == (3.0,)
    run(device, pack(0, Command.SET_POS_GAIN, 4.0))
    run(device, pack(0, Command.REBOOT, 0), ticks=BOOT_TICKS + 5)
    assert struct.unpack("<f", read(device, pos_gain)) == (3.0,)


def test_settings_are_read_with_four_bytes() -> None:
    """can_param_access.py: read without a value, write in the setting's own size, call with an argument."""
    device = drive()
    listed = json.loads(json.dumps(flat_endpoints()))
    assert listed["fw_version"] == "0.6.11"
    assert listed["hw_version"] == "4.4.58"
    entries = listed["endpoints"]
    number = entries["axis0.controller.config.vel_integrator_limit"]["id"]
    data = struct.pack("<BHBf", 1, number, 0, 1.234)
    confirmed = run(device, FRAME.pack(Command.RX_SDO, len(data), data))
    assert (Command.TX_SDO, struct.pack("<BHx", 0, number)) in confirmed
    assert struct.unpack("<f", read(device, number)) == pytest.approx((1.234,))
    watched = struct.pack("<BHB?", 1, ENABLE_WATCHDOG, 0, True)
    run(device, FRAME.pack(Command.RX_SDO, len(watched), watched))
    assert read(device, ENABLE_WATCHDOG) == b"\1\0\0\0"
    call = struct.pack("<BHBI", 1, entries["get_adc_voltage"]["id"], 0, 1)
    answers = dict(run(device, FRAME.pack(Command.RX_SDO, len(call), call)))
    assert struct.unpack_from("<f", answers[Command.TX_SDO], 4) == (0.0,)
    # A measurement is not written, and a number that no setting has is not answered.
    state = ENDPOINTS["axis0.current_state"].number
    tried = struct.pack("<BHBB", 1, state, 0, 8)
    assert Command.TX_SDO not in dict(run(device, FRAME.pack(Command.RX_SDO, len(tried), tried)))
    assert read(device, state)[0] == IDLE
    unknown = struct.pack("<BHx", 0, 9999)
    assert Command.TX_SDO not in dict(run(device, FRAME.pack(Command.RX_SDO, 4, unknown)))


def test_the_adapter_passes_remote_and_extended_frames() -> None:
    """slcan: r asks the drive; T and R reach nobody here; all are acknowledged as Lawicel's page says."""
    adapter = SlcanAdapter([drive()], CanFaults())
    adapter.receive(b"S6\rO\r")
    adapter.tick()
    adapter.receive(b"r0000\rT000000070\rR000000070\r")
    answer = adapter.tick()
    assert answer.startswith(b"z\rZ\rZ\r")
    assert b"t00080204043A00060B00\r" in answer
    adapter.receive(b"r0009\rT0000000\rr000\rR0000000701\r")
    assert adapter.tick() == b"\a\a\a\a"


def test_an_emulated_drive_may_have_the_factory_number() -> None:
    """`emulate cartpole --transport odrive --node 0`, as the docs have it."""
    emulator = odrive_emulator(
        nominal_truth("ideal"), link=None, hazards=Hazards(can=CanFaults(node=0)), firmware="python"
    )
    port = emulator.open()
    emulator.close()
    assert "&node=0" in port
