"""The safety module to the nanosecond and to the letter, where the other tests are coarser."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from deal_hw.control.safety.filter import SafetyFilter, keep_effort
from deal_hw.control.safety.leg_checks import LegChecks
from deal_hw.control.safety.machine import SAFETY_FLAGS, in_order
from deal_hw.control.safety.safety import CycleInput, Safety, SafetyConfig, SafetyState
from deal_hw.description import LegLimits, RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import SafetyError
from deal_hw.types import BodyState, JointCommand, RobotState, Status

MS = 1_000_000
S = 1_000_000_000
ARMED = Status.ARMED | Status.HOMED
T0 = 50 * S
LEGS = LegLimits(
    effort=(10.0,),
    tilt=0.8,
    tumble=6.0,
    free_fall=3.0,
    free_fall_s=2.0,
    flail_velocity=(4.0, 5.0),
    flail_s=2.0,
    temperature=80.0,
    lost_rate=50.0,
    battery=0.3,
    battery_low=0.15,
    voltage=26.0,
    command_age_s=2.0,
)


def robot(**limits: Any) -> RobotDescription:
    """Return the cart-pole with other limits."""
    return dataclasses.replace(DESCRIPTION, limits=dataclasses.replace(DESCRIPTION.limits, **limits))


def state(
    now_ns: int = T0,
    *,
    cart: float = 0.0,
    cart_speed: float = 0.0,
    status: Status = ARMED,
    lag_ns: int = 0,
    body: BodyState | None = None,
) -> RobotState:
    """Return a state received just now, sent ``lag_ns`` earlier than usual by a clock that is 7 s behind."""
    return RobotState(
        position=np.array([cart, 0.0]),
        velocity=np.array([cart_speed, 0.0]),
        effort=np.zeros(2),
        receive_ns=now_ns,
        device_ns=now_ns - 7 * S - lag_ns,
        sequence=0,
        command_sequence=-1,
        command_age_ns=-1,
        status=status,
        body=body,
    )


def body(**changes: Any) -> BodyState:
    """Return the body of a robot that stands well, or not."""
    values: dict[str, Any] = {
        "orientation": np.array([1.0, 0, 0, 0]),
        "angular_velocity": np.zeros(3),
        "acceleration": np.array([0, 0, 9.81]),
        "foot_force": np.zeros(4),
        "temperature": np.full(2, 30.0),
        "lost": np.zeros(2, dtype=np.int64),
        "battery": 0.8,
        "voltage": 29.5,
        "current": 1.0,
        "sticks": np.zeros(4),
        "buttons": -1,
        **changes,
    }
    return BodyState(**values)


def command(target: float = 0.0, **changes: float) -> JointCommand:
    """Return a command with the description's gains, or others."""
    values = {
        "position_target": target,
        "velocity_target": 0.0,
        "stiffness": 80.0,
        "damping": 8.0,
        "effort": 0.0,
        "effort_limit": 4.0,
        "speed_limit": 1.0,
        **changes,
    }
    return JointCommand(**{name: np.array([value]) for name, value in values.items()})


def cycle(now_ns: int = T0, sample: RobotState | None = None, **changes: Any) -> CycleInput:
    """Return the input of a cycle with a fresh state, unless another is given."""
    return CycleInput(now_ns=now_ns, state=state(now_ns) if sample is None else sample, **changes)


def armed_with(description: RobotDescription, config: SafetyConfig | None = None) -> Safety:
    """Return an armed module after its first cycle."""
    safety = Safety(description, config)
    sample = None if description.limits.legs is None else state(body=body())
    safety.arm(cycle(sample=sample))
    assert safety.step(cycle(sample=sample), command()).send
    return safety


# To the letter.


