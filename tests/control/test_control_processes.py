"""Real processes, a real pty: whatever dies or hangs, the robot is passive and the data are whole."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import resource
import select
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fakes.faulty_policy import RARE_M_S, faulty_policy
from fakes.linear_policy import CARTPOLE_GAINS, feedback_spec

from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.collect import collect
from deal_hw.cli.deploy import KINDS as DEPLOY
from deal_hw.cli.deploy import deploy
from deal_hw.cli.replay import KINDS as REPLAY
from deal_hw.cli.replay import replay
from deal_hw.control.process.channel import RUNNING, Beat, Outcome
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.reader import read_episode
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import (
    ConfigurationError,
    DatasetError,
    PolicyError,
    PolicyMismatchError,
    PortBusyError,
    PortNotFoundError,
    SafetyError,
    WrongDeviceError,
)
from deal_hw.types import Status
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.supervised import InterruptedRunError, run_episodes

pytestmark = pytest.mark.real_time

AT_BEAT = 25
"""Faults happen half a second into the run."""
PASSIVE_S = 0.5
"""So long is a robot without a link waited for here [s]."""
LONG = 60.0
"""Nothing here runs to this end [s]."""


class Emulator:
    """An emulated cart-pole in a process of its own."""

    def __init__(self, *options: str) -> None:
        command = [sys.executable, "-m", "deal_hw", "emulate", "--nominal", "--profile", "sensor", *options]
        command += ["--parent", str(os.getpid())]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        if self.process.stdout is None:
            raise RuntimeError("no pipe")
        self.port = self.process.stdout.readline().split()[1]
        # A device does not stand still because the machine is busy; where this is refused, tests need an idle
        # machine.
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(self.process.pid, os.SCHED_FIFO, os.sched_param(60))

    def status(self) -> Status:
        """Return the device's status without a word to it."""
        decoder = protocol.FrameDecoder()
        with SerialTransport(self.port) as transport:
            while True:
                for payload in decoder.feed(transport.receive(2.0).payload):
                    message = protocol.decode(payload)
                    if isinstance(message, protocol.State):
                        return Status(message.status)

    def close(self) -> None:
        """End the process."""
        self.process.terminate()
        self.process.communicate()


@pytest.fixture
def start_emulator() -> Iterator[Callable[..., Emulator]]:
    """Start emulators that end with the test."""
    running: list[Emulator] = []

    def start(*options: str) -> Emulator:
        running.append(Emulator(*options))
        return running[-1]

    yield start
    for emulator in running:
        emulator.close()


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    """A well-behaved one, for all runs that leave a passive robot behind: each homes it anew."""
    made = Emulator()
    yield made
    made.close()


def children() -> dict[str, int]:
    """Return the pid of the control and the recorder process, by module name."""
    found = {}
    for pid in Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split():
        words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
        if "-m" in words:
            found[words[words.index("-m") + 1].rpartition(".")[2]] = int(pid)
    return found


def run(
    emulator: Emulator,
    folder: Path,
    act: Callable[[], None] = lambda: None,
    *,
    seconds: float = LONG,
    dry: bool = False,
) -> RunReport:
    """Run a chirp under supervision and act once, half a second into it."""
    done = False

    def on_beat(beat: Beat) -> None:
        nonlocal done
        if beat.phase == RUNNING and beat.count >= AT_BEAT and not done:
            done = True
            act()

    plan = RunPlan(
        robot="cartpole", motion="chirp", seconds=seconds, dry_run=dry, passive_timeout_s=PASSIVE_S
    )
    return run_episodes(
        plan, port=emulator.port, dataset=folder, episodes=1, purpose="collect", on_beat=on_beat
    )


def assert_whole(folder: Path, at_least: int = AT_BEAT - 5) -> None:
    """Check that the dataset holds one good episode with the cycles before the fault."""
    dataset = Dataset.open(folder)
    assert len(dataset.episodes) == 1
    episode = dataset.read(0)
    assert episode.trajectory.sent_s.size >= at_least
    assert episode.trajectory.receive_s.size >= 3 * at_least


# Ends that are no accident.


