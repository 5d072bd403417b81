"""The recorder as a process of its own: kills, signals, full disks and bad datagrams."""

from __future__ import annotations

import itertools
import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from deal_hw import load
from deal_hw.clock import MonotonicClock
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.data.recording.record import CycleRecord, encode
from deal_hw.data.recording.recorder_launch import RecorderHandle, start_recorder
from deal_hw.data.recording.repair import repair, verify
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import DatasetError, TornRecordingError

pytestmark = pytest.mark.real_time

MakeCycle = Callable[[int], CycleRecord]


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[RecorderHandle]:
    """A recorder process that is ready."""
    handle = start_recorder(tmp_path / "episode.mcap", DESCRIPTION.to_json(), {"purpose": "test"})
    try:
        handle.wait_ready()
        yield handle
    finally:
        handle.finish()


def feed(handle: RecorderHandle, datagrams: list[bytes]) -> None:
    """Send all datagrams, waiting only while the socket is full."""
    handle.control_socket.setblocking(True)
    for datagram in datagrams:
        handle.control_socket.send(datagram)


def test_episode_is_whole_when_the_peer_closes(
    recorder: RecorderHandle, tmp_path: Path, make_cycle: MakeCycle
) -> None:
    """All that was handed over is in the file, in order, though the peer closes at once."""
    feed(recorder, [encode(make_cycle(number)) for number in range(300)])
    outcome = recorder.finish()
    assert outcome.complete
    assert (outcome.cycles, outcome.states, outcome.errors) == (300, 1200, ())
    trajectory = read_trajectory(tmp_path / "episode.mcap")
    np.testing.assert_array_equal(trajectory.effort[:, 0], 0.5 * np.arange(1200))
    assert verify(tmp_path / "episode.mcap").sound


@pytest.mark.parametrize("seconds", [0.15, 0.42])
def test_kill_loses_at_most_100_ms(
    recorder: RecorderHandle, tmp_path: Path, make_cycle: MakeCycle, seconds: float
) -> None:
    """Killed at 50 Hz, a recorder keeps all but the last 100 ms of samples, counted by their own stamps."""
    clock = MonotonicClock()
    begin_ns = clock.now_ns()
    cycles = round(seconds * 50)
    for number in range(cycles):
        clock.sleep_until_ns(begin_ns + number * 20_000_000)
        recorder.control_socket.send(encode(make_cycle(number)))
    # The load of a test machine is not the recorder's: let it take what is in the socket, then kill it.
    wait_until_drained(recorder.control_socket)
    recorder.process.kill()
    outcome = recorder.finish()
    assert not outcome.complete
    assert "without a report" in outcome.errors[0]
    with pytest.raises(TornRecordingError):
        read_trajectory(tmp_path / "episode.mcap")
    assert repair(tmp_path / "episode.mcap").repaired
    kept = read_trajectory(tmp_path / "episode.mcap")
    last_s = 0.005 * (4 * cycles - 1)
    assert last_s - kept.receive_s[-1] <= 0.1
    np.testing.assert_array_equal(kept.effort[:, 0], 0.5 * np.arange(kept.effort.shape[0]))


def wait_until_drained(sender: socket.socket) -> None:
    """Return once the receiver has taken every datagram (SIOCOUTQ is 0)."""
    import fcntl
    import struct
    import termios

    while struct.unpack("i", fcntl.ioctl(sender, termios.TIOCOUTQ, b"\0" * 4))[0]:
        os.sched_yield()


def test_ctrl_c_does_not_end_the_recorder(
    recorder: RecorderHandle, tmp_path: Path, make_cycle: MakeCycle
) -> None:
    """The supervisor hears of it and ends the run; cycles after it are still recorded."""
    feed(recorder, [encode(make_cycle(0))])
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGUSR1, signal.SIGALRM):
        os.kill(recorder.process.pid, number)
    feed(recorder, [encode(make_cycle(1))])
    outcome = recorder.finish()
    assert outcome.complete and outcome.cycles == 2
    (reported,) = outcome.errors
    assert reported.startswith("it was ended by SIG")


def test_sigterm_ends_it_with_a_whole_file(
    recorder: RecorderHandle, tmp_path: Path, make_cycle: MakeCycle
) -> None:
    """After SIGTERM the peer has two seconds for its last words, then the file is closed properly."""
    feed(recorder, [encode(make_cycle(0))])
    os.kill(recorder.process.pid, signal.SIGTERM)
    feed(recorder, [encode(make_cycle(1))])
    assert recorder.process.wait(timeout=20) == 0
    assert verify(tmp_path / "episode.mcap").sound
    assert read_trajectory(tmp_path / "episode.mcap").device_s.size == 8


