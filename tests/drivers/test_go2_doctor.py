"""What `deal-hw doctor` tells of a Go2, on an emulated robot in virtual time."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from fakes.unitree_mujoco import UnitreeMujoco

from deal_hw.clock import VirtualClock
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.doctor import Go2Doctor
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.faults import FaultPlan
from deal_hw.drivers.go2.emulator.truth import nominal_truth
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.go2.messages.refusals import StateCheck
from deal_hw.drivers.go2.messages.simulated import Simulator
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.unitree.rpc import decode_response, encode_response
from deal_hw.errors import TransportError
from deal_hw.findings import Finding, Severity

Tamper = Callable[[str, bytes], Iterable[bytes]]


class Air:
    """A Go2 and what others do to its messages: tampering, and messages of their own by device time [ms]."""

    def __init__(self, device: Go2Device, tamper: Tamper, printed: dict[int, tuple[str, bytes]]) -> None:
        self.device, self._tamper, self._said = device, tamper, printed

    @property
    def device_ns(self) -> int:
        return self.device.device_ns

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        self.device.receive(topic, payload, stamp_ns)

    def tick(self) -> list[tuple[str, bytes]]:
        now_ms = self.device.device_ns // 1_000_000
        sent = [(topic, p) for topic, payload in self.device.tick() for p in self._tamper(topic, payload)]
        return sent + ([self._said[now_ms]] if now_ms in self._said else [])


class Wire(VirtualTopics):
    """A wire whose discovery knows others."""

    known: tuple[str, ...] = ()

    def writers(self, topic: str) -> tuple[str, ...]:
        return self.known if topic == topics.LOW_COMMAND else ()


def examine(
    *,
    tamper: Tamper = lambda topic, payload: (payload,),
    printed: dict[int, tuple[str, bytes]] | None = None,
    others: tuple[str, ...] = (),
    state_check: StateCheck = "strict",
    **options: Any,
) -> list[Finding]:
    """Return the findings on an emulated Go2, without sport mode, with a remote, by default."""
    clock = VirtualClock()
    device = Go2Device(nominal_truth(), **{"sport": "", "remote": (), **options})
    wire = Wire(Air(device, tamper, printed or {}), clock)
    wire.known = others
    return list(Go2Doctor(wire, clock, 1.0, state_check).run())


def only(findings: Iterable[Finding], area: str, word: str) -> Finding:
    """Return the one finding of an area with a word in it."""
    (found,) = [f for f in findings if f.code == area and word in f.seen]
    return found


def test_a_sound_robot_has_nothing_to_complain_of() -> None:
    """500 states a second, a running clock, nobody else, a full battery, level, a remote."""
    findings = examine()
    assert {f.severity for f in findings} == {Severity.OK}
    assert "500 states a second" in only(findings, "states", "states a second").seen
    assert "nobody else" in only(findings, "commands", "nobody").seen
    assert "0 degrees" in only(findings, "robot", "leans").seen
    assert only(findings, "services", "low level is free")


def test_it_sends_no_motor_command() -> None:
    """The emulated robot's log has no command, and its mode stays what it was."""
    clock = VirtualClock()
    device = Go2Device(nominal_truth(), sport="normal", remote=())
    list(Go2Doctor(VirtualTopics(device, clock), clock, 1.0).run())
    assert (device.log.accepted, device.log.refused) == (0, 0)
    again = list(Go2Doctor(VirtualTopics(device, clock), clock, 1.0).run())
    assert only(again, "services", "'normal' is active").severity is Severity.NOTE


def test_sport_modes_own_commands_are_told_from_a_strangers() -> None:
    """While a mode is active, commands are probably its own; without one, somebody else sends them."""
    assert only(examine(sport="ai"), "commands", "sport mode 'ai'").severity is Severity.NOTE
    printed = {100 * k: (topics.LOW_COMMAND, b"whatever") for k in range(1, 6)}
    stranger = only(
        examine(printed=printed, others=("process walk",)), "commands", "5 messages (process walk)"
    )
    assert (stranger.severity, stranger.do) == (Severity.FAIL, "stop that program")


