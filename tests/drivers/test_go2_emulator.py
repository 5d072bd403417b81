"""The emulated Go2 in time: on a clock that the test sets and a wire in memory, and as a process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.memory_wire import MemoryWire

from deal_hw.cli.emulate import KINDS as EMULATE
from deal_hw.cli.emulate import emulate
from deal_hw.clock import MonotonicClock, VirtualClock
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.faults import FaultPlan, Go2Faults
from deal_hw.drivers.go2.emulator.sport_controller import STANDING
from deal_hw.drivers.go2.emulator.truth import nominal_truth
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.emulated_faults import SHARES
from deal_hw.drivers.unitree.emulator import UnitreeEmulator
from deal_hw.drivers.unitree.rpc import Request, decode_response, encode_request
from deal_hw.errors import ConfigurationError, TransportTimeoutError, UnknownNameError
from deal_hw.robots.connect import make_topic_transport
from deal_hw.transport import Message, WireOptions
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.emulation.settings import Go2Options
from deal_hw.workflows.emulation.topics import free_port, summary

MS = 1_000_000
ZERO = np.zeros(12)
STAND = LowCommandEncoder().encode(LowCommand(STANDING, ZERO, np.full(12, 60.0), np.full(12, 5.0), ZERO))


class Bench:
    """An emulator whose time the test moves."""

    def __init__(self, **options: Any) -> None:
        self.clock = VirtualClock(5_000 * MS)
        self.device = Go2Device(nominal_truth(), **options)
        self.wire = MemoryWire()
        self.emulator = UnitreeEmulator(self.device, self.wire, self.clock)
        self.emulator.open()

    def run(self, milliseconds: int) -> list[Message]:
        """Step through the milliseconds; return what was sent."""
        self.wire.sent.clear()
        for _ in range(milliseconds):
            self.emulator.step()
        return self.wire.sent

    def ticks(self) -> list[int]:
        """Return the ticks of the states of the last run [ms]."""
        return [decode_low_state(m.payload).tick_ms for m in self.wire.sent if m.channel == topics.LOW_STATE]


def test_device_time_follows_the_clock() -> None:
    """A step is a tick at its own deadline: 100 steps end 99 ms after the first."""
    bench = Bench(sport="")
    bench.run(100)
    assert bench.ticks() == list(range(0, 100, 2))
    assert bench.clock.now_ns() == 5_099 * MS
    assert bench.emulator.slips == bench.emulator.late == 0


def test_it_reads_and_writes_what_the_robot_does() -> None:
    """It subscribes commands and requests; rt/lowcmd is written only where sport mode is to be seen."""
    wire = Bench(sport="normal").wire
    assert wire.is_open
    assert topics.LOW_COMMAND in wire.published
    assert wire.subscribed == {topics.LOW_COMMAND, *(topics.request(name) for name in topics.SERVICES)}
    assert wire.published <= set(topics.TYPES)
    assert topics.LOW_COMMAND not in Bench(sport="normal", sport_on_wire=False).wire.published


def test_commands_and_requests_arrive() -> None:
    """A command moves the log, with the host's stamp; a request is answered within a tick."""
    bench = Bench(sport="normal")
    bench.wire.arriving.append(Message(topics.LOW_COMMAND, STAND, 77))
    request = encode_request(Request(5, 1001))
    bench.wire.arriving.append(Message(topics.request("motion_switcher"), request, 78))
    sent = bench.run(1)
    (answer,) = [m for m in sent if m.channel == topics.response("motion_switcher")]
    assert decode_response(answer.payload).json() == {"form": "0", "name": "normal"}
    assert bench.device.log.changes == [(0, 77, "stiff")]


def test_a_short_stall_is_caught_up() -> None:
    """40 ms behind are made good at once, and counted as late."""
    bench = Bench(sport="")
    bench.run(2)
    bench.clock.advance_ns(40 * MS)
    bench.run(1)
    assert bench.ticks() == list(range(2, 42, 2))
    assert (bench.emulator.late, bench.emulator.slips) == (1, 0)


