"""Common part of the fault tables: an emulator and a run of deal-hw, as processes over a real wire."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from fakes.faulty_policy import RARE_M_S, faulty_policy
from fakes.faulty_proxy import FaultyProxy

from deal_hw.description import RobotDescription
from deal_hw.policies.onnx_export import write_policy
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.sim.robots.file_description import file_description
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.workflows.emulation.process import EmulatorProcess

UNDER_TEST = os.environ.get("DEAL_HW_PYTHON", sys.executable)
"""Python of the deal-hw under test, perhaps of an older checkout; emulator and judgement are of this one."""
PATIENCE_S = 240.0
"""A run that takes longer than this hangs; a busy machine takes ten times as long as a quiet one [s]."""
CONNECTING, TAKING_OVER, ARMING, RISING, RUNNING, LYING_DOWN, ENDING = (
    "connecting",
    "taking over",
    "arming",
    "standing up",
    "running",
    "lying down",
    "ending",
)
COMMANDING = (RISING, RUNNING, LYING_DOWN, ENDING)
ANY = (CONNECTING, TAKING_OVER, ARMING, *COMMANDING)
_POLL_S = 0.004
LATE_S, HANG_S = 0.12, 1000.0
"""Processor time of a late policy, and of one that hangs [s]."""
GOES_WRONG_AT_S = 0.4
"""Beginning of a policy's fault [s]."""

AGAIN_S = 1.2
"""Pause between the end of a fault and the next run [s]: the robot's motion of the first second is noted."""
DEPLOY = """
import sys
from pathlib import Path
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.cli.show import Terminal
from deal_hw.workflows.running.supervised import run_episodes
from deal_hw.errors import DealHwError

robot, policy, wanted, seconds, wire, port, dataset, *dry = sys.argv[1:]
plan = RunPlan(
    robot=robot, transport=wire, policy=policy, velocity=wanted, seconds=float(seconds),
    dry_run=bool(dry), home=not dry,
)
try:
    code = run_episodes(
        plan, port=port, dataset=Path(dataset), episodes=1, purpose="deploy", view=Terminal()
    ).exit_code
except KeyboardInterrupt:
    code = 130
except DealHwError as error:
    print(f"deal-hw: error: {error}", file=sys.stderr)
    code = 2
sys.exit(code)
"""

Expect = Literal["goes on", "passive", "contested", "untouched", "unhomed", "stiff"]
"""Expected ends: the run finished; the robot is passive and stays so; the same while another program
continues to command; nothing was sent; no motor was commanded; the robot holds its last command, because only
a program on its own side could stop it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One row of the table.

    Attributes:
        name: The fault, in words.
        expect: The expected end.
        codes: Correct exit codes.
        act: Causes the fault; called at a random moment of a random phase. None: the emulator causes it.
        phases: Those phases.
        emulator: Options of the emulator; "{t}" becomes a random moment after the first command [s],
            "{joint}" a random joint.
        policy: "nan", "late" or "hang" for a faulty policy; "" to hold the pose.
        dry: Whether it is a dry run.
        seconds: Length of the run without standing up and lying down [s]; 0: the rig's.
        within_ms: The robot must be passive within this time of the fault, or of the link's return [ms].
        wires: The wires on which it is possible; empty: all.
        from_ms: Times count from this long after the fault [ms]: the duration of the link's loss.
        motion: Arguments that choose the motion; empty: the rig's.
        moments_s: First and last moment of an emulator's own fault after the first command [s]; None: the
            rig's.
        again: Whether another run follows on the same robot when its fault is over; it must finish.
    """

    name: str
    expect: Expect = "passive"
    codes: tuple[int, ...] = (3,)
    act: Callable[[Rig], None] | None = None
    phases: tuple[str, ...] = COMMANDING
    emulator: tuple[str, ...] = ()
    policy: str = ""
    dry: bool = False
    seconds: float = 0.0
    within_ms: float = 600.0
    wires: tuple[str, ...] = ()
    from_ms: float = 0.0
    motion: tuple[str, ...] = ()
    moments_s: tuple[float, float] | None = None
    again: bool = False


class SpoiledError(Exception):
    """A repetition without result: on a busy machine the run ended, or came not so far, before the fault."""