def test_collect_records_a_whole_episode(emulator: Emulator, tmp_path: Path) -> None:
    """Two episodes under one roof: loop_timing in the index, all commands in the file, a passive robot."""
    report = collect(
        COLLECT.settings(
            robot="cartpole",
            port=emulator.port,
            out=tmp_path,
            motion="chirp",
            seconds=0.6,
            episodes=2,
            quiet=True,
        )
    )
    assert (report.outcome, report.exit_code, len(report.episodes)) == (Outcome.FINISHED, 0, 2)
    dataset = Dataset.open(tmp_path / "dataset")
    facts = [episode.facts for episode in dataset.episodes]
    assert [f["loop_timing"]["cycles"] for f in facts] == [30, 30]
    assert dataset.read(0).trajectory.sent_sequence.tolist() == list(range(30))
    assert dataset.read(1).metadata["seed"] == 1
    assert Status.ARMED not in emulator.status()


def test_replay_asks_for_what_was_recorded(emulator: Emulator, tmp_path: Path) -> None:
    """The asked targets of the replay are those of the recording, command by command."""
    run(emulator, tmp_path / "a", seconds=0.5)
    first = Dataset.open(tmp_path / "a")
    report = replay(
        REPLAY.settings(episode=first.path(0), port=emulator.port, dataset=tmp_path / "b", quiet=True)
    )
    assert report.outcome is Outcome.FINISHED
    asked = [d.read(0).trajectory.requested_position for d in (first, Dataset.open(tmp_path / "b"))]
    assert asked[0].shape == (25, 1)
    assert (asked[0] == asked[1]).all()
    printed = report.episodes[-1]
    assert printed.replay is not None and printed.replay.position[0] < 0.05
    lines = printed.lines()
    assert lines[1].startswith("  ran for 0.5 s")
    assert any(line.startswith("  difference from the recording at most ") for line in lines)


def test_dry_run_leaves_the_motor_off(start_emulator: Callable[..., Emulator], tmp_path: Path) -> None:
    """The commands are computed and recorded, and the device was never armed."""
    emulator = start_emulator()
    report = run(emulator, tmp_path, seconds=0.7, dry=True)
    assert report.outcome is Outcome.FINISHED
    episode = read_episode(tmp_path / "episodes" / "000000.mcap")
    armed = [Status(int(s)) for s in episode.trajectory.status]
    assert len(armed) > 100 and not any(Status.ARMED in s for s in armed)
    assert episode.trajectory.sent_s.size == 0
    assert Status.HOMED not in emulator.status()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_the_run_passively(
    emulator: Emulator, tmp_path: Path, number: signal.Signals
) -> None:
    """The operator's stop: passive, whole data, exit code 130, and the handlers of before are back."""
    before = signal.getsignal(number)
    with pytest.raises(InterruptedRunError, match="stopped by the operator") as raised:
        run(emulator, tmp_path, lambda: os.kill(os.getpid(), number))
    report = raised.value.report
    assert (report.outcome, report.exit_code) == (Outcome.STOPPED, 130)
    assert report.episodes[0].reason == "stopped by the operator"
    assert report.episodes[0].passive_confirmed
    assert Status.ARMED not in emulator.status()
    assert Status.WATCHDOG not in emulator.status()
    assert_whole(tmp_path)
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("phase", ["loading", "connecting", "homing", "arming", "making passive"])
def test_ctrl_c_in_every_other_phase_ends_passively(emulator: Emulator, tmp_path: Path, phase: str) -> None:
    """Nothing is commanded afterwards; a run that is over anyway stays finished."""
    done = False

    def on_beat(beat: Beat) -> None:
        nonlocal done
        if beat.phase == phase and not done:
            done = True
            os.kill(os.getpid(), signal.SIGINT)

    plan = RunPlan(robot="cartpole", motion="chirp", seconds=0.2 if phase == "making passive" else LONG)
    with pytest.raises(InterruptedRunError) as raised:
        run_episodes(
            plan,
            port=emulator.port,
            dataset=tmp_path,
            episodes=1,
            purpose="collect",
            on_beat=on_beat,
        )
    assert done
    assert raised.value.report.outcome is (Outcome.FINISHED if phase == "making passive" else Outcome.STOPPED)
    assert Status.ARMED not in emulator.status()
    assert len(Dataset.open(tmp_path).episodes) == 1


# Deaths and stalls.


