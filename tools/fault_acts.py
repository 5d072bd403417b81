"""Faults of any robot's run, and their rows: signals, a lost link, a second run."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fakes.faulty_proxy import FaultyProxy, State
from fault_rig import (
    ANY,
    ARMING,
    CONNECTING,
    ENDING,
    LYING_DOWN,
    PATIENCE_S,
    RISING,
    RUNNING,
    TAKING_OVER,
    Case,
    Rig,
    headline,
)

from deal_hw.control.process.realtime import process_state


def signal_run(number: signal.Signals) -> Callable[[Rig], None]:
    """Return an act: a signal to the process that the operator started."""
    return lambda rig: rig.signal(rig.run.pid, number)


def signal_control(number: signal.Signals) -> Callable[[Rig], None]:
    """Return an act: a signal to the control process."""
    return lambda rig: rig.signal(rig.control_pid(), number)


def processes(rig: Rig) -> dict[str, int]:
    """Return the pids of a run's processes; -1 where the run ended before."""
    return {
        "supervisor": rig.run.pid,
        "control process": rig.control_pid(),
        "recorder": rig.until(lambda: rig.child("recorder_process")) or -1,
    }


def signal_each(target: str, *numbers: int) -> Callable[[Rig], None]:
    """Return an act: signals to one process of a run or to all, one after the other, as a session ends.

    Args:
        target: "supervisor", "control process", "recorder" or "all processes".
        numbers: The signals.
    """

    def act(rig: Rig) -> None:
        found = processes(rig)
        pids = [pid for name, pid in found.items() if target in (name, "all processes")]
        for number in numbers:
            for pid in pids:
                rig.signal(pid, number)
        if signal.SIGTSTP in numbers and rig.run.pid in pids:
            _go_on(rig)

    return act


def kill_control_sometime(rig: Rig) -> None:
    """The control process is killed at a random time: a dry run has no phases in the emulator's log."""
    pid = rig.control_pid()
    time.sleep(float(rig.rng.uniform(0.0, 3.0)))
    rig.signal(pid, signal.SIGKILL)


def kill_both(rig: Rig) -> None:
    """Both processes are killed, as when the machine is out of memory."""
    pid = rig.control_pid()
    rig.signal(rig.run.pid, signal.SIGKILL)
    rig.signal(pid, signal.SIGKILL)


def stop_supervisor(rig: Rig) -> None:
    """The operator's process is stopped until its control process has ended; then it goes on."""
    control = rig.control_pid()
    rig.signal(rig.run.pid, signal.SIGSTOP)
    with contextlib.suppress(TimeoutError):
        rig.until(lambda: process_state(control) in "ZX")
    rig.run.send_signal(signal.SIGCONT)


def suspend(rig: Rig) -> None:
    """Ctrl-Z: the robot must be passive before the process stops; then `fg`."""
    rig.signal(rig.run.pid, signal.SIGTSTP)
    _go_on(rig)


def _go_on(rig: Rig) -> None:
    """Wait until the run has stopped, check that the motors do not obey, and let it go on."""
    stopped = rig.until(lambda: process_state(rig.run.pid) == "T")
    if not stopped:
        rig.notes.append("it ended instead of stopping")
        return
    time.sleep(0.02)
    if rig.is_active:
        rig.notes.append("stopped while the motors obey")
    time.sleep(0.3)
    if rig.is_active:
        rig.notes.append("the motors obey while it is stopped")
    rig.run.send_signal(signal.SIGCONT)


def freeze_link(seconds: float) -> Callable[[Rig], None]:
    """Return an act: the link is silent both ways for a time [s]."""

    def act(rig: Rig) -> None:
        rig.fault()
        if rig.proxy is None:
            os.kill(rig.process.pid, signal.SIGUSR1)
        else:
            _away(rig.proxy, "frozen", seconds)

    return act


