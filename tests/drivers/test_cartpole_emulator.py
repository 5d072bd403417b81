"""The emulator over a pty: here with a clock that the test sets, and as a process of its own."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fakes.waiting import PATIENCE_S, until

from deal_hw.cli.emulate import KINDS as EMULATE
from deal_hw.cli.emulate import emulate
from deal_hw.clock import MonotonicClock, VirtualClock
from deal_hw.control.process.realtime import process_state
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.emulator.faults import Hazards
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import (
    ConfigurationError,
    PortBusyError,
    TransportError,
    TransportLostError,
    UnknownNameError,
)
from deal_hw.robots.connect import adopt_robot, make_robot
from deal_hw.testing.pseudo_terminal import PseudoTerminal
from deal_hw.testing.robot_suite import default_command
from deal_hw.transport import Message
from deal_hw.types import Status
from deal_hw.workflows.emulation.process import EmulatorProcess

pytestmark = pytest.mark.real_time

MS = 1_000_000


class Bench:
    """An emulator whose time the test moves, and a port on it."""

    def __init__(self, hazards: Hazards | None = None, link: Path | None = None) -> None:
        self.clock = VirtualClock()
        self.device = CartpoleDevice(nominal_truth())
        self.emulator = PseudoTerminal(self.device, link=link, hazards=hazards, clock=self.clock)
        self.port = SerialTransport(self.emulator.open())
        self.port.open()
        self.decoder = protocol.FrameDecoder()

    def run(self, milliseconds: int, step_ms: int = 5) -> list[protocol.State]:
        """Let time pass; return the states that came over the pty."""
        found = []
        for _ in range(milliseconds // step_ms):
            self.clock.advance_ns(step_ms * MS)
            if not self.emulator.step(0.0):
                break
            found += self.states()
        return found

    def states(self) -> list[protocol.State]:
        """Return the states that are at hand."""
        messages: list[protocol.AnyMessage] = []
        while True:
            try:
                data = self.port.receive(0.0).payload
            except TimeoutError:
                return [m for m in messages if isinstance(m, protocol.State)]
            messages += [protocol.decode(p) for p in self.decoder.feed(data)]

    def send(self, message: protocol.AnyMessage) -> None:
        """Send as the host."""
        self.port.send(Message("", protocol.encode(message), 0))

    def arm(self) -> None:
        """Home and arm."""
        self.send(protocol.Home(1))
        self.run(550)
        self.send(protocol.Arm(2))
        self.run(20)
        assert self.device.armed

    def close(self) -> None:
        """Close both ends."""
        self.port.close()
        self.emulator.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


def test_device_time_follows_the_clock(bench: Bench) -> None:
    """One second of steps of 5 ms brings 201 states whose device time is the clock's."""
    found = bench.run(1000)
    assert len(found) == 201  # At 0, 5, ..., 1000 ms.
    assert found[-1].device_us == bench.clock.now_ns() // 1000


def test_a_stall_of_the_emulator_does_not_trip_the_watchdog(bench: Bench) -> None:
    """After a stall of 1 s device time stood still, once; a silent host trips the watchdog all the same."""
    bench.arm()
    bench.clock.advance_ns(1000 * MS)
    bench.run(50)
    assert bench.emulator.slips == 1
    assert bench.device.armed
    assert Status.WATCHDOG in Status(bench.run(200)[-1].status)


def test_a_short_stall_is_caught_up(bench: Bench) -> None:
    """40 ms behind are made good at once: eight frames, no slip."""
    bench.run(100)
    assert len(bench.run(40, step_ms=40)) == 8
    assert bench.emulator.slips == 0


def test_nobody_reading_drops_frames_and_a_later_host_is_served(bench: Bench) -> None:
    """After 10 s without a reader a host that opens the port gets whole frames of now."""
    bench.port.close()
    for _ in range(2000):
        bench.clock.advance_ns(5 * MS)
        bench.emulator.step(0.0)
    assert bench.emulator.dropped > 1000
    bench.port.open()
    bench.decoder = protocol.FrameDecoder()
    found = bench.run(500)
    assert found[-1].device_us == bench.clock.now_ns() // 1000
    assert len(found) >= 99


def test_the_firmware_freezes_on_request() -> None:
    """0.3 s after arming nothing comes any more, and the port is still there."""
    bench = Bench(Hazards(freeze_after_s=0.3))
    try:
        bench.arm()
        assert len(bench.run(1000)) in range(52, 62)
        assert bench.run(100) == []
        assert [what for _, _, what in bench.emulator.changes].count("frozen") == 1
    finally:
        bench.close()


