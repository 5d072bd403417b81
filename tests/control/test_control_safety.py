"""The safety module on grids dense around each limit and sparse elsewhere."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.control.safety.machine import SAFETY_FLAGS, SafetyMachine
from deal_hw.control.safety.safety import CycleInput, Safety, SafetyConfig, SafetyState
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import SafetyError
from deal_hw.types import JointCommand, RobotState, Status

MS = 1_000_000
ARMED = Status.ARMED | Status.HOMED
T0 = 50_000_000_000
"""Host time at arming; the device's clock runs 7 s behind."""


def state(
    now_ns: int = T0,
    *,
    cart: float = 0.0,
    pole: float = 0.0,
    cart_speed: float = 0.0,
    pole_speed: float = 0.0,
    status: Status = ARMED,
    lag_ns: int = 0,
) -> RobotState:
    """Return a state received just now, sent ``lag_ns`` earlier than usual."""
    return RobotState(
        position=np.array([cart, pole]),
        velocity=np.array([cart_speed, pole_speed]),
        effort=np.zeros(2),
        receive_ns=now_ns,
        device_ns=now_ns - 7_000_000_000 - lag_ns,
        sequence=0,
        command_sequence=-1,
        command_age_ns=-1,
        status=status,
    )


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


@pytest.fixture
def safety() -> Safety:
    """A disarmed safety module for the cart-pole."""
    return Safety(DESCRIPTION)


@pytest.fixture
def armed(safety: Safety) -> Safety:
    """An armed one, ACTIVE after its first cycle."""
    safety.arm(cycle())
    safety.step(cycle(), command())
    return safety


def around(limit: float, span: float = 1.0) -> list[float]:
    """Values dense around a limit and sparse elsewhere."""
    near = [limit + k * 10.0**-e for e in (9, 6, 3) for k in (-1, 1)]
    return [*near, limit, limit - span, limit + span, 0.0]


# The state machine.


def test_machine_walks_the_whole_circle() -> None:
    """DISARMED, EASING_IN, ACTIVE, PASSIVE, and only a re-arm leads back to DISARMED."""
    machine = SafetyMachine(ease_in_ns=100 * MS)
    assert machine.state is SafetyState.DISARMED
    machine.arm(0)
    assert machine.update(99 * MS, ()) is SafetyState.EASING_IN
    assert machine.authority(25 * MS) == 0.25
    assert machine.update(100 * MS, ()) is SafetyState.ACTIVE
    assert machine.authority(100 * MS) == 1.0
    assert machine.update(101 * MS, ("velocity",)) is SafetyState.PASSIVE
    assert machine.update(999 * MS, ()) is SafetyState.PASSIVE
    machine.rearm()
    assert machine.state is SafetyState.DISARMED


def test_machine_without_ease_in_is_active_at_once() -> None:
    """An ease-in time of 0 gives full authority in the first cycle."""
    machine = SafetyMachine(ease_in_ns=0)
    machine.arm(5)
    assert machine.update(5, ()) is SafetyState.ACTIVE


@pytest.mark.parametrize("flag", SAFETY_FLAGS)
@pytest.mark.parametrize("before", [SafetyState.EASING_IN, SafetyState.ACTIVE])
def test_any_flag_trips_from_either_armed_state(flag: str, before: SafetyState) -> None:
    """Each flag alone trips, while easing in as well as when active."""
    machine = SafetyMachine(ease_in_ns=10 * MS)
    machine.arm(0)
    if before is SafetyState.ACTIVE:
        machine.update(10 * MS, ())
    assert machine.state is before
    assert machine.update(10 * MS, (flag,)) is SafetyState.PASSIVE


def test_flags_do_nothing_while_disarmed() -> None:
    """There is nothing to trip where nothing is commanded."""
    machine = SafetyMachine(ease_in_ns=0)
    assert machine.update(0, ("position",)) is SafetyState.DISARMED


def test_arming_twice_and_rearming_while_armed_are_errors() -> None:
    """Arming needs DISARMED; re-arming needs not to be armed; a passive machine does not arm."""
    machine = SafetyMachine(ease_in_ns=0)
    machine.rearm()
    machine.arm(0)
    with pytest.raises(SafetyError, match="cannot arm in state easing in"):
        machine.arm(0)
    with pytest.raises(SafetyError, match="cannot re-arm in state easing in"):
        machine.rearm()
    machine.stop()
    with pytest.raises(SafetyError, match="cannot arm in state passive"):
        machine.arm(0)


