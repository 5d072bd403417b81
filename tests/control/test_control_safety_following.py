"""Does each joint follow? By hand-computed times, and by joints that are simulated in a few lines."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from deal_hw.control.safety.following import LOAD_S, FollowingWatch, Unfollowed
from deal_hw.control.safety.safety import CycleInput, Safety, SafetyState
from deal_hw.description import RobotDescription
from deal_hw.drivers.so101.description import DRIVEN
from deal_hw.types import FloatArray, JointCommand, RobotState, Status

MS = 1_000_000
PERIOD_S = 0.02
STIFFNESS, LIMIT = 20.0, 4.0
"""At 0.2 rad a drive pushes with its limit."""


def robot(
    units: tuple[str, ...] = ("rad", "rad"),
    limit: float = LIMIT,
    stiffness: float = STIFFNESS,
    **changes: Any,
) -> RobotDescription:
    """Return a robot whose joints a, b, ... all have a drive."""
    n = len(units)
    names = tuple("abcdef"[:n])
    free = (math.inf,) * n
    limits = dataclasses.replace(
        DRIVEN.limits,
        target=((-2.0, 2.0),) * n,
        target_step=free,
        target_distance=free,
        trip_position=((-math.inf, math.inf),) * n,
        trip_velocity=changes.pop("trip_velocity", (5.0,) * n),
        stiffness=free,
        damping=free,
        effort=free,
        speed=free,
        **changes.pop("limits", {}),
    )
    return dataclasses.replace(
        DRIVEN,
        name="test",
        joint_names=names,
        actuated=names,
        position_units=units,
        default_position=(0.0,) * n,
        stiffness=(stiffness,) * n,
        damping=(0.0,) * n,
        effort_limit=(limit,) * n,
        speed_limit=free,
        control_rate_hz=50.0,
        limits=limits,
        **changes,
    )


def command(*target: float, **changes: float) -> JointCommand:
    """Return a command with the robot's gains and limits, or others."""
    n = len(target)
    values = {
        "velocity_target": 0.0,
        "stiffness": STIFFNESS,
        "damping": 0.0,
        "effort": 0.0,
        "effort_limit": LIMIT,
        "speed_limit": math.inf,
        **changes,
    }
    arrays = {name: np.full(n, value) for name, value in values.items()}
    return JointCommand(position_target=np.array(target), **arrays)


Motion = Callable[[float], tuple[float, ...]]


def still(*at: float) -> Motion:
    """Return a motion that stands."""
    return lambda time_s: at


def play(
    watch: FollowingWatch,
    target: Motion,
    position: Motion,
    seconds: float = 3.0,
    velocity: Motion | None = None,
    period_s: float = PERIOD_S,
    **changes: float,
) -> tuple[float, Unfollowed] | None:
    """Step a watch through a motion that begins at time 0; return when and what it found."""
    for k in range(round(seconds / period_s) + 1):
        time_s = k * period_s
        at = np.array(position(time_s))
        speed = np.zeros(len(at)) if velocity is None else np.array(velocity(time_s))
        found = watch.step(round(time_s * 1e9), at, speed, command(*target(time_s), **changes))
        if found is not None:
            return round(time_s, 6), found
    return None


def after_start(first: float, *later: float) -> Motion:
    """Return set-points that are 0 at the first state and elsewhere from then on."""
    return lambda time_s: tuple(0.0 for _ in (first, *later)) if time_s == 0 else (first, *later)


# Pushes without motion.


def test_a_blocked_joint_at_its_limit_is_found_after_360_ms() -> None:
    """The push counts from its fourth state on, 60 ms after its first, and 15 periods of 20 ms are 0.3 s."""
    found = play(FollowingWatch(robot()), after_start(0.4, 0.0), still(0.0, 0.0))
    assert found is not None
    time_s, lost = found
    assert time_s == 0.36
    assert lost.joints == ("a",)
    assert "joint 'a' does not follow: its set-point is 0.40 rad away" in lost.reason
    assert "should push with 100% of its limit" in lost.reason
    # The last state before the push.
    assert lost.since_ns == 0


def test_half_a_push_takes_longer_since_it_becomes_the_usual_load() -> None:
    """0.1 rad are half of the limit; the load takes 2 % of the rest a state, so beyond it are 0.5 * 0.98^n.

    From the state n = 3 on, 0.02 s * 0.5 * (0.98^3 + ... + 0.98^n) is 0.3 s at n = 53: at the 54th state.
    """
    found = play(FollowingWatch(robot()), after_start(0.1, 0.0), still(0.0, 0.0))
    assert found is not None and found[0] == pytest.approx(54 * PERIOD_S)


