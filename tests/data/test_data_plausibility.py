"""Checks of recordings of unknown origin, on recordings with one thing wrong."""

from __future__ import annotations

import dataclasses
import itertools
import re
import sys
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from deal_hw.data.checks.joint_match import best_assignment
from deal_hw.data.checks.suite import examine, require
from deal_hw.data.table import Table
from deal_hw.errors import DatasetError, MissingExtraError
from deal_hw.findings import Finding, Severity, worst
from deal_hw.install import install_line

MakeTable = Callable[..., Table]
LIMITS = np.array([[-1.0, 1.0]] * 3)


def verdict(table: Table, name: str, limits: np.ndarray | None = None) -> Finding:
    """Return one verdict on a recording."""
    return next(verdict for verdict in examine(table, limits) if verdict.code == name)


def test_sound_recording_passes(make_table: MakeTable) -> None:
    """Nothing is found in a sound recording, and nothing is refused."""
    verdicts = examine(make_table(), LIMITS)
    assert worst(verdicts) is Severity.OK, [v for v in verdicts if v.severity is not Severity.OK]
    require(verdicts, "rec.csv")
    assert "30 ms" in verdict(make_table(), "delay").message


def test_values_that_are_not_numbers(make_table: MakeTable) -> None:
    """Few lost positions are a warning, many or a lost target a refusal that counts them."""
    position = make_table().position.copy()
    position[[5, 6], 1] = np.nan
    few = verdict(make_table(position=position), "finite")
    assert few.severity is Severity.WARN and "knee (2 samples)" in few.message
    position[100:150, 1] = np.inf
    many = verdict(make_table(position=position), "finite")
    assert many.severity is Severity.FAIL and "knee (52 samples)" in many.message
    target = make_table().target.copy()
    target[7, 0] = np.nan
    assert verdict(make_table(target=target), "finite").severity is Severity.FAIL


def test_infinite_values_are_named_once(make_table: MakeTable) -> None:
    """A joint that reads inf in one sample is no joint in degrees, and reaches no limit."""
    table = make_table()
    position = table.position.copy()
    position[100] = np.inf
    free = np.array([[-np.inf, np.inf]] * 3)
    found = examine(dataclasses.replace(table, position=position), free)
    assert {f.code for f in found if f.severity is not Severity.OK} == {"finite"}


def test_clock_going_backwards(make_table: MakeTable) -> None:
    """The last sample before, counted from 1, and the two stamps are named."""
    time_s = make_table().time_s.copy()
    time_s[600:] -= 3.0
    found = verdict(make_table(time_s=time_s), "clock")
    assert found.severity is Severity.FAIL
    assert (
        "1 times" in found.message and "sample 600 (" in found.message and "5.99 s, then 3 s" in found.message
    )


@pytest.mark.parametrize(("step", "severity"), [(100, Severity.WARN), (2, Severity.FAIL)])
def test_equal_stamps(make_table: MakeTable, step: int, severity: Severity) -> None:
    """12 of 1200 equal stamps are a warning, 600 a refusal."""
    time_s = make_table().time_s.copy()
    time_s[1::step] = time_s[0::step]
    found = verdict(make_table(time_s=time_s), "clock")
    assert found.severity is severity and f"{1200 // step} samples" in found.message


