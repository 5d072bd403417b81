"""Contract of every robot driver on any wire."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from deal_hw.clock import Clock
from deal_hw.errors import (
    SafetyError,
    TransportError,
    TransportLostError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.motions.behaviours import position_command
from deal_hw.robot import Robot
from deal_hw.types import JointCommand, RobotState, Status

_PATIENCE_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotBench:
    """A robot under test and faulty robots, none of them connected.

    Attributes:
        robot: A driver that is connected to a device (or its emulator) that works.
        foreign: A driver that is connected to another kind of device.
        newer: A driver that is connected to a device with a newer version of the protocol.
        silent: A driver that is connected to a device that sends nothing.
        unplug: Pulls the cable of ``robot``.
        corrupt: Makes the next frame from ``robot``'s device arrive corrupt.
        greets: Whether ``connect`` sends a message to the device; False if it only listens.
    """

    robot: Robot
    foreign: Robot
    newer: Robot
    silent: Robot
    unplug: Callable[[], None]
    corrupt: Callable[[], None]
    greets: bool = True


def default_command(robot: Robot, target: float = 0.0) -> JointCommand:
    """Return a command with the description's gains and limits and this target for every actuated joint."""
    facts = robot.description
    return position_command(facts, np.full(len(facts.actuated), target))


def arm(robot: Robot) -> None:
    """Connect, home and arm a robot, and send its first command."""
    robot.connect()
    robot.home(20.0)
    robot.arm(1.0)
    robot.send_command(default_command(robot))


def run_cycles(robot: Robot, clock: Clock, cycles: int, command: JointCommand) -> list[RobotState]:
    """Command and read as the control loop does, for cycles of its control period; return the states."""
    period_ns = round(1e9 / robot.description.control_rate_hz)
    states: list[RobotState] = []
    for _ in range(cycles):
        deadline_ns = clock.now_ns() + period_ns
        robot.send_command(command)
        states += read_until(robot, clock, deadline_ns)
    return states


def read_until(robot: Robot, clock: Clock, deadline_ns: int) -> list[RobotState]:
    """Read until a time [ns]; return the states."""
    states: list[RobotState] = []
    with contextlib.suppress(TransportTimeoutError):
        while (left_ns := deadline_ns - clock.now_ns()) > 0:
            states.append(robot.read_state(left_ns / 1e9))
    return states


