"""The C core on CAN: frames against cantools and the DBC; bit-equal to the state machine in Python."""

import random
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from firmware_inputs import CAN, IntegerServo, outputs
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.cli.emulate import KINDS as EMULATE
from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.chips.controller import Controller, Firmware, Mode
from deal_hw.drivers.cartpole.chips.host_firmware import CanHostFirmware, Settings, library, settings_of
from deal_hw.drivers.cartpole.emulator.can_emulator import can_device, can_devices
from deal_hw.drivers.cartpole.emulator.faults import CanFaults
from deal_hw.drivers.cartpole.emulator.odrive_drive import OdriveFirmware
from deal_hw.drivers.cartpole.emulator.odrive_emulator import PoleEncoder, odrive_device
from deal_hw.drivers.cartpole.emulator.slcan_adapter import SlcanAdapter
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading
from deal_hw.drivers.cartpole.plant.truth import candidate_truth, nominal_truth
from deal_hw.drivers.cartpole.robots.can_robot import CanFrames
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import FRAME, CanLink, accept, database, frame_id
from deal_hw.drivers.cartpole.wire.odrive_link import OdriveSettings
from deal_hw.drivers.cartpole.wire.protocol import Target
from deal_hw.drivers.transports.slcan_transport import SlcanTransport
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import ConfigurationError, UnknownNameError, VersionMismatchError, WrongDeviceError
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.faults import FaultyTransport, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite

pytestmark = pytest.mark.skipif(
    shutil.which(native.compiler()) is None, reason="no C compiler: apt-get install gcc libc6-dev"
)
PAGE = Path(__file__).parents[2] / "docs" / "reference" / "protocol-cartpole-can.md"
NOMINAL = Settings(65536, 65536, 65536, 65536, 0xE000_0003, 0)
STILL = Motor(0.0, 0.0)
U8, U16, U32 = (st.integers(0, 2**n - 1) for n in (8, 16, 32))
I32 = st.integers(-(2**31), 2**31 - 1)
NODES = st.integers(1, 62)


def core(node: int = 1, version: int = 1, unique_id: int = 0xE000_0003) -> CanHostFirmware:
    """Return the core with nominal trims, whose targets act at once."""
    return CanHostFirmware(Settings(65536, 65536, 65536, 65536, unique_id, 0), lambda: 0, node, version)


def armed(firmware: CanHostFirmware, node: int = 1) -> CanHostFirmware:
    """Home and arm."""
    firmware.receive(packed("Home", node, Request=254, Version=1), STILL)
    firmware.finish_homing()
    firmware.receive(packed("Arm", node, Request=255, Version=1), STILL)
    assert firmware.mode is Mode.ARMED
    return firmware


def packed(name: str, node: int = 1, **signals: int) -> bytes:
    """Return a frame as cantools writes it from the DBC."""
    data = database()[name].encode(signals, scaling=False)
    return FRAME.pack(node << 5 | database()[name].frame_id & 0x1F, len(data), data)


def unpacked(data: bytes, node: int = 1) -> list[tuple[str, dict[str, int], bytes]]:
    """Return frames as cantools reads them: name, raw signals, data."""
    names = {message.frame_id & 0x1F: name for name, message in database().items()}
    found = []
    for identifier, length, payload in FRAME.iter_unpack(data):
        assert identifier >> 5 == node
        name = names[identifier & 0x1F]
        assert length == database()[name].length
        assert payload[length:] == bytes(8 - length)
        values = database()[name].decode(payload[:length], decode_choices=False, scaling=False)
        assert isinstance(values, dict)
        found.append((name, {key: int(value) for key, value in values.items()}, payload[:length]))  # type: ignore[arg-type]
    return found