def test_a_long_stall_stops_the_robots_time() -> None:
    """After a second away no burst of old states comes; the robot's clock stood still once."""
    bench = Bench(sport="")
    bench.run(2)
    bench.clock.advance_ns(1000 * MS)
    bench.run(4)
    assert bench.ticks() == [2, 4]
    report = bench.emulator.report()
    assert (report["slips"], report["late_ticks"]) == (1, 1)
    assert report["origin_host_ns"] == 5_000 * MS + 999 * MS


def test_a_flood_does_not_stop_time() -> None:
    """Of a thousand commands at once a tick takes 200, the next one goes on."""
    bench = Bench(sport="")
    bench.wire.arriving.extend(Message(topics.LOW_COMMAND, STAND, 0) for _ in range(1000))
    bench.run(2)
    assert bench.device.log.accepted == 400


def test_a_cut_wire_does_not_stop_the_robot() -> None:
    """What cannot be sent is counted; the robot goes on."""
    bench = Bench(sport="", remote=None)
    bench.wire.broken = True
    bench.run(11)
    # Six states, and one copy at the slow rate.
    assert bench.emulator.report()["unsent"] == 7


@pytest.mark.real_time
@pytest.mark.parametrize("transport", ["dds", "zenoh"])
@pytest.mark.parametrize(
    "shares", [{"corrupt": 0.6}, dict.fromkeys(SHARES, 1.0), dict.fromkeys(SHARES[1:], 1.0)]
)
def test_its_own_faults_do_not_end_it(transport: str, shares: dict[str, float], dds_domain: int) -> None:
    """On a real wire, whatever bytes are changed: what the wire refuses is counted, the robot goes on."""
    pytest.importorskip({"dds": "cyclonedds", "zenoh": "zenoh"}[transport])
    clock = VirtualClock(5_000 * MS)
    device = Go2Device(nominal_truth(), sport="", plan=FaultPlan(**shares))  # type: ignore[arg-type]
    port = free_port({"dds": "127.0.0.1", "zenoh": "tcp/127.0.0.1:0"}[transport])
    wire = make_topic_transport(
        transport,
        port,
        MonotonicClock(),
        WireOptions(listen=True) if transport == "zenoh" else WireOptions(domain=dds_domain),
    )
    emulator = UnitreeEmulator(device, wire, clock)
    emulator.open()
    try:
        # At a share of 0.6, one state in 500 has another CDR header, which DDS refuses.
        for _ in range(4000):
            emulator.step()
    finally:
        emulator.close()
    report = emulator.report()
    assert report["device_ms"] == 4000
    faults = report["wire_faults"]
    assert faults["drop"] == 2000 if "drop" in shares else faults["corrupt"] >= 1000
    assert (report["unsent"] > 0) == (transport == "dds" and "drop" not in shares)


def test_the_summary_says_what_happened() -> None:
    """Faults come with the time to damping, or with its absence."""
    bench = Bench(sport="")
    bench.run(2)
    bench.device.begin_fault("hot")
    assert bench.device.log.faults[0].begin_host_ns == 5_002 * MS
    bench.run(2)
    assert summary(bench.emulator.report()) == [
        "emulator: 0.0 s, 2 states sent, 0 ticks late (worst 0.0 ms), 0 stalls, 0 messages not sent",
        "commands: 0 taken, 0 refused, the last kind: none; sport mode: released",
        "fault hot at 0.002 s: no damping since",
    ]


# The command line.


