"""The operator's keys during a run, since the control process has no terminal."""

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
from deal_hw.motions.velocity import END_KEY
from deal_hw.workflows.say import Say, to_stderr

STOP_KEY = "\x1b"
"""Escape makes the robot passive at once."""
HELP = (
    "keys: w s ahead, back; a d left, right; q e turn; space stand still; "
    f"{END_KEY} stop and lie down; Esc passive at once"
)


def check_terminal() -> None:
    """Check that a terminal is there to read keys from.

    Raises:
        ConfigurationError: Standard input is no terminal.
    """
    if not sys.stdin.isatty():
        raise ConfigurationError(
            "--velocity keyboard needs a terminal as standard input; use remote, x,y,yaw or a script"
        )


@contextlib.contextmanager
def keys(pressed: Callable[[str], None], stop: Callable[[], None], say: Say = to_stderr) -> Iterator[None]:
    """Call ``pressed`` for each key, and ``stop`` for the one that makes the robot passive, from a thread.

    ``stop`` is called once: a held key repeats, and a second stop would kill the control process. It is also
    called when the terminal goes away, since then nobody could stop the robot.

    Raises:
        ConfigurationError: Standard input is no terminal.
    """
    check_terminal()
    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    end_read, end_write = os.pipe()

    def read() -> None:
        stopped = False
        while True:
            ready, _, _ = select.select([fd, end_read], [], [])
            if end_read in ready:
                return
            text = _read(fd)
            for key in text or STOP_KEY:
                if key != STOP_KEY:
                    pressed(key)
                elif not stopped:
                    stopped = True
                    stop()
            if not text:
                return

    thread = threading.Thread(target=read, name="keys", daemon=True)
    tty.setcbreak(fd)
    thread.start()
    say(HELP)
    try:
        yield
    finally:
        os.write(end_write, b"x")
        thread.join()
        os.close(end_read)
        os.close(end_write)
        with contextlib.suppress(termios.error):
            termios.tcsetattr(fd, termios.TCSADRAIN, before)


def _read(fd: int) -> str:
    """Return the pressed keys; "" if the terminal is gone."""
    try:
        data = os.read(fd, 64)
    except OSError:
        return ""
    # A byte that is no text is a key without meaning.
    return data.decode("utf-8", "replace")
