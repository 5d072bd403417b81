"""What was found by using and attacking deal-hw on commit d5a5f8c, through what that commit has, too.

Each test here fails on it, by its own assertion or by the traceback that was the finding: copy this file
there and run it. docs/measured/reproductions.md has every finding with its tests; most are in other files.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import io
import json
import os
import select
import signal
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.faulty_policy import faulty_policy
from fakes.go2 import FakeBench
from mcap.writer import CompressionType, Writer

from deal_hw.cli.calibrate import Calibrate
from deal_hw.cli.collect import Collect
from deal_hw.cli.main import main
from deal_hw.cli.show import Terminal
from deal_hw.clock import VirtualClock
from deal_hw.control.behaviours import HoldBehaviour
from deal_hw.control.loop import ControlLoop, LoopConfig
from deal_hw.control.process_channel import Beat
from deal_hw.control.safety import Safety
from deal_hw.data.importing.load import load_tables
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.recorder import LIBRARY, METADATA_NAME
from deal_hw.data.recording.repair import verify
from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION as ON_STAND
from deal_hw.drivers.go2.doctor import Go2Doctor
from deal_hw.drivers.go2.emulator.command_log import DAMPING, STIFF
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import draw_truth, nominal_truth
from deal_hw.drivers.go2.messages import topics
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.go2.robot import Go2OnStandRobot, Go2Robot
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.errors import ConfigurationError, DatasetError, PortBusyError, SafetyError
from deal_hw.findings import Finding, Level
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.supervised import run_episodes

S = 1_000_000_000
PATIENCE_S = 60.0
"""Time limit for events that come within seconds, and on commit d5a5f8c never."""


# A Go2 that stays stiff.


def test_a_link_that_drops_as_the_run_ends_leaves_no_stiff_go2() -> None:
    """Ten attempts took no time where each send raised; the last command stayed stiff with the link back."""
    clock = VirtualClock(S)
    device = Go2Device(nominal_truth("ideal"), on_stand=True)
    wire = VirtualTopics(device, clock)
    cut_ns = 0

    def progress(phase: str, silence_s: float) -> None:
        nonlocal cut_ns
        if phase == "making passive":
            cut_ns = clock.now_ns()
            wire.unplug()
        elif cut_ns and clock.now_ns() - cut_ns > 0.1 * S:
            wire.plug_in()

    ControlLoop(
        Go2OnStandRobot(wire, clock), HoldBehaviour(ON_STAND), Safety(ON_STAND), clock, lambda record: True,
        LoopConfig(duration_s=0.5), progress=progress,
    ).run()  # fmt: skip
    kinds = [kind for *_, kind in device.log.changes]
    assert STIFF in kinds and kinds[-1] == DAMPING


class Go2:
    """An emulated Go2 in a process of its own, which reports its commands at its end."""

    def __init__(self, folder: Path, *options: str) -> None:
        self._truth = folder / "truth.json"
        self.process = EmulatorProcess(
            "go2", "--transport", "zenoh", "--port", "tcp/127.0.0.1:0", "--nominal", "--profile", "ideal",
            "--reveal-to", str(self._truth), *options,
        )  # fmt: skip

    def plan(self, **changes: Any) -> dict[str, Any]:
        """Return a run that holds the pose, and its port."""
        values = {"robot": "go2", "transport": "zenoh", "motion": "hold", "seconds": 60.0, **changes}
        return {"plan": RunPlan(**values), "port": self.process.port}

    def commands(self) -> dict[str, Any]:
        """End the emulator and return the commands that it received."""
        self.process.stop()
        told: dict[str, Any] = json.loads(self._truth.read_text())["commands"]
        return told


@pytest.fixture
def go2(tmp_path: Path) -> Iterator[Callable[..., Go2]]:
    """Start emulators that end with the test."""
    with contextlib.ExitStack() as running:

        def start(*options: str) -> Go2:
            robot = Go2(tmp_path, *options)
            running.enter_context(robot.process)
            return robot

        yield start


def run(
    plan: RunPlan, port: str, on_beat: Callable[[Beat], None] = lambda beat: None, *, quiet: bool = True
) -> None:
    """Run a plan, and record nothing."""
    run_episodes(
        plan, port=port, dataset=None, episodes=1, purpose="collect", view=Terminal(quiet), on_beat=on_beat
    )


def control_pid() -> int:
    """Return the pid of this process's control process."""
    for pid in Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split():
        if "deal_hw.workflows.running.control_process" in Path(f"/proc/{pid}/cmdline").read_text().split(
            "\0"
        ):
            return int(pid)
    raise AssertionError("there is no control process")