def target_frames(target: Target, crc: Callable[[bytes], int], node: int = 1) -> list[bytes]:
    """Return a target's frames, signal by signal from the DBC, with a CRC from its definition."""
    frames = [
        packed("Target1", node, Sequence=target.sequence, Position=target.position_um),
        packed("Target2", node, Stiffness=target.stiffness_mn_m, Damping=target.damping_mns_m),
    ]
    third = {"EffortLimit": target.effort_limit_mn, "SpeedLimit": target.speed_limit_um_s}
    body = b"".join(FRAME.unpack(frame)[2] for frame in frames)
    last = database()["Target3"].encode({**third, "Crc": 0}, scaling=False)[:6]
    return [*frames, packed("Target3", node, **third, Crc=crc(b"\1" + body + last))]


# Frame by frame against the DBC.


@given(I32, I32, I32, I32, NODES, st.integers(1, 255), st.booleans())
def test_states_and_heartbeats_are_what_the_dbc_says(
    crc_bit_by_bit: Callable[[bytes], int],
    cart: int,
    cart_speed: int,
    pole: int,
    pole_speed: int,
    node: int,
    version: int,
    stopped: bool,
) -> None:
    """21 states, signal by signal as cantools reads them, with two heartbeats; the CRC by its definition."""
    firmware = core(node, version)
    beats = 0
    for sequence in range(21):
        for _ in range(5):
            _, due = firmware.control(STILL)
            if due:
                frames = unpacked(
                    firmware.report(Reading(cart, cart_speed, pole, pole_speed, 0.0, stopped)), node
                )
        values = {key: value for _, signals, _ in frames[:5] for key, value in signals.items()}
        data = b"".join(payload for *_, payload in frames[:5])
        assert [name for name, *_ in frames[:5]] == [f"State{k}" for k in range(1, 6)]
        assert values == {
            "Sequence": sequence,
            "CommandSequence": protocol.NO_COMMAND,
            "DeviceTime": 5000 * sequence,
            "Status": 64 * stopped,
            "SequenceLow": sequence,
            "CartPosition": cart,
            "CartVelocity": cart_speed,
            "PolePosition": pole,
            "PoleVelocity": pole_speed,
            "Effort": 0,
            "CommandAge": 0,
            "Crc": crc_bit_by_bit(bytes([version]) + data[:-2]),
        }
        if frames[5:]:
            beats += 1
            assert [(name, signals) for name, signals, _ in frames[5:]] == [
                (
                    "Heartbeat",
                    {
                        "UniqueIdLow": 0xE000_0003,
                        "Version": version,
                        "Status": 64 * stopped,
                        "TransmitErrors": 0,
                        "ReceiveErrors": 0,
                    },
                )
            ]
    assert beats == 2


@given(st.sampled_from(["Stop", "Arm", "Home"]), U8, U8, NODES)
def test_requests_are_answered_as_the_dbc_says(name: str, request: int, version: int, node: int) -> None:
    """Stop in any version; arm is refused before homing; arm and home of another version are errors."""
    firmware = core(node)
    out = firmware.receive(packed(name, node, Request=request, Version=version), STILL)
    if name != "Stop" and version != 1:
        assert (out, firmware.frame_errors, firmware.homings) == (b"", 1, 0)
        return
    of = {"Arm": 2, "Stop": 3, "Home": 4}[name]
    ((found, signals, _),) = unpacked(out, node)
    assert found == "Ack"
    assert signals == {"Request": request, "Of": of, "Result": int(name == "Arm"), "Version": 1}


@given(U8, U8, U32, NODES, st.integers(1, 255))
def test_info_is_what_the_dbc_says(
    crc_bit_by_bit: Callable[[bytes], int], request: int, asked: int, number: int, node: int, version: int
) -> None:
    """Whoever asks, in whatever version; the CRC begins with 0 in place of the version."""
    out = core(node, version, number).receive(packed("Hello", node, Request=request, Version=asked), STILL)
    frames = unpacked(out, node)
    assert [name for name, *_ in frames] == [f"Info{k}" for k in range(1, 6)]
    data = b"".join(payload for *_, payload in frames)
    assert {key: value for _, signals, _ in frames for key, value in signals.items()} == {
        "Request": request,
        "Version": version,
        "DeviceRate": 1000,
        "StateRate": 200,
        "Kind1": int.from_bytes(b"cartpole", "little"),
        "Kind2": 0,
        "UniqueId": number,
        "Major": 0,
        "Minor": 1,
        "Patch": 0,
        "Crc": crc_bit_by_bit(bytes(1) + data[:-2]),
    }


