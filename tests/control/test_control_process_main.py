"""The control process's last words, without a robot."""

from __future__ import annotations

import io
import json
import os
import socket
import types
from typing import Any

import pytest

from deal_hw.workflows.running import control_process

pytestmark = pytest.mark.real_time


class Status:
    """Keeps what the supervisor would get."""

    reported: list[dict[str, Any]]

    def __init__(self, channel: socket.socket) -> None:
        channel.close()
        Status.reported = []

    def beat(self, stamp_ns: int, phase: str, silence_s: float) -> None:
        """Ignore a heartbeat."""

    def result(self, values: dict[str, Any]) -> None:
        """Keep the result."""
        self.reported.append(values)


@pytest.mark.parametrize("with_loop", [False, True])
def test_only_a_process_without_a_loop_knows_that_the_robot_is_passive(
    with_loop: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a bug in the loop the supervisor must make the robot passive, so nothing is claimed."""
    mine, theirs = socket.socketpair()
    orders = {"status_fd": theirs.detach(), "parent_pid": os.getppid()}
    monkeypatch.setattr("sys.stdin", io.StringIO(json.dumps(orders)))
    monkeypatch.setattr(control_process, "StatusSender", Status)
    monkeypatch.setattr(control_process, "die_with_parent", lambda pid: None)
    monkeypatch.setattr(control_process, "_Stopper", lambda pid: types.SimpleNamespace(loop=None))

    def broken(orders: Any, status: Any, clock: Any, stopper: Any) -> Any:
        stopper.loop = object() if with_loop else None
        raise RuntimeError("a bug")

    monkeypatch.setattr(control_process, "_run", broken)
    with mine:
        assert control_process.main() == 0
    (result,) = Status.reported
    assert (result["outcome"], result["reason"]) == ("failed", "a bug")
    assert result["passive_confirmed"] is not with_loop
