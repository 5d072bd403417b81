"""The bridge in real time: TLS on one side, DDS and an emulated Go2 on the other."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from random import SystemRandom

import numpy as np
import pytest
from bridge_client import BridgeClient
from bridge_rig import BridgeRig

import deal_hw
from deal_hw.clock import MonotonicClock
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.transports import zenoh_session
from deal_hw.drivers.transports.zenoh_transport import ZenohTransport
from deal_hw.errors import ConfigurationError, PortNotFoundError, SafetyError, TransportTimeoutError
from deal_hw.types import JointCommand
from deal_hw.workflows.stop import StopReport
from deal_hw.workflows.stopping import robot as stopping

IMPATIENT = {"connect/timeout_ms": 500}
"""Setting of a session that never comes, so that nobody waits long for it."""

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(
        any(importlib.util.find_spec(name) is None for name in ("cyclonedds", "cryptography", "mujoco")),
        reason="pip install 'deal-hw[dds,keys,sim]'",
    ),
]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BridgeRig]:
    """An emulated Go2 whose sport mode is off, and a bridge."""
    # A busy machine may hold a process up for longer than the usual limit of 50 ms.
    patient = ("--command-age-s", "0.4")
    folder = tmp_path_factory.mktemp("bridge")
    with BridgeRig(folder, SystemRandom().randrange(10, 100), bridge=patient) as made:
        yield made


@pytest.fixture
def controller(rig: BridgeRig) -> Iterator[BridgeClient]:
    """A client that may command, in charge; at the end it damps the robot."""
    with BridgeClient(rig.port, rig.options("controller")) as client:
        client.take_over()
        yield client
        client.repeat(client.damping(), lambda: rig.commands()[-1] == "damping")


def test_a_robot_without_a_commander_is_damped_from_the_start(rig: BridgeRig) -> None:
    """Sport mode is off and nobody commands: it may hold anything, so the bridge damps it."""
    with BridgeClient(rig.port, rig.options("observer")) as observer:
        observer.hear(lambda: bool(observer.status) and bool(rig.commands()))
    assert observer.status["control"] == "damping"
    rig.await_commands(["damping"])


def test_the_driver_works_through_it(rig: BridgeRig) -> None:
    """A whole run's life: connect, home, arm, command, passive; a second run is refused meanwhile."""
    clock = MonotonicClock()
    robot, other = (
        Go2Robot(ZenohTransport(rig.port, clock, rig.options("controller")), clock, support_check=False)
        for _ in range(2)
    )
    with robot, other:
        robot.home(10.0)
        robot.arm(5.0)
        state = robot.read_state(1.0)
        facts = robot.description
        zero, gain = np.zeros(12), np.ones(12)
        stay = JointCommand(
            np.clip(state.position, *np.array(facts.limits.target).T), zero, 20 * gain, gain, zero, gain, gain
        )
        before = rig.commands()
        while rig.commands() == before:
            robot.send_command(stay)
            robot.read_state(1.0)
        rig.await_commands([*before, "stiff"])
        with pytest.raises(SafetyError, match="another controller commands the robot through the bridge"):
            while True:
                robot.send_command(stay)
                robot.read_state(1.0)
                with contextlib.suppress(TransportTimeoutError):
                    other.home(0.005)
        with BridgeClient(rig.port, rig.options("controller")) as rude:
            refused: list[int] = []
            while not refused or refused[-1] <= refused[0] + 20:
                robot.send_command(stay)
                robot.read_state(1.0)
                rude.listen()
                if rude.status:
                    refused.append(rude.status["refused"].get("holder", 0))
                    rude.repeat(rude.damping(), lambda: True)
        assert robot.fault == "", "another client's commands are the bridge's to refuse"
        robot.passive()


def test_an_observer_reads_and_cannot_command(rig: BridgeRig, controller: BridgeClient) -> None:
    """Its commands do not even reach the judge."""
    with BridgeClient(rig.port, rig.options("observer")) as observer:
        observer.repeat(observer.damping(), lambda: observer.states > 200 and bool(observer.status))
        assert observer.status["control"] == "controlled"
        refused = observer.status["refused"]
        admitted = observer.status["admitted"]
        observer.hear(lambda: observer.status["admitted"] > admitted + 200)
        assert observer.status["refused"] == refused
        assert not observer.in_charge


def test_a_run_with_an_observers_certificate_is_refused(rig: BridgeRig) -> None:
    """It waited for a minute for services that never received it, and blamed sport mode."""
    clock = MonotonicClock()
    with BridgeClient(rig.port, rig.options("observer")) as observer:
        # The controller of the test before counts as live until its last command is 0.5 s old.
        observer.hear(lambda: bool(observer.status) and observer.status["control"] != "controlled")
    reported = rig.commands()
    with Go2Robot(ZenohTransport(rig.port, clock, rig.options("observer")), clock) as robot:
        with pytest.raises(TransportTimeoutError, match=r"the certificate may only read.*--controllers"):
            robot.home(30.0)
        robot.passive()
    assert rig.commands() == reported


