"""Positions for motors and efforts for servos: refused with the suspected mistake."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.data.checks.command_kind import command_kind
from deal_hw.data.importing.columns import read_column_map
from deal_hw.data.importing.load import load_tables
from deal_hw.data.table import Table
from deal_hw.findings import Severity
from deal_hw.types import FloatArray

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
SERVOS = ("go2_suspended", "so101")
STEP_S = 0.002


def table(position: FloatArray, command: FloatArray) -> Table:
    """Return a recording at 50 Hz of joints that are all commanded."""
    names = tuple(f"joint{i}" for i in range(position.shape[1]))
    time = np.arange(len(position), dtype=np.float64) * 0.02
    return Table(
        joint_names=names,
        actuated=names,
        units=("rad",) * len(names),
        time_s=time,
        position=position,
        velocity=None,
        effort=None,
        command_s=time,
        target=command,
        orientation=None,
        gyro=None,
        source={"file": "r", "part": ""},
    )


def wish(seconds: float, seed: int) -> FloatArray:
    """Return sums of sines for two joints at 50 Hz, (T, 2)."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.02)
    tones, phases = rng.uniform(0.2, 1.5, (2, 5)), rng.uniform(0, 2 * np.pi, (2, 5))
    wave = np.sin(2 * np.pi * tones[:, :, None] * time + phases[:, :, None])
    return np.asarray(0.2 * wave.sum(axis=1).T)


