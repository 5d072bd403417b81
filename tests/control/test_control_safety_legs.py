"""What the safety module checks on a robot with legs, on grids dense around each limit."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from deal_hw.control.safety.leg_checks import LegChecks, tilt
from deal_hw.control.safety.safety import CycleInput, Safety, SafetyDecision, SafetyState
from deal_hw.description import LegLimits, RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import SafetyError
from deal_hw.types import BodyState, FloatArray, JointCommand, RobotState, Status

MS = 1_000_000
T0 = 50_000_000_000
"""Host time at arming; the device's clock runs 7 s behind."""
BEHIND = 7_000_000_000
LEGS = LegLimits(
    effort=(10.0,), tilt=0.8, tumble=6.0, free_fall=3.0, free_fall_s=0.1, flail_velocity=(4.0, 5.0),
    flail_s=0.06, temperature=80.0, lost_rate=50.0, battery=0.3, battery_low=0.15, voltage=26.0,
    command_age_s=0.1, arm_voltage=27.0,
)  # fmt: skip


def robot(legs: LegLimits | None = LEGS) -> RobotDescription:
    """Return a leg of two joints; only the second is actuated, so that a wrong index shows."""
    limits = dataclasses.replace(
        DESCRIPTION.limits, legs=legs, trip_position=((-9.0, 9.0), (-9.0, 9.0)), trip_velocity=(60.0, 60.0),
        state_age_s=0.06,
    )  # fmt: skip
    return dataclasses.replace(
        DESCRIPTION, name="leg", joint_names=("hip", "knee"), actuated=("knee",),
        position_units=("rad", "rad"), limits=limits,
    )  # fmt: skip


def leaning(angle: float, turn: float = 0.0) -> FloatArray:
    """Return the orientation of a base that leans by an angle and is turned about the vertical."""
    lean = np.array([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0])
    c, s = math.cos(turn / 2), math.sin(turn / 2)
    w, x, y, z = lean
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])


def body(**changes: Any) -> BodyState:
    """Return the body of a robot that stands well, or not."""
    values: dict[str, Any] = {
        "orientation": leaning(0.0), "angular_velocity": np.zeros(3), "acceleration": np.array([0, 0, 9.81]),
        "foot_force": np.zeros(4), "temperature": np.array([30.0, 31.0]), "lost": np.array([7, 9]),
        "battery": 0.8, "voltage": 29.5, "current": 1.0, "sticks": np.zeros(4), "buttons": -1, **changes,
    }  # fmt: skip
    return BodyState(**values)


def state(
    now_ns: int = T0,
    sensed: BodyState | None = None,
    *,
    velocity: tuple[float, float] = (0.0, 0.0),
    position: tuple[float, float] = (0.0, 0.0),
    status: Status = Status.ARMED,
) -> RobotState:
    """Return a state received just now."""
    return RobotState(
        position=np.array(position),
        velocity=np.array(velocity),
        effort=np.zeros(2),
        receive_ns=now_ns,
        device_ns=now_ns - BEHIND,
        sequence=0,
        command_sequence=-1,
        command_age_ns=-1,
        status=status,
        body=body() if sensed is None else sensed,
    )


def cycle(now_ns: int = T0, sample: RobotState | None = None, **changes: Any) -> CycleInput:
    """Return the input of a cycle with a fresh state and a fresh command, unless others are given."""
    changes = {"command_age_ns": 2 * MS, **changes}
    return CycleInput(now_ns=now_ns, state=state(now_ns) if sample is None else sample, **changes)


def command(target: float = 0.0, **changes: float) -> JointCommand:
    """Return a soft command."""
    values = {
        "position_target": target, "velocity_target": 0.0, "stiffness": 20.0, "damping": 1.0, "effort": 0.0,
        "effort_limit": 4.0, "speed_limit": 1.0, **changes,
    }  # fmt: skip
    return JointCommand(**{name: np.array([value]) for name, value in values.items()})


@pytest.fixture
def safety() -> Safety:
    """A disarmed safety module."""
    return Safety(robot())


@pytest.fixture
def armed(safety: Safety) -> Safety:
    """An armed one, in its first cycle."""
    safety.arm(cycle())
    assert safety.step(cycle(), command()).send
    return safety