def test_a_second_controller_and_replays_are_refused(rig: BridgeRig, controller: BridgeClient) -> None:
    """Both are counted, and the first one's commands go on: nothing else moved the robot."""
    reported = rig.commands()

    def refused(*kinds: str) -> int:
        return sum(controller.status["refused"].get(kind, 0) for kind in kinds)

    with BridgeClient(rig.port, rig.options("controller")) as second:
        second.hear(lambda: second.frame is not None)
        before = refused("holder")
        second.repeat(second.damping(), lambda: bool(second.status) and second.states > 100)
        controller.hear(lambda: refused("holder") > before + 20)
        assert "another controller" in controller.status["last_refusal"]
    before = refused("sequence", "age")
    command, old = controller.pose(), controller.echoes.next()

    def replay() -> bool:
        controller.send(command, old)
        return refused("sequence", "age") > before + 20

    controller.hear(replay)
    assert controller.in_charge
    assert rig.commands() == reported


def test_a_silent_controller_is_replaced_by_damping(rig: BridgeRig) -> None:
    """Its link is gone without a word; the stream that comes back has to take the robot over anew."""
    with BridgeClient(rig.port, rig.options("controller")) as client:
        client.take_over()
        reported = rig.commands()
        client.repeat(b"", lambda: client.status["control"] == "damping")
        assert "no admissible command" in client.status["reason"]
        rig.await_commands([*reported, "damping"])
        refused = client.status["refused"].get("handover", 0)
        client.repeat(client.pose(), lambda: client.status["refused"].get("handover", 0) > refused + 20)
        rig.await_commands([*reported, "damping"])


def test_a_killed_bridge_damps_when_it_is_back(rig: BridgeRig) -> None:
    """The robot holds its last command; the next bridge damps it, and the old stream stays out."""
    with BridgeClient(rig.port, rig.options("controller")) as client:
        client.take_over()
        reported = rig.commands()
        assert reported[-1] == "stiff"
        rig.kill_bridge()
        assert rig.commands() == reported
        client.status = {}
        rig.start_bridge()
        client.hear(lambda: client.status.get("refused", {}).get("handover", 0) > 20)
        assert client.status["control"] == "damping"
        rig.await_commands([*reported, "damping"])
        client.take_over()
        rig.await_commands([*reported, "damping", "stiff"])


def test_a_bridge_survives_a_broken_pipe(rig: BridgeRig) -> None:
    """A client that is killed makes the next TLS send raise SIGPIPE; the others keep the bridge."""
    with BridgeClient(rig.port, rig.options("controller")) as client:
        client.hear(lambda: client.frame is not None)
        os.kill(rig.bridge.pid, signal.SIGPIPE)
        states = client.states
        client.hear(lambda: client.states > states + 200)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP, signal.SIGALRM])
def test_a_bridge_that_is_told_to_end_damps_first(rig: BridgeRig, number: signal.Signals) -> None:
    """While a controller holds the robot: each signal that ends or stops the bridge damps the robot first."""
    with BridgeClient(rig.port, rig.options("controller")) as client:
        client.take_over()
        reported = rig.commands()
        os.kill(rig.bridge.pid, number)
        rig.await_commands([*reported, "damping"])
        _, printed = rig.bridge.stop()
        assert "the bridge ended: " in printed and "commands passed" in printed
    rig.start_bridge()


def test_stop_damps_through_the_bridge_and_fights_nobody(
    rig: BridgeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the bridge damps is passive, also for an observer. Where another one controls, nothing is sent."""
    monkeypatch.setattr(stopping, "FREE_S", 0.5)

    def stop(name: str) -> StopReport:
        return deal_hw.stop("go2", port=rig.port, transport="zenoh", wire=rig.options(name), seconds=0.5)

    assert stop("observer").passive and stop("controller").passive
    with BridgeClient(rig.port, rig.options("controller")) as client:
        client.take_over()
        reported = rig.commands()
        for name in ("observer", "controller"):
            found = stop(name)
            # On a busy computer commands arrive before the bridge's status, and the words are of a program.
            assert not found.passive
            assert re.search("another (controller|program) commands the robot", found.words)
        assert client.in_charge and rig.commands() == reported


@pytest.mark.parametrize(
    ("name", "kind", "words"),
    [
        ("expired", ConfigurationError, "certificate has expired"),
        ("", PortNotFoundError, "--certificate and --key"),
    ],
)
def test_others_are_refused_and_told_why(
    rig: BridgeRig, name: str, kind: type[Exception], words: str
) -> None:
    """An expired certificate, and none."""
    with pytest.raises(kind, match=words), BridgeClient(rig.port, rig.options(name), IMPATIENT):
        pass


def test_the_robots_side_refuses_an_expired_certificate_itself(
    rig: BridgeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client that does not look at its own, such as another program: the peer's verdict is put in words."""
    monkeypatch.setattr(zenoh_session, "own_certificate_trouble", lambda options: (0, ""))
    with (
        pytest.raises(PortNotFoundError, match="it finds our certificate expired"),
        BridgeClient(rig.port, rig.options("expired"), IMPATIENT),
    ):
        pass


def test_a_certificate_of_another_name_reads_nothing(rig: BridgeRig, tmp_path: Path) -> None:
    """Signed by the same authority, and named neither controller nor observer: the robot's own, here."""
    with (
        BridgeClient(rig.port, rig.options("robot")) as stranger,
        BridgeClient(rig.port, rig.options("observer")) as observer,
    ):
        observer.hear(lambda: observer.states > 100)
        stranger.listen()
        assert stranger.states == 0
        assert not stranger.status
