"""Angles that were folded into one turn are unwrapped, and nothing else is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.data.checks.command_kind import command_kind
from deal_hw.data.importing.columns import JointKinds, parse_column_map
from deal_hw.data.importing.grid import to_trajectories
from deal_hw.data.importing.load import load_tables, tables_of
from deal_hw.data.importing.memory_source import read_memory
from deal_hw.data.importing.table import unwrap
from deal_hw.data.table import Table
from deal_hw.errors import ConfigurationError
from deal_hw.findings import Severity
from deal_hw.types import FloatArray

TURN = 2 * np.pi
POLE = JointKinds(slides=frozenset({"cart"}), motors={"cart": 2.62})


def folded(angle: FloatArray, low: float) -> FloatArray:
    """Return an angle in [low, low + 2 pi)."""
    return np.asarray((angle - low) % TURN + low)


def swing(rate_hz: float, seconds: float = 6.0) -> tuple[FloatArray, FloatArray]:
    """Return times and the angle of a pole that turns over and swings at up to 18 rad/s."""
    t = np.arange(0, seconds, 1 / rate_hz)
    return t, 5.0 * np.sin(2 * np.pi * 0.35 * t) + 1.2 * np.sin(2 * np.pi * 0.9 * t + 1.0)


@settings(max_examples=60, deadline=None)
@given(
    low=st.sampled_from([-np.pi, 0.0, -1.0]),
    rate_hz=st.sampled_from([50.0, 100.0, 1000.0]),
    noise=st.sampled_from([0.0, 2e-3]),
    lost=st.sets(st.integers(1, 298), max_size=20),
    seed=st.integers(0, 9),
)
def test_a_folded_swing_comes_back_but_for_whole_turns(
    low: float, rate_hz: float, noise: float, lost: set[int], seed: int
) -> None:
    """Whatever the seam, the rate, the noise at the seam and the samples that were lost."""
    t, angle = swing(rate_hz)
    angle = angle + np.random.default_rng(seed).normal(0, noise, t.size)
    keep = np.ones(t.size, dtype=bool)
    keep[list(lost)] = False
    found, count = unwrap(folded(angle, low)[keep], t[keep])
    assert count == np.count_nonzero(np.diff(np.floor((angle[keep] - low) / TURN)))
    np.testing.assert_allclose(found - found[0], angle[keep] - angle[keep][0], atol=1e-9)
    # What is whole already stays as it is, to the bit.
    whole, jumps = unwrap(angle, t)
    assert jumps == 0 and np.array_equal(whole, angle)


def test_a_spike_and_a_pause_do_not_keep_the_turns_from_being_counted() -> None:
    """The pole goes on turning over; the spike stays where it was, for its check."""
    t, angle = swing(50.0)
    keep = (t < 2.0) | (t > 2.7)
    angle[50] += 2.5
    found, count = unwrap(folded(angle, -np.pi)[keep], t[keep])
    assert count > 4
    apart = np.diff(found) - np.diff(angle[keep])
    apart[np.count_nonzero(t < 2.0) - 1] = 0.0  # Over the pause whole turns may be lost.
    np.testing.assert_allclose(apart, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ([0.0] * 50 + [4.0] + [0.0] * 50, "a spike is no turn"),
        ([0.0] * 50 + [3.5] * 50, "nor is a step"),
        ([-3.0] * 50 + [3.0] * 50, "of a joint at rest that leaves more than noise"),
        ([0.0] * 50 + [TURN] * 50 + [14.0] * 50, "nor what is wider than a turn"),
        ([1.0], "nor is a single sample"),
        (list(np.random.default_rng(0).uniform(-3.1, 3.1, 60)), "nor is a joint faster than its samples"),
        ([0.0, 1.0, 2.0, 3.0, -2.3], "nor is what five samples show"),
    ],
)
def test_other_jumps_stay(values: list[float], why: str) -> None:
    """They are faults for the checks to name."""
    angle = np.array(values)
    found, count = unwrap(angle, 0.02 * np.arange(angle.size, dtype=np.float64))
    assert count == 0 and np.array_equal(found, angle), why


def cartpole(pole: FloatArray, t: FloatArray, target: FloatArray) -> dict[str, FloatArray]:
    """Return the arrays of a recording of a cart-pole."""
    return {"time": t, "cart_pos": 0.1 * np.sin(3 * t), "cart_cmd": target, "pole_pos": pole}


def read(arrays: dict[str, FloatArray], **joints: Mapping[str, object]) -> tuple[Table, list[str]]:
    """Return the recording by a column map with these entries, and what was reported."""
    printed: list[str] = []
    listed: list[dict[str, object]] = [{"name": name, **entries} for name, entries in joints.items()]
    listed[-1]["target"] = "none"
    values = {"time": "time", "position": "{joint}_pos", "target": "{joint}_cmd", "joints": listed}
    (table,) = tables_of(
        [read_memory(arrays, "rec")], parse_column_map(values), None, printed.append, None, POLE
    )
    return table, printed


@pytest.mark.parametrize(("unit", "scale"), [("rad", 1.0), ("deg", 180 / np.pi)])
def test_an_import_says_that_it_unwraps(unit: str, scale: float) -> None:
    """In the file's unit; the sentence names file, joint and number of jumps, and the episode keeps them."""
    t, angle = swing(50.0)
    arrays = cartpole(folded(angle, -np.pi) * scale, t, 2 * np.sin(t))
    table, printed = read(arrays, cart={}, pole={"unit": unit})
    (sentence,) = [text for text in printed if "unwrapped" in text]
    count = np.count_nonzero(np.diff(np.floor((angle + np.pi) / TURN)))
    assert f"rec: the angle of pole jumps by a full turn {count} times" in sentence
    assert table.source["unwrapped"] == {"pole": count} and json.dumps(table.source)
    np.testing.assert_allclose(np.diff(table.position[:, 1]), np.diff(angle), atol=1e-9)