def test_gaps_are_counted(make_table: MakeTable) -> None:
    """A pause, however long, is between two parts; a third sample alone holds nothing that can be fitted."""
    time_s = make_table().time_s
    for pause_s in (1.0, 5.0):
        paused = np.where(np.arange(time_s.size) < 700, time_s, time_s + pause_s)
        found = verdict(make_table(time_s=paused, command_s=paused), "gaps")
        assert found.severity is Severity.WARN
        assert f"2 parts; the pause between them is not fitted ({pause_s:.0f}" in found.message
    torn = time_s + 0.1 * (np.arange(time_s.size) // 3)
    assert verdict(make_table(time_s=torn, command_s=torn), "gaps").severity is Severity.FAIL


@pytest.mark.parametrize(
    ("scale", "severity", "words"),
    [
        (1.0, Severity.OK, "100"),
        (2.5, Severity.WARN, "40"),
        (6.0, Severity.FAIL, "16.67"),
        (1e3, Severity.FAIL, "record faster, or correct the unit of time"),
        (1e-3, Severity.FAIL, "unit of time"),
        (1e6, Severity.FAIL, "unit of time"),
    ],
)
def test_rate(make_table: MakeTable, scale: float, severity: Severity, words: str) -> None:
    """Under 50 Hz is a warning, under 20 Hz a refusal, and so is a time in another unit."""
    time_s = make_table().time_s * scale
    found = verdict(make_table(time_s=time_s, command_s=time_s), "rate")
    assert found.severity is severity and words in found.message


def test_joint_that_never_moves(make_table: MakeTable) -> None:
    """A dead sensor under a moving command is refused; a joint that is held is a warning."""
    position, target = make_table().position.copy(), make_table().target.copy()
    position[:, 2] = 0.3
    dead = verdict(make_table(position=position), "frozen")
    assert dead.severity is Severity.FAIL and "foot" in dead.message
    target[:, 2] = 0.3
    held = verdict(make_table(position=position, target=target), "frozen")
    assert held.severity is Severity.WARN and "foot" in held.message
    assert verdict(make_table(position=0 * position), "frozen").severity is Severity.FAIL


def test_stretch_without_change(make_table: MakeTable) -> None:
    """A position that stalls for 2 s while its command moves is a warning with its time."""
    position = make_table().position.copy()
    position[400:600, 0] = position[400, 0]
    found = verdict(make_table(position=position), "frozen")
    assert found.severity is Severity.WARN and "hip for 2 s" in found.message


def test_measurement_that_copies_the_command(make_table: MakeTable) -> None:
    """A copy is refused, also one that comes three samples later."""
    target = make_table().target
    assert verdict(make_table(position=target), "copy").severity is Severity.FAIL
    found = verdict(make_table(position=np.roll(target, 3, axis=0)), "copy")
    assert found.severity is Severity.FAIL and "3 samples later" in found.message


def test_command_that_copies_the_measurement(make_table: MakeTable) -> None:
    """A log of readings in place of the commands: they follow the motion."""
    table = make_table()
    target = np.roll(table.position[:, list(table.actuated_index)], 2, axis=0)
    found = verdict(dataclasses.replace(table, command_s=table.time_s, target=target), "copy")
    assert found.severity is Severity.FAIL and "commands that are a copy of the measured" in found.message


def test_command_that_stands_while_its_joint_moves(make_table: MakeTable) -> None:
    """One column without any change is named; the others are commands."""
    table = make_table()
    target = table.target.copy()
    target[:, 1] = 0.5
    found = verdict(dataclasses.replace(table, target=target), "commands")
    assert found.severity is Severity.WARN and "never changes although the joint moves: knee" in found.message


def test_degrees(make_table: MakeTable) -> None:
    """Degrees in either channel are found by the factor between them, in both by the limits."""
    sound = make_table()
    for name in ("position", "target"):
        found = verdict(make_table(**{name: np.rad2deg(getattr(sound, name))}), "units")
        assert found.severity is Severity.FAIL and "degrees" in found.message
    both = make_table(position=np.rad2deg(sound.position), target=np.rad2deg(sound.target))
    found = verdict(both, "units", LIMITS)
    assert found.severity is Severity.FAIL and "degrees" in found.message


def test_degrees_are_one_cause_in_one_short_paragraph(make_table: MakeTable) -> None:
    """Positions in degrees lie far from their commands and outside the limits: no second cause."""
    sound = make_table()
    found = examine(make_table(position=np.rad2deg(sound.position)), LIMITS)
    assert [v.code for v in found if v.severity is Severity.FAIL] == ["units"]
    with pytest.raises(DatasetError) as refused:
        require(found, "rec.csv")
    text = str(refused.value)
    assert text.count("degrees") == 1 and "hip, knee, foot: the measurement's range is about 57.3" in text
    assert "another zero" not in text and "normalised to" not in text and len(text) < 300


def test_degrees_of_a_joint_without_limits(make_table: MakeTable) -> None:
    """A servo's joint that turns 23 rad may be in degrees: a warning. A free one, or a wheel, may turn so."""
    sound = make_table()
    free = np.array([[-np.inf, np.inf]] * 3)
    wide = {name: 40 * getattr(sound, name) for name in ("position", "target")}
    found = verdict(make_table(**wide), "limits", free)
    assert (
        found.severity is Severity.WARN
        and "check whether they are in degrees" in found.message
        and "hip 23" in found.message
    )
    assert verdict(sound, "limits", free).severity is Severity.OK
    wheel = make_table(position=wide["position"], target=np.roll(sound.target, 150, axis=0)[:, ::-1])
    assert verdict(wheel, "limits", free).severity is Severity.OK


def test_a_free_joint_without_limits_may_turn(make_table: MakeTable) -> None:
    """The pole of a cart that turned over: 51 rad are no degrees; with a motor, or limits, they may be."""
    sound = make_table()
    position = sound.position * [1, 1, 80]
    pole = {"position": position, "actuated": ("hip", "knee"), "target": sound.target[:, :2]}
    free = np.array([*LIMITS[:2], [-np.inf, np.inf]])
    assert verdict(make_table(**pole), "units", free).severity is Severity.OK
    assert verdict(make_table(**pole), "units", LIMITS).severity is Severity.FAIL
    motor = make_table(position=position, target=sound.target * [1, 1, 80])
    assert verdict(motor, "units", free).severity is Severity.FAIL


@pytest.mark.parametrize(
    ("factors", "clock", "words"),
    [
        ((1.0, 1.2, 0.8), 1.0, ""),
        ((57.3, 57.3, 57.3), 1.0, "degrees and radians"),
        ((1.0, 1 / 57.3, 1.0), 1.0, "degrees and radians"),
        ((1.0, -1.0, 1.0), 1.0, "sign"),
        ((1.0, 0.5, 1.0), 1.0, "unit of its positions"),
        ((1.0, 1.0, 1.0), 2.0, "check the clock"),
        ((1.0, 1.0, 1.0), 0.5, "check the clock"),
    ],
)
def test_velocities_are_slopes(
    make_table: MakeTable, factors: tuple[float, ...], clock: float, words: str
) -> None:
    """Another unit, sign or clock is a warning that says by how much; a fifth is a filter's."""
    sound = make_table()
    velocity = np.gradient(sound.position, sound.time_s, axis=0) * factors
    time_s = clock * sound.time_s
    found = verdict(make_table(velocity=velocity, time_s=time_s, command_s=time_s), "velocity")
    assert found.severity is (Severity.WARN if words else Severity.OK) and words in found.message


def test_velocities_of_noise_say_nothing(make_table: MakeTable) -> None:
    """Velocities that are not like the slopes, not numbers, or constant, are not compared."""
    rng = np.random.default_rng(0)
    shape = make_table().position.shape
    for velocity in (rng.normal(size=shape), np.full(shape, np.nan), np.zeros(shape)):
        assert verdict(make_table(velocity=velocity), "velocity").severity is Severity.OK


def test_millimetres(make_table: MakeTable) -> None:
    """A slide's command in mm against its measurement in m is refused by the factor of 1000."""
    sound = make_table()
    table = make_table(units=("m",) * 3, target=1000 * sound.target)
    found = verdict(table, "units")
    assert found.severity is Severity.FAIL and "millimetres" in found.message


def test_normalised_channel(make_table: MakeTable) -> None:
    """-100..100 against rad is refused and named; a channel that fills 0..1 in both is a warning."""
    sound = make_table()
    target = sound.target.copy()
    target[:, 1] *= 100 / np.max(np.abs(target[:, 1]))
    found = verdict(make_table(target=target), "units")
    assert found.severity is Severity.FAIL and "knee" in found.message and "-100..100" in found.message
    low, high = sound.position[:, 0].min(), sound.position[:, 0].max()
    position, target = sound.position.copy(), sound.target.copy()
    for values in (position, target):
        values[:, 0] = (values[:, 0] - low) / (high - low)
    found = verdict(make_table(position=position, target=target), "units")
    assert found.severity is Severity.WARN and "hip (0..1)" in found.message


def test_limits_and_levels(make_table: MakeTable) -> None:
    """Positions off the model's range, or far from their command, are refused and named."""
    sound = make_table()
    position = sound.position + np.array([0.0, 0.0, 2.5])
    shifted = make_table(position=position, target=sound.target + np.array([0.0, 0.0, 2.5]))
    found = verdict(shifted, "limits", LIMITS)
    assert found.severity is Severity.FAIL and "foot" in found.message and "hip" not in found.message
    away = verdict(make_table(position=sound.position + np.array([0.0, 4.5, 0.0])), "levels")
    assert away.severity is Severity.FAIL and "knee +4.5 rad" in away.message


@pytest.mark.parametrize("order", [order for order in itertools.permutations(range(3)) if order != (0, 1, 2)])
def test_wrong_order_names_the_permutation(make_table: MakeTable, order: tuple[int, ...]) -> None:
    """Every wrong order of three joints is refused, and the message says whose command each joint follows."""
    sound = make_table()
    found = verdict(make_table(position=sound.position[:, order]), "assignment")
    assert found.severity is Severity.FAIL
    for joint, source in enumerate(order):
        mine, its = sound.joint_names[joint], sound.joint_names[source]
        named = f"the measurement of {mine} follows the command of {its}"
        assert (named in found.message) == (joint != source)
    assert found.message.startswith("joints seem to be in another order: ")
    assert found.message.count("the measurement of") == sum(
        joint != source for joint, source in enumerate(order)
    )
    assert "sign" not in found.message


@pytest.mark.parametrize("signs", [(-1, 1, 1), (1, -1, -1), (-1, -1, -1)])
def test_wrong_sign(make_table: MakeTable, signs: tuple[int, ...]) -> None:
    """Joints measured against their command are refused by name, the others not accused."""
    sound = make_table()
    found = verdict(make_table(position=sound.position * signs), "assignment")
    assert found.severity is Severity.FAIL
    accused = found.message.partition("the sign of ")[2].partition(" is wrong")[0].split(", ")
    assert accused == [n for n, sign in zip(sound.joint_names, signs, strict=True) if sign < 0]


def test_wrong_order_and_sign(make_table: MakeTable) -> None:
    """Two joints swapped, one of them turned as well: both are reported."""
    sound = make_table()
    found = verdict(make_table(position=sound.position[:, [1, 0, 2]] * [-1, 1, 1]), "assignment")
    assert found.severity is Severity.FAIL
    assert "the measurement of hip follows the command of knee with the sign turned" in found.message


def test_joints_that_move_together_are_not_accused(make_table: MakeTable) -> None:
    """Legs with one command for all cannot be distinguished, so that a swap of two is no finding."""
    sound = make_table()
    together = make_table(position=sound.position[:, [0, 0, 0]], target=sound.target[:, [0, 0, 0]])
    assert verdict(together, "assignment").severity is Severity.OK


def test_commands_that_come_late(make_table: MakeTable) -> None:
    """A measurement 70 ms before its command is refused with that time."""
    found = verdict(make_table(command_s=make_table().time_s + 0.1), "delay")
    assert found.severity is Severity.FAIL and "70 ms before" in found.message


def test_commands_on_another_clock(make_table: MakeTable) -> None:
    """Commands that lie outside the samples' time, or never change, or are absent, are refused."""
    late = make_table(command_s=make_table().time_s + 100.0)
    assert verdict(late, "commands").severity is Severity.FAIL
    assert verdict(make_table(target=np.zeros((1200, 3))), "commands").severity is Severity.FAIL
    none = make_table(command_s=np.empty(0), target=np.empty((0, 3)))
    assert verdict(none, "commands").severity is Severity.FAIL


def test_clipped_commands_and_saturated_effort(make_table: MakeTable) -> None:
    """Commands cut at 0.3 rad and efforts cut at 1 sit at their extreme; a square wave does not count."""
    sound = make_table()
    clipped = make_table(target=np.clip(sound.target, -0.3, 0.3))
    assert verdict(clipped, "clamped").severity is Severity.WARN
    effort = np.clip(5 * (sound.target - sound.position), -1, 1) * [10.0, 1.0, 1.0]
    assert verdict(make_table(effort=effort), "saturated").severity is Severity.OK
    effort[:, 0] = np.clip(effort[:, 0], -2, 2)
    found = verdict(make_table(effort=effort), "saturated")
    assert found.severity is Severity.WARN and "hip" in found.message and "knee" not in found.message
    assert verdict(make_table(target=0.3 * np.sign(sound.target)), "clamped").severity is Severity.OK


def test_little_motion(make_table: MakeTable) -> None:
    """All joints within 0.06 rad are refused, one of them is a warning."""
    sound = make_table()
    weak = make_table(position=0.05 * sound.position, target=0.05 * sound.target)
    assert verdict(weak, "excitation").severity is Severity.FAIL
    one = make_table(position=sound.position * [1, 0.05, 1], target=sound.target * [1, 0.05, 1])
    found = verdict(one, "excitation")
    assert found.severity is Severity.WARN and "knee" in found.message


def test_quaternions(make_table: MakeTable) -> None:
    """Values that are no unit quaternions are refused; an upright base in the other order is a warning."""
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (1200, 1))
    assert verdict(make_table(orientation=upright), "orientation").severity is Severity.OK
    assert verdict(make_table(orientation=2 * upright), "orientation").severity is Severity.FAIL
    assert verdict(make_table(orientation=upright[:, [1, 2, 3, 0]]), "orientation").severity is Severity.WARN