def step(safety: Safety, at_ms: float, sample: RobotState | None = None, **changes: Any) -> SafetyDecision:
    """Run a cycle some time after arming."""
    now = T0 + round(at_ms * MS)
    return safety.step(cycle(now, sample, **changes), command())


def sensed(at_ms: float, **changes: Any) -> RobotState:
    """Return the state of a body some time after arming."""
    return state(T0 + round(at_ms * MS), body(**changes))


def around(limit: float, far: float) -> list[float]:
    """Values dense around a limit and sparse elsewhere."""
    near = [limit + k * 10.0**-e for e in (6, 4, 2) for k in (-1, 1)]
    return [*near, limit, 0.0, 0.5 * limit, 2 * limit, far]


def both(at_ms: float, trips: bool, flag: str, sample: RobotState, **changes: Any) -> None:
    """Check one input armed and disarmed: the same flag, and a trip only while armed."""
    flags = (flag,) if trips else ()
    safety = Safety(robot())
    verdict = step(safety, at_ms, sample, **changes)
    assert (verdict.state, verdict.flags, verdict.send) == (SafetyState.DISARMED, flags, False)
    safety.arm(cycle())
    step(safety, 0.0)
    verdict = step(safety, at_ms, sample, **changes)
    assert verdict.flags == flags
    assert (verdict.state is SafetyState.PASSIVE) is trips
    assert verdict.send is not trips


# Each flag alone, with its words.

FAILURES: list[tuple[str, dict[str, Any], str]] = [
    (
        "orientation",
        {"orientation": np.array([1.02, 0.0, 0.0, 0.0])},
        "the orientation is no rotation: its quaternion has norm 1.020, not 1",
    ),
    ("tilt", {"orientation": leaning(0.9)}, "the base leans by 0.90 rad, at most 0.8 are allowed"),
    (
        "tumble",
        {"angular_velocity": np.array([0.0, -6.5, 0.0])},
        "the base turns at 6.50 rad/s, at most 6 are allowed",
    ),
    (
        "body_not_finite",
        {"angular_velocity": np.array([math.nan, 0.0, 0.0])},
        "the inertial sensor reports a value that is not finite",
    ),
    (
        "motor_temperature",
        {"temperature": np.array([30.0, 81.0])},
        "the motor of joint 'knee' is at 81 °C, at most 80 °C are allowed",
    ),
    (
        "motor_temperature",
        {"temperature": np.array([95.0, 85.0])},
        "the motor of joint 'hip' is at 95 °C, at most 80 °C are allowed",
    ),
    (
        "lost_commands",
        {"lost": np.array([7, 60])},
        "the motor of joint 'knee' missed 51 commands in 1 s, at most 50 are allowed",
    ),
    ("battery_low", {"battery": 0.14}, "the battery is at 14.0 %, at least 15 % are needed"),
    ("voltage_low", {"voltage": 25.9}, "the supply has 25.90 V, at least 26 V are needed"),
]


@pytest.mark.parametrize(("flag", "changes", "reason"), FAILURES)
def test_each_failure_alone_trips_with_its_reason_and_latches(
    armed: Safety, flag: str, changes: dict[str, Any], reason: str
) -> None:
    """One bad sample of the body is enough, and what is good again a cycle later stays passive."""
    verdict = step(armed, 20, sensed(20, **changes))
    assert (verdict.state, verdict.flags, verdict.reason) == (SafetyState.PASSIVE, (flag,), reason)
    assert (verdict.command, verdict.send) == (None, False)
    verdict = step(armed, 1100)
    assert (verdict.state, verdict.flags, verdict.reason) == (SafetyState.PASSIVE, (), reason)
    armed.rearm()
    armed.arm(cycle(T0 + 1120 * MS))
    assert step(armed, 1120).send


def test_a_robot_with_legs_that_reports_no_body_fails(armed: Safety) -> None:
    """Without orientation and battery nothing can be judged."""
    bare = dataclasses.replace(state(T0 + 20 * MS), body=None)
    verdict = step(armed, 20, bare)
    assert verdict.flags == ("body_missing",)
    assert verdict.reason == "the robot reports no state of its body: no orientation, no battery"
    with pytest.raises(SafetyError, match="reports no state of its body"):
        Safety(robot()).arm(cycle(sample=dataclasses.replace(state(), body=None)))