class Rig(ABC):
    """An emulator, a run, and their faults. One repetition of one case.

    Args:
        case: The case.
        wire: The transport.
        folder: For files.
        rng: Draws the moment.
        slot: Number of the job, for ports and domains of its own.
        typical_s: Recent duration of connecting and taking over on this machine [s].
    """

    robot: ClassVar[str]
    description: ClassVar[RobotDescription]
    phases: ClassVar[tuple[str, ...]]
    """The phases of a run of this robot."""
    wires: ClassVar[tuple[str, ...]]
    longest_s: ClassVar[float]
    """The latest moment after the first command at which an emulator's own faults begin [s]."""
    active: ClassVar[frozenset[str]]
    """Entries of the emulator's log after which the motors obey."""
    inactive: ClassVar[frozenset[str]]
    over: ClassVar[frozenset[str]] = frozenset()
    """Entries of the emulator's log at which its own fault is over."""
    again: ClassVar[tuple[str, ...]] = ()
    """Arguments that choose the motion of another run after the fault."""
    usual_s: ClassVar[float]
    """Length of a run whose case has none of its own [s]."""
    by_program: ClassVar[bool] = False
    """Whether a policy, or a dry run, is run by a program; see :meth:`deployment`."""

    def __init__(
        self,
        case: Case,
        wire: str,
        folder: Path,
        rng: np.random.Generator,
        slot: int = 0,
        typical_s: Mapping[str, float] | None = None,
    ) -> None:
        self.case, self.wire, self.folder, self.rng, self.slot = case, wire, folder, rng, slot
        self.typical_s = dict(typical_s or {CONNECTING: 2.0, TAKING_OVER: 0.5})
        self.fault_ns = self.start_ns = -1
        self.end_ns: int | None = None
        self.phase = ""
        self.notes: list[str] = []
        self.events: list[tuple[int, str]] = []
        self.port = ""
        self.proxy: FaultyProxy | None = None
        self.run: subprocess.Popen[str]
        self.printed: list[str] = []
        self._events_at = 0
        self._pids: set[int] = set()

    @abstractmethod
    def emulator_options(self) -> list[str]:
        """Return the options of the emulator for this wire."""

    @abstractmethod
    def arguments(self) -> list[str]:
        """Return the arguments of deal-hw, without port, folder and dry run."""

    @abstractmethod
    def phase_at(self, phase: str) -> tuple[str, float, float]:
        """Return a phase as the event that comes before it, its begin after that and its length [s]."""

    @abstractmethod
    def changes(self, report: Mapping[str, Any]) -> list[tuple[int, str]]:
        """Return the robot's commands and actions, from the emulator's report: host time [ns] and name."""

    @abstractmethod
    def untouched(self, report: Mapping[str, Any]) -> str:
        """Return the commands to the robot, as text; "" for none."""

    def by_itself(self, report: Mapping[str, Any]) -> int:
        """Return the time of the emulator's own fault [host ns]; -1: there was none."""
        return -1

    def figures(self, report: Mapping[str, Any]) -> dict[str, float]:
        """Return further figures by name with unit; what is wrong with them goes to the notes."""
        return {}

    def states(self, report: Mapping[str, Any]) -> list[tuple[int, bool]]:
        """Return the times at which the motors began or ceased to follow this run [host ns]."""
        found = [(ns, what) for ns, what in self.changes(report) if what in self.active | self.inactive]
        return [(ns, what in self.active) for ns, what in found if self.end_ns is None or ns < self.end_ns]

    @contextlib.contextmanager
    def emulator(self) -> Iterator[EmulatorProcess]:
        """Run the emulator."""
        moment = f"{self.rng.uniform(*(self.case.moments_s or (0.2, self.longest_s))):.3f}"
        joint = str(self.rng.choice(self.description.actuated)) if "{joint}" in self.case.emulator else ""
        drawn = {"{t}": moment, "{joint}": joint}
        options = [drawn.get(word, word) for word in self.case.emulator]
        process = EmulatorProcess(
            self.robot,
            *self.emulator_options(),
            "--reveal-to",
            str(self.folder / "emulator.json"),
            "--events-to",
            str(self.folder / "events"),
            *options,
        )
        (self.folder / "events").touch()
        with process, self._before(process):
            yield process

    @contextlib.contextmanager
    def _before(self, process: EmulatorProcess) -> Iterator[None]:
        """Put the proxy before the emulator where the wire has connections."""
        self.process, self.port = process, process.port
        if self.wire != "zenoh":
            yield
            return
        with FaultyProxy(("127.0.0.1", int(process.port.rpartition(":")[2]))) as self.proxy:
            self.port = f"tcp/127.0.0.1:{self.proxy.port}"
            yield

    def policy_arguments(self) -> list[str]:
        """Write the case's policy, and return the arguments that deploy it."""
        policy, script = self.folder / "policy.onnx", self.folder / "wanted.csv"
        if not policy.exists():
            write_faulty(policy, self.description, self.case.policy)
            wanted = 0.0 if self.case.policy == "hold" else RARE_M_S
            script.write_text(f"time_s,x,y,yaw\n{GOES_WRONG_AT_S},{wanted},0,0\n", encoding="utf-8")
        return ["--policy", str(policy), "--velocity", str(script)]

    def command(self, out: str, port: str = "") -> list[str]:
        """Return the command line of a run."""
        if self.by_program and (self.case.policy or self.case.dry):
            return self.deployment(out, port)
        dry = ["--dry-run"] if self.case.dry else []
        where = ["--port", port or self.port, "--out", str(self.folder / out)]
        return [UNDER_TEST, "-m", "deal_hw", *self.arguments(), *where, *dry]

    @property
    def seconds(self) -> float:
        """Length of the run [s]."""
        return self.case.seconds or self.usual_s

    def deployment(self, out: str, port: str = "") -> list[str]:
        """Return the command line of a run of the case's policy on a robot without legs.

        A policy's fault begins at a commanded velocity, so that its trial does not find the fault. `deploy`
        refuses that option for a robot without legs, so a program runs the same plan.
        """
        _, policy, _, wanted = self.policy_arguments()
        where = [self.wire, port or self.port, str(self.folder / out / "dataset")]
        dry = ["dry"] * self.case.dry
        return [UNDER_TEST, "-c", DEPLOY, self.robot, policy, wanted, str(self.seconds), *where, *dry]

    def launch(self, out: str, port: str = "", command: Sequence[str] = ()) -> subprocess.Popen[str]:
        """Start a run, or another command, in a process group of its own, as a shell does."""
        (self.folder / "out").mkdir(exist_ok=True)
        with (self.folder / "out" / out).open("w") as file:
            return subprocess.Popen(
                command or self.command(out, port),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                text=True,
                process_group=0,
            )

    def start(self) -> None:
        """Start the run."""
        self.start_ns = time.monotonic_ns()
        self.run = self.launch("run")

    @property
    def output(self) -> str:
        """What the run has printed."""
        return (self.folder / "out" / "run").read_text()

    # Conditions to wait for.

    def pump(self) -> None:
        """Read the emulator's new events."""
        if (self.folder / "events").stat().st_size == self._events_at:
            return
        with (self.folder / "events").open() as file:
            file.seek(self._events_at)
            while (line := file.readline()).endswith("\n"):
                _, host_ns, what = json.loads(line)
                self.events.append((host_ns, what))
                self._events_at = file.tell()

    def until(self, ready: Callable[[], Any], seconds: float = PATIENCE_S) -> Any:
        """Return the result of ``ready`` as soon as it is true; None if the run ended before.

        Raises:
            TimeoutError: It takes too long.
        """
        until_ns = time.monotonic_ns() + round(seconds * 1e9)
        while time.monotonic_ns() < until_ns:
            self.pump()
            if found := ready():
                return found
            if self.run.poll() is not None:
                return None
            time.sleep(_POLL_S)
        raise TimeoutError(f"waited {seconds:g} s without result: {getattr(ready, '__doc__', '')}")

    def event_ns(self, what: str) -> int:
        """Return the first time of an event [host ns]; 0: not yet. "start": the start of the run."""
        if what == "start":
            return self.start_ns
        return next((ns for ns, reported in self.events if reported == what), 0)

    def await_moment(self) -> None:
        """Draw a phase and a moment of it, and return then.

        Raises:
            SpoiledError: The run ended before, or the moment never came: nothing was caused.
        """
        self.phase = str(self.rng.choice([phase for phase in self.case.phases if phase in self.phases]))
        event, begin_s, length_s = self.phase_at(self.phase)
        offset_s = begin_s + length_s * float(self.rng.uniform())
        try:
            begun_ns = self.until(lambda: self.event_ns(event))
        except TimeoutError as error:
            raise SpoiledError(f"the run did not reach its phase {self.phase!r}: {error}") from error
        if begun_ns:
            due_ns = begun_ns + round(offset_s * 1e9)
            time.sleep(max(due_ns - time.monotonic_ns(), 0) * 1e-9)
        if not begun_ns or (self.phase != ENDING and self.run.poll() is not None):
            raise SpoiledError(f"the run ended before its phase {self.phase!r} was over")

    def control_pid(self) -> int:
        """Return the control process's pid once it exists; -1 where the run ended before."""
        return self.until(lambda: self.child("control_process")) or -1

    def child(self, module: str) -> int:
        """Return the pid of the run's child with this module; 0: there is none."""
        with contextlib.suppress(OSError):
            for pid in Path(f"/proc/{self.run.pid}/task/{self.run.pid}/children").read_text().split():
                self._pids.add(int(pid))
                with contextlib.suppress(OSError):
                    if module in Path(f"/proc/{pid}/cmdline").read_text():
                        return int(pid)
        return 0

    @property
    def is_active(self) -> bool:
        """Whether the motors follow commands, by the emulator's events so far."""
        self.pump()
        reported = [what for _, what in self.events if what in self.active | self.inactive]
        return bool(reported) and reported[-1] in self.active

    # Actions.

    def fault(self) -> None:
        """Note the present time as that of the fault."""
        if self.fault_ns < 0:
            self.fault_ns = time.monotonic_ns()

    def signal(self, pid: int, number: int) -> None:
        """Send a signal, which is the fault; to a process that has just ended, nothing."""
        self.fault()
        if pid > 0:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)

    def run_again(self) -> None:
        """Wait until the emulator's fault is over and some time has passed; run again: it must finish.

        Raises:
            SpoiledError: The fault never began, because the run ended before it commanded; or it never ended.
        """
        if not any(what in self.active for _, what in self.events):
            raise SpoiledError(f"the run ended before it commanded: {headline(self.output)}")
        due = time.monotonic() + PATIENCE_S
        while not any(self.event_ns(what) for what in self.over):
            if time.monotonic() > due:
                raise SpoiledError("the emulator's fault did not end")
            time.sleep(0.02)
            self.pump()
        time.sleep(AGAIN_S)
        words = ["collect", self.robot, *self.again, "--transport", self.wire, "--port", self.port]
        next_run = self.launch(
            "again", command=[UNDER_TEST, "-m", "deal_hw", *words, "--out", str(self.folder / "again")]
        )
        try:
            code = next_run.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            next_run.kill()
            code = next_run.wait()
        if code != 0:
            printed = headline((self.folder / "out" / "again").read_text())
            self.notes.append(f"the next run ended with {code}: {printed}")

    def finish(self) -> None:
        """Wait until the run and its children have ended; kill what hangs."""
        self.child("")
        deadline = time.monotonic() + PATIENCE_S
        try:
            self.run.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.notes.append("the run hung")
            self.run.kill()
            self.run.wait()
        while alive := [pid for pid in self._pids if Path(f"/proc/{pid}").exists()]:
            if time.monotonic() > deadline:
                self.notes.append(f"{len(alive)} processes outlived the run")
                for pid in alive:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                break
            time.sleep(0.01)