# The filter, by hand.


@pytest.mark.parametrize(
    ("target", "previous", "measured", "expected", "names"),
    [
        (0.10, 0.00, 0.00, 0.10, ()),
        # 0.25 is the absolute limit; a step of 0.5 and a distance of 0.6 allow more.
        (0.25, 0.00, 0.00, 0.25, ()),
        (0.30, 0.00, 0.00, 0.25, ("target",)),
        (-0.30, 0.00, 0.00, -0.25, ("target",)),
        # A step of 0.5 from -0.25 reaches exactly 0.25; from -0.30 (measured, never sent) only 0.20.
        (0.25, -0.25, 0.00, 0.25, ()),
        (0.25, -0.30, 0.00, 0.20, ("target_step",)),
        (-0.25, 0.30, 0.00, -0.20, ("target_step",)),
        # The cart at -0.38 may be pulled to -0.38 + 0.6 = 0.22.
        (0.25, 0.20, -0.38, 0.22, ("target_distance",)),
        (-0.25, -0.20, 0.38, -0.22, ("target_distance",)),
        # All three at once: step to 0.9 from 0.4, distance to 0.8 from 0.2, absolute to 0.25.
        (2.0, 0.4, 0.2, 0.25, ("target_step", "target_distance", "target")),
    ],
)
def test_targets_are_clipped_by_hand_computed_amounts(
    target: float, previous: float, measured: float, expected: float, names: tuple[str, ...]
) -> None:
    """Step, then distance, then the absolute limit, which always holds."""
    result, clipped = SafetyFilter(DESCRIPTION).clip(
        command(target), np.array([previous]), np.array([measured]), np.zeros(1)
    )
    assert result.position_target[0] == pytest.approx(expected, abs=1e-12)
    assert clipped == names


@pytest.mark.parametrize(
    ("field", "low", "high"),
    [
        ("position_target", -0.25, 0.25),
        ("stiffness", 0.0, 200.0),
        ("damping", 0.0, 20.0),
        ("effort_limit", 0.0, 8.0),
        ("speed_limit", 0.0, 3.0),
        ("velocity_target", -3.0, 3.0),
        ("effort", -8.0, 8.0),
    ],
)
def test_every_field_is_clipped_exactly_at_its_limits(field: str, low: float, high: float) -> None:
    """Values around both limits come out inside, unchanged where they were, flagged where not."""
    name = "target" if field == "position_target" else field
    previous = measured = np.zeros(1)
    for value in {*around(low, 0.1), *around(high, 0.1)}:
        asked = dataclasses.replace(command(), **{field: np.array([value])})
        result, clipped = SafetyFilter(DESCRIPTION).clip(asked, previous, measured, np.zeros(1))
        assert getattr(result, field)[0] == min(max(value, low), high)
        assert (name in clipped) is not (low <= value <= high)


# The whole module: clipping while armed and disarmed.


@pytest.mark.parametrize("target", around(0.25) + around(-0.25))
def test_nothing_is_sent_while_disarmed(safety: Safety, target: float) -> None:
    """Disarmed, the command is computed and clipped for the record, but never to be sent."""
    verdict = safety.step(cycle(), command(target))
    assert verdict.state is SafetyState.DISARMED
    assert verdict.send is False
    assert verdict.command is not None
    assert abs(verdict.command.position_target[0]) <= 0.25


@pytest.mark.parametrize("target", around(0.25) + around(-0.25))
def test_armed_commands_are_inside_the_limit(armed: Safety, target: float) -> None:
    """Armed, each target goes out at most at the limit, and a clip never trips."""
    verdict = armed.step(cycle(T0 + 20 * MS), command(target))
    assert verdict.state is SafetyState.ACTIVE
    assert verdict.send is True
    assert verdict.command is not None
    assert abs(verdict.command.position_target[0]) <= 0.25
    assert bool(verdict.clipped) is (abs(target) > 0.25)