def test_commands_of_a_robot_that_does_not_say_its_mode_are_nobodys() -> None:
    """An observer may not ask for the mode: what it hears may be sport mode, which is no fault."""
    findings = examine(
        sport="ai",
        tamper=lambda topic, payload: () if topic == topics.response(topics.SERVICES[0]) else (payload,),
    )
    found = only(findings, "commands", "did not report whether its sport mode")
    assert found.severity is Severity.WARN and "controller" in found.do


def test_a_silent_writer_is_named() -> None:
    """Discovery knows somebody who has not said anything yet."""
    assert only(examine(others=("process walk",)), "commands", "process walk").severity is Severity.WARN


def test_no_states_is_said_with_what_to_look_at() -> None:
    """A robot that says nothing: the finding names the topic and the usual causes."""
    findings = examine(tamper=lambda topic, payload: ())
    silent = only(findings, "states", "no states came on rt/lowstate")
    assert silent.severity is Severity.FAIL
    assert "interface" in silent.do
    assert only(findings, "services", "does not answer").severity is Severity.WARN


def test_another_robot_on_the_topic_is_said() -> None:
    """Messages that are no Go2 states are counted, with the reason."""
    findings = examine(tamper=lambda topic, p: (p[:-4],) if topic == topics.LOW_STATE else (p,))
    (found,) = [f for f in findings if f.code == "states"]
    assert found.severity is Severity.FAIL and "1176 bytes" in found.seen and "G1" in found.do


def other_rule(topic: str, payload: bytes) -> Iterable[bytes]:
    """Turn a bit of each checksum."""
    return (payload[:-1] + bytes([payload[-1] ^ 1]),) if topic == topics.LOW_STATE else (payload,)


def test_another_checksum_rule_is_one_finding() -> None:
    """However many states there are, each with a checksum of its own; it names the switch and its risk."""
    (found,) = [f for f in examine(tamper=other_rule) if f.code == "states"]
    assert found.severity is Severity.FAIL
    assert re.match(
        r"\d+ of \d+ messages on rt/lowstate \(100\.0%\) .*the first: .*checksum is 0x", found.seen
    )
    assert "--state-check length" in found.do and "corrupted" in found.do


def test_with_the_switch_another_rule_is_a_warning() -> None:
    """What the states say is examined all the same."""
    findings = examine(tamper=other_rule, state_check="length")
    assert only(findings, "states", "not checked").severity is Severity.WARN
    assert only(findings, "states", "states a second").severity is Severity.OK


def test_a_few_corrupt_states_are_a_warning() -> None:
    """One in two hundred: it works, but worse than it could."""
    count = 0

    def rarely(topic: str, payload: bytes) -> Iterable[bytes]:
        nonlocal count
        count += topic == topics.LOW_STATE
        return other_rule(topic, payload) if count % 200 == 0 else (payload,)

    found = only(examine(tamper=rarely), "states", "no Go2 states")
    assert (found.severity, "cable" in found.do) == (Severity.WARN, True)


def test_a_clock_that_stands_still_is_said() -> None:
    """The same tick again and again."""

    def stale(topic: str, payload: bytes) -> Iterable[bytes]:
        if topic != topics.LOW_STATE:
            return (payload,)
        return (encode_low_state(dataclasses.replace(decode_low_state(payload).values(), tick_ms=7)),)

    assert only(examine(tamper=stale), "states", "stands still").severity is Severity.FAIL


def test_a_clock_that_runs_fast_is_a_failure() -> None:
    """By 9.55 %, as of a simulator that does not keep time."""

    def fast(topic: str, payload: bytes) -> Iterable[bytes]:
        if topic != topics.LOW_STATE:
            return (payload,)
        values = decode_low_state(payload).values()
        return (encode_low_state(dataclasses.replace(values, tick_ms=round(values.tick_ms * 1.0955))),)

    found = only(examine(tamper=fast), "states", "robot's clock against ours: +9.5")
    assert found.severity is Severity.FAIL and "simulator" in found.do


def test_lost_states_are_counted() -> None:
    """Every fifth state is lost: a warning about the rate, and the count of those missing."""
    count = 0

    def lossy(topic: str, payload: bytes) -> Iterable[bytes]:
        nonlocal count
        count += topic == topics.LOW_STATE
        return () if topic == topics.LOW_STATE and count % 5 == 0 else (payload,)

    findings = examine(tamper=lossy)
    assert only(findings, "states", "states a second").severity is Severity.WARN
    assert only(findings, "states", "states lost").severity is Severity.NOTE