def test_a_stopped_control_process_is_killed_and_the_robot_made_passive(
    emulator: Emulator, tmp_path: Path
) -> None:
    """No heartbeat, so it is killed, and the supervisor sends the passive command itself."""
    pids: dict[str, int] = {}

    def stall() -> None:
        pids.update(children())
        os.kill(pids["control_process"], signal.SIGSTOP)

    with pytest.raises(SafetyError, match="was killed: it sent no heartbeat while running"):
        run(emulator, tmp_path, stall)
    assert not Path(f"/proc/{pids['control_process']}").exists()
    assert Status.ARMED not in emulator.status()
    assert_whole(tmp_path)
    assert Dataset.open(tmp_path).episodes[0].facts["passive_confirmed"] is True


def test_a_killed_control_process_leaves_a_passive_robot(emulator: Emulator, tmp_path: Path) -> None:
    """SIGKILL: the supervisor sees the death and sends the passive command before the watchdog has to act."""
    with pytest.raises(SafetyError, match=r"died by signal 9 \(SIGKILL\) without a report"):
        run(emulator, tmp_path, lambda: os.kill(children()["control_process"], signal.SIGKILL))
    assert Status.ARMED not in emulator.status()
    assert Status.WATCHDOG not in emulator.status()
    assert_whole(tmp_path)


def test_a_killed_recorder_ends_the_run_passively(emulator: Emulator, tmp_path: Path) -> None:
    """No recording, no run; the dataset repairs what was written and keeps all but the last 0.1 s."""
    with pytest.raises(DatasetError, match="the recorder has ended"):
        run(emulator, tmp_path, lambda: os.kill(children()["recorder_process"], signal.SIGKILL))
    assert Status.ARMED not in emulator.status()
    assert_whole(tmp_path)
    info = Dataset.open(tmp_path).episodes[0]
    assert any("the recording is incomplete" in warning for warning in info.facts["warnings"])


def test_a_full_disk_ends_the_run_passively(emulator: Emulator, tmp_path: Path) -> None:
    """The recorder may write no more (here: its file size limit); what was written is whole."""

    def fill() -> None:
        limit = (tmp_path / "episodes" / "000000.mcap").stat().st_size + 8000
        resource.prlimit(children()["recorder_process"], resource.RLIMIT_FSIZE, (limit, limit))

    with pytest.raises(DatasetError, match="the recorder failed"):
        run(emulator, tmp_path, fill)
    assert Status.ARMED not in emulator.status()
    assert_whole(tmp_path)