def test_robots_without_legs_know_none_of_it() -> None:
    """Neither a missing body nor a bad one nor unsent commands matter where the description has no legs."""
    safety = Safety(robot(None))
    safety.arm(cycle(sample=dataclasses.replace(state(), body=None)))
    bad = body(orientation=leaning(3.0), temperature=np.array([200.0, 200.0]), battery=0.0, voltage=0.0)
    assert step(safety, 0, state(T0, bad)).send
    assert step(safety, 900, state(T0 + 900 * MS, bad), command_age_ns=900 * MS).send
    assert step(safety, 901, dataclasses.replace(state(T0 + 901 * MS), body=None), command_age_ns=-1).send


# Body.


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, math.pi / 2, 3.0, math.pi])
@pytest.mark.parametrize("turn", [0.0, 1.0, -2.5])
@pytest.mark.parametrize("scale", [1.0, -1.0, 0.3])
def test_tilt_is_the_angle_to_the_vertical(angle: float, turn: float, scale: float) -> None:
    """Yaw, the quaternion's sign and its norm do not matter."""
    assert tilt(scale * leaning(angle, turn)) == pytest.approx(angle, abs=1e-12)


def test_tilt_counts_pitch_as_well_as_roll() -> None:
    """0.6 rad of pitch alone, and by hand: roll 0.6 and pitch 0.5 lean by acos(cos 0.6 cos 0.5)."""
    half = 0.3
    assert tilt(np.array([math.cos(half), 0.0, math.sin(half), 0.0])) == pytest.approx(0.6)
    w, x = math.cos(0.3), math.sin(0.3)
    c, s = math.cos(0.25), math.sin(0.25)
    both_ways = np.array([w * c, x * c, w * s, x * s])
    assert tilt(both_ways) == pytest.approx(math.acos(math.cos(0.6) * math.cos(0.5)))


@pytest.mark.parametrize("angle", [*around(0.8, 3.0), *(-a for a in around(0.8, 3.0))])
@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_leaning_trips_beyond_the_limit(angle: float, turn: float) -> None:
    """Up to 0.8 rad in any direction and no further."""
    if abs(angle) == 0.8:
        return  # cos and atan2 do not hit the limit itself to the last bit
    both(20, abs(angle) > 0.8, "tilt", sensed(20, orientation=leaning(angle, turn)))


def test_leaning_by_exactly_the_limit_passes() -> None:
    """The limit itself is allowed."""
    lean = leaning(0.7)
    legs = dataclasses.replace(LEGS, tilt=tilt(lean))
    assert LegChecks(robot(), legs).failures(sensed(0, orientation=lean)) == {}


def test_a_base_that_is_held_may_lean_anyhow() -> None:
    """An infinite limit of tilt never trips."""
    checks = LegChecks(robot(), dataclasses.replace(LEGS, tilt=math.inf))
    assert checks.failures(sensed(0, orientation=leaning(math.pi))) == {}


@pytest.mark.parametrize("norm", [0.0, 0.5, 0.98, 0.9899, 0.9901, 1.0, 1.0099, 1.0101, 1.02, 2.0])
def test_an_orientation_must_be_a_unit_quaternion(norm: float) -> None:
    """A hundredth is allowed; all zeros, as before the first fusion, are no orientation."""
    both(20, abs(norm - 1) > 0.01, "orientation", sensed(20, orientation=norm * leaning(0.2)))


def test_a_norm_off_by_exactly_the_tolerance_passes() -> None:
    """Norms 1.25 and 0.75 are exact in binary, and so is a tolerance of 0.25."""
    checks = LegChecks(robot(), LEGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("deal_hw.control.safety.leg_checks.UNIT_TOLERANCE", 0.25)
        for norm in (0.75, 1.25):
            assert checks.failures(sensed(0, orientation=np.array([norm, 0.0, 0.0, 0.0]))) == {}


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("speed", [*around(6.0, 30.0), *(-a for a in around(6.0, 30.0))])
def test_turning_trips_beyond_the_limit(axis: int, speed: float) -> None:
    """6 rad/s about any axis, in both directions."""
    turn = np.zeros(3)
    turn[axis] = speed
    both(20, abs(speed) > 6.0, "tumble", sensed(20, angular_velocity=turn))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["orientation", "angular_velocity", "acceleration"])