def test_the_step_limit_counts_from_the_last_target_sent() -> None:
    """A step of 0.5 passes; a limit of 0.3 stops the second command at 0.05."""
    limits = dataclasses.replace(DESCRIPTION.limits, target_step=(0.3,))
    safety = Safety(dataclasses.replace(DESCRIPTION, limits=limits))
    safety.arm(cycle())
    first = safety.step(cycle(), command(-0.25))
    second = safety.step(cycle(T0 + 20 * MS), command(0.25))
    assert first.command is not None and second.command is not None
    assert first.command.position_target[0] == -0.25
    assert second.command.position_target[0] == pytest.approx(0.05)
    assert second.clipped == ("target_step",)


def test_easing_in_moves_from_the_measured_pose_to_the_wish() -> None:
    """After a quarter of 0.2 s, a wish of 0.2 from a measured 0.1 is granted to 0.1 + 0.25 * 0.1 = 0.125."""
    limits = dataclasses.replace(DESCRIPTION.limits, ease_in_s=0.2)
    safety = Safety(dataclasses.replace(DESCRIPTION, limits=limits))
    safety.arm(cycle(sample=state(cart=0.1)))
    verdict = safety.step(cycle(T0 + 50 * MS, state(T0 + 50 * MS, cart=0.15)), command(0.2))
    assert verdict.state is SafetyState.EASING_IN
    assert verdict.command is not None
    assert verdict.command.position_target[0] == pytest.approx(0.125)
    assert safety.step(cycle(T0 + 200 * MS), command(0.2)).state is SafetyState.ACTIVE


# Trips.


@pytest.mark.parametrize("cart", [*around(0.38, 0.2), *around(-0.38, 0.2)])
def test_track_ends_trip(armed: Safety, cart: float) -> None:
    """A measured cart position outside -0.38..0.38 m trips; on the limit it does not."""
    verdict = armed.step(cycle(T0 + 20 * MS, state(T0 + 20 * MS, cart=cart)), command())
    assert (verdict.state is SafetyState.PASSIVE) is (abs(cart) > 0.38)
    assert ("joint 'cart' is at" in verdict.reason) is (abs(cart) > 0.38)


@pytest.mark.parametrize("angle", [-1e4, -math.pi, 0.0, 3.0, 1e4])
def test_the_pole_may_turn_freely(armed: Safety, angle: float) -> None:
    """A joint without trip range never trips by its position."""
    assert armed.step(cycle(T0 + 20 * MS, state(T0 + 20 * MS, pole=angle)), command()).send


@pytest.mark.parametrize(("joint", "limit"), [("cart_speed", 6.0), ("pole_speed", 60.0)])
def test_speeds_trip(joint: str, limit: float) -> None:
    """A measured speed above the trip speed trips, in both directions; on the limit it does not."""
    for speed in {*around(limit), *around(-limit)}:
        safety = Safety(DESCRIPTION)
        safety.arm(cycle())
        moving: dict[str, Any] = {joint: speed}
        verdict = safety.step(cycle(T0 + MS, state(T0 + MS, **moving)), command())
        assert (verdict.state is SafetyState.PASSIVE) is (abs(speed) > limit)
        assert ("velocity" in verdict.flags) is (abs(speed) > limit)


@pytest.mark.parametrize(("age_ms", "trips"), [(0, False), (59, False), (60, False), (61, True), (500, True)])
def test_old_states_trip(armed: Safety, age_ms: int, trips: bool) -> None:
    """The newest state may be 60 ms old and no older."""
    verdict = armed.step(cycle(T0 + age_ms * MS, state(T0)), command())
    assert (verdict.flags == ("state_stale",)) is trips
    assert (verdict.state is SafetyState.PASSIVE) is trips


@pytest.mark.parametrize(("lag_ms", "trips"), [(10, False), (59, False), (61, True), (4000, True)])
def test_states_that_waited_in_a_buffer_trip(armed: Safety, lag_ms: int, trips: bool) -> None:
    """A fresh receive stamp does not make an old sample fresh: the device's clock tells."""
    now = T0 + 5_000 * MS
    armed.step(cycle(now - 20 * MS), command())
    verdict = armed.step(cycle(now, state(now, lag_ns=lag_ms * MS)), command())
    assert (verdict.flags == ("state_stale",)) is trips


