"""Every state that the bridge's decisions can reach: none leaves the robot without a commander for long.

The bridge's memory (admission and knowledge of the robot's side) and the world around it are explored breadth
first, in steps of a quarter of a second. Times count relative to now, up to the longest that matters, so that
equal states merge and their number is finite.
"""

from __future__ import annotations

import copy
import dataclasses
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from fakes.go2 import FakeGo2

from deal_hw.drivers.go2.bridge import robot_side
from deal_hw.drivers.go2.bridge.admission import Admission, Control
from deal_hw.drivers.go2.bridge.config import DESCRIPTION, BridgeConfig
from deal_hw.drivers.go2.bridge.limits import CommandLimits
from deal_hw.drivers.go2.bridge.robot_side import ASK_NS, SILENCE_NS
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.zenoh_stamps import Echo, Stamp
from deal_hw.drivers.unitree.rpc import Request, encode_request
from deal_hw.transport import Message

pytestmark = pytest.mark.real_time

STEP_NS = 250_000_000
# The limit for silence is 0.4 s here, so that two steps are beyond it.
CONFIG = BridgeConfig(command_age_s=0.5, margin_s=0.1)
LIMITS = CommandLimits(DESCRIPTION, CONFIG.effort_margin)
SESSION = 1
ZERO, POSE = np.zeros(12), np.array(DESCRIPTION.default_position)
DAMPING = LowCommandEncoder().encode(LowCommand(ZERO, ZERO, ZERO, np.full(12, 5.0), ZERO))
STIFF = LowCommandEncoder().encode(LowCommand(POSE, ZERO, np.full(12, 30.0), np.ones(12), ZERO))
SELECT = encode_request(Request(1, 1002, '{"name": "normal"}'))
FRAME = decode_low_state(
    encode_low_state(dataclasses.replace(FakeGo2().state(), position=POSE, velocity=ZERO))
)

ANSWERED = "time passes"
UNANSWERED = "time passes, no answer"
EVENTS = (
    ANSWERED,
    "controller damps",
    "controller commands",
    "other controller damps",
    "foreign command",
    "mode active",
    "mode released",
    "handed back",
    "bad message",
    "states stop",
)


@dataclass(slots=True)
class World:
    """The bridge's memory, and what is true around it.

    Attributes:
        bridge: Admission, with its knowledge of the robot's side.
        now_ns: The bridge's clock [ns].
        mode: Whether a mode is active.
        foreign_ns: When another program last commanded the motors [ns].
        damped: Whether the robot's command in force is damping.
        states: Whether the robot's states, and with them its answers, arrive.
        alone_ns: How long the robot has had neither a live commander nor damping [ns].
        doubt: Whether the bridge missed an answer while it believed in a mode, or knew nothing.
    """

    bridge: Admission
    now_ns: int = 10**12
    mode: bool = False
    foreign_ns: int = 0
    damped: bool = False
    states: bool = True
    alone_ns: int = 0
    doubt: bool = False

    def copy(self) -> World:
        """Return a copy; settings are shared."""
        return copy.deepcopy(self, {id(CONFIG): CONFIG, id(LIMITS): LIMITS})

    def key(self) -> tuple[Any, ...]:
        """Return all that later events depend on, with times relative to now."""
        b, side, now = self.bridge, self.bridge.robot_side, self.now_ns

        def age(then_ns: int, most_ns: int) -> int:
            return min(now - then_ns, most_ns) // STEP_NS

        held = (b._stiff, age(b._last_ns, 10**9)) if b.control is Control.CONTROLLED else None
        longest_ns = robot_side.HAND_BACK_NS + STEP_NS
        known = (side.mode, side._fresh, side._patience_ns, age(side._quiet_ns, longest_ns))
        world = (self.mode, age(self.foreign_ns, SILENCE_NS), self.damped, self.states, self.doubt)
        idle = known if b.control is Control.IDLE else None
        return b.control, held, idle, age(side._asked_ns, ASK_NS), world, self.alone_ns // STEP_NS

    def after(self, event: str) -> World:
        """Return the world after an event."""
        world = self.copy()
        world._apply(event)
        return world

    def _apply(self, event: str) -> None:
        b = self.bridge
        if event in (ANSWERED, UNANSWERED):
            self._pass(answered=event == ANSWERED and self.states)
        elif event == "controller damps":
            self.damped |= b.command(self._message(DAMPING), self.now_ns, FRAME) is not None
        elif event == "controller commands":
            self.damped &= b.command(self._message(STIFF), self.now_ns, FRAME) is None
        elif event == "other controller damps":
            self.damped |= b.command(self._message(DAMPING, other=True), self.now_ns, FRAME) is not None
        elif event == "foreign command":
            b.yield_to_robot_side(self.now_ns)
            self.foreign_ns, self.damped, self.alone_ns = self.now_ns, False, 0
        elif event == "mode active":
            self.mode, self.damped, self.alone_ns = True, False, 0
        elif event == "mode released":
            self.mode = False
        elif event == "handed back":
            b.request(self._message(SELECT, channel=topics.request("motion_switcher")), self.now_ns)
        elif event == "bad message":
            assert b.command(self._message(b"rubbish"), self.now_ns, FRAME) is None
            assert b.command(self._message(STIFF, age_ns=10**9), self.now_ns, FRAME) is None
        elif event == "states stop":
            self.states = False

    def _message(
        self, payload: bytes, *, other: bool = False, channel: str = topics.LOW_COMMAND, age_ns: int = 10**6
    ) -> Message:
        """Return the next message of the stream that has the robot, or of another one."""
        holder = self.bridge._holder or 1
        stream = 3 - holder if other else holder
        number = self.bridge._newest.get((stream, channel), 0) + 1
        # Without new states, a sender's newest one is too old.
        stamp_ns = self.now_ns - (age_ns if self.states else 10**10)
        return Message(channel, payload, self.now_ns, Echo(stream, number, Stamp(SESSION, stamp_ns)).encode())

    def _pass(self, *, answered: bool) -> None:
        """Let a step of time pass, as the bridge's loop does."""
        self.now_ns += STEP_NS
        b, side = self.bridge, self.bridge.robot_side
        if b.control is Control.IDLE and side.to_ask(self.now_ns):
            if answered:
                side.answered("normal" if self.mode else "")
            self.doubt = not answered and side.mode != ""
        damps = b.tick(self.now_ns)
        live = (
            b.control is Control.CONTROLLED
            or self.mode
            or self.now_ns - self.foreign_ns < SILENCE_NS
            or damps
        )
        self.damped |= damps and not self.mode
        self.alone_ns = 0 if live or self.damped or self.doubt else self.alone_ns + STEP_NS