def where(name: str) -> Any:
    """Return the module that starts a run's processes: supervised.py was split after d5a5f8c."""
    for module in ("deal_hw.workflows.running.episode", "deal_hw.workflows.running.supervised"):
        with contextlib.suppress(ModuleNotFoundError):
            found = importlib.import_module(module)
            if hasattr(found, name):
                return found
    raise AssertionError(f"no module starts runs with {name}")


SUPERVISOR = """
import os, signal, sys, threading
from pathlib import Path
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.supervised import run_episodes

port, number = sys.argv[1:]


def on_beat(beat):
    if beat.phase == "running" and beat.count == 5:
        children = Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split()
        print(*children, flush=True)
        if number != "0":
            os.kill(os.getpid(), int(number))


plan = RunPlan(robot="go2", transport="zenoh", motion="hold", seconds=600.0)
run_episodes(plan, port=port, dataset=None, episodes=1, purpose="collect", on_beat=on_beat)
"""


@pytest.fixture
def supervisor() -> Iterator[Callable[[Go2, int], tuple[subprocess.Popen[str], int]]]:
    """Start runs in processes of their own that send themselves a signal; they are killed at the end."""
    with contextlib.ExitStack() as running:

        def start(robot: Go2, number: int) -> tuple[subprocess.Popen[str], int]:
            process = subprocess.Popen(
                [sys.executable, "-c", SUPERVISOR, robot.process.port, str(number)],
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, process_group=0,
            )  # fmt: skip
            running.callback(process.communicate)
            running.callback(process.kill)
            assert process.stdout is not None
            return process, int(process.stdout.readline())

        yield start


