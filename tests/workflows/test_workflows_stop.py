"""``deal-hw stop``: against real runs on emulated robots, hung ones too, and without a run."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fakes.go2 import STIFF as STIFF_COMMAND
from fakes.waiting import PATIENCE_S, until

from deal_hw.cli.main import main
from deal_hw.clock import VirtualClock
from deal_hw.control.process import run_end
from deal_hw.control.process.claim import LocalClaim
from deal_hw.control.process.run_note import RunNote, find_runs
from deal_hw.drivers.unitree.command_log import DAMPING, STIFF
from deal_hw.errors import ConfigurationError, PortBusyError, UnknownNameError
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.stop import stop
from deal_hw.workflows.stopping.robot import _claimed

pytestmark = pytest.mark.real_time

HOLDER = """
import sys, time
from deal_hw.control.process.run_note import RunNote

with RunNote("go2", {"claim": "x"}) as note:
    note.say_passive(None)
    print("ready", flush=True)
    sys.stdin.readline()
    note.say_passive(False)
    print("said", flush=True)
    sys.stdin.readline()
"""


class Rig:
    """An emulated robot, and runs on it as programs of their own."""

    def __init__(self, folder: Path, robot: str, *options: str) -> None:
        self.folder, self.robot = folder, robot
        self._events = folder / "events"
        self._events.touch()
        own = ("--nominal", "--profile", "sensor", "--events-to", str(self._events))
        self.emulator = EmulatorProcess(robot, *own, *options)
        self.runs: list[subprocess.Popen[bytes]] = []

    def run(self, *options: str) -> subprocess.Popen[bytes]:
        """Start a run of a minute; return when the robot obeys it."""
        before = len(self.reported())
        words = ["collect", self.robot, "--port", self.emulator.port, "--out", str(self.folder / "run")]
        process = subprocess.Popen(
            [sys.executable, "-m", "deal_hw", *words, "--seconds", "60", *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            process_group=0,
        )
        self.runs.append(process)
        until(
            lambda: {STIFF, "armed"} & {*self.reported()[before:]} or process.poll() is not None,
            "the robot obeys the run",
        )
        assert process.poll() is None
        return process

    def kill_run(self, *options: str) -> None:
        """Start a run and kill all of it at once; again where the run had ended itself before.

        Where one process is killed alone, the others see it and damp the robot, while a busy machine keeps
        the next kill waiting. So all are stopped first: for 0.2 s nobody misses anybody. A machine that
        stands still for 60 ms trips a run, whatever is done to it.
        """
        for _ in range(3):
            run = self.run(*options)
            pids = self.processes()
            for number in (signal.SIGSTOP, signal.SIGKILL):
                for pid in pids:
                    os.kill(pid, number)
            run.wait()
            if self.reported()[-1] in (STIFF, "armed"):
                return

    def reported(self) -> list[str]:
        """Return the robot's log: kinds of command, or what happened to it."""
        return [json.loads(line)[2] for line in self._events.read_text().splitlines()]

    def processes(self) -> list[int]:
        """Return the processes of the newest run, and of no other on this computer."""
        (found,) = [run for run in find_runs() if run.pid == self.runs[-1].pid]
        with found:
            return [found.pid, *(pid for pid in found.holders() if pid != found.pid)]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Callable[..., Rig]]:
    """Make emulated robots; runs that are left end with the test."""
    made: list[Rig] = []

    def make(robot: str, *options: str) -> Rig:
        made.append(Rig(tmp_path, robot, *options))
        made[-1].emulator.start()
        return made[-1]

    yield make
    for one in made:
        for run in one.runs:
            run.kill()
            run.wait()
        one.emulator.stop()


def test_a_note_is_found_while_its_run_lives() -> None:
    """By other programs; it follows what the run says, and goes with it."""
    before = len(find_runs())
    with RunNote("go2", {}):
        assert len(find_runs()) == before, "one's own run is none to stop"
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdin is not None and holder.stdout is not None
        assert holder.stdout.readline() == "ready\n"
        (found,) = [run for run in find_runs() if run.pid == holder.pid]
        with found:
            assert (found.facts["robot"], found.facts["claim"], found.passive) == ("go2", "x", None)
            assert found.holders() == [holder.pid]
            holder.stdin.write("\n")
            holder.stdin.flush()
            assert holder.stdout.readline() == "said\n"
            assert found.passive is False
            holder.communicate("\n")
            assert found.holders() == []
            assert found.passive is False, "what it said last is kept"