def reachable(starts: Iterable[World], events: Iterable[str]) -> dict[tuple[Any, ...], World]:
    """Return one world for each state that events can reach."""
    events = tuple(events)
    found = {world.key(): world for world in starts}
    left = deque(found.values())
    while left:
        world = left.popleft()
        for event in events:
            if (key := (new := world.after(event)).key()) not in found:
                found[key] = new
                # A robot that is alone for ever need not be followed for ever.
                if new.alone_ns < 20 * STEP_NS:
                    left.append(new)
    return found


def starts() -> list[World]:
    """Return the bridge after its start: no answer yet, a mode, another program, nobody."""
    worlds = [World(Admission(CONFIG, LIMITS, SESSION)) for _ in range(4)]
    unknown, mode, program, nobody = worlds
    unknown.doubt = True
    mode.mode = True
    mode.bridge.robot_side.left(mode.now_ns, mode="normal")
    program.bridge.robot_side.left(program.now_ns, mode="")
    program.bridge.yield_to_robot_side(program.now_ns)
    program.foreign_ns = program.now_ns
    nobody.bridge.robot_side.left(nobody.now_ns, mode="")
    nobody.bridge.take_charge("started")
    nobody.damped = True
    return worlds


@pytest.fixture(autouse=True)
def short_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program has 1 s and a mode 1.5 s to take the robot: the same decisions in fewer states."""
    monkeypatch.setattr(robot_side, "TAKE_OVER_NS", 4 * STEP_NS)
    monkeypatch.setattr(robot_side, "HAND_BACK_NS", 6 * STEP_NS)


def longest(found: Iterable[World], patience_ns: int) -> int:
    """Return the longest time alone in any state in which the bridge waits so long for a commander [ns]."""
    return max(w.alone_ns for w in found if w.bridge.robot_side._patience_ns == patience_ns)


def test_no_state_leaves_the_robot_alone_while_the_switcher_answers() -> None:
    """At most the time between two questions, and the step in which the silence ends."""
    found = reachable(starts(), (event for event in EVENTS if event != "states stop"))
    assert {world.bridge.control for world in found.values()} == set(Control)
    assert longest(found.values(), SILENCE_NS) <= ASK_NS + STEP_NS
    assert ASK_NS < longest(found.values(), robot_side.TAKE_OVER_NS) <= robot_side.TAKE_OVER_NS + STEP_NS
    assert longest(found.values(), robot_side.HAND_BACK_NS) <= robot_side.HAND_BACK_NS


def test_no_state_leaves_the_robot_alone_when_answers_are_lost() -> None:
    """Any of them, and for good when states stop: what was known before counts after two seconds more."""
    found = reachable(starts(), (*EVENTS, UNANSWERED))
    lost_ns = robot_side.ANSWER_NS
    assert ASK_NS < longest(found.values(), SILENCE_NS) <= lost_ns + STEP_NS
    assert longest(found.values(), robot_side.TAKE_OVER_NS) <= robot_side.TAKE_OVER_NS + lost_ns + STEP_NS
    assert longest(found.values(), robot_side.HAND_BACK_NS) <= robot_side.HAND_BACK_NS + lost_ns


def test_the_exploration_finds_a_bridge_that_lets_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that never takes charge again, as before: the robot is alone for as long as it is followed."""
    monkeypatch.setattr(robot_side.RobotSide, "deserted", lambda self, now_ns: "")
    found = reachable(starts(), (ANSWERED, "controller damps", "foreign command"))
    assert longest(found.values(), SILENCE_NS) == 20 * STEP_NS