def test_battery_heat_and_remote() -> None:
    """Each has its finding and remedy."""
    no_remote = only(examine(remote=None), "robot", "no remote")
    assert (no_remote.severity, "switch the remote on" in no_remote.do) == (Severity.NOTE, True)

    def sick(topic: str, payload: bytes) -> Iterable[bytes]:
        if topic != topics.LOW_STATE:
            return (payload,)
        values = decode_low_state(payload).values()
        values = dataclasses.replace(
            values,
            battery_percent=7,
            temperature=values.temperature + 60,
            orientation=np.array([0.7, 0.7, 0.0, 0.14]),
        )
        return (encode_low_state(values),)

    findings = examine(tamper=sick)
    for word in ("battery 7 %", "hottest motor", "leans"):
        assert only(findings, "robot", word).severity is Severity.WARN


def test_a_transport_without_topics_is_refused() -> None:
    """A byte stream cannot carry this robot."""

    class Stream:
        def open(self) -> None: ...

    with pytest.raises(TransportError, match="carries no topics"):
        list(Go2Doctor(Stream(), VirtualClock(), 1.0).run())  # type: ignore[arg-type]


def test_other_answers_are_passed_over() -> None:
    """An answer to somebody else's request, or garbage, is not taken for ours."""
    answers = topics.response("motion_switcher")
    printed = {k: (answers, b"garbage" if k % 2 else bytes(60)) for k in range(2000)}
    assert only(examine(printed=printed), "services", "low level is free")


def test_faults_of_the_emulator_reach_the_doctor() -> None:
    """A tenth of the states corrupt: they are refused by their checksum and reported."""
    findings = examine(plan=FaultPlan(corrupt=0.1))
    assert any(f.severity is Severity.FAIL and "no Go2 states" in f.seen for f in findings)


def test_a_refused_question_is_not_taken_for_a_free_robot() -> None:
    """A switcher that answers with an error names no mode either; the finding has the error's words."""

    def refuse(topic: str, payload: bytes) -> Iterable[bytes]:
        if topic != topics.response("motion_switcher"):
            return (payload,)
        return (encode_response(dataclasses.replace(decode_response(payload), code=7006, data="")),)

    findings = examine(tamper=refuse)
    assert only(findings, "services", "checking the mode failed").severity is Severity.WARN
    assert not any("low level is free" in f.seen for f in findings)


# unitree_mujoco in the robot's place.


def simulated(simulator: Simulator, **attributes: Any) -> list[Finding]:
    """Return the findings on a stand-in of the simulator."""
    clock = VirtualClock()
    device = UnitreeMujoco(np.array(DRIVER.rest_position))
    for name, value in attributes.items():
        setattr(device, name, value)
    return list(Go2Doctor(VirtualTopics(device, clock), clock, 1.0, simulator=simulator).run())


def test_a_simulator_is_recognised_and_its_option_named() -> None:
    """One finding for all its states, with what to add and when not to."""
    found = only(simulated("none"), "states", "are no Go2 states")
    assert found.severity is Severity.FAIL
    assert "--simulator unitree_mujoco" in found.do and "A real Go2 never sends them" in found.do


def test_a_simulator_that_is_named_is_well() -> None:
    """Services and battery that it lacks are no findings, and what is not checked is reported once."""
    findings = simulated("unitree_mujoco")
    assert {f.severity for f in findings} == {Severity.OK, Severity.NOTE}
    assert only(findings, "states", "states a second").seen.startswith("500 ")
    assert len([f for f in findings if "no head, clock, checksum and battery" in f.seen]) == 1
    assert not [f for f in findings if f.code == "services" or "battery 0" in f.seen]


def test_a_simulator_that_is_paused_is_said() -> None:
    """Its states go on and do not change."""
    found = only(simulated("unitree_mujoco", paused=True), "states", "do not change")
    assert (found.severity, found.do) == (Severity.FAIL, "let the simulation run: it is paused")