def test_a_body_that_is_not_finite_trips(field: str, bad: float) -> None:
    """NaN passes every comparison unnoticed, so it is looked for by itself; nothing else is reported then."""
    for index in range(3):
        values = np.array([0.5, 0.5, 0.5, 0.5]) if field == "orientation" else np.ones(3)
        values[index] = bad
        both(20, True, "body_not_finite", sensed(20, **{field: values}))


# Falls.


@pytest.mark.parametrize("force", around(3.0, 40.0))
def test_free_fall_counts_below_its_limit(force: float) -> None:
    """A tenth of a second below 3 m/s² is a fall; 3 m/s² itself is none. The direction does not matter."""
    checks = LegChecks(robot(), LEGS)
    felt = np.array([0.0, -force, 0.0])
    assert checks.failures(sensed(0, acceleration=felt)) == {}
    assert checks.failures(sensed(99.9, acceleration=felt)) == {}
    found = checks.failures(sensed(100, acceleration=felt))
    assert (tuple(found) == ("free_fall",)) is (force < 3.0)
    assert (found == {}) is (force >= 3.0)


def test_a_fall_trips_with_its_reason(armed: Safety) -> None:
    """Five samples of free fall, then the trip, in words."""
    felt = np.array([0.6, 0.0, 0.8])
    for at_ms in (20, 40, 60, 80, 100):
        assert step(armed, at_ms, sensed(at_ms, acceleration=felt)).send
    verdict = step(armed, 120, sensed(120, acceleration=felt))
    assert (verdict.state, verdict.flags) == (SafetyState.PASSIVE, ("free_fall",))
    assert verdict.reason == ("the robot falls: its specific force is below 3 m/s² for 0.1 s, now 1.00 m/s²")


def test_a_touch_ends_a_fall() -> None:
    """One sample of ground in between, and the time counts anew."""
    checks = LegChecks(robot(), LEGS)
    weightless = np.zeros(3)
    assert checks.failures(sensed(0, acceleration=weightless)) == {}
    assert checks.failures(sensed(90)) == {}
    assert checks.failures(sensed(100, acceleration=weightless)) == {}
    assert checks.failures(sensed(199, acceleration=weightless)) == {}
    assert tuple(checks.failures(sensed(200, acceleration=weightless))) == ("free_fall",)


def test_the_same_sample_again_is_no_longer_fall() -> None:
    """Time is the device's: a sample that is seen twice adds nothing."""
    checks = LegChecks(robot(), LEGS)
    first = sensed(0, acceleration=np.zeros(3))
    for _ in range(100):
        assert checks.failures(first) == {}


# Joints.


