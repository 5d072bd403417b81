"""Channels out of the control process: nothing waits, refusals are counted, a dead peer is reported."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from deal_hw.control.process import realtime
from deal_hw.control.process.channel import Beat, RecordSender, StatusReceiver, StatusSender, socket_pair
from deal_hw.control.process.realtime import become_realtime, die_with_parent, raise_priority
from deal_hw.data.recording.record import CycleRecord, decode
from deal_hw.errors import DatasetError
from deal_hw.priorities import FIFO_PRIORITY
from deal_hw.transport import Message

pytestmark = pytest.mark.real_time

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A channel with the smallest buffer that the kernel gives."""
    sender, receiver = socket_pair(buffer_bytes=1)
    with sender, receiver:
        yield sender, receiver


def record(cycle: int, size: int = 0) -> CycleRecord:
    """Return a record with a wire message of some size."""
    return CycleRecord(cycle=cycle, deadline_ns=1, start_ns=2, wire=(Message("rx", bytes(size), 3),))


def test_records_arrive_whole_and_in_order(pair: Pair) -> None:
    """One datagram each."""
    send = RecordSender(pair[0])
    assert send(record(0, 100)) and send(record(1, 7))
    received = [decode(pair[1].recv(1 << 18)) for _ in range(2)]
    assert [(r.cycle, len(r.wire[0].payload)) for r in received] == [(0, 100), (1, 7)]


def test_a_full_queue_refuses_and_does_not_wait(pair: Pair) -> None:
    """The sender goes on; when the recorder takes something again, so does the sender."""
    send = RecordSender(pair[0])
    taken = 0
    while send(record(taken, 500)):
        taken += 1
    assert taken >= 1
    assert not send(record(taken, 500))
    for _ in range(taken):
        pair[1].recv(1 << 18)
    assert send(record(taken, 500))


def test_a_record_too_long_for_a_datagram_is_refused_not_raised(pair: Pair) -> None:
    """The loop must not die of it."""
    assert RecordSender(pair[0])(record(0, 200_000)) is False


def test_fifty_refusals_in_a_row_end_the_run(pair: Pair) -> None:
    """49 are counted; the 50th says that nobody records; one success in between starts the count anew."""
    send = RecordSender(pair[0])
    too_long = record(0, 200_000)
    for _ in range(49):
        assert not send(too_long)
    assert send(record(1))
    for _ in range(49):
        assert not send(too_long)
    with pytest.raises(DatasetError, match="refused the last 50 cycles"):
        send(too_long)


def test_a_recorder_that_is_gone_is_an_error(pair: Pair) -> None:
    """A closed socket never takes anything again."""
    pair[1].close()
    with pytest.raises(DatasetError, match="the recorder has ended"):
        RecordSender(pair[0])(record(0))


def test_heartbeats_count_within_a_phase() -> None:
    """The count starts anew with each phase; the deadline is the stamp plus the silence."""
    ends = socket_pair()
    sender, receiver = StatusSender(ends[0]), StatusReceiver(ends[1])
    for stamp, phase in ((5, "homing"), (6, "running"), (7, "running")):
        sender.beat(stamp, phase, 0.3)
    sender.result({"outcome": "finished"})
    beats = [receiver.receive() for _ in range(3)]
    assert beats == [Beat(5, 0.3, "homing", 0), Beat(6, 0.3, "running", 0), Beat(7, 0.3, "running", 1)]
    assert Beat(5, 0.3, "homing", 0).stale_ns == 300_000_005
    assert receiver.receive() == {"outcome": "finished"}
    assert receiver.receive() is None
    assert receiver.open
    ends[0].close()
    assert receiver.receive() is None
    assert not receiver.open
    receiver.close()


def test_without_a_supervisor_the_status_goes_nowhere(pair: Pair) -> None:
    """A control process whose supervisor died still has to make its robot passive."""
    sender = StatusSender(pair[0])
    pair[1].close()
    sender.beat(1, "running", 0.3)
    sender.result({"outcome": "stopped"})


def test_what_the_system_refuses_is_a_warning_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the right to SCHED_FIFO and locked memory the loop still runs."""

    def refuse(*args: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr("deal_hw.control.process.realtime._lock_memory", lambda: "Cannot allocate memory")
    granted = become_realtime()
    assert granted.scheduling == "default"
    assert "SCHED_FIFO was refused (Operation not permitted)" in granted.warnings[0]
    assert "rtprio" in granted.warnings[0]
    assert "memlock" in granted.warnings[1]


def test_a_process_whose_parent_is_gone_does_not_start() -> None:
    """It would never get the signal; a number that no parent has stands for a dead one."""
    pid = os.fork()
    if pid == 0:
        try:
            die_with_parent(0)
        except ProcessLookupError:
            os._exit(7)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7


def test_every_thread_of_a_killed_process_is_hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is gone only once each thread has run once more; what is refused, or gone already, is no error."""
    program = """if 1:
        import threading
        for _ in range(3):
            threading.Thread(target=threading.Event().wait, daemon=True).start()
        print("ready", flush=True)
        input()
    """
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        threads = {int(name) for name in os.listdir(f"/proc/{process.pid}/task")}
        lifted: set[int] = set()

        def lift(thread: int, policy: int, parameters: os.sched_param) -> None:
            assert (policy, parameters.sched_priority) == (os.SCHED_FIFO, FIFO_PRIORITY)
            lifted.add(thread)
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(os, "sched_setscheduler", lift)
        raise_priority(process.pid)
        assert lifted == threads
        assert len(threads) == 4
        process.kill()
    assert not Path(f"/proc/{process.pid}").exists()
    raise_priority(process.pid)


def test_what_is_ending_is_hurried_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed process that nobody has waited for yet; one that lives is left alone."""
    hurried: list[int] = []
    monkeypatch.setattr(realtime, "raise_priority", hurried.append)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        realtime.hurry_the_dying()
        assert not {process.pid, os.getpid()} & {*hurried}
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        realtime.hurry_the_dying()
        assert process.pid in hurried and os.getpid() not in hurried
