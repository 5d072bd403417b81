"""The emulated controller's log: commands that move or hold the robot, and speeds of joints after events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ros2_rig import Ros2Rig

from deal_hw.control.safety.passive import make_passive
from deal_hw.drivers.ros2.command_log import AGAIN, FIRST, HOLDS, MOVES, Ros2CommandLog
from deal_hw.drivers.ros2.emulator import ros2_device
from deal_hw.drivers.ros2.faults import ControllerFaults
from deal_hw.drivers.ros2.messages import encode_positions
from deal_hw.testing.joint_faults import JointFaults

MS = 1_000_000
AT = np.zeros(2)


def events(rig: Ros2Rig) -> list[str]:
    """Return what the log of a rig's device says."""
    return [what for _, _, what in rig.device.changes]


def test_the_same_target_again_holds_from_its_first_command_on() -> None:
    """The second one shows it; the event has the time of the first."""
    log = Ros2CommandLog()
    found = [
        log.take(at_ms * MS, at_ms, np.array(target), AT)
        for at_ms, target in ((0, (0.1, 0.0)), (20, (0.2, 0.0)), (40, (0.3, 0.0)), (60, (0.3, 0.0)))
    ]
    assert found == [[(0, 0, FIRST)], [(20, 20, MOVES)], [], [(40, 40, HOLDS)]]
    assert log.take(80 * MS, 80, np.array((0.3, 0.0)), AT) == []
    assert log.take(100 * MS, 100, np.array((0.3, 0.1)), AT) == [(100, 100, MOVES)]
    commands = log.to_json()["commands"]
    assert commands[0] == [0, [0.1, 0.0], 0.1] and commands[-1] == [100, [0.3, 0.1], 0.3]


def test_a_command_after_a_pause_is_an_event() -> None:
    """Another run begins there."""
    log = Ros2CommandLog()
    log.take(0, 0, AT, AT)
    assert log.take(499 * MS, 499, AT, AT) == [(0, 0, HOLDS)]
    assert log.take(999 * MS, 999, AT, AT) == [(999, 999, AGAIN)]


def test_speeds_count_for_a_second_after_each_event() -> None:
    """Of two events that are close, each has its own second."""
    log = Ros2CommandLog()
    log.watch(1000 * MS, 5, "limp")
    log.move(1100 * MS, np.array((0.2, -0.3)))
    log.watch(1500 * MS, 6, "sound")
    for at_ms, speed in ((1600, 0.4), (2100, 0.7), (2499, 0.5), (2500, 9.0)):
        log.move(at_ms * MS, np.array((0.0, speed)))
    assert log.to_json()["fastest_after"] == [[1000, 5, "limp", 0.4], [1500, 6, "sound", 0.7]]


def test_a_passive_robot_holds_by_the_emulators_log(tmp_path: Path) -> None:
    """The last target came several times, and is where the joints were."""
    rig = Ros2Rig(tmp_path)
    rig.armed()
    for step in range(30):
        rig.run(1, target=0.02 * step)
    assert events(rig)[-1] == MOVES
    assert make_passive(rig.robot, rig.clock)
    assert events(rig)[-1] == HOLDS
    commands = rig.device.report()["commands"]
    assert len({tuple(target) for _, target, _ in commands[-3:]}) == 1
    # Its speed of 1 rad/s in one state of 10 ms.
    assert commands[-3][2] < 0.02


def test_commands_to_an_inactive_controller_are_in_the_log(tmp_path: Path) -> None:
    """They are not taken, but a judge must see that the run went on, or held the robot."""
    rig = Ros2Rig(tmp_path)
    rig.device.active = False
    rig.device.receive(rig.topics.commands, encode_positions(np.array([0.1, 0.2])))
    report = rig.device.report()
    assert report["commands_accepted"] == 0
    assert [target for _, target, _ in report["commands"]] == [[0.2, 0.1]]


def test_the_ends_of_faults_are_events_with_speeds(tmp_path: Path) -> None:
    """Drives that come back far from their set-point move the joints fast."""
    rig = Ros2Rig(tmp_path)
    assert rig.file.ros2 is not None
    device = ros2_device(
        rig.file.ros2,
        rig.description,
        rig.device._truth,
        noisy=False,
        joint_faults=JointFaults(limp_after_s=0.2, limp_s=0.5),
        faults=ControllerFaults(controller_off_after_s=1.0, controller_off_s=0.1),
    )
    device.receive(rig.topics.commands, encode_positions(np.array([0.0, 0.0])))
    device.advance_to(300 * MS)
    device.receive(rig.topics.commands, encode_positions(np.array([0.6, 0.6])))
    device.freeze(1.4)
    device.advance_to(2000 * MS)
    report = device.report()
    assert [what for _, _, what in device.changes if what not in (MOVES, HOLDS)] == [
        FIRST,
        "limp",
        "sound",
        "controller off",
        "controller active",
        "frozen",
    ]
    speeds = {what: speed for _, _, what, speed in report["fastest_after"]}
    assert speeds["sound"] > 2.0 and speeds["frozen"] < 0.1
