"""An exclusive claim on a robot, sent as messages: a second program that wants to command is refused at once.

Claims use a topic of deal-hw, which robot and sport mode ignore. A claim has these states:

    asking --nobody answered for LISTEN_S--> held --every REFRESH_S--> held ... --> released
       └──── somebody holds it, or asks with a smaller number: refused

The holder answers each request at once and repeats its claim. A claim that is silent for LISTEN_S has
expired. Programs without claims are detected by their commands ( :mod:`takeover`).
"""

from __future__ import annotations

import contextlib
import threading
import uuid
from collections.abc import Callable
from typing import ClassVar, Final

from deal_hw.clock import Clock
from deal_hw.drivers.transports.topics import CLAIM
from deal_hw.drivers.unitree.rpc import CLAIM_TEXTS, encode_note, read_note
from deal_hw.errors import PortBusyError, TransportError, TransportTimeoutError
from deal_hw.transport import Message, TopicTransport

LISTEN_S: Final = 0.8
"""Time without an answer after which the claim is held, and after which a silent claim has expired [s].
Discovery over DDS takes up to about 0.3 s of it."""
REFRESH_S: Final = 0.2
_ASK_S: Final = 0.1
_JOIN_S: Final = 2.0
ASKING, HELD, RELEASED = "asking", "held", "released"


class WireClaim:
    """Claims the robot on its own transport; a thread keeps the claim alive.

    Args:
        transport: Topics of the robot; not open, and not shared.
        clock: For the waiting.
        holder: Description of the claimant for other programs.
        identity: Number of the claim; of two simultaneous requests the smaller one wins. Random by default.

    Attributes:
        robot: Its name, as messages begin.
        listen_s: How long :meth:`acquire` listens for other claims [s].
    """

    robot: ClassVar[str] = "go2"
    listen_s: ClassVar[float] = LISTEN_S

    def __init__(
        self, transport: TopicTransport, clock: Clock, holder: str, identity: str | None = None
    ) -> None:
        self._transport, self._clock, self._holder = transport, clock, holder
        self._identity = identity or uuid.uuid4().hex
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    def acquire(self) -> None:
        """Open the transport, request the claim, and hold it from now on.

        Raises:
            PortBusyError: Another program holds it, or requested it first.
            TransportError: The transport cannot be opened.
        """
        self._transport.declare(publish=[CLAIM], subscribe=[CLAIM])
        self._transport.open()
        try:
            self._ask()
        except BaseException:
            self._transport.close()
            raise
        self._say(HELD)
        self._thread = threading.Thread(target=self._keep, name="claim", daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Release the claim and close the transport; idempotent."""
        self._end.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_JOIN_S)
            with contextlib.suppress(TransportError):
                self._say(RELEASED)
        self._transport.close()

    def _ask(self) -> None:
        end_ns = self._clock.now_ns() + round(LISTEN_S * 1e9)
        next_ns = self._clock.now_ns()
        while (now_ns := self._clock.now_ns()) < end_ns:
            if now_ns >= next_ns:
                self._say(ASKING)
                next_ns += round(_ASK_S * 1e9)
            self._listen((min(next_ns, end_ns) - now_ns) * 1e-9, self._yield_to)

    def _yield_to(self, claim: dict[str, str]) -> None:
        if claim["state"] == HELD or (claim["state"] == ASKING and claim["id"] < self._identity):
            raise PortBusyError(
                f"{self.robot}: the robot is in use: {claim['who']} commands it, or is about to. Two "
                "programs that command one robot make it jump. End the other run first "
                "(Ctrl-C in its terminal)"
            )

    def _keep(self) -> None:
        next_ns = self._clock.now_ns()
        while not self._end.is_set():
            now_ns = self._clock.now_ns()
            try:
                if now_ns >= next_ns:
                    self._say(HELD)
                    next_ns = now_ns + round(REFRESH_S * 1e9)
                self._listen(max(next_ns - now_ns, 0) * 1e-9, self._answer)
            except TransportError:
                # The connection is lost, which the control process handles. The claim continues when it is
                # back.
                self._end.wait(REFRESH_S)
                with contextlib.suppress(TransportError):
                    self._transport.reopen()

    def _answer(self, claim: dict[str, str]) -> None:
        if claim["state"] == ASKING:
            self._say(HELD)

    def _listen(self, timeout_s: float, handle: Callable[[dict[str, str]], None]) -> None:
        """Pass another claim's message to ``handle``; return after one message or the time [s]."""
        try:
            message = self._transport.receive(timeout_s)
        except TransportTimeoutError:
            return
        claim = read_note(message.payload, CLAIM_TEXTS) if message.channel == CLAIM else None
        if claim is not None and claim["id"] != self._identity:
            handle(claim)

    def _say(self, state: str) -> None:
        payload = encode_note({"id": self._identity, "who": self._holder, "state": state})
        with contextlib.suppress(TransportTimeoutError):
            self._transport.send(Message(CLAIM, payload, self._clock.now_ns()))