def test_the_port_vanishes_on_request() -> None:
    """0.3 s after arming the host's port reports that the device is gone."""
    bench = Bench(Hazards(vanish_after_s=0.3))
    try:
        bench.arm()
        with pytest.raises(TransportLostError, match="check the cable"):
            bench.run(1000)
            bench.states()
    finally:
        bench.close()


def test_the_wire_is_cut_for_a_time() -> None:
    """0.3 s after arming nothing is received or sent for 0.4 s; the device's watchdog acts meanwhile."""
    bench = Bench(Hazards(cut_after_s=0.3, cut_s=0.4))
    try:
        bench.arm()
        assert len(bench.run(1000)) in range(201 - 90, 201 - 70)
        # Disarmed 0.2 s after the last word, 0.1 s before the cut: a robot goes on without its host.
        reported = [what for _, _, what in bench.emulator.changes]
        assert reported == ["homing", "held", "armed", "idle", "cut"]
        assert bench.emulator.report()["watchdog"]
        bench.emulator.cut()
        bench.send(protocol.Arm(3))
        assert bench.run(300) == []
        bench.run(300)
        assert not bench.device.armed
    finally:
        bench.close()


def test_the_port_comes_back_under_its_link(tmp_path: Path) -> None:
    """0.3 s after arming the cable is pulled for 0.5 s: a new port, and a device that lived on."""
    bench = Bench(Hazards(vanish_after_s=0.3, return_after_s=0.5), link=tmp_path / "robot")
    try:
        bench.arm()
        with pytest.raises(TransportLostError, match="check the cable"):
            bench.run(1000)
        assert not (tmp_path / "robot").exists()
        for _ in range(150):
            bench.clock.advance_ns(5 * MS)
            assert bench.emulator.step(0.0)
        bench.port.reopen()
        bench.decoder = protocol.FrameDecoder()
        state = bench.run(50)[-1]
        assert state.device_us == bench.clock.now_ns() // 1000
        assert Status.WATCHDOG in Status(state.status)
        times = {what: ns for _, ns, what in bench.emulator.changes}
        assert 500 * MS <= times["back"] - times["gone"] <= 510 * MS
        bench.arm()
        # It vanishes once.
        bench.run(1000)
    finally:
        bench.close()


def test_a_link_is_made_replaced_and_removed(tmp_path: Path) -> None:
    """The link points at the port while it exists; a stale link is replaced, a file is not."""
    link = tmp_path / "robot"
    link.symlink_to("/dev/nowhere")
    bench = Bench(link=link)
    assert link.is_symlink()
    assert os.readlink(link).startswith("/dev/")
    assert len(bench.run(100)) == 21  # At 0, 5, ..., 100 ms.
    bench.close()
    assert not link.is_symlink()
    link.write_text("mine")
    emulator = PseudoTerminal(CartpoleDevice(nominal_truth()), link=link)
    with pytest.raises(ConfigurationError, match="not a symbolic link"):
        emulator.open()
    assert link.read_text() == "mine"


def test_settings_are_checked() -> None:
    """Unknown names list the table, negative times and impossible rates are refused."""
    with pytest.raises(UnknownNameError, match="known: cartpole"):
        EMULATE.settings(robot="spot")
    with pytest.raises(UnknownNameError, match="known: serial"):
        EMULATE.settings(transport="smoke")
    with pytest.raises(ConfigurationError, match=r"--vanish-after-s -1\.0 s"):
        EMULATE.settings(vanish_after_s=-1.0)
    with pytest.raises(ConfigurationError, match="--return-after-s needs"):
        EMULATE.settings(vanish_after_s=1.0, return_after_s=1.0)
    with pytest.raises(ConfigurationError, match="exclude each other"):
        EMULATE.settings(nominal=True, truth_from=Path("truth.json"))
    with pytest.raises(ConfigurationError, match=r"--corrupt 1\.5: allowed are 0 to 1"):
        emulate(EMULATE.settings(nominal=True, corrupt=1.5))