def play(command: FloatArray, *, servo: bool, seed: int) -> FloatArray:
    """Simulate two joints of 0.02 kg·m², damped, with a weight, 10 ms late; return positions at 50 Hz."""
    x, v, seen = np.zeros(2), np.zeros(2), np.empty_like(command)
    sent = np.repeat(command, 10, axis=0)
    for k in range(len(sent)):
        if k % 10 == 0:
            seen[k // 10] = x
        u = sent[max(k - 5, 0)]
        torque = 20.0 * (u - x) - 0.8 * v if servo else u
        v = v + STEP_S / 0.02 * (torque - 0.05 * v - 0.3 * np.sin(x))
        x = x + STEP_S * v
    return np.asarray(seen + 5e-4 * np.random.default_rng(seed).standard_normal(seen.shape))


@pytest.mark.parametrize("gain", [0.15, 0.5])
def test_a_soft_servo_that_gravity_holds_back_is_no_effort(gain: float) -> None:
    """It moves less than a half of what was commanded; its friction and weight make it lag, too."""
    command = 1.5 * np.sin(2 * np.pi * 0.3 * np.arange(0.0, 10.0, 0.02))[:, None] * np.ones(2)
    x, v, seen = np.zeros(2), np.zeros(2), np.empty_like(command)
    for k in range(10 * len(command)):
        if k % 10 == 0:
            seen[k // 10] = x
        torque = gain * (command[k // 10] - x) - 0.3 * np.sin(x) - 0.05 * v
        v = v + STEP_S / 0.005 * torque
        x = x + STEP_S * v
    moved = float(np.ptp(seen) / np.ptp(command))
    assert 0.2 < moved < 0.75
    assert command_kind(table(seen, command), servo=True).severity is Severity.OK


@pytest.mark.parametrize("seed", range(4))
def test_positions(seed: int) -> None:
    """Fine for servos, refused for motors."""
    command = wish(12.0, seed)
    made = table(play(command, servo=True, seed=seed), command)
    assert command_kind(made, servo=True).severity is Severity.OK
    verdict = command_kind(made, servo=False)
    assert verdict.severity is Severity.FAIL and verdict.code == "actuation"
    assert "look like positions (joint0, joint1)" in verdict.message and "<position joint=" in verdict.message


@pytest.mark.parametrize("seed", range(4))
def test_torques(seed: int) -> None:
    """Fine for motors, refused for servos; random torques as well as smooth ones."""
    smooth = 0.6 * wish(12.0, seed)
    rough = np.repeat(np.random.default_rng(seed).uniform(-0.3, 0.3, (60, 2)), 10, axis=0)
    for command in (smooth, rough):
        made = table(play(command, servo=False, seed=seed), command)
        assert command_kind(made, servo=False).severity is Severity.OK
        verdict = command_kind(made, servo=True)
        assert verdict.severity is Severity.FAIL, command is smooth
        assert "look like efforts" in verdict.message and "<motor>" in verdict.message


def test_commands_beyond_the_ctrlrange() -> None:
    """Outside for most of the time is a refusal, for a tenth of it a warning, with the range in words."""
    command = wish(12.0, 0)
    made = table(play(command, servo=True, seed=0), command)
    narrow = np.tile([-0.05, 0.05], (2, 1))
    verdict = command_kind(made, servo=True, limits=narrow)
    assert verdict.severity is Severity.FAIL and "takes -0.05..0.05" in verdict.message
    edge = float(np.quantile(np.abs(command), 0.85))
    verdict = command_kind(made, servo=True, limits=np.tile([-edge, edge], (2, 1)))
    assert verdict.severity is Severity.WARN and "ctrlrange" in verdict.message
    assert command_kind(made, servo=True, limits=np.tile([-2.0, 2.0], (2, 1))).severity is Severity.OK


def test_still_joints_say_nothing() -> None:
    """A recording that hardly moves is neither."""
    still = table(np.full((300, 1), 0.1), np.full((300, 1), 0.1))
    assert command_kind(still, servo=True).severity is Severity.OK
    assert command_kind(still, servo=False).severity is Severity.OK


@pytest.mark.skipif(
    not REAL.is_dir(), reason="the public recordings are not here: they are no part of the repository"
)
@pytest.mark.parametrize(
    "path",
    sorted(path for robot in SERVOS for path in REAL.glob(f"{robot}/*.npz")),
    ids=lambda path: path.stem,
)
def test_real_servos(path: Path) -> None:
    """Recordings of real servos are positions, whatever the motion, and most joints say so to a motor."""
    legs = [f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
    (made,) = load_tables(path, joints=legs if "go2" in str(path) else None)
    assert command_kind(made, servo=True).severity is Severity.OK


@pytest.mark.parametrize("factor", [180 / np.pi, np.pi / 180, 1000.0])
def test_positions_in_another_unit_are_no_efforts(factor: float) -> None:
    """The check of the units says degrees or millimetres; "look like efforts" beside it is wrong."""
    command = wish(12.0, 0)
    made = table(factor * play(command, servo=True, seed=0), command)
    assert command_kind(made, servo=True).severity is Severity.OK


def test_a_slow_joint_that_follows_a_torque(tmp_path: Path) -> None:
    """A weight of 1 N·m/rad goes where a slow torque sends it; the column map says that it is a torque."""
    time = np.arange(0.0, 12.0, 0.02)
    torque = 0.6 * np.sin(2 * np.pi * 0.2 * time)
    rows = np.column_stack([time, np.arcsin(torque / 0.981), torque])
    recording = tmp_path / "slow.csv"
    np.savetxt(recording, rows, delimiter=",", header="time,arm_pos,arm_tau", comments="")
    columns = "time: time\nposition: '{joint}_pos'\ntarget: '{joint}_tau'\njoints: [arm]\n"
    verdicts = []
    for more in ("", "target_unit: Nm\n"):
        (tmp_path / "columns.yaml").write_text(columns + more, encoding="utf-8")
        (made,) = load_tables(recording, read_column_map(tmp_path / "columns.yaml"))
        verdicts.append(command_kind(made, servo=False))
    assert [verdict.severity for verdict in verdicts] == [Severity.FAIL, Severity.WARN]
    assert "write `target_unit: Nm`" in verdicts[0].message
    assert "map says Nm, so they are taken as efforts" in verdicts[1].message
