"""The recorder process: receives one datagram per control cycle and writes the episode until the peer closes.

``recorder_launch`` starts it as ``python -m deal_hw.data.recording.recorder_process``. Even after an error
the socket is read to its end, because the recorder must never slow the control loop.

It reports on ``--status-fd``, one JSON object on each line with a key ``kind``: "ready", "error" (with
``message``), and "finished" (with ``complete``, ``cycles``, ``states``, ``unreadable``). Exit codes: 0 if
everything was written, 3 if the recording is incomplete.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import socket
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from deal_hw import signals
from deal_hw.clock import Clock, MonotonicClock
from deal_hw.data.recording.record import MAX_DATAGRAM_BYTES, decode
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.errors import DealHwError, ProtocolError

EXIT_OK, EXIT_INCOMPLETE = 0, 3
TERM_GRACE_S = 2.0
"""How long the peer may still send after a signal [s]: the supervisor gets a message, so the run ends, and
its last records follow."""


class RecorderProcess:
    """The loop between the socket and the file.

    Args:
        peer: The recorder's end of the socket pair (SOCK_SEQPACKET).
        recorder: Not yet opened.
        report: Called with each report.
        clock: The host's monotonic clock.
    """

    def __init__(self, peer: socket.socket, recorder: EpisodeRecorder, report: Report, clock: Clock) -> None:
        self._peer = peer
        self._recorder: EpisodeRecorder | None = recorder
        self._totals = recorder
        self._report = report
        self._clock = clock
        self._stop_at_ns: int | None = None
        self.unreadable = 0

    def terminate(self, number: int) -> None:
        """Take a signal: report it, which ends the run, and finish soon even if the peer does not close."""
        if self._stop_at_ns is None:
            self._stop_at_ns = self._clock.now_ns() + round(TERM_GRACE_S * 1e9)
            self._report({"kind": "error", "message": f"it was ended by {signals.name(number)}"})

    def run(self) -> int:
        """Write until the peer closes; return the exit code."""
        incomplete = not self._attempt("open")
        self._report({"kind": "ready", "path": str(self._totals.path)})
        while self._receive():
            pass
        self._attempt("close")
        incomplete = incomplete or self._recorder is None or self.unreadable > 0
        counts = {"cycles": self._totals.cycles, "states": self._totals.states, "unreadable": self.unreadable}
        self._report({"kind": "finished", "complete": not incomplete, **counts})
        return EXIT_INCOMPLETE if incomplete else EXIT_OK

    def _receive(self) -> bool:
        """Take the waiting records, or wait until the next chunk is due; return False at the end."""
        wait_s = self._recorder.due_in_s() if self._recorder is not None else None
        if self._stop_at_ns is not None:
            left_s = (self._stop_at_ns - self._clock.now_ns()) * 1e-9
            if left_s <= 0:
                return False
            wait_s = left_s if wait_s is None else min(wait_s, left_s)
        # Python resumes select after a signal handler, so an endless wait would never see the signal.
        ready, _, _ = select.select([self._peer], [], [], 0.5 if wait_s is None else wait_s)
        if ready:
            try:
                datagram = self._peer.recv(MAX_DATAGRAM_BYTES)
            except ConnectionResetError:
                return False
            if not datagram:
                return False
            self._take(datagram)
        else:
            self._attempt("flush_if_due")
        return True

    def _take(self, datagram: bytes) -> None:
        if self._recorder is None:
            return
        try:
            record = decode(datagram)
        except ProtocolError as error:
            self.unreadable += 1
            if self.unreadable == 1:
                self._report(
                    {"kind": "error", "message": f"a record from the control process was refused: {error}"}
                )
            return
        self._attempt("write", record)

    def _attempt(self, method: str, *arguments: Any) -> bool:
        """Call the recorder; after its first error it is not called again: further records are dropped."""
        if self._recorder is None:
            return False
        try:
            getattr(self._recorder, method)(*arguments)
        except (DealHwError, OSError) as error:
            self._recorder = None
            self._report({"kind": "error", "message": str(error)})
            return False
        return True


class Report:
    """Writes reports to the status pipe and errors to stderr; never blocks, never fails.

    Args:
        descriptor: Write end of the status pipe; -1 for none.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        if descriptor >= 0:
            os.set_blocking(descriptor, False)

    def __call__(self, values: Mapping[str, Any]) -> None:
        """Send one report."""
        if values["kind"] == "error":
            _write_quietly(2, f"recorder: {values['message']}\n".encode())
        if self._descriptor >= 0:
            _write_quietly(self._descriptor, json.dumps(values).encode() + b"\n")


def _write_quietly(descriptor: int, data: bytes) -> None:
    try:
        os.write(descriptor, data)
    except OSError:
        pass  # Nobody reads the reports any more. The episode is more important.


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the recorder process; return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m deal_hw.data.recording.recorder_process", description=__doc__
    )
    parser.add_argument("--fd", type=int, required=True, help="the recorder's end of the socket pair")
    parser.add_argument("--path", type=Path, required=True, help="the file to create")
    parser.add_argument(
        "--config-fd", type=int, required=True, help="a file with JSON: description, metadata"
    )
    parser.add_argument("--status-fd", type=int, default=-1, help="write end of a pipe for reports")
    options = parser.parse_args(arguments)
    clock = MonotonicClock()
    with open(options.config_fd, encoding="utf-8") as file:
        config = json.load(file)
    recorder = EpisodeRecorder(options.path, config["description"], config["metadata"], clock)
    with socket.socket(fileno=options.fd) as peer:
        process = RecorderProcess(peer, recorder, Report(options.status_fd), clock)
        signals.take(process.terminate)
        return process.run()


if __name__ == "__main__":
    sys.exit(main())