@pytest.mark.parametrize(
    ("changes", "flag", "reason"),
    [
        ({"stop_reason": "enough"}, "operator_stop", "enough"),
        ({"state": None}, "no_state", "no state sample has arrived"),
        ({"fault": "somebody else commands"}, "device_fault", "somebody else commands"),
        (
            {"fault": "CRC wrong", "state": state(T0 + 20 * MS, status=ARMED | Status.FAULT)},
            "device_fault",
            "CRC wrong",
        ),
        (
            {"state": state(T0 - 41 * MS)},
            "state_stale",
            "the newest state is 61 ms old, at most 60 ms are allowed",
        ),
        (
            {"state": state(T0 + 20 * MS, lag_ns=-2 * S)},
            "clock_jump",
            "the device's clock jumped ahead by 2.000 s",
        ),
        (
            {"state": state(T0 + 20 * MS, status=ARMED | Status.FAULT)},
            "device_fault",
            "the device reports a fault",
        ),
        (
            {"state": state(T0 + 20 * MS, status=ARMED | Status.WATCHDOG)},
            "device_watchdog",
            "the device's watchdog stopped its motors because no commands came",
        ),
        (
            {"state": state(T0 + 20 * MS, status=Status.HOMED)},
            "device_disarmed",
            "the device disarmed itself",
        ),
        (
            {"state": state(T0 + 20 * MS, cart=-0.5)},
            "position",
            "joint 'cart' is at -0.500 m, outside -0.38..0.38",
        ),
        (
            {"state": state(T0 + 20 * MS, cart_speed=-6.5)},
            "velocity",
            "joint 'cart' moves at -6.50 m/s, faster than 6",
        ),
        (
            {"state": state(T0 + 20 * MS, cart=math.nan)},
            "state_not_finite",
            "the robot reports a state that is not finite",
        ),
        ({"action_age_ns": 41 * MS}, "action_late", "the policy took 41.0 ms, at most 40 ms are allowed"),
        (
            {"transport_errors": 61},
            "transport_errors",
            "61 transport errors in 1 s, at most 60 are allowed",
        ),
    ],
)
def test_each_flag_alone_trips_with_its_reason(changes: dict[str, Any], flag: str, reason: str) -> None:
    """What the operator reads, whole; disarmed, the same flag is raised and nothing trips."""
    safety = armed_with(DESCRIPTION)
    assert safety.reason == ""
    made = {"now_ns": T0 + 20 * MS, "state": state(T0 + 20 * MS), **changes}
    verdict = safety.step(CycleInput(**made), command())
    assert (verdict.state, verdict.flags, verdict.reason) == (SafetyState.PASSIVE, (flag,), reason)
    assert (verdict.command, verdict.clipped, verdict.send) == (None, (), False)
    assert safety.reason == reason


def test_a_command_that_is_not_finite_has_its_reason() -> None:
    """The policy is to blame, and the operator reads so."""
    verdict = armed_with(DESCRIPTION).step(cycle(), command(math.nan))
    assert verdict.reason == "the policy asked for a command that is not finite"
    assert verdict.clipped == ()


def test_all_reasons_are_given_in_the_order_of_the_flags() -> None:
    """Both of a trip, and both of a refusal to arm."""
    bad = state(T0, cart=0.5, cart_speed=7.0)
    both = "joint 'cart' is at 0.500 m, outside -0.38..0.38; joint 'cart' moves at 7.00 m/s, faster than 6"
    safety = Safety(DESCRIPTION)
    assert safety.reason == ""
    with pytest.raises(SafetyError) as refusal:
        safety.arm(cycle(sample=bad))
    assert str(refusal.value) == f"refusing to arm: {both}"
    assert armed_with(DESCRIPTION).step(cycle(sample=bad), command()).reason == both


def test_reasons_are_listed_in_one_order_whatever_was_found_first() -> None:
    """An unknown name is a programming error."""
    assert in_order(()) == ()
    assert in_order([*SAFETY_FLAGS][::-1]) == tuple(SAFETY_FLAGS)
    with pytest.raises(KeyError):
        in_order(["position", "nothing"])


def test_states_have_the_names_that_recordings_carry() -> None:
    """Readers of old recordings know these words."""
    assert [state.value for state in SafetyState] == ["disarmed", "easing in", "active", "passive"]


def test_nothing_is_sent_where_nothing_is_asked() -> None:
    """Armed, and the behaviour has no command yet: that is no failure, and nothing to send."""
    verdict = armed_with(DESCRIPTION).step(cycle(), None)
    assert (verdict.state.armed, verdict.command, verdict.send, verdict.flags) == (True, None, False, ())


def test_a_loop_that_does_not_say_when_it_sent_has_not_sent() -> None:
    """The age of the last command must be given."""
    now = T0 + 3 * S
    verdict = armed_with(robot(legs=LEGS)).step(cycle(now, state(now, body=body())), command())
    assert verdict.flags == ("command_stale",)


# To the nanosecond: limits of 2 s, for which a rounded factor shows.


@pytest.mark.parametrize("late", [False, True])
def test_state_age_to_the_nanosecond(late: bool) -> None:
    """2 s are allowed, 2 s and 1 ns are not."""
    verdict = armed_with(robot(state_age_s=2.0)).step(cycle(T0 + 2 * S + late, state(T0)), command())
    assert verdict.flags == (("state_stale",) if late else ())