def reset_link(seconds: float) -> Callable[[Rig], None]:
    """Return an act: the connection is reset, and refused for a time [s]."""

    def act(rig: Rig) -> None:
        rig.fault()
        if rig.proxy is None:
            raise RuntimeError("this wire has no connections")
        _away(rig.proxy, "refused", seconds)

    return act


def _away(proxy: FaultyProxy, state: State, seconds: float) -> None:
    until = time.monotonic() + seconds
    proxy.set(state)
    time.sleep(max(until - time.monotonic(), 0.0))
    proxy.set("open")


def second_run(elsewhere: bool = False) -> Callable[[Rig], None]:
    """Return an act: a second run of the same robot; Ctrl-C then ends the first; no run takes over.

    Args:
        elsewhere: Whether the second uses another address, as from another computer.
    """

    def act(rig: Rig) -> None:
        second = rig.launch("second", rig.process.port if elsewhere else "")
        begun = time.monotonic()
        try:
            code = second.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            second.kill()
            code = second.wait()
            rig.notes.append(f"the second run was not refused within {PATIENCE_S:g} s")
        rig.notes += [] if code == 2 else [f"the second run ended with {code}"]
        text = (rig.folder / "out" / "second").read_text()
        rig.notes += [] if "in use" in text else [f"the second run said {headline(text)!r}"]
        rig.printed.append(f"second run, after {time.monotonic() - begun:.1f} s: {headline(text)}")
        if rig.run.poll() is not None:
            rig.notes.append("the first run did not go on")
            return
        rig.until(lambda: rig.is_active)
        time.sleep(float(rig.rng.uniform(0.1, 0.5)))
        rig.signal(rig.run.pid, signal.SIGINT)
        rig.run.wait(PATIENCE_S)
        left = writers(rig.folder / "out" / "second")
        rig.notes += [f"{len(left)} processes of the second run are left to take over"] if left else []

    return act


def writers(output: Path) -> list[int]:
    """Return the processes with this file as output: of a run and all that it started."""
    found = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdigit() and os.readlink(entry / "fd" / "2") == str(output.resolve()):
                found.append(int(entry.name))
    return found


def after(option: str) -> tuple[str, ...]:
    """Return an option of the emulator with a random moment."""
    return (option, "{t}")


LINK_S = (0.1, 0.5, 1.5, 3.0, 8.0)
JOINT_FAULTS = ("limp", "held", "frozen reading", "exchanged readings", "turned reading")
"""How an emulator's log names the faults of joints."""
JOINT_MS = 2000.0
"""Longest time until a run is passive whose joints do not follow (docs/explanation/safety.md) [ms]."""
LEAVES_MS = 500.0
"""The push that is judged begins when the set-point has left a reading that stands or is another's [ms]."""


def joint_cases(
    seconds: float, moments_s: tuple[float, float], *, exchanged: bool = True, again: bool = False
) -> Iterator[Case]:
    """Yield the rows of joints that fail in a motion that moves all of them.

    Args:
        seconds: Length of the run [s].
        moments_s: First and last moment of the fault after the first command [s].
        exchanged: Whether readings are exchanged or have the other sign, too.
        again: Whether another run follows when drives are back, or joints are free.
    """
    common: dict[str, Any] = {
        "motion": ("--excite", "multisine"),
        "seconds": seconds,
        "moments_s": moments_s,
        "within_ms": JOINT_MS,
    }
    for what, option in {"drives are limp": "--limp-after-s", "joints are held": "--held-after-s"}.items():
        yield Case(name=f"the {what} for 2 s", emulator=after(option), again=again, **common)
    readings = {
        "stands still": "--frozen-after-s",
        "is exchanged with another's": "--exchanged-after-s",
        "has the other sign": "--turned-after-s",
    }
    for what, option in list(readings.items())[: 3 if exchanged else 1]:
        words = (*after(option), "--faulty-joint", "{joint}")
        yield Case(
            name=f"the reading of a joint {what}",
            emulator=words,
            **{**common, "within_ms": JOINT_MS + LEAVES_MS},
        )


