"""Keeps this computer awake while a run commands a robot that holds its last command, and hears of a sleep.

A computer that sleeps leaves such a robot stiff as long as it sleeps: no process of the run acts.
systemd-logind gives out two kinds of lock (https://systemd.io/INHIBITOR_LOCKS). A run asks for both:

- *block*, on sleep and on the lid switch: sleep is refused as long as the lock is held. For the lid, "sleep"
  is not enough: logind ignores it by default (LidSwitchIgnoreInhibited), but not "handle-lid-switch", which
  knows this mode only. logind grants it to a session at the computer, seldom to one over ssh. A privileged
  user may override it.
- *delay*, on sleep: sleep waits until the lock is released, 5 s by default, and a signal says that it comes.
  logind grants it to everybody. The run then makes the robot passive first.

A lock is a file descriptor, released when it is closed, also by the end of the process.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final

from deal_hw.workflows.say import Say

ANSWER_S: Final = 1.0
"""Longest wait for logind before a run starts [s]; it answers within milliseconds."""
BLOCK: Final = ("sleep:handle-lid-switch", "block")
DELAY: Final = ("sleep", "delay")
ASLEEP: Final = "this computer is about to sleep"
"""Reason of a run that ends for this."""
_WHY: Final = "a robot would stay stiff"
_UNTIL: Final = "Switch automatic sleep off, and leave the lid open"


class SleepLock:
    """The locks on sleep, taken and watched in a thread of its own, since a bus may hang.

    Attributes:
        refused: Why a kind of lock was not granted, by mode.
        held: The modes that were granted.

    Args:
        before_sleep: Called in the thread when the computer is about to sleep. The computer sleeps once the
            run has ended, or after logind's time.
        answer_s: Longest wait for logind [s].
    """

    def __init__(self, before_sleep: Callable[[], None], answer_s: float = ANSWER_S) -> None:
        self._before_sleep, self._answer_s = before_sleep, answer_s
        self._answer: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._locks: list[Any] = []
        self._connection: Any = None
        self._over = threading.Event()
        self.held: tuple[str, ...] = ()
        self.refused: dict[str, str] = {}

    def take(self) -> str:
        """Ask for the locks, at most for ``answer_s``; return why there is no logind, or ""."""
        threading.Thread(target=self._serve, name="sleep lock", daemon=True).start()
        try:
            return self._answer.get(timeout=self._answer_s)
        except queue.Empty:
            return f"no answer within {self._answer_s:g} s"

    def release(self) -> None:
        """Release the locks."""
        self._over.set()
        connection = self._connection
        if connection is not None:
            # Wakes up the thread, which closes everything.
            with contextlib.suppress(OSError):
                connection.sock.shutdown(socket.SHUT_RDWR)

    def _serve(self) -> None:
        try:
            self._ask()
        except Exception as error:
            self._answer.put(str(error) or type(error).__name__)
            return
        finally:
            if self._over.is_set():
                self._close()
        self._answer.put("")
        try:
            while not self._over.is_set():
                message = self._connection.receive()
                if message.header.fields.get(_MEMBER) == "PrepareForSleep" and message.body[0]:
                    self._before_sleep()
        except Exception:
            # The bus is gone, or the run is over.
            return
        finally:
            self._close()

    def _ask(self) -> None:
        # Imported here: a run that needs no lock does not load it.
        from jeepney import DBusAddress, MatchRule, message_bus, new_method_call
        from jeepney.io.blocking import open_dbus_connection
        from jeepney.wrappers import DBusErrorResponse, unwrap_msg

        manager = DBusAddress(
            "/org/freedesktop/login1", "org.freedesktop.login1", "org.freedesktop.login1.Manager"
        )
        self._connection = connection = open_dbus_connection(
            "SYSTEM", enable_fds=True, auth_timeout=2 * self._answer_s
        )
        coming = MatchRule(
            type="signal", interface=manager.interface, member="PrepareForSleep", path=manager.object_path
        )
        unwrap_msg(connection.send_and_get_reply(message_bus.AddMatch(coming), timeout=self._answer_s))
        for what, mode in (BLOCK, DELAY):
            asked = new_method_call(manager, "Inhibit", "ssss", (what, "deal-hw", _WHY, mode))
            try:
                (lock,) = unwrap_msg(connection.send_and_get_reply(asked, timeout=self._answer_s))
            except DBusErrorResponse as error:
                self.refused[mode] = str(error.data[0]) if error.data else error.name
            else:
                self._locks.append(lock)
                self.held += (mode,)

    def _close(self) -> None:
        for lock in self._locks:
            lock.close()
        self._locks.clear()
        if self._connection is not None:
            self._connection.close()


_MEMBER: Final = 3
"""The header field of a message's name, as the D-Bus specification numbers it."""


@contextlib.contextmanager
def awake(before_sleep: Callable[[], None], say: Say, answer_s: float = ANSWER_S) -> Iterator[None]:
    """Keep this computer awake inside the block, or say that it cannot be kept awake.

    Args:
        before_sleep: Called from another thread when the computer is about to sleep all the same.
        say: Called with one line if sleep is not blocked.
        answer_s: Longest wait for logind [s].
    """
    lock = SleepLock(before_sleep, answer_s)
    missing = lock.take()
    if "block" not in lock.held:
        why = missing or lock.refused.get("block", "no lock")
        then = (
            "a run then makes the robot passive first"
            if "delay" in lock.held
            else "the robot then holds its last command as long as it sleeps"
        )
        say(f"note: nothing keeps this computer from sleeping (logind: {why}); {then}. {_UNTIL}")
    try:
        yield
    finally:
        lock.release()