def test_require_names_what_failed(make_table: MakeTable) -> None:
    """The error holds each failed check's sentence and no warning."""
    table = dataclasses.replace(make_table(), position=make_table().target)
    with pytest.raises(DatasetError, match=r"rec\.csv cannot be used: copy: .*hip"):
        require(examine(table), table.name)


@given(hnp.arrays(np.float64, st.integers(1, 5).map(lambda n: (n, n)), elements=st.floats(-9, 9)))
def test_best_assignment_is_the_best(score: np.ndarray) -> None:
    """No permutation scores more, each column is used once."""
    rows = np.arange(len(score))
    found = best_assignment(score)
    assert sorted(found) == list(rows)
    best = max(score[rows, list(order)].sum() for order in itertools.permutations(rows))
    assert score[rows, found].sum() == pytest.approx(best, abs=1e-9)


def test_without_scipy_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, make_table: MakeTable) -> None:
    """The base install has no scipy, and needs it only where two joints agree best with the same commands."""
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    assert not [check for check in examine(make_table()) if check.severity is Severity.FAIL]
    table = make_table()
    same = dataclasses.replace(table, position=np.repeat(table.position[:, :1], 3, axis=1))
    with pytest.raises(MissingExtraError, match="scipy is not installed.*" + re.escape(install_line("sim"))):
        examine(same)