def test_a_killed_supervisor_leaves_a_passive_robot_and_no_process(
    emulator: Emulator, tmp_path: Path
) -> None:
    """The control process ends by its passive route, the recorder closes its file."""
    program = f"""
        import os
        from pathlib import Path
        from deal_hw.workflows.running.plan import RunPlan
        from deal_hw.workflows.running.supervised import run_episodes

        def on_beat(beat):
            if beat.phase == "running" and beat.count == {AT_BEAT}:
                print(Path("/proc/self/task/" + str(os.getpid()) + "/children").read_text(), flush=True)

        run_episodes(
            RunPlan(robot="cartpole", motion="chirp", seconds={LONG}), port={emulator.port!r},
            dataset=Path({str(tmp_path)!r}), episodes=1, purpose="collect", on_beat=on_beat,
        )
    """
    command = [sys.executable, "-c", textwrap.dedent(program)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as supervisor:
        if supervisor.stdout is None:
            raise RuntimeError("no pipe")
        pids = [int(word) for word in supervisor.stdout.readline().split()]
        assert len(pids) == 2
        deaths = [os.pidfd_open(pid) for pid in pids]
        supervisor.kill()
    for death in deaths:
        assert select.select([death], [], [], 10.0)[0], "a child outlived its supervisor"
        os.close(death)
    status = emulator.status()
    assert Status.ARMED not in status and Status.WATCHDOG not in status
    events = Dataset.open(tmp_path, notify=lambda text: None).read(0).trajectory.events
    assert [e.message for e in events if e.kind == "passive"] == ["the supervisor died"]
    assert_whole(tmp_path)


# Faults of the wire.


def test_a_cable_that_is_pulled_is_named_and_the_data_are_whole(
    start_emulator: Callable[..., Emulator], tmp_path: Path
) -> None:
    """The message names the port; the report says that nobody could confirm, and what the device does."""
    emulator = start_emulator("--vanish-after-s", "0.6")
    report = run(emulator, tmp_path)
    assert (report.outcome, report.exit_code) == (Outcome.TRIPPED, 3)
    assert report.episodes[0].reason.startswith(
        f"the connection is lost: {emulator.port}: the device vanished"
    )
    facts = Dataset.open(tmp_path).episodes[0].facts
    assert facts["passive_confirmed"] is False
    assert any(
        "switch it off by hand. If the cable is cut, its own watchdog has stopped the motor after 0.2 s" in w
        for w in facts["warnings"]
    )
    assert_whole(tmp_path)


def test_a_state_stream_that_stops_trips(start_emulator: Callable[..., Emulator], tmp_path: Path) -> None:
    """A firmware that hangs is seen by the age of its newest state."""
    report = run(start_emulator("--freeze-after-s", "0.6"), tmp_path)
    assert (report.outcome, report.exit_code) == (Outcome.TRIPPED, 3)
    assert "ms old, at most 60 ms are allowed" in report.episodes[0].reason
    assert any("switch it off by hand" in warning for warning in report.episodes[0].warnings)
    assert_whole(tmp_path)


def test_five_percent_of_corrupt_frames_are_survived_and_reported(
    start_emulator: Callable[..., Emulator], tmp_path: Path
) -> None:
    """The run finishes, the robot is passive, and the operator reads that the emulator spoils frames."""
    emulator = start_emulator("--corrupt", "0.05")
    report = run(emulator, tmp_path, seconds=2.0)
    assert report.outcome is Outcome.FINISHED
    assert any("spoils frames on purpose" in warning for warning in report.episodes[0].warnings)
    assert Status.ARMED not in emulator.status()
    assert_whole(tmp_path, at_least=95)


def test_a_second_collector_is_refused_and_disturbs_nobody(emulator: Emulator, tmp_path: Path) -> None:
    """The port is busy, at the level of the operating system, while the first run goes on to its end."""
    refused: list[PortBusyError] = []

    def second() -> None:
        try:
            run(emulator, tmp_path / "second")
        except PortBusyError as error:
            refused.append(error)

    report = run(emulator, tmp_path / "first", second, seconds=1.0)
    assert report.outcome is Outcome.FINISHED
    assert f"the robot is in use by process {os.getpid()} (" in str(refused[0])
    assert not (tmp_path / "second").exists()


def test_no_such_port_and_a_wrong_device_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    """The port that does not exist, and one on which something else answers."""
    with pytest.raises(PortNotFoundError, match="no serial port '/dev/ttyNOPE'"):
        collect(
            COLLECT.settings(robot="cartpole", port="/dev/ttyNOPE", dataset=tmp_path / "a", motion="hold")
        )
    master, slave = os.openpty()
    done = threading.Event()

    def chatter() -> None:
        while not done.wait(0.01):
            os.write(master, b"ready> ")

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        with pytest.raises(WrongDeviceError, match="no answer to hello"):
            collect(
                COLLECT.settings(
                    robot="cartpole", port=os.ttyname(slave), dataset=tmp_path / "a", motion="hold"
                )
            )
    finally:
        done.set()
        thread.join()
        os.close(master)
        os.close(slave)
    assert not (tmp_path / "a").exists()


# Policies.


def write_policy(path: Path, gains: tuple[float, ...] = CARTPOLE_GAINS, **changes: object) -> Path:
    """Write state feedback as an ONNX file with its spec."""
    onnx = pytest.importorskip("onnx")
    from deal_hw.policies.onnx_runtime import SPEC_KEY

    spec = dataclasses.replace(feedback_spec(DESCRIPTION), **changes)  # type: ignore[arg-type]
    float32, helper = onnx.TensorProto.FLOAT, onnx.helper
    weights = helper.make_tensor("W", float32, (4, 1), [gain / 0.25 for gain in gains])
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["observation", "W"], ["action"])],
        "feedback",
        [helper.make_tensor_value_info("observation", float32, ("batch", 4))],
        [helper.make_tensor_value_info("action", float32, ("batch", 1))],
        [weights],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {SPEC_KEY: spec.to_json()})
    onnx.save(model, str(path))
    return path


