"""What goes wrong with the emulated Go2 on request, in virtual time."""

from __future__ import annotations

import dataclasses
import itertools
import json
from typing import Any

import numpy as np
import pytest

from deal_hw.drivers.go2.descriptions.floor import JOINTS
from deal_hw.drivers.go2.emulator.faults import MOMENTS, FaultPlan
from deal_hw.drivers.go2.emulator.remote_script import RemoteMoment
from deal_hw.drivers.go2.emulator.sport_controller import LYING, STANDING
from deal_hw.drivers.go2.messages.low_command import LowCommand
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.remote import Remote, button_mask, decode_remote, decode_wireless
from deal_hw.types import FloatArray

ZERO = np.zeros(12)
CALF = JOINTS.index("FL_calf_joint")


def servo(position: FloatArray, stiffness: float = 60.0, damping: float = 5.0) -> LowCommand:
    """Return a command to hold a pose, with the gains of the SDK's example."""
    return LowCommand(position, ZERO, np.full(12, stiffness), np.full(12, damping), ZERO)


DAMP = servo(ZERO, 0.0, 3.0)
OFF = dataclasses.replace(DAMP, mode=np.zeros(12, np.int64))


def faulty(make_go2: Any, name: str, **options: Any) -> Any:
    """Return a bench whose robot stands, 100 ms after a fault began under stiff commands."""
    plan = FaultPlan(**{f"{name}_after_s": 0.1, **options})
    bench = make_go2(start="standing", plan=plan)
    bench.run(100, servo(STANDING))
    assert not bench.device.log.faults
    bench.run(100, servo(STANDING))
    assert [fault.name for fault in bench.device.log.faults] == [name]
    assert bench.device.log.faults[0].begin_ms == 100
    return bench


def test_freeze_says_nothing_and_still_hears(make_go2: Any) -> None:
    """A frozen robot sends nothing, not even answers, and takes the damping command."""
    bench = faulty(make_go2, "freeze")
    assert bench.out == []
    assert bench.call("motion_switcher", 1001) is None
    bench.run(10, DAMP)
    assert bench.device.log.faults[0].first_damping_ms == 201


def test_a_cut_is_silent_both_ways_and_ends(make_go2: Any) -> None:
    """For 0.3 s nothing goes out or is received, and the motors hold their last command; then all is well."""
    bench = faulty(make_go2, "cut", cut_s=0.3)
    assert bench.out == []
    bench.run(150, DAMP)
    log = bench.device.log
    assert bench.out == [] and log.to_json()["last_kind"] == "stiff"
    assert bench.device.base_height > 0.25
    bench.run(100, DAMP)
    assert log.faults[0].first_damping_ms in range(400, 404)
    assert len([topic for topic, _ in bench.out if topic == topics.LOW_STATE]) in range(23, 27)


def test_requests_are_noted(make_go2: Any) -> None:
    """What a service is asked stands in the log with its moment, for whoever must know that nobody asked."""
    bench = make_go2(start="standing")
    assert bench.device.report()["commands"]["requests"] == []
    bench.call("motion_switcher", 1001)
    (request,) = bench.device.report()["commands"]["requests"]
    assert request[2] == "motion_switcher"


def test_stale_repeats_the_same_bytes(make_go2: Any) -> None:
    """The same state comes 500 times a second; the robot itself goes on."""
    bench = faulty(make_go2, "stale")
    payloads = [payload for topic, payload in bench.out if topic == topics.LOW_STATE]
    assert len(payloads) == 50
    assert len(set(payloads)) == 1
    bench.run(600, OFF)
    assert bench.device.base_height < 0.15


def test_a_lost_motor_gives_nothing_and_counts(make_go2: Any) -> None:
    """Its effort is 0, its counter grows by one a state, the others work."""
    bench = faulty(make_go2, "lost", lost_joint="RR_thigh_joint")
    lost = JOINTS.index("RR_thigh_joint")
    states = bench.states()
    assert states[-1].lost[lost] - states[0].lost[lost] == len(states) - 1
    assert np.count_nonzero(states[-1].lost) == 1
    assert states[-1].effort[lost] == 0.0
    assert np.count_nonzero(states[-1].effort) == 11


def test_sport_mode_returns(make_go2: Any) -> None:
    """CheckMode names it again, its commands are on the wire, and it fights damping."""
    bench = faulty(make_go2, "sport")
    assert bench.device.sport_name == "normal"
    assert bench.count(topics.LOW_COMMAND) > 0
    bench.run(500, DAMP)
    assert bench.device.base_height > 0.2