def test_nothing_is_interpolated_across_a_jump() -> None:
    """With stamps that jitter by 5 ms a sample at the seam lay anywhere between -pi and pi."""
    t, angle = swing(50.0)
    t = t + np.random.default_rng(0).uniform(-2.5e-3, 2.5e-3, t.size)
    angle = np.interp(t, *swing(2000.0, 6.1))
    table, _ = read(cartpole(folded(angle, -np.pi), t, 2 * np.sin(t)), cart={}, pole={})
    (part,) = to_trajectories(table)
    trajectory = part.trajectory
    assert trajectory.metadata["import"]["method"] == "interpolated"
    # 5 x 2 pi x 0.35 + 1.2 x 2 pi x 0.9 = 17.8 rad/s for 20 ms.
    assert np.max(np.abs(np.diff(trajectory.position[:, 1]))) < 0.36
    assert np.max(np.abs(trajectory.velocity[:, 1])) < 18


def test_a_slide_is_never_unwrapped() -> None:
    """6.2 m back in one sample is a fault of a slide's sensor, also where it looks like a turn."""
    t = np.arange(0, 6, 0.02)
    arrays = cartpole(0.3 * np.sin(t), t, 2 * np.sin(t)) | {"cart_pos": folded(2.0 * t, 0.0)}
    table, printed = read(arrays, cart={}, pole={})
    assert "unwrapped" not in table.source and not [text for text in printed if "unwrapped" in text]
    np.testing.assert_array_equal(table.position[:, 0], arrays["cart_pos"])


def test_commanded_angles_follow_the_measured_ones() -> None:
    """A wheel's servo: the folded command gets the turns that bring it nearest to the wheel."""
    t, angle = swing(100.0)
    arrays = {"time": t, "hub_pos": folded(angle, 0.0), "hub_cmd": folded(angle + 0.2, 0.0)}
    (table,) = tables_of([read_memory(arrays, "rec")])
    np.testing.assert_allclose(table.target - table.position, 0.2, atol=1e-9)


def test_a_slide_is_guessed_in_metres(tmp_path: Path) -> None:
    """Without a map the model's slide is in metres, in the table and in the printed map; rad was printed."""
    printed: list[str] = []
    path = tmp_path / "r.csv"
    path.write_text("time,cart_pos,cart_cmd,pole_pos\n0,0.1,2,0\n0.02,0.2,-2,0.1\n", encoding="utf-8")
    (table,) = load_tables(path, joints=("cart", "pole"), say=printed.append, kinds=POLE)
    assert table.units == ("m", "rad")
    (line,) = [text for text in printed if '"cart_pos"' in text]
    assert 'unit: "m"' in line and "target_unit" not in line
    assert load_tables(path, joints=("cart", "pole"))[0].units == ("rad", "rad")