@pytest.mark.parametrize(("joint", "limit"), [(0, 4.0), (1, 5.0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_that_stays_fast_flails(joint: int, limit: float, sign: float) -> None:
    """Faster than its own limit for 0.06 s; the limit itself is not faster."""
    for speed in around(limit, 50.0):
        checks = LegChecks(robot(), LEGS)
        velocity = (sign * speed, 0.0) if joint == 0 else (0.0, sign * speed)
        flags = [tuple(checks.failures(state(T0 + at * MS, velocity=velocity))) for at in (0, 20, 40, 59, 60)]
        assert flags[:4] == [()] * 4
        assert flags[4] == (("flail",) if speed > limit else ())


def test_flailing_trips_with_its_reason(armed: Safety) -> None:
    """The joint that has been fast for longest is named."""
    assert step(armed, 20, state(T0 + 20 * MS, velocity=(0.0, -5.5))).send
    assert step(armed, 40, state(T0 + 40 * MS, velocity=(8.0, -5.5))).send
    verdict = step(armed, 80, state(T0 + 80 * MS, velocity=(8.0, -5.25)))
    assert (verdict.state, verdict.flags) == (SafetyState.PASSIVE, ("flail",))
    assert verdict.reason == "joint 'knee' flails: faster than 5 rad/s for 0.06 s, now -5.25 rad/s"


def test_joints_flail_each_for_itself() -> None:
    """Two joints that take turns do not flail together, and a slow sample starts the time anew."""
    checks = LegChecks(robot(), LEGS)
    for at, velocity in ((0, (9.0, 0.0)), (40, (0.0, 9.0)), (80, (9.0, 0.0)), (120, (0.0, 9.0))):
        assert checks.failures(state(T0 + at * MS, velocity=velocity)) == {}
    assert checks.failures(state(T0 + 179 * MS, velocity=(0.0, 9.0))) == {}
    assert tuple(checks.failures(state(T0 + 180 * MS, velocity=(0.0, 9.0)))) == ("flail",)


# Motors.


@pytest.mark.parametrize("hot", [*around(80.0, 150.0), -20.0, math.nan])
@pytest.mark.parametrize("joint", [0, 1])
def test_hot_motors_trip(hot: float, joint: int) -> None:
    """80 °C is allowed, and a motor that does not know its temperature is not."""
    temperature = np.array([30.0, 30.0])
    temperature[joint] = hot
    both(20, not hot <= 80.0, "motor_temperature", sensed(20, temperature=temperature))


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("count", [0, 1, 25, 49, 50, 51, 52, 500])
def test_lost_commands_trip_by_their_rate(joint: int, count: int) -> None:
    """50 in a second pass and 51 do not, whatever was lost before."""
    safety = Safety(robot())
    start = np.array([1000, 2000])
    after = start.copy()
    after[joint] += count
    safety.arm(cycle(sample=sensed(0, lost=start)))
    assert step(safety, 0, sensed(0, lost=start)).send
    verdict = step(safety, 1000, sensed(1000, lost=after))
    assert verdict.flags == (("lost_commands",) if count > 50 else ())


def test_lost_commands_of_longer_ago_do_not_count() -> None:
    """40 in each of three seconds pass; the window is a second long, its ends included."""
    checks = LegChecks(robot(), LEGS)
    lost = np.array([0, 0])
    for k in range(4):
        assert checks.failures(sensed(1001 * k, lost=lost + 40 * k)) == {}
    checks.reset()
    assert checks.failures(sensed(0, lost=lost)) == {}
    assert checks.failures(sensed(600, lost=lost + 30)) == {}
    # At 1000 ms the sample of 0 ms still counts: 51 in a second; a millisecond later it does not.
    assert tuple(checks.failures(sensed(1000, lost=lost + 51))) == ("lost_commands",)
    assert checks.failures(sensed(1001, lost=lost + 51)) == {}


def test_a_counter_that_starts_anew_forgets_nothing() -> None:
    """30 lost, a counter back at 0, and 21 more are 51; 20 more are 50."""
    for more in (20, 21):
        checks = LegChecks(robot(), LEGS)
        assert checks.failures(sensed(0, lost=np.array([100, 100]))) == {}
        assert checks.failures(sensed(20, lost=np.array([130, 100]))) == {}
        assert checks.failures(sensed(40, lost=np.array([0, 100]))) == {}
        assert bool(checks.failures(sensed(60, lost=np.array([more, 100])))) is (more == 21)


def test_the_driver_may_reuse_its_array_of_lost_commands() -> None:
    """What was seen is copied: an array that changes in place is no old sample."""
    checks = LegChecks(robot(), LEGS)
    lost = np.array([0, 0])
    assert checks.failures(sensed(0, lost=lost)) == {}
    lost += 51
    assert tuple(checks.failures(sensed(20, lost=lost))) == ("lost_commands",)


# Supply.


@pytest.mark.parametrize("charge", [*around(0.15, 1.0), 0.29, 0.3, math.nan])
def test_an_empty_battery_trips(charge: float) -> None:
    """15 % is enough to go on with; a robot that does not know its charge is judged by its voltage."""
    both(20, charge < 0.15, "battery_low", sensed(20, battery=charge))


@pytest.mark.parametrize("volts", [*around(26.0, 34.0), 26.9, math.nan])
def test_a_low_voltage_trips(volts: float) -> None:
    """26 V is enough to go on with; a voltage that is not known is not."""
    both(20, not volts >= 26.0, "voltage_low", sensed(20, voltage=volts))


@pytest.mark.parametrize("charge", [0.15, 0.2, 0.299999, 0.3, 0.300001, 1.0, math.nan])
def test_arming_asks_for_more_charge(charge: float) -> None:
    """30 % to arm."""
    safety = Safety(robot())
    if charge < 0.3:
        with pytest.raises(
            SafetyError, match=r"refusing to arm: the battery is at \d+\.\d %, at least 30 % are"
        ):
            safety.arm(cycle(sample=sensed(0, battery=charge)))
        assert safety.state is SafetyState.DISARMED
    else:
        safety.arm(cycle(sample=sensed(0, battery=charge)))
        assert safety.state.armed


@pytest.mark.parametrize("volts", [26.0, 26.5, 26.999999, 27.0, 27.000001, 30.0])
def test_arming_asks_for_more_voltage(volts: float) -> None:
    """27 V to arm."""
    safety = Safety(robot())
    if volts < 27.0:
        with pytest.raises(SafetyError) as refusal:
            safety.arm(cycle(sample=sensed(0, voltage=volts)))
        assert str(refusal.value) == (
            f"refusing to arm: the supply has {volts:.2f} V, at least 27 V are needed to arm"
        )
    else:
        safety.arm(cycle(sample=sensed(0, voltage=volts)))
        assert safety.state.armed


def test_without_a_voltage_for_arming_the_trip_voltage_holds() -> None:
    """0 means that arming asks for no more than running."""
    checks = LegChecks(robot(), dataclasses.replace(LEGS, arm_voltage=0.0))
    assert checks.failures(sensed(0, voltage=26.0), arming=True) == {}
    assert checks.failures(sensed(0, voltage=25.9), arming=True) == {
        "voltage_low": "the supply has 25.90 V, at least 26 V are needed to arm"
    }


# Commands must really go out.


@pytest.mark.parametrize(
    ("age_ms", "trips"), [(0, False), (2, False), (99.9, False), (100, False), (100.1, True), (5000, True)]
)
def test_commands_that_stay_away_trip(armed: Safety, age_ms: float, trips: bool) -> None:
    """A tenth of a second after the last command, and not before."""
    verdict = step(armed, 6000, command_age_ns=round(age_ms * MS))
    assert verdict.flags == (("command_stale",) if trips else ())
    assert (verdict.state is SafetyState.PASSIVE) is trips
    if trips:
        assert verdict.reason == f"no command was sent for {age_ms:.0f} ms, at most 100 ms are allowed"


@pytest.mark.parametrize("age_ms", [-1, 5000])
def test_commands_count_from_the_first_cycle_after_arming(safety: Safety, age_ms: int) -> None:
    """None yet, or one of an earlier run: the first cycle has a tenth of a second to send the first."""
    age_ns = age_ms * MS if age_ms > 0 else -1
    safety.arm(cycle(command_age_ns=age_ns))
    # Arming the robot itself took four seconds.
    for at_ms in (4000, 4020, 4100):
        assert step(safety, at_ms, command_age_ns=age_ns).send
    verdict = step(safety, 4100.1, command_age_ns=age_ns)
    assert verdict.flags == ("command_stale",)
    assert verdict.reason == "no command was sent for 100 ms, at most 100 ms are allowed"


def test_a_command_just_now_counts(armed: Safety) -> None:
    """An age of 0 is an age."""
    assert step(armed, 3000, command_age_ns=0).send


def test_nothing_needs_to_be_sent_while_disarmed(safety: Safety) -> None:
    """Before arming, and after a trip, silence is right."""
    assert step(safety, 900, command_age_ns=-1).flags == ()
    safety.arm(cycle(T0 + 1000 * MS))
    assert step(safety, 1000).send
    assert step(safety, 1020, stop_reason="enough").flags == ("operator_stop",)
    assert step(safety, 3000, command_age_ns=2000 * MS).flags == ()


# Arming a robot with legs takes seconds.


def test_easing_in_starts_where_the_first_cycle_finds_the_robot() -> None:
    """It sank from 0.1 to 0.2 rad while it was armed: a quarter of the way from 0.2 to 0.24 is 0.21."""
    description = robot()
    limits = dataclasses.replace(description.limits, ease_in_s=0.2)
    safety = Safety(dataclasses.replace(description, limits=limits))
    safety.arm(cycle(sample=state(position=(5.0, 0.1))))
    first = T0 + 4000 * MS
    verdict = safety.step(cycle(first, state(first, position=(5.0, 0.2))), command(0.24))
    assert (verdict.state, verdict.clipped) == (SafetyState.EASING_IN, ())
    assert verdict.command is not None
    assert verdict.command.position_target[0] == 0.2
    now = first + 50 * MS
    verdict = safety.step(cycle(now, state(now, position=(5.0, 0.22))), command(0.24))
    assert (verdict.state, verdict.clipped) == (SafetyState.EASING_IN, ())
    assert verdict.command is not None
    assert verdict.command.position_target[0] == pytest.approx(0.21)
    now = first + 200 * MS
    assert safety.step(cycle(now, state(now)), command(0.24)).state is SafetyState.ACTIVE


def test_the_step_limit_counts_from_the_first_cycle() -> None:
    """A step of 0.5 from where the robot is found, not from where it was when it was armed."""
    description = robot()
    limits = dataclasses.replace(description.limits, ease_in_s=0.0, target=((-2.0, 2.0),))
    safety = Safety(dataclasses.replace(description, limits=limits))
    safety.arm(cycle(sample=state(position=(0.0, -1.0))))
    verdict = safety.step(cycle(T0, state(position=(0.0, 1.0))), command(1.25))
    assert (verdict.clipped, verdict.send) == ((), True)
    assert verdict.command is not None
    assert verdict.command.position_target[0] == 1.25


def test_losing_all_states_in_the_first_cycle_trips(safety: Safety) -> None:
    """There is nothing to start from, and nothing is sent."""
    safety.arm(cycle())
    verdict = safety.step(CycleInput(now_ns=T0, state=None, command_age_ns=-1), command())
    assert (verdict.flags, verdict.send) == (("no_state",), False)


def test_arming_forgets_what_was_before() -> None:
    """Durations and counts of the disarmed time do not count: they start with the arming."""
    safety = Safety(robot())
    falling = {"acceleration": np.zeros(3)}
    assert step(safety, 0, sensed(0, **falling)).flags == ()
    fast = dataclasses.replace(sensed(40, lost=np.array([40, 0]), **falling), velocity=np.array([0.0, 9.0]))
    assert step(safety, 40, fast).flags == ()
    again = dataclasses.replace(sensed(90, lost=np.array([80, 0]), **falling), velocity=np.array([0.0, 9.0]))
    safety.arm(cycle(T0 + 90 * MS, again))
    more = dataclasses.replace(sensed(140, lost=np.array([120, 0]), **falling), velocity=np.array([0.0, 9.0]))
    assert step(safety, 140, more).flags == ()


# The filter sees the measured velocity of the right joint.


def test_the_armed_module_limits_the_predicted_effort(armed: Safety) -> None:
    """Braking of the knee from 20 rad/s with kd 1 would take 20 N·m; of the hip, which has no motor, none."""
    verdict = step(armed, 20, state(T0 + 20 * MS, velocity=(0.0, 20.0)))
    assert verdict.send
    assert verdict.clipped == ("predicted_effort", "gains")
    assert verdict.command is not None
    assert verdict.command.damping[0] == pytest.approx(0.5, rel=1e-8)
    verdict = step(armed, 40, state(T0 + 40 * MS, velocity=(20.0, 0.0)))
    assert (verdict.send, verdict.clipped) == (True, ())


def test_a_state_that_is_not_finite_gives_no_command_while_disarmed(safety: Safety) -> None:
    """There is no effort to predict from it."""
    verdict = step(safety, 0, state(velocity=(0.0, math.inf)))
    assert (verdict.command, verdict.flags) == (None, ("state_not_finite",))