def test_bad_datagram_is_reported_and_passed_over(recorder: RecorderHandle, make_cycle: MakeCycle) -> None:
    """A corrupt record costs itself alone; the outcome says that something is missing."""
    broken = bytearray(encode(make_cycle(1)))
    broken[100] ^= 1
    feed(recorder, [encode(make_cycle(0)), bytes(broken), encode(make_cycle(2))])
    outcome = recorder.finish()
    assert not outcome.complete
    assert outcome.cycles == 2
    assert "wrong CRC-32" in outcome.errors[0]


def test_full_disk_is_reported_while_the_socket_is_drained(tmp_path: Path, make_cycle: MakeCycle) -> None:
    """Past the limit the recorder says so, takes all further cycles and leaves a sound file of the first."""
    import resource

    path = tmp_path / "episode.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handle = start_recorder(path, DESCRIPTION.to_json(), {})
    try:
        handle.wait_ready()
        resource.prlimit(handle.process.pid, resource.RLIMIT_FSIZE, (20_000, hard))
        # Cycles come as fast as they are taken, so chunks must be closed by the clock: pace them.
        clock = MonotonicClock()
        while not handle.errors():
            feed(handle, [encode(make_cycle(number)) for number in range(50)])
            clock.sleep_until_ns(clock.now_ns() + 60_000_000)
        feed(handle, [encode(make_cycle(number)) for number in range(2000)])
    finally:
        outcome = handle.finish()
    assert resource.getrlimit(resource.RLIMIT_FSIZE) == (soft, hard)
    assert not outcome.complete
    assert handle.process.returncode == 3
    assert "File too large; the data written before are kept" in outcome.errors[0]
    assert path.stat().st_size <= 20_000
    assert verify(path).sound


def test_a_recorder_that_cannot_start_says_why(tmp_path: Path, make_cycle: MakeCycle) -> None:
    """An existing file is refused before any cycle; a control process that sends all the same is drained."""
    path = tmp_path / "episode.mcap"
    path.touch()
    handle = start_recorder(path, DESCRIPTION.to_json(), {})
    with pytest.raises(DatasetError, match=r"cannot start: .*exists"):
        handle.wait_ready()
    feed(handle, [encode(make_cycle(number)) for number in range(500)])
    assert not handle.finish().complete


def test_a_recorder_that_is_kept_waiting_gets_more_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own time is over at once; what it waits for a processor comes on top."""
    handle = start_recorder(tmp_path / "a.mcap", DESCRIPTION.to_json(), {})
    waited = itertools.count(0.0, 100.0)
    monkeypatch.setattr(load, "waited_s", lambda pid: next(waited))
    monkeypatch.setattr(load, "_MOST", 1e12)
    handle.wait_ready(own_s=1e-6)
    assert handle.finish(own_s=1e-6).complete


def test_a_recorder_that_does_not_start_in_its_time_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the load of the computer, what it means and what to do; and one that ended says so."""
    monkeypatch.setattr(load, "waited_s", lambda pid: 0.0)
    monkeypatch.setattr(load.Load, "now", classmethod(lambda cls: load.Load(15.2, 2)))
    handle = start_recorder(tmp_path / "a.mcap", DESCRIPTION.to_json(), {})
    with pytest.raises(
        DatasetError,
        match=r"the recorder process did not start in its time, 1e-06 s of its own .*load 15\.2 on 2 "
        r"processors: other programs keep this computer busy\. End them",
    ):
        handle.wait_ready(own_s=1e-6)
    handle.process.kill()
    with pytest.raises(DatasetError, match="ended before it had started"):
        handle.wait_ready()
    handle.finish()


def test_no_descriptor_leaks(tmp_path: Path) -> None:
    """Three recordings leave as many descriptors open as none."""
    before = len(os.listdir("/proc/self/fd"))
    for number in range(3):
        handle = start_recorder(tmp_path / f"{number}.mcap", DESCRIPTION.to_json(), {})
        handle.wait_ready()
        handle.finish()
    assert len(os.listdir("/proc/self/fd")) == before


def test_recorder_is_not_in_the_foreground_group(recorder: RecorderHandle) -> None:
    """A terminal's Ctrl-C goes to the foreground process group, which the recorder is not in."""
    assert os.getpgid(recorder.process.pid) != os.getpgid(0)