@pytest.mark.parametrize("late", [False, True])
def test_action_age_to_the_nanosecond(late: bool) -> None:
    """2 s are allowed, 2 s and 1 ns are not."""
    verdict = armed_with(robot(action_age_s=2.0)).step(cycle(action_age_ns=2 * S + late), command())
    assert verdict.flags == (("action_late",) if late else ())


@pytest.mark.parametrize("late", [False, True])
def test_clock_jump_to_the_nanosecond(late: bool) -> None:
    """A jump of 2 s is let pass, one of 2 s and 1 ns is not."""
    safety = armed_with(DESCRIPTION, SafetyConfig(clock_jump_s=2.0))
    verdict = safety.step(cycle(sample=state(lag_ns=-2 * S - late)), command())
    assert verdict.flags == (("clock_jump",) if late else ())


def test_a_jump_of_exactly_the_default_passes() -> None:
    """0.1 s, and 1 ns more."""
    for late in (False, True):
        verdict = armed_with(DESCRIPTION).step(cycle(sample=state(lag_ns=-100 * MS - late)), command())
        assert verdict.flags == (("clock_jump",) if late else ())


@pytest.mark.parametrize("late", [False, True])
def test_confirmation_to_the_nanosecond(late: bool) -> None:
    """A device that never confirms trips at 2 s, and not 1 ns before."""
    old = Status.HOMED
    safety = Safety(DESCRIPTION, SafetyConfig(confirm_s=2.0))
    safety.arm(cycle(sample=state(status=old)))
    now = T0 + 2 * S - 1 + late
    verdict = safety.step(cycle(now, state(now, status=old)), command())
    assert verdict.flags == (("device_disarmed",) if late else ())


@pytest.mark.parametrize("status", [Status.HOMED, ARMED | Status.WATCHDOG])
def test_half_a_confirmation_is_none(status: Status) -> None:
    """Not armed without a watchdog's bit, or armed with one: an old sample either way, and forgiven."""
    safety = Safety(DESCRIPTION)
    safety.arm(cycle(sample=state(status=status)))
    for at_ms in (20, 40):
        assert safety.step(cycle(T0 + at_ms * MS, state(T0 + at_ms * MS, status=status)), command()).send


@pytest.mark.parametrize("late", [False, True])
def test_easing_in_to_the_nanosecond(late: bool) -> None:
    """ACTIVE at 2 s, and not 1 ns before."""
    safety = Safety(robot(ease_in_s=2.0))
    safety.arm(cycle())
    now = T0 + 2 * S - 1 + late
    expected = SafetyState.ACTIVE if late else SafetyState.EASING_IN
    assert safety.step(cycle(now), command()).state is expected


@pytest.mark.parametrize("late", [False, True])
def test_the_window_of_transport_errors_to_the_nanosecond(late: bool) -> None:
    """0.3 x 200/s x 2 s = 120 are allowed in 2 s; the 121st counts until the first is older than 2 s."""
    safety = armed_with(DESCRIPTION, SafetyConfig(transport_error_window_s=2.0))
    assert safety.step(cycle(T0 + S, transport_errors=120), command()).send
    now = T0 + 2 * S + late
    verdict = safety.step(cycle(now, transport_errors=121), command())
    assert verdict.flags == (() if late else ("transport_errors",))


def test_faster_drift_than_any_clocks_becomes_age() -> None:
    """1 ms a second is no drift: 5e-4 of it is forgiven, and 121 s later the rest is more than 60 ms."""
    safety = armed_with(DESCRIPTION)
    for k in range(1, 122):
        now = T0 + k * S
        verdict = safety.step(cycle(now, state(now, lag_ns=k * MS)), command())
        assert verdict.send is (k < 121)
    assert verdict.flags == ("state_stale",)


@pytest.mark.parametrize("late", [False, True])
def test_command_age_to_the_nanosecond(late: bool) -> None:
    """2 s without a command are allowed, 2 s and 1 ns are not."""
    safety = armed_with(robot(legs=LEGS))
    now = T0 + 3 * S
    verdict = safety.step(cycle(now, state(now, body=body()), command_age_ns=2 * S + late), command())
    assert verdict.flags == (("command_stale",) if late else ())


