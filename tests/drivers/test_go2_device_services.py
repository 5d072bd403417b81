"""The emulated Go2's services in virtual time, and sport mode, which fights."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from deal_hw.drivers.go2.emulator.sport_controller import LYING, STANDING
from deal_hw.drivers.go2.messages.low_command import LowCommand, decode_low_command
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.rpc import Response
from deal_hw.types import FloatArray

ZERO = np.zeros(12)


def servo(position: FloatArray, stiffness: float = 60.0, damping: float = 5.0) -> LowCommand:
    """Return a command to hold a pose, with the gains of the SDK's example."""
    return LowCommand(position, ZERO, np.full(12, stiffness), np.full(12, damping), ZERO)


def fast(states: Sequence[LowStateFrame]) -> float:
    """Return the root mean square of all joint speeds [rad/s]."""
    return float(np.sqrt(np.mean([np.square(state.velocity) for state in states])))


def test_the_sdks_release_sequence(make_go2: Any) -> None:
    """CheckMode, StandDown, ReleaseMode until the name is empty; then sport mode is gone and silent."""
    bench = make_go2(sport="ai", start="standing")
    assert bench.mode() == "ai"
    assert bench.call("sport", 1005) == Response(77_000_000_001, 1005)
    assert bench.call("motion_switcher", 1003) == Response(77_000_000_001, 1003)
    assert bench.mode() == "ai"
    bench.run(1600)
    assert bench.mode() == ""
    assert bench.device.base_height < 0.15
    bench.run(100)
    assert bench.count(topics.SPORT_STATE) == bench.count(topics.LOW_COMMAND) == 0
    assert bench.call("sport", 1004) is None


@pytest.mark.parametrize("start", ["lying", "standing"])
def test_the_sdks_release_loop_ends(make_go2: Any, start: str) -> None:
    """Its loop asks for StandDown and ReleaseMode every second while a name is there: three turns suffice."""
    bench = make_go2(sport="normal", start=start)
    turns = 0
    while bench.mode() and turns < 10:
        bench.call("sport", 1005)
        bench.call("motion_switcher", 1003)
        bench.run(1000)
        turns += 1
    assert turns <= 3
    assert bench.device.base_height < 0.15


def test_postures_of_sport_mode(make_go2: Any) -> None:
    """StandUp lifts it, Damp lets it sink, RecoveryStand lifts it again, StandDown lays it down."""
    bench = make_go2(sport="normal")
    heights = []
    for api, wait_ms in ((1004, 1600), (1001, 1500), (1006, 2600), (1002, 100), (1005, 2000)):
        answer = bench.call("sport", api)
        assert answer is not None
        assert answer.code == 0
        bench.run(wait_ms)
        heights.append(bench.device.base_height)
    up, damped, recovered, balanced, down = heights
    assert min(up, recovered, balanced) > 0.31
    assert damped < 0.15
    assert down < 0.15


def test_a_move_is_answered_and_not_walked(make_go2: Any) -> None:
    """Move and StopMove return 0; the robot stays where it is."""
    bench = make_go2(sport="normal", start="standing")
    before = bench.device.base_position[0]
    answer = bench.call("sport", 1008, {"x": 0.5, "y": 0.0, "z": 0.1})
    assert answer is not None
    assert answer.code == 0
    bench.run(300)
    assert abs(bench.device.base_position[0] - before) < 0.01
    assert bench.call("sport", 1003) == Response(77_000_000_001, 1003)


@pytest.mark.parametrize(
    ("service", "api", "parameter", "code"),
    [
        ("motion_switcher", 4711, {}, 3203),
        ("sport", 1030, {}, 3203),
        ("sport", 1008, {"x": 1.0}, 3204),
        ("sport", 1008, {"x": float("nan"), "y": 0.0, "z": 0.0}, 3204),
        ("motion_switcher", 1002, {"name": "gallop"}, 7004),
        ("motion_switcher", 1002, {"name": "ai"}, 0),
        ("motion_switcher", 1002, {"name": "normal"}, 0),
        ("robot_state", 1001, {"name": "tea_kitchen", "switch": 1}, 3204),
        ("motion_switcher", 1, {}, 0),
    ],
)
def test_codes_of_answers(
    make_go2: Any, service: str, api: int, parameter: dict[str, Any], code: int
) -> None:
    """Unknown functions, bad parameters and wrong names have the vendor's error codes."""
    answer = make_go2(sport="normal").call(service, api, parameter)
    assert answer == Response(77_000_000_001, api, code, answer.data if answer else "")