def test_commands_within_one_are_asked_about() -> None:
    """Full power or newtons: the map must say it, and each answer gives its newtons."""
    t = np.arange(0, 6, 0.02)
    power = np.sin(t)
    arrays = cartpole(0.3 * np.sin(t), t, power)
    unsaid: list[Mapping[str, object]] = [{}, {"target_unit": "rad"}, {"unit": "m"}]
    for entries in unsaid:
        table, _ = read(arrays, cart=entries, pole={})
        found = command_kind(table, servo=False)
        assert found.severity is Severity.FAIL
        assert "{from: [-1, 1], to: [-2.62, 2.62]}" in found.message and "`target_unit: N`" in found.message
    scale = {"from": [-1, 1], "to": [-2.62, 2.62]}
    by_power, _ = read(arrays, cart={"target_normalised": scale, "sign": -1}, pole={})
    np.testing.assert_allclose(by_power.target[:, 0], -2.62 * power, atol=1e-12)
    assert "unsaid" not in by_power.source
    by_force, _ = read(arrays, cart={"target_unit": "N", "offset": 0.3}, pole={})
    np.testing.assert_array_equal(by_force.target[:, 0], power)
    # Larger commands, or none, leave no doubt.
    for scale_by in (2.0, 0.0):
        assert "unsaid" not in read(cartpole(power, t, scale_by * power), cart={}, pole={})[0].source


def test_a_motors_target_is_an_effort() -> None:
    """Neither the position's unit nor its offset changes a torque: it was multiplied by pi / 180."""
    t = np.arange(0, 6, 0.02)
    arrays = {"time": t, "hub_pos": 30 * np.sin(t), "hub_cmd": 3 * np.sin(t)}
    entries = {"name": "hub", "unit": "deg", "offset": 0.1, "sign": -1}
    values = {"time": "time", "position": "{joint}_pos", "target": "{joint}_cmd", "joints": [entries]}
    kinds = JointKinds(motors={"hub": 4.0})
    (table,) = tables_of([read_memory(arrays, "rec")], parse_column_map(values), kinds=kinds)
    np.testing.assert_allclose(table.target[:, 0], -3 * np.sin(t))
    np.testing.assert_allclose(table.position[:, 0], -np.pi / 6 * np.sin(t) + 0.1)
    slide = JointKinds(slides=frozenset({"hub"}))
    for unit, kind in (("deg", kinds), ("", slide)):
        mapped = parse_column_map(values | {"joints": [entries | {"target_unit": unit}]})
        with pytest.raises(ConfigurationError, match=r"is an effort|slides, but its unit is deg"):
            tables_of([read_memory(arrays, "rec")], mapped, kinds=kind)


def test_a_velocity_servos_target_is_a_speed() -> None:
    """It becomes an effort by the servo's gain: 4 N·m·s/rad; positions and efforts are refused."""
    t = np.arange(0, 6, 0.02)
    arrays = {"time": t, "hub_pos": 30 * np.sin(t), "hub_cmd": 30 * np.cos(t)}
    kinds = JointKinds(speeds={"hub": 4.0})

    def read(kinds: JointKinds | None, **entries: object) -> Table:
        joint = {"name": "hub", "unit": "deg", "offset": 0.1, "sign": -1, **entries}
        values = {"time": "time", "position": "{joint}_pos", "target": "{joint}_cmd", "joints": [joint]}
        return tables_of([read_memory(arrays, "rec")], parse_column_map(values), kinds=kinds)[0]

    np.testing.assert_allclose(read(kinds).target[:, 0], -120 * np.cos(t))
    in_degrees = read(kinds, target_unit="deg/s").target[:, 0]
    np.testing.assert_allclose(in_degrees, -4 * np.pi / 6 * np.cos(t))
    shares = read(kinds, target_normalised={"from": [-30, 30], "to": [-2, 2]}).target[:, 0]
    np.testing.assert_allclose(shares, -8 * np.cos(t))
    for unit in ("deg", "Nm"):
        with pytest.raises(ConfigurationError, match="its target is a speed; write target_unit: rad/s"):
            read(kinds, target_unit=unit)
    with pytest.raises(ConfigurationError, match="is a speed, but no velocity servo"):
        read(JointKinds(motors={"hub": 4.0}), target_unit="rad/s")
    with pytest.raises(ConfigurationError, match="is a speed, but no velocity servo"):
        read(None, target_unit="rad/s")