def test_clock_drift_is_no_lag() -> None:
    """A device clock that is 1e-4 slow for ten minutes drifts by 60 ms and trips nothing."""
    safety = Safety(DESCRIPTION)
    safety.arm(cycle())
    for k in range(1, 601):
        now = T0 + k * 1000 * MS
        assert safety.step(cycle(now, state(now, lag_ns=k * 100_000)), command()).send


def test_a_device_clock_that_jumps_trips(armed: Safety) -> None:
    """A device whose clock runs 0.101 s ahead of what it was has restarted or lies; 0.099 s is let pass."""
    now = T0 + 20 * MS
    assert armed.step(cycle(now, state(now, lag_ns=-99 * MS)), command()).send
    verdict = armed.step(cycle(now + MS, state(now + MS, lag_ns=-201 * MS)), command())
    assert verdict.flags == ("clock_jump",)
    assert "jumped ahead by 0.102 s" in verdict.reason


@pytest.mark.parametrize(
    ("age_ms", "trips"), [(0, False), (39.9, False), (40, False), (40.1, True), (900, True)]
)
def test_a_late_policy_trips(armed: Safety, age_ms: float, trips: bool) -> None:
    """A policy may take 40 ms and no longer."""
    verdict = armed.step(cycle(T0 + 20 * MS, action_age_ns=round(age_ms * MS)), command())
    assert (verdict.flags == ("action_late",)) is trips


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", [f.name for f in dataclasses.fields(JointCommand)])
def test_a_command_that_is_not_finite_trips_and_is_not_passed_on(
    armed: Safety, field: str, bad: float
) -> None:
    """No field of a command may be NaN or infinite."""
    verdict = armed.step(cycle(T0 + 20 * MS), dataclasses.replace(command(), **{field: np.array([bad])}))
    assert verdict.state is SafetyState.PASSIVE
    assert verdict.command is None
    assert verdict.flags == ("action_not_finite",)


def test_a_command_that_is_not_finite_is_withheld_while_disarmed(safety: Safety) -> None:
    """A dry run reports it and has nothing to clip."""
    verdict = safety.step(cycle(), command(math.nan))
    assert (verdict.state, verdict.command, verdict.flags) == (
        SafetyState.DISARMED,
        None,
        ("action_not_finite",),
    )


@pytest.mark.parametrize("where", ["cart", "pole", "cart_speed", "pole_speed"])
def test_a_state_that_is_not_finite_trips(armed: Safety, where: str) -> None:
    """NaN passes every comparison with a limit unnoticed, so it is looked for by itself."""
    broken: dict[str, Any] = {where: math.nan}
    verdict = armed.step(cycle(T0 + MS, state(T0 + MS, **broken)), None)
    assert verdict.flags == ("state_not_finite",)
    assert verdict.state is SafetyState.PASSIVE


def test_an_operator_stop_trips_and_is_named_first(armed: Safety) -> None:
    """The operator's wish is the first reason even when something else is wrong, too."""
    verdict = armed.step(cycle(T0 + MS, state(T0 + MS, cart=0.5), stop_reason="enough"), command())
    assert verdict.flags == ("operator_stop", "position")
    assert verdict.reason.startswith("enough; joint 'cart'")


def test_a_device_fault_trips_at_once(armed: Safety) -> None:
    """A fault needs no confirmation."""
    verdict = armed.step(cycle(T0 + MS, state(T0 + MS, status=ARMED | Status.FAULT)), command())
    assert verdict.flags == ("device_fault",)


def test_the_devices_watchdog_trips_once_it_was_armed(armed: Safety) -> None:
    """Watchdog and lost arming are both named."""
    verdict = armed.step(cycle(T0 + MS, state(T0 + MS, status=Status.WATCHDOG)), command())
    assert verdict.flags == ("device_watchdog", "device_disarmed")


def test_samples_from_before_the_arming_are_forgiven_for_a_while() -> None:
    """An old watchdog bit may still be under way for 0.2 s after arming, and not longer."""
    old = Status.HOMED | Status.WATCHDOG
    safety = Safety(DESCRIPTION)
    safety.arm(cycle(sample=state(status=old)))
    assert safety.step(cycle(T0 + 199 * MS, state(T0 + 199 * MS, status=old)), command()).send
    verdict = safety.step(cycle(T0 + 200 * MS, state(T0 + 200 * MS, status=old)), command())
    assert verdict.flags == ("device_watchdog", "device_disarmed")


