"""Slips of the clocks inside a recording: found where there is one, silent on clean recordings."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.data.checks.slip import ALIKE, LEAST_S, Slip, find_slip, slip_verdict
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.findings import Severity
from deal_hw.testing.plain_robots import make_robot, record
from deal_hw.types import FloatArray

Recording = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"


def arm(seconds: float = 20.0, noise: float = 5e-4, seed: int = 0) -> Recording:
    """Return stamps, positions and commands of two servos at 50 Hz that follow 8 sines each, 30 ms late."""
    rng = np.random.default_rng(seed)
    step = 0.002
    time = np.arange(0.0, seconds, step)
    tones, phases = rng.uniform(0.2, 2.5, (2, 8)), rng.uniform(0, 2 * np.pi, (2, 8))
    wish = 0.1 * np.sin(2 * np.pi * tones[:, :, None] * time + phases[:, :, None]).sum(axis=1).T
    command = np.repeat(wish[::10], 10, axis=0)[: len(time)]
    x, v, seen = command[0].copy(), np.zeros(2), np.empty_like(command)
    for k in range(len(time)):
        seen[k] = x
        v = v + step * (400.0 * (command[max(k - 15, 0)] - x) - 28.0 * v)
        x = x + step * v
    return time[::10], seen[::10] + noise * rng.standard_normal(seen[::10].shape), time[::10], command[::10]


def slipped(recording: Recording, at: float, by_s: float) -> Recording:
    """Stamp the commands from a time on as sent earlier: the measurements follow them later by as much."""
    time, position, stamps, target = recording
    moved = np.where(stamps > at, stamps - by_s, stamps)
    order = np.argsort(moved, kind="stable")
    return time, position, moved[order], target[order]


def find(recording: Recording) -> Slip | None:
    """Look for a slip in a recording whose joints are all commanded."""
    return find_slip(*recording, np.arange(recording[3].shape[1]))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_clean_recordings_are_not_accused(seed: int) -> None:
    """Neither with the noise of an encoder nor without, nor with gaps."""
    for noise in (0.0, 5e-4):
        time, position, stamps, target = arm(noise=noise, seed=seed)
        verdict = slip_verdict(time, position, stamps, target, np.arange(2))
        assert verdict.severity is Severity.OK, verdict.message
        kept = (time < 5.0) | (time > 7.0)
        verdict = slip_verdict(time[kept], position[kept], stamps, target, np.arange(2))
        assert verdict.severity is Severity.OK, verdict.message


@pytest.mark.parametrize(("at", "by_s"), [(12.0, 0.06), (6.0, 0.04), (14.0, -0.05), (9.0, -0.02)])
def test_slip_is_found_and_measured(at: float, by_s: float) -> None:
    """Its place within two seconds, its size within one sampling period, both joints agree."""
    found = find(slipped(arm(), at, by_s))
    assert found is not None and found.clear > 0.5 and found.agree == 1.0
    inside = found.end_s > 19.0  # Up to the end, or from the beginning: the same thing from the other side.
    assert (found.begin_s if inside else found.end_s) == pytest.approx(at, abs=2.0)
    assert (1 if inside else -1) * found.later_s == pytest.approx(by_s, abs=0.021)


def test_glaring_slip_is_refused() -> None:
    """60 ms in brisk motion are refused; the message says where, how much and what to do."""
    verdict = slip_verdict(*slipped(arm(), 12.0, 0.06), np.arange(2))
    assert verdict.severity is Severity.FAIL
    assert "60 ms" in verdict.message and "leave one of the two parts out" in verdict.message


def test_shift_for_a_while_is_found() -> None:
    """Commands 60 ms early from 8 s to 12 s only."""
    time, position, stamps, target = arm()
    moved = np.where((stamps > 8.0) & (stamps < 12.0), stamps - 0.06, stamps)
    order = np.argsort(moved, kind="stable")
    verdict = slip_verdict(time, position, moved[order], target[order], np.arange(2))
    assert verdict.severity is not Severity.OK
    assert "60 ms later" in verdict.message and "--leave-out" in verdict.message


def test_short_and_still_recordings_say_nothing() -> None:
    """Under eight seconds, or without motion, there is too little to tell."""
    assert find(arm(seconds=6.0)) is None
    time, position, stamps, target = arm()
    assert find((time, 0 * position, stamps, target)) is None


@pytest.mark.parametrize(("by_s", "severity"), [(0.0, Severity.OK), (0.04, Severity.FAIL)])
def test_closed_loop_of_a_cart_pole(by_s: float, severity: Severity) -> None:
    """A balanced cart-pole, whose commands follow its own motion, is no slip; one of 40 ms is."""
    space = k9_space()
    for sensor in (False, True):
        made = simulated_episode(
            DESCRIPTION, space, space.nominal, seconds=12.0, latency_ticks=5, sensor=sensor, seed=3
        )
        recording = (made.device_s, made.position, made.sent_s, made.position_target)
        assert slip_verdict(*slipped(recording, 7.0, by_s), np.array([0])).severity is severity


@pytest.mark.parametrize(("kind", "seed"), [("pendulum", 2001), ("cart-pole", 2001), ("pendulum", 5)])
def test_backlash_is_not_refused(kind: str, seed: int) -> None:
    """Where motions are small, play delays them; the message says so, and the recording is used."""
    rows = list(csv.reader(io.StringIO(record(make_robot(kind, seed, "backlash"), 0, 12.0))))
    values = np.array(rows[1:], dtype=float)
    commands = [i for i, name in enumerate(rows[0]) if name.endswith(".command")]
    positions = [i for i in range(1, len(rows[0])) if i not in commands]
    actuated = np.array([rows[0][i].removesuffix(".command") for i in commands])
    joints = np.array([positions.index(rows[0].index(name)) for name in actuated])
    time = values[:, 0]
    found = find_slip(time, values[:, positions], time, values[:, commands], joints)
    assert found is not None and found.clear > 0.5 and found.alike < ALIKE
    verdict = slip_verdict(time, values[:, positions], time, values[:, commands], joints)
    assert verdict.severity is not Severity.FAIL
    assert "backlash looks similar" in verdict.message


def real(name: str) -> Recording:
    """Return a public recording of a real robot, where it is present."""
    path = REAL / name
    if not path.is_file():
        pytest.skip(f"{name} is not here: it is no part of the repository (docs name its source)")
    data = np.load(path)
    if "dof_pos" in data:
        time = data["time"] - data["time"][0]
        return time, data["dof_pos"], time, data["des_dof_pos"]
    start = data["time"][0]
    return data["time"] - start, data["position"], data["command_time"] - start, data["position_target"]


@pytest.mark.parametrize(
    "name",
    [
        "go2_suspended/train.npz",
        "so101/multisine.npz",
        "so101/prbs_excitation.npz",
        "so101/step_response.npz",
        "so101/friction_gravity.npz",
        "so101/slow_precision.npz",
        "so101/random_waypoints.npz",
    ],
)
def test_real_recordings_are_clean(name: str) -> None:
    """The suspended Go2 and motions of an SO-101, some with contacts, are not accused."""
    recording = real(name)
    verdict = slip_verdict(*recording, np.arange(recording[3].shape[1]))
    assert verdict.severity is Severity.OK, verdict.message


def test_slip_of_a_real_recording_is_found() -> None:
    """In the SO-101's chirp the clocks slipped near 110 s; without its end nothing is wrong."""
    time, position, stamps, target = real("so101/chirp_sweep.npz")
    found = find((time, position, stamps, target))
    assert found is not None and found.agree == 1.0 and abs(found.later_s) > LEAST_S and found.clear > 0.5
    assert found.end_s == pytest.approx(112.6, abs=8.0)
    kept = time < 105.0
    verdict = slip_verdict(time[kept], position[kept], stamps, target, np.arange(6))
    assert verdict.severity is Severity.OK, verdict.message