def test_deploy_balances_with_a_policy_file(emulator: Emulator, tmp_path: Path) -> None:
    """The same loop with another policy and purpose."""
    policy = write_policy(tmp_path / "p.onnx")
    report = deploy(
        DEPLOY.settings(
            robot="cartpole",
            port=emulator.port,
            policy=policy,
            out=tmp_path,
            seconds=1.0,
            task="stand",
            quiet=True,
        )
    )
    assert report.outcome is Outcome.FINISHED
    episode = Dataset.open(tmp_path / "dataset").read(0)
    assert (episode.metadata["purpose"], episode.metadata["task"]) == ("deploy", "stand")
    printed = report.episodes[-1]
    assert printed.balance is not None and not printed.balance.fell and printed.balance.angle_error_rad < 0.1
    assert any(line.startswith("  pole upright (within 0.5 rad) for 1.") for line in printed.lines())
    assert abs(episode.trajectory.position[:, 1]).max() < 0.3


def test_a_policy_that_returns_nan_trips_at_once(emulator: Emulator, tmp_path: Path) -> None:
    """Nothing of it reaches the robot, where the trial of the policy did not meet the fault either."""
    onnx_export = pytest.importorskip("deal_hw.policies.onnx_export")
    policy = tmp_path / "nan.onnx"
    onnx_export.write_policy(*faulty_policy(DESCRIPTION, "nan", rare=True), policy)
    # The verb refuses a wanted velocity for a robot without legs; the plan takes it.
    plan = RunPlan(robot="cartpole", policy=str(policy), velocity=f"{RARE_M_S},0,0")
    report = run_episodes(
        plan, port=emulator.port, dataset=tmp_path / "dataset", episodes=1, purpose="deploy"
    )
    assert (report.outcome, report.exit_code) == (Outcome.TRIPPED, 3)
    assert report.episodes[0].reason == "the policy asked for a command that is not finite"
    assert report.episodes[0].cycles_sent == 0
    assert Status.ARMED not in emulator.status()


def test_policies_that_do_not_fit_are_refused_before_the_robot_is_touched(tmp_path: Path) -> None:
    """No port is opened for a policy of another robot, one that is missing, or one that is none."""
    port = "/dev/ttyNOPE"
    other = write_policy(tmp_path / "other.onnx", robot="go2")
    with pytest.raises(PolicyMismatchError, match="robot: policy has 'go2', robot has 'cartpole'"):
        deploy(DEPLOY.settings(robot="cartpole", port=port, policy=other))
    with pytest.raises(PolicyError, match="no such policy file"):
        deploy(DEPLOY.settings(robot="cartpole", port=port, policy=tmp_path / "missing.onnx"))
    (tmp_path / "junk.onnx").write_text("not a network")
    with pytest.raises(PolicyError, match="not an ONNX network"):
        deploy(DEPLOY.settings(robot="cartpole", port=port, policy=tmp_path / "junk.onnx"))


def test_settings_that_cannot_be_are_refused(tmp_path: Path) -> None:
    """Where the data should go, how long, how often."""
    with pytest.raises(ConfigurationError, match="not both"):
        collect(COLLECT.settings("cartpole", port="x", out=tmp_path, dataset=tmp_path, motion="hold"))
    with pytest.raises(ConfigurationError, match="give --out RUN"):
        collect(COLLECT.settings("cartpole", port="x", motion="hold"))
    with pytest.raises(ConfigurationError, match="--seconds"):
        collect(COLLECT.settings("cartpole", port="x", out=tmp_path, motion="hold", seconds=math.nan))
    with pytest.raises(ConfigurationError, match="--episodes 0: allowed are 1 to 10000"):
        collect(COLLECT.settings("cartpole", port="x", out=tmp_path, motion="hold", episodes=0))


def test_the_verbs_that_run_on_the_robot_load_neither_torch_nor_mujoco_nor_scipy() -> None:
    """All that they import, the policy runtime and the driver included."""
    program = """
        import json, sys
        import deal_hw.cli.collect, deal_hw.cli.deploy, deal_hw.cli.replay
        import deal_hw.workflows.running.control_process
        import deal_hw.data.recording.dataset, deal_hw.data.recording.recorder_process
        import deal_hw.policies.onnx_runtime
        from deal_hw.workflows.running.plan import RunPlan, make_behaviour
        from deal_hw.clock import MonotonicClock
        from deal_hw.robots.connect import make_robot
        robot = make_robot("cartpole", "serial", "/dev/null", MonotonicClock())
        make_behaviour(RunPlan(robot="cartpole", motion="chirp"), robot.description)
        heavy = ("torch", "mujoco", "scipy", "rerun", "pandas")
        print(json.dumps([name for name in heavy if name in sys.modules]))
    """
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=True
    )
    assert json.loads(result.stdout) == []