def test_a_device_that_disarms_itself_trips(armed: Safety) -> None:
    """Without a watchdog bit the missing arming is reason enough."""
    verdict = armed.step(cycle(T0 + MS, state(T0 + MS, status=Status.HOMED)), command())
    assert verdict.flags == ("device_disarmed",)


def test_transport_errors_trip_by_their_share_of_a_second() -> None:
    """Of 200 states/s, 60 errors within a second pass and 61 trip; older ones do not count."""
    safety = Safety(DESCRIPTION)
    safety.arm(cycle(transport_errors=1000))
    assert safety.step(cycle(T0 + 500 * MS, transport_errors=1060), command()).send
    assert safety.step(cycle(T0 + 1600 * MS, transport_errors=1120), command()).send
    verdict = safety.step(cycle(T0 + 1700 * MS, transport_errors=1122), command())
    assert verdict.flags == ()
    verdict = safety.step(cycle(T0 + 2000 * MS, transport_errors=1182), command())
    assert verdict.flags == ("transport_errors",)
    assert "62 transport errors in 1 s" in verdict.reason


def test_no_state_is_a_failure(safety: Safety) -> None:
    """Without any state there is nothing to send, and no arming."""
    empty = CycleInput(now_ns=T0, state=None)
    verdict = safety.step(empty, command())
    assert (verdict.flags, verdict.command) == (("no_state",), None)
    with pytest.raises(SafetyError, match="no state sample"):
        safety.arm(empty)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cart": 0.39}, "outside -0.38..0.38"),
        ({"pole_speed": 61.0}, "faster than 60"),
        ({"status": Status.FAULT}, "reports a fault"),
    ],
)
def test_arming_is_refused_while_something_is_wrong(
    safety: Safety, changes: dict[str, Any], message: str
) -> None:
    """The message says what is wrong."""
    with pytest.raises(SafetyError, match=message):
        safety.arm(cycle(sample=state(**changes)))
    assert safety.state is SafetyState.DISARMED


def test_a_trip_latches_with_its_first_reason(armed: Safety) -> None:
    """What was good again a cycle later stays passive, with the reason of the trip, until re-armed."""
    armed.step(cycle(T0 + MS, state(T0 + MS, cart=0.5)), command())
    verdict = armed.step(cycle(T0 + 2 * MS), command())
    assert (verdict.state, verdict.command, verdict.send) == (SafetyState.PASSIVE, None, False)
    assert verdict.reason.startswith("joint 'cart' is at 0.500 m")
    armed.stop("the run is over")
    assert armed.reason.startswith("joint 'cart' is at 0.500 m")
    armed.rearm()
    assert (armed.state, armed.reason) == (SafetyState.DISARMED, "")
    armed.arm(cycle(T0 + 3 * MS))
    assert armed.step(cycle(T0 + 3 * MS), command()).send


def test_a_stop_gives_its_reason(armed: Safety) -> None:
    """The end of a run is passive, too, and says so."""
    armed.stop("the run is over")
    assert (armed.state, armed.reason) == (SafetyState.PASSIVE, "the run is over")


def test_settings_that_disable_a_check_are_refused() -> None:
    """A window of 0 would never trip."""
    with pytest.raises(ValueError, match=r"transport_error_window_s is 0.*above 0"):
        SafetyConfig(transport_error_window_s=0)


def test_the_description_is_what_limits(armed: Safety) -> None:
    """Limits come from the description alone: another one trips elsewhere."""
    limits = dataclasses.replace(DESCRIPTION.limits, trip_position=((-0.1, 0.1), (-1.0, 1.0)))
    other: RobotDescription = dataclasses.replace(DESCRIPTION, limits=limits)
    safety = Safety(other)
    safety.arm(cycle())
    verdict = safety.step(cycle(T0 + MS, state(T0 + MS, cart=0.2, pole=2.0)), command())
    assert "joint 'pole' is at 2.000 rad, outside -1..1" in verdict.reason
    assert armed.step(cycle(T0 + MS, state(T0 + MS, cart=0.2, pole=2.0)), command()).send