def process_cases(interrupt_ms: float = 600.0) -> tuple[Case, ...]:
    """Return the rows with a fault of a process; the same for every robot.

    Args:
        interrupt_ms: The robot must be passive within this time of Ctrl-C [ms].
    """
    stop, kill = signal_control(signal.SIGSTOP), signal_control(signal.SIGKILL)
    connected = ANY[1:]
    return (
        Case(name="Ctrl-C", act=signal_run(signal.SIGINT), phases=ANY, codes=(130,), within_ms=interrupt_ms),
        # Without a control process only the shell's own stop acts; then the run goes on.
        Case(name="Ctrl-Z, then fg", act=suspend, phases=ANY, codes=(130, 0)),
        Case(
            name="the supervisor stands still (SIGSTOP)",
            act=stop_supervisor,
            codes=(130,),
            phases=(TAKING_OVER, ARMING, RISING, RUNNING),
            within_ms=2000.0,
            seconds=20.0,
        ),
        Case(
            name="the supervisor is killed (SIGKILL)",
            act=signal_run(signal.SIGKILL),
            phases=connected,
            codes=(-9,),
        ),
        Case(name="the control process stands still (SIGSTOP)", act=stop, codes=(2,), within_ms=1500.0),
        Case(name="the control process is killed (SIGKILL)", act=kill, phases=connected, codes=(2,)),
        Case(name="a policy that hangs", policy="hang", codes=(2,), phases=(), within_ms=1500.0),
        Case(
            name="a second run while the first connects, starts or runs",
            act=second_run(),
            codes=(130,),
            phases=(CONNECTING, TAKING_OVER, RISING, RUNNING),
            seconds=60.0,
            within_ms=interrupt_ms,
        ),
        Case(
            name="dry run: a policy that hangs",
            policy="hang",
            dry=True,
            expect="untouched",
            codes=(2,),
            phases=(),
        ),
        Case(
            name="dry run: the control process is killed",
            act=kill_control_sometime,
            dry=True,
            policy="hold",
            expect="untouched",
            codes=(2,),
            phases=(CONNECTING,),
            seconds=6.0,
        ),
    )


def link_cases(
    kinds: Mapping[str, Callable[[float], Callable[[Rig], None]]],
    cut: bool,
    wires: tuple[str, ...] = (),
    lengths_s: Sequence[float] = LINK_S,
) -> Iterator[Case]:
    """Yield the rows with a link that is lost for a time: at any moment, and while the run ends.

    Args:
        kinds: Fault of the link, in words with "{}" for the time, and a function from a time [s] to an act.
        cut: Whether the emulator needs the length of a cut.
        wires: Wires on which they are possible.
        lengths_s: How long the link is lost [s].
    """
    for words, make in kinds.items():
        for when, phases in ((" as the run ends", (ENDING,)), ("", (RISING, RUNNING, LYING_DOWN))):
            for seconds in lengths_s:
                yield Case(
                    name=words.format(f"{seconds:g} s") + when,
                    act=make(seconds),
                    phases=phases,
                    codes=(0, 3) if phases == (ENDING,) else (3,),
                    from_ms=1e3 * seconds,
                    emulator=("--cut-s", f"{seconds}") if cut else (),
                    within_ms=2500.0,
                    wires=wires,
                )


def network_cases(lengths_s: Sequence[float] = LINK_S) -> Iterator[Case]:
    """Yield the rows with a link that is lost, of a robot on Zenoh and DDS.

    Args:
        lengths_s: How long the link is lost [s].
    """
    tcp = {"the link freezes for {}": freeze_link, "the link is reset for {}": reset_link}
    yield from link_cases(tcp, cut=False, wires=("zenoh",), lengths_s=lengths_s)
    yield from link_cases(
        {"the link is cut for {}": freeze_link}, cut=True, wires=("dds",), lengths_s=lengths_s
    )