TARGETS = st.builds(
    Target,
    st.integers(0, protocol.NO_COMMAND - 1),
    st.integers(-400_000, 400_000),
    st.integers(0, 2**31 - 1),
    st.integers(0, 2**31 // 1000 - 1),
    U16,
    st.integers(400_000_000, 500_000_000),
)


@given(TARGETS, NODES)
def test_a_target_from_the_dbc_acts(
    crc_bit_by_bit: Callable[[bytes], int], target: Target, node: int
) -> None:
    """Every field that cantools packed arrives: the force by hand; sequence and age in the next state."""
    firmware = armed(core(node), node)
    for frame in target_frames(target, crc_bit_by_bit, node):
        assert firmware.receive(frame, STILL) == b""
    motor = Motor(0.001, 2**-4)
    force, _ = firmware.control(motor)
    # The speed limit lets the set-point arrive in one tick: K e - D v, cut at the limit, in pN.
    demand = target.stiffness_mn_m * (target.position_um * 1000 - 1_000_000)
    demand -= target.damping_mns_m * 1000 * 62_500
    limit = target.effort_limit_mn * 10**9
    assert force == max(-limit, min(limit, demand)) * 1e-12
    while not firmware.control(motor)[1]:
        pass
    signals = {
        k: v for _, s, _ in unpacked(firmware.report(Reading(0, 0, 0, 0, 0.0)), node) for k, v in s.items()
    }
    assert signals["CommandSequence"] == target.sequence
    assert signals["CommandAge"] == 5000


@given(st.lists(st.integers(0, 2), min_size=3, max_size=12))
def test_torn_targets_are_counted_and_do_not_act(order: list[int]) -> None:
    """Frames of one target in any order: it acts for a run 1, 2, 3; the link in Python counts the same."""
    frames = [CanLink().encode(Target(7, 1, 2, 3, 4, 5))[k * FRAME.size :][: FRAME.size] for k in range(3)]
    data = b"".join(frames[k] for k in order)
    link, firmware = CanLink(device=True), armed(core())
    taken = len(list(link.decode(data)))
    firmware.receive(data, STILL)
    firmware.control(STILL)
    found = unpacked(firmware.report(Reading(0, 0, 0, 0, 0.0)))
    assert found[1][1]["Status"] & 1
    assert found[0][1]["CommandSequence"] == (7 if taken else protocol.NO_COMMAND)
    torn = [signals for name, signals, _ in found if name == "Errors"]
    assert [signals["TornMessages"] for signals in torn] == [link.torn] * (link.torn > 0)


@given(st.integers(0, 21), st.integers(0, 7))
def test_a_changed_bit_in_a_target_is_noticed(byte: int, bit: int) -> None:
    """A CRC finds every single wrong bit, those of the CRC included."""
    firmware = armed(core())
    data = bytearray(CanLink().encode(Target(7, 1000, 80_000, 8_000, 4_000, 1_000_000)))
    data[byte // 8 * FRAME.size + 8 + byte % 8] ^= 1 << bit
    firmware.receive(bytes(data), STILL)
    firmware.control(STILL)
    assert firmware.frame_errors == 1
    assert unpacked(firmware.report(Reading(0, 0, 0, 0, 0.0)))[0][1]["CommandSequence"] == protocol.NO_COMMAND


def test_test_vectors_of_the_protocol_page() -> None:
    """What a device sends is, byte for byte, what the page has; what it takes, it takes from there."""
    rows = {
        expression: b"".join(
            FRAME.pack(int(identifier, 16), len(bytes.fromhex(data)), bytes.fromhex(data))
            for identifier, data in re.findall(r"`([0-9A-F]{3})` `([0-9a-f ]+)`", cell)
        )
        for expression, cell in re.findall(r"^\| `(\w+\(.*\))` \| (.*) \|$", PAGE.read_text(), re.MULTILINE)
    }
    frames = {expression.partition("(")[0]: data for expression, data in rows.items()}
    assert list(frames) == ["Hello", "Info", "Arm", "Stop", "Home", "Ack", "Target", "State", "Angle"]
    firmware = core()
    assert firmware.receive(frames["Hello"], STILL) == frames["Info"]
    assert firmware.receive(frames["Arm"], STILL) == frames["Ack"]
    firmware.receive(frames["Home"] + frames["Stop"], STILL)
    assert (firmware.mode, firmware.homings) == (Mode.IDLE, 1)
    armed(firmware)
    firmware.receive(frames["Target"], STILL)
    # -12.345 mm lie beyond 1 m/s times 1 ms: 80 N/m times -1 mm.
    assert firmware.control(STILL)[0] == pytest.approx(-0.08, abs=1e-12)
    assert firmware.frame_errors == 0
    assert firmware.report(Reading(0, 0, 0, 0, 0.0))[: FRAME.size] == FRAME.pack(
        0x28, 8, bytes(4) + b"\2\1\0\0"
    )


def test_the_state_of_the_protocol_page() -> None:
    """Its 2103rd state, 19 ms after target 499: 80 N/m and 8 N s/m demand -0.756 N at that set-point."""
    (expected,) = re.findall(r"^\| `State\(.*\)` \| (.*) \|$", PAGE.read_text(), re.MULTILINE)
    frames = re.findall(r"`([0-9A-F]{3})` `([0-9a-f ]+)`", expected)
    firmware, link = armed(core()), CanLink()
    for tick in range(10_511):
        if tick % 100 == 0 and tick < 10_491:
            firmware.receive(link.encode(Target(1000 + tick, 0, 80_000, 8_000, 4_000, 1_000)), STILL)
        if tick == 10_491:
            firmware.receive(link.encode(Target(499, 300_000, 80_000, 8_000, 4_000, 1_000)), STILL)
        if firmware.control(STILL)[1]:
            found = firmware.report(Reading(-40_200, 128_748, -2_824_507, -673_565, -0.0367752))
    assert found == b"".join(FRAME.pack(int(i, 16), 8, bytes.fromhex(data)) for i, data in frames)


def test_frames_of_other_devices_and_nodes_are_not_its_business() -> None:
    """States of a second device under its number, and requests to node 2, are no errors; number 7 is one."""
    firmware = core()
    state = CanLink(unique_id=5).encode(protocol.State(0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    for data in (state, packed("Home", 2, Request=1, Version=1), FRAME.pack(0x8000_0020, 2, b"\1\1")):
        assert firmware.receive(data, STILL) == b""
    assert (firmware.frame_errors, firmware.homings) == (0, 0)
    firmware.receive(FRAME.pack(0x27, 2, b"\1\1") + FRAME.pack(0x25, 3, b"\1\1"), STILL)
    assert firmware.frame_errors == 2
    firmware.receive(b"\0" * 17, STILL)
    assert firmware.frame_errors == 3


def test_the_count_of_errors_ends_at_its_largest_value() -> None:
    """70 000 unknown frames: its 16 bits do not wrap."""
    firmware = core()
    firmware.receive(FRAME.pack(0x27, 2, b"\1\1") * 70_000, STILL)
    firmware.control(STILL)
    (errors,) = [
        signals
        for name, signals, _ in unpacked(firmware.report(Reading(0, 0, 0, 0, 0.0)))
        if name == "Errors"
    ]
    assert errors == {"TornMessages": 65_535, "ReceiveOverflows": 0, "BusOffs": 0, "TransmitDrops": 0}


# Equal to the state machine in Python.


@pytest.mark.parametrize("seed", range(6))
def test_recorded_inputs_give_the_same_frames(seed: int) -> None:
    """3000 ticks of commands, garbage and watchdog stops; hidden trims, commands late by 0 to 28 ticks."""
    truth = candidate_truth("realistic", np.random.default_rng(seed), seed=seed, range_ratio=5.0, refused=0)
    first, second = random.Random(seed), random.Random(seed)
    trims = settings_of(truth, 0)
    link = CanLink(unique_id=trims.unique_id, device=True)
    python = Controller(IntegerServo(trims), trims.unique_id, lambda: first.randint(seed, 28), link)
    core = CanHostFirmware(trims, lambda: second.randint(seed, 28), 1)
    modes, errors = set(), 0
    for ours, theirs in zip(outputs(python, seed, wire=CAN), outputs(core, seed, wire=CAN), strict=True):
        assert theirs == ours
        modes.add(ours[2])
        errors += any(frame[0] == frame_id("Errors", 1) for frame in FRAME.iter_unpack(ours[0]))
    assert modes == {"IDLE", "HOMING", "ARMED"}
    assert errors > 0
    assert core.frame_errors == python.frame_errors > 0
    assert link.torn > 0


MESSAGES = st.one_of(
    st.builds(
        lambda *v: CanLink().encode(Target(*v)),
        st.integers(0, 3) | st.integers(4, 2**32 - 2),
        I32,
        U32,
        U32,
        U16,
        U32,
    ),
    st.builds(
        lambda kind, request: CanLink().encode(kind(request)),
        st.sampled_from([protocol.Arm, protocol.Arm, protocol.Home, protocol.Stop]),
        st.integers(0, 3),
    ),
    st.builds(lambda *v: CanLink().encode(protocol.Hello(*v)), U8, U8),
    st.builds(
        lambda number, length, data: FRAME.pack(0x20 | number, length, data),
        st.integers(0, 31),
        st.integers(0, 8),
        st.binary(max_size=8),
    ),
    st.builds(FRAME.pack, st.integers(0, 2**32 - 1), U8, st.binary(max_size=8)),
    st.binary(max_size=40),
)
TICKS = st.lists(
    st.tuples(
        st.lists(MESSAGES, max_size=3),
        st.builds(lambda p, v: Motor(p / 2**28, v / 2**18), I32, I32),
        st.builds(Reading, I32, I32, I32, I32, I32.map(lambda nm: nm / 2**30), st.booleans()),
        st.sampled_from((1, 3, 210)),
        st.integers(0, 4),
    )
)


@settings(deadline=None, max_examples=300)
@given(TICKS, st.tuples(*[U32 | st.just(65536)] * 4), NODES, st.integers(1, 2), st.booleans(), st.booleans())
def test_any_inputs_give_the_same_frames(
    ticks: list[tuple[list[bytes], Motor, Reading, int, int]],
    trims: tuple[int, int, int, int],
    node: int,
    version: int,
    homed: bool,
    encoder: bool,
) -> None:
    """Any frames, lost and moved ones, of two versions; positions, gains and trims of any size."""
    sent = Settings(*trims, 7, 0)
    link = CanLink(node, version, 7, device=True)
    both: list[Firmware] = [
        PoleEncoder(IntegerServo(sent), 7, link)
        if encoder
        else Controller(IntegerServo(sent), 7, lambda: 2, link),
        CanHostFirmware(sent, lambda: 2, node, version, encoder=encoder),
    ]
    ours = CanLink(node, version)
    found: list[list[object]] = [[], []]
    for firmware, seen in zip(both, found, strict=True):
        if homed:
            firmware.receive(ours.encode(protocol.Home(254)), STILL)
            firmware.finish_homing()
            firmware.receive(ours.encode(protocol.Arm(255)), STILL)
        for messages, motor, reading, repeat, lost in ticks:
            frames = [FRAME.unpack(m[k : k + 16]) for m in messages for k in range(0, len(m) // 16 * 16, 16)]
            moved = [
                FRAME.pack(f[0] - 0x20 + (node << 5) if f[0] >> 5 == 1 else f[0], *f[1:]) for f in frames
            ]
            seen.append(firmware.receive(b"".join(moved[:lost] + moved[lost + 1 :]), motor))
            seen.append(firmware.receive(b"".join(messages), motor))
            for _ in range(repeat):
                force, due = firmware.control(motor)
                seen += [force, firmware.report(reading) if due else b"", firmware.mode, firmware.setpoint]
        seen += [firmware.watchdog, firmware.homings, firmware.armings, firmware.frame_errors]
    assert found[1] == found[0]


# The driver in front of it.


def fake(message: protocol.AnyMessage | None) -> CartpoleRobot:
    """Return a driver in front of a node that always says the same."""
    clock = VirtualClock()
    answer = b"" if message is None else CanLink().encode(message)
    return CartpoleRobot(VirtualTransport(FakeDevice(answer), clock), clock, link=CanLink)


class TestCartpoleWithTheCore(RobotSuite):
    @pytest.fixture
    def bench(self) -> Iterator[RobotBench]:
        clock, fault = VirtualClock(), OneBadFrame(10)
        wire = VirtualTransport(can_device(nominal_truth("ideal"), firmware="host"), clock)
        known = protocol.Info(1, "toaster", (2, 3, 4), 1000, 200, 1)
        yield RobotBench(
            robot=CartpoleRobot(FaultyTransport(wire, received=fault), clock, link=CanLink),
            foreign=fake(known),
            newer=fake(protocol.Info(1, "cartpole", (2, 3, 4), 1000, 200, 1, 2)),
            silent=fake(None),
            unplug=wire.unplug,
            corrupt=fault.corrupt_next,
        )


class VirtualPort(VirtualTransport):
    """A serial port in virtual time that is never lost."""

    def reopen(self) -> None:
        """It still works."""

    def fileno(self) -> int:
        """Any number: nobody waits on it."""
        return 99


@pytest.mark.parametrize(
    ("faults", "error", "words"),
    [
        (CanFaults(duplicate_node=True), WrongDeviceError, "two devices use node 1"),
        (CanFaults(dbc_version=2), VersionMismatchError, "update deal-hw"),
    ],
)
def test_a_wrong_bus_is_refused(faults: CanFaults, error: type[Exception], words: str) -> None:
    """Two cores under one number, and a core of another version, behind an adapter."""
    clock = VirtualClock()
    adapter = SlcanAdapter(can_devices(nominal_truth(), faults, "host"), faults)
    transport = SlcanTransport("slcan:x", clock, accept(1), serial=VirtualPort(adapter, clock))
    with pytest.raises(error, match=words):
        CartpoleRobot(CanFrames(transport), clock, link=CanLink).connect()


def test_the_chip_without_can_is_no_firmware_here() -> None:
    """The ATmega328P has no CAN controller; servos have a firmware of their own."""
    with pytest.raises(UnknownNameError, match="firmware on CAN"):
        can_device(nominal_truth(), firmware="avr")
    with pytest.raises(UnknownNameError, match="firmware on CAN"):
        odrive_device(nominal_truth(), OdriveSettings(), firmware="avr")
    for wire in ("can", "odrive"):
        with pytest.raises(ConfigurationError, match="the ATmega328P has no CAN controller"):
            EMULATE.settings(robot="cartpole", transport=wire, firmware="avr")
        EMULATE.settings(robot="cartpole", transport=wire, firmware="host")
    with pytest.raises(ConfigurationError, match="`can` and `odrive` have this firmware"):
        EMULATE.settings(robot="cartpole", transport="dynamixel", firmware="host")


def test_an_emulated_node_runs_the_core_where_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    """auto: the C core; without a compiler the firmware in Python."""

    def nodes() -> list[object]:
        library.cache_clear()
        drive = odrive_device(nominal_truth(), OdriveSettings(), firmware="auto").firmware
        assert isinstance(drive, OdriveFirmware)
        return [can_device(nominal_truth(), firmware="auto").firmware, drive.encoder]

    assert [type(node) for node in nodes()] == [CanHostFirmware, CanHostFirmware]
    monkeypatch.setenv("CC", "no-such-compiler")
    assert [type(node) for node in nodes()] == [Controller, PoleEncoder]
    library.cache_clear()
