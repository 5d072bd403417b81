"""unitree_mujoco as a robot: the driver and the loop against a stand-in with its bytes, in virtual time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from fakes.go2 import STIFF, FakeGo2
from fakes.unitree_mujoco import UnitreeMujoco

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import RUNNING, Outcome
from deal_hw.control.safety.passive import make_passive
from deal_hw.control.safety.safety import Safety
from deal_hw.drivers.go2.descriptions import on_stand
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder
from deal_hw.drivers.go2.messages.low_state import encode_low_state
from deal_hw.drivers.go2.messages.simulated import is_unitree_mujoco
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.go2.unitree_mujoco import (
    UnitreeMujocoConfig,
    UnitreeMujocoOnStandRobot,
    UnitreeMujocoRobot,
)
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.errors import (
    ConfigurationError,
    SafetyError,
    TransportTimeoutError,
    UnknownNameError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.motions.posture import PostureBehaviour, PostureConfig
from deal_hw.robots.connect import make_robot
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.types import RobotState, Status

RESTING = np.array(DRIVER.rest_position)
STANDING = np.array(DRIVER.default_position)
ZERO = np.zeros(12)
POSTURE = PostureConfig(fold_s=0.5, rise_s=0.8, settle_s=0.2, lie_s=0.8)
Tamper = Callable[[bytes], Iterable[bytes]]


class Wire(VirtualTopics):
    """A virtual wire on which states may be changed, and others may write."""

    tamper: Tamper = staticmethod(lambda payload: (payload,))
    state_writers: tuple[str, ...] = ("unitree_mujoco",)

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return who writes states."""
        return self.state_writers if topic == topics.LOW_STATE else ()

    def say(self, topic: str, payload: bytes) -> None:
        """Let another participant speak; the simulator hears it, too."""
        self.device.receive(topic, payload)
        self._arrive(topic, payload, self._clock.now_ns())

    def _run_tick(self, tick_ns: int) -> None:
        for topic, payload in self.device.tick():
            for arrived in self.tamper(payload):
                self._arrive(topic, arrived, tick_ns)


class Rig:
    """The simulator's stand-in, the wire and the driver."""

    def __init__(self, step_ms: int = 2, held: bool = False) -> None:
        self.clock = VirtualClock(5_000_000_000)
        self.device = UnitreeMujoco(STANDING if held else RESTING, on_stand=held, step_ms=step_ms)
        self.wire = Wire(self.device, self.clock)
        kind = UnitreeMujocoOnStandRobot if held else UnitreeMujocoRobot
        self.robot = kind(self.wire, self.clock)

    def armed(self) -> Go2Robot:
        """Return the driver, connected, homed and armed."""
        self.robot.connect()
        self.robot.home(10.0)
        self.robot.arm(1.0)
        return self.robot

    def run(self, at_s: float = -1.0, act: Callable[[], None] = lambda: None) -> LoopReport:
        """Stand up, hold, lie down; act once, so long after the first cycle."""
        whole = PostureBehaviour(HoldBehaviour(self.robot.description), self.robot.description, 0.5, POSTURE)
        begun: list[int] = []

        def progress(phase: str, silence_s: float) -> None:
            if phase != RUNNING:
                return
            begun.append(self.clock.now_ns())
            if at_s >= 0 and self.clock.now_ns() - begun[0] >= at_s * 1e9 and not acted:
                acted.append(True)
                act()

        acted: list[bool] = []
        return ControlLoop(
            self.robot,
            whole,
            Safety(self.robot.description),
            self.clock,
            lambda record: True,
            LoopConfig(duration_s=whole.longest_s),
            progress=progress,
            end=whole.end,
        ).run()


def tampered(change: Tamper) -> Go2Robot:
    """Return a driver in front of a simulator all of whose states are changed."""
    rig = Rig()
    rig.wire.tamper = change
    return rig.robot


