"""The operator's keys, while the control process, which owns no terminal, runs."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator

from deal_hw.errors import ConfigurationError

STOP_KEYS = ("\x1b", "p")
"""Escape and p make the robot passive."""
HELP = "keys: w s ahead, back; a d left, right; q e turn; space stand still; p or Esc passive"


@contextlib.contextmanager
def keys(pressed: Callable[[str], None], stop: Callable[[], None]) -> Iterator[None]:
    """Call ``pressed`` for each key, and ``stop`` for those that make the robot passive, from a thread.

    Raises:
        ConfigurationError: Standard input is no terminal.
    """
    if not sys.stdin.isatty():
        raise ConfigurationError(
            "--velocity keyboard needs a terminal as standard input; use remote, x,y,yaw or a script"
        )
    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    end_read, end_write = os.pipe()

    def read() -> None:
        while True:
            ready, _, _ = select.select([fd, end_read], [], [])
            if end_read in ready:
                return
            text = os.read(fd, 64).decode("utf-8", "ignore")
            if not text:
                return
            for key in text:
                if key in STOP_KEYS:
                    stop()
                else:
                    pressed(key)

    thread = threading.Thread(target=read, name="keys", daemon=True)
    tty.setcbreak(fd)
    thread.start()
    print(HELP, file=sys.stderr)
    try:
        yield
    finally:
        os.write(end_write, b"x")
        thread.join()
        os.close(end_read)
        os.close(end_write)
        termios.tcsetattr(fd, termios.TCSADRAIN, before)