def test_wrong_options_are_refused_before_anything_opens() -> None:
    """Unknown wires, options of the other robot and contradictions are named."""
    with pytest.raises(UnknownNameError, match="unknown transport 'serial'; known: dds, zenoh"):
        EMULATE.settings(robot="go2", transport="serial")
    with pytest.raises(UnknownNameError, match="robot to emulate 'spot'; known: cartpole, go2"):
        EMULATE.settings(robot="spot")
    both = r"settings cartpole 'go2'; .*`settings go2` and `settings b2` have it"
    with pytest.raises(UnknownNameError, match=both):
        EMULATE.settings(go2=Go2Options(on_stand=True, faults=Go2Faults(push=5.0)))
    with pytest.raises(ConfigurationError, match="--tick-start-ms -1 ms: allowed are 0 to 4294967295 ms"):
        Go2Options(tick_start_ms=-1)
    contradiction = Go2Options(no_remote=True, remote_script=Path("x"))
    with pytest.raises(ConfigurationError, match="--no-remote and --remote-script exclude each other"):
        emulate(EMULATE.settings(robot="go2", transport="zenoh", go2=contradiction))


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", "truth.json cannot be read"), ("[]", "should be an object"), ("{}", "is missing")],
)
def test_a_file_that_holds_no_truth_is_refused(tmp_path: Path, text: str, message: str) -> None:
    """Whatever is in the file, the error says what writes one."""
    path = tmp_path / "truth.json"
    path.write_text(text)
    for robot in ("go2", "cartpole"):
        with pytest.raises(ConfigurationError, match=message):
            emulate(EMULATE.settings(robot=robot, truth_from=path))


def test_a_free_port_is_found() -> None:
    """Number 0 becomes a number; anything else stays; an address of others is an error."""
    assert free_port("tcp/127.0.0.1:7447") == "tcp/127.0.0.1:7447"
    assert free_port("127.0.0.1") == "127.0.0.1"
    found = free_port("tcp/127.0.0.1:0")
    assert found.startswith("tcp/127.0.0.1:")
    assert int(found.rpartition(":")[2]) > 0
    with pytest.raises(ConfigurationError, match=r"port 'tcp/192\.0\.2\.1:0'"):
        free_port("tcp/192.0.2.1:0")


@pytest.mark.real_time
def test_over_zenoh_as_a_process(tmp_path: Path) -> None:
    """A client releases sport mode and commands, sees ticks that count up; at the end it prints the truth."""
    pytest.importorskip("zenoh")
    revealed = tmp_path / "truth.json"
    process = EmulatorProcess(
        "go2",
        "--transport",
        "zenoh",
        "--port",
        "tcp/127.0.0.1:0",
        "--seed",
        "3",
        "--start",
        "standing",
        "--hot-after-s",
        "0",
        "--reveal-to",
        str(revealed),
    )
    with process:
        client = make_topic_transport("zenoh", process.port, MonotonicClock(), WireOptions())
        asked = topics.request("motion_switcher")
        answers = topics.response("motion_switcher")
        client.declare(publish=(asked, topics.LOW_COMMAND), subscribe=(answers, topics.LOW_STATE))
        with client:
            clock = MonotonicClock()
            end_ns = clock.now_ns() + 20_000 * MS
            wanted = {topics.LOW_STATE, answers, "hot"}
            ticks: list[int] = []
            while wanted and clock.now_ns() < end_ns:
                client.send(Message(asked, encode_request(Request(9, 1003)), 0))
                client.send(Message(topics.LOW_COMMAND, STAND, 0))
                for _ in range(20):
                    try:
                        message = client.receive(0.5)
                    except TransportTimeoutError:
                        break
                    wanted.discard(message.channel)
                    if message.channel == topics.LOW_STATE:
                        state = decode_low_state(message.payload)
                        ticks.append(state.tick_ms)
                        if state.temperature.max() == 95:
                            wanted.discard("hot")
            assert not wanted
            assert ticks == sorted(ticks)
        out, messages = process.stop()
    assert "profile realistic, seed 3, on zenoh" in out
    assert "fault hot at" in messages
    report = json.loads(revealed.read_text())
    assert report["commands"]["accepted"] > 0
    assert report["requests_answered"] > 0
    assert report["stiffness"]["FL_hip_joint"] != 1.0
    again = EMULATE.settings(
        robot="go2", transport="zenoh", port="tcp/127.0.0.1:0", truth_from=revealed, duration_s=0.0
    )
    assert emulate(again) == 0