@pytest.mark.parametrize("target", ["a note that is just being written", "[]", '{"pid": 1}'])
def test_a_note_that_is_none_is_passed_over(target: str) -> None:
    """Another program may give a file this name."""
    program = (
        "import os, sys; fd = os.memfd_create('deal-hw-run:go2'); os.write(fd, sys.argv[1].encode()); "
        "print(flush=True); sys.stdin.readline()"
    )
    before = len(find_runs())
    with subprocess.Popen(
        [sys.executable, "-c", program, target], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        assert len(find_runs()) == before
        holder.communicate("\n")


def test_what_cannot_work_is_refused() -> None:
    """A robot that is none, options without effect; without a run and a port it says what to do."""
    with pytest.raises(UnknownNameError, match="go3"):
        stop("go3")
    with pytest.raises(ConfigurationError, match="--transport would have no effect: without --port"):
        stop("go2", transport="zenoh")
    with pytest.raises(ConfigurationError, match="--state-check would have no effect: without --port"):
        stop("go2", state_check="length")


def test_a_killed_run_may_take_its_time_to_die() -> None:
    """Its claim is free once its last process is gone; that of a run that lives is refused after 2 s."""
    dying = LocalClaim("test of stop")
    dying.acquire()

    class Dying(VirtualClock):
        def sleep_until_ns(self, deadline_ns: int) -> None:
            super().sleep_until_ns(deadline_ns)
            if self.now_ns() > 1_000_000_000:
                dying.release()

    _claimed("test of stop", Dying()).release()
    with LocalClaim("test of stop"), pytest.raises(PortBusyError, match="in use by"):
        _claimed("test of stop", clock := VirtualClock())
    assert clock.now_ns() == 2_000_000_000


def test_without_a_run_and_a_port_nothing_is_done(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exit code is 1, for nobody confirmed anything. Runs of other tests beside it must go on."""
    monkeypatch.setattr("deal_hw.workflows.stopping.robot.find_runs", list)
    assert main(["stop", "go2_on_stand"]) == 1
    assert "no run of go2_on_stand of this user on this computer" in capsys.readouterr().err


HANGING = """
import signal, sys
from deal_hw.control.process.claim import LocalClaim
from deal_hw.control.process.run_note import RunNote
from deal_hw.robots.connect import claim_name
from deal_hw.transport import WireOptions

signal.signal(signal.SIGTERM, signal.SIG_IGN)
claim = claim_name("serial", sys.argv[1], WireOptions())
facts = {"port": sys.argv[1], "transport": "serial", "claim": claim, "settings": {}}
with LocalClaim(claim), RunNote("cartpole", {**facts, "wire": WireOptions().to_json()}) as note:
    note.say_passive(None)
    note.beat(1)
    print("ready", flush=True)
    sys.stdin.readline()
"""
"""A run that commands a cart-pole and hangs: it keeps note and claim, and nothing else works."""


def test_a_run_that_hangs_is_killed_and_its_robot_made_passive_from_here(
    rig: Callable[..., Rig], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, by what its note says; then nobody else commanded the robot, and nobody is listened for."""
    monkeypatch.setattr(run_end, "OBEY_S", 10 * PATIENCE_S)
    robot = rig("cartpole")
    with subprocess.Popen(
        [sys.executable, "-c", HANGING, robot.emulator.port],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as hanging:
        assert hanging.stdout is not None
        hanging.stdout.readline()
        # The port says which run is meant, and how it is spelled does not matter.
        assert main(["stop", "cartpole", "--port", f"{robot.emulator.port}?baudrate=115200"]) == 0
        assert hanging.wait(PATIENCE_S) == -signal.SIGKILL
    printed = capsys.readouterr()
    assert "has ended without a passive robot; making it passive from here" in printed.err
    assert "cartpole is passive: its run was killed" in printed.out
    assert "listening" not in printed.err


def test_all_runs_are_asked_before_one_is_waited_for() -> None:
    """Two of the same kind of robot; the first one found ends only when the other was asked, too."""
    program = (
        "import os, signal, sys\n"
        "from deal_hw.control.process.run_note import RunNote\n"
        "mine, others = int(sys.argv[1]), int(sys.argv[2])\n"
        "signal.signal(signal.SIGTERM, lambda *_: os.write(others, b'asked'))\n"
        "with RunNote('h1', {'claim': 'x'}) as note:\n"
        "    note.say_passive(None)\n"
        "    print('ready', flush=True)\n"
        "    os.read(mine, 5)\n"
        "    note.say_passive(True)\n"
        "    sys.stdin.readline()\n"
    )
    (read_a, write_a), (read_b, write_b) = os.pipe(), os.pipe()
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", program, str(mine), str(others)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            pass_fds=(mine, others),
        )
        for mine, others in ((read_a, write_b), (read_b, write_a))
    ]
    for run in runs:
        assert run.stdout is not None and run.stdout.readline() == "ready\n"
    report = stop("h1")
    for run in runs:
        run.communicate("\n", timeout=PATIENCE_S)
    for end in (read_a, write_a, read_b, write_b):
        os.close(end)
    assert report.passive
    assert [run.returncode for run in runs] == [0, 0], "none was killed"


def test_a_cartpole_is_stopped_with_and_without_a_run(
    rig: Callable[..., Rig], capsys: pytest.CaptureFixture[str]
) -> None:
    """The run ends as for Ctrl-C; afterwards the port is free, and the motor is off already."""
    robot = rig("cartpole")
    run = robot.run("--motion", "chirp")
    assert main(["stop", "cartpole"]) == 0
    assert "the run of process" in capsys.readouterr().out
    assert run.wait(PATIENCE_S) == 130
    assert main(["stop", "cartpole", "--port", robot.emulator.port]) == 0
    assert "no run commanded it" in capsys.readouterr().out
    assert main(["stop", "cartpole", "--port", "/dev/ttyNOPE"]) == 1
    assert "was NOT made passive" in capsys.readouterr().err


@pytest.mark.slow
def test_a_go2_is_damped_whoever_holds_it(
    rig: Callable[..., Rig], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its run; by this program after all of the run was killed; and by a stopped run."""
    wire = ("--transport", "zenoh")
    robot = rig("go2", *wire, "--port", "tcp/127.0.0.1:0", "--sport", "off")
    motion = ("--motion", "hold", *wire)
    run = robot.run(*motion)
    assert stop("go2").passive
    assert run.wait(PATIENCE_S) == 130
    assert robot.reported()[-1] == DAMPING

    robot.kill_run(*motion)
    assert robot.reported()[-1] == STIFF
    assert stop("go2").passive is False, "without a run and a port nobody is found"
    assert robot.reported()[-1] == STIFF
    capsys.readouterr()
    assert main(["stop", "go2", "--port", robot.emulator.port, *wire]) == 0
    printed = capsys.readouterr()
    assert "listening for other commanders for 0.8 s before anything is sent" in printed.err
    assert "no run commanded it, and the robot has confirmed it" in printed.out
    assert robot.reported()[-1] == DAMPING

    # Nothing here may wait for the end of a fixed time.
    monkeypatch.setattr(run_end, "OBEY_S", 10 * PATIENCE_S)
    run = robot.run(*motion)
    for pid in robot.processes():
        os.kill(pid, signal.SIGSTOP)
    assert main(["stop", "go2"]) == 0
    assert "the run of process" in capsys.readouterr().out, "its supervisor, which was continued, did it"
    assert run.wait(PATIENCE_S) == 130
    assert robot.reported()[-1] == DAMPING


COMMANDING = """
import select, sys
from deal_hw.clock import MonotonicClock
from deal_hw.control.process.realtime import priority
from deal_hw.drivers.transports.topics import LOW_COMMAND
from deal_hw.robots.connect import make_topic_transport
from deal_hw.transport import Message

clock = MonotonicClock()
other = make_topic_transport("zenoh", sys.argv[1], clock)
other.declare(publish=[LOW_COMMAND])
# On a busy machine a program of ordinary priority may send nothing for longer than others listen.
with priority(40, children=True), other:
    print("ready", flush=True)
    while not select.select([sys.stdin], [], [], 0.02)[0]:
        other.send(Message(LOW_COMMAND, bytes.fromhex(sys.argv[2]), clock.now_ns()))
"""
"""Another program that commands a Go2, 50 times a second, until it reads a line."""


@pytest.mark.slow
def test_nobody_fights_who_took_the_robot_while_its_run_was_stopped(
    rig: Callable[..., Rig], capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither the run, which is continued, nor this program: another program commands the robot by now."""
    wire = ("--transport", "zenoh")
    robot = rig("go2", *wire, "--port", "tcp/127.0.0.1:0", "--sport", "off")
    run = robot.run("--motion", "hold", *wire)
    stopped_s, before = time.monotonic(), len(robot.reported())
    for pid in robot.processes():
        os.kill(pid, signal.SIGSTOP)
    with subprocess.Popen(
        [sys.executable, "-c", COMMANDING, robot.emulator.port, STIFF_COMMAND.hex()],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        try:
            assert other.stdout is not None and other.stdout.readline() == "ready\n"
            until(lambda: time.monotonic() - stopped_s > 1.5, "the claim of the run has expired")
            assert main(["stop", "go2"]) == 1
        finally:
            other.communicate("\n")
    assert "was NOT made passive: go2: another program commands the robot's motors" in capsys.readouterr().err
    assert run.wait(PATIENCE_S) != 0
    assert robot.reported()[-1] == STIFF and DAMPING not in robot.reported()[before:]
    assert main(["stop", "go2", "--port", robot.emulator.port, *wire]) == 0
    assert robot.reported()[-1] == DAMPING