@pytest.mark.parametrize("late", [False, True])
def test_falling_and_flailing_to_the_nanosecond(late: bool) -> None:
    """At 2 s, and not 1 ns before."""
    for flag, changes in (("free_fall", {"acceleration": np.zeros(3)}), ("flail", {})):
        checks = LegChecks(robot(), LEGS)
        speed = 4.5 if flag == "flail" else 0.0
        now = T0 + 2 * S - 1 + late
        assert checks.failures(state(T0, cart_speed=speed, body=body(**changes))) == {}
        found = checks.failures(state(now, cart_speed=speed, body=body(**changes)))
        assert tuple(found) == ((flag,) if late else ())


@pytest.mark.parametrize("late", [False, True])
def test_the_window_of_lost_commands_to_the_nanosecond(late: bool) -> None:
    """51 in a second trip; a nanosecond later the first no longer counts."""
    checks = LegChecks(robot(), LEGS)
    for at_ns, lost in ((0, 0), (S // 2, 30)):
        assert checks.failures(state(T0 + at_ns, body=body(lost=np.array([0, lost])))) == {}
    found = checks.failures(state(T0 + S + late, body=body(lost=np.array([0, 51]))))
    assert tuple(found) == (() if late else ("lost_commands",))


def test_a_longer_window_allows_more_lost_commands() -> None:
    """The limit is a rate: in a window of 2 s, 100 may be lost at 50 a second."""
    for lost in (100, 101):
        checks = LegChecks(robot(), LEGS, lost_window_s=2.0)
        assert checks.failures(state(T0, body=body())) == {}
        found = checks.failures(state(T0 + S, body=body(lost=np.array([lost, 0]))))
        assert list(found.values()) == (
            ["the motor of joint 'cart' missed 101 commands in 2 s, at most 100 are allowed"]
            if lost == 101
            else []
        )


def test_running_asks_for_less_than_arming_unless_told() -> None:
    """A battery at 20 % may go on, and may not start."""
    checks = LegChecks(robot(), LEGS)
    assert checks.failures(state(body=body(battery=0.2))) == {}
    assert tuple(checks.failures(state(body=body(battery=0.2)), arming=True)) == ("battery_low",)


# To the last bit.


def test_after_easing_in_targets_pass_to_the_last_bit() -> None:
    """0.2 + 1.0 x (1e-17 - 0.2) would be 0."""
    safety = Safety(DESCRIPTION)
    safety.arm(cycle(sample=state(cart=0.2)))
    assert safety.step(cycle(T0 + S, state(T0 + S, cart=0.2)), command()).state is SafetyState.ACTIVE
    verdict = safety.step(cycle(T0 + S, state(T0 + S)), command(1e-17))
    assert verdict.command is not None
    assert verdict.command.position_target[0] == 1e-17


def test_a_joint_at_its_limit_of_effort_stays_untouched_beside_one_beyond() -> None:
    """20 x 0.4 is 8.0 exactly, and 8.0 is allowed; the parts of the other may be small."""
    asked = JointCommand(
        position_target=np.array([0.4, 0.04]),
        velocity_target=np.zeros(2),
        stiffness=np.full(2, 20.0),
        damping=np.zeros(2),
        effort=np.array([0.0, 0.6]),
        effort_limit=np.ones(2),
        speed_limit=np.ones(2),
    )
    span = (np.full(2, -1.0), np.full(2, 1.0))
    made, _ = keep_effort(asked, np.zeros(2), np.zeros(2), np.array([8.0, 0.5]), span)
    assert made.position_target[0] == 0.4
    # 20 x 0.04 + 0.6 = 1.4: the spring's 0.8 goes whole, 0.1 of the feed-forward after it.
    assert made.position_target[1] == 0.0
    assert made.effort[1] == pytest.approx(0.5, rel=1e-8)


def test_limits_may_be_whole_numbers() -> None:
    """A description may say 10 where it means 10.0."""
    legs = dataclasses.replace(LEGS, effort=(10,), flail_velocity=(4, 5))
    description = robot(legs=legs, stiffness=(200,), damping=(20,), effort=(8,), speed=(3,))
    asked = command(0.25, stiffness=80.0, damping=0.0, effort_limit=0.5, speed_limit=0.5)
    made, names = SafetyFilter(description).clip(asked, np.zeros(1), np.zeros(1), np.zeros(1))
    assert made.position_target[0] == pytest.approx(0.125)
    assert (made.effort_limit[0], made.speed_limit[0], names) == (0.5, 0.5, ("predicted_effort",))