def test_the_verb_runs_from_python_and_reveals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It prints the port first and the truth last, writes the same truth, and takes it back."""
    revealed = tmp_path / "truth.json"
    config = EMULATE.settings(profile="sensor", seed=5, duration_s=0.0, reveal=True, reveal_to=revealed)
    assert emulate(config) == 0
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("port /dev/")
    reported = json.loads(lines[-1])
    assert reported == json.loads(revealed.read_text())
    assert (reported["changes"], reported["last_mode"], reported["received_bytes"]) == ([], "idle", 0)
    assert emulate(EMULATE.settings(truth_from=revealed, duration_s=0.0, reveal=True)) == 0
    again = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert CartpoleTruth.from_json(again) == CartpoleTruth.from_json(reported)


def test_a_process_end_to_end(tmp_path: Path) -> None:
    """A parent opens the port and drives, a second collector is refused, a child's robot takes over."""
    clock = MonotonicClock()
    with EmulatorProcess(
        "cartpole", "--nominal", "--profile", "ideal", "--corrupt", "0.05", "--reveal"
    ) as emulator:
        robot = make_robot("cartpole", "serial", emulator.port, clock)
        assert isinstance(robot, CartpoleRobot)
        drive(robot)
        with pytest.raises(PortBusyError):
            make_robot("cartpole", "serial", emulator.port, clock).connect()
        child = adopt_robot("cartpole", "serial", os.dup(robot.fileno()), clock)
        drive(child)
        child.disconnect()
        robot.passive()
        robot.disconnect()
        again = make_robot("cartpole", "serial", emulator.port, clock)
        drive(again)
        again.disconnect()
        out, errors = emulator.stop()
    assert json.loads(out.splitlines()[-1])["parameters"]["cart.mass"] == 0.3
    assert "this computer stalled it" in errors


def test_a_process_that_loses_its_parent_ends() -> None:
    """An emulator whose parent is another process than the given one stops by itself."""
    emulator = EmulatorProcess("cartpole", "--nominal", "--parent", "1")
    emulator.start()
    process = emulator._process
    assert process is not None
    assert process.wait(10) == 0
    emulator.stop()


STARTER = """
import signal, subprocess, sys
if "nohup" in sys.argv:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
with open(sys.argv[1], "w") as out:
    command = [sys.executable, "-m", "deal_hw", "emulate", "cartpole", "--nominal", "--duration-s", "600"]
    print(subprocess.Popen(command, stdout=out).pid, flush=True)
sys.stdin.read()
"""
"""A script that starts an emulator as by hand, with its output in a file, and waits."""


@pytest.mark.parametrize("goes_on", [False, True], ids=["usual", "nohup"])
def test_an_emulator_that_was_started_by_hand_ends_with_its_starter(tmp_path: Path, goes_on: bool) -> None:
    """A killed script gives no signal. With nohup it goes on, as other programs do."""
    out = tmp_path / "printed"
    command = [sys.executable, "-c", STARTER, str(out), *["nohup"] * goes_on]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as starter:
        assert starter.stdout is not None
        pid = int(starter.stdout.readline())
        try:
            until(lambda: "next, in another terminal" in out.read_text(), "it emulates")
            starter.kill()
            starter.wait()
            if goes_on:
                robot = make_robot("cartpole", "serial", out.read_text().split()[1], MonotonicClock())
                drive(robot)
                robot.disconnect()
                os.kill(pid, signal.SIGTERM)
            until(lambda: process_state(pid) in "ZX", "it has ended")
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def test_an_emulator_ends_with_its_terminal() -> None:
    """A closed window, or a lost ssh connection: the kernel sends SIGHUP."""
    master, slave = os.openpty()
    # The first terminal that a new session opens is its own.
    in_terminal = (
        "import os, sys\n"
        "terminal = os.open(sys.argv[1], os.O_RDWR)\n"
        "for number in range(3):\n"
        "    os.dup2(terminal, number)\n"
        "os.execv(sys.executable, [sys.executable, '-m', 'deal_hw', 'emulate', *sys.argv[2:]])\n"
    )
    options = ["cartpole", "--nominal", "--duration-s", "600"]
    command = [sys.executable, "-c", in_terminal, os.ttyname(slave), *options]
    with subprocess.Popen(command, start_new_session=True) as emulator:
        with open(master, "rb", buffering=0) as terminal:
            printed = b""
            while b"next, in another terminal" not in printed:
                printed += terminal.read(4096)
            os.close(slave)
        try:
            assert emulator.wait(PATIENCE_S) is not None
        finally:
            emulator.kill()


def test_a_process_that_cannot_start_says_why() -> None:
    """The emulator's own error reaches whoever started it."""
    with pytest.raises(TransportError, match="spot"):
        EmulatorProcess("spot").start()


def drive(robot: object) -> None:
    """Connect, home, arm and send targets until ten were echoed; a loaded machine may trip the watchdog."""
    assert isinstance(robot, CartpoleRobot)
    robot.connect()
    robot.home(5.0)
    robot.arm(5.0)
    deadline = time.monotonic() + 30.0
    state = robot.read_state(5.0)
    while state.command_sequence < 9:
        assert time.monotonic() < deadline
        if state.status & Status.WATCHDOG:
            robot.arm(5.0)
        robot.send_command(default_command(robot))
        for _ in range(4):
            state = robot.read_state(5.0)