def test_joints_that_stand_together_are_found_sooner() -> None:
    """As above with two joints: from n = 3 on, 2 * 0.02 s * 0.5 * 0.98^n add up to 0.45 s at n = 35."""
    found = play(FollowingWatch(robot()), after_start(0.1, -0.1), still(0.0, 0.0))
    assert found is not None and found[0] == pytest.approx(36 * PERIOD_S)
    assert found[1].joints == ("a", "b")


def test_a_joint_that_follows_clears_what_the_others_have_together() -> None:
    """The drives are on, so each joint is judged alone: as above, 54 states."""

    def stepped(time_s: float) -> tuple[float, ...]:
        return (*after_start(0.1, -0.1)(time_s), 0.3 * int(2 * time_s))

    def followed(time_s: float) -> tuple[float, ...]:
        step = int(2 * time_s)
        return 0.0, 0.0, max(0.3 * (step - 1) + min(1.5 * (time_s - step / 2), 0.3), 0.0)

    three = robot(units=("rad",) * 3, trip_velocity=(100.0,) * 3)
    found = play(FollowingWatch(three), stepped, followed)
    assert found is not None and found[0] == pytest.approx(54 * PERIOD_S)


def test_two_fifths_of_a_push_are_a_new_load() -> None:
    """0.4 * 0.98^n is below 0.15 from n = 49 on; until then 0.23 s have been counted."""
    watch = FollowingWatch(robot())
    assert play(watch, after_start(0.08, 0.0), still(0.0, 0.0), seconds=20) is None
    assert watch.worst == pytest.approx(0.02 * sum(0.4 * 0.98**n for n in range(3, 49)), rel=1e-6)


def test_a_leg_under_a_constant_load_follows() -> None:
    """It never reaches its set-point: 90 % of the drive's limit hold the load."""
    watch = FollowingWatch(robot())
    assert play(watch, still(0.18, -0.18), still(0.0, 0.0), seconds=20) is None
    assert watch.worst == 0.0


def test_a_drive_that_stays_at_its_limit_is_blocked() -> None:
    """At its limit a drive has nothing left for a load, however usual this is."""
    found = play(FollowingWatch(robot()), still(0.2, 0.0), still(0.0, 0.0))
    assert found is not None and found[0] == 0.36


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_at_its_limit_that_moves_follows(sign: float) -> None:
    """At 0.1 rad/s it moves 0.02 rad in 0.2 s, before 0.3 s are counted."""
    target, slow = still(sign * 2.0, 0.0), lambda time_s: (sign * 0.1 * time_s, 0.0)
    assert play(FollowingWatch(robot()), target, slow, seconds=10) is None


def test_a_joint_that_moves_away_does_not_follow() -> None:
    """A limp joint falls: its motion against the push is no motion with it."""
    found = play(FollowingWatch(robot()), still(0.3, 0.0), lambda time_s: (-0.3 * time_s, 0.0))
    assert found is not None and found[0] == 0.36


def test_a_joint_that_is_braked_follows() -> None:
    """It still moves against the push, slower and slower: it gains speed in the push's direction."""

    def fast(time_s: float) -> tuple[float, float]:
        return -2.0 + 1.5 * time_s, 0.0

    def braked(time_s: float) -> tuple[float, float]:
        return -2.0 * time_s + 0.75 * time_s**2, 0.0

    assert play(FollowingWatch(robot()), still(0.3, 0.0), braked, seconds=1.3, velocity=fast) is None


def test_a_push_that_changes_its_direction_counts_all_the_same() -> None:
    """A held joint whose set-point swings by 0.3 rad at 1 Hz is found within a second."""
    swing: Motion = lambda time_s: (0.3 * math.sin(2 * math.pi * time_s), 0.0)  # noqa: E731
    found = play(FollowingWatch(robot()), swing, still(0.0, 0.0))
    assert found is not None and found[0] < 1.0