@pytest.mark.slow
def test_ctrl_z_stops_the_program_with_a_damped_go2(
    go2: Callable[..., Go2], supervisor: Callable[[Go2, int], tuple[subprocess.Popen[str], int]]
) -> None:
    """The shell said "Stopped" while the robot stayed stiff to the end of the run."""
    robot = go2("--sport", "off")
    process, _ = supervisor(robot, signal.SIGTSTP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
    commands = robot.commands()
    assert commands["first_stiff_ms"] and commands["last_kind"] == DAMPING


@pytest.mark.slow
def test_a_supervisor_that_stands_still_leaves_a_damped_go2(
    go2: Callable[..., Go2], supervisor: Callable[[Go2, int], tuple[subprocess.Popen[str], int]]
) -> None:
    """SIGSTOP: the control process went on without a watch."""
    robot = go2("--sport", "off")
    process, control = supervisor(robot, signal.SIGSTOP)
    ended = os.pidfd_open(control)
    try:
        assert select.select([ended], [], [], PATIENCE_S)[0], "the control process goes on without a watch"
    finally:
        os.close(ended)
    # It would hold up the end of the emulator, whose messages it does not take.
    process.kill()
    commands = robot.commands()
    assert commands["first_stiff_ms"] and commands["last_kind"] == DAMPING


@pytest.mark.parametrize(
    ("number", "words"), [(signal.SIGKILL, "died by signal 9"), (signal.SIGSTOP, "no heartbeat")]
)
def test_a_dry_run_whose_control_process_dies_or_hangs_sends_nothing(
    go2: Callable[..., Go2], number: signal.Signals, words: str
) -> None:
    """A robot that stood under sport mode got 20 to 25 damping commands from the supervisor."""
    robot = go2("--start", "standing")

    def strike(beat: Beat) -> None:
        if beat.phase == "running" and beat.count == 5:
            os.kill(control_pid(), number)

    with pytest.raises(SafetyError, match=words):
        run(**robot.plan(dry_run=True), on_beat=strike)
    assert robot.commands()["accepted"] == 0


def test_a_run_that_dies_before_it_took_the_robot_over_sends_no_command(go2: Callable[..., Go2]) -> None:
    """Killed while homing, with the robot still under sport mode: 3 to 21 damping commands."""
    robot = go2("--start", "standing")

    def kill(beat: Beat) -> None:
        if beat.phase == "homing":
            with contextlib.suppress(ProcessLookupError):
                os.kill(control_pid(), signal.SIGKILL)

    with pytest.raises(SafetyError, match="died by signal 9"):
        run(**robot.plan(), on_beat=kill)
    assert robot.commands()["accepted"] == 0


def test_what_deal_hw_cannot_help_is_said_at_the_start(
    go2: Callable[..., Go2], capsys: pytest.CaptureFixture[str]
) -> None:
    """Where both processes are killed the Go2 holds its last command, and nobody said so."""
    run(**go2("--sport", "off").plan(seconds=0.2), quiet=False)
    assert "holds its last command" in capsys.readouterr().err


@pytest.mark.slow
def test_a_second_run_is_refused_and_does_not_take_over(
    go2: Callable[..., Go2], supervisor: Callable[[Go2, int], tuple[subprocess.Popen[str], int]]
) -> None:
    """It waited for up to 20 s, and commanded the robot as soon as Ctrl-C had ended the first one."""
    robot = go2("--sport", "off")
    first, _ = supervisor(robot, 0)
    ended: list[int] = []

    def end_first(beat: Beat) -> None:
        if beat.phase == "homing" and not ended:
            ended.append(first.pid)
            os.kill(first.pid, signal.SIGINT)

    with pytest.raises(PortBusyError, match="the robot is in use by process"):
        run(**robot.plan(seconds=0.2), on_beat=end_first)
    assert not ended and first.poll() is None


@pytest.mark.parametrize(
    ("kind", "on_stand", "words"),
    [(Go2OnStandRobot, False, "on the floor"), (Go2Robot, True, "holds the robot in the air")],
)
def test_robot_and_model_must_agree(kind: type[Go2Robot], on_stand: bool, words: str) -> None:
    """`collect go2_on_stand` with the robot on the floor was accepted, and ended at 0.85 rad of tilt."""
    device = Go2Device(draw_truth("realistic", 1), on_stand=on_stand)
    clock = VirtualClock(S)
    robot = kind(VirtualTopics(device, clock), clock)
    robot.connect()
    with pytest.raises(SafetyError, match=words):
        robot.home(20.0)
    assert device.log.accepted == 0


def test_a_go2_whose_link_stays_away_is_not_told_of_a_watchdog(go2: Callable[..., Go2]) -> None:
    """The Go2 has none: it holds its last command."""
    robot = go2("--sport", "off")
    given = {"passive_timeout_s": 0.5} if hasattr(RunPlan(robot="go2"), "passive_timeout_s") else {}
    warnings: tuple[str, ...] = ()

    def vanish(beat: Beat) -> None:
        if beat.phase == "running" and beat.count == 5:
            os.kill(robot.process.pid, signal.SIGKILL)

    with pytest.MonkeyPatch.context() as patch:
        runs = where("account")
        account = runs.account

        def listen(*arguments: Any) -> Any:
            nonlocal warnings
            report = account(*arguments)
            warnings = report.warnings
            return report

        patch.setattr(runs, "account", listen)
        with contextlib.suppress(Exception):
            run(**robot.plan(**given), on_beat=vanish)
    (said,) = [text for text in warnings if "did not confirm" in text]
    assert "watchdog" not in said


# The doctor, and states that are not as expected.


def examined(change: Callable[[bytes], bytes]) -> list[Finding]:
    """Return what doctor finds about states that are changed on their way."""
    bench = FakeBench(mode="")
    bench.topics.tamper = lambda topic, p: (change(p),) if topic == topics.LOW_STATE else (p,)
    return [found for found in Go2Doctor(bench.topics, bench.clock, 1.0).run() if found.area == "states"]


def test_another_checksum_rule_is_one_finding() -> None:
    """Doctor printed 1,500 FAILs in 3,041 lines, one for each state."""
    findings = examined(lambda payload: payload[:-1] + bytes([payload[-1] ^ 1]))
    assert [found.level for found in findings] == [Level.FAIL]


def test_a_clock_that_runs_ten_percent_fast_is_a_failure() -> None:
    """Doctor called +9.55 % ok."""

    def fast(payload: bytes) -> bytes:
        values = decode_low_state(payload).values()
        return encode_low_state(dataclasses.replace(values, tick_ms=round(values.tick_ms * 1.0955)))

    (found,) = [found for found in examined(fast) if "clock" in found.message]
    assert found.level is Level.FAIL


# The program and its processes.


def interrupt(beat: Beat) -> None:
    """Press Ctrl-C in the fifth cycle."""
    if beat.phase == "running" and beat.count == 5:
        os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_ends_a_loop_of_runs() -> None:
    """It ended one `collect()`: a loop in Python went on with the next."""
    with EmulatorProcess("cartpole", "--nominal", "--profile", "sensor") as emulator:
        plan = RunPlan(robot="cartpole", motion="chirp", seconds=60.0)
        with pytest.raises(KeyboardInterrupt):
            run(plan, emulator.port, interrupt)


@pytest.mark.slow
def test_ctrl_c_ends_the_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It armed the robot again for its second recording, and ended with 2."""
    runs = where("Supervisor")
    made = 0

    class Pressed(runs.Supervisor):  # type: ignore[misc, name-defined]
        def __init__(self, **settings: Any) -> None:
            nonlocal made
            made += 1
            super().__init__(**{**settings, "on_beat": interrupt})

    monkeypatch.setattr(runs, "Supervisor", Pressed)
    assert (main(["demo", "--out", str(tmp_path / "demo")]), made) == (130, 1)


def test_the_supervisor_has_real_time_priority() -> None:
    """With an ordinary one a stopped control process was noticed after 332 to 431 ms on a busy machine."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        pytest.skip("it is not granted here")
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    seen: set[int] = set()
    with EmulatorProcess("cartpole", "--nominal", "--profile", "sensor") as emulator:
        plan = RunPlan(robot="cartpole", motion="chirp", seconds=0.2)
        run(plan, emulator.port, lambda beat: seen.add(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK))
    assert seen == {os.SCHED_FIFO}


@pytest.mark.slow
def test_a_network_that_loops_for_ever_is_refused_before_the_port(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It hung `deploy`, and with --dry-run made the supervisor send damping."""
    from deal_hw.policies import trial
    from deal_hw.policies.onnx_export import write_policy

    # A tenth of its usual processor time: it is used up in any case.
    brief = functools.partial(trial.TrialPolicy, settings=trial.TrialSettings(processor_s=1))
    monkeypatch.setattr(trial, "TrialPolicy", brief)
    path = tmp_path / "endless.onnx"
    write_policy(*faulty_policy(CARTPOLE, "late", 10**9), path)
    assert main(["deploy", "cartpole", "--port", str(tmp_path / "no-port"), "--policy", str(path)]) == 2
    said = capsys.readouterr().err
    assert "endless.onnx" in said and "no-port" not in said


# Files.


def zeros(path: Path, count: int) -> Path:
    """Write the beginning of an episode, with zeros behind it as after a power cut."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library=LIBRARY)
        said = {
            "description": json.dumps(CARTPOLE.to_json()),
            "metadata": "{}",
            "wall_utc": "",
            "host_ns": "0",
        }
        writer.add_metadata(METADATA_NAME, said)
        file.write(bytes(count))
    return path


def test_zeros_are_said_in_one_line(tmp_path: Path) -> None:
    """1 MB of them took 32 s and printed 5 MB; nine bytes were a damaged record of their own."""
    said = verify(zeros(tmp_path / "a.mcap", 20_000)).describe()
    assert len(said) < 500 + len(str(tmp_path)) and "\n" not in said


def test_zeros_are_searched_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each nine bytes of them were a reason to search the rest of the file again."""
    from deal_hw.data.recording import mcap_scan

    looked = 0

    class Counting(bytes):
        def find(self, *arguments: Any) -> int:
            nonlocal looked
            looked += len(self) - (arguments[1] if len(arguments) > 1 else 0)
            return super().find(*arguments)

    data = Counting(zeros(tmp_path / "a.mcap", 20_000).read_bytes())
    for _ in mcap_scan.scan(data):
        pass
    assert looked <= 4 * len(data)


def refusal(read: Callable[[], object], kind: type[Exception]) -> str:
    """Return the one line with which something is refused."""
    with pytest.raises(kind) as caught:
        read()
    text = str(caught.value)
    assert "\n" not in text and len(text) < 1000
    return text


def read_or_refuse(path: Path) -> None:
    """Read recordings; a refusal is one line."""
    try:
        load_tables(path)
    except DatasetError as error:
        assert "\n" not in str(error)


def test_mutated_archives_end_in_one_line(tmp_path: Path) -> None:
    """329 of 8,000 mutated NPZ files were tracebacks."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, time=np.arange(50.0), a_pos=np.ones(50), a_cmd=np.ones(50))
    path = tmp_path / "a.npz"
    for mutation in range(60):
        data = bytearray(buffer.getvalue())
        rng = np.random.default_rng(mutation)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(256)
        path.write_bytes(data)
        read_or_refuse(path)


def test_mutated_mcap_files_end_in_one_line(tmp_path: Path) -> None:
    """218 of 1,600 were tracebacks."""
    path = tmp_path / "a.mcap"
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema("p/msg/M", "ros2msg", b"float64[] position\nstring[] name")
        channel = writer.register_channel("/t", "cdr", schema)
        for stamp in range(20):
            writer.add_message(channel, stamp, b"\0\1\0\0" + bytes(60), stamp, stamp)
        writer.finish()
    whole = path.read_bytes()
    for mutation in range(60):
        data = bytearray(whole)
        rng = np.random.default_rng(mutation)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(256)
        path.write_bytes(data)
        read_or_refuse(path)


def test_a_list_of_lists_in_a_csv_cell_is_refused(tmp_path: Path) -> None:
    """A traceback."""
    path = tmp_path / "a.csv"
    path.write_text("time;pos\n0;[1, 2]\n1;[[1], 2]\n2;[1, 2]\n", encoding="utf-8")
    assert str(path) in refusal(lambda: load_tables(path), DatasetError)


def test_a_dataset_json_of_another_structure_is_refused(tmp_path: Path) -> None:
    """1,179 of 15,000 were tracebacks: nested too deep, or another type in a field."""
    Dataset.create_or_open(tmp_path, CARTPOLE).close()
    index = tmp_path / "dataset.json"
    values = json.loads(index.read_text(encoding="utf-8"))
    for content in (json.dumps({**values, "episodes": 3}), "[" * 100_000):
        index.write_text(content, encoding="utf-8")
        assert "dataset.json" in refusal(lambda: Dataset.open(tmp_path), DatasetError)


def test_a_model_whose_contacts_overflow_the_arena_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`calibrate --model` ended in a traceback of MuJoCo's own error."""
    spheres = "".join(f"<geom size='.1' pos='0 0 {i / 1000}'/>" for i in range(60))
    model, recording = tmp_path / "robot.xml", tmp_path / "j.csv"
    model.write_text(
        f"<mujoco><size memory='100K'/><worldbody>{spheres}<body><joint name='j' damping='1'/>{spheres}"
        "</body></worldbody><actuator><position name='m' joint='j' kp='5'/></actuator></mujoco>",
        encoding="utf-8",
    )
    time = 0.01 * np.arange(400)
    noise = np.random.default_rng(0).normal(0.0, 1e-3, 400)
    columns = np.stack([time, 0.1 * np.sin(5 * time), 0.09 * np.sin(5 * time) + noise], axis=1)
    np.savetxt(recording, columns, delimiter=",", header="time,j_pos,j_cmd", comments="")
    words = ["--model", str(model), "--data", str(recording), "--out", str(tmp_path / "out"), "--force"]
    assert main(["calibrate", *words]) == 2
    assert "arena too small" in capsys.readouterr().err


def test_an_alias_bomb_prints_little(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Eight levels of nine aliases printed 312 MB; these are four."""
    lines = ["- &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"- &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 4)]
    columns, recording = tmp_path / "columns.yaml", tmp_path / "a.csv"
    columns.write_text("\n".join(lines), encoding="utf-8")
    recording.write_text("time,pos,cmd\n0,0,0\n1,0,0\n", encoding="utf-8")
    out = str(tmp_path / "out")
    assert main(["data", "import", str(recording), "--columns", str(columns), "--out", out]) == 2
    assert len(capsys.readouterr().err) < 2000


def test_an_array_is_not_read_beyond_the_limit(tmp_path: Path) -> None:
    """An NPZ of 2.9 MB took 8.9 GB of memory; this one would take 1.1 GB."""
    path, header = tmp_path / "bomb.npz", "{'descr': '|u1', 'fortran_order': False, 'shape': (136314880,)}\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("time.npy", "w") as member:
        member.write(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode())
        for _ in range(130):
            member.write(bytes(1 << 20))
    assert "numbers" in refusal(lambda: load_tables(path), DatasetError)


# Options.


OUT_OF_RANGE: Iterable[Callable[[], object]] = (
    lambda: Calibrate(dataset=Path("d"), latency=12.0),
    lambda: Calibrate(dataset=Path("d"), latency=float("nan")),
    lambda: Calibrate(dataset=Path("d"), seed=-1),
    lambda: Collect(robot="cartpole", port="p", out=Path("o"), excitation_level=float("nan")),
    lambda: Collect(robot="cartpole", port="p", out=Path("o"), seconds=float("nan")),
)


@pytest.mark.parametrize("make", OUT_OF_RANGE)
def test_numbers_out_of_range_are_refused(make: Callable[[], object]) -> None:
    """A latency of 12 s was clamped to 40 ms, without a word."""
    with pytest.raises(ConfigurationError):
        make()


def test_a_negative_seed_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A traceback of numpy."""
    assert main(["design-excitation", "cartpole", "--out", str(tmp_path / "o"), "--seed", "-1"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