def test_low_battery_nan_and_heat_are_reported(make_go2: Any) -> None:
    """4 % and a lower voltage; NaN in one joint alone; 95 °C in one motor alone."""
    state = faulty(make_go2, "battery").states()[-1]
    assert state.battery_percent <= 4
    assert state.voltage < 27.0
    state = faulty(make_go2, "nan").states()[-1]
    assert np.flatnonzero(np.isnan(state.position)).tolist() == [CALF]
    assert np.flatnonzero(np.isnan(state.velocity)).tolist() == [CALF]
    state = faulty(make_go2, "hot").states()[-1]
    assert np.flatnonzero(state.temperature == 95).tolist() == [CALF]


def test_the_operator_stops(make_go2: Any) -> None:
    """L2 and B are held in the state's 40 bytes and in WirelessController."""
    bench = faulty(make_go2, "stop")
    mask = button_mask(["L2", "B"])
    remote = decode_remote(bench.states()[-1].remote)
    assert remote is not None
    assert remote.holds(mask)
    assert decode_wireless([p for t, p in bench.out if t == topics.WIRELESS][-1]).holds(mask)


def test_a_push_moves_the_base(make_go2: Any) -> None:
    """25 N·s to the left in 0.1 s throw 15 kg at about 1.6 m/s: 80 mm by then, less what the legs resist."""
    bench = faulty(make_go2, "push")
    assert 0.02 < bench.device.base_position[1] < 0.085


def test_shares_of_states(make_go2: Any) -> None:
    """A tenth of 1000 states each: lost, doubled, late and corrupt ones come in about that number."""
    plan = FaultPlan(drop=0.1, duplicate=0.1, reorder=0.1, corrupt=0.1)
    bench = make_go2(plan=plan, on_stand=True)
    bench.out = [message for _ in range(2000) for message in bench.device.tick()]
    counts = bench.device.report()["wire_faults"]
    assert all(60 < count < 140 for count in counts.values())
    assert bench.count(topics.LOW_STATE) == pytest.approx(1000 - counts["drop"] + counts["duplicate"], abs=15)
    ticks = [int.from_bytes(p[1100:1104], "little") for t, p in bench.out if t == topics.LOW_STATE]
    assert sum(1 for a, b in itertools.pairwise(ticks) if b < a) > 30


def test_shares_can_begin_later(make_go2: Any) -> None:
    """With wire_after_s every state comes until then and none after."""
    bench = make_go2(start="standing", plan=FaultPlan(drop=1.0, wire_after_s=0.1))
    assert len(bench.run(100, servo(STANDING))) == 50
    assert bench.run(100, servo(STANDING)) == []


def test_the_log_gives_the_time_to_damping(make_go2: Any) -> None:
    """Fault at 100 ms, last stiff command at 118, damping from 120 ms on: 20 ms."""
    bench = make_go2(start="standing", plan=FaultPlan(hot_after_s=0.1))
    bench.run(120, servo(STANDING))
    bench.run(50, DAMP)
    log = bench.device.report()["commands"]
    (fault,) = log["faults"]
    assert (fault["begin_ms"], fault["last_stiff_ms"], fault["first_damping_ms"]) == (100, 118, 120)
    assert [(at, kind) for at, _, kind in log["changes"]] == [(0, "stiff"), (120, "damping")]
    assert log["largest_gap_ms"] == 2
    assert json.loads(json.dumps(bench.device.report()))["commands"]["last_kind"] == "damping"


def test_faults_wait_for_the_first_stiff_command(make_go2: Any) -> None:
    """Damping does not start the clock of a plan."""
    bench = make_go2(plan=FaultPlan(hot_after_s=0.0))
    bench.run(50, DAMP)
    assert not bench.device.log.faults
    bench.run(2, servo(LYING))
    assert [fault.name for fault in bench.device.log.faults] == ["hot"]


@pytest.mark.parametrize("name", MOMENTS)
def test_each_fault_begins_at_once_when_asked(make_go2: Any, name: str) -> None:
    """A test may begin any fault itself."""
    bench = make_go2(on_stand=True)
    bench.device.begin_fault(name)
    bench.device.tick()
    assert bench.device.log.faults[0].name == name


def test_an_unknown_fault_is_refused(make_go2: Any) -> None:
    """A name that is no fault is an error."""
    with pytest.raises(ValueError, match="no such fault: 'rain'"):
        make_go2(on_stand=True).device.begin_fault("rain")


def test_the_remote_follows_its_script(make_go2: Any) -> None:
    """A stick moves at 20 ms, the remote goes out of reach at 40 ms; without one the bytes are zeros."""
    script = (RemoteMoment(20, Remote(left_y=0.5)), RemoteMoment(40, None))
    states = make_go2(on_stand=True, remote=script).run(60)
    seen = [decode_remote(state.remote) for state in states]
    assert seen[5] == Remote()
    assert seen[15] == Remote(left_y=0.5)
    assert seen[25] is None
    assert make_go2(on_stand=True, remote=None).run(2)[-1].remote == bytes(40)