@pytest.mark.parametrize("service", ["motion_switcher", "sport", "robot_state"])
def test_the_version_is_the_text_that_the_sdk_compares(make_go2: Any, service: str) -> None:
    """Its client prints "not equal" where the text differs from its own 1.0.0.1, by quotes, too."""
    answer = make_go2(sport="normal").call(service, 1, {})
    assert answer is not None and answer.data == "1.0.0.1"


def test_another_mode_may_be_selected_while_one_is_active(make_go2: Any) -> None:
    """As programs do on the robot: the new one has it, standing. While one lets go, the switcher is busy."""
    bench = make_go2(sport="normal", start="standing")
    assert bench.call("motion_switcher", 1002, {"name": "ai"}).code == 0
    assert bench.mode() == "ai"
    bench.run(1600)
    assert bench.device.base_height > 0.31
    bench.call("motion_switcher", 1003)
    assert bench.call("motion_switcher", 1002, {"name": "normal"}).code == 7002
    bench.run(320)
    assert bench.mode() == ""
    assert bench.call("motion_switcher", 1002, {"name": "normal"}).code == 0


def test_no_reply_is_no_reply(make_go2: Any) -> None:
    """A request that wants no answer is obeyed in silence."""
    bench = make_go2(sport="normal")
    assert bench.call("motion_switcher", 1003, no_reply=True) is None
    bench.run(320)
    assert bench.mode() == ""


def test_select_mode_brings_sport_mode_back(make_go2: Any) -> None:
    """SelectMode after a release, also by the service's name, stands the robot up."""
    bench = make_go2()
    answer = bench.call("motion_switcher", 1002, {"name": "ai_sport"})
    assert answer is not None
    assert answer.code == 0
    assert bench.mode() == "ai"
    bench.run(1600)
    assert bench.device.base_height > 0.31


def test_the_older_service_switch(make_go2: Any) -> None:
    """robot_state lists services (0: active), switches sport_mode off and on, and protects itself."""
    bench = make_go2(sport="normal")

    def status() -> dict[str, int]:
        answer = bench.call("robot_state", 1003)
        assert answer is not None
        return {entry["name"]: entry["status"] for entry in json.loads(answer.data)}

    assert status()["sport_mode"] == 0
    assert status()["ai_sport"] == 1
    assert bench.call("robot_state", 1001, {"name": "sport_mode", "switch": 0}) is not None
    bench.run(320)
    assert bench.mode() == ""
    assert status()["sport_mode"] == 1
    bench.call("robot_state", 1001, {"name": "sport_mode", "switch": 1})
    assert bench.mode() == "normal"
    answer = bench.call("robot_state", 1001, {"name": "robot_state", "switch": 0})
    assert answer is not None
    assert answer.json()["status"] == 5


def test_sport_mode_fights_until_it_is_released(make_go2: Any) -> None:
    """A user who lays the robot down against sport mode shakes it; after the release it obeys."""
    bench = make_go2(sport="normal", start="standing")
    calm = fast(bench.run(300))
    fight = fast(bench.run(400, servo(LYING)))
    assert fight > 20 * calm
    assert fight > 0.5
    assert bench.device.base_height > 0.15
    bench.call("motion_switcher", 1003)
    bench.run(1500, servo(LYING))
    assert bench.device.base_height < 0.15
    assert fast(bench.run(200, servo(LYING))) < 0.1 * fight


def test_sport_modes_commands_are_seen_on_the_wire(make_go2: Any) -> None:
    """While it is active its commands come over rt/lowcmd at 500 Hz, valid ones; if it hides, none."""
    bench = make_go2(sport="normal", start="standing")
    bench.run(100)
    assert bench.count(topics.LOW_COMMAND) == 50
    command = decode_low_command([p for t, p in bench.out if t == topics.LOW_COMMAND][-1])
    assert np.allclose(command.position, STANDING, atol=1e-6)
    hidden = make_go2(sport="normal", start="standing", sport_on_wire=False)
    hidden.run(100)
    assert hidden.count(topics.LOW_COMMAND) == 0