def test_a_jitter_of_set_points_does_not_count() -> None:
    """A push of 40 ms in each direction ends before a command has acted."""
    jitter: Motion = lambda time_s: (0.4 * (-1) ** (round(time_s / PERIOD_S) // 2), 0.0)  # noqa: E731
    watch = FollowingWatch(robot())
    assert play(watch, jitter, still(0.0, 0.0), seconds=10) is None
    assert watch.worst == 0.0


def test_what_was_counted_is_forgotten_slowly_without_a_push() -> None:
    """0.2 s are counted; then nothing is asked for 5 s, which takes 0.1 s off; 0.2 s more trip."""
    watch = FollowingWatch(robot())

    def target(time_s: float) -> tuple[float, float]:
        pushed = 0.0 < time_s < 0.27 or time_s > 5.27
        return (0.4 if pushed else 0.0), 0.0

    found = play(watch, target, still(0.0, 0.0), seconds=8.0)
    assert found is not None
    # 10 periods were counted until 0.26 s: 0.2 s. 5 s later 0.1 s are left. 10 periods later there are 0.3 s.
    assert found[0] == pytest.approx(5.28 + 0.06 + 0.18, abs=0.021)


def test_a_weak_command_asks_for_little() -> None:
    """A commanded effort limit of 30 % is no push beyond it, however far the set-point."""
    target = after_start(1.0, 0.0)
    assert play(FollowingWatch(robot()), target, still(0.0, 0.0), seconds=10, effort_limit=1.2) is None


def test_without_stiffness_nothing_is_asked() -> None:
    """As in damping: no set-point counts, and no division by zero."""
    free = FollowingWatch(robot(limit=math.inf))
    target = after_start(1.0, 0.0)
    assert play(free, target, still(0.0, 0.0), stiffness=0.0, effort_limit=math.inf) is None


def test_an_effort_beside_the_set_point_counts() -> None:
    """A feed-forward effort at the limit pushes, too."""
    found = play(FollowingWatch(robot()), still(0.0, 0.0), still(0.0, 0.0), effort=LIMIT)
    assert found is not None and found[1].joints == ("a", "b")


def test_a_stiff_drive_needs_an_error_of_some_size() -> None:
    """With 100 times the stiffness the limit would be reached at 2 mrad; 30 mrad are still too little."""
    stiff = robot(stiffness=100 * STIFFNESS)
    for error, finds in ((0.029, False), (0.4, True)):
        target = after_start(error, 0.0)
        found = play(FollowingWatch(stiff), target, still(0.0, 0.0), stiffness=100 * STIFFNESS)
        assert (found is not None) is finds


def test_a_drive_with_an_unknown_limit_is_judged_by_its_error() -> None:
    """0.5 rad count as its limit: 0.6 rad are found after 0.36 s, 0.07 rad never."""
    unknown = robot(limit=math.inf)
    far = play(FollowingWatch(unknown), after_start(0.6, 0.0), still(0.0, 0.0), effort_limit=math.inf)
    near = play(FollowingWatch(unknown), after_start(0.07, 0.0), still(0.0, 0.0), effort_limit=math.inf)
    assert far is not None and far[0] == 0.36
    assert near is None


def test_the_set_point_moves_no_faster_than_its_generator() -> None:
    """A set-point of 2 rad at 0.5 rad/s is a joint's that moves at 0.5 rad/s: it is not behind."""
    watch = FollowingWatch(robot())
    target, slow = after_start(2.0, 0.0), lambda time_s: (0.5 * time_s, 0.0)
    assert play(watch, target, slow, seconds=3.9, speed_limit=0.5) is None
    assert watch.worst == 0.0


def test_a_gripper_may_hold_an_object() -> None:
    """A joint that may be blocked is not found by its push; the other one is."""
    gripper = robot(limits={"may_be_blocked": ("a",)})
    assert play(FollowingWatch(gripper), after_start(0.5, 0.0), still(0.0, 0.0)) is None
    found = play(FollowingWatch(gripper), after_start(0.5, 0.5), still(0.0, 0.0))
    assert found is not None and found[1].joints == ("b",)


def test_commands_of_effort_are_not_watched() -> None:
    """No set-point says where the joints are to be."""
    assert play(FollowingWatch(robot(actuation="motor")), after_start(1.0, 1.0), still(0.0, 0.0)) is None


def test_a_repeated_state_adds_nothing_and_a_pause_little() -> None:
    """The same state again counts no time; of a pause of 10 s only 0.1 s count, here twice."""
    watch, at, speed = FollowingWatch(robot()), np.zeros(2), np.zeros(2)
    watch.step(0, at, speed, command(0.0, 0.0))
    for _ in range(100):
        assert watch.step(20 * MS, at, speed, command(0.5, 0.0)) is None
    for k in (1, 2):
        assert watch.step(20 * MS + k * 10_000 * MS, at, speed, command(0.5, 0.0)) is None
    assert watch.worst == pytest.approx(0.2)


def test_after_a_reset_nothing_is_left() -> None:
    """A new run begins with nothing counted and a new load."""
    watch = FollowingWatch(robot())
    play(watch, after_start(0.4, 0.0), still(0.0, 0.0), seconds=0.3)
    assert watch.worst > 0.2
    watch.reset()
    assert watch.worst == 0.0
    found = play(watch, after_start(0.4, 0.0), still(0.0, 0.0))
    assert found is not None and found[0] == 0.36


# Readings that are another joint's, or turned, or jump.


def sines(time_s: float) -> tuple[float, float]:
    """Slow set-points of two joints, 0.5 rad."""
    return 0.5 * math.sin(1.5 * time_s), 0.5 * math.cos(1.5 * time_s)


def test_joints_that_follow_are_not_misread() -> None:
    """Both are 0.1 s late."""
    assert play(FollowingWatch(robot()), sines, lambda t: sines(t - 0.1), seconds=20) is None


def test_exchanged_readings_name_both_joints() -> None:
    """Each reading fits the other one's set-point."""
    found = play(FollowingWatch(robot(limit=100.0)), sines, lambda t: sines(t)[::-1], effort_limit=100.0)
    assert found is not None
    time_s, lost = found
    assert time_s < 1.5 and lost.joints == ("a", "b")
    assert "'a' does not follow: its reading fits the set-point of 'b'" in lost.reason


def test_exchanged_readings_of_a_pose_that_is_held_are_named() -> None:
    """A still set-point shows no motion that would fit, but each reading ends at the other one's place."""

    def exchanged(time_s: float) -> tuple[float, float]:
        part = min(time_s / 0.3, 1.0)
        return 0.9 - 1.2 * part, -0.3 + 1.2 * part

    found = play(FollowingWatch(robot()), still(0.9, -0.3), exchanged)
    assert found is not None and "is at the set-point of 'b'" in found[1].reason


def test_limp_joints_of_a_small_motion_are_not_called_exchanged() -> None:
    """Each reading is near the other one's set-point, but its own is near, too."""
    found = play(FollowingWatch(robot()), still(0.2, 0.0), still(0.0, 0.2))
    assert found is not None and "exchanged" not in found[1].reason


def test_joints_of_different_units_are_never_exchanged() -> None:
    """A slide's reading in metres is no hinge's."""
    slide = robot(units=("rad", "m"), limit=1e4)
    found = play(FollowingWatch(slide), sines, lambda t: sines(t)[::-1], effort_limit=1e4)
    assert found is None or "exchanged" not in found[1].reason


def test_a_turned_reading_is_named() -> None:
    """The reading is the set-point with the other sign."""

    def turned(time_s: float) -> tuple[float, float]:
        a, b = sines(time_s)
        return a, -b

    found = play(FollowingWatch(robot(limit=100.0)), sines, turned, effort_limit=100.0)
    assert found is not None and found[0] < 1.5
    assert found[1].joints == ("b",) and "with the other sign" in found[1].reason


def test_fast_motion_in_counterphase_is_no_turned_reading() -> None:
    """Above its resonance a joint moves against its set-point; only slow motion is judged."""
    fast: Motion = lambda t: (0.4 * math.sin(25.0 * t), 0.0)  # noqa: E731
    against: Motion = lambda t: (-0.3 * math.sin(25.0 * t), 0.0)  # noqa: E731
    found = play(FollowingWatch(robot(limit=1e4)), fast, against, effort_limit=1e4)
    assert found is None or "sign" not in found[1].reason


def test_a_weak_drive_may_be_elsewhere() -> None:
    """With a tenth of its limit a joint may stand where another one's set-point is."""
    weak = FollowingWatch(robot())
    assert play(weak, still(0.5, -0.5), still(-0.5, 0.5), seconds=10, effort_limit=0.1 * LIMIT) is None


def test_since_when_a_misread_joint_did_not_follow() -> None:
    """Since its last state near its set-point: the readings are exchanged at 1 s."""

    def seen(time_s: float) -> tuple[float, ...]:
        return sines(time_s) if time_s < 1.0 else sines(time_s)[::-1]

    slow = robot(limit=100.0, limits={})
    found = play(FollowingWatch(slow), sines, seen, effort_limit=100.0)
    assert found is not None
    assert 980 * MS <= found[1].since_ns <= 1000 * MS


def test_one_odd_reading_is_forgiven_and_two_are_a_jump() -> None:
    """0.3 rad in 20 ms are more than 0.04 rad and 1.25 times 5 rad/s; the second odd state trips."""

    def one(time_s: float) -> tuple[float, float]:
        return (0.3 if math.isclose(time_s, 0.5) else 0.0), 0.0

    def lasting(time_s: float) -> tuple[float, float]:
        return (0.3 if time_s >= 0.5 else 0.0), 0.0

    assert play(FollowingWatch(robot()), still(0.0, 0.0), one) is None
    found = play(FollowingWatch(robot()), still(0.0, 0.0), lasting)
    assert found is not None and found[0] == pytest.approx(0.52)
    assert found[1].joints == ("a",) and "the reading of joint 'a' jumped" in found[1].reason
    assert found[1].since_ns == pytest.approx(480 * MS, abs=1)


@pytest.mark.parametrize(("change", "finds"), [(0.164, False), (0.166, True)])
def test_the_size_of_a_jump(change: float, finds: bool) -> None:
    """0.04 rad and 1.25 * 5 rad/s * 20 ms are 0.165 rad."""
    found = play(FollowingWatch(robot()), still(0.0, 0.0), lambda t: (change if t > 1.0 else 0.0, 0.0))
    assert (found is not None and "jumped" in found[1].reason) is finds


def test_without_a_trip_speed_nothing_jumps() -> None:
    """Nobody says how fast the joint may be."""
    free = robot(limit=1e4)
    limits = dataclasses.replace(free.limits, trip_velocity=(math.inf, math.inf))
    watch = FollowingWatch(dataclasses.replace(free, limits=limits))
    target: Motion = lambda t: (1.0 if t > 1.0 else 0.0, 0.0)  # noqa: E731
    assert play(watch, target, target, effort_limit=1e4) is None


# Simulated joints.


@settings(max_examples=30)
@given(
    frequency=st.floats(5.0, 60.0),
    damping=st.floats(0.2, 2.0),
    friction=st.floats(0.0, 0.1),
    load=st.floats(-0.5, 0.5),
    swing_hz=st.floats(0.05, 1.5),
    size=st.floats(0.0, 0.6),
    weaker=st.floats(0.7, 1.4),
)
def test_a_sound_joint_never_trips(
    frequency: float,
    damping: float,
    friction: float,
    load: float,
    swing_hz: float,
    size: float,
    weaker: float,
) -> None:
    """A drive with another stiffness than its description's, friction, and a load that bends it.

    The joint is at most 0.2 s behind its set-point.
    """
    assume(2 * damping / frequency <= 0.2)
    inertia = STIFFNESS / frequency**2
    step_s, q, v = 2e-3, load * LIMIT / STIFFNESS, 0.0
    watch = FollowingWatch(robot(units=("rad",)))
    for k in range(2500):
        target = size * math.sin(2 * math.pi * swing_hz * k * step_s)
        if k % 10 == 0:
            found = watch.step(2 * k * MS, np.array([q]), np.array([v]), command(target))
            assert found is None, found
        push = weaker * STIFFNESS * (target - q) - 2 * damping * weaker * STIFFNESS / frequency * v
        push = min(max(push, -LIMIT), LIMIT) + load * LIMIT * weaker
        v += (push - friction * LIMIT * math.tanh(v / 1e-3)) / inertia * step_s
        v *= 1.0 / (1.0 + friction * LIMIT / inertia * step_s / (1e-3 + abs(v))) if abs(v) < 1e-3 else 1.0
        q += v * step_s


@settings(max_examples=30)
@given(swing_hz=st.floats(0.1, 1.0), size=st.floats(0.15, 0.8), at_s=st.floats(0.5, 2.0))
def test_a_joint_that_stops_is_found_before_its_set_point_has_swung_back(
    swing_hz: float, size: float, at_s: float
) -> None:
    """Blocked, limp at rest, or with a reading that stands still: within 0.4 s and one and a half swings."""

    def target(time_s: float) -> tuple[float]:
        return (size * math.sin(2 * math.pi * swing_hz * time_s),)

    found = play(
        FollowingWatch(robot(units=("rad",))), target, lambda t: target(min(t, at_s)), seconds=at_s + 20.0
    )
    assert found is not None
    assert at_s < found[0] < at_s + 0.4 + 1.5 / swing_hz


def test_the_time_constant_of_the_load_is_a_second() -> None:
    """After it the load has taken 63 % of a push; the docs name it."""
    watch: Any = FollowingWatch(robot())
    play(watch, after_start(0.02, 0.0), still(0.0, 0.0), seconds=LOAD_S)
    assert watch._load[0] == pytest.approx(0.1 * (1 - math.exp(-1)), rel=0.03)


# In the safety module.


def state(now_ns: int, position: FloatArray) -> RobotState:
    """Return a state received and sensed now."""
    return RobotState(
        position=position,
        velocity=np.zeros(len(position)),
        effort=np.zeros(len(position)),
        receive_ns=now_ns,
        device_ns=now_ns,
        sequence=0,
        command_sequence=-1,
        command_age_ns=-1,
        status=Status.ARMED,
    )


def test_the_safety_module_trips_and_says_since_when() -> None:
    """Latched as every trip; the decision names the joints, once."""
    safety = Safety(robot())
    at = np.zeros(2)
    safety.arm(CycleInput(now_ns=0, state=state(0, at)))
    decisions = []
    for k in range(1, 200):
        now_ns = k * 20 * MS
        decisions.append(safety.step(CycleInput(now_ns=now_ns, state=state(now_ns, at)), command(0.5, 0.0)))
    tripped = next(one for one in decisions if one.state is SafetyState.PASSIVE)
    assert tripped.flags == ("not_following",) and tripped.command is None
    assert tripped.unfollowed is not None and tripped.unfollowed.joints == ("a",)
    assert "joint 'a' does not follow" in tripped.reason
    assert decisions[-1].state is SafetyState.PASSIVE and decisions[-1].unfollowed is None


def test_the_safety_module_watches_only_what_it_sends() -> None:
    """Disarmed, nothing is asked of the joints; a state with NaN trips as such."""
    safety = Safety(robot())
    for k in range(1, 200):
        now_ns = k * 20 * MS
        cycle = CycleInput(now_ns=now_ns, state=state(now_ns, np.zeros(2)))
        assert safety.step(cycle, command(1.0, 1.0)).flags == ()
    safety.arm(CycleInput(now_ns=10**10, state=state(10**10, np.zeros(2))))
    safety.step(CycleInput(now_ns=10**10, state=state(10**10, np.zeros(2))), command(1.0, 1.0))
    bad = np.array([math.nan, 0.0])
    now_ns = 10**10 + 20 * MS
    decision = safety.step(CycleInput(now_ns=now_ns, state=state(now_ns, bad)), command(1.0, 1.0))
    assert decision.flags == ("state_not_finite",)


def test_a_joint_that_is_pushed_to_both_sides_and_stands_is_found_at_once() -> None:
    """0.08 rad to either side, as a small, quick motion passes a limp joint: no push lasts.

    0.3 s of 40 % are 38 % when smoothed. Then -40 % lead to -30 % after 0.1 s * ln(0.78 / 0.1) = 0.21 s.
    """
    watch = FollowingWatch(robot())

    def target(time_s: float) -> tuple[float, float]:
        return (0.08 if time_s <= 0.3 else -0.08) if time_s > 0 else 0.0, 0.0

    found = play(watch, target, still(0.0, 0.0))
    assert found is not None and found[0] == pytest.approx(0.51, abs=0.021)
    assert found[1].joints == ("a",)
    assert watch.worst < 0.3


def test_a_joint_that_is_pushed_to_one_side_only_may_stand() -> None:
    """From 0 to 40 % and back, again and again: a load, or friction, may take it."""
    watch = FollowingWatch(robot())

    def target(time_s: float) -> tuple[float, float]:
        return 0.08 if time_s % 1.0 < 0.3 else 0.0, 0.0

    assert play(watch, target, still(0.0, 0.0), seconds=2.0) is None


def test_a_joint_that_moves_a_little_between_two_pushes_follows() -> None:
    """6 mrad are more than a reading's noise."""
    creep: Motion = lambda t: (0.006 * round(2 * t), 0.0)  # noqa: E731

    def target(time_s: float) -> tuple[float, float]:
        return creep(time_s)[0] + (0.11 if time_s % 1.0 < 0.5 else -0.11), 0.0

    found = play(FollowingWatch(robot(limits={"may_be_blocked": ("a", "b")})), target, creep)
    assert found is None
