"""Words from the operator's terminal to the control process, and a supervisor without a port to hand on."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

from deal_hw.control.process.channel import HEARTBEAT, Beat, StatusReceiver, StatusSender, socket_pair
from deal_hw.control.process.supervisor import ChildEnd, Supervisor

pytestmark = pytest.mark.real_time

CHILD = """
import json, os, signal, socket, sys

signal.alarm(20)  # Whoever says nothing to this process waits no longer.
from deal_hw.clock import MonotonicClock
from deal_hw.control.process.channel import StatusSender

orders = json.load(sys.stdin)
status = StatusSender(socket.socket(fileno=orders["status_fd"]))
beat = lambda phase: status.beat(MonotonicClock().now_ns(), phase, 20.0)
beat("listening")
received = []
while "end" not in received:
    received += status.received()
    beat("listening")
opened = sorted(int(name) for name in os.listdir("/proc/self/fd"))
status.result({"got": received, "port_fd": orders["port_fd"], "opened": opened, "passive_confirmed": True})
"""


def test_words_arrive_in_order_between_heartbeats() -> None:
    """Both directions share one channel; nothing waits where nothing was sent."""
    ends = socket_pair()
    sender, receiver = StatusSender(ends[0]), StatusReceiver(ends[1])
    assert sender.received() == []
    for word in ("w", " ", "é"):
        receiver.tell(word)
    sender.beat(1, "running", 0.3)
    assert sender.received() == ["w", " ", "é"]
    assert sender.received() == []
    assert receiver.receive() == Beat(1, 0.3, "running", 0)
    receiver.close()
    ends[0].close()


def test_long_words_are_cut_and_odd_bytes_are_survived() -> None:
    """256 bytes at most; half a letter at the cut is one letter without a meaning."""
    ends = socket_pair()
    sender, receiver = StatusSender(ends[0]), StatusReceiver(ends[1])
    receiver.tell("x" * 255 + "é")
    assert sender.received() == ["x" * 255 + "�"]
    receiver.close()
    ends[0].close()


def test_words_to_nobody_are_lost_without_a_sound() -> None:
    """A queue that is full, a control process that is gone, a channel that is closed."""
    ends = socket_pair(buffer_bytes=1)
    sender, receiver = StatusSender(ends[0]), StatusReceiver(ends[1])
    for _ in range(5000):
        receiver.tell("w")
    assert 0 < len(sender.received()) <= 5000
    ends[0].close()
    receiver.tell("w")
    receiver.close()
    receiver.tell("w")


def test_a_dead_supervisor_says_nothing() -> None:
    """The control process reads on, and hears nothing more."""
    ends = socket_pair()
    sender, receiver = StatusSender(ends[0]), StatusReceiver(ends[1])
    receiver.tell("w")
    receiver.close()
    assert sender.received() == ["w"]
    assert sender.received() == []
    ends[0].close()


class Run:
    """A supervisor over a control process that only listens."""

    def __init__(self, port_fd: int | None) -> None:
        self.passive_calls = 0
        self._told = False
        self.supervisor = Supervisor(
            module="deal_hw_listening_child",
            plan={"robot": "none"},
            port_fd=port_fd,
            passive=self._passive,
            on_beat=self._on_beat,
        )

    def _passive(self, phase: str, already_tried: bool) -> bool:
        self.passive_calls += 1
        return True

    def _on_beat(self, beat: Beat) -> None:
        if not self._told:
            self._told = True
            # As the thread that reads the keys does.
            thread = threading.Thread(target=self._speak)
            thread.start()
            thread.join()

    def _speak(self) -> None:
        for word in ("w", "a", "end"):
            self.supervisor.tell(word)

    def result(self) -> tuple[ChildEnd, dict[str, Any]]:
        """Run to the end; return how it ended and what the process printed."""
        end = self.supervisor.run()
        assert end.result is not None
        return end, end.result


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The control process is one that listens until it hears "end"."""
    (tmp_path / "deal_hw_listening_child.py").write_text(CHILD)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


def test_the_supervisor_passes_words_on_without_a_port(child: None) -> None:
    """Each process opens its own path: no descriptor is inherited beside the channel, and none is named."""
    run = Run(None)
    run.supervisor.tell("too early, and lost")
    end, result = run.result()
    assert (end.exit_code, end.killed, end.stop_cause) == (0, "", "")
    assert [word for word in result["got"] if word != HEARTBEAT] == ["w", "a", "end"]
    assert HEARTBEAT in result["got"]
    assert result["port_fd"] is None
    # Standard input, output and error, the channel, and the folder that is being listed.
    assert len(result["opened"]) == 5
    assert (end.passive_confirmed, run.passive_calls) == (True, 0)
    run.supervisor.tell("too late, and lost")


def test_an_open_port_is_handed_on(child: None, tmp_path: Path) -> None:
    """The same descriptor, open in the control process."""
    with (tmp_path / "port").open("w") as port:
        _, result = Run(port.fileno()).result()
        assert result["port_fd"] == port.fileno()
        assert port.fileno() in result["opened"]