class RobotSuite:
    """Contract of a robot; inherit it and override ``bench``."""

    @pytest.fixture
    def bench(self) -> RobotBench:
        """Return the robots under test."""
        raise NotImplementedError("a RobotSuite overrides the fixture `bench`")

    @pytest.fixture
    def armed(self, bench: RobotBench) -> Robot:
        """Return a robot that is connected, homed and armed."""
        bench.robot.connect()
        bench.robot.home(_PATIENCE_S)
        bench.robot.arm(_PATIENCE_S)
        return bench.robot

    def test_connecting_and_disconnecting_may_be_repeated(self, bench: RobotBench) -> None:
        """Both do nothing the second time, and a robot can be connected again."""
        bench.robot.disconnect()
        for _ in range(2):
            bench.robot.connect()
            bench.robot.connect()
            assert bench.robot.read_state(_PATIENCE_S).sequence >= 0
            bench.robot.disconnect()
            bench.robot.disconnect()

    def test_another_device_is_refused(self, bench: RobotBench) -> None:
        """A device that is not this robot raises WrongDeviceError."""
        with pytest.raises(WrongDeviceError):
            bench.foreign.connect()

    def test_another_version_is_refused(self, bench: RobotBench) -> None:
        """Another protocol version raises VersionMismatchError, whose text says what to update."""
        with pytest.raises(VersionMismatchError, match="update"):
            bench.newer.connect()

    def test_silence_is_a_timeout(self, bench: RobotBench) -> None:
        """A silent device raises a TransportError that is a TimeoutError."""
        with pytest.raises(TransportError) as caught:
            bench.silent.connect()
        assert isinstance(caught.value, TimeoutError)

    def test_states_come_in_order_and_fit_the_description(self, bench: RobotBench) -> None:
        """Numbers and stamps grow, arrays have one finite entry a joint, no command is in force."""
        with bench.robot as robot:
            states = [robot.read_state(_PATIENCE_S) for _ in range(50)]
        joints = len(robot.description.joint_names)
        for state in states:
            for values in (state.position, state.velocity, state.effort):
                assert values.shape == (joints,)
                assert np.isfinite(values).all()
            assert (state.command_sequence, state.command_age_ns) == (-1, -1)
        for earlier, later in itertools.pairwise(states):
            assert later.sequence > earlier.sequence
            assert later.device_ns > earlier.device_ns
            assert later.receive_ns >= earlier.receive_ns

    def test_homing_and_arming_show_in_the_status(self, armed: Robot) -> None:
        """After home and arm, states say so, and no fault is reported."""
        state = armed.read_state(_PATIENCE_S)
        while not state.status & Status.ARMED:
            state = armed.read_state(_PATIENCE_S)
        assert state.status & Status.HOMED
        assert not state.status & (Status.WATCHDOG | Status.FAULT | Status.HOMING)

    def test_a_command_returns_what_was_sent(self, armed: Robot) -> None:
        """The rounded command is close to the requested one, and sending it again changes nothing."""
        sent = armed.send_command(default_command(armed, target=0.012345678))
        again = armed.send_command(sent)
        np.testing.assert_allclose(sent.position_target, 0.012345678, atol=1e-3)
        for field in dataclasses.fields(JointCommand):
            np.testing.assert_array_equal(getattr(again, field.name), getattr(sent, field.name))

    def test_commands_are_numbered_and_echoed(self, armed: Robot) -> None:
        """Numbers start at 0, and states name the command in force with an age that grows."""
        assert armed.last_sequence == -1
        armed.send_command(default_command(armed))
        assert armed.last_sequence == 0
        first = _wait(armed, lambda state: state.command_sequence == 0)
        second = armed.read_state(_PATIENCE_S)
        assert second.command_age_ns - first.command_age_ns == second.device_ns - first.device_ns
        armed.send_command(default_command(armed))
        assert armed.last_sequence == 1
        assert _wait(armed, lambda state: state.command_sequence == 1).command_age_ns >= 0

    def test_values_that_are_not_finite_are_not_sent(self, armed: Robot) -> None:
        """NaN and infinity raise SafetyError and do not take a number."""
        for value in (float("nan"), float("inf")):
            with pytest.raises(SafetyError):
                armed.send_command(default_command(armed, target=value))
        assert armed.last_sequence == -1

    def test_passive_ends_the_motion(self, armed: Robot) -> None:
        """After passive the robot is not armed, and commands do not change that."""
        armed.send_command(default_command(armed))
        armed.passive()
        _wait(armed, lambda state: not state.status & Status.ARMED)
        armed.send_command(default_command(armed))
        for _ in range(20):
            assert not armed.read_state(_PATIENCE_S).status & Status.ARMED

    def test_unplugging_is_reported(self, bench: RobotBench, armed: Robot) -> None:
        """Once the cable is pulled, reading and the passive command fail at once instead of waiting."""
        bench.unplug()
        with pytest.raises(TransportLostError):
            for _ in range(10_000):
                armed.read_state(_PATIENCE_S)
        with pytest.raises(TransportError):
            armed.passive()

    def test_a_corrupt_frame_is_counted_and_survived(self, bench: RobotBench) -> None:
        """One corrupt frame raises nothing, makes transport_errors grow, and the stream goes on."""
        with bench.robot as robot:
            robot.read_state(_PATIENCE_S)
            assert robot.transport_errors == 0
            bench.corrupt()
            for _ in range(5):
                robot.read_state(_PATIENCE_S)
            assert robot.transport_errors >= 1

    def test_the_wire_can_be_taken_once(self, bench: RobotBench) -> None:
        """Raw messages of both directions are kept until taken."""
        with bench.robot as robot:
            robot.read_state(_PATIENCE_S)
            wire = robot.take_wire()
            assert {message.channel for message in wire} == ({"rx", "tx"} if bench.greets else {"rx"})
            assert all(message.payload for message in wire)
            assert robot.take_wire() == []

    def test_commands_are_on_the_wire_once(self, armed: Robot) -> None:
        """A command is kept once; a repetition of it is not kept."""
        armed.take_wire()
        armed.send_command(default_command(armed))
        armed.repeat()
        assert [message.channel for message in armed.take_wire()].count("tx") == 1


def _wait(robot: Robot, wanted: Callable[[RobotState], bool]) -> RobotState:
    for _ in range(1000):
        if wanted(state := robot.read_state(_PATIENCE_S)):
            return state
    raise AssertionError("the awaited state did not come within 1000 samples")