class FileRig(Rig):
    """A robot of a robot.yaml, which is known when its files are written, one for each repetition.

    Attributes:
        file: What robot.yaml holds.
    """

    def __init__(
        self,
        case: Case,
        wire: str,
        folder: Path,
        rng: np.random.Generator,
        slot: int = 0,
        typical_s: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(case, wire, folder, rng, slot, typical_s)
        self.file = self.written()
        self.robot = str(folder / "robot.yaml")  # type: ignore[misc]
        self.description = file_description(self.file, folder / "arm.xml")  # type: ignore[misc]

    @abstractmethod
    def written(self) -> RobotFile:
        """Write arm.xml and robot.yaml into the folder, and return what the latter holds."""


def headline(printed: str) -> str:
    """Return the operator's line on the end of the run."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    wanted = [line for line in lines if re.match(r"(tripped|finished|stopped|failed|deal-hw: error)", line)]
    return (wanted or lines or [""])[0]


def write_faulty(path: Path, description: RobotDescription, fault: str) -> None:
    """Write a policy whose fault begins when the commanded velocity is not zero.

    Args:
        path: The file.
        description: The robot.
        fault: "nan"; "late", which computes for :data:`LATE_S`; "hang", for ever.
    """
    rounds = 1000
    if fault in ("late", "hang"):
        write_policy(*faulty_policy(description, "late", rounds, rare=True), path)
        policy, wish = OnnxPolicy(path), np.array([RARE_M_S, 0.0, 0.0], dtype=np.float32)
        times = []
        for _ in range(5):
            begun = time.thread_time()
            policy.act(wish)
            times.append(time.thread_time() - begun)
        rounds = round(rounds * (LATE_S if fault == "late" else HANG_S) / min(times))
    write_policy(*faulty_policy(description, "nan" if fault == "nan" else "late", rounds, rare=True), path)