def real(payload: bytes) -> list[bytes]:
    """Return a real Go2's state."""
    return [encode_low_state(FakeGo2().state())]


class TestUnitreeMujoco(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        rig, silent = Rig(), Rig()
        silent.device.talks = False

        def corrupt() -> None:
            def once(payload: bytes) -> list[bytes]:
                rig.wire.tamper = lambda payload: (payload,)
                return [payload[:-1]]

            rig.wire.tamper = once

        return RobotBench(
            robot=rig.robot,
            foreign=tampered(lambda payload: [payload + bytes(100)]),
            newer=tampered(real),
            silent=silent.robot,
            unplug=rig.wire.unplug,
            corrupt=corrupt,
            greets=False,
        )


# It is accepted where it is named, and only then.


def test_without_the_option_its_states_are_refused_and_the_option_is_named() -> None:
    """Nothing in the states may make the driver of a real robot accept a simulator."""
    rig = Rig()
    with pytest.raises(VersionMismatchError, match=r"head is 00 00.*--simulator unitree_mujoco"):
        Go2Robot(rig.wire, rig.clock).connect()


def test_a_real_robot_is_refused_where_the_simulator_is_named() -> None:
    """The option takes checks away that a real robot needs."""
    with pytest.raises(VersionMismatchError, match=r"real Go2.*Leave `--simulator` out"):
        tampered(real).connect()


def test_a_state_with_a_battery_and_no_head_is_neither() -> None:
    """What is known of neither robot nor simulator is not commanded."""
    charged = 1043

    def change(payload: bytes) -> list[bytes]:
        return [payload[:charged] + b"\x50" + payload[charged + 1 :]]

    with pytest.raises(VersionMismatchError, match="battery are set"):
        tampered(change).connect()


def test_a_real_robot_beside_the_simulator_ends_the_connection() -> None:
    """Commands would reach both."""
    with pytest.raises(VersionMismatchError, match="real Go2"):
        tampered(lambda payload: [payload, *real(payload)]).connect()


def test_two_simulators_are_told_apart_by_discovery() -> None:
    """Without clock and checksum the states do not tell."""
    rig = Rig()
    rig.wire.state_writers = ("one", "two")
    with pytest.raises(WrongDeviceError, match="2 programs write rt/lowstate: one; two"):
        rig.robot.connect()


def test_the_option_chooses_the_driver() -> None:
    """By name, for the two Go2s and nobody else."""
    clock = VirtualClock()

    def made(robot: str, simulator: str, transport: str = "dds", port: str = "lo") -> Go2Robot:
        found = make_robot(robot, transport, port, clock, settings={"simulator": simulator})
        assert isinstance(found, Go2Robot)
        return found

    assert type(made("go2", "unitree_mujoco")) is UnitreeMujocoRobot
    assert type(made("go2_on_stand", "unitree_mujoco")) is UnitreeMujocoOnStandRobot
    with pytest.raises(UnknownNameError, match="unitree_mujoco"):
        made("go2", "gazebo")
    with pytest.raises(ConfigurationError, match=r"--simulator would have no effect.*'cartpole'"):
        made("cartpole", "unitree_mujoco", "serial", "p")


def test_every_limit_but_those_of_the_battery_is_the_robots() -> None:
    """Nothing else is loosened, on the floor and on a stand."""
    for has, real_one in (
        (UnitreeMujocoRobot, DRIVER),
        (UnitreeMujocoOnStandRobot, on_stand.DESCRIPTION),
    ):
        mine, theirs = has.description.limits, real_one.limits
        assert mine.legs is not None and theirs.legs is not None
        assert dataclasses.replace(mine, legs=None) == dataclasses.replace(theirs, legs=None)
        differ = [
            entry.name
            for entry in dataclasses.fields(mine.legs)
            if getattr(mine.legs, entry.name) != getattr(theirs.legs, entry.name)
        ]
        assert differ == ["battery", "battery_low", "voltage", "arm_voltage"]
        for name in (
            "joint_names",
            "stiffness",
            "damping",
            "effort_limit",
            "passive_damping",
            "repeat_rate_hz",
        ):
            assert getattr(has.description, name) == getattr(real_one, name)


def test_the_settings_are_checked() -> None:
    """A joint that must stand still without a speed never does."""
    with pytest.raises(ConfigurationError, match="still_rad_s must be positive"):
        UnitreeMujocoConfig(still_rad_s=0.0)


# Freshness: by reception and by change.


def test_a_state_that_comes_twice_is_taken_once_and_is_no_error() -> None:
    """The simulator publishes in a thread of its own, faster than its physics steps."""
    rig = Rig()
    rig.wire.tamper = lambda payload: (payload, payload)
    with rig.robot as robot:
        states = [robot.read_state(1.0) for _ in range(20)]
    stamps = np.array([state.receive_ns for state in states])
    assert (np.diff(stamps) == 2_000_000).all()
    assert robot.transport_errors == 0


def test_a_simulation_that_is_paused_gives_no_states() -> None:
    """Its thread goes on publishing; nothing in them changes."""
    rig = Rig()
    rig.robot.connect()
    rig.device.paused = True
    with pytest.raises(TransportTimeoutError, match="nothing in them changes"):
        for _ in range(3):
            rig.robot.read_state(0.5)
    rig.robot.disconnect()
    with pytest.raises(TransportTimeoutError, match=r"nothing in them changes.*paused"):
        rig.robot.connect()


@pytest.mark.parametrize("step_ms", [2, 5])
@pytest.mark.parametrize("held", [False, True])
def test_a_robot_at_rest_goes_on_sending_new_states(held: bool, step_ms: int) -> None:
    """Contacts and joints keep moving in the last digits: change tells a pause from rest."""
    rig = Rig(step_ms, held)
    before = b""
    for _ in range(20_000 // step_ms):
        (found,) = [payload for _ in range(step_ms) for _, payload in rig.device.tick()]
        assert found != before
        before = found


# Taking over, and running.


def test_nothing_is_asked_of_services_that_are_not_there() -> None:
    """Homing a real robot waits three seconds for them before it tries older ones."""
    rig = Rig()
    rig.robot.connect()
    begun_ns = rig.clock.now_ns()
    rig.robot.home(10.0)
    assert rig.clock.now_ns() - begun_ns < 1_500_000_000
    assert rig.device.commands == 0


def test_another_program_that_commands_the_simulator_is_found() -> None:
    """As on the robot: half a second of silence before anything is sent, and none but ours afterwards."""
    rig = Rig()
    rig.robot.connect()
    pending = [True]

    def rogue(payload: bytes) -> list[bytes]:
        if pending:
            rig.wire.say(topics.LOW_COMMAND, STIFF)
        return [payload]

    rig.wire.tamper = rogue
    with pytest.raises(SafetyError, match="another program commands"):
        rig.robot.home(3.0)
    pending.clear()
    rig.robot.home(10.0)
    rig.robot.arm(1.0)
    pending.append(True)
    assert Status.FAULT in _state_after(rig, 0.1).status


def _state_after(rig: Rig, seconds: float) -> RobotState:
    """Return the first state so much later [s]."""
    end_ns = rig.clock.now_ns() + round(seconds * 1e9)
    while (state := rig.robot.read_state(1.0)).receive_ns < end_ns:
        pass
    return state


@pytest.mark.parametrize("step_ms", [2, 5])
def test_it_stands_up_lies_down_and_ends_without_torque(step_ms: int) -> None:
    """A whole run: the torques that it holds afterwards are those of joints at rest."""
    rig = Rig(step_ms)
    report = rig.run()
    assert (report.outcome, report.passive_confirmed) == (Outcome.FINISHED, True)
    assert np.abs(rig.device.torque).max() < 0.6
    for _ in range(2000):
        rig.device.tick()
    assert np.abs(rig.device.velocity).max() < 0.2


def test_a_pause_of_the_physics_trips_within_the_limit_of_a_states_age() -> None:
    """Nothing is loosened: 40 ms without a state that differs."""
    rig = Rig()

    def pause() -> None:
        rig.device.paused = True

    report = rig.run(2.0, pause)
    assert report.outcome is Outcome.TRIPPED
    assert "old" in report.reason and not report.passive_confirmed


def test_a_robot_in_the_air_is_not_stood_up() -> None:
    """Floor and stand are distinguished as on the robot."""
    rig = Rig(held=True)
    floor = UnitreeMujocoRobot(rig.wire, rig.clock)
    floor.connect()
    with pytest.raises(SafetyError, match="holds the robot in the air"):
        floor.home(5.0)


# Passive: it holds torques, not gains.


def standing(rig: Rig) -> Go2Robot:
    """Return the driver while it holds the legs stiffly, pushed out of the way."""
    robot = rig.armed()
    command = default_command(robot)
    for at in np.linspace(0.0, 1.0, 100):
        robot.send_command(
            dataclasses.replace(
                command,
                position_target=RESTING + at * (STANDING - RESTING),
                stiffness=np.full(12, 60.0),
                damping=np.full(12, 5.0),
            )
        )
        for _ in range(5):
            robot.repeat()
            robot.read_state(1.0)
    return robot


def test_damping_that_is_not_sent_again_shakes_the_legs() -> None:
    """What the repeats are for: a torque that was damping once drives the joint afterwards."""
    damping = LowCommandEncoder().encode(LowCommand(ZERO, ZERO, ZERO, np.full(12, 5.0), ZERO))
    fastest = {}
    for every_ms in (2, 20):
        device = UnitreeMujoco(RESTING)
        for tick in range(4000):
            if tick < 1000:
                device.receive(topics.LOW_COMMAND, STIFF)
            elif tick % every_ms == 0:
                device.receive(topics.LOW_COMMAND, damping)
            device.tick()
        fastest[every_ms] = float(np.abs(device.velocity).max())
    assert fastest[2] < 0.1 and fastest[20] > 5.0


def test_passive_is_damping_with_every_state_until_the_joints_are_slow() -> None:
    """The robot sinks, and only a slow one counts as passive; what it holds then is next to nothing."""
    rig = Rig()
    robot = standing(rig)
    received = rig.device.commands
    begun_ns = rig.clock.now_ns()
    assert make_passive(robot, rig.clock)
    states = (rig.clock.now_ns() - begun_ns) // 2_000_000
    assert rig.device.commands - received >= states
    command = rig.device.command
    assert command is not None and not command.stiffness.any()
    np.testing.assert_array_equal(command.damping, DRIVER.passive_damping)
    assert np.abs(rig.device.velocity).max() < 0.2 and np.abs(rig.device.torque).max() < 0.6


def test_a_robot_that_still_moves_is_not_passive() -> None:
    """Its efforts are those of damping at once; the torque that it would hold is not small."""
    rig = Rig()
    robot = standing(rig)
    robot.passive()
    seen = [robot.read_state(1.0) for _ in range(500)]
    fast = [np.abs(state.velocity).max() >= 0.1 for state in seen]
    ended = [Status.ARMED not in state.status for state in seen]
    assert any(fast[10:]) and any(ended)
    assert not any(fast[ended.index(True) - 1 : ended.index(True)])


def test_whoever_only_listens_sends_nothing() -> None:
    """Before the first command there is nothing to send again."""
    rig = Rig()
    with rig.robot as robot:
        for _ in range(50):
            robot.read_state(1.0)
    assert rig.device.commands == 0


def test_the_stand_ins_states_are_known_by_what_they_lack() -> None:
    """And a real robot's are not."""
    assert is_unitree_mujoco(Rig().device.state())
    assert not is_unitree_mujoco(real(b"")[0])
    assert not is_unitree_mujoco(Rig().device.state()[4:])
